"""Poses from images: against OpenCV and scipy, the one residual, and what theory predicts."""

from dataclasses import replace

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import board_recording, matrix, stereo_recording, to_plane, to_point
from scipy.spatial.transform import Rotation

from jaxvm.geometry import (
    grid_points,
    lens_family,
    pose_from_vector,
    so3_left_jacobian_inverse,
    so3_log,
)
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.pose.monocular import locate, orthogonal_iteration
from jaxvm.pose.orientation import orient
from jaxvm.pose.precision import Setup, precision
from jaxvm.pose.refine import refine, refine_many
from jaxvm.pose.sighting import Sighting, sighting
from jaxvm.pose.station import Ranges, locate_body, locate_from_station
from jaxvm.pose.triangulate import linear, mid_point, optimal
from jaxvm.recording.model import Prior, Rangefinder
from jaxvm.recording.recording import Ranges as MeasuredRanges
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import standard_deviations

FOCAL = 1500.0
MOST = 20
located = jax.jit(jax.vmap(locate))
measured = jax.jit(precision, static_argnums=2)


def random_poses(count: int, rng, depth=(2.0, 6.0)) -> np.ndarray:
    turn = Rotation.random(count, random_state=int(rng.integers(1 << 30))).as_rotvec()
    shift = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(*depth, count)])
    return np.concatenate([turn, shift], axis=1)


def pictures(points, poses, sigma_px, rng) -> Sighting:
    """Sightings [b] of marks [b, n, 3] or [n, 3] with noise."""
    points = np.broadcast_to(points, (len(poses), *np.shape(points)[-2:]))
    turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    seen = np.einsum("bij,bnj->bni", turn, points) + poses[:, None, 3:]
    noise = rng.normal(size=(*seen.shape[:2], 2)) * sigma_px / FOCAL
    whitener = np.eye(2) * FOCAL / sigma_px
    return Sighting(
        jnp.asarray(points),
        jnp.asarray(seen[..., :2] / seen[..., 2:] + noise),
        jnp.broadcast_to(jnp.asarray(whitener), (*seen.shape[:2], 2, 2)),
    )


def filled(seen: Sighting) -> Sighting:
    """Sightings with marks that were not seen, up to one number: one compiled program for all."""
    more = MOST - seen.points.shape[1]
    return jax.tree.map(
        lambda leaf: jnp.pad(leaf, [(0, 0), (0, more)] + [(0, 0)] * (leaf.ndim - 2)), seen
    )


def angles(vectors, poses) -> np.ndarray:
    own = Rotation.from_rotvec(np.array(vectors[:, :3]))
    return (own * Rotation.from_rotvec(poses[:, :3]).inv()).magnitude()


def normalised(refined, poses) -> np.ndarray:
    """Errors' squared length in units of their covariance (mean 6)."""

    def one(vector, covariance, true):
        found, true = pose_from_vector(vector), pose_from_vector(true)
        turn = so3_log(found.rotation @ true.rotation.T)
        error = jnp.concatenate([turn, found.shift - found.rotation @ true.rotation.T @ true.shift])
        return error @ jnp.linalg.solve(covariance, error)

    return np.asarray(
        jax.vmap(one)(refined.observer_from_target, refined.covariance, jnp.asarray(poses))
    )


def sqpnp(points, image) -> np.ndarray:
    _, turn, shift = cv2.solvePnP(
        np.array(points), np.array(image), np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
    )
    return np.concatenate([turn, shift]).ravel()


@pytest.mark.parametrize("n, flat", [(6, False), (20, False), (5, True), (20, True), (4, True)])
def test_never_worse_than_sqpnp(n, flat):
    """The likelihood from our global start is at least that from OpenCV's SQPNP."""
    rng = np.random.default_rng(n)
    points = rng.uniform(-0.5, 0.5, (150, n, 3)) * np.array([1.0, 1.0, 0.0 if flat else 1.0])
    if n == 4:  # the corners of a plate: four random marks may lie on a line
        points = np.broadcast_to(grid_points(2, 2, 0.6) - 0.3, (150, 4, 3)) * [1, 1, 0]
    seen = pictures(points, random_poses(150, rng), 0.3, rng)
    starts = [sqpnp(p, i) for p, i in zip(seen.points, seen.image, strict=True)]
    peer = refine_many(seen, jnp.asarray(np.array(starts)))
    seen = filled(seen)
    assert (np.asarray(located(seen).best.cost) <= np.asarray(peer.cost) * (1 + 1e-9) + 1e-9).all()


