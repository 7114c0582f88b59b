"""One pass of the light from the marks to the pixels, and what hidden physics does on its way.

A hidden effect gives functions for steps of the way ("hooks", by the names in `STEPS`). Each takes
the `View` (everything known about the rows so far) and the value at that step, and returns it
changed. Without hooks the world is exactly what the engineer believes, to the lens's approximation.
"""

from dataclasses import dataclass, field

import numpy as np

from . import lens
from .rotation import apply, back, matrix

STEPS = (
    "clock",  # true time of the exposure's middle (s) [n]
    "shape",  # place of the mark on the target (m) [n, 3]
    "target",  # (turn rad, shift m) of the target, world axes about its origin, each [n, 3]
    "station",  # (turn, shift) of the station, its own axes
    "camera",  # (turn, shift) of the camera, its own axes
    "air",  # mark in camera axes (m), as it appears through the air
    "glass",  # the same through windows
    "pupil",  # (way of the entrance pupil along the axis) (m) [n]
    "lens",  # image point in units of the principal distance [n, 2]
    "sensor",  # pixel (px) [n, 2]
    "detect",  # pixel (px) [n, 2]
    "beam",  # (origin, direction) of a rangefinder in station axes
    "range",  # distance (m)
)


@dataclass
class Rows:
    """Which mark is seen when by which camera; places in the scene's lists."""

    epoch: np.ndarray
    camera: np.ndarray
    target: np.ndarray
    point: np.ndarray

    def __len__(self):
        return len(self.epoch)

    def where(self, mask):
        return Rows(self.epoch[mask], self.camera[mask], self.target[mask], self.point[mask])


@dataclass
class View:
    """All that an effect may look at: the rows and what is known of the light's way so far."""

    scene: object
    rows: Rows
    t: np.ndarray
    plain: object = None
    mark: np.ndarray | None = None
    world: np.ndarray | None = None
    turn: np.ndarray | None = None
    seen: np.ndarray | None = None
    ray: np.ndarray | None = None
    pixel: np.ndarray | None = None
    part: dict = field(default_factory=dict)

    def node(self, name):
        """Temperature (degC) of a node of each row's camera at its time; also "since" (s)."""
        return self._gather(name, self.rows.camera, len(self.scene.cameras))

    def body(self):
        """Temperature (degC) of each row's target."""
        return self._gather("target", self.rows.target, len(self.scene.targets))

    def air(self, name):
        weather = self.scene.weather
        return np.interp(self.t, weather.time, weather.air[name])

    def course(self, function, owner, count):
        """A course made on the weather's grid for each owner, read at each row's time."""
        weather = self.scene.weather
        out = np.zeros(len(self.t))
        for k in np.unique(owner):
            mine = owner == k
            out[mine] = np.interp(self.t[mine], weather.time, function(weather, int(k)))
        return out

    def _gather(self, name, owner, count):
        return self.course(lambda weather, k: weather.series(name, k), owner, count)

    def station(self):
        """Station of each row's camera."""
        return np.array([camera.station for camera in self.scene.cameras])[self.rows.camera]


def run(hooks, step, view, value):
    """Send a value through all hooks of a step."""
    for hook in hooks:
        if step in hook:
            value = hook[step](view, value)
    return value


def pixels(scene, rows, hooks=(), plain=None, lag=None):
    """Pixels [n, 2] of the rows; `plain` is the View of the world without hidden physics."""
    if plain is not None and not any(hook for hook in hooks):
        return plain.pixel
    view = look(scene, rows, hooks, plain)
    if any("clock" in hook for hook in hooks):  # rows are exposed where the mark really is
        view = look(scene, rows, hooks, view_at(plain, view.pixel))
    return view.pixel


def view_at(plain, pixel):
    """The plain view with other pixels, for a second pass of the clocks."""
    other = View(**{name: getattr(plain, name) for name in plain.__dataclass_fields__})
    other.pixel = pixel
    return other


def look(scene, rows, hooks=(), plain=None):
    """The whole way of the light for all rows."""
    view = View(scene, rows, scene.t[rows.epoch].copy(), plain)
    moment = run(hooks, "clock", view, view.t)
    nothing = np.zeros((len(rows), 3))
    turn, shift = target_pose(scene, rows, moment)
    view.turn = turn
    view.mark = marks(scene, rows)
    mark = run(hooks, "shape", view, view.mark)
    bent, moved = run(hooks, "target", view, (nothing, nothing))
    arm = apply(turn, mark)
    if bent is not nothing:
        arm = apply(matrix(bent), arm)
    view.world = arm + shift + moved
    view.seen = to_camera(scene, rows, view, hooks, view.world)
    apparent = run(hooks, "air", view, view.seen)
    apparent = run(hooks, "glass", view, apparent)
    pupil = run(hooks, "pupil", view, None)
    if pupil is not None:
        apparent = apparent - np.stack([0 * pupil, 0 * pupil, pupil], axis=1)
    view.ray = apparent
    image = np.empty((len(rows), 2))
    for k, camera in enumerate(scene.cameras):
        mine = rows.camera == k
        image[mine] = lens.image(camera, apparent[mine])
    image = run(hooks, "lens", view, image)
    focal = np.array([camera.focal for camera in scene.cameras])[rows.camera]
    centre = np.array([camera.centre for camera in scene.cameras])[rows.camera]
    view.pixel = image * focal + centre
    view.pixel = run(hooks, "sensor", view, view.pixel)
    view.pixel = run(hooks, "detect", view, view.pixel)
    return view


def marks(scene, rows):
    """Places of the rows' marks on their targets (m), as they were measured."""
    out = np.empty((len(rows), 3))
    for k, target in enumerate(scene.targets):
        mine = rows.target == k
        out[mine] = target.points[rows.point[mine]]
    return out


