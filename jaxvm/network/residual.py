"""The one residual function of a network, and its block Jacobian from the same local functions.

Simulation, adjustment, covariance, Monte Carlo and diagnosis all call what stands here.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.compiling import program
from jaxvm.geometry.poses import Pose, TurnedPose
from jaxvm.geometry.rotations import so3_exp, so3_left_jacobian
from jaxvm.network.componentwise import Numbers, componentwise, joined
from jaxvm.network.factors import Factor, PixelFactor, RangeFactor
from jaxvm.network.network import Network, Residuals
from jaxvm.network.state import State
from jaxvm.network.tiles import Tiles
from jaxvm.physics.blocks import by_blocks, hosted, roomy, whole
from jaxvm.physics.effects import EffectTable, Known, course_slopes, courses
from jaxvm.physics.ports import ALL_PORTS, CHEAP_PORTS, DEAR, N_PORTS, PORT_INDEX, PortValues


def residual(state: State, network: Network) -> Residuals:
    """Whitened residuals of all observations: the one function of the project.

    Pure and differentiable in every field of `state`; `jax.vmap` and `jax.jit` apply. Called
    outside of them it is computed in compiled blocks (`jaxvm.physics.blocks`).
    """
    at = present(network, state.flatten())

    def whitened(factor: Factor) -> Array:
        value = rows(factor, network, at, _used(factor))
        return _whitened(value, factor.weight, factor.sigma)

    return network.residuals([whitened(factor) for factor in network.factors()])


def whitening(factor: Factor) -> Float[Array, "observations components"]:
    """Factor from a residual in its unit to a whitened one: weight / sigma."""
    return _scale(factor.weight, factor.sigma)


@program
def _scale(weight, sigma):
    return weight[:, None] / sigma


@program
def _whitened(value, weight, sigma):
    # What is set aside counts nothing, even where it can't be predicted at all.
    return jnp.where(weight[:, None] > 0.0, value, 0.0) * _scale(weight, sigma)


class Present(NamedTuple):
    """What all observations share of a state: its poses as rotations, the courses of its effects.

    Attributes:
        flat: the state.
        rotation: of each pose.
        lever: left Jacobian of each rotation: exp(turn + d) = exp(lever d) exp(turn).
        values: of the courses of the effects' columns.
        slopes: of the same by their constants; None where they are not wanted.
    """

    flat: Float[Array, " n"]
    rotation: Float[Array, "poses 3 3"]
    lever: Float[Array, "poses 3 3"]
    values: Float[Array, "columns views"]
    slopes: Float[Array, "columns views 2"] | None


def present(network: Network, flat: Float[Array, " n"], slopes: bool = False) -> Present:
    """A state as observations need it, each pose turned into a rotation once.

    With `slopes` also as their derivatives by constants of effects need it.
    """
    constant = flat[network.layout.all("constant")]
    (table,) = hosted(flat[: 6 * network.layout.n_poses])
    rotation, lever = by_blocks(_rotations, table.reshape(-1, 6)[:, :3])
    return Present(
        flat,
        rotation,
        lever,
        courses(network.effects, constant, network.channels),
        course_slopes(network.effects, constant, network.channels) if slopes else None,
    )


@program
def _rotations(turns):
    return jax.vmap(so3_exp)(turns), jax.vmap(so3_left_jacobian)(turns)


def rows(
    factor: Factor, network: Network, at: Present, only: np.ndarray | None = None
) -> Float[Array, "observations components"]:
    """Predicted minus measured of one table, in its unit; of some rows `only`, if so wanted."""
    fed = _fed(factor, network)
    ports = None
    if fed.any and isinstance(factor, PixelFactor | RangeFactor):
        ports = _ports(factor, network.effects, _acting(network, at), only)
    return _chained(partial(_values, fed=fed.ports), factor, at, ports, only)


def _used(factor: Factor) -> np.ndarray | None:
    """Rows with weight; None where they are not known before the table is computed."""
    return None if whole(factor.weight) else np.flatnonzero(np.asarray(factor.weight))


def _chained(function, factor: Factor, at: Present, ports, only):
    """A function of a table with the port values of its rows, and of the state, block by block.

    It knows nothing of effects, so their number changes no program of the chain. Where the table is
    one program and nothing acts on it, tiles of rows are computed number by number.
    """
    shared = at.flat, at.rotation, at.lever
    factor = factor.bare()
    if ports is None and isinstance(factor, PixelFactor) and factor.tiles and whole(factor, shared):
        return function((factor, None), shared)
    return by_blocks(function, (factor.untiled(), ports), tuple(map(roomy, shared)), only=only)


class Fed(NamedTuple):
    """Whether effects may act on a table at all, and through which ports."""

    any: bool
    ports: tuple[int, ...]


def _fed(factor: Factor, network: Network) -> Fed:
    """As far as it is known before anything is computed: mere room for effects costs nothing.

    Few sets of ports are few programs: that of all, and that of all but the dear one.
    """
    table = network.effects
    if not isinstance(factor, PixelFactor | RangeFactor):
        return Fed(False, ())
    if table.known is not None:
        return Fed(bool(table.known.fed), table.known.fed)
    every = ALL_PORTS if isinstance(factor, PixelFactor) else CHEAP_PORTS
    if whole(table.ports):
        return Fed(table.ports.shape[0] > 0, every)
    ports = np.asarray(table.ports)
    return Fed(bool(ports.any()), every if ports[:, PORT_INDEX[DEAR]].any() else CHEAP_PORTS)


class Acting(NamedTuple):
    """What all observations share of the effects."""

    amplitude: Float[Array, " columns"]
    ports: Float[Array, "columns ports"]
    value: Float[Array, "columns views"]


def _acting(network: Network, at: Present) -> Acting:
    """With spare views, so that a recording of another length is no other program."""
    (flat,) = hosted(at.flat)
    amplitude = flat[network.layout.all("amplitude")]
    return Acting(amplitude, network.effects.ports, roomy(at.values, axis=1))


def parts_of(factor: Factor, flat: Float[Array, " n"]) -> tuple[Float[Array, "n part"], ...]:
    """Values at the slots of a table, one array for each parameter."""
    return tuple(flat[slots] for slots in _slots_of_parts(factor))


def _slots_of_parts(factor: Factor):
    ends = np.cumsum(factor.widths)
    pieces = zip(ends - np.array(factor.widths), ends, strict=True)
    return [factor.slots[:, a:b] for a, b in pieces]


class _Pose(NamedTuple):
    """A pose that is a parameter: derivatives are those by its six numbers."""

    pose: Pose
    lever: Float[Array, "3 3"]

    def changed(self, change: Float[Array, "6"]) -> Pose:
        """To first order: exp(turn + d) = exp(lever d) exp(turn)."""
        rotation, shift = self.pose.rotation, self.pose.shift + change[3:]
        return TurnedPose(rotation, shift, self.lever @ change[:3])


def _own(factor: Factor, shared) -> list:
    """Values of a table's parameters, poses as rotations and shifts; what the rows of a tile share
    once a tile."""
    flat, rotation, lever = shared
    tiles = _tiles(factor)
    *others, last = _slots_of_parts(factor)
    if tiles is not None:
        others = [slots[tiles.rows[:, :1]] for slots in others]
        last = last[tiles.rows]
    found = []
    for slots in (*others, last):
        if slots.shape[-1] == 6:
            k = slots[..., 0] // 6
            found.append(_Pose(Pose(rotation[k], flat[slots[..., 3:]]), lever[k]))
        else:
            found.append(flat[slots])
    return found


def _tiles(factor: Factor) -> Tiles | None:
    return factor.tiles if isinstance(factor, PixelFactor) else None


def _by_rows(function, factor: Factor, shared, ports) -> Any:
    """A function of a row's parameters, port values and data, over a table."""
    tiles = _tiles(factor)
    if tiles is None:
        return jax.vmap(function)(_own(factor, shared), ports, factor.data())
    numbers = _by_numbers(function, factor, shared, ports)

    def in_rows(own):
        values = joined(own, tiles.rows.shape, 0)
        return jnp.reshape(values, (tiles.rows.size, *own.shape))[tiles.place]

    return jax.tree.map(in_rows, numbers)


