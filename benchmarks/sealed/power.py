"""What a sealed recording can show: lambda, gaps to rival names, noise floor.

Computed with the key, from the noise-free change e that an effect makes to the measurements, on the
plain model fitted to the recording with that change taken away (so that it is the truth about which
things are linear, and that its residuals are noise alone). With e whitened,

    lambda = |M e|^2 / variance  (over e' C e / e' e where the noise is correlated),

M the projector on what the plain model does not absorb, is the drop of chi-square that naming the
effect perfectly is expected to give. A hypothesis that gives the drop d on e is worse by
lambda - d: the gap. (MATHEMATICS 1.8.)
"""

from dataclasses import asdict, dataclass

import numpy as np
from names import Facts
from scipy.spatial.transform import Rotation

from jaxvm.discover.diagnose import ROOM
from jaxvm.discover.gross import without_gross_errors
from jaxvm.discover.heldout import Split, hold_out, split
from jaxvm.discover.ranking import Ranking
from jaxvm.discover.scatter import MOST_IMAGES, families_of_images
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import stacked
from jaxvm.discover.space import enumerate_hypotheses, member
from jaxvm.network.residual import whitening
from jaxvm.network.scene import Scene, build
from jaxvm.network.start import start
from jaxvm.recording import Recording
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.snooping import robust_variance

ROLL_DEG = 10.0

Change = tuple[np.ndarray, np.ndarray]
"""Change of pixels [observations, 2] (px) and of ranges [ranges] (m)."""


@dataclass(frozen=True)
class Power:
    """What one hidden effect could show.

    Attributes:
        expected_drop: lambda, with the noise that the recording really has.
        seen: share of |e|^2 that the plain model does not absorb.
        rms_px: RMS of e over fitted pixel coordinates.
        drops: largest drop on e by name (key of the catalogue); "" is for hypotheses without one.
        evidence: the same of drop - unknowns x ln n: a name with more unknowns pays for them.
    """

    expected_drop: float
    seen: float
    rms_px: float
    drops: dict[str, float]
    evidence: dict[str, float]


@dataclass(frozen=True)
class Shown:
    """What a recording can show: `effects` in the order of the key.

    Attributes:
        floor_px: held-out RMS of the plain model when nothing is hidden.
        variance: of unit weight, of the noise alone.
    """

    effects: tuple[Power, ...]
    floor_px: float
    variance: float
    facts: Facts

    def as_dict(self) -> dict:
        """Plain numbers for JSON."""
        return asdict(self)


def without(recording: Recording, pixels: np.ndarray, ranges: np.ndarray) -> Recording:
    """The recording with a change of its pixels (px) and ranges (m) taken away."""
    obs, own = recording.observations, recording.ranges
    parts = {"observations": _with(obs, pixel=obs.pixel - pixels)}
    if own is not None:
        parts["ranges"] = _with(own, distance=own.distance - ranges)
    return _with(recording, **parts)


def _with(record, **parts):
    return type(record)(**(vars(record) | parts))


def shown(recording: Recording, change: Change, each: list[Change], noise: dict) -> Shown:
    """What a recording can show of its hidden effects.

    Args:
        recording: as it was recorded.
        change: of the noise-free measurements by all effects together: pixels [observations, 2]
            (px) and ranges [ranges] (m).
        each: the same by each effect alone.
        noise: entry "noise" of the key.
    """
    base, parts = plain_fit(without(recording, *change))
    variance = robust_variance(base)
    effects: tuple[Power, ...] = ()
    if each:
        families = enumerate_hypotheses(base.scene)
        if len(base.scene.recording.time) <= MOST_IMAGES:
            # What differs from image to image is asked apart, but it is a rival like any other.
            families += families_of_images(base.scene)
        tests = ScoreTests.of(base, families)
        effects = tuple(_power(base, parts, tests, variance, noise, *own) for own in each)
    floor = parts.evaluate(base.scene).rms_px
    return Shown(effects, floor, variance, facts_of(base.scene))


