"""A plate that no few names describe gets a map in as much detail as held-out epochs allow."""

from dataclasses import fields, replace

import numpy as np
import pytest
from networks import HELD, board_recording, photographs

from jaxvm.discover.courses import Course
from jaxvm.discover.detail import with_detail
from jaxvm.discover.diagnose import ROOM, _plain_fit
from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.groups import Group
from jaxvm.discover.heldout import gain
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.select import refit
from jaxvm.geometry.targets import grid_points
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.physics.catalogue.maps import fine_plate_map, plate_map
from jaxvm.physics.effects import Scope
from jaxvm.recording.model import grid_names
from jaxvm.solve.adjust import reference_sigma
from jaxvm.solve.snooping import robust_variance

N_EPOCHS, SPACING = 24, 0.033
BOARD = Scope(target=("board",))


def test_a_dented_plate_gets_a_fine_map():
    known = board_recording(n_epochs=N_EPOCHS, free=frozenset())
    (board,) = known.recording.model.targets
    marks = grid_points(11, 13, SPACING)
    board = replace(board, point_names=grid_names(11, 13), points=marks)
    model = replace(known.recording.model, targets=(board,), priors=())
    x, y = marks[:, 0] / SPACING, marks[:, 1] / SPACING
    dented = marks.copy()
    dented[:, 2] += 1.2e-3 * np.exp(-((x - 4.0) ** 2 + (y - 3.0) ** 2) / 4.0)
    dented[:, 2] -= 1.0e-3 * np.exp(-((x - 9.0) ** 2 + (y - 7.0) ** 2) / 4.0)
    poses = known.truth["carrier_from_target"]
    rng = np.random.default_rng(4)
    seen = photographs(model, N_EPOCHS, [[HELD] * N_EPOCHS], [poses], [dented], rng, 1.0)
    recording = replace(known.recording, model=model, observations=seen)
    scene = start(build(recording, ())).with_effects((), ROOM)
    parts, plain, _ = _plain_fit(scene, 3)
    plain, before = parts.proven(plain)
    # Two coarse tiles that were found one after the other.
    current, findings = plain, []
    for tile in (6, 18):
        group = Group(plate_map()[tile : tile + 1], "target")
        hypothesis = Hypothesis(group, Course("constant", "constant"), BOARD, ())
        candidate = refit(current, hypothesis, np.zeros(1), parts)
        assert candidate is not None
        drop = 2.0 * (current.cost - candidate.adjustment.cost)
        current = candidate.adjustment
        findings.append(told(hypothesis, candidate.effect, drop, gain(before, before, 0)))
    current, coarse = parts.proven(current)
    fitted, shown, found = with_detail(current, coarse, findings, parts, 0)
    (only,) = found
    assert only.effect.n_columns == len(fine_plate_map())
    assert only.drop == pytest.approx(sum(f.drop for f in findings))
    assert only.others == () and only.rivals == ()
    assert shown.rms_px < 0.97 * coarse.rms_px < before.rms_px
    # Its proof is that of all that it explains: from nothing to the map.
    assert (only.gain.before_px, only.gain.after_px) == (
        pytest.approx(before.rms_px, rel=0.01),
        shown.rms_px,
    )
    share = 1.0 - (only.gain.after_px / only.gain.before_px) ** 2
    assert only.gain.share == pytest.approx(share, abs=0.02)
    assert np.all(np.isfinite(only.stds)) and len(only.stds) == only.effect.n_columns
    # As far as it can be known: photographs of a plate without dents leave no less.
    noise = np.sqrt(robust_variance(fitted)) * reference_sigma(fitted.scene)
    assert shown.rms_px < 1.05 * noise


def told(hypothesis, effect, drop, proof):
    """A finding of which only what a map asks for is told."""
    nothing = {part.name: () for part in fields(Finding)}
    known = {"hypothesis": hypothesis, "effect": effect, "drop": drop, "gain": proof}
    return Finding(**(nothing | known))