def _by_numbers(function, factor: Factor, shared, ports) -> Any:
    """The same of a table in tiles, as numbers: each is an array over tiles and rows of a tile."""
    tiles = _tiles(factor)
    assert tiles is not None
    data = jax.tree.map(lambda leaf: leaf[tiles.rows], factor.data())
    return componentwise(function, _own(factor, shared), ports, data, axes=2)


@program
def _values(table, shared, fed: tuple[int, ...]) -> Float[Array, "observations components"]:
    factor, ports = table

    def local(own, ports, data):
        return factor.local(list(map(_still, own)), data, PortValues(ports, fed))

    return _by_rows(local, factor, shared, ports)


def _still(part):
    return part.pose if isinstance(part, _Pose) else part


def _ports(
    factor: PixelFactor | RangeFactor,
    effects: EffectTable,
    acting: Acting,
    only: np.ndarray | None,
) -> Float[Array, "observations ports"]:
    """Port values of each observation: what all effects together do to it."""
    values = partial(_port_values, known=effects.known)
    return by_blocks(values, (factor.view, factor.pattern), acting, only=only)


@program
def _port_values(table, acting: Acting, known: Known | None):
    view, pattern = table
    each = acting.amplitude * acting.value.T[view] * pattern
    if known is None:
        return each @ acting.ports
    fed = np.array(known.fed, int)
    return jnp.zeros((len(each), N_PORTS)).at[:, fed].set(each @ acting.ports[:, fed])


