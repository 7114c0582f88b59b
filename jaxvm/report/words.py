"""A finding in words and numbers: parameters with units, sizes that can be read, when and where."""

import math
import re
from dataclasses import dataclass

import numpy as np

from jaxvm.discover.collocation import Signal
from jaxvm.discover.diagnosis import Diagnosis, Finding
from jaxvm.discover.heldout import Gain
from jaxvm.discover.scatter import ALIKE
from jaxvm.discover.shape import shape_words
from jaxvm.identify.inputs import are_power
from jaxvm.identify.model import CameraDrift
from jaxvm.physics.catalogue import BY_ID, Entry
from jaxvm.physics.drivers import channel_unit
from jaxvm.physics.effects import Effect
from jaxvm.physics.forms import FORMS
from jaxvm.physics.materials import length_of, materials_for
from jaxvm.physics.ports import PORTS

_HOPELESS = 0.05
"""Chance to decide below which a further recording is no advice."""

_PORT = {port.name: port for port in PORTS}

HAZE, STABILISER = BY_ID["haze"], BY_ID["image-jumps"]
"""What a random signal that the marks of an image share is called; and, of whole images, too."""

SIGNAL_WHEN = "in every image anew, alike for neighbouring marks"

_PER_DRIVER = {
    "linear": 1,
    "lag": 1,
    "delayed": 1,
    "play": 1,
    "square": 2,
    "ramp": 1,
    "rate": 1,
}
"""Power of the driver's unit under the unit of an amplitude, by basis."""


@dataclass(frozen=True)
class Parameter:
    """One number of a finding: value and standard deviation in `unit`."""

    name: str
    value: float
    std: float
    unit: str


def driver_unit(driver: str) -> str:
    """Unit of a driver, from the end of its name (temperature differences are in K)."""
    if driver.startswith("time"):
        return "s"
    known = channel_unit(driver)
    return known.unit if known else driver


def parameters(effect: Effect, stds: tuple[float, ...]) -> list[Parameter]:
    """Amplitudes and nonlinear constants of an effect with their units."""
    form = FORMS[effect.form]
    stds = stds or (float("nan"),) * (effect.n_columns + len(effect.constants))
    found, column = [], 0
    for term in effect.terms:
        for basis, label in zip(form.bases, form.labels, strict=True):
            name = term.port
            if term.driver != "one":
                name += f" ~ {term.driver}"
                if term.basis != "linear":
                    name += f" {term.basis}"
                if term.basis == "bump":
                    name += f" at {term.constants[0]:.2f}"
            if len(form.bases) > 1:
                name += f", {label}"
            per = _PER_DRIVER.get(basis, 0) if effect.driver != "constant" else 0
            unit = _per(_PORT[term.port].unit, driver_unit(effect.driver), per, basis == "rate")
            found.append(Parameter(name, effect.amplitudes[column], stds[column], unit))
            column += 1
    for k, constant in enumerate(form.constants):
        unit = constant.unit.replace("driver", driver_unit(effect.driver))
        found.append(
            Parameter(constant.name, effect.constants[k], stds[effect.n_columns + k], unit)
        )
    return found


def _per(unit: str, driver: str, power: int, hourly: bool) -> str:
    if power == 0:
        return unit
    driver = f"({driver})" if "/" in driver or " " in driver else driver
    below = driver if power == 1 else f"{driver}²"
    if hourly:
        below = f"({driver}/h)"
    return f"{unit}/{below}"


_SCALES = {
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm")),
    "rad": ((1.0, "rad"), (1e-3, "mrad"), (1e-6, "µrad"), (1e-9, "nrad")),
    "s": ((3600.0, "h"), (60.0, "min"), (1.0, "s"), (1e-3, "ms"), (1e-6, "µs")),
    "1": ((1.0, ""), (1e-2, "%"), (1e-6, "ppm")),
    "px": ((1.0, "px"), (1e-3, "mpx")),
}


def quantity(value: float, std: float, unit: str) -> str:
    """A value with its standard deviation in a unit that reads well: "-1.04 ± 0.01 mm"."""
    head, slash, below = unit.partition("/")
    scales = _SCALES.get(head, ((1.0, head),))
    least = 0.02 if head == "px" else 1.0
    scale, prefixed = next((s for s in scales if abs(value) >= least * s[0]), scales[-1])
    tail = f"{prefixed}{slash}{below}" if prefixed else (f"1/{below}" if slash else "")
    if not math.isfinite(std) or std <= 0.0:
        return f"{_significant(value / scale, 3)} {tail}".strip()
    digits = max(0, 1 - math.floor(math.log10(std / scale)))
    if digits > 6:
        return f"{_significant(value / scale, 4)} {tail}".strip()
    return f"{value / scale:.{digits}f} ± {std / scale:.{digits}f} {tail}".strip()


