"""A diagnosis as a whole: its report, its model, several effects, mistakes, a real recording."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scenes import recorded, true_value

from jaxvm.discover import diagnose
from jaxvm.physics.catalogue import BY_ID
from jaxvm.recording import find_data, open_recording, read_model, read_recording
from jaxvm.report import document, summary, write_report


def test_a_mistake_is_no_physics_and_physics_no_mistake(tmp_path):
    """One point measured 40 sigma off is set aside; a mark that is 40 sigma off always is found."""
    _, recording = recorded((), tmp_path)
    obs = recording.observations
    wrong = 1234
    pixel = obs.pixel.copy()
    pixel[wrong, 0] += 2.0
    found = diagnose(replace(recording, observations=replace(obs, pixel=pixel)))
    assert found.n_rejected == 1 and found.verdict == "consistent", summary(found)
    same = (obs.target == obs.target[wrong]) & (obs.point == obs.point[wrong])
    pixel = obs.pixel.copy()
    pixel[same] += [2.0, 0.0]
    found = diagnose(replace(recording, observations=replace(obs, pixel=pixel)))
    assert found.n_rejected == 0 and found.findings, summary(found)
    # What a report shows is measured minus predicted, as its page says.
    assert np.mean(found.before.residual[same & found.before.used, 0]) > 1.0
    target = recording.model.targets[obs.target[wrong]]
    where = found.findings[0].effect.scope.as_dict()
    assert where == {"target": [target.name], "point": [target.point_names[obs.point[wrong]]]}


def test_two_effects_at_once(tmp_path):
    """Alone a principal point fits better; beside the growing plate the mount gets its name."""
    truth, recording = recorded(("hysteresis", "plate-expansion"), tmp_path, seed=1)
    found = diagnose(recording)
    assert found.verdict == "explained", summary(found)
    names = [finding.effect.catalogue_id for finding in found.findings]
    assert names == ["mount-hysteresis", "target-expansion"], summary(found)
    assert [f.effect.scope.as_dict() for f in found.findings] == [t.place for t in truth]
    for finding, name, true in zip(found.findings, ("turn", "expansion"), truth, strict=True):
        value, std = finding.effect.amplitudes[0], finding.stds[0]
        assert abs(value - true_value(true, name)) < 4.0 * std
    before = [f.gain.before_px for f in found.findings]
    assert before == sorted(before, reverse=True) and found.final.heldout_rms_px < before[-1]


def test_report_of_a_finding(tmp_path):
    (truth,), recording = recorded("focal-drift", tmp_path)
    found = diagnose(recording)
    page = write_report(found, tmp_path / "report")
    told = json.loads((tmp_path / "report" / "report.json").read_text())
    assert told == json.loads(json.dumps(document(found)))
    assert told["verdict"] == "explained" and told["format"] == 1
    (finding,) = told["findings"]
    assert finding["catalogue_id"] == "focal-drift" and finding["named"]
    assert finding["port"] == "sensor.focal" and finding["where"] == truth.place
    (parameter,) = finding["parameters"]
    assert parameter["unit"] == "1/K"
    assert parameter["value"] == pytest.approx(true_value(truth, "growth"), rel=0.1)
    assert finding["heldout_rms_px"]["after"] < finding["heldout_rms_px"]["before"]
    html = page.read_text()
    assert "measured minus predicted" in html
    # Self-contained: nothing is fetched.
    assert "http://" not in html and "https://" not in html and 'src="data:image/png' in html
    assert BY_ID["focal-drift"].explanation in html
    # The extended model explains the recording: what is in it is not found again.
    model, _ = read_model(tmp_path / "report" / "model.toml")
    assert [effect.catalogue_id for effect in model.effects] == ["focal-drift"]
    again = diagnose(read_recording(tmp_path / "recording", tmp_path / "report" / "model.toml"))
    assert again.verdict == "consistent", summary(again)
    assert again.plain.heldout_rms_px == pytest.approx(found.final.heldout_rms_px, rel=1e-3)


needs_sony = pytest.mark.skipif(
    find_data("sony-board") is None,
    reason="the recording sony-board is not here: set JAXVM_DATA to the folder that holds it",
)


@needs_sony
def test_bent_board_of_a_real_recording(tmp_path):
    """mrcal's own solution: (-1.03983, +0.52493) mm, as stored in its camera model."""
    found = diagnose(open_recording("sony-board"), max_findings=1)
    finding = found.findings[0]
    assert finding.effect.catalogue_id == "target-bow"
    assert finding.effect.scope.as_dict() == {"target": ["board"]}
    assert [t.port for t in finding.effect.terms] == ["target.bow_x", "target.bow_y"]
    assert finding.effect.amplitudes == pytest.approx((-1.03983e-3, 0.52493e-3), rel=0.03)
    assert found.plain.heldout_rms_px == pytest.approx(0.82, abs=0.02)
    assert finding.gain.after_px <= 0.58
    assert finding.share > 0.5 and finding.gain.proven
    write_report(found, tmp_path)
    again = diagnose(open_recording("sony-board", tmp_path / "model.toml"), max_findings=1)
    assert again.findings and again.findings[0].effect.catalogue_id != "target-bow"
    assert all(t.port not in ("target.bow_x", "target.bow_y")
               for t in again.findings[0].effect.terms)  # fmt: skip
    assert np.isclose(again.plain.heldout_rms_px, finding.gain.after_px, rtol=0.01)