class Linearised(NamedTuple):
    """A table at one state, in its unit."""

    value: Float[Array, "observations components"]  # predicted minus measured
    jacobian: Float[Array, "observations components live"]
    tangent: Float[Array, "observations components ports"]  # by every port: tangents of all effects


def linearise(
    factor: Factor,
    network: Network,
    at: Present,
    live: tuple[int, ...],
    tangent: bool = False,
) -> Linearised:
    """Each row with its derivatives: by its live slots, and by the ports.

    `live` are the positions along [own slots, amplitudes, constants] that are wanted; constants of
    a state with their slopes alone (`present`). Reverse mode: a row has one to six components and
    many slots. Whatever the number of effects, they enter through the ports: one derivative by the
    ports serves all amplitudes and constants. Without any the tangent is computed when it is asked
    for, else it is empty.
    """
    layout, n_own = network.layout, factor.slots.shape[1]
    acting, fed, only = _acting(network, at), _fed(factor, network), _used(factor)
    ports = None
    if isinstance(factor, PixelFactor | RangeFactor):
        if fed.any:
            ports = _ports(factor, network.effects, acting, only)
        elif tangent:
            ports = np.zeros((factor.slots.shape[0], N_PORTS))
    own = tuple(at for at in live if at < n_own)
    through = tuple(sorted({*fed.ports, *CHEAP_PORTS})) if tangent else fed.ports
    derivatives = partial(_derivatives, live=own, fed=through)
    value, by_own, by_ports = _chained(derivatives, factor, at, ports, only)
    if tangent and isinstance(factor, PixelFactor) and PORT_INDEX[DEAR] not in through:
        by_ports = _with_dear(factor, at, ports, only, value, by_ports)
    wanted = tuple(at - n_own for at in live if at >= n_own)
    if not fed.any or not wanted:
        by_effects = jnp.zeros((*value.shape, len(wanted)))
    else:
        assert isinstance(factor, PixelFactor | RangeFactor)
        owner = _owners(network.effects, len(layout.all("constant")))
        table = (by_ports, factor.view, factor.pattern)
        slopes = at.slopes
        if slopes is None:
            assert max(wanted) < len(layout.all("amplitude")), "constants are derived by slopes"
            slopes = np.zeros((*at.values.shape, 2))
        slopes = roomy(slopes, axis=1)
        derivatives = partial(_by_effects, known=network.effects.known)
        by_effects = by_blocks(derivatives, table, acting, slopes, owner, only=only)
        together = wanted[-1] - wanted[0] == len(wanted) - 1  # they need no copy
        chosen = slice(wanted[0], wanted[-1] + 1) if together else np.asarray(wanted)
        by_effects = by_effects[:, :, chosen]
    joined: Any = np if isinstance(by_own, np.ndarray) else jnp
    return Linearised(value, joined.concatenate([by_own, by_effects], axis=2), by_ports)


