"""The sources that a module's compiled code comes from: its own, and those of every project module that it imports.

Numba looks at a function's own file alone, while its code holds the functions and constants of other files too. The
`__init__` of a room that a module is in says what the room is for; it counts only where it is imported itself.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path

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
