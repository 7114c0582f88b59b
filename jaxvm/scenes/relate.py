"""Links of a scene: relative poses of stations along their lines, measured with a covariance."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxvm.geometry.rotations import so3_left_jacobian
from jaxvm.recording.recording import Links, uncorrelated
from jaxvm.scenes.describe import LinkNoise
from jaxvm.scenes.layouts import Structure
from jaxvm.scenes.placement import Placement, Ties


def ties_of_lines(structure: Structure, placement: Placement) -> Ties:
    """Every line once, and once for each epoch where one of its ends moves."""
    a, b = structure.lines.T
    epochs = placement.shift.shape[1]
    times = np.where(placement.moving[a] | placement.moving[b], epochs, 1)
    line = np.repeat(np.arange(len(a)), times)
    epoch = np.arange(len(line)) - np.repeat(np.cumsum(times) - times, times)
    return Ties(a[line], b[line], epoch)


def measured_links(
    ties: Ties,
    structure: Structure,
    placement: Placement,
    spread: LinkNoise,
    rng: np.random.Generator,
    noise: float,
) -> Links:
    """Links between stations: measured = true . exp(-twist), the twist drawn from its covariance.

    In the axes of the station that is seen, the covariance is worse by the factors of `spread`:
    the depth along the line, and the turns about all axes but the line. `noise` is a factor on
    the twist.
    """
    r_a, r_b = (placement.rotation[end, ties.epoch] for end in (ties.a, ties.b))
    p_a, p_b = (placement.shift[end, ties.epoch] for end in (ties.a, ties.b))
    back = np.swapaxes(r_a, 1, 2)
    turn, shift = back @ r_b, np.einsum("nij,nj->ni", back, p_b - p_a)
    covariance = _covariance(r_b, p_b - p_a, spread)
    root = np.linalg.cholesky(covariance)
    twist = -noise * np.einsum("nij,nj->ni", root, rng.standard_normal((len(turn), 6)))
    omega, rho = twist[:, :3], twist[:, 3:]
    bend = np.asarray(jax.vmap(so3_left_jacobian)(jnp.asarray(omega)))
    moved = shift + np.einsum("nij,njk,nk->ni", turn, bend, rho)
    measured = (Rotation.from_matrix(turn) * Rotation.from_rotvec(omega)).as_rotvec()
    moves = placement.moving[ties.a] | placement.moving[ties.b]
    names = structure.names
    return Links(
        tuple(f"{names[a]}-to-{names[b]}" for a, b in zip(ties.a, ties.b, strict=True)),
        [("station", int(a)) for a in ties.a],
        [("station", int(b)) for b in ties.b],
        np.concatenate([measured, moved], axis=1),
        covariance,
        np.where(moves, ties.epoch, -1),
    )


def _covariance(
    world_from_b: Float[np.ndarray, "n 3 3"], sight: Float[np.ndarray, "n 3"], spread: LinkNoise
) -> Float[np.ndarray, "n 6 6"]:
    n, f, g = len(sight), spread.turn_factor, spread.depth_factor
    if f == 1.0 and g == 1.0:
        return uncorrelated(np.full(n, spread.sigma_rad), np.full(n, spread.sigma_m))
    along = np.einsum("nji,nj->ni", world_from_b, sight)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    outer = along[:, :, None] * along[:, None, :]
    found = np.zeros((n, 6, 6))
    found[:, :3, :3] = spread.sigma_rad**2 * (f**2 * np.eye(3) + (1.0 - f**2) * outer)
    found[:, 3:, 3:] = spread.sigma_m**2 * (np.eye(3) + (g**2 - 1.0) * outer)
    return found
