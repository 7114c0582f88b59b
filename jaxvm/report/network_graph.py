"""An adjusted scene as a graph: its bodies, and what was measured between them.

A sight line (one target in one image) counts as the relative pose that its image points alone give,
to first order at the adjusted values, with the covariance of these points. So links and sight lines
are edges of one kind, with cycles, misclosures and redundancy numbers alike.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxvm.geometry.matrices import matrices, matrix
from jaxvm.geometry.poses import se3_exp
from jaxvm.geometry.rotations import so3_left_jacobian, so3_left_jacobian_inverse
from jaxvm.network.graph import PoseGraph
from jaxvm.network.redundancy import bridges
from jaxvm.network.relations import (
    Key,
    Relation,
    held_poses,
    keys,
    link_relations,
    pose_graph,
)
from jaxvm.network.residual import linearise, present
from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import pose_covariances
from jaxvm.solve.snooping import redundancy

_UNSEEN = 1e-12
"""Eigenvalue of a view's unit-diagonal normal matrix below which it gives no pose."""


@dataclass(frozen=True)
class Body:
    """A station, a target that stands on its own, or a free camera on a station that is held.

    Attributes:
        kind: "station", "target" or "camera".
        name: as in the model.
        nodes: its poses, one for each epoch if it moves; places in the graph.
        held: whether its pose is given.
    """

    kind: str
    name: str
    nodes: Int[np.ndarray, " poses"]
    held: bool


@dataclass(frozen=True, eq=False)
class BodyGraph:
    """Bodies of an adjusted scene and the relative poses measured between them.

    Attributes:
        graph: one node for each pose; edges are all links and sight lines that were used.
        bodies: in the order of their nodes.
        body: of each node.
        pose: world_from_node, turn (rad) and shift (m), adjusted.
        covariance: of a turn and a shift of the node about its origin, world axes (rad, m).
        sight: which edges are sight lines; the others are links.
        source: of each edge its place in the recording's links, or in `views`.
        views: camera, target and epoch of each sight line.
        redundancy: of each edge 1 - tr(hat) / 6: the share of its six components that the rest of
            the network checks. For a sight line the hat matrix of its image points is summed.
        excess: of each sight line: squared whitened residuals over redundancy; 1 if all is well.
        bridge: edges in no cycle.
        link_test: of each link of the recording v^T R^+ v, with R its redundancy matrix. If the
            link is sound: chi-squared with as many degrees of freedom as R has directions that
            something checks, eigenvalues above 1e-6 (Baarda 1968).
        link_checked: these degrees of freedom.
        link_residual: log(measured^-1 . adjusted) of each link, to's axes (rad, m).
        rejected: pairs of nodes of rejected links that the recording still has, with their names.
        mounts: cameras and the station that carries each, places of bodies.
        n_folded: free cameras and targets on stations that move or are free: their sight lines
            begin at the station, with the adjusted mount counted as known.
        n_poseless: views that give no pose: too few marks.
    """

    graph: PoseGraph
    bodies: tuple[Body, ...]
    body: Int[np.ndarray, " nodes"]
    pose: Float[np.ndarray, "nodes 6"]
    covariance: Float[np.ndarray, "nodes 6 6"]
    sight: Bool[np.ndarray, " edges"]
    source: Int[np.ndarray, " edges"]
    views: Int[np.ndarray, "views 3"]
    redundancy: Float[np.ndarray, " edges"]
    excess: Float[np.ndarray, " views"]
    bridge: Bool[np.ndarray, " edges"]
    link_test: Float[np.ndarray, " links"]
    link_checked: Int[np.ndarray, " links"]
    link_residual: Float[np.ndarray, "links 6"]
    rejected: tuple[tuple[str, int, int], ...]
    mounts: tuple[tuple[int, int], ...]
    n_folded: int
    n_poseless: int


