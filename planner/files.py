"""Reading and writing files safely: whole-or-nothing writes, bounded readers, text tables, MCAP logs."""

from __future__ import annotations

import csv
import gc
import io
import json
import logging
import math
import mmap
import os
import re
import secrets
import shlex
import stat
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias

import numpy as np
from mcap.exceptions import EndOfFile
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import InputError, MapError, UsageError, visible

# Atomic writes, and readers that check the claims of a header.

Json: TypeAlias = dict[str, Any]
"""A JSON object, or the same from a YAML file: values are unchecked."""
CHECKSUM = "checksum"
"""Key of the checksum in a plan or state file, which `read_json` verifies if present."""
LOG = logging.getLogger("mrac_jax")
LONG_BYTES = 8 * 2**20
"""Text longer than this takes seconds to read."""
LONGEST_NAME = 300
"""Characters of a path in a message."""


def printable(path: str | Path) -> str:
    """A path for a message: one line of limited length."""
    text = visible(str(path), kept="")
    return text if len(text) <= LONGEST_NAME else f"{text[: LONGEST_NAME // 2]}...{text[-LONGEST_NAME // 2 :]}"


def why_no_file(path: Path) -> str:
    """Why no regular file can be read at `path`, "" if there is one. Never raises, whatever the name."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "no such file"
    except OSError as error:  # too long a name, a folder without access, links in a circle
        return f"{'cannot be read' if isinstance(error, PermissionError) else 'no such file'} ({error.strerror})"
    except ValueError:  # a NUL, half a surrogate pair
        return "no such file (its name has a character that no file name can have)"
    return "" if stat.S_ISREG(mode) else "is a folder" if stat.S_ISDIR(mode) else "is no regular file"


def check_file(path: Path, expected: str) -> None:
    """Check that there is a regular file at `path`.

    Raises:
        MapError: there is none.
    """
    problem = why_no_file(path)
    if problem:
        raise MapError(problem, source=printable(path), expected=expected)


def check_new(*paths: str | Path, force: bool = False) -> None:
    """Check that files may be written.

    Args:
        paths: the files.
        force: whether existing files may be replaced.

    Raises:
        UsageError: one of them exists.
    """
    for path in map(Path, () if force else paths):
        if path.exists():
            fix = f"give {argument('force', True)} to replace it, or another name"
            raise UsageError(f"{printable(path)} is there already", fix=fix)


@contextmanager
def atomic_write(path: Path, mode: str = "w", *, sync: bool = False) -> Iterator[IO[Any]]:
    """Context with a temporary file in the folder of `path`; on success it replaces `path`, else it is removed.

    A link is followed: its target is replaced.

    Args:
        path: the file.
        mode: of `open`.
        sync: whether content and name are on the disk before the context ends.

    Raises:
        MapError: the file cannot be written, or exists and is no regular file.
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
            beside.unlink(missing_ok=True)  # after success it no longer exists


def _target(path: Path) -> Path:
    """The target of `path` with all links followed: a regular file, or a new name in an existing folder."""
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
def library_errors(problem: str, source: object = "", expected: str = "") -> Iterator[None]:
    """Context in which nearly all exceptions of a library become MapErrors, and its warnings are suppressed.

    Args:
        problem, source, expected: of the MapError.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except InputError:
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:160] or type(error).__name__
        raise MapError(f"{problem} ({said})", source=source, expected=expected) from error


def read_npy(path: Path, most_cells: int) -> NDArray:
    """Read a `.npy` array without pickles; the size in its header is checked against the file first.

    Args:
        path: the file.
        most_cells: largest number of elements.

    Raises:
        MapError: it is invalid.
    """
    check_file(path, "a NumPy array file")
    with library_errors("cannot be read as .npy", path, "a NumPy array file"), path.open("rb") as stream:
        _, claimed = _claimed(stream, most_cells, path)
        held = path.stat().st_size
        if claimed > held:
            raise MapError(f"{held} bytes claim {claimed}", source=path, expected="a complete array file")
        return np.load(path, allow_pickle=False)


def read_npz(path: Path, most_bytes: int) -> dict[str, NDArray]:
    """Read the arrays of a `.npz` file without pickles; sizes in its headers are checked first.

    Args:
        path: the file.
        most_bytes: largest unpacked size.

    Raises:
        MapError: it is invalid.
    """
    check_file(path, "a NumPy archive")
    return _unpack(path, most_bytes, path)


def npz_bytes(**arrays: Any) -> bytes:
    """Content of a NumPy archive, the same for the same arrays."""
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def unpack_npz(data: bytes, most_bytes: int, source: str) -> dict[str, NDArray]:
    """`read_npz` of a file's content; `source` names it in errors."""
    return _unpack(io.BytesIO(data), most_bytes, source)


