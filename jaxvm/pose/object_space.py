"""The object-space error of a pose as a quadratic form of its rotation.

With rays v_i, F_i = I - v v^T / (v^T v) and the shift that is best for a rotation,

    E(R) = sum_i |F_i (R p_i + t(R))|^2 = r^T Omega r,   t(R) = T r,

where r holds the rows of R (Lu, Hager, Mjolsness 2000, eq. 19 and 20; as a form of nine numbers
Terzakis and Lourakis 2020). Whatever the number of points, an iteration costs a product with a
9 x 9 matrix.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry import Pose, hat


class ObjectSpace(eqx.Module):
    """Object-space error of a sighting.

    Attributes:
        omega: Omega (m^2).
        shift_of: T.
        spread: C = sum w (p - mean) (p - mean)^T (m^2).
    """

    omega: Float[Array, "9 9"]
    shift_of: Float[Array, "3 9"]
    spread: Float[Array, "3 3"]

    def error(self, rotation: Float[Array, "3 3"]) -> Float[Array, ""]:
        """E (m^2) with the best shift."""
        r = rotation.reshape(9)
        return r @ self.omega @ r

    def pose(self, rotation: Float[Array, "3 3"]) -> Pose:
        """camera_from_target with the best shift for a rotation."""
        return Pose(rotation, self.shift_of @ rotation.reshape(9))

    def derivatives(
        self, rotation: Float[Array, "3 3"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Gradient and Hessian of E over a turn w: E(exp(w) R)."""
        generators = jnp.stack([hat(axis) for axis in jnp.eye(3)])
        turned = generators @ rotation  # [3, 3, 3]
        rows = turned.reshape(3, 9)
        pull = self.omega @ rotation.reshape(9)
        # exp(w) R = R + hat(w) R + hat(w)^2 R / 2
        bend = (generators[:, None] @ turned[None]).reshape(3, 3, 9) @ pull
        return 2.0 * rows @ pull, 2.0 * rows @ self.omega @ rows.T + bend + bend.T


def object_space(
    points: Float[Array, "n 3"], image: Float[Array, "n 2"], weight: Float[Array, " n"]
) -> ObjectSpace:
    """The object-space error of ideal image points with weights."""
    ray = jnp.concatenate([image, jnp.ones((len(image), 1))], axis=1)
    unit = ray / jnp.linalg.norm(ray, axis=1, keepdims=True)
    across = weight[:, None, None] * (jnp.eye(3) - unit[:, :, None] * unit[:, None, :])  # w F
    moment = jnp.einsum("nab,nc->abc", across, points).reshape(3, 9)
    shift_of = -jnp.linalg.solve(across.sum(axis=0), moment)
    square = jnp.einsum("nab,nc,nd->acbd", across, points, points).reshape(9, 9)
    mean = weight @ points / weight.sum()
    centred = points - mean
    return ObjectSpace(
        omega=square + moment.T @ shift_of,
        shift_of=shift_of,
        spread=jnp.einsum("n,nc,nd->cd", weight, centred, centred),
    )
