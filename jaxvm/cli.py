"""Commands. Each is a thin wrapper of a function that a notebook calls."""

import argparse
import json
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxvm import __version__

BAD_INPUT = 2
INTERRUPTED = 130


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status (0 done, 2 bad input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    options.interruption = Interruption()
    try:
        with options.interruption:
            answer, text = options.run(options)
    except KeyboardInterrupt:
        print("interrupted; nothing was left half-written", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, OSError) as problem:
        # Every foreseen complaint is a ValueError or OSError whose message names the mend.
        print(f"jaxvm {options.command}: {problem}", file=sys.stderr)
        return BAD_INPUT
    print(json.dumps(answer, indent=1, allow_nan=False) if options.json else text)
    return 0


class Interruption:
    """Ctrl-C, remembered: what arrives in a library's callback is lost there, but not here."""

    def __init__(self) -> None:
        self.asked = False
        self._former: Any = None

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            self._former = signal.signal(signal.SIGINT, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        if self._former is not None:
            signal.signal(signal.SIGINT, self._former)

    def _stop(self, *_: object) -> None:
        self.asked = True
        raise KeyboardInterrupt

    def check(self) -> None:
        """Stop now if somebody asked for it before.

        Raises:
            KeyboardInterrupt: somebody did.
        """
        if self.asked:
            raise KeyboardInterrupt


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxvm",
        description="Measure with networks of cameras, and find the physics that a model left out.",
    )
    parser.add_argument("--version", action="version", version=f"jaxvm {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Callable, words: str) -> argparse.ArgumentParser:
        own = commands.add_parser(name, help=words, description=words)
        own.set_defaults(run=run)
        own.add_argument("--json", action="store_true", help="print the answer as JSON")
        own.add_argument("--quiet", action="store_true", help="no progress")
        return own

    demo = command("demo", _demo, "hide physics in a simulated recording and find it")
    demo.add_argument("--seed", type=_natural, default=10, help="draws scene, noise and effect")
    demo.add_argument(
        "--hide",
        default=None,
        metavar="EFFECT",
        help='effects to hide, with commas; "nothing"; drawn by the seed if not given',
    )
    demo.add_argument("--size", choices=("full", "small"), default="full")
    demo.add_argument("--out", type=Path, default=Path("jaxvm-demo"), metavar="DIR")

    diagnose = command("diagnose", _diagnose, "find the physics that a model left out")
    diagnose.add_argument(
        "recording",
        nargs="+",
        help="folder of a recording, or the name of a public one; several are diagnosed one by one",
    )
    _model_argument(diagnose)
    diagnose.add_argument(
        "--with",
        dest="further",
        action="append",
        default=[],
        metavar="RECORDING",
        help="a further recording of the same cameras and bodies, diagnosed together with it",
    )
    diagnose.add_argument("--out", type=Path, default=Path("jaxvm-report"), metavar="DIR")
    diagnose.add_argument(
        "--data-only", action="store_true", help="report.json and model.toml, no page, no figures"
    )
    diagnose.add_argument("--every", type=_natural, default=3, help="hold out every n-th epoch")
    diagnose.add_argument("--alpha", type=float, default=0.01, help="risk of a false claim")
    diagnose.add_argument("--seed", type=_natural, default=0, help="of sign-flips and bootstrap")

    adjust = command("adjust", _adjust, "least-squares adjustment of a recording")
    _recording_argument(adjust)
    adjust.add_argument("--out", type=Path, default=None, metavar="DIR")
    adjust.add_argument(
        "--method",
        choices=("levenberg-marquardt", "gauss-newton", "spgd", "lbfgs"),
        default="levenberg-marquardt",
    )
    adjust.add_argument(
        "--start",
        choices=("auto", "given", "chordal", "best"),
        default="auto",
        help="start values of poses: those given and chains from them, all relations together, "
        "or whichever fits best",
    )
    adjust.add_argument(
        "--snoop", action="store_true", help="set aside links with gross errors, and name them"
    )
    adjust.add_argument(
        "--loss", choices=("squared", "huber", "cauchy", "tukey"), default="squared"
    )

    identify = command("identify", _identify, "identify how cameras drift with temperature")
    _recording_argument(identify)
    identify.add_argument("--out", type=Path, default=Path("drift.toml"), metavar="FILE")
    identify.add_argument(
        "--two-steps", action="store_true", help="do not refine through the residual of the network"
    )

    compensate = command("compensate", _compensate, "take drift off the pixels of a recording")
    compensate.add_argument("recording", help="folder of a recording")
    compensate.add_argument(
        "--model", type=Path, required=True, metavar="FILE", help="what jaxvm identify wrote"
    )
    compensate.add_argument("--out", type=Path, required=True, metavar="RECORDING")

    simulate = command("simulate", _simulate, "write a simulated recording")
    simulate.add_argument(
        "scene",
        help='"deformation" (a world of its own, where physics is hidden), a network of the '
        "examples by its name (ship, tunnel, bridge, wind-tunnel, chain, double-chain, ring, "
        "station, random), or a TOML that describes one",
    )
    simulate.add_argument("--out", type=Path, required=True, metavar="RECORDING")
    simulate.add_argument("--seed", type=_natural, default=0, help="of the noise")
    simulate.add_argument(
        "--truth",
        type=Path,
        default=None,
        metavar="DIR",
        help='networks: folder for what is true; beside the recording, with "-truth"',
    )
    simulate.add_argument(
        "--hide", default=None, metavar="EFFECT", help="deformation: effects, with commas"
    )
    simulate.add_argument(
        "--size", choices=("full", "small"), default=None, help="deformation: full by default"
    )
    simulate.add_argument(
        "--strength", type=float, default=None, help="deformation: factor on every effect"
    )

    montecarlo = command(
        "montecarlo", _montecarlo, "adjust a simulated network many times: errors against theory"
    )
    montecarlo.add_argument("scene", help="as for simulate: an example by its name, or a TOML")
    montecarlo.add_argument("--trials", type=_positive, default=1000)
    montecarlo.add_argument("--batch", type=_positive, default=128, help="trials at a time")
    montecarlo.add_argument("--seed", type=_natural, default=0, help="of the noise")
    montecarlo.add_argument("--out", type=Path, default=None, metavar="DIR")

    convert = command("convert", _convert, "make a recording of other programs' files")
    convert.add_argument(
        "source",
        help="table of corners (.csv), mrcal's corners (.vnl) or .cameramodel, OpenCV's "
        "calibration (.yml, .xml), a pose graph (.g2o, .g2o.gz), the folder of a recording, or the "
        "name of a public one",
    )
    convert.add_argument(
        "--out", type=Path, required=True, metavar="RECORDING", help="a folder, or a .g2o file"
    )
    convert.add_argument(
        "--mend", action="store_true", help="g2o: mend information that is not positive definite"
    )
    convert.add_argument("--table", choices=("csv", "parquet"), default="csv")
    convert.add_argument("--image-size", type=_size, default=None, metavar="WxH")
    convert.add_argument("--spacing", type=float, default=None, metavar="METRES")
    convert.add_argument("--rows", type=_natural, default=None)
    convert.add_argument("--columns", type=_natural, default=None)
    convert.add_argument("--lens", default="opencv8")

    validate = command("validate", _validate, "check a recording and tell what is in it")
    _recording_argument(validate)
    return parser


def _recording_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", help="folder of a recording, or the name of a public one")
    _model_argument(parser)


def _model_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model", type=Path, default=None, metavar="FILE", help="in place of its recording.toml"
    )


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def _positive(text: str) -> int:
    value = _natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError("it must be at least 1")
    return value


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text} is not like 6016x4016")
    return int(width), int(height)


