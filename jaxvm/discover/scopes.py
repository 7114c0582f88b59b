"""Who has it: do all cameras (stations, targets, rangefinders) share a finding, or one alone?

The effect is given to every body of its kind with its own amplitudes and everything is fitted
again. A Wald test asks whether the amplitudes are equal, and for each body whether they are zero.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from jaxvm.discover.heldout import Split
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Scope, room_for
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import amplitude_covariance

DIFFERENT = 1e-3
"""Probability of equal amplitudes below which bodies count as different."""


@dataclass(frozen=True)
class Sharing:
    """How the bodies of one kind share an effect.

    Attributes:
        kind: "camera", "station", "target" or "rangefinder".
        names: the bodies.
        amplitudes, stds: [bodies, columns], in the unit of the effect.
        equal: probability that all have the same amplitudes.
        has_it: for each body whether its own are significantly not zero.
    """

    kind: str
    names: tuple[str, ...]
    amplitudes: np.ndarray
    stds: np.ndarray
    equal: float
    has_it: tuple[bool, ...]

    @property
    def homogeneous(self) -> bool:
        """Whether all bodies may share one amplitude."""
        return self.equal >= DIFFERENT

    def words(self) -> str:
        """For a report."""
        own = [name for name, has in zip(self.names, self.has_it, strict=True) if has]
        if self.homogeneous and len(own) == len(self.names):
            return f"all {self.kind}s have it alike (p = {self.equal:.2g})"
        if len(own) == 1:
            return f"only {self.kind} {own[0]} has it"
        if own:
            return f"{self.kind}s {', '.join(own)} have it, not alike (p = {self.equal:.1g})"
        return f"no single {self.kind} has it for sure"


def sharing(fitted: Adjustment, place: int, split: Split, noise: float = 1.0) -> Sharing | None:
    """How the bodies of its kind share the effect at `place`.

    None where there is only one body, or where the scene has no room for an effect of each: a wider
    one is another compiled program, and that costs more than this is worth.

    Args:
        fitted: a fit with the effect in.
        place: number of the effect in its scene.
        split: what is fitted.
        noise: by how much more than white noise it makes chi-square drop.
    """
    scene = fitted.scene
    effect = scene.fitted_effects()[place]
    kind, names = _bodies(scene, effect.scope)
    if len(names) < 2:
        return None
    others = tuple(e for k, e in enumerate(scene.fitted_effects()) if k != place)
    own = tuple(replace(effect, scope=Scope(**{kind: (name,)})) for name in names)
    effects = (*others, *own)
    if room_for(effects, scene.room) != scene.room:
        return None
    apart = split.fit(scene.with_effects(effects, scene.room))
    if not apart.converged:
        return None
    variance = noise * apart.variance_factor
    first = apart.scene.places()[len(others)][0].start
    n, m = len(names), effect.n_columns
    columns = np.arange(first, first + n * m)
    values = np.asarray(apart.scene.state.amplitude)[columns]
    spread = variance * amplitude_covariance(apart, columns)
    if not np.isfinite(spread).all():
        return None
    blocks = spread.reshape(n, m, n, m)
    has_it = []
    for k in range(n):
        a, c = values[k * m : (k + 1) * m], blocks[k, :, k]
        # A body that the recording says nothing about keeps its prior and does not have it.
        has_it.append(bool(chdtrc(m, a @ np.linalg.pinv(c) @ a) < DIFFERENT))
    differences = np.kron(np.eye(n - 1, n) - np.eye(n - 1, n, 1), np.eye(m))
    d = differences @ values
    test = d @ np.linalg.pinv(differences @ spread @ differences.T) @ d
    return Sharing(
        kind,
        names,
        values.reshape(n, m),
        np.sqrt(np.diag(spread)).reshape(n, m),
        float(chdtrc(len(d), test)),
        tuple(has_it),
    )


def _bodies(scene: Scene, scope: Scope) -> tuple[str, tuple[str, ...]]:
    """The kind of bodies that a scope names, and all bodies of that kind."""
    model = scene.model
    of_kind = {
        "camera": model.cameras,
        "station": model.stations,
        "target": model.targets,
        "rangefinder": model.rangefinders,
    }
    kinds = [kind for kind in scope.as_dict() if kind in of_kind]
    if len(kinds) != 1 or scope.point:
        return "", ()
    return kinds[0], tuple(body.name for body in of_kind[kinds[0]])
