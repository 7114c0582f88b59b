"""The catalogue: every entry is well formed, can be found, and gives the name that it should."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import board_recording, matrix, stereo_recording, to_plane, to_point
from scipy.spatial.transform import Rotation

from jaxvm.discover.courses import driver_kind, kinds_in_scope
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.scatter import families_of_images
from jaxvm.discover.space import enumerate_hypotheses, member
from jaxvm.network.binding import in_scope, observation_driver_table, range_driver_table
from jaxvm.network.residual import residual
from jaxvm.network.scene import Scene, build
from jaxvm.network.tables import along_beam
from jaxvm.physics.catalogue import BY_ID, CATALOGUE, entries_for
from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.catalogue.range import UNITS_M
from jaxvm.physics.drivers import (
    CHANNEL_UNITS,
    OBSERVATION_DRIVER_INDEX,
    OBSERVATION_DRIVERS,
    PLANES,
    build_channels,
    channel_kind,
    patterns,
)
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.forms import BASES, FORMS
from jaxvm.physics.materials import MATERIALS, length_of, materials_for
from jaxvm.physics.ports import PORT_INDEX, PORTS
from jaxvm.recording.recording import Drivers, Ranges
from jaxvm.report.words import parameters, substance

KINDS = {kind for kind, _ in CHANNEL_UNITS.values()}
CHANNELS = {
    "plate_degC": "temperature",
    "body_K": "temperature",
    "room_pct": "humidity",
    "baro_hPa": "pressure",
    "sun_W_m2": "irradiance",
    "gusts_m_s": "wind",
    "air_K_per_m": "gradient",
    "shutter_ms": "exposure",
    "rate_Hz": "frame rate",
    "lamp_lux": "light",
    "load_kN": "quantity",
    "degC": "quantity",
}


# --- entries --------------------------------------------------------------------------------------


def test_identifiers_are_unique_and_many():
    assert len(BY_ID) == len(CATALOGUE) >= 65


MIXED = {"aspect", "radial-beyond-model", "sensor-tilt", "window-off-centre"}
"""Entries whose ports have several units."""


@pytest.mark.parametrize("entry", CATALOGUE, ids=lambda entry: entry.id)
def test_entry_is_well_formed(entry):
    assert entry.id == entry.id.lower() and " " not in entry.id
    assert entry.physics and entry.mistaken_for and entry.separate_by
    assert entry.explanation.endswith(".") and entry.explanation.count(". ") == 1
    assert 0.0 < entry.plausible[0] < entry.plausible[1]
    assert entry.rows and all(1 <= row <= 98 for row in entry.rows)
    assert list(entry.rows) == sorted(set(entry.rows))
    assert entry.entity in ("camera", "station", "target", "view", "face", "mark", "rangefinder")
    assert set(entry.drivers) <= {"constant", "time", "power-on", "quantity", "neighbour"} | KINDS
    assert set(entry.forms) <= set(FORMS)
    assert ("constant" in entry.drivers) == ("constant" in entry.forms)
    assert len(set(entry.groups)) == len(entry.groups)
    units = {PORTS[PORT_INDEX[group[0].port]].unit for group in entry.groups}
    assert units <= {"m", "rad"} or len(units) == 1 or entry.id in MIXED
    for term in (term for group in entry.groups for term in group):
        assert term.port in PORT_INDEX
        assert (
            term.driver in OBSERVATION_DRIVERS
            and term.basis in BASES
            or (term.driver in PLANES and term.basis == "tile")
        )
        assert (term.driver == "one") == (term.basis == "one")


def test_no_two_entries_claim_the_same():
    """Entries for the same combination are doubles that no recording resolves: each is meant."""
    claimed: dict[tuple, str] = {}
    for entry in CATALOGUE:
        for group in entry.groups:
            for driver in entry.drivers:
                for form in entry.forms:
                    first = claimed.setdefault((group, entry.entity, driver, form), entry.id)
                    pair = {first, entry.id}
                    assert first == entry.id or pair in ALIKE, (pair, group, driver, form)


ALIKE = (
    {"range-scale", "range-air"},
    # Both go with the sign of the rate.
    {"mount-hysteresis", "beam-warms-unevenly"},
    # While the temperature changes beam and mount turn the camera alike.
    {"beam-warms-unevenly", "mount-lags"},
    # The image scales alike, whether glass or firmware does it.
    {"focal-drift", "device-compensates"},
    # Centroids of lopsided spots move as if the lens distorted.
    {"distortion-drift", "defocus-drift"},
    {"radial-beyond-model", "coma"},
    # A wedge or a dome bends the image as a decentred lens does.
    {"decentring", "window-off-centre"},
    # A dome beside the axis acts as a weak lens off the axis, as stale intrinsics do.
    {"focal-wrong", "window-off-centre"},
    # The sun bends what carries the camera, mount or beam; it changes the lens or its window.
    {"camera-on-bent-beam", "mount-turn-sun"},
    {"window-lens-power", "focal-sun"},
    # Both are a delay from one moment on.
    {"frame-slip", "trigger-late"},
    # Sunlight heats the housing and brightens one side of the marks.
    {"principal-point-sun", "light-bias"},
    # A longer exposure heats the sensor and lets bright marks bloom.
    {"duty-cycle", "blooming"},
)


# --- kinds of channels ----------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "kind"), CHANNELS.items())
def test_kind_of_a_channel(name, kind):
    assert channel_kind(name) == kind


def names(terms, entity, form, *kinds):
    return [entry.id for entry in entries_for(terms, entity, kinds, form)]


def test_distortion_changes_in_the_image_too():
    """Towards 90 degrees from the axis a polynomial of the tangent is none of the image."""
    in_image = partial(names, (Term("sensor.focal", "radius", "square"),), "camera")
    assert in_image("linear", "temperature") == ["distortion-drift", "defocus-drift"]
    assert in_image("step", "time") == ["distortion-jump"]
    assert in_image("onset", "power-on") == ["distortion-warm-up"]
    near = (Term("sensor.focal", "radius2_over_range", "linear"),)
    assert names(near, "camera", "constant", "constant") == ["distortion-with-range"]


def test_the_kind_of_a_channel_decides_the_name():
    focal, turn = (Term("sensor.focal"),), (Term("mount.turn_x"),)
    of_camera = partial(names, focal, "camera", "linear", "quantity")
    assert of_camera("temperature") == ["focal-drift", "device-compensates"]
    assert of_camera("pressure") == ["focal-pressure"]
    assert of_camera("irradiance") == ["window-lens-power", "focal-sun"]
    # A load does not heat a lens, but it bends a mount.
    assert of_camera("quantity") == of_camera() == []
    of_mount = partial(names, turn, "camera", "linear", "quantity")
    assert of_mount("quantity") == ["mount-loaded"]
    # Where the kind is named, what takes any quantity is not meant.
    assert of_mount("temperature") == ["mount-turn"]
    # The temperature of another camera may be that of its surroundings, or its own heat.
    assert of_mount("temperature", "neighbour") == ["mount-turn", "mount-loaded"]
    scale = (Term("range.scale"),)
    assert names(scale, "rangefinder", "linear", "quantity", "pressure") == ["range-air"]
    assert names(scale, "rangefinder", "constant", "constant") == ["range-scale"]
    # Time is no quantity.
    assert names(turn, "camera", "linear", "time") == ["mount-creep"]
    assert names(turn, "camera", "onset", "power-on") == ["mount-warm-up"]
    # The same terms of another body are another effect.
    image = (Term("sensor.cx"), Term("sensor.cy"))
    assert names(image, "target", "linear", "quantity", "light") == ["side-light"]
    # What each mark has for itself is named whatever their number.
    marks = each("mark", "target.point_z", numbers=range(7, 20))
    assert names(marks, "target", "constant", "constant") == ["marks-of-other-depth"]


def test_the_body_of_a_camera_is_a_neighbour_of_what_does_not_carry_it():
    recording = parted_scene().recording
    time = recording.drivers.time
    names = ("ambient_degC", "body_left_degC", "body_right_degC")
    channels = {name: np.linspace(10.0, 12.0 + k, len(time)) for k, name in enumerate(names)}
    scene = build(replace(recording, drivers=Drivers(time, channels)))

    def kinds(scope, driver="body_left_degC", kind="quantity"):
        return kinds_in_scope(kind, driver, scope, scene)

    own = ("quantity", "temperature")
    assert kinds(Scope(camera=("left",))) == kinds(Scope(station=("bar",))) == own
    # Another camera is a neighbour on the same station, and nothing on one far away.
    assert kinds(Scope(camera=("right",))) == kinds(Scope(station=("other",))) == ()
    together = build(replace(logged_scene().recording, drivers=scene.recording.drivers))
    right = Scope(camera=("right",))
    assert kinds_in_scope("quantity", "body_left_degC", right, together) == ("neighbour",)
    # What a camera sees of a target is as warm as the camera.
    view = Scope(camera=("left",), target=(scene.model.targets[0].name,))
    assert kinds(view) == own
    assert kinds(view, "body_right_degC") == ()
    # Targets are as warm as the air, which is logged.
    target = Scope(target=(scene.model.targets[0].name,))
    assert kinds(target) == ("neighbour",)
    assert kinds(target, "ambient_degC") == own
    # What is called a body and is no camera's may be anything's.
    assert kinds(target, "body_hull_degC") == own
    difference = "body_left_degC - ambient_degC"
    assert kinds(Scope(station=("bar",)), difference, "difference") == own
    assert kinds(Scope(station=("other",)), difference, "difference") == ()
    assert kinds(Scope(), kind="time") == ("time",)


# --- every entry can be found ---------------------------------------------------------------------


@cache
def logged_scene() -> Scene:
    """Two cameras, a reference, a plate and a rangefinder, with channels of every kind."""
    known = stereo_recording()
    recording = known.recording
    time = np.linspace(recording.time[0] - 1.0, recording.time[-1] + 1.0, 40)
    rng = np.random.default_rng(1)
    channels = {name: np.cumsum(rng.normal(size=len(time))) for name in CHANNELS}
    cameras = tuple(replace(c, powered_on_s=(-60.0,)) for c in recording.model.cameras)
    recording = replace(
        recording,
        drivers=Drivers(time, channels),
        model=replace(recording.model, cameras=cameras),
    )
    return known.true_scene(recording)


@cache
def parted_scene() -> Scene:
    """The same with each camera on a station of its own: targets have two faces."""
    recording = logged_scene().recording
    (bar,), (left, right) = recording.model.stations, recording.model.cameras
    model = replace(
        recording.model,
        stations=(bar, replace(bar, name="other")),
        cameras=(left, replace(right, station="other")),
    )
    return build(replace(recording, model=model))


@cache
def first_names() -> dict[str, Hypothesis]:
    """For each entry that some hypothesis may be called by: one such hypothesis."""
    found: dict[str, Hypothesis] = {}
    for scene in (logged_scene(), parted_scene()):
        for family in (*enumerate_hypotheses(scene), *families_of_images(scene)):
            for g, c in np.argwhere(family.valid.any(axis=2)):
                s = int(np.argmax(family.valid[g, c]))
                hypothesis = member(family, (g, c, s), scene)
                for entry in hypothesis.entries:
                    found.setdefault(entry.id, replace(hypothesis, entries=(entry,)))
    return found


@pytest.mark.parametrize("entry", CATALOGUE, ids=lambda entry: entry.id)
def test_entry_names_a_hypothesis(entry):
    hypothesis = first_names()[entry.id]
    assert hypothesis.effect(()).name == entry.physics
    assert hypothesis.group.entity == entry.entity
    view = {"camera", "target"}
    kinds = {"mark": {"target", "point"}, "face": view, "view": view}
    assert set(hypothesis.scope.as_dict()) == kinds.get(entry.entity, {entry.entity})


def test_time_is_asked_of_marks_but_not_too_often():
    scene = logged_scene()
    marks = [f for f in enumerate_hypotheses(scene) if f.groups[0].mark is not None]
    forms = {"constant", "linear", "step", "onset", "creep", "settling"}
    assert {c.form for f in marks for c in f.courses} == forms
    assert all(
        driver_kind(scene, c.driver) in ("constant", "time")
        or channel_kind(c.driver) == "temperature"
        for f in marks
        for c in f.courses
    )
    assert sum(int(f.valid.sum()) for f in marks) < 4000
    hypothesis = member(marks[0], (3, 0, 0), scene)
    assert hypothesis.scope == Scope(target=("reference",), point=("0/3",))


def test_what_never_changes_has_half_of_the_prior_of_its_name():
    """A scale that is wrong is as likely as one that follows any quantity, not one in twenty."""
    scene = logged_scene()
    shares = []
    for family in enumerate_hypotheses(scene):
        for g, c, s in np.argwhere(family.valid):
            if family.groups[g].terms[0].port == "range.scale" and len(family.groups[g].terms) == 1:
                hypothesis = member(family, (int(g), int(c), int(s)), scene)
                if "range-scale" in {entry.id for entry in hypothesis.entries}:
                    kind = hypothesis.course.driver, hypothesis.course.form
                    shares.append((kind, 1.0 / hypothesis.alternatives["range-scale"]))
    by_kind = dict(shares)
    assert by_kind.pop(("constant", "constant")) == 0.5
    # Some quantities have a name of their own for what they do to ranges.
    assert len(by_kind) > 10 and 0.25 < sum(by_kind.values()) <= 0.5


def test_what_a_recording_lacks_is_not_asked():
    with_finder, without = (
        enumerate_hypotheses(build(stereo_recording(with_ranges=has).recording))
        for has in (True, False)
    )

    def ports(families):
        return {t.port for f in families for g in f.groups for t in g.terms}

    assert ports(with_finder) - ports(without) == {"range.offset", "range.scale"}
    for family in (*with_finder, *without):
        assert family.valid.any(axis=(1, 2)).all() and len(family.groups) == len(family.valid)


@pytest.fixture(scope="module")
def seen():
    """Known board before a camera at the origin, drivers by name, and marks in the world (m)."""
    known = board_recording(noise=0.0, n_epochs=2)
    scene, obs = known.true_scene(), known.recording.observations
    rows = scene.tables[0]
    table = np.asarray(observation_driver_table(scene, scene.network.pixels[0], rows))[: len(rows)]
    pose = known.truth["carrier_from_target"][obs.epoch[rows]]
    marks = known.recording.model.targets[0].points[obs.point[rows]]
    world = Rotation.from_rotvec(pose[:, :3]).apply(marks) + pose[:, 3:]
    return known, dict(zip(OBSERVATION_DRIVER_INDEX, table.T, strict=True)), rows, world


def test_distortion_by_range_by_hand(seen):
    """The square of the radius in the image over the slanted distance of the mark."""
    known, drivers, rows, world = seen
    obs = known.recording.observations
    distance = np.linalg.norm(world, axis=1)
    from_centre = obs.pixel[rows] - known.truth["centre"][0]
    (camera,) = known.recording.model.cameras
    half = 0.5 * np.linalg.norm(camera.image_size)
    expected = np.sum((from_centre / half) ** 2, axis=1) / distance
    np.testing.assert_allclose(drivers["radius2_over_range"], expected, rtol=1e-9)


def test_place_of_a_mark_above_and_beside_the_camera_by_hand(seen):
    known, drivers, _, world = seen
    up = np.array(known.recording.model.up) / np.linalg.norm(known.recording.model.up)
    level_x, level_y, height = (drivers[name] for name in ("level_x", "level_y", "height"))
    np.testing.assert_allclose(height, world @ up, rtol=1e-9, atol=1e-12)
    # The other two are level, and the three are lengths along axes at right angles.
    flat = world - (world @ up)[:, None] * up
    np.testing.assert_allclose(level_x**2 + level_y**2, np.sum(flat**2, axis=1), rtol=1e-9)


# --- patterns over distances ----------------------------------------------------------------------


def distances(scene: Scene) -> tuple[Ranges, np.ndarray]:
    """The distances of a scene and their drivers."""
    assert scene.recording.ranges is not None and scene.network.ranges is not None
    return scene.recording.ranges, np.asarray(range_driver_table(scene, scene.network.ranges))


def test_drivers_of_a_distance_by_hand():
    """Distance and incidence from matrices, to a plane and to a mark; nothing of an image."""
    known = stereo_recording(noise=0.0)
    scene = known.true_scene()
    (ranges, table), model = distances(scene), scene.model
    at = OBSERVATION_DRIVER_INDEX
    np.testing.assert_allclose(table[:, at["range"]], ranges.distance, rtol=1e-12)
    np.testing.assert_allclose(table[:, at["inverse_range"]] * ranges.distance, 1.0, rtol=1e-12)
    assert np.all(table[:, at["one"]] == 1.0)

    beam = matrix(model.stations[0].pose) @ matrix(model.rangefinders[0].pose)
    poses = np.asarray(known.truth["carrier_from_target"])
    for row, (epoch, target, point) in enumerate(
        zip(ranges.epoch, ranges.target, ranges.point, strict=True)
    ):
        plate = matrix(poses[0 if target == 0 else 1 + epoch])
        ray = beam[:3, 2]
        if point >= 0:
            mark = model.targets[target].points[point]
            ray = plate[:3, :3] @ mark + plate[:3, 3] - beam[:3, 3]
            assert to_point(beam, plate, mark) == pytest.approx(table[row, at["range"]])
        else:
            assert to_plane(beam, plate) == pytest.approx(table[row, at["range"]])
        cosine = abs(ray @ plate[:3, 2]) / np.linalg.norm(ray)
        assert np.cos(table[row, at["incidence"]]) == pytest.approx(cosine, rel=1e-12)

    meaning = {"one", "range", "inverse_range", "incidence"}
    for driver, basis in ((d, b) for d in OBSERVATION_DRIVERS for b in ("linear", "cosine")):
        values = patterns([Term("range.offset", driver, basis, (2.0,))], jnp.asarray(table))[:, 0]
        assert np.any(values != 0.0) == (driver in meaning), driver


@pytest.mark.parametrize(
    ("term", "by_hand"),
    [
        (Term("range.offset", "range", "sine", (0.5,)), lambda rho: np.sin(4.0 * np.pi * rho)),
        (Term("range.offset", "inverse_range", "linear"), lambda rho: 1.0 / rho),
        (Term("range.offset", "row", "cosine", (0.5,)), lambda rho: 0.0 * rho),
    ],
)
def test_a_pattern_over_distances_enters_the_residuals(term, by_hand):
    known = stereo_recording()
    plain = known.true_scene()
    effect = Effect("pattern", (term,), scope=Scope(rangefinder=("lidar",)), amplitudes=(2e-3,))
    scene = plain.with_effects((effect,))
    before, after = (np.asarray(residual(s.state, s.network).ranges)[:, 0] for s in (plain, scene))
    ranges, table = distances(plain)
    distance = table[:, OBSERVATION_DRIVER_INDEX["range"]]
    expected = 2e-3 * by_hand(distance) / ranges.sigma
    np.testing.assert_allclose(after - before, expected, atol=1e-9)


def test_cyclic_error_is_one_entry_with_many_units():
    entry = BY_ID["range-cyclic"]
    assert [group[0].constants for group in entry.groups] == [(unit,) for unit in UNITS_M]
    assert all([t.basis for t in group] == ["sine", "cosine"] for group in entry.groups)


def test_a_seam_parts_the_image():
    table = np.zeros((4, len(OBSERVATION_DRIVERS)))
    at = np.array([-0.5, -1e-9, 1e-9, 0.5])
    for place, name in ((0.0, "row"), (0.0, "column"), (0.24, "column")):
        term = Term("detect.u", name, "step", (place,))
        assert any(term in group for group in BY_ID["sensor-stitched"].groups)
        table[:, OBSERVATION_DRIVER_INDEX[name]] = place + at
        found = jax.jit(lambda t, term=term: patterns([term], t))(table)
        assert found[:, 0].tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize("course", [("constant", "constant", ()), ("time", "periodic", (60.0,))])
def test_terms_keep_their_columns_when_they_are_evaluated_together(course):
    images = each("epoch", "sensor.cx", numbers=range(3))
    between = Term("detect.u", "radius", "linear"), Term("detect.v", "row", "linear")
    terms = images[0], between[0], images[1], between[1], images[2]

    def columns(*terms):
        effect = Effect("effect", terms, *course, scope=Scope(camera=("cam",)))
        (factor,) = board_recording().true_scene().with_effects((effect,), (16, 4)).network.pixels
        return np.asarray(factor.pattern)[:, : effect.n_columns]

    alone = np.concatenate([columns(term) for term in terms], axis=1)
    np.testing.assert_array_equal(columns(*terms), alone)
    assert len(np.unique(alone, axis=1).T) == len(terms)


def test_each_mark_has_its_own_column():
    table = np.zeros((3, len(OBSERVATION_DRIVERS)))
    table[:, OBSERVATION_DRIVER_INDEX["mark"]] = [4.0, 5.0, 6.0]
    terms = each("mark", "target.point_z", numbers=range(4, 7))
    columns = [np.asarray(patterns([term], table)[:, 0]) * term.weight for term in terms]
    np.testing.assert_allclose(columns, np.eye(3), atol=1e-15)


def test_a_face_is_a_target_as_one_camera_sees_it():
    scene = parted_scene()
    scope = first_names()["hand-over-plate"].scope
    rows = scene.tables[0]
    obs = scene.recording.observations
    names = [c.name for c in scene.model.cameras], [t.name for t in scene.model.targets]
    own = (obs.camera[rows] == names[0].index(*scope.camera)) & (
        obs.target[rows] == names[1].index(*scope.target)
    )
    assert own.any() and np.array_equal(in_scope(scene, scope, rows), own)


def test_cameras_stand_along_their_beam():
    station = np.array([0, 0, 1, 0, 2, 2])
    place = np.zeros((6, 3))
    place[:, 1] = [0.2, 0.6, 5.0, 0.3, 1.0, 1.0]
    places = along_beam(station, place)
    expected = [-1.0, 1.0, np.nan, -0.5, np.nan, np.nan]  # alone; two in one place
    assert np.allclose(places, expected, equal_nan=True) or np.allclose(
        places, -np.array(expected), equal_nan=True
    )


def test_bodies_are_compared_with_the_air():
    recorded = {"ambient_degC": np.array([1.0, 2.0]), "body_left_degC": np.array([4.0, 7.0])}
    channels = build_channels(np.array([0.0, 1.0]), recorded, None, {})
    name = "body_left_degC - ambient_degC"
    assert channels.kinds[channels.index(name)] == "difference"
    assert np.asarray(channels.values[channels.index(name)]).tolist() == [3.0, 5.0]
    assert channel_kind(name) == "temperature"


# --- materials ------------------------------------------------------------------------------------


def test_materials_of_an_expansion():
    assert materials_for(23.4, 0.6)[0] == "aluminium"
    assert materials_for(23.4, 0.0) == ["aluminium"]
    assert materials_for(11.9, 0.1) == ["steel", "concrete"]
    assert materials_for(1.2, 0.1)[:2] == ["Invar", "CFRP"]
    assert materials_for(-30.0, 1.0) == materials_for(300.0, 10.0) == []
    # Nothing is ruled out by a measurement that says nothing.
    assert set(materials_for(20.0, 1000.0)) == set(MATERIALS)
    assert all(low < high for low, high in MATERIALS.values())


def test_length_of_a_bracket():
    assert length_of(-2.325e-6, "aluminium") == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("entry", "driver", "value", "std", "words"),
    [
        ("target-expansion", "plate_degC", 23.4e-6, 0.6e-6, "aluminium"),
        ("target-expansion", "plate_degC", 23.4e-6, float("nan"), "aluminium"),
        ("target-expansion", "plate_degC", 300e-6, 1e-6, ""),
        ("target-expansion", "sun_W_m2", 23.4e-6, 0.6e-6, ""),
        ("bracket-growth", "ambient_degC", -2.325e-6, 1e-8, "as 100 mm of aluminium or 194 mm of"),
        ("focal-drift", "body_degC", 23.4e-6, 0.6e-6, ""),
    ],
)
def test_words_of_a_substance(entry, driver, value, std, words):
    named = BY_ID[entry]
    effect = Effect(named.physics, named.groups[-1], driver, "linear", catalogue_id=entry)
    said = substance(effect, parameters(replace(effect, amplitudes=(value,)), (std,)))
    assert said.startswith(words) and bool(said) == bool(words)


def test_light_that_enters_a_foil_has_the_pattern_of_its_entry():
    """Snell: the way within goes with 1 / sqrt(1 - (sin i / n)^2) at the angle of incidence i."""
    (terms,) = BY_ID["range-penetration"].groups
    incidence = np.linspace(0.0, np.radians(60.0), 50)
    drivers = np.zeros((50, len(OBSERVATION_DRIVERS)))
    drivers[:, list(OBSERVATION_DRIVERS).index("incidence")] = incidence
    columns = np.hstack([patterns((term,), drivers) for term in terms])
    for index in (1.33, 1.5, 1.7):
        within = 1.0 / np.sqrt(1.0 - (np.sin(incidence) / index) ** 2)
        left = within - columns @ np.linalg.lstsq(columns, within, rcond=None)[0]
        assert np.abs(left).max() < 0.05 * np.ptp(within)