def _progress(options) -> Callable[[str], None]:
    """Lines with the elapsed time on stderr."""
    began = time.perf_counter()

    def line(text: str) -> None:
        options.interruption.check()
        if not options.quiet:
            print(f"{time.perf_counter() - began:6.1f} s  {text}", file=sys.stderr, flush=True)

    return line


def _open(name: str, model: Path | None = None):
    """The recording that a command is about: a folder, or a public one by name."""
    from jaxvm.recording import DATASETS, open_recording, read_recording
    from jaxvm.recording.g2o import import_g2o

    if name.endswith((".g2o", ".g2o.gz")):
        if model is not None:
            raise ValueError(f"--model goes with a folder; convert {name} to one first")
        return import_g2o(name)
    if name in DATASETS and not Path(name).exists():
        return open_recording(name, model)
    return read_recording(name, model)


def _report(diagnosis, out: Path, data_only: bool = False) -> tuple[dict[str, Any], str]:
    from jaxvm.report import document, summary, write_report

    page = write_report(diagnosis, out, data_only)
    answer = document(diagnosis) | {"report": str(page)}
    return answer, f"{summary(diagnosis)}\n\nreport     {page}"


def _demo(options):
    from jaxvm.demo import demo, paragraph
    from jaxvm.solve.compiling import keep_compiled

    keep_compiled()
    shown = demo(options.seed, options.hide, options.size, options.out, _progress(options))
    answer, text = _report(shown.diagnosis, options.out)
    answer["hidden"] = [truth.effect for truth in shown.truth]
    answer["paragraph"] = paragraph(shown, options.out / "report.html")
    return answer, f"{text}\n\n{answer['paragraph']}"


