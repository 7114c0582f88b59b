"""Scenes in the field: a station with two cameras, fast stereo, a chain of three stations."""

import numpy as np

from .bodies import Camera, Finder, Scene, Station, Target
from .heat import make_weather
from .near import grid
from .paths import fast_path, wander
from .rotation import looking, matrix
from .streams import stream

CHANNELS = (
    "ambient_degC",
    "body",
    "humidity_pct",
    "pressure_hPa",
    "irradiance_W_m2",
    "wind_m_s",
    "gradient_K_per_m",
)


_POWER_ON = (-40.0, -300.0, -1800.0, -7200.0)


def _camera(rng, name, station, turn, shift, half=(0.3, 0.42), on=_POWER_ON):
    """A held, calibrated camera with a normal lens of the given range of half-field tangents."""
    size = [(2448, 2048), (2048, 2048), (4096, 3000)][rng.integers(3)]
    focal = 0.5 * size[0] / rng.uniform(*half)
    bare = rng.random() < 0.3
    brown = np.zeros(5)
    if not bare:
        brown[:2] = rng.uniform(-0.2, -0.05), rng.uniform(0.02, 0.15)
        brown[2:4] = rng.normal(0.0, 3e-4, 2)
    return Camera(
        name=name,
        station=station,
        size=size,
        focal=np.array([focal, focal]),
        centre=0.5 * np.array(size) - 0.5 + rng.normal(0.0, 8.0, 2),
        brown=brown,
        wide=None,
        turn=turn,
        shift=np.asarray(shift, float),
        on_s=float(rng.choice(on)),
        known={"lens": "pinhole" if bare else "opencv5", "held": True},
    )


def _marks(rng, count, half, relief):
    """Names and places (m) of marks on a plate of a half size, some standing off the plate."""
    columns = int(np.ceil(np.sqrt(count)))
    rows = int(np.ceil(count / columns))
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)[:count] * half
    points[:, :2] += rng.uniform(-0.08, 0.08, (count, 2)) * half
    points[:, 2] = np.where(rng.random(count) < 0.5, rng.uniform(-1, 0, count), 0.0) * relief
    return [f"m{k:02d}" for k in range(count)], np.round(points, 5)


def _still(turn, shift, count):
    return np.repeat(turn[None], count, axis=0), np.repeat(np.asarray(shift)[None], count, axis=0)


def _facing(rng, lean):
    """Axes of a target that faces a camera, leaned by up to an angle (rad)."""
    return matrix(np.append(rng.uniform(-lean, lean, 2), rng.uniform(-0.3, 0.3)))


