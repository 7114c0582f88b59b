"""Waves over the image, and what every image has for itself: found, measured, not imagined."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from networks import predicted

from jaxvm.discover import diagnose
from jaxvm.discover.diagnose import ROOM, _plain_fit
from jaxvm.discover.heldout import hold_out, split
from jaxvm.discover.rivals import rivals
from jaxvm.discover.scatter import ALIKE, likeness, of_each_image
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import refit
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.discover.waves import strongest_wave
from jaxvm.geometry.targets import grid_points
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.effects import Effect, Scope
from jaxvm.recording import Camera, Model, Observations, Recording, Station, Target
from jaxvm.recording.model import grid_names
from jaxvm.report import summary
from jaxvm.report.document import document
from jaxvm.report.figures import figures, png
from jaxvm.report.page import html

IMAGE, SIGMA, N_EPOCHS, SPACING = (1280, 960), 0.05, 30, 60.0
MARKS = grid_points(7, 9, 0.11) - [0.44, 0.33, 0.0]


@pytest.fixture(scope="module")
def still():
    """A camera that stands before a plate that moves; the plate's pose is free in every epoch."""
    rng = np.random.default_rng(5)
    place = np.column_stack(
        [rng.uniform(-0.3, 0.3, (N_EPOCHS, 3)), rng.uniform(-0.1, 0.1, (N_EPOCHS, 2)),
         rng.uniform(1.1, 1.6, N_EPOCHS)]
    )  # fmt: skip
    camera = Camera("cam", "desk", IMAGE, "pinhole", np.full(2, 1100.0),
                    np.array([639.5, 479.5]), None, np.zeros(6))  # fmt: skip
    target = Target("plate", grid_names(7, 9), MARKS, "per-epoch", place, free=("pose",))
    model = Model("still", (camera,), (Station("desk", "static", np.zeros(6)),), (target,))
    epoch, point = np.divmod(np.arange(N_EPOCHS * len(MARKS)), len(MARKS))
    nothing = np.zeros(len(epoch), int)
    seen = Observations(
        epoch, nothing, nothing, point, np.zeros((len(epoch), 2)), np.full(len(epoch), SIGMA)
    )
    recording = Recording(model, np.arange(N_EPOCHS), SPACING * np.arange(N_EPOCHS), {}, seen)
    scene = build(recording)
    pixel = predicted(scene)
    return replace(recording, observations=replace(seen, pixel=pixel))


def recorded(still, change, seed: int = 0) -> Recording:
    """The recording with a change of its pixels and with noise."""
    obs = still.observations
    noise = SIGMA * np.random.default_rng(seed).standard_normal(obs.pixel.shape)
    return replace(still, observations=replace(obs, pixel=obs.pixel + change + noise))


def running(still, cycles_x: float, cycles_y: float, rate: float, size: float = 0.06):
    """A wave of so many cycles over the image's width and height and over the recording."""
    obs = still.observations
    phase = obs.pixel / IMAGE @ [cycles_x, cycles_y] + rate * obs.epoch / (N_EPOCHS - 1)
    return size * np.sin(2.0 * np.pi * phase + 0.4)[:, None] * [0.8, -0.6]


@pytest.mark.parametrize("cycles", [(5.3, -2.2, 2.7), (-7.1, 3.9, -1.3), (0.3, 6.2, 0.0)])
def test_the_periodogram_finds_a_wave(still, cycles):
    scene = build(still)
    noise = np.random.default_rng(1).standard_normal(still.observations.pixel.shape)
    found, p, _ = strongest_wave(scene, running(still, *cycles) / SIGMA + noise, 0)
    assert p < 1e-6
    assert {term.driver for term in found.group.terms} == {"pixels"}
    own = np.array(found.group.terms[0].constants) * IMAGE
    # A wave and the one that runs the other way with the opposite vector are the same.
    sign = np.sign(own @ cycles[:2])
    np.testing.assert_allclose(sign * own, cycles[:2], atol=0.1)
    if cycles[2] == 0.0:
        assert found.course.driver == "constant"
    else:
        period = SPACING * (N_EPOCHS - 1) / abs(cycles[2])
        assert found.course.constants[0] == pytest.approx(period, rel=0.04)


