"""The model chain: one pure function for each stage, and their composition for one observation.

    target -> structure -> shutter -> medium -> mount -> lens -> sensor -> detection

Each stage takes the ports that act on it (`jaxvm.physics.ports`); with all ports at zero the chain
is the plain model. Only one observation is written here: tables of observations are `vmap`ped.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.geometry.lenses import LensFamily
from jaxvm.geometry.poses import Pose, pose_from_vector
from jaxvm.geometry.rotations import rotate
from jaxvm.physics.ports import PortValues

WINDOW_INDEX = 1.52
"""Refractive index of the glass that `medium.window` puts before the lens (N-BK7, visible)."""

DOME_RADII = 0.070, 0.074
"""Inner and outer radius (m) of the dome of that glass of which `medium.dome` tells the middle."""

_DOME_TURNS = 2
"""Times that the ray inside the dome is aimed; what a third one changes can't be measured."""


class Sight(NamedTuple):
    """The unknowns that one observation touches, gathered from the state; poses in either form."""

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    distortion: Float[Array, " coefficients"]
    station_from_camera: Float[Array, "6"] | Pose
    world_from_station: Float[Array, "6"] | Pose
    world_from_carrier: Float[Array, "6"] | Pose  # of the target: a station, or the world itself
    carrier_from_target: Float[Array, "6"] | Pose
    point: Float[Array, "3"]

    @property
    def world_from_target(self) -> Pose:
        """Pose of the target."""
        return pose_from_vector(self.world_from_carrier) @ pose_from_vector(
            self.carrier_from_target
        )


class Circumstances(NamedTuple):
    """What is recorded about one observation and is not estimated."""

    pixel: Float[Array, "2"]  # measured (or nominal) image point, px
    image_height: Float[Array, ""]  # px
    target_centre: Float[Array, "3"]  # target coordinates, m
    target_half_size: Float[Array, "2"]  # target coordinates, m
    checker: Float[Array, ""]  # +1 and -1 in turn over the marks of a grid; NaN without a grid
    mark: Float[Array, ""]  # number of the mark among those of all targets
    epoch: Float[Array, ""]  # number of the epoch
    along_beam: Float[Array, ""]  # place of the camera on its station, -1 to 1; NaN without one
    velocity: Float[Array, "6"]  # of the target's origin in the world: m/s and rad/s


# --- target -------------------------------------------------------------------------------------


def mark(
    point: Float[Array, "3"],
    centre: Float[Array, "3"],
    half_size: Float[Array, "2"],
    ports: PortValues,
) -> Float[Array, "3"]:
    """Mark in target coordinates (m) on a target that has grown, bent or been misprinted.

    Bow and twist have mrcal's shape: `bow_x` is the deflection of the middle against the edges,
    4c(1-c) over the width c in [0, 1], which is 1-xi^2 over xi in [-1, 1]; twist is xi*eta.
    Growth acts about the centre of the target, the part of a plate that its pose describes.
    """
    if ports.plain:
        return point
    arm = point - centre
    xi, eta = arm[:2] / half_size
    growth = 1.0 + jnp.stack(
        [
            ports["target.scale"] + ports["target.scale_x"],
            ports["target.scale"] + ports["target.scale_y"],
            jnp.asarray(ports["target.scale"]),
        ]
    )
    lift = (
        ports["target.bow_x"] * (1.0 - xi**2)
        + ports["target.bow_y"] * (1.0 - eta**2)
        + ports["target.twist"] * xi * eta
    )
    grown = centre + growth * arm + jnp.zeros(3).at[2].set(lift)
    return grown + ports.axes("target.point")


# --- structure and shutter ----------------------------------------------------------------------


def place(
    world_from_carrier: Pose,
    carrier_from_target: Pose,
    mark_target: Float[Array, "3"],
    delay: Float[Array, ""] | float,
    velocity: Float[Array, "6"],
    ports: PortValues,
) -> Float[Array, "3"]:
    """Mark in the world (m) at the moment of exposure, `delay` seconds after the recorded time.

    The target turns about its own origin and about axes parallel to the world's.
    """
    if ports.plain:
        return world_from_carrier.apply(carrier_from_target.apply(mark_target))
    arm = world_from_carrier.rotate(carrier_from_target.rotate(mark_target))
    origin = world_from_carrier.apply(carrier_from_target.shift)
    turn = ports.axes("structure.turn") + delay * velocity[3:]
    shift = ports.axes("structure.shift") + delay * velocity[:3]
    return rotate(turn, arm) + origin + shift


