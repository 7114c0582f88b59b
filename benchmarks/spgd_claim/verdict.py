"""What the numbers say: exponents with intervals, tables, and the claim in sentences.

Every sentence is put together from what was measured; none is written beforehand.
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

METHODS = {
    "condition": "dense condition adjustment",
    "sparse": "sparse Gauss-Newton",
    "spgd": "SPGD",
    "lbfgs": "L-BFGS",
}
RACES = {
    "optimum": "dead reckoning to 1.01 J*",
    "early": "dead reckoning to 1 % of its cost",
    "rough": "rough start to 1 % of its cost",
}
STEEP, LEVEL = 1.5, 0.25
"""Exponents of time beyond which it rises steeply, and below which it stays about the same.

Reading every link once is 1 already.
"""

_LARGE = 100


@dataclass(frozen=True)
class Fit:
    """Exponent of a power of n with its 95 % interval (Student's t; NaN below three sizes)."""

    exponent: float
    low: float
    high: float
    sizes: tuple[int, ...]
    left_out: tuple[int, ...]

    def words(self) -> str:
        """Exponent and interval."""
        if len(self.sizes) < 2:
            return "–"
        if np.isnan(self.low):
            return f"{self.exponent:.2f}"
        return f"{self.exponent:.2f} [{self.low:.2f}, {self.high:.2f}]"


_NOTHING = Fit(np.nan, np.nan, np.nan, (), ())


def total_s(cell: dict) -> float:
    """Seconds with what the method prepared."""
    return cell["seconds"] + cell["prepare_s"]


def chosen(content: dict, **wanted) -> list[dict]:
    """Cells with these values."""
    cells = content["cells"].values()
    return [c for c in cells if all(c[name] == value for name, value in wanted.items())]


def kinds(content: dict) -> list[str]:
    """Kinds of network, in the order of their redundancy."""
    there = {cell["kind"] for cell in content["cells"].values()}
    order = {"ring": 0.0, "ladder": 1.5}
    return sorted(there, key=lambda k: order[k] if k in order else float(k.split()[1]))


def fitted(cells: list[dict], value, least: int = 0) -> Fit:
    """log value ~ exponent log n over the sizes where no network is censored.

    A size with a censored network is left out as a whole: what it has left are the lucky ones.
    """
    of_size = defaultdict(list)
    for cell in cells:
        if cell["n"] >= least and cell["status"] in ("reached", "censored"):
            of_size[cell["n"]].append(cell)
    whole = {n for n, own in of_size.items() if all(c["status"] == "reached" for c in own)}
    points = [(n, value(c)) for n in sorted(whole) for c in of_size[n]]
    left_out = tuple(sorted(set(of_size) - whole))
    nothing = Fit(np.nan, np.nan, np.nan, tuple(sorted(whole)), left_out)
    if len(whole) < 2:
        return nothing
    x, y = np.log(np.array(points, float)).T
    x = x - x.mean()
    slope = float(x @ y / (x @ x))
    if len(whole) < 3:
        return Fit(slope, np.nan, np.nan, nothing.sizes, left_out)
    rest = y - y.mean() - slope * x
    error = np.sqrt(rest @ rest / (len(x) - 2) / (x @ x)) * student.ppf(0.975, len(x) - 2)
    return Fit(slope, slope - error, slope + error, nothing.sizes, left_out)


def report(content: dict) -> str:
    """results.md."""
    parts = [
        "# The claim examined: adjustment gets costly with the network, SPGD does not",
        _statement(content), _exponents(content), _races(content), _steps(content),
        _compiling(content), _wandering(content), _how(content),
    ]  # fmt: skip
    return "\n\n".join(part for part in parts if part) + "\n"


def _statement(content: dict) -> str:
    lines = ["## Where it holds and where it does not", ""]
    for race in RACES:
        lines += _of_race(content, race)
    lines += _of_steps(content)
    lines += _of_reach(content)
    lines += _of_loops(content)
    lines.append(
        f'"Steeply" is an exponent of time whose whole interval is above {STEEP}, "about the same" '
        f'one below {LEVEL}, "moderately" one below {STEEP}; else it is undecided. Exponents are '
        f"those of n >= {_LARGE} where three sizes are, but of all sizes for SPGD. These sentences "
        "are made from the tables below."
    )
    return "\n".join(lines)


def _verdict(fit: Fit) -> str:
    if np.isnan(fit.low):
        return "undecided"
    if fit.low > STEEP:
        return "steeply"
    if fit.high < LEVEL:
        return "about the same"
    return "moderately" if fit.high < STEEP else "undecided"


def _of_race(content: dict, race: str) -> list[str]:
    """One paragraph on a stopping rule, over all kinds of network."""
    lines = [f"**From {RACES[race]}.**"]
    for method, name in METHODS.items():
        fits = {}
        for kind in kinds(content):
            cells = chosen(content, kind=kind, method=method, race=race)
            # Small networks are ruled by what a call takes; SPGD has no others.
            least = _LARGE if method != "spgd" else 0
            fit = fitted(cells, total_s, least)
            fits[kind] = fitted(cells, total_s) if np.isnan(fit.low) else fit
        known = {kind: fit for kind, fit in fits.items() if not np.isnan(fit.low)}
        if not known:
            continue
        exponents = [fit.exponent for fit in known.values()]
        lines.append(f"The time of {name} rises as n^{_range(exponents)}: {_by_verdict(known)}.")
    below = chosen(content, race=race, method="sparse", status="below the optimum")
    if below:
        every = len(chosen(content, race=race, method="sparse"))
        lines.append(
            f"On {len(below)} of {every} networks this target is below the optimal cost, where no "
            "method comes: they are not run."
        )
    return [" ".join([*lines, _claim(content, race)]), ""] if len(lines) > 1 else []


def _claim(content: dict, race: str) -> str:
    """Whether both halves of the claim hold, kind by kind."""
    said = defaultdict(list)
    for kind in kinds(content):
        spgd = fitted(chosen(content, kind=kind, method="spgd", race=race), total_s)
        steep = [
            _verdict(fitted(chosen(content, kind=kind, method=m, race=race), total_s, _LARGE))
            for m in ("condition", "sparse")
        ]
        said[_judged(spgd, steep)].append(kind)
    found = "; it ".join(f"{verdict} on {', '.join(own)}" for verdict, own in said.items())
    return f"By this rule the claim {found}."


def _judged(spgd: Fit, adjustments: list[str]) -> str:
    """The claim, given the exponent of SPGD and what those of the adjustments are called."""
    if np.isnan(spgd.exponent):
        return "can't be judged (SPGD came to the target on fewer than two sizes)"
    if np.isnan(spgd.low):
        return "can't be judged (SPGD came to the target on two sizes only)"
    if spgd.low > LEVEL:
        return "does not hold (SPGD's time rises)"
    if spgd.high >= LEVEL:
        return "is undecided (the interval of SPGD's exponent is too wide)"
    if "steeply" in adjustments:
        return "holds"
    if any(word == "undecided" for word in adjustments):
        return "is undecided (whether adjustment rises steeply)"
    return "does not hold (adjustment does not rise steeply)"


def _range(values, form: str = ".1f") -> str:
    low, high = (format(value, form).replace("-0.0", "0.0") for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _of_steps(content: dict) -> list[str]:
    """The claim counted by the step, and how many steps it takes."""
    words, verdicts, spgd = ["**By the step.**"], {}, {}
    for method, name in METHODS.items():
        fits = {
            kind: fitted(
                chosen(content, kind=kind, method=method, race="step"),
                lambda cell: cell["step_s"],
                _LARGE if method == "condition" else 0,
            )
            for kind in kinds(content)
        }
        known = {kind: fit for kind, fit in fits.items() if not np.isnan(fit.low)}
        verdicts[method] = {kind: _verdict(fit) for kind, fit in known.items()}
        spgd = known if method == "spgd" else spgd
        if known:
            judged = _by_verdict(known)
            exponents = [fit.exponent for fit in known.values()]
            words.append(f"A step of {name} takes n^{_range(exponents)}: {judged}.")
    if len(words) == 1:
        return []
    for method in ("condition", "sparse"):
        ratios = [
            (cell["n"], peer["step_s"] / cell["step_s"])
            for cell in chosen(content, method="spgd", race="step")
            for peer in chosen(content, kind=cell["kind"], n=cell["n"], race="step", method=method)
            if "step_s" in peer
        ]
        if ratios:
            ends = min(n for n, _ in ratios), max(n for n, _ in ratios)
            at = [np.median([ratio for n, ratio in ratios if n == end]) for end in ends]
            words.append(
                f"One of {METHODS[method]} takes {at[0]:.3g} times one of SPGD at {ends[0]:,} "
                f"stations and {at[1]:,.3g} times at {ends[1]:,}."
            )
    said = defaultdict(list)
    for kind in kinds(content):
        adjustments = [verdicts[m].get(kind, "undecided") for m in ("condition", "sparse")]
        said[_judged(spgd.get(kind, _NOTHING), adjustments)].append(kind)
    found = "; it ".join(f"{verdict} on {', '.join(own)}" for verdict, own in said.items())
    words.append(f"Counted by the step, the claim {found}. But what counts is the way:")
    return [" ".join([*words, _way(content)]), ""]


def _by_verdict(fits: dict[str, Fit]) -> str:
    """Kinds of network by what their exponents say."""
    said = defaultdict(list)
    for kind, fit in fits.items():
        said[_verdict(fit)].append(kind)
    return "; ".join(f"{verdict} on {', '.join(own)}" for verdict, own in said.items())


def _way(content: dict) -> str:
    """Steps that SPGD and sparse Gauss-Newton need where both come to the optimum."""
    said = []
    for method in ("sparse", "spgd"):
        cells = [c for c in chosen(content, method=method, race="optimum")
                 if c["status"] == "reached"]  # fmt: skip
        if not cells:
            return "SPGD came to the optimum on no network."
        sizes = [c["n"] for c in cells]
        counts = [c["evaluations"] for c in cells]
        said.append(
            f"{METHODS[method]} takes {_range(counts, ',')} evaluations to the optimum of networks "
            f"of {_range(sizes, ',')} stations"
        )
    return "; ".join(said) + "."


def _of_reach(content: dict) -> list[str]:
    """How far each method gets within the limit, and how far apart they are where both do."""
    words = []
    for method, name in METHODS.items():
        most = {}
        for kind in kinds(content):
            cells = chosen(content, kind=kind, method=method, race="optimum")
            sizes = fitted(cells, lambda c: 1.0).sizes
            most[kind] = max(sizes, default=0)
        if any(most.values()):
            words.append(f"{name} {_range(most.values(), ',')} stations")
    slower = []
    for cell in chosen(content, method="spgd", race="optimum", status="reached"):
        own = chosen(content, kind=cell["kind"], n=cell["n"], seed=cell["seed"], race="optimum",
                     method="sparse", status="reached")  # fmt: skip
        slower += [(cell["n"], total_s(cell) / total_s(c)) for c in own]
    said = ["**Reach.** The largest size of which all networks came to 1.01 J* within the limit, "
            "by kind of network: " + "; ".join(words) + "."]  # fmt: skip
    if slower:
        small, large = min(slower)[0], max(slower)[0]
        at = [np.median([r for n, r in slower if n == size]) for size in (small, large)]
        said.append(
            f"SPGD takes {at[0]:.3g} times as long as sparse Gauss-Newton at {small} stations and "
            f"{at[1]:,.0f} times at {large}, the largest that it came to the end of."
        )
    return [" ".join(said), ""]


def _of_loops(content: dict) -> list[str]:
    rows = content["wander"]
    if not rows:
        return []
    said = []
    for gain in dict.fromkeys(row["gain"] for row in rows):
        own = [row for row in rows if row["gain"] == gain]
        alone = [row["misclosure alone"]["median"] for row in own]
        held = [row["with links"]["median"] for row in own]
        said.append(
            f"at a gain of {gain} / tr H it ends off the least-squares adjustment by "
            f"{min(alone):.2g} to {max(alone):.2g} of its square (medians), with the links' own "
            f"term by {min(held):.1g} to {max(held):.1g}"
        )
    return ["**Misclosures alone.** SPGD on the misclosure of a loop alone closes it, but "
            + "; ".join(said) + ".", ""]  # fmt: skip


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows]]
    return "\n".join(lines)


