"""The independent world against OpenCV, numerical integration and formulas done by hand."""

import ast
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxvm.simulate
from jaxvm.simulate import HIDEABLE, simulate_deformation_scene
from jaxvm.simulate.bodies import Placement
from jaxvm.simulate.optics import apparent
from jaxvm.simulate.scene import build_site, velocity
from jaxvm.simulate.thermal import CameraBody, Signal
from jaxvm.simulate.world import record

SEED = 5
HEIGHT = 2048


class Scene:
    """A small scene with and without one effect, without noise."""

    def __init__(self, *keys: str, seed: int = SEED, strength: float = 1.0):
        self.plain = build_site(seed, "small")
        self.site = build_site(seed, "small")
        self.truth = [HIDEABLE[key].into(self.site, seed, strength) for key in keys]
        self.t = self.plain.epoch_t
        self.pixels, self.ranges = record(self.plain)
        self.new_pixels, self.new_ranges = record(self.site)
        self.range_change = self.new_ranges - self.ranges

    def change(self, camera: str, plate: str) -> np.ndarray:
        return self.new_pixels[camera, plate] - self.pixels[camera, plate]

    def size(self, name: str) -> float:
        return self.truth[0].parameters[name][0]

    def excess(self, signal: Signal) -> np.ndarray:
        return signal(self.t) - signal(self.t).mean()

    def in_camera(self, camera: str, plate: str) -> np.ndarray:
        """Marks in camera coordinates, (epochs, marks, 3), by matrices only."""
        nominal = self.plain.plates[plate].nominal
        return np.stack(
            [m[:3, :3] @ nominal.T + m[:3, 3:] for m in self.camera_from_plate(camera, plate)]
        ).swapaxes(1, 2)

    def camera_from_plate(self, camera: str, plate: str) -> list[np.ndarray]:
        rest = as_matrix(self.plain.station) @ as_matrix(self.plain.cameras[camera].rest)
        placed = [self.plain.plates[plate].place(np.array([t])) for t in self.t]
        return [np.linalg.inv(rest) @ as_matrix(p) for p in placed]

    def opencv(self, camera: str, plate: str, points=None) -> np.ndarray:
        """cv2.projectPoints of a plate's marks, or of other points of it, at all epochs."""
        body = self.plain.cameras[camera]
        points = self.plain.plates[plate].nominal if points is None else points
        fx, fy = body.focal(self.t)[0]
        cx, cy = body.centre(self.t)[0]
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        out = []
        for k, matrix in enumerate(self.camera_from_plate(camera, plate)):
            own = points if points.ndim == 2 else points[k]
            turn = cv2.Rodrigues(matrix[:3, :3])[0]
            out.append(cv2.projectPoints(own, turn, matrix[:3, 3], K, body.distortion)[0][:, 0])
        return np.array(out)


def as_matrix(placed: Placement) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = placed.rotation.as_matrix()
    matrix[:3, 3] = np.ravel(placed.shift)
    return matrix


@pytest.fixture(scope="module")
def plain() -> Scene:
    return Scene()


# --- nothing hidden -----------------------------------------------------------------------------


@pytest.mark.parametrize("camera", ["left", "right"])
@pytest.mark.parametrize("plate", ["reference_near", "deck", "reference_far"])
def test_plain_world_is_opencv(plain, camera, plate):
    np.testing.assert_allclose(plain.pixels[camera, plate], plain.opencv(camera, plate), atol=1e-8)


def test_plain_ranges_meet_the_plane(plain):
    finder = as_matrix(plain.plain.station) @ as_matrix(plain.plain.rangefinder.place)
    for t, distance in zip(plain.t, plain.ranges, strict=True):
        end = finder @ np.array([0.0, 0.0, distance, 1.0])
        deck = np.linalg.inv(as_matrix(plain.plain.plates["deck"].place(np.array([t])))) @ end
        assert abs(deck[2]) < 1e-10
        assert np.all(np.abs(deck[:2] - plain.plain.plates["deck"].middle[:2]) < 0.5)


