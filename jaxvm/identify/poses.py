"""Poses of targets from every image of a recording, to compare them before and after."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxvm.geometry.lenses import lens_family
from jaxvm.pose.monocular import locate
from jaxvm.pose.sighting import sighting
from jaxvm.recording import Recording

_FEWEST = 4
"""Marks of an image that give a pose."""


def image_poses(recording: Recording) -> pd.DataFrame:
    """Maximum-likelihood pose camera_from_target of every target in every image.

    Columns: epoch, camera, target, turn_x ... shift_z (rad, m), std_turn_x ... std_shift_z of a
    turn and a shift about the camera, in radians and metres. Cameras without known focal_px, and
    targets with unknown marks, are left out.
    """
    obs, tables = recording.observations, []
    parts = [f"{part}_{axis}" for part in ("turn", "shift") for axis in "xyz"]
    for i, camera in enumerate(recording.model.cameras):
        if camera.focal_px is None:
            continue
        size = np.asarray(camera.image_size, float)
        centre = (size - 1.0) / 2.0 if camera.centre_px is None else camera.centre_px
        n = lens_family(camera.lens).n_coefficients
        lens = np.zeros(n) if camera.distortion is None else camera.distortion
        for k, target in enumerate(recording.model.targets):
            own = np.flatnonzero((obs.camera == i) & (obs.target == k))
            if not len(own) or not np.isfinite(target.points).all():
                continue
            epochs, row = np.unique(obs.epoch[own], return_inverse=True)
            pixels = np.full((len(epochs), len(target.points), 2), np.nan)
            pixels[row, obs.point[own]] = obs.pixel[own]
            sigma = np.ones(pixels.shape[:2])
            sigma[row, obs.point[own]] = obs.sigma[own]
            enough = np.isfinite(pixels[:, :, 0]).sum(axis=1) >= _FEWEST
            if not enough.any():
                continue
            found = _located(
                camera.lens, jnp.asarray(target.points), jnp.asarray(pixels[enough]),
                jnp.asarray(sigma[enough]), *(jnp.asarray(x, float) for x in
                                              (camera.focal_px, centre, lens)),
            )  # fmt: skip
            vector, covariance = map(np.asarray, found)
            spread = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            table = pd.DataFrame(np.hstack([vector, spread]))
            table.columns = [*parts, *(f"std_{name}" for name in parts)]
            table.insert(0, "epoch", recording.epoch_ids[epochs[enough]])
            table.insert(1, "camera", camera.name)
            table.insert(2, "target", target.name)
            tables.append(table)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def mark_depths(recording: Recording) -> Float[np.ndarray, " observations"]:
    """Distance (m) of every observed mark along the axis of its camera, from its image's pose.

    Raises:
        ValueError: an image has no pose.
    """
    model, obs = recording.model, recording.observations
    table = image_poses(recording)
    names = [camera.name for camera in model.cameras], [target.name for target in model.targets]
    pose = np.full((len(names[0]), len(names[1]), len(recording.time), 6), np.nan)
    parts = [f"{part}_{axis}" for part in ("turn", "shift") for axis in "xyz"]
    if len(table):
        row = {number: k for k, number in enumerate(recording.epoch_ids.tolist())}
        at = (
            [names[0].index(name) for name in table["camera"]],
            [names[1].index(name) for name in table["target"]],
            [row[number] for number in table["epoch"]],
        )
        pose[at] = table[parts].to_numpy()
    own = pose[obs.camera, obs.target, obs.epoch]
    if not np.isfinite(own).all():
        k = int(np.argmin(np.isfinite(own).all(axis=1)))
        raise ValueError(
            f'camera "{names[0][obs.camera[k]]}" sees too little of target '
            f'"{names[1][obs.target[k]]}" at epoch {recording.epoch_ids[obs.epoch[k]]} to know its '
            "distance; give the depths, or drop the view"
        )
    points = np.concatenate([target.points for target in model.targets])
    first = np.cumsum([0, *(len(target.points) for target in model.targets)])
    marks = Rotation.from_rotvec(own[:, :3]).apply(points[first[obs.target] + obs.point])
    return marks[:, 2] + own[:, 5]


@eqx.filter_jit
def _located(lens: str, points, pixels, sigma, focal, centre, coefficients):
    family = lens_family(lens)

    def one(own, noise):
        seen = sighting(points, own, focal, centre, family, coefficients, noise)
        best = locate(seen).best
        return best.observer_from_target, best.covariance

    return jax.vmap(one)(pixels, sigma)