def body_graph(adjustment: Adjustment, scale: float = 1.0) -> BodyGraph:
    """The graph of an adjusted scene.

    Args:
        adjustment: of the scene; its links of weight zero are set aside.
        scale: factor on the covariance of the poses: 1 trusts the stated sigmas.
    """
    scene = adjustment.scene
    nodes = _Nodes(scene)
    known = {("camera", i): matrix(pose) for i, pose in enumerate(_values(scene, "camera"))}
    known |= {("target", i): matrix(pose) for i, pose in enumerate(_values(scene, "target"))}
    known = {key: pose for key, pose in known.items() if key not in nodes.place}

    blocks = redundancy(adjustment)
    links = link_relations(scene)
    link_blocks, set_aside = _links(adjustment, blocks)
    test, checked, residual = _link_tests(adjustment, link_blocks)
    sights, views, sight_hat, excess, n_poseless = _sights(adjustment, blocks)
    relations = [nodes.joined(relation) for relation in (*links, *sights)]
    sight = np.repeat([False, True], [len(links), len(sights)])
    source = np.concatenate([np.arange(len(links)), np.arange(len(sights))])
    share = np.concatenate([np.trace(link_blocks, axis1=1, axis2=2) / 6.0, 1.0 - sight_hat / 6.0])
    # A station that sees its own marks measures nothing between bodies.
    apart = np.array([r.a[0] != r.b[0] for r in relations], bool)
    used = np.flatnonzero(apart & ~np.append(set_aside, np.zeros(len(sights), bool)))
    found, order = pose_graph(scene, [relations[k] for k in used], known)
    place = np.array([nodes.place.get(key, -1) for key in order])
    held = held_poses(scene, given=False)
    graph = PoseGraph(
        nodes.names,
        place[found.edges],
        found.edge_names,
        found.pose,
        found.covariance,
        np.array([k for key, k in nodes.place.items() if key in held], int),
    )
    bridge = np.zeros(len(used), bool)
    bridge[bridges(graph)] = True
    pose, covariance = nodes.poses(adjustment, scale)
    aside = [relations[k] for k in np.flatnonzero(set_aside & apart[: len(links)])]
    ends = [(link.name, nodes.place[link.a[0]], nodes.place[link.b[0]]) for link in aside]
    return BodyGraph(
        graph=graph,
        bodies=tuple(
            Body(kind, name, own, bool(np.isin(own, graph.held).all()))
            for kind, name, own in nodes.bodies
        ),
        body=np.repeat(np.arange(len(nodes.bodies)), [len(own) for *_, own in nodes.bodies]),
        pose=pose,
        covariance=covariance,
        sight=sight[used],
        source=source[used],
        views=views,
        redundancy=np.where(bridge, 0.0, np.clip(share[used], 0.0, 1.0)),
        excess=excess,
        link_test=test,
        link_checked=checked,
        link_residual=residual,
        bridge=bridge,
        rejected=tuple(ends),
        mounts=nodes.mounts,
        n_folded=nodes.n_folded,
        n_poseless=n_poseless,
    )


def _values(scene: Scene, kind: str) -> np.ndarray:
    table = {
        "station": scene.state.world_from_station,
        "target": scene.state.carrier_from_target,
        "camera": scene.state.station_from_camera,
    }[kind]
    return np.asarray(table)


