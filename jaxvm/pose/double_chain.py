"""Double pose-relay chains: out and home over the same stations, and what joining them brings.

Chao et al. 2010 (Appl. Opt. 49:5192) add symmetrical cameras to the stations of a relay, adjust
both chains under the constraints that the stations impose, and find the result better than the
classic weighted mean of the two chains. Here every way of joining them has its covariance, so that
one can see where that gain comes from:

- without lever arms, or where both chains err at the same end of each link, the adjustment has next
  to nothing over a mean with correct weights: the chains are resistors in parallel;
- a link out errs at its far station, a link home at its near one. With lever arms between them each
  knows what the other does not (both directions of the line of sight, as in reciprocal pointing of
  theodolites), station by station; a mean at the far end comes too late to use it;
- planar marks, bad in depth and tilt, make this large: the adjustment need not believe a tilt;
- a mean with wrong weights is worse for that reason alone.
"""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxvm.geometry import Pose, pose_from_vector, so3_exp, vector_from_pose
from jaxvm.pose.chains import Growth, Link, compose, deviations, drawn, pose_error
from jaxvm.pose.relay import adjust_relay

T = TypeVar("T")


class DoubleChain(eqx.Module):
    """Two chains over the stations 0 to k, and what joins them at each station.

    Station i carries a body of the chain out and one of the chain home.

    Attributes:
        out: links from station i to station i + 1, on the chain out.
        home: links from station i + 1 to station i, on the chain home.
        rungs: of every station, out_from_home: the station's own calibration.
    """

    out: Link
    home: Link
    rungs: Link

    @property
    def n_links(self) -> int:
        """Links of one chain: k."""
        return self.out.pose.shape[0]

    def pairs(self) -> Int[np.ndarray, "links 2"]:
        """Bodies of out, home and rungs: those of the chain out from 0, of the chain home from k+1.

        The order is that of `links`.
        """
        k = self.n_links
        at = np.arange(k + 1)
        out, home = np.stack([at[:-1], at[1:]], 1), np.stack([at[1:], at[:-1]], 1) + k + 1
        return np.concatenate([out, home, np.stack([at, at + k + 1], 1)])

    def links(self) -> Link:
        """All measured poses, in the order of `pairs`."""
        return jax.tree.map(lambda *x: jnp.concatenate(x), self.out, self.home, self.rungs)

    def way_home(self) -> Link:
        """The far body of the chain out by way of the chain home: independent of `compose(out)`."""
        first, last = (jax.tree.map(lambda x, i=i: x[i], self.rungs) for i in (0, -1))
        way = jax.vmap(Link.back)(self.home)
        return first.then(compose(way)).then(last.back())


class Estimates(NamedTuple, Generic[T]):
    """Something of the far end of a double chain, for each way to estimate its pose.

    Attributes:
        single: the chain out alone.
        naive: mean of both chains with equal weights.
        classic: mean weighted component by component, with the true variances but no covariances.
        weighted: mean with the full covariances: the best that the two ends allow.
        adjusted: all links adjusted together.
    """

    single: T
    naive: T
    classic: T
    weighted: T
    adjusted: T

    def map(self, function: Callable) -> "Estimates":
        """The function of each."""
        return Estimates(*map(function, self))


@eqx.filter_jit
def far_covariance(chain: DoubleChain) -> Estimates[Float[Array, "6 6"]]:
    """Covariances of the far end, turn (rad) and position (m) in the axes of the first body.

    First order in the errors, for links whose errors are independent; `jax.vmap` it over chains.
    """
    out, home = compose(chain.out).in_first_axes(), chain.way_home().in_first_axes()

    def of_mean(share):
        rest = jnp.eye(6) - share
        return rest @ out @ rest.T + share @ home @ share.T

    adjusted = adjust_relay(chain.pairs(), chain.links()).between(0, chain.n_links)
    single, naive, classic, weighted = map(of_mean, _shares(out, home))
    return Estimates(single, naive, classic, weighted, adjusted.in_first_axes())


@eqx.filter_jit
def far_growth(chain: DoubleChain) -> Estimates[Growth]:
    """Predicted standard deviations of the far end for each way to estimate it."""
    position = compose(chain.out).pose[3:]
    return far_covariance(chain).map(lambda covariance: deviations(covariance, position))


@eqx.filter_jit
def far_errors(
    chain: DoubleChain,
    key: PRNGKeyArray,
    trials: int = 1000,
    believed: DoubleChain | None = None,
) -> Estimates[Float[Array, "trials 6"]]:
    """Errors of the far end (turn, position; rad, m; axes of the first body) in drawn chains.

    Every link is drawn about its true pose, and every estimate is made of the drawn links without
    linearising.

    Args:
        chain: the truth, and the covariances that the links are drawn with.
        key, trials: of the Monte Carlo.
        believed: the chain whose covariances the weights are made of; the true ones by default.
    """
    believed = chain if believed is None else believed
    pairs, spread, k = chain.pairs(), believed.links().covariance, chain.n_links
    truth = compose(chain.out).pose
    shares = _shares(compose(believed.out).in_first_axes(), believed.way_home().in_first_axes())

    def once(key):
        links = Link(drawn(chain.links(), key).pose, spread)
        parts = (slice(0, k), slice(k, 2 * k), slice(2 * k, None))
        own = DoubleChain(*(jax.tree.map(lambda x, p=p: x[p], links) for p in parts))
        out, home = compose(own.out).pose, own.way_home().pose
        single, naive, classic, weighted = (_mean(out, home, share) for share in shares)
        adjusted = adjust_relay(pairs, links).between(0, k).pose
        ends = Estimates(single, naive, classic, weighted, adjusted)
        return ends.map(lambda pose: pose_error(pose, truth))

    return jax.lax.map(once, jax.random.split(key, trials), batch_size=100)


def _shares(out, home) -> tuple[Float[Array, "6 6"], ...]:
    """How much of the way from the end of the chain out to that by home: the four means."""
    variances = jnp.diagonal(out) / (jnp.diagonal(out) + jnp.diagonal(home))
    full = jnp.linalg.solve(out + home, out).T
    return jnp.zeros((6, 6)), 0.5 * jnp.eye(6), jnp.diag(variances), full


def _mean(out, home, share) -> Float[Array, "6"]:
    """The end of the chain out, moved by a share of what leads to the end by home."""
    step = share @ pose_error(home, out)
    end = pose_from_vector(out)
    return vector_from_pose(Pose(so3_exp(step[:3]) @ end.rotation, end.shift + step[3:]))
