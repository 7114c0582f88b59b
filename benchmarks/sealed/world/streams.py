"""Independent random streams of one recording, so that a plan changes nothing but what it says."""

import zlib

import numpy as np


def stream(kind, seed, name):
    """Generator for one purpose ("geometry", "hidden", "noise" ...) of one recording."""
    return np.random.default_rng([zlib.crc32(kind.encode()), int(seed), zlib.crc32(name.encode())])