def plain_fit(recording: Recording) -> tuple[Adjustment, Split]:
    """The plain model fitted to the epochs that are not held out, without gross errors."""
    scene = start(build(recording, ())).with_effects(recording.model.effects, ROOM)
    sound = tuple(np.ones(len(rows)) for rows in scene.tables)
    parts = split(scene, hold_out(scene), sound)
    base, parts, _ = without_gross_errors(parts.fit(scene), parts)
    return base, parts


def left_over(base: Adjustment, parts: Split, pixels, ranges) -> np.ndarray:
    """What the plain model leaves of a change when it is fitted to its own prediction plus that.

    Whitened [all observations, components], without noise. An effect that turns the whole scene is
    absorbed beyond first order, so nothing is linearised here.
    """
    scene, residuals, network = base.scene, base.residuals(), base.problem.network

    def unwhitened(factor, values, n: int) -> np.ndarray:
        scale, values = np.asarray(whitening(factor))[:n], np.asarray(values)[:n]
        return np.divide(values, scale, out=np.zeros_like(values), where=scale > 0.0)

    obs, own = scene.recording.observations, scene.recording.ranges
    pixel = obs.pixel + pixels
    for factor, rows, left in zip(network.pixels, scene.tables, residuals.pixels, strict=True):
        pixel[rows] += unwhitened(factor, left, len(rows))
    changed = {"observations": _with(obs, pixel=pixel)}
    if own is not None:
        left = unwhitened(network.ranges, residuals.ranges, len(own.distance))
        changed["ranges"] = _with(own, distance=own.distance + left.ravel() + ranges)
    plain = start(build(_with(scene.recording, **changed), ()))
    plain = plain.with_effects(scene.recording.model.effects, ROOM)
    return stacked(parts.fit(plain))


def whitened(base: Adjustment, components: int, pixels, ranges) -> np.ndarray:
    """A change of pixels (px) and ranges (m) like the residuals: [all observations, components]."""
    scene, blocks = base.scene, []
    network = base.problem.network
    for factor, rows in zip(network.pixels, scene.tables, strict=True):
        blocks.append(np.asarray(whitening(factor))[: len(rows)] * pixels[rows])
    if network.ranges is not None:
        n = network.ranges.n_real
        blocks.append(np.asarray(whitening(network.ranges))[:n] * ranges[:, None])
    return np.concatenate([np.pad(b, [(0, 0), (0, components - b.shape[1])]) for b in blocks])


def inflation(scene: Scene, effect: np.ndarray, noise: dict) -> float:
    """Variance of the score of an effect under the noise of the key, over that of white noise.

    Correlated noise has a share that each mark remembers, and one that each image shares, both
    autoregressive over epochs: lambda is smaller by e' C e / e' e.

    Args:
        scene: of the recording.
        effect: what the model does not absorb of it, whitened [pixel observations, 2].
        noise: entry "noise" of the key.
    """
    square = float(np.sum(effect**2))
    if noise["type"] != "correlated" or square == 0.0:
        return 1.0
    obs, n_epochs = scene.recording.observations, len(scene.recording.time)
    rows = np.concatenate(scene.tables)
    apart = np.abs(np.subtract.outer(np.arange(n_epochs), np.arange(n_epochs)))
    memory = np.exp(-apart / noise["memory_epochs"])
    mark = (obs.camera * scene.first_point[-1] + scene.first_point[obs.target] + obs.point)[rows]
    spread = 0.0
    for label, share in ((mark, noise["share"]), (obs.camera[rows], noise["image_share"])):
        series = np.zeros((n_epochs, int(label.max()) + 1, 2))
        np.add.at(series, (obs.epoch[rows], label), effect)
        spread += share * float(np.einsum("kmc,kl,lmc->", series, memory, series))
    white = 1.0 - noise["share"] - noise["image_share"]
    return white + spread / square


