"""Trials: what a Monte Carlo study does again and again, as a pure function of a random key.

A study draws a truth and measurements, estimates, and compares. One that JAX can trace is computed
in batches under `vmap` on all devices (`Traced`). Others run on the host: of one that computes many
trials together (`Together`), or any function of a key, called for one trial after the other
(`OneByOne`).
"""

import hashlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

AXIS = "trials"
"""Name of the mesh axis over which trials are shared out."""


class Trial(NamedTuple):
    """What one trial found; or many, stacked.

    Attributes:
        error: estimate minus truth of each quantity, in its unit.
        converged: whether the estimate is one. Trials that failed are kept, but don't count.
        sigma: standard deviations foretold for quantities, by name; may be left out.
        noted: anything else: a cost, a number of evaluations.
    """

    error: Mapping[str, Float[ArrayLike, "*t m"]]
    converged: Bool[ArrayLike, "*t"] | bool = True
    sigma: Mapping[str, Float[ArrayLike, "*t m"]] = {}
    noted: Mapping[str, Float[ArrayLike, "*t"]] = {}


class Study(Protocol):
    """What can be run many times (`jaxvm.montecarlo.run`)."""

    def about(self) -> dict[str, Any]:
        """What makes it this study and no other, for a file."""
        ...

    def batch(self, key: PRNGKeyArray, numbers: Int[np.ndarray, " t"], mesh: Mesh | None) -> Trial:
        """Trials of these numbers, stacked; trial k draws from `jax.random.fold_in(key, k)`."""
        ...


