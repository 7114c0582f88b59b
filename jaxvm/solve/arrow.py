"""Normal equations in arrow form, and the lineax solver that uses the form.

    H = [ U   W^T ]     shared unknowns: U, dense
        [ W   V   ]     local unknowns: V, one small block for each group; W couples them to U

The local unknowns are eliminated first (Schur complement, batched small Cholesky), the reduced
system S = U - sum W^T V^-1 W is dense. Brown 1958; Triggs et al. 2000, section 6.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import lineax as lx
from jaxtyping import Array, Bool, Float


class Arrow(lx.AbstractLinearOperator):
    """A symmetric positive (semi)definite matrix in arrow form, as a lineax operator.

    Vectors are ordered [shared | group 0 | group 1 | ...].
    """

    shared: Float[Array, "s s"]
    coupling: Float[Array, "groups d s"]
    local: Float[Array, "groups d d"]

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Number of shared unknowns, of groups, and of unknowns in a group."""
        groups, d, s = self.coupling.shape
        return s, groups, d

    def split(self, x: Float[Array, "n *k"]) -> tuple[Array, Array]:
        """Shared [s, ...] and local [groups, d, ...] part of a vector or a block of columns."""
        s, groups, d = self.sizes
        return x[:s], jnp.reshape(x[s:], (groups, d, *x.shape[1:]))

    @staticmethod
    def join(shared: Array, local: Array) -> Array:
        """Inverse of `split`."""
        rows = math.prod(local.shape[:2])
        return jnp.concatenate([shared, jnp.reshape(local, (rows, *local.shape[2:]))])

    def mv(self, vector: Float[Array, " n"]) -> Float[Array, " n"]:
        """Matrix times vector."""
        a, b = self.split(vector)
        top = self.shared @ a + jnp.einsum("gds,gd->s", self.coupling, b)
        return self.join(top, self.coupling @ a + jnp.einsum("gde,ge->gd", self.local, b))

    def diagonal(self) -> Float[Array, " n"]:
        """Diagonal of the matrix."""
        return self.join(jnp.diagonal(self.shared), jnp.diagonal(self.local, axis1=1, axis2=2))

    def add_diagonal(self, values: Float[Array, " n"]) -> "Arrow":
        """The matrix with a diagonal added."""
        a, b = self.split(values)
        return Arrow(self.shared + jnp.diag(a), self.coupling, self.local + jax.vmap(jnp.diag)(b))

    def as_matrix(self) -> Float[Array, "n n"]:
        """The dense matrix, for tests and small problems."""
        return jax.vmap(self.mv)(jnp.eye(self.in_size()))

    def transpose(self) -> "Arrow":
        """Itself."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Shape of the vectors it takes."""
        s, groups, d = self.sizes
        return jax.ShapeDtypeStruct((s + groups * d,), self.shared.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """Shape of the vectors it gives."""
        return self.in_structure()


class ArrowFactors(eqx.Module):
    """Cholesky factors of an arrow matrix."""

    arrow: Arrow
    touched: Bool[Array, " n"]  # unknowns with a diagonal
    local: Float[Array, "groups d d"]
    coupled: Float[Array, "groups d s"]  # L^-1 W of each group
    reduced: Float[Array, "s s"]

    def solve(self, rhs: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """Solution for one right-hand side or a block of them."""
        flat = rhs if rhs.ndim == 2 else rhs[:, None]
        a, b = self.arrow.split(flat)
        half = _lower_solve(self.local, b)
        top = a - jnp.einsum("gds,gdk->sk", self.coupled, half)
        shared = jsl.cho_solve((self.reduced, True), top)
        local = _lower_solve(
            self.local, half - jnp.einsum("gds,sk->gdk", self.coupled, shared), trans=1
        )
        return jnp.reshape(Arrow.join(shared, local), rhs.shape)


def _lower_solve(factor, rhs, trans: int = 0):
    return jax.vmap(lambda f, b: jsl.solve_triangular(f, b, lower=True, trans=trans))(factor, rhs)


def factorise(arrow: Arrow) -> ArrowFactors:
    """Cholesky factors. Unknowns that no observation touches (zero diagonal) stay where they are.

    A matrix that is not positive definite gives NaN.
    """
    diagonal = arrow.diagonal()
    arrow = arrow.add_diagonal(jnp.where(diagonal == 0.0, 1.0, 0.0))
    local = jnp.linalg.cholesky(arrow.local)
    coupled = _lower_solve(local, arrow.coupling)
    s, groups, d = arrow.sizes
    tall = jnp.reshape(coupled, (groups * d, s))
    return ArrowFactors(
        arrow, diagonal != 0.0, local, coupled, jnp.linalg.cholesky(arrow.shared - tall.T @ tall)
    )


class ArrowCholesky(lx.AbstractLinearSolver[ArrowFactors]):
    """Lineax solver for `Arrow` operators, alone or damped (`arrow + scalar * identity`)."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> ArrowFactors:
        """Factorise. TypeError for an operator that is no (damped) arrow."""
        return factorise(_as_arrow(operator))

    def compute(self, state: ArrowFactors, vector, options: dict[str, Any]):
        """Solve; the result is a failure if the matrix was not positive definite."""
        solution = state.solve(vector)
        finite = jnp.all(jnp.isfinite(solution))
        result = lx.RESULTS.where(finite, lx.RESULTS.successful, lx.RESULTS.singular)
        return jnp.where(finite, solution, 0.0), result, {}

    def transpose(self, state: ArrowFactors, options: dict[str, Any]):
        """The matrix is symmetric."""
        return state, options

    def conj(self, state: ArrowFactors, options: dict[str, Any]):
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Rank deficiency is a failure here; `jaxvm.solve.gauge` names it."""
        return True


def _as_arrow(operator: lx.AbstractLinearOperator) -> Arrow:
    if isinstance(operator, Arrow):
        return operator
    if isinstance(operator, lx.TaggedLinearOperator):
        return _as_arrow(operator.operator)
    if isinstance(operator, lx.AddLinearOperator):
        arrow, shift = _as_arrow(operator.operator1), operator.operator2
        if isinstance(shift, lx.MulLinearOperator) and isinstance(
            shift.operator, lx.IdentityLinearOperator
        ):
            scalar = jnp.broadcast_to(shift.scalar, (arrow.in_size(),))
            return arrow.add_diagonal(scalar)
    raise TypeError(f"ArrowCholesky solves arrow matrices, not {type(operator).__name__}")


for _property in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.has_unit_diagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_negative_semidefinite,
):
    _property.register(Arrow)(lambda operator: False)
for _property in (lx.is_symmetric, lx.is_positive_semidefinite):
    _property.register(Arrow)(lambda operator: True)
for _transform in (lx.linearise, lx.materialise, lx.conj):
    _transform.register(Arrow)(lambda operator: operator)
lx.diagonal.register(Arrow)(lambda operator: operator.diagonal())
