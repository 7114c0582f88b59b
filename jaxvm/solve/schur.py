"""Normal equations of few bodies and very many local unknowns: Schur complement without a scatter.

In a block of images every point is a group of unknowns that a few views see. The arrow form
(`jaxvm.solve.arrow`) couples each group densely to all shared unknowns; here only what sees it
counts. Two packets of observations of one group fall on a pair of views, and all that fall on one
pair are gathered into one product of matrices (Brown 1958; Triggs et al. 2000, section 6; Agarwal
et al. 2010).
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from jaxvm.network.residual import linearise, present
from jaxvm.solve.buckets import padded
from jaxvm.solve.problem import Problem, assemble, flat_state, in_packets, whitened
from jaxvm.solve.schur_pattern import SchurPattern, View


@dataclass(frozen=True, eq=False)
class SchurNormal:
    """Cost, gradient and Gauss-Newton matrix at one x, in blocks.

    Attributes:
        shared: of shared unknowns among themselves.
        local: of each group.
        coupling: of each packet, the unknowns of its group with its shared ones.
    """

    pattern: SchurPattern
    cost: float
    gradient: Float[Array, " n"]
    shared: Float[Array, "s s"]
    local: Float[Array, "groups d d"]
    coupling: Float[Array, "packets d shared"]

    def at(self, problem: Problem, x: Float[Array, " n"]) -> "SchurNormal":
        """The normal equations elsewhere."""
        return schur_normal(problem, self.pattern, x)

    def rescaled(self, scale: Float[np.ndarray, " n"]) -> "SchurNormal":
        """The same for unknowns in other units: x_new = x / scale."""
        s, groups, d = self.pattern.sizes
        a, b = jnp.asarray(scale[:s]), jnp.asarray(scale[s:].reshape(groups, d))
        wide = self.coupling.shape[2]
        columns = [
            jnp.pad(own, ((0, 0), (0, wide - own.shape[1])), constant_values=s)
            for own in (view.packets.columns for view in self.pattern.views)
        ]
        by_shared = jnp.append(a, 1.0)[jnp.concatenate(columns)][:, None, :]
        by_local = padded(b)[self.pattern.group][:, :, None]
        return replace(
            self,
            gradient=self.gradient * scale,
            shared=a[:, None] * self.shared * a,
            local=b[:, :, None] * self.local * b[:, None, :],
            coupling=by_local * self.coupling * by_shared,
        )

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """Diagonal of the matrix."""
        own = jnp.diagonal(self.local, axis1=1, axis2=2)
        return np.concatenate([np.diagonal(self.shared), np.ravel(own)])


def schur_normal(problem: Problem, pattern: SchurPattern, x: Float[Array, " n"]) -> SchurNormal:
    """Normal equations of a problem at x, with the weights of its robust loss."""
    bare = eqx.tree_at(lambda p: p.packets, problem, ())
    cost, *blocks = _linearised(bare, pattern, jnp.asarray(x))
    return SchurNormal(pattern, float(cost), *blocks)


@eqx.filter_jit
def _linearised(problem: Problem, pattern: SchurPattern, x):
    """Cost, gradient, shared and local blocks, and couplings of all packets."""
    network, layout = problem.network, problem.network.layout
    flat, per_parameter = flat_state(problem, x)
    at = present(network, flat)
    effects = jnp.asarray(np.concatenate([layout.all("amplitude"), layout.all("constant")]))
    cost, tables, rest = jnp.zeros(()), [], []
    for factor, view in zip(network.factors(), pattern.tables, strict=True):
        packets = view.packets if isinstance(view, View) else view
        raw = linearise(factor, network, at, packets.live)
        (table,) = whitened(
            [raw], [(factor.weight, factor.sigma)], [(factor.slots, effects, packets.live)],
            per_parameter,
        )  # fmt: skip
        square = jnp.sum(table.value**2, axis=1)
        cost = cost + 0.5 * jnp.sum(problem.loss.value(square))
        if not isinstance(view, View):
            rest.append((table, packets, factor.slots.shape[1]))
            continue
        root = jnp.sqrt(problem.loss.weight(square))[:, None]
        left, right = in_packets(packets, table.jacobian * root[:, :, None]), table.value * root
        right = in_packets(packets, right[:, :, None])
        shared, local = view.split(left)
        # Sums over few rows: products of components, which vectorise over the packets.
        tables.append(
            (
                view,
                shared,
                jnp.sum(local[:, :, :, None] * shared[:, :, None, :], axis=1),
                jnp.sum(local[:, :, :, None] * local[:, :, None, :], axis=1),
                jnp.sum(shared * right, axis=1),
                jnp.sum(local * right, axis=1),
            )
        )
    s = problem.sizes[0]
    found = [t for t, *_ in rest], tuple(p for _, p, _ in rest), [n for *_, n in rest]
    return cost, *_joined(pattern, tables, assemble(*found, problem.loss, (s, 0, 0)))


def _joined(pattern: SchurPattern, tables, rest):
    """Sums over views and groups."""
    s = pattern.sizes[0]
    wide = pattern.pair_rows.shape[1]
    shared = jnp.zeros((s + 1, s + 1)).at[:s, :s].add(rest.hessian.shared)
    gradient = jnp.zeros(s + 1).at[:s].add(rest.gradient)
    couplings, locals_, pulls = [], [], []
    for view, own, coupling, local, by_shared, by_local in tables:
        at = view.square_columns
        shared = shared.at[at[:, :, None], at[:, None, :]].add(view.squares(own))
        gradient = gradient.at[view.columns].add(view.views.sums(by_shared))
        couplings.append(jnp.pad(coupling, ((0, 0), (0, 0), (0, wide - coupling.shape[2]))))
        locals_.append(local)
        pulls.append(by_local)
    local = pattern.groups.sums(jnp.concatenate(locals_))
    pull = pattern.groups.sums(jnp.concatenate(pulls))
    return (
        jnp.concatenate([gradient[:s], jnp.ravel(pull)]),
        shared[:s, :s],
        local,
        jnp.concatenate(couplings),
    )


class SchurFactors:
    """Cholesky factors of damped normal equations: groups eliminated first, the rest dense.

    Unknowns that no observation touches (zero diagonal) stay where they are.
    """

    bends = True

    def __init__(self, pattern: SchurPattern):
        self.pattern = pattern

    def factorise(self, normal: SchurNormal, damping: float = 0.0) -> bool:
        """Factorise the matrix with its diagonal raised by `damping` of itself; False where it is
        not definite."""
        self._lower, self._half = _eliminated(normal.local, normal.coupling, self.pattern, damping)
        self._reduced, sound = _reduced(normal.shared, self._half, self.pattern, damping)
        return bool(sound)

    def damped(self, normal: SchurNormal) -> Float[np.ndarray, " n"]:
        """What damping is relative to: the present diagonal (Marquardt 1963)."""
        return normal.diagonal()

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for one right-hand side, with the latest factors."""
        return _solved(self.pattern, self._lower, self._half, self._reduced, jnp.asarray(right))


