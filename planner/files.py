"""Reading and writing files safely: whole-or-nothing writes, and readers that refuse what a header merely claims."""

from __future__ import annotations

import gc
import io
import json
import logging
import math
import os
import secrets
import stat
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import InputError, MapError, UsageError, visible

Json: TypeAlias = dict[str, Any]
"""A JSON object, or what a YAML file holds in its place: values are looked at before they are believed."""
CHECKSUM = "checksum"
"""Key of a plan's or state's file that `read_json` checks, where it is there."""
LOG = logging.getLogger("mrac_jax")
LONG_BYTES = 8 * 2**20
"""Text of more than this takes seconds to read."""
LONGEST_NAME = 300
"""Characters of a path that a message shows."""


def printable(path: str | Path) -> str:
    """A path as a message shows it: one line, not endless."""
    text = visible(str(path), kept="")
    return text if len(text) <= LONGEST_NAME else f"{text[: LONGEST_NAME // 2]}...{text[-LONGEST_NAME // 2 :]}"


def why_no_file(path: Path) -> str:
    """Why no regular file can be read at `path`, "" if one is there. Never raises, whatever the name."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "no such file"
    except OSError as error:  # a name that is too long, a folder that may not be entered, links in a circle
        return f"{'cannot be read' if isinstance(error, PermissionError) else 'no such file'} ({error.strerror})"
    except ValueError:  # a NUL, half a surrogate pair
        return "no such file (its name has a character that no file name can have)"
    return "" if stat.S_ISREG(mode) else "is a folder" if stat.S_ISDIR(mode) else "is no regular file"


def check_file(path: Path, expected: str) -> None:
    """MapError unless there is a regular file at `path`."""
    problem = why_no_file(path)
    if problem:
        raise MapError(problem, source=printable(path), expected=expected)


def check_new(*paths: str | Path, force: bool = False) -> None:
    """Raise UsageError for the first of these files that is there already, unless it may be replaced by `force`."""
    for path in map(Path, () if force else paths):
        if path.exists():
            fix = f"give {argument('force', True)} to replace it, or another name"
            raise UsageError(f"{printable(path)} is there already", fix=fix)


@contextmanager
def atomic_write(path: Path, mode: str = "w", *, sync: bool = False) -> Iterator[IO[Any]]:
    """Open a temporary file beside `path`; on success it replaces `path`, on any error it is removed.

    `sync`: what is written is on the disk before that, and its name before this returns.
    A link is followed: its target is replaced. Raises MapError where nothing can be written, and for a target that is
    there and no regular file.
    """
    beside: Path | None = None
    try:
        target = _target(path)
        beside = target.with_name(f".{secrets.token_hex(8)}.partial")
        encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
        with beside.open(mode.replace("w", "x"), encoding=encoding, newline=newline) as out:
            yield out
            if sync:
                out.flush()
                os.fsync(out.fileno())
        beside.replace(target)
        if sync and os.name == "posix":
            folder = os.open(target.parent, os.O_RDONLY)
            os.fsync(folder)  # its new name too
            os.close(folder)
    except OSError as error:
        problem = f"cannot be written ({error.strerror or error})"
        raise MapError(problem, source=printable(path), expected="a file that can be written") from error
    finally:
        if beside is not None:
            beside.unlink(missing_ok=True)  # after success it is gone


def _target(path: Path) -> Path:
    """Where `path` leads, all links followed: a regular file, or a new name in a folder that is there."""
    target = path
    try:
        target = path.resolve()
        mode = target.stat().st_mode
    except FileNotFoundError:
        if target.parent.is_dir():
            return target
        problem = "cannot be written: its folder does not exist"
        raise MapError(problem, source=printable(path), fix=f"make {printable(path.parent)} first") from None
    except (ValueError, RuntimeError):  # a NUL; links in a circle
        raise MapError("cannot be written: no file can have this name", source=printable(path)) from None
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "no regular file (a device or a pipe)"
        raise MapError(f"cannot be written: it is {what}", source=printable(path), expected="the name of a file")
    return target


@contextmanager
def foreign_errors(problem: str, source: object = "", expected: str = "") -> Iterator[None]:
    """Whatever a library raises in here about what it reads, nearly anything, is a MapError; no warning is news."""
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except MapError:
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:160] or type(error).__name__
        raise MapError(f"{problem} ({said})", source=source, expected=expected) from error


def read_npy(path: Path, most_cells: int) -> NDArray:
    """A `.npy` array without pickles; the size that its header claims is checked against the file before loading."""
    check_file(path, "a NumPy array file")
    with foreign_errors("cannot be read as .npy", path, "a NumPy array file"), path.open("rb") as stream:
        _, claimed = _claimed(stream, most_cells, path)
        held = path.stat().st_size
        if claimed > held:
            raise MapError(f"{held} bytes claim {claimed}", source=path, expected="a complete array file")
        return np.load(path, allow_pickle=False)


def read_npz(path: Path, most_bytes: int) -> dict[str, NDArray]:
    """The arrays of a `.npz` file without pickles; what its headers claim is checked before memory is taken."""
    check_file(path, "a NumPy archive")
    return _unpack(path, most_bytes, path)


def npz_bytes(**arrays: Any) -> bytes:
    """A NumPy archive, the same for the same arrays."""
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def unpack_npz(data: bytes, most_bytes: int, source: str) -> dict[str, NDArray]:
    """`read_npz` of a file's bytes; `source` names them in errors."""
    return _unpack(io.BytesIO(data), most_bytes, source)


