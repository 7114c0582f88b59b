"""Who has an effect: put into both cameras alike, into one, into both by other amounts."""

from dataclasses import replace

import numpy as np
import pytest
from networks import predicted, stereo_recording

from jaxvm.discover.heldout import Split, range_weights_of, weights_of
from jaxvm.discover.scopes import sharing
from jaxvm.physics.effects import Effect, Scope, Term

ROOM = (16, 4)
BOTH = ("left", "right")


def grows(amplitude: float, *cameras: str) -> Effect:
    """Principal distance that grows with time (1/s)."""
    return Effect(
        "grows",
        (Term("sensor.focal"),),
        "time",
        "linear",
        (),
        1.25,
        Scope(camera=cameras),
        (amplitude,),
    )


@pytest.fixture(scope="module")
def known():
    """Two cameras on a bar, a reference and a plate that moves, in six epochs."""
    return stereo_recording(with_ranges=False)


def fitted_to(known, true: tuple[Effect, ...], fitted: Effect, seed: int = 5):
    """The fit of one effect to pixels that the true ones make, and what was fitted."""
    scene = known.true_scene().with_effects(true, ROOM)
    obs = known.recording.observations
    pixel = predicted(scene)
    pixel += obs.sigma[:, None] * np.random.default_rng(seed).standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    start = known.true_scene(recording).with_effects((fitted,), ROOM)
    sound = tuple(np.ones(len(rows)) for rows in start.tables)
    everything = np.ones(len(recording.time), bool)
    parts = Split(
        ~everything,
        sound,
        weights_of(start, everything, sound),
        range_weights_of(start, everything),
    )
    return parts.fit(start), parts


def test_both_alike(known):
    result, parts = fitted_to(known, (grows(2e-3, *BOTH),), grows(0.0, *BOTH))
    found = sharing(result, 0, parts)
    assert found is not None and found.kind == "camera" and found.names == BOTH
    assert found.homogeneous and found.has_it == (True, True)
    assert "all cameras have it alike" in found.words()
    assert np.abs((found.amplitudes - 2e-3) / found.stds).max() < 4.0
    # Together they are known better than each alone, and in between.
    together = result.scene.fitted_effects()[0].amplitudes[0]
    assert found.amplitudes.min() <= together <= found.amplitudes.max()


def test_noise_that_inflates_makes_bodies_more_alike(known):
    """What differs by a few of its standard deviations is alike in noise with a memory."""
    result, parts = fitted_to(known, (grows(2e-3, *BOTH),), grows(0.0, *BOTH))
    white, louder = sharing(result, 0, parts), sharing(result, 0, parts, 9.0)
    assert white is not None and louder is not None
    np.testing.assert_allclose(louder.stds, 3.0 * white.stds, rtol=1e-6)
    assert louder.equal > white.equal


def test_a_finding_in_one_camera_is_found_in_both(known):
    """The question is put to all cameras, also where the finding names one only."""
    result, parts = fitted_to(known, (grows(2e-3, *BOTH),), grows(0.0, "left"))
    found = sharing(result, 0, parts)
    assert found is not None and found.homogeneous and found.has_it == (True, True)


@pytest.mark.parametrize("name", BOTH)
def test_only_one_has_it(known, name):
    result, parts = fitted_to(known, (grows(2e-3, name),), grows(0.0, *BOTH))
    found = sharing(result, 0, parts)
    assert found is not None and not found.homogeneous
    assert found.has_it == tuple(camera == name for camera in BOTH)
    assert found.words() == f"only camera {name} has it"
    expected = np.array([[2e-3 * (camera == name)] for camera in BOTH])
    assert np.abs((found.amplitudes - expected) / found.stds).max() < 4.0


def test_both_by_other_amounts(known):
    true = (grows(2e-3, "left"), grows(-3e-3, "right"))
    result, parts = fitted_to(known, true, grows(0.0, *BOTH))
    found = sharing(result, 0, parts)
    assert found is not None and not found.homogeneous
    assert found.has_it == (True, True)
    assert "cameras left, right have it, not alike" in found.words()
    assert np.abs((found.amplitudes.ravel() - [2e-3, -3e-3]) / found.stds.ravel()).max() < 4.0


def test_what_belongs_to_no_kind_is_not_asked(known):
    """A finding everywhere, in a single mark or on the only station has nobody to share with."""
    result, parts = fitted_to(known, (grows(2e-3, *BOTH),), grows(0.0, *BOTH))
    effect = result.scene.fitted_effects()[0]
    for scope in (
        Scope(),
        Scope(station=("bar",)),
        Scope(target=("plate",), point=("r0c1",)),
        Scope(camera=("left",), target=("plate",)),
    ):
        other = replace(result, scene=result.scene.with_effects((replace(effect, scope=scope),)))
        assert sharing(other, 0, parts) is None
