"""Commands: answers, JSON, bad input with status 2 and nothing half-done, interruption."""

import gc
import json
import os
import re
import signal
import subprocess
import sys
import sysconfig
import time
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from networks import board_recording
from pose_networks import network

from jaxvm import commands
from jaxvm.cli import Interruption, main
from jaxvm.recording import read_recording, write_recording
from jaxvm.recording.g2o import import_g2o, write_g2o
from jaxvm.scenes import example_names
from jaxvm.simulate import HIDEABLE


@pytest.fixture
def board(tmp_path):
    return write_recording(board_recording().recording, tmp_path / "board")


def test_validate(board, capsys):
    assert main(["validate", str(board)]) == 0
    assert "1 camera(s)" in capsys.readouterr().out
    assert main(["validate", str(board), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["valid"] is True


def test_what_is_odd_in_a_recording_is_hinted_at(board, capsys):
    """It is valid and adjusted all the same."""
    times = pd.read_csv(board / "epochs.csv")["t"]
    log = pd.DataFrame({"t": times, "air": 20.0 + np.arange(len(times))})
    log.to_csv(board / "drivers.csv", index=False)
    words = "drivers have no unit at the end of air"
    assert main(["validate", str(board)]) == 0
    assert f"hint       {words}" in capsys.readouterr().out
    assert main(["validate", str(board), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hints"][0].startswith(words)
    assert main(["adjust", str(board)]) == 0
    assert f"hint: {words}" in capsys.readouterr().err


def test_adjust_and_its_model(board, tmp_path, capsys):
    out = tmp_path / "adjusted"
    assert main(["adjust", str(board), "--out", str(out), "--json", "--quiet"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["why"].startswith("converged") and 0.5 < told["variance_factor"] < 1.5
    assert {f.name for f in out.iterdir()} == {"adjustment.json", "model.toml", "poses.csv"}
    # The adjusted model is a model: adjusting with it changes nothing.
    model = str(out / "model.toml")
    assert main(["adjust", str(board), "--model", model, "--json", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["cost"] == pytest.approx(told["cost"], rel=1e-9)


@pytest.mark.parametrize("command", ["diagnose", "adjust", "validate"])
def test_bad_recording(command, board, tmp_path, capsys):
    table = board / "observations.csv"
    lines = table.read_text().splitlines()
    lines[11] = lines[11].replace("cam,", "came,")
    table.write_text("\n".join(lines) + "\n")
    before = sorted(tmp_path.iterdir())
    out = [] if command == "validate" else ["--out", str(tmp_path / "out")]
    assert main([command, str(board), *out, "--quiet"]) == 2
    said = capsys.readouterr().err
    assert 'observations.csv line 12: camera "came" is not in recording.toml' in said
    assert said.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["validate", "nowhere"], "there is no such folder"),
        (["diagnose", "nowhere"], "there is no such folder"),
        (["demo", "--hide", "gremlins"], 'no effect "gremlins" can be hidden'),
        (["simulate", "deformation", "--hide", "x", "--out", "o"], 'no effect "x"'),
        (["convert", "nothing.docx", "--out", "o"], "is no folder"),
        (["demo", "--hide", "focal-drfit"], 'can be hidden; did you mean "focal-drift"?'),
        (["demo", "--hide", "focal-drift,nothing"], '"nothing" stands alone; drop it'),
        (["demo", "--hide", ","], 'no effect is named; write "nothing" to hide none'),
        (["montecarlo", "shp"], 'no example of that name; did you mean "ship"?'),
        (["simulate", "deformaton", "--out", "o"], 'did you mean "deformation"?'),
    ],
)
def test_bad_arguments(arguments, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "--quiet"] if arguments[0] == "demo" else arguments) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_list_of_examples_holds_what_the_command_takes(capsys):
    assert main(["montecarlo", "deformation"]) == 2
    listed = re.search(r"known here: (.*) \(to write", capsys.readouterr().err)
    assert listed and tuple(listed[1].split(", ")) == example_names()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["demo", "--seed", "x"], "argument --seed: x is no whole number from 0 on"),
        (["demo", "--seed", "-1"], "argument --seed: -1 is no whole number from 0 on"),
        (["diagnose", "a", "--every", "1"], "argument --every: 1 is no whole number from 2 on"),
        (["montecarlo", "ship", "--trials", "0"], "argument --trials: 0 is no whole number from 1"),
    ],
)
def test_wrong_numbers_are_told_with_what_is_wanted(arguments, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2 and words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "defaults"),
    [
        ("adjust", ["auto", "levenberg-marquardt", "squared"]),
        ("diagnose", ["jaxvm-report", "3", "0.01", "0"]),
        ("demo", ["10", "full", "jaxvm-demo"]),
        ("validate", []),
    ],
)
def test_help_tells_defaults(command, defaults, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    told = re.findall(r"\(default: (.*?)\)", capsys.readouterr().out)
    assert sorted(told) == sorted(defaults)


def test_what_the_system_refuses_is_told_without_its_number(board, capsys):
    (board / "drivers.csv").mkdir()
    assert main(["validate", str(board)]) == 2
    said = capsys.readouterr().err
    assert "drivers.csv: it can't be read or written (is a directory); mend" in said
    assert "Errno" not in said


def test_unknown_option_is_status_2(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["diagnose", "--colour"])
    assert stopped.value.code == 2
    assert "usage" in capsys.readouterr().err


def test_singular_network_is_named(board, tmp_path, capsys):
    """A camera of which one view of a plane is known: some of its numbers are free to choose."""
    alone = read_recording(board)
    first = alone.select_epochs(alone.epoch_ids == alone.epoch_ids[0])
    free = frozenset({"focal", "centre"})
    camera = replace(alone.model.cameras[0], lens="pinhole", distortion=None, free=free)
    model = replace(alone.model, cameras=(camera,))
    folder = write_recording(replace(first, model=model), tmp_path / "alone")
    assert main(["adjust", str(folder), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert "camera cam" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_simulate_writes_a_valid_recording(tmp_path, capsys):
    folder = tmp_path / "scene"
    arguments = ["simulate", "deformation", "--hide", "mount-slip", "--size", "small"]
    assert main([*arguments, "--out", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hidden"] == ["mount-slip"]
    assert len(read_recording(folder).time) == 40
    # Nothing in the folder tells what is hidden.
    text = "".join(f.read_text() for f in folder.iterdir()).lower()
    assert not [key for key in HIDEABLE if key in text] and "slip" not in text
    assert main([*arguments, "--out", str(folder)]) == 2
    assert "already there" in capsys.readouterr().err


def test_an_interrupt_that_a_callback_swallowed_is_not_lost():
    before = signal.getsignal(signal.SIGINT)
    with Interruption() as interruption:
        interruption.check()
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            pass  # as a library does
        with pytest.raises(KeyboardInterrupt):
            interruption.check()
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_in_a_garbage_collection_comes_again(capsys):
    """Python prints an exception of such a callback, and goes on as if nothing had been."""
    hook, arrived = sys.unraisablehook, []

    def interrupted(phase: str, _: dict) -> None:
        gc.callbacks.remove(interrupted)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), Interruption():
        gc.callbacks.append(interrupted)
        gc.collect()
        arrived.append("here")
        time.sleep(60)
    assert arrived == ["here"] and capsys.readouterr().err == ""
    assert sys.unraisablehook is hook


def test_what_a_library_makes_of_an_interrupt_is_one(board, capsys, monkeypatch):
    def run(_):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as problem:
            raise RuntimeError("a callback failed") from problem

    monkeypatch.setattr(commands, "run_validate", run)
    assert main(["validate", str(board)]) == 130
    assert capsys.readouterr().err == "interrupted; nothing was left half-written\n"


def test_an_interrupt_while_packages_are_imported():
    command = os.path.join(sysconfig.get_path("scripts"), "jaxvm")
    run = subprocess.Popen(
        [sys.executable, "-X", "importtime", command, "validate", "nothing"],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stderr is not None
    while "numpy" not in run.stderr.readline():
        assert run.poll() is None
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=60)
    told = [line for line in said.splitlines() if not line.startswith("import time:")]
    assert run.returncode == 130 and told == ["interrupted; nothing was left half-written"]


def test_interrupted_run_leaves_nothing(board, tmp_path):
    out = tmp_path / "report"
    run = subprocess.Popen(
        [sys.executable, "-m", "jaxvm.cli", "diagnose", str(board), "--out", str(out)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled")},
    )
    assert run.stderr is not None
    assert "start values" in run.stderr.readline()
    time.sleep(0.5)
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=120)
    assert run.returncode == 130 and "interrupted" in said
    assert not out.exists()
    assert not [f for f in tmp_path.iterdir() if f.name.startswith(".")]


def test_an_adjustment_interrupted_at_its_picture_leaves_nothing(tmp_path, capsys, monkeypatch):
    graph = tmp_path / "graph.g2o"
    write_g2o(network(seed=2).recording, graph)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxvm.report.network._html", interrupted)
    assert main(["adjust", str(graph), "--out", str(tmp_path / "out"), "--quiet"]) == 130
    assert capsys.readouterr().err == "interrupted; nothing was left half-written\n"
    assert [file.name for file in tmp_path.iterdir()] == ["graph.g2o"]


def test_a_pose_graph_goes_in_and_out(tmp_path, capsys):
    """A gross error among its links is named; the pictures are written; g2o comes out again."""
    recording = network(seed=2).recording
    pose = recording.links.pose.copy()
    pose[7, 3:] += 2.0
    graph = tmp_path / "graph.g2o"
    write_g2o(replace(recording, links=replace(recording.links, pose=pose)), graph)
    folder, out, back = (str(tmp_path / name) for name in ("folder", "out", "back.g2o"))
    assert main(["convert", str(graph), "--out", folder]) == 0
    assert main(["convert", folder, "--out", back]) == 0
    assert len(import_g2o(back).links.name) == len(recording.links.name)
    capsys.readouterr()
    assert main(["adjust", folder, "--snoop", "--out", out, "--json", "--quiet"]) == 0
    told = json.loads(capsys.readouterr().out)
    name = read_recording(folder).links.name[7]
    assert [r["where"] for r in told["rejected"]] == [f"link {name}"]
    assert told["pixel_rms_px"] is None and 0.3 < told["variance_factor"] < 2.0
    assert {f.name for f in (tmp_path / "out").iterdir()} == {
        "adjustment.json", "model.toml", "poses.csv", "network.html", "network.json"
    }  # fmt: skip
    # Without snooping the error spoils the fit, and a model can't be put in place of a graph's.
    assert main(["adjust", str(graph), "--json", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["variance_factor"] > 10.0
    model = str(tmp_path / "out" / "model.toml")
    assert main(["adjust", str(graph), "--model", model, "--quiet"]) == 2
    assert "--model goes with a folder" in capsys.readouterr().err


def test_monte_carlo_of_a_described_network(tmp_path, capsys):
    scene, out = tmp_path / "scene.toml", tmp_path / "trials"
    scene.write_text('layout = "ring"\nstations = 4\nobserve = "links"\n')
    asked = ["montecarlo", str(scene), "--trials", "300", "--batch", "100", "--out", str(out)]
    assert main([*asked, "--json"]) == 0
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert "200 of 300 trials" in said.err
    assert told["trials"] == 300 and told["failed"] == 0
    assert told["chi_square"] == pytest.approx(1.0, abs=4 * (2 / (18 * 300)) ** 0.5)
    assert len((out / "montecarlo.csv").read_text().splitlines()) == 1 + 6 * 3
    assert told["coverage_90"] == pytest.approx(0.9, abs=0.05)
    # More trials go on where the others ended.
    asked[asked.index("300")] = "350"
    assert main([*asked, "--json"]) == 0
    said = capsys.readouterr()
    assert "350 of 350 trials" in said.err and "100 of" not in said.err
    assert main([*asked, "--noise", "student-t:5"]) == 2
    assert "of another study (another noise: normal, not student-t:5)" in capsys.readouterr().err
    assert main([*asked, "--seed", "3"]) == 2
    assert "of another study (another seed: 0, not 3); ask" in capsys.readouterr().err
    scene.write_text('layout = "ring"\nstations = 5\nobserve = "links"\n')
    assert main(asked) == 2
    assert "of another study (another scene)" in capsys.readouterr().err
    assert main([*asked, "--noise", "pink"]) == 2
    assert 'no noise "pink"' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["montecarlo", str(scene), "--trials", "0"])


NEW = "simulate chain", "convert board", "compensate board --model drift.toml"
FOLDERS = "diagnose board", "adjust board", "montecarlo chain", "demo"


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("afile", "afile is "),
        ("afile/x", "afile is a file, not a folder; choose another place"),
        ("/proc/x", "the folder /proc takes no files; choose another place"),
    ],
)
@pytest.mark.parametrize("command", [*NEW, *FOLDERS, "identify board"])
def test_a_place_that_cannot_be_written_is_refused_before_any_work(
    command, place, words, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "afile").touch()
    if place.startswith("/proc") and not os.path.isdir("/proc"):
        pytest.skip("there is no /proc here")
    if command.startswith("identify") and place == "afile":
        place, words = ".", "is a folder, not a file; choose another name"
    # There is no recording either: whoever looks for it first has begun to work.
    assert main([*command.split(), "--out", place]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"jaxvm {command.split()[0]}: --out {place} ") and words in said
    assert said.count("\n") == 1 and "Errno" not in said
    assert [file.name for file in tmp_path.iterdir()] == ["afile"]


def test_the_place_of_the_truth_is_refused_before_any_work(tmp_path, capsys):
    (tmp_path / "ship-truth").touch()
    assert main(["simulate", "nothing", "--out", str(tmp_path / "ship")]) == 2
    assert "ship-truth is already there" in capsys.readouterr().err


def test_the_folders_of_several_reports_are_refused_before_any_work(tmp_path, capsys):
    (tmp_path / "b").touch()
    assert main(["diagnose", "a", "b", "--out", str(tmp_path)]) == 2
    assert "b is a file, not a folder" in capsys.readouterr().err


def test_a_model_of_another_recording_is_named(board, tmp_path, capsys):
    """Whatever it lacks is told of the file that was given, not of the recording's own."""
    own = (board / "recording.toml").read_text()
    other = tmp_path / "x.toml"
    for change, words in (
        (("cameras.cam", "cameras.left"), "its cameras are left, not cam; give"),
        (("targets.board", "targets.b"), "its targets are b, not board; give"),
        (("rows = 5", "rows = 4"), 'target "board" has other points'),
        (("lens = ", "lense = "), 'unknown key "lense"'),
        (("format = 1", "format = "), "this is not valid TOML"),
    ):
        assert change[0] in own
        other.write_text(own.replace(*change))
        assert main(["validate", str(board), "--model", str(other)]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"jaxvm validate: {other}") and words in said, said
        assert "recording.toml" not in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["board", "--model", "no.toml"], "no.toml: there is no such file; give the model.toml"),
        (["board", "--model", "board"], "board is a folder; give the model.toml in it"),
        (
            ["board/epochs.csv"],
            "board/epochs.csv is a file; a recording is a folder, give that: bo",
        ),
        (["afile"], "afile is a file; a recording is a folder, give that with recording.toml"),
    ],
)
def test_what_is_no_recording_is_told(arguments, words, board, capsys, monkeypatch):
    monkeypatch.chdir(board.parent)
    (board.parent / "afile").touch()
    assert main(["validate", *arguments]) == 2
    assert f"jaxvm validate: {words}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [["validate", ""], ["adjust", "a", "--out", ""], ["adjust", "a", "--model", ""]]
)
def test_an_empty_name_is_refused(arguments, board, capsys, monkeypatch):
    """It would be the folder one is in."""
    monkeypatch.chdir(board)
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert "the name is empty; give the name of a file or folder" in capsys.readouterr().err
