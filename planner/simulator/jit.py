"""Numba's compiler with a cache on disk, and the simulator as plain Python (`interpreted`).

`compiled`, `threaded` and `program` decorate functions that Python calls.

The cache folder is `$NUMBA_CACHE_DIR/mrac-jax` if set, else `$XDG_CACHE_HOME/mrac-jax/compiled`, else
`~/.cache/mrac-jax/compiled`. Compiled code is in a folder there, named by the hash of the sources and the versions.
`MRAC_JAX_NO_CACHE=1` in the environment (the command line's `--no-cache`) turns the cache off.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import llvmlite  # type: ignore[import-untyped]
import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from .jit_features import FeatureCompiler

LOG = logging.getLogger("mrac_jax")
NO_CACHE = "MRAC_JAX_NO_CACHE"
"""Environment variable that turns the cache off."""
COMPILES_JAX = "jax:compile"
"""Event (`numba.core.event`) that begins and ends when JAX compiles."""
SUFFIX = ".sealed"
KEPT_SECONDS = 30 * 86400.0


class CacheFolder:
    """Files of compiled code in one folder, created when first needed.

    A file begins with the hash of its name and content, since damaged code would end the process. Folder and files are
    used only if they belong to this user or root and no other user may write to them, since write access would allow
    to run code. A file is written under a temporary name and then moved: a concurrent reader finds the old or the new
    file, complete. An error of the file system costs a compilation and one log line of the process; it is never raised.

    Attributes:
        path: the folder, in the folder of all compiled code.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reported = self._pruned = False

    def read(self, name: str) -> bytes | None:
        """The content written under the name; None if there is none that can be trusted."""
        path = self.path / (name + SUFFIX)
        try:
            if not path.is_file() or not self._is_private(self.path, path):
                return None
            data = path.read_bytes()
            with suppress(OSError):  # a read-only file system
                os.utime(path)
        except OSError as error:
            self.report(f"is compiled again: it cannot be read ({error.strerror})")
            return None
        hash_bytes, content = data[:32], data[32:]
        if hash_bytes != _hash(name.encode(), content):
            self.report("is compiled again: it was damaged")
            return None
        return content

    def write(self, name: str, content: bytes) -> None:
        """Store the content under the name, if possible."""
        try:
            self._prune()
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not self._is_private(self.path):
                return
            handle, partial = tempfile.mkstemp(suffix=".partial", dir=self.path)
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(_hash(name.encode(), content) + content)
                Path(partial).replace(self.path / (name + SUFFIX))
            finally:
                Path(partial).unlink(missing_ok=True)
        except OSError as error:
            self.report(f"is not kept ({error.strerror}): expected a folder to write to, or XDG_CACHE_HOME set to one")

    def report(self, what: str) -> None:
        """Log the process's one line on this folder; a worker leaves it to its parent process."""
        if not self._reported and multiprocessing.parent_process() is None:
            LOG.warning("note: compiled code in %s %s", self.path, what)
        self._reported = True

    def _is_private(self, *paths: Path) -> bool:
        """Whether only this user and root can write to them (where files have owners)."""
        for facts in map(os.stat, paths):
            if os.name == "posix" and (facts.st_uid not in (0, os.geteuid()) or facts.st_mode & 0o022):
                self.report("is not used: expected files that only you can write to (chown, chmod go-w)")
                return False
        return True

    def _prune(self) -> None:
        """Remove files not used for a month, also those of other sources; once per process.

        Another process may be using a file: it has read it completely, or compiles again.
        """
        if not self._pruned:
            self._pruned = True
            with suppress(OSError):  # another process does the same
                for path in self.path.parent.rglob("*"):
                    if path.suffix in (SUFFIX, ".partial") and path.stat().st_mtime < time.time() - KEPT_SECONDS:
                        path.unlink()
                        with suppress(OSError):  # other files are left
                            path.parent.rmdir()


def _hash(*contents: bytes) -> bytes:
    """SHA-256 of the contents and their lengths."""
    return hashlib.sha256(repr([*map(len, contents)]).encode() + b"".join(contents)).digest()


def cache_folder() -> Path | None:
    """The folder of all compiled code; None if the cache is off."""
    if os.environ.get(NO_CACHE, "") not in ("", "0"):
        return None
    if numba.config.CACHE_DIR:
        return Path(numba.config.CACHE_DIR).absolute() / "mrac-jax"
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # the user has no home
        return None
    return Path(base).absolute() / "mrac-jax" / "compiled"


@cache
def open_folder(path: Path) -> CacheFolder:
    """The folder's object, one per process, so that each problem is logged once."""
    return CacheFolder(path)


@cache
def sources_hash(folder: Path = Path(__file__).parent) -> str:
    """Hash of this package's sources and of the versions that compiled code depends on, as first read."""
    versions = (numba.__version__, llvmlite.__version__, sys.implementation.cache_tag)
    return _hash(repr(versions).encode(), _sources(folder)).hex()[:16]


