"""Numba's compiler with the cache in the user's cache folder: compiled functions wear `compiled` or `threaded`.

The folder is `$NUMBA_CACHE_DIR/mrac-jax` if set, else `$XDG_CACHE_HOME/mrac-jax/compiled`, else
`~/.cache/mrac-jax/compiled`. `MRAC_JAX_NO_CACHE=1` in the environment (the command line's `--no-cache`) keeps nothing
on disk.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

import llvmlite  # type: ignore[import-untyped]
import numba
from numba.core.caching import NullCache
from numba.core.compiler import Compiler, CompileResult
from numba.core.serialize import dumps

from planner.sealed import NO_CACHE, SealedFolder
from planner.sources import ROOMS, file_of, sources_hash

KNOWN = "0.68."
"""Releases of Numba whose insides `planner.jit_parts` works with; others compile everything as they see fit."""
Rebuild = Callable[[Any, Any], Any]
"""Of a target and what was kept, a compiled function."""


class Listener(Protocol):
    """Who wants to know that something is being compiled."""

    def begins(self) -> None: ...
    def ends(self) -> None: ...


OF_JAX: list[Listener] = []
"""Who is told of what JAX compiles."""
OF_THIS_PROCESS = "(of this process)"
"""In the name of a type: code for it is of no use to another process, and not kept."""
UNCOUNTED: dict[str, Any] = {"_nrt": False, "error_model": "numpy"}


def _rebuild(target: Any, reduced: Any) -> Any:
    return CompileResult._rebuild(target, *reduced)


def _compilers() -> tuple[type, type, type, Rebuild]:
    """Those of parts, of programs and of all else, and what rebuilds a part."""
    if not numba.__version__.startswith(KNOWN):
        return Compiler, Compiler, Compiler, _rebuild
    from planner import jit_parts

    return jit_parts.PartCompiler, jit_parts.ProgramCompiler, jit_parts.QuickCompiler, jit_parts.rebuild_part


PART, PROGRAM, ANY, REBUILD_PART = _compilers()
WITHIN: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": PART}
Function = TypeVar("Function", bound=Callable[..., Any])


def cache_folder(kind: str) -> Path | None:
    """Where what is made once ("compiled" code, "bench") is kept between runs; None when nothing is to be kept."""
    if os.environ.get(NO_CACHE, "") not in ("", "0"):
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    except RuntimeError:  # nobody's home
        return None
    return Path(base).absolute() / "mrac-jax" / kind


@cache
def sealed_folder(path: Path) -> SealedFolder:
    """The folder's one object in this process: it says once what is wrong there."""
    return SealedFolder(path)


def compiled(function: Function) -> Function:
    """`numba.njit` of a serial function, cached on disk unless that is turned off."""
    return _njit(function)


def threaded(function: Function) -> Function:
    """The same for a function that several threads may run at once: it lets go of the interpreter.

    Threads of our own, never `parallel=True`: it would need a cache that knows the threading layer.
    """
    return _njit(function, nogil=True)


def program(function: Function) -> Function:
    """The same for a function that allocates nothing: no array that it is handed has its references counted.

    `_nrt=False` is an option that Numba keeps to itself, and worth twice the speed of the closed loop. A function that
    makes an array, a list or a string does not compile so: it is handed its scratch instead. No index in it, or in a
    part of it, may be negative: Numba asks at every access whether one is, and here it does not.
    """
    return _njit(function, nogil=True, **UNCOUNTED, pipeline_class=PROGRAM)


def kernel(function: Function) -> Function:
    """A part of a program, which Python does not call: inlined where it is called, since it is handed many arrays."""
    return _njit(function, **UNCOUNTED, **WITHIN, forceinline=True)


def spliced(function: Function) -> Function:
    """The same for a part that is called in one place, or returns an array: it is its caller's before types are."""
    return _njit(function, **UNCOUNTED, **WITHIN, inline="always")


