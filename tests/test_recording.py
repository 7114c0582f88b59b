"""Recordings: what is written is read again, and whatever is wrong is said with line and mend."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from networks import board_recording, relay_recording, stereo_recording

from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.catalogue.maps import fine_plate_map, image_map
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording import (
    RecordingError,
    describe,
    hints,
    model_text,
    read_model,
    read_recording,
    write_recording,
)
from jaxvm.recording.files import new_folder, write_files
from jaxvm.simulate import simulate_deformation_scene


@pytest.fixture(scope="module")
def simulated():
    return simulate_deformation_scene((), seed=3, size="small")


@pytest.fixture
def folder(simulated, tmp_path):
    return simulated.write(tmp_path / "recording")


def same(one, two):
    for name, value in vars(one).items():
        other = getattr(two, name)
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, other, equal_nan=True), name
        else:
            assert value == other, name


@pytest.mark.parametrize("table", ["csv", "parquet"])
@pytest.mark.parametrize("make", [board_recording, stereo_recording, relay_recording])
def test_written_and_read_again(make, table, tmp_path):
    recording = make().recording
    again = read_recording(write_recording(recording, tmp_path / "r", table))
    same(recording.observations, again.observations)
    assert np.array_equal(recording.time, again.time) and recording.timed == again.timed
    for name, rates in recording.velocities.items():
        assert np.array_equal(rates, again.velocities[name])
    for part in ("drivers", "ranges", "links"):
        value = getattr(recording, part)
        assert (value is None) == (getattr(again, part) is None)
    if recording.links is not None:
        same(recording.links, again.links)
    if recording.ranges is not None:
        same(recording.ranges, again.ranges)
    assert model_text(recording.model) == model_text(again.model)


def test_effects_are_part_of_a_model(folder):
    model, _ = read_model(folder / "recording.toml")
    effect = Effect(
        "the camera turns",
        (Term("mount.turn_x"), Term("detect.u", "pixel_u", "sine", (1.0,), 0.5)),
        driver="ambient_degC",
        form="lag",
        constants=(900.0,),
        reference=11.5,
        scope=Scope(camera=("left",)),
        amplitudes=(1e-5, 0.01),
        catalogue_id="mount-turn",
    )
    text = model_text(type(model)(**{**vars(model), "effects": (effect,)}))
    (folder / "recording.toml").write_text(text)
    assert read_recording(folder).model.effects == (effect,)


@pytest.mark.parametrize(
    "terms",
    [image_map(), fine_plate_map(), each("epoch", "sensor.cx", "sensor.cy", numbers=range(7)),
     (Term("detect.v", "pixels", "cosine", (0.004, -0.002)),)],
    ids=["image", "plate", "epochs", "wave"],
)  # fmt: skip
def test_patterns_that_a_diagnosis_adds_are_read_back(folder, terms):
    model, _ = read_model(folder / "recording.toml")
    effect = Effect("found", terms, amplitudes=tuple(0.1 * k for k in range(len(terms))))
    text = model_text(type(model)(**{**vars(model), "effects": (effect,)}))
    (folder / "recording.toml").write_text(text)
    assert read_recording(folder).model.effects == (effect,)


def test_epochs_are_selected(folder):
    recording = read_recording(folder)
    chosen = np.arange(len(recording.time)) % 2 == 0
    half = recording.select_epochs(chosen)
    assert np.array_equal(half.time, recording.time[chosen])
    rows = chosen[recording.observations.epoch]
    assert np.array_equal(half.observations.pixel, recording.observations.pixel[rows])
    assert np.array_equal(half.epoch_ids[half.observations.epoch],
                          recording.epoch_ids[recording.observations.epoch[rows]])  # fmt: skip
    with pytest.raises(ValueError, match="selects no epoch"):
        recording.select_epochs(np.zeros(len(recording.time), bool))


def edit(name: str, change):
    """A mistake made in one table: the frame is changed and written again."""

    def make(folder: Path):
        frame = pd.read_csv(folder / f"{name}.csv", dtype=str, keep_default_na=False)
        changed = change(frame)
        (frame if changed is None else changed).to_csv(folder / f"{name}.csv", index=False)

    return make


def put(name: str, row: int, column: str, value: str):
    return edit(name, lambda frame: frame.__setitem__(
        column, frame[column].where(frame.index != row, value)))  # fmt: skip


def toml(old: str, new: str):
    def make(folder: Path):
        file = folder / "recording.toml"
        text = file.read_text()
        assert re.search(old, text), old
        file.write_text(re.sub(old, new, text, count=1))

    return make


def remove(name: str):
    return lambda folder: (folder / name).unlink()


def text_of(name: str, text: str):
    return lambda folder: (folder / name).write_text(text)


def bytes_of(name: str, data: bytes):
    return lambda folder: (folder / name).write_bytes(data)


def drop_rows(name: str, column: str, value: str, keep: int):
    def change(frame):
        own = np.flatnonzero(frame[column] == value)
        return frame.drop(index=own[keep:])

    return edit(name, change)


WRONG = {
    "no model": (remove("recording.toml"), r"recording\.toml: there is no such file"),
    "no observations": (remove("observations.csv"), r"observations\.csv: there is no such file"),
    "no epochs": (remove("epochs.csv"), r"epochs\.csv: there is no such file"),
    "not toml": (text_of("recording.toml", "format = 1\nname = \n"),
                 r"recording\.toml line 2: this is not valid TOML \(invalid value in column 8\)"),
    "half a toml": (text_of("recording.toml", "format = 1\nname = [1,\n"),
                    r"recording\.toml line 2: this is not valid TOML \(.*\); mend it"),
    "toml in Latin-1": (bytes_of("recording.toml", b'format = 1\nname = "Br\xfccke"\n'),
                        r"recording\.toml line 2: the byte 0xfc .*; save the file as UTF-8"),
    "no format": (toml(r"format = 1\n", ""),
                  r"^recording\.toml: it has no format; add format = 1$"),
    "unknown table": (toml(r"\[noise\]", "[nois]"),
                      r'^recording\.toml line \d+: unknown key "nois"; did you mean "noise"\?$'),
    "other format": (toml(r"format = 1", "format = 9"), r"recording\.toml line 1: format is 9"),
    "unknown key": (toml(r"image_size", "imagesize"), r"line \d+: unknown key .*did you mean"),
    "unknown lens": (toml(r"opencv5", "opencv6"), r"line \d+: .*lens is 'opencv6'; it must be one"),
    "wrong coefficients": (toml(r'"opencv5"', '"opencv8"'), r"has 5 coefficients.*has 8"),
    "focal in mm": (toml(r"focal_px = \[\s*3000.0,\s*3000.0", "focal_px = [8, 8"), r"millimetres"),
    "spacing in mm": (toml(r"spacing_m = [\d.]+", "spacing_m = 400.0"), r"millimetres"),
    "unknown free": (toml(r'"focal"', '"focus"'), r'"focus".*did you mean "focal"'),
    "no size": (toml(r"image_size = \[[^\]]*\]\n", ""), r"has no image_size; add"),
    "missing column": (edit("observations", lambda f: f.drop(columns="v")), r'line 1: column "v"'),
    "unknown column": (edit("observations", lambda f: f.assign(sigm="1")), r'"sigm".*"sigma"'),
    "unknown camera": (put("observations", 810, "camera", "lft"),
                       r'observations\.csv line 812: camera "lft" .*left, right.*"left"'),
    "unknown target": (put("observations", 3, "target", "dek"), r'line 5: target "dek".*"deck"'),
    "unknown point": (put("observations", 3, "point", "9/9"),
                      r'line 5: point "9/9" .* \(it has: 0/0, .*, and \d+ more\); mend the name$'),
    "unknown epoch": (put("observations", 7, "epoch", "4711"), r"line 9: epoch 4711"),
    "no number": (put("observations", 5, "u", "abc"), r"line 7: u is abc"),
    "nan": (put("observations", 5, "v", "nan"), r"line 7: v is NaN"),
    "empty": (put("observations", 5, "v", ""), r"line 7: v is empty"),
    "outside": (put("observations", 5, "u", "9999"), r"line 7: .*outside the image.*2448 x 2048"),
    "normalised": (edit("observations", lambda f: f.assign(
        u=(f.u.astype(float) / 2448).astype(str), v=(f.v.astype(float) / 2048).astype(str))),
        r"normalised"),
    "bad sigma": (edit("observations", lambda f: f.assign(sigma="0")), r"line 2: sigma is 0"),
    "twice": (edit("observations", lambda f: pd.concat([f, f[:1]])), r"already; keep one"),
    "never seen": (edit("observations", lambda f: f[f.target != "reference_far"]),
                   r'target "reference_far" is never seen'),
    "unused camera": (edit("observations", lambda f: f[f.camera != "right"]), r'camera "right"'),
    "unsorted time": (put("epochs", 4, "t", "1.0"), r"epochs\.csv line 6: .*sort the epochs"),
    "epoch twice": (put("epochs", 4, "epoch", "3"), r"line 6: epoch 3 is there twice"),
    "half a velocity": (edit("epochs", lambda f: f.drop(columns="deck.wz")), r'"deck.wz" is'),
    "kelvin": (edit("drivers", lambda f: f.assign(
        ambient_degC=(f.ambient_degC.astype(float) + 273.15).astype(str))), r"kelvin"),
    "unsorted drivers": (put("drivers", 9, "t", "-99999"), r"drivers\.csv line 11"),
    "driver gone": (edit("drivers", lambda f: f.drop(columns="humidity_pct")), r'"humidity_pct"'),
    "other clock": (edit("drivers", lambda f: f.assign(t=(f.t.astype(float) + 1e6).astype(str))),
                    r"both need one clock"),
    "no drivers": (remove("drivers.csv"), r"describes the driver"),
    "range in mm": (put("ranges", 2, "range_m", "8123.4"), r"ranges\.csv line 4: .*looks like mm"),
    "negative range": (put("ranges", 2, "range_m", "-1"), r"line 4: range_m is -1"),
    "unknown finder": (put("ranges", 2, "rangefinder", "dist"), r'"dist".*"disto"'),
    "ragged": (text_of("epochs.csv", "epoch,t\n0,0\n1,1,1\n"),
               r"epochs\.csv line 3: 3 fields, the header 2; every line"),
    "semicolons": (text_of("epochs.csv", "epoch;t\n0;0,5\n"),
                   r'epochs\.csv line 1: its fields are separated by ";"; save .* decimal points'),
    "tabs": (text_of("epochs.csv", "epoch\tt\n0\t0.5\n"), r"epochs\.csv line 1: .* by tabs; save"),
    "decimal commas": (text_of("epochs.csv", "epoch,t\n0,0,5\n1,1,5\n"),
                       r"epochs\.csv line 2: .* decimal point"),
    "csv in Latin-1": (bytes_of("epochs.csv", b"epoch,t\n0,0\n1,\xb11\n"),
                       r"epochs\.csv line 3: the byte 0xb1 .*; save the file as UTF-8"),
    "empty file": (text_of("epochs.csv", ""), r"epochs\.csv line 1: the file is empty"),
    "no rows": (text_of("epochs.csv", "epoch,t\n"), r"no row below the header"),
    "both tables": (lambda folder: pd.read_csv(folder / "epochs.csv").to_parquet(
        folder / "epochs.parquet"), r"both in"),
    "no parquet": (lambda folder: (folder / "epochs.csv").rename(folder / "epochs.parquet"),
                   r"epochs\.parquet: this is not a parquet file"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_is_named(name, folder):
    make, message = WRONG[name]
    make(folder)
    with pytest.raises(RecordingError) as caught:
        read_recording(folder)
    text = str(caught.value)
    assert re.search(message, text), text
    # One sentence that tells the mend.
    assert "\n" not in text and re.search(r"[;:] ?.+", text)


def test_too_few_points(tmp_path):
    recording = board_recording(n_epochs=4).recording
    folder = write_recording(recording, tmp_path / "r")
    second = str(recording.epoch_ids[1])

    def scarce(f):
        return pd.concat([f[f.epoch != second], f[f.epoch == second][:2]])

    edit("observations", scarce)(folder)
    with pytest.raises(
        RecordingError, match=rf"shows 2 of its points at epoch {second}, .*least 3"
    ):
        read_recording(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("links", 1, "from", "camra:a"), r'links\.csv line 3: from is "camra:a"; write camera'),
        (put("links", 1, "to", "target:t9"), r'there is no target "t9"'),
        (put("links", 0, "turn_x", "90"), r"line 2: the turn has length 90, .*not degrees"),
        (put("links", 0, "sigma_m", "0"), r"line 2: sigma_m is 0"),
        (edit("links", lambda f: f[f.link != "c20"]), r'link "c20" of a closure is not'),
        (edit("links", lambda f: f.assign(to=f["from"])), r"line 2: the link joins .* with itself"),
    ],
)
def test_wrong_links(change, message, tmp_path):
    folder = write_recording(relay_recording().recording, tmp_path / "r")
    change(folder)
    with pytest.raises(RecordingError, match=message):
        read_recording(folder)


def test_a_log_in_milliseconds_is_hinted_at(folder):
    edit("drivers", lambda f: f.assign(t=(1000 * f.t.astype(float)).astype(str)))(folder)
    (hint,) = hints(read_recording(folder))
    assert re.search(r"drivers run for 9\d+ h, epochs for 6\.\d+ h; .* by 1000", hint), hint


def test_a_channel_without_a_unit_is_hinted_at(folder):
    def rename(name):
        return name.replace("ambient_degC", "air").replace("humidity_pct", "wet")

    edit("drivers", lambda f: f.rename(columns=rename))(folder)
    toml(r"\[drivers.ambient_degC\]", "[drivers.air]")(folder)
    toml(r"\[drivers.humidity_pct\]", "[drivers.wet]")(folder)
    (hint,) = hints(read_recording(folder))
    assert re.search(r"no unit at the end of air, wet.* names no physics; rename .*air_degC", hint)


def test_epochs_that_show_nothing_are_counted(folder):
    assert "40 epochs over 6.50 h;" in describe(read_recording(folder))
    assert hints(read_recording(folder)) == []
    edit("observations", lambda f: f[f.epoch.astype(int) < 5])(folder)
    said = describe(read_recording(folder))
    assert "40 epochs over 6.50 h, 35 of them without an image point;" in said


def test_effect_needs_its_driver(folder):
    file = folder / "recording.toml"
    effect = '\n[[effects]]\nname = "x"\ndriver = "wind"\nform = "linear"\namplitudes = [1e-5]\n'
    file.write_text(file.read_text() + effect + '[[effects.terms]]\nport = "mount.turn_x"\n')
    with pytest.raises(RecordingError, match=r'depends on "wind", which is not recorded'):
        read_recording(folder)


def test_interrupted_writing_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "out") as staging:
        (staging / "half").write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_failed_files_leave_the_old_ones(tmp_path):
    write_files(tmp_path, {"a": "old", "b": "old"})
    with pytest.raises(TypeError):
        write_files(tmp_path, {"a": "new", "b": None})  # type: ignore[dict-item]
    assert {f.name: f.read_text() for f in tmp_path.iterdir()} == {"a": "old", "b": "old"}


def test_files_take_their_places_together_or_not_at_all(tmp_path, monkeypatch):
    """One of them can't be written: none is, and the complaint is of their place alone."""
    out = tmp_path / "out"
    (out / "b").mkdir(parents=True)
    with pytest.raises(OSError, match=r"out/b is a folder, not a file; remove it"):
        write_files(out, {"a": "new", "b": "new"})
    assert [file.name for file in out.iterdir()] == ["b"]

    def full(*_):
        raise OSError(28, "No space left on device", ".writing-123/a")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"new can't be written \(no space left on device\); mend"):
        write_files(tmp_path / "new", {"a": "new"})
    assert [file.name for file in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_takes_a_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_recording(board_recording().recording, ".")
    assert read_recording(tmp_path).timed
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".")]


def test_a_folder_is_not_overwritten(folder):
    recording = read_recording(folder)
    with pytest.raises(FileExistsError, match="already there; choose another name"):
        write_recording(recording, folder)
