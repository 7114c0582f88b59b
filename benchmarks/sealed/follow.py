"""Follow the advice: record what a diagnosis asked for, diagnose both together, count.

`python benchmarks/sealed/follow.py DIR [--count 20] [--jobs 2]`

Takes scored recordings (`solve.py`, `score.py`) in which a finding has doubles and advice. The
world makes the same scene again under the plan that was named best, `jaxvm diagnose FIRST --with
SECOND` sees the two and nothing else, and the key tells whether the doubles came apart: the right
name first, and no other name left in its set. Writes DIR/follow.json and prints a table.
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
from world import record

from jaxvm.discover.select import DECIDED


def asked(folder: Path, entries: list[dict]) -> list[dict]:
    """Cases: recordings whose leading double has a plan that promises to decide."""
    cases = []
    for entry in entries:
        file = folder / "reports" / entry["id"] / "report.json"
        if not file.exists() or not entry["hidden"]:
            continue
        for finding in json.loads(file.read_text())["findings"]:
            best = next(iter(finding["advice"]), None)
            if best is None or not finding["equivalents"]:
                continue
            gaps = [gap for gap in best["gaps"] if gap is not None]
            cases.append(
                {
                    "entry": entry,
                    "plan": best["plan"],
                    "expected_gap": min(gaps, default=0.0),
                    "before": _names(finding),
                }
            )
            break
    return cases


def _names(finding: dict) -> list[str]:
    return list(dict.fromkeys(c["catalogue_id"] or c["physics"] for c in claims(finding)))


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
    return case | outcome(entry, report, Facts(**known["shown"]["facts"]))


def outcome(entry: dict, report: dict, facts: Facts) -> dict:
    """Whether the right name stands alone after both recordings."""
    right = [
        finding
        for finding in report["findings"]
        if any(same_name(t, claims(finding)[0]["rows"], facts) for t in entry["hidden"])
    ]
    # A name that is no other physics for the key (an exact tie) is not left over.
    alone = [
        all(
            any(same_name(t, c["rows"] or catalogue_rows(c["catalogue_id"]), facts)
                for t in entry["hidden"])
            for c in claims(finding)
        )
        for finding in right
    ]  # fmt: skip
    return {
        "after": [_names(finding) for finding in report["findings"]],
        "right": bool(right),
        "apart": any(alone),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="record what the diagnoses advised, and see")
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    folder = options.folder.resolve()
    entries, _ = sealed_key(folder)
    cases = asked(folder, entries)[: options.count]
    print(f"{len(cases)} recordings have doubles and advice", flush=True)
    results = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for case in pool.map(lambda c: follow(folder, c), cases):
            entry = case.pop("entry")
            case |= {"id": entry["id"], "hidden": [t["effect"] for t in entry["hidden"]]}
            results.append(case)
            state = case.get("failed") or ("apart" if case["apart"] else case["after"])
            words = f"{case['id']}  {case['hidden']}  {case['before']}  {case['plan']}"
            print(f"{words}  (gap {case['expected_gap']:.3g}): {state}", flush=True)
    promised = [c for c in results if c["expected_gap"] >= DECIDED and "failed" not in c]
    apart = sum(c["apart"] for c in promised)
    print(f"{apart} of {len(promised)} doubles that the advice promised to separate came apart")
    (folder / "follow.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
