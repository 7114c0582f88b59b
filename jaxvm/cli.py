"""The command line: arguments, exit status, interruption. `jaxvm.commands` does the work."""

import _thread
import argparse
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxvm import __version__, commands
from jaxvm.interrupted import INTERRUPTED, LAST_WORDS

BAD_INPUT = 2

_RECORDING = "folder of a recording, a pose graph (.g2o), or the name of a public recording"


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status (0 done, 2 bad input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    options.interruption = Interruption()
    try:
        with options.interruption:
            _check_out(options)
            answer, text = options.run(options)
    except (KeyboardInterrupt, Exception) as problem:
        # A library may have made another error of an interruption.
        if options.interruption.asked or isinstance(problem, KeyboardInterrupt):
            print(LAST_WORDS, file=sys.stderr)
            return INTERRUPTED
        if not isinstance(problem, ValueError | OSError):
            raise
        from jaxvm.recording.errors import sentence

        # Every foreseen complaint is a ValueError or OSError whose message names the mend.
        print(f"jaxvm {options.command}: {sentence(problem)}", file=sys.stderr)
        return BAD_INPUT
    if options.json:
        from jaxvm.recording.files import json_text

        text = json_text(answer).rstrip()
    print(text)
    return 0


def _check_out(options: argparse.Namespace) -> None:
    """Refuse what can't be written to before anything is computed for it."""
    if getattr(options, "out", None) is not None:
        from jaxvm.recording.files import check_place

        try:
            check_place(options.out, options.writes)
        except OSError as problem:
            raise OSError(f"--out {problem}") from None


def _interrupt() -> None:
    """Ctrl-C for the main thread; by a signal where there are any, which ends a wait as well."""
    main_thread = threading.main_thread().ident
    if main_thread is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main_thread, signal.SIGINT)
    else:
        _thread.interrupt_main()


