"""The harness itself: the projection, the names, the places, the intervals."""

import json
from types import SimpleNamespace

import jax
import numpy as np
import pooled
import pytest
from judge import _sizes, claims, covered, judge
from names import Facts, same_name, same_place
from power import facts_of, plain_fit, shown, whitened
from scipy.integrate import solve_ivp
from tally import failures, figures, odds_of_noise, wilson
from world import EFFECTS, heat, record
from world.effect import Site

from jaxvm.discover.cells import arrange
from jaxvm.discover.courses import Course
from jaxvm.discover.curved import with_curved
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import refit
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.physics.effects import Scope, Term
from jaxvm.recording import join, read_recording
from jaxvm.simulate import simulate_deformation_scene
from jaxvm.solve.snooping import robust_variance


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small recording, and the change that its hidden slip makes."""
    folder = tmp_path_factory.mktemp("small")
    made = {}
    for name, hide in (("plain", ()), ("slip", ("mount-slip",))):
        scene = simulate_deformation_scene(hide, seed=3, size="small")
        made[name] = read_recording(scene.write(folder / name))
    plain, slip = made["plain"].observations, made["slip"].observations
    assert np.array_equal(plain.point, slip.point)  # same seed, same noise, same marks missed
    # Rounding of the tables leaves 1e-4 px.
    change = slip.pixel - plain.pixel, np.zeros(len(made["slip"].ranges.distance))
    return made["slip"], change


def test_projection_against_dense(small):
    recording, change = small
    base, _ = plain_fit(recording)
    arrangement = arrange(base)
    e = whitened(base, arrangement.components, *change)
    square = np.sum(arrangement.cells.projected(arrangement.in_cells(e)) ** 2)

    problem = base.problem
    jacobian = jax.jacfwd(lambda x: jax.tree.leaves(problem.residual(x)))(base.x)
    n_real = [f.n_real for f in problem.network.factors()]
    dense = np.concatenate(
        [np.asarray(j)[:n].reshape(-1, problem.n) for j, n in zip(jacobian, n_real, strict=False)]
    )
    pixels = 2 * len(recording.observations.epoch)
    vector = np.zeros(len(dense))
    vector[:pixels] = e[: pixels // 2].ravel()
    basis, values, _ = np.linalg.svd(dense, full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]]
    expected = np.sum((vector - basis @ (basis.T @ vector)) ** 2)
    assert square == pytest.approx(expected, rel=1e-6)
    assert 0.0 < square < np.sum(e**2)


def test_power_names_what_was_hidden(small):
    recording, change = small
    found = shown(recording, change, [change], {"type": "white"})
    own = found.effects[0]
    assert own.expected_drop > 50.0
    # A slip is a hypothesis of the catalogue: it takes all of its own drop.
    assert own.drops["mount-slip"] == pytest.approx(own.expected_drop, rel=0.02)
    assert all(drop < 1.001 * own.expected_drop for drop in own.drops.values())
    assert 0.04 < found.floor_px < 0.06
    assert facts_of(plain_fit(recording)[0].scene).station_of["left"] == "mast"


FACTS = Facts(
    {"camera": ("l", "r"), "station": ("s",), "target": ("a", "b"), "rangefinder": ("f",)},
    {"l": "s", "r": "s", "f": "s"},
    600.0,
    0.0,
    False,
    {"a": ("l",), "b": ("l", "r")},
)


def test_names():
    assert same_name({"rows": [59]}, [62], FACTS)
    assert not same_name({"rows": [25, 76]}, [51, 76], FACTS)  # both lag: no common name
    assert not same_name({"rows": [4]}, [56], FACTS)  # two targets
    turn = {"rows": [25], "where": {"camera": ["l"]}}
    assert not same_name(turn, [11], FACTS)
    alone = Facts({**FACTS.names, "camera": ("l",)}, FACTS.station_of, 600.0, 0.0, False)
    assert same_name(turn, [11], alone)


@pytest.mark.parametrize(
    ("true", "claimed", "same"),
    [
        ({"camera": ["l"]}, {"camera": ["l"]}, True),
        ({"camera": ["l"]}, {"camera": ["r"]}, False),
        ({"camera": ["l", "r"]}, {}, True),
        ({"camera": ["l"]}, {}, False),
        ({"rangefinder": ["f"]}, {}, True),
        ({"station": ["s"]}, {"camera": ["l", "r"]}, True),
        ({"station": ["s"]}, {"camera": ["l"]}, False),
        ({"target": ["a"], "point": ["p3"]}, {"target": ["a"], "point": ["p3"]}, True),
        ({"target": ["a"], "point": ["p3"]}, {"target": ["a"]}, False),
        ({"target": ["a"]}, {"camera": ["l"]}, False),
        ({"target": ["a"], "camera": ["l"]}, {"target": ["a"]}, True),
        ({"target": ["b"], "camera": ["l"]}, {"target": ["b"]}, False),
        ({"target": ["b"], "camera": ["l"]}, {"target": ["b"], "camera": ["l"]}, True),
    ],
)
def test_places(true, claimed, same):
    assert same_place({"where": true}, claimed, FACTS) is same


def test_wilson():
    # Newcombe 1998, table I: 81 of 263.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)


def test_what_noise_leaves_to_the_right_one_of_two():
    rng = np.random.default_rng(0)
    for gap in (1.0, 6.0, 20.0):
        # The other hypothesis is off by a vector of length sqrt(gap), in white noise.
        noise, other = rng.normal(size=(20_000, 3)), np.array([np.sqrt(gap), 0.0, 0.0])
        right = np.sum(noise**2, axis=1) < np.sum((noise - other) ** 2, axis=1)
        assert np.mean(right) == pytest.approx(odds_of_noise(gap), abs=0.01)


@pytest.mark.parametrize(("rival", "decided"), [(380.0, True), (393.5, False)])
def test_names_of_one_hypothesis_decide_nothing(rival, decided):
    drops = {"mount-slip": 394.0, "tripod-settles": rival}
    power = SHOWN["effects"][0] | {"drops": drops, "evidence": drops}
    rows = ROWS | {"tripod-settles": (34,)}
    (effect,) = judge(ENTRY, REPORT, SHOWN | {"effects": [power]}, rows.get)["effects"]
    assert effect["decidable"] and effect["decidable_by_names"] is decided


HIDDEN = {
    "effect": "slip",
    "rows": [29],
    "outside": False,
    "where": {"camera": ["l"]},
    "when": "from",
    "t0_s": 3000.0,
    "values": {"mount.turn_y": 1e-4},
}
REPORT = {
    "verdict": "explained",
    "seconds": 10.0,
    "plain": {"heldout_rms_px": 0.08},
    "final": {"heldout_rms_px": 0.05},
    "findings": [
        {
            "catalogue_id": "mount-slip",
            "physics": "the mount slips",
            "named": True,
            "rows": [29],
            "where": {"camera": ["l"]},
            "form": "step",
            "weight": 0.99,
            "parameters": [
                {"name": "mount.turn_y", "port": "mount.turn_y", "value": 1.1e-4, "std": 1e-5},
                {"name": "instant", "value": 3300.0, "std": 0.0, "unit": "s"},
            ],
            "equivalents": [],
        }
    ],
}
SHOWN = {
    "effects": [
        {
            "expected_drop": 400.0,
            "seen": 0.5,
            "rms_px": 0.1,
            "drops": {"mount-slip": 399.0},
            "evidence": {"mount-slip": 390.0},
        }
    ],
    "floor_px": 0.05,
    "variance": 1.0,
    "facts": vars(FACTS),
}

ENTRY = {"id": "r0000", "kind": "one", "hidden": [HIDDEN], "noise": {"type": "white"}}
ROWS = {"mount-slip": (29,)}


def test_judge():
    row = judge(ENTRY, REPORT, SHOWN, ROWS.get)
    effect = row["effects"][0]
    assert effect["in_set"] and effect["first"] and effect["place_right"]
    assert effect["decidable"] and effect["reason"] == ""
    assert effect["z"] == [pytest.approx(1.0)]
    assert row["floor_ratio"] == pytest.approx(1.0)
    late = json.loads(json.dumps(REPORT))
    late["findings"][0]["parameters"][1]["value"] = 4000.0
    row = judge(ENTRY, late, SHOWN, ROWS.get)
    assert not row["effects"][0]["place_right"]
    assert "wrong instant" in row["effects"][0]["reason"]
    empty = judge(ENTRY | {"kind": "nothing", "hidden": []}, REPORT, SHOWN | {"effects": []})
    assert empty["false_claim"]


def test_claims_and_intervals():
    finding = dict(REPORT["findings"][0], equivalents=[{"rows": [51], "where": {}, "weight": 0.01}])
    assert [claim["rows"] for claim in claims(finding)] == [[29], [51]]
    assert covered(1.0) and not covered(-2.0)


def test_a_size_that_is_far_off_is_told():
    right = judge(ENTRY, REPORT, SHOWN, ROWS.get)
    (effect,) = right["effects"]
    assert effect["first"] and not [text for text in failures([right]) if "size off" in text]
    wrong = right | {"effects": [effect | {"z": [-3.21, 0.4]}]}
    (told,) = [text for text in failures([wrong]) if "size off" in text]
    assert told.endswith("size off by -3.2 standard deviations")
    by_number = {figure.number: figure for figure in figures([wrong])}
    assert by_number["9"].value == 0.5
    assert by_number["9c"].value == pytest.approx(0.5 * (3.21 + 0.4))


def test_shares_of_several_seeds_add_up(tmp_path, monkeypatch):
    monkeypatch.setattr(pooled, "SEEDS", tmp_path)
    for seed, value, cases in (("1", "90.0", 10), ("2", "97.5", 40)):
        (tmp_path / seed).mkdir()
        row = f"| 1 | right physics | {value} % | 80 % – 99 % | {cases} | at least 97 % | no |"
        (tmp_path / seed / "results.md").write_text(f"# Table\n\n{row}\n", encoding="utf-8")
    assert pooled.shares("2") == {"1": ("right physics", 39, 40)}
    assert "| 90.0 % of 10 | 97.5 % of 40 | 96.0 % of 50 |" in pooled.markdown(["1", "2"])
    told = "9 of 12 findings that were promised"
    (tmp_path / "1" / "follow.md").write_text(f"# Advice\n\n{told}\n", encoding="utf-8")
    assert pooled.advice("1") == (9, 12) and pooled.advice("2") is None


def test_sizes_of_vectors_and_waves():
    def deviation(port, true, parameters, where=None):
        finding = {"rows": [32], "where": where or {}, "parameters": parameters}
        own = {"rows": [32], "driver": "", "values": {port: true}}
        return _sizes(own, finding, FACTS)["z"]

    wave = [
        {"name": "mount.turn_x, sine", "port": "mount.turn_x", "value": 3.0, "std": 0.1},
        {"name": "mount.turn_x, cosine", "port": "mount.turn_x", "value": 4.0, "std": 0.1},
    ]
    assert deviation("mount.turn_x", -4.9, wave) == [pytest.approx(1.0)]
    mark = [
        {"name": f"target.point_{a}", "port": f"target.point_{a}", "value": v, "std": 0.1}
        for a, v in (("x", 0.0), ("y", 1.0))
    ]
    assert deviation("target.point", 0.9, mark) == [pytest.approx(1.0)]
    turn = [{"name": "station.turn_z", "port": "station.turn_z", "value": 1.0, "std": 0.5}]
    assert deviation("mount.turn_z", 2.0, turn, {"station": ["s"]}) == [pytest.approx(-2.0)]
    lags = [{**wave[0], "name": "mount.turn_x, lag"}, {**wave[1], "name": "mount.turn_x, slow lag"}]
    assert deviation("mount.turn_x", 1.0, lags) == []


def test_only_like_sizes_are_compared():
    size = {"port": "target.scale_y", "name": "target.scale_y", "value": -2.1e-4, "std": 1e-5}
    truth = {
        "rows": [4], "driver": "constant", "where": {"target": ["plate"]},
        "values": {"target.scale_x": 1e-4, "target.scale_y": -1e-4},
    }  # fmt: skip
    finding = {"driver": "constant", "where": {"target": ["plate"]}, "parameters": [size]}
    # One scale alone is that of a free common scale: it stands for the difference.
    assert _sizes(truth, finding, FACTS)["z"] == [pytest.approx(-1.0)]
    elsewhere = {**finding, "where": {"target": ["body"]}}
    assert "another place" in _sizes(truth, elsewhere, FACTS)["not_compared"]
    other = {**finding, "driver": "body_a_degC - ambient_degC"}
    warm = {**truth, "driver": "body_a_degC"}
    assert "other driver" in _sizes(warm, other, FACTS)["not_compared"]


def test_a_size_is_compared_with_a_rate_only_where_the_key_tells_its_end():
    size = {"port": "mount.turn_x", "name": "mount.turn_x", "value": 1.1e-6, "std": 1e-7}
    where = {"camera": ["left"]}
    ramp = {"driver": "time", "form": "ramp", "where": where, "parameters": [size]}
    grown = {
        "rows": [28], "driver": "time", "where": where, "values": {"mount.turn_x": 1e-4},
        "constants": {"t0_s": 20.0, "end_s": 120.0},
    }  # fmt: skip
    assert _sizes(grown, ramp, FACTS)["z"] == [pytest.approx(1.0)]
    settled = {**grown, "constants": {"t0_s": 20.0, "tau_s": 14.0}}
    assert _sizes(settled, ramp, FACTS)["z"] == []
    assert _sizes(grown, {**ramp, "form": "settling"}, FACTS)["z"] == []
    assert len(_sizes(settled, {**ramp, "form": "settling"}, FACTS)["z"]) == 1


def test_what_warms_up_fades_with_the_other_sign():
    """a (1 - exp(-s / tau)) and -a exp(-s / tau) differ by what never changes."""
    size = {"port": "sensor.focal", "name": "sensor.focal", "value": 6.2e-4, "std": 1e-5}
    where = {"camera": ["left"]}
    fades = {
        "driver": "time since power-on of left", "form": "fading", "where": where,
        "parameters": [size],
    }  # fmt: skip
    warms = {
        "rows": [52], "driver": "power-on", "where": where, "values": {"sensor.focal": -6.3e-4},
        "constants": {"tau_s": 900.0},
    }  # fmt: skip
    assert _sizes(warms, fades, FACTS)["z"] == [pytest.approx(-1.0)]
    onset = {**fades, "form": "onset", "parameters": [{**size, "value": -6.2e-4}]}
    assert _sizes(warms, onset, FACTS)["z"] == [pytest.approx(1.0)]
    # What the key itself gives as fading has two time constants.
    two = {**warms, "values": {"sensor.focal": 6.3e-4}, "constants": {"tau_s": 9.0, "tau2_s": 1.0}}
    assert _sizes(two, fades, FACTS)["z"] == [pytest.approx(-1.0)]


@pytest.mark.parametrize("tau", [4.0, 45.0, 2000.0])
def test_lags_of_the_world_are_the_differential_equation(tau):
    t = heat.STEP * np.arange(60)
    x = 3.0 + np.sin(t / 70.0)
    exact = solve_ivp(
        lambda at, y: (np.interp(at, t, x) - y) / tau, t[[0, -1]], x[:1], "LSODA", t,
        max_step=2.0, rtol=1e-9, atol=1e-11,
    )  # fmt: skip
    np.testing.assert_allclose(heat.lagged(x, tau), exact.y[0], atol=2e-6)


def test_a_tilted_sensor_keeps_lines_straight_and_cross_ratios():
    """A homography: points of a line stay on one, and their cross ratio stays what it was."""
    scene = SimpleNamespace(kind="wide", cameras=[SimpleNamespace(name="camera")])
    site = Site(scene, np.random.default_rng(4), [0], 0, 0, 0)
    hook = EFFECTS["sensor-tilted"].draw(site).hooks(0.05)["lens"]
    at = np.array([-0.9, -0.2, 0.4, 1.1])
    line = np.array([0.1, -0.3]) + at[:, None] * [0.8, 0.6]
    view = SimpleNamespace(rows=SimpleNamespace(camera=np.zeros(4, int)), t=np.zeros(4))
    moved = hook(view, line)
    assert np.abs(moved - line).max() > 0.02
    way = moved[-1] - moved[0]
    along = (moved - moved[0]) @ way / (way @ way)
    np.testing.assert_allclose(moved, moved[0] + along[:, None] * way, atol=1e-12)

    def cross_ratio(a, b, c, d):
        return (c - a) * (d - b) / ((c - b) * (d - a))

    assert cross_ratio(*along) == pytest.approx(cross_ratio(*at), rel=1e-12)


@pytest.mark.parametrize("kind", ["board", "wide"])
def test_a_second_camera_shares_the_target_and_not_the_lens(kind, tmp_path):
    """Of one make, at another place; the recordings with and without it join."""
    for effect, shared in (("lens-radial-residue", False), ("target-bow", True)):
        first = record(kind, 5, (effect,))
        second = record(kind, 5, (effect,), plan="camera")
        assert len(first.scene.cameras) == 1 and len(second.scene.cameras) == 2
        sizes = np.abs(second.change["pixels"]).max(axis=1)
        own, aside = (sizes[second.rows.camera == k].max() for k in (0, 1))
        # Only shares of a lens's errors differ between the recordings, by the poses of the board.
        assert own == pytest.approx(np.abs(first.change["pixels"]).max(), rel=0.5)
        assert aside > 0.3 * own if shared else aside == 0.0
    one, other = second.scene.cameras
    middle = np.mean(second.scene.targets[0].shift, axis=0)
    ways = [middle - camera.shift for camera in (one, other)]
    angle = np.arccos(ways[0] @ ways[1] / np.prod(np.linalg.norm(ways, axis=1)))
    assert np.radians(25.0) < angle < np.radians(55.0)
    for name, made in (("first", first), ("second", second)):
        made.write(tmp_path / name)
    both = join(*(read_recording(tmp_path / name) for name in ("first", "second")))
    assert [camera.name for camera in both.model.cameras] == ["camera", "second"]
    assert "pose" in both.model.cameras[1].free


def test_a_dome_is_measured_though_its_tangent_hides_it(tmp_path):
    """The lens, the middle of the image and the board's poses take up pixels of it.

    What is left is of the second order: the scores see a small part, a fit sees all of it.
    """
    made = record("wide", 662945752, ("dome-off-centre",))
    (hidden,) = made.truth["hidden"]
    made.write(tmp_path / "dome")
    base, parts = plain_fit(read_recording(tmp_path / "dome"))
    tests = ScoreTests.of(base, enumerate_hypotheses(base.scene))
    ranking = tests.score(robust_variance(base))
    always = Course("constant", "constant")
    place = Scope(camera=("camera",))
    skew = Hypothesis(Group((Term("sensor.skew"),), "camera"), always, place, ())
    (dome, *_), _ = with_curved([(skew, 1.0, np.zeros(1))], ranking, base.scene)
    found = refit(base, dome, np.zeros(3), parts)
    drop = 2.0 * (base.cost - found.adjustment.cost)
    foretold = max(
        float(scores.drop[g].max())
        for scores in ranking.scores
        for g, group in enumerate(scores.family.groups)
        if group.terms == dome.group.terms
    )
    assert foretold < 0.2 * drop
    assert found.adjustment.variance_factor < base.variance_factor
    # Half of the offset is along the axis, in the simulated dome of another radius and glass.
    across, along = np.linalg.norm(found.amplitudes[:2]), found.amplitudes[2]
    assert along == pytest.approx(0.5 * across, rel=0.3)
    assert across == pytest.approx(abs(hidden["size"]), rel=0.5)
