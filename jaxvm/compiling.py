"""Compiled programs: kept ready to be called from process to process, counted, and forgotten.

JAX's cache on disk keeps what the compiler makes of a program; each process still traces and lowers
every program before it can ask for it, which takes longer than to run most of them. A `program`
keeps the executable, and under what it is asked for: function, structure of the arguments, sources
of this package, configuration of JAX, machine. A second process calls it at once.
"""

import dataclasses
import functools
import hashlib
import os
import pickle
import platform
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.monitoring
import jaxlib
import lineax
import numpy as np
import optimistix
from jax.core import Tracer
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

P = ParamSpec("P")
R = TypeVar("R")

_OURS = frozenset(
    "jaxvm jax jaxlib equinox optimistix lineax numpy builtins collections functools".split()
)
"""Packages whose functions and types are told by their names: `_context` tells their sources.

What the function of a user does may be another thing tomorrow, under the same name.
"""

_everything: list["program"] = []
_alone = threading.Lock()  # one thread at a time goes without JAX's cache


class program(Generic[P, R]):  # noqa: N801 (a decorator)
    """As `equinox.filter_jit`, and the executable is kept for other processes.

    Arrays are arguments of the program, all else is static. It is kept on the CPU of one device,
    where all that is static is known by name (no functions of users, whose meaning may change, and
    no local ones); under a transformation of JAX, and elsewhere, this is `equinox.filter_jit`
    itself. JAX_ENABLE_COMPILATION_CACHE=false keeps nothing.
    """

    def __init__(self, function: Callable[P, R]):
        self._function = function
        self._name = f"{function.__module__}:{function.__qualname__}"
        self._traced = eqx.filter_jit(function)
        self._ready: dict = {}
        functools.update_wrapper(self, function)
        _everything.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        leaves, structure = jax.tree.flatten((args, kwargs))
        return self.of_leaves(leaves, structure)

    def of_leaves(self, leaves: list, structure) -> R:
        """The result for arguments and keywords that are taken apart: `jax.tree.flatten`."""
        settings: Any = jax.config
        if settings.jax_disable_jit or settings.jax_debug_nans:
            return self._by_jax(leaves, structure)
        arrays, key = [], [structure, settings.jax_enable_x64]
        for leaf in leaves:
            if isinstance(leaf, Tracer):
                return self._by_jax(leaves, structure)
            if isinstance(leaf, jax.Array):
                arrays.append(leaf)
                key.append((leaf.shape, leaf.dtype, leaf.weak_type))
            elif isinstance(leaf, np.ndarray | np.generic):
                arrays.append(leaf)
                key.append((leaf.shape, leaf.dtype, False))
            else:
                # 1, 1.0 and True are equal, and are different programs.
                key.append((type(leaf), leaf))
        key = tuple(key)
        ready = self._ready.get(key)
        if ready is None:
            ready = self._ready[key] = self._made_ready(structure, leaves, key)
        if ready == "traced":
            return self._by_jax(leaves, structure)
        executable, result, others = ready
        found = iter(executable(*arrays))
        return jax.tree.unflatten(result, [next(found) if o is ... else o for o in others])

    def _by_jax(self, leaves: list, structure) -> R:
        args, kwargs = jax.tree.unflatten(structure, leaves)
        traced: Any = self._traced
        return traced(*args, **kwargs)

    def __get__(self, instance, owner=None):
        return self if instance is None else functools.partial(self, instance)

    def forget(self) -> None:
        """Forget what is loaded; what is on disk stays there."""
        self._ready.clear()

    def _made_ready(self, structure, leaves, key):
        folder = _folder()
        told = None if folder is None else _described((self._name, *key))
        if folder is None or told is None:
            return "traced"
        known = folder / _digest(_context(), told)
        name, result = _read(known) or ("", None)
        found = _executable(folder / name) if name else None
        if found is None:
            lowered, result = self._lowered(structure, leaves)
            if "callback" in lowered.as_text():
                return "traced"  # it holds an address of this process
            # Arguments that it has no use for are not in its text.
            text = f"{lowered.args_info} {lowered.as_text()}"
            name = _digest(_compiler(), text)
            # Other sources may have asked for the same program.
            found = _executable(folder / name) or _compiled(lowered, folder / name)
            if found is None:
                return "traced"
            _write(known, (name, result))
        others, structure = jax.tree.flatten(result)
        return found, structure, others

    def _lowered(self, structure, leaves):
        """From arrays to arrays, and the result with `...` in their places."""
        result = None
        function: Callable[..., Any] = self._function

        def flat(*arrays):
            nonlocal result
            given = iter(arrays)
            merged = [next(given) if eqx.is_array(leaf) else leaf for leaf in leaves]
            args, kwargs = jax.tree.unflatten(structure, merged)
            found, others = eqx.partition(function(*args, **kwargs), eqx.is_array)
            result = eqx.combine(jax.tree.map(lambda _: ..., found), others)
            return jax.tree.leaves(found)

        flat.__name__ = flat.__qualname__ = self._function.__name__
        return jax.jit(flat).lower(*filter(eqx.is_array, leaves)), result


def _executable(file: Path):
    kept = _read(file)
    _with_lapack()
    try:
        return None if kept is None else serialize_executable.deserialize_and_load(*kept)
    except (ValueError, RuntimeError):  # it was made by something that calls itself the same
        return None


@functools.cache
def _with_lapack() -> None:
    """Tell XLA where LAPACK is, as JAX does when it lowers a call of it: else calls of it crash."""
    jax.jit(jax.lax.linalg.cholesky).lower(np.eye(1))


