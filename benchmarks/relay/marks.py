"""Links that the benchmark is made of: plates before a camera, straight chains, double chains.

The plates are those of MATHEMATICS 1.6: 0.5 m wide, 10 x 10 points, at 10 m, f = 5000 px,
0.05 px. Deviations are of the pose in the plate's own axes, the line of sight along x.
"""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxvm.pose.chains import Link, mark_covariance
from jaxvm.pose.double_chain import DoubleChain

LENGTH = 10.0
"""Of a link (m)."""

APART = 0.3
"""Distance of the two bodies of a station (m)."""


def isotropic(sigma_turn: float, sigma_shift: float) -> np.ndarray:
    """The same deviation about (rad) and along (m) every axis."""
    return np.diag([sigma_turn**2] * 3 + [sigma_shift**2] * 3)


@dataclass(frozen=True)
class Plate:
    """Deviations across and along the line of sight (m), about it and of the tilt (rad)."""

    lateral: float
    depth: float
    roll: float
    tilt: float

    def covariance(self, sight=(1.0, 0.0, 0.0)) -> np.ndarray:
        """Of the twist in the plate's axes."""
        sight = jnp.asarray(sight)
        return np.array(_of_mark(sight, self.lateral, self.depth, self.roll, self.tilt))

    def at(self, distance: float) -> "Plate":
        """As seen from farther: lateral, roll and tilt grow with the distance, depth squared."""
        ratio = distance / LENGTH
        return Plate(
            self.lateral * ratio, self.depth * ratio**2, self.roll * ratio, self.tilt * ratio
        )


TILTED = Plate(10e-6, 0.63e-3, 63e-6, 0.17e-3)
FRONTAL = Plate(10e-6, 0.44e-3, 44e-6, 2.9e-3)


@cache
def pictured(distance: float, tilt: float = 0.5) -> np.ndarray:
    """Covariance of a plate's twist from its picture (Cramer-Rao), with all correlations.

    In axes with x along the line of sight, as `Plate` has them: with p a point in these axes and
    z = distance + p_x its depth, a twist moves it by turn x p + shift, its pixel by
    f / z (dp_y - (p_y / z) dp_x) and so on.
    """
    focal, sigma_px = 5000.0, 0.05
    side = np.linspace(-0.25, 0.25, 10)
    right, up = (grid.ravel() for grid in np.meshgrid(side, side))
    points = np.stack([np.sin(tilt) * up, right, np.cos(tilt) * up], axis=1)
    move = np.concatenate(
        [np.cross(np.eye(3), points[:, None]), np.tile(np.eye(3), (100, 1, 1))], 1
    )
    depth = distance + points[:, 0, None]
    seen = (
        focal
        / depth[..., None]
        * (move[..., 1:].swapaxes(1, 2) - (points[:, 1:] / depth)[..., None] * move[:, None, :, 0])
    )
    slope = seen.reshape(-1, 6)
    return sigma_px**2 * np.linalg.inv(slope.T @ slope)


def equal_links(n: int, shift, covariance) -> Link:
    """The same link n times, without a turn."""
    pose = np.tile([0.0, 0.0, 0.0, *shift], (n, 1))
    return Link(jnp.asarray(pose), jnp.broadcast_to(jnp.asarray(covariance), (n, 6, 6)))


_backwards = jax.jit(jax.vmap(Link.back))
_of_mark = jax.jit(mark_covariance)


def double(
    k: int, out, home, rung, length: float = LENGTH, apart: float = APART, opposite: bool = True
) -> DoubleChain:
    """Straight chains out and home, side by side; covariances of one link of each.

    Args:
        opposite: whether the links home are measured from station i + 1 to a mark on station i (so
            that they err at their near station), or from i to i + 1 like those out.
    """
    there = equal_links(k, (length, 0.0, 0.0), home)
    back = equal_links(k, (-length, 0.0, 0.0), home) if opposite else _backwards(there)
    return DoubleChain(
        equal_links(k, (length, 0.0, 0.0), out), back, equal_links(k + 1, (0.0, apart, 0.0), rung)
    )


def relative(poses) -> np.ndarray:
    """a_from_b of pairs of world_from_body poses [pairs, 2, 6], turn (rad) and shift (m)."""
    poses = np.asarray(poses)
    first, second = (Rotation.from_rotvec(poses[:, k, :3]) for k in (0, 1))
    turn = (first.inv() * second).as_rotvec()
    return np.hstack([turn, first.inv().apply(poses[:, 1, 3:] - poses[:, 0, 3:])])
