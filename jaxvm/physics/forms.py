"""Forms: how a driver becomes the course of an effect.

A *basis* is one function of a driver's course x over times t, with up to two constants. A *form* is
one or several bases that share their constants: a periodic effect is a sine and a cosine of one
period. Everything is written for one course; tables of effects `vmap` over it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

T = TypeVar("T")
Course = Float[Array, " times"]
Constants = Float[Array, "2"]


def first_order_lag(x: Course, t: Course, tau: Float[Array, ""]) -> Course:
    """Course of tau dy/dt + y = x, in equilibrium at the first sample.

    Exact for a driver that is linear between samples (first-order hold), whatever the sampling:
    y1 = a y0 + (1-a) x0 + (x1-x0) (1 - (1-a) tau/dt), a = exp(-dt/tau) (MATHEMATICS 1.5).
    """
    dt = jnp.diff(t)
    rest = -jnp.expm1(-dt / tau)
    drive = rest * x[:-1] + jnp.diff(x) * (1.0 - rest * tau / dt)

    def step(y, inputs):
        rest_k, drive_k = inputs
        y = (1.0 - rest_k) * y + drive_k
        return y, y

    _, rest_of_course = jax.lax.scan(step, x[0], (rest, drive))
    return jnp.concatenate([x[:1], rest_of_course])


def delayed(x: Course, t: Course, dead_time: Float[Array, ""]) -> Course:
    """Course of y(t) = x(t - dead time), at rest before the first sample."""
    return cast(Array, jnp.interp(t - dead_time, t, x))


def play(x: Course, half_width: Float[Array, ""], first: ArrayLike = 1.0) -> Course:
    """Play (backlash) operator of Prandtl and Ishlinskii: follows x with free travel either way.

    What was before the recording decides where in its travel the contact is at the first sample:
    `first` is 1 in the middle, 0 at the lower end (x was rising), 2 at the upper one.
    """

    def step(y, x_k):
        y = jnp.clip(y, x_k - half_width, x_k + half_width)
        return y, y

    # Where the contact has left its first place nothing depends on it: no refit moves it.
    start = x[0] + (jax.lax.stop_gradient(jnp.asarray(first)) - 1.0) * half_width
    return jax.lax.scan(step, start, x)[1]


def rate(x: Course, t: Course) -> Course:
    """Rate of change of x (driver's unit per hour), by central differences."""
    return cast(Array, jnp.gradient(x, t / 3600.0))


def bump(x: Course, centre: Float[Array, ""], width: Float[Array, ""]) -> Course:
    """Cubic B-spline of knot distance `width` about `centre`; bumps on a regular grid sum to 1."""
    s = jnp.abs((x - centre) / width)
    inner = 2.0 / 3.0 - s**2 + 0.5 * s**3
    outer = (2.0 - s) ** 3 / 6.0
    return jnp.where(s < 1.0, inner, jnp.where(s < 2.0, outer, 0.0))


def _angle(t: Course, period: Float[Array, ""]) -> Course:
    """Angle (rad) by which a direction has turned since the beginning."""
    return 2.0 * jnp.pi * (t - t[0]) / period


N_KNOTS = {"curve": 12, "fine curve": 30}
"""Cubic B-splines of a free-form curve, and of one that follows faster changes."""

_MOST_KNOTS = max(N_KNOTS.values())


def _knot(k: int):
    """The k-th B-spline of a free-form curve; the constants are its first knot and the spacing."""
    return lambda x, t, c: bump(x, c[0] + k * c[1], c[1])


BASES: dict[str, Callable[[Course, Course, Constants], Course]] = {
    "one": lambda x, t, c: jnp.ones_like(x),
    "linear": lambda x, t, c: x,
    "square": lambda x, t, c: x**2,
    "cube": lambda x, t, c: x**3,
    "fourth": lambda x, t, c: x**4,
    "sixth": lambda x, t, c: x**6,
    "lag": lambda x, t, c: first_order_lag(x, t, c[0]),
    "delayed": lambda x, t, c: delayed(x, t, c[0]),
    "first state": lambda x, t, c: jnp.exp(-(t - t[0]) / c[0]),
    "rate": lambda x, t, c: rate(x, t),
    "aged": lambda x, t, c: x * (t - t[0]) / 3600.0,
    "direction": lambda x, t, c: jnp.tanh(rate(first_order_lag(x, t, c[1]), t) / c[0]),
    "play": lambda x, t, c: play(x, c[0], c[1]) - x,
    "onset": lambda x, t, c: -jnp.expm1(-jnp.maximum(x, 0.0) / c[0]),
    "log": lambda x, t, c: jnp.log1p(jnp.maximum(x, 0.0) / c[0]),
    "step": lambda x, t, c: jnp.where(x >= c[0], 1.0, 0.0),
    "ramp": lambda x, t, c: jnp.maximum(x - c[0], 0.0),
    "decay": lambda x, t, c: jnp.exp(-jnp.maximum(x, 0.0) / c[0]),
    "staircase": lambda x, t, c: c[0] * (jnp.round(x / c[0] - c[1]) + c[1]),
    "doubling": lambda x, t, c: jnp.exp2(jnp.clip(x / c[0], -30.0, 30.0)),
    "turned": lambda x, t, c: first_order_lag(x, t, c[1]) * jnp.cos(_angle(t, c[0])),
    "turned aside": lambda x, t, c: first_order_lag(x, t, c[1]) * jnp.sin(_angle(t, c[0])),
    "sine": lambda x, t, c: jnp.sin(2.0 * jnp.pi * x / c[0]),
    "cosine": lambda x, t, c: jnp.cos(2.0 * jnp.pi * x / c[0]),
    "transient": lambda x, t, c: x - first_order_lag(x, t, c[0]),
    "late onset": lambda x, t, c: -jnp.expm1(-jnp.maximum(x - c[0], 0.0) / jnp.maximum(c[1], 1e-9)),
    "bump": lambda x, t, c: bump(x, c[0], c[1]),
    **{f"knot {k}": _knot(k) for k in range(_MOST_KNOTS)},
}
"""All bases by name. Those that use `t` remember the past and apply to time courses only."""

_PLACED = ("step", "ramp", "late onset", "bump", "play", *(f"knot {k}" for k in range(_MOST_KNOTS)))

BASIS_INDEX = {name: index for index, name in enumerate(BASES)}

_BUMP = BASIS_INDEX["bump"]
"""The last basis but for the knots, which are bumps with a place of their own."""


EVERY_KIND = tuple(range(_BUMP + 1))


def kinds_of(basis: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """The programs behind numbers of bases: all knots are bumps."""
    return np.minimum(basis, _BUMP)


def evaluate_basis(
    basis: Int[Array, ""],
    x: Course,
    t: Course,
    constants: Constants,
    kinds: tuple[int, ...] = EVERY_KIND,
) -> Float[Array, " times"]:
    """Course of the basis with number `basis`; the number is data, so nothing is recompiled.

    Only the `kinds` of bases that may occur are computed; the others give something else.
    """
    knot = jnp.maximum(basis - _BUMP - 1, 0)
    placed = jnp.stack([constants[0] + knot * constants[1], constants[1]])
    # Bases that are computed along and thrown away must not divide by an instant at zero, and an
    # optimiser that steps to a negative time constant meets the limit of a very short one.
    positive = jnp.maximum(constants, 1e-9)
    names = [list(BASES)[kind] for kind in kinds]
    each = [BASES[name](x, t, placed if name in _PLACED else positive) for name in names]
    place = jnp.searchsorted(jnp.asarray(kinds), jnp.minimum(basis, _BUMP))
    return each[0] if len(each) == 1 else jnp.stack(each)[place]


@dataclass(frozen=True)
class Constant:
    """A nonlinear constant of a form: its name, unit, and the range it may take."""

    name: str
    unit: str
    refined: bool = True
    """Whether a refit may move it (a step's instant has no derivative)."""


@dataclass(frozen=True)
class Form:
    """A named form: its bases, its constants, and how it reads in a sentence."""

    name: str
    bases: tuple[str, ...]
    constants: tuple[Constant, ...]
    words: str
    centred: bool = False
    """Whether the driver is counted from its reference value (its mean over the recording)."""
    reads: tuple[int, ...] = ()
    """Of each basis the first constant that it reads; by default that of the form."""
    more_of: str = ""
    """Another form of which this has several at once: what may run in that may run in this."""
    one_course: bool = False
    """Whether its bases make up one course (a lag and its first state), by which whatever moves
    does so along one line; a vibration goes round, and every jump has a way of its own."""
    sized_by: tuple[str, ...] = ()
    """Bases whose amplitudes together are the size of an effect, for a unit of its driver; by
    default those of the first one's name. What it is at a driver of zero is no size."""

    def read_by(self, basis: int, constants: Sequence[T]) -> Sequence[T]:
        """Those constants of the form, one or two, that one of its bases reads."""
        first = self.reads[basis] if self.reads else 0
        return constants[first : first + 2]

    @property
    def single(self) -> str:
        """The form itself, or that of which it has several."""
        return self.more_of or self.name

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the bases; one that occurs again is told by its constant: "slow lag"."""
        firsts = self.reads or (0,) * len(self.bases)
        again = (f"{self.constants[k].name.split()[0]} " if k else "" for k in firsts)
        return tuple(own + basis for own, basis in zip(again, self.bases, strict=True))


_TAU = Constant("time constant", "s")
_INSTANTS = tuple(
    Constant(name, "s", refined=False)
    for name in ("instant", "second instant", "third instant", "fourth instant")
)

JUMPS = {n: f"{n} jumps" for n in range(2, len(_INSTANTS) + 1)}
"""Forms of what stands still between several jumps, by their number."""

FORMS: dict[str, Form] = {
    form.name: form
    for form in (
        Form("constant", ("one",), (), "always the same"),
        Form("linear", ("linear",), (), "in proportion to {driver}", centred=True),
        Form(
            "affine",
            ("one", "linear"),
            (),
            "in proportion to {driver}, from a reference of its own",
            one_course=True,
            sized_by=("linear",),
        ),
        Form(
            "affine lag",
            ("one", "lag"),
            (_TAU,),
            "following {driver} with a lag, from a reference of its own",
            centred=True,
            one_course=True,
            sized_by=("lag",),
        ),
        Form(
            "parabola",
            ("one", "linear", "square"),
            (),
            "as a parabola of {driver}, from a reference of its own",
            centred=True,
            one_course=True,
            sized_by=("linear",),
        ),
        Form(
            "quadratic",
            ("linear", "square"),
            (),
            "as a parabola of {driver}",
            centred=True,
            one_course=True,
        ),
        Form("lag", ("lag",), (_TAU,), "following {driver} with a lag", centred=True),
        Form(
            "lag with state",
            ("lag", "first state"),
            (_TAU,),
            "following {driver} with a lag, from a state of its own at first",
            centred=True,
            one_course=True,
        ),
        Form(
            "delay",
            ("delayed",),
            (Constant("dead time", "s"),),
            "following {driver} after a dead time",
            centred=True,
        ),
        Form("first state", ("first state",), (_TAU,), "fading from where it was at first"),
        Form(
            "two lags",
            ("lag", "lag"),
            (_TAU, Constant("slow time constant", "s")),
            "following {driver} with two time constants",
            centred=True,
            reads=(0, 1),
            one_course=True,
        ),
        Form("proportional", ("linear",), (), "in proportion to {driver} itself"),
        Form("square", ("square",), (), "in proportion to the square of {driver} itself"),
        Form(
            "ageing",
            ("linear", "aged"),
            (),
            "in proportion to {driver}, more or less so as time goes on",
            centred=True,
            one_course=True,
        ),
        Form("rate", ("rate",), (), "in proportion to the rate of {driver}"),
        Form(
            "transient",
            ("transient",),
            (_TAU,),
            "as far as {driver} is ahead of its own lag",
        ),
        Form(
            "transient with state",
            ("transient", "first state"),
            (_TAU,),
            "as far as {driver} is ahead of its own lag, from a state of its own at first",
            one_course=True,
        ),
        Form(
            "direction",
            ("direction",),
            (Constant("rate of half play", "driver/h"), _TAU),
            "with the direction in which {driver} moves",
        ),
        Form(
            "hysteresis",
            ("linear", "play"),
            (Constant("half play", "driver"),),
            "with {driver} and with backlash",
            centred=True,
            one_course=True,
            sized_by=("linear", "play"),
        ),
        Form(
            "hysteresis with state",
            ("linear", "play"),
            (Constant("half play", "driver"), Constant("first contact", "1", refined=False)),
            "with {driver} and with backlash, from a contact of its own at first",
            centred=True,
            one_course=True,
            sized_by=("linear", "play"),
        ),
        Form("onset", ("onset",), (_TAU,), "settling exponentially with {driver}"),
        Form("fading", ("decay",), (_TAU,), "fading exponentially with {driver}"),
        Form(
            "two decays",
            ("decay", "decay"),
            (_TAU, Constant("slow time constant", "s")),
            "fading with two time constants of {driver}",
            reads=(0, 1),
            one_course=True,
        ),
        Form(
            "doubling",
            ("doubling",),
            (Constant("doubling", "driver"),),
            "doubling again and again with {driver}",
            centred=True,
        ),
        Form(
            "turning",
            ("turned", "turned aside"),
            (Constant("period", "s"), _TAU),
            "following {driver} with a lag, from a direction that turns",
            centred=True,
            sized_by=("turned", "turned aside"),
        ),
        Form(
            "staircase",
            ("staircase",),
            (Constant("step", "driver", refined=False), Constant("phase", "1", refined=False)),
            "in steps of {driver}",
            centred=True,
        ),
        Form("creep", ("log",), (_TAU,), "creeping with the logarithm of {driver}"),
        Form("step", ("step",), _INSTANTS[:1], "suddenly, in {driver}"),
        *(
            Form(
                name,
                n * ("step",),
                _INSTANTS[:n],
                f"suddenly, {n} times in {{driver}}",
                reads=tuple(range(n)),
                more_of="step",
            )
            for n, name in JUMPS.items()
        ),
        Form(
            "settling",
            ("late onset",),
            (Constant("start", "s"), _TAU),
            "settling exponentially from a moment in {driver} on",
        ),
        Form("ramp", ("ramp",), (Constant("start", "s"),), "steadily from a moment in {driver} on"),
        Form(
            "periodic",
            ("sine", "cosine"),
            (Constant("period", "driver"),),
            "periodically in {driver}",
            sized_by=("sine", "cosine"),
        ),
        *(
            Form(
                name,
                tuple(f"knot {k}" for k in range(n)),
                (
                    Constant("first knot", "driver", refined=False),
                    Constant("knot spacing", "driver", refined=False),
                ),
                "in a free-form curve of {driver}",
            )
            for name, n in N_KNOTS.items()
        ),
    )
}
"""The forms of time-like drivers, by name."""
