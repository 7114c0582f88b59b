"""Couplings: which changes of a camera look alike in its images, and what that leaves open.

One view of a plane shows at most eight combinations of a camera's changes, seven where the plane is
frontal (MATHEMATICS 1.2). Whoever identifies more numbers than that has chosen a gauge; it is said
here, in words.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_ZERO = 1e-9
"""Singular value of normalised columns, over the largest, that counts as none."""

WORDS = {
    "fx": "principal distance fx",
    "fy": "principal distance fy",
    "f": "principal distance",
    "cx": "principal point cx",
    "cy": "principal point cy",
    "turn_x": "turn about x",
    "turn_y": "turn about y",
    "turn_z": "roll",
    "shift_x": "shift along x",
    "shift_y": "shift along y",
    "shift_z": "axial shift",
}


@dataclass(frozen=True)
class Couplings:
    """How alike the changes of a camera look for one geometry.

    Attributes:
        names: of the changes.
        cosine: between every two columns: 1 where they look alike.
        singular: singular values of the normalised columns, the largest first.
        directions: right singular vectors over the normalised columns, one in each row.
    """

    names: tuple[str, ...]
    cosine: Float[np.ndarray, "p p"]
    singular: Float[np.ndarray, " p"]
    directions: Float[np.ndarray, "p p"]

    @property
    def rank(self) -> int:
        """Number of combinations that the images can show."""
        return int(np.sum(self.singular > _ZERO * self.singular[0]))

    def alike(self, least: float = 0.9) -> list[tuple[str, str, float]]:
        """Pairs that look alike, the most alike first."""
        upper = np.argwhere(np.triu(np.abs(self.cosine), 1) >= least)
        pairs = [(self.names[i], self.names[j], float(self.cosine[i, j])) for i, j in upper]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))

    def hidden(self, below: float = 1e-2) -> list[tuple[float, dict[str, float]]]:
        """Combinations that hardly show: singular value over the largest, and its chief parts."""
        found = []
        for value, row in zip(self.singular, self.directions, strict=True):
            if value <= below * self.singular[0]:
                parts = {n: float(r) for n, r in zip(self.names, row, strict=True)}
                found.append(
                    (float(value / self.singular[0]),
                     {n: r for n, r in parts.items() if abs(r) > 0.1})
                )  # fmt: skip
        return found[::-1]

    def words(self, below: float = 1e-2) -> str:
        """What can't be told apart, one sentence a line."""
        p, lines = len(self.names), []
        lines.append(f"{self.rank} of {p} changes can be told apart.")
        for value, parts in self.hidden(below):
            chief = sorted(parts, key=lambda n: -abs(parts[n]))
            told = " and ".join(WORDS.get(n, n) for n in chief[:2])
            more = f", with {', '.join(WORDS.get(n, n) for n in chief[2:])}" if chief[2:] else ""
            how = "can't be told apart" if value <= _ZERO else f"differ by {value:.2g} of an effect"
            lines.append(f"{told}{more}: {how}.")
        for a, b, cosine in self.alike(0.95):
            lines.append(f"{WORDS.get(a, a)} and {WORDS.get(b, b)}: {cosine:.4f}.")
        return "\n".join(lines)


def couplings(columns: Float[np.ndarray, "n 2 p"], names: tuple[str, ...]) -> Couplings:
    """Couplings of the columns of a drift model (`jaxvm.identify.drift.drift_columns`).

    Raises:
        ValueError: a column is zero: the images don't show this change at all.
    """
    flat = np.asarray(columns).reshape(-1, len(names))
    size = np.linalg.norm(flat, axis=0)
    if not size.all():
        blind = ", ".join(n for n, s in zip(names, size, strict=True) if s == 0.0)
        raise ValueError(f"the images don't show {blind}: leave it out")
    unit = flat / size
    _, singular, directions = np.linalg.svd(unit, full_matrices=False)
    return Couplings(tuple(names), unit.T @ unit, singular, directions)


def absorbed(
    columns: Float[np.ndarray, "n 2 p"], names: tuple[str, ...], by: tuple[str, ...]
) -> dict[str, float]:
    """Share of each change, |M g| / |g|, that is left when other changes may explain it.

    Args:
        by: names of the changes that may explain the others, as the six of a free pose.
    """
    flat = np.asarray(columns).reshape(-1, len(names))
    free = flat[:, [names.index(n) for n in by]]
    own, singular, _ = np.linalg.svd(free / np.linalg.norm(free, axis=0), full_matrices=False)
    own = own[:, singular > _ZERO * singular[0]]
    left = {}
    for k, name in enumerate(names):
        if name not in by:
            g = flat[:, k]
            left[name] = float(np.linalg.norm(g - own @ (own.T @ g)) / np.linalg.norm(g))
    return left
