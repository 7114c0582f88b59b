"""Recordings of similar size are the same programs: a further one waits for no compiler."""

import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxvm import compiling
from jaxvm.discover.noise import random_signs
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.recording import read_recording
from jaxvm.simulate import scene as simulated
from jaxvm.simulate import simulate_deformation_scene
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import standard_deviations


@pytest.fixture
def nothing_kept(tmp_path):
    """No program is on disk at first."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "compiled"))
    compiling._folder.cache_clear()
    compilation_cache.reset_cache()
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    compiling._folder.cache_clear()
    compilation_cache.reset_cache()


def recorded(epochs: int, folder, monkeypatch):
    """The deformation scene over so many epochs."""
    extent = simulated.Extent(epochs, every_s=600.0, side=5)
    monkeypatch.setitem(simulated.EXTENTS, "asked", extent)
    made = simulate_deformation_scene((), seed=epochs, size="asked")
    return read_recording(made.write(folder / str(epochs)))


def fitted_and_scored(recording):
    """An adjustment, its standard deviations and the scores of all hypotheses."""
    fit = adjust(start(build(recording)).with_effects((), (16, 8)))
    signs = random_signs(len(recording.time), 9, 0)
    ranking = ScoreTests.of(fit, enumerate_hypotheses(fit.scene)).score(1.0, signs)
    return fit, standard_deviations(fit), ranking


@pytest.mark.usefixtures("nothing_kept")
def test_some_epochs_more_compile_nothing(tmp_path, monkeypatch):
    one, other, further = (recorded(n, tmp_path, monkeypatch) for n in (29, 30, 60))
    fit, deviations, _ = fitted_and_scored(one)
    compiled = compiling.compile_seconds()
    fitted_and_scored(other)
    assert compiling.compile_seconds() == compiled
    # The measure sees what does compile.
    adjust(start(build(further)).with_effects((), (16, 8)))
    assert compiling.compile_seconds() > compiled

    # What is spare says nothing: as many unknowns as there are, and no pose beyond the last epoch.
    rows = np.unique(fit.scene.target_row)
    spare = np.setdiff1d(np.arange(len(fit.scene.state.carrier_from_target)), rows)
    assert len(spare) and (np.asarray(fit.scene.state.carrier_from_target)[spare] == 0.0).all()
    assert (np.asarray(deviations.carrier_from_target)[spare] == 0.0).all()
    unknowns = sum(
        name != "" and not name.startswith("spare") for name in fit.scene.unknowns.names()
    )
    observed = 2 * len(one.observations.epoch) + len(one.ranges.epoch)
    given = sum(len(prior.value) for prior in one.model.priors)
    assert fit.degrees_of_freedom == observed + given - unknowns
