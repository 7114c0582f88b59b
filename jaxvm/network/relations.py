"""Relations between bodies: what every view and every link says about their poses.

The pose of a body in the world is a product of up to two poses of the state: its carrier's and its
own. Each of these has a key: ("station", row), ("target", row), ("camera", number).
"""

from collections import defaultdict
from functools import reduce
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxvm.geometry.lenses import lens_family
from jaxvm.geometry.matrices import adjoint_of_inverse, matrices, vector
from jaxvm.network.graph import PoseGraph
from jaxvm.network.scene import Scene
from jaxvm.network.views import View, pose_of_view, rays_of_pixels
from jaxvm.recording import uncorrelated

Key = tuple[str, int]

_EXACT = 1e-6
"""Standard deviation (rad) of the turn of a view without noise: finite weights against links'."""


class Relation(NamedTuple):
    """A relative pose, product(a)^-1 product(b), of two bodies.

    Attributes:
        a, b: keys of the poses that make up the bodies' poses in the world, carriers first.
        pose: a_from_b, as a 4 x 4 matrix.
        covariance: of the twist log(pose^-1 . true), turn (rad) then shift (m).
        name: of the link, or of what was seen.
    """

    a: tuple[Key, ...]
    b: tuple[Key, ...]
    pose: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    name: str

    @property
    def error(self) -> float:
        """Largest standard deviation of the turn (rad)."""
        return float(np.sqrt(np.diagonal(self.covariance)[:3].max()))


def view_relations(scene: Scene, views: list[View]) -> list[Relation]:
    """What the views say at the present intrinsics; of each the better one of a plane's two poses.

    Their covariances are rough: turns as well known as rays are, shifts at the distance seen.
    """
    focal, centre = np.asarray(scene.state.focal), np.asarray(scene.state.centre)
    distortion = np.asarray(scene.state.distortion)
    of_lens: dict[str, list[View]] = defaultdict(list)
    for view in views:
        of_lens[scene.model.cameras[view.camera].lens].append(view)
    seen, poses, sigmas = [], [], []
    for lens, own in of_lens.items():
        sizes = [len(view.pixels) for view in own]
        camera = np.repeat([view.camera for view in own], sizes)
        rays = rays_of_pixels(
            lens_family(lens), focal[camera], centre[camera], distortion[camera],
            np.concatenate([view.pixels for view in own]),
        )  # fmt: skip
        for view, of_view in zip(own, np.split(rays, np.cumsum(sizes)[:-1]), strict=True):
            sound = np.isfinite(of_view).all(axis=1)
            if sound.sum() < 4:
                continue
            found = pose_of_view(view.points[sound], of_view[sound])
            if found is None:
                continue
            seen.append(view)
            poses.append(found[0])
            sigmas.append(found[1] / np.sqrt(len(of_view)) + _EXACT)
    length = np.linalg.norm(np.reshape(poses, (-1, 6))[:, 3:], axis=1)
    sigma = np.array(sigmas)
    return [
        Relation(
            keys(scene, "camera", view.camera, view.epoch),
            keys(scene, "target", view.target, view.epoch),
            pose,
            covariance,
            "view",
        )
        for view, pose, covariance in zip(
            seen, matrices(poses), uncorrelated(sigma, sigma * length), strict=True
        )
    ]


def link_relations(scene: Scene) -> list[Relation]:
    """What the links say."""
    links = scene.recording.links
    if links is None:
        return []
    epoch, pose = np.maximum(links.epoch, 0), matrices(links.pose)
    return [
        Relation(
            keys(scene, *links.from_node[i], epoch[i]),
            keys(scene, *links.to_node[i], epoch[i]),
            pose[i],
            links.covariance[i],
            links.name[i],
        )
        for i in range(len(links.name))
    ]


def keys(scene: Scene, kind: str, number: int, epoch: int) -> tuple[Key, ...]:
    """Keys of the poses that make up the pose of a node in the world, carriers first."""
    if kind == "station":
        return (("station", int(scene.station_row[number, epoch])),)
    bodies = scene.model.cameras if kind == "camera" else scene.model.targets
    own = (kind, number if kind == "camera" else int(scene.target_row[number, epoch]))
    carrier = bodies[number].station
    if not carrier:
        return (own,)
    return (("station", int(scene.station_row[scene.station_places[carrier], epoch])), own)


