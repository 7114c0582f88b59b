"""Factors: one local prediction and a table of the observations that it explains.

A factor knows, for each of its observations, which positions of the flat state it touches (its
*slots*), what was measured, and how to predict it. The residual of the network is all factors, one
after the other; the block Jacobian comes from the same local functions (`jaxvm.network.residual`).
"""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from jaxvm.geometry.lenses import LensFamily
from jaxvm.geometry.poses import Pose, pose_from_vector, se3_log
from jaxvm.network.tiles import Tiles
from jaxvm.physics.chain import Aim, Circumstances, Sight, predict_pixel, predict_range
from jaxvm.physics.ports import PortValues


class Factor(eqx.Module):
    """A table of observations with one local prediction.

    Attributes:
        slots: positions in the flat state of each observation's own parameters.
        sigma: standard deviation of each residual component, in its unit.
        weight: 1 where used, 0 where set aside or rejected.
    """

    slots: eqx.AbstractVar[Int[Array, "observations slots"]]
    sigma: eqx.AbstractVar[Float[Array, "observations components"]]
    weight: eqx.AbstractVar[Float[Array, " observations"]]

    @property
    def n_real(self) -> int:
        """Number of observations without the padding at the end of the table."""
        return self.slots.shape[0]

    @property
    @abc.abstractmethod
    def widths(self) -> tuple[int, ...]:
        """How many slots each parameter has: a focal length 2, a point 3; six are a pose."""

    def bare(self) -> "Factor":
        """The table without what the effects add to it."""
        return self

    def untiled(self) -> "Factor":
        """The table as rows alone: every leaf leads with the observations."""
        return self

    @abc.abstractmethod
    def data(self) -> PyTree:
        """PyTree of the recorded values; its leaves lead with the observations."""

    @abc.abstractmethod
    def local(self, own, data, ports: PortValues) -> Float[Array, " components"]:
        """Predicted minus measured of one observation, in its unit.

        `own` are the values of its parameters, poses as `Pose` or as numbers.
        """


class PixelFactor(Factor):
    """Image points of all cameras with one family of lenses: predicted minus measured pixel.

    The table is padded to a round number of rows, so that recordings of similar size are the same
    program; padding repeats the last observation with weight zero. `tiles` are its rows with the
    same parameters but the mark; None where few have.
    """

    family: LensFamily = eqx.field(static=True)
    up: tuple[float, float, float] = eqx.field(static=True)
    real: Int[Array, ""]
    slots: Int[Array, "observations slots"]
    sigma: Float[Array, "observations 2"]
    weight: Float[Array, " observations"]
    circumstances: Circumstances
    view: Int[Array, " observations"]
    pattern: Float[Array, "observations columns"]
    tiles: Tiles | None

    @property
    def n_real(self) -> int:
        return int(self.real)

    def untiled(self):
        return eqx.tree_at(lambda f: f.tiles, self, None, is_leaf=lambda leaf: leaf is None)

    def bare(self):
        return eqx.tree_at(lambda f: f.pattern, self, self.pattern[:, :0])

    def data(self):
        return self.circumstances

    @property
    def widths(self):
        return (2, 2, self.family.n_coefficients, 6, 6, 6, 6, 3)

    def local(self, own, data, ports):
        return predict_pixel(self.family, Sight(*own), data, ports, self.up) - data.pixel


class RangeFactor(Factor):
    """Distances of all rangefinders: predicted minus measured (m); padded like image points."""

    real: Int[Array, ""]
    slots: Int[Array, "observations slots"]
    sigma: Float[Array, "observations 1"]
    weight: Float[Array, " observations"]
    circumstances: Circumstances
    to_plane: Float[Array, " observations"]
    measured: Float[Array, " observations"]
    view: Int[Array, " observations"]
    pattern: Float[Array, "observations columns"]

    @property
    def n_real(self) -> int:
        return int(self.real)

    def bare(self):
        return eqx.tree_at(lambda f: f.pattern, self, self.pattern[:, :0])

    def data(self):
        return self.circumstances, self.to_plane, self.measured

    @property
    def widths(self):
        return (6, 6, 6, 6, 3)

    def local(self, own, data, ports):
        circumstances, to_plane, measured = data
        return (predict_range(Aim(*own), circumstances, to_plane, ports) - measured)[None]


class LinkFactor(Factor):
    """Measured or calibrated relative poses: log(measured^-1 . from^-1 . to), turn then shift.

    A node is a body on a carrier (a camera on its station); one that is its own carrier has the
    identity as its second pose. Where all nodes are, tables have no second poses. `root` is a
    square root of the information, root^T root = C^-1: what comes out is whitened, sigma is one.
    """

    slots: Int[Array, "observations slots"]
    sigma: Float[Array, "observations 6"]
    weight: Float[Array, " observations"]
    measured: Float[Array, "observations 6"]
    root: Float[Array, "observations 6 6"]

    def data(self):
        return self.measured, self.root

    @property
    def widths(self):
        return (6,) * (self.slots.shape[1] // 6)

    def local(self, own, data, ports):
        measured, root = data
        a_from_b = link_pose([pose_from_vector(vector) for vector in own])
        return root @ se3_log(pose_from_vector(measured).inverse() @ a_from_b)


def link_pose(poses: Sequence[Pose]) -> Pose:
    """a_from_b of (world_from_a, world_from_b), or of carriers and the bodies on them."""
    if len(poses) == 4:
        poses = poses[0] @ poses[1], poses[2] @ poses[3]
    return poses[0].inverse() @ poses[1]


class EdgeFactor(Factor):
    """Measured relative poses that are unknowns themselves: log(measured^-1 . link), whitened."""

    slots: Int[Array, "observations 6"]
    sigma: Float[Array, "observations 6"]
    weight: Float[Array, " observations"]
    measured: Float[Array, "observations 6"]
    root: Float[Array, "observations 6 6"]

    def data(self):
        return self.measured, self.root

    @property
    def widths(self):
        return (6,)

    def local(self, own, data, ports):
        measured, root = data
        return root @ se3_log(pose_from_vector(measured).inverse() @ pose_from_vector(own[0]))


class ClosureFactor(Factor):
    """Loops of relative poses whose product must be the identity: log(T1^s1 . T2^s2 ...).

    Shorter loops are filled up with identities.
    """

    slots: Int[Array, "observations slots"]
    sigma: Float[Array, "observations 6"]
    weight: Float[Array, " observations"]
    forward: Float[Array, "observations links"]

    def data(self):
        return self.forward

    @property
    def widths(self):
        return (6,) * (self.slots.shape[1] // 6)

    def local(self, own, data, ports):
        poses = [pose_from_vector(part).settled() for part in own]
        links = jax.tree.map(lambda *each: jnp.stack(each), *poses)
        back = jax.vmap(Pose.inverse)(links)
        ahead = data > 0.0
        walked = Pose(
            jnp.where(ahead[:, None, None], links.rotation, back.rotation),
            jnp.where(ahead[:, None], links.shift, back.shift),
        )
        # A scan, so that a loop of a thousand links is no longer a program than one of three.
        product, _ = jax.lax.scan(
            lambda so_far, link: (so_far @ link, None), Pose.identity(), walked
        )
        return se3_log(product)


class PriorFactor(Factor):
    """What is known about single parameters beforehand: value minus expected value."""

    slots: Int[Array, "observations 1"]
    sigma: Float[Array, "observations 1"]
    weight: Float[Array, " observations"]
    expected: Float[Array, " observations"]

    def data(self):
        return self.expected

    @property
    def widths(self):
        return (1,)

    def local(self, own, data, ports):
        return own[0] - data