def test_velocity_is_the_slope_of_the_place(plain):
    deck, t, h = plain.plain.plates["deck"], plain.t, 0.02
    rates = velocity(deck, t)
    now, later = deck.place(t), deck.place(t + h)
    for mark in deck.nominal[[0, 4, 20, 24]]:
        arm = now.rotation.apply(mark)
        moved = (later.rotation.apply(mark) + later.shift - arm - now.shift) / h
        # Half an acceleration of some 0.1 m/s2 times h stays.
        np.testing.assert_allclose(rates[:, :3] + np.cross(rates[:, 3:], arm), moved, atol=2.5e-3)
    assert np.abs(rates[:, :3]).max() < 0.2 and np.abs(rates[:, :3]).std() > 0.01


def test_plates_do_not_cover_each_other(plain):
    for camera in plain.plain.cameras:
        for one, other in combinations(plain.plain.plates, 2):
            for k in range(plain.t.size):
                hulls = [
                    cv2.convexHull(plain.pixels[camera, plate][k].astype(np.float32))
                    for plate in (one, other)
                ]
                assert cv2.intersectConvexConvex(*hulls)[0] == 0.0


# --- parts against numerical integration --------------------------------------------------------


def test_light_in_the_world_obeys_the_ray_equation():
    """d/ds(n dr/ds) = grad n, integrated from the eye into the apparent direction."""
    slope, up = 3e-4, np.array([0.0, 0.0, 1.0])  # far stronger than air
    eye, mark = np.array([0.5, 0.0, 1.0]), np.array([-2.0, 12.0, 3.0])
    seen = apparent(eye[None], mark[None], up, np.array([slope]))[0]
    start = (seen - eye) / np.linalg.norm(seen - eye)
    # n^2 = 1 + slope (z - z_eye), so that n = 1 at the eye.
    index = lambda z: np.sqrt(1.0 + 2.0 * slope * (z - eye[2]))  # noqa: E731

    def ray(_, state):
        n = index(state[2])
        return np.concatenate([state[3:] / n, slope / n * up])

    def nearest(_, state):
        return (state[:3] - mark) @ state[3:]

    nearest.terminal = True
    way = solve_ivp(ray, (0.0, 30.0), [*eye, *start], events=nearest, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(way.y[:3, -1], mark, atol=1e-7)
    assert np.linalg.norm(seen - mark) > 0.01


def test_lag_is_the_differential_equation():
    t = np.arange(0.0, 7200.0, 10.0)
    signal = Signal(t, 20.0 + 3.0 * np.sin(t / 700.0) + (t > 3000.0))
    tau = 900.0
    exact = solve_ivp(
        lambda x, p: (signal(np.array([x])) - p) / tau,
        (0.0, t[-1]),
        [signal.value[0]],
        t_eval=t,
        max_step=5.0,
        rtol=1e-9,
        atol=1e-9,
    )
    np.testing.assert_allclose(signal.lagged(tau).value, exact.y[0], atol=1e-5)


def test_camera_body_warms_up_as_its_heat_balance_says():
    t = np.arange(-1200.0, 20000.0, 10.0)
    air, sun = Signal(t, np.full_like(t, 18.0)), Signal(t, np.zeros_like(t))
    body = CameraBody(power_w=1.2, powered_on_s=-15.0, sunlit_m2=0.001)
    housing = body.housing(air, sun)
    assert housing(np.array([-600.0])) == pytest.approx(18.0, abs=1e-9)
    assert housing(t[-1:]) == pytest.approx(18.0 + 1.2 / 0.12, abs=1e-3)
    exact = solve_ivp(
        lambda _, T: [
            (1.2 - 0.25 * (T[0] - T[1])) / 15.0,
            (0.25 * (T[0] - T[1]) - 0.12 * (T[1] - 18.0)) / 90.0,
        ],
        (-15.0, 3600.0),
        [18.0, 18.0],
        t_eval=[300.0, 1800.0, 3600.0],
        rtol=1e-9,
    )
    # The grid of 10 s switches the power on as a ramp; that is half a step of doubt at most.
    np.testing.assert_allclose(housing(exact.t), exact.y[1], atol=0.03)


def test_play_rests_until_the_gap_is_crossed():
    t = np.arange(400.0)
    driver = Signal(t, 5.0 * np.sin(t / 30.0))
    follower = driver.with_play(2.0).value
    assert np.all(np.abs(follower - driver.value) <= 1.0 + 1e-12)
    moving = np.diff(follower) != 0.0
    np.testing.assert_allclose(np.abs(follower - driver.value)[1:][moving], 1.0, atol=1e-12)
    assert 0.1 < np.mean(~moving) < 0.6


# --- every effect -------------------------------------------------------------------------------


@pytest.mark.parametrize("key", HIDEABLE)
def test_effect_is_where_it_says_and_of_a_size_that_shows(key):
    recording = simulate_deformation_scene((key,), seed=SEED, size="small")
    (truth,) = recording.truth
    assert truth.effect == key and truth.parameters
    if key == "range-drift":
        assert truth.rms_px == 0.0 and 1e-4 < truth.rms_range_m < 3e-3
    else:
        assert 0.008 < truth.rms_affected_px < 0.9
        assert 0.0 < truth.rms_px <= truth.rms_affected_px
    scene = Scene(key)
    for camera in ("left", "right"):
        for plate in scene.plain.plates:
            outside = camera not in truth.place.get("camera", [camera])
            outside |= plate not in truth.place.get("target", [plate])
            if outside or key == "range-drift":
                assert np.abs(scene.change(camera, plate)).max() < 1e-9


def test_strength_scales():
    once, twice = Scene("focal-drift"), Scene("focal-drift", strength=2.0)
    np.testing.assert_allclose(
        twice.change("left", "deck"), 2.0 * once.change("left", "deck"), atol=1e-9
    )


# --- plates


def test_plate_expansion_is_alpha_times_its_own_temperature():
    scene = Scene("plate-expansion")
    alpha, tau = scene.size("expansion"), scene.size("lag")
    ambient = scene.plain.weather.ambient
    own = solve_ivp(
        lambda t, p: (ambient(np.array([t])) - p) / tau,
        (ambient.t[0], scene.t[-1]),
        [ambient.value[0]],
        t_eval=scene.t,
        max_step=30.0,
    ).y[0]
    growth = alpha * (own - ambient(scene.t).mean())
    plate = scene.plain.plates["reference_near"]
    stretched = plate.middle + (1.0 + growth[:, None, None]) * (plate.nominal - plate.middle)
    expected = scene.opencv("right", plate.name, stretched)
    np.testing.assert_allclose(scene.new_pixels["right", plate.name], expected, atol=2e-4)
    # By hand: alpha dT s f/Z, for the two ends of the middle row.
    depth = scene.in_camera("left", plate.name)[0, :, 2]
    ends = scene.change("left", plate.name)[:, [10, 14], 0]
    by_hand = growth * 1.6 * np.cos(np.radians(27.0)) * 3000.0 / depth[12]
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], by_hand, rtol=0.15, atol=1e-3)


