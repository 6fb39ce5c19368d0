"""Numba's compiler with the cache in the user's cache folder: compiled functions wear `compiled` or `threaded`.

The folder is `$NUMBA_CACHE_DIR/mrac-jax` if set, else `$XDG_CACHE_HOME/mrac-jax/compiled`, else
`~/.cache/mrac-jax/compiled`. `MRAC_JAX_NO_CACHE=1` in the environment (the command line's `--no-cache`) keeps nothing
on disk.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import pickle
import re
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import Any, Protocol, TypeVar

import llvmlite  # type: ignore[import-untyped]
import numba
from numba.core.caching import NullCache
from numba.core.compiler import Compiler, CompileResult
from numba.core.serialize import dumps

from planner.jit_features import FeatureCompiler

# Files of compiled code, kept between runs: read only if they are whole and nobody else's, else made again.
#
# Compiled code that is damaged ends the process, and whoever can write it can run anything: so a file carries the hash
# of
# its content, and is used only if it belongs to this user (or to root) and nobody else may write it. It is written
# beside
# its place and then moved there: whoever reads it meanwhile finds all of it, or what was there before. Whatever happens
# to these files is no error: it costs a compilation, and a line in the log (which Python prints to standard error).

LOG = logging.getLogger("mrac_jax")
NO_CACHE = "MRAC_JAX_NO_CACHE"
"""Environment variable that keeps such files from being read and written."""
SUFFIX = ".sealed"
MARK = b"mrac sealed 1\n\0\0"
HASH_BYTES = hashlib.sha256().digest_size
DAY = 86400.0
KEPT_DAYS = 30
MOST_BYTES = 2**29


class SealedFolder:
    """Content by name in one folder, which is made when it is first needed.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._told = self._pruned = False
        self._trusted: bool | None = None

    def read(self, name: str) -> bytes | None:
        """What was written under the name; None if there is nothing, or nothing that can be trusted."""
        try:
            if not self._is_trusted():
                return None
            sealed = _read_own(self.path / (name + SUFFIX))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            self._tell(f"is made again: it cannot be read ({error.strerror})")
            return None
        content = memoryview(sealed)[len(MARK) + HASH_BYTES :]
        if sealed[: len(MARK) + HASH_BYTES] != MARK + _hash(name, content):
            self.damaged()
            return None
        return bytes(content)

    def write(self, name: str, content: bytes) -> None:
        """Keep the content under the name, if that is possible."""
        try:
            with suppress(FileExistsError):
                self.path.mkdir(mode=0o700, parents=True)
            if self._is_trusted():
                self._prune()
                _write_whole(self.path / (name + SUFFIX), MARK + _hash(name, content) + content)
        except OSError as error:
            self._tell(f"is not kept ({error.strerror}): expected a folder to write to, or XDG_CACHE_HOME set to one")

    def damaged(self) -> None:
        """Say that a file of this folder was of no use."""
        self._tell("is made again: it was damaged")

    def _is_trusted(self) -> bool:
        """Whether it is a folder that only this user and root may write to; raises OSError if there is none."""
        if self._trusted is None:
            facts = self.path.stat()
            self._trusted = stat.S_ISDIR(facts.st_mode) and _nobody_elses(facts)
            if not self._trusted:
                self._tell("is not used: expected a folder of yours that nobody else may write to (chown, chmod go-w)")
        return self._trusted

    def _tell(self, what: str) -> None:
        """The one line of a process on this folder; a worker leaves it to the process that started it."""
        if not self._told and multiprocessing.parent_process() is None:
            LOG.warning("note: compiled code in %s %s", self.path, what)
        self._told = True

    def _prune(self) -> None:
        """Once a process: remove what nobody has used for a month, and the longest unused above MOST_BYTES.

        Another process may be using them: it has read them whole, or compiles again.
        """
        if self._pruned:
            return
        self._pruned, old = True, time.time() - KEPT_DAYS * DAY
        found = [(path, path.stat()) for path in self.path.iterdir() if path.name.endswith((SUFFIX, ".partial"))]
        found.sort(key=lambda one: -one[1].st_mtime)
        total = 0
        for path, facts in found:
            total += facts.st_size
            if total > MOST_BYTES or facts.st_mtime < old:
                path.unlink(missing_ok=True)


