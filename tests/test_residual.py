"""The residual against OpenCV and matrices, and its derivatives against automatic ones."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import (
    at_values,
    board_recording,
    dense_residuals,
    free_points_recording,
    matrix,
    nudged,
    relay_recording,
    stereo_recording,
    to_plane,
    to_point,
    without_starts,
)
from scipy.linalg import logm

from jaxvm.network.factors import PixelFactor, RangeFactor
from jaxvm.network.residual import linearise, present, residual, whitening
from jaxvm.network.scene import build
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.ports import N_PORTS, PORTS
from jaxvm.recording.model import Prior

NETWORKS = {
    "board": board_recording,
    "stereo": stereo_recording,
    "points": free_points_recording,
    "relay": relay_recording,
}


@eqx.filter_jit
def of_flat(flat, network):
    """All whitened residuals as one vector: the whole residual function."""
    blocks = residual(network.layout.restore(flat), network)
    return jnp.concatenate([jnp.ravel(block) for block in jax.tree.leaves(blocks)])


@eqx.filter_jit
def forward_jacobian(flat, network):
    return jax.jacfwd(of_flat)(flat, network)


def linearised(factor, network, flat, live=(), tangent=False):
    """A table with its derivatives."""
    return linearise(factor, network, present(network, flat, slopes=True), live, tangent)


@eqx.filter_jit
def assembled_jacobian(flat, network):
    """The blocks of every table, whitened and put in their places."""
    effects = np.concatenate([network.layout.all("amplitude"), network.layout.all("constant")])
    parts = []
    for factor in network.factors():
        n, own = factor.slots.shape
        live = tuple(range(own + len(effects)))
        block = linearised(factor, network, flat, live).jacobian * whitening(factor)[:, :, None]
        slots = jnp.concatenate(
            [factor.slots, jnp.broadcast_to(jnp.asarray(effects, int), (n, len(effects)))], axis=1
        )
        dense = jnp.zeros((n, block.shape[1], network.layout.size))
        rows = jnp.arange(n)[:, None]
        dense = dense.at[rows, :, slots].add(jnp.swapaxes(block, 1, 2))
        parts.append(dense.reshape(-1, network.layout.size))
    return jnp.concatenate(parts)


@pytest.fixture(scope="module", params=NETWORKS)
def exact(request):
    """A network without noise, and its scene at the truth."""
    known = NETWORKS[request.param](noise=0.0)
    return known, known.true_scene()


@pytest.fixture(scope="module")
def stereo():
    """The stereo network off the truth, its plate in known motion."""
    known = stereo_recording(noise=0.0)
    velocity = np.random.default_rng(4).uniform(-0.5, 0.5, (6, 6))
    recording = replace(known.recording, velocities={"plate": velocity})
    return recording, nudged(known, known.true_scene(recording), 1e-3)


@pytest.fixture(scope="module")
def mixed():
    """Two families of lenses, so two tables of pixels."""
    known = stereo_recording(noise=0.0, right_lens="fisheye")
    scene = known.true_scene()
    assert np.abs(of_flat(scene.state.flatten(), scene.network)).max() < 1e-8
    return known.recording, nudged(known, scene, 1e-3)


@pytest.fixture(scope="module")
def relay():
    """The relay network off the truth, with measured links."""
    known = relay_recording()
    return known, nudged(known, known.true_scene(), 1e-2)


def test_truth_leaves_nothing(exact):
    _, scene = exact
    assert np.abs(of_flat(scene.state.flatten(), scene.network)).max() < 1e-8


def test_blocks_are_the_derivative(exact):
    known, scene = exact
    scene = nudged(known, scene, 1e-3)
    blocks = np.asarray(assembled_jacobian(scene.state.flatten(), scene.network))
    against_differences(blocks, scene)
    if known.recording.links is None:
        whole = np.asarray(forward_jacobian(scene.state.flatten(), scene.network))
        scale = np.abs(whole).max(axis=0) + 1e-300
        assert np.abs((blocks - whole) / scale).max() < 1e-11


def against_differences(jacobian, scene):
    """Finite differences of the whole residual, along random directions in natural units."""
    flat = scene.state.flatten()
    scale = np.maximum(np.abs(jacobian).max(axis=0), 1.0)
    rng = np.random.default_rng(0)
    for _ in range(6):
        direction = rng.standard_normal(len(flat)) / scale
        h = 1e-4
        ahead = of_flat(flat + h * direction, scene.network)
        behind = of_flat(flat - h * direction, scene.network)
        expected = np.asarray(ahead - behind) / (2 * h)
        assert np.abs(jacobian @ direction - expected).max() < 1e-6 * np.abs(expected).max()


def test_reverse_mode_agrees():
    known = free_points_recording()
    scene = nudged(known, known.true_scene(), 1e-3)
    flat = scene.state.flatten()
    forward = forward_jacobian(flat, scene.network)
    reverse = eqx.filter_jit(jax.jacrev(of_flat))(flat, scene.network)
    assert np.allclose(forward, reverse, rtol=1e-10, atol=1e-8)


def test_effects_enter_the_derivative():
    known = free_points_recording()
    lagging = Effect(
        "focal follows the time",
        (Term("sensor.focal"), Term("lens.k1")),
        "time",
        "lag",
        (0.7,),
        0.1,
        Scope(camera=("cam1",)),
        (2e-4, -1e-4),
    )
    scene = nudged(known, known.true_scene().with_effects((lagging,)), 1e-3)
    flat = scene.state.flatten()
    whole = np.asarray(assembled_jacobian(flat, scene.network))
    against_differences(whole, scene)
    constants = scene.network.layout.all("constant")
    assert np.abs(whole[:, constants[0]]).max() > 1e-4
    # The effect acts on its camera and on no other.
    obs = scene.recording.observations
    amplitude = scene.network.layout.all("amplitude")[0]
    n = len(scene.tables[0])
    acting = np.abs(whole[: 2 * n, amplitude]).reshape(n, 2).max(axis=1) > 0
    seen_late = (obs.camera == 1)[scene.tables[0]]
    assert acting[~seen_late].sum() == 0 and acting.sum() > 5


def test_pure(stereo):
    _, scene = stereo
    flat = scene.state.flatten()
    before = np.array(flat)
    first, second = of_flat(flat, scene.network), of_flat(flat, scene.network)
    assert np.array_equal(first, second) and np.array_equal(before, flat)
    assert first.dtype == np.float64
    blocks = jax.jit(residual)(scene.state, scene.network)
    assert np.array_equal(dense_residuals(blocks), first)


def test_vmap_over_states(stereo):
    _, scene = stereo
    steps = 1e-4 * np.random.default_rng(1).standard_normal((3, scene.network.layout.size))
    flats = scene.state.flatten() + steps
    together = eqx.filter_jit(eqx.filter_vmap(of_flat, in_axes=(0, None)))(flats, scene.network)
    for flat, one in zip(flats, together, strict=True):
        assert np.allclose(of_flat(flat, scene.network), one, rtol=1e-10, atol=1e-9)


def test_port_jacobian_is_the_derivative_by_an_effect_on_each_port(stereo):
    _, scene = stereo
    effects = tuple(Effect(port.name, (Term(port.name),)) for port in PORTS)
    with_all = scene.with_effects(effects)
    amplitude = with_all.network.layout.all("amplitude")[:N_PORTS]
    tangents = [
        linearised(f, scene.network, scene.state.flatten(), tangent=True).tangent
        * whitening(f)[:, :, None]
        for f in scene.network.factors()
        if isinstance(f, PixelFactor | RangeFactor)
    ]
    tangents = np.concatenate([np.asarray(t).reshape(-1, N_PORTS) for t in tangents])
    # A port that acts on nothing would make this pass in vain.
    reach = np.abs(tangents).max(axis=0)
    idle = [port.name for port, size in zip(PORTS, reach, strict=True) if size == 0]
    assert idle == []
    flat = with_all.state.flatten()
    for k, port in enumerate(PORTS):
        h = 1e-4 * port.largest
        step = jnp.zeros(len(flat)).at[amplitude[k]].set(h)
        ahead, behind = (of_flat(flat + s * step, with_all.network) for s in (1, -1))
        difference = np.asarray(ahead - behind)[: len(tangents)] / (2 * h)
        assert np.abs(difference - tangents[:, k]).max() < 1e-6 * reach[k], port.name


def test_padding_weighs_nothing(stereo):
    _, scene = stereo
    factor, rows = scene.network.pixels[0], scene.tables[0]
    n = len(rows)
    assert factor.slots.shape[0] > n == factor.n_real
    spoiled = eqx.tree_at(
        lambda f: f.pixels[0].circumstances.pixel,
        scene.network,
        factor.circumstances.pixel.at[n:].add(1e5),
    )
    flat = scene.state.flatten()
    assert np.array_equal(of_flat(flat, scene.network), of_flat(flat, spoiled))
    assert np.all(of_flat(flat, spoiled)[2 * n : 2 * factor.slots.shape[0]] == 0.0)


def test_every_observation_stands_once(mixed):
    recording, scene = mixed
    assert len(scene.tables) == 2
    rows = np.concatenate(scene.tables)
    assert np.array_equal(np.sort(rows), np.arange(len(recording.observations.epoch)))
    for table, factor in zip(scene.tables, scene.network.pixels, strict=True):
        measured = factor.circumstances.pixel[: len(table)]
        assert np.array_equal(measured, recording.observations.pixel[table])


def test_sigma_and_weight_whiten(mixed):
    recording, scene = mixed
    obs = recording.observations
    rng = np.random.default_rng(2)
    sigma = rng.uniform(0.05, 3.0, len(obs.sigma))
    weight = rng.integers(0, 2, scene.network.pixels[1].slots.shape[0]).astype(float)
    other = build(replace(recording, observations=replace(obs, sigma=sigma)))
    other = other.with_state(scene.state)
    network = eqx.tree_at(lambda n: n.pixels[1].weight, other.network, jnp.asarray(weight))
    flat = scene.state.flatten()
    before, after = of_flat(flat, scene.network), of_flat(flat, network)
    first = scene.network.pixels[0].slots.shape[0]
    rows = scene.tables[0]
    ratio = (obs.sigma / sigma)[rows, None]
    m = 2 * len(rows)
    assert np.allclose(after[:m].reshape(-1, 2), before[:m].reshape(-1, 2) * ratio, rtol=1e-12)
    rows = scene.tables[1]
    ratio = (weight[: len(rows)] * (obs.sigma / sigma)[rows])[:, None]
    own = slice(2 * first, 2 * first + 2 * len(rows))
    assert np.allclose(after[own].reshape(-1, 2), before[own].reshape(-1, 2) * ratio, rtol=1e-12)


def test_ranges_by_hand(stereo):
    recording, scene = stereo
    ranges, state = recording.ranges, scene.state
    got = np.asarray(jax.jit(residual)(state, scene.network).ranges)[:, 0]
    beam = matrix(state.world_from_station[0]) @ matrix(state.station_from_rangefinder[0])
    kinds = set()
    for k in range(len(got)):
        row = scene.target_row[ranges.target[k], ranges.epoch[k]]
        pose = matrix(state.carrier_from_target[row])
        if ranges.point[k] < 0:
            distance = to_plane(beam, pose)
        else:
            mark = recording.model.targets[ranges.target[k]].points[ranges.point[k]]
            distance = to_point(beam, pose, mark)
        kinds.add((ranges.point[k] < 0, int(ranges.target[k])))
        assert got[k] == pytest.approx((distance - ranges.distance[k]) / ranges.sigma[k], rel=1e-8)
    assert len(kinds) == 3 and np.abs(got).min() > 1e-3


def test_links_by_hand(relay):
    known, scene = relay
    links, state = known.recording.links, scene.state
    blocks = jax.jit(residual)(state, scene.network)
    stations = [matrix(p) for p in state.world_from_station]
    nodes = {("station", i): pose for i, pose in enumerate(stations)}
    for i in range(3):
        nodes["camera", i] = stations[i] @ matrix(state.station_from_camera[i])
        nodes["target", i] = matrix(state.carrier_from_target[i])
    for k in range(2):
        a, b = nodes[links.from_node[k]], nodes[links.to_node[k]]
        expected = twist(np.linalg.inv(matrix(links.pose[k])) @ np.linalg.inv(a) @ b)
        expected /= links.sigma[k]
        assert np.allclose(blocks.links[k], expected, rtol=1e-8, atol=1e-8)
        assert np.abs(expected).min() > 1e-2
    for k in range(3):
        own = np.linalg.inv(matrix(links.pose[2 + k])) @ matrix(state.link[k])
        expected = twist(own) / links.sigma[2 + k]
        assert np.allclose(blocks.edges[k], expected, rtol=1e-8, atol=1e-8)


def test_closures_by_hand(relay):
    known, scene = relay
    closure = known.recording.model.closures[0]
    c01, c21, c20 = (matrix(p) for p in scene.state.link)
    expected = twist(c01 @ np.linalg.inv(c21) @ c20)
    expected /= np.repeat([closure.sigma_rad, closure.sigma_m], 3)
    got = jax.jit(residual)(scene.state, scene.network).closures
    assert np.allclose(got[0], expected, rtol=1e-8, atol=1e-6)
    assert np.abs(expected).min() > 1.0


def twist(pose) -> np.ndarray:
    """(omega, rho) of a 4x4 matrix by its general logarithm."""
    log = np.real(logm(pose))
    return np.array([log[2, 1], log[0, 2], log[1, 0], *log[:3, 3]])


def test_priors_by_hand():
    known = board_recording()
    priors = (
        Prior("cameras.cam.focal", np.array([990.0, 1000.0]), np.array([2.0, 5.0])),
        Prior("cameras.cam.distortion", np.array([0.1, 0.2, 0.3, 0.4]), np.full(4, 0.01)),
        Prior("targets.board.pose", np.arange(6.0), np.arange(1.0, 7.0)),
        Prior("stations.desk.pose", np.full(6, 0.5), np.full(6, 0.1)),
    )
    scene = at_values(build(known.with_model(priors=priors)), known.truth)
    got = np.asarray(jax.jit(residual)(scene.state, scene.network).priors)[:, 0]
    expected = [
        (known.truth["focal"][0] - [990.0, 1000.0]) / [2.0, 5.0],
        (known.truth["distortion"][0, :4] - [0.1, 0.2, 0.3, 0.4]) / 0.01,
        ((known.truth["carrier_from_target"] - np.arange(6.0)) / np.arange(1.0, 7.0)).ravel(),
        np.full(6, -5.0),
    ]
    assert np.allclose(got, np.concatenate(expected), rtol=1e-12)


def test_one_epoch_is_a_recording():
    known = free_points_recording(noise=0.0, n_epochs=1)
    scene = known.true_scene()
    assert np.abs(of_flat(scene.state.flatten(), scene.network)).max() < 1e-8


def test_an_effect_of_no_size_changes_nothing():
    """Also where the points of a target had no coordinates when the scene was built."""
    known = free_points_recording(noise=0.0)
    scene = at_values(build(without_starts(known.recording)), known.truth)
    scene = scene.with_effects((Effect("growth", (Term("target.scale"),)),))
    assert np.abs(of_flat(scene.state.flatten(), scene.network)).max() < 1e-8


@pytest.mark.parametrize(("low", "high", "plane"), [(0.0, 0.05, 0.0), (-0.03, -0.01, -0.01)])
def test_a_plate_with_posts_grows_about_its_plane(low, high, plane):
    known = board_recording(noise=0.0)
    (board,) = known.recording.model.targets
    points = board.points.copy()
    points[:, 2] = np.linspace(low, high, len(points))
    model = replace(known.recording.model, targets=(replace(board, points=points),))
    truth = known.truth | {"point": points}
    scene = at_values(build(replace(known.recording, model=model)), truth)
    e = 1e-3
    grown = scene.with_effects((Effect("growth", (Term("target.scale"),), amplitudes=(e,)),))
    middle = np.append(0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)), plane)
    by_hand = at_values(scene, {"point": middle + (1.0 + e) * (points - middle)})
    n = 2 * len(known.recording.observations.epoch)
    plain, got, expected = (
        of_flat(s.state.flatten(), s.network)[:n] for s in (scene, grown, by_hand)
    )
    np.testing.assert_allclose(got, expected, atol=1e-9)
    assert np.abs(got - plain).max() > 1.0


def test_blocks_are_the_whole_table(exact):
    """Whether rows are computed in blocks or as one program under `jit`, they are the same."""
    _, scene = exact
    network, flat = scene.network, scene.state.flatten()
    for factor in network.factors():
        n_own = factor.slots.shape[1]
        live = tuple(range(n_own + network.effects.n_columns))
        apart = linearised(factor, network, flat, live, True)
        whole = eqx.filter_jit(linearised)(factor, network, flat, live, True)
        used = np.asarray(factor.weight) > 0.0
        for a, b in zip(apart, whole, strict=True):
            assert a.shape == b.shape
            np.testing.assert_allclose(a[used], b[used], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("tangent", [False, True])
@pytest.mark.parametrize("compiled", [eqx.filter_jit, lambda function: function])
def test_a_program_of_its_own_is_the_whole_table(stereo, tangent, compiled):
    """What is known of the effects before a program is traced leaves out what changes nothing."""
    _, scene = stereo
    scope = Scope(camera=("left",))
    terms = Term("sensor.focal"), Term("mount.turn_y"), Term("target.disc", "one", weight=1e-3)
    effects = (
        Effect("lag", terms[:2], "time", "lag with state", (0.7,), 0.1, scope, (2e-4, 0, 1e-4, 0)),
        Effect("again", terms[1:], "time", "lag", (0.7,), 0.1, Scope(), (2e-4, 0.5), shares="lag"),
        Effect("whole", (Term("lens.k1"),), "constant", "constant", amplitudes=(1e-3,)),
        Effect("range", (Term("range.scale"),), "constant", "constant", amplitudes=(1e-3,)),
    )
    scene = scene.with_effects(effects)
    network, flat = scene.network, scene.state.flatten()
    own = replace(network, effects=network.effects.specialised())
    known = own.effects.known
    assert len(known.fed) == 5 and len(set(known.course)) == 4 < network.effects.n_columns
    amplitudes, constants = (len(network.layout.all(f)) for f in ("amplitude", "constant"))
    assert network.ranges is not None
    for factor in (*network.pixels, network.ranges):
        live = tuple(range(factor.slots.shape[1] + amplitudes + constants - 1))
        find = compiled(linearised)
        some, every = (find(factor, net, flat, live, tangent) for net in (own, network))
        used = np.asarray(factor.weight) > 0.0
        for a, b in zip(some[: 2 + tangent], every, strict=False):
            np.testing.assert_allclose(a[used], b[used], rtol=1e-9, atol=1e-9)
        fed = np.array(known.fed)
        np.testing.assert_allclose(some[2][used][..., fed], every[2][used][..., fed], rtol=1e-9)
    some, every = (compiled(residual)(scene.state, net) for net in (own, network))
    for a, b in zip(jax.tree.leaves(some), jax.tree.leaves(every), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("port", ["", "sensor.focal", "target.disc"])
def test_blocks_leave_out_what_nothing_feeds(exact, port):
    """One program under `jit` computes all ports and all rows; blocks only what counts."""
    _, scene = exact
    effects = (Effect("one", (Term(port),), amplitudes=(1e-3,)),) if port else ()
    scene = scene.with_effects(effects, (8, 3))
    kept = jnp.arange(len(scene.network.pixels[0].weight)) % 3 > 0
    weight = scene.network.pixels[0].weight * kept
    network = eqx.tree_at(lambda n: n.pixels[0].weight, scene.network, weight)
    apart = residual(scene.state, network)
    whole = eqx.filter_jit(residual)(scene.state, network)
    for a, b in zip(jax.tree.leaves(apart), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