def test_humidity_growth_differs_along_the_two_axes():
    scene = Scene("humidity-growth")
    damp = scene.excess(scene.plain.weather.humidity)
    plate = scene.plain.plates["reference_far"]
    rates = np.array([scene.size("growth along x"), scene.size("growth along y"), 0.0])
    swollen = plate.nominal + damp[:, None, None] * rates * (plate.nominal - plate.middle)
    expected = scene.opencv("left", plate.name, swollen)
    np.testing.assert_allclose(scene.new_pixels["left", plate.name], expected, atol=1e-8)


def test_bow_lifts_the_middle_and_not_the_edges():
    scene = Scene("plate-bow")
    deflection = scene.size("deflection")
    plate = scene.plain.plates["deck"]
    change = scene.change("left", "deck").reshape(scene.t.size, 5, 5, 2)
    across = np.abs(change).max(axis=(0, 3))
    edges_quiet = [np.abs(across[:, [0, 4]]).max(), np.abs(across[[0, 4]]).max()]
    axis = int(np.argmin(edges_quiet))
    assert edges_quiet[axis] < 1e-9 < edges_quiet[1 - axis]
    lifted = plate.nominal.copy()
    lifted[12, 2] = deflection
    expected = scene.opencv("left", "deck", lifted)[:, 12]
    np.testing.assert_allclose(scene.new_pixels["left", "deck"][:, 12], expected, atol=1e-8)
    assert np.abs(scene.range_change).mean() == pytest.approx(abs(deflection), rel=0.3)


