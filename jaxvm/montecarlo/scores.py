"""Monte Carlo of a diagnosis' score: how hypotheses look in noise, alone or on hidden physics."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxvm.discover.hypotheses import Family
from jaxvm.discover.score import ScoreTests
from jaxvm.montecarlo.trials import Trial
from jaxvm.network.draw import Noise
from jaxvm.solve.adjust import Adjustment


@dataclass(frozen=True, eq=False)
class ScoreStudy:
    """Scores of all hypotheses against residuals that are drawn anew.

    A trial gives the largest drop of chi-square (`drop`), its surprise in standard deviations
    (`z`), and which hypothesis that is: `family` and `hypothesis` within it.

    Attributes:
        tests: score tests at a fit.
        hidden: whitened change of the residuals that something hidden makes; None without.
        noise: distribution of whitened residuals.
        told: what it is, for a file.
    """

    tests: ScoreTests
    hidden: Float[np.ndarray, "observations components"] | None
    noise: Noise
    told: dict[str, Any]

    together = 4

    def about(self) -> dict[str, Any]:
        return self.told

    def batch(self, key, numbers, mesh=None) -> Trial:
        """Trials one by one: one has as many scores as there are hypotheses."""
        del mesh
        found = [self._one(jax.random.fold_in(key, int(number))) for number in numbers]
        return jax.tree.map(lambda *each: np.stack(each), *found)

    def _one(self, key) -> Trial:
        arrangement = self.tests.arrangement
        shape = (len(arrangement.drivers), arrangement.components)
        residual = np.asarray(self.noise(key, shape))
        if self.hidden is not None:
            residual = residual + self.hidden
        scores = self.tests.score(1.0, residual=residual).scores
        z = [np.where(own.valid, own.z, -np.inf) for own in scores]
        family = int(np.argmax([own.max(initial=-np.inf) for own in z]))
        best = int(np.argmax(z[family]))
        return Trial(
            error={
                "drop": np.array([scores[family].drop.ravel()[best]]),
                "z": np.array([z[family].ravel()[best]]),
            },
            converged=np.array(np.isfinite(z[family].ravel()[best])),
            noted={"family": np.array(family), "hypothesis": np.array(best)},
        )


def score_study(
    fit: Adjustment,
    families: tuple[Family, ...],
    hidden: Float[np.ndarray, "observations components"] | None = None,
    noise: Noise = jax.random.normal,
    told: dict[str, Any] | None = None,
) -> ScoreStudy:
    """The study of the scores of hypotheses at a fit.

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
    numbers = 0.0 if hidden is None else float(np.sum(np.asarray(hidden) ** 2))
    about = {"kind": "score", "hypotheses": len(families), "hidden": numbers, **(told or {})}
    return ScoreStudy(tests, hidden, noise, about)
