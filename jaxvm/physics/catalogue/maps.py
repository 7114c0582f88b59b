"""Smooth maps over the image and over plates: bumps on a regular grid of tiles."""

from jaxvm.physics.catalogue.entry import Terms
from jaxvm.physics.drivers import PLANES
from jaxvm.physics.effects import Term


def image_map() -> Terms:
    """A smooth map of errors of the detector, along u and along v."""
    return _tiles("detect.u", "image", 5, 4) + _tiles("detect.v", "image", 5, 4)


def fine_image_map() -> Terms:
    """The same with finer tiles, for dents and fringes."""
    return _tiles("detect.u", "fine image", 9, 7) + _tiles("detect.v", "fine image", 9, 7)


def finest_image_map() -> Terms:
    """The same with tiles that need a prior to be known."""
    tiles = [_tiles(f"detect.{axis}", "finest image", 20, 15) for axis in "uv"]
    return tiles[0] + tiles[1]


def height_map() -> Terms:
    """A smooth map of the local principal distance: the height of the sensor's surface."""
    return _tiles("sensor.focal", "image", 5, 4)


def plate_map() -> Terms:
    """A smooth surface by which a plate stands off its plane."""
    return _tiles("target.point_z", "plate", 5, 5)


def fine_plate_map() -> Terms:
    """The same with tiles that need a prior to be known."""
    return _tiles("target.point_z", "fine plate", 11, 11)


def _tiles(port: str, plane: str, columns: int, rows: int) -> Terms:
    width = PLANES[plane][2]
    return tuple(
        Term(port, plane, "tile", (width * (i - (columns - 1) / 2), width * (j - (rows - 1) / 2)))
        for j in range(rows)
        for i in range(columns)
    )
