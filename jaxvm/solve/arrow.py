"""Normal equations in arrow form, and the lineax solver of matrices that know their form.

    H = [ U   W^T ]     shared unknowns: U, dense
        [ W   V   ]     local unknowns: V, one small block for each group; W couples them to U

The local unknowns are eliminated first (Schur complement, batched small Cholesky), the reduced
system S = U - sum W^T V^-1 W is dense. Brown 1958; Triggs et al. 2000, section 6.
"""

import abc
import math
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import lineax as lx
from jaxtyping import Array, Bool, Float


class CholeskyFactors(Protocol):
    """Cholesky factors of a matrix."""

    def solve(self, rhs: Float[Array, "n *k"]) -> Float[Array, "n *k"]: ...


class NormalMatrix(lx.AbstractLinearOperator):
    """A symmetric positive (semi)definite matrix that knows its form, as a lineax operator."""

    @abc.abstractmethod
    def diagonal(self) -> Float[Array, " n"]:
        """Diagonal of the matrix."""

    @abc.abstractmethod
    def add_diagonal(self, values: Float[Array, " n"]) -> "NormalMatrix":
        """The matrix with a diagonal added."""

    @abc.abstractmethod
    def factorised(self) -> CholeskyFactors:
        """Cholesky factors. Unknowns that no observation touches (zero diagonal) stay where they
        are. A matrix that is not positive definite gives NaN."""

    def as_matrix(self) -> Float[Array, "n n"]:
        """The dense matrix, for tests and small problems."""
        return jax.vmap(self.mv)(jnp.eye(self.in_size()))

    def transpose(self) -> "NormalMatrix":
        """Itself."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Shape of the vectors it takes."""
        return jax.eval_shape(self.diagonal)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """Shape of the vectors it gives."""
        return self.in_structure()


class Arrow(NormalMatrix):
    """A symmetric positive (semi)definite matrix in arrow form.

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

    def factorised(self) -> "ArrowFactors":
        """Cholesky factors (`factorise`)."""
        return factorise(self)


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


class NormalCholesky(lx.AbstractLinearSolver[CholeskyFactors]):
    """Lineax solver for normal matrices, alone or damped (`matrix + scalar * identity`)."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> CholeskyFactors:
        """Factorise. TypeError for an operator that is no (damped) normal matrix."""
        return _as_normal(operator).factorised()

    def compute(self, state: CholeskyFactors, vector, options: dict[str, Any]):
        """Solve; the result is a failure if the matrix was not positive definite."""
        solution = state.solve(vector)
        finite = jnp.all(jnp.isfinite(solution))
        result = lx.RESULTS.where(finite, lx.RESULTS.successful, lx.RESULTS.singular)
        return jnp.where(finite, solution, 0.0), result, {}

    def transpose(self, state: CholeskyFactors, options: dict[str, Any]):
        """The matrix is symmetric."""
        return state, options

    def conj(self, state: CholeskyFactors, options: dict[str, Any]):
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Rank deficiency is a failure here; `jaxvm.solve.gauge` names it."""
        return True


def _as_normal(operator: lx.AbstractLinearOperator) -> NormalMatrix:
    if isinstance(operator, NormalMatrix):
        return operator
    if isinstance(operator, lx.TaggedLinearOperator):
        return _as_normal(operator.operator)
    if isinstance(operator, lx.AddLinearOperator):
        matrix, shift = _as_normal(operator.operator1), operator.operator2
        if isinstance(shift, lx.MulLinearOperator) and isinstance(
            shift.operator, lx.IdentityLinearOperator
        ):
            return matrix.add_diagonal(jnp.broadcast_to(shift.scalar, (matrix.in_size(),)))
    raise TypeError(f"NormalCholesky solves normal matrices, not {type(operator).__name__}")


for _property in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.has_unit_diagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_negative_semidefinite,
):
    _property.register(NormalMatrix)(lambda operator: False)
for _property in (lx.is_symmetric, lx.is_positive_semidefinite):
    _property.register(NormalMatrix)(lambda operator: True)
for _transform in (lx.linearise, lx.materialise, lx.conj):
    _transform.register(NormalMatrix)(lambda operator: operator)
lx.diagonal.register(NormalMatrix)(lambda operator: operator.diagonal())