def _significant(value: float, digits: int) -> str:
    text = f"{value:.{digits}g}"
    return f"{float(text):g}" if re.search(r"e[+-]?\d", text) and 1e-4 < abs(value) < 1e6 else text


_CLEAR = 3.0
"""Standard deviations from which a lasting change of a camera is told."""


def lasting_drift(drift: CameraDrift) -> list[str]:
    """What a lasting change of its inputs does to a camera in the end, a line for each port.

    What is less than three standard deviations is left out; the largest in the training come first.
    """
    names, dynamics = drift.dynamics.inputs, drift.dynamics
    power = are_power(names)
    spans = [1.0 if on else drift.trained[n].high - drift.trained[n].low
             for n, on in zip(names, power, strict=True)]  # fmt: skip
    lines = []
    changes = zip(drift.ports, dynamics.stationary(), dynamics.stationary_sigma(), strict=True)
    for port, each, sigma in changes:
        told, unit = [], _PORT[port].unit
        for k in np.argsort(-np.abs(each) * spans):
            if abs(each[k]) > _CLEAR * sigma[k]:
                per = unit if power[k] else _per(unit, driver_unit(names[k]), 1, hourly=False)
                size = quantity(float(each[k]), float(sigma[k]), per)
                told.append(f"{size} {'after' if power[k] else 'of'} {names[k]}")
        lines += [f"{port} {', '.join(told)}"] if told else []
    return lines


def when(effect: Effect, stds: tuple[float, ...] = ()) -> str:
    """How an effect runs: "always", or with its driver and the constants of its form.

    Of these the standard deviations, where `stds` of all its parameters are given.
    """
    form = FORMS[effect.form]
    if effect.form == "constant":
        return "always"
    words = form.words.format(driver=effect.driver)
    unit = driver_unit(effect.driver)
    known = (*stds[effect.n_columns :], *(0.0 for _ in effect.constants))[: len(effect.constants)]
    named = [
        f"{constant.name} {quantity(value, std, constant.unit.replace('driver', unit))}"
        for constant, value, std in zip(form.constants, effect.constants, known, strict=True)
    ]
    return f"{words} ({', '.join(named)})" if named else words


def size(finding: Finding, final: bool = False) -> str:
    """All amplitudes of a finding in one phrase; a free-form curve by its range."""
    effect = finding.final_effect if final else finding.effect
    stds = finding.final_stds if final else finding.stds
    numbers = parameters(effect, stds)[: effect.n_columns]
    if len(numbers) > 4:
        values = [p.value for p in numbers]
        low, high = min(values), max(values)
        unit = numbers[0].unit
        return f"values between {quantity(low, 0.0, unit)} and {quantity(high, 0.0, unit)}"
    words = ", ".join(f"{p.name} {quantity(p.value, p.std, p.unit)}" for p in numbers)
    stuff = substance(effect, numbers)
    return f"{words}: {stuff}" if stuff else words


def substance(effect: Effect, numbers: list[Parameter]) -> str:
    """What grows with temperature as measured: materials of a plate, lengths of a bracket."""
    if len(numbers) != 1 or effect.form not in ("linear", "lag"):
        return ""
    (grown,) = numbers
    if effect.catalogue_id == "target-expansion" and grown.unit == "1/K":
        std = grown.std if math.isfinite(grown.std) else 0.0
        return " or ".join(materials_for(1e6 * grown.value, 1e6 * std)[:3])
    if effect.catalogue_id == "bracket-growth" and grown.unit == "m/K":
        lengths = (
            f"{quantity(length_of(grown.value, material), 0.0, 'm')} of {material}"
            for material in ("aluminium", "steel")
        )
        return "as " + " or ".join(lengths)
    return ""


def in_pixels(finding: Finding) -> float:
    """RMS (px) of what the finding explains on held-out epochs."""
    gain = finding.gain
    return math.sqrt(max(gain.before_px**2 - gain.after_px**2, 0.0))


def nearly_as_good(finding: Finding) -> str:
    """Hypotheses that were refitted too and fell behind only a little, by name."""
    names = dict.fromkeys(h.effect(()).name for h in finding.doubles)
    names.pop(finding.effect.name, None)
    return "; ".join(names)


