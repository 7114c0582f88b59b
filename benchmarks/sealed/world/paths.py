"""How targets move: fast trajectories in continuous time, slow ones from epoch to epoch."""

from dataclasses import dataclass

import numpy as np

from .rotation import matrix


@dataclass
class Path:
    """Sum of sines in position (m) and in the rotation vector (rad); `pace` scales time.

    It leans (rad) to one side of its y axis, and from the instant `over_s` on to the other.
    """

    middle: np.ndarray
    reach: np.ndarray
    rate: np.ndarray
    phase: np.ndarray
    turn_middle: np.ndarray
    turn_reach: np.ndarray
    turn_rate: np.ndarray
    turn_phase: np.ndarray
    pace: float = 1.0
    lean: float = 0.0
    over_s: float = 0.0

    def pose(self, t):
        """Axes [n, 3, 3] and position [n, 3] at times [n] (s)."""
        t = self.pace * np.asarray(t, float)[:, None]
        shift = self.middle + np.sum(
            self.reach * np.sin(self.rate * t[..., None] + self.phase), axis=-1
        )
        turn = self.turn_middle + np.sum(
            self.turn_reach * np.sin(self.turn_rate * t[..., None] + self.turn_phase), axis=-1
        )
        turn[:, 1] += self.lean * np.where(t[:, 0] < self.over_s, -1.0, 1.0)
        return matrix(turn), shift

    def velocity(self, t):
        """Velocity (m/s) and angular rate (rad/s), world axes, [n, 6]."""
        step = 1e-4
        after, before = self.pose(t + step), self.pose(t - step)
        spin = np.einsum("nij,nkj->nik", after[0], before[0])
        omega = np.stack(
            [spin[:, 2, 1] - spin[:, 1, 2], spin[:, 0, 2] - spin[:, 2, 0],
             spin[:, 1, 0] - spin[:, 0, 1]], axis=1,
        )  # fmt: skip
        return np.concatenate([(after[1] - before[1]), 0.5 * omega], axis=1) / (2.0 * step)


def fast_path(rng, middle, reach, speed, turn_middle, turn_reach):
    """A path of three sines an axis with about the given speed (m/s)."""
    middle, reach = np.asarray(middle, float), np.asarray(reach, float)
    share = rng.dirichlet([3.0, 2.0, 1.0], size=3)
    rate = rng.uniform(0.5, 1.4, (3, 3)) * (speed / reach.mean())
    return Path(
        middle=middle,
        reach=reach[:, None] * share,
        rate=rate,
        phase=rng.uniform(0.0, 2.0 * np.pi, (3, 3)),
        turn_middle=np.asarray(turn_middle, float),
        turn_reach=np.asarray(turn_reach, float)[:, None] * share[::-1],
        turn_rate=0.7 * rate[:, ::-1],
        turn_phase=rng.uniform(0.0, 2.0 * np.pi, (3, 3)),
    )


def wander(rng, count, size):
    """A smooth slow course [count, len(size)] of about the given amplitudes."""
    x = np.linspace(0.0, 1.0, count)[:, None]
    size = np.asarray(size, float)
    out = np.zeros((count, len(size)))
    for k in range(1, 4):
        angle = 2.0 * np.pi * rng.uniform(0.4, 1.2) * k * x
        out += np.sin(angle + rng.uniform(0.0, 6.28, len(size))) / k
    return 0.7 * size * out


def hand_poses(rng, count, camera, half, distances, fill, tilt, spread_roll=True):
    """Poses of a board of half sizes `half` (m) held before a camera by hand.

    Args:
        distances: nearest and farthest (m).
        fill: how far from the image centre the board's centre goes, as a share of the half image.
        tilt: largest tilt (rad).
    """
    size, focal = np.array(camera.size), camera.focal
    turns, shifts = [], []
    for _ in range(count):
        z = np.exp(rng.uniform(*np.log(distances)))
        reach = fill * 0.5 * size / focal
        where = rng.uniform(-1.0, 1.0, 2) * reach
        roll = rng.integers(4) * 0.5 * np.pi * spread_roll + 0.25 * rng.normal()
        lean_to = rng.uniform(0.0, 2.0 * np.pi)
        lean = tilt * np.sqrt(rng.uniform(0.02, 1.0))
        turn = matrix(lean * np.array([np.cos(lean_to), np.sin(lean_to), 0.0]))
        turn = turn @ matrix([0.0, 0.0, roll])
        turns.append(turn)
        shifts.append(np.array([where[0] * z, where[1] * z, z]) - turn @ np.append(half, 0.0))
    return np.array(turns), np.array(shifts)