def test_both_minima_of_a_plane_are_those_of_ippe():
    rng = np.random.default_rng(2)
    plate = grid_points(3, 3, 0.1) - np.array([0.1, 0.1, 0.0])
    poses = random_poses(150, rng, depth=(6.0, 12.0))
    seen = pictures(plate, poses, 0.05, rng)
    found = located(filled(seen))
    two = np.isfinite(found.second.cost)
    assert two.mean() > 0.7
    assert (found.second.cost >= found.best.cost).all()
    refined = jax.jit(refine)
    for k in np.flatnonzero(two)[:40]:
        args = np.array(plate), np.array(seen.image[k]), np.eye(3), None
        _, turns, shifts, _ = cv2.solvePnPGeneric(*args, flags=cv2.SOLVEPNP_IPPE)
        starts = np.concatenate([np.array(turns)[..., 0], np.array(shifts)[..., 0]], axis=1)
        one = jax.tree.map(lambda leaf, k=k: leaf[k], seen)
        costs = sorted(float(refined(one, jnp.asarray(start)).cost) for start in starts)
        own = float(found.best.cost[k]), float(found.second.cost[k])
        np.testing.assert_allclose(own, costs, rtol=1e-6)


def test_orthogonal_iteration_never_goes_up_and_ends_where_newton_does():
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.5, 0.5, (12, 3))
    seen = jax.tree.map(lambda leaf: leaf[0], pictures(points, random_poses(1, rng), 0.5, rng))
    iterate = jax.jit(orthogonal_iteration, static_argnames="tolerance")
    errors = [float(iterate(seen, most=k).error) for k in range(1, 12)]
    assert all(b <= a * (1 + 1e-9) for a, b in zip(errors, errors[1:], strict=False))
    last = iterate(seen)
    assert last.error < errors[0] and int(last.iterations) < 2000

    def object_space_error(change):
        pose = pose_from_vector(change)
        at = seen.points @ pose.rotation.T + pose.shift
        ray = jnp.concatenate([seen.image, jnp.ones((12, 1))], axis=1)
        ray = ray / jnp.linalg.norm(ray, axis=1, keepdims=True)
        return jnp.sum((at - ray * jnp.sum(ray * at, axis=1, keepdims=True)) ** 2)

    vector = jnp.concatenate([so3_log(last.pose.rotation), last.pose.shift])
    assert object_space_error(vector) == pytest.approx(float(last.error), rel=1e-9)
    slope, bend = jax.grad(object_space_error)(vector), jax.hessian(object_space_error)(vector)
    assert np.linalg.norm(np.linalg.solve(bend, slope)) < 1e-9


def test_refinement_is_at_the_bound_and_the_iteration_alone_is_not():
    """Marks 1.5 to 9 m away: orthogonal iteration is 20 to 35 % worse (MATHEMATICS 1.6)."""
    rng = np.random.default_rng(4)
    count = 3000
    points = np.column_stack([rng.uniform(-1, 1, (12, 2)), np.linspace(1.5, 9.0, 12) - 5.0])
    points[:, :2] *= 0.25 * (points[:, 2:] + 5.0)
    pose = np.array([[0.02, -0.03, 0.1, 0.05, -0.02, 5.0]]).repeat(count, axis=0)
    seen = pictures(points, pose, 0.1, rng)
    refined = refine_many(seen, jnp.asarray(pose))
    square = normalised(refined, pose)
    # The mean of 3000 chi-squares with 6 degrees of freedom is known to 0.063.
    assert square.mean() == pytest.approx(6.0, abs=0.26)
    start = jnp.asarray(pose[0])
    iterated = jax.jit(jax.vmap(lambda s: orthogonal_iteration(s, start).pose))(seen)
    turns = np.asarray(jax.vmap(so3_log)(iterated.rotation))
    ratio = np.sqrt(np.mean(angles(turns, pose) ** 2)) / np.sqrt(
        np.mean(angles(refined.observer_from_target, pose) ** 2)
    )
    assert 1.1 < ratio < 1.5


