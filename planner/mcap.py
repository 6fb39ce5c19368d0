"""Access to MCAP logs, our own and others', for the readers of the `mcap` library."""

from __future__ import annotations

import mmap
import shlex
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mcap.exceptions import EndOfFile

from planner.errors import InputError
from planner.files import printable, why_no_file

MAGIC = b"\x89MCAP0\r\n"


def mapped(path: Path, error: type[InputError] = InputError, *, magic: bool = True) -> mmap.mmap:
    """The file's bytes, read as they are used.

    Args:
        path: the file.
        error: exception if it is no regular file, or empty.
        magic: whether it must begin like an MCAP file.
    """
    problem = why_no_file(path)
    if problem == "is a folder" and (inside := sorted(one.name for one in path.glob("*.mcap"))):
        problem, fix = f"is a folder with {', '.join(inside)[:200]}", "name the file in it"
        raise error(problem, source=printable(path), expected="an MCAP file", fix=fix)
    try:
        if not problem and not path.stat().st_size:
            problem = "is empty"
        if not problem:
            with path.open("rb") as stream:
                data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
            if not magic or data[: len(MAGIC)] == MAGIC:
                return data
            problem = "is not an MCAP file"
    except (OSError, ValueError) as wrong:
        raise error(f"cannot be read ({wrong})", source=printable(path), expected="an MCAP file") from wrong
    raise error(problem, source=printable(path), expected="an MCAP file")


@contextmanager
def damage_reported(path: Path, error: type[InputError] = InputError) -> Iterator[None]:
    """Context in which every error of the library becomes one that names the file and the fix.

    The library has no common exception for invalid bytes: it raises McapError, ValueError, KeyError, struct.error,
    MemoryError, and the errors of the decompressors.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as wrong:
        said = "a record is cut" if isinstance(wrong, EndOfFile | struct.error) else printable(str(wrong))[:160]
        fix = f"try `mrac-jax inspect --repair OUT {shlex.quote(printable(path))}`"
        problem = f"truncated or damaged: {said or type(wrong).__name__}"
        raise error(problem, source=path, fix=fix) from wrong