def _unpack(file: Path | io.BytesIO, most_bytes: int, source: Path | str) -> dict[str, NDArray]:
    with library_errors("cannot be read as .npz", source, "a NumPy archive"):
        with zipfile.ZipFile(file) as archive:
            _check_members(archive, most_bytes, source)
        if isinstance(file, io.BytesIO):
            file.seek(0)
        with np.load(file, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}


def _check_members(archive: zipfile.ZipFile, most_bytes: int, path: Path | str) -> None:
    """MapError for an archive that is too large, holds a name twice, or has a member shorter than its header claims."""
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
    """Shape and size in bytes in the header of an array; MapError for more than `most` elements."""
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    count = math.prod(shape)
    if count > most or any(not 0 <= length <= most for length in shape):
        raise MapError(f"claims an array {shape}", source=path, expected=f"at most {most} values")
    return shape, count * dtype.itemsize


def read_json(path: Path, most_bytes: int, error: type[InputError], expected: str) -> Any:
    """Read a JSON file. A file of `write_json` has to match its checksum; a plan that does not is only warned about.

    Args:
        path: the file.
        most_bytes: largest size.
        error: exception for an invalid file, which names the line.
        expected: for messages.
    """
    check_size(path, most_bytes, error, expected)
    collecting = gc.isenabled()
    gc.disable()  # collections during parsing find no garbage, and make it three times slower
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
        ours = isinstance(data, dict) and str(data.get("format")).startswith("mrac-") and CHECKSUM in data
        if ours and data.pop(CHECKSUM) != _checksum(data):
            problem, fix = "is damaged, or was changed: its checksum is of other content", f"leave {CHECKSUM} out"
            if data["format"] != "mrac-plan":
                raise error(problem, source=path, expected=expected, fix=f"if you changed it, {fix}")
            LOG.warning("%s %s", printable(path), problem)  # other programs edit plans
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
    """Write one line of JSON with its checksum, atomically.

    Args:
        path: the file.
        data: the object.
        most_bytes: largest size, as of `read_json`.
        error: exception if it is larger.
        sync: whether it is on the disk before this returns.
    """
    text = _compact({**data, CHECKSUM: _checksum(data)}) + "\n"
    if len(text) > most_bytes:  # ASCII
        problem, expected = f"would be {len(text)} bytes", f"at most {most_bytes}, more is not read back"
        raise error(problem, source=printable(path), expected=expected, fix="larger cells, or a part of the map")
    with atomic_write(path, sync=sync) as out:
        out.write(text)


def check_size(path: Path, most_bytes: int, error: type[InputError], expected: str, fix: str = "") -> None:
    """Check that there is a regular file of limited size; a large one is logged.

    Args:
        path: the file.
        most_bytes: largest size.
        error: exception otherwise.
        expected, fix: for messages.
    """
    problem = why_no_file(path)
    if problem:
        raise error(problem, source=printable(path), expected=expected)
    size = path.stat().st_size
    if size > most_bytes:
        raise error(f"{size} bytes", source=path, expected=f"{expected} of at most {most_bytes}", fix=fix)
    if size > LONG_BYTES:
        LOG.warning("reading %s (%.0f MB), which takes a while ...", printable(path), size / 1e6)


# Text tables (CSV): separators of columns, decimal signs; and grids of numbers.

MAX_CSV_BYTES = 2**26
"""Largest grid of numbers that is read (64 MiB); larger ones are faster as arrays."""
SAMPLE = 64
"""Lines at the top of a grid that determine its separator."""
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas", " ": "spaces"}
"""Separators of columns, and their names."""
SIGNS = {".": "points", ",": "commas"}
"""Decimal signs, and their names."""
STRONG = (";", "\t", "|")
"""Separators that occur in no number and between no words."""
COMMA = re.compile(r"[-+]?(\d+,\d*|,\d+)([eE][-+]?\d+)?")
"""A number with a decimal comma."""
GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}[,.]\d{3}")
"""A possible whole number with a mark between thousands: 1,234."""
MARKED = re.compile(r"[-+]?[\d.,]+")
"""Digits and marks."""
DECIMAL_COMMAS = "if its numbers have decimal commas, separate the columns by semicolons"
Fields = Sequence[tuple[int, str]]
"""(line number, text)."""


