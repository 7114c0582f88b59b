"""Pose-relay chains: objects that cannot see each other, joined by stations that see in turn.

A chain is a product of relative poses. Each is measured with an error that everything behind it
inherits: turns as they are, positions through the lever arm. Sources: Yu et al. 2009 (Appl. Opt.
48:4683), Jiang et al. 2011 (Chin. Sci. Bull. 56:113); covariances through adjoints as in Barfoot
and Furgale 2014 (IEEE T-RO 30:679), first order.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxvm.geometry import (
    pose_from_vector,
    se3_adjoint,
    se3_exp,
    so3_log,
    vector_from_pose,
)


class Link(eqx.Module):
    """A measured relative pose a_from_b and how well it is known; or many, stacked.

    Attributes:
        pose: a_from_b as turn (rad) and shift (m).
        covariance: of the twist log(measured^-1 . true), turn (rad) then shift (m) in the axes of
            b: the convention of `jaxvm.network.graph.PoseGraph`.
    """

    pose: Float[Array, "*b 6"]
    covariance: Float[Array, "*b 6 6"]

    @classmethod
    def exact(cls) -> "Link":
        """The identity, known without error."""
        return cls(jnp.zeros(6), jnp.zeros((6, 6)))

    def then(self, following: "Link") -> "Link":
        """a_from_c of a_from_b and an independent b_from_c."""
        b_from_c = pose_from_vector(following.pose)
        carry = se3_adjoint(b_from_c.inverse())
        return Link(
            vector_from_pose(pose_from_vector(self.pose) @ b_from_c),
            carry @ self.covariance @ carry.T + following.covariance,
        )

    def back(self) -> "Link":
        """b_from_a of a_from_b."""
        pose = pose_from_vector(self.pose)
        carry = se3_adjoint(pose)
        return Link(vector_from_pose(pose.inverse()), carry @ self.covariance @ carry.T)

    def in_first_axes(self) -> Float[Array, "6 6"]:
        """Covariance of turn (rad) and position (m) of b, both in the axes of a."""
        turn = pose_from_vector(self.pose).rotation
        carry = jax.scipy.linalg.block_diag(turn, turn)
        return carry @ self.covariance @ carry.T


class Growth(eqx.Module):
    """Standard deviations of the poses along a chain, in the axes of its first frame.

    Attributes:
        turn: about each axis (rad).
        shift: of the position along each axis (m).
        axial: of the position along the line from the first frame (m); NaN at the first frame.
        lateral: across that line (m), RMS of the two directions; NaN at the first frame.
    """

    turn: Float[Array, "*b 3"]
    shift: Float[Array, "*b 3"]
    axial: Float[Array, "*b"]
    lateral: Float[Array, "*b"]


def compose(links: Link) -> Link:
    """Far end of a chain: first_from_last of n stacked links, [n, 6].

    Covariance: sum of Ad(S_i^-1) C_i Ad(S_i^-1)^T with S_i the product of the links behind link i.
    The errors of the links are taken as independent.
    """
    return jax.lax.scan(lambda end, link: (end.then(link), None), Link.exact(), links)[0]


def along(links: Link) -> Link:
    """Every station of a chain from its first frame, stacked: [n, 6]; the last is `compose`."""

    def step(end, link):
        end = end.then(link)
        return end, end

    return jax.lax.scan(step, Link.exact(), links)[1]


def growth(links: Link) -> Growth:
    """Predicted errors at every station of a chain of n links: [n, ...]."""
    ends = along(links)
    return deviations(jax.vmap(Link.in_first_axes)(ends), ends.pose[:, 3:])


def deviations(covariance: Float[Array, "*b 6 6"], position: Float[Array, "*b 3"]) -> Growth:
    """Standard deviations of poses at given positions.

    Args:
        covariance: of turn (rad) and position (m), in the axes of the first frame.
        position: from the first frame (m): where the line of sight of axial and lateral ends.
    """
    return jax.tree.map(jnp.sqrt, _variances(covariance, position))


def _variances(moment, position) -> Growth:
    """Squares of a `Growth`: linear in the second moments, so that one error is enough for it."""
    turns, shifts = moment[..., :3, :3], moment[..., 3:, 3:]
    line = position / jnp.linalg.norm(position, axis=-1, keepdims=True)
    axial = jnp.einsum("...i,...ij,...j->...", line, shifts, line)
    each = jnp.diagonal(shifts, axis1=-2, axis2=-1)
    lateral = 0.5 * (jnp.sum(each, axis=-1) - axial)
    return Growth(jnp.diagonal(turns, axis1=-2, axis2=-1), each, axial, lateral)


def straight_growth(
    n: int, length: float, sigma_turn: float, sigma_shift: float
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Closed form for n equal straight links with isotropic noise: turn, lateral, axial.

    sigma_turn sqrt(n) (rad), sqrt(n s_t^2 + s_r^2 L^2 (n-1) n (2n-1) / 6) (m) and s_t sqrt(n) (m):
    the turn error of link i acts on the n - i links behind it.

    Args:
        n: number of links.
        length: of a link (m).
        sigma_turn: of a link about each axis (rad).
        sigma_shift: of a link along each axis (m).
    """
    levers = (n - 1) * n * (2 * n - 1) / 6
    root = jnp.sqrt(1.0 * n)
    lateral = jnp.sqrt(n * sigma_shift**2 + (sigma_turn * length) ** 2 * levers)
    return sigma_turn * root, lateral, sigma_shift * root


