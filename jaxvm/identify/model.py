"""Drift models of cameras as files: what was identified, on what, and how far it may be trusted."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from jaxtyping import Bool

from jaxvm.identify.difference import Difference, Orders
from jaxvm.identify.inputs import Inputs
from jaxvm.identify.lags import Lags, Structure
from jaxvm.physics.drivers import POWER_ON
from jaxvm.physics.ports import PORT_INDEX
from jaxvm.recording.texts import parse_toml, read_text

FORMAT = 1

_BEYOND = 0.05
"""An input beyond its trained range by this share of the range is extrapolation."""


@dataclass(frozen=True, eq=False)
class Trained:
    """What an input did in the recording that a model was identified on."""

    low: float
    high: float


@dataclass(frozen=True, eq=False)
class CameraDrift:
    """How the ports of one camera follow its inputs.

    Attributes:
        camera: its name.
        ports: names of the ports, the outputs of the dynamics.
        held: names of the ports that the images could not show beside these.
        dynamics: from inputs to ports.
        depth_m: mean distance of the marks it was identified on (m).
        trained: what every input did.
        held_out_px: error (px RMS of a mark) of the blocks that were not fitted, noise taken off.
        drift_px: drift (px RMS of a mark) of the training, noise taken off.
        focal_px: mean focal length (px) that its recording gave the camera; 0 where none.
    """

    camera: str
    ports: tuple[str, ...]
    held: tuple[str, ...]
    dynamics: Lags | Difference
    depth_m: float
    trained: dict[str, Trained]
    held_out_px: float
    drift_px: float
    focal_px: float = 0.0

    @property
    def has_shifts(self) -> bool:
        """Whether the distance of a mark matters."""
        return any(port.startswith("mount.shift") for port in self.ports)

    def outside(self, inputs: Inputs) -> Bool[np.ndarray, " epochs"]:
        """Epochs at which an input is outside the range that the model was trained on."""
        found = np.zeros(len(inputs.epoch), bool)
        for name, known in self.trained.items():
            if not name.startswith(POWER_ON):
                margin = _BEYOND * (known.high - known.low)
                x = inputs.row(name)[inputs.epoch]
                found |= (x < known.low - margin) | (x > known.high + margin)
        return found

    def lasting(self) -> dict[str, dict[str, float]]:
        """Change of every port (its unit) that a unit of every input brings in the end."""
        table = self.dynamics.stationary()
        return {
            port: {name: float(x) for name, x in zip(self.dynamics.inputs, row, strict=True)}
            for port, row in zip(self.ports, table, strict=True)
        }


@dataclass(frozen=True, eq=False)
class DriftModel:
    """Drift of all cameras of a recording."""

    cameras: tuple[CameraDrift, ...]

    def of(self, camera: str) -> CameraDrift | None:
        """The part of one camera, None where it has none."""
        return next((own for own in self.cameras if own.camera == camera), None)

    def text(self) -> str:
        """The model as a TOML file; `read_drift_model` gives the same model back."""
        return tomli_w.dumps(
            {"format": FORMAT, "cameras": {c.camera: _table(c) for c in self.cameras}}
        )


def _floats(values) -> Any:
    return np.asarray(values, float).tolist()


def _table(own: CameraDrift) -> dict[str, Any]:
    d = own.dynamics
    common = {
        "inputs": list(d.inputs),
        "reference": _floats(d.reference),
        "centre": _floats(d.centre),
    }
    if isinstance(d, Lags):
        dynamics = common | {
            "kind": "time constants",
            "power": d.structure.power,
            "delayed": d.structure.delayed,
            "tau_s": _floats(d.tau),
            "tau_sigma_s": _floats(d.tau_sigma),
            "delay_s": float(d.delay),
            "delay_sigma_s": float(d.delay_sigma),
        }
    else:
        dynamics = common | {
            "kind": d.structure.kind,
            "nb": d.structure.nb,
            "nk": d.structure.nk,
            "step_s": float(d.step),
            "a": _floats(d.a),
        }
    return {
        "depth_m": float(own.depth_m),
        "held_out_px": float(own.held_out_px),
        "drift_px": float(own.drift_px),
        "focal_px": float(own.focal_px),
        "held": list(own.held),
        "dynamics": dynamics,
        "trained": {name: asdict(t) for name, t in own.trained.items()},
        "ports": {
            port: {"gain": _floats(gain), "sigma": _floats(sigma)}
            for port, gain, sigma in zip(own.ports, d.gain, d.gain_sigma, strict=True)
        },
    }


def read_drift_model(file: str | Path) -> DriftModel:
    """The model in a file that `jaxvm identify` wrote.

    Raises:
        ValueError: the file is absent, no TOML, or no drift model; says what is missing.
    """
    file = Path(file)
    if not file.is_file():
        raise ValueError(f"{file}: there is no such file; give the one that jaxvm identify wrote")
    table = parse_toml(read_text(file, file.name), file.name)
    if table.get("format") != FORMAT or not isinstance(table.get("cameras"), dict):
        raise ValueError(
            f"{file.name}: this is no drift model of format {FORMAT}; give the file that jaxvm "
            "identify wrote"
        )
    cameras = []
    for name, own in table["cameras"].items():
        try:
            cameras.append(_camera(name, own))
        except (KeyError, TypeError, ValueError, AttributeError) as problem:
            raise ValueError(
                f'{file.name}: camera "{name}": {problem} is missing or wrong; write the file anew '
                "with jaxvm identify"
            ) from None
    return DriftModel(tuple(cameras))


def _camera(name: str, table: dict[str, Any]) -> CameraDrift:
    d, ports = table["dynamics"], table["ports"]
    unknown = [port for port in ports if port not in PORT_INDEX]
    if unknown:
        raise ValueError(f'port "{unknown[0]}"')
    inputs = tuple(d["inputs"])
    reference, centre = np.array(d["reference"], float), np.array(d["centre"], float)
    gain = np.array([port["gain"] for port in ports.values()], float)
    sigma = np.array([port["sigma"] for port in ports.values()], float)
    if gain.shape != (len(ports), len(centre)) or len(reference) != len(inputs):
        raise ValueError("the number of gains")
    dynamics: Lags | Difference
    if d["kind"] == "time constants":
        tau = np.array(d["tau_s"], float)
        if np.any(tau <= 0.0):
            raise ValueError("tau_s")
        structure = Structure(len(tau), int(d["power"]), bool(d["delayed"]))
        spread = np.array(d["tau_sigma_s"], float)
        dynamics = Lags(structure, inputs, reference, tau, float(d["delay_s"]), gain, centre,
                        spread, float(d["delay_sigma_s"]), sigma)  # fmt: skip
    else:
        a = np.array(d["a"], float)
        if np.any(np.abs(np.roots(np.append(1.0, a))) >= 1.0):
            raise ValueError("a (not stable)")
        orders = Orders(d["kind"], len(a), int(d["nb"]), int(d["nk"]))
        dynamics = Difference(orders, inputs, reference, float(d["step_s"]), a, gain, centre, sigma)
    return CameraDrift(
        name, tuple(ports), tuple(table["held"]), dynamics, float(table["depth_m"]),
        {key: Trained(float(t["low"]), float(t["high"])) for key, t in table["trained"].items()},
        float(table["held_out_px"]), float(table["drift_px"]), float(table.get("focal_px", 0.0)),
    )  # fmt: skip
