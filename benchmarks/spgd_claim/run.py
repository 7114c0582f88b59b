"""Does the cost of adjustment rise steeply with a network while SPGD's stays about the same?

    python benchmarks/spgd_claim/run.py [--quick] [--resume]

Networks of 5 to 10,000 stations are adjusted by dense condition adjustment, sparse Gauss-Newton,
SPGD and L-BFGS, each to 1.01 times the optimal cost and to 1 % of the initial cost. One process for
each network size, one core for each process. results.json is written after every cell; with
--resume what stands there is not done again. See README.md.
"""

import argparse
import itertools
import json
import os
import platform
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).parent
SIZES = [5, 10, 14, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000]
LINKS = ["1.2", "2", "4"]
METHODS = ["condition", "sparse", "spgd", "lbfgs"]
RACES = ["step", "optimum", "early", "rough"]
LATER = 0.1
"""Share of the limit that a race has on networks larger than one where it was censored."""

_PATIENCE_S = 300.0
"""What a cell may take beyond four times its limit (to prepare and compile) before it is ended."""


def key(kind: str, n: int, seed: int, method: str, race: str) -> str:
    """Name of a cell."""
    return f"{kind}, {n} stations, seed {seed}, {method}, {race}"


def seeds(n: int, networks: int) -> range:
    """Fewer networks where they are large."""
    return range(networks if n <= 200 else min(networks, 2) if n <= 1_000 else 1)


class Results:
    """results.json: cells by name, rows of the study of loops, and how it was run."""

    def __init__(self, path: Path, resume: bool):
        self.path, self._lock = path, threading.Lock()
        there = resume and path.exists()
        self.content = json.loads(path.read_text()) if there else {"cells": {}, "wander": []}

    def begin(self, settings: dict) -> None:
        """Note how it is run; the seconds of earlier runs count on."""
        seconds = self.content.get("settings", {}).get("seconds", 0.0)
        self._since = time.perf_counter() - seconds
        self.content["settings"] = settings | {"seconds": seconds}

    def add(self, name: str, cell: dict) -> None:
        """Write a cell; those of the study of loops have no name of their own."""
        with self._lock:
            if name.startswith("wander"):
                self.content["wander"].append(cell)
            else:
                self.content["cells"][name] = cell
            self.content["settings"]["seconds"] = time.perf_counter() - self._since
            self._write()

    def _write(self) -> None:
        """Replace the file at once, so that it is whole whenever this is stopped."""
        new = self.path.with_suffix(".tmp")
        new.write_text(json.dumps(self.content, indent=1) + "\n")
        new.replace(self.path)

    def has(self, name: str) -> bool:
        return name in self.content["cells"] or any(
            name == wander_key(row["kind"], row["n"], row["gain"]) for row in self.content["wander"]
        )

    def known(self, kind: str, n: int, limit_s: float) -> dict:
        """What a worker on one size of one kind has to know.

        Names of the cells that are done; methods and races that took too long to be repeated on
        this size; those that did not come to their target on a smaller one.
        """
        with self._lock:
            cells = [(name, c) for name, c in self.content["cells"].items() if c["kind"] == kind]
        own = [(name, cell) for name, cell in cells if cell["n"] == n]
        smaller = [cell for _, cell in cells if cell["n"] < n]
        return {
            "done": [name for name, _ in own],
            "slow": [f"{c['method']} {c['race']}" for _, c in own if too_long(c, limit_s)],
            "censored": [
                f"{c['method']} {c['race']}" for c in smaller if c["status"] == "censored"
            ],
        }


def too_long(cell: dict, limit_s: float) -> bool:
    """Whether other networks of the size are left out."""
    return cell["status"] == "censored" or cell.get("seconds", 0.0) > 0.5 * limit_s


def wander_key(kind: str, n: int, gain: str) -> str:
    """Name of a row of the study of loops."""
    return f"wander, {kind}, {n}, {gain}"