def _power(
    base: Adjustment,
    parts: Split,
    tests: ScoreTests,
    variance: float,
    noise: dict,
    pixels: np.ndarray,
    ranges: np.ndarray,
) -> Power:
    scene = base.scene
    full = float(np.sum(whitened(base, tests.arrangement.components, pixels, ranges) ** 2))
    left = left_over(base, parts, pixels, ranges)
    square = float(np.sum(left**2))
    n_pixels = sum(map(len, scene.tables))
    # Remembering noise makes effect and gaps count less, by one factor.
    spread = inflation(scene, left[:n_pixels], noise)
    variance = variance * spread
    alike = tests.score(variance, residual=left)
    drops, evidence = best_by_name(alike, scene, variance, np.log(np.count_nonzero(left)))
    return Power(
        expected_drop=square / variance,
        seen=square / full if full > 0.0 else 0.0,
        rms_px=float(np.sqrt(np.mean(np.asarray(pixels) ** 2))) if len(pixels) else 0.0,
        drops=drops,
        evidence=evidence,
    )


def best_by_name(
    ranking: Ranking, scene: Scene, variance: float, price: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Largest drop, and largest drop less `price` for each unknown, over hypotheses of each name.

    A hypothesis counts for each of its names.
    """
    drops: dict[str, float] = {}
    evidence: dict[str, float] = {}
    for scores in ranking.scores:
        family = scores.family
        # Between the points of a grid of constants, as the diagnosis itself sees its rivals.
        values = family.at_peaks(np.where(scores.valid, scores.drop, -np.inf)) / variance
        for index in sorted(family.with_best_constants(values)):
            drop = float(values[index])
            entries = member(family, index, scene).entries
            unknowns = family.n_terms * family.n_bases + len(family.courses[index[1]].constants)
            for name in [entry.id for entry in entries] or [""]:
                drops[name] = max(drops.get(name, 0.0), drop)
                evidence[name] = max(evidence.get(name, -np.inf), drop - unknowns * price)
    return drops, evidence


def facts_of(scene: Scene) -> Facts:
    """What of a fitted scene decides ties and places."""
    model, time = scene.model, scene.recording.time
    kinds = ("camera", "station", "target", "rangefinder")
    bodies = (model.cameras, model.stations, model.targets, model.rangefinders)
    names = {k: tuple(b.name for b in own) for k, own in zip(kinds, bodies, strict=True)}
    station_of = {body.name: body.station for body in (*model.cameras, *model.rangefinders)}
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return Facts(names, station_of, spacing, float(time[0]), rolled(scene), seers(scene))


def seers(scene: Scene) -> dict[str, tuple[str, ...]]:
    """The cameras that see each target."""
    model, obs = scene.model, scene.recording.observations
    seen = np.unique(np.stack([obs.target, obs.camera], axis=1), axis=0)
    return {
        target.name: tuple(model.cameras[c].name for c in seen[seen[:, 0] == t, 1])
        for t, target in enumerate(model.targets)
    }


def rolled(scene: Scene) -> bool:
    """Whether any target's x axis leaves the rows of any camera's image by over ROLL_DEG."""
    turn = {
        name: Rotation.from_rotvec(np.array(getattr(scene.state, name))[:, :3])
        for name in ("station_from_camera", "world_from_station", "carrier_from_target")
    }
    stations = [s.name for s in scene.model.stations]
    for c, camera in enumerate(scene.model.cameras):
        station = turn["world_from_station"][scene.station_row[stations.index(camera.station)]]
        camera_from_world = (station * turn["station_from_camera"][c]).inv()
        for rows in scene.target_row:
            x_axis = (camera_from_world * turn["carrier_from_target"][rows]).as_matrix()[..., 0]
            lean = np.abs(np.arctan2(x_axis[..., 1], np.abs(x_axis[..., 0])))
            if np.degrees(lean).max() > ROLL_DEG:
                return True
    return False
