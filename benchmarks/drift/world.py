"""A world of cameras that drift with temperature, which knows nothing of the models under test.

A camera is a thermal network (heat capacities in J/K, conductances in W/K, its own power, sun and
wind), stepped by the implicit midpoint rule. Each of its parameters is linear in the temperatures
of the nodes; images of a plate are projected by OpenCV. Everything is in SI units and pixels.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

STEP = 10.0
"""Step of the thermal network (s)."""

PARAMETERS = ("focal", "cx", "cy", "turn_x", "turn_y", "turn_z", "k1")
"""Focal length as a ratio, principal point in px, turns in rad."""

FAMILIES = ("one node", "two nodes", "four nodes")


@dataclass(frozen=True)
class Thermal:
    """A thermal network: C dT/dt = G T + loss (1 + blow wind) (air - T) + power on + lit sun."""

    capacity: np.ndarray
    conduct: np.ndarray
    loss: np.ndarray
    power: np.ndarray
    lit: np.ndarray
    blow: float

    def temperatures(self, air: "Air", on: np.ndarray) -> np.ndarray:
        """Node temperatures [nodes, times] (degC), settled without power at the start."""
        n, eye = len(self.capacity), np.eye(len(self.capacity))
        blown = 1.0 + self.blow * air.wind
        first = np.diag(self.loss * blown[0]) - self.conduct
        state = np.linalg.solve(
            first, self.loss * blown[0] * air.ambient[0] + self.lit * air.sun[0]
        )
        out = np.empty((n, len(air.time)))
        out[:, 0] = state
        for k in range(1, len(air.time)):
            cool = self.loss * 0.5 * (blown[k] + blown[k - 1])
            rate = (self.conduct - np.diag(cool)) / self.capacity[:, None]
            ambient = 0.5 * (air.ambient[k] + air.ambient[k - 1])
            sun = 0.5 * (air.sun[k] + air.sun[k - 1])
            gain = (cool * ambient + self.power * on[k] + self.lit * sun) / self.capacity
            left = eye - 0.5 * STEP * rate
            state = np.linalg.solve(left, state + STEP * (0.5 * rate @ state + gain))
            out[:, k] = state
        return out

    def time_constants(self) -> np.ndarray:
        """Time constants (s) without wind, the longest first."""
        rate = (self.conduct - np.diag(self.loss)) / self.capacity[:, None]
        return np.sort(-1.0 / np.linalg.eigvals(rate).real)[::-1]


@dataclass(frozen=True)
class Air:
    """Weather on a regular grid (s): air (degC), sun (W/m^2), wind (m/s)."""

    time: np.ndarray
    ambient: np.ndarray
    sun: np.ndarray
    wind: np.ndarray


@dataclass(frozen=True)
class World:
    """A camera, its plate, its thermal network and what drifts with which node.

    Attributes:
        drift: change of each parameter per kelvin of each node [parameters, nodes].
        at: temperature of every node at which the camera was calibrated (degC).
        logged: names of the logged channels.
    """

    seed: int
    family: str
    size: tuple[int, int]
    focal: float
    centre: np.ndarray
    distortion: np.ndarray
    plate: np.ndarray
    grid: tuple[int, int, float]
    turn: np.ndarray
    shift: np.ndarray
    thermal: Thermal
    drift: np.ndarray
    at: float
    sigma: float
    logged: tuple[str, ...]


@dataclass(frozen=True)
class Made:
    """A recording of a world.

    Attributes:
        style: of the weather.
        time: of the epochs (s).
        pixel, still: noise-free pixels [epochs, marks, 2], and those of the camera as calibrated.
        measured: with noise.
        change: of the parameters [epochs, parameters].
        nodes: temperatures at the epochs [nodes, epochs].
        logs: logged channels at `log_time`.
    """

    world: World
    style: str
    time: np.ndarray
    pixel: np.ndarray
    still: np.ndarray
    measured: np.ndarray
    change: np.ndarray
    nodes: np.ndarray
    log_time: np.ndarray
    logs: dict[str, np.ndarray]
    on_s: float

    def write(self, folder: Path, held_pose: bool = False) -> None:
        """The recording as a folder, in the form that jaxvm reads."""
        w, folder = self.world, Path(folder)
        folder.mkdir(parents=True)
        rows, columns, spacing = w.grid
        pose = f"pose = {{turn_rad = {_list(w.turn)}, shift_m = {_list(w.shift)}}}"
        lines = ["format = 1", "[noise]", f"pixel_px = {w.sigma:.6g}"]
        lines += ["[stations.pillar]", 'motion = "static"', "free = []"]
        lines += ["pose = {turn_rad = [0.0, 0.0, 0.0], shift_m = [0.0, 0.0, 0.0]}"]
        lines += ["[cameras.camera]", 'station = "pillar"', 'lens = "opencv5"']
        lines += [f"image_size = [{w.size[0]}, {w.size[1]}]", f"powered_on_s = {self.on_s:.1f}"]
        lines += [f"focal_px = {_list([w.focal, w.focal])}", f"centre_px = {_list(w.centre)}"]
        lines += [f"distortion = {_list(w.distortion)}", "free = []"]
        lines += ["pose = {turn_rad = [0.0, 0.0, 0.0], shift_m = [0.0, 0.0, 0.0]}"]
        lines += ["[targets.plate]", 'motion = "static"']
        lines += [f"grid = {{rows = {rows}, columns = {columns}, spacing_m = {spacing!r}}}"]
        lines += [pose, "free = []"] if held_pose else ['free = ["pose"]']
        (folder / "recording.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        with (folder / "epochs.csv").open("w") as file:
            file.write("epoch,t\n")
            file.writelines(f"{k},{t:.3f}\n" for k, t in enumerate(self.time))
        with (folder / "observations.csv").open("w") as file:
            file.write("epoch,camera,target,point,u,v\n")
            for k, image in enumerate(self.measured):
                for mark, (u, v) in enumerate(image):
                    name = f"{mark // columns}/{mark % columns}"
                    file.write(f"{k},camera,plate,{name},{u:.5f},{v:.5f}\n")
        with (folder / "drivers.csv").open("w") as file:
            file.write(",".join(["t", *self.logs]) + "\n")
            for row in zip(self.log_time, *self.logs.values(), strict=True):
                file.write(",".join(f"{x:.4f}" for x in row) + "\n")


def _list(values) -> str:
    return "[" + ", ".join(f"{float(x)!r}" for x in values) + "]"


def draw_world(seed: int, family: str) -> World:
    """A random camera, plate and thermal network of a family."""
    rng = np.random.default_rng([seed, 11])
    size = [(2448, 2048), (4096, 3000), (1936, 1216)][rng.integers(3)]
    focal = float(size[0] * rng.uniform(1.2, 3.0))
    centre = (np.array(size) - 1.0) / 2.0 + rng.uniform(-15.0, 15.0, 2)
    distortion = np.array([rng.uniform(-0.12, 0.02), rng.uniform(-0.02, 0.05), 0.0, 0.0, 0.0])
    rows, columns, spacing = 5, 7, 0.1
    distance = columns * spacing * focal / (rng.uniform(0.55, 0.8) * size[0])
    distance *= max(1.0, (rows * size[0]) / (columns * size[1]))
    axis = rng.normal(size=2)
    lean = rng.uniform(0.3, 0.6) * axis / np.linalg.norm(axis)
    turn = np.array([*lean, rng.uniform(-0.1, 0.1)])
    y, x = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    plate = np.stack([x.ravel() * spacing, y.ravel() * spacing, 0 * x.ravel()], axis=1)
    middle = cv2.Rodrigues(turn)[0] @ plate.mean(axis=0)
    shift = np.array([*rng.uniform(-0.03, 0.03, 2) * distance, distance]) - middle
    thermal = _network(rng, family)
    nodes = len(thermal.capacity)
    per_kelvin = np.array([30e-6, 0.02, 0.02, 8e-6, 8e-6, 4e-6, 2e-5])
    drift = per_kelvin[:, None] * rng.normal(size=(7, nodes)) * rng.uniform(0.5, 2.0)
    drift[0] = np.abs(drift[0])
    logged = {
        "one node": [("ambient_degC",), ("ambient_degC", "body_camera_degC")],
        "two nodes": [("ambient_degC",), ("ambient_degC", "body_camera_degC")],
        "four nodes": [
            ("ambient_degC", "body_camera_degC"),
            ("ambient_degC", "body_camera_degC", "irradiance_W_m2"),
        ],
    }[family]
    return World(
        seed, family, size, focal, centre, distortion, plate, (rows, columns, spacing), turn, shift,
        thermal, drift, 20.0, float(rng.uniform(0.02, 0.05)), logged[rng.integers(len(logged))],
    )  # fmt: skip


def _network(rng, family: str) -> Thermal:
    def about(values):
        values = np.asarray(values, float)
        return values * np.exp(rng.uniform(-0.35, 0.35, values.shape))

    def conduct(n, links):
        table = np.zeros((n, n))
        for i, j, g in links:
            table[[i, j], [j, i]] += g
            table[[i, j], [i, j]] -= g
        return table

    if family == "one node":
        return Thermal(about([200.0]), np.zeros((1, 1)), about([0.15]), about([3.0]),
                       np.zeros(1), 0.0)  # fmt: skip
    if family == "two nodes":
        # Sensor board and housing (Zhou S. et al. 2020).
        g = float(about(0.10))
        return Thermal(about([60.0, 250.0]), conduct(2, [(0, 1, g)]), np.array([0.0, about(0.15)]),
                       np.array([about(3.0), 0.0]), np.zeros(2), 0.0)  # fmt: skip
    links = [(0, 1, float(about(0.25))), (1, 2, float(about(0.12))), (1, 3, float(about(0.15)))]
    loss = np.array([0.0, about(0.10), about(0.05), about(0.25)])
    lit = float(about(0.006)) * np.array([0.0, 1.0, 0.2, 0.1])
    return Thermal(about([15.0, 90.0, 70.0, 300.0]), conduct(4, links), loss,
                   np.array([about(3.0), 0.0, 0.0, 0.0]), lit, 0.12)  # fmt: skip


def weather(rng, style: str, length: float, start: float, low: float, high: float) -> Air:
    """Air of a style: "chamber" (steps and ramps), "room" (air conditioning), "outdoors" (days)."""
    time = np.arange(start, length + 2.0 * STEP, STEP)
    n, middle, half = len(time), 0.5 * (low + high), 0.5 * (high - low)
    sun, wind = np.zeros(n), np.zeros(n)
    if style == "chamber":
        knots, levels = [start], [rng.uniform(low, high)]
        while knots[-1] < length:
            ramp, stay = rng.uniform(300.0, 3600.0), rng.uniform(1800.0, 7200.0)
            level = rng.uniform(low, high)
            knots += [knots[-1] + ramp, knots[-1] + ramp + stay]
            levels += [level, level]
        ambient = np.interp(time, knots, levels)
    elif style == "room":
        period = rng.uniform(1200.0, 5400.0)
        ambient = middle + 0.35 * half * np.sin(2 * np.pi * time / period + rng.uniform(0, 6.28))
        ambient += 0.6 * half * np.sin(2 * np.pi * time / 86400.0 + rng.uniform(0, 6.28))
        ambient += 0.05 * half * _noise(rng, n, 60.0)
    else:
        hours = rng.uniform(0.0, 24.0) + time / 3600.0
        ambient = middle + 0.8 * half * np.sin(2 * np.pi * (hours - 9.0) / 24.0)
        ambient += 0.2 * half * _noise(rng, n, 240.0)
        cloud = 1.0 / (1.0 + np.exp(-2.0 * (_noise(rng, n, 60.0) + rng.uniform(0.0, 1.5))))
        high_sun = np.clip(np.sin(np.pi * (hours % 24.0 - 5.5) / 14.0), 0.0, None)
        sun = rng.uniform(350.0, 900.0) * high_sun * (0.25 + 0.75 * cloud)
        wind = np.abs(rng.uniform(1.0, 3.0) + 1.0 * _noise(rng, n, 60.0))
    return Air(time, ambient, sun, wind)


def _noise(rng, count: int, memory: float) -> np.ndarray:
    """Unit random process with a memory of so many steps."""
    from scipy.signal import lfilter

    a = np.exp(-1.0 / memory)
    white = rng.normal(size=count + int(6 * memory))
    return lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], white)[-count:]


def record(
    world: World, style: str, seed: int, hours: float, low: float, high: float,
    every: float = 120.0, on_s: float = 0.0,
) -> Made:  # fmt: skip
    """A recording of a world under a history of weather.

    Args:
        style: of the weather.
        seed: of weather and noise.
        hours: length.
        low, high: range of the air (degC).
        every: between epochs (s).
        on_s: when the camera was switched on; it was cold before.
    """
    rng = np.random.default_rng([world.seed, seed, 23])
    length = 3600.0 * hours
    air = weather(rng, style, length, min(on_s, 0.0) - 4 * 3600.0, low, high)
    nodes = world.thermal.temperatures(air, (air.time >= on_s).astype(float))
    time = np.arange(0.0, length + 0.5 * every, every)
    at_epochs = np.array([np.interp(time, air.time, row) for row in nodes])
    change = (world.drift @ (at_epochs - world.at)).T
    pixel = np.array([_image(world, own) for own in change])
    still = np.repeat(_image(world, np.zeros(7))[None], len(time), axis=0)
    measured = pixel + world.sigma * rng.normal(size=pixel.shape)
    log_time = np.arange(max(air.time[0], -7200.0), length + 60.0, 60.0)
    body = nodes[min(1, len(nodes) - 1)]
    of = {"ambient_degC": air.ambient, "body_camera_degC": body, "irradiance_W_m2": air.sun}
    noise = {"irradiance_W_m2": (2.0, 1.0)}
    logs = {}
    for name in world.logged:
        sigma, step = noise.get(name, (0.01, 0.02))
        values = np.interp(log_time, air.time, of[name]) + sigma * rng.normal(size=len(log_time))
        logs[name] = np.round(values / step) * step
    return Made(world, style, time, pixel, still, measured, change, at_epochs, log_time, logs, on_s)


def _image(world: World, change: np.ndarray) -> np.ndarray:
    focal = world.focal * (1.0 + change[0])
    matrix = np.array(
        [[focal, 0.0, world.centre[0] + change[1]], [0.0, focal, world.centre[1] + change[2]],
         [0.0, 0.0, 1.0]]
    )  # fmt: skip
    distortion = world.distortion.copy()
    distortion[0] += change[6]
    turn = cv2.Rodrigues(change[3:6])[0]
    seen = turn @ cv2.Rodrigues(world.turn)[0]
    image, _ = cv2.projectPoints(
        world.plate, cv2.Rodrigues(seen)[0], turn @ world.shift, matrix, distortion
    )
    return image[:, 0]


def pair(seed: int, family: str) -> tuple[Made, Made]:
    """A training recording, and one of another day, rate and range, of one random world."""
    rng = np.random.default_rng([seed, 5])
    world = draw_world(seed, family)
    styles = ("chamber", "room", "outdoors")
    first, second = (str(rng.choice(styles)) for _ in range(2))
    base = rng.uniform(12.0, 24.0)
    half = rng.uniform(5.0, 10.0)
    train = record(world, first, 1, float(rng.uniform(14.0, 24.0)), base - half, base + half,
                   on_s=float(rng.uniform(600.0, 3600.0)))  # fmt: skip
    shift, wide = rng.uniform(-0.5, 0.5) * half, rng.uniform(0.6, 1.1) * half
    test = record(world, second, 2, float(rng.uniform(8.0, 16.0)), base + shift - wide,
                  base + shift + wide, on_s=float(rng.uniform(-7200.0, 1800.0)))  # fmt: skip
    return train, test


def relative(train: Made, test: Made) -> np.ndarray:
    """True drift [epochs, marks, 2] (px) of the test against the mean state of the training."""
    return test.pixel - train.pixel.mean(axis=0)


__all__ = ["FAMILIES", "Made", "World", "draw_world", "pair", "record", "relative"]