def _with_dear(factor: Factor, at: Present, ports, only, value, by_ports) -> Any:
    """Derivatives by ports with that by the dear one, of which the prediction is a linear function.

    A prediction with it takes a third as long as all derivatives with it.
    """
    unit = np.zeros((1, N_PORTS))
    unit[0, PORT_INDEX[DEAR]] = 1.0
    fed = _chained(partial(_values, fed=ALL_PORTS), factor, at, ports + unit, only)
    return by_ports + (fed - value)[:, :, None] * unit


def _owners(effects: EffectTable, n: int) -> Float[Array, "columns 2 constants"]:
    """1 where a constant is the first or second one of a column."""
    (index,) = hosted(effects.constant_index)
    return (index[:, :, None] == np.arange(n)).astype(float)


@program
def _by_effects(table, acting: Acting, slopes, owner, known: Known | None):
    """Derivatives of rows by all amplitudes, then by all constants of effects."""
    by_ports, view, pattern = table
    n, components, _ = by_ports.shape
    ports = acting.ports
    if known is not None:
        fed = np.array(known.fed, int)
        by_ports, ports = by_ports[:, :, fed], ports[:, fed]
    entering = (by_ports @ ports.T) * pattern[:, None, :]
    by_amplitudes = entering * acting.value.T[view][:, None, :]
    slope = jnp.moveaxis(slopes, 1, 0)[view]
    moved = (entering * acting.amplitude)[..., None] * slope[:, None]
    by_constants = jnp.reshape(moved, (n, components, -1)) @ jnp.reshape(
        owner, (-1, owner.shape[2])
    )
    return jnp.concatenate([by_amplitudes, by_constants], axis=2)


@program
def _derivatives(table, shared, live: tuple[int, ...], fed: tuple[int, ...]):
    """Values of the rows, and their derivatives by live slots of their own and by all ports."""
    factor, ports = table
    if not live and ports is None:
        value = _values(table, shared, fed=())
        return value, *(2 * (jnp.zeros((*value.shape, 0)),))
    return _by_rows(_derivatives_of_row(factor, live, fed), factor, shared, ports)


def _derivatives_of_row(factor: Factor, live: tuple[int, ...], fed: tuple[int, ...] = ()):
    """Function of one row: its value, and its derivatives by live slots of its own and by ports."""
    ends = np.cumsum(factor.widths)
    first = np.concatenate([[0], ends])[:-1]
    # Only parameters with a wanted slot are differentiated; the others are constants.
    moving = [k for k in range(len(ends)) if any(first[k] <= at < ends[k] for at in live)]
    within = np.concatenate([np.arange(first[k], ends[k]) for k in moving] or [[]])
    wanted = np.searchsorted(within, np.asarray(live, int))

    def local(free, ports, parts, data):
        own = list(map(_still, parts))
        for k, change in zip(moving, free, strict=True):
            part = parts[k]
            own[k] = part.changed(change) if isinstance(part, _Pose) else part + change
        value = factor.local(own, data, PortValues(ports, fed))
        return value, value

    def row(parts, ports, data):
        free = [jnp.zeros(factor.widths[k]) for k in moving]
        derivative = jax.jacrev(local, argnums=(0, 1), has_aux=True)
        (blocks, by_ports), value = derivative(free, ports, parts, data)
        none = jnp.zeros((len(value), 0))
        by_own = jnp.concatenate([none, *blocks], axis=1)[:, wanted]
        return value, by_own, none if by_ports is None else by_ports

    return row


def linearise_tiles(
    factor: PixelFactor, at: Present, live: tuple[int, ...]
) -> tuple[Numbers, Numbers]:
    """Values of the rows of a table in tiles, and their derivatives by live slots of their own.

    For a table on which no effect acts. Numbers of each row, [components] and [components, live];
    each is an array over tiles and the rows of a tile, or a known number.
    """
    row = _derivatives_of_row(factor, live)
    value, jacobian, _ = _by_numbers(row, factor, (at.flat, at.rotation, at.lever), None)
    return value, jacobian


def predict_pixels(state: State, network: Network) -> tuple[Float[Array, "observations 2"], ...]:
    """Predicted pixels (px) of every table: what a simulation adds its noise to."""
    at = present(network, state.flatten())
    return tuple(rows(f, network, at) + f.circumstances.pixel for f in network.pixels)
