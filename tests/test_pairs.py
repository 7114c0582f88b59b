"""Second thoughts: one wide name that took two effects gives way to the two, and only then."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import recorded

from jaxvm.discover.diagnose import ROOM, _plain_fit
from jaxvm.discover.hypotheses import FREE
from jaxvm.discover.pairs import WIDE, better_pair, other_beginnings, worth_a_second_thought
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.search import Search
from jaxvm.discover.select import Weighing, refit, shortlist
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.physics.forms import JUMPS
from jaxvm.solve.snooping import robust_variance

PER_KELVIN = 2e-5


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A mount that creeps, by the independent simulator, and a lens that grows with the air."""
    _, recording = recorded("mount-creep", tmp_path_factory.mktemp("two"))
    obs, drivers = recording.observations, recording.drivers
    warm = np.interp(recording.time, drivers.time, drivers.channels["ambient_degC"])
    mine = obs.camera == [c.name for c in recording.model.cameras].index("right")
    centre = recording.model.cameras[1].centre_px
    zoom = np.where(mine, PER_KELVIN * (warm - warm.mean())[obs.epoch], 0.0)
    pixel = obs.pixel + zoom[:, None] * (obs.pixel - centre)
    recording = replace(recording, observations=replace(obs, pixel=pixel))
    scene = start(build(recording, ())).with_effects(recording.model.effects, ROOM)
    parts, plain, _ = _plain_fit(scene, 3)
    return parts, plain, ScoreTests.of(plain, enumerate_hypotheses(plain.scene))


def finding(before, candidate):
    drop = 2.0 * (before.cost - candidate.adjustment.cost)
    return SimpleNamespace(hypothesis=candidate.hypothesis, drop=drop, effect=candidate.effect)


def test_a_wide_name_gives_way_to_two_narrow_ones(two, monkeypatch):
    parts, plain, tests = two
    variance = robust_variance(plain)
    ranking = tests.score(variance)
    leading = shortlist(ranking, plain.scene, Weighing(variance, parts.n), 60)
    wide = next(item for item in leading if WIDE <= len(item[2]) <= FREE)
    one = refit(plain, wide[0], wide[2], parts)
    findings = [finding(plain, one)]
    assert worth_a_second_thought(findings)
    others = other_beginnings(ranking, plain, wide[0], parts.n)
    pair = better_pair(plain, one.adjustment, findings, others, tests, parts)
    assert pair is not None
    names = [{entry.id for entry in candidate.hypothesis.entries} for candidate in pair]
    # Image and mount can't be told apart here.
    creeps = {"mount-creep", "mount-warm-up", "self-heating"}
    assert any(creeps & own for own in names), names
    assert any("focal-drift" in own for own in names), names
    drift = next(c for c in pair if "focal-drift" in {e.id for e in c.hypothesis.entries})
    last = pair[1].adjustment
    value = last.scene.fitted_effects()[pair.index(drift)].amplitudes[0]
    assert value == pytest.approx(PER_KELVIN, rel=0.1)
    # Against themselves the two are no better.
    own = [finding(plain, pair[0]), finding(pair[0].adjustment, pair[1])]
    assert better_pair(plain, last, own, others, tests, parts) is None
    # They take its place where they have a size.
    search = Search(parts, *parts.proven(plain), 0)
    assert search._may_replace(pair[1])
    monkeypatch.setattr("jaxvm.discover.search.is_determined", lambda *_: False)
    assert not search._may_replace(pair[1])


def test_a_narrow_name_alone_needs_no_second_thought():
    def of(columns, *names, form="linear"):
        effect = SimpleNamespace(amplitudes=(0.0,) * columns, form=form)
        return SimpleNamespace(effect=effect, hypothesis=SimpleNamespace(entries=names))

    assert not worth_a_second_thought([])
    assert not worth_a_second_thought([of(1, "one")])
    assert worth_a_second_thought([of(1, "one"), of(1, "other")])
    assert worth_a_second_thought([of(6, "wide")])
    assert worth_a_second_thought([of(1)])
    assert not worth_a_second_thought([of(24), of(1, "one")])
    assert worth_a_second_thought([of(9, "jumping", form=JUMPS[3])])
    assert not worth_a_second_thought([of(1, "one")] * 5)