def _hash(name: str, content: bytes | memoryview) -> bytes:
    digest = hashlib.sha256(name.encode() + b"\0")
    digest.update(content)
    return digest.digest()


def _nobody_elses(facts: os.stat_result) -> bool:
    """Whether only this user and root can have written it (where files have owners)."""
    return os.name != "posix" or (facts.st_uid in (0, os.geteuid()) and not facts.st_mode & 0o022)


def _read_own(path: Path) -> bytes:
    """A regular file of this user, marked as used today; raises OSError."""
    with os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb") as file:  # a pipe would wait
        facts = os.fstat(file.fileno())
        if not stat.S_ISREG(facts.st_mode) or not _nobody_elses(facts):
            raise PermissionError(0, "others may have written it")
        content = file.read()
    if facts.st_mtime < time.time() - DAY:
        with suppress(OSError):
            os.utime(path)
    return content


def _write_whole(path: Path, content: bytes) -> None:
    """Write beside the file, then move there: with mode 0600; raises OSError and leaves nothing."""
    handle, beside = tempfile.mkstemp(prefix=path.name, suffix=".partial", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(beside).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(beside).unlink()
        raise


# The sources that a module's compiled code comes from: its own, and those of every project module that it imports.
#
# Numba looks at a function's own file alone, while its code holds the functions and constants of other files too. The
# `__init__` of a room that a module is in says what the room is for; it counts only where it is imported itself.

ROOMS = ("planner", "mrac_jax", "analysis")
_IMPORT = re.compile(rb"\n[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]*))")
"""An import as the formatter leaves it; for the parser a file would take 20 times as long."""
_BESIDE = re.compile(rb"[()]|#[^\n]*")
_NAME = re.compile(rb"(?:^|,)\s*([.\w]+)")


@cache
def sources_hash(module: str, file: str) -> str:
    """Hash of a module's source and of all that it imports of this project, directly or not, wherever in the file."""
    hashes, todo = {module: _read(module, file)[0]}, {*_read(module, file)[1]}
    while todo:
        name, path = todo.pop()
        if name not in hashes:
            hashes[name], beyond = _read(name, path)
            todo |= beyond
    return hashlib.sha256(repr(sorted(hashes.items())).encode()).hexdigest()


@cache
def _read(module: str, file: str) -> tuple[str, frozenset[tuple[str, str]]]:
    """Hash of a source, and the modules of this project that it imports, with their files."""
    source = Path(file).read_bytes()
    package = module if file.endswith("__init__.py") else module.rpartition(".")[0]
    found: set[str] = set()
    for base, members, plain in _IMPORT.findall(b"\n" + source):
        stem = base if base.endswith(b".") else base + b"."
        listed = _NAME.findall(_BESIDE.sub(b"", members or plain))
        found |= {name.decode() for name in ((base, *(stem + name for name in listed)) if base else listed)}
    names = {resolve_name(name, package) if name.startswith(".") else name for name in found}
    return hashlib.sha256(source).hexdigest(), frozenset(
        (name, path) for name in names if name.partition(".")[0] in ROOMS and (path := file_of(name)) is not None
    )


@cache
def file_of(module: str) -> str | None:
    """A module's source; None if there is no such module in the packages that are being run."""
    room, *rest = module.split(".")
    for folder in _folders(room):
        path = Path(folder, *rest)
        for file in (path / "__init__.py", Path(f"{path}.py")):
            if file.is_file():
                return str(file)
    return None


@cache
def _folders(room: str) -> tuple[str, ...]:
    """Where a package is that is being run."""
    spec = find_spec(room)
    return tuple(spec.submodule_search_locations or ()) if spec else ()


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
UNCOUNTED: dict[str, Any] = {"_nrt": False, "error_model": "numpy"}


def _rebuild(target: Any, reduced: Any) -> Any:
    return CompileResult._rebuild(target, *reduced)


def _compilers() -> tuple[type, type, type, Rebuild]:
    """Those of parts, of programs and of all else, and what rebuilds a part."""
    if not numba.__version__.startswith(KNOWN):
        return FeatureCompiler, FeatureCompiler, Compiler, _rebuild
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
        if data.library.has_dynamic_globals or any(not lifted.can_cache for lifted in data.lifted):
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