def _diagnose(options):
    from jaxvm.solve.compiling import keep_compiled

    keep_compiled()
    if not 0.0 < options.alpha < 1.0:
        raise ValueError(f"--alpha is {options.alpha:g}; it is a probability between 0 and 1")
    if len(options.recording) == 1:
        return _diagnose_one(options, options.recording[0], options.out)
    if options.further:
        raise ValueError("--with joins further recordings to one; give only one before it")
    folders = [Path(name).name for name in options.recording]
    twice = {folder for folder in folders if folders.count(folder) > 1}
    if twice:
        raise ValueError(f"two recordings are called {min(twice)}; their reports would collide")
    answers, failed = {}, []
    for name, folder in zip(options.recording, folders, strict=True):
        try:
            answers[folder], _ = _diagnose_one(options, name, options.out / folder)
        except (ValueError, OSError) as problem:
            print(f"jaxvm diagnose {name}: {problem}", file=sys.stderr, flush=True)
            failed.append(folder)
    lines = [f"{folder}: {answer['verdict']}" for folder, answer in answers.items()]
    if failed:
        raise ValueError(f"{len(answers)} recordings diagnosed; not so {', '.join(failed)}")
    return answers, "\n".join(lines)


def _diagnose_one(options, name: str, out: Path):
    from jaxvm.discover import diagnose
    from jaxvm.recording import join

    progress = _progress(options)
    recording = _open(name, options.model)
    for further in options.further:
        recording = join(recording, _open(further))
    found = diagnose(
        recording, every=options.every, alpha=options.alpha, seed=options.seed, progress=progress
    )
    progress("writing the report")
    return _report(found, out, options.data_only)


def _adjust(options):
    from jaxvm.network.estimate import estimated_model, pose_table
    from jaxvm.network.scene import build
    from jaxvm.network.start import is_network, start
    from jaxvm.recording import model_text
    from jaxvm.recording.files import write_files
    from jaxvm.report.network import write_network_page
    from jaxvm.solve.adjust import adjust, pixel_rms
    from jaxvm.solve.compiling import keep_compiled
    from jaxvm.solve.covariance import standard_deviations
    from jaxvm.solve.optimise import METHODS
    from jaxvm.solve.robust import LOSSES
    from jaxvm.solve.snooping import snoop_links

    keep_compiled()
    progress = _progress(options)
    progress("start values from the data")
    scene = start(build(_open(options.recording, options.model)), options.start)
    progress("adjustment")
    rejected = []
    if options.snoop:
        if options.method not in METHODS or options.loss != "squared":
            raise ValueError("--snoop goes with --method levenberg-marquardt or gauss-newton alone")
        result, rejected, _ = snoop_links(scene, method=options.method)
    else:
        result = adjust(scene, options.method, LOSSES[options.loss]())
    residuals = result.residuals()
    answer = {
        "cost_before": result.cost_before,
        "cost": result.cost,
        "variance_factor": result.variance_factor,
        "degrees_of_freedom": result.degrees_of_freedom,
        "pixel_rms_px": pixel_rms(result.scene, residuals) if residuals.pixels else None,
        "evaluations": result.evaluations,
        "why": result.why,
        "seconds": result.seconds,
        "rejected": [{"where": r.where, "test": r.test} for r in rejected],
    }
    text = result.summary()
    for r in rejected:
        text += f"\nset aside          {r.where} (test {r.test:.1f})"
    if options.out is not None:
        progress("precision")
        deviations = standard_deviations(result, result.variance_factor)
        files = {
            "adjustment.json": json.dumps(answer, indent=1) + "\n",
            "model.toml": model_text(estimated_model(result.scene)),
            "poses.csv": pose_table(result.scene, deviations).to_csv(index=False),
        }
        write_files(options.out, files)
        names = list(files)
        if is_network(result.scene):
            progress("the picture of the network")
            links = result.scene.recording.links
            page = write_network_page(
                result,
                options.out,
                [links.name[r.row] for r in rejected] if links is not None else (),
                method=options.method,
                scale=result.variance_factor,
            )
            names.append(page.name)
        text += f"\nwritten            {options.out}: {', '.join(names)}"
    return answer, text


def _identify(options):
    from jaxvm.identify import identify
    from jaxvm.recording.files import write_files
    from jaxvm.solve.compiling import keep_compiled

    keep_compiled()
    recording = _open(options.recording, options.model)
    found = identify(recording, one_step=not options.two_steps, progress=_progress(options))
    write_files(options.out.absolute().parent, {options.out.name: found.model.text()})
    answer = {"model": str(options.out), "cameras": [own.as_dict() for own in found.cameras]}
    return answer, f"{found.summary()}\n\nwritten    {options.out}"