def _unpack(file: Path | io.BytesIO, most_bytes: int, source: Path | str) -> dict[str, NDArray]:
    with foreign_errors("cannot be read as .npz", source, "a NumPy archive"):
        with zipfile.ZipFile(file) as archive:
            _check_members(archive, most_bytes, source)
        if isinstance(file, io.BytesIO):
            file.seek(0)
        with np.load(file, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}


def _check_members(archive: zipfile.ZipFile, most_bytes: int, path: Path | str) -> None:
    """MapError for an archive that holds too much, a name twice, or a member shorter than its header claims."""
    unpacked = sum(item.file_size for item in archive.infolist())
    if unpacked > most_bytes:
        raise MapError(f"claims {unpacked} bytes unpacked", source=path, expected=f"at most {most_bytes}")
    seen: set[str] = set()
    for item in archive.infolist():
        name = item.filename.removesuffix(".npy")
        if name in seen:
            raise MapError(f"holds {name[:40]!r} twice", source=path, expected="every array once")
        seen.add(name)
        with archive.open(item) as stream:
            shape, claimed = _claimed(stream, most_bytes, path)
        if claimed > item.file_size:
            problem = f"{name[:40]!r} claims {claimed} bytes, {shape}"
            raise MapError(problem, source=path, expected=f"the {item.file_size} that it holds")


def _claimed(stream: IO[bytes], most: int, path: Path | str) -> tuple[tuple[int, ...], int]:
    """The shape and the bytes that the header of an array claims; MapError for more than `most` values."""
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    count = math.prod(shape)
    if count > most or any(not 0 <= length <= most for length in shape):
        raise MapError(f"claims an array {shape}", source=path, expected=f"at most {most} values")
    return shape, count * dtype.itemsize


def read_json(path: Path, most_bytes: int, error: type[InputError], expected: str) -> Any:
    """What a JSON file of at most `most_bytes` holds; an `error` names the line that is no JSON.

    A file of `write_json` must hold what it did when it was written; a changed plan is read with a warning.
    """
    check_size(path, most_bytes, error, expected)
    collecting = gc.isenabled()
    gc.disable()  # which would look through all values, none of them garbage, again and again: three times slower
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
        ours = isinstance(data, dict) and str(data.get("format")).startswith("mrac-") and CHECKSUM in data
        if ours and data.pop(CHECKSUM) != _checksum(data):
            problem, fix = "is damaged, or was changed: its checksum is of other content", f"leave {CHECKSUM} out"
            if data["format"] != "mrac-plan":
                raise error(problem, source=path, expected=expected, fix=f"if you changed it, {fix}")
            LOG.warning("%s %s", printable(path), problem)  # programs of others change plans
        return data
    except json.JSONDecodeError as wrong:
        problem = f"line {wrong.lineno}, column {wrong.colno}: no JSON ({wrong.msg})"
        raise error(problem, source=path, expected=expected) from None
    except RecursionError:
        raise error("is nested too deeply", source=path, expected=expected) from None
    except InputError:
        raise
    except (OSError, ValueError, MemoryError) as wrong:  # not UTF-8, an integer of thousands of digits, no permission
        raise error(f"cannot be read as JSON ({str(wrong)[:60]})", source=path, expected=expected) from None
    finally:
        if collecting:
            gc.enable()


def _compact(data: object) -> str:
    return json.dumps(data, separators=(",", ":"))


def _checksum(data: Json) -> int:
    """crc32 of the text of a JSON object."""
    return zlib.crc32(_compact(data).encode())


def write_json(path: Path, data: Json, most_bytes: int, error: type[InputError], *, sync: bool = False) -> None:
    """Write `data` as one line of JSON with its checksum, whole or not; an `error` where `read_json` would refuse it.

    `sync`: it is on the disk before this returns.
    """
    text = _compact({**data, CHECKSUM: _checksum(data)}) + "\n"
    if len(text) > most_bytes:  # ASCII
        problem, expected = f"would be {len(text)} bytes", f"at most {most_bytes}, more is not read back"
        raise error(problem, source=printable(path), expected=expected, fix="larger cells, or a part of the map")
    with atomic_write(path, sync=sync) as out:
        out.write(text)


def check_size(path: Path, most_bytes: int, error: type[InputError], expected: str, fix: str = "") -> None:
    """An `error` unless there is a regular file of at most `most_bytes` at `path`; a large one is announced (log)."""
    problem = why_no_file(path)
    if problem:
        raise error(problem, source=printable(path), expected=expected)
    size = path.stat().st_size
    if size > most_bytes:
        raise error(f"{size} bytes", source=path, expected=f"{expected} of at most {most_bytes}", fix=fix)
    if size > LONG_BYTES:
        LOG.warning("reading %s (%.0f MB), which takes a while ...", printable(path), size / 1e6)
