"""Drift as it is seen: how every mark has moved over the image, and when it comes to rest."""

import numpy as np
from jaxtyping import Bool, Float

from jaxvm.identify.identify import Identified
from jaxvm.recording import Recording


def drift_map(
    recording: Recording,
    camera: str,
    first: Bool[np.ndarray, " epochs"],
    second: Bool[np.ndarray, " epochs"],
) -> tuple[Float[np.ndarray, "marks 2"], Float[np.ndarray, "marks 2"]]:
    """Mean place of every mark (px) in one set of epochs, and its displacement (px) in another.

    Of marks that a camera sees in both; what moves by itself is not told from what drifts.

    Raises:
        ValueError: there is no such camera, or no mark is seen in both.
    """
    names = [own.name for own in recording.model.cameras]
    if camera not in names:
        raise ValueError(f'there is no camera "{camera}" (there are: {", ".join(names)})')
    obs = recording.observations
    own = obs.camera == names.index(camera)
    mark = obs.target * 1_000_000 + obs.point
    places = []
    for chosen in (first, second):
        rows = own & np.asarray(chosen)[obs.epoch]
        marks, where = np.unique(mark[rows], return_inverse=True)
        total = np.stack(
            [np.bincount(where.ravel(), weights=obs.pixel[rows, k]) for k in (0, 1)], axis=1
        )
        places.append((marks, total / np.bincount(where.ravel())[:, None]))
    both = np.intersect1d(places[0][0], places[1][0])
    if not len(both):
        raise ValueError("no mark is seen in both sets of epochs; take wider ones")
    a, b = (at[np.searchsorted(marks, both)] for marks, at in places)
    return a, b - a


def settled_after(found: Identified, window: float = 600.0) -> float | None:
    """Time (s, on the clock of the epochs) from which on the image rests.

    At rest the marks drift less (RMS) than the noise of a pixel coordinate within a window (s), by
    the identified model. None where they never do for the rest of the recording, which has to be
    six windows long at least.
    """
    courses, time = found.fit.courses, found.trajectories.time
    later = np.array([np.interp(time + window, time, column) for column in courses.T]).T
    inside = time + window <= time[-1]
    step = found.trajectories.pixels_per_mode * np.linalg.norm(later - courses, axis=1)
    moving = np.flatnonzero((step >= found.trajectories.pixel_sigma) & inside)
    if not len(moving):
        return float(time[0])
    after = min(moving[-1] + 1, len(time) - 1)
    return float(time[after]) if time[-1] - time[after] > 6.0 * window else None
