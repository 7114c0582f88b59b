"""Shares of several sealed seeds side by side, and of all their cases together.

`python benchmarks/sealed/pooled.py SEED [SEED ...]` reads seeds/SEED/results.md and follow.md.
"""

import argparse
import re

from tally import SEEDS, wilson

SHARES = ("1", "2", "2b", "2c", "4", "5", "6a", "6c", "7", "8", "9", "9a", "9b")


def shares(seed: str) -> dict[str, tuple[str, int, int]]:
    """Question, hits and cases of every share in the table of a seed, by its number."""
    found = {}
    for line in (SEEDS / seed / "results.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 7 and cells[0] in SHARES and cells[2].endswith("%"):
            n = int(cells[4])
            found[cells[0]] = cells[1], round(float(cells[2].rstrip(" %")) * n / 100.0), n
    return found


def advice(seed: str) -> tuple[int, int] | None:
    """Promises that were kept, and all; None where no advice of the seed was followed."""
    table = SEEDS / seed / "follow.md"
    told = re.search(r"^(\d+) of (\d+) findings", table.read_text() if table.exists() else "", re.M)
    return None if told is None else (int(told[1]), int(told[2]))


def markdown(seeds: list[str]) -> str:
    """One row a question: each seed, then all cases together with a 95 % interval."""
    each = [shares(seed) for seed in seeds]
    counts = {
        number: (f"| {number} | {own[number][0]}", [(o[number][1:]) for o in each if number in o])
        for number in SHARES
        for own in each
        if number in own
    }
    counts["advice"] = (
        "| | advised recordings that part the doubles, as promised",
        [own for own in map(advice, seeds) if own is not None],
    )
    lines = [f"| # | question | {' | '.join(seeds)} | together | 95 % interval |"]
    lines.append("|---|---|" + "---|" * (len(seeds) + 2))
    for head, own in counts.values():
        if len(own) < len(seeds):
            continue
        k, n = (sum(part) for part in zip(*own, strict=True))
        low, high = wilson(k, n)
        cells = [f"{100 * a / b:.1f} % of {b}" if b else "" for a, b in [*own, (k, n)]]
        lines.append(f"{head} | {' | '.join(cells)} | {100 * low:.1f} – {100 * high:.1f} % |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="figures of several sealed seeds together")
    known = sorted(folder.name for folder in SEEDS.iterdir())
    parser.add_argument("seeds", nargs="+", metavar="SEED", choices=known)
    print(markdown(parser.parse_args().seeds))


if __name__ == "__main__":
    main()
