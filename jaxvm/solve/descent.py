"""What a descent reports: where it came to, how fast, and why it ended."""

from enum import IntEnum

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

_ENTRIES = 512
_PER_DOUBLING = 16


class Stop(IntEnum):
    """Why a descent ended."""

    RUNNING = 0
    TARGET = 1
    SHARE = 2
    SETTLED = 3
    SLOW = 4
    LIMIT = 5
    FAILED = 6


_WORDS = {
    Stop.RUNNING: "stopped from outside: not converged",
    Stop.TARGET: "reached: the cost is down to the target",
    Stop.SHARE: "reached: the cost is down to the target share of the first cost",
    Stop.SETTLED: "converged: the cost no longer changes",
    Stop.SLOW: "stopped: the cost hardly falls any more, which may be far from the minimum",
    Stop.FAILED: "failed: the cost is no number",
}


class History(eqx.Module):
    """Costs at evaluation counts that grow by a constant factor, inside a compiled loop.

    16 entries for each doubling: 512 of them last for 10^10 evaluations.
    """

    costs: Float[Array, " entries"]
    evaluations: Int[Array, " entries"]
    length: Int[Array, ""]
    due: Int[Array, ""]

    @staticmethod
    def empty() -> "History":
        """History without entries."""
        none = jnp.zeros(_ENTRIES, int)
        return History(jnp.zeros(_ENTRIES), none, jnp.array(0), jnp.array(0))

    def noted(
        self, cost: Float[Array, ""], evaluations: Int[Array, ""], always: Bool[Array, ""] | bool
    ) -> "History":
        """The history with this cost, if `always` or an entry is due."""
        wanted = always | (evaluations >= self.due)
        # A place behind the end is dropped.
        place = jnp.where(wanted, self.length, _ENTRIES)
        ahead = jnp.ceil(evaluations * 2.0 ** (1.0 / _PER_DOUBLING)).astype(evaluations.dtype)
        return History(
            self.costs.at[place].set(cost, mode="drop"),
            self.evaluations.at[place].set(evaluations, mode="drop"),
            self.length + wanted,
            jnp.where(wanted, jnp.maximum(evaluations + 1, ahead), self.due),
        )


class Descent(eqx.Module):
    """Result of a descent.

    Attributes:
        x: scaled unknowns at the lowest cost found.
        cost: half the sum of the losses there.
        history: costs on the way; the first one at the start, the last one at `x`.
        evaluations_at: how often the cost had been evaluated at each entry of the history.
        evaluations: how often in all.
        why: why it stopped.
    """

    x: Float[Array, " n"]
    cost: float
    history: Float[np.ndarray, " entries"]
    evaluations_at: Int[np.ndarray, " entries"]
    evaluations: int
    why: str

    @property
    def converged(self) -> bool:
        """Whether it reached what it was asked for, or a point from where it goes no further."""
        return self.why.startswith(("converged", "reached"))


def descent(x, cost, history: History, evaluations, stop, limit) -> Descent:
    """The report of a loop that has ended, from device arrays."""
    length, reason = int(history.length), Stop(int(stop))
    words = f"stopped after {int(limit)} evaluations: not converged"
    return Descent(
        x=x,
        cost=float(cost),
        history=np.asarray(history.costs)[:length],
        evaluations_at=np.asarray(history.evaluations)[:length],
        evaluations=int(evaluations),
        why=_WORDS.get(reason, words),
    )
