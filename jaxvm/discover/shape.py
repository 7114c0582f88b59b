"""The shape of a free-form curve in words: what an engineer would say who looks at the plot."""

import numpy as np
from scipy.interpolate import BSpline

from jaxvm.physics.effects import Effect
from jaxvm.physics.forms import N_KNOTS

_SAMPLES = 200
_FLAT = 0.12
"""Swings smaller than this share of the whole range are not counted."""


def curve(effect: Effect, term: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Driver and value of one term of a free-form curve, over the span of its knots."""
    first, spacing = effect.constants
    n = N_KNOTS[effect.form]
    x = np.linspace(first + spacing, first + (n - 2) * spacing, _SAMPLES)
    own = np.asarray(effect.amplitudes).reshape(len(effect.terms), n)[term]
    spline = BSpline.basis_element(spacing * np.arange(-2.0, 3.0), extrapolate=False)
    knots = first + spacing * np.arange(n)
    return x, np.nan_to_num(spline(x[:, None] - knots)) @ own


def shape_words(effect: Effect) -> str:
    """The shape of the strongest term of a free-form curve; "" for other forms."""
    if effect.form not in N_KNOTS or not effect.amplitudes:
        return ""
    curves = [curve(effect, term) for term in range(len(effect.terms))]
    x, y = max(curves, key=lambda pair: np.ptp(pair[1]))
    return f"{describe_curve(x, y)} with {effect.driver}"


def describe_curve(x: np.ndarray, y: np.ndarray) -> str:
    """One phrase for a curve: rises, settles, there and back, swings so many times."""
    turns = turning_points(y)
    if not turns:
        way = "rises" if y[-1] > y[0] else "falls"
        middle = np.interp(0.5 * (x[0] + x[-1]), x, (y - y[0]) / (y[-1] - y[0]))
        if middle > 0.65:
            return f"{way} fast at first and settles"
        if middle < 0.35:
            return f"{way} slowly at first, then faster"
        steepest = np.max(np.abs(np.gradient(y, x))) * (x[-1] - x[0]) / np.ptp(y)
        return f"{way} mostly in one place" if steepest > 3.0 else f"{way} evenly"
    if len(turns) == 1:
        back = abs(y[-1] - y[0]) < 0.35 * np.ptp(y)
        up = y[turns[0]] > y[0]
        if back:
            return "goes up and comes back" if up else "goes down and comes back"
        return "rises, then falls a little" if up else "falls, then rises a little"
    gaps = np.diff(x[turns])
    even = len(gaps) < 2 or np.std(gaps) < 0.25 * np.mean(gaps)
    period = 2.0 * float(np.mean(gaps))
    steady = f"about every {period:.3g}" if even else "unevenly"
    return f"swings {len(turns) / 2.0:.1f} times, {steady}"


def turning_points(y: np.ndarray) -> list[int]:
    """Positions of the maxima and minima that stand out by a share of the range."""
    least = _FLAT * np.ptp(y)
    turns, extreme, direction = [], 0, 0
    for k in range(1, len(y)):
        if direction >= 0 and y[k] > y[extreme] or direction <= 0 and y[k] < y[extreme]:
            if direction == 0 and abs(y[k] - y[0]) > least:
                direction = 1 if y[k] > y[0] else -1
            if direction != 0 or abs(y[k] - y[0]) > abs(y[extreme] - y[0]):
                extreme = k
        elif direction != 0 and abs(y[k] - y[extreme]) > least:
            turns.append(extreme)
            direction, extreme = -direction, k
    return turns