def test_noise_has_no_wave(still):
    """Of 20 recordings of noise none is below 1 % (expected 0.2 by chance at most)."""
    scene, rng = build(still), np.random.default_rng(2)
    shape = still.observations.pixel.shape
    assert min(strongest_wave(scene, rng.standard_normal(shape), k)[1] for k in range(20)) > 0.01


def test_a_wave_that_runs_is_diagnosed(still):
    found = diagnose(recorded(still, running(still, 5.3, -2.2, 2.7)))
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert not finding.hypothesis.entries and finding.effect.terms[0].driver == "pixels"
    assert found.final.heldout_rms_px == pytest.approx(SIGMA, rel=0.04)
    (told,) = re.findall(r"wave of (\d+) px", finding.effect.name)
    assert float(told) == pytest.approx(1.0 / np.hypot(5.3 / IMAGE[0], 2.2 / IMAGE[1]), rel=0.02)


def test_noise_is_not_alike_and_images_that_jump_are(still):
    scene, rng = build(still), np.random.default_rng(3)
    obs = still.observations
    noise = rng.standard_normal(obs.pixel.shape)
    assert likeness(scene, noise) == 0.0
    jumps = rng.standard_normal((N_EPOCHS, 2))
    # Correlation of noise and a share of the same variance: a half.
    assert likeness(scene, noise + jumps[obs.epoch]) == pytest.approx(0.5, abs=0.15)
    assert likeness(scene, noise + 0.1 * jumps[obs.epoch]) < ALIKE
    unseen = np.where((obs.epoch % 3 == 2)[:, None], np.nan, noise)
    assert likeness(scene, unseen) == 0.0


def test_what_each_image_has_for_itself_is_free_in_held_out_epochs(still):
    """A principal distance that hunts, before a plate that stands: its errors go to the noise."""
    obs, rng = still.observations, np.random.default_rng(4)
    hunting = 1e-3 * rng.standard_normal(N_EPOCHS)
    change = hunting[obs.epoch, None] * (obs.pixel - [639.5, 479.5])
    held_model = replace(still.model, targets=(replace(still.model.targets[0], free=()),))
    recording = replace(recorded(still, change), model=held_model)
    terms = each("epoch", "sensor.focal", numbers=range(N_EPOCHS))
    effect = Effect("hunts", terms, scope=Scope(camera=("cam",)))
    scene = build(recording, ())
    parts = split(scene, hold_out(scene), tuple(np.ones(len(rows)) for rows in scene.tables))
    plain = parts.evaluate(parts.fit(scene).scene)
    assert plain.rms_px > 3.0 * SIGMA
    fitted = parts.fit(scene.with_effects((effect,)))
    shown = parts.evaluate(fitted.scene)
    # 20 held-out images of 63 marks: 2 % is one standard deviation of the RMS.
    assert shown.rms_px == pytest.approx(SIGMA, rel=0.06)
    (mended,) = shown.scene.fitted_effects()
    deviation = SIGMA / np.linalg.norm(obs.pixel[obs.epoch == 0] - [639.5, 479.5])
    # Fitted epochs keep what they had; held-out ones find their own.
    z = (np.array(mended.amplitudes) - hunting) / deviation
    assert np.abs(z).max() < 6.0


@pytest.fixture(scope="module")
def pair(still):
    """Two cameras that stand side by side before the plate."""
    (camera,) = still.model.cameras
    beside = replace(camera, name="other", pose=np.array([0.0, -0.08, 0.0, 0.15, 0.0, 0.0]))
    obs = still.observations
    both = Observations(
        np.tile(obs.epoch, 2),
        np.repeat([0, 1], len(obs.epoch)),
        *(np.concatenate([own, own]) for own in (obs.target, obs.point, obs.pixel, obs.sigma)),
    )
    model = replace(still.model, cameras=(camera, beside))
    recording = replace(still, model=model, observations=both)
    scene = build(recording)
    pixel = predicted(scene)
    return replace(recording, observations=replace(both, pixel=pixel))