def _compensate(options):
    from jaxvm.identify import compensate, read_drift_model
    from jaxvm.identify.poses import image_poses
    from jaxvm.recording import write_recording
    from jaxvm.solve.compiling import keep_compiled

    keep_compiled()
    progress = _progress(options)
    recording, model = _open(options.recording), read_drift_model(options.model)
    found = compensate(recording, model)
    progress("poses before and after")
    poses = {
        "poses-before.csv": image_poses(recording).to_csv(index=False),
        "poses.csv": image_poses(found.recording).to_csv(index=False),
    }
    write_recording(found.recording, options.out, beside=poses)
    answer = found.as_dict() | {"recording": str(options.out)}
    return answer, f"{found.summary()}\nwritten    {options.out}, with {', '.join(poses)}"


def _simulate(options):
    if options.scene != "deformation":
        return _simulate_network(options)
    from jaxvm.demo import hidden_keys
    from jaxvm.recording.files import new_folder
    from jaxvm.simulate import simulate_deformation_scene

    if options.truth is not None:
        raise ValueError("--truth is for networks; what deformation hides is printed")
    made = simulate_deformation_scene(
        hidden_keys("nothing" if options.hide is None else options.hide),
        options.seed,
        options.size or "full",
        1.0 if options.strength is None else options.strength,
    )
    with new_folder(options.out) as staging:
        made.write(staging)
    hidden = " ".join(truth.sentence for truth in made.truth) or "nothing"
    answer = {"recording": str(options.out), "hidden": [truth.effect for truth in made.truth]}
    return answer, f"written    {options.out}\nhidden     {hidden}"


def _simulate_network(options):
    from jaxvm.recording import describe
    from jaxvm.scenes import read_description, simulate_network
    from jaxvm.solve.compiling import keep_compiled

    for name in ("hide", "size", "strength"):
        if getattr(options, name) is not None:
            raise ValueError(
                f"--{name} is for deformation; what a network hides stands in its TOML, as "
                '[[effects]] with model = "hidden"'
            )
    keep_compiled()
    made = simulate_network(read_description(options.scene), options.seed)
    truth = made.write(options.out, options.truth)
    told, hidden = describe(made.recording), list(made.truth.hidden)
    answer = {
        "recording": str(options.out),
        "truth": str(truth),
        "contents": told,
        "hidden": hidden,
    }
    return answer, f"written    {options.out}: {told}\ntruth      {truth}"


def _montecarlo(options):
    import jax
    import numpy as np

    from jaxvm.network.scene import build
    from jaxvm.recording.files import write_files
    from jaxvm.scenes import read_description, simulate_network
    from jaxvm.solve.compiling import keep_compiled
    from jaxvm.solve.montecarlo import station_trials

    keep_compiled()
    progress = _progress(options)
    made = simulate_network(read_description(options.scene), noise=0.0)
    scene = build(made.recording)
    scene = scene.with_state(made.truth.state(scene))
    world = None
    if made.truth.hidden:
        world = build(made.recording, made.truth.effects)
        world = world.with_state(made.truth.state(world))
    found, frame = station_trials(
        scene,
        jax.random.key(options.seed),
        options.trials,
        options.batch,
        lambda done: progress(f"{done} of {options.trials} trials"),
        world,
    )
    ratio = np.asarray(frame["measured"]) / np.asarray(frame["predicted"])
    spread = {
        "least": float(ratio.min()),
        "median": float(np.median(ratio)),
        "largest": float(ratio.max()),
    }
    answer = {
        "trials": options.trials,
        "failed": int(found.failed.sum()),
        "chi_square": found.chi_square,
        "variance_factor": float((2.0 * found.cost / found.degrees_of_freedom).mean()),
        "measured_over_predicted": spread,
        "hidden": list(made.truth.hidden),
    }
    text = "\n".join(
        [
            f"trials             {options.trials}, of which failed {answer['failed']}",
            f"variance factor    {answer['variance_factor']:.4f}",
            f"chi-square         {found.chi_square:.4f} of the errors, 1 where theory is right",
            "measured/predicted {least:.3f} to {largest:.3f}, median {median:.3f}".format(**spread),
            *([f"hidden             {', '.join(made.truth.hidden)}"] if made.truth.hidden else []),
        ]
    )
    if options.out is not None:
        files = {
            "montecarlo.json": json.dumps(answer, indent=1) + "\n",
            "montecarlo.csv": frame.to_csv(index=False),
        }
        write_files(options.out, files)
        text += f"\nwritten            {options.out}: {', '.join(files)}"
    return answer, text


def _convert(options):
    from jaxvm.recording import convert

    told = convert(
        options.source,
        options.out,
        table=options.table,
        image_size=options.image_size,
        spacing_m=options.spacing,
        rows=options.rows,
        columns=options.columns,
        lens=options.lens,
        mend=options.mend,
    )
    return {"recording": str(options.out), "contents": told}, f"written    {options.out}: {told}"


def _validate(options):
    from jaxvm.recording import describe

    told = describe(_open(options.recording, options.model))
    return {"valid": True, "contents": told}, f"valid      {told}"


if __name__ == "__main__":
    sys.exit(main())
