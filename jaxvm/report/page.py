"""Write a diagnosis: report.html, report.json, model.toml and figures, all or none."""

import base64
import json
from pathlib import Path

from jinja2 import Environment, PackageLoader

from jaxvm import __version__
from jaxvm.discover.diagnosis import Diagnosis
from jaxvm.discover.shape import shape_words
from jaxvm.network.estimate import estimated_model
from jaxvm.physics.catalogue import BY_ID
from jaxvm.recording.files import write_files
from jaxvm.recording.write import model_text
from jaxvm.report.document import document
from jaxvm.report.figures import figures, png
from jaxvm.report.words import (
    HAZE,
    doubles,
    explanation,
    in_pixels,
    mistaken_for,
    nearly_as_good,
    odds,
    parameters,
    proof,
    quantity,
    separate_by,
    signal_rows,
    size,
    verdict_sentence,
    when,
)


def write_report(diagnosis: Diagnosis, folder: str | Path, data_only: bool = False) -> Path:
    """Write everything about a diagnosis into a folder; returns the path of report.html.

    With `data_only` there are report.json (whose path is returned) and model.toml, no page and no
    figures. Files of an earlier report are replaced, each when its successor is complete.
    """
    files: dict[str, str | bytes] = {
        "report.json": json.dumps(document(diagnosis), indent=1, allow_nan=False) + "\n",
        "model.toml": model_text(estimated_model(diagnosis.scene)),
    }
    if not data_only:
        pictures = {f"{name}.png": png(figure) for name, figure in figures(diagnosis).items()}
        files |= {**pictures, "report.html": html(diagnosis, pictures)}
    write_files(folder, files)
    return Path(folder) / ("report.json" if data_only else "report.html")


def html(diagnosis: Diagnosis, pictures: dict[str, bytes]) -> str:
    """The page, with its pictures inside."""
    environment = Environment(
        loader=PackageLoader("jaxvm.report"), autoescape=True, trim_blocks=True
    )
    encoded = {
        name.removesuffix(".png"): "data:image/png;base64," + base64.b64encode(data).decode()
        for name, data in pictures.items()
    }
    words = {
        "explanation": explanation,
        "in_pixels": in_pixels,
        "mistaken_for": mistaken_for,
        "doubles": doubles,
        "nearly_as_good": nearly_as_good,
        "parameters": parameters,
        "proof": proof,
        "odds": odds,
        "quantity": quantity,
        "shape_words": shape_words,
        "separate_by": separate_by,
        "signal_rows": signal_rows(diagnosis),
        "haze": HAZE,
        "size": size,
        "when": when,
    }
    smallest = sorted(diagnosis.smallest.items())
    return environment.get_template("report.html.j2").render(
        d=diagnosis,
        model=diagnosis.recording.model,
        verdict=verdict_sentence(diagnosis),
        picture=encoded,
        smallest=[(name, quantity(value, 0.0, unit)) for name, (value, unit) in smallest],
        absorbed=[BY_ID[name].physics for name in diagnosis.absorbed],
        version=__version__,
        **words,
    )