@cache
def _sources(folder: Path) -> bytes:
    """Hash of names and contents of the Python files in a folder."""
    files = sorted(folder.glob("*.py"))
    return _hash(repr([path.name for path in files]).encode(), *(path.read_bytes() for path in files))


class FunctionCache(NullCache):
    """Numba's cache of one function, as its dispatcher calls it: a file for each signature and machine.

    Numba's own cache keeps an index. Two processes that compile at once can leave an index that points to the other's
    code, and damaged files are loaded unchecked: of 200 files with one bit flipped, 28 killed the process and 41
    raised.
    """

    has_read = False
    """Whether this process has read the code of a function: reading more is fast."""

    def __init__(self, function: Callable[..., Any], folder: CacheFolder) -> None:
        code = function.__code__
        self.folder = folder
        self.name = f"{function.__module__}.{function.__qualname__}"
        # A function of another package depends on the files in its own folder.
        self._key = (_sources(Path(code.co_filename).parent), code.co_firstlineno, code.co_code)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code of the signature from the cache; None if there is none."""
        try:
            target_context.refresh()
            content = self.folder.read(self._file(sig, target_context.codegen()))
            FunctionCache.has_read = True
            return None if content is None else CompileResult._rebuild(target_context, *pickle.loads(content))
        except Exception:  # complete and this user's, but not usable by this Numba
            self.folder.report("is compiled again: it was damaged")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the compiled code of the signature."""
        try:
            if not data.library.has_dynamic_globals and not data.lifted:
                self.folder.write(self._file(sig, data.codegen), dumps(data._reduce()))
        except Exception as error:  # a Numba with other internals
            self.folder.report(f"is not kept ({error})")

    def has(self, sig: Any, target_context: Any) -> bool:
        """Whether the cache has a file for the signature."""
        return (self.folder.path / (self._file(sig, target_context.codegen()) + SUFFIX)).exists()

    def _file(self, sig: Any, codegen: Any) -> str:
        key = repr((*self._key, sig, codegen.magic_tuple()))
        return f"{self.name}-{_hash(key.encode()).hex()[:32]}"


KNOWN = "0.68."
"""Releases of Numba whose internals `jit_parts` supports; with others each function is compiled by Numba's default."""
UNCOUNTED: dict[str, Any] = {"_nrt": False, "error_model": "numpy"}
PART = PROGRAM = FeatureCompiler
if numba.__version__.startswith(KNOWN):
    from . import jit_parts

    PART, PROGRAM = jit_parts.PartCompiler, jit_parts.ProgramCompiler
WITHIN: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": PART}
LARGE = 2**12
"""Cells of a map from which on its searches are compiled at once."""
MOST_CELLS = 2**17
"""Cells, summed over its calls, after which a search is compiled: as Python they have taken about as long."""
COLD_SHIFT, WARM_SHIFT = 2, 6
"""MOST_CELLS is halved so many times if the code is in the cache: reading the first function of a process takes 0.3 s,
reading another 10 ms."""
A_NUMBER = 32
"""A call without arrays (`planner.simulator.failure_sampling.threefry`) counts as so many cells."""
Function = TypeVar("Function", bound=Callable[..., Any])


INTERPRETED = bool(numba.config.DISABLE_JIT)
"""Whether this package runs as Python: by Numba's switch, or as its second load (`interpreted`)."""


def compiled(function: Function) -> Function:
    """Decorator: `numba.njit` of a serial function, cached on disk unless the cache is off."""
    return _cached(function)


def threaded(function: Function) -> Function:
    """Decorator like `compiled`, for a function that several threads may run at once: it releases the GIL.

    The threads are the caller's, never `parallel=True`, whose cache would have to know the threading layer.
    """
    return _cached(function, nogil=True)


def host_search(function: Function) -> Function:
    """Decorator like `threaded`, for a loop over arrays that the planner calls: it runs as Python for small inputs."""
    if INTERPRETED:
        return function
    compiled = threaded(function)

    def as_python(*given: Any) -> Any:
        return getattr(interpreted(function.__module__.rpartition(".")[2]), function.__name__).py_func(*given)

    return as_work_grows(as_python, lambda: compiled)


def as_work_grows(as_python: Callable[..., Any], compiled: Callable[[], Any]) -> Any:
    """A function that calls `as_python` while its inputs are small, and `compiled()` from then on.

    The limits are `LARGE` and `MOST_CELLS`; the second is lower if the code is in the cache.
    """
    done, cached = 0, cache(lambda: is_cached(compiled()))

    def call(*given: Any) -> Any:
        nonlocal done
        most = MOST_CELLS >> (COLD_SHIFT if not FunctionCache.has_read else WARM_SHIFT) * cached()
        if done <= most:
            cells = next((len(one) for one in given if hasattr(one, "__len__")), A_NUMBER)
            done += 2 * MOST_CELLS if cells >= LARGE else cells
        return as_python(*given) if done <= most else compiled()(*[getattr(one, "array", one) for one in given])

    return call


