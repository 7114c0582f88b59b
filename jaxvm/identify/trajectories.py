"""Trajectories: the state of the cameras epoch by epoch, in numbers that the images can show.

The plain model is adjusted; what it leaves in every epoch is explained by the ports of all cameras
together (turns, principal distance, ...), free poses of that epoch eliminated. Many changes look
alike (MATHEMATICS 1.2): a port that does not show beside those before it is held at zero. That
choice of gauge is stated; it changes no predicted image of the same geometry. The others are turned
into *modes*, combinations of ports whose noise is 1 and independent.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxvm.discover.cells import Cells, arrange
from jaxvm.geometry import pose_from_vector
from jaxvm.network.scene import Scene
from jaxvm.physics.ports import PORT_INDEX
from jaxvm.solve.adjust import Adjustment

CAMERA_PORTS = {
    "mount.turn_x": 1e-3,
    "mount.turn_y": 1e-3,
    "mount.turn_z": 1e-3,
    "sensor.focal": 1e-3,
    "lens.k1": 1e-3,
    "sensor.cx": 1.0,
    "sensor.cy": 1.0,
    "mount.shift_z": 1e-4,
    "mount.shift_x": 1e-4,
    "mount.shift_y": 1e-4,
    "sensor.aspect": 1e-4,
}
"""Ports of a camera that drift with temperature, and the size (rad, 1, px, m) of a large drift.

In the order in which they are held last.
"""

_RANGES = 1.5
"""Ratio of the distances of marks from which a shift of the camera is more than a turn."""

_SHARE = 0.1
"""Information about a mode, over the mean of all epochs, below which an epoch is left out."""


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Changes of one camera over the epochs, from the mean of the recording.

    Attributes:
        camera: its name.
        ports: names of the ports that show.
        held: names of those that were held at zero.
        time: of the epochs that show all modes (s).
        epoch: their places among the epochs of the recording.
        mode: amplitude of each mode, noise 1 [epochs, modes].
        sigma: standard deviation of each amplitude [epochs, modes].
        ports_from_mode: changes of the ports for a unit of each mode [ports, modes].
        large: amplitude of each mode that large drifts of all ports make (RMS).
        pixels: number of pixel coordinates behind an epoch, to express modes as pixels.
        pixel_sigma: their noise (px).
    """

    camera: str
    ports: tuple[str, ...]
    held: tuple[str, ...]
    time: Float[np.ndarray, " epochs"]
    epoch: np.ndarray
    mode: Float[np.ndarray, "epochs modes"]
    sigma: Float[np.ndarray, "epochs modes"]
    ports_from_mode: Float[np.ndarray, "ports modes"]
    large: Float[np.ndarray, " modes"]
    pixels: float
    pixel_sigma: float

    @property
    def port(self) -> Float[np.ndarray, "epochs ports"]:
        """Changes of the ports in this gauge, in their units."""
        return self.mode @ self.ports_from_mode.T

    @property
    def pixels_per_mode(self) -> float:
        """RMS displacement (px) of the marks by a unit of any mode."""
        return float(self.pixel_sigma * np.sqrt(2.0 / self.pixels))

    def gauge(self) -> str:
        """In words, what was estimated and what was held."""
        text = f"estimated: {', '.join(self.ports)}"
        return f"{text}; held: {', '.join(self.held) or 'nothing'}"


def trajectories(adjustment: Adjustment, camera: str, least: float = 3.0) -> Trajectories:
    """Trajectories of a camera in an adjusted recording, to first order in its changes.

    Args:
        adjustment: of the plain model; its statics have taken up the mean of what drifts.
        camera: name of the camera.
        least: a port is held if its plausible size over its noise, all epochs together, is less.

    Raises:
        ValueError: the camera sees nothing, or its changes do not show in any image.
    """
    scene = adjustment.scene
    number = [c.name for c in scene.model.cameras].index(camera)
    arranged = arrange(adjustment)
    of_camera = _camera_of_cells(scene, arranged.rows)
    if not np.any(of_camera == number):
        raise ValueError(f'camera "{camera}" sees nothing; there is no drift to identify')
    ports, size = tuple(CAMERA_PORTS), np.array(list(CAMERA_PORTS.values()))
    tangent = arranged.cells.tangent[[PORT_INDEX[p] for p in ports]] * size[:, None, None]
    information, right = _of_epochs(arranged.cells, tangent, of_camera, number)
    seen = np.einsum("epp->e", information) > 0.0
    mean = information[seen].mean(axis=0)
    apart = _at_several_ranges(scene, number)
    asked = [k for k, port in enumerate(ports) if apart or not port.startswith("mount.shift")]
    kept = _shown(mean * seen.sum(), asked, least)
    if not kept:
        raise ValueError(f'no change of camera "{camera}" shows in its images; nothing to identify')
    value, vector = np.linalg.eigh(mean[np.ix_(kept, kept)])
    into = vector / np.sqrt(value)
    # In modes the information of a usual epoch is the unit matrix.
    own = np.einsum("pm,epq,qn->emn", into, information[:, kept][:, :, kept], into)
    good = np.flatnonzero(np.linalg.eigvalsh(own)[:, 0] > _SHARE)
    if len(good) < 2:
        raise ValueError(
            f'the views of camera "{camera}" differ too much from epoch to epoch; let it watch '
            "marks that stay"
        )
    cofactor = np.linalg.inv(own[good])
    amplitude = np.einsum("emn,en->em", cofactor, right[good][:, kept] @ into)
    obs = scene.recording.observations
    return Trajectories(
        camera=camera,
        ports=tuple(ports[k] for k in kept),
        held=tuple(port for k, port in enumerate(ports) if k not in kept),
        time=np.asarray(scene.recording.time)[good],
        epoch=good,
        mode=amplitude - amplitude.mean(axis=0),
        sigma=np.sqrt(np.einsum("emm->em", cofactor)),
        ports_from_mode=size[kept, None] * into,
        large=np.sqrt(value),
        pixels=2.0 * np.sum(obs.camera == number) / seen.sum(),
        pixel_sigma=float(np.median(obs.sigma)),
    )


