"""A small sealed set: thirty recordings of a world that shares no code with the model.

The world (benchmarks/sealed/world) is plain numpy, written from the physics. What a recording can
show is told by the world's own estimate of the part that survives the adjustment ("visible"). The
full benchmark makes sets of hundreds (benchmarks/sealed/make.py). The seed was new when it was put
here: no engine was changed for it.
"""

import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from jaxvm.discover import diagnose
from jaxvm.recording import read_recording
from jaxvm.report import document

SEALED = Path(__file__).parent
SEED = 20261128
KINDS = "board", "wide", "station", "stereo", "relay"
COUNT, EMPTY = 30, 8
CLEAR = 150.0
"""Visible chi-square from which the name has to be right in nearly all cases."""


@pytest.fixture(scope="module")
def world():
    sys.path.insert(0, str(SEALED))
    try:
        import world

        yield world
    finally:
        sys.path.remove(str(SEALED))


@pytest.fixture(scope="module")
def diagnosed(world, tmp_path_factory):
    """Truth and report of every recording."""
    folder = tmp_path_factory.mktemp("sealed")
    rows = []
    for name, truth in _drawn(world, folder):
        report = document(diagnose(read_recording(folder / name)))
        rows.append((truth, json.loads(json.dumps(report))))
    return rows


def _drawn(world, folder: Path) -> list[tuple[str, dict]]:
    rng = np.random.default_rng(SEED)
    drawn = []
    for number in range(COUNT):
        kind = KINDS[number % len(KINDS)]
        listed = [k for k, e in world.EFFECTS.items() if kind in e.kinds and not e.outside]
        hidden = () if number < EMPTY else (str(rng.choice(listed)),)
        made = world.record(kind, int(rng.integers(2**31)), hidden)
        made.write(folder / f"r{number}")
        drawn.append((f"r{number}", made.truth))
    return drawn


def _rows_of_set(report: dict) -> set[int]:
    return {
        row
        for finding in report["findings"]
        for claim in (finding, *finding["equivalents"])
        for row in claim["rows"]
    }


def test_nothing_is_claimed_where_nothing_is_hidden(diagnosed):
    empty = [report for truth, report in diagnosed if not truth["hidden"]]
    assert len(empty) == EMPTY
    claimed = [f["physics"] for report in empty for f in report["findings"]]
    assert not claimed, claimed


def test_clear_physics_is_named(diagnosed):
    clear = [
        (truth["hidden"][0], report)
        for truth, report in diagnosed
        if truth["hidden"] and truth["hidden"][0]["visible"] >= CLEAR
    ]
    assert len(clear) >= 8
    right = [bool(set(h["rows"]) & _rows_of_set(report)) for h, report in clear]
    wrong = [
        (h["effect"], [f["physics"] for f in report["findings"]])
        for (h, report), ok in zip(clear, right, strict=True)
        if not ok
    ]
    assert np.mean(right) >= 0.8, wrong


def test_what_is_found_improves_the_held_out_epochs(diagnosed):
    for _, report in diagnosed:
        for finding in report["findings"]:
            assert finding["heldout_share"]["value"] > 0.0, finding["physics"]


def test_the_recordings_tell_nothing(diagnosed, world):
    keys = Counter(h["effect"] for truth, _ in diagnosed for h in truth["hidden"])
    assert len(keys) >= 15
    texts = [report["recording"] for _, report in diagnosed]
    assert not any(key in text for key in keys for text in texts)
