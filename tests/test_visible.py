"""What a recording can't show: effects that the model's own unknowns take over."""

from dataclasses import replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.score import ScoreTests
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.discover.visible import absorbed
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.solve.adjust import adjust, pixel_rms

CAMERA, BOARD = Scope(camera=("cam",)), Scope(target=("board",))


def cant_show(free: frozenset[str]) -> tuple[str, ...]:
    """Of a board before a camera with these unknowns; the board's pose is free in every image."""
    fitted = adjust(board_recording(n_epochs=12, free=free).true_scene(), check=False)
    tests = ScoreTests.of(fitted, enumerate_hypotheses(fitted.scene))
    return absorbed(tests.score(1.0), fitted.scene)


def test_free_unknowns_conceal_what_is_like_them():
    known, free = cant_show(frozenset()), cant_show(frozenset({"focal", "centre"}))
    # Wherever the board is put, its pose is free.
    assert {"target-moved", "camera-displaced"} <= set(known) & set(free)
    assert {"focal-wrong", "principal-point-wrong"} <= set(free) - set(known)
    assert not {"focal-drift", "target-bow", "mark-displaced"} & {*known, *free}
    assert list(free) == sorted(set(free))


@pytest.mark.parametrize(
    "terms, scope, driver, form, constants, amplitude, left",
    [
        (("target.point_x",), BOARD, "time", "step", (3.5,), 5e-3, False),
        (("sensor.focal",), CAMERA, "constant", "constant", (), 1e-3, False),
        (("target.bow_x",), BOARD, "constant", "constant", (), 1e-3, True),
    ],
)
def test_what_is_absorbed_leaves_no_residuals(
    terms, scope, driver, form, constants, amplitude, left
):
    """A board that was moved, or a wrong focal length, is fitted without them to the last digit."""
    known = board_recording(n_epochs=12, noise=0.0, free=frozenset({"focal", "centre"}))
    effect = Effect(
        "it", tuple(map(Term, terms)), driver, form, constants, 0.0, scope, (amplitude,)
    )
    pixel = predicted(known.true_scene().with_effects((effect,), (8, 4)))
    assert np.abs(pixel - known.recording.observations.pixel).max() > 0.1
    observations = replace(known.recording.observations, pixel=pixel)
    fitted = adjust(known.true_scene(replace(known.recording, observations=observations)))
    rms = pixel_rms(fitted.scene, fitted.residuals())
    assert (rms > 1e-2) if left else (rms < 1e-6)
