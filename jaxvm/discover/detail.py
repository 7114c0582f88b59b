"""Maps in as much detail as the held-out epochs allow: for what is fixed in the image or the plate.

A coarse map, or several names for one camera's image that only together come near, are replaced by
one map with fine tiles. So many tiles need a prior, as in least-squares collocation: all have the
same spread, and the map itself shows how large it is (empirical Bayes).
"""

from dataclasses import replace

import numpy as np

from jaxvm.discover.courses import Course
from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.groups import Group
from jaxvm.discover.heldout import HeldOut, Split, gain
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.revise import given_effects
from jaxvm.network.scene import Scene
from jaxvm.physics.catalogue.maps import fine_plate_map, finest_image_map
from jaxvm.physics.effects import Effect, room_for
from jaxvm.solve.adjust import Adjustment, adjust
from jaxvm.solve.covariance import effect_deviations

_IMAGE = {"radius", "image_x", "image_y", "row", "column", "image", "fine image"}
_PLATE = {"plate", "target_x", "target_y"}

_FIRST_SPREAD = {"camera": 0.3, "target": 3e-4}
"""Spread of the tiles to begin with (px; m)."""

_RTOL, _MAX_STEPS = 1e-5, 6
"""A map enters linearly: few steps do."""


def with_detail(
    current: Adjustment, heldout: HeldOut, findings: list[Finding], parts: Split, seed: int
) -> tuple[Adjustment, HeldOut, list[Finding]]:
    """The model with maps in detail where the held-out epochs prove them better."""
    for entity, drivers, tiles in (
        ("camera", _IMAGE, finest_image_map()),
        ("target", _PLATE, fine_plate_map()),
    ):
        for scope in dict.fromkeys(f.effect.scope for f in findings):
            members = [f for f in findings if f.effect.scope == scope and _fixed(f.effect, drivers)]
            # A name that does alone needs no map.
            if len(members) < 2 and all(f.hypothesis.entries for f in members):
                continue
            given = given_effects(current, findings)
            kept = [k for k, f in enumerate(findings) if not any(f is m for m in members)]
            effects = current.scene.fitted_effects()
            others = (*effects[:given], *(effects[given + k] for k in kept))
            hypothesis = Hypothesis(Group(tiles, entity), Course("constant", "constant"), scope, ())
            tried = _mapped(current.scene, others, hypothesis, parts)
            tried, shown = parts.proven(tried)
            proof = gain(heldout, shown, seed)
            if tried.failed or not proof.proven:
                continue
            # What the map explains is what nothing did without any of its members.
            bare = current.scene.with_effects(others, current.scene.room)
            strongest = max(members, key=lambda f: f.drop)
            effect = tried.scene.fitted_effects()[-1]
            found = replace(
                strongest,
                hypothesis=hypothesis,
                effect=effect,
                final_effect=effect,
                stds=effect_deviations(tried)[-1],
                weight=1.0,
                others=(),
                rivals=(),
                drop=sum(f.drop for f in members),
                after=parts.residuals(tried),
                gain=gain(parts.proven(parts.fit(bare))[1], shown, seed),
            )
            current, heldout = tried, shown
            findings = [*(findings[k] for k in kept), found]
    return current, heldout, findings


def _fixed(effect: Effect, drivers: set[str]) -> bool:
    """Whether an effect is a pattern that is fixed in the image, or in the plate."""
    return effect.driver == "constant" and any(term.driver in drivers for term in effect.terms)


def _mapped(
    scene: Scene, others: tuple[Effect, ...], hypothesis: Hypothesis, parts: Split
) -> Adjustment:
    """The fit with a map in detail, its tiles' spread estimated on the way."""
    entity, n = hypothesis.group.entity, len(hypothesis.group.terms)

    def fit(spread: float) -> Adjustment:
        effects = (*others, replace(hypothesis.effect((0.0,) * n), spread=spread))
        return adjust(
            scene.with_effects(effects, room_for(effects, scene.room)),
            weights=parts.weights,
            range_weights=parts.range_weights,
            rtol=_RTOL,
            damping=1e-6,
            max_steps=_MAX_STEPS,
            repeats=0,
            check=False,
        )

    tiles = np.asarray(fit(_FIRST_SPREAD[entity]).scene.fitted_effects()[-1].amplitudes)
    return fit(float(np.sqrt(np.mean(tiles**2))))
