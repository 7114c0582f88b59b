"""Gauge and rank: which unknowns the observations don't determine, by name."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaxvm.compiling import program
from jaxvm.network.unknowns import Unknowns
from jaxvm.solve.problem import Normal

SINGULAR = 1e-13
"""An eigenvalue of the unit-diagonal normal matrix below this is zero in double precision."""


class RankDeficiency(ValueError):
    """The observations don't determine all unknowns; the message names those that are free."""


@dataclass(frozen=True)
class NullDirection:
    """A combination of unknowns that changes no observation.

    Attributes:
        eigenvalue: of the unit-diagonal normal matrix.
        unknowns: the names and shares (largest first) that make it up.
    """

    eigenvalue: float
    unknowns: tuple[tuple[str, float], ...]

    def words(self) -> str:
        """The main members, in a sentence."""
        names = [name for name, _ in self.unknowns[:6]]
        more = len(self.unknowns) - len(names)
        return ", ".join(names) + (f" and {more} more" if more > 0 else "")


def null_directions(normal: Normal, unknowns: Unknowns) -> list[NullDirection]:
    """Combinations of active unknowns that (scaled) normal equations don't determine.

    Unknowns that no weighted observation touches are not counted: they stay where they are.
    """
    names = unknowns.names()
    found = []
    hessian, eigen_local, vectors_local, eigen, vectors = _spectra(normal)
    s, groups, d = hessian.sizes
    for group in np.flatnonzero(np.asarray(eigen_local).min(axis=1, initial=1.0) < SINGULAR):
        own = names[s + group * d : s + (group + 1) * d]
        k = int(np.argmin(eigen_local[group]))
        found.append(named_direction(float(eigen_local[group, k]), vectors_local[group, :, k], own))
    if not found:
        for k in np.flatnonzero(np.asarray(eigen) < SINGULAR):
            found.append(named_direction(float(eigen[k]), vectors[:, k], names[:s]))
    return found


def check_gauge(normal: Normal, unknowns: Unknowns) -> None:
    """Raise RankDeficiency, naming the unknowns, where the problem is singular."""
    found = null_directions(normal, unknowns)
    if found:
        raise deficiency(found)


def deficiency(found: list[NullDirection]) -> RankDeficiency:
    """The error that names what the observations don't determine."""
    what = "; ".join(direction.words() for direction in found[:3])
    more = f" (and {len(found) - 3} more combinations)" if len(found) > 3 else ""
    return RankDeficiency(
        f"the observations do not determine: {what}{more}; "
        "hold one of them, add a prior, or record what ties them down"
    )


def named_direction(eigenvalue: float, vector, names: list[str]) -> NullDirection:
    """A null direction with the names and shares of what makes it up."""
    share = np.abs(np.asarray(vector))
    order = np.argsort(-share)
    kept = [(names[i], float(share[i])) for i in order if share[i] > 0.1 * share.max() and names[i]]
    return NullDirection(eigenvalue, tuple(kept))


@program
def _spectra(normal: Normal):
    hessian = normal.hessian
    diagonal = hessian.diagonal()
    hessian = hessian.add_diagonal(jnp.where(diagonal == 0.0, 1.0, 0.0))
    eigen_local, vectors_local = jnp.linalg.eigh(hessian.local)
    # Singular groups are reported on their own; elsewhere they must not spoil the reduction.
    safe = jnp.maximum(eigen_local, SINGULAR)
    half = jnp.einsum("gde,gds->ges", vectors_local, hessian.coupling) / jnp.sqrt(safe)[:, :, None]
    s, groups, d = hessian.sizes
    tall = jnp.reshape(half, (groups * d, s))
    # The part of each shared column that local unknowns can't imitate decides its own scale.
    reduced = hessian.shared - tall.T @ tall
    eigen, vectors = jnp.linalg.eigh(0.5 * (reduced + reduced.T))
    return hessian, eigen_local, vectors_local, eigen, vectors
