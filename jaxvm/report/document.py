"""The diagnosis as a document: report.json, and the extended model as recording.toml."""

from typing import Any

import numpy as np

from jaxvm.discover.collocation import Signal
from jaxvm.discover.diagnosis import Diagnosis, Finding
from jaxvm.discover.rivals import Rival
from jaxvm.discover.shape import shape_words
from jaxvm.physics.catalogue import BY_ID
from jaxvm.report.words import (
    HAZE,
    SIGNAL_WHEN,
    Parameter,
    explanation,
    parameters,
    separate_by,
    signal_names,
    signal_parameters,
    when,
)

FORMAT = 1


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Content of report.json (DESIGN: format 1); plain numbers and texts only."""
    content = {
        "format": FORMAT,
        "recording": diagnosis.recording.model.name,
        "verdict": diagnosis.verdict,
        "noise_px": diagnosis.noise_px,
        "plain": vars(diagnosis.plain),
        "final": vars(diagnosis.final),
        "findings": [
            *(_finding(finding) for finding in diagnosis.findings),
            *(_signal(signal, diagnosis) for signal in [diagnosis.signal] if signal),
        ],
        "left_over": {
            "significant": diagnosis.significant_left,
            "p_value": diagnosis.left_p_value,
            "likeness": diagnosis.likeness,
            "unproven": diagnosis.unproven,
            "located": [vars(place) for place in diagnosis.located_left],
        },
        "located_before": [vars(place) for place in diagnosis.located_before],
        "n_hypotheses": diagnosis.n_hypotheses,
        "n_rejected": diagnosis.n_rejected,
        "second_look": diagnosis.second_look,
        "heldout_epochs": diagnosis.recording.epoch_ids[diagnosis.held].tolist(),
        "smallest_visible": {
            name: {"amplitude": value, "unit": unit}
            for name, (value, unit) in sorted(diagnosis.smallest.items())
        },
        "can_not_show": list(diagnosis.absorbed),
        "seconds": diagnosis.seconds,
    }
    return _plain(content)


def _plain(content: Any) -> Any:
    """Lists, dictionaries and Python's own numbers; JSON has no NaN and no infinity."""
    if isinstance(content, dict):
        return {key: _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if isinstance(content, bool | np.bool_):
        return bool(content)
    if isinstance(content, int | np.integer):
        return int(content)
    if isinstance(content, float | np.floating):
        return float(content) if np.isfinite(content) else None
    return content


def _finding(finding: Finding) -> dict[str, Any]:
    effect, gain = finding.effect, finding.gain
    return {
        "physics": effect.name,
        "catalogue_id": effect.catalogue_id,
        "rows": _rows(effect.catalogue_id),
        "named": bool(finding.hypothesis.entries),
        "port": effect.terms[0].port,
        "terms": [{"port": t.port, "pattern": t.driver, "basis": t.basis} for t in effect.terms],
        "driver": effect.driver,
        "form": effect.form,
        "where": effect.scope.as_dict(),
        "when": when(effect),
        "shape": shape_words(effect),
        "parameters": _parameters(parameters(effect, finding.stds)),
        "final_parameters": _parameters(parameters(finding.final_effect, finding.final_stds)),
        "share_of_excess": finding.share,
        "p_value": finding.p_value,
        "n_hypotheses": finding.n_hypotheses,
        "weight": finding.weight,
        "other_drivers": [h.course.driver for h in finding.others],
        "equivalents": [_rival(rival) for rival in finding.rivals],
        "nearly_as_good": [h.effect(()).name for h in finding.doubles],
        "separate_by": separate_by(finding),
        "advice": [
            {
                "plan": advice.plan.key,
                "words": advice.plan.words,
                "rivals": [rival.effect(()).name for rival in advice.rivals],
                "gaps": list(advice.gaps),
                "chances": list(advice.chances),
                "chance": advice.chance,
                "odds": min(advice.odds, 1e12),
                "decides": bool(advice.decides),
            }
            for advice in finding.advice
        ],
        "shared": finding.sharing.words() if finding.sharing else "",
        "explanation": explanation(finding),
        "heldout_rms_px": {"before": gain.before_px, "after": gain.after_px},
        "heldout_log_odds": 0.5 * gain.odds if gain.odds else None,
        "heldout_share": {"value": gain.share, "interval_95": list(gain.interval)},
        "ranking": [{"hypothesis": words, "evidence": e} for words, e in finding.ranking],
    }


def _signal(signal: Signal, diagnosis: Diagnosis) -> dict[str, Any]:
    """What the marks of an image share at random, with the keys of a finding."""
    values, gain = _parameters(signal_parameters(signal, diagnosis)), signal.gain
    names = signal_names(signal)
    return {
        "physics": HAZE.physics,
        "catalogue_id": HAZE.id,
        "rows": list(HAZE.rows),
        "named": True,
        "port": "medium.bend_u",
        "terms": [
            {"port": port, "pattern": "place in the image", "basis": "covariance"}
            for port in ("medium.bend_u", "medium.bend_v")
        ],
        "driver": "image",
        "form": "random",
        "where": {},
        "when": SIGNAL_WHEN,
        "shape": "",
        "parameters": values,
        "final_parameters": values,
        "share_of_excess": diagnosis.signal_share,
        "p_value": signal.p_value,
        "n_hypotheses": 1,
        "weight": 1.0 / len(names),
        "other_drivers": [],
        "equivalents": [
            {
                "physics": entry.physics,
                "catalogue_id": entry.id,
                "rows": list(entry.rows),
                "port": entry.groups[0][0].port,
                "driver": "image",
                "form": "random",
                "where": {},
                "weight": 1.0 / len(names),
                "other_drivers": [],
            }
            for entry in names[1:]
        ],
        "nearly_as_good": [],
        "separate_by": "; ".join(entry.separate_by for entry in names),
        "advice": [],
        "shared": "",
        "explanation": HAZE.explanation,
        "heldout_rms_px": {"before": gain.before_px, "after": gain.after_px},
        "heldout_share": {"value": gain.share, "interval_95": list(gain.interval)},
        "ranking": [],
    }


def _rival(rival: Rival) -> dict[str, Any]:
    effect = rival.hypothesis.effect(())
    return {
        "physics": effect.name,
        "catalogue_id": effect.catalogue_id,
        "rows": _rows(effect.catalogue_id),
        "port": effect.terms[0].port,
        "driver": effect.driver,
        "form": effect.form,
        "where": effect.scope.as_dict(),
        "weight": rival.weight,
        "other_drivers": [h.course.driver for h in rival.others],
    }


def _rows(catalogue_id: str) -> list[int]:
    return list(BY_ID[catalogue_id].rows) if catalogue_id in BY_ID else []


def _parameters(values: list[Parameter]) -> list[dict[str, Any]]:
    return [{"name": p.name, "value": p.value, "std": p.std, "unit": p.unit} for p in values]
