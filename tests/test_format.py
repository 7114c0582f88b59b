"""The reference of the format speaks of all that is read, and of nothing else."""

import re
from importlib.resources import files

from jaxvm.geometry.lenses import LENS_NAMES
from jaxvm.physics.drivers import CHANNEL_UNITS
from jaxvm.recording import parse
from jaxvm.recording.entries import Entry

TEXT = (files("jaxvm.recording") / "FORMAT.md").read_text(encoding="utf-8")


def documented() -> dict[str, set[str]]:
    """Keys of each table of recording.toml, as the reference lists them."""
    found: dict[str, set[str]] = {"": set()}
    table = ""
    for line in TEXT[TEXT.index("## recording.toml") :].splitlines():
        first = line.split("|")[1].strip() if line.startswith("|") else ""
        if head := re.fullmatch(r"\*\*\[+([a-z]+)(?:\.NAME)?\]+\*\*", first):
            table = head[1]
            found[table] = set()
        elif table or "`" in first:
            found[table] |= set(re.findall(r"`(\w+)`", first))
    return found


def test_every_key_that_is_read_is_told(monkeypatch):
    read: dict[str, set[str]] = {}
    only = Entry.only

    def noted(self, keys):
        # What is deeper than a body, or an entry of a list, has its keys told beside it.
        if len(self.path) <= 2:
            read.setdefault(str(self.path[0]) if self.path else "", set()).update(keys)
        return only(self, keys)

    monkeypatch.setattr(Entry, "only", noted)
    parse.parse_model(EVERYTHING, "")
    tables = set(read.pop("")) - {"format", "name"}
    told = documented()
    assert told.pop("") == {"format", "name"}
    assert set(told) == tables
    assert {name: told[name] for name in read} == read
    for word in (*LENS_NAMES, *CHANNEL_UNITS):
        assert f"`{word}`" in TEXT


EVERYTHING = {
    "format": 1,
    "cameras": {"left": {"image_size": [100, 100], "lens": "pinhole", "focal_px": [100.0, 100.0]}},
    "stations": {"left": {"motion": "static"}},
    "targets": {"deck": {"grid": {"rows": 2, "columns": 2, "spacing_m": 0.1}, "motion": "static"}},
    "rangefinders": {"laser": {"pose": {"turn_rad": [0.0] * 3, "shift_m": [0.0] * 3}}},
    "drivers": {"air_degC": {"description": "air"}},
    "noise": {},
    "world": {},
    "priors": [{"parameter": "cameras.left.focal", "value": [1.0, 1.0], "sigma": [1.0, 1.0]}],
    "closures": [{"links": ["a", "b"]}],
    "effects": [{"terms": [{"port": "sensor.focal"}], "amplitudes": [0.0]}],
}
