"""Judge one report against the key: name, place, instant, size, held-out gain, and why not."""

from collections.abc import Callable

import numpy as np
from names import Facts, same_name, same_place

from jaxvm.physics.catalogue import BY_ID

DECIDED = 2.0 * np.log(20.0)
"""Gap in chi-square at which one name is twenty times as likely as another."""

SHOWN = 50.0
"""Expected drop of chi-square from which an effect counts as shown by its recording."""

CONFIDENT = 0.95
Z_90 = 1.645
INSTANTS = ("instant", "start")
CONSTANTS = {"tau_s": ("time constant",), "period_s": ("period",), "t0_s": INSTANTS}


def catalogue_rows(name: str) -> tuple[int, ...]:
    """Rows of PHYSICS.md of a catalogue entry; none where the entry is unknown or has none."""
    return tuple(getattr(BY_ID.get(name), "rows", ()))


def judge(
    entry: dict,
    report: dict | None,
    shown: dict,
    rows_of: Callable[[str], tuple[int, ...]] = catalogue_rows,
) -> dict:
    """One row of the results.

    Args:
        entry: of key.json.
        report: report.json, or None where the diagnosis failed.
        shown: what the recording can show (`power.Shown`).
        rows_of: rows of PHYSICS.md of a name of the catalogue.
    """
    facts = Facts(**shown["facts"])
    found = [] if report is None else report["findings"]
    hidden = entry["hidden"]
    effects = [
        _effect(truth, power, found, facts, len(hidden) == 1, rows_of)
        for truth, power in zip(hidden, shown["effects"], strict=True)
    ]
    row = {
        "id": entry["id"],
        "kind": entry["kind"],
        "correlated": entry["noise"]["type"] == "correlated",
        "failed": report is None,
        "outside": any(truth.get("outside") for truth in hidden),
        "n_hidden": len(hidden),
        "n_findings": len(found),
        "named": [_label(claims(finding)[0]) for finding in found],
        "set_sizes": [len(claims(finding)) for finding in found],
        "set_names": [len({_label(c) for c in claims(finding)}) for finding in found],
        "false_claim": not hidden and bool(found),
        "superfluous": bool(hidden) and len(found) > len(hidden),
        "confident_wrong": [
            _label(claims(finding)[0]) for finding in found if _is_wrong(finding, hidden, facts)
        ],
        "floor_px": shown["floor_px"],
        "variance": shown["variance"],
        "effects": effects,
    }
    if report is not None:
        row |= _held_out(report, shown["floor_px"])
        row |= {"verdict": report["verdict"], "seconds": report.get("seconds")}
        row["second_look"] = report.get("second_look", False)
        for effect in effects:
            if "nothing was claimed" in effect["reason"]:
                unproven = report.get("left_over", {}).get("unproven")
                effect["reason"] += f" (not proven: {unproven})" if unproven else ""
    return row


def claims(finding: dict) -> list[dict]:
    """Everything that a finding may be: itself, then its equivalents."""
    return [
        {
            "catalogue_id": claim.get("catalogue_id", ""),
            "physics": claim.get("physics", ""),
            "rows": list(claim.get("rows") or catalogue_rows(claim.get("catalogue_id", ""))),
            "where": claim.get("where") or {},
            "weight": claim.get("weight"),
        }
        for claim in (finding, *finding.get("equivalents", ()))
    ]


def covered(z: float) -> bool:
    """Whether the true value lies inside the 90 % interval."""
    return abs(z) <= Z_90


def _label(claim: dict) -> str:
    return claim["catalogue_id"] or f"unnamed: {claim['physics']}"


def _is_wrong(finding: dict, hidden: list[dict], facts: Facts) -> bool:
    """A confident name that is none of what is hidden."""
    if finding.get("unnamed", not finding.get("named", True)):
        return False
    if (finding.get("weight") or 0.0) < CONFIDENT:
        return False
    rows = claims(finding)[0]["rows"]
    return not any(same_name(truth, rows, facts) for truth in hidden)


def _held_out(report: dict, floor: float) -> dict:
    before, after = report["plain"]["heldout_rms_px"], report["final"]["heldout_rms_px"]
    excess = before**2 - floor**2
    return {
        "heldout_before_px": before,
        "heldout_after_px": after,
        "floor_ratio": after / floor,
        "excess_removed": (before**2 - after**2) / excess if excess > 0.0 else None,
    }


