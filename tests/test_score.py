"""Scores of hypotheses against dense projections, and their distribution under noise."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from networks import dense_residuals, stereo_recording
from test_steps import dense

from jaxvm.discover import products
from jaxvm.discover.battery import Part, Place
from jaxvm.discover.groups import Group
from jaxvm.discover.noise import random_signs
from jaxvm.discover.products import Tangents, whitener_of
from jaxvm.discover.ranking import surprise
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import stacked
from jaxvm.discover.space import enumerate_hypotheses, member
from jaxvm.network.residual import residual
from jaxvm.physics.drivers import OWN_BODY
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.ports import PORT_INDEX, PORTS
from jaxvm.recording.recording import Drivers
from jaxvm.solve.adjust import adjust
from jaxvm.solve.problem import scene_problem

LARGEST = {port.name: port.largest for port in PORTS}


@pytest.fixture(scope="module")
def stereo():
    """A stereo pair, adjusted, with a temperature of the air and of each camera's body."""
    known = stereo_recording()
    time = known.recording.time
    rng = np.random.default_rng(4)
    names = ("ambient_degC", "body_left_degC", "body_right_degC")
    channels = {name: 20.0 + np.cumsum(rng.normal(size=len(time))) for name in names}
    recording = replace(known.recording, drivers=Drivers(time, channels))
    return adjust(known.true_scene(recording))


@pytest.fixture(scope="module")
def ranked(stereo):
    return ScoreTests.of(stereo, enumerate_hypotheses(stereo.scene)).score(1.0)


def observed(scene, effects) -> np.ndarray:
    """Whitened residuals of pixels and ranges with effects in the model."""
    changed = scene.with_effects(effects)
    blocks = residual(changed.state, changed.network)
    return dense_residuals(blocks._replace(priors=None))


