"""Scenes on a bench: a board moved by hand before one camera, of a normal or a wide lens."""

import copy

import numpy as np

from .bodies import Camera, Scene, Station, Target
from .heat import make_weather
from .paths import hand_poses
from .rotation import matrix
from .streams import stream

CHANNELS = ("ambient_degC", "body", "humidity_pct", "pressure_hPa", "irradiance_W_m2")


def grid(rows, columns, spacing):
    """Names "row/column" and coordinates (m) of a grid of marks, row by row."""
    names = [f"{r}/{c}" for r in range(rows) for c in range(columns)]
    points = [[c * spacing, r * spacing, 0.0] for r in range(rows) for c in range(columns)]
    return names, np.array(points)


def board(seed, plan, size):
    """One camera with a normal lens, a board of 7 x 9 marks moved by hand."""
    rng = stream("board", seed, "geometry")
    wide_px, high_px = [(2048, 1536), (2448, 2048), (1920, 1200)][rng.integers(3)]
    focal = 0.5 * wide_px / rng.uniform(0.33, 0.48)
    bare = rng.random() < 0.35
    coefficients = np.zeros(5)
    if not bare:
        coefficients[:2] = rng.uniform(-0.22, -0.06), rng.uniform(0.02, 0.12)
        coefficients[2:4] = rng.normal(0.0, 4e-4, 2)
    camera = Camera(
        name="camera",
        station=0,
        size=(wide_px, high_px),
        focal=np.array([focal, focal]),
        centre=0.5 * np.array([wide_px, high_px]) - 0.5 + rng.normal(0.0, 8.0, 2),
        brown=coefficients,
        wide=None,
        turn=np.eye(3),
        shift=np.zeros(3),
        on_s=-float(rng.choice([40.0, 200.0, 900.0, 5400.0])),
        known={"lens": "pinhole" if bare else "opencv5"},
    )
    spacing = float(rng.choice([0.03, 0.04, 0.06]))
    distance = 8.0 * spacing * np.array([0.9, 2.6]) / (0.5 * wide_px / focal) / 1.2
    return _bench("board", seed, plan, size, rng, camera, (7, 9, spacing), distance, (0.55, 1.0), 1)


def wide(seed, plan, size):
    """One wide-angle camera, a board of 8 x 10 marks at 0.3 to 1 m."""
    rng = stream("wide", seed, "geometry")
    wide_px, high_px = [(2048, 2048), (2448, 2048), (1920, 1536)][rng.integers(3)]
    equal = rng.random() < 0.5
    odd = np.array([rng.uniform(-0.035, 0.0), rng.uniform(-0.006, 0.0), 0.0])
    if not equal:
        odd = np.array([1.0 / 12.0 + rng.uniform(-0.02, 0.0), 1.0 / 120.0, 0.0])
    half = np.radians(rng.uniform(51.0, 56.0))
    radius = half * (1.0 + half**2 * (odd[0] + half**2 * odd[1]))
    focal = 0.5 * np.hypot(wide_px, high_px) / radius
    camera = Camera(
        name="camera",
        station=0,
        size=(wide_px, high_px),
        focal=np.array([focal, focal]),
        centre=0.5 * np.array([wide_px, high_px]) - 0.5 + rng.normal(0.0, 6.0, 2),
        brown=None,
        wide=odd,
        turn=np.eye(3),
        shift=np.zeros(3),
        on_s=-float(rng.choice([40.0, 200.0, 900.0, 5400.0])),
        known={"lens": str(rng.choice(["opencv8", "fisheye"]))},
    )
    spacing = float(rng.choice([0.03, 0.04, 0.05]))
    layout, distances = (8, 10, spacing), (0.3, 0.85)
    return _bench("wide", seed, plan, size, rng, camera, layout, distances, (0.8, 0.8), 0)


