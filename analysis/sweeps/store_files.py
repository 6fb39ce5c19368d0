"""A tally as bytes, and its sums. Counts have the narrowest type and are compressed with zlib (with checksum).

A blob is zlib of one line of JSON (`key`, `shape`, `arrays`: [name, type, length]) and the arrays in that order.
"""

from __future__ import annotations

import json
import sqlite3
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.variance_reduction import control_sums
from planner.files import Json
from planner.tally import COUNTS_OF_0_3, Tally

FIGURES = ("visited", "survived", "time", "alive")
MOST_BYTES = 2**34


def pack(tally: Tally) -> bytes:
    """The tally as a blob, without its ids."""
    arrays = [(name, _narrow(values)) for name, values in tally.counts().items()]
    head = {
        "key": tally.key,
        "shape": tally.shape,
        "arrays": [(name, values.dtype.str, len(values)) for name, values in arrays],
    }
    parts = [json.dumps(head, separators=(",", ":")).encode(), b"\n", *(values.tobytes() for _, values in arrays)]
    return zlib.compress(b"".join(parts), 1)


def unpack(blob: bytes, ids: tuple[tuple[int, int], ...]) -> Tally:
    """The tally of a blob. Raises ValueError for invalid bytes."""
    try:
        unpacker = zlib.decompressobj()
        # The limit protects against a damaged blob that unpacks without end.
        data = unpacker.decompress(blob, MOST_BYTES)
        if not unpacker.eof:
            raise ValueError("cut off")
        line, _, rest = data.partition(b"\n")
        head, at, counts = json.loads(line), 0, {}
        for name, kind, length in head["arrays"]:
            values = np.frombuffer(rest, dtype=kind, count=length, offset=at)
            counts[COUNTS_OF_0_3.get(name, name)] = values.astype(np.int64)
            at += values.nbytes
        if at != len(rest):
            raise ValueError(f"{len(rest) - at} bytes too many")
        return Tally(head["key"], tuple(head["shape"]), ids, **counts)
    except (zlib.error, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"no tally ({error})") from error


def _narrow(values: NDArray[np.int64]) -> NDArray[Any]:
    most, least = int(values.max(initial=0)), int(values.min(initial=0))
    return values.astype(np.min_scalar_type(most).newbyteorder("<") if least >= 0 and most < 2**32 else "<i8")


def sums_of(tally: Tally) -> Json:
    """The tally's sums, exact integers that add: `rollouts`, `outcomes`, and [sum, sum of squares] of each figure.

    `luck`: see `analysis.statistics.variance_reduction.control_sums`.
    """
    said: Json = {"rollouts": tally.rollouts, "outcomes": tally.outcomes.tolist(), "luck": control_sums(tally)}
    for figure in FIGURES:
        counts = getattr(tally, figure)
        held = np.flatnonzero(counts)
        often = counts[held]
        # Sums of squares may exceed int64.
        if tally.rollouts * (len(counts) ** 2) >= 2**63:
            often = often.astype(object)  # Python integers do not overflow
        said[figure] = [int(often @ held), int(often @ held**2)]
    return said


def add_sums(left: Json, right: Json) -> Json:
    """The sum of two sums. Blocks of earlier releases may lack an outcome, or `luck`."""
    return {
        name: left[name] + right[name]
        if name == "rollouts"
        else [a + b for a, b in zip_longest(left.get(name, ()), right.get(name, ()), fillvalue=0)]
        for name in left | right
    }


# Sets of rollout ids as ranges.

Ranges = tuple[tuple[int, int], ...]
"""Rollout ids: sorted, disjoint `(start, stop)`, stop excluded."""


def joined(ids: Iterable[Iterable[int]]) -> Ranges:
    """Sorted ranges of ids; overlapping and adjacent ones are joined."""
    merged: list[tuple[int, int]] = []
    for start, stop in sorted((int(start), int(stop)) for start, stop in ids):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return tuple(merged)


def cut(ids: Ranges, size: int) -> list[tuple[int, int]]:
    """The ids in parts `(start, stop)`, cut at multiples of `size`."""
    parts = []
    for start, stop in ids:
        while start < stop:
            end = min(stop, (start // size + 1) * size)
            parts.append((start, end))
            start = end
    return parts


def without(ids: Ranges, taken: Ranges) -> Ranges:
    """The ids that are not in `taken`; both are sorted and disjoint."""
    left = []
    for start, stop in ids:
        for begin, end in taken:
            if begin >= stop or end <= start:
                continue
            if start < begin:
                left.append((start, begin))
            start = max(start, end)
        if start < stop:
            left.append((start, stop))
    return tuple(left)


# Recovery of a damaged store: rows are found through the index and through the table.
#
# A row is read by its number (SQLite's rowid), which index and table both hold, and then verified by its checksum. Only
# the numbers are kept in memory.

LAST = 2**63 - 1
"""The largest rowid."""
COLUMNS = {"runs": "key", "blocks": "key, block"}


@dataclass
class Rows:
    """Rows of a damaged store by the key of their run.

    Attributes:
        runs: rowids of a run's rows; more than one if index and table disagree. blocks: rowids of its blocks.
        named: (key, block) of every block in the index or the table.
    """

    runs: dict[str, set[int]] = field(default_factory=dict)
    blocks: dict[str, set[int]] = field(default_factory=dict)
    named: set[tuple[str, int]] = field(default_factory=set)


def rows_of(connection: sqlite3.Connection) -> Rows:
    """Every row that can be reached, in order of insertion of the runs."""
    found = Rows()
    for number, key in sorted(_reached(connection, "runs"), key=lambda row: row[0]):
        found.runs.setdefault(str(key), set()).add(number)
    for number, key, block in _reached(connection, "blocks"):
        found.blocks.setdefault(str(key), set()).add(number)
        found.named.add((str(key), block))
    return found


def _reached(connection: sqlite3.Connection, table: str) -> set[tuple[int, ...]]:
    """(rowid, columns) of the rows of a table: by its index, then by the table itself, skipping damaged places."""
    columns, found = COLUMNS[table], set[tuple[int, ...]]()
    for order in ("ASC", "DESC"):
        by = ", ".join(f"{column} {order}" for column in columns.split(", "))
        query = f"SELECT rowid, {columns} FROM {table} INDEXED BY sqlite_autoindex_{table}_1 ORDER BY {by}"
        try:
            for row in connection.execute(query):
                found.add(row)
        except sqlite3.DatabaseError:
            continue
    last = max((row[0] for row in found), default=LAST - 1)
    for sign, way, place in ((1, "> ? ORDER BY rowid", 0), (-1, "< ? ORDER BY rowid DESC", min(last, LAST - 1) + 1)):
        query, step = f"SELECT rowid, {columns} FROM {table} NOT INDEXED WHERE rowid {way}", 1
        while 0 <= place <= LAST:
            try:
                for row in connection.execute(query, (place,)):
                    found.add(row)
                    place, step = row[0], 1
                break
            except sqlite3.DatabaseError:  # skip the damaged place in growing steps
                place, step = place + sign * step, 2 * step
    return found