def test_drops_are_those_of_dense_projections(stereo, ranked):
    scene = stereo.scene
    problem = scene_problem(scene)
    r, j = map(np.asarray, dense(jnp.zeros(problem.n), problem))
    r, j = (part[: len(observed(scene, ()))] for part in (r, j))
    base = np.linalg.svd(j, full_matrices=False)
    base = base[0][:, base[1] > 1e-10 * base[1][0]]
    rng, compared = np.random.default_rng(0), set()
    for scores in ranked.scores:
        found = np.argwhere(scores.valid & (scores.seen > 1e-3))
        for g, c, s in found[rng.permutation(len(found))[:3]]:
            hypothesis = member(scores.family, (g, c, s), scene)
            if hypothesis.group.mark is not None or scores.amplitude.shape[-1] > 8:
                continue
            # A step that is lost in the rounding of the residuals tells nothing.
            least = [1e-6 * LARGEST[term.port] for term in hypothesis.group.terms]
            sizes = 1e-2 * np.abs(scores.amplitude[g, c, s])
            sizes = np.maximum(sizes, np.repeat(least, len(sizes) // len(least)))
            columns = []
            for k, size in enumerate(sizes):
                step = np.zeros(len(sizes))
                step[k] = size
                ahead, behind = (observed(scene, (hypothesis.effect(a),)) for a in (step, -step))
                columns.append((ahead - behind) / (2.0 * size))
            tangent = np.stack(columns, axis=1)
            size = np.linalg.norm(tangent, axis=0)
            if not size.all():
                continue
            tangent = (tangent - base @ (base.T @ tangent)) / size
            if np.linalg.cond(tangent) > 50.0:  # what is nearly alike is cut off softly
                continue
            left = r - base @ (base.T @ r)
            explained = tangent @ np.linalg.lstsq(tangent, left, rcond=1e-10)[0]
            expected = float(explained @ explained)
            assert scores.drop[g, c, s] == pytest.approx(expected, rel=1e-3, abs=1e-4), hypothesis
            compared.add(hypothesis.course.driver)
    assert {"constant", "time", "ambient_degC", OWN_BODY} <= compared


def test_many_vectors_are_scored_as_one_after_the_other(stereo):
    """Of all hypotheses, information known or not, and at a fit whose information has a border."""
    tests = ScoreTests.of(stereo, enumerate_hypotheses(stereo.scene))
    shape = len(tests.arrangement.drivers), tests.arrangement.components
    drawn = np.random.default_rng(5).normal(size=(3, *shape))
    focal = Effect("", (Term("sensor.focal"),), "ambient_degC", "linear", (), 20.0, Scope(), (0.0,))
    beside = adjust(stereo.scene.with_effects((focal,)))
    again = ScoreTests.of(stereo, enumerate_hypotheses(stereo.scene))  # which knows nothing yet
    again.score(1.0)
    first = tests.score_many(1.0, drawn)
    border = tests.at(beside)
    assert border.plain is tests
    for rankings, alone in (
        (first, again),
        (tests.score_many(1.0, drawn), again),
        (border.score_many(1.0, drawn), again.at(beside)),
    ):
        for vector, ranking in zip(drawn, rankings, strict=True):
            expected = alone.score(1.0, residual=vector)
            assert ranking.n == expected.n > 100
            for one, other in zip(ranking.scores, expected.scores, strict=True):
                np.testing.assert_allclose(one.drop, other.drop, rtol=1e-6, atol=1e-6)
                np.testing.assert_array_equal(one.valid, other.valid)
                # Where nothing is explained, or nearly all absorbed, amplitudes are rounding.
                size = np.abs(other.amplitude).max(axis=-1, keepdims=True)
                close = np.abs(one.amplitude - other.amplitude) <= 1e-4 * size
                assert close[(other.seen > 1e-4) & (other.drop > 1e-3)].all()


def test_maps_are_scored_as_by_dense_matrices(stereo, monkeypatch):
    """Few terms and many, with products within groups and without, against M G itself."""
    families = [f for f in enumerate_hypotheses(stereo.scene) if f.n_terms > 8]
    tests = ScoreTests.of(stereo, tuple(families))
    scored = tests.score(1.0).scores
    monkeypatch.setattr(products, "MOST_PRODUCTS", 0)
    # Some cells at a time in which no term acts, too.
    monkeypatch.setattr(products, "MANY_TERMS_CELLS", 1)
    monkeypatch.setattr("jaxvm.discover.tangents.MANY_TERMS_CELLS", 1)
    again = ScoreTests.of(stereo, tuple(families)).score(1.0).scores
    cells, wide = tests.arrangement.cells, set()
    rows = cells.residual.size
    for family, parts, one, other in zip(families, tests.battery.parts, scored, again, strict=True):
        np.testing.assert_allclose(one.drop, other.drop, rtol=1e-6, atol=1e-6)
        for part in parts:
            if family.n_bases > 1 or not family.valid[0, part.courses[0], part.scope]:
                continue
            course = np.zeros(len(cells.residual))
            course[part.place.cells] = part.weights[0, 0]
            g = np.stack(
                [
                    cells.tangent[PORT_INDEX[term.port]]
                    * np.tile(tests.tangents.pattern(term), tests.arrangement.components)
                    * course[:, None]
                    for term in family.groups[0].terms
                ]
            )
            mg = np.stack([cells.projected(own) for own in g]).reshape(-1, rows)
            score = mg @ cells.residual.ravel()
            size = np.linalg.norm(g.reshape(-1, rows), axis=1)
            size = np.where(size > 0.0, size, 1.0)
            information = (mg @ mg.T) / np.outer(size, size)
            # What is absorbed is cut off softly.
            softened = information + 1e-8 * np.eye(len(size))
            expected = float((score / size) @ np.linalg.solve(softened, score / size))
            got = one.drop[0, part.courses[0], part.scope]
            assert got == pytest.approx(expected, rel=1e-4), family.groups[0]
            wide.add(family.n_terms > cells.residual.shape[1])
    assert wide == {True, False}


def test_own_temperatures_are_those_of_the_cameras(stereo):
    """One effect of all cameras with their own temperatures is the sum of one for each."""
    scene = stereo.scene
    focal, size = (Term("sensor.focal"),), (1e-3,)

    def drift(driver, *cameras, form="lag", constants=(100.0,)):
        return Effect("", focal, driver, form, constants, 20.0, Scope(camera=cameras), size)

    together = observed(scene, (drift(OWN_BODY, "left", "right"),))
    apart = observed(scene, (drift("body_left_degC", "left"), drift("body_right_degC", "right")))
    assert np.abs(together - observed(scene, ())).max() > 0.1
    np.testing.assert_allclose(together, apart, rtol=0, atol=1e-10)


def test_no_hypothesis_is_beyond_what_noise_gives(stereo):
    """The data are the model and noise."""
    scene = stereo.scene
    signs = random_signs(len(scene.recording.time), 99, 0)
    found = ScoreTests.of(stereo, enumerate_hypotheses(scene)).score(1.0, signs)
    assert found.p_value(found.best_z()) > 0.01


def test_the_null_distribution_is_that_of_residuals_with_other_signs(stereo):
    """Each repetition is scored as if those residuals had been measured."""
    scene = stereo.scene
    signs = random_signs(len(scene.recording.time), 3, 0)
    tests = ScoreTests.of(stereo, enumerate_hypotheses(scene))
    found = tests.score(1.0, signs)
    residual = stacked(stereo)
    epoch = np.zeros(len(residual), int)
    epochs = [scene.recording.observations.epoch[rows] for rows in scene.tables]
    if scene.recording.ranges is not None:
        epochs.append(scene.recording.ranges.epoch)
    for start, own in zip(tests.arrangement.starts, epochs, strict=True):
        epoch[start : start + len(own)] = own
    for k, largest in enumerate(found.null):
        flipped = residual * signs[epoch, k][:, None]
        lost = 1.0 - 1.0 / len(signs)
        assert tests.score(lost, residual=flipped).best_z() == pytest.approx(largest, rel=1e-4)


def test_what_is_left_elsewhere_is_no_noise_of_a_place(stereo):
    """An image that jumps makes signs that flip surprising, less so where they can't follow it."""
    scene, rng = stereo.scene, np.random.default_rng(1)
    obs = scene.recording.observations
    signs = random_signs(len(scene.recording.time), 99, 0)
    jump = rng.normal(size=(len(scene.recording.time), 2))
    pixels = np.concatenate([(obs.camera == 0)[own, None] * jump[obs.epoch[own]]
                             for own in scene.tables])  # fmt: skip
    residual = stacked(stereo)
    residual[: len(pixels), :2] += 3.0 * pixels
    tests = ScoreTests.of(stereo, enumerate_hypotheses(scene))
    found = tests.score(1.0, signs, residual)
    groups = [group for scores in found.scores for group in scores.family.groups]

    def of(*ports):
        return next(g for g in groups if {term.port for term in g.terms} == {*ports})

    z = float(np.median(found.null))
    assert found.p_value(z) == pytest.approx(0.5, abs=0.1)
    assert found.p_at(z, of("target.scale_x")) == 0.01
    assert found.p_at(z, of("sensor.cx", "sensor.cy")) > 0.1
    assert all(found.p_at(z, group) <= found.p_value(z) for group in groups)
    unscored = Group((Term("detect.u", "tile"),), "camera")
    assert unscored not in groups and found.p_at(z, unscored) == found.p_value(z)


def test_a_surprise_is_the_log_of_a_tail():
    from scipy.stats import chi2

    for columns in (1, 2, 6, 40):
        for statistic in (columns + 30.0, columns + 200.0):
            told = surprise(np.array(statistic), columns)
            assert told == pytest.approx(-2.0 * chi2.logsf(statistic, columns), rel=0.2)


def test_rounding_of_what_is_absorbed_stops_nothing():
    """Information with an eigenvalue below zero: the other directions count as they did."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    sound, broken = ((axes * [1.0, 0.3, 0.1, last]) @ axes.T for last in (0.05, -3e-8))
    found = whitener_of(np.stack([sound, broken]))
    assert np.allclose(found[0].T @ found[0], np.linalg.inv(sound), rtol=1e-6)
    inverse = (axes[:, :3] / [1.0, 0.3, 0.1]) @ axes[:, :3].T
    assert np.allclose(found[1].T @ found[1], inverse, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("n_bases", [1, 3])
def test_products_of_many_terms_are_those_of_few(n_bases):
    """Very many terms keep their tangents, few their products cell by cell: the same sums."""
    rng = np.random.default_rng(4)
    cells, terms, rows = np.arange(3, 90), 7, 5
    stack = rng.normal(size=(100, terms, rows))
    # Some act in some cells alone, and in 32 cells that are multiplied together none does.
    stack[:60, :3] = stack[35:67] = 0.0
    square = stack @ np.swapaxes(stack, 1, 2)
    place = Place(cells, np.zeros((0, 1), int), np.zeros((0, 1), int))
    table = rng.normal(size=(2, n_bases, len(cells)))
    part = Part(0, np.arange(2), place, table, np.arange(len(cells)))
    product = np.zeros((100, terms))
    few = Tangents(0, square, None, None, product)
    many = Tangents(0, None, stack, None, product)
    np.testing.assert_allclose(many.gram(part), few.gram(part), atol=1e-10)
    np.testing.assert_allclose(many.sizes(cells), few.sizes(cells), rtol=1e-12)
    # Term by term: column (k, i) is the tangent of term k times base i.
    columns = np.einsum("nkr,in->kinr", stack[cells], part.weights[1])
    columns = columns.reshape(terms * n_bases, -1)
    np.testing.assert_allclose(few.gram(part)[1], columns @ columns.T, atol=1e-10)
