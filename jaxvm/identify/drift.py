"""Image drift: how every image point moves when a camera changes, linear and exact.

A camera's state is its principal distances, its principal point, its distortion, and a small turn w
and shift d of what it sees, X -> exp(w) X + d. For a pinhole, with x = X/Z, y = Y/Z,

    du = dcx + x dfx + fx (dx/Z - x dz/Z - x y wx + (1 + x^2) wy - y wz),
    dv = dcy + y dfy + fy (dy/Z - y dz/Z - (1 + y^2) wx + x y wy + x wz)

(MATHEMATICS 1.1). The columns here come from the chain by differentiation, for any lens.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry import LensFamily, so3_exp

INTRINSIC = ("fx", "fy", "cx", "cy")
EXTRINSIC = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z")
"""Turn (rad) and shift (m) of what the camera sees."""


class CameraState(eqx.Module):
    """Interior orientation of a camera.

    Attributes:
        focal, centre: principal distances and principal point (px).
        coefficients: of the lens.
        lens: its family.
    """

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    coefficients: Float[Array, " k"]
    lens: LensFamily = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of what may change, in the order of `drift_columns`."""
        own = (f"distortion_{k + 1}" for k in range(self.lens.n_coefficients))
        return (*INTRINSIC, *own, *EXTRINSIC)


def image(
    camera: CameraState, points: Float[Array, "n 3"], change: Float[Array, " p"]
) -> Float[Array, "n 2"]:
    """Pixels of points in camera coordinates (m) when the camera has changed; the full model.

    Args:
        change: of fx, fy, cx, cy (px), the coefficients, turn (rad) and shift (m).
    """
    k = camera.lens.n_coefficients
    focal, centre = camera.focal + change[:2], camera.centre + change[2:4]
    coefficients = camera.coefficients[:k] + change[4 : 4 + k]
    turn, shift = change[4 + k : 7 + k], change[7 + k :]
    seen = points @ so3_exp(turn).T + shift
    ideal = jax.vmap(lambda ray: camera.lens.distort(coefficients, ray))(seen)
    return focal * ideal + centre


def exact_drift(
    camera: CameraState, points: Float[Array, "n 3"], change: Float[Array, " p"]
) -> Float[Array, "n 2"]:
    """Displacement (px) of every image point under a change; the full model."""
    return image(camera, points, change) - image(camera, points, jnp.zeros_like(change))


def drift_columns(camera: CameraState, points: Float[Array, "n 3"]) -> Float[Array, "n 2 p"]:
    """The general linear drift model: pixels per unit of each parameter, by differentiation."""
    still = jnp.zeros(len(camera.parameters))
    return jax.jacfwd(lambda change: image(camera, points, change))(still)


def linear_drift(
    camera: CameraState, points: Float[Array, "n 3"], change: Float[Array, " p"]
) -> Float[Array, "n 2"]:
    """Displacement (px) of every image point under a change, to first order."""
    return drift_columns(camera, points) @ change


SIMILARITY = ("shift_u", "shift_v", "stretch_u", "stretch_v", "roll")


def similarity_columns(camera: CameraState, points: Float[Array, "n 3"]) -> Float[Array, "n 2 5"]:
    """The simplified model of a narrow field: five numbers that an image can show.

    du = A + s_u x' - r y', dv = B + s_v y' + r x' with x' = fx x, y' = fy y in pixels; what is left
    out is of the order of (field angle)^2 times the turn in pixels (MATHEMATICS 1.4).
    """
    at = camera.focal * points[:, :2] / points[:, 2:]
    one, zero = jnp.ones(len(at)), jnp.zeros(len(at))
    du = jnp.stack([one, zero, at[:, 0], zero, -at[:, 1]], axis=1)
    dv = jnp.stack([zero, one, zero, at[:, 1], at[:, 0]], axis=1)
    return jnp.stack([du, dv], axis=1)


def similarity_of(
    camera: CameraState, depth: Float[Array, ""], change: Float[Array, " p"]
) -> Float[Array, "5"]:
    """The five numbers that a change makes for targets at one depth (m), without distortion."""
    k = camera.lens.n_coefficients
    (fx, fy), turn, shift = camera.focal, change[4 + k : 7 + k], change[7 + k :]
    return jnp.stack(
        [
            change[2] + fx * turn[1] + fx * shift[0] / depth,
            change[3] - fy * turn[0] + fy * shift[1] / depth,
            change[0] / fx - shift[2] / depth,
            change[1] / fy - shift[2] / depth,
            turn[2],
        ]
    )
