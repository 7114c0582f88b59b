"""Numbers of a network in words: lengths, angles, probabilities, and the verdict."""

from typing import Any

_LENGTHS = ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm"))
_ANGLES = ((1.0, "rad"), (1e-3, "mrad"), (1e-6, "µrad"), (1e-9, "nrad"))

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def length(metres: float | None) -> str:
    """A length with three digits and the unit that suits it; a dash where there is none."""
    return _scaled(metres, _LENGTHS)


def angle(radians: float | None) -> str:
    """An angle with three digits and the unit that suits it; a dash where there is none."""
    return _scaled(radians, _ANGLES)


def _scaled(value: float | None, units: tuple[tuple[float, str], ...]) -> str:
    if value is None:
        return "–"
    if value == 0.0:
        return f"0 {units[0][1]}"
    fitting = (entry for entry in units if abs(value) >= 0.9995 * entry[0])
    unit, name = next(fitting, units[-1])
    return f"{number(value / unit)} {name}"


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many digits, thousands set apart; a dash where there is none."""
    if value is None:
        return "–"
    if value == 0.0:
        return "0"
    mantissa, _, power = f"{value:.{digits - 1}e}".partition("e")
    if not -4 <= int(power) < 7:
        return f"{mantissa}·10{str(int(power)).translate(_RAISED)}"
    return f"{value:,.{max(digits - 1 - int(power), 0)}f}"


def counted(count: int, noun: str) -> str:
    """A count with its noun."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def verdict(document: dict[str, Any]) -> dict[str, str]:
    """The page's first lines: whether it fits, in a word and in sentences.

    Returns:
        "word" (fits, too large, too small, not converged, unchecked), "network" and "fit".
    """
    a = document["adjustment"]
    bodies = [
        counted(a[kind], noun)
        for kind, noun in (("stations", "station"), ("targets", "target"), ("cameras", "camera"))
        if a[kind]
    ]
    joints = [
        counted(a[kind], noun)
        for kind, noun in (("links", "link"), ("sight_lines", "sight line"))
        if a[kind]
    ]
    network = f"{' and '.join(bodies) or 'no body'} joined by {' and '.join(joints) or 'nothing'}"
    n = a["independent_cycles"]
    network += f"; {counted(n, 'independent cycle')} of six conditions each" if n else "; no cycle"
    bounds, factor = a["variance_factor_bounds_95"], a["variance_factor"]
    if not a["converged"]:
        return {"word": "not converged", "network": network, "fit": a["why"]}
    if bounds is None or factor is None:
        fit = "there are as many observations as unknowns: nothing checks the result"
        return {"word": "unchecked", "network": network, "fit": fit}
    low, high = bounds
    range_ = f"{number(factor, 4)}, 95 % bounds {low:.3f} to {high:.3f}"
    if factor > high:
        fit = f"variance factor {range_}: residuals are larger than the stated sigmas allow; "
        return {
            "word": "residuals too large", "network": network,
            "fit": fit + "look for gross errors, or sigmas that are too small",
        }  # fmt: skip
    if factor < low:
        fit = f"variance factor {range_}: residuals are smaller than the stated sigmas; "
        return {
            "word": "residuals too small", "network": network,
            "fit": fit + "the sigmas are too large, or were no standard deviations",
        }  # fmt: skip
    fit = f"variance factor {range_}: the residuals are as large as the stated sigmas say"
    return {"word": "consistent", "network": network, "fit": fit}
