"""The page of an adjusted network: its numbers against direct computations, and its content."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import networkx as nx
import numpy as np
import pytest
from networks import (
    Known,
    adjusted,
    board_recording,
    matrix,
    opencv_pixels,
    stereo_recording,
    twist_matrix,
    vector,
)
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxvm.network.scene import build
from jaxvm.recording.model import Model, Station
from jaxvm.recording.recording import Links, Recording, no_observations, uncorrelated
from jaxvm.report.network import network_document, variance_bounds, write_network_page
from jaxvm.report.network_graph import body_graph
from jaxvm.report.network_view import first_axes, first_scale, network_view, semi_axes
from jaxvm.report.network_words import angle, length, number
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import pose_covariances, standard_deviations
from jaxvm.solve.snooping import redundancy

NASTY = "</script><b>&\"'<!--"


def linked(edges, n, seed=0, names=None, sigma=(1e-3, 2e-3), held=(0,), weights=None):
    """Stations at random places joined by links with noise, adjusted; weight 0: rejected."""
    rng = np.random.default_rng(seed)
    poses = np.concatenate([rng.uniform(-0.5, 0.5, (n, 3)), rng.uniform(-5, 5, (n, 3))], axis=1)
    names = names or [f"s{i}" for i in range(n)]
    spread = np.repeat(sigma, 3)
    measured = [
        vector(
            np.linalg.inv(matrix(poses[a]))
            @ matrix(poses[b])
            @ np.linalg.inv(twist_matrix(spread * rng.standard_normal(6)))
        )
        for a, b in edges
    ]
    m = len(edges)
    links = Links(
        tuple(f"{names[a]}-{names[b]}" for a, b in edges),
        [("station", a) for a, _ in edges],
        [("station", b) for _, b in edges],
        np.array(measured).reshape(-1, 6),
        uncorrelated(np.full(m, sigma[0]), np.full(m, sigma[1])),
        np.full(m, -1),
    )
    free = frozenset({"pose"})
    stations = tuple(
        Station(names[i], "static", poses[i], frozenset() if i in held else free) for i in range(n)
    )
    recording = Recording(
        Model("network", (), stations, ()), np.zeros(1, int), np.zeros(1), {}, no_observations(),
        links=links, timed=False,
    )  # fmt: skip
    return adjust(build(recording), link_weights=weights)


EDGES = [(0, 1), (1, 2), (2, 0), (2, 3), (3, 4), (4, 2), (4, 5)]
"""Two triangles that share a node, and a tail."""


@pytest.fixture(scope="module")
def small():
    return linked(EDGES, 6)


def turn_covariance(pose, covariance):
    """Covariance of a turn about world axes, from that of a rotation vector, by differences."""
    base, jacobian = Rotation.from_rotvec(pose[:3]), np.zeros((3, 3))
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        ahead, back = (Rotation.from_rotvec(pose[:3] + s * step) for s in (1, -1))
        jacobian[:, k] = ((ahead * base.inv()).as_rotvec() - (back * base.inv()).as_rotvec()) / 2e-6
    return jacobian @ covariance[:3, :3] @ jacobian.T


def test_numbers_are_those_computed_directly(small):
    told = network_document(small)
    assert told == json.loads(json.dumps(told, allow_nan=False))
    a = told["adjustment"]
    assert (a["stations"], a["links"], a["nodes"], a["parts"]) == (6, 7, 6, 1)
    assert a["conditions"] == 6 * (7 - 6 + 1) == small.degrees_of_freedom
    assert a["held"] == ["s0"] and a["conditions_of_further_held"] == 0
    low, high = a["variance_factor_bounds_95"]
    f = small.degrees_of_freedom
    assert chi2.cdf(f * low, f) == pytest.approx(0.025)
    assert chi2.cdf(f * high, f) == pytest.approx(0.975)
    assert a["variance_factor"] == pytest.approx(2 * small.cost / f)

    spread = pose_covariances(small)
    poses = np.array(small.scene.state.world_from_station)
    for k, body in enumerate(told["bodies"]):
        np.testing.assert_allclose(
            body["position_std_m"], np.sqrt(np.diag(spread[k])[3:]), rtol=1e-6, atol=1e-12
        )
        worst = np.sqrt(np.linalg.eigvalsh(spread[k][3:, 3:]).max())
        assert body["position_std_max_m"] == pytest.approx(worst, rel=1e-6, abs=1e-12)
        turn = np.linalg.eigvalsh(turn_covariance(poses[k], spread[k])).max()
        assert body["turn_std_max_rad"] == pytest.approx(np.sqrt(max(turn, 0)), rel=1e-5, abs=1e-9)
    peer = nx.MultiGraph(EDGES)
    far = nx.single_source_shortest_path_length(peer, 0)
    assert [b["distance_edges"] for b in told["bodies"]] == [far[i] for i in range(6)]

    cut = {tuple(sorted(e)) for e in nx.bridges(nx.Graph(EDGES))}
    for edge, ends, own in zip(told["edges"], EDGES, redundancy(small)[0], strict=True):
        assert (edge["from"], edge["to"]) == ends
        assert edge["bridge"] == (tuple(sorted(ends)) in cut)
        assert edge["redundancy"] == pytest.approx(np.trace(own) / 6, abs=1e-6)
        assert edge["turn_std_max_rad"] == pytest.approx(1e-3)
        assert edge["shift_std_max_m"] == pytest.approx(2e-3)
    assert 6 * sum(e["redundancy"] for e in told["edges"]) == pytest.approx(f, abs=1e-5)
    assert [w["edge"] for w in told["weak_edges"]] == [6]
    assert "nothing checks" in told["weak_edges"][0]["words"] and not told["unobservable"]


def test_cycles_and_links_are_tested(small):
    told = network_document(small)
    assert len(told["cycles"]) == 2
    links = small.scene.recording.links
    for cycle in told["cycles"]:
        product = np.eye(4)
        for edge, sign in zip(cycle["edges"], cycle["signs"], strict=True):
            pose = matrix(links.pose[edge])
            product = product @ (pose if sign > 0 else np.linalg.inv(pose))
        turn = np.linalg.norm(Rotation.from_matrix(product[:3, :3]).as_rotvec())
        assert cycle["turn_rad"] == pytest.approx(turn, rel=1e-9)
        assert cycle["p_value"] == pytest.approx(chi2.sf(cycle["statistic"], 6))
        assert cycle["deviations"] ** 2 == pytest.approx(cycle["statistic"])
        assert set(cycle["bodies"]) in ({0, 1, 2}, {2, 3, 4})
        # Three like edges: two thirds of the condition fall on the two of the tree.
        assert cycle["effective"] and "67 % of its condition falls on the best" in cycle["effect"]
    statistics = [cycle["statistic"] for cycle in told["cycles"]]
    assert statistics == sorted(statistics, reverse=True)
    # Two separate triangles: each alone makes the residuals of its links; the cost is their sum.
    assert sum(statistics) == pytest.approx(2 * small.cost, rel=1e-3)
    tests = {test["edge"]: test for test in told["link_tests"]}
    assert tests[6]["checked"] == 0 and tests[6]["p_value"] == 1.0
    assert all(tests[k]["checked"] == 6 for k in range(6))
    # In a cycle of its own the residual of a link tests nothing but the cycle.
    triangle = next(c for c in told["cycles"] if 0 in c["edges"])
    assert tests[0]["statistic"] == pytest.approx(triangle["statistic"], rel=1e-3)


def test_sight_lines_are_poses_with_the_covariance_of_their_points():
    known = stereo_recording(noise=0.0)
    found = adjust(known.true_scene())
    bodies = body_graph(found)
    scene, obs = found.scene, found.scene.recording.observations
    k = int(np.flatnonzero(bodies.sight)[0])
    camera, target, epoch = bodies.views[bodies.source[k]]
    body = scene.model.cameras[camera]
    places = [s.name for s in scene.model.stations]
    row = scene.station_row[places.index(body.station), epoch]
    world_from_station = matrix(scene.state.world_from_station[row])
    mount = matrix(scene.state.station_from_camera[camera])
    seen = matrix(scene.world_from_targets(np.array([target]), np.array([epoch]))[0])
    station_from_target = np.linalg.inv(world_from_station) @ seen
    measured = matrix(bodies.graph.pose[k])
    np.testing.assert_allclose(measured, station_from_target, atol=1e-7)

    rows = np.flatnonzero((obs.camera == camera) & (obs.target == target) & (obs.epoch == epoch))
    points = np.asarray(scene.state.point)[scene.first_point[target] + obs.point[rows]]
    body = replace(
        body,
        focal_px=np.asarray(scene.state.focal[camera]),
        centre_px=np.asarray(scene.state.centre[camera]),
        distortion=np.asarray(scene.state.distortion[camera]) if body.lens != "fisheye" else None,
    )
    jacobian = np.zeros((2 * len(rows), 6))
    for j in range(6):
        step = np.zeros(6)
        step[j] = 1e-6
        ahead, back = (
            opencv_pixels(body, world_from_station @ mount, seen @ twist_matrix(s * step), points)
            for s in (1, -1)
        )
        jacobian[:, j] = ((ahead - back) / 2e-6 / obs.sigma[rows][:, None]).ravel()
    expected = np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(
        bodies.graph.covariance[k], expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max()
    )


def test_redundancies_of_sight_lines_add_up_to_the_conditions():
    """Held intrinsics and mounts: poses of views are all that the image points say of bodies."""
    known = stereo_recording()
    model = known.recording.model
    model = replace(
        model,
        cameras=tuple(replace(camera, free=frozenset()) for camera in model.cameras),
        targets=tuple(replace(t, free=t.free - {"points"}) for t in model.targets),
        priors=(), rangefinders=(),
    )  # fmt: skip
    recording = replace(known.recording, model=model, ranges=None, links=None, drivers=None)
    found = adjust(Known(recording, known.truth).true_scene())
    told = network_document(found)
    assert 6 * sum(e["redundancy"] for e in told["edges"]) == pytest.approx(
        told["adjustment"]["conditions"] + told["adjustment"]["conditions_of_further_held"],
        abs=1e-4,
    )


def test_a_moving_body_is_one_node_with_a_trace():
    known = board_recording()
    found = adjust(known.true_scene())
    bodies, told = body_graph(found), network_document(found)
    n = len(known.recording.time)
    board = told["bodies"][1]
    assert (board["kind"], board["name"], board["poses"]) == ("target", "board", n)
    assert told["adjustment"]["nodes"] == n + 1 and len(told["edges"]) == n
    assert board["worst_epoch"] in known.recording.epoch_ids
    view = network_view(bodies, told)
    assert view["a"] == [0] and view["b"] == [1] and view["count"] == [n]
    (trace,) = view["traces"]["of"]
    course = np.reshape(trace["points"], (-1, 3))
    poses = np.asarray(found.scene.state.carrier_from_target)[:, 3:]
    np.testing.assert_allclose(
        course - course[0], view["traces"]["enlarged"] * (poses - poses[0]), atol=1e-4
    )
    largest = max(b["position_std_max_m"] for b in told["bodies"])
    spread = pose_covariances(found, "carrier_from_target")[:, 3:, 3:]
    assert largest == pytest.approx(np.sqrt(np.linalg.eigvalsh(spread).max()), rel=1e-6)


def test_relay_with_links_and_sight_lines(tmp_path):
    _, found = adjusted("relay")
    told = network_document(found)
    kinds = {(body["kind"], body["name"]) for body in told["bodies"]}
    assert {("station", f"s{i}") for i in range(3)} | {
        ("target", f"t{i}") for i in range(3)
    } == kinds
    assert told["adjustment"]["links"] == 5 and told["adjustment"]["sight_lines"] == 6
    # Links of cameras join their stations; their own poses are those of the stations' product.
    link = next(e for e in told["edges"] if e["name"] == "c20")
    assert (link["from"], link["to"]) == (2, 0)
    assert write_network_page(found, tmp_path).is_file()


class Tags(HTMLParser):
    """Tags, attributes and texts of a page."""

    def __init__(self, page: str):
        super().__init__()
        self.tags, self.attributes, self.text, self.scripts = [], [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag == "script":
            self.scripts.append("")
        self.attributes += [(tag, *attribute) for attribute in attrs]

    def handle_data(self, data):
        if self.tags and self.tags[-1] == "script" and self.cdata_elem == "script":
            self.scripts[-1] += data
        else:
            self.text.append(data)


def test_page_holds_all_that_it_needs(tmp_path):
    small = linked(EDGES, 6, weights=np.arange(len(EDGES)) > 0)
    page = write_network_page(
        small, tmp_path, {"SPGD": (np.arange(1, 4), [9.0, 5.0, small.cost])}, "a method"
    )
    text = page.read_text()
    assert page == tmp_path / "network.html" and "http" not in text and "@import" not in text
    for tag, name, value in Tags(text).attributes:
        if name in ("src", "href", "srcset", "action", "data", "xlink:href"):
            assert value.startswith(("data:", "#")), (tag, name, value)
    assert not re.search(r"url\((?!#)", text)
    told = json.loads((tmp_path / "network.json").read_text())
    assert told["rejected"] == [{"name": "s0-s1", "from": 0, "to": 1}]
    assert told["adjustment"]["links"] == 6 and [e["name"] for e in told["edges"]][0] == "s1-s2"
    assert [c["method"] for c in told["convergence"]] == ["a method", "SPGD"]
    assert "SPGD" in text and "variance factor" in text and text.count("<svg class") == 3


def test_names_are_text_in_the_page_and_in_its_data(tmp_path):
    names = [NASTY + str(i) for i in range(3)]
    found = linked([(0, 1), (1, 2), (2, 0)], 3, names=names, weights=np.array([0.0, 1.0, 1.0]))
    method = "method " + NASTY
    text = write_network_page(found, tmp_path, {NASTY: ([1, 2], [2.0, 1.0])}, method).read_text()
    parsed = Tags(text)
    assert NASTY not in text and parsed.tags.count("b") == text.count("<b>")
    assert "-->" not in text and "<!--" not in text
    data, program = parsed.scripts
    assert json.loads(data)["names"] == names and "</" not in program
    shown = "".join(parsed.text)
    assert (
        f"station {names[0]}" in shown
        and method in shown
        and f"Rejected: {names[0]}-{names[1]}" in shown
    )
    assert shown.count(names[1]) >= 2


def test_empty_and_broken_networks_have_a_page(tmp_path):
    chain = linked([(0, 1), (1, 2)], 3)
    told = network_document(chain)
    assert told["cycles"] == [] and told["adjustment"]["conditions"] == 0
    assert told["adjustment"]["variance_factor_bounds_95"] is None
    assert len(told["weak_edges"]) == 2
    text = write_network_page(chain, tmp_path).read_text()
    assert "nothing checks the result" in text and "tr data-cycle" not in text

    apart = linked([(0, 1), (2, 3)], 4, held=(0, 2))
    told = network_document(apart)
    assert told["adjustment"]["parts"] == 2 and told["unobservable"] == []
    document = network_document(linked([(0, 1), (1, 2)], 3, held=(0, 2)))
    # A way between two held stations is a cycle: half of every error shows.
    assert document["weak_edges"] == []
    assert [edge["redundancy"] for edge in document["edges"]] == pytest.approx([0.5, 0.5], abs=0.05)
    both = document["adjustment"]
    assert both["conditions"] == 0 and both["conditions_of_further_held"] == 6
    assert both["conditions_of_further_held"] == both["degrees_of_freedom"]

    # All links rejected: nothing joins anything.
    none = linked([(0, 1), (1, 2)], 3, weights=np.zeros(2))
    told = network_document(none)
    assert told["edges"] == [] and len(told["unobservable"]) == 2
    assert "s1" in told["unobservable"][0]
    assert "s0-s1, s1-s2" in write_network_page(none, tmp_path).read_text()
    assert none.degrees_of_freedom == 0 and none.variance_factor == 1.0
    spread = standard_deviations(none).world_from_station
    assert np.isnan(spread[1:]).all() and (np.asarray(spread[0]) == 0.0).all()
    # What nothing observes has no ellipsoid, and a document without NaN.
    assert told["bodies"][1]["position_std_max_m"] is None


def test_a_free_camera_is_a_body_where_its_station_is_held():
    known, found = adjusted("stereo")
    model = known.recording.model
    assert not found.scene.model.cameras[0].free & {"pose"} and model.cameras[1].free & {"pose"}
    folded = body_graph(found)
    assert folded.n_folded == 1 and all(body.kind != "camera" for body in folded.bodies)

    pose = known.truth["world_from_station"][0]
    held = replace(model.stations[0], pose=pose, free=frozenset(), motion="static")
    recording = replace(known.recording, model=replace(model, stations=(held,)))
    found = adjust(Known(recording, known.truth).true_scene())
    bodies, told = body_graph(found), network_document(found)
    camera = next(body for body in bodies.bodies if body.kind == "camera")
    assert camera.name == "right" and not camera.held and bodies.n_folded == 0
    assert [bodies.bodies[i].name for i in bodies.mounts[0]] == ["right", "bar"]
    mount = np.array(found.scene.state.station_from_camera[1])
    in_world = matrix(pose) @ matrix(mount)
    k = camera.nodes[0]
    np.testing.assert_allclose(matrix(bodies.pose[k]), in_world, atol=1e-9)
    spread, turned = pose_covariances(found, "station_from_camera")[1], matrix(pose)[:3, :3]
    np.testing.assert_allclose(
        bodies.covariance[k][3:, 3:], turned @ spread[3:, 3:] @ turned.T, rtol=1e-6, atol=1e-16
    )
    np.testing.assert_allclose(
        bodies.covariance[k][:3, :3], turned @ turn_covariance(mount, spread) @ turned.T, rtol=1e-4
    )
    assert {e["from"] for e in told["edges"] if e["name"].startswith("right sees")} == {
        [body.name for body in bodies.bodies].index("right")
    }


def test_histories_need_a_cost_for_each_evaluation(small):
    with pytest.raises(ValueError, match='"SPGD" has 2 evaluations and 3 costs'):
        network_document(small, histories={"SPGD": ([1, 2], [1.0, 2.0, 3.0])})
    told = network_document(small, histories={"lost": ([1, 2], [np.nan, 3.0])})
    assert told["convergence"][1]["cost"] == [None, 3.0]


def test_scale_multiplies_covariances(small):
    once, four = (network_document(small, scale=s)["bodies"][3] for s in (1.0, 4.0))
    assert four["position_std_max_m"] == pytest.approx(2 * once["position_std_max_m"])
    assert four["turn_std_rad"] == pytest.approx(2 * np.array(once["turn_std_rad"]))


def test_first_view_shows_the_face_of_a_plane():
    rng = np.random.default_rng(0)
    for turn in rng.uniform(-2, 2, (20, 3)):
        flat = rng.uniform(-1, 1, (40, 3)) * [5.0, 3.0, 0.0]
        axes = first_axes(Rotation.from_rotvec(turn).apply(flat))
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        normal = Rotation.from_rotvec(turn).apply([0.0, 0.0, 1.0])
        assert abs(axes[2] @ normal) > np.cos(np.deg2rad(35))
    for few in (np.zeros((0, 3)), np.zeros((1, 3)), np.array([[0.0, 0, 0], [1, 0, 0]])):
        assert np.isfinite(first_axes(few)).all()
    # A floor plan is seen from above.
    assert first_axes(rng.uniform(-1, 1, (40, 3)) * [5.0, 3.0, 0.01])[2, 2] > 0.7


def test_ellipsoids_and_their_scale():
    spread = np.random.default_rng(1).standard_normal((4, 3, 5))
    spread = spread @ spread.swapaxes(1, 2)
    axes = semi_axes(spread)
    np.testing.assert_allclose(axes.swapaxes(1, 2) @ axes, spread, rtol=1e-9)
    assert first_scale(np.array([1e-3, 1e-3]), 100.0) == pytest.approx(5000.0)
    assert first_scale(np.zeros(3), 1.0) == 1.0


def test_numbers_in_words():
    assert (length(0.00123), length(12.34), length(0.0)) == ("1.23 mm", "12.3 m", "0 m")
    assert (angle(4.56e-6), angle(1e-12)) == ("4.56 µrad", "0.00100 nrad")
    assert (number(1234567.0, 7), number(4.581e-5, 4), number(None)) == (
        "1,234,567",
        "4.581·10⁻⁵",
        "–",
    )
    assert variance_bounds(0) is None
