"""Relay stations: camera-to-camera poses from redundant calibrations, adjusted together.

The m cameras of a station can be calibrated in pairs in more ways than needed. Around every loop
the true poses multiply to the identity, T12 T23 ... Tn1 = I; poses of all cameras in the frame of
the first satisfy every such constraint, so the least-squares poses of the cameras are the
adjustment under the loop constraints (`jaxvm.solve.condition` does the same with the constraints
written out). Everything here serves any few bodies joined by relative poses, such as two chains
that run over the same stations (`jaxvm.pose.double_chain`).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from jaxvm.geometry import pose_from_vector, se3_adjoint, se3_exp, vector_from_pose
from jaxvm.network.factors import LinkFactor
from jaxvm.network.residual import parts_of
from jaxvm.physics.ports import PortValues
from jaxvm.pose.chains import Link

_STEPS = 30


class Relay(eqx.Module):
    """Bodies adjusted together; the first one is the frame.

    Attributes:
        first_from_body: adjusted poses, turn (rad) and shift (m).
        covariance: joint, of the twists log(adjusted^-1 . true) of all bodies in their own axes,
            turn (rad) then shift (m); zero for the first body.
        correction: twist that each measured link got, log(measured^-1 . adjusted).
        squares: weighted sum of squares of the corrections; chi-square with 6 (links - bodies + 1)
            degrees of freedom when the covariances are right.
        steps: of Gauss-Newton.
        last: length of its last step in standard deviations; far below 1 when it has converged.
    """

    first_from_body: Float[Array, "m 6"]
    covariance: Float[Array, "m 6 m 6"]
    correction: Float[Array, "links 6"]
    squares: Float[Array, ""]
    steps: Int[Array, ""]
    last: Float[Array, ""]

    def between(self, a: Int[Array, ""] | int, b: Int[Array, ""] | int) -> Link:
        """Adjusted a_from_b with its covariance."""
        pose = pose_from_vector(self.first_from_body[a]).inverse() @ pose_from_vector(
            self.first_from_body[b]
        )
        carry = jnp.stack([-se3_adjoint(pose.inverse()), jnp.eye(6)])
        ends = jnp.stack([jnp.asarray(a), jnp.asarray(b)])
        joint = self.covariance[ends][:, :, ends]
        spread = jnp.einsum("pij,pjqk,qlk->il", carry, joint, carry)
        return Link(vector_from_pose(pose), spread)

    @eqx.filter_jit
    def links(self, pairs: Int[np.ndarray, "links 2"]) -> Link:
        """Adjusted poses of many pairs of bodies, stacked."""
        return jax.vmap(self.between)(*jnp.asarray(pairs).T)


def adjust_relay(
    pairs: Int[np.ndarray, "links 2"], links: Link, names: tuple[str, ...] | None = None
) -> Relay:
    """Least-squares poses of bodies from redundant relative poses with full covariances.

    Gauss-Newton from a spanning tree of the links, on the residual of `LinkFactor`; dense, for some
    tens of bodies. Pure in `links`: `jax.vmap` it over repeated calibrations.

    Args:
        pairs: which bodies each link joins, from and to: numbers from 0, all of them joined.
        links: what was measured, stacked; several may join the same two bodies. Covariances must be
            positive definite.
        names: of the bodies, for errors.

    Raises:
        ValueError: bodies that no link joins to the first, by name; a link of a body with itself.
    """
    tree = _tree(pairs, names)
    return _adjusted(jnp.asarray(pairs), tree, links)


def all_pairs(m: int) -> Int[np.ndarray, "links 2"]:
    """Every pair of m cameras once: the calibration with the most redundancy."""
    return np.stack(np.triu_indices(m, 1), axis=1)


def pair_variance(m: int) -> float:
    """Variance of an adjusted pair over that of a plain one, 2/m: all pairs, equal isotropic noise.

    It is the effective resistance between two nodes of the complete graph; the precision of a pair
    gains sqrt(m/2). It holds for turns, and for shifts where the cameras stand close together
    against sigma_shift / sigma_turn.
    """
    return 2.0 / m


@eqx.filter_jit
def precision_gain(
    pairs: Int[np.ndarray, "links 2"], links: Link, relay: Relay
) -> Float[Array, "links 6"]:
    """Standard deviation of each plain link over that of its adjusted pose, component by component.

    Turns (rad) then shifts (m) in the axes of the second body of each pair.
    """
    adjusted = relay.links(pairs)

    def variances(link):
        return jnp.diagonal(link.covariance, axis1=1, axis2=2)

    return jnp.sqrt(variances(links) / variances(adjusted))


def _tree(pairs, names) -> Int[np.ndarray, "m_less_1 4"]:
    """Body, the body before it, their link and 1 where it leads away from the first; in order."""
    pairs = np.asarray(pairs, int)
    n = int(pairs.max()) + 1 if names is None else len(names)
    names = tuple(map(str, range(n))) if names is None else names
    if len(own := np.flatnonzero(pairs[:, 0] == pairs[:, 1])):
        raise ValueError(f"link {own[0]} joins {names[pairs[own[0], 0]]} with itself: leave it out")
    joined = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(n, n)).tocsr()
    order, before = breadth_first_order(joined, 0, directed=False)
    if len(order) < n:
        apart = ", ".join(names[i] for i in np.setdiff1d(np.arange(n), order))
        raise ValueError(f"no link joins {apart} to {names[0]}: calibrate one of them against it")
    first = {(a, b): k for k, (a, b) in reversed(list(enumerate(pairs)))}
    rows = [
        (body, at, first[at, body], 1) if (at, body) in first else (body, at, first[body, at], 0)
        for body, at in zip(order[1:], before[order[1:]], strict=True)
    ]
    return np.array(rows, int).reshape(-1, 4)


@eqx.filter_jit
def _adjusted(pairs, tree, links: Link) -> Relay:
    n = tree.shape[0] + 1
    table = _table(pairs, links, n)

    def unfinished(state):
        _, _, step, before, count = state
        # The second rule ends at the rounding of the residuals, where steps no longer shorten.
        falling = (step > 1e-5) | (step < 0.5 * before)
        return (count < _STEPS) & (step > 1e-10) & falling

    def improve(state):
        poses, _, step, _, count = state
        slope, value = _linearised(table, pairs, poses)
        # Turns and shifts differ by many orders of magnitude; the normal matrix would square that,
        # and again what one link is better than another.
        scale = 1.0 / jnp.linalg.norm(slope, axis=0)
        orthogonal, root = jnp.linalg.qr(slope * scale)
        shorter = orthogonal.T @ value
        change = -scale * solve_triangular(root, shorter)
        poses = _moved(poses, jnp.concatenate([jnp.zeros(6), change]).reshape(n, 6))
        return poses, root / scale, jnp.linalg.norm(shorter), step, count + 1

    far = jnp.asarray(jnp.inf)
    start = (_start(tree, links, n), jnp.eye(6 * (n - 1)), far, far, jnp.asarray(0))
    # The root of the normal matrix is that before the last step, which is none to speak of.
    poses, root, last, _, steps = jax.lax.while_loop(unfinished, improve, start)
    whitened = jax.vmap(partial(table.local, ports=PortValues()))(
        parts_of(table, _flat(poses)), table.data()
    )
    inverse = solve_triangular(root, jnp.eye(6 * (n - 1)))
    covariance = jnp.zeros((6 * n, 6 * n)).at[6:, 6:].set(inverse @ inverse.T)
    correction = jnp.einsum("eij,ej->ei", jnp.linalg.cholesky(links.covariance), whitened)
    squares = jnp.sum(whitened**2)
    return Relay(poses, covariance.reshape(n, 6, n, 6), correction, squares, steps, last)


def _start(tree, links: Link, n) -> Float[Array, "m 6"]:
    """Poses along the tree, body by body."""

    def reach(poses, row):
        body, at, link, ahead = row
        pose = pose_from_vector(links.pose[link])
        step = jax.tree.map(lambda x, y: jnp.where(ahead, x, y), pose, pose.inverse())
        return poses.at[body].set(vector_from_pose(pose_from_vector(poses[at]) @ step)), None

    return jax.lax.scan(reach, jnp.zeros((n, 6)), jnp.asarray(tree))[0]


def _table(pairs, links: Link, n) -> LinkFactor:
    """The links as a table of the one residual; behind the bodies its state holds an identity."""
    of_body = 6 * pairs[:, :, None] + jnp.arange(6)
    none = jnp.broadcast_to(6 * n + jnp.arange(6), of_body[:, 0].shape)
    count = len(pairs)
    return LinkFactor(
        slots=jnp.concatenate([of_body[:, 0], none, of_body[:, 1], none], axis=1),
        sigma=jnp.ones((count, 6)),
        weight=jnp.ones(count),
        measured=links.pose,
        root=jnp.linalg.inv(jnp.linalg.cholesky(links.covariance)),
    )


def _moved(poses, change):
    """Each pose followed by the exponential of a small twist in its own axes."""

    def move(pose, twist):
        return vector_from_pose(pose_from_vector(pose) @ se3_exp(twist))

    return jax.vmap(move)(poses, change)


def _linearised(table: LinkFactor, pairs, poses):
    """Derivatives by the twists of all bodies but the first, and whitened residuals."""
    n, links = len(poses), len(pairs)

    def local(change, own, data):
        ends = _moved(jnp.stack([own[0], own[2]]), change)
        value = table.local((ends[0], own[1], ends[1], own[3]), data, PortValues())
        return value, value

    slope, value = jax.vmap(jax.jacfwd(local, has_aux=True), in_axes=(None, 0, 0))(
        jnp.zeros((2, 6)), parts_of(table, _flat(poses)), table.data()
    )
    which = jnp.arange(links)[:, None]
    placed = jnp.zeros((links, 6, n, 6)).at[which, :, pairs].add(slope.transpose(0, 2, 1, 3))
    return placed.reshape(6 * links, 6 * n)[:, 6:], value.ravel()


def _flat(poses) -> Float[Array, " n"]:
    """The state that the slots of the table count in."""
    return jnp.concatenate([poses.ravel(), jnp.zeros(6)])