def doubles(finding: Finding) -> list[str]:
    """What this recording can't tell the finding from: name, other driver, place, weight."""
    told = []
    for rival in finding.rivals:
        effect = rival.hypothesis.effect(())
        other = "" if effect.driver in ("constant", finding.effect.driver) else f", {when(effect)}"
        told.append(f"{effect.name}{other}, {effect.scope.words()} ({rival.weight:.2f})")
    return told


def mistaken_for(finding: Finding) -> str:
    """What the effect is easily taken for, by the catalogue."""
    entries = finding.hypothesis.entries
    return entries[0].mistaken_for if entries else ""


def separate_by(finding: Finding) -> str:
    """The recording that would part it from its doubles, the catalogue's where none would."""
    entries = finding.hypothesis.entries
    other = entries[0].separate_by if entries else "another driver's range, another geometry"
    if not finding.rivals:
        return f"{other} (by the catalogue)"
    if not finding.advice:
        return f"{other} (by the catalogue: these doubles are other names of it, or contain it)"
    best = finding.advice[0]
    rival = best.rivals[int(np.argmin(best.chances))].effect(()).name
    if best.chance < _HOPELESS:
        return f"{other} (no recording that was weighed tells it from “{rival}”)"
    told = f"expected odds {odds(best.odds)}, a chance of {best.chance:.0%} to tell it from"
    return f"record {best.plan.words}: {told} “{rival}”"


def odds(value: float) -> str:
    """Odds to one, to a million."""
    if value > 1e6:
        return "over 1,000,000:1"
    return f"{value:.1f}:1" if value < 10.0 else f"{value:,.0f}:1"


def proof(gain: Gain) -> str:
    """What the held-out epochs say: their errors and, where these hardly tell, how likely they are
    smaller, and their odds."""
    low, high = (100.0 * bound for bound in gain.interval)
    words = (
        f"held-out {gain.before_px:.4f} px -> {gain.after_px:.4f} px "
        f"({low:.1f} to {high:.1f} % of chi-square, 95 %)"
    )
    if gain.interval[0] <= 0.0:
        words += f"; smaller with a probability of {gain.probability:.0%}"
    if gain.odds > 0.0:
        words += f"; odds of the two forecasts {odds(math.exp(0.5 * min(gain.odds, 100.0)))}"
    return words


def signal_names(signal: Signal) -> list[Entry]:
    """What a random signal that the marks of an image share may be, the air first."""
    return [HAZE, STABILISER] if signal.whole else [HAZE]


def signal_parameters(signal: Signal, diagnosis: Diagnosis) -> list[Parameter]:
    """Numbers of what the marks of an image share at random."""
    cameras = diagnosis.recording.model.cameras
    sizes = zip(signal.cameras, signal.size_rad, signal.size_stds_rad, strict=True)
    return [
        *(
            Parameter(f"tilt of the rays, {cameras[c].name}", float(value), float(std), "rad")
            for c, value, std in sizes
        ),
        *([] if signal.whole else [Parameter("correlation length", signal.length_rad, 0.0, "rad")]),
    ]