def exposure_delay(
    pixel: Float[Array, "2"], image_height: Float[Array, ""], ports: PortValues
) -> Float[Array, ""] | float:
    """Seconds between the recorded time and the exposure of the row that holds the mark.

    `shutter.row_time` counts from the middle row, so it does not act as a clock offset.
    """
    if ports.plain:
        return 0.0
    row = (pixel[1] + 0.5) / image_height - 0.5
    return ports["clock.offset"] + ports["shutter.row_time"] * row


# --- mount --------------------------------------------------------------------------------------


def look(
    world_from_station: Pose,
    station_from_camera: Pose,
    mark_world: Float[Array, "3"],
    ports: PortValues,
) -> Float[Array, "3"]:
    """Mark in camera coordinates (m). Station and camera turn and move about their own axes."""
    seen_by_station = _disturb(world_from_station.unapply(mark_world), "station", ports)
    return _disturb(station_from_camera.unapply(seen_by_station), "mount", ports)


def _disturb(point: Float[Array, "3"], body: str, ports: PortValues) -> Float[Array, "3"]:
    if ports.plain:
        return point
    # The body turns by +omega and moves by +s in its own axes, so what it sees does the opposite.
    return rotate(-ports.axes(f"{body}.turn"), point - ports.axes(f"{body}.shift"))


# --- medium -------------------------------------------------------------------------------------