def _effect(
    truth: dict, power: dict, found: list[dict], facts: Facts, only: bool, rows_of: Callable
) -> dict:
    right = [[same_name(truth, c["rows"], facts) for c in claims(f)] for f in found]
    first = [own[0] for own in right]
    # Among claims of the right name, any with the right place will do: the set is what is claimed.
    at = [
        (_place(truth, claim, finding, facts))
        for finding, own in zip(found, right, strict=True)
        for claim, named in zip(claims(finding), own, strict=True)
        if named
    ]
    alike = {name: same_name(truth, rows_of(name), facts) for name in power["drops"]}
    rivals = [name for name, same in alike.items() if name and not same]
    own_names = [name for name, same in alike.items() if same]
    gaps = {name: power["expected_drop"] - power["drops"][name] for name in rivals}
    own_drop = max((power["drops"][name] for name in own_names), default=0.0)
    ahead = own_drop - max((power["drops"][name] for name in rivals), default=0.0)
    own_best = max((power["evidence"][name] for name in own_names), default=-np.inf)
    priced = own_best - max((power["evidence"][name] for name in rivals), default=-1e300)
    nearest = min(gaps, key=gaps.__getitem__, default="")
    by_name = [drop for name, drop in power["drops"].items() if name]
    is_shown = power["expected_drop"] >= SHOWN
    result = {
        "effect": truth["effect"],
        "rows": list(truth["rows"]),
        "outside": bool(truth.get("outside")),
        "where": truth.get("where") or {},
        "expected_drop": power["expected_drop"],
        "seen": power["seen"],
        "rms_px": power["rms_px"],
        "own_share": own_drop / max(power["expected_drop"], 1e-300),
        "wrongly_first": _wrongly_first(found, alike, power["drops"]),
        "nearest": nearest,
        "gap": gaps.get(nearest),
        "doubles": max(1, sum(bool(power["expected_drop"] - d < DECIDED) for d in by_name)),
        "shown": is_shown,
        "decidable": is_shown and all(gap >= DECIDED for gap in gaps.values()),
        "decidable_by_names": is_shown and bool(ahead >= DECIDED),
        "decidable_priced": is_shown and bool(priced >= DECIDED),
        "affordable": is_shown and bool(priced >= -DECIDED),
        "detected": bool(found),
        "in_set": any(any(own) for own in right),
        "first": bool(first) and (first[0] if only else any(first)),
        "place_right": "" in at,
        "z": [],
        "z_constants": {},
        "not_compared": "",
    }
    named = next((f for f, own in zip(found, first, strict=True) if own), None)
    if named is not None:
        result |= _sizes(truth, named, facts)
    result["reason"] = _reason(result, found, at, gaps)
    return result


def _wrongly_first(found: list[dict], alike: dict, drops: dict) -> dict[str, float]:
    """Names of findings that are not the right one, and how much of lambda each gives at most.

    Where that is no less than the right name gives, the package's physics can't tell them apart.
    """
    told = [_label(claims(finding)[0]) for finding in found]
    return {name: drops[name] for name in told if alike.get(name) is False}


def _place(truth: dict, claim: dict, finding: dict, facts: Facts) -> str:
    """Why a claim's place or instant is wrong; empty where it is right."""
    if not same_place(truth, claim["where"], facts):
        return f"wrong place: {claim['where'] or 'everywhere'}, not {truth.get('where')}"
    t0, own = truth.get("t0_s"), _constant(finding, INSTANTS)
    if t0 is None or own is None or truth.get("when", "from") != "from":
        return ""
    instant, std = own[0] + facts.first_s, own[1] or 0.0
    if abs(instant - t0) <= max(facts.spacing_s, 3.0 * std):
        return ""
    return f"wrong instant: {instant:.0f} s, not {t0:.0f} s"


def _numbers(finding: dict) -> list[dict]:
    """Parameters by the fit to all epochs, where that has standard deviations."""
    final = finding.get("final_parameters") or []
    if any(p.get("std") for p in final):
        return final
    return finding.get("parameters") or []


def _constant(finding: dict, names: tuple[str, ...]) -> tuple[float, float | None] | None:
    for p in _numbers(finding):
        if p["name"] in names and p["value"] is not None:
            return p["value"], p.get("std")
    return None


