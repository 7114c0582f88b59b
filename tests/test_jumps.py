"""What jumps several times: found at its instants, not called by what runs smoothly."""

from dataclasses import replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.courses import gaps
from jaxvm.discover.diagnose import _plain_fit
from jaxvm.discover.jumps import with_jumps
from jaxvm.discover.rivals import rivals
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import Weighing, refit, shortlist
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.solve.snooping import robust_variance

N_EPOCHS = 60
LOOSE = (Term("sensor.cx"), Term("sensor.cy"))


def scored(course, seed=3):
    """Plain fit, tests, ranking and leading hypotheses where the principal point runs like this."""
    known = board_recording(n_epochs=N_EPOCHS)
    scene = known.true_scene()
    middles = gaps("time", scene.network.channels)
    truth = course(middles)
    obs = known.recording.observations
    pixel = predicted(scene.with_effects((truth,), (8, 4)))
    pixel += obs.sigma[:, None] * np.random.default_rng(seed).standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    parts, plain, _ = _plain_fit(known.true_scene(recording), 3)
    tests = ScoreTests.of(plain, enumerate_hypotheses(plain.scene))
    ranking = tests.score(robust_variance(plain))
    weigh = Weighing.at(plain, ranking, parts.n)
    leading = shortlist(ranking, plain.scene, weigh, 12)
    return truth, parts, plain, tests, ranking, weigh, leading


def knocked(middles):
    # There and back, then to the other side: no single step, and nothing that runs one way.
    at, to = tuple(middles[[10, 25, 40]]), np.diff([0.0, 6.0, -5.0, 3.0])
    sizes = (*(0.6 * to), *(-0.8 * to))
    return Effect("it is loose", LOOSE, "time", "3 jumps", at, 0.0, Scope(camera=("cam",)), sizes)


@pytest.fixture(scope="module")
def loose():
    return scored(knocked)


def test_three_jumps_lead_at_their_instants(loose):
    truth, parts, plain, tests, ranking, weigh, leading = loose
    assert not any(h.course.form == "3 jumps" for h, *_ in leading)
    found = with_jumps(leading, tests, ranking, weigh)
    assert [own for _, own, _ in found] == sorted((own for _, own, _ in found), reverse=True)
    named = [h for h, *_ in found if h.group.terms == LOOSE and "jumps" in h.course.form]
    assert named and named[0].entries[0].id == "principal-point-jump"
    assert named[0].course.form == "3 jumps"
    pause = np.median(np.diff(gaps("time", plain.scene.network.channels)))
    # An epoch that was set aside leaves open on which side of it a jump lies.
    np.testing.assert_allclose(
        sorted(named[0].course.constants), truth.constants, rtol=0, atol=1.01 * pause
    )
    others = [own for h, own, _ in found if "jumps" not in h.course.form]
    of_named = next(own for h, own, _ in found if h is named[0])
    assert of_named > max(others) + 100.0


def test_rivals_of_jumps_are_what_else_may_jump(loose):
    _, parts, plain, tests, ranking, weigh, leading = loose
    found = with_jumps(leading, tests, ranking, weigh)
    hypothesis, _, amplitudes = next(
        item for item in found if item[0].group.terms == LOOSE and "jumps" in item[0].course.form
    )
    candidate = refit(plain, hypothesis, amplitudes, parts)
    assert candidate is not None
    own, effect = candidate.hypothesis, candidate.effect
    _, doubles = rivals(plain, candidate.adjustment, own, effect, tests, parts.n)
    names = {entry.id for r in doubles for entry in r.hypothesis.entries}
    # A camera that turns is followed by the board; an image that is cut anew is not.
    assert names == {"image-resampled"}
    assert all(r.hypothesis.course.form == "3 jumps" for r in doubles)


def test_what_drifts_is_not_called_jumps():
    def drifting(middles):
        return Effect("it drifts", LOOSE, "time", "linear", (), 0.0, Scope(), (2e-2, 1.5e-2))

    *_, tests, ranking, weigh, leading = scored(drifting)
    found = with_jumps(leading, tests, ranking, weigh)
    assert found[0][0] is leading[0][0]


def test_what_sways_is_not_called_jumps(monkeypatch):
    def swaying(middles):
        period = 0.8 * (middles[-1] - middles[0])
        sizes = (2.0, 3.0, -2.5, 1.5)  # px, sine and cosine
        return Effect("it sways", LOOSE, "time", "periodic", (period,), 0.0, Scope(), sizes)

    *_, tests, ranking, weigh, leading = scored(swaying)
    assert with_jumps(leading, tests, ranking, weigh) == leading
    # Four jumps explain much of it, and would be offered.
    monkeypatch.setattr("jaxvm.discover.jumps._by_a_curve", lambda *_: -np.inf)
    offered = with_jumps(leading, tests, ranking, weigh)
    assert any(h.course.form == "4 jumps" and own > 100.0 for h, own, _ in offered)


def test_a_curve_at_another_place_speaks_against_jumps(loose):
    """What one camera does at random is followed by four jumps of its station, too."""
    *_, tests, ranking, weigh, leading = loose
    offered = with_jumps(leading, tests, ranking, weigh)
    scopes = {h.scope for h, *_ in offered if "jumps" in h.course.form}
    assert scopes
    raised = []
    for own in ranking.scores:
        drop = own.drop.copy()
        for (driver, form), places in own.family.by_driver_and_form().items():
            if (driver, form) == ("time", "curve"):
                for s, scope in enumerate(own.family.scopes):
                    if scope not in scopes:
                        drop[:, places, s] = 1e9
        raised.append(replace(own, drop=drop))
    other = replace(ranking, scores=tuple(raised))
    assert with_jumps(leading, tests, other, weigh) == leading


def test_nothing_is_tried_where_no_step_explains_enough(loose, monkeypatch):
    *_, tests, ranking, weigh, leading = loose
    monkeypatch.setattr("jaxvm.discover.jumps._LEAST", 1.01)
    assert with_jumps(leading, tests, ranking, weigh) is leading
    assert with_jumps([], tests, ranking, weigh) == []
