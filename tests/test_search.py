"""Hypotheses are weighed by the noise that will be left."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import recorded

from jaxvm.discover.courses import Course
from jaxvm.discover.diagnose import ROOM, _plain_fit
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.search import Search
from jaxvm.discover.select import Weighing, evidence
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.physics.effects import Scope, Term

PER_KELVIN = 3e-5


def test_a_large_effect_is_no_noise_of_its_rivals(tmp_path):
    """A focal length that follows the air: what is foretold of it is what a refit finds."""
    _, recording = recorded((), tmp_path)
    obs, drivers = recording.observations, recording.drivers
    warm = np.interp(recording.time, drivers.time, drivers.channels["ambient_degC"])
    mine = obs.camera == [c.name for c in recording.model.cameras].index("right")
    reach = np.where(mine[:, None], obs.pixel - recording.model.cameras[1].centre_px, 0.0)
    pixel = obs.pixel + PER_KELVIN * (warm - warm.mean())[obs.epoch][:, None] * reach
    recording = replace(recording, observations=replace(obs, pixel=pixel))
    scene = start(build(recording, ())).with_effects(recording.model.effects, ROOM)
    parts, plain, _ = _plain_fit(scene, 3)
    plain, heldout = parts.proven(plain)
    search = Search(parts, plain, heldout, len(scene.effects))

    (hypothesis, foretold, amplitudes), *_ = search._score()
    assert [entry.id for entry in hypothesis.entries[:1]] == ["focal-drift"]
    weigh = search._weigh
    search.run(1, lambda line: None)
    left = search.current.variance_factor
    assert weigh.variance > 1.2 * left
    assert weigh.quiet == pytest.approx(left, rel=0.01)
    drop = 2.0 * (plain.cost - search.current.cost)
    own = evidence(hypothesis, drop, amplitudes, left, parts.n)
    assert foretold * weigh.variance == pytest.approx(own * left, rel=0.02)


def hypothesis_of(n_terms: int) -> Hypothesis:
    """A constant of so many terms, which no one has named."""
    terms = tuple(Term(port) for port in (("focal", "centre_x") * n_terms)[:n_terms])
    return Hypothesis(Group(terms, "camera"), Course("constant", "constant"), Scope(), ())


def test_only_what_is_narrow_pays_in_the_noise_that_is_left():
    """A second column that explains half a dozen more is worth it there, forty are not."""
    loud, quiet, n, drop = 100.0, 1.0, 10_000, 3e4
    weigh = Weighing(loud, n, quiet)
    one, two, many = map(hypothesis_of, (1, 2, 40))
    more = drop + 20.0
    assert weigh(two, more, np.ones(2)) > weigh(one, drop, np.ones(1))
    assert Weighing(loud, n)(two, more, np.ones(2)) < Weighing(loud, n)(one, drop, np.ones(1))
    assert weigh(many, more, np.ones(40)) == Weighing(loud, n)(many, more, np.ones(40))
    # On the scale of the noise that is there.
    assert weigh(one, drop, np.ones(1)) == pytest.approx(drop / loud, rel=0.01)
