"""The double chain: every way of joining its two chains, case by case, predicted and drawn.

The estimates of `jaxvm.pose.double_chain`, and two between the mean at the far end and the
adjustment: the mean link by link. Each link out is averaged with the link home beside it, carried
over the rungs of its two stations, and the averaged links are composed. With full covariances the
mean knows that a turn error of the link home moves its far end too; with variances alone it does
not.
"""

from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from intervals import gain, rms
from marks import FRONTAL, LENGTH, TILTED, Plate, double, isotropic, pictured

from jaxvm.geometry import (
    Pose,
    pose_from_vector,
    se3_exp,
    so3_exp,
    vector_from_pose,
)
from jaxvm.pose.chains import Link, compose, drawn, pose_error
from jaxvm.pose.double_chain import DoubleChain, far_covariance, far_errors

SEED = 2
LINKS = 10
RUNG = isotropic(10e-6, 5e-6)
EVEN = isotropic(20e-6, 0.2e-3)
ESTIMATES = ("single", "naive", "classic", "weighted", "by_variances", "by_link", "adjusted")
WORDS = {
    "single": "single chain",
    "naive": "mean, equal weights",
    "classic": "classic mean (variances)",
    "weighted": "mean, full covariances",
    "by_variances": "link by link, variances",
    "by_link": "link by link, full covariances",
    "adjusted": "adjusted",
}


@dataclass(frozen=True)
class Case:
    """A double chain, and what its weights are made of where that is not the truth.

    Attributes:
        what: the case in words.
        group: where it belongs in the tables.
        factor: noise and arrangement, where the case is one of the factorial design.
    """

    group: str
    what: str
    chain: DoubleChain
    believed: DoubleChain | None = None
    factor: tuple[str, str] | None = field(default=None)


def cases() -> list[Case]:
    """All that the tables show."""
    return _factorial() + _what_multiplies() + _stations() + _weights()


def _factorial() -> list[Case]:
    noises = {
        "isotropic": EVEN,
        "tilted plates": TILTED.covariance(),
        "frontal plates": FRONTAL.covariance(),
    }
    ways = {
        "no levers": dict(length=0.0, apart=0.0),
        "levers, same ends": dict(opposite=False),
        "levers, opposite ends": {},
    }
    return [
        Case("noise and arrangement", f"{noise}, {way}",
             double(LINKS, covariance, covariance, RUNG, **own), factor=(noise, way))
        for noise, covariance in noises.items() for way, own in ways.items()
    ]  # fmt: skip


def _what_multiplies() -> list[Case]:
    sharp = isotropic(TILTED.tilt, TILTED.lateral)
    # As anisotropic as a plate and more, in depth alone: across and tilt are those of `EVEN`.
    deep = Plate(0.2e-3, 12e-3, 20e-6, 20e-6).covariance()
    coarse = Plate(1.7e-3, 12e-3, 17e-6, 0.17e-3).covariance()
    real = pictured(10.0)
    listed = [
        ("isotropic of a plate's tilt and lateral (0.17 mrad, 10 µm), opposite ends", sharp, True),
        ("the same, same ends", sharp, False),
        ("depth 60 times worse than across (20 µrad, 0.2 mm, 12 mm), opposite ends", deep, True),
        (
            "tilt 10 times worse than roll, but across 1.7 mm = tilt · L, opposite ends",
            coarse,
            True,
        ),
        ("tilted plate, all correlations of its picture, opposite ends", real, True),
        ("the same, same ends", real, False),
    ]
    return [
        Case("what multiplies", what, double(LINKS, c, c, RUNG, opposite=opposite))
        for what, c, opposite in listed
    ]


def _stations() -> list[Case]:
    plates = TILTED.covariance()
    return [
        Case("stations", f"tilted plates, {way}, rungs {rung}",
             double(LINKS, plates, plates, isotropic(*sigma), opposite=opposite))
        for rung, sigma in (("10 µrad, 5 µm", (10e-6, 5e-6)), ("100 µrad, 0.05 mm", (1e-4, 5e-5)),
                            ("1 mrad, 0.5 mm", (1e-3, 5e-4)))
        for way, opposite in (("opposite ends", True), ("same ends", False))
    ]  # fmt: skip


def _weights() -> list[Case]:
    plates, even = TILTED.covariance(), isotropic(TILTED.roll, TILTED.depth)
    chain = double(LINKS, plates, plates, RUNG)
    return [
        Case("weights", "isotropic, home 3 times worse, opposite ends",
             double(LINKS, EVEN, 9 * EVEN, RUNG)),
        Case("weights", "tilted plates, home 3 times worse, opposite ends",
             double(LINKS, plates, 9 * plates, RUNG)),
        Case("weights", "the same, both believed equal",
             double(LINKS, plates, 9 * plates, RUNG), chain),
        Case("weights", "tilted plates, opposite ends, believed isotropic (63 µrad, 0.63 mm)",
             chain, double(LINKS, even, even, RUNG)),
    ]  # fmt: skip


