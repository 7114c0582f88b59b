"""Follow the advice: record what a diagnosis asked for, diagnose both together, count.

`python benchmarks/sealed/follow.py DIR [--label NAME] [--count 20] [--jobs 2]`

Takes scored recordings (`solve.py`, `score.py`) in which a finding has doubles and advice. The
world makes the same scene again under the plan that was named best, `jaxvm diagnose FIRST --with
SECOND` sees the two and nothing else, and the key tells whether the doubles came apart: the right
name in a set that has no longer both names of any pair that the plan promised to part. Stricter are
*first*: it leads there, too; and *alone*: no other name at all is left. Writes DIR/follow.json and
benchmarks/sealed/seeds/NAME/follow.md.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from judge import catalogue_rows, claims
from names import Facts, same_name
from score import sealed_key
from solve import copy_recording, environment
from tally import page_of
from world import record


def asked(folder: Path, entries: list[dict]) -> list[dict]:
    """Cases: recordings that have a finding with doubles and a plan to part them.

    Of several findings in one recording the first whose plan is said to decide.
    """
    cases = []
    for entry in entries:
        file = folder / "reports" / entry["id"] / "report.json"
        known = [truth for truth in entry["hidden"] if not truth["outside"]]
        if not file.exists() or not known:
            continue
        for finding in json.loads(file.read_text())["findings"]:
            best = next(iter(finding["advice"]), None)
            if best is None:
                continue
            before = _names(finding)
            ids = {c["physics"]: _name(c) for c in claims(finding)}
            rivals = {ids[name] for name in best["rivals"]} - {before[0]}
            if best["decides"] and rivals:
                told = {"plan": best["plan"], "chance": best["chance"]}
                told |= {"before": before, "rivals": sorted(rivals), "claims": claims(finding)}
                cases.append({"entry": entry} | told)
                break
    return cases


def _names(finding: dict) -> list[str]:
    return list(dict.fromkeys(_name(claim) for claim in claims(finding)))


def _name(claim: dict) -> str:
    return claim["catalogue_id"] or claim["physics"]


def follow(folder: Path, case: dict) -> dict:
    """Record the plan, diagnose both together; the case with what came out."""
    entry = case["entry"]
    hidden = tuple(truth["effect"] for truth in entry["hidden"])
    with tempfile.TemporaryDirectory(prefix="follow-") as place:
        work = Path(place)
        first = copy_recording(folder / "recordings" / entry["id"], work)
        again = record(entry["kind"], entry["seed"], hidden, plan=case["plan"], size=entry["size"])
        again.write(work / "further")
        command = [sys.executable, "-m", "jaxvm.cli", "diagnose", first.name, "--with", "further"]
        done = subprocess.run(
            [*command, "--out", "report", "--data-only"],
            cwd=work, env=environment(), stdin=subprocess.DEVNULL, capture_output=True, text=True,
        )  # fmt: skip
        file = work / "report" / "report.json"
        if not file.exists():
            return case | {"failed": done.stderr.strip().splitlines()[-1:]}
        report = json.loads(file.read_text())
        shutil.rmtree(work / "report")
    known = json.loads((folder / "score-cache" / f"{entry['id']}.json").read_text())
    return case | outcome(case, report, Facts(**known["shown"]["facts"]))


def outcome(case: dict, report: dict, facts: Facts) -> dict:
    """Whether the right name is found after both recordings, and what is left beside it.

    Of several hidden effects those count that the finding may have been: another one that comes out
    right says nothing of this advice.
    """

    def right(claim: dict, truths: list[dict]) -> bool:
        rows = claim["rows"] or catalogue_rows(claim["catalogue_id"])
        return any(same_name(truth, rows, facts) for truth in truths)

    meant = [t for t in case["entry"]["hidden"] if any(right(c, [t]) for c in case["claims"])]
    found = [f for f in report["findings"] if any(right(c, meant) for c in claims(f))]
    first = [right(claims(f)[0], meant) for f in found]
    pairs = [{case["before"][0], rival} for rival in case["rivals"]]
    # A name that is no other physics for the key (an exact tie) is not left over.
    alone = [all(right(claim, meant) for claim in claims(f)) for f in found]
    parted = [not any(pair <= set(_names(f)) for pair in pairs) for f in found]
    return {
        "after": [_names(finding) for finding in report["findings"]],
        "meant": [truth["effect"] for truth in meant],
        "apart": any(a or p for a, p in zip(alone, parted, strict=True)),
        "first": any(f and (a or p) for f, a, p in zip(first, alone, parted, strict=True)),
        "alone": any(alone),
    }


def markdown(label: str, results: list[dict]) -> str:
    """What came of every case, and how many came apart."""
    number, expected = len(results), sum(case["chance"] for case in results)
    apart, first, alone = (
        sum(case.get(key, False) for case in results) for key in ("apart", "first", "alone")
    )
    rows = [
        f"| {case['id']} | {', '.join(case['hidden'])} | {', '.join(case['before'])} "
        f"| {case['plan']} | {case['chance']:.0%} | {_came_of(case)} |"
        for case in results
    ]
    return "\n".join(
        [
            f"# Advice followed on sealed set {label}",
            "",
            f"{apart} of {number} findings that were promised to come apart from their doubles did "
            f"({expected:.1f} expected), {first} with the right name first, {alone} with it alone.",
            "",
            "| recording | hidden | finding and doubles | plan | promised | both together |",
            "|---|---|---|---|---|---|",
            *rows,
            "",
        ]
    )


def _came_of(case: dict) -> str:
    if "failed" in case:
        return f"failed: {' '.join(case['failed'])}"
    named = "; ".join(", ".join(names) for names in case["after"]) or "nothing found"
    return f"{'apart' if case['apart'] else 'not apart'}: {named}"


def main() -> None:
    parser = argparse.ArgumentParser(description="record what the diagnoses advised, and see")
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--label", help="name of the table; that of the folder by default")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    folder = options.folder.resolve()
    entries, _ = sealed_key(folder)
    cases = asked(folder, entries)[: options.count]
    print(f"{len(cases)} recordings have doubles and a plan that is said to decide", flush=True)
    results = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for case in pool.map(lambda c: follow(folder, c), cases):
            entry, _ = case.pop("entry"), case.pop("claims")
            case |= {"id": entry["id"], "hidden": [t["effect"] for t in entry["hidden"]]}
            results.append(case)
            state = "apart" if case.get("apart") else case.get("after", case.get("failed"))
            words = f"{case['id']}  {case['hidden']}  {case['before']}  {case['plan']}"
            print(f"{words}  ({case['chance']:.0%}): {state}", flush=True)
    label = options.label or folder.name
    text = markdown(label, results)
    page_of(label, "follow.md").write_text(text, encoding="utf-8")
    print(text.splitlines()[2])
    (folder / "follow.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
