"""Effects: `port x driver x form x scope`, kept as data.

An `Effect` is the readable record; an `EffectTable` is the same as arrays of a fixed size, so that
a model with other effects is another table and not another program. A term of an effect feeds one
port, modulated by one observation-like driver; all terms share the time-like driver and its form.

Port value of observation o from column j:

    amplitude_j  x  course_j(epoch of o; constants)  x  pattern_j(o)

The course is computed once per call for all epochs and gathered; the pattern (which camera, which
target, how the row or the radius enters) is a table.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvm.compiling import program
from jaxvm.physics.blocks import by_blocks, continued, hosted, roomy, whole
from jaxvm.physics.forms import BASIS_INDEX, EVERY_KIND, FORMS, Form, evaluate_basis, kinds_of
from jaxvm.physics.ports import N_PORTS, PORT_INDEX


@dataclass(frozen=True)
class Scope:
    """Which entities an effect touches; an empty tuple means all of that kind."""

    camera: tuple[str, ...] = ()
    station: tuple[str, ...] = ()
    target: tuple[str, ...] = ()
    point: tuple[str, ...] = ()
    rangefinder: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, list[str]]:
        """The kinds that are narrowed down, for a report or a file."""
        kinds = ("camera", "station", "target", "point", "rangefinder")
        return {kind: list(getattr(self, kind)) for kind in kinds if getattr(self, kind)}

    def words(self) -> str:
        """Reads in a sentence: "camera left", "everywhere"."""
        parts = [f"{kind} {', '.join(names)}" for kind, names in self.as_dict().items()]
        return "; ".join(parts) or "everywhere"


@dataclass(frozen=True)
class Term:
    """One port of an effect and the pattern over observations with which it is fed."""

    port: str
    driver: str = "one"
    basis: str = "one"
    constants: tuple[float, ...] = ()
    weight: float = 1.0


@dataclass(frozen=True)
class Effect:
    """Physics in a model: terms (ports and patterns), a time-like driver, a form, a scope.

    Attributes:
        name: what an engineer calls it.
        terms: the ports it feeds.
        driver: name of a time-like channel, or "constant".
        form: key of `jaxvm.physics.forms.FORMS`.
        constants: nonlinear constants of the form (tau, period, ...).
        reference: value from which a centred form counts its driver.
        scope: the entities it touches.
        amplitudes: one for each term and basis, term by term, in the unit of the port per unit of
            the driver.
        catalogue_id: entry of the catalogue, "" where it has no name.
        spread: prior standard deviation of every amplitude; 0 for that of its port.
        shares: name of the effect before it whose constants it shares; "" where it has its own.
    """

    name: str
    terms: tuple[Term, ...]
    driver: str = "constant"
    form: str = "constant"
    constants: tuple[float, ...] = ()
    reference: float = 0.0
    scope: Scope = field(default_factory=Scope)
    amplitudes: tuple[float, ...] = ()
    catalogue_id: str = ""
    spread: float = 0.0
    shares: str = ""

    @property
    def n_columns(self) -> int:
        """Number of amplitudes: terms times bases."""
        return len(self.terms) * len(FORMS[self.form].bases)

    def as_dict(self) -> dict:
        """The effect as a table of recording.toml."""
        terms = [
            {"port": t.port, "driver": t.driver, "basis": t.basis, "weight": float(t.weight)}
            | ({"constants": [float(c) for c in t.constants]} if t.constants else {})
            for t in self.terms
        ]
        return {
            "name": self.name,
            "catalogue_id": self.catalogue_id,
            "spread": float(self.spread),
            "shares": self.shares,
            "terms": terms,
            "driver": self.driver,
            "form": self.form,
            "constants": [float(c) for c in self.constants],
            "reference": float(self.reference),
            "scope": self.scope.as_dict(),
            "amplitudes": [float(a) for a in self.amplitudes] or [0.0] * self.n_columns,
        }

    def with_values(self, amplitudes, constants) -> "Effect":
        """The same effect with estimated amplitudes and constants."""
        return replace(
            self,
            amplitudes=tuple(float(a) for a in amplitudes),
            constants=tuple(float(c) for c in constants),
        )


class Channels(eqx.Module):
    """Time-like drivers on one common grid of times, and how the views of epochs read them.

    Some drivers differ between cameras: each follows the temperature of its own body. Where there
    are such, an epoch has one *view* for each camera (number camera x epochs + epoch), else one.

    Attributes:
        names: channel names; the first is "constant" (all ones).
        time: grid (s).
        values: one row a channel.
        epoch_time: time of each epoch (s).
        reads: row of values that each view reads for a channel [channels, views of an epoch].
        kinds: for each channel "constant", "quantity", "difference" (of two temperatures), "own"
            (each camera's), "time", "order" or "power-on".
    """

    time: Float[Array, " times"]
    values: Float[Array, "channels times"]
    epoch_time: Float[Array, " epochs"]
    reads: Int[Array, "channels cameras"]
    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)

    def view(self, camera, epoch):
        """Number of the view of an epoch by a camera."""
        return epoch + (camera * len(self.epoch_time) if self.reads.shape[1] > 1 else 0)

    def index(self, name: str) -> int:
        """Row of a channel; KeyError with the known names otherwise."""
        if name not in self.names:
            known = ", ".join(self.names)
            raise KeyError(f'there is no driver "{name}" in this recording (it has: {known})')
        return self.names.index(name)


@dataclass(frozen=True)
class Known:
    """What is known of a table before a program is traced.

    Attributes:
        fed: numbers of the ports that it feeds.
        first: the first column of each course.
        kind: program behind the basis of each course.
        course: of each column.
    """

    fed: tuple[int, ...]
    first: tuple[int, ...]
    kind: tuple[int, ...]
    course: tuple[int, ...]


class EffectTable(eqx.Module):
    """A list of effects as arrays. Unused columns have no port and no pattern.

    Where nothing is `known`, a traced program serves all tables of its size: it computes every
    column by every basis and takes the one that the table has, and all ports.
    """

    ports: Float[Array, "columns ports"]
    channel: Int[Array, " columns"]
    basis: Int[Array, " columns"]
    reference: Float[Array, " columns"]
    constant_index: Int[Array, "columns 2"]  # into the constants of the state; the last is unused
    known: Known | None = eqx.field(static=True, default=None)

    def specialised(self) -> "EffectTable":
        """The table for programs of its own: each course is computed once, and no idle port."""
        if not self.n_columns:
            return self
        parts = self.basis, self.channel, self.reference, *np.asarray(self.constant_index).T
        rows = np.stack([np.asarray(part, float) for part in parts], axis=1)
        _, first, course = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        kind = kinds_of(np.asarray(self.basis)[first])
        fed = np.flatnonzero(np.asarray(self.ports).any(axis=0))
        known = Known(*(tuple(part.ravel().tolist()) for part in (fed, first, kind, course)))
        return replace(self, known=known)

    @property
    def n_columns(self) -> int:
        """Capacity of the table, used or not."""
        return self.ports.shape[0]


def tabulate(
    effects: tuple[Effect, ...], channels: Channels, n_columns: int, n_constants: int
) -> tuple[EffectTable, Float[np.ndarray, " columns"], Float[np.ndarray, " constants"]]:
    """Effects as a table of given capacity, with their amplitudes and constants.

    The last constant is always 1 and belongs to nobody: bases without constants read it.
    """
    ports = np.zeros((n_columns, N_PORTS))
    channel = np.zeros(n_columns, int)
    basis = np.zeros(n_columns, int)
    reference = np.zeros(n_columns)
    constant_index = np.full((n_columns, 2), n_constants - 1)
    amplitudes = np.zeros(n_columns)
    constants = np.ones(n_constants)
    column, first_constant = 0, 0
    for effect in effects:
        form = FORMS[effect.form]
        own = [first_constant + k for k in range(len(effect.constants))]
        constants[own] = effect.constants
        given = effect.amplitudes or (0.0,) * effect.n_columns
        start, driver = column, channels.index(effect.driver)
        for term in effect.terms:
            for k, name in enumerate(form.bases):
                read = form.read_by(k, own)
                ports[column, PORT_INDEX[term.port]] = term.weight
                channel[column] = driver
                basis[column] = BASIS_INDEX[name]
                reference[column] = effect.reference if form.centred else 0.0
                constant_index[column, : len(read)] = read
                amplitudes[column] = given[column - start]
                column += 1
        first_constant += len(own)
    parts = map(jnp.asarray, (ports, channel, basis, reference, constant_index))
    table = EffectTable(*parts, known=None)
    return table, amplitudes, constants


def capacity(effects: tuple[Effect, ...]) -> tuple[int, int]:
    """Rounded-up numbers of columns and constants, so that one more effect is no new program."""
    columns = sum(e.n_columns for e in effects)
    constants = sum(len(e.constants) for e in effects)
    if columns == 0:
        return 0, 1
    return 4 * -(-columns // 4), 4 * -(-(constants + 1) // 4)


_STEP = 80
"""Steps in which the room for effects grows where it is wide, in columns."""


def room_for(effects: tuple[Effect, ...], present: tuple[int, int]) -> tuple[int, int]:
    """The present room where the effects fit in, else a much wider one (free-form curves need it).

    Few sizes of room mean few compiled programs; but a very wide model costs more by the room that
    it leaves empty than by another program.
    """
    columns, constants = capacity(effects)
    if columns <= present[0] and constants <= present[1]:
        return present
    wide = min(
        40 << max(-(-columns // 40) - 1, 0).bit_length(), max(160, _STEP * -(-columns // _STEP))
    )
    return wide, max(16 * -(-constants // 16), present[1])


def courses(
    table: EffectTable, constants: Float[Array, " constants"], channels: Channels
) -> Float[Array, "columns views"]:
    """Course of every column at the views. Differentiable in the constants."""
    return _of_columns(_at_epochs, table, constants, channels)


def course_slopes(
    table: EffectTable, constants: Float[Array, " constants"], channels: Channels
) -> Float[Array, "columns views 2"]:
    """Derivative of every column's course with respect to its own two constants."""
    return _of_columns(_slopes, table, constants, channels)


def _of_columns(function, table: EffectTable, constants, channels: Channels) -> Any:
    columns, known = _columns(table, constants), table.known
    if known is None:
        return _in_views(function, *columns, channels)
    first = np.array(known.first)
    basis, channel, reference, values = (part[first] for part in columns)
    found = _in_views(function, basis, channel, reference, values, channels, known.kind)
    return found[np.array(known.course)]


_FEW = 16
"""Courses that are evaluated at once."""


def _columns(table: EffectTable, constants) -> tuple[Any, Any, Any, Any]:
    """Basis, channel, reference and constants of each column."""
    constants, index = hosted(constants, table.constant_index)
    channel, reference = hosted(table.channel, table.reference)
    return table.basis, channel, reference, constants[index]


def evaluate(basis, channel, reference, constants, channels: Channels) -> Float[Array, "n views"]:
    """Courses of many bases at the views.

    Args:
        basis, channel: for each its number [n].
        reference: from which its driver counts [n].
        constants: its constants [n, 2].
        channels: the drivers, and the epochs.
    """
    return _in_views(_at_epochs, basis, channel, reference, constants, channels)


def _in_views(
    function,
    basis,
    channel,
    reference,
    constants,
    channels: Channels,
    kinds: tuple[int, ...] | None = None,
) -> Any:
    """A function of courses at the epochs, for the views of one camera after the other.

    `kinds` are those of the bases, where they are known before a program is traced.
    """
    together = whole(basis, channel, reference, constants, channels.values)
    values, reads = channels.values, channels.reads
    if not together:
        values, reads = hosted(values, reads)

    def of(camera: int, chosen: Any = slice(None)):
        x = values[reads[channel, camera]] - reference[:, None]
        rows = basis[chosen], x[chosen], constants[chosen]
        return _by_kinds(function, rows, channels, kinds)

    found = [of(0)]
    for camera in range(1, reads.shape[1]):
        if together:
            found.append(of(camera))
            continue
        # Most drivers are the same for all cameras.
        changed = np.flatnonzero(reads[channel, camera] != reads[channel, 0])
        own = found[0]
        if len(changed):
            own = np.array(own)
            own[changed] = of(camera, changed)
        found.append(own)
    joined: Any = np if isinstance(found[0], np.ndarray) else jnp
    return found[0] if len(found) == 1 else joined.concatenate(found, axis=1)


def _by_kinds(function, rows, channels: Channels, kinds: tuple[int, ...] | None) -> Any:
    """A function of courses at the epochs, evaluated for those of one kind of basis at once."""
    n, grid = len(channels.epoch_time), (channels.time, channels.epoch_time)
    if whole(rows, grid) or not len(rows[0]):
        if kinds is None:
            return function(rows, *grid)
        places = [np.flatnonzero(np.array(kinds) == kind) for kind in sorted(set(kinds))]
        each = [
            function(tuple(part[own] for part in rows), *grid, kinds=(kinds[own[0]],))
            for own in places
        ]
        return jnp.concatenate(each)[np.argsort(np.concatenate(places))]
    # Spare times: a recording of another length is no other program.
    grid = continued(channels.time), roomy(channels.epoch_time)
    basis, x, constants = map(np.asarray, rows)
    rows, kind = (basis, continued(x), constants), kinds_of(basis)
    found = []
    for own in np.unique(kind):
        of_kind = partial(function, kinds=(int(own),))
        chosen = tuple(part[kind == own] for part in rows)
        found.append(np.asarray(by_blocks(of_kind, chosen, *grid, size=_FEW)))
    order = np.argsort(np.argsort(kind, kind="stable"), kind="stable")
    return np.concatenate(found)[order, :n]


@program
def _at_epochs(rows, time, epoch_time, kinds=EVERY_KIND):
    on_grid = jax.vmap(lambda b, x, c: evaluate_basis(b, x, time, c, kinds))(*rows)
    return jax.vmap(lambda y: jnp.interp(epoch_time, time, y))(on_grid)


@program
def _slopes(rows, time, epoch_time, kinds=EVERY_KIND):
    # One shift for all columns: a column depends on no constant but its own two.
    basis, x, constants = rows
    return jax.jacfwd(lambda by: _at_epochs((basis, x, constants + by), time, epoch_time, kinds))(
        jnp.zeros(2)
    )


def form_of(effect: Effect) -> Form:
    """The form record of an effect."""
    return FORMS[effect.form]
