"""Lenses: from a ray in camera coordinates to the ideal image point (principal distance 1).

Families are static objects without numbers; coefficients are data. Brown-Conrady (Brown 1971) in
OpenCV's order with 0, 4, 5, 8, 12 or 14 coefficients, Kannala-Brandt (2006) as OpenCV's fisheye.
"""

import abc
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_NEWTON_STEPS = 30


class LensFamily(eqx.Module):
    """A family of lenses: its name, its number of coefficients, and how it distorts."""

    name: str = eqx.field(static=True)
    n_coefficients: int = eqx.field(static=True)

    @abc.abstractmethod
    def distort(
        self,
        coefficients: Float[Array, " n"],
        ray: Float[Array, "3"],
        extra: Float[Array, "7"] | None = None,
    ) -> Float[Array, "2"]:
        """Ideal image point of a ray (any length, z forward).

        Args:
            coefficients: of the family.
            ray: point or direction in camera coordinates.
            extra: (k1, k2, k3, p1, p2, tilt_x, tilt_y) added to the family's own.
        """

    @abc.abstractmethod
    def undistort(
        self, coefficients: Float[Array, " n"], image_point: Float[Array, "2"]
    ) -> Float[Array, "3"]:
        """Ray of an ideal image point: the inverse of `distort`. NaN where there is none."""


class BrownConrady(LensFamily):
    """Perspective lens with radial (rational), decentring, thin-prism and tilt terms.

    Coefficients k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y, cut off after the family's number.
    """

    def __init__(self, n: int):
        if n not in (0, 4, 5, 8, 12, 14):
            raise ValueError(f"OpenCV's lens has 0, 4, 5, 8, 12 or 14 coefficients, not {n}")
        self.name = f"opencv{n}" if n else "pinhole"
        self.n_coefficients = n

    def distort(self, coefficients, ray, extra=None):
        in_front = ray[2] > 0.0
        depth = jnp.where(in_front, ray[2], 1.0)
        image_point = self._plane(coefficients, ray[:2] / depth, extra)
        return jnp.where(in_front, image_point, jnp.nan)

    def _plane(self, coefficients, tangent, extra=None):
        n, c = self.n_coefficients, coefficients
        if n == 0 and extra is None:
            return tangent
        k1, k2, p1, p2 = (c[i] if n > i else 0.0 for i in range(4))
        k3 = c[4] if n > 4 else 0.0
        tilt_x, tilt_y = (c[12], c[13]) if n > 12 else (0.0, 0.0)
        if extra is not None:
            k1, k2, k3 = k1 + extra[0], k2 + extra[1], k3 + extra[2]
            p1, p2 = p1 + extra[3], p2 + extra[4]
            tilt_x, tilt_y = tilt_x + extra[5], tilt_y + extra[6]
        x, y = tangent
        r2 = x**2 + y**2
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if n > 5:
            radial = radial / (1.0 + r2 * (c[5] + r2 * (c[6] + r2 * c[7])))
        u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2)
        v = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y
        if n > 8:
            u = u + r2 * (c[8] + r2 * c[9])
            v = v + r2 * (c[10] + r2 * c[11])
        if n > 12 or extra is not None:
            return tilt(tilt_x, tilt_y, jnp.stack([u, v]))
        return jnp.stack([u, v])

    def undistort(self, coefficients, image_point):
        tangent = _invert(lambda t: self._plane(coefficients, t), image_point)
        # Beyond the edge of the image circle the polynomial folds back; no ray is imaged there.
        slope = jax.jacfwd(lambda t: self._plane(coefficients, t))(jax.lax.stop_gradient(tangent))
        seen = (jnp.linalg.det(slope) > 0.0) & (jnp.trace(slope) > 0.0)
        return jnp.append(jnp.where(seen, tangent, jnp.nan), 1.0)


class Radial(BrownConrady):
    """k1 and k2 alone, the lens of structure from motion (Snavely, Seitz & Szeliski 2006).

    A point behind the camera is imaged through its centre, as the programs there do: among very
    many points the start of some may be wrong, and an adjustment brings them to the front.
    """

    def __init__(self):
        self.name = "radial"
        self.n_coefficients = 2

    def distort(self, coefficients, ray, extra=None):
        return self._plane(coefficients, ray[:2] / ray[2], extra)