def _exponents(content: dict) -> str:
    rows = []
    for race, words in RACES.items():
        for kind in kinds(content):
            for method, name in METHODS.items():
                cells = chosen(content, kind=kind, method=method, race=race)
                ran = [c for c in cells if c["status"] in ("reached", "censored")]
                if not ran:
                    continue
                time = fitted(ran, total_s)
                sizes = f"{time.sizes[0]:,}–{time.sizes[-1]:,}" if time.sizes else "none"
                censored = ", ".join(f"{n:,}" for n in time.left_out) or "none"
                rows.append([
                    words, kind, name, time.words(), fitted(ran, total_s, _LARGE).words(),
                    fitted(ran, lambda c: c["evaluations"]).words(), sizes, censored,
                ])  # fmt: skip
    head = ["race", "network", "method", "time", f"time, n >= {_LARGE}", "evaluations", "sizes",
            "censored sizes, left out"]  # fmt: skip
    return "## Exponents of n, with 95 % intervals\n\n" + _table(head, rows)


def _races(content: dict) -> str:
    parts = ["## Seconds (evaluations) to the target, median over the networks of a size"]
    sizes = sorted({cell["n"] for cell in content["cells"].values()})
    for race, words in RACES.items():
        rows = []
        for kind in kinds(content):
            for method, name in METHODS.items():
                row = [_cell(chosen(content, kind=kind, method=method, race=race, n=n))
                       for n in sizes]  # fmt: skip
                if any(row):
                    rows.append([kind, name, *row])
        if rows:
            parts += [f"### {words[0].upper()}{words[1:]}",
                      _table(["network", "method", *(f"{n:,}" for n in sizes)], rows)]  # fmt: skip
    parts.append(
        "Censored: > seconds run, and the cost come to in units of the optimum. «J*»: 1 % of the "
        "initial cost is below the optimal cost, where no method comes."
    )
    return "\n\n".join(parts)