@jax.jit
def _eliminated(local, coupling, pattern: SchurPattern, damping):
    """Factors L of each group, and L^-1 W^T [d, shared] of each packet."""
    d = local.shape[1]
    diagonal = jnp.diagonal(local, axis1=1, axis2=2)
    raised = local + jnp.where(diagonal > 0.0, damping * diagonal, 1.0)[:, :, None] * jnp.eye(d)
    lower = _cholesky([[raised[:, i, j] for j in range(i + 1)] for i in range(d)])
    of_packet = [[jnp.append(one, 1.0)[pattern.group] for one in row] for row in lower]
    return lower, jnp.stack(_forward(of_packet, [coupling[:, k] for k in range(d)]), axis=1)


def _cholesky(a):
    """Cholesky factor of many small matrices, component by component: each is one long vector."""
    d = len(a)
    lower = [[a[i][j] for j in range(i + 1)] for i in range(d)]
    for j in range(d):
        pivot = lower[j][j] - sum(lower[j][k] ** 2 for k in range(j))
        lower[j][j] = jnp.sqrt(pivot)
        for i in range(j + 1, d):
            rest = lower[i][j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            lower[i][j] = rest / lower[j][j]
    return lower


def _forward(lower, right):
    """L^-1 right, component by component; right may have further axes behind the first."""
    found = []
    for i, own in enumerate(right):
        for k in range(i):
            own = own - _along(lower[i][k], own) * found[k]
        found.append(own / _along(lower[i][i], own))
    return found


def _backward(lower, right):
    """L^-T right, component by component."""
    found = {}
    for i in reversed(range(len(right))):
        own = right[i] - sum(lower[k][i] * found[k] for k in found)
        found[i] = own / lower[i][i]
    return [found[i] for i in range(len(right))]


def _along(vector, values):
    return jnp.reshape(vector, (-1,) + (1,) * (values.ndim - 1))


@jax.jit
def _reduced(shared, half, pattern: SchurPattern, damping):
    """Cholesky factor of the reduced matrix, scaled to a unit diagonal, and whether it is sound."""
    s = shared.shape[0]
    products = pattern.pairs(half)
    rows, columns = pattern.pair_rows[:, :, None], pattern.pair_columns[:, None, :]
    taken = jnp.zeros((s + 1, s + 1)).at[rows, columns].add(
        products * pattern.halved[:, None, None]
    )[:s, :s]  # fmt: skip
    diagonal = jnp.diagonal(shared)
    raised = shared + jnp.diag(jnp.where(diagonal > 0.0, damping * diagonal, 1.0))
    matrix = raised - taken - taken.T
    scale = 1.0 / jnp.sqrt(jnp.diagonal(matrix))
    factor = jnp.linalg.cholesky(scale[:, None] * matrix * scale)
    return (factor, scale), jnp.all(jnp.isfinite(factor))


@jax.jit
def _solved(pattern: SchurPattern, lower, half, reduced, right):
    s, n_groups, d = pattern.sizes
    a, b = right[:s], jnp.reshape(right[s:], (n_groups, d))
    forward = jnp.stack(_forward(lower, [b[:, k] for k in range(d)]), axis=1)
    taken = jnp.sum(half * padded(forward)[pattern.group][:, :, None], axis=1)
    top = jnp.append(a, 0.0)
    for view, own in pattern.by_table(taken):
        top = top.at[view.columns].add(-view.views.sums(own[:, : view.columns.shape[1]]))
    factor, scale = reduced
    shared = scale * jsl.cho_solve((factor, True), scale * top[:s])
    seen = jnp.append(shared, 0.0)
    back = [
        jnp.sum(own[:, :, : view.columns.shape[1]] * seen[view.packets.columns][:, None, :], axis=2)
        for view, own in pattern.by_table(half)
    ]
    rest = forward - pattern.groups.sums(jnp.concatenate(back))
    local = jnp.stack(_backward(lower, [rest[:, k] for k in range(d)]), axis=1)
    return jnp.concatenate([shared, jnp.ravel(local)])