def test_an_image_that_jumps_is_named_at_its_camera(pair):
    obs = pair.observations
    jumps = 0.1 * np.random.default_rng(6).standard_normal((N_EPOCHS, 2))
    found = diagnose(recorded(pair, jumps[obs.epoch] * (obs.camera == 1)[:, None]))
    (finding,) = found.findings
    assert finding.effect.catalogue_id in {"image-jumps", "haze"}
    names = {finding.effect.catalogue_id}
    names |= {r.hypothesis.entries[0].id for r in finding.rivals if r.hypothesis.entries}
    assert "image-jumps" in names
    assert finding.effect.scope.camera == ("other",)
    assert found.final.heldout_rms_px == pytest.approx(SIGMA, rel=0.05)
    assert found.likeness == 0.0


def test_names_of_what_every_image_has_are_rivals_whoever_asks(pair):
    """They are not among the hypotheses that are scored together, nor shown by a refit here."""
    obs = pair.observations
    jumps = 0.03 * np.random.default_rng(6).standard_normal((N_EPOCHS, 2))
    recording = recorded(pair, jumps[obs.epoch] * (obs.camera == 1)[:, None])
    parts, plain, _ = _plain_fit(start(build(recording, ())).with_effects((), ROOM), 3)
    tests = ScoreTests.of(plain, enumerate_hypotheses(plain.scene))
    leading, _ = of_each_image(plain.scene, tests, 1.0, parts.n, lambda *_: None)
    here = [(h, a) for h, _, a in leading if h.scope.camera == ("other",)]
    found = refit(plain, *next(own for own in here if own[0].entries[0].id == "image-jumps"), parts)
    assert found is not None
    own = found.hypothesis, found.effect
    _, doubles = rivals(plain, found.adjustment, *own, tests, parts.n)
    assert "haze" in {r.hypothesis.entries[0].id for r in doubles}
    assert "focal-hunts" not in {r.hypothesis.entries[0].id for r in doubles}


def test_what_every_camera_has_for_itself_is_the_air_or_a_stabiliser(pair):
    """Each camera and image shifts by an amount of its own, before a plate that is known."""
    obs = pair.observations
    jumps = 0.1 * np.random.default_rng(7).standard_normal((2, N_EPOCHS, 2))
    known = replace(pair.model, targets=(replace(pair.model.targets[0], free=()),))
    found = diagnose(replace(recorded(pair, jumps[obs.camera, obs.epoch]), model=known))
    signal = found.signal
    assert found.verdict == "explained" and not found.findings
    assert signal is not None and signal.whole and signal.cameras == (0, 1)
    assert np.abs(signal.size_rad - 0.1 / 1100.0).max() < 4.0 * signal.size_stds_rad.max()
    (told,) = document(found)["findings"]
    assert [told["catalogue_id"], *(e["catalogue_id"] for e in told["equivalents"])] == [
        "haze",
        "image-jumps",
    ]
    assert "length" not in json.dumps(told["parameters"])
    assert "stabiliser" in summary(found)


def turbulent(recording: Recording, size: float, length: float, share: float, seed: int):
    """A random field in every image [observations, 2] (px), of which the next keeps a share."""
    obs, rng = recording.observations, np.random.default_rng(seed)
    found = np.zeros(obs.pixel.shape)
    for camera in range(len(recording.model.cameras)):
        last = None
        for epoch in range(N_EPOCHS):
            own = (obs.camera == camera) & (obs.epoch == epoch)
            apart = np.linalg.norm(obs.pixel[own][:, None] - obs.pixel[own], axis=-1)
            root = np.linalg.cholesky(
                np.exp(-((apart / length) ** (5 / 3))) + 1e-9 * np.eye(own.sum())
            )
            drawn = size * root @ rng.standard_normal((own.sum(), 2))
            last = drawn if last is None else share * last + np.sqrt(1.0 - share**2) * drawn
            found[own] = last
    return found