def test_many_at_once_are_one_by_one():
    rng = np.random.default_rng(5)
    poses = random_poses(700, rng)
    seen = pictures(rng.uniform(-0.5, 0.5, (700, 8, 3)), poses, 0.5, rng)
    starts = jnp.asarray(poses + 0.02 * rng.normal(size=poses.shape))
    many, each = refine_many(seen, starts), jax.jit(jax.vmap(refine))(seen, starts)
    # Where the start is as far as another minimum, both may differ in the last digits alone.
    np.testing.assert_allclose(many.cost, each.cost, rtol=1e-9)
    np.testing.assert_allclose(many.observer_from_target, each.observer_from_target, atol=1e-8)


def test_the_pose_is_that_of_the_one_residual():
    """A distorted picture: the same pose and standard deviations as the network's adjustment."""
    known = board_recording(free=frozenset(), n_epochs=3)
    scene = known.true_scene()
    result = adjust(scene)
    spread = standard_deviations(result)
    camera, obs = known.recording.model.cameras[0], known.recording.observations
    one = jax.jit(locate)
    for k in range(3):
        rows = np.flatnonzero(obs.epoch == k)
        points = known.recording.model.targets[0].points[obs.point[rows]]
        seen = sighting(
            jnp.asarray(points),
            jnp.asarray(obs.pixel[rows]),
            jnp.asarray(camera.focal_px),
            jnp.asarray(camera.centre_px),
            lens_family(camera.lens),
            jnp.asarray(camera.distortion),
            jnp.asarray(obs.sigma[rows]),
        )
        found = one(seen).best
        expected = np.asarray(result.scene.state.carrier_from_target)[k]
        own = np.asarray(found.observer_from_target)
        sigma = np.asarray(spread.carrier_from_target)[k]
        # Whitening is first order in the noise.
        np.testing.assert_allclose(own, expected, atol=0.02 * sigma.max())
        to_vector = so3_left_jacobian_inverse(found.observer_from_target[:3])
        turn = to_vector @ found.covariance[:3, :3] @ to_vector.T
        np.testing.assert_allclose(np.sqrt(np.diag(turn)), sigma[:3], rtol=0.02)


def two_cameras(rng, poses, points, sigma_px=0.3):
    """A rig of two cameras 1 m apart: station_from_camera, and sightings [b, 2, ...]."""
    rig = np.array([[0.0, 0.1, 0.0, -0.5, 0.0, 0.0], [0.0, -0.1, 0.0, 0.5, 0.0, 0.0]])
    seen = []
    for own in rig:
        turn = Rotation.from_rotvec(own[:3])
        shift = turn.inv().apply(poses[:, 3:] - own[3:])
        total = (turn.inv() * Rotation.from_rotvec(poses[:, :3])).as_rotvec()
        moved = np.concatenate([total, shift], axis=1)
        seen.append(pictures(points, moved, sigma_px, rng))
    return jnp.asarray(rig), jax.tree.map(lambda a, b: jnp.stack([a, b], axis=1), *seen)


def test_binocular_pose_in_one_step_and_in_two():
    rng = np.random.default_rng(6)
    poses = random_poses(400, rng, depth=(3.0, 5.0))
    rig, seen = two_cameras(rng, poses, rng.uniform(-0.3, 0.3, (10, 3)))
    joint = jax.jit(jax.vmap(lambda s: locate_from_station(s, rig)))(seen)
    steps = jax.jit(jax.vmap(lambda s: locate_body(s, rig)))(seen)
    for found in (joint, steps):
        square = normalised(found, poses)
        assert square.mean() == pytest.approx(6.0, abs=0.7)  # four deviations of the mean
    sizes = np.linalg.det(joint.covariance), np.linalg.det(steps.covariance)
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=0.1)