class _Nodes:
    """Poses that are nodes: their places, names and bodies."""

    def __init__(self, scene: Scene):
        model, held = scene.model, held_poses(scene, given=False)
        self.scene = scene
        self.place: dict[Key, int] = {}
        self.bodies: list[tuple[str, str, np.ndarray]] = []
        names: list[str] = []

        def add(kind: str, name: str, rows) -> None:
            first = len(names)
            for when, row in enumerate(rows):
                self.place[kind, int(row)] = len(names)
                epoch = f", epoch {scene.recording.epoch_ids[when]}" if len(rows) > 1 else ""
                names.append(name + epoch)
            self.bodies.append((kind, name, np.arange(first, len(names))))

        for i, station in enumerate(model.stations):
            add("station", station.name, np.unique(scene.station_row[i]))
        for i, target in enumerate(model.targets):
            if not target.station:
                add("target", target.name, np.unique(scene.target_row[i]))
        self.carrier: dict[int, Key] = {}
        mounts, self.n_folded = [], sum(
            bool(t.station) and "pose" in t.free for t in model.targets
        )  # fmt: skip
        for i, camera in enumerate(model.cameras):
            if "pose" not in camera.free:
                continue
            rows = np.unique(scene.station_row[scene.station_places[camera.station]])
            if len(rows) > 1 or ("station", int(rows[0])) not in held:
                self.n_folded += 1
                continue
            self.carrier[i] = ("station", int(rows[0]))
            mounts.append((len(self.bodies), scene.station_places[camera.station]))
            add("camera", camera.name, [i])
        self.mounts = tuple(mounts)
        self.names = tuple(names)

    def joined(self, relation: Relation) -> Relation:
        """The relation with a camera that is a node on its own as such."""

        def end(chain: tuple[Key, ...]) -> tuple[Key, ...]:
            return chain[-1:] if chain[-1] in self.place else chain

        return relation._replace(a=end(relation.a), b=end(relation.b))

    def poses(self, adjustment: Adjustment, scale: float):
        """Adjusted world_from_node of all nodes, and covariances of (turn, shift), world axes."""
        pose, spread = np.zeros((len(self.names), 6)), np.zeros((len(self.names), 6, 6))
        for kind, table in (
            ("station", "world_from_station"),
            ("target", "carrier_from_target"),
            ("camera", "station_from_camera"),
        ):
            rows = np.array([row for k, row in self.place if k == kind], int)
            if len(rows) == 0:
                continue
            own = [self.place[kind, int(row)] for row in rows]
            pose[own] = _values(self.scene, kind)[rows]
            spread[own] = pose_covariances(adjustment, table, scale)[rows]
        # exp(turn + d) = exp(J_l d) exp(turn).
        lever = np.tile(np.eye(6), (len(pose), 1, 1))
        if len(pose):
            lever[:, :3, :3] = jax.vmap(so3_left_jacobian)(jnp.asarray(pose[:, :3]))
        for camera, station in self.carrier.items():
            k, carrier = self.place["camera", camera], matrix(pose[self.place[station]])
            in_world = carrier @ matrix(pose[k])
            turned = np.kron(np.eye(2), carrier[:3, :3])
            lever[k] = turned @ lever[k]
            pose[k, :3] = Rotation.from_matrix(in_world[:3, :3]).as_rotvec()
            pose[k, 3:] = in_world[:3, 3]
        return pose, lever @ spread @ lever.swapaxes(1, 2)


def _links(adjustment: Adjustment, blocks):
    """Redundancy matrix of each link, and which are set aside."""
    network, links = adjustment.problem.network, adjustment.scene.recording.links
    if links is None or network.links is None:
        return np.zeros((0, 6, 6)), np.zeros(0, bool)
    aside = np.asarray(network.links.weight)[: len(links.name)] <= 0.0
    of_links = blocks[len(network.acted_on)]
    return of_links, aside


def _link_tests(adjustment: Adjustment, blocks: Float[np.ndarray, "links 6 6"]):
    """Test values, their degrees of freedom, and residuals (rad, m) of all links."""
    factor = adjustment.problem.network.links
    if factor is None or len(blocks) == 0:
        return np.zeros(0), np.zeros(0, int), np.zeros((0, 6))
    v = np.asarray(adjustment.residuals().links)[: len(blocks)]
    values, vectors = np.linalg.eigh(blocks)
    seen = values > 1e-6
    along = np.einsum("nij,ni->nj", vectors, v)
    test = np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
    root = np.asarray(factor.root)[: len(blocks)]
    return test, seen.sum(axis=1), np.linalg.solve(root, v[:, :, None])[:, :, 0]