def rare_kernel(function: Function) -> Function:
    """The same for a large part that is called now and then: not inlined, so that it is compiled once."""
    return _njit(function, **UNCOUNTED, **WITHIN)


def _njit(function: Function, pipeline_class: type = ANY, **options: Any) -> Function:
    dispatcher = numba.njit(**options, pipeline_class=pipeline_class)(function)
    folder, chosen = cache_folder("compiled"), numba.config.CACHE_DIR
    if folder is not None and not numba.config.DISABLE_JIT:
        dispatcher._cache = _KeptCode(
            function,
            sealed_folder(Path(chosen).absolute() / "mrac-jax" if chosen else folder),
            REBUILD_PART if pipeline_class is PART else _rebuild,
        )
    return dispatcher


class _KeptCode(NullCache):
    """One function's cache, as Numba's dispatcher wants it: a file for each signature, machine, state of the sources.

    In the place of Numba's own, which keeps an index beside the code: two processes that compile at once can leave an
    index that leads to the other's code, a damaged file ends the run, and a change in another module is not seen.
    """

    def __init__(self, function: Callable[..., Any], folder: SealedFolder, rebuild: Rebuild) -> None:
        self._rebuild = rebuild
        code = function.__code__
        self._folder = folder
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._state = (
            sources_hash(function.__module__, code.co_filename),
            code.co_firstlineno,
            code.co_code,
            numba.__version__,
            llvmlite.__version__,
            sys.implementation.cache_tag,
        )

        self._prefix = f"{self._name}-{_short(self._state, 8)}-"

    @property
    def is_kept(self) -> bool:
        """Whether code of these sources is there, for some signature."""
        return any(self._folder.path.glob(f"{self._prefix}*"))

    @property
    def cache_path(self) -> str:
        return str(self._folder.path)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        if OF_THIS_PROCESS in str(sig):
            return None
        target_context.refresh()
        key = self._key(sig, target_context.codegen())
        content = self._folder.read(self._file(key))
        if content is None:
            return None
        try:
            of, reduced = pickle.loads(content)
            return self._rebuild(target_context, reduced) if of == key else None
        except Exception:  # whole, our own, and yet of no use: compiled again like any other
            self._folder.damaged()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        if (
            OF_THIS_PROCESS in str(sig)
            or data.library.has_dynamic_globals
            or any(not lifted.can_cache for lifted in data.lifted)
        ):
            return
        key = self._key(sig, data.codegen)
        self._folder.write(self._file(key), dumps((key, data._reduce())))

    def _key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        """What the code depends on: sources, versions, types, machine."""
        return (*self._state, sig, sorted(_sources_of(sig)), codegen.magic_tuple())

    def _file(self, key: tuple[Any, ...]) -> str:
        return f"{self._prefix}{_short(key, 32)}"


def _sources_of(kinds: Iterable[Any]) -> set[str]:
    """Hashes of the sources of this project's own types among these, of its named tuples and of what they hold.

    A function reads a tuple that it is handed without importing what says where its fields lie.
    """
    hashes: set[str] = set()
    for kind in kinds:
        for module in (type(kind).__module__, getattr(kind, "instance_class", type(kind)).__module__):
            if module.partition(".")[0] in ROOMS:
                hashes.add(sources_hash(module, str(file_of(module))))
        hashes |= _sources_of(getattr(kind, "types", ()))
    return hashes


def _short(key: tuple[Any, ...], digits: int) -> str:
    """A key as part of a file's name."""
    return hashlib.sha256(repr(key).encode()).hexdigest()[:digits]


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether compiled code of a function that wears `threaded` is in the cache, so that nobody has to compile it."""
    cache = getattr(function, "_cache", None)
    return isinstance(cache, _KeptCode) and cache.is_kept


@threaded
def put_first(values, into):  # type: ignore[no-untyped-def]
    """`into[: len(values)] = values` without Numba's message about other lengths, which takes 3 s to compile."""
    for place in range(len(values)):
        into[place] = values[place]
