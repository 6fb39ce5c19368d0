"""Reading and writing files safely: whole-or-nothing writes, and readers that refuse what a header merely claims."""

from __future__ import annotations

import math
import os
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError


@contextmanager
def atomic_write(path: Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Open a temporary file beside `path`; on success it replaces `path`, on any error it is removed."""
    if not path.parent.is_dir():
        raise MapError("cannot be written: its folder does not exist", source=path, fix=f"make {path.parent} first")
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".partial", dir=path.parent)
    try:
        encoding = None if "b" in mode else "utf-8"
        with os.fdopen(handle, mode, encoding=encoding, newline=None if "b" in mode else "") as out:
            yield out
        umask = os.umask(0)
        os.umask(umask)
        Path(name).chmod(0o666 & ~umask)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def read_npy(path: Path, most_cells: int) -> NDArray:
    """A `.npy` array without pickles; the size that its header claims is checked against the file before loading."""
    try:
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        if mapped.size > most_cells:
            raise MapError(f"{mapped.size} values", source=path, expected=f"at most {most_cells}")
        return np.array(mapped)
    except MapError:
        raise
    except Exception as error:  # NumPy's parser of broken headers raises nearly anything
        problem = f"cannot be read as .npy ({str(error)[:120]})"
        raise MapError(problem, source=path, expected="a NumPy array file") from error


def read_npz(path: Path, most_bytes: int) -> dict[str, NDArray]:
    """The arrays of a `.npz` file without pickles; what its headers claim is checked before memory is taken."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(item.file_size for item in archive.infolist())
            if unpacked > most_bytes:
                raise MapError(f"claims {unpacked} bytes unpacked", source=path, expected=f"at most {most_bytes}")
            for item in archive.infolist():
                with archive.open(item) as stream:
                    claimed = _claimed_bytes(stream)
                if claimed > item.file_size:
                    problem = f"{item.filename} claims {claimed} bytes"
                    raise MapError(problem, source=path, expected=f"the {item.file_size} that it holds")
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except MapError:
        raise
    except Exception as error:  # broken archives raise nearly anything
        problem = f"cannot be read as .npz ({str(error)[:120]})"
        raise MapError(problem, source=path, expected="a NumPy archive") from error


def _claimed_bytes(stream: IO[bytes]) -> int:
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    return math.prod(shape) * dtype.itemsize


def read_csv_grid(path: Path, most_cells: int) -> NDArray[np.float64]:
    """A grid of comma-separated numbers, float64 `[H, W]`; `nan` allowed. MapError names a bad line and value."""
    rows: list[list[float]] = []
    try:
        with path.open(encoding="utf-8-sig") as lines:
            for number, line in enumerate(lines, start=1):
                if line.strip():
                    rows.append(_csv_row(path, number, line, rows, most_cells))
    except (OSError, UnicodeDecodeError) as error:
        raise MapError(f"cannot be read as text ({error})", source=path, expected="comma-separated numbers") from error
    if not rows:
        raise MapError("is empty", source=path, expected="rows of comma-separated numbers")
    return np.array(rows, dtype=np.float64)


def _csv_row(path: Path, number: int, line: str, rows: list[list[float]], most_cells: int) -> list[float]:
    fields = [text.strip() for text in line.rstrip("\r\n").split(",")]
    values = []
    for column, text in enumerate(fields):
        try:
            values.append(float(text))
        except ValueError:
            problem = f"line {number}, column {column}: {text[:40]!r} is no number"
            raise MapError(problem, source=path, expected="comma-separated numbers without a header") from None
    if rows and len(values) != len(rows[0]):
        raise MapError(f"line {number} has {len(values)} values", source=path, expected=f"{len(rows[0])} as above")
    if (len(rows) + 1) * len(values) > most_cells:
        raise MapError(f"more than {most_cells} cells", source=path, fix="coarsen the map")
    return values