def test_triangulation():
    rng = np.random.default_rng(7)
    poses = random_poses(300, rng, depth=(3.0, 5.0)) * np.array([0, 0, 0, 1, 1, 1])
    rig, seen = two_cameras(rng, poses, np.zeros((1, 3)))
    cameras = jax.vmap(lambda v: pose_from_vector(v).inverse())(rig)
    each = jax.vmap(lambda i, w: optimal(cameras, i[:, 0], w[:, 0]))(seen.image, seen.whitener)
    error = np.asarray(each.point) - poses[:, 3:]
    square = np.einsum("bi,bij,bj->b", error, np.linalg.inv(each.covariance), error)
    assert square.mean() == pytest.approx(3.0, abs=0.6)
    assert np.mean(each.cost) == pytest.approx(1.0, abs=0.35)  # four image numbers, three unknowns
    # OpenCV's linear triangulation.
    rows = [np.asarray(jnp.concatenate([cameras.rotation[k], cameras.shift[k][:, None]], axis=1))
            for k in (0, 1)]  # fmt: skip
    image = np.array(seen.image)[:, :, 0]
    peer = cv2.triangulatePoints(rows[0], rows[1], image[:, 0].T.copy(), image[:, 1].T.copy())
    own = jax.vmap(lambda i: linear(cameras, i))(jnp.asarray(image))
    np.testing.assert_allclose(own, (peer[:3] / peer[3]).T, atol=1e-9)
    # Of two lines the mid-point of their common perpendicular.
    origin, direction = rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
    across = np.cross(direction[0], direction[1])
    a, b, _ = np.linalg.solve(
        np.column_stack([direction[0], -direction[1], across]), origin[1] - origin[0]
    )
    middle = 0.5 * (origin[0] + a * direction[0] + origin[1] + b * direction[1])
    np.testing.assert_allclose(mid_point(jnp.asarray(origin), jnp.asarray(direction)), middle)


def test_absolute_orientation_weighs_what_is_known():
    rng = np.random.default_rng(8)
    poses = random_poses(500, rng)
    points = rng.uniform(-1, 1, (8, 3))
    root_a, root_b = 1e-3 * rng.normal(size=(2, 8, 3, 3))

    def noisy(root):
        return np.einsum("nij,bnj->bni", root, rng.normal(size=(500, 8, 3)))

    turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    seen = np.einsum("bij,nj->bni", turn, points) + poses[:, None, 3:] + noisy(root_a)
    spread = [jnp.asarray(r @ np.swapaxes(r, 1, 2)) for r in (root_a, root_b)]
    found = jax.vmap(lambda a, b: orient(a, b, *spread))(
        jnp.asarray(seen), jnp.asarray(points + noisy(root_b))
    )
    assert normalised(found, poses).mean() == pytest.approx(6.0, abs=0.65)
    assert np.mean(found.cost) == pytest.approx(24 - 6, abs=1.1)
    alike = orient(
        jnp.asarray(seen[0]), jnp.asarray(points), jnp.broadcast_to(jnp.eye(3), (8, 3, 3))
    )
    peer, _ = Rotation.align_vectors(seen[0] - seen[0].mean(0), points - points.mean(0))
    np.testing.assert_allclose(pose_from_vector(alike.observer_from_target).rotation,
                               peer.as_matrix(), atol=1e-10)  # fmt: skip


def plate(tilt=0.0, relief=0.0, range_sigma=np.inf) -> Setup:
    """The example of MATHEMATICS 1.6: 10 x 10 marks on 0.5 m, 10 m away, 5000 px, 0.05 px."""
    points = grid_points(10, 10, 0.5 / 9.0)
    points = points - points.mean(axis=0)
    points[:, 2] = relief * (np.arange(100) % 2 - 0.5)
    pose = jnp.array([tilt, 0.0, 0.0, 0.0, 0.0, 10.0])
    sizes = (jnp.asarray(x) for x in (5000.0, 0.05, range_sigma))
    return Setup(jnp.asarray(points), pose, *sizes)


@pytest.mark.parametrize(
    "setup, turn",
    [(plate(), 2.9e-3), (plate(tilt=0.5), 0.17e-3), (plate(relief=0.1), 0.20e-3)],
)
def test_precision_of_a_plate(setup, turn):
    found = measured(setup, jax.random.PRNGKey(0), 1500)
    assert np.asarray(found.predicted)[:2] == pytest.approx(turn, rel=0.05)
    # 1500 repetitions know a standard deviation to 1.8 %.
    np.testing.assert_allclose(found.measured, found.predicted, rtol=0.075)