class KannalaBrandt(LensFamily):
    """Fisheye: theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).

    Sees beyond 90 degrees from the axis; `undistort` gives rays of unit length.
    """

    def __init__(self):
        self.name = "fisheye"
        self.n_coefficients = 4

    def _angle(self, k, theta):
        t2 = theta**2
        return theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))

    def distort(self, coefficients, ray, extra=None):
        k = coefficients
        if extra is not None:
            k = k + jnp.concatenate([extra[:3], jnp.zeros(1)])
        square = ray[0] ** 2 + ray[1] ** 2
        off_axis = square > 1e-24 * (ray @ ray)
        rho = jnp.sqrt(jnp.where(off_axis, square, 1.0))
        theta = jnp.arctan2(rho, ray[2])
        # On the axis theta_d / rho is 1 / z, and smooth.
        axis_depth = jnp.where(off_axis, 1.0, jnp.where(ray[2] > 0.0, ray[2], jnp.nan))
        scale = jnp.where(off_axis, self._angle(k, theta) / rho, 1.0 / axis_depth)
        point = scale * ray[:2]
        if extra is None:
            return point
        x, y = point
        r2 = x**2 + y**2
        u = x + 2.0 * extra[3] * x * y + extra[4] * (r2 + 2.0 * x**2)
        v = y + extra[3] * (r2 + 2.0 * y**2) + 2.0 * extra[4] * x * y
        return tilt(extra[5], extra[6], jnp.stack([u, v]))

    def undistort(self, coefficients, image_point):
        square = image_point @ image_point
        off_axis = square > 0.0
        radius = jnp.sqrt(jnp.where(off_axis, square, 1.0))
        theta = _invert(lambda t: self._angle(coefficients, t), jnp.where(off_axis, radius, 0.0))
        theta = jnp.where((theta >= 0.0) & (theta <= jnp.pi), theta, jnp.nan)
        direction = image_point / radius
        ray = jnp.append(jnp.sin(theta) * direction, jnp.cos(theta))
        axis = jnp.append(image_point, 1.0)
        return jnp.where(off_axis, ray, axis)


def tilt(
    tilt_x: Float[Array, ""] | float, tilt_y: Float[Array, ""] | float, point: Float[Array, "2"]
) -> Float[Array, "2"]:
    """Image point on a sensor tilted by two angles (rad) against the lens (Scheimpflug), as OpenCV.

    R = Ry(tilt_y) Rx(tilt_x) in OpenCV's signs; the point goes through the projection onto the
    tilted plane and back along the axis.
    """
    tilt_x, tilt_y = jnp.asarray(tilt_x, float), jnp.asarray(tilt_y, float)
    cx, sx, cy, sy = jnp.cos(tilt_x), jnp.sin(tilt_x), jnp.cos(tilt_y), jnp.sin(tilt_y)
    x, y = point
    # Rows of R = Ry Rx; the first two projected components and the depth of R (x, y, 1).
    a = cy * x + sy * sx * y - sy * cx
    b = cx * y + sx
    depth = sy * x - cy * sx * y + cy * cx
    # The projection matrix [[r33, 0, -r13], [0, r33, -r23], [0, 0, 1]] with R's last column.
    r13, r23, r33 = -sy * cx, sx, cy * cx
    return jnp.stack([r33 * a - r13 * depth, r33 * b - r23 * depth]) / depth


def _invert(function, target):
    """Newton's iteration for function(t) = target from t = target; differentiable.

    Steps are halved while they don't come nearer. One more step outside the loop carries the
    derivatives (implicit function theorem). NaN where no solution is found.
    """
    fixed = jax.lax.stop_gradient(target)

    def miss(t):
        difference = jax.lax.stop_gradient(function(t)) - fixed
        return jnp.sqrt(jnp.sum(difference**2))

    def newton(t, goal, evaluate):
        slope = jnp.atleast_2d(jax.jacfwd(evaluate)(t))
        gap = jnp.atleast_1d(evaluate(t) - goal)
        return t - jnp.reshape(jnp.linalg.solve(slope, gap), jnp.shape(t))

    def step(_, t):
        full = newton(t, fixed, function)
        shares = jnp.array([1.0, 0.5, 0.25, 0.125, 0.03])
        trials = jax.vmap(lambda share: t + share * (full - t))(shares)
        errors = jax.vmap(miss)(trials)
        errors = jnp.where(jnp.isfinite(errors), errors, jnp.inf)
        best = jnp.argmin(errors)
        return jnp.where(errors[best] < miss(t), trials[best], t)

    solution = jax.lax.stop_gradient(jax.lax.fori_loop(0, _NEWTON_STEPS, step, fixed))
    found = miss(solution) <= 1e-9 * (1.0 + jnp.sqrt(jnp.sum(fixed**2)))
    # The last step moves nothing but carries the derivatives.
    polished = newton(solution, target, function)
    return jnp.where(found, polished, jnp.nan)


LENS_NAMES = (
    "pinhole",
    "radial",
    "opencv4",
    "opencv5",
    "opencv8",
    "opencv12",
    "opencv14",
    "fisheye",
)
"""Names of lenses in a recording."""


@cache
def lens_family(name: str) -> LensFamily:
    """Family of a lens by name; ValueError naming the known ones otherwise."""
    if name not in LENS_NAMES:
        raise ValueError(f'there is no lens "{name}" (there are: {", ".join(LENS_NAMES)})')
    if name == "fisheye":
        return KannalaBrandt()
    if name == "radial":
        return Radial()
    return BrownConrady(0 if name == "pinhole" else int(name.removeprefix("opencv")))


def project(
    family: LensFamily,
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    coefficients: Float[Array, " n"],
    point_cam: Float[Array, "3"],
) -> Float[Array, "2"]:
    """Pixel of a point in camera coordinates (m); NaN where the lens can't see it."""
    return focal * family.distort(coefficients, point_cam) + centre


def unproject(
    family: LensFamily,
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    coefficients: Float[Array, " n"],
    pixel: Float[Array, "2"],
) -> Float[Array, "3"]:
    """Ray (camera coordinates) of a pixel."""
    return family.undistort(coefficients, (pixel - centre) / focal)
