"""Look at earlier findings again once later ones are in the model.

While a second effect was still missing, the first may have got the name of a near double, or may be
superfluous now. What is no longer needed goes; a double that fits better takes the name.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.select import evidence, identity, price_of_columns
from jaxvm.network.scene import Scene
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import wald_drops

Fit = Callable[[Scene], Adjustment]


def prune(
    current: Adjustment, findings: list[Finding], n: int, fit: Fit
) -> tuple[Adjustment, list[Finding]]:
    """Drop an earlier finding that the later ones made superfluous (Wald test against BIC)."""
    given = len(current.scene.effects) - len(findings)
    groups = [np.arange(columns.start, columns.stop) for columns, _ in current.scene.places()]
    drops = wald_drops(current, groups[given:])
    for k, (finding, drop) in enumerate(zip(findings[:-1], drops, strict=False)):
        drop = drop / current.variance_factor
        price = price_of_columns(finding.hypothesis, len(finding.effect.amplitudes), drop, n)
        if drop < price + len(finding.effect.constants) * np.log(n):
            effects = current.scene.fitted_effects()
            kept = (*effects[: given + k], *effects[given + k + 1 :])
            return fit(current.scene.with_effects(kept, current.scene.room)), findings[
                :k
            ] + findings[k + 1 :]
    return current, findings


def rename(
    current: Adjustment, findings: list[Finding], n: int, fit: Fit
) -> tuple[Adjustment, list[Finding]]:
    """Give each finding the name among its near doubles that fits best beside all the others."""
    given = len(current.scene.effects) - len(findings)
    findings = list(findings)
    for k, finding in enumerate(findings if len(findings) > 1 else []):
        for other in finding.doubles:
            if identity(other) == identity(findings[k].hypothesis):
                continue
            effects = list(current.scene.fitted_effects())
            own = effects[given + k]
            columns = len(other.group.terms) * len(FORMS[other.course.form].bases)
            effects[given + k] = other.effect(np.zeros(columns))
            tried = fit(current.scene.with_effects(tuple(effects), current.scene.room))
            if not tried.converged:
                continue
            variance = min(current.variance_factor, tried.variance_factor)
            drop = 2.0 * (current.cost - tried.cost)
            effect = tried.scene.fitted_effects()[given + k]
            new = evidence(other, drop, np.asarray(effect.amplitudes), variance, n)
            old = evidence(findings[k].hypothesis, 0.0, np.asarray(own.amplitudes), variance, n)
            if new > old:
                current = tried
                findings[k] = replace(
                    findings[k], hypothesis=other, effect=effect, final_effect=effect,
                    stds=(), rivals=(), weight=1.0,
                )  # fmt: skip
    return current, findings
