"""Identification: from a recording to models of how its cameras drift with temperature.

Two steps: trajectories of every camera (`jaxvm.identify.trajectories`), then dynamics from the
recorded inputs to these, of several structures, the simplest of which is taken that foretells
epochs that it was not fitted to as well as the best does. One step more is optional:
time constants and gains are refined together with all else that is free, through the residual of
the network and the noise of the pixels (`jaxvm.identify.one_step`).
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from jaxvm.discover.select import DECIDED
from jaxvm.identify.difference import Orders, fit_difference, is_even
from jaxvm.identify.gains import SLOWEST, Fit
from jaxvm.identify.inputs import RANGES, Inputs, inputs_of
from jaxvm.identify.lags import Lags, Structure, fit
from jaxvm.identify.model import CameraDrift, DriftModel, Trained
from jaxvm.identify.one_step import refined
from jaxvm.identify.trajectories import Trajectories, depths, trajectories
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.physics.drivers import POWER_ON, channel_kind
from jaxvm.recording import Recording
from jaxvm.solve.adjust import Adjustment, adjust

_FEWEST = 24
"""Epochs below which nothing is identified."""

_BLOCK, _FOLDS = 5, 5
"""Epochs in a block, and folds: each holds out every fifth block.

A block is short against what happens once, as a warm-up: the other blocks have to show it, too.
"""

_SHARE = 0.25
"""Share of what is left above the noise that a structure with more unknowns has to take away."""

_STILL = 0.05
"""An input that changes by less than this share of its range drives nothing."""

_LEAST_K = 0.3
"""Span of a temperature (K) below which nothing can be said about it."""

CONTINUOUS = (
    Structure(0),
    Structure(0, power=2),
    Structure(1),
    Structure(1, delayed=True),
    Structure(2),
    Structure(0, power=0),
)
DISCRETE = (
    Orders("ARX", 1, 1),
    Orders("ARX", 2, 2),
    Orders("output error", 1, 2),
    Orders("output error", 2, 3),
)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A structure that was tried.

    Attributes:
        name: of the structure.
        unknowns: number of its constants and gains.
        score: minus twice the logarithm of the density of what was held out, over that of noise.
    """

    name: str
    unknowns: int
    score: float