def across(error: np.ndarray) -> np.ndarray:
    """Squares of the position across chains along x, mean of the two directions (m^2)."""
    return np.mean(error[..., 4:] ** 2, axis=-1)


@eqx.filter_jit
def by_link_errors(chain: DoubleChain, believed: DoubleChain, key, trials: int):
    """Errors of the far end of the two means link by link: the draws are those of `far_errors`."""
    truth, shares = compose(chain.out).pose, _link_shares(believed)

    def once(key):
        links = drawn(chain.links(), key)
        ends = (_by_link(links.pose, share) for share in shares)
        return tuple(pose_error(vector_from_pose(end), truth) for end in ends)

    return jax.lax.map(once, jax.random.split(key, trials), batch_size=100)


@eqx.filter_jit
def by_link_covariances(chain: DoubleChain, believed: DoubleChain):
    """First-order covariances of the same, in the axes of the first body.

    By central differences along the principal axes of every link's errors, a standard deviation
    long: no smaller than the rounding, and of second order alone in what it neglects.
    """
    links, truth = chain.links(), compose(chain.out).pose
    count = len(links.pose)
    roots = jnp.linalg.cholesky(links.covariance)
    steps = jnp.zeros((count, 6, count, 6)).at[jnp.arange(count), :, jnp.arange(count)]
    steps = steps.set(roots.swapaxes(1, 2)).reshape(6 * count, count, 6)

    def error(twists, shares):
        def measure(pose, twist):
            return vector_from_pose(pose_from_vector(pose) @ se3_exp(twist))

        end = _by_link(jax.vmap(measure)(links.pose, twists), shares)
        return pose_error(vector_from_pose(end), truth)

    def spread(shares):
        ends = [jax.vmap(lambda t: error(t, shares))(sign * steps) for sign in (1.0, -1.0)]
        slope = 0.5 * (ends[0] - ends[1])
        return slope.T @ slope

    return jax.lax.map(spread, jnp.stack(_link_shares(believed)))


def _beside(home: Link, near: Link, far: Link) -> Link:
    """The link from station to station by way of the body home: over the rungs."""
    return near.then(home.back()).then(far.back())


def _link_shares(believed: DoubleChain):
    """How much of the way from each link out to that beside it: by variances, by covariances."""
    rungs = believed.rungs
    near, far = (jax.tree.map(lambda x, s=s: x[s], rungs) for s in (slice(0, -1), slice(1, None)))
    out = believed.out.covariance
    home = jax.vmap(_beside)(believed.home, near, far).covariance
    variances = jnp.diagonal(out, axis1=1, axis2=2), jnp.diagonal(home, axis1=1, axis2=2)
    alone = jax.vmap(jnp.diag)(variances[0] / (variances[0] + variances[1]))
    full = jnp.linalg.solve(out + home, out).transpose(0, 2, 1)
    return alone, full


def _by_link(poses, shares) -> Pose:
    """Far end of the averaged links of a double chain, from the poses in the order of `links`."""
    k = len(shares)
    out, home, rungs = poses[:k], poses[k : 2 * k], poses[2 * k :]

    def average(out, home, near, far, share):
        own, back, first, last = map(pose_from_vector, (out, home, near, far))
        other = first @ back.inverse() @ last.inverse()
        apart = own.inverse() @ other
        turn, shift = jnp.split(share @ pose_error(vector_from_pose(apart), jnp.zeros(6)), 2)
        return vector_from_pose(own @ Pose(so3_exp(turn), shift))

    averaged = jax.vmap(average)(out, home, rungs[:-1], rungs[1:], shares)
    end = compose(Link(averaged, jnp.zeros((k, 6, 6)))).pose
    return pose_from_vector(end)


