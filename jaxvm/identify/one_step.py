"""One step: constants and gains of drift models refined through the residual of the network.

A model of time constants is a list of effects: every input at once and behind every lag, on all
ports of a camera. They are adjusted together with everything that is free, with the noise of the
pixels. Lags of one camera share their time constants; means, and the states that lags begin with,
are nuisance effects and are dropped afterwards.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxvm.identify.gains import LOOSE
from jaxvm.identify.inputs import Inputs
from jaxvm.identify.lags import Lags, regressors
from jaxvm.identify.model import CameraDrift
from jaxvm.identify.trajectories import CAMERA_PORTS
from jaxvm.network.scene import Scene, build
from jaxvm.network.state import State
from jaxvm.physics.drivers import POWER_ON
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording import Drivers, Recording
from jaxvm.solve.adjust import Adjustment, adjust
from jaxvm.solve.covariance import standard_deviations

ENOUGH = 1e-8
"""Change of the cost that ends the adjustment: with 20,000 residuals no unknown moves by more than
0.015 of its standard deviation then.

Two time constants that are nearly one lie in a valley so flat that a sharper rule walks for ever.
"""


def refined(plain: Adjustment, drifts: list[CameraDrift], inputs: Inputs) -> list[CameraDrift]:
    """The drift models of all cameras, adjusted together.

    Models in discrete time, and static parabolas, are no effects of the network; they stay as they
    are.
    """
    if not any(map(is_effects, drifts)):
        return drifts
    found = adjusted(plain, drifts, inputs)
    if found.failed:
        return drifts
    deviations = standard_deviations(found, found.unit_variance)
    return [
        _read_back(drift, inputs, found.scene, deviations) if is_effects(drift) else drift
        for drift in drifts
    ]


def is_effects(drift: CameraDrift) -> bool:
    """Whether a drift model is a list of effects."""
    return isinstance(drift.dynamics, Lags) and drift.dynamics.structure.power == 1


def adjusted(plain: Adjustment, drifts: list[CameraDrift], inputs: Inputs) -> Adjustment:
    """Adjustment of a scene together with the drift models that are effects, begun at these."""
    recording, effects = plain.scene.recording, list[Effect]()
    for drift in filter(is_effects, drifts):
        assert isinstance(drift.dynamics, Lags)
        recording = _with_late_channels(recording, drift.dynamics)
        effects += _effects(drift, inputs.only(drift.dynamics.inputs).ranges())
    scene = replace(build(recording, ()), state=plain.scene.state)
    scene = scene.with_effects((*recording.model.effects, *effects))
    return adjust(scene, rtol=ENOUGH, check=False, repeats=0)


def _late(name: str, delay: float) -> str:
    return name if delay == 0.0 or name.startswith(POWER_ON) else f"{name} {delay:.1f} s late"


def _with_late_channels(recording: Recording, model: Lags) -> Recording:
    """The recording with delayed inputs as channels of their own."""
    if model.delay == 0.0 or recording.drivers is None:
        return recording
    time, channels = recording.drivers.time, dict(recording.drivers.channels)
    for name in model.inputs:
        if name in channels:
            channels[_late(name, model.delay)] = np.interp(time - model.delay, time, channels[name])
    return replace(recording, drivers=Drivers(time, channels))


def _effects(drift: CameraDrift, ranges: Float[np.ndarray, " inputs"]) -> list[Effect]:
    """Effects in the order of the regressors, then the nuisance ones."""
    model = drift.dynamics
    assert isinstance(model, Lags)
    scope = Scope(camera=(drift.camera,))
    # Amplitudes count in large drifts, so that one width serves all ports.
    sizes = np.array([CAMERA_PORTS[port] for port in drift.ports])
    terms = tuple(Term(port, weight=size) for port, size in zip(drift.ports, sizes, strict=True))
    found: list[Effect] = []
    gain = iter(model.gain.T)

    def add(name, driver, form, constants=(), reference=0.0, of="", values=None, spread=1.0):
        own = np.zeros(len(terms)) if values is None else values / sizes
        if form == "lag with state":
            own = np.column_stack([own, 0.0 * own]).ravel()
        found.append(
            Effect(f"{drift.camera}: {name}", terms, driver, form, constants, reference, scope,
                   tuple(own), spread=spread, shares=of)
        )  # fmt: skip

    inputs = list(zip(model.inputs, model.reference, LOOSE / ranges, strict=True))
    for name, reference, spread in inputs:
        if name.startswith(POWER_ON):
            add(name, name, "step", (0.0,), values=next(gain), spread=spread)
        else:
            driver = _late(name, model.delay)
            add(name, driver, "linear", (), reference, values=next(gain), spread=spread)
    for k, tau in enumerate(model.tau):
        first, begun = "", False
        for name, reference, spread in inputs:
            own, constants = f"{name}, lag {k + 1}", (float(tau),)
            if name.startswith(POWER_ON):
                add(own, name, "onset", constants, 0.0, first, next(gain), spread)
            else:
                form = "lag" if begun else "lag with state"
                driver, begun = _late(name, model.delay), True
                add(own, driver, form, constants, reference, first, next(gain), spread)
            first = first or f"{drift.camera}: {own}"
    add("mean", "constant", "constant", spread=10.0)
    return found


@dataclass(frozen=True)
class Places:
    """Where the gains and time constants of a drift model are in the state of a scene.

    Attributes:
        gain: places among the amplitudes [ports, regressors].
        tau: places among the constants.
        size: of a unit of an amplitude in each port's unit.
    """

    gain: Int[np.ndarray, "ports regressors"]
    tau: Int[np.ndarray, " order"]
    size: Float[np.ndarray, " ports"]

    @classmethod
    def of(cls, drift: CameraDrift, scene: Scene) -> "Places":
        """Of a model that is among the effects of a scene (`adjusted`)."""
        model = drift.dynamics
        assert isinstance(model, Lags)
        own = {e.name: (e, *at) for e, at in zip(scene.effects, scene.places(), strict=True)}
        names = [f"{drift.camera}: {name}" for name in model.inputs]
        lagged = [f"{drift.camera}: {name}, lag {k + 1}" for k in range(len(model.tau))
                  for name in model.inputs]  # fmt: skip
        gain = []
        for effect, columns, _ in (own[name] for name in names + lagged):
            # Of every port the first basis; the second is a state.
            every = 2 if effect.form == "lag with state" else 1
            gain.append(np.arange(columns.start, columns.stop, every))
        tau = [own[name][2].start for name in lagged[:: len(model.inputs)]]
        size = np.array([CAMERA_PORTS[port] for port in drift.ports])
        return cls(np.stack(gain, axis=1), np.array(tau, int), size)


def _read_back(drift: CameraDrift, inputs: Inputs, scene: Scene, deviations: State) -> CameraDrift:
    model, at = drift.dynamics, Places.of(drift, scene)
    assert isinstance(model, Lags)

    def values(state: State) -> tuple[np.ndarray, np.ndarray]:
        gain = np.asarray(state.amplitude)[at.gain] * at.size[:, None]
        return gain, np.asarray(state.constant)[at.tau]

    gain, tau = values(scene.state)
    spread, tau_sigma = values(deviations)
    order = np.argsort(tau)
    m = len(model.inputs)
    columns = np.concatenate([np.arange(m), *(m + m * k + np.arange(m) for k in order)]).astype(int)
    own = inputs.only(model.inputs)
    centre = regressors(own, model.reference, model.structure, tau[order], model.delay).mean(axis=0)
    return replace(
        drift,
        dynamics=replace(model, tau=tau[order], tau_sigma=tau_sigma[order], gain=gain[:, columns],
                         gain_sigma=spread[:, columns], centre=centre),
    )  # fmt: skip