def worker(job: dict) -> Iterator[tuple[str, dict | None]]:
    """Work through the cells of one size of one kind; each is announced before it begins."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {job["core"]})
    if job["kind"] == "wander":
        from wander import study

        for kind, n, gain, runs in job["rows"]:
            name = wander_key(kind, n, gain)
            yield name, None
            yield name, study(kind, n, gain, runs)
        return
    left = list(itertools.product(job["seeds"], RACES, job["methods"]))
    left = [(*cell, key(job["kind"], job["n"], cell[0], cell[2], cell[1])) for cell in left]
    left = [cell for cell in left if cell[-1] not in job["done"] and _worthwhile(job, *cell[:3])]
    if left:
        yield from _cells(job, left)


def _worthwhile(job: dict, seed: int, rule: str, method: str) -> bool:
    """Whether a cell is run: on the first network always, on others where it doesn't take long."""
    what = f"{method} {rule}"
    return not seed or not (rule == "step" or what in job["slow"] or what in job["censored"])


def _cells(job: dict, left: list[tuple[int, str, str, str]]) -> Iterator[tuple[str, dict | None]]:
    """The cells left, network by network.

    Steps come first: they compile, and say how long an evaluation takes.
    """
    from layouts import layout
    from methods import METHODS as methods
    from methods import Contest, TooLarge, race, step

    kind, n, limit_s = job["kind"], job["n"], job["limit_s"]
    for seed, own in itertools.groupby(left, lambda cell: cell[0]):
        contest = Contest(layout(kind, n, seed))
        for _, rule, method, name in own:
            if not _worthwhile(job, seed, rule, method):
                continue
            yield name, None
            what = f"{method} {rule}"
            if rule == "step":
                try:
                    cell = step(methods[method], contest)
                except TooLarge as error:
                    cell = {"status": "censored", "why": str(error)}
            else:
                limit = limit_s * (LATER if what in job["censored"] else 1.0)
                cell = race(methods[method], contest, rule, limit)
            if too_long(cell, limit_s):
                job["slow"].append(what)
            links = len(contest.layout.graph.edges)
            yield name, {"kind": kind, "n": n, "links": links, "seed": seed,
                         "method": method, "race": rule, **cell}  # fmt: skip


def supervise(job: dict, core: int, results: Results) -> None:
    """Run a worker on one core; a cell that never ends is recorded and its process ended."""
    while True:
        begun, process = None, _started(job, core)
        lines: queue.Queue[str | None] = queue.Queue()

        def read(stream=process.stdout, lines=lines):
            for line in stream:
                lines.put(line)
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        try:
            while (line := _next(lines, 4.0 * job["limit_s"] + _PATIENCE_S)) is not None:
                begun, cell = json.loads(line)
                if cell is not None:
                    results.add(begun, cell)
                    print(f"{begun}: {_told(cell)}", flush=True)
        except queue.Empty:
            why = "ended from outside: it took far longer than its limit"
        else:
            if process.wait() == 0:
                return
            why = f"the process ended with code {process.returncode}"
        process.kill()
        if begun is None or results.has(begun) or job["kind"] == "wander":
            raise RuntimeError(f"{job['kind']} {job.get('n', '')}: {why}")
        # The rest of the job goes on in a new process.
        name, seed, method, rule = begun, *_parsed(begun)
        results.add(name, {"kind": job["kind"], "n": job["n"], "links": None, "seed": seed,
                           "method": method, "race": rule, "status": "censored",
                           "cost": None, "evaluations": 0, "why": why})  # fmt: skip
        job = job | results.known(job["kind"], job["n"], job["limit_s"])


def _next(lines: queue.Queue, seconds: float) -> str | None:
    """The next line; queue.Empty if none comes. A pause of everything counts for one part only."""
    parts = 20
    for _ in range(parts - 1):
        try:
            return lines.get(timeout=seconds / parts)
        except queue.Empty:
            continue
    return lines.get(timeout=seconds / parts)


def _started(job: dict, core: int) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, __file__, "--worker", json.dumps(job | {"core": core})],
        stdout=subprocess.PIPE, text=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def _parsed(name: str) -> tuple[int, str, str]:
    _, _, seed, method, rule = name.split(", ")
    return int(seed.split()[1]), method, rule


