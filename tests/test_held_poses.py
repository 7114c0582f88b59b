"""A body whose pose is known in every epoch: a plate on a robot, or watched by another device."""

from dataclasses import replace

import numpy as np
import pytest
from networks import board_recording

from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.recording import RecordingError, model_text, read_recording, write_recording
from jaxvm.recording.join import join
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import standard_deviations


@pytest.fixture(scope="module")
def held():
    """A camera with free intrinsics before a board that is held at its true poses."""
    known = board_recording(n_epochs=8)
    poses = known.truth["carrier_from_target"]
    (board,) = known.recording.model.targets
    board = replace(board, pose=poses, free=frozenset())
    return known, known.with_model(targets=(board,))


def test_written_and_read_again(held, tmp_path):
    _, recording = held
    again = read_recording(write_recording(recording, tmp_path / "r"))
    assert np.array_equal(again.model.targets[0].pose, recording.model.targets[0].pose)
    assert model_text(again.model) == model_text(recording.model)


def test_it_is_held_where_it_is_known(held):
    known, recording = held
    free = adjust(start(build(known.recording, ())))
    fitted = adjust(start(build(recording, ())))
    places = fitted.scene.state.carrier_from_target
    np.testing.assert_allclose(places, known.truth["carrier_from_target"], atol=1e-12)
    own, other = (float(standard_deviations(f).focal[0, 0]) for f in (fitted, free))
    error = float(fitted.scene.state.focal[0, 0]) - known.truth["focal"][0, 0]
    assert abs(error) < 4.0 * own
    # The scale of the scene is known now, not the board's size alone.
    assert own < 0.7 * other


def test_epochs_that_are_chosen_and_joined_keep_their_poses(held):
    _, recording = held
    poses = recording.model.targets[0].pose
    assert poses is not None
    early = np.arange(8) < 5
    first, second = recording.select_epochs(early), recording.select_epochs(~early)
    assert np.array_equal(first.model.targets[0].pose, poses[:5])
    assert np.array_equal(join(first, second).model.targets[0].pose, poses)


@pytest.mark.parametrize(
    "change, message",
    [
        (("per-epoch", "static"), r"turn_rad has \d+ entries; it must be a list of 3 numbers"),
        (("turn_rad = [\n", "turn_rad = [\n[0.0, 0.0],\n"), r"turn_rad has 2 entries"),
        (("turn_rad = [\n", "turn_rad = [\n[0, 0, 0],\n"), r"9 rows and .*shift_m 8; give both"),
    ],
)
def test_wrong_poses_are_named(held, change, message, tmp_path):
    folder = write_recording(held[1], tmp_path / "r")
    text = (folder / "recording.toml").read_text()
    before, after = text[: text.index("[targets")], text[text.index("[targets") :]
    old, new = change
    assert old in after
    (folder / "recording.toml").write_text(before + after.replace(old, new, 1))
    with pytest.raises(RecordingError, match=message):
        read_recording(folder)


def test_other_poses_than_epochs_are_named(held, tmp_path):
    _, recording = held
    (board,) = recording.model.targets
    model = replace(recording.model, targets=(replace(board, pose=board.pose[:5]),))
    folder = write_recording(replace(recording, model=model), tmp_path / "r")
    with pytest.raises(RecordingError, match=r"targets\.board\.pose has 5 rows, but there are 8"):
        read_recording(folder)
