"""A function of one row over whole tables, number by number.

`jax.vmap` keeps the numbers of a row together: points are [rows, 3], rotations [rows, 3, 3], and on
a processor XLA then loops over rows of tiny matrices, one number at a time. Here every number of a
row is an array of its own over all rows (a structure of arrays), so each operation is one long
vector; a number that rows share is stored once; and what is known to be zero or one when the
program is traced (much of a derivative) is left out. Compiling grows with the number of operations:
it is meant for short functions.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array

Numbers = np.ndarray
"""Array of objects in the shape that one row has: an array over rows, or a known number, each."""


def componentwise(function: Callable, *args, axes: int) -> Any:
    """`function`, vmapped over the leading axes of its arguments, as numbers.

    Args:
        function: of one row; pure, with no traced array in its closure.
        args: PyTrees of arrays; their leading `axes` axes broadcast against each other, so what
            many rows share has length 1 there.
        axes: how many axes count rows.

    Returns:
        A PyTree like that of `function`, of `Numbers`; `joined` makes arrays of them.
    """
    leaves, structure = jax.tree.flatten(args)
    row = [jax.ShapeDtypeStruct(np.shape(leaf)[axes:], leaf.dtype) for leaf in leaves]

    def flat(*row):
        return function(*jax.tree.unflatten(structure, row))

    closed, result = jax.make_jaxpr(flat, return_shape=True)(*row)
    found = _run(closed.jaxpr, closed.consts, [apart(leaf, axes) for leaf in leaves])
    return jax.tree.unflatten(jax.tree.structure(result), settled(found))


def settled(parts: list[Numbers]) -> list[Numbers]:
    """The same numbers, each computed once: XLA computes a number again in every loop that it fuses
    it into."""
    arrays = {id(x): x for own in parts for x in own.ravel() if not is_known(x)}
    once = dict(zip(arrays, jax.lax.optimization_barrier(list(arrays.values())), strict=True))
    return [each(lambda x: once.get(id(x), x), own) for own in parts]


def joined(numbers: Numbers, rows: tuple[int, ...], axis: int) -> Array:
    """One array of numbers, the axes of rows in it from `axis` on.

    Args:
        numbers: of one row.
        rows: lengths of the axes that count rows.
        axis: where in the shape of a row these axes stand.
    """
    full = [jnp.broadcast_to(jnp.asarray(number), rows) for number in numbers.ravel()]
    before, after = numbers.shape[:axis], numbers.shape[axis:]
    if not full:
        return jnp.zeros((*before, *rows, *after))
    stacked = jnp.stack(full, axis=-1 if axis == 0 else 0)
    if axis in (0, numbers.ndim):
        return jnp.reshape(stacked, (*before, *rows, *after))
    stacked = jnp.reshape(stacked, (*before, *after, *rows))
    order = (*range(axis), *range(numbers.ndim, stacked.ndim), *range(axis, numbers.ndim))
    return jnp.transpose(stacked, order)


# --- running a program ---------------------------------------------------------------------------

_CALLS = set(
    "jit pjit closed_call core_call remat checkpoint custom_jvp_call custom_vjp_call".split()
)


def _run(jaxpr, consts, args: list[Numbers]) -> list[Numbers]:
    """Results of a program, its inputs given as numbers."""
    values = dict(zip(jaxpr.invars, args, strict=True))
    values |= {v: _objects(np.asarray(c)) for v, c in zip(jaxpr.constvars, consts, strict=True)}

    def read(variable):
        if isinstance(variable, core.Literal):
            return _objects(np.asarray(variable.val))
        return values[variable]

    for equation in jaxpr.eqns:
        found = _applied(jaxpr, equation, [read(v) for v in equation.invars])
        values.update(zip(equation.outvars, found, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _applied(jaxpr, equation, inputs: list[Numbers]) -> list[Numbers]:
    """Results of one operation of a program."""
    primitive, params = equation.primitive, equation.params
    name = primitive.name
    if name in _CALLS:
        inner = params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"]
        closed = inner if hasattr(inner, "jaxpr") else core.ClosedJaxpr(inner, ())
        return _run(closed.jaxpr, closed.consts, inputs)
    if name in _MOVES:
        found = _MOVES[name](*inputs, **params)
        return list(found) if primitive.multiple_results else [found]
    if all(is_known(x) for own in inputs for x in own.ravel()):
        return _known(jaxpr, equation, inputs)
    if name in _RULES:
        return [_RULES[name](*inputs, **params)]
    if name in _ELEMENTWISE:
        return [each(functools.partial(_one, primitive, params), *inputs)]
    if name in _INDEXED and all(map(is_known, inputs[1].ravel())):
        return [_indexed(equation, inputs)]
    return _by_rows(jaxpr, equation, inputs)


def _known(jaxpr, equation, inputs: list[Numbers]) -> list[Numbers]:
    """Results of an operation on known numbers: computed once, while the program is traced."""
    with jax.ensure_compile_time_eval():
        values = [_array(x, v) for x, v in zip(inputs, equation.invars, strict=True)]
        return [_objects(np.asarray(part)) for part in _alone(jaxpr, equation, values)]


def _by_rows(jaxpr, equation, inputs: list[Numbers]) -> list[Numbers]:
    """Any operation, vmapped over rows as usual."""
    rows = np.broadcast_shapes(*(np.shape(x) for own in inputs for x in own.ravel()))

    def function(*row):
        return _alone(jaxpr, equation, row)

    for _ in rows:
        function = jax.vmap(function)
    both = zip(inputs, equation.invars, strict=True)
    whole = [joined(own, rows, 0).astype(variable.aval.dtype) for own, variable in both]
    return [apart(part, len(rows)) for part in function(*whole)]


def _alone(jaxpr, equation, values) -> list[Array]:
    """An operation of a program as JAX does it; what is written into the program stays there."""
    both = zip(equation.invars, values, strict=True)
    given = {v: value for v, value in both if not isinstance(v, core.Literal)}
    own = jaxpr.replace(constvars=[], invars=list(given), outvars=equation.outvars, eqns=[equation])
    return core.jaxpr_as_fun(core.ClosedJaxpr(own, ()))(*given.values())


# --- numbers -------------------------------------------------------------------------------------


def _objects(array: np.ndarray) -> Numbers:
    """Known numbers."""
    found = np.empty(array.shape, object)
    for at in np.ndindex(*array.shape):
        found[at] = array[at]
    return found


def apart(array, axes: int) -> Numbers:
    """An array over rows, number by number."""
    shape = np.shape(array)[axes:]
    flat = jnp.reshape(array, (*np.shape(array)[:axes], math.prod(shape)))
    found = np.empty(math.prod(shape), object)
    for k in range(found.size):
        found[k] = flat[..., k]
    return found.reshape(shape)


def _array(numbers: Numbers, variable) -> Array:
    """Known numbers as an array."""
    flat = np.array(numbers.ravel().tolist(), variable.aval.dtype)
    return jnp.asarray(flat.reshape(numbers.shape))


def is_known(x) -> bool:
    """Whether a number is known while the program is traced."""
    return isinstance(x, np.generic)


def _is(x, value: float) -> bool:
    return is_known(x) and bool(x == value)


def each(function: Callable, *inputs: Numbers) -> Numbers:
    """A function of single numbers, for each of them; shapes broadcast."""
    shape = np.broadcast_shapes(*(own.shape for own in inputs))
    inputs = tuple(np.broadcast_to(own, shape) for own in inputs)
    found = np.empty(shape, object)
    for at in np.ndindex(*shape):
        found[at] = function(*(own[at] for own in inputs))
    return found


def _one(primitive, params, *numbers):
    """An operation on single numbers."""
    rows = np.broadcast_shapes(*map(np.shape, numbers))
    return primitive.bind(*(jnp.broadcast_to(jnp.asarray(x), rows) for x in numbers), **params)


def _sum(a, b):
    return b if _is(a, 0.0) else a if _is(b, 0.0) else a + b


def _difference(a, b):
    return a if _is(b, 0.0) else -b if _is(a, 0.0) else a - b


def product(a, b):
    """Product of two numbers."""
    for x, y in ((a, b), (b, a)):
        if _is(x, 0.0):
            return np.float64(0.0)
        if _is(x, 1.0):
            return y
        if _is(x, -1.0):
            return -y
    return a * b


def total(numbers) -> Any:
    """Sum of numbers."""
    return functools.reduce(_sum, numbers, np.float64(0.0))


def matmul(a: Numbers, b: Numbers) -> Numbers:
    """Product of two matrices of numbers."""
    found = np.empty((len(a), b.shape[1]), object)
    for i, j in np.ndindex(*found.shape):
        found[i, j] = total(map(product, a[i], b[:, j]))
    return found


# --- operations ----------------------------------------------------------------------------------


def _dot_general(a: Numbers, b: Numbers, *, dimension_numbers, **_) -> Numbers:
    (over_a, over_b), (batch_a, batch_b) = dimension_numbers
    free_a = [k for k in range(a.ndim) if k not in (*over_a, *batch_a)]
    free_b = [k for k in range(b.ndim) if k not in (*over_b, *batch_b)]
    left, right = a.transpose(*batch_a, *free_a, *over_a), b.transpose(*batch_b, *free_b, *over_b)
    batch = left.shape[: len(batch_a)]
    rows = left.shape[len(batch) : len(batch) + len(free_a)]
    columns = right.shape[len(batch) : len(batch) + len(free_b)]
    left = left.reshape((*batch, math.prod(rows), -1))
    right = right.reshape((*batch, math.prod(columns), -1))
    found = np.empty((*batch, left.shape[-2], right.shape[-2]), object)
    for k in np.ndindex(*batch):
        found[k] = matmul(left[k], right[k].T)
    return found.reshape((*batch, *rows, *columns))


def _reduce_sum(x: Numbers, *, axes, **_) -> Numbers:
    kept = [k for k in range(x.ndim) if k not in axes]
    rows = x.transpose(*kept, *axes).reshape((*(x.shape[k] for k in kept), -1))
    found = np.empty(rows.shape[:-1], object)
    for at in np.ndindex(*found.shape):
        found[at] = total(rows[at])
    return found


def _integer_pow(x: Numbers, *, y: int) -> Numbers:
    if not 0 <= y <= 8:
        return each(lambda v: v**y if is_known(v) else jax.lax.integer_pow(v, y), x)
    return each(lambda v: functools.reduce(product, [v] * y, np.float64(1.0)), x)


def _select_n(which: Numbers, *cases: Numbers) -> Numbers:
    def one(which, *cases):
        if is_known(which):
            return cases[int(which)]
        if len(cases) == 2 and all(is_known(c) for c in cases) and cases[0] == cases[1]:
            return cases[0]
        rows = np.broadcast_shapes(np.shape(which), *map(np.shape, cases))
        like = [jnp.broadcast_to(jnp.asarray(c), rows) for c in cases]
        return jax.lax.select_n(jnp.broadcast_to(which, rows), *like)

    return each(one, np.broadcast_to(which, cases[0].shape), *cases)


def _broadcast(x: Numbers, *, shape, broadcast_dimensions, **_) -> Numbers:
    own = [1] * len(shape)
    for k, at in enumerate(broadcast_dimensions):
        own[at] = x.shape[k]
    return np.broadcast_to(x.reshape(own), shape)


def _slice(x: Numbers, *, start_indices, limit_indices, strides) -> Numbers:
    steps = strides or (1,) * x.ndim
    ends = zip(start_indices, limit_indices, steps, strict=True)
    return x[tuple(slice(a, b, c) for a, b, c in ends)]


def _pad(x: Numbers, filling: Numbers, *, padding_config) -> Numbers:
    """Edges of known widths, also between numbers and less than none."""
    for axis, (low, high, inner) in enumerate(padding_config):
        n = x.shape[axis]
        long = max(n + max(n - 1, 0) * inner + low + high, 0)
        place = low + np.arange(n) * (inner + 1)
        inside = (place >= 0) & (place < long)
        own = np.empty((*x.shape[:axis], long, *x.shape[axis + 1 :]), object)
        own[...] = filling
        np.moveaxis(own, axis, 0)[place[inside]] = np.moveaxis(x, axis, 0)[inside]
        x = own
    return x


def _indexed(equation, inputs: list[Numbers]) -> Numbers:
    """A gather or scatter at known indices: it tells where each number goes, or comes from."""
    moved = [own for k, own in enumerate(inputs) if k != 1]
    flat = [x for own in moved for x in own.ravel()]
    params = dict(equation.params)
    with jax.ensure_compile_time_eval():
        index = _array(inputs[1], equation.invars[1])
        first = np.cumsum([0, *(own.size for own in moved)])
        places = [
            jnp.arange(k, k + own.size).reshape(own.shape)
            for k, own in zip(first, moved, strict=False)
        ]
        place = np.asarray(equation.primitive.bind(places[0], index, *places[1:], **params))
    found = np.empty(place.shape, object)
    for at in np.ndindex(*place.shape):
        found[at] = flat[place[at]]
    return found


_MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *parts, dimension: np.concatenate(parts, axis=dimension),
    "copy": lambda x: x,
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, dimensions),
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "pad": _pad,
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "slice": _slice,
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "split": lambda x, *, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis=axis),
    "stack": lambda *parts, axis, **_: np.stack(parts, axis=axis),
    "stop_gradient": lambda x: x,
    "transpose": lambda x, *, permutation: x.transpose(permutation),
    "unstack": lambda x, *, axis, **_: [
        part.squeeze(axis) for part in np.split(x, x.shape[axis], axis)
    ],
}

_RULES: dict[str, Callable] = {
    "add": lambda a, b, **_: each(_sum, a, b),
    "add_any": lambda a, b, **_: each(_sum, a, b),
    "dot_general": _dot_general,
    "integer_pow": _integer_pow,
    "mul": lambda a, b, **_: each(product, a, b),
    "neg": lambda x, **_: each(lambda v: -v, x),
    "reduce_sum": _reduce_sum,
    "select_n": _select_n,
    "square": lambda x, **_: each(lambda v: product(v, v), x),
    "sub": lambda a, b, **_: each(_difference, a, b),
}

_INDEXED = {"gather", "scatter"}

_ELEMENTWISE = set(
    "abs acos acosh and asin asinh atan atan2 atanh cbrt ceil convert_element_type cos cosh div eq "
    "erf exp exp2 expm1 floor ge gt is_finite le log log1p logistic lt max min ne not or pow rem "
    "round rsqrt sign sin sinh sqrt tan tanh xor".split()
)
