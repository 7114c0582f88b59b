"""Monte Carlo of a diagnosis' score: how hypotheses look in noise, alone or on hidden physics.

The scores of many trials are computed together: the tangents of hypotheses, which are the same
in all of them, are read once and multiplied with the residuals of all.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxvm.discover.hypotheses import Family
from jaxvm.discover.ranking import Ranking
from jaxvm.discover.score import ScoreTests
from jaxvm.montecarlo.trials import Together, Trial, fingerprint, name_of
from jaxvm.network.draw import Noise
from jaxvm.solve.adjust import Adjustment

_TOGETHER, _AT_ONCE = 32, 64_000_000
"""Trials of a batch, more are hardly faster; and numbers in their residuals and scores (512 MB)."""


def score_study(
    fit: Adjustment,
    families: tuple[Family, ...],
    hidden: Float[np.ndarray, "observations components"] | None = None,
    noise: Noise = jax.random.normal,
    told: dict[str, Any] | None = None,
) -> Together:
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
    about: dict[str, Any] = {"kind": "score", "noise": name_of(noise)}
    asked = [(f.groups, f.courses, f.scopes) for f in families]
    numbers = fit.scene.state, fit.scene.network, [f.valid for f in families], hidden, noise
    about |= {"numbers": fingerprint(numbers, words=(asked, fit.scene.effects))} | (told or {})

    @jax.jit
    def drawn(keys):
        return jax.vmap(lambda key: noise(key, shape))(keys)

    def trials(keys) -> Trial:
        residuals = np.asarray(drawn(keys))
        if hidden is not None:
            residuals = residuals + hidden
        largest = [_largest(ranking) for ranking in tests.score_many(1.0, residuals)]
        return jax.tree.map(lambda *parts: np.stack(parts), *largest)

    room = [f.valid.size * (2 + f.n_terms * f.n_bases) for f in families]
    numbers = np.prod(shape) + sum(room)
    return Together(trials, about, together=int(np.clip(_AT_ONCE // numbers, 1, _TOGETHER)))


def _largest(ranking: Ranking) -> Trial:
    """What looks most like something in one trial."""
    z = [np.where(own.valid, own.z, -np.inf) for own in ranking.scores]
    family = int(np.argmax([own.max(initial=-np.inf) for own in z]))
    best = int(np.argmax(z[family]))
    drop = ranking.scores[family].drop.ravel()[best]
    return Trial(
        error={"drop": drop, "z": z[family].ravel()[best]},
        noted={"family": np.array(family), "hypothesis": np.array(best)},
    )