def _told(cell: dict) -> str:
    if "seconds" in cell:
        return (
            f"{cell['status']}, {cell['evaluations']} evaluations, {cell['seconds']:.3g} s, "
            f"cost {cell['cost']:.6g} for {cell['target']:.6g}"
        )
    return f"{cell['step_s']:.3g} s a step" if "step_s" in cell else cell.get("why", "done")


def jobs(options, results: Results) -> list[dict]:
    """All sizes of all kinds, small ones first; kinds take turns."""
    from layouts import possible
    from wander import GAINS, POSE_RING, RINGS

    rows = [
        ("numbers", n, gain, 128 if options.quick else 1024)
        for n in (RINGS[:2] if options.quick else RINGS)
        for gain in GAINS
    ] + [("poses", POSE_RING, gain, 16 if options.quick else 64) for gain in GAINS]
    missing = [row for row in rows if not results.has(wander_key(*row[:3]))]
    first = [{"kind": "wander", "rows": missing, "limit_s": 600.0}] if missing else []
    kinds = [*(f"random {links}" for links in options.redundancies), "ring", "ladder"]
    return first + [
        {"kind": kind, "n": n, "seeds": list(seeds(n, options.networks)),
         "methods": options.methods, "limit_s": options.limit_s}
        for n in sorted(options.sizes) for kind in kinds if possible(kind, n)
    ]  # fmt: skip


def race_all(options, results: Results) -> None:
    """All jobs, one to a core; a size begins when the smaller one of its kind has ended."""
    waiting, busy, failed = jobs(options, results), set(), []
    free = threading.Condition()

    def work(core: int) -> None:
        while True:
            with free:
                while waiting and not failed:
                    ready = [j for j in waiting if j["kind"] not in busy]
                    if ready:
                        break
                    free.wait()
                if not waiting or failed:
                    return
                job = ready[0]
                waiting.remove(job)
                busy.add(job["kind"])
            if job["kind"] != "wander":
                job = job | results.known(job["kind"], job["n"], options.limit_s)
            try:
                supervise(job, core, results)
            except Exception as error:
                failed.append(error)
            with free:
                busy.discard(job["kind"])
                free.notify_all()

    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    threads = [threading.Thread(target=work, args=(core,)) for core in cores[: options.workers]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        raise failed[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", help="stations")
    parser.add_argument("--redundancies", nargs="+", default=LINKS, help="links for each station")
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--networks", type=int, help="of each small size")
    parser.add_argument("--limit-s", type=float, help="seconds of a cell")
    parser.add_argument("--workers", type=int, default=2, help="processes, each on its own core")
    parser.add_argument("--quick", action="store_true", help="small sizes, into report/")
    parser.add_argument("--resume", action="store_true", help="do what results.json lacks")
    parser.add_argument("--only-report", action="store_true", help="tables and figures again")
    parser.add_argument("--out", type=Path, help="folder of the results")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        for line in worker(json.loads(options.worker)):
            print(json.dumps(line), flush=True)
        return
    options.sizes = options.sizes or ([5, 10, 20, 50] if options.quick else SIZES)
    options.networks = options.networks or (1 if options.quick else 3)
    options.limit_s = options.limit_s or (2.0 if options.quick else 20.0)
    out = options.out or (HERE / "report" if options.quick else HERE)
    out.mkdir(parents=True, exist_ok=True)
    results = Results(out / "results.json", options.resume or options.only_report)
    began = time.perf_counter()
    if not options.only_report:
        results.begin({
            "sizes": options.sizes, "redundancies": options.redundancies,
            "limit_s": options.limit_s, "workers": options.workers,
            "processor": _processor(), "cores": os.cpu_count(),
        })  # fmt: skip
        race_all(options, results)
    from figures import draw
    from verdict import report

    (out / "results.md").write_text(report(results.content))
    draw(results.content, out)
    print(f"{time.perf_counter() - began:.0f} s; {out / 'results.md'}")


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


if __name__ == "__main__":
    main()