class Traced(eqx.Module):
    """A study whose trial JAX can trace.

    Attributes:
        trial: of a key; a PyTree that is called, or a function.
        told: what it is, for a file.
        single: whether it is computed in single precision (`in_single_precision`).
    """

    trial: Callable[[PRNGKeyArray], Trial]
    told: dict[str, Any] = eqx.field(static=True, default_factory=dict)
    single: bool = eqx.field(static=True, default=False)

    def about(self) -> dict[str, Any]:
        return self.told | ({"precision": "float32"} if self.single else {})

    @property
    def own_bytes(self) -> int:
        """Bytes of the numbers that every trial reads."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(eqx.filter(self.trial, eqx.is_array)))

    def in_single_precision(self) -> "Traced":
        """The same study in float32, for accelerators that are many times as fast in it.

        Safe where errors are far above 1e-7 of the numbers that they are errors of: single poses
        (a pixel of 2,000 is rounded by 1e-4), not the normal equations of long chains. It draws
        other random numbers than in float64.
        """

        def cast(leaf):
            if not eqx.is_array(leaf) or jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                return leaf
            kind = np.asarray(leaf).dtype.kind
            wanted = {"f": np.float32, "i": np.int32, "u": np.uint32}.get(kind)
            return np.asarray(leaf) if wanted is None else np.asarray(leaf, wanted)

        return Traced(jax.tree.map(cast, self.trial), self.told, True)

    def batch(self, key, numbers, mesh=None) -> Trial:
        if self.single:
            # Accelerators multiply float32 in three digits (TF32, bfloat16) unless told not to.
            with jax.enable_x64(False), jax.default_matmul_precision("highest"):
                return self._batch(key, numbers.astype(np.int32), mesh)
        return self._batch(key, numbers, mesh)

    def _batch(self, key, numbers, mesh) -> Trial:
        if mesh is None:
            return _batch(self.trial, key, numbers)
        whole, own = (jax.NamedSharding(mesh, PartitionSpec(*axes)) for axes in ((), (AXIS,)))
        key = jax.random.wrap_key_data(
            _placed(np.asarray(jax.random.key_data(key)), whole), impl=jax.random.key_impl(key)
        )
        arrays, rest = eqx.partition(self.trial, eqx.is_array)
        arrays = jax.tree.map(lambda leaf: _placed(np.asarray(leaf), whole), arrays)
        return _on_mesh(eqx.combine(arrays, rest), key, _placed(numbers, own), mesh)


def name_of(function: Callable) -> str:
    """Name of a function, or of the class of anything else that is called."""
    return getattr(function, "__qualname__", type(function).__qualname__)


def fingerprint(tree: Any, words: Any = None) -> str:
    """Hash of all numbers of a trial, or of what else makes one: other sigmas are another.

    `words` are what has no arrays: tuples of names and numbers.
    """
    found = hashlib.sha256(b"" if words is None else repr(words).encode())
    for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)):
        found.update(str(leaf.shape).encode() + np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()[:16]


def _placed(values: np.ndarray, sharding) -> Array:
    """On the devices of all processes; each process has all the values."""
    return jax.make_array_from_callback(values.shape, sharding, lambda index: values[index])


def _all(trial, key, numbers) -> Trial:
    return jax.vmap(lambda number: _sound(trial(jax.random.fold_in(key, number))))(numbers)


_batch = eqx.filter_jit(_all)


@eqx.filter_jit
def _on_mesh(trial, key, numbers, mesh: Mesh) -> Trial:
    """Every device takes its share, and no step of a trial waits for another device."""
    arrays, rest = eqx.partition(trial, eqx.is_array)

    def share(arrays, key, numbers):
        return _all(eqx.combine(arrays, rest), key, numbers)

    own, whole = PartitionSpec(AXIS), PartitionSpec()
    shared = jax.shard_map(
        share, mesh=mesh, in_specs=(whole, whole, own), out_specs=own, check_vma=False
    )
    return shared(arrays, key, numbers)


def _sound(found: Any) -> Trial:
    """What a trial returned, as a `Trial` of flat arrays."""
    if not isinstance(found, Trial):
        found = Trial(found if isinstance(found, Mapping) else {"error": found})
    flat = {name: jnp.ravel(jnp.asarray(e, float)) for name, e in found.error.items()}
    sigma = {name: jnp.ravel(jnp.asarray(s, float)) for name, s in found.sigma.items()}
    noted = {name: jnp.asarray(value) for name, value in found.noted.items()}
    for name, own in sigma.items():
        if name not in flat or own.shape != flat[name].shape:
            raise ValueError(f'a trial foretells sigmas of "{name}", but has no such errors')
    for name, value in noted.items():
        if value.ndim:
            raise ValueError(f'"{name}" of a trial is an array of shape {value.shape}, no number')
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(e)) for e in flat.values()]))
    return Trial(flat, jnp.asarray(found.converged) & finite, sigma, noted)


class Together:
    """A study of a function that computes many trials together, on the host.

    Attributes:
        trials: from the keys of some trials to these trials, stacked.
        told: what it is, for a file.
        together: trials of a batch, unless it is given.
    """

    def __init__(
        self, trials: Callable[[PRNGKeyArray], Trial], told: dict[str, Any], together: int
    ):
        self.trials, self.told, self.together = trials, told, together

    def about(self) -> dict[str, Any]:
        return self.told

    def batch(self, key, numbers, mesh=None) -> Trial:
        del mesh
        found = self.trials(jax.vmap(partial(jax.random.fold_in, key))(numbers))
        return jax.tree.map(np.asarray, jax.vmap(_sound)(found))


class OneByOne:
    """A study of any function of a key, called for one trial after the other on the host.

    A trial that raises one of `failures` counts as one that did not converge.
    """

    together = 4
    """Trials of a batch, unless it is given: each may take long."""

    def __init__(
        self,
        trial: Callable[[PRNGKeyArray], Trial],
        told: dict[str, Any] | None = None,
        failures: tuple[type[Exception], ...] = (ArithmeticError, np.linalg.LinAlgError),
    ):
        self.trial, self.told, self.failures = trial, told or {}, failures
        self._like: Trial | None = None

    def about(self) -> dict[str, Any]:
        return self.told

    def batch(self, key, numbers, mesh=None) -> Trial:
        """Trials of these numbers; ValueError where not one of the very first ones succeeds."""
        del mesh
        found: list[Trial | None] = []
        why: Exception | None = None
        for number in numbers:
            try:
                found.append(_sound(self.trial(jax.random.fold_in(key, int(number)))))
            except self.failures as error:
                found.append(None)
                why = error
        self._like = next((one for one in found if one is not None), self._like)
        if self._like is None:
            raise ValueError(f"all of the first {len(numbers)} trials failed: {why}") from why
        none = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan, float), self._like)
        none = none._replace(converged=np.array(False))
        each = [none if one is None else one for one in found]
        return jax.tree.map(lambda *parts: np.stack([np.asarray(part) for part in parts]), *each)