def held_poses(scene: Scene, given: bool = True) -> dict[Key, Float[np.ndarray, "4 4"]]:
    """Poses that the model holds; with `given` those that it gives as start values, too."""
    known = {}
    model = scene.model

    mounted = matrices(scene.state.station_from_camera)

    def counts(body) -> bool:
        return "pose" not in body.free or (given and body.pose is not None)

    for i, camera in enumerate(model.cameras):
        if counts(camera):
            known["camera", i] = mounted[i]
    for kind, bodies, rows, table in (
        ("station", model.stations, scene.station_row, scene.state.world_from_station),
        ("target", model.targets, scene.target_row, scene.state.carrier_from_target),
    ):
        values = matrices(table)
        for i, body in enumerate(bodies):
            if counts(body):
                for row in np.unique(rows[i]):
                    known[kind, int(row)] = values[row]
    return known


def name_of(scene: Scene, key: Key) -> str:
    """A body in words."""
    kind, row = key
    if kind == "camera":
        return f'camera "{scene.model.cameras[row].name}"'
    rows = scene.station_row if kind == "station" else scene.target_row
    bodies = scene.model.stations if kind == "station" else scene.model.targets
    body = int(np.argmax((rows == row).any(axis=1)))
    moving = bodies[body].motion == "per-epoch"
    when = f" at epoch {scene.recording.epoch_ids[np.argmax(rows[body] == row)]}" if moving else ""
    return f'{kind} "{bodies[body].name}"{when}'


WORLD: Key = ("world", 0)
"""Node of a graph that stands for all known poses."""


def pose_graph(
    scene: Scene, relations: list[Relation], known: dict[Key, np.ndarray]
) -> tuple[PoseGraph, list[Key]]:
    """Graph of the unknown poses that relations join, and their keys.

    Node 0 is the world, held at the identity: whatever is known belongs to it. A relation that is
    no relative pose of two of these is no edge: with two unknown poses on one side (a camera that
    is free on a station that is free), or with cameras that are free on two different stations.
    """
    number: dict[Key, int] = {WORLD: 0}
    edges, poses, covariances, names = [], [], [], []
    for relation in relations:
        found = _edge(relation, known)
        if found is None:
            continue
        ends, measured, right = found
        carry = adjoint_of_inverse(right[None])[0]
        edges.append([number.setdefault(key, len(number)) for key in ends])
        poses.append(vector(measured))
        covariances.append(carry @ relation.covariance @ carry.T)
        names.append(relation.name)
    graph = PoseGraph(
        names=tuple("the world" if key == WORLD else name_of(scene, key) for key in number),
        edges=np.array(edges, int).reshape(-1, 2),
        edge_names=tuple(names),
        pose=np.array(poses).reshape(-1, 6),
        covariance=np.array(covariances).reshape(-1, 6, 6),
        held=np.zeros(1, int),
    )
    return graph, list(number)


def _edge(relation: Relation, known: dict[Key, np.ndarray]):
    """Two keys, the relative pose of their poses, and what it has to the right of the measured one.

    With each body's pose = before @ unknown @ behind the relation says
    before_a @ x_a @ behind_a @ measured = before_b @ x_b @ behind_b.
    """
    from_end, to_end = _end(relation.a, known), _end(relation.b, known)
    if from_end is None or to_end is None:
        return None
    (a, before_a, behind_a), (b, before_b, behind_b) = from_end, to_end
    if a == b:
        return None
    if a == WORLD:
        right = np.linalg.inv(behind_b)
        return (a, b), np.linalg.inv(before_b) @ before_a @ relation.pose @ right, right
    if b == WORLD:
        right = np.linalg.inv(before_b) @ before_a
        return (a, b), behind_a @ relation.pose @ right, right
    if not np.array_equal(before_a, before_b):
        return None
    right = np.linalg.inv(behind_b)
    return (a, b), behind_a @ relation.pose @ right, right


def _end(chain: tuple[Key, ...], known: dict[Key, np.ndarray]):
    """The unknown pose of a chain, what is known before it and behind it; None where two are."""
    missing = [key for key in chain if key not in known]
    if len(missing) > 1:
        return None
    if not missing:
        return WORLD, reduce(np.matmul, (known[key] for key in chain), np.eye(4)), np.eye(4)
    at = chain.index(missing[0])
    before = reduce(np.matmul, (known[key] for key in chain[:at]), np.eye(4))
    behind = reduce(np.matmul, (known[key] for key in chain[at + 1 :]), np.eye(4))
    return missing[0], before, behind
