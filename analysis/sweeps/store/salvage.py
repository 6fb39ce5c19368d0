"""What can still be read of a damaged store: its rows, reached through the index and through the table, both ways.

A row is looked for by its number (SQLite's rowid), which the index and the table each know; whoever reads it checks its
checksum. Memory: the numbers alone.
"""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass, field

LAST = 2**63 - 1
"""The largest rowid."""
COLUMNS = {"runs": "key", "blocks": "key, block"}


@dataclass
class Rows:
    """Rows of a damaged store by the key of their run: their numbers, and what the index and the table say is there.

    Attributes:
        runs: rowids of a run's own rows; more than one where the two ways disagree. blocks: of its blocks.
        named: (key, block) of every block that either of them names.
    """

    runs: dict[str, set[int]] = field(default_factory=dict)
    blocks: dict[str, set[int]] = field(default_factory=dict)
    named: set[tuple[str, int]] = field(default_factory=set)


def rows_of(connection: sqlite3.Connection) -> Rows:
    """Every row that can be reached, in the order in which the runs were added."""
    found = Rows()
    for number, key in sorted(_reached(connection, "runs"), key=lambda row: row[0]):
        found.runs.setdefault(str(key), set()).add(number)
    for number, key, block in _reached(connection, "blocks"):
        found.blocks.setdefault(str(key), set()).add(number)
        found.named.add((str(key), block))
    return found


def _reached(connection: sqlite3.Connection, table: str) -> set[tuple[int, ...]]:
    """(rowid, columns) of the rows of a table: by its index, then by the table itself past every damaged place."""
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
            except sqlite3.DatabaseError:  # over the damaged place, in growing steps
                place, step = place + sign * step, 2 * step
    return found