def test_shimmering_air_is_named_and_measured(pair):
    """A field that falls off over 250 px, before a plate that is known."""
    known = replace(pair.model, targets=(replace(pair.model.targets[0], free=()),))
    change = turbulent(pair, 0.06, 250.0, 0.0, 8)
    found = diagnose(replace(recorded(pair, change), model=known))
    signal = found.signal
    assert signal is not None and not found.findings
    assert found.verdict == "explained" and "the air shimmers" in summary(found)
    assert signal.cameras == (0, 1)
    assert np.abs(signal.size_rad - 0.06 / 1100.0).max() < 4.0 * signal.size_stds_rad.max()
    assert signal.size_stds_rad.max() < 0.2 * 0.06 / 1100.0
    assert 125.0 < signal.length_px < 500.0
    assert abs(signal.lasting) < 0.3
    # Of the excess some is left: neighbours have noise, too.
    before, after = found.plain.heldout_rms_px, found.final.heldout_rms_px
    assert before == pytest.approx(np.hypot(SIGMA, 0.06), rel=0.1)
    assert SIGMA < after < 0.9 * before
    (told,) = document(found)["findings"]
    assert told["catalogue_id"] == "haze" and told["rows"] == [18, 98]
    pictures = {f"{name}.png": png(figure) for name, figure in figures(found).items()}
    assert "signal.png" in pictures and "the air shimmers" in html(found, pictures)


def test_what_neighbours_share_a_little_is_haze_where_it_falls_off(pair):
    """A ninth of the variance; where images shift as a whole that is what is told and measured."""
    known = replace(pair.model, targets=(replace(pair.model.targets[0], free=()),))
    change = turbulent(pair, 0.018, 250.0, 0.0, 12)
    found = diagnose(replace(recorded(pair, change), model=known))
    assert ALIKE < found.likeness < 0.15
    assert found.signal is not None and not found.signal.whole
    assert np.abs(found.signal.size_rad - 0.018 / 1100.0).max() < 4.0 * (
        found.signal.size_stds_rad.max()
    )
    obs = pair.observations
    for seed, size in ((14, 0.018), (15, 0.018), (13, 0.008)):
        jumps = size * np.random.default_rng(seed).standard_normal((2, N_EPOCHS, 2))
        shifted = recorded(pair, jumps[obs.camera, obs.epoch], seed)
        found = diagnose(replace(shifted, model=known))
        assert not found.findings
        if size == 0.018:
            assert found.signal is not None and found.signal.whole
            off = found.signal.size_rad - size / 1100.0
            assert np.abs(off).max() < 4.0 * found.signal.size_stds_rad.max()
        else:
            # A fortieth of it is what a readout may give all marks of an image.
            assert found.signal is None and found.likeness < ALIKE


def test_what_lasts_is_no_haze(pair):
    """A field that goes on from image to image is a deformation."""
    known = replace(pair.model, targets=(replace(pair.model.targets[0], free=()),))
    change = turbulent(pair, 0.06, 250.0, 0.95, 9)
    found = diagnose(replace(recorded(pair, change), model=known))
    assert found.signal is None and found.verdict != "consistent"


def test_what_one_camera_has_is_no_haze(pair):
    known = replace(pair.model, targets=(replace(pair.model.targets[0], free=()),))
    change = turbulent(pair, 0.06, 250.0, 0.0, 10)
    change[pair.observations.camera == 0] = 0.0
    found = diagnose(replace(recorded(pair, change), model=known))
    assert found.signal is None


def test_images_are_asked_where_a_wave_is_not_proven(pair, monkeypatch):
    """What every image has for itself can look like a wave; the held-out epochs know better."""

    def significant(*arguments):
        wave, _, drop = strongest_wave(*arguments)
        return wave, 1e-4, drop

    monkeypatch.setattr("jaxvm.discover.search.strongest_wave", significant)
    obs = pair.observations
    jumps = 0.1 * np.random.default_rng(6).standard_normal((N_EPOCHS, 2))
    found = diagnose(recorded(pair, jumps[obs.epoch] * (obs.camera == 1)[:, None]))
    (finding,) = found.findings
    assert finding.effect.catalogue_id in {"image-jumps", "haze"}