def program(function: Function) -> Function:
    """Decorator like `threaded`, for a function that allocates nothing: references of its arrays are not counted.

    `_nrt=False` is an undocumented option of Numba and doubles the speed of the closed loop. A function that makes an
    array, a list or a string does not compile with it: its caller passes scratch arrays. No index in a program or its
    parts may be negative: Numba's test for that is left out.
    """
    return _cached(function, nogil=True, **UNCOUNTED, pipeline_class=PROGRAM)


scalar = program
"""Decorator: a `program` of numbers alone, which the simulator as Python calls as well."""


def kernel(function: Function) -> Function:
    """Decorator: a part of a program, which Python does not call; inlined, since it takes many arrays."""
    return numba.njit(**UNCOUNTED, **WITHIN, forceinline=True)(function)


def search(function: Function) -> Function:
    """Decorator: a `kernel` that is a loop over array arguments, with no tuples of them.

    Where the simulator runs as Python (`interpreted`) it is compiled separately once its inputs are large.
    """
    return kernel(function)


def spliced(function: Function) -> Function:
    """Decorator: a kernel called in one place, or returning an array; spliced into its caller before typing."""
    return numba.njit(**UNCOUNTED, **WITHIN, inline="always")(function)


def rare_kernel(function: Function) -> Function:
    """Decorator: a large kernel called rarely; not inlined, so that it is compiled once."""
    return numba.njit(**UNCOUNTED, **WITHIN)(function)


def _cached(function: Function, **options: Any) -> Function:
    dispatcher, base = numba.njit(**options)(function), cache_folder()
    if base is not None and not numba.config.DISABLE_JIT:
        with suppress(OSError):  # a function without a source file
            dispatcher._cache = FunctionCache(function, open_folder(base / sources_hash()))
    return dispatcher


def is_cached(function: Callable[..., Any]) -> bool:
    """Whether compiled code of a `program` is in the cache, for some signature."""
    cache = getattr(function, "_cache", None)
    return isinstance(cache, FunctionCache) and any(cache.folder.path.glob(f"{cache.name}-*"))


def has_program(function: Any, given: tuple[Any, ...], cached: bool) -> bool:
    """Whether compiled code exists for a call with these arguments.

    Args:
        function: a `program`.
        given: its arguments.
        cached: whether code in the cache counts too, not only that of this process.
    """
    kinds, cache = tuple(map(numba.typeof, given)), getattr(function, "_cache", None)
    if kinds in getattr(function, "overloads", ()):  # Numba may be switched off
        return True
    return cached and isinstance(cache, FunctionCache) and cache.has(kinds, function.targetctx)


@threaded
def put_first(values, into):  # type: ignore[no-untyped-def]
    """`into[: len(values)] = values`; Numba's check of lengths, with its message, would take 3 s to compile."""
    for place in range(len(values)):
        into[place] = values[place]


# The simulator as plain Python: a second load of its modules, in which nothing is compiled.
#
# The same source serves both. Nominal runs, missions, environments and users' functions run one rollout or one step at
# a time, and should not wait for a compilation.

FIRST = sys.modules[__package__]
"""The package's first load, which is compiled."""
NAME = f"{__package__}_as_python"
"""The name of the second load, in `sys.modules`."""
SAME = "kernel", "rare_kernel", "spliced", "program"
"""Decorators that the second load replaces by the identity."""


@cache
def interpreted(module: str) -> Any:
    """A module of the simulator as plain Python.

    Its imports are relative, so they find modules of the same load. The decorators of this module are replaced by the
    identity.

    Args:
        module: name within the package, for example `"step"`.
    """
    if NAME not in sys.modules:
        spec = spec_from_file_location(NAME, FIRST.__file__, submodule_search_locations=list(FIRST.__path__))
        assert spec is not None and spec.loader is not None
        package, plain = module_from_spec(spec), ModuleType(f"{NAME}.jit")
        vars(plain).update(globals() | dict.fromkeys(SAME, _same))
        vars(plain).update(threaded=_compiled, compiled=_compiled, INTERPRETED=True)
        vars(plain).update(search=_growing(lambda part: program(_compiled(part).py_func)), scalar=_growing(_compiled))
        vars(plain).update(host_search=_host_search)
        sys.modules |= {NAME: package, f"{NAME}.jit": plain}
        spec.loader.exec_module(package)
    return import_module(f"{NAME}.{module}")


def _same(function: Any) -> Any:
    return function


def _compiled(function: Any) -> Any:
    """The compiled function of the same name."""
    module = import_module(f"{__package__}.{function.__module__.rpartition('.')[2]}")
    return getattr(module, function.__name__)


def _host_search(function: Any) -> Any:
    """The function of the first load, which runs `py_func` while its inputs are small."""

    def call(*given: Any) -> Any:
        return _compiled(function)(*given)

    vars(call)["py_func"] = function
    return function if INTERPRETED else call


def _growing(find: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Decorator: runs as Python for small inputs or the first calls, then as the program that `find` makes of it."""
    return lambda function: function if INTERPRETED else as_work_grows(function, cache(lambda: find(function)))