class Sign(NamedTuple):
    """The decimal sign of some numbers, "." or ","; `problem`: why it is ambiguous, else ""."""

    decimal: str = "."
    problem: str = ""


def is_number(field: str) -> bool:
    """True for a number in Python's form."""
    try:
        float(field)
    except ValueError:
        return False
    return True


def is_header(row: Iterable[str]) -> bool:
    """True if no field is a number, with a decimal point or a decimal comma."""
    return not any(is_number(field) or COMMA.fullmatch(field.strip()) for field in row)


def layout_note(separator: str, decimal: str) -> tuple[str, ...]:
    """A note on how a table was read; none for the usual commas and decimal points."""
    if (separator, decimal) == (",", "."):
        return ()
    return (
        f"columns are read as separated by {SEPARATORS[separator]}, numbers as written with decimal {SIGNS[decimal]}",
    )


def separator_of(lines: Iterable[str], path: Path) -> str:
    """The separator of columns: it splits each line into as many fields, most of them numbers.

    Args:
        lines: of the table.
        path: for messages.

    Raises:
        MapError: two separators are possible.
    """
    lines = [line for line in lines if line.strip()]
    first = lines[0].strip(" \r\n") if lines else ""
    shares: dict[str, float] = {}
    for separator in SEPARATORS:
        rows = _split(lines, separator) if separator in first else []
        if len({len(row) for row in rows}) == 1 and len(rows[0]) > 1:
            body = [field for row in rows[1:] or rows for field in row]
            shares[separator] = sum(not is_header([field]) for field in body) / len(body)
    if not shares:  # lines of different lengths: the reader reports the first
        return next((separator for separator in (*STRONG, ",") if separator in first), ",")
    best = [separator for separator, share in shares.items() if share == max(shares.values())]
    if len(best) > 1 and best[1] in STRONG:
        problem = f"its columns may be separated by {SEPARATORS[best[0]]} or by {SEPARATORS[best[1]]}"
        raise MapError(problem, source=path, expected="one of them in every line")
    return best[0]


def _split(lines: Sequence[str], separator: str) -> list[list[str]]:
    """The fields of every line; none if they cannot be determined."""
    if separator == " ":
        return [line.split() for line in lines]
    with suppress(csv.Error):
        return [row for row in csv.reader(lines, delimiter=separator) if row]
    return []


def sign_of(fields: Fields, sure: bool = False) -> Sign:
    """The decimal sign of numbers of one kind; `sure`: other numbers in the file clearly have decimal commas."""
    commas = [(line, field.strip()) for line, field in fields if "," in field and COMMA.fullmatch(field.strip())]
    points = [(line, field.strip()) for line, field in fields if "." in field and is_number(field)]
    for line, field in fields:
        if "," in field and "." in field and MARKED.fullmatch(field.strip()):
            return Sign(problem=f"line {line}: {field.strip()[:40]!r} has marks between thousands")
    if commas and points:
        (line, comma), (other, point) = commas[0], points[0]
        return Sign(
            problem=f"line {line} has {comma[:40]!r} and line {other} {point[:40]!r}: decimal commas and points"
        )
    unclear = commas if commas and not sure else points if points and sure else []
    if unclear and all(GROUPED.fullmatch(field) for _, field in unclear):
        line, field = unclear[0]
        whole = re.sub("[,.]", "", field)
        return Sign(problem=f"line {line}: {field!r} may be {field.replace(',', '.')} or {whole}")
    return Sign("," if commas else ".")


def signs_of(rows: Sequence[tuple[int, Sequence[str]]]) -> list[Sign]:
    """The decimal sign of every column, from rows of one length."""
    fields = [field.strip() for _, row in rows for field in row if "," in field]
    if not fields:
        return [Sign()] * len(rows[0][1])
    sure = any(COMMA.fullmatch(field) and not GROUPED.fullmatch(field) for field in fields)
    return [sign_of([(line, row[at]) for line, row in rows], sure) for at in range(len(rows[0][1]))]