def _cell(cells: list[dict]) -> str:
    if not cells:
        return ""
    censored = [c for c in cells if c["status"] == "censored"]
    if censored:
        worst = censored[0]
        if "seconds" not in worst:
            return "too large" if worst["why"].startswith("too large") else "ended"
        return f"> {total_s(worst):.3g} ({worst['cost'] / worst['optimum']:.3g} J*)"
    reached = [c for c in cells if c["status"] == "reached"]
    if not reached:
        return "J*" if cells[0]["status"] == "below the optimum" else ""
    seconds = np.median([total_s(c) for c in reached])
    return f"{seconds:.3g} ({np.median([c['evaluations'] for c in reached]):,.0f})"


def _steps(content: dict) -> str:
    sizes = sorted({cell["n"] for cell in chosen(content, race="step")})
    shown = [n for n in sizes if n in (5, 10, 20, 50, 100, 500, 1_000, 5_000, 10_000)]
    rows = []
    for kind in kinds(content):
        for method, name in METHODS.items():
            row = []
            for n in shown:
                cells = chosen(content, kind=kind, method=method, race="step", n=n)
                if not cells or "step_s" not in cells[0]:
                    row.append("too large" if cells else "")
                    continue
                row.append(f"{1e3 * cells[0]['step_s']:.3g} ms, {_bytes(cells[0]['peak_bytes'])}")
            cells = chosen(content, kind=kind, method=method, race="step")
            fit = fitted(cells, lambda c: c["step_s"])
            rows.append([kind, name, *row, fit.words()])
    if not rows:
        return ""
    head = ["network", "method", *(f"{n:,}" for n in shown), "exponent of time"]
    return "## One step: time and memory\n\n" + _table(head, rows)


