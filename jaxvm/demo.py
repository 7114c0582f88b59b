"""The demonstration: physics is hidden in a simulated recording, and a diagnosis looks for it.

The simulator shares no code with the models; the diagnosis gets the folder of the recording and
nothing else. Only the last paragraph puts what was hidden beside what was found.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxvm.discover import Diagnosis, diagnose
from jaxvm.recording import read_recording
from jaxvm.recording.errors import did_you_mean
from jaxvm.recording.files import write_files
from jaxvm.report.words import quantity, size, when
from jaxvm.simulate import HIDEABLE, Truth, simulate_deformation_scene
from jaxvm.simulate.scene import Size


@dataclass(frozen=True)
class Demonstration:
    """What was hidden, and what was found without knowing it."""

    truth: tuple[Truth, ...]
    diagnosis: Diagnosis


def hidden_keys(hide: str | None, seed: int = 0) -> tuple[str, ...]:
    """Keys of effects from a text with commas; "nothing" is none, None one drawn by the seed.

    Raises:
        ValueError: an effect that can't be hidden, "nothing" beside others, or no word at all.
    """
    if hide is None:
        return (str(np.random.default_rng([seed, 17]).choice(list(HIDEABLE))),)
    keys = tuple(key.strip() for key in hide.split(",") if key.strip())
    if keys == ("nothing",):
        return ()
    if not keys:
        raise ValueError('no effect is named; write "nothing" to hide none')
    if "nothing" in keys:
        raise ValueError('"nothing" stands alone; drop it, or the effects beside it')
    for key in keys:
        if key not in HIDEABLE:
            mend = did_you_mean(key, (*HIDEABLE, "nothing"))
            raise ValueError(f'no effect "{key}" can be hidden; {mend}')
    return keys


def demo(
    seed: int = 10,
    hide: str | None = None,
    size: Size = "full",
    out: str | Path = "jaxvm-demo",
    progress: Callable[[str], None] = lambda line: None,
) -> Demonstration:
    """Simulate a deformation scene with hidden physics, write it to out/recording, diagnose it.

    Raises:
        ValueError: an effect that can't be hidden.
    """
    hidden = hidden_keys(hide, seed)
    progress("simulating the deformation scene")
    made = simulate_deformation_scene(hidden, seed, size)
    folder = Path(out) / "recording"
    write_files(folder, made.files())
    found = diagnose(read_recording(folder), progress=progress)
    return Demonstration(tuple(made.truth), found)


def paragraph(shown: Demonstration, page: Path) -> str:
    """What was hidden, where and how large; what was found; the held-out improvement; the page."""
    diagnosis = shown.diagnosis
    if shown.truth:
        hidden = "Hidden in the recording: " + " ".join(_told(truth) for truth in shown.truth)
    else:
        hidden = "Nothing was hidden in the recording."
    if diagnosis.findings:
        named = "; ".join(
            f"{f.effect.name} ({f.effect.scope.words()}, {when(f.final_effect)}): "
            f"{size(f, final=True)}"
            for f in diagnosis.findings
        )
        found = f"The diagnosis, which saw only the recording, found: {named}."
    else:
        found = (
            f"The diagnosis calls it {diagnosis.verdict}: of {diagnosis.n_hypotheses:,} hypotheses "
            f"none is claimed (p = {diagnosis.left_p_value:.2g})."
        )
    plain, final = diagnosis.plain.heldout_rms_px, diagnosis.final.heldout_rms_px
    proof = (
        f"On the epochs that were never fitted the RMS residual went from {plain:.4f} px to "
        f"{final:.4f} px, with a noise of {diagnosis.noise_px:.4f} px."
    )
    return f"{hidden} {found} {proof} Report: {page}"


def _told(truth: Truth) -> str:
    numbers = ", ".join(
        f"{name} {quantity(value, 0.0, unit)}" for name, (value, unit) in truth.parameters.items()
    )
    at = "; ".join(f"{kind} {', '.join(names)}" for kind, names in truth.place.items())
    return f"{truth.sentence.rstrip('.')} ({at}; {numbers}; {truth.rms_px:.3f} px RMS)."