def _sights(adjustment: Adjustment, blocks):
    """Relative poses of all views: relations, (camera, target, epoch), trace of the hat matrix,
    squared residuals over redundancy; and the number of views that give none."""
    scene, problem = adjustment.scene, adjustment.problem
    network = problem.network
    obs, flat = scene.recording.observations, problem.flat(adjustment.x)
    at = present(network, flat)
    view = np.stack([obs.camera, obs.target, obs.epoch], axis=1)
    views, of_row = np.unique(view, axis=0, return_inverse=True)
    of_row = np.ravel(of_row)
    n = len(views)
    normal, pull = np.zeros((n, 6, 6)), np.zeros((n, 6))
    hat, square, count = np.zeros(n), np.zeros(n), np.zeros(n, int)
    for rows, factor, block in zip(scene.tables, network.pixels, blocks, strict=False):
        first = sum(factor.widths[:6])
        table = linearise(factor, network, at, tuple(range(first, first + 6)))
        weight = np.asarray(factor.weight)[: len(rows)]
        used = weight > 0.0
        scale = np.where(
            used[:, None], (weight[:, None] / np.asarray(factor.sigma)[: len(rows)]), 0
        )
        value = np.where(used[:, None], np.asarray(table.value)[: len(rows)], 0.0) * scale
        jacobian = np.asarray(table.jacobian)[: len(rows)]
        jacobian = np.where(used[:, None, None], jacobian, 0.0) * scale[:, :, None]
        own = of_row[rows]
        np.add.at(normal, own, jacobian.swapaxes(1, 2) @ jacobian)
        np.add.at(pull, own, np.einsum("nck,nc->nk", jacobian, value))
        np.add.at(hat, own, 2.0 * used - np.trace(block, axis1=1, axis2=2))
        np.add.at(square, own, np.sum(value**2, axis=1))
        np.add.at(count, own, used)
    # The target's own pose moves by T exp(twist): its turn by J_r^-1 omega, its shift by R rho.
    pose = _values(scene, "target")[scene.target_row[views[:, 1], views[:, 2]]].reshape(-1, 6)
    step = np.zeros((n, 6, 6))
    if n:
        step[:, :3, :3] = jax.vmap(so3_left_jacobian_inverse)(jnp.asarray(-pose[:, :3]))
        step[:, 3:, 3:] = Rotation.from_rotvec(pose[:, :3]).as_matrix()
    normal = step.swapaxes(1, 2) @ normal @ step
    pull = np.einsum("nij,ni->nj", step, pull)
    unit = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
    least = np.linalg.eigvalsh(normal / (unit[:, :, None] * unit[:, None, :])).min(
        axis=1, initial=1
    )
    good = np.flatnonzero((least > _UNSEEN) & (count >= 3))
    covariance = np.linalg.inv(normal[good])
    covariance = 0.5 * (covariance + covariance.swapaxes(1, 2))
    twist = -np.einsum("nij,nj->ni", covariance, pull[good])
    views, redundant = views[good], 2.0 * count[good] - hat[good]
    excess = square[good] / np.maximum(redundant, 1e-9)
    measured = matrices(scene.camera_from_targets(*views.T)) @ _exponentials(twist)
    relations = [
        Relation(
            keys(scene, "camera", int(camera), int(epoch)),
            keys(scene, "target", int(target), int(epoch)),
            measured[k],
            covariance[k],
            scene.view_name(camera, target, epoch),
        )
        for k, (camera, target, epoch) in enumerate(views)
    ]
    return relations, views, hat[good], excess, n - len(good)


def _exponentials(twists: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n 4 4"]:
    out = np.tile(np.eye(4), (len(twists), 1, 1))
    if len(twists):
        pose = jax.vmap(se3_exp)(jnp.asarray(twists))
        out[:, :3, :3], out[:, :3, 3] = np.asarray(pose.rotation), np.asarray(pose.shift)
    return out
