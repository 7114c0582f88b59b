"""Compensation: images as the camera would have taken them in the mean state of its training.

A pixel is moved by what the model foretells for its place in the image: the derivative of the chain
by the camera's ports there, times their changes. Only shifts of the camera need the distance of the
mark.
"""

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxvm.geometry.lenses import lens_family, unproject
from jaxvm.identify.inputs import inputs_of
from jaxvm.identify.model import CameraDrift, DriftModel
from jaxvm.identify.poses import mark_depths
from jaxvm.physics.chain import Circumstances, Sight, predict_pixel
from jaxvm.physics.ports import N_PORTS, PORT_INDEX, PortValues
from jaxvm.recording import Recording
from jaxvm.recording.model import Camera

_SAME_CAMERA = 2e-3
"""Relative difference of focal lengths from which it is another camera, or another focus.

Temperature changes them by some 1e-4, calibrations differ by as much.
"""


@dataclass(frozen=True, eq=False)
class Compensated:
    """A recording with what the model foretells taken off.

    Attributes:
        recording: with the corrected pixels.
        correction: what was added to every observation (px).
        outside: epochs at which an input is outside the range of the training.
        warnings: in words.
    """

    recording: Recording
    correction: Float[np.ndarray, "observations 2"]
    outside: Bool[np.ndarray, " epochs"]
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The chief numbers, for a file."""
        size = np.linalg.norm(self.correction, axis=1)
        return {
            "correction_rms_px": float(np.sqrt(np.mean(size**2))),
            "correction_largest_px": float(size.max()),
            "epochs_outside": self.recording.epoch_ids[self.outside].tolist(),
            "warnings": list(self.warnings),
        }

    def summary(self) -> str:
        """A few lines."""
        told = self.as_dict()
        lines = [
            f"correction {told['correction_rms_px']:.3f} px RMS of a mark, at most "
            f"{told['correction_largest_px']:.3f} px"
        ]
        return "\n".join([*lines, *(f"warning    {text}" for text in self.warnings)])


def compensate(
    recording: Recording, model: DriftModel, depth: Float[np.ndarray, " observations"] | None = None
) -> Compensated:
    """Take the drift that a model foretells off the pixels of a recording.

    Args:
        depth: distance (m) of every mark along the axis. It matters only for a model with shifts
            of a camera, and follows from the images where it is not given.

    Raises:
        ValueError: the recording has none of the model's cameras, or lacks an input of the model.
    """
    inputs, obs = inputs_of(recording), recording.observations
    correction = np.zeros((len(obs.epoch), 2))
    outside = np.zeros(len(recording.time), bool)
    known = [c.name for c in recording.model.cameras if model.of(c.name) is not None]
    if not known:
        raise ValueError(
            f"the model is of {', '.join(c.camera for c in model.cameras)}; the recording has "
            f"{', '.join(c.name for c in recording.model.cameras)}; give the camera's own model"
        )
    warnings = list(inputs.warnings)
    for number, camera in enumerate(recording.model.cameras):
        drift = model.of(camera.name)
        if drift is None:
            warnings.append(f'the model has no camera "{camera.name}"; its pixels stay as they are')
            continue
        if camera.focal_px is not None and drift.focal_px > 0.0:
            focal = float(np.mean(camera.focal_px))
            if abs(focal / drift.focal_px - 1.0) > _SAME_CAMERA:
                warnings.append(
                    f"camera {camera.name} has a focal length of {focal:.1f} px, the one that the "
                    f"model was identified on {drift.focal_px:.1f} px: is it the same camera?"
                )
        own = np.flatnonzero(obs.camera == number)
        ports = drift.dynamics.response(inputs)[obs.epoch[own]]
        if depth is None and drift.has_shifts:
            depth = mark_depths(recording)
        at = np.full(len(own), drift.depth_m) if depth is None else depth[own]
        correction[own] = -moved(camera, drift, obs.pixel[own], at, ports)
        beyond = drift.outside(inputs)
        outside |= beyond
        if beyond.any():
            warnings.append(
                f"camera {camera.name}: {beyond.sum()} of {len(beyond)} epochs are outside the "
                "range of the training"
            )
    corrected = replace(recording, observations=replace(obs, pixel=obs.pixel + correction))
    return Compensated(corrected, correction, outside, tuple(warnings))


def moved(camera: Camera, drift: CameraDrift, pixel, depth, ports) -> np.ndarray:
    """Displacement (px) of pixels by changes of ports, row by row."""
    return np.einsum("ncp,np->nc", moves(camera, drift, pixel, depth), ports)


def moves(camera: Camera, drift: CameraDrift, pixel, depth) -> Float[np.ndarray, "n 2 ports"]:
    """Displacement (px) of pixels by a unit of each port that a model has."""
    if camera.focal_px is None:
        raise ValueError(
            f'camera "{camera.name}" has no focal_px; calibrate it first (jaxvm adjust), and '
            "compensate with that model"
        )
    size = np.asarray(camera.image_size, float)
    centre = (size - 1.0) / 2.0 if camera.centre_px is None else camera.centre_px
    n = lens_family(camera.lens).n_coefficients
    coefficients = np.zeros(n) if camera.distortion is None else camera.distortion
    columns = port_columns(
        camera.lens, jnp.asarray(camera.focal_px, float), jnp.asarray(centre, float),
        jnp.asarray(coefficients, float), jnp.asarray(pixel, float), jnp.asarray(depth, float),
    )  # fmt: skip
    return np.asarray(columns)[:, :, [PORT_INDEX[port] for port in drift.ports]]


@eqx.filter_jit
def port_columns(
    lens: str,
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    coefficients: Float[Array, " k"],
    pixel: Float[Array, "n 2"],
    depth: Float[Array, " n"],
) -> Float[Array, "n 2 ports"]:
    """Derivatives of pixels by all ports of the chain, for marks on the rays of given pixels.

    Args:
        lens: name of its family.
        focal, centre: principal distances and principal point (px).
        coefficients: of the lens.
        pixel: where the marks are seen (px).
        depth: their distances along the axis (m).
    """
    family, none = lens_family(lens), jnp.zeros(6)

    def one(own, z):
        ray = unproject(family, focal, centre, coefficients, own)
        sight = Sight(focal, centre, coefficients, none, none, none, none, ray / ray[2] * z)
        zero = jnp.zeros(())
        still = Circumstances(
            own, zero + 1.0, jnp.zeros(3), jnp.ones(2), zero, zero, zero, zero, none
        )
        return jax.jacfwd(lambda p: predict_pixel(family, sight, still, PortValues(p)))(
            jnp.zeros(N_PORTS)
        )

    return jax.vmap(one)(pixel, depth)
