"""From judged recordings to the figures of the table, each with an interval and its cases."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from judge import SHOWN, covered
from scipy.special import ndtr

SEEDS = Path(__file__).parent / "seeds"
"""A folder for each sealed set: results.md, follow.md and figures."""

FLOOR_RATIO = 1.03
EXCESS = 0.75


@dataclass(frozen=True)
class Figure:
    """One number of the table: value with its 95 % interval over `cases`, and its target."""

    number: str
    question: str
    value: float | None
    interval: tuple[float, float] | None
    cases: int
    target: str
    met: bool | None
    unit: str = "%"

    def as_dict(self) -> dict:
        """Plain values for JSON."""
        return asdict(self)


def page_of(label: str, name: str) -> Path:
    """Where a table or a figure of a sealed set is written; its folder is made."""
    page = SEEDS / label / name
    page.parent.mkdir(parents=True, exist_ok=True)
    return page


def wilson(k: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """95 % interval of a share k/n (Wilson 1927)."""
    if n == 0:
        return 0.0, 1.0
    share, width = k / n, z * z / n
    middle = (share + 0.5 * width) / (1.0 + width)
    half = z / (1.0 + width) * np.sqrt(share * (1.0 - share) / n + 0.25 * width / n)
    return max(float(middle - half), 0.0), min(float(middle + half), 1.0)


def quantile(
    values: Iterable[float], q: float, repetitions: int = 2000
) -> tuple[float, tuple[float, float]]:
    """A quantile with its 95 % interval from a bootstrap over recordings."""
    values = np.asarray(list(values), float)
    picks = np.random.default_rng(0).integers(0, len(values), (repetitions, len(values)))
    low, high = np.quantile(np.quantile(values[picks], q, axis=1), [0.025, 0.975])
    return float(np.quantile(values, q)), (float(low), float(high))


def _share(number: str, question: str, hits: list[bool], low: float, high: float = 1.0) -> Figure:
    n, k = len(hits), sum(map(bool, hits))
    bounds = [f"at least {100 * low:g} %"] * (low > 0.0) + [f"at most {100 * high:g} %"] * (
        high < 1.0
    )
    target = " and ".join(bounds)
    if not n:
        return Figure(number, question, None, None, 0, target, None)
    met = low <= k / n <= high if bounds else None
    return Figure(number, question, k / n, wilson(k, n), n, target, met)


def odds_of_noise(gap: float | None) -> float:
    """Probability that the right one of two hypotheses fits better, by the gap between them.

    The difference of their chi-squares is normal, with the gap as its mean and twice the root of
    the gap as its standard deviation. Who holds both for equally likely can't do better.
    """
    return 1.0 if gap is None else float(ndtr(0.5 * np.sqrt(gap)))


def _mean(number: str, question: str, values: list[float]) -> Figure:
    if not values:
        return Figure(number, question, None, None, 0, "", None)
    picks = np.random.default_rng(0).choice(values, (2000, len(values)))
    low, high = np.quantile(picks.mean(axis=1), [0.025, 0.975])
    return Figure(
        number, question, float(np.mean(values)), (float(low), float(high)), len(values), "", None
    )


def _level(number: str, question: str, values, q: float, target: str, most=None, unit="") -> Figure:
    values = [v for v in values if v is not None]
    if not values:
        return Figure(number, question, None, None, 0, target, None, unit)
    value, interval = quantile(values, q)
    met = None if most is None else value <= most
    return Figure(number, question, value, interval, len(values), target, met, unit)


def figures(rows: list[dict]) -> list[Figure]:
    """The figures of the table from judged recordings."""
    inside = [r for r in rows if r["n_hidden"] and not r["outside"]]
    ones = [(r, r["effects"][0]) for r in inside if r["n_hidden"] == 1]
    shown = [(r, e) for r, e in ones if e["shown"]]
    outside = [r for r in rows if r["outside"]]
    outside_shown = [r for r in outside if any(e["shown"] for e in r["effects"])]
    pairs = [r for r in inside if r["n_hidden"] > 1]
    pairs_shown = [r for r in pairs if all(e["shown"] for e in r["effects"])]
    empty = [r for r in rows if not r["n_hidden"]]
    sizes = [size for r in inside for size in r["set_names"]]
    claims = [size for r in inside for size in r["set_sizes"]]
    sizes_right = [
        (r["correlated"], d) for r in inside for e in r["effects"] if e["first"] for d in e["z"]
    ]
    constants = [
        d for r in inside for e in r["effects"] if e["first"] for d in e["z_constants"].values()
    ]
    removed = [r.get("excess_removed") for r in outside_shown]
    removed_median = _level(
        "6b", "outside the catalogue: excess removed on held-out epochs, median", removed, 0.5,
        f"at least {100 * EXCESS:g} %", unit="%",
    )  # fmt: skip
    if removed_median.value is not None:
        removed_median = Figure(
            **(removed_median.as_dict() | {"met": removed_median.value >= EXCESS})
        )
    return [
        _share(
            "1", f"right physics in the set, lambda >= {SHOWN:g}",
            [e["in_set"] for _, e in shown], 0.97,
        ),
        _share(
            "1a", "the same where unknowns, priced at ln n each, do not rule the right name out",
            [e["in_set"] for _, e in shown if e["affordable"]], 0.0,
        ),
        _share(
            "2", "named first where decidable", [e["first"] for _, e in ones if e["decidable"]],
            0.95,
        ),
        _mean(
            "2a", "the most that can be expected of 2: noise may turn the nearest rival",
            [odds_of_noise(e["gap"]) for _, e in ones if e["decidable"]],
        ),
        _share(
            "2b", "the same where decidable with a price of ln n for each unknown",
            [e["first"] for _, e in ones if e["decidable_priced"]], 0.0,
        ),
        _share(
            "2c", "the same (2) where the right name gives so much more than any other",
            [e["first"] for _, e in ones if e["decidable_by_names"]], 0.0,
        ),
        _level("3a", "size of the set (names), median", sizes, 0.5, "at most 2", 2.0),
        _level("3b", "size of the set, 90th percentile", sizes, 0.9, "at most 5", 5.0),
        _level("3c", "names and places in the set, 90th percentile", claims, 0.9, ""),
        _level(
            "3d", "names with a gap below 2 ln 20: what the recordings leave open, 90th percentile",
            [e["doubles"] for r in inside for e in r["effects"] if e["detected"]], 0.9, "",
        ),
        _share(
            "4", "right place and instant where the right name is in the set",
            [e["place_right"] for _, e in shown if e["in_set"]], 0.97,
        ),
        _share(
            "5", "false claims where nothing is hidden", [r["false_claim"] for r in empty],
            0.0, 0.02,
        ),
        _share(
            "6a", "outside the catalogue: confident wrong name",
            [bool(r["confident_wrong"]) for r in outside], 0.0, 0.03,
        ),
        removed_median,
        _share(
            "6c", f"outside the catalogue: at least {100 * EXCESS:g} % of the excess removed",
            [(v or 0.0) >= EXCESS for v in removed], 0.0,
        ),
        _share(
            "7", "two effects: both right, both with lambda >= 50",
            [all(e["in_set"] for e in r["effects"]) for r in pairs_shown], 0.85,
        ),
        _share(
            "8", f"held-out RMS at most {FLOOR_RATIO:g} times the noise floor",
            [r.get("floor_ratio", np.inf) <= FLOOR_RATIO for r in rows if not r["outside"]], 0.95,
        ),
        _share(
            "9", "true size inside the 90 % interval, right name first",
            [covered(d) for _, d in sizes_right], 0.85, 0.95,
        ),
        _share(
            "9a", "the same where the noise is correlated",
            [covered(d) for correlated, d in sizes_right if correlated], 0.0,
        ),
        _share(
            "9b", "the same (9) for time constants, periods and instants",
            [covered(d) for d in constants], 0.0,
        ),
        _level(
            "9c", "error of a size (9) in its standard deviations, median: 0.67 is right",
            [abs(d) for _, d in sizes_right], 0.5, "",
        ),
        _level("10", "seconds for a recording, median", [r.get("seconds") for r in rows], 0.5, "",
               unit="s"),
        _share("", "more findings than effects hidden", [r["superfluous"] for r in inside], 0.0),
        _share("", "diagnosis failed", [r["failed"] for r in rows], 0.0),
    ]  # fmt: skip


def by_effect(rows: list[dict]) -> list[dict]:
    """Counts for each hidden effect."""
    counts: dict[tuple[bool, str], dict[str, float]] = defaultdict(lambda: defaultdict(int))
    for row in rows:
        for effect in row["effects"]:
            own = counts[effect["outside"], effect["effect"]]
            own["cases"] += 1
            if effect["shown"]:
                own["shown"] += 1
                for key in ("decidable", "in_set", "first", "place_right"):
                    own[key] += bool(effect[key])
    return [
        {"effect": name, "outside": outside, **dict(own)}
        for (outside, name), own in sorted(counts.items())
    ]


def markdown(rows: list[dict], title: str, hashes: list[str]) -> str:
    """The tables as a page."""
    lines = [f"# {title}", ""]
    lines += [f"Key sealed before anything was diagnosed, SHA-256 `{h}`." for h in hashes]
    lines += [
        "", "| # | question | value | 95 % interval | cases | target | met |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for f in figures(rows):
        met = {True: "yes", False: "**no**", None: ""}[f.met]
        interval = "" if f.interval is None else " – ".join(_text(v, f.unit) for v in f.interval)
        cells = (f.number, f.question, _text(f.value, f.unit), interval, f.cases, f.target, met)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines += [
        "", "## By hidden effect", "",
        f"Shown: lambda at least {SHOWN:g}. The columns to its right count shown ones only.", "",
        "| effect | cases | shown | decidable | right name in the set | first | place |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for own in by_effect(rows):
        name = own["effect"] + (" (outside)" if own["outside"] else "")
        keys = ("cases", "shown", "decidable", "in_set", "first", "place_right")
        lines.append("| " + " | ".join([name, *(str(own.get(k, 0)) for k in keys)]) + " |")
    lines += ["", "## What went wrong", ""]
    lines += [f"- {text}" for text in failures(rows)] or ["Nothing."]
    looks = second_looks(rows)
    lines += (
        ["", "## Found at a second look", "", *(f"- {text}" for text in looks)] if looks else []
    )
    return "\n".join(lines) + "\n"


def second_looks(rows: list[dict]) -> list[str]:
    """What was found with all epochs, where two thirds of them showed nothing."""
    return [
        f"{row['id']}: {', '.join(row['named'])}; "
        + (", ".join(map(_hidden, row["effects"])) or "nothing is hidden")
        for row in rows
        if row.get("second_look")
    ]


def _hidden(effect: dict) -> str:
    """An effect, how well it shows, and whether its name was found."""
    where = "first" if effect["first"] else "in the set" if effect["in_set"] else "not in the set"
    where = "outside" if effect["outside"] else where
    return f"{effect['effect']} (lambda {effect['expected_drop']:.0f}, {where})"


def failures(rows: list[dict]) -> list[str]:
    """Every failure in words, effects too small to show not among them."""
    found = []
    for row in rows:
        if row["failed"]:
            found.append(f"{row['id']}: the diagnosis failed")
            continue
        if row["false_claim"]:
            found.append(f"{row['id']}: nothing is hidden, claimed {', '.join(row['named'])}")
        if row["outside"] and row["confident_wrong"]:
            found.append(f"{row['id']}: outside, confident {', '.join(row['confident_wrong'])}")
        if row["outside"] and any(e["shown"] for e in row["effects"]):
            removed = row.get("excess_removed")
            if removed is not None and removed < EXCESS:
                found.append(f"{row['id']}: outside, {100 * removed:.0f} % of the excess removed")
        for effect in row["effects"]:
            name = f"{row['id']}: {effect['effect']}"
            if effect["shown"] and effect["reason"]:
                paid = effect["in_set"] or effect.get("affordable", True)
                dear = "" if paid else "; its unknowns cost more than they show (1a)"
                found.append(f"{name}: {effect['reason']}{dear}")
            elif effect["decidable"] and not effect["outside"] and not effect["first"]:
                found.append(
                    f"{name}: in the set but not first, though decidable; {_instead(row, effect)}"
                )
            # Of an effect with several sizes each counts.
            missed = [f"{z:+.1f}" for z in effect["z"] if not covered(z)]
            if effect["first"] and not effect["outside"] and missed:
                found.append(f"{name}: size off by {', '.join(missed)} standard deviations")
        if not row["outside"] and row["floor_ratio"] > FLOOR_RATIO:
            found.append(f"{row['id']}: held-out RMS {row['floor_ratio']:.3f} times the floor")
    return found


def _instead(row: dict, effect: dict) -> str:
    """What was named first, and which share of lambda right and wrong name explain at most."""
    words = f"named {', '.join(row['named'])}"
    wrong = effect["wrongly_first"]
    if not wrong:
        return words
    share = max(wrong.values()) / effect["expected_drop"]
    return (
        f"{words}, which explains {100 * share:.1f} % of lambda {effect['expected_drop']:.0f}, "
        f"the right name {100 * effect['own_share']:.1f} %"
    )


def _text(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    return f"{100 * value:.1f} %" if unit == "%" else f"{value:.3g} {unit}".strip()
