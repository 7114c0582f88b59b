"""What a recording could have shown: the smallest amplitude of each effect that would be found."""

import numpy as np
from scipy.stats import norm

from jaxvm.discover.ranking import Ranking
from jaxvm.discover.space import member
from jaxvm.network.scene import Scene
from jaxvm.physics.ports import PORTS


def smallest_visible(
    ranking: Ranking, variance: float, scene: Scene
) -> dict[str, tuple[float, str]]:
    """Smallest amplitude that would be found at family-wise 5 % with power 80 %, by entry.

    sqrt(lambda0 / I) with I the information of one column (MATHEMATICS 1.8); lambda0 from the
    number of hypotheses. Hypotheses of one column, constant or linear in a driver; the most
    favourable place counts.
    """
    level = norm.isf(0.025 / max(ranking.n, 1)) + norm.isf(0.2)
    unit = {port.name: port.unit for port in PORTS}
    smallest: dict[str, tuple[float, str]] = {}
    for scores in ranking.scores:
        if scores.amplitude.shape[-1] != 1:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            # One-step amplitude a = S / I and drop S^2 / I give the information drop / a^2.
            information = scores.drop / scores.amplitude[..., 0] ** 2
            detectable = level * np.sqrt(variance / information)
        detectable = np.where(scores.valid & np.isfinite(detectable), detectable, np.inf)
        for g in range(len(scores.family.groups)):
            for c, course in enumerate(scores.family.courses):
                s = int(np.argmin(detectable[g, c]))
                known = course.form in ("constant", "linear")
                if not known or not np.isfinite(detectable[g, c, s]):
                    continue
                hypothesis = member(scores.family, (g, c, s), scene)
                for entry in hypothesis.entries:
                    key = (
                        f"{entry.id} ({course.driver})" if course.driver != "constant" else entry.id
                    )
                    value = float(detectable[g, c, s])
                    if key not in smallest or value < smallest[key][0]:
                        smallest[key] = (value, unit[hypothesis.group.terms[0].port])
    return smallest
