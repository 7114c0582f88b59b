"""Diagnose all recordings of a sealed benchmark, in processes that see the recordings alone.

`python benchmarks/sealed/solve.py DIR [--jobs 2] [--batch 12] [--json-only]`

Every batch is copied into a fresh temporary folder without the key, and `jaxvm diagnose` runs there
as a process of its own. Reports go to DIR/reports/rNNNN/. Recordings of one shape share a batch, so
that their compiled programs are used again. What has a report is skipped; what failed has
`failed.txt` and is tried again with --again.
"""

import argparse
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

SETTLED_S = 2.0
"""A report that has not changed for so long (s) is complete."""

POLL_S = 1.0


def shape(recording: Path) -> tuple:
    """What decides the sizes of the compiled programs: numbers of bodies, epochs, quantities."""
    model = tomllib.loads((recording / "recording.toml").read_text(encoding="utf-8"))
    bodies = (len(model.get(k, {})) for k in ("cameras", "stations", "targets", "rangefinders"))
    with (recording / "epochs.csv").open(encoding="utf-8") as lines:
        epochs = sum(1 for _ in lines) - 1
    return (*bodies, epochs, len(model.get("drivers", {})))


def batches(recordings: list[Path], size: int, jobs: int) -> list[list[Path]]:
    """Recordings sorted by shape, cut into batches of at most `size` and enough for all jobs."""
    ordered = sorted(recordings, key=lambda folder: (shape(folder), folder.name))
    size = max(1, min(size, -(-len(ordered) // jobs)))
    return [ordered[first : first + size] for first in range(0, len(ordered), size)]


def copy_recording(source: Path, folder: Path) -> Path:
    """A copy of a recording; a link or a folder inside could lead to the key and is refused."""
    target = folder / source.name
    target.mkdir()
    for file in sorted(source.iterdir()):
        if file.is_symlink() or not file.is_file():
            raise ValueError(f"{file} is not a plain file; a recording consists of files alone")
        shutil.copyfile(file, target / file.name)
    return target


def command(recordings: list[str], json_only: bool) -> list[str]:
    """The command of one worker; with one recording its report goes where --out says."""
    out = "reports" if len(recordings) > 1 else f"reports/{recordings[0]}"
    options = ["--data-only"] if json_only else []
    return [sys.executable, "-m", "jaxvm.cli", "diagnose", *recordings, "--out", out, *options]


def environment() -> dict[str, str]:
    """The environment of a worker: nothing in it names the folder of the benchmark."""
    return {name: value for name, value in os.environ.items() if name not in ("PWD", "OLDPWD")}


def run_batch(
    batch: list[Path], reports: Path, json_only: bool, stop: threading.Event
) -> Iterator[tuple[str, str]]:
    """Diagnose a batch; yields (name, words) when a recording is through, whether well or not.

    After a crash the recording at fault gets failed.txt, and the others go on in a new process.
    When `stop` is set the process is ended, and what has no report yet is left as it was.
    """
    with tempfile.TemporaryDirectory(prefix="sealed-") as place:
        work = Path(place)
        left = [copy_recording(recording, work).name for recording in batch]
        while left:
            began = time.perf_counter()
            with (work / "stderr.txt").open("w") as log:
                process = subprocess.Popen(
                    command(left, json_only),
                    cwd=work,
                    env=environment(),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    start_new_session=True,
                )
                while process.poll() is None:
                    time.sleep(POLL_S)
                    if stop.is_set():
                        process.terminate()
                        process.wait()
                        return
                    for name in _collected(left, work / "reports", reports, SETTLED_S):
                        left.remove(name)
                        yield name, f"{time.perf_counter() - began:6.0f} s into its batch"
            for name in _collected(left, work / "reports", reports, 0.0):
                left.remove(name)
                yield name, f"{time.perf_counter() - began:6.0f} s into its batch"
            if stop.is_set():
                return
            text = (work / "stderr.txt").read_text(encoding="utf-8", errors="replace")
            for name in _failures(left, text):
                folder = reports / name
                folder.mkdir(parents=True, exist_ok=True)
                status = f"exit status {process.returncode}"
                (folder / "failed.txt").write_text(f"{status}\n{text[-4000:]}")
                left.remove(name)
                lines = [line for line in text.splitlines() if f"jaxvm diagnose {name}:" in line]
                yield name, "FAILED: " + (lines or text.splitlines() or [status])[-1]


def _collected(names: list[str], source: Path, target: Path, settled: float) -> list[str]:
    """Names whose reports are complete; their folders are moved out of the worker's place."""
    moved = []
    for name in names:
        report = source / name / "report.json"
        if not report.is_file() or time.time() - report.stat().st_mtime < settled:
            continue
        shutil.rmtree(target / name, ignore_errors=True)
        shutil.move(source / name, target / name)
        moved.append(name)
    return moved


def _failures(missing: list[str], text: str) -> list[str]:
    """Recordings without a report that are at fault: complained about, or the first of a crash."""
    complained = [name for name in missing if f"jaxvm diagnose {name}:" in text]
    return complained or missing[:1]


def solve(folder: Path, jobs: int, size: int, json_only: bool, again: bool) -> int:
    """Diagnose what has no report yet; returns how many failed."""
    reports = folder / "reports"
    reports.mkdir(exist_ok=True)
    done = ("report.json",) if again else ("report.json", "failed.txt")
    recordings = [
        recording
        for recording in sorted((folder / "recordings").iterdir())
        if not any((reports / recording.name / file).exists() for file in done)
    ]
    waiting: queue.SimpleQueue[list[Path]] = queue.SimpleQueue()
    for batch in batches(recordings, size, jobs):
        waiting.put(batch)
    print(f"{len(recordings)} recordings to diagnose, {jobs} processes", flush=True)
    lock, stop, failed, through = threading.Lock(), threading.Event(), [], []
    began = time.perf_counter()

    def work() -> None:
        while not stop.is_set():
            try:
                batch = waiting.get_nowait()
            except queue.Empty:
                return
            for name, words in run_batch(batch, reports, json_only, stop):
                with lock:
                    through.append(name)
                    failed.extend([name] if words.startswith("FAILED") else [])
                    clock = f"{time.perf_counter() - began:7.0f} s"
                    count = f"{len(through)}/{len(recordings)}"
                    print(f"{clock}  {count}  {name}  {words}", flush=True)

    threads = [threading.Thread(target=work) for _ in range(jobs)]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            thread.join()
    finally:
        stop.set()
    return len(failed)


def main() -> None:
    parser = argparse.ArgumentParser(description="diagnose the recordings of a sealed benchmark")
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--batch", type=int, default=12, help="recordings of one process")
    parser.add_argument("--json-only", "--no-figures", action="store_true", help="no page")
    parser.add_argument("--again", action="store_true", help="try failed ones again")
    options = parser.parse_args()
    folder = options.folder.resolve()
    if not (folder / "HASH.txt").is_file():
        parser.error(f"{folder} has no HASH.txt: the key was not sealed before the diagnosis")
    print(f"key sealed as {(folder / 'HASH.txt').read_text().strip()}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    failed = solve(folder, options.jobs, options.batch, options.json_only, options.again)
    if failed:
        sys.exit(f"{failed} recordings failed; see failed.txt in their reports")


if __name__ == "__main__":
    main()