def _bytes(count: float) -> str:
    if count < 1e6:
        return "< 1 MB"
    return f"{count / 1e6:,.0f} MB" if count < 1e9 else f"{count / 1e9:.2g} GB"


def _compiling(content: dict) -> str:
    rows = []
    for method, name in METHODS.items():
        cells = [c for c in chosen(content, method=method, seed=0) if "compile_s" in c]
        seconds = [c["compile_s"] for c in cells if c["compile_s"] > 0.0]
        if seconds:
            rows.append([name, f"{np.median(seconds):.2g}", f"{max(seconds):.2g}"])
    if not rows:
        return ""
    return (
        "## Compiling, not in the times above\n\n"
        + _table(["method", "median s", "most s"], rows)
        + "\n\nOf sizes where something was compiled; a cache on disk (README.md) makes it less."
    )


def _wandering(content: dict) -> str:
    rows = []
    for row in content["wander"]:
        alone, held = row["misclosure alone"], row["with links"]
        exact = row["exact"]
        rows.append([
            f"{row['n']} {row['kind']}", f"{row['gain']} / tr H",
            f"{row['formula']:.3g}", exact if isinstance(exact, str) else f"{exact:.3g}",
            f"{alone['mean']:.3g} ± {alone['error']:.2g}", f"{alone['median']:.3g}",
            f"{alone['steps']:.0f}", f"{held['median']:.2g}", f"{held['steps']:.0f}",
        ])  # fmt: skip
    if not rows:
        return ""
    head = ["ring", "gain", "first order (numbers: eta (n-1)(n-2) / 2)", "exact mean", "mean",
            "median", "steps", "with the links' term, median", "steps"]  # fmt: skip
    return (
        "## SPGD on loop misclosures alone: excess |xi - xi_LS|² / |xi_LS|²\n\n"
        + _table(head, rows)
        + "\n\nWhere the exact mean is infinite the measured one is that of the runs that happened "
        "to be drawn; the median tells more. The ring of poses goes through the network's own "
        "residual (EdgeFactor, ClosureFactor)."
    )


def _how(content: dict) -> str:
    settings = content.get("settings")
    if not settings:
        return ""
    return (
        f"## How\n\n{settings['processor']}, {settings['cores']} cores, {settings['workers']} "
        f"processes at a time with one core each; {settings['limit_s']:g} s a cell; "
        f"{settings['seconds'] / 60:.0f} minutes in all. See README.md."
    )