def _times(count, length, plan):
    """Times (s), and the power break of a restart."""
    if plan == "longer":
        count, length = 2 * count, 2.0 * length
    t = np.linspace(0.0, length, count)
    if plan != "restart":
        return t, None
    pause = 1200.0 if length > 3000.0 else 400.0
    middle = 0.5 * (t[count // 2 - 1] + t[count // 2])
    t[count // 2 :] += pause
    return t, (middle, t[count // 2] - 20.0)


def _move(rng, turn, shift, reach, lean, count, plan):
    """Slow motion about a pose: reach (m, xyz) and lean (rad, xyz); the plans that concern it."""
    course = wander(rng, count, np.append(reach, lean))
    if plan == "reverse":
        course = course[::-1][np.minimum(2 * np.arange(count), count - 1)]
    turns, shifts = turn @ matrix(course[:, 3:]), shift + course[:, :3]
    if plan == "roll":
        roll = np.linspace(0.0, 0.5 * np.pi, count)[:, None] * np.array([0.0, 0.0, 1.0])
        turns = matrix(roll) @ turns
    if plan == "tilt":
        side = np.where(np.arange(count) % 2, 0.7, -0.7)[:, None]
        turns = matrix(side * np.array([0.0, 1.0, 0.0])) @ turns
    return turns, shifts


def _sweep(shifts, distance, half, count):
    """Positions that go round the whole field of half tangent `half` at a distance."""
    angle = np.linspace(0.0, 4.0 * np.pi, count)
    grow = np.linspace(0.3, 0.85, count)
    out = shifts.copy()
    out[:, 0] = half * distance * grow * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.5
    out[:, 1] = half * distance * grow * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.5
    return out


def station(seed, plan, size):
    """A station with two cameras, two references at different ranges and a moving target."""
    rng = stream("station", seed, "geometry")
    base = rng.uniform(0.4, 1.2)
    aim = np.array([0.0, 0.0, rng.uniform(10.0, 16.0)])
    right_at = np.array([base, rng.normal(0.0, 0.02), rng.normal(0.0, 0.02)])
    cameras = [
        _camera(rng, "left", 0, np.eye(3), np.zeros(3)),
        _camera(rng, "right", 0, looking(aim - right_at), right_at),
    ]
    prior = rng.random() < 0.5
    length = 3600.0 * float(rng.choice([6.0, 8.0, 10.0]))
    count, marks = [(72, 12), (72, 16), (96, 12)][rng.integers(3)]
    if size == "large":
        count, marks = 144, 24
    sigma = float(np.exp(rng.uniform(np.log(0.02), np.log(0.08))))
    t, break_s = _times(count, length, plan)
    count = len(t)
    tangent = min(0.5 * c.size[1] / c.focal[1] for c in cameras)
    near_z, far_z, moving_z = rng.uniform(4.0, 8.0), rng.uniform(15.0, 30.0), rng.uniform(7.0, 14.0)
    held = rng.random(2) < 0.5
    targets = []
    for k, (name, z, side) in enumerate((("near", near_z, -1.0), ("far", far_z, 1.0))):
        half = rng.uniform(0.25, 0.36) * tangent * z
        names, points = _marks(rng, marks, half, rng.choice([0.0, 0.3, 0.5]) * half)
        aside = 0.4 * base + side * 0.45 * tangent * z
        at = np.array([aside, rng.uniform(-0.4, 0.4) * tangent * z, z])
        turn, shift = _still(_facing(rng, 0.5), at, count)
        targets.append(Target(name, names, points, False, not held[k], turn, shift))
    half = rng.uniform(0.25, 0.36) * tangent * moving_z
    names, points = _marks(rng, marks, half, rng.choice([0.0, 0.0, 0.3, 0.5]) * half)
    turn, at = _facing(rng, 0.5), np.array([0.3 * base, 0.0, moving_z])
    reach = np.array([0.25, 0.2, 0.8]) * tangent * moving_z * rng.uniform(0.5, 1.0)
    lean = rng.uniform(0.05, 0.2, 3)
    with_finder, to_marks = rng.random() < 0.6, rng.random() < 0.4
    to_marks = to_marks or np.ptp(points[:, 2]) > 0.0
    at[2] *= {"nearer": 0.5, "farther": 2.5}.get(plan, 1.0)
    turns, shifts = _move(stream("station", seed, "motion"), turn, at, reach, lean, count, plan)
    if plan == "field":
        shifts = _sweep(shifts, at[2], tangent, count)
    targets.append(Target("object", names, points, True, True, turns, shifts))
    place = np.array([0.5 * base, -0.1, 0.05])
    axes = looking(np.array([0.3 * base, 0.0, moving_z]) - place)
    used = sorted(int(k) for k in rng.choice(marks, 3, replace=False)) if to_marks else []
    finders = [Finder("ranger", 0, axes, place, 2, used)]
    priors = []
    for camera in cameras:
        if prior:
            given = camera.focal * (1.0 + rng.normal(0.0, 1e-4))
            camera.known |= {"focal_px": given, "free": ["aspect-locked-focal"]}
            priors.append((camera.name, "focal", given, 1e-4 * camera.focal))
    scene = _field_scene(
        "station", seed, plan, size, t, cameras, [Station("mast", np.eye(3), np.zeros(3))], targets,
        finders, [(c, g) for c in range(2) for g in range(3)], sigma, rng, priors, break_s,
    )  # fmt: skip
    scene.with_finder = bool(with_finder)
    return scene


def stereo(seed, plan, size):
    """Two cameras and one target in fast motion, with its velocity known."""
    rng = stream("stereo", seed, "geometry")
    base, z = rng.uniform(0.5, 1.6), rng.uniform(2.5, 6.0)
    right_at = np.array([base, rng.normal(0.0, 0.02), rng.normal(0.0, 0.03)])
    aim = np.array([0.5 * base, 0.0, z])
    on = (-40.0, -300.0, -1800.0)
    cameras = [
        _camera(rng, "left", 0, looking(aim), np.zeros(3), (0.32, 0.45), on),
        _camera(rng, "right", 0, looking(aim - right_at), right_at, (0.32, 0.45), on),
    ]
    count, marks = [(96, 24), (96, 30), (120, 24), (120, 30)][rng.integers(4)]
    gap = float(rng.choice([1.0, 2.0, 3.0]))
    sigma = float(np.exp(rng.uniform(np.log(0.03), np.log(0.1))))
    t, break_s = _times(count, gap * (count - 1), plan)
    t = t + gap * 0.1 * stream("stereo", seed, "jitter").uniform(-1, 1, len(t))
    t = t - t[0]
    tangent = min(0.5 * c.size[1] / c.focal[1] for c in cameras)
    half = rng.uniform(0.28, 0.42) * tangent * z
    names, points = _marks(rng, marks, half, rng.choice([0.0, 0.3, 0.5]) * half)
    reach = np.array([0.75, 0.7, 0.9]) * tangent * z
    speed = rng.uniform(0.3, 1.5)
    lean = rng.uniform(0.2, 0.5, 3)
    path = fast_path(rng, aim, reach, speed, rng.uniform(-0.2, 0.2, 3), lean)
    place = np.array([0.5 * base, -0.08, 0.0])
    finder = Finder("ranger", 0, looking(aim - place), place, 0, [])
    with_finder = rng.random() < 0.5
    used = sorted(int(k) for k in rng.choice(marks, 3, replace=False))
    finder.marks = used if rng.random() < 0.5 or np.ptp(points[:, 2]) > 0.0 else []
    if plan in ("nearer", "farther"):
        factor = {"nearer": 0.5, "farther": 2.5}[plan]
        path.middle = path.middle * factor
        path.reach = path.reach * factor
    if plan == "reverse":
        path.pace = -2.0
    if plan == "roll":
        path.turn_reach[2] = 0.0
        path.turn_middle[2] += 0.5 * np.pi
    if plan == "tilt":
        path.lean, path.over_s = 0.7, 0.5 * (t[len(t) // 2 - 1] + t[len(t) // 2])
    if plan == "field":
        path.reach[:2] *= 1.4
    turns, shifts = path.pose(t)
    scene = _field_scene(
        "stereo", seed, plan, size, t, cameras, [Station("rig", np.eye(3), np.zeros(3))],
        [Target("body", names, points, True, True, turns, shifts)],
        [finder], [(0, 0), (1, 0)], sigma, rng, [], break_s,
    )  # fmt: skip
    scene.path, scene.with_finder = path, bool(with_finder)
    change = np.exp(0.5 * wander(stream("stereo", seed, "exposure"), len(t), [1.0])[:, 0])
    scene.exposure = np.clip(rng.uniform(0.002, 0.006) * change, 0.0005, 0.02)
    return scene


def relay(seed, plan, size):
    """Three stations in a row that hand a known reference on to a far, moving target."""
    rng = stream("relay", seed, "geometry")
    leg = rng.uniform(5.0, 12.0)
    count, marks = [(48, 16), (72, 12), (72, 16)][rng.integers(3)]
    length = 3600.0 * float(rng.choice([3.0, 5.0, 8.0]))
    sigma = float(np.exp(rng.uniform(np.log(0.02), np.log(0.08))))
    t, break_s = _times(count, length, plan)
    count = len(t)
    along = np.cumsum([leg] + list(leg * rng.uniform(0.8, 1.2, 6)))
    along -= along[1]
    off = rng.uniform(-0.04, 0.04, (7, 2)) * leg
    spots = np.column_stack([off, along])
    spots[1] = 0.0
    stations, cameras, sees = [], [], []
    for k in range(3):
        here = spots[2 * k + 1]
        axes = np.eye(3) if k == 0 else matrix(rng.normal(0.0, 0.05, 3))
        stations.append(Station("ABC"[k], axes, here, True))
        for name, other, dz in (("back", spots[2 * k], -0.1), ("fore", spots[2 * k + 2], 0.1)):
            at = np.array([rng.normal(0.0, 0.05), rng.normal(0.0, 0.05), dz])
            way = axes.T @ (other - here) - at
            turn = looking(way) @ matrix(rng.normal(0.0, 0.02, 3))
            cameras.append(_camera(rng, f"{'ABC'[k]}_{name}", k, turn, at, (0.10, 0.16)))
    sees = [(0, 0), (1, 1), (2, 1), (3, 2), (4, 2), (5, 3)]
    targets = []
    for k, name in enumerate(("origin", "plate1", "plate2", "object")):
        near = leg * 0.8
        half = rng.uniform(0.5, 0.65) * 0.10 * near
        names, points = _marks(rng, marks, half, rng.uniform(0.5, 1.0) * half)
        turn = _facing(rng, 0.45)
        if k < 3:
            poses = _still(turn, spots[2 * k], count)
        else:
            at = spots[6].copy()
            stretch = {"nearer": 0.5, "farther": 2.5}.get(plan, 1.0)
            at = spots[5] + stretch * (at - spots[5])
            reach = np.array([0.2, 0.2, 0.5]) * 0.10 * near
            move = stream("relay", seed, "motion")
            poses = _move(move, turn, at, reach, rng.uniform(0.03, 0.1, 3), count, plan)
            if plan == "field":
                poses = poses[0], _sweep_from(poses[1], at, 0.09 * near, count)
        targets.append(Target(name, names, points, k == 3, k > 0, *poses))
    return _field_scene(
        "relay", seed, plan, size, t, cameras, stations, targets, [], sees, sigma, rng, [], break_s
    )


def _sweep_from(shifts, at, reach, count):
    return at + _sweep(shifts - at, reach, 1.0, count) * [1, 1, 0] + (shifts - at) * [0, 0, 1]


def _field_scene(
    kind, seed, plan, size, t, cameras, stations, targets, finders, sees, sigma, rng, priors, off
):
    style = "day" if rng.random() < 0.65 else "hall"
    scene = Scene(
        kind=kind,
        seed=seed,
        plan=plan,
        size=size,
        t=t,
        exposure=np.full(len(t), 0.005),
        cameras=cameras,
        stations=stations,
        targets=targets,
        finders=finders,
        sees=sees,
        up=np.array([0.0, -1.0, 0.0]),
        sigma_px=sigma,
        sigma_m=float(rng.choice([2e-4, 5e-4, 1e-3])),
        priors=priors,
        tells_power=bool(rng.random() < 0.6),
        restart_s=None if off is None else off[1],
    )
    weather = stream(kind, seed, "weather")
    style = "room" if kind == "stereo" and rng.random() < 0.5 else style
    scene.weather = make_weather(weather, cameras, targets, t[-1], style, plan, CHANNELS, off)
    return scene


BUILDERS = {"station": station, "stereo": stereo, "relay": relay}

__all__ = ["BUILDERS", "grid"]
