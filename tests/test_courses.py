"""Courses of the grid: nothing that a body may do with a temperature falls between them."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from networks import board_recording

from jaxvm.discover.courses import enumerate_courses
from jaxvm.physics.forms import BASES, FORMS
from jaxvm.recording.recording import Drivers

AIR, EVERY_S, N_EPOCHS = "ambient_degC", 600.0, 40


@pytest.fixture(scope="module")
def grid():
    """Courses of the air, read every minute, over epochs of ten minutes; each at the epochs."""
    known = board_recording(n_epochs=N_EPOCHS)
    at = EVERY_S * np.arange(N_EPOCHS)
    log = np.arange(0.0, at[-1] + 60.0, 60.0)
    # A cycle of an hour on a slow rise: what is late by minutes shows.
    air = 20.0 + 1.5 * np.sin(2.0 * np.pi * log / 3600.0) + 3.0 * log / log[-1]
    recording = replace(known.recording, time=at, drivers=Drivers(log, {AIR: air}))
    courses = [c for c in enumerate_courses(known.true_scene(recording)) if c.driver == AIR]

    def column(form: str, constants: tuple[float, ...]) -> np.ndarray:
        padded = jnp.asarray([*constants, 1.0, 1.0][:2])
        values = [BASES[b](jnp.asarray(air - 20.0), jnp.asarray(log), padded) for b in
                  FORMS[form].bases]  # fmt: skip
        return np.stack([np.interp(at, log, np.asarray(v)) for v in values], axis=1)

    return courses, column


LATE = 120.0, 250.0, 400.0, 700.0, 1500.0, 3000.0


@pytest.mark.parametrize("truth, late", [
    *(("lag", late) for late in LATE),
    *(("transient", late) for late in LATE),
    *(("delay", late) for late in LATE[:-1]),  # no body is dead for longer
])  # fmt: skip
def test_whatever_is_late_has_a_course_like_it(grid, truth, late):
    courses, column = grid
    own = column(truth, (late,))[:, 0]
    own = own - own.mean()
    # By courses of its own kind: with enough other ones anything is explained.
    kinds = {"lag": ("linear", "lag"), "delay": ("linear", "delay")}
    kinds = kinds.get(truth, ("rate", "transient"))
    best = 0.0
    for course in courses:
        if course.form in kinds:
            like = column(course.form, course.constants)
            like = like - like.mean(axis=0)
            left = own - like @ np.linalg.lstsq(like, own, rcond=None)[0]
            best = max(best, 1.0 - float(left @ left) / float(own @ own))
    # A refit finds the dead time from as far as that.
    assert best > (0.85 if truth == "delay" else 0.93)


@pytest.mark.parametrize("n_epochs", [6, 7, 8, 40])
def test_no_course_is_asked_twice(n_epochs):
    """Of a handful of epochs, too, whose third is shorter than two spacings."""
    known = board_recording(n_epochs=n_epochs)
    at = EVERY_S * np.arange(n_epochs)
    drivers = Drivers(at, {AIR: 20.0 + np.sqrt(at)})
    recording = replace(known.recording, time=at, drivers=drivers)
    courses = enumerate_courses(known.true_scene(recording))
    lags = [c.constants[0] for c in courses if (c.driver, c.form) == (AIR, "transient with state")]
    assert lags == sorted(lags) and lags[-1] == pytest.approx(EVERY_S * (n_epochs - 1) / 3.0)
    assert len(set(courses)) == len(courses)