class Interruption:
    """Ctrl-C, remembered and repeated: what arrives in a callback of a library is lost there."""

    def __init__(self) -> None:
        self.asked = False
        self._former: Any = None
        self._told = sys.unraisablehook
        self._again: threading.Timer | None = None

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            self._former = signal.signal(signal.SIGINT, self._stop)
            self._told, sys.unraisablehook = sys.unraisablehook, self._swallowed
        return self

    def __exit__(self, *_: object) -> None:
        if self._former is not None:
            if self._again is not None:
                self._again.cancel()
            sys.unraisablehook = self._told
            signal.signal(signal.SIGINT, self._former)

    def _stop(self, *_: object) -> None:
        self.asked = True
        raise KeyboardInterrupt

    def _swallowed(self, unraisable: "sys.UnraisableHookArgs") -> None:
        """Interrupt again, soon, what could not be interrupted, such as a garbage collection."""
        if unraisable.exc_type is not KeyboardInterrupt:
            return self._told(unraisable)
        self._again = threading.Timer(0.05, _interrupt)
        self._again.daemon = True
        self._again.start()

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
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, words: str) -> argparse.ArgumentParser:
        own = subparsers.add_parser(name, help=words, description=words, formatter_class=_Defaults)
        own.set_defaults(run=getattr(commands, f"run_{name}"))
        own.add_argument("--json", action="store_true", help="print the answer as JSON")
        own.add_argument("--quiet", action="store_true", help="no progress")
        return own

    demo = command("demo", "hide physics in a simulated recording and find it")
    demo.add_argument("--seed", type=_whole(0), default=10, help="draws scene, noise and effect")
    demo.add_argument(
        "--hide",
        default=None,
        metavar="EFFECT",
        help='effects to hide, with commas; "nothing"; drawn by the seed if not given',
    )
    demo.add_argument("--size", choices=("full", "small"), default="full", help="of the recording")
    _out_argument(demo, "folder", "jaxvm-demo", metavar="DIR", help="recording and report")

    diagnose = command("diagnose", "find the physics that a model left out")
    diagnose.add_argument(
        "recording",
        type=_named,
        nargs="+",
        help=f"{_RECORDING}; several are diagnosed one by one",
    )
    _model_argument(diagnose)
    diagnose.add_argument(
        "--with",
        dest="further",
        action="append",
        type=_named,
        default=[],
        metavar="RECORDING",
        help="a further recording of the same cameras and bodies, diagnosed together with it",
    )
    _out_argument(diagnose, "folder", "jaxvm-report", metavar="DIR", help="report and model")
    diagnose.add_argument(
        "--data-only", action="store_true", help="report.json and model.toml, no page, no figures"
    )
    diagnose.add_argument("--every", type=_whole(2), default=3, help="hold out every n-th epoch")
    diagnose.add_argument("--alpha", type=float, default=0.01, help="risk of a false claim")
    diagnose.add_argument("--seed", type=_whole(0), default=0, help="of sign-flips and bootstrap")

    adjust = command("adjust", "least-squares adjustment of a recording")
    _recording_argument(adjust)
    _out_argument(
        adjust, "folder", metavar="DIR", help="model, poses, picture; nothing is written without"
    )
    adjust.add_argument(
        "--method",
        choices=("levenberg-marquardt", "gauss-newton", "spgd", "lbfgs"),
        default="levenberg-marquardt",
        help="how the cost is minimised",
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
        "--loss",
        choices=("squared", "huber", "cauchy", "tukey"),
        default="squared",
        help="what a residual costs; all but squared hold gross errors down",
    )

    identify = command("identify", "identify how cameras drift with temperature")
    _recording_argument(identify)
    _out_argument(identify, "file", "drift.toml", metavar="FILE", help="the model of the drift")
    identify.add_argument(
        "--two-steps", action="store_true", help="do not refine through the residual of the network"
    )

    compensate = command("compensate", "take drift off the pixels of a recording")
    compensate.add_argument("recording", type=_named, help="folder of a recording")
    compensate.add_argument(
        "--model", type=_path, required=True, metavar="FILE", help="what jaxvm identify wrote"
    )
    _out_argument(compensate, "new", required=True, metavar="RECORDING", help="a new folder")

    simulate = command("simulate", "write a simulated recording")
    simulate.add_argument(
        "scene",
        type=_named,
        help='"deformation" (a world of its own, where physics is hidden), a network of the '
        "examples by its name (ship, tunnel, bridge, wind-tunnel, chain, double-chain, ring, "
        "station, random), or a TOML that describes one",
    )
    _out_argument(simulate, "new", required=True, metavar="RECORDING", help="a new folder")
    simulate.add_argument(
        "--seed",
        type=_whole(0),
        default=0,
        help="draws the noise; of deformation also the scene (its cameras, its weather) and how "
        "large is what is hidden",
    )
    simulate.add_argument(
        "--truth",
        type=_path,
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
    simulate.add_argument(
        "--day", type=_whole(0), default=None, help="deformation: the same site, other weather"
    )

    montecarlo = command(
        "montecarlo", "adjust a simulated network many times: errors against theory"
    )
    montecarlo.add_argument(
        "scene", type=_named, help="as for simulate: an example by its name, or a TOML"
    )
    montecarlo.add_argument("--trials", type=_whole(1), default=1000, help="how many")
    montecarlo.add_argument(
        "--batch", type=_whole(1), default=None, help="trials at a time; found by measuring"
    )
    montecarlo.add_argument("--seed", type=_whole(0), default=0, help="of the noise")
    montecarlo.add_argument(
        "--noise",
        default="normal",
        help="normal, student-t:FREEDOM, laplace, uniform or outliers:SHARE:FACTOR",
    )
    montecarlo.add_argument(
        "--estimator",
        choices=("gauss-newton", "levenberg-marquardt", "spgd"),
        default="gauss-newton",
        help="how each trial is adjusted",
    )
    _out_argument(
        montecarlo,
        "folder",
        metavar="DIR",
        help="where trials and tables are written; what was stopped there goes on",
    )

    convert = command("convert", "make a recording of other programs' files")
    convert.add_argument(
        "source",
        type=_named,
        help="table of corners (.csv), mrcal's corners (.vnl) or .cameramodel, OpenCV's "
        "calibration (.yml, .xml), a pose graph (.g2o, .g2o.gz), a problem of bundle adjustment "
        "(.txt, .txt.gz, libmv's .bin), the folder of a recording, or the name of a public one",
    )
    _out_argument(
        convert, "new", required=True, metavar="RECORDING", help="a folder, or a .g2o file"
    )
    convert.add_argument(
        "--mend", action="store_true", help="g2o: mend information that is not positive definite"
    )
    convert.add_argument(
        "--table", choices=("csv", "parquet"), default="csv", help="form of the tables"
    )
    convert.add_argument(
        "--image-size", type=_size, default=None, metavar="WxH", help="corners: of the image (px)"
    )
    convert.add_argument(
        "--spacing", type=float, default=None, metavar="METRES", help="corners: to the next one"
    )
    for side in ("rows", "columns"):
        convert.add_argument(f"--{side}", type=_whole(1), help=f"corners.vnl: {side} of the board")
    convert.add_argument("--lens", default="opencv8", help="corners: lens of the camera")

    validate = command("validate", "check a recording and tell what is in it")
    _recording_argument(validate)
    return parser


class _Defaults(argparse.ArgumentDefaultsHelpFormatter):
    """Help that tells what is taken where an option is not given, if anything is."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        none = action.default is None or action.default is False or action.default == []
        return action.help if none else super()._get_help_string(action)


def _recording_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=_named, help=_RECORDING)
    _model_argument(parser)


def _model_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model", type=_path, default=None, metavar="FILE", help="in place of its recording.toml"
    )


def _out_argument(
    parser: argparse.ArgumentParser, writes: str, default: str | None = None, **words: Any
) -> None:
    """`writes`: a kind of `jaxvm.recording.files.Place`."""
    parser.add_argument("--out", type=_path, default=default and Path(default), **words)
    parser.set_defaults(writes=writes)


def _named(text: str) -> str:
    """A name; an empty one would be the folder one is in."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name is empty; give the name of a file or folder")
    return text


def _path(text: str) -> Path:
    return Path(_named(text))


def _whole(least: int) -> Callable[[str], int]:
    """Numbers of at least so many."""

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text} is no whole number from {least} on")
        return value

    return number


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text} is not like 6016x4016")
    return int(width), int(height)


if __name__ == "__main__":
    sys.exit(main())