def test_another_day_is_the_same_scene_in_another_weather():
    first, again, later = (
        simulate_deformation_scene(["focal-drift"], SEED, "small", day=day) for day in (0, 0, 3)
    )
    sizes = [made.truth[0].parameters for made in (first, again, later)]
    assert sizes[0] == sizes[1] == sizes[2]
    assert first.toml == later.toml
    assert first.recording_tables["observations"].equals(again.recording_tables["observations"])
    for name in ("drivers", "observations"):
        assert not first.recording_tables[name].equals(later.recording_tables[name])
    assert first.recording_tables["epochs"]["t"].equals(later.recording_tables["epochs"]["t"])


def test_one_mark_is_displaced():
    scene = Scene("mark-displaced")
    (name,) = scene.truth[0].place["point"]
    row, column = map(int, name.split("/"))
    change = scene.change("right", "reference_near")
    assert set(np.nonzero(np.abs(change).max(axis=(0, 2)) > 1e-9)[0]) == {5 * row + column}
    size = np.hypot(scene.size("displacement x"), scene.size("displacement y"))
    depth = scene.in_camera("right", "reference_near")[0, 5 * row + column, 2]
    seen = np.linalg.norm(change[0, 5 * row + column])
    assert 0.75 * size * 3000 / depth < seen < 1.1 * size * 3000 / depth


def test_reference_is_knocked_at_a_moment():
    scene = Scene("reference-moved")
    change = scene.change("left", "reference_far")
    late = scene.t >= scene.size("moment")
    assert 8 < late.sum() < 32
    assert np.abs(change[~late]).max() < 1e-12
    depth = scene.in_camera("left", "reference_far")[0, :, 2]
    by_hand = abs(scene.size("displacement")) * 3000.0 / depth
    np.testing.assert_allclose(np.linalg.norm(change[late][0], axis=1), by_hand, rtol=0.08)


# --- mounts


def uniform_turn(scene: Scene, camera: str, plate: str, axis: int, angle: np.ndarray):
    """First-order change of pixels of a camera that turns about its own axis by an angle (rad)."""
    mark = scene.in_camera(camera, plate)
    turned = [
        Rotation.from_rotvec(-a * np.eye(3)[axis]).apply(m)
        for a, m in zip(angle, mark, strict=True)
    ]
    ideal = mark[..., :2] / mark[..., 2:]
    return 3000.0 * (np.array(turned)[..., :2] / np.array(turned)[..., 2:] - ideal)


def close_in_pixels(change: np.ndarray, by_hand: np.ndarray) -> None:
    """Equal up to the local magnification of lens and focal length (some per cent)."""
    np.testing.assert_allclose(change, by_hand, atol=0.06 * np.abs(by_hand).max() + 1e-6)


def test_mount_slips_at_a_moment():
    scene = Scene("mount-slip")
    angle = scene.size("turn about y") * (scene.t >= scene.size("moment"))
    close_in_pixels(
        scene.change("right", "reference_near"),
        uniform_turn(scene, "right", "reference_near", 1, angle),
    )


def test_mount_creeps_ever_more_slowly():
    scene = Scene("mount-creep")
    angle = scene.size("turn about x") * (1.0 - np.exp(-scene.t / scene.size("time constant")))
    close_in_pixels(scene.change("left", "deck"), uniform_turn(scene, "left", "deck", 0, angle))


def test_mount_nods_with_its_period():
    scene = Scene("vibration")
    phase = 2 * np.pi * scene.t / scene.size("period") + scene.size("phase")
    angle = scene.size("amplitude about x") * np.sin(phase)
    close_in_pixels(
        scene.change("left", "reference_far"),
        uniform_turn(scene, "left", "reference_far", 0, angle),
    )


def test_hysteresis_opens_a_loop():
    scene = Scene("hysteresis")
    warmth = scene.excess(scene.plain.weather.ambient)
    turn = -scene.change("right", "reference_far")[:, 12, 0] / 3000.0
    gap = turn / scene.size("turn about y") - warmth
    half = scene.size("play") / 2
    assert np.abs(gap).max() < 1.1 * half + 0.1
    assert gap.max() > 0.8 * half and gap.min() < -0.8 * half


