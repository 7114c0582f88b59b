"""Free-form curves in words."""

import numpy as np
import pytest

from jaxvm.discover.curves import curve_constants
from jaxvm.discover.shape import curve, describe_curve, shape_words, turning_points
from jaxvm.physics.effects import Effect, Term
from jaxvm.physics.forms import N_KNOTS

X = np.linspace(0.0, 10.0, 200)

SHAPES = {
    "rises evenly": X,
    "falls evenly": 3.0 - 2.0 * X,
    "rises fast at first and settles": 1.0 - np.exp(-X),
    "falls fast at first and settles": np.exp(-X),
    "rises slowly at first, then faster": X**4,
    "rises mostly in one place": np.tanh(3.0 * (X - 5.0)),
    "goes up and comes back": np.exp(-((X - 5.0) ** 2)),
    "goes down and comes back": -np.exp(-((X - 5.0) ** 2)),
    "swings 4.0 times, about every 2.51": np.sin(2.0 * np.pi * X / 2.5),
    "swings 4.0 times, unevenly": np.sin(X**2 / 4.0),
}


@pytest.mark.parametrize("words", SHAPES)
def test_shapes_are_called_what_they_are(words):
    assert describe_curve(X, SHAPES[words]) == words


def test_small_ripples_are_no_swings():
    assert not turning_points(X + 0.1 * np.sin(8.0 * X))
    assert len(turning_points(X + 3.0 * np.sin(2.0 * X))) > 2


def test_the_strongest_term_of_a_curve_speaks():
    """Amplitudes at the knots of a wave; the other term is a hundred times weaker."""
    first, spacing = curve_constants(0.0, 8.0)
    knots = first + spacing * np.arange(N_KNOTS["curve"])
    wave, slope = np.sin(2.0 * np.pi * knots / 4.0), 0.01 * knots
    effect = Effect(
        "turn",
        (Term("mount.turn_x"), Term("mount.turn_y")),
        "time",
        "curve",
        (first, spacing),
        amplitudes=(*slope, *wave),
    )
    x, y = curve(effect, 0)
    assert (x[0], x[-1]) == pytest.approx((0.0, 8.0))
    np.testing.assert_allclose(y, 0.01 * x, atol=1e-12)  # splines reproduce a straight line
    assert shape_words(effect).startswith("swings 2.0 times, about every 3.99")
    assert shape_words(Effect("x", (Term("sensor.focal"),))) == ""