def one(case: Case, trials: int) -> dict:
    """Deviations of the far end by every estimate, predicted and drawn, and gains."""
    believed = case.chain if case.believed is None else case.believed
    key = jax.random.key(SEED)
    ends = far_errors(case.chain, key, trials, believed)
    between = by_link_errors(case.chain, believed, key, trials)
    errors = {name: np.asarray(x) for name, x in zip(ends._fields, ends, strict=True)}
    errors |= dict(zip(("by_variances", "by_link"), map(np.asarray, between), strict=True))
    squares = {name: across(errors[name]) for name in ESTIMATES}
    row = {
        "group": case.group,
        "case": case.what,
        "factor": case.factor,
        "rung_rad": float(jnp.sqrt(case.chain.rungs.covariance[0, 0, 0])),
        "measured_m": {name: rms(x) for name, x in squares.items()},
        "gain": {
            f"{a}/{b}": gain(squares[a], squares[b])
            for a, b in (("single", "adjusted"), ("naive", "adjusted"), ("classic", "adjusted"),
                         ("weighted", "adjusted"), ("classic", "weighted"), ("naive", "weighted"),
                         ("weighted", "by_link"), ("weighted", "by_variances"))
        },
    }  # fmt: skip
    row["turn_gain"] = gain(*(np.mean(errors[name][:, 1:3] ** 2, axis=1)
                              for name in ("weighted", "adjusted")))  # fmt: skip
    row["predicted_m"] = predicted(case.chain) if case.believed is None else None
    return row


def predicted(chain: DoubleChain) -> dict:
    """First-order deviation across of every estimate (m), weights being right."""
    ends = far_covariance(chain)
    spread = dict(zip(ends._fields, ends, strict=True))
    spread |= dict(zip(("by_variances", "by_link"), by_link_covariances(chain, chain), strict=True))
    return {
        name: float(np.sqrt(np.mean(np.diagonal(np.asarray(spread[name]))[4:])))
        for name in ESTIMATES
    }


def predicted_gain(chain: DoubleChain) -> float:
    """Adjusted over the mean with full covariances, across, to first order."""
    ends = far_covariance(chain)
    weighted, adjusted = (np.diagonal(np.asarray(x))[4:] for x in (ends.weighted, ends.adjusted))
    return float(np.sqrt(weighted.mean() / adjusted.mean()))


def pointing(noise_turn: float, noise_across: float, rung_turn: float, length: float) -> float:
    """Rule of thumb for the gain of the adjustment over the mean with full covariances.

    A mean of both chains has turn errors of s_t / sqrt(2) a link. Both directions of a line of
    sight give the turn from one station's body to the next without any measured attitude, with
    s_p^2 = rung^2 + 2 (across / L)^2; the two are independent to speak of, so that the gain is
    sqrt(1 + s_t^2 / (2 s_p^2)).
    """
    square = rung_turn**2 + 2.0 * (noise_across / length) ** 2
    return float(np.sqrt(1.0 + noise_turn**2 / (2.0 * square)))


def ratios(count: int) -> dict:
    """Gain predicted against tilt . L / across, for noise isotropic and of plates."""
    ratio = np.geomspace(0.1, 300.0, count)
    # Rungs as good as the pointing: far better ones are beyond the digits of `adjust_relay`.
    length, across_m, turn = LENGTH, 0.1e-3, 10e-6
    rung = isotropic(turn, 0.5 * across_m)
    rows = {}
    for noise in ("isotropic", "plates"):
        for way, opposite in (("same ends", False), ("opposite ends", True)):
            values = []
            for q in ratio:
                tilt = q * across_m / length
                spread = (
                    isotropic(tilt, across_m)
                    if noise == "isotropic"
                    else Plate(across_m, 63 * across_m, tilt / 10, tilt).covariance()
                )
                values.append(
                    predicted_gain(double(LINKS, spread, spread, rung, opposite=opposite))
                )
            rows[f"{noise}, {way}"] = values
    rule = [pointing(q * across_m / length, across_m, turn, length) for q in ratio]
    return {"ratio": ratio.tolist(), "gain": rows, "rule": rule}


def rungs(count: int) -> dict:
    """Gain predicted against the deviations of the stations' calibrations."""
    sigma = np.geomspace(1e-6, 10e-3, count)
    listed = {
        "isotropic, no levers": (EVEN, dict(length=0.0, apart=0.0)),
        "isotropic, opposite ends": (EVEN, {}),
        "tilted plates, same ends": (TILTED.covariance(), dict(opposite=False)),
        "tilted plates, opposite ends": (TILTED.covariance(), {}),
        "frontal plates, opposite ends": (FRONTAL.covariance(), {}),
    }
    rows = {}
    for name, (spread, way) in listed.items():
        values = []
        for s in sigma:
            # As good in position as their turn over half a metre.
            station = isotropic(s, 0.5 * s)
            values.append(predicted_gain(double(LINKS, spread, spread, station, **way)))
        rows[name] = values
    return {"sigma_rad": sigma.tolist(), "gain": rows}


def study(trials: int, points: int) -> dict:
    """All cases and both curves."""
    return {
        "seed": SEED,
        "trials": trials,
        "links": LINKS,
        "rows": [one(case, trials) for case in cases()],
        "ratios": ratios(points),
        "rungs": rungs(points),
    }
