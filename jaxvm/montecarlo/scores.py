"""Monte Carlo of a diagnosis' score: how hypotheses look in noise, alone or on hidden physics.

One trial has as many scores as there are hypotheses, so trials run one by one.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxvm.discover.hypotheses import Family
from jaxvm.discover.score import ScoreTests
from jaxvm.montecarlo.trials import OneByOne, Trial, fingerprint, name_of
from jaxvm.network.draw import Noise
from jaxvm.solve.adjust import Adjustment


def score_study(
    fit: Adjustment,
    families: tuple[Family, ...],
    hidden: Float[np.ndarray, "observations components"] | None = None,
    noise: Noise = jax.random.normal,
    told: dict[str, Any] | None = None,
) -> OneByOne:
    """The study of the scores of hypotheses at a fit, against residuals that are drawn anew.

    A trial gives the largest drop of chi-square (`drop`), its surprise in standard deviations
    (`z`), and which hypothesis that is: `family` and `hypothesis` within it.

    Args:
        fit: of the plain model.
        families: hypotheses (`jaxvm.discover.hypotheses`).
        hidden: change of whitened observations that something hidden makes; what the model absorbs
            of it does not count. None for noise alone.
        noise: distribution of whitened observations; normal by default.
        told: what else the study is, for a file.

    Raises:
        ValueError: `hidden` is of another shape than the observations.
    """
    tests = ScoreTests.of(fit, families)
    shape = (len(tests.arrangement.drivers), tests.arrangement.components)
    if hidden is not None and np.shape(hidden) != shape:
        raise ValueError(f"a hidden change of shape {np.shape(hidden)} does not fit {shape}")
    about = {"kind": "score", "hypotheses": len(families), "noise": name_of(noise)}
    measured = fit.scene.recording.observations.pixel
    about |= {"numbers": fingerprint((measured, hidden, noise))} | (told or {})

    def trial(key) -> Trial:
        residual = np.asarray(noise(key, shape))
        if hidden is not None:
            residual = residual + hidden
        scores = tests.score(1.0, residual=residual).scores
        z = [np.where(own.valid, own.z, -np.inf) for own in scores]
        family = int(np.argmax([own.max(initial=-np.inf) for own in z]))
        best = int(np.argmax(z[family]))
        return Trial(
            error={"drop": scores[family].drop.ravel()[best], "z": z[family].ravel()[best]},
            noted={"family": family, "hypothesis": best},
        )

    return OneByOne(trial, about, failures=())