def test_a_range_fixes_the_depth():
    without, with_range = (
        measured(plate(0.5, range_sigma=sigma), jax.random.PRNGKey(1), 1500)
        for sigma in (np.inf, 2e-4)
    )
    own, bound = (np.asarray(x) for x in with_range.along)
    alone = float(without.along[1])
    # Two independent measurements of one depth; the tilted plate couples a little more.
    assert bound == pytest.approx((alone**-2 + 2e-4**-2) ** -0.5, rel=0.02)
    assert own == pytest.approx(bound, rel=0.075)
    across = [float(x.across[1]) for x in (without, with_range)]
    assert across[1] == pytest.approx(across[0], rel=1e-3)


def test_ranges_are_those_of_the_chain():
    """Distance to a plane by hand, and to a mark."""
    beam = jnp.array([[0.0, 0.2, 0.0, 0.1, 0.0, 0.0]])
    pose = pose_from_vector(jnp.array([0.3, 0.0, 0.0, 0.0, 0.0, 4.0]))
    point = jnp.array([[0.05, -0.02, 0.0]])
    ranges = Ranges(beam, point, jnp.ones(1), jnp.zeros(1), jnp.ones(1))
    direction = Rotation.from_rotvec([0.0, 0.2, 0.0]).apply([0.0, 0.0, 1.0])
    normal = np.asarray(pose.rotation)[:, 2]
    expected = normal @ (np.array([0, 0, 4.0]) - [0.1, 0, 0]) / (normal @ direction)
    assert float(ranges.predicted(pose)[0]) == pytest.approx(expected, rel=1e-12)
    to_mark = eqx.tree_at(lambda r: r.to_plane, ranges, jnp.zeros(1))
    expected = np.linalg.norm(np.asarray(pose.apply(point[0])) - [0.1, 0, 0])
    assert float(to_mark.predicted(pose)[0]) == pytest.approx(expected, rel=1e-12)


def test_mounting_and_index_error_of_a_rangefinder_are_estimated():
    """A rangefinder whose place on the bar and whose zero nobody knows, from ranges alone."""
    known = stereo_recording()
    recording, model = known.recording, known.recording.model
    plate, bar = model.targets[1].points, matrix(known.truth["world_from_station"][0])
    true_place, index = model.rangefinders[0].pose, 3e-3
    beam, rng = bar @ matrix(true_place), np.random.default_rng(5)
    rows, distance = [], []
    for epoch, pose in enumerate(known.truth["carrier_from_target"][1:]):
        rows += [(epoch, point) for point in (-1, *range(len(plate)))]
        distance += [to_plane(beam, matrix(pose))]
        distance += [to_point(beam, matrix(pose), mark) for mark in plate]
    epoch, point = np.array(rows).T
    sigma = np.full(len(rows), 1e-4)
    measured = np.array(distance) + index + sigma * rng.normal(size=len(rows))
    ranges = MeasuredRanges(epoch, 0 * epoch, 0 * epoch + 1, point, measured, sigma)
    finder = Rangefinder("lidar", "bar", true_place + [0.01, -0.01, 0.0, 0.02, -0.02, 0.01],
                         frozenset({"pose"}))  # fmt: skip
    # A turn about the beam itself shows in no range; it is known from the drawing.
    held = Prior("rangefinders.lidar.pose", true_place, np.array([9.0, 9.0, 1e-4, 9.0, 9.0, 9.0]))
    recording = replace(
        recording, ranges=ranges, model=replace(model, rangefinders=(finder,), priors=(held,))
    )
    zero = Effect("index error", (Term("range.offset"),), scope=Scope(rangefinder=("lidar",)))
    found = adjust(start(build(recording, (zero,))))
    spread = standard_deviations(found, found.variance_factor)
    place = np.asarray(found.scene.state.station_from_rangefinder[0] - true_place)[[0, 1, 3, 4, 5]]
    deviation = np.asarray(spread.station_from_rangefinder[0])[[0, 1, 3, 4, 5]]
    assert np.all(np.abs(place) < 4.0 * deviation) and np.all(deviation[2:4] < 2e-3)
    z = (float(found.scene.state.amplitude[0]) - index) / float(spread.amplitude[0])
    # Along the beam a shift looks much like an index error: each is known to 4 mm only.
    assert abs(z) < 4.0 and float(spread.amplitude[0]) < 4e-3