def _lines(path: Path, holds: str) -> list[str]:
    """The lines of a text file, the first one empty if it is the `sep=;` of spreadsheet programs. Raises MapError."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            return _without_sep(stream.readlines())
    except (OSError, UnicodeDecodeError) as error:
        raise MapError(f"cannot be read as text ({error})", source=path, expected=holds) from error


def read_rows(path: Path, holds: str) -> tuple[str, list[tuple[int, list[str]]]]:
    """(separator, non-empty rows with their line numbers) of a text table.

    Args:
        path: the file.
        holds: expected content, for messages.

    Raises:
        MapError: it cannot be read.
    """
    lines = _lines(path, holds)
    separator = separator_of(lines, path)
    reader = csv.reader(lines, delimiter=separator)
    rows = enumerate(map(str.split, lines), start=1) if separator == " " else ((reader.line_num, r) for r in reader)
    try:
        return separator, [(line, row) for line, row in rows if any(field.strip() for field in row)]
    except csv.Error as error:
        raise MapError(f"cannot be read as text ({error})", source=path, expected=holds) from error


def _without_sep(lines: list[str]) -> list[str]:
    """The lines, the first one empty if it is the `sep=;` of spreadsheet programs."""
    return ["\n", *lines[1:]] if lines and re.fullmatch(r"sep=.\s*", lines[0]) else lines


def starts_with_header(path: Path) -> bool:
    """True for a text table without number in its first row."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        top = _without_sep([line for _, line in zip(range(SAMPLE), stream, strict=False)])
    lines = [line for line in top if line.strip()]
    rows = _split(lines[:1], separator_of(lines, path))
    return bool(rows) and is_header(rows[0])


def read_csv_grid(path: Path, most_cells: int) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Read a grid of numbers; `nan` is allowed.

    Args:
        path: the file.
        most_cells: largest size.

    Returns:
        (float64 `[H, W]`, notes).

    Raises:
        MapError: names the first invalid line and value.
    """
    holds = "rows of numbers without a header"
    check_size(path, MAX_CSV_BYTES, MapError, holds, "save it as .npz or .npy, or coarsen the map")
    rows = [(number, line) for number, line in enumerate(_lines(path, holds), start=1) if line.strip()]
    if not rows:
        raise MapError("is empty", source=path, expected=holds)
    separator = separator_of([line for _, line in rows[: 2 * SAMPLE]], path)
    decimal = _decimal(rows, separator, path)
    if decimal == ",":
        rows = [(number, line.replace(",", ".")) for number, line in rows]
    delimiter = None if separator == " " else separator
    try:
        with warnings.catch_warnings(action="ignore"):
            values = np.loadtxt([line for _, line in rows], delimiter=delimiter, comments=None, ndmin=2)
    except ValueError:  # an invalid line, or loadtxt is too strict: line by line
        width = len(rows[0][1].split(delimiter))
        values = np.array([_csv_row(path, number, line, width, delimiter) for number, line in rows])
    if values.size > most_cells:
        raise MapError(f"more than {most_cells} cells", source=path, fix="coarsen the map")
    return values, layout_note(separator, decimal)


def _decimal(rows: Fields, separator: str, path: Path) -> str:
    """The decimal sign of a grid. Raises MapError if it is ambiguous."""
    if separator == "," or not any("," in line for _, line in rows):
        return "."
    fields = ((number, field.strip()) for number, line in rows for field in line.split(separator))
    sure = any("," in field and not GROUPED.fullmatch(field) for _, field in fields)  # up to the first one
    if not sure or any("." in line for _, line in rows):
        problem = sign_of([(number, field) for number, line in rows for field in line.split(separator)]).problem
        if problem:
            raise MapError(problem, source=path, expected="decimal points, or decimal commas")
    return ","


def _csv_row(path: Path, number: int, line: str, width: int, delimiter: str | None) -> list[float]:
    values = []
    for column, text in enumerate(field.strip() for field in line.rstrip("\r\n").split(delimiter)):
        try:
            values.append(float(text))
        except ValueError:
            problem = f"line {number}, column {column}: {text[:40]!r} is no number"
            expected = f"numbers without a header, separated by {SEPARATORS[delimiter or ' ']}"
            raise MapError(problem, source=path, expected=expected) from None
    if width != len(values):
        problem, fix = f"line {number} has {len(values)} values", DECIMAL_COMMAS if delimiter == "," else ""
        raise MapError(problem, source=path, expected=f"{width} as above", fix=fix)
    return values


# MCAP logs, our own and others', for the readers of the `mcap` library.

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