def signal_rows(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """What the report says of it, as (title, words); empty without."""
    signal = diagnosis.signal
    if signal is None:
        return []
    gain, values = signal.gain, signal_parameters(signal, diagnosis)
    sizes = "; ".join(f"{p.name} {quantity(p.value, p.std, p.unit)}" for p in values)
    return [
        ("where", "everywhere; seen by the cameras that are named with their sizes"),
        *([("or", f"{STABILISER.physics}, at each of them")] if signal.whole else []),
        ("when", SIGNAL_WHEN),
        ("size", f"{sizes} (standard deviations of single images)"),
        (
            "explains",
            f"{100 * diagnosis.signal_share:.0f} % of the excess chi-square by what the marks "
            f"around foretell; p = {signal.p_value:.2g}; correlation with the next "
            f"image {signal.lasting:.2f}",
        ),
        ("proof", proof(gain)),
        ("separate", "; ".join(entry.separate_by for entry in signal_names(signal))),
    ]


def explanation(finding: Finding) -> str:
    """Two sentences for an engineer."""
    entries = finding.hypothesis.entries
    if entries:
        return entries[0].explanation
    return (
        "No named effect explains this. The best port and driver are given with a free-form or "
        "simple course; it is not in the catalogue, but it improves epochs that were not fitted."
    )


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """The verdict with its reason."""
    tried = f"{diagnosis.n_hypotheses:,} hypotheses"
    p = f"p = {diagnosis.left_p_value:.2g}"
    if diagnosis.verdict == "consistent":
        return (
            f"The recording agrees with its model: none of {tried} is significant "
            f"(family-wise {p})."
        )
    if diagnosis.verdict == "explained":
        found = _count(_n_found(diagnosis))
        looks = _looks(diagnosis)
        return f"{found}; after that none of {tried} is significant (family-wise {p}).{looks}"
    left = f"Something significant is left ({p})"
    if diagnosis.likeness > ALIKE and diagnosis.signal is None:
        left = (
            f"What is left moves neighbouring marks of one image alike (correlation "
            f"{diagnosis.likeness:.2f}), at random from image to image or in a pattern that is "
            "too fine for the hypotheses: an autofocus, a stabiliser, haze, fringes"
        )
    if diagnosis.unproven:
        left += (
            f"; its best name, “{diagnosis.unproven}”, is not proven by the held-out epochs and is "
            "not claimed"
        )
    if diagnosis.verdict == "unexplained":
        return f"The recording differs from its model, but nothing passes the proof. {left}."
    return f"{_count(_n_found(diagnosis))}. {left}.{_looks(diagnosis)}"


def _looks(diagnosis: Diagnosis) -> str:
    """How it was chosen, where not with the fitted epochs alone."""
    if not diagnosis.second_look:
        return ""
    return (
        " Fewer epochs do not show it: it was chosen at a second look, with all of them, and each "
        "third was then foretold from the other two."
    )


def _n_found(diagnosis: Diagnosis) -> int:
    return len(diagnosis.findings) + (diagnosis.signal is not None)


def _count(n: int) -> str:
    return (
        "One effect was missing in the model"
        if n == 1
        else f"{n} effects were missing in the model"
    )


def summary(diagnosis: Diagnosis) -> str:
    """The diagnosis for a terminal."""
    plain, final = diagnosis.plain, diagnosis.final
    lines = [
        f"VERDICT  {diagnosis.verdict}",
        f"         {verdict_sentence(diagnosis)}",
        "",
        f"held-out RMS   {plain.heldout_rms_px:.4f} px -> {final.heldout_rms_px:.4f} px"
        f"   (noise about {diagnosis.noise_px:.4f} px)",
        f"fitted RMS     {plain.rms_px:.4f} px -> {final.rms_px:.4f} px",
        f"chi2 per dof   {plain.chi2_per_dof:.3f} -> {final.chi2_per_dof:.3f}",
    ]
    if diagnosis.n_rejected:
        lines.append(f"set aside      {diagnosis.n_rejected} gross errors")
    for number, finding in enumerate(diagnosis.findings, start=1):
        effect, gain = finding.effect, finding.gain
        named = "" if finding.hypothesis.entries else "   (not in the catalogue)"
        shape = shape_words(effect)
        lines += [
            "",
            f"{number}. {effect.name}{named}",
            f"   where     {effect.scope.words()}",
            f"   when      {when(finding.final_effect, finding.final_stds)}"
            + (f": it {shape}" if shape else ""),
            f"   size      {size(finding, final=True)}",
            f"   explains  {100 * finding.share:.0f} % of the excess chi-square, "
            f"{in_pixels(finding):.3f} px RMS; p = {finding.p_value:.2g}, family-wise, "
            f"of {finding.n_hypotheses:,} hypotheses",
            f"   proof     {proof(gain)}",
        ]
        if finding.rivals:
            lines.append(
                f"   weight    {finding.weight:.2f}; this recording can't tell it at 20:1 from"
            )
            lines += [f"             {words}" for words in doubles(finding)]
            lines.append(f"   separate  {separate_by(finding)}")
        if nearly_as_good(finding):
            lines.append(f"   nearly    {nearly_as_good(finding)}  [fitted a little worse]")
    if diagnosis.signal is not None:
        lines += ["", f"{len(diagnosis.findings) + 1}. {HAZE.physics}"]
        lines += [f"   {title:<9} {words}" for title, words in signal_rows(diagnosis)]
    located = diagnosis.located_left if diagnosis.findings else diagnosis.located_before
    if located and diagnosis.significant_left:
        lines += ["", "left over  " + "; ".join(place.words() for place in located[:3])]
    if diagnosis.absorbed:
        lines += [
            "",
            f"can't show {len(diagnosis.absorbed)} of the effects that were asked (the report has "
            "them): the model's own unknowns absorb them, or too few epochs carry them",
        ]
    return "\n".join(lines)
