"""From the pixel level to the pose level: every view as a measured relative pose.

A view is one target in one image. Alone it gives the pose of the target before the camera, by
maximum likelihood, with the covariance of its own pixels; known mounts carry that to the stations.
A network of known cameras loses nothing by it, to first order. What several views have in common it
does lose: free intrinsics of one camera, and effects of a temperature. Each view then has to find
its own, for a link can't say that another link errs alike.
"""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Array

from jaxvm.geometry import pose_from_vector, se3_adjoint, vector_from_pose
from jaxvm.network.scene import Scene
from jaxvm.pose.view_poses import ViewPoses, Views, view_poses
from jaxvm.recording.model import Camera, Prior
from jaxvm.recording.recording import Links, Recording, no_observations


def view_links(scene: Scene) -> Links:
    """Every view as a measured relative pose with its full covariance.

    A link leads from the camera's station to the target's station. Where the camera's mount is free
    it begins at the camera itself; where the target's is, or the target stands in the world, it
    ends at the target itself. Its pose has the maximum likelihood of the pixels of that view alone.
    Points, and intrinsics that are held, are taken as they are at present. Intrinsics that are free
    are unknowns of each view for itself, with the priors of the model. Effects are taken off the
    pixels at their present size.

    Views with fewer than four marks of known coordinates, and with marks on one line, give no link.

    Args:
        scene: at start values or adjusted; intrinsics that are held must be known. Rays must have
            z > 0. Poses need not be near: a view that they don't explain starts anew.

    Raises:
        ValueError: the marks of a view don't determine the free intrinsics; it is named.
    """
    views, found = view_poses(scene)
    return _links(scene, views, found)


def pose_level(scene: Scene) -> Recording:
    """The recording of stations and relative poses alone: `view_links`, and the links it had.

    What was held or free stays so. Cameras and targets are gone but for those that links begin or
    end at; of these the poses stay free, intrinsics and points are held at present values. Ranges,
    drivers, effects and priors of what is gone go with the pixels.
    """
    model, own, state = scene.model, scene.recording.links, scene.state
    links = view_links(scene)
    if own is not None:
        links = _joined(own, links)
    nodes = {*links.from_node, *links.to_node}
    kept = {
        kind: [i for i in range(len(bodies)) if (kind, i) in nodes]
        for kind, bodies in (("camera", model.cameras), ("target", model.targets))
    }
    place = {(kind, i): (kind, k) for kind, rows in kept.items() for k, i in enumerate(rows)}

    def bare(i: int) -> Camera:
        camera = model.cameras[i]
        count = len(np.trim_zeros(np.asarray(state.distortion[i]), "b"))
        count = max(count, 0 if camera.distortion is None else len(camera.distortion))
        return replace(
            camera,
            focal_px=np.array(state.focal[i]),
            centre_px=np.array(state.centre[i]),
            distortion=np.array(state.distortion[i, :count]) if count else None,
            free=camera.free & {"pose"},
        )

    def stays(prior: Prior) -> bool:
        kind, name, quantity = prior.parameter.split(".")
        bodies = {"cameras": kept["camera"], "targets": kept["target"]}
        of_kind = getattr(model, kind)
        named = [body.name for body in of_kind].index(name)
        return quantity == "pose" and (kind == "stations" or named in bodies.get(kind, ()))

    return replace(
        scene.recording,
        model=replace(
            model,
            cameras=tuple(map(bare, kept["camera"])),
            targets=tuple(
                replace(model.targets[i], free=model.targets[i].free & {"pose"})
                for i in kept["target"]
            ),
            rangefinders=(),
            drivers={},
            priors=tuple(filter(stays, model.priors)),
            effects=(),
        ),
        velocities={},
        observations=no_observations(),
        drivers=None,
        ranges=None,
        links=replace(
            links,
            from_node=[place.get(node, node) for node in links.from_node],
            to_node=[place.get(node, node) for node in links.to_node],
        ),
    )


def _links(scene: Scene, views: Views, found: ViewPoses) -> Links:
    model, places, state = scene.model, scene.station_places, scene.state
    if len(views.camera) == 0:
        return Links((), [], [], np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros(0, int))
    mounted = np.array([("pose" not in c.free) for c in model.cameras], bool)
    carried = np.array([bool(t.station) and "pose" not in t.free for t in model.targets], bool)
    from_node = [
        ("station", places[model.cameras[c].station]) if mounted[c] else ("camera", int(c))
        for c in views.camera
    ]
    to_node = [
        ("station", places[model.targets[t].station]) if carried[t] else ("target", int(t))
        for t in views.target
    ]
    before = np.asarray(state.station_from_camera)[views.camera] * mounted[views.camera, None]
    row = scene.target_row[views.target, views.epoch]
    behind = np.asarray(state.carrier_from_target)[row] * carried[views.target, None]
    pose, covariance = _carried(before, *found, behind)
    # A station with known mounts that sees its own marks measures nothing.
    apart = np.array([a != b for a, b in zip(from_node, to_node, strict=True)], bool)
    chosen = np.flatnonzero(apart)
    return Links(
        name=tuple(
            scene.view_name(views.camera[k], views.target[k], views.epoch[k]) for k in chosen
        ),
        from_node=[from_node[k] for k in chosen],
        to_node=[to_node[k] for k in chosen],
        pose=np.asarray(pose)[chosen],
        covariance=np.asarray(covariance)[chosen],
        epoch=views.epoch[chosen],
    )


@jax.jit
@jax.vmap
def _carried(before, camera_from_target, covariance, behind) -> tuple[Array, Array]:
    """a_from_b = before @ camera_from_target @ behind^-1, and the covariance of its twist.

    With E the small turn and shift as the camera sees them, true = before E T behind^-1, so
    measured^-1 . true = exp(Ad(behind T^-1) (turn, shift)) to first order.
    """
    pose, outer = pose_from_vector(camera_from_target), pose_from_vector(behind)
    carry = se3_adjoint(outer @ pose.inverse())
    spread = carry @ covariance @ carry.T
    found = pose_from_vector(before) @ pose @ outer.inverse()
    return vector_from_pose(found), 0.5 * (spread + spread.T)


def _joined(a: Links, b: Links) -> Links:
    return Links(
        a.name + b.name,
        [*a.from_node, *b.from_node],
        [*a.to_node, *b.to_node],
        np.concatenate([a.pose, b.pose]),
        np.concatenate([a.covariance, b.covariance]),
        np.concatenate([a.epoch, b.epoch]),
    )