def _of_epochs(
    cells: Cells, tangent: Float[np.ndarray, "p cells rows"], camera: np.ndarray, number: int
) -> tuple[Float[np.ndarray, "epochs p p"], Float[np.ndarray, "epochs p"]]:
    """Information about the ports of a camera in every epoch, and the right side with it.

    All cameras of an epoch may have changed, and the poses of that epoch are free: with F the rows
    of J L^-T of these, the ports g of all cameras have the information g g^T - (g F) (g F)^T. The
    other cameras, with priors of a large drift, are eliminated. At the solution what is left is
    square to the free poses already.
    """
    p, n_cameras, d = len(tangent), camera.max() + 1, cells.n_local
    information, right = np.zeros((cells.n_epochs, p, p)), np.zeros((cells.n_epochs, p))
    mine = np.arange(number * p, (number + 1) * p)
    others = np.setdiff1d(np.arange(n_cameras * p), mine)
    for epoch in np.unique(cells.epoch_of[camera == number]):
        own = np.flatnonzero((cells.epoch_of == epoch) & (camera >= 0))
        joint, pull = np.zeros((n_cameras * p, n_cameras * p)), np.zeros(n_cameras * p)
        free: dict[int, np.ndarray] = {}
        for k in own:
            g, at = tangent[:, k], slice(camera[k] * p, (camera[k] + 1) * p)
            joint[at, at] += g @ g.T
            pull[at] -= g @ cells.residual[k]
            if d and cells.group_of[k] < len(cells.group):
                taken = free.setdefault(int(cells.group_of[k]), np.zeros((n_cameras * p, d)))
                taken[at] += g @ cells.half[k, :, :d]
        joint -= sum((taken @ taken.T for taken in free.values()), np.zeros_like(joint))
        cross = joint[np.ix_(mine, others)]
        away = np.linalg.solve(joint[np.ix_(others, others)] + np.eye(len(others)), cross.T).T
        information[epoch] = joint[np.ix_(mine, mine)] - away @ cross.T
        right[epoch] = pull[mine] - away @ pull[others]
    return information, right


def _at_several_ranges(scene: Scene, camera: int) -> bool:
    """Whether a camera sees marks at distances so different that its shifts are no turns."""
    low, high = np.quantile(
        depths(scene)[scene.recording.observations.camera == camera], [0.05, 0.95]
    )
    return bool(high > _RANGES * low)


def depths(scene: Scene) -> Float[np.ndarray, " observations"]:
    """Distance (m) of every observed mark along the axis of its camera, in an adjusted scene."""
    obs, state = scene.recording.observations, scene.state
    names = [s.name for s in scene.model.stations]
    station = np.array([names.index(c.station) for c in scene.model.cameras])[obs.camera]
    poses = [
        np.asarray(state.station_from_camera)[obs.camera],
        np.asarray(state.world_from_station)[scene.station_row[station, obs.epoch]],
        scene.world_from_targets(obs.target, obs.epoch),
    ]
    point = np.asarray(state.point)[scene.first_point[obs.target] + obs.point]
    return np.asarray(_depths(*map(jnp.asarray, (*poses, point))))


@jax.jit
@jax.vmap
def _depths(camera, carrier, target, point):
    world_from_camera = pose_from_vector(carrier) @ pose_from_vector(camera)
    return world_from_camera.inverse().apply(pose_from_vector(target).apply(point))[2]


def _shown(information: Float[np.ndarray, "p p"], asked: list[int], least: float) -> list[int]:
    """Ports whose plausible size, over its noise, shows beside those before it."""
    kept: list[int] = []
    for k in asked:
        block, cross = information[np.ix_(kept, kept)], information[kept, k]
        own = information[k, k] - cross @ np.linalg.pinv(block, rcond=1e-12) @ cross
        if own > max(least**2, 1e-9 * information[k, k]):
            kept.append(k)
    return kept


def _camera_of_cells(scene: Scene, rows: np.ndarray) -> np.ndarray:
    """Camera of each cell; -1 for ranges."""
    obs = scene.recording.observations
    camera = np.concatenate([obs.camera[table] for table in scene.tables])
    first = rows.min(axis=1)
    return np.where(first < len(camera), camera[np.minimum(first, len(camera) - 1)], -1)