class Trials(eqx.Module):
    """Chains drawn again and again.

    Attributes:
        error: measured minus true (turn, position) of every station, in the axes of the first
            frame (rad, m).
        measured: RMS of the errors.
        bars: standard deviation of each value of `measured`, from the scatter of the squares.
    """

    error: Float[Array, "trials n 6"]
    measured: Growth
    bars: Growth


@eqx.filter_jit
def simulate(links: Link, key: PRNGKeyArray, trials: int = 1000) -> Trials:
    """Monte Carlo of a chain: every link is drawn, and the drawn links are composed.

    The poses of `links` are taken as the truth; `jax.vmap` it over chains or keys.
    """
    truth = along(links).pose

    def once(key):
        return jax.vmap(pose_error)(along(drawn(links, key)).pose, truth)

    error = jax.vmap(once)(jax.random.split(key, trials))
    squares = _variances(error[..., :, None] * error[..., None, :], truth[:, 3:])
    measured = jax.tree.map(lambda x: jnp.sqrt(jnp.mean(x, axis=0)), squares)
    bars = jax.tree.map(
        lambda x, rms: jnp.std(x, axis=0) / (2.0 * rms * trials**0.5), squares, measured
    )
    return Trials(error, measured, bars)


def drawn(links: Link, key: PRNGKeyArray) -> Link:
    """Links as one measures them when the given ones are true: true . exp(-twist)."""
    # A Cholesky root would be NaN for a component that is known without error.
    values, vectors = jnp.linalg.eigh(links.covariance)
    scaled = jnp.sqrt(jnp.maximum(values, 0.0)) * jax.random.normal(key, links.pose.shape)
    twist = jnp.einsum("...ij,...j->...i", vectors, scaled)

    def measure(pose, twist):
        return vector_from_pose(pose_from_vector(pose) @ se3_exp(-twist))

    return Link(jax.vmap(measure)(links.pose, twist), links.covariance)


def pose_error(measured: Float[Array, "6"], truth: Float[Array, "6"]) -> Float[Array, "6"]:
    """Measured minus true turn (rad) and position (m), in the axes of the frame they map to."""
    a, b = pose_from_vector(measured), pose_from_vector(truth)
    return jnp.concatenate([so3_log((a @ b.inverse()).rotation), a.shift - b.shift])


def mark_covariance(
    sight: Float[Array, "3"], lateral: float, depth: float, roll: float, tilt: float
) -> Float[Array, "6 6"]:
    """Covariance of the pose of a planar mark as a camera sees it, in the axes of the mark.

    A frontal plate is well known across the line of sight and in its roll about it, badly in depth
    and in its tilt out of the plane: 10 to 60 times worse (`jaxvm.pose.precision` gives the
    numbers of a set-up).

    Args:
        sight: line of sight in the axes of the mark, of any length.
        lateral: standard deviation of the position across the line of sight, each axis (m).
        depth: along it (m).
        roll: of the turn about it (rad).
        tilt: about each axis across it (rad).
    """
    line = sight / jnp.linalg.norm(sight)
    along_line = jnp.outer(line, line)
    across = jnp.eye(3) - along_line
    return jax.scipy.linalg.block_diag(
        roll**2 * along_line + tilt**2 * across, depth**2 * along_line + lateral**2 * across
    )
