"""The search weighs hypotheses by the noise that will be left."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import recorded

from jaxvm.discover.diagnose import ROOM, _plain_fit
from jaxvm.discover.search import Search
from jaxvm.network.scene import build
from jaxvm.network.start import start

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

    (hypothesis, foretold, _), *_ = search._score()
    assert [entry.id for entry in hypothesis.entries[:1]] == ["focal-drift"]
    before, sharper = search.ranking.scores[0].variance, search._sharper.scores[0].variance
    anew = search._tests.score(sharper)
    for own, other in zip(search._sharper.scores, anew.scores, strict=True):
        np.testing.assert_allclose(own.z, other.z, rtol=1e-9)
    search.run(1, lambda line: None)
    left = search.current.variance_factor
    assert before > 1.2 * left
    assert sharper == pytest.approx(left, rel=0.01)
    drop = 2.0 * (plain.cost - search.current.cost) / left
    assert foretold == pytest.approx(drop, rel=0.02)
