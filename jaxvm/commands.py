"""What the commands do: thin wrappers of functions that a notebook calls.

Each takes the parsed options and returns its answer as data and as text. What it needs is imported
when it runs: a command that has nothing to compile starts at once.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def _progress(options) -> Callable[[str], None]:
    """Lines with the elapsed time on stderr."""
    began = time.perf_counter()

    def line(text: str) -> None:
        options.interruption.check()
        if not options.quiet:
            print(f"{time.perf_counter() - began:6.1f} s  {text}", file=sys.stderr, flush=True)

    return line


def _open(name: str, model: Path | None, tell: Callable[[str], None]):
    """The recording that a command is about: a folder, or a public one by name.

    `tell` hears what is odd in it.
    """
    from jaxvm.recording import hints

    recording = _recording(name, model)
    for hint in hints(recording):
        tell(f"hint: {hint}")
    return recording


def _recording(name: str, model: Path | None):
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


def run_demo(options):
    from jaxvm.demo import demo, paragraph

    shown = demo(options.seed, options.hide, options.size, options.out, _progress(options))
    answer, text = _report(shown.diagnosis, options.out)
    answer["hidden"] = [truth.effect for truth in shown.truth]
    answer["paragraph"] = paragraph(shown, options.out / "report.html")
    return answer, f"{text}\n\n{answer['paragraph']}"


def run_diagnose(options):
    from jaxvm.recording.errors import sentence
    from jaxvm.recording.files import check_place

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
    for folder in folders:
        check_place(options.out / folder, "folder")
    answers, failed = {}, []
    for name, folder in zip(options.recording, folders, strict=True):
        try:
            answers[folder], _ = _diagnose_one(options, name, options.out / folder)
        except (ValueError, OSError) as problem:
            print(f"jaxvm diagnose {name}: {sentence(problem)}", file=sys.stderr, flush=True)
            failed.append(folder)
    lines = [f"{folder}: {answer['verdict']}" for folder, answer in answers.items()]
    if failed:
        raise ValueError(f"{len(answers)} recordings diagnosed; not so {', '.join(failed)}")
    return answers, "\n".join(lines)


def _diagnose_one(options, name: str, out: Path):
    from jaxvm.discover import diagnose
    from jaxvm.recording import join

    progress = _progress(options)
    recording = _open(name, options.model, progress)
    for further in options.further:
        recording = join(recording, _open(further, None, progress))
    found = diagnose(
        recording, every=options.every, alpha=options.alpha, seed=options.seed, progress=progress
    )
    progress("writing the report")
    return _report(found, out, options.data_only)


def run_adjust(options):
    from jaxvm.network.estimate import estimated_model, pose_table
    from jaxvm.network.scene import build
    from jaxvm.network.start import is_network, start
    from jaxvm.recording import model_text
    from jaxvm.recording.files import json_text, write_files
    from jaxvm.report.network import network_files
    from jaxvm.solve.adjust import adjust, pixel_rms
    from jaxvm.solve.covariance import standard_deviations
    from jaxvm.solve.optimise import METHODS
    from jaxvm.solve.robust import LOSSES
    from jaxvm.solve.snooping import snoop_links

    progress = _progress(options)
    progress("start values from the data")
    scene = start(build(_open(options.recording, options.model, progress)), options.start)
    progress("adjustment")
    rejected = []
    if options.snoop:
        if options.method not in METHODS or options.loss != "squared":
            raise ValueError("--snoop goes with --method levenberg-marquardt or gauss-newton alone")
        result, rejected, _ = snoop_links(scene, method=options.method)
    else:
        result = adjust(scene, options.method, LOSSES[options.loss]())
    if result.failed:
        raise ValueError(
            f"the adjustment {result.why} (cost {result.cost:.4g}); nothing was written. Begin "
            "from other start values (--start chordal) or with --loss cauchy"
        )
    residuals = result.residuals()
    answer = {
        "cost_before": result.cost_before,
        "cost": result.cost,
        "variance_factor": result.variance_factor,
        "degrees_of_freedom": result.degrees_of_freedom,
        "pixel_rms_px": pixel_rms(result.scene, residuals) if residuals.pixels else None,
        "evaluations": result.evaluations,
        "converged": result.converged,
        "why": result.why,
        "covariance_scale": result.unit_variance,
        "seconds": result.seconds,
        "rejected": [{"where": r.where, "test": r.test} for r in rejected],
    }
    text = result.summary()
    for r in rejected:
        text += f"\nset aside          {r.where} (test {r.test:.1f})"
    if options.out is not None:
        progress("precision")
        deviations = standard_deviations(result, result.unit_variance)
        files = {
            "adjustment.json": json_text(answer),
            "model.toml": model_text(estimated_model(result.scene)),
            "poses.csv": pose_table(result.scene, deviations).to_csv(index=False),
        }
        if is_network(result.scene):
            progress("the picture of the network")
            files |= network_files(result, method=options.method, scale=result.unit_variance)
        write_files(options.out, files)
        text += f"\nwritten            {options.out}: {', '.join(files)}"
    return answer, text


def run_identify(options):
    from jaxvm.identify import identify
    from jaxvm.recording.files import write_files
    from jaxvm.report.words import lasting_drift

    progress = _progress(options)
    recording = _open(options.recording, options.model, progress)
    found = identify(recording, one_step=not options.two_steps, progress=progress)
    write_files(options.out.absolute().parent, {options.out.name: found.model.text()})
    answer = {"model": str(options.out), "cameras": [own.as_dict() for own in found.cameras]}
    lines = [found.summary()]
    for own in found.cameras:
        if lasting := lasting_drift(own.drift):
            lines += [f"camera {own.drift.camera}, in the end", *(f"  {line}" for line in lasting)]
    return answer, "\n".join([*lines, f"\nwritten    {options.out}"])


def run_compensate(options):
    from jaxvm.identify import compensate, read_drift_model
    from jaxvm.identify.poses import image_poses
    from jaxvm.recording import write_recording

    progress = _progress(options)
    model = read_drift_model(options.model)
    recording = _open(options.recording, None, progress)
    found = compensate(recording, model)
    progress("poses before and after")
    poses = {
        "poses-before.csv": image_poses(recording).to_csv(index=False),
        "poses.csv": image_poses(found.recording).to_csv(index=False),
    }
    write_recording(found.recording, options.out, beside=poses)
    answer = found.as_dict() | {"recording": str(options.out)}
    return answer, f"{found.summary()}\nwritten    {options.out}, with {', '.join(poses)}"


def run_simulate(options):
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
        options.day or 0,
    )
    with new_folder(options.out) as staging:
        made.write(staging)
    hidden = " ".join(truth.sentence for truth in made.truth) or "nothing"
    answer = {"recording": str(options.out), "hidden": [truth.effect for truth in made.truth]}
    return answer, f"written    {options.out}\nhidden     {hidden}"


def _simulate_network(options):
    from jaxvm.recording import describe
    from jaxvm.scenes import read_description, simulate_network, truth_folder

    for name in ("hide", "size", "strength", "day"):
        if getattr(options, name) is not None:
            raise ValueError(
                f"--{name} is for deformation; what a network hides stands in its TOML, as "
                '[[effects]] with model = "hidden"'
            )
    truth = truth_folder(options.out, options.truth)
    made = simulate_network(read_description(options.scene, ("deformation",)), options.seed)
    made.write(options.out, truth)
    told, hidden = describe(made.recording), list(made.truth.hidden)
    answer = {
        "recording": str(options.out),
        "truth": str(truth),
        "contents": told,
        "hidden": hidden,
    }
    return answer, f"written    {options.out}: {told}\ntruth      {truth}"


def run_montecarlo(options):
    import jax
    import numpy as np

    from jaxvm.montecarlo import ESTIMATORS, station_trials
    from jaxvm.montecarlo.noise import noise_by_name
    from jaxvm.network.scene import build
    from jaxvm.recording.files import json_text, write_files
    from jaxvm.scenes import description_text, read_description, simulate_network

    progress = _progress(options)
    noise = noise_by_name(options.noise)
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
        lambda done: progress(str(done)),
        folder=None if options.out is None else options.out / "trials",
        world=world,
        noise=noise,
        estimator=ESTIMATORS[options.estimator](),
        told={
            "scene": description_text(options.scene),
            "noise": options.noise,
            "estimator": options.estimator,
        },
    )
    options.interruption.check()
    if found.failed.all():
        raise ValueError(
            f"none of {options.trials} trials converged: the noise is too large for this network; "
            "take smaller sigmas, or more and better placed measurements"
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
        "coverage_90": float(np.mean(found.results.statistics.coverage(0.9))),
        "seconds": found.results.seconds,
        "seconds_compiling": found.results.compiling,
        "batch": found.results.batch,
        "hidden": list(made.truth.hidden),
    }
    text = "\n".join(
        [
            found.results.summary(),
            f"variance factor    {answer['variance_factor']:.4f}",
            f"chi-square         {found.chi_square:.4f} of the errors, 1 where theory is right",
            "measured/predicted {least:.3f} to {largest:.3f}, median {median:.3f}".format(**spread),
            f"coverage           {answer['coverage_90']:.4f} of the 90 % intervals",
            *([f"hidden             {', '.join(made.truth.hidden)}"] if made.truth.hidden else []),
        ]
    )
    if options.out is not None:
        files = {
            "montecarlo.json": json_text(answer),
            "montecarlo.csv": frame.to_csv(index=False),
        }
        write_files(options.out, files)
        text += f"\nwritten            {options.out}: {', '.join(files)}, trials"
    return answer, text


def run_convert(options):
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


def run_validate(options):
    from jaxvm.recording import describe, hints

    recording = _recording(options.recording, options.model)
    told, found = describe(recording), hints(recording)
    text = "\n".join([f"valid      {told}", *(f"hint       {hint}" for hint in found)])
    return {"valid": True, "contents": told, "hints": found}, text