def _compiled(lowered, file: Path):
    """The executable of a lowered program, kept in a file; None where JAX can't write it."""
    # What JAX's cache has loaded can't be written again: its machine code is gone by then.
    with _alone:
        jax.config.update("jax_enable_compilation_cache", False)
        compilation_cache.reset_cache()
        try:
            executable = lowered.compile()
        finally:
            jax.config.update("jax_enable_compilation_cache", True)
            compilation_cache.reset_cache()
    try:
        _write(file, serialize_executable.serialize(executable))
    except (ValueError, NotImplementedError):  # JAX can't write what has constants as arguments
        return None
    return executable


def _read(file: Path) -> Any:
    """What was written; None where nothing was, or where it is damaged."""
    try:
        return pickle.loads(file.read_bytes())
    except (OSError, EOFError, ValueError, AttributeError, ImportError, pickle.UnpicklingError):
        return None


def _write(file: Path, content) -> None:
    """Write in one piece or not at all: other processes may be looking."""
    try:
        with tempfile.TemporaryDirectory(dir=file.parent) as apart:
            whole = Path(apart, file.name)
            whole.write_bytes(pickle.dumps(content))
            os.replace(whole, file)
    except (OSError, pickle.PicklingError):
        return


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:40]


@functools.cache
def _folder() -> Path | None:
    """Where programs stay, or None where none is kept."""
    settings = jax.config.values
    within = settings["jax_compilation_cache_dir"]
    one = jax.default_backend() == "cpu" and len(jax.devices()) == 1
    if not (within and settings["jax_enable_compilation_cache"] and one):
        return None
    folder = Path(within) / "programs"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder


def _context() -> str:
    """What a program is made from, apart from its function and arguments."""
    return repr((_sources(), _compiler()))


@functools.cache
def _sources() -> str:
    sources = sorted(Path(__file__).parent.rglob("*.py"))
    told = hashlib.sha256(b"".join(file.read_bytes() for file in sources)).hexdigest()
    others = [f"{module.__name__} {module.__version__}" for module in (eqx, optimistix, lineax, np)]
    return repr((told, others))


def _compiler() -> str:
    """What makes an executable of a program; a user may set JAX up anew at any time."""
    settings = sorted((k, v) for k, v in jax.config.values.items() if "cache" not in k)
    versions = jax.__version__, jaxlib.__version__
    return repr((versions, settings, os.environ.get("XLA_FLAGS"), _machine()))


@functools.cache
def _machine() -> str:
    """The machine, by what its processor can do: executables are made for it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        kinds = {line for line in lines if line.startswith(("flags", "model name", "Features"))}
    except OSError:
        kinds = {platform.processor()}
    return repr((platform.machine(), platform.system(), sorted(kinds)))


def _described(value: Any) -> str | None:
    """A static value in words that are the same in every process, or None where there are none."""
    if isinstance(value, jax.tree_util.PyTreeDef):
        parts = (value.node_data(), *value.children())
        return "*" if value.node_data() is None and not value.children() else _listed("tree", parts)
    if value is None or isinstance(value, bool | int | float | str | bytes | np.dtype):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, tuple | list):
        return _listed(type(value).__name__, value)
    if isinstance(value, dict):
        return _listed("dict", [part for item in value.items() for part in item])
    if isinstance(value, functools.partial):
        return _listed("partial", (value.func, value.args, value.keywords))
    if isinstance(value, type | FunctionType):
        return _name_of(value)
    if isinstance(value, eqx.Module):
        return _listed("module", jax.tree.flatten(value))
    if dataclasses.is_dataclass(value):
        own = [getattr(value, field.name) for field in dataclasses.fields(value)]
        return _listed("data", (type(value), *own))
    if type(value).__mro__[1:] == (object,) and getattr(value, "__dict__", None) == {}:
        return _listed("object", (type(value),))
    return None


def _name_of(value: Any) -> str | None:
    """Where a function or type is found, if that is what its name leads to (no local one)."""
    if value.__module__.split(".")[0] not in _OURS or "<" in value.__qualname__:
        return None
    found = sys.modules.get(value.__module__)
    for part in value.__qualname__.split("."):
        found = getattr(found, part, None)
    # Some types that JAX registers have no name of their own there (NoneType).
    same = found is value or isinstance(value, type)
    return f"{value.__module__}:{value.__qualname__}" if same else None


def _listed(kind: str, values) -> str | None:
    found = [_described(value) for value in values]
    return None if None in found else f"{kind}({', '.join(map(str, found))})"


_total = 0.0


def _listen(event: str, duration_secs: float, **_) -> None:
    global _total
    if event.endswith("compile_duration"):
        _total += duration_secs


jax.monitoring.register_event_duration_secs_listener(_listen)


def compile_seconds() -> float:
    """Seconds spent compiling since the package was imported."""
    return _total


_MAPS, _MOST_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")


def forget_compiled_if_many() -> bool:
    """Forget compiled programs before the process runs out of memory maps; whether it did.

    Linux allows a process some 65,000 maps, every compiled program takes dozens, and beyond the
    limit XLA ends the process ("LLVM compilation error: Cannot allocate memory"). Whoever works
    through many recordings of many sizes calls this between them; what is on disk stays there.
    """
    if not (_MAPS.exists() and _MOST_MAPS.exists()):
        return False
    many = _MAPS.read_bytes().count(b"\n") > 0.5 * int(_MOST_MAPS.read_text())
    if many:
        jax.clear_caches()
        for one in _everything:
            one.forget()
    return many
