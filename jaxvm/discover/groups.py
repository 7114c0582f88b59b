"""Groups: what an effect may enter through, and the kind of body that has it.

A group is one port or several, plain or with a pattern over the observations. The catalogue lists
further ones; those here are asked without a name, too.
"""

from dataclasses import dataclass

from jaxvm.network.scene import Scene
from jaxvm.physics.catalogue import CATALOGUE
from jaxvm.physics.effects import Term
from jaxvm.physics.ports import PORTS

_ENTITY_OF_STAGE = {
    "target": "target",
    "structure": "target",
    "station": "station",
    "medium": "station",
    "shutter": "camera",
    "mount": "camera",
    "lens": "camera",
    "sensor": "camera",
    "detection": "camera",
    "range": "rangefinder",
}
_STAGE = {port.name: port.stage for port in PORTS}

_PATTERNS: tuple[tuple[str, str, tuple[float, ...]], ...] = (
    *((driver, basis, ()) for driver in ("row", "column") for basis in ("linear", "square")),
    *(("radius", basis, ()) for basis in ("linear", "square", "fourth", "sixth")),
    *((driver, "linear", ()) for driver in ("image_x", "image_y", "range", "inverse_range")),
    *(("incidence", basis, ()) for basis in ("linear", "square")),
    *((driver, "linear", ()) for driver in ("motion_u", "motion_v", "up_x", "up_y", "up_z")),
    *((d, basis, ()) for d in ("target_x", "target_y") for basis in ("linear", "square", "cube")),
    *(
        (driver, basis, (period,))
        for driver in ("pixel_u", "pixel_v")
        for period in (1.0, 2.0)
        for basis in ("sine", "cosine")
    ),
)
_TWICE = {("target.point_z", "target_x", "square"), ("target.point_z", "target_y", "square")}
"""Patterns that are ports by another name: these are `target.bow_x` and `bow_y`."""

_DOME = ("medium.dome_x", "medium.dome_y", "medium.dome_z")
_AS_NAMED = ("target.disc", "medium.wedge_x", "medium.wedge_y", *_DOME)
"""Ports that follow nothing: the size of marks stays, a window is there or is not."""

_PATTERNED_PORTS = ("detect.u", "detect.v", "sensor.focal", "target.point_z")


@dataclass(frozen=True)
class Group:
    """Terms that share a scope, and the kind of entity that has them."""

    terms: tuple[Term, ...]
    entity: str
    mark: tuple[int, int] | None = None
    """(target, point) when a single mark is meant."""
    target: str = ""
    """The only target that can have it, where the terms name its marks."""


def every_port() -> list[Group]:
    """Each port alone."""
    return [Group((Term(port.name),), entity_of(port.name)) for port in PORTS]


def single_groups() -> list[Group]:
    """Each port alone that means something without a pattern and without a name."""
    # A detector that measures too far everywhere is a principal point that moved, and what bends
    # rays for long is layered, alike for all cameras.
    other = ("detect.u", "detect.v", "medium.bend_u", "medium.bend_v", *_AS_NAMED)
    return [group for group in every_port() if group.terms[0].port not in other]


def patterned_groups() -> list[Group]:
    """One port with a pattern over the observations."""
    return [
        Group((Term(port, driver, basis, constants),), entity_of(port))
        for port in _PATTERNED_PORTS
        for driver, basis, constants in _PATTERNS
        if (port, driver, basis) not in _TWICE
    ]


def marks_of(scene: Scene) -> list[Group]:
    """Each mark that sits wrongly, of targets whose marks are not free."""
    groups = []
    alternatives = next(entry for entry in CATALOGUE if entry.entity == "mark").groups
    for t, target in enumerate(scene.model.targets):
        if "points" in target.free:
            continue
        marks = range(len(target.point_names))
        groups += [Group(terms, "mark", (t, p)) for terms in alternatives for p in marks]
    return groups


def is_special(group: Group) -> bool:
    """Whether a group is asked in the courses of its names alone.

    So are patterns that differ from observation to observation, and ports that don't move.
    """
    return any(
        term.driver not in ("one", "along_beam") or term.port in _AS_NAMED for term in group.terms
    )


def entity_of(port: str) -> str:
    """Kind of entity that has a port."""
    # A window belongs to its camera, the air to all cameras of a station alike.
    glass = port.startswith(("medium.window", "medium.wedge", "medium.dome"))
    return "camera" if glass else _ENTITY_OF_STAGE[_STAGE[port]]