def test_bracket_growth_is_seen_with_parallax():
    scene = Scene("bracket-growth", seed=1)
    shift = scene.size("growth along x") * scene.excess(scene.plain.weather.ambient)
    for plate in ("reference_near", "reference_far"):
        depth = scene.in_camera("right", plate)[..., 2]
        close_in_pixels(scene.change("right", plate)[..., 0], -3000.0 * shift[:, None] / depth)


# --- lens, sensor, detection


def test_focal_drift_is_radial_about_the_principal_point():
    scene = Scene("focal-drift")
    growth = scene.size("growth") * scene.excess(scene.plain.cameras["left"].housing)
    centre = scene.plain.cameras["left"].centre(scene.t)[0]
    by_hand = growth[:, None, None] * (scene.pixels["left", "deck"] - centre)
    np.testing.assert_allclose(scene.change("left", "deck"), by_hand, atol=1e-9)


def test_principal_point_walks_alike_for_all_marks():
    scene = Scene("principal-point-walk")
    rate = np.array([scene.size("walk along u"), scene.size("walk along v")])
    walk = scene.excess(scene.plain.cameras["right"].housing)[:, None] * rate
    for plate in ("reference_near", "reference_far"):
        change = scene.change("right", plate)
        np.testing.assert_allclose(change, np.broadcast_to(walk[:, None], change.shape), atol=1e-9)


def test_self_heating_starts_with_the_power():
    scene = Scene("self-heating")
    (axis,) = (name[-1] for name in scene.truth[0].parameters if name.startswith("shift"))
    since = scene.t - scene.plain.cameras["left"].powered_on_s
    by_hand = scene.size(f"shift along {axis}") * (
        1.0 - np.exp(-since / scene.size("time constant"))
    )
    change = scene.change("left", "reference_far")
    np.testing.assert_allclose(change[:, 7, "uv".index(axis)], by_hand, atol=1e-9)
    assert np.abs(change[..., 1 - "uv".index(axis)]).max() < 1e-9


def test_extra_lens_term_is_of_the_seventh_order():
    scene = Scene("lens-radial")
    mark = scene.in_camera("right", "reference_near")
    ideal = mark[..., :2] / mark[..., 2:]
    radius2 = (ideal**2).sum(axis=-1, keepdims=True)
    focal = scene.plain.cameras["right"].focal(scene.t)[0]
    by_hand = scene.size("distortion of the seventh order") * focal * radius2**3 * ideal
    np.testing.assert_allclose(scene.change("right", "reference_near"), by_hand, atol=1e-9)


def test_pixel_locking_has_a_period_of_one_pixel():
    scene = Scene("pixel-locking")
    for camera in ("left", "right"):
        by_hand = scene.size("amplitude") * np.sin(2 * np.pi * scene.pixels[camera, "deck"])
        np.testing.assert_allclose(scene.change(camera, "deck"), by_hand, atol=1e-9)


# --- shutter and clock


def image_velocity(scene: Scene, camera: str) -> np.ndarray:
    """Velocity of the deck's marks in the image (px/s), by the chain rule."""
    deck, body = scene.plain.plates["deck"], scene.plain.cameras[camera]
    rates = velocity(deck, scene.t)
    camera_from_world = np.linalg.inv(as_matrix(scene.plain.station) @ as_matrix(body.rest))[:3, :3]
    mark = scene.in_camera(camera, "deck")
    arm = np.stack([deck.place(scene.t).rotation.apply(m) for m in deck.nominal], axis=1)
    speed = rates[:, None, :3] + np.cross(rates[:, None, 3:], arm)
    speed = speed @ camera_from_world.T
    ideal = mark[..., :2] / mark[..., 2:]
    return 3000.0 * (speed[..., :2] - ideal * speed[..., 2:]) / mark[..., 2:]


def test_late_trigger_shows_velocity_times_delay():
    scene = Scene("trigger-offset")
    close_in_pixels(
        scene.change("right", "deck"), image_velocity(scene, "right") * scene.size("delay")
    )


def test_rolling_shutter_shows_velocity_times_row_time():
    scene = Scene("rolling-shutter")
    row = scene.pixels["left", "deck"][..., 1:]
    delay = scene.size("time per frame") * ((row + 0.5) / HEIGHT - 0.5)
    close_in_pixels(scene.change("left", "deck"), image_velocity(scene, "left") * delay)


# --- air and rangefinder


