"""Open the key of a sealed benchmark and score the diagnoses.

`python benchmarks/sealed/score.py DIR [DIR ...] [--label NAME] [--jobs 2] [--again]`

Checks that the key is the one that was sealed, computes for every recording what it could show
(kept in DIR/score-cache), judges every report, and writes DIR/results.json and
benchmarks/sealed/seeds/NAME/results.md.
"""

import argparse
import hashlib
import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from judge import judge
from tally import by_effect, figures, markdown, page_of

HERE = Path(__file__).parent


def sealed_key(folder: Path) -> tuple[list[dict], str]:
    """Entries of key.json and its SHA-256.

    Raises:
        ValueError: the key is not the one that was sealed.
    """
    text = (folder / "key" / "key.json").read_bytes()
    digest = hashlib.sha256(text).hexdigest()
    if digest not in (folder / "HASH.txt").read_text():
        raise ValueError(f"{folder}: key.json has SHA-256 {digest}, which HASH.txt does not say")
    return json.loads(text), digest


def fingerprint() -> str:
    """Of the space of hypotheses and of power.py: what is cached is anew when they change."""
    from jaxvm.discover import courses, groups, hypotheses, space
    from jaxvm.physics.catalogue import CATALOGUE

    names = [(e.id, e.groups, e.drivers, e.forms, e.entity) for e in CATALOGUE]
    modules = (hypotheses, space, courses, groups)
    sources = [*(Path(module.__file__) for module in modules), HERE / "power.py"]
    text = repr(names).encode() + b"".join(source.read_bytes() for source in sources)
    return hashlib.sha256(text).hexdigest()[:16]


def show(folder: Path, entry: dict) -> dict:
    """What a recording can show, as plain numbers. Runs in a worker."""
    from power import shown

    from jaxvm.compiling import forget_compiled_if_many
    from jaxvm.recording import read_recording

    forget_compiled_if_many()
    recording = read_recording(folder / "recordings" / entry["id"])
    return shown(recording, *sealed_changes(folder, entry), entry["noise"]).as_dict()


def sealed_changes(
    folder: Path, entry: dict
) -> tuple[tuple[np.ndarray, np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """Changes of pixels (px) and ranges (m) by all hidden effects together, and by each.

    Raises:
        ValueError: the file is not the one that was sealed.
    """
    file = folder / "key" / f"{entry['id']}.npz"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    if digest != entry["npz_sha256"]:
        raise ValueError(f"{file.name} has SHA-256 {digest}, which key.json does not say")
    with np.load(file) as arrays:
        numbers = range(len(entry["hidden"]))
        each = [(arrays[f"change_{k}"], arrays[f"change_{k}_ranges"]) for k in numbers]
        return (arrays["change"], arrays["change_ranges"]), each


def shown_of_all(folder: Path, entries: list[dict], jobs: int, again: bool) -> dict[str, dict]:
    """What every recording can show, from the cache where it is there; absent where it failed."""
    cache = folder / "score-cache"
    cache.mkdir(exist_ok=True)
    mark, known, wanted = fingerprint(), {}, []
    for entry in entries:
        file = cache / f"{entry['id']}.json"
        kept = json.loads(file.read_text()) if file.exists() and not again else {}
        if kept.get("fingerprint") == mark:
            known[entry["id"]] = kept["shown"]
        else:
            wanted.append(entry)
    context = multiprocessing.get_context("spawn")
    # Replacing workers after some tasks locks up Python 3.11's pool; they forget programs instead.
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        pending = {pool.submit(show, folder, entry): entry["id"] for entry in wanted}
        for count, future in enumerate(as_completed(pending), start=1):
            name = pending[future]
            try:
                known[name] = future.result()
            except Exception as problem:
                print(f"{count}/{len(wanted)}  {name}  can't be computed: {problem}", flush=True)
                continue
            text = json.dumps({"fingerprint": mark, "shown": known[name]}, indent=1)
            (cache / f"{name}.json").write_text(text + "\n")
            drops = ", ".join(f"{e['expected_drop']:.3g}" for e in known[name]["effects"])
            print(f"{count}/{len(wanted)}  {name}  lambda {drops or '-'}", flush=True)
    return known


def diagnosed(folder: Path, entries: list[dict]) -> list[dict]:
    """Entries of the recordings that the diagnosis was given, whether it failed or not."""
    given = []
    for entry in entries:
        reports = folder / "reports" / entry["id"]
        if (reports / "report.json").exists() or (reports / "failed.txt").exists():
            given.append(entry)
        else:
            print(f"{entry['id']} is left out: not diagnosed yet")
    return given


def judged(folder: Path, entries: list[dict], known: dict[str, dict]) -> list[dict]:
    """Rows of results of all recordings that were given to the diagnosis."""
    rows = []
    for entry in entries:
        file = folder / "reports" / entry["id"] / "report.json"
        if entry["id"] not in known:
            print(f"{entry['id']} is left out: its power is not known")
            continue
        report = json.loads(file.read_text()) if file.exists() else None
        rows.append(judge(entry, report, known[entry["id"]]) | {"benchmark": folder.name})
    return rows


def results(rows: list[dict], digests: list[str]) -> dict:
    """Content of results.json."""
    return {
        "sha256": digests,
        "figures": [figure.as_dict() for figure in figures(rows)],
        "by_effect": by_effect(rows),
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="score the diagnoses of a sealed benchmark")
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--label", default=None, help="of the page; the folders' names if not set")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="compute what is cached anew")
    options = parser.parse_args()
    rows, digests, made = [], [], 0
    for folder in options.folders:
        try:
            entries, digest = sealed_key(folder)
        except (OSError, ValueError) as problem:
            parser.error(str(problem))
        made += len(entries)
        entries = diagnosed(folder, entries)
        known = shown_of_all(folder.resolve(), entries, options.jobs, options.again)
        own = judged(folder, entries, known)
        text = json.dumps(results(own, [digest]), indent=1)
        (folder / "results.json").write_text(text + "\n")
        rows += own
        digests.append(digest)
    label = options.label or "-".join(folder.resolve().name for folder in options.folders)
    part = "" if len(rows) == made else f" ({len(rows)} of {made} recordings)"
    page = markdown(rows, f"Sealed benchmark {label}{part}", digests)
    table = page_of(label, "results.md")
    table.write_text(page, encoding="utf-8")
    print(page.split("## What went wrong")[0])
    print(f"written {table}")


if __name__ == "__main__":
    main()
