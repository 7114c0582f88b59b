"""The ports of the model chain: named scalar perturbations that are zero in the plain model.

A port is one field here and one use in `jaxvm.physics.chain`. Everything that an effect, a
hypothesis or a temperature model does to a prediction, it does through a port.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STAGES = (
    "target",
    "structure",
    "shutter",
    "medium",
    "station",
    "mount",
    "lens",
    "sensor",
    "detection",
    "range",
)
"""The stages of the chain, from the mark to the measured number."""


@dataclass(frozen=True)
class Port:
    """One named perturbation of the chain.

    Attributes:
        name: name in the form `stage.quantity`.
        stage: the stage of the chain where it enters.
        unit: unit of the perturbation ("1" is a ratio).
        largest: the largest perturbation that is still physics and not a mistake, in its unit; an
            effect has a prior of this width.
        meaning: what a positive value does, in words.
    """

    name: str
    stage: str
    unit: str
    largest: float
    meaning: str


def _axes(prefix: str, stage: str, unit: str, largest: float, meaning: str) -> tuple[Port, ...]:
    return tuple(Port(f"{prefix}_{a}", stage, unit, largest, meaning.format(axis=a)) for a in "xyz")


PORTS: tuple[Port, ...] = (
    Port("target.scale", "target", "1", 0.02, "the target grows about its centre"),
    Port("target.scale_x", "target", "1", 0.02, "the target grows along its x axis only"),
    Port("target.scale_y", "target", "1", 0.02, "the target grows along its y axis only"),
    Port("target.bow_x", "target", "m", 0.05, "the middle rises along +z against the x edges"),
    Port("target.bow_y", "target", "m", 0.05, "the middle rises along +z against the y edges"),
    Port(
        "target.twist", "target", "m", 0.05, "the corners where x and y agree in sign rise along +z"
    ),
    *_axes("target.point", "target", "m", 0.02, "a mark moves along the target's {axis} axis"),
    Port("target.disc", "target", "m²", 0.05, "the squared radius of discs taken for points"),
    *_axes(
        "structure.shift", "structure", "m", 0.5, "the target moves along the world's {axis} axis"
    ),
    *_axes(
        "structure.turn", "structure", "rad", 0.1, "the target turns about the world's {axis} axis"
    ),
    Port("clock.offset", "shutter", "s", 0.1, "the exposure is later than the recorded time"),
    Port("shutter.row_time", "shutter", "s", 0.2, "the last row is exposed later than the first"),
    Port(
        "medium.bend_u",
        "medium",
        "rad/m",
        0.0001,
        "a path of length L displaces the mark L²/2 along u",
    ),
    Port(
        "medium.bend_v",
        "medium",
        "rad/m",
        0.0001,
        "a path of length L displaces the mark L²/2 along v",
    ),
    Port(
        "medium.layers_up",
        "medium",
        "rad/m",
        0.0001,
        "layered air displaces a mark at the distance L by L²/2 upwards",
    ),
    Port(
        "medium.layers_x",
        "medium",
        "rad/m",
        0.0001,
        "layered air displaces a mark at the distance L by L²/2 along the first level axis",
    ),
    Port(
        "medium.layers_y",
        "medium",
        "rad/m",
        0.0001,
        "layered air displaces a mark at the distance L by L²/2 along the second level axis",
    ),
    Port("medium.window", "medium", "m", 0.05, "thickness of a plane glass plate before the lens"),
    Port("medium.wedge_x", "medium", "rad", 0.02, "wedge of a glass plate that shifts marks to +u"),
    Port("medium.wedge_y", "medium", "rad", 0.02, "wedge of a glass plate that shifts marks to +v"),
    *_axes(
        "medium.dome",
        "medium",
        "m",
        0.03,
        "the middle of a dome lies off the pupil along the camera's {axis} axis",
    ),
    *_axes("station.turn", "station", "rad", 0.02, "the station turns about its own {axis} axis"),
    *_axes("station.shift", "station", "m", 0.1, "the station moves along its own {axis} axis"),
    *_axes("mount.turn", "mount", "rad", 0.02, "the camera turns about its own {axis} axis"),
    *_axes("mount.shift", "mount", "m", 0.1, "the camera moves along its own {axis} axis"),
    Port("lens.k1", "lens", "1", 0.3, "radial distortion of the third order"),
    Port("lens.k2", "lens", "1", 0.3, "radial distortion of the fifth order"),
    Port("lens.k3", "lens", "1", 0.3, "radial distortion of the seventh order"),
    Port("lens.p1", "lens", "1", 0.02, "decentring distortion, first coefficient"),
    Port("lens.p2", "lens", "1", 0.02, "decentring distortion, second coefficient"),
    Port("lens.tilt_x", "lens", "rad", 0.05, "the sensor tilts about x behind the lens"),
    Port("lens.tilt_y", "lens", "rad", 0.05, "the sensor tilts about y behind the lens"),
    Port(
        "lens.entrance", "lens", "m", 0.03, "the entrance pupil moves forward with the field angle²"
    ),
    Port("sensor.focal", "sensor", "1", 0.05, "the principal distance grows"),
    Port("sensor.aspect", "sensor", "1", 0.02, "the principal distance along u grows"),
    Port("sensor.cx", "sensor", "px", 30.0, "the principal point moves along u"),
    Port("sensor.cy", "sensor", "px", 30.0, "the principal point moves along v"),
    Port("sensor.skew", "sensor", "1", 0.02, "rows shear along u"),
    Port("detect.u", "detection", "px", 3.0, "the detector measures u too large"),
    Port("detect.v", "detection", "px", 3.0, "the detector measures v too large"),
    Port("range.offset", "range", "m", 0.1, "the rangefinder measures too long by a constant"),
    Port("range.scale", "range", "1", 0.01, "the rangefinder measures too long in proportion"),
)
"""All ports, in the order of the chain."""

PORT_INDEX: dict[str, int] = {port.name: index for index, port in enumerate(PORTS)}
"""Column of each port in a vector of port values."""

N_PORTS = len(PORTS)


DEAR = "target.disc"
"""The port that takes as long as all others together: the chain leaves it out where nothing feeds
it."""

ALL_PORTS = tuple(range(N_PORTS))
CHEAP_PORTS = tuple(k for k in ALL_PORTS if PORTS[k].name != DEAR)


class PortValues:
    """Read a vector of port values by name; without a vector every port is exactly zero.

    `fed` are the ports that may be other than zero.

    The vector is split once, by one operation whose transpose is one concatenation; slicing it port
    by port would cost a padded sum for each in reverse mode.
    """

    def __init__(
        self, values: Float[Array, " ports"] | None = None, fed: tuple[int, ...] = ALL_PORTS
    ):
        self.plain = values is None
        self.fed = frozenset(() if self.plain else fed)
        if values is not None:
            self._values = [part[0] for part in jax.lax.split(values, (1,) * N_PORTS)]

    def held(self) -> "PortValues":
        """The same values, which are not differentiated."""
        held = PortValues()
        if not self.plain:
            held.plain, held.fed = False, self.fed
            held._values = jax.lax.stop_gradient(self._values)
        return held

    def __getitem__(self, name: str) -> Float[Array, ""] | float:
        """Value of one port, in its unit."""
        port = PORT_INDEX[name]
        return self._values[port] if port in self.fed else 0.0

    @property
    def dear(self) -> bool:
        """Whether the dear port may be other than zero."""
        return PORT_INDEX[DEAR] in self.fed

    def axes(self, prefix: str) -> Float[Array, "3"]:
        """The three components `prefix_x, prefix_y, prefix_z`."""
        return jnp.stack([jnp.asarray(self[f"{prefix}_{axis}"]) for axis in "xyz"])