def _bench(kind, seed, plan, size, rng, camera, layout, distances, fill_tilt, long):
    count = int(rng.choice([48, 72])) if not long else 72
    step = float(rng.choice([8.0, 15.0, 25.0]))
    sigma = float(np.exp(rng.uniform(np.log(0.03), np.log(0.12))))
    pause = float(rng.uniform(0.7, 1.0))
    if plan == "longer":
        count *= 2
    distances, (fill, tilt) = np.array(distances), fill_tilt
    distances = distances * {"nearer": 0.5, "farther": 2.5}.get(plan, 1.0)
    if plan == "field":
        fill = 1.0
    if plan == "tilt":
        tilt = 1.1
    t = step * (np.arange(count) + pause * stream(kind, seed, "pauses").uniform(-0.3, 0.3, count))
    t -= t[0]
    break_s = None
    if plan == "restart":
        break_s = (t[count // 2] - 0.5 * step, t[count // 2] + 300.0)
        t[count // 2 :] += 320.0
    rows, columns, spacing = layout
    names, points = grid(rows, columns, spacing)
    half = 0.5 * spacing * np.array([columns - 1, rows - 1])
    poses = stream(kind, seed, f"poses {plan}")
    turn, shift = hand_poses(poses, count, camera, half, distances, fill, tilt)
    if plan == "roll":
        extra = matrix(np.linspace(0.0, 0.5 * np.pi, count)[:, None] * np.array([0.0, 0.0, 1.0]))
        centre = shift + np.einsum("eij,j->ei", turn, np.append(half, 0.0))
        turn = extra @ turn
        shift = centre - np.einsum("eij,j->ei", turn, np.append(half, 0.0))
    if plan == "reverse":
        turn, shift = turn[::-1], shift[::-1]
    target = Target("board", names, points, True, True, turn, shift, layout)
    known = camera.known
    guess = 1.0 + rng.uniform(-0.01, 0.01)
    known["focal_px"] = np.round(camera.focal * guess, 1)
    known["centre_px"] = 0.5 * np.array(camera.size) - 0.5
    known["free"] = ["focal", "centre"] + ["distortion"] * (known["lens"] != "pinhole")
    tells = bool(rng.random() < 0.6)
    priors = []
    if known["lens"] == "opencv8":  # its radial coefficients are nearly tied to each other
        priors = [("camera", "distortion", np.zeros(8), np.array([1, 1, 0.1, 0.1, 1, 1, 1, 1.0]))]
    scene = Scene(
        kind=kind,
        seed=seed,
        plan=plan,
        size=size,
        t=t,
        exposure=np.full(count, 0.005),
        cameras=[camera],
        stations=[Station("bench", np.eye(3), np.zeros(3))],
        targets=[target],
        finders=[],
        sees=[(0, 0)],
        up=np.array([0.0, -1.0, 0.0]),
        sigma_px=sigma,
        sigma_m=1e-3,
        tells_power=tells,
        restart_s=None if break_s is None else break_s[1],
        priors=priors,
    )
    weather = stream(kind, seed, "weather")
    scene.weather = make_weather(
        weather, scene.cameras, scene.targets, t[-1], "room", plan, CHANNELS[:3], break_s
    )
    if plan == "camera":
        _set_aside(scene)
    return scene


def _set_aside(scene):
    """A second camera of the same make, 40 degrees to the side, on a tripod of its own.

    It is as warm as the first one. Where it stands is guessed to a few degrees.
    """
    (camera,), (board,) = scene.cameras, scene.targets
    rng = stream(scene.kind, scene.seed, "second camera")
    middle = np.mean(board.shift + board.turn @ board.points.mean(axis=0), axis=0)
    about = matrix(np.radians(40.0 + rng.normal(0.0, 3.0)) * scene.up)
    second = copy.deepcopy(camera)
    second.name, second.station = "second", 1
    second.focal = camera.focal * (1.0 + rng.normal(0.0, 0.003))
    second.centre = 0.5 * np.array(camera.size) - 0.5 + rng.normal(0.0, 8.0, 2)
    if camera.brown is not None:
        second.brown = camera.brown * (1.0 + rng.normal(0.0, 0.05, 5))
    second.turn = about @ matrix(rng.normal(0.0, 0.02, 3)) @ camera.turn
    second.shift = middle + about @ (camera.shift - middle)
    guess = matrix(rng.normal(0.0, 0.03, 3)) @ second.turn
    off = 0.03 * np.linalg.norm(middle - second.shift) * rng.normal(size=3)
    second.known["free"] = [*camera.known["free"], "pose"]
    second.known["pose"] = guess, second.shift + off
    scene.cameras.append(second)
    scene.stations.append(Station("tripod", np.eye(3), np.zeros(3)))
    scene.sees.append((1, 0))
    scene.priors += [("second", *prior[1:]) for prior in scene.priors if prior[0] == camera.name]
    weather = scene.weather
    for name in ("nodes", "on", "since"):
        setattr(weather, name, np.repeat(getattr(weather, name), 2, axis=0))
