"""Text tables (CSV): what separates their columns, how their numbers are written; and grids of numbers."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import check_size

MAX_CSV_BYTES = 2**26
"""Largest grid of numbers that is read (64 MiB); larger ones are faster as arrays."""
CSV_BATCH = 2**20
"""Characters of such a file that are read at a time: a wrong value is named as soon as it is met."""
SAMPLE = 64
"""Lines at the top of a grid that show its separator."""
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas", " ": "spaces"}
"""What may separate columns, in words."""
SIGNS = {".": "points", ",": "commas"}
"""Decimal signs in words."""
STRONG = (";", "\t", "|")
"""Separators that stand in no number and between no words."""
COMMA = re.compile(r"[-+]?(\d+,\d*|,\d+)([eE][-+]?\d+)?")
"""A number with a decimal comma."""
GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}[,.]\d{3}")
"""What may be a whole number with a mark between thousands: 1,234."""
MARKED = re.compile(r"[-+]?[\d.,]+")
"""Digits and marks."""
DECIMAL_COMMAS = "if its numbers have decimal commas, separate the columns by semicolons"
Fields = Sequence[tuple[int, str]]
"""(number of the line, text)."""


class Sign(NamedTuple):
    """The decimal sign of some numbers, "." or ","; `problem`: why it cannot be told, else ""."""

    decimal: str = "."
    problem: str = ""


def is_number(field: str) -> bool:
    """True for a number as Python writes it."""
    try:
        float(field)
    except ValueError:
        return False
    return True


def is_header(row: Iterable[str]) -> bool:
    """True if no field is a number, with a decimal point or a decimal comma."""
    return not any(is_number(field) or COMMA.fullmatch(field.strip()) for field in row)


def layout_note(separator: str, decimal: str) -> tuple[str, ...]:
    """What a user should know of how a table was read: nothing of the usual commas and decimal points."""
    if (separator, decimal) == (",", "."):
        return ()
    return (
        f"columns are read as separated by {SEPARATORS[separator]}, numbers as written with decimal {SIGNS[decimal]}",
    )


def separator_of(lines: Iterable[str], path: Path) -> str:
    """What separates the columns in lines of a table: what parts each into as many fields, most of them numbers.

    Raises MapError where two may: no guess decides between semicolons and tabs.
    """
    lines = [line for line in lines if line.strip()]
    first = lines[0].strip(" \r\n") if lines else ""
    shares: dict[str, float] = {}
    for separator in SEPARATORS:
        rows = _split(lines, separator) if separator in first else []
        if len({len(row) for row in rows}) == 1 and len(rows[0]) > 1:
            body = [field for row in rows[1:] or rows for field in row]
            shares[separator] = sum(not is_header([field]) for field in body) / len(body)
    if not shares:  # lines of different lengths: the reader names the first
        return next((separator for separator in (*STRONG, ",") if separator in first), ",")
    best = [separator for separator, share in shares.items() if share == max(shares.values())]
    if len(best) > 1 and best[1] in STRONG:
        problem = f"its columns may be separated by {SEPARATORS[best[0]]} or by {SEPARATORS[best[1]]}"
        raise MapError(problem, source=path, expected="one of them in every line")
    return best[0]


def _split(lines: Sequence[str], separator: str) -> list[list[str]]:
    """The fields of every line; none where they cannot be told."""
    if separator == " ":
        return [line.split() for line in lines]
    with suppress(csv.Error):
        return [row for row in csv.reader(lines, delimiter=separator) if row]
    return []


def sign_of(fields: Fields, sure: bool = False) -> Sign:
    """The decimal sign of numbers that belong together; `sure`: others in the file have decimal commas beyond doubt."""
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
    doubtful = commas if commas and not sure else points if points and sure else []
    if doubtful and all(GROUPED.fullmatch(field) for _, field in doubtful):
        line, field = doubtful[0]
        whole = re.sub("[,.]", "", field)
        return Sign(problem=f"line {line}: {field!r} may be {field.replace(',', '.')} or {whole}")
    return Sign("," if commas else ".")


def signs_of(rows: Sequence[tuple[int, Sequence[str]]]) -> list[Sign]:
    """The decimal sign of every column, of rows of one length."""
    fields = [field.strip() for _, row in rows for field in row if "," in field]
    if not fields:
        return [Sign()] * len(rows[0][1])
    sure = any(COMMA.fullmatch(field) and not GROUPED.fullmatch(field) for field in fields)
    return [sign_of([(line, row[at]) for line, row in rows], sure) for at in range(len(rows[0][1]))]


def read_rows(path: Path, holds: str) -> tuple[str, list[tuple[int, list[str]]]]:
    """What separates the columns of a text table, and its rows that are not empty with their lines. Raises MapError."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            lines = _without_sep(stream.readlines())
        separator = separator_of(lines, path)
        reader = csv.reader(lines, delimiter=separator)
        rows = enumerate(map(str.split, lines), start=1) if separator == " " else ((reader.line_num, r) for r in reader)
        return separator, [(line, row) for line, row in rows if any(field.strip() for field in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise MapError(f"cannot be read as text ({error})", source=path, expected=holds) from error


def _without_sep(lines: list[str]) -> list[str]:
    """The lines, the first one empty if it is the `sep=;` of spreadsheet programs."""
    return ["\n", *lines[1:]] if lines and re.fullmatch(r"sep=.\s*", lines[0]) else lines


def starts_with_header(path: Path) -> bool:
    """True for a text table whose first row holds no number."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        top = _without_sep([line for _, line in zip(range(SAMPLE), stream, strict=False)])
    lines = [line for line in top if line.strip()]
    rows = _split(lines[:1], separator_of(lines, path))
    return bool(rows) and is_header(rows[0])


def read_csv_grid(path: Path, most_cells: int) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """A grid of numbers, float64 `[H, W]`, and notes; `nan` allowed. MapError names a bad line and value."""
    holds = "rows of numbers without a header"
    check_size(path, MAX_CSV_BYTES, MapError, holds, "save it as .npz or .npy, or coarsen the map")
    blocks: list[NDArray[np.float64]] = []
    number = cells = 0
    separator = decimal = ""
    try:
        with path.open(encoding="utf-8-sig") as stream:
            while lines := stream.readlines(CSV_BATCH):
                lines = lines if number else _without_sep(lines)
                if not blocks and not any(map(str.strip, lines)):
                    number += len(lines)
                    continue
                separator = separator or separator_of(lines[: 2 * SAMPLE], path)
                plain, found = _with_points(lines, separator, number, path)
                if decimal and found and decimal != found:
                    problem = f"decimal {SIGNS[decimal]} up to line {number}, decimal {SIGNS[found]} below"
                    raise MapError(problem, source=path, expected="one decimal sign")
                decimal = decimal or found
                block = _csv_block(path, number, plain, blocks[0].shape[1] if blocks else None, separator)
                number, cells = number + len(lines), cells + block.size
                if cells > most_cells:
                    raise MapError(f"more than {most_cells} cells", source=path, fix="coarsen the map")
                blocks += [block] if block.size else []
    except (OSError, UnicodeDecodeError) as error:
        raise MapError(f"cannot be read as text ({error})", source=path, expected=holds) from error
    if not blocks:
        raise MapError("is empty", source=path, expected=holds)
    return np.concatenate(blocks), layout_note(separator, decimal or ".")


def _with_points(lines: list[str], separator: str, before: int, path: Path) -> tuple[list[str], str]:
    """Lines of a grid with decimal points, and their sign, "" without any. Raises MapError where it cannot be told."""
    if separator == "," or not any("," in line for line in lines):
        return lines, "." if separator != "," and any("." in line for line in lines) else ""
    fields = ((n, field.strip()) for n, line in enumerate(lines, before + 1) for field in line.split(separator))
    sure = any("," in field and not GROUPED.fullmatch(field) for _, field in fields)  # up to the first one
    if not sure or any("." in line for line in lines):
        rows = enumerate(lines, before + 1)
        problem = sign_of([(n, field) for n, line in rows for field in line.split(separator)]).problem
        if problem:
            raise MapError(problem, source=path, expected="decimal points, or decimal commas")
    return [line.replace(",", ".") for line in lines], ","


def _csv_block(path: Path, before: int, lines: list[str], width: int | None, separator: str) -> NDArray[np.float64]:
    """The numbers in `lines`, of which there are `before` above, float64 `[rows, width]`; empty lines are skipped."""
    delimiter = None if separator == " " else separator
    with suppress(ValueError), warnings.catch_warnings(action="ignore"):
        block = np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2)
        if width in (None, block.shape[1]):
            return block
    rows: list[list[float]] = []  # something is wrong, or loadtxt is too strict: line by line
    for number, line in enumerate(lines, start=before + 1):
        if line.strip():
            rows.append(_csv_row(path, number, line, width, delimiter))
            width = len(rows[0])
    return np.array(rows, dtype=np.float64)


def _csv_row(path: Path, number: int, line: str, width: int | None, delimiter: str | None) -> list[float]:
    values = []
    for column, text in enumerate(field.strip() for field in line.rstrip("\r\n").split(delimiter)):
        try:
            values.append(float(text))
        except ValueError:
            problem = f"line {number}, column {column}: {text[:40]!r} is no number"
            expected = f"numbers without a header, separated by {SEPARATORS[delimiter or ' ']}"
            raise MapError(problem, source=path, expected=expected) from None
    if width not in (None, len(values)):
        problem, fix = f"line {number} has {len(values)} values", DECIMAL_COMMAS if delimiter == "," else ""
        raise MapError(problem, source=path, expected=f"{width} as above", fix=fix)
    return values
