"""A network described in a short TOML: what every key means, and what it comes to.

Ten lines make a scene; only `layout` is needed:

    layout = "ship"
    [time]
    epochs = 24
    [deformation]
    bending_m = 0.02

| table and key | default | meaning |
|---|---|---|
| `layout` | | ship, tunnel, bridge, wind-tunnel, chain, ring, station, random |
| `name` | the layout | what the recording is called |
| `stations` | by layout | number of stations (wind-tunnel: outer ones and sections of the model) |
| `held` | `[first]` | names of the stations whose poses are given: the gauge |
| `observe` | `"pixels"` | pixels, links (relative poses alone) or both |
| `seed` | 0 | draws what is random in the network; the noise has a seed of its own |
| **[structure]** | | sizes of the layout: |
| `length_m`, `width_m` | 120, 16 | ship, with `decks` = 2 and `deck_height_m` = 6 |
| `length_m`, `width_m` | 200, 10 | tunnel, with `radius_m` = 400 of its curve |
| `length_m`, `width_m` | 300, 12 | bridge, with `towers` = 2, `tower_height_m` = 60 and \
`tower_stations` = 2 on each |
| `outer` | 4 | wind-tunnel: stations around the model, with `span_m` = 2 and `distance_m` = 3 |
| `spacing_m` | 10 | chain, ring, random: from station to station |
| `distance_m` | 3 | station: from its cameras to the frame around, with `moved_m` = 0.1 and \
`moved_rad` = 0.05, by which the frame is moved in every epoch |
| **[sights]** | | who sees whom: |
| `reach_m` | by layout | how far cameras see |
| `both_ways` | by layout | whether a line is looked along from both ends (ship, tunnel, bridge) |
| `redundancy` | 3 | random: mean number of sight lines per station |
| **[cameras]** | | |
| `each` | `"sight"` | one camera for each sight line, or `"sector"`s all around |
| `count` | 6 | cameras of the layout station; sectors of a station (4) |
| `focal_px` | by layout | sectors: a tenth wider than they have to be |
| `image_size` | `[2448, 2048]` | px |
| `lens`, `distortion` | `"pinhole"` | as in recording.toml; known |
| `margin_px` | 20 | border of the image where no mark is used |
| `pose` | `"known"` | on the station: known, or free from a rough start value |
| **[marks]** | | what stations carry to be seen: |
| `kind` | `"body"` | body: marks in 3-D, seen from all sides; plate: one grid, towards all \
who see it; plates: a grid for each of them |
| `count` | 16, 4 | marks of a body; rows and columns of a plate |
| `size_m` | by layout | diameter of the body, side of the plate |
| `tilt_deg` | 0 | turn of a plate out of the line of sight; 30 gives twenty times better turns |
| `incidence_deg` | 65 | steepest view in which the marks of a plate are found |
| **[time]** | | |
| `epochs` | 1 | |
| `interval_s` | 600 | |
| **[deformation]** | none | stations that are not held move: |
| `bending_m`, `sway_m` | 0 | up and down, and to the sides, at the far end |
| `settling_m` | 0 | down at the far end, for good |
| `torsion_rad` | 0 | about the long axis, at the far end |
| `period_s` | 1.6 times all epochs | of bending and torsion; sway has half of it |
| **[temperature]** | none | a day, logged in drivers.csv: |
| `mean_degC`, `swing_K` | 15, 8 | of the air |
| `rise_K` | 12 | of a camera's body above the air, when it has warmed up |
| `body_lag_s` | 2400 | time constant of a body |
| `bodies` | true | whether the bodies of the cameras are logged |
| `every_s` | 300 | from reading to reading |
| `noise_K` | 0.01 | of a reading |
| **[[effects]]** | none | what temperature does to the cameras: |
| `port`, `per_K` | | a port of mount, lens, sensor or detection, in its unit per kelvin |
| `driver` | `"body"` | of each camera its body, or `"ambient"` |
| `lag_s` | 0 | time constant with which it follows |
| `model` | `"hidden"` | known (amplitude given as start), free (start at zero), hidden: not \
in the model |
| `camera` | all | names of cameras |
| **[links]** | | relative poses of the stations along the lines: |
| `sigma_rad`, `sigma_m` | 5e-5, 2e-4 | standard deviations |
| `turn_factor` | 1 | how much worse turns out of the image plane are than the roll |
| `depth_factor` | 1 | how much worse the depth is than the sides |
| **[noise]** | | |
| `pixel_px` | 0.05 | of an image coordinate |
"""

from dataclasses import dataclass

import numpy as np

from jaxvm.recording.entries import Entry
from jaxvm.recording.errors import RecordingError, in_file


@dataclass(frozen=True, eq=False)
class Cameras:
    """What cameras a station has; `focal_px` None: what sectors need."""

    each: str
    count: int
    focal_px: float
    image_size: tuple[int, int]
    lens: str
    distortion: np.ndarray
    margin_px: float
    free: bool


@dataclass(frozen=True)
class Marks:
    """What a station carries to be seen (m, rad)."""

    kind: str
    count: int
    size_m: float
    tilt: float
    incidence: float


@dataclass(frozen=True)
class Temperature:
    """A day, and how bodies of cameras follow (degC, K, s)."""

    mean_degC: float
    swing_K: float
    rise_K: float
    body_lag_s: float
    bodies: bool
    every_s: float
    noise_K: float


@dataclass(frozen=True)
class ThermalEffect:
    """What a temperature does to cameras: port, size per kelvin, driver, lag (s), and whether the
    model knows it, estimates it or has nothing of it."""

    port: str
    per_K: float
    driver: str
    lag_s: float
    model: str
    camera: tuple[str, ...]
    entry: Entry


@dataclass(frozen=True)
class LinkNoise:
    """Standard deviations of links, and how much worse the bad directions are."""

    sigma_rad: float
    sigma_m: float
    turn_factor: float
    depth_factor: float


@dataclass(frozen=True, eq=False)
class Description:
    """A described network, with all defaults; the table in the module's head says what is what.

    Attributes:
        source: the file's content, for errors with its lines.
        file: its name.
        structure: sizes of the layout.
        deformation: amplitude of each mode; empty: nothing moves.
    """

    source: Entry
    file: str
    name: str
    layout: str
    stations: int
    held: tuple[str, ...]
    observe: str
    seed: int
    structure: dict[str, float]
    reach_m: float | None
    both_ways: bool
    redundancy: float
    cameras: Cameras
    marks: Marks
    epochs: int
    interval_s: float
    deformation: dict[str, float]
    period_s: float
    temperature: Temperature | None
    effects: tuple[ThermalEffect, ...]
    links: LinkNoise
    pixel_px: float

    def error(self, table: str, key: str | None, problem: str) -> RecordingError:
        """Error at a key of a table ("": of the file itself), with the file and its line."""
        entry = self.source.entry(table) if table else self.source
        if table and table not in self.source:
            # What is not written has no line: the layout it comes from has one.
            entry, key = self.source, "layout"
        return self.error_at(entry, key, problem)

    def error_at(self, entry: Entry, key: str | None, problem: str) -> RecordingError:
        """Error at a key of an entry of the file (None: at the entry itself)."""
        return in_file(entry.error(key, problem), self.file)