def level_axes(up: tuple[float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Two level directions and the one upwards (columns, world axes).

    The first level one is as near as can be to the axis of the world that is least upright.
    """
    upwards = np.asarray(up, float) / np.linalg.norm(up)
    nearest = np.eye(3)[np.argmin(np.abs(upwards))]
    first = nearest - (nearest @ upwards) * upwards
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(upwards, first), upwards], axis=1)


def layers(up: tuple[float, float, float], ports: PortValues) -> Float[Array, "3"]:
    """Curvature (1/m, world axes) that layered air gives to rays, alike for all cameras."""
    return jnp.asarray(level_axes(up)) @ jnp.stack(
        [ports["medium.layers_x"], ports["medium.layers_y"], ports["medium.layers_up"]]
    )


def refract(
    mark_cam: Float[Array, "3"], curvature: Float[Array, "3"], ports: PortValues
) -> Float[Array, "3"]:
    """Apparent mark in camera coordinates (m) through bending air and a window or a dome.

    Air with a constant gradient of its index bends rays to arcs of a curvature k (rad per m of
    path), given in camera axes: the mark seems displaced by k L^2 / 2 across the line of sight
    (MATHEMATICS 1.9). A plane-parallel plate of thickness d and index n, normal to the axis, brings
    the mark nearer by d (1 - cos i / sqrt(n^2 - sin^2 i)) along the axis and turns no ray. A plate
    whose far face is tilted by the wedge w turns rays by (sqrt(n^2 - sin^2 i) - cos i) w, in
    direction cosines across the axis (Snell's law at the far face, to first order in w). For a dome
    see `_through_dome`.
    """
    square = mark_cam @ mark_cam
    across_axis = jnp.stack([ports["medium.bend_u"], ports["medium.bend_v"], jnp.zeros(())])
    bent = mark_cam + 0.5 * square * (curvature + across_axis)
    cos2 = bent[2] ** 2 / (bent @ bent)
    nearer = ports["medium.window"] * (1.0 - jnp.sqrt(cos2 / (WINDOW_INDEX**2 - (1.0 - cos2))))
    straight = bent.at[2].add(-nearer)
    distance = jnp.linalg.norm(straight)
    way = straight / distance
    prism = jnp.sqrt(WINDOW_INDEX**2 - way[:2] @ way[:2]) - way[2]
    across = prism * jnp.stack([ports["medium.wedge_x"], ports["medium.wedge_y"]])
    # A direction keeps its length; nothing that is seen through a plane window is beside it.
    along = -(way[:2] @ across) / jnp.maximum(way[2], 0.05)
    turned = _through_dome(straight, ports.axes("medium.dome"))
    return turned + distance * jnp.concatenate([across, along[None]])


def _through_dome(mark: Float[Array, "3"], middle: Float[Array, "3"]) -> Float[Array, "3"]:
    """Apparent mark (m) through two spheres about a point that is beside the pupil (m).

    Snell's law at a sphere keeps the ray's distance p from the middle: sin i = p / R without and
    p / (n R) within the glass. Both faces together turn the ray about the middle by

        asin(p / R) - asin(p / (n R)) - asin(p / R') + asin(p / (n R')),

    which is all that they do. The apparent mark is the mark turned back by that angle, p being that
    of the ray inside, which is aimed at it.
    """
    inner, _ = DOME_RADII
    distance = jnp.linalg.norm(mark)
    way = mark / distance
    along = middle @ way
    off = middle - along * way
    # Without a dome there is no direction to it, and none is needed.
    apart = jnp.sqrt(off @ off + 1e-24)
    seen = jnp.stack([distance, jnp.zeros(())])
    for _ in range(_DOME_TURNS):
        p = (apart * seen[0] - along * seen[1]) / jnp.linalg.norm(seen)
        p = jnp.clip(p, -0.9 * inner, 0.9 * inner)
        by_face = [
            jnp.arcsin(p / radius) - jnp.arcsin(p / (WINDOW_INDEX * radius))
            for radius in DOME_RADII
        ]
        turn = by_face[0] - by_face[1]
        sine, cosine = jnp.sin(turn), jnp.cos(turn)
        from_middle = distance - along
        seen = jnp.stack(
            [
                along + from_middle * cosine + apart * sine,
                apart + from_middle * sine - apart * cosine,
            ]
        )
    return seen[0] * way + seen[1] * off / apart


# --- lens, sensor, detection --------------------------------------------------------------------


def image(
    family: LensFamily,
    distortion: Float[Array, " coefficients"],
    mark_cam: Float[Array, "3"],
    ports: PortValues,
) -> Float[Array, "2"]:
    """Ideal image point (principal distance 1) of a mark in camera coordinates (m).

    `lens.entrance` moves the entrance pupil along the axis by entrance * theta^2, theta being the
    field angle: rays then do not meet in one point (a non-central lens).
    """
    if ports.plain:
        return family.distort(distortion, mark_cam)
    theta = jnp.arctan2(_safe_norm(mark_cam[:2]), mark_cam[2])
    from_pupil = mark_cam.at[2].add(-ports["lens.entrance"] * theta**2)
    extra = jnp.stack(
        [
            ports["lens.k1"],
            ports["lens.k2"],
            ports["lens.k3"],
            ports["lens.p1"],
            ports["lens.p2"],
            ports["lens.tilt_x"],
            ports["lens.tilt_y"],
        ]
    )
    return family.distort(distortion, from_pupil, extra=extra)


def off_centre_of_disc(
    image_of: Callable[[Float[Array, "3"]], Float[Array, "2"]],
    mark_cam: Float[Array, "3"],
    plate: Float[Array, "3 2"],
) -> Float[Array, "2"]:
    """By how much the centre of gravity of a disc's image is off, in units of R^2/4 (1/m^2).

    With p(a, b) the image of the plate's points about the mark and J the determinant of its
    derivative F, the centroid of the image of a disc of radius R is, to the second order in R,

        p + R^2/8 (p_aa + p_bb) + R^2/4 F grad log |J|.

    For a pinhole that is the centre of the ellipse, on the axis f R^2 sin i cos i / Z^2 off the
    image of the disc's centre (MATHEMATICS 1.9; Ahn, Warnecke and Kotowski 1999); it holds for what
    a lens distorts and a window refracts across the mark as well.

    Args:
        image_of: image of a point in camera coordinates (m).
        mark_cam: centre of the mark in camera coordinates (m).
        plate: two directions along the plate in camera coordinates (columns).
    """

    def image_at(arm):
        return image_of(mark_cam + plate @ arm)

    def slope(arm):
        first = jax.jacfwd(image_at)(arm)
        return first, first

    second, ((a, b), (c, d)) = jax.jacfwd(slope, has_aux=True)(jnp.zeros(2))
    cofactors = jnp.array([[d, -c], [-b, a]])
    turned = jnp.einsum("ij,ijk->k", cofactors, second) / (a * d - b * c)
    return 0.5 * jnp.trace(second, axis1=1, axis2=2) + jnp.array([[a, b], [c, d]]) @ turned


def expose(
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    image_point: Float[Array, "2"],
    ports: PortValues,
) -> Float[Array, "2"]:
    """Measured pixel (px) of an ideal image point: sensor and detection."""
    if ports.plain:
        return focal * image_point + centre
    x, y = image_point
    stretch = 1.0 + ports["sensor.focal"]
    u = focal[0] * (stretch * (1.0 + ports["sensor.aspect"]) * x + ports["sensor.skew"] * y)
    v = focal[1] * stretch * y
    return centre + jnp.stack(
        [
            u + ports["sensor.cx"] + ports["detect.u"],
            v + ports["sensor.cy"] + ports["detect.v"],
        ]
    )


def predict_pixel(
    family: LensFamily,
    sight: Sight,
    circumstances: Circumstances,
    ports: PortValues,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Float[Array, "2"]:
    """Predicted pixel (px) of one observation: the whole chain. `up` is a world direction."""
    at = circumstances
    target = mark(sight.point, at.target_centre, at.target_half_size, ports)
    delay = exposure_delay(at.pixel, at.image_height, ports)
    carrier, own = map(pose_from_vector, (sight.world_from_carrier, sight.carrier_from_target))
    world = place(carrier, own, target, delay, at.velocity, ports)
    station, mounted = map(pose_from_vector, (sight.world_from_station, sight.station_from_camera))
    camera = look(station, mounted, world, ports)

    if ports.plain:
        image_point = image(family, sight.distortion, camera, ports)
        return expose(sight.focal, sight.centre, image_point, ports)

    def camera_from_world(direction):
        return mounted.unrotate(station.unrotate(direction))

    def image_of(point, distortion, curvature, ports):
        return image(family, distortion, refract(point, curvature, ports), ports)

    shown = sight.distortion, camera_from_world(layers(up, ports))
    image_point = image_of(camera, *shown, ports)
    if not ports.dear:
        return expose(sight.focal, sight.centre, image_point, ports)
    plate = jnp.stack([camera_from_world(carrier.rotate(own.rotate(a))) for a in jnp.eye(3)[:2]], 1)
    # What the size of a mark does changes with poses and lenses by its square alone: third
    # derivatives of the image would make every fit twice as dear.
    still, middle, arms = jax.lax.stop_gradient((shown, camera, plate))
    off = off_centre_of_disc(lambda p: image_of(p, *still, ports.held()), middle, arms)
    image_point = image_point + 0.25 * ports["target.disc"] * off
    return expose(sight.focal, sight.centre, image_point, ports)


# --- rangefinder --------------------------------------------------------------------------------


class Aim(NamedTuple):
    """The unknowns that one range touches, gathered from the state; poses in either form."""

    station_from_rangefinder: Float[Array, "6"] | Pose
    world_from_station: Float[Array, "6"] | Pose
    world_from_carrier: Float[Array, "6"] | Pose
    carrier_from_target: Float[Array, "6"] | Pose
    point: Float[Array, "3"]

    @property
    def world_from_target(self) -> Pose:
        """Pose of the target."""
        return pose_from_vector(self.world_from_carrier) @ pose_from_vector(
            self.carrier_from_target
        )


def predict_range(
    aim: Aim,
    circumstances: Circumstances,
    to_plane: Float[Array, ""],
    ports: PortValues,
) -> Float[Array, ""]:
    """Predicted distance (m) from a rangefinder to a mark, or along its beam to a target's plane.

    `to_plane` is 1 where the beam (the instrument's +z axis) meets the plane z = 0 of the target,
    rho = n.(t - o) / (n.d), and 0 where the distance to the mark itself is measured.
    """
    at = circumstances
    point = jnp.where(to_plane > 0.5, aim.point.at[2].set(0.0), aim.point)
    target = mark(point, at.target_centre, at.target_half_size, ports)
    carrier, own = map(pose_from_vector, (aim.world_from_carrier, aim.carrier_from_target))
    delay = ports["clock.offset"]
    seen = look(
        pose_from_vector(aim.world_from_station),
        pose_from_vector(aim.station_from_rangefinder),
        place(carrier, own, target, delay, at.velocity, ports),
        ports,
    )
    # A second mark, one metre along the plate's normal, gives the normal through the same chain.
    ahead = look(
        pose_from_vector(aim.world_from_station),
        pose_from_vector(aim.station_from_rangefinder),
        place(carrier, own, target + jnp.array([0.0, 0.0, 1.0]), delay, at.velocity, ports),
        ports,
    )
    normal = ahead - seen
    along_normal = jnp.where(to_plane > 0.5, normal[2], 1.0)
    distance = jnp.where(to_plane > 0.5, (normal @ seen) / along_normal, _safe_norm(seen))
    return distance * (1.0 + ports["range.scale"]) + ports["range.offset"]


def _safe_norm(vector: Float[Array, " n"]) -> Float[Array, ""]:
    square = vector @ vector
    away = square > 0.0
    return jnp.where(away, jnp.sqrt(jnp.where(away, square, 1.0)), 0.0)