@dataclass(frozen=True, eq=False)
class Identified:
    """What came out for one camera.

    Attributes:
        drift: the model.
        trajectories: that it was identified on.
        fit: of the structure that was taken.
        candidates: all structures that were tried.
        warnings: in words.
    """

    drift: CameraDrift
    trajectories: Trajectories
    fit: Fit
    candidates: tuple[Candidate, ...]
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The chief numbers, for a file."""
        d = self.drift
        return {
            "camera": d.camera,
            "structure": self.fit.model.structure.name,
            "inputs": list(d.dynamics.inputs),
            "tau_s": d.dynamics.tau.tolist() if isinstance(d.dynamics, Lags) else None,
            "drift_px": d.drift_px,
            "held_out_px": d.held_out_px,
            "ports": list(d.ports),
            "held": list(d.held),
            "lasting": d.lasting(),
            "candidates": [asdict(candidate) for candidate in self.candidates],
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, eq=False)
class Identification:
    """What came out for a recording."""

    recording: Recording
    plain: Adjustment
    cameras: tuple[Identified, ...]

    @property
    def model(self) -> DriftModel:
        """Models of all cameras."""
        return DriftModel(tuple(own.drift for own in self.cameras))

    def summary(self) -> str:
        """A few lines for every camera."""
        lines = []
        for own in self.cameras:
            d, m = own.drift, own.drift.dynamics
            lines.append(
                f"camera {d.camera}: drift {d.drift_px:.3f} px RMS, foretold to "
                f"{d.held_out_px:.3f} px in epochs that were not fitted"
            )
            driven = f", of {', '.join(m.inputs)}" if m.gain.size else " that the inputs explain"
            lines.append(f"  dynamics   {m.structure.name}{driven}")
            if isinstance(m, Lags) and len(m.tau):
                taus = zip(m.tau, m.tau_sigma, strict=True)
                told = ", ".join(f"{t / 60.0:.3g} ± {s / 60.0:.2g} min" for t, s in taus)
                lines.append(f"  times      {told}")
            lines.append(f"  gauge      {own.trajectories.gauge()}")
            lines += [f"  warning    {text}" for text in own.warnings]
        return "\n".join(lines)


def identify(
    recording: Recording,
    structures: Sequence[Structure | Orders] | None = None,
    one_step: bool = True,
    progress: Callable[[str], None] = lambda line: None,
) -> Identification:
    """Identify how the cameras of a recording drift with what was logged.

    Args:
        recording: cameras that watch marks which stay, through a history of temperature.
        structures: to choose from; by default static ones, time constants, ARX and output error.
        one_step: whether constants and gains are refined through the residual of the network.
        progress: told what is going on.

    Raises:
        ValueError: nothing was logged, nothing changed, or there are too few epochs.
    """
    inputs = inputs_of(recording)
    _check(recording, inputs)
    progress("adjustment of the plain model")
    plain = adjust(start(build(recording, recording.model.effects)))
    found = []
    for camera in recording.model.cameras:
        if not np.any(recording.observations.camera == recording.model.cameras.index(camera)):
            continue
        progress(f"camera {camera.name}: trajectories")
        courses = trajectories(plain, camera.name)
        own = _own(inputs, recording, camera.name, courses)
        found.append(_identified(plain, courses, own, structures, progress))
    if one_step:
        progress("one step, through the residual of the network")
        better = refined(plain, [own.drift for own in found], inputs)
        found = [replace(own, drift=drift) for own, drift in zip(found, better, strict=True)]
    return Identification(recording, plain, tuple(found))


def _check(recording: Recording, inputs: Inputs) -> None:
    if len(recording.time) < _FEWEST:
        raise ValueError(
            f"there are {len(recording.time)} epochs; record at least {_FEWEST}, over several "
            "hours and a change of temperature"
        )
    if not inputs.names:
        raise ValueError(
            "there are no drivers and no power-on; add drivers.csv with temperatures, or "
            "powered_on_s to a camera"
        )
    seen = inputs.values[:, inputs.epoch]
    spans = {n: float(np.ptp(v)) for n, v in zip(inputs.names, seen, strict=True)}
    warm = {n: s for n, s in spans.items() if channel_kind(n) == "temperature"}
    powered = any(n.startswith(POWER_ON) and x.min() < 5.0 * 3600.0 for n, x in
                  zip(inputs.names, seen, strict=True))  # fmt: skip
    if warm and max(warm.values()) < _LEAST_K and not powered:
        name = max(warm, key=lambda n: warm[n])
        raise ValueError(
            f"no temperature changes ({name} by {warm[name]:.2g} K); record through a change of at "
            f"least a few kelvin"
        )


def _own(inputs: Inputs, recording: Recording, camera: str, courses: Trajectories) -> Inputs:
    """What may drive one camera, at the epochs of its trajectories, and does change."""
    others = {c.name for c in recording.model.cameras} - {camera}
    names = []
    for name in inputs.names:
        body = name.removeprefix(POWER_ON) if name.startswith(POWER_ON) else ""
        if name.startswith("body_"):
            body = name.removeprefix("body_").rsplit("_", 1)[0]
        x = inputs.row(name)[inputs.epoch]
        still = (
            np.all(x > 20.0 * 3600.0)
            if name.startswith(POWER_ON)
            else (np.ptp(x) < _STILL * RANGES.get(channel_kind(name), 0.0) or np.ptp(x) == 0.0)
        )
        if body not in others and not still:
            names.append(name)
    if not names:
        raise ValueError(f'nothing that drives camera "{camera}" changes; record a longer history')
    return replace(inputs.only(tuple(names)), epoch=inputs.epoch[courses.epoch])


def _identified(plain, courses: Trajectories, inputs: Inputs, structures, progress) -> Identified:
    n = len(courses.time)
    blocks = np.arange(n) // _BLOCK % _FOLDS
    if structures is None:
        structures = (*CONTINUOUS, *(DISCRETE if is_even(courses.time) else ()))
    fits: list[Fit] = []
    for structure in structures:
        progress(f"camera {courses.camera}: {structure.name}")
        data = inputs, courses.mode, courses.sigma
        if isinstance(structure, Structure):
            fits.append(fit(*data, structure, blocks, courses.large))
        else:
            fits.append(fit_difference(*data, structure, blocks, courses.large))
    chosen, candidates = _choice(fits)
    best = fits[chosen]
    trained = {
        name: Trained(float(x.min()), float(x.max()))
        for name, x in zip(inputs.names, inputs.values[:, inputs.epoch], strict=True)
    }
    m = best.model
    dynamics = replace(
        m,
        gain=courses.ports_from_mode @ m.gain,
        gain_sigma=np.sqrt(courses.ports_from_mode**2 @ m.gain_sigma**2),
    )
    noise = float(np.sum(courses.sigma**2)) / n
    excess = max(float(np.mean(best.held_out)) - courses.mode.shape[1], 0.0)
    moved = max(float(np.mean(np.sum(courses.mode**2, axis=1))) - noise, 0.0)
    px = courses.pixels_per_mode
    drift = CameraDrift(
        courses.camera, courses.ports, courses.held, dynamics, _depth(plain, courses.camera),
        trained, float(px * np.sqrt(excess)), float(px * np.sqrt(moved)),
        _focal(plain, courses.camera),
    )  # fmt: skip
    return Identified(drift, courses, best, candidates, tuple(_warnings(best, inputs, courses)))


def _choice(fits: list[Fit]) -> tuple[int, tuple[Candidate, ...]]:
    """The structure that held-out epochs ask for, from the fewest unknowns on.

    Another one has to win at 20:1, and to take away a fair share of what the simpler one leaves
    above the noise beyond chance: where no structure is right, errors go on from epoch to epoch,
    odds overstate, and what explains a little more of one history foretells less of another.
    """
    score = np.array([one.held_out.sum() for one in fits])
    noise = np.array([one.courses.size for one in fits])
    excess = np.maximum(score - noise - 2.0 * np.sqrt(2.0 * noise), 0.0)
    order = sorted(range(len(fits)), key=lambda k: fits[k].unknowns)
    chosen = order[0]
    for k in order[1:]:
        won = score[k] < score[chosen] - DECIDED
        if won and excess[k] < (1.0 - _SHARE) * excess[chosen]:
            chosen = k
    return chosen, tuple(
        Candidate(one.model.structure.name, one.unknowns, float(own))
        for one, own in zip(fits, score, strict=True)
    )


def _depth(plain: Adjustment, camera: str) -> float:
    """Mean distance (m) along the axis of the marks that a camera sees."""
    obs = plain.scene.recording.observations
    own = obs.camera == [c.name for c in plain.scene.model.cameras].index(camera)
    return float(np.mean(depths(plain.scene)[own]))


def _focal(plain: Adjustment, camera: str) -> float:
    """Mean focal length (px) that the recording gives a camera; 0 where it gives none."""
    given = next(c.focal_px for c in plain.scene.model.cameras if c.name == camera)
    return 0.0 if given is None else float(np.mean(given))


def _warnings(best: Fit, inputs: Inputs, courses: Trajectories) -> list[str]:
    found = list(inputs.warnings)
    model, n = best.model, len(courses.time)
    span = float(courses.time[-1] - courses.time[0])
    if isinstance(model, Lags):
        found += [
            f"the time constant of {tau / 3600.0:.2g} h is the longest that {span / 3600.0:.3g} h "
            "can show; record longer"
            for tau in model.tau
            if tau > 0.9 * span / SLOWEST
        ]
        if model.delay < -3.0 * model.delay_sigma and model.structure.delayed:
            found.append(
                f"images are ahead of the log by {-model.delay:.3g} ± {model.delay_sigma:.2g} s; "
                "are the clocks one?"
            )
    chi = float(np.sum(best.chi)) / max(n * courses.mode.shape[1] - best.unknowns, 1)
    if chi > 1.5:
        found.append(
            f"what the model leaves is {np.sqrt(chi):.2g} times the noise; something else moves "
            "the image, jaxvm diagnose may name it"
        )
    return found
