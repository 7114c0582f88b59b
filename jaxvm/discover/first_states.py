"""What was before the recording: a lag starts from a state that nothing logged.

In equilibrium is what a lag without a state of its own assumes. Where the start does not show in
the residuals that is the simpler name, but it may be far from true, and the time constant and the
size then pay for it. So the last fit gives every such lag a state that is unknown within what its
driver did while it was logged: a prior, not a finding.
"""

from dataclasses import replace

import numpy as np

from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Channels, Effect, room_for
from jaxvm.physics.forms import FORMS

_LAGS = {"lag", "affine lag", "transient"}
"""Forms of one lag that starts in equilibrium."""


def with_first_states(scene: Scene) -> Scene:
    """The scene with an uncertain first state after all effects for each lag among them."""
    effects = scene.fitted_effects()
    names = [effect.name for effect in effects]
    states = [
        state
        for effect in effects
        if effect.form in _LAGS and names.count(effect.name) == 1
        for state in first_states(effect, scene.network.channels)
    ]
    everything = (*effects, *states)
    return scene.with_effects(everything, room_for(everything, scene.room)) if states else scene


def first_states(effect: Effect, channels: Channels) -> list[Effect]:
    """Where each term of a lag may have started, off equilibrium.

    The spread is the size of the term times the range of the driver: what it did before the
    recording was of that kind.
    """
    swing = float(np.ptp(np.asarray(channels.values)[channels.index(effect.driver)]))
    bases = FORMS[effect.form].bases
    sizes = np.reshape(effect.amplitudes, (len(effect.terms), len(bases)))[:, -1]
    return [
        replace(
            effect,
            name=f"{effect.name}: first state of {term.port}",
            terms=(term,),
            form="first state",
            amplitudes=(0.0,),
            catalogue_id="",
            spread=max(abs(float(size)) * swing, 1e-12),
            shares=effect.name,
        )
        for term, size in zip(effect.terms, sizes, strict=True)
    ]