def target_pose(scene, rows, moment):
    """Axes [n, 3, 3] and origin [n, 3] of each row's target at its moment."""
    turn, shift = np.empty((len(rows), 3, 3)), np.empty((len(rows), 3))
    for k, target in enumerate(scene.targets):
        mine = rows.target == k
        if scene.path is not None and target.moving:
            turn[mine], shift[mine] = scene.path.pose(moment[mine])
        else:
            turn[mine] = target.turn[rows.epoch[mine]]
            shift[mine] = target.shift[rows.epoch[mine]]
    return turn, shift


def to_camera(scene, rows, view, hooks, world):
    """World points in the axes of each row's camera."""
    nothing = np.zeros((len(rows), 3))
    station = view.station()
    axes = np.array([s.turn for s in scene.stations])[station]
    origin = np.array([s.shift for s in scene.stations])[station]
    local = back(axes, world - origin)
    turn, shift = run(hooks, "station", view, (nothing, nothing))
    if turn is not nothing or shift is not nothing:
        local = back(matrix(turn), local - shift)
    axes = np.array([c.turn for c in scene.cameras])[rows.camera]
    origin = np.array([c.shift for c in scene.cameras])[rows.camera]
    seen = back(axes, local - origin)
    turn, shift = run(hooks, "camera", view, (nothing, nothing))
    if turn is not nothing or shift is not nothing:
        seen = back(matrix(turn), seen - shift)
    return seen


def all_rows(scene, margin=6.0):
    """Every mark that falls into an image."""
    epochs = len(scene.t)
    parts = []
    for camera, target in scene.sees:
        n = len(scene.targets[target].points)
        parts.append(
            Rows(
                np.repeat(np.arange(epochs), n),
                np.full(epochs * n, camera),
                np.full(epochs * n, target),
                np.tile(np.arange(n), epochs),
            )
        )
    rows = Rows(*(np.concatenate([getattr(p, k) for p in parts]) for k in vars(parts[0])))
    order = np.lexsort((rows.point, rows.target, rows.camera, rows.epoch))
    rows = rows.where(order)
    view = look(scene, rows)
    size = np.array([camera.size for camera in scene.cameras])[rows.camera]
    inside = ((view.pixel > margin) & (view.pixel < size - 1 - margin)).all(axis=1)
    seen = inside & (view.seen[:, 2] > 0.02)
    return rows.where(seen & _from_the_front(scene, rows, view))


def _from_the_front(scene, rows, view):
    """Whether a mark is seen from the side of its target that the first camera sees.

    The scenes turn their targets to the cameras that they have; a second one stands anywhere.
    """
    if scene.plan != "camera":
        return np.ones(len(rows), bool)
    normal = view.turn[:, :, 2]
    cosine = []
    for camera in scene.cameras:
        way = view.world - camera.shift
        cosine.append(np.sum(normal * way, axis=1) / np.linalg.norm(way, axis=1))
    own = np.choose(rows.camera, cosine)
    return own * np.sign(cosine[0]) > np.cos(np.radians(80.0))


@dataclass
class Shots:
    """Rows of the rangefinders: epoch, rangefinder, mark (-1: the plane of the target)."""

    epoch: np.ndarray
    finder: np.ndarray
    point: np.ndarray


def all_shots(scene):
    """One distance for each epoch and rangefinder, or one for each of its marks."""
    rows = []
    for f, finder in enumerate(scene.finders):
        for e in range(len(scene.t)):
            rows += [(e, f, p) for p in (finder.marks or [-1])]
    table = np.array(sorted(rows), int).reshape(-1, 3)
    return Shots(table[:, 0], table[:, 1], table[:, 2])


def distances(scene, shots, hooks=()):
    """Distances (m) of the shots; to a mark its own, else along the beam to the plane z = 0."""
    n = len(shots.epoch)
    if n == 0:
        return np.zeros(0)
    target = np.array([f.target for f in scene.finders])[shots.finder]
    point = np.maximum(shots.point, 0)
    rows = Rows(shots.epoch, np.zeros(n, int), target, point)
    view = View(scene, rows, scene.t[shots.epoch].copy())
    view.part = {"shots": shots}
    moment = run([h for h in hooks if "shot clock" in h], "shot clock", view, view.t)
    turn, shift = target_pose(scene, rows, moment)
    view.turn, view.mark = turn, marks(scene, rows)
    mark = run(hooks, "shape", view, view.mark)
    base = run(hooks, "shape", view, view.mark * [1, 1, 0]) - view.mark * [1, 1, 0]
    nothing = np.zeros((n, 3))
    bent, moved = run(hooks, "target", view, (nothing, nothing))
    if bent is not nothing:
        turn = matrix(bent) @ turn
    spot = apply(turn, mark) + shift + moved
    station = np.array([f.station for f in scene.finders])[shots.finder]
    axes = np.array([s.turn for s in scene.stations])[station]
    origin = np.array([s.shift for s in scene.stations])[station]
    place = np.array([f.shift for f in scene.finders])[shots.finder]
    aim = np.array([f.turn for f in scene.finders])[shots.finder][:, :, 2]
    place, aim = run(hooks, "beam", view, (place, aim))
    start, aim = apply(axes, place) + origin, apply(axes, aim)
    normal = turn[:, :, 2]
    facing = np.sum(normal * aim, axis=1)
    plane_point = shift + moved
    along = np.sum(normal * (plane_point - start), axis=1) / facing
    view.part |= {"slant": np.arccos(np.clip(np.abs(facing), 0, 1)), "lift": base}
    to_mark = np.linalg.norm(spot - start, axis=1)
    out = np.where(shots.point >= 0, to_mark, along)
    return run(hooks, "range", view, out)