def _sizes(truth: dict, finding: dict, facts: Facts) -> dict:
    """Deviations from the true sizes and constants in standard deviations.

    Only like is compared with like: a double at another place or with another driver has another
    size. Where the common scale of a target is free, one scale of two stands for their difference.
    """
    driver, own_driver = truth.get("driver") or "constant", finding.get("driver")
    same_driver = (own_driver or driver).removeprefix("time since ").startswith(driver)
    if not same_driver or (own_driver and (" - " in own_driver) != (" - " in driver)):
        return {"not_compared": f"other driver: {own_driver}, not {driver}"}
    if not same_place(truth, finding.get("where") or {}, facts):
        return {"not_compared": "a double at another place"}
    told, constants = truth.get("constants") or {}, {}
    for name, known in CONSTANTS.items():
        own = _constant(finding, known)
        # One of two time constants has no counterpart in a finding with one.
        if told.get(name) is None or own is None or not own[1] or "tau2_s" in told:
            continue
        offset = facts.first_s if name == "t0_s" else 0.0
        constants[name] = (own[0] + offset - told[name]) / own[1]
    z = []
    for port, value in _shown_values(truth, finding).items():
        true = _in_units_of(finding, value, told, driver)
        z.append(None if true is None else _deviation(port, true, finding, 80 in truth["rows"]))
    words = "not all sizes have one number to compare" if None in z else ""
    return {
        "z": [d for d in z if d is not None],
        "z_constants": constants,
        "not_compared": words,
    }


def _shown_values(truth: dict, finding: dict) -> dict[str, float]:
    """True values by port; of two scales of a target their difference where only one was found."""
    values = dict(truth.get("values") or {})
    pair = ("target.scale_x", "target.scale_y")
    told = {p.get("port", p["name"].split(",")[0]) for p in _numbers(finding)}
    if set(pair) <= set(values) and len(told & set(pair)) == 1:
        (own,) = told & set(pair)
        other = pair[0] if own == pair[1] else pair[1]
        values[own] -= values.pop(other)
    return values


def _in_units_of(finding: dict, value: float, told: dict, driver: str) -> float | None:
    """A true size per unit of the driver; the key gives what grows in time at its end.

    What settles has no rate. A quantity less its own lag is the time constant times its rate. What
    warms up by 1 - exp(-s / tau) since power-on fades by exp(-s / tau) with the other sign.
    """
    if driver == "power-on" and "tau2_s" not in told and finding.get("form") == "fading":
        return -value
    if ("end_s" in told) != (finding.get("form") == "ramp"):
        return None
    if "end_s" in told:
        return value / (told["end_s"] - told["t0_s"])
    if "rate_s" in told and finding.get("form") != "rate":
        own = value * told["rate_s"] / told["tau_s"]
        return own if finding.get("form", "").startswith("transient") else None
    if "length_s" in told:
        return value / told["length_s"] if finding.get("form") == "linear" else None
    return value


def _deviation(port: str, true: float, finding: dict, squared: bool) -> float | None:
    """(estimate - truth) / std at a port.

    A sine and a cosine, and the axes of a vector of which the key gives the length, count by their
    magnitude; of a parabola in the driver the square counts where `squared`.
    """
    ports = {port, *(f"{port}_{axis}" for axis in "xyz")}
    if "station" in (finding.get("where") or {}):
        ports |= {name.replace("mount.", "station.") for name in ports}
    own = [
        (p["value"], p["std"], p["name"].rsplit(", ", 1)[-1])
        for p in _numbers(finding)
        if p.get("port", p["name"].split(",")[0]) in ports and p.get("std")
    ]
    own = [one for one in own if one[2] != "first state"]
    if squared:
        own = [one for one in own if one[2] == "square"]
    if len(own) == 1:
        return (own[0][0] - true) / own[0][1]
    courses = {"lag", "slow lag", "linear", "square", "play"} & {one[2] for one in own}
    mixed = courses and {one[2] for one in own} != {"lag"}
    if not own or mixed or len(own) > 3:
        return None
    value, std = np.array([one[:2] for one in own]).T
    size = float(np.linalg.norm(value))
    return (size - abs(true)) / float(np.linalg.norm(value * std) / size) if size > 0.0 else None


def _reason(effect: dict, found: list[dict], at: list[str], gaps: dict[str, float]) -> str:
    """Why an effect was not told rightly, in words; empty where it was or need not be."""
    if effect["outside"] or (effect["in_set"] and effect["place_right"]):
        return ""
    if effect["in_set"]:
        return "; ".join(dict.fromkeys(at))
    small = f"lambda {effect['expected_drop']:.1f}"
    if not effect["shown"]:
        absorbed = f", {100 * effect['seen']:.2g} % of it not absorbed by the plain model"
        return f"too small to show ({small}{absorbed})"
    if not found:
        words = "nothing was claimed"
    else:
        name = _label(claims(found[0])[0])
        gap = gaps.get(name)
        if gap is None:
            words = f"{name} was named"
        elif gap < DECIDED:
            words = f"double not in the set: {name} was named, its gap is {gap:.1f}"
        else:
            words = f"{name} was named though its gap is {gap:.0f}"
    if effect["own_share"] < 0.9:
        words += f"; the right name explains {100 * effect['own_share']:.0f} % at most"
    return f"{words} ({small})"