def test_air_lifts_marks_by_half_k_length_squared():
    scene = Scene("air-bending")
    k = scene.size("curvature") * scene.plain.weather.gradient(scene.t)
    for plate in ("reference_near", "reference_far"):
        mark = scene.in_camera("left", plate)
        length = np.linalg.norm(mark, axis=-1)
        by_hand = -3000.0 / mark[..., 2] * 0.5 * k[:, None] * length**2  # v counts downwards
        change = scene.change("left", plate)
        np.testing.assert_allclose(change[..., 1], by_hand, rtol=0.1)


def test_range_drifts_with_the_air_and_no_pixel_knows():
    scene = Scene("range-drift")
    by_hand = scene.size("drift") * scene.excess(scene.plain.weather.ambient)
    np.testing.assert_allclose(scene.range_change, by_hand, atol=1e-12)


# --- the recording ------------------------------------------------------------------------------


def test_recording_is_noise_about_the_world():
    scene = Scene("focal-drift", "trigger-offset")
    recording = simulate_deformation_scene(
        ("focal-drift", "trigger-offset"), seed=SEED, size="small"
    )
    table = recording.recording_tables["observations"]
    assert 0.98 < len(table) / (40 * 2 * 3 * 25) < 0.998
    noise = []
    for (camera, plate), rows in table.groupby(["camera", "target"]):
        mark = rows["point"].str.split("/", expand=True).astype(int)
        clean = scene.new_pixels[camera, plate][rows["epoch"], 5 * mark[0] + mark[1]]
        noise.append(rows[["u", "v"]].to_numpy() - clean)
    noise = np.concatenate(noise)
    assert noise.std() == pytest.approx(0.05, rel=0.03) and abs(noise.mean()) < 0.002
    ranges = recording.recording_tables["ranges"]["range_m"]
    assert (ranges - scene.new_ranges).std() == pytest.approx(0.0002, rel=0.4)


def test_same_seed_is_the_same_scene_and_noise():
    again = [simulate_deformation_scene(("vibration",), seed=3, size="small") for _ in range(2)]
    for name, table in again[0].recording_tables.items():
        pd.testing.assert_frame_equal(table, again[1].recording_tables[name])
    assert again[0].toml == again[1].toml and again[0].truth == again[1].truth

    nothing = simulate_deformation_scene((), seed=3, size="small")
    assert nothing.truth == []
    for name in ("epochs", "drivers"):
        pd.testing.assert_frame_equal(
            nothing.recording_tables[name], again[0].recording_tables[name]
        )
    other = simulate_deformation_scene((), seed=4, size="small")
    assert not nothing.recording_tables["drivers"].equals(other.recording_tables["drivers"])


def test_folder_does_not_tell_the_answer(tmp_path):
    keys = tuple(HIDEABLE)
    recording = simulate_deformation_scene(keys, seed=1, size="small")
    assert [truth.effect for truth in recording.truth] == list(keys)
    recording.write(tmp_path / "recording")
    files = {path.name: path for path in (tmp_path / "recording").iterdir()}
    assert set(files) == {
        "recording.toml",
        "observations.csv",
        "epochs.csv",
        "drivers.csv",
        "ranges.csv",
    }
    text = "".join(path.read_text() for path in files.values()).lower()
    for key in keys:
        assert key not in text and key.replace("-", "_") not in text
        assert key.replace("-", " ") not in text
    nothing = simulate_deformation_scene((), seed=1, size="small").write(tmp_path / "nothing")
    assert (nothing / "recording.toml").read_text() == files["recording.toml"].read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hide": ("gremlins",)}, "known: .*plate-expansion"),
        ({"hide": ("vibration", "vibration")}, "twice"),
        ({"size": "huge"}, "known: full, small"),
    ],
)
def test_wrong_requests_name_what_is_known(arguments, message):
    with pytest.raises(ValueError, match=message):
        simulate_deformation_scene(**arguments)


def test_world_uses_none_of_the_models():
    folder = Path(jaxvm.simulate.__file__).parent
    used = set()
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                used |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0
                used.add(node.module)
    own = {name for name in used if name.startswith("jaxvm")}
    assert all(name.startswith("jaxvm.simulate.") for name in own)
    assert not {name.split(".")[0] for name in used} & {"jax", "equinox", "optimistix", "lineax"}
