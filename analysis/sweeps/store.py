"""The store: tallies of runs in aligned blocks of 4,096 rollout ids, in one crash-safe SQLite file.

Runs are found by their key (`cases.run_key`), whatever sweep they belong to. Blocks only grow: ids that are stored are
never counted twice, and stores merge by union.
"""

from __future__ import annotations

import json
import os
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import reduce
from itertools import islice
from operator import add
from pathlib import Path
from typing import Any
from urllib.parse import quote

from analysis.sweeps.cases import Label, RunResult, canonical
from analysis.sweeps.store_files import Ranges, add_sums, joined, pack, sums_of, unpack, without
from analysis.utils.notes import say
from planner.arguments import BLOCK, argument
from planner.errors import LOOPS, PER_VISIT, RENAMED, InputError, UsageError
from planner.files import Json, printable, why_no_file
from planner.formatting import counted
from planner.tally import Tally

# Opening a store's file: SQLite in WAL mode, with checks of version and structure; SQLite's errors become StoreErrors.
#
# Crash safety: a transaction is complete or absent, whenever the process is killed. Two processes may write at once;
# each waits for the other's transaction. After a power cut in WAL mode with `synchronous = NORMAL`, the file is intact
# and has all but the last transactions. Against flipped bits, rows carry checksums, since SQLite has none. SQLite's
# check of the structure (`integrity_check`: no row is missing from an index or table) runs at every opening: 1.6 s of
# CPU for each gigabyte, less than it takes to read the runs.

MARK = 0x4D524143
"""SQLite's application id of a store: "MRAC" in ASCII."""
VERSION = 1
"""Version of the tables below."""
BUSY_SECONDS = 60.0
"""Time limit for waiting on another process's transaction."""
TABLES = """
CREATE TABLE runs (
    key TEXT PRIMARY KEY, identity TEXT NOT NULL, what TEXT NOT NULL, facts TEXT NOT NULL, checksum INTEGER NOT NULL
);
CREATE TABLE blocks (
    key TEXT NOT NULL, block INTEGER NOT NULL, ids TEXT NOT NULL, sums TEXT NOT NULL, tally BLOB NOT NULL,
    checksum INTEGER NOT NULL, PRIMARY KEY (key, block)
);
"""


A_STORE = "a store (`mrac-jax sweep` makes one)"
SAVE = "save the intact runs: mrac-jax results NEW --merge THIS"
ROOM = "free disk space and run the same command again: the previous content is intact"
ERRORS: tuple[tuple[Any, str, str, str], ...] = (
    ("SQLITE_NOTADB", "is not a store", A_STORE, ""),
    (("SQLITE_FULL", "SQLITE_IOERR"), "cannot be {done} ({text})", "", ROOM),
    (("SQLITE_READONLY", "SQLITE_CANTOPEN"), "cannot be {done} ({text})", "a file and a folder that can be {done}", ""),
    (("SQLITE_BUSY", "SQLITE_LOCKED"), f"another process held it for {BUSY_SECONDS:g} s", "an unlocked store", ""),
    ("", "cannot be used ({text})", "", ""),
)
"""Begin of SQLite's name of an error; problem, expectation and fix of the StoreError."""


class StoreError(InputError):
    """A store cannot be read or written. Its previous content is intact."""


def open_file(path: Path, *, write: bool, whole: bool = True) -> sqlite3.Connection:
    """A connection to the store at `path`; with `write` a missing file is created. Raises StoreError.

    `whole`: also check the structure: pages, tables and indexes must agree, or rows may be missing.
    """
    # A dangling symbolic link is an error: its target may be on a disk that is not mounted.
    problem = why_no_file(path)
    if problem and (problem != "no such file" or not write or path.is_symlink()):
        raise StoreError(problem, source=printable(path), expected=A_STORE)
    if problem and not path.parent.is_dir():
        fix = f"make {printable(path.parent)} first"
        raise StoreError("cannot be made: its folder does not exist", source=printable(path), fix=fix)
    with _store_errors(path, write=write):
        connection = _connect(path, "mode=rwc") if write else _readable(path)
        try:
            if write:
                _prepare(connection, path)
            found = str(connection.execute("PRAGMA integrity_check(1)").fetchone()[0]) if whole else "ok"
            if found != "ok":
                raise damaged(path, found.replace("*** in database main ***", ""))
            if write:
                with transaction(connection):  # detect a file that cannot be written now, not after a sweep
                    connection.execute("PRAGMA user_version").fetchone()
                    connection.execute(f"PRAGMA user_version = {VERSION}")
            with suppress(sqlite3.DatabaseError):  # damage is reported when rows are read
                if connection.execute(_BY_VISITS).fetchone():
                    raise StoreError(PER_VISIT, source=printable(path))
        except BaseException:
            connection.close()
            raise
    return connection


def _connect(path: Path, parameters: str) -> sqlite3.Connection:
    address = f"file:{quote(os.fsencode(path.absolute()))}?{parameters}"
    connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=BUSY_SECONDS)
    # Text of a row may be damaged: the checksum detects that.
    connection.text_factory = lambda data: data.decode("utf-8", "surrogateescape")
    return connection


def _readable(path: Path) -> sqlite3.Connection:
    connection = _connect(path, "mode=rw")  # a read-write connection removes SQLite's -wal and -shm when it closes
    try:
        connection.execute("PRAGMA query_only = ON")
        _check(connection, path)
    except sqlite3.OperationalError:  # SQLite cannot create the WAL index on a read-only disk
        connection.close()
        if path.with_name(path.name + "-wal").exists():
            raise
        connection = _connect(path, "mode=ro&immutable=1")
        _check(connection, path)
    return connection


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    if _is_new(connection):
        with suppress(sqlite3.OperationalError):  # busy: another process creates it too, in WAL mode
            connection.execute("PRAGMA journal_mode = WAL")
        with transaction(connection):
            if _is_new(connection):
                _make(connection)
    _check(connection, path)
    wal = connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    connection.execute(f"PRAGMA synchronous = {'NORMAL' if wal else 'FULL'}")  # without WAL, NORMAL is not safe


def _is_new(connection: sqlite3.Connection) -> bool:
    """True for a file without tables and application id: just created, or its creator was killed."""
    mark = connection.execute("PRAGMA application_id").fetchone()[0]
    tables = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
    return mark == 0 and tables == 0


def _make(connection: sqlite3.Connection) -> None:
    for statement in (*TABLES.split(";"), f"PRAGMA application_id = {MARK}", f"PRAGMA user_version = {VERSION}"):
        connection.execute(statement)


def _check(connection: sqlite3.Connection, path: Path) -> None:
    mark = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if mark != MARK:
        what = "is empty" if _is_new(connection) else "is a database of another program"
        raise StoreError(what, source=printable(path), expected=A_STORE)
    if version > VERSION:
        problem, fix = f"is a store of version {version}, of a newer mrac-jax", "update mrac-jax, or use another store"
        raise StoreError(problem, source=printable(path), expected=f"version {VERSION} at most", fix=fix)
    if version < 1:
        raise damaged(path, f"version {version}")
    found = {" ".join(str(sql).split()) for (sql,) in connection.execute("SELECT sql FROM sqlite_master")}
    wanted = {" ".join(statement.split()) for statement in TABLES.split(";")} - {""}
    if not wanted <= found:
        raise damaged(path, "other tables")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """An exclusive transaction: complete or rolled back; other writers wait."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            with suppress(sqlite3.Error):
                connection.execute("ROLLBACK")
        raise


@contextmanager
def _store_errors(path: Path | None, *, write: bool = True) -> Iterator[None]:
    """Turn SQLite's errors into StoreErrors that name the file, the problem and a fix."""
    try:
        yield
    except UnicodeDecodeError as error:  # SQLite's message may quote undecodable bytes
        raise damaged(path, "text that is not UTF-8") from error
    except sqlite3.DatabaseError as error:
        code, text = getattr(error, "sqlite_errorname", "") or "", str(error)
        if code.startswith("SQLITE_CORRUPT") or "malformed" in text or (code == "SQLITE_ERROR" and "no such" in text):
            raise damaged(path, text) from error
        problem, expected, fix = next(words for codes, *words in ERRORS if code.startswith(codes))
        problem = problem.format(done="written" if write else "read", text=text)
        raise StoreError(problem, source=printable(path or "store"), expected=expected, fix=fix) from error


def damaged(path: Path | None, what: str) -> StoreError:
    """The error for a store whose bytes have changed."""
    what = " ".join(what.split())[:120]
    return StoreError(f"is damaged ({what})", source=printable(path or "store"), fix=SAVE)


def checksum(*parts: object) -> int:
    """crc32 of a row's columns."""
    total = 0
    for part in parts:
        data = part if isinstance(part, bytes) else str(part).encode("utf-8", "surrogateescape")
        total = zlib.crc32(data + b"\0", total)
    return total


MERGED = 256
"""Runs of another store that are merged in one transaction."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run in the store.

    Attributes:
        key: `cases.run_key`. what: labels for queries. facts: `cases.facts_of`.
        ids: stored rollouts. sums: `store_files.sums_of` over them; None: no rollouts.
    """

    key: str
    what: dict[str, Label]
    facts: Json
    ids: Ranges
    sums: Json | None

    @property
    def rollouts(self) -> int:
        """Number of stored rollouts."""
        return sum(stop - start for start, stop in self.ids)


class Store:
    """Runs and their tallies. One thread of a process may use a store; several processes may use one file."""

    def __init__(
        self, connection: sqlite3.Connection | None = None, path: Path | None = None, problem: str = ""
    ) -> None:
        """In memory; for files use `Store.open` or `Store.rescue`. `problem`: damage of the file's structure."""
        self.path, self.problem = path, problem
        if connection is None:
            connection = sqlite3.connect(":memory:", isolation_level=None)
            _make(connection)
        self._connection = connection

    @classmethod
    def open(cls, path: str | Path, *, write: bool = True) -> Store:
        """The store in this file; with `write` a missing file is created. Raises StoreError."""
        return cls(open_file(Path(path), write=write), Path(path))

    @classmethod
    def rescue(cls, path: str | Path) -> Store:
        """The readable content of a damaged store, for a merge into another. Raises StoreError."""
        try:
            return cls.open(path, write=False)
        except StoreError as error:
            try:
                connection = open_file(Path(path), write=False, whole=False)
            except StoreError as again:
                fix = again.fix.replace(SAVE, "take an older copy, or run the sweep again into another store")
                raise StoreError(again.problem, source=again.source, expected=again.expected, fix=fix) from error
            return cls(connection, Path(path), f"{error.source}: {error.problem}")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with _store_errors(self.path, write=False):
            return self._connection.execute(query, values).fetchall()

    def __len__(self) -> int:
        """Number of runs."""
        return int(self._rows("SELECT count(*) FROM runs")[0][0])

    def held(self, key: str) -> Ranges:
        """The stored rollout ids of a run: sorted, disjoint, not adjacent."""
        return joined(pair for ids, _ in self._parts(key) for pair in ids)

    def missing(self, key: str, start: int, stop: int) -> Ranges:
        """The ids of `start .. stop - 1` of a run that are not stored."""
        return without(((start, stop),) if start < stop else (), self.held(key))

    def tally(self, key: str) -> Tally | None:
        """The sum of all stored tallies of a run, or None. Raises StoreError for a damaged block."""
        tallies = [self._tally(row) for row in self._rows(f"{_BLOCKS} WHERE key = ? ORDER BY block", key)]
        return reduce(add, tallies) if tallies else None

    def run(self, key: str) -> Run | None:
        """A run, or None."""
        rows = self._rows(f"{_RUNS} WHERE key = ?", key)
        return self._run(rows[0]) if rows else None

    def runs(self) -> Iterator[Run]:
        """All runs, in order of insertion."""
        with _store_errors(self.path, write=False):
            for row in self._connection.execute(f"{_RUNS} ORDER BY rowid"):
                yield self._run(row)

    def labels(self) -> Iterator[dict[str, Label]]:
        """The labels of all runs."""
        with _store_errors(self.path, write=False):
            for row in self._connection.execute(_RUNS):
                yield self._as_json(row)[0]

    def label(self, key: str, what: Mapping[str, Label]) -> None:
        """Add labels to a run; existing labels are not changed."""
        for row in self._rows(f"{_RUNS} WHERE key = ?", key):
            if not what.keys() <= self._as_json(row)[0].keys():
                with _store_errors(self.path), transaction(self._connection):
                    self._add_run(key, row[1], dict(what), {})

    def forget(self, keys: Iterable[str]) -> None:
        """Remove runs, to save memory."""
        with _store_errors(self.path), transaction(self._connection):
            for key in keys:
                self._connection.execute("DELETE FROM runs WHERE key = ?", (key,))
                self._connection.execute("DELETE FROM blocks WHERE key = ?", (key,))

    def add(self, results: Iterable[RunResult]) -> dict[str, Ranges]:
        """Store results in one transaction. Returns the ids that were rejected, as they overlap stored ones.

        A part that is already stored is ignored; one that contains all stored ids replaces them. Of two parts that
        overlap otherwise (written by two processes) the larger is kept, and the ids of the other must run again. Raises
        StoreError if the file cannot be written (then nothing is stored), or if equal ids have different counts.
        """
        lost: dict[str, Ranges] = {}
        with _store_errors(self.path), transaction(self._connection):
            for result in results:
                for identity in {tally.key for tally in result.tallies}:
                    self._add_run(result.key, identity, result.what, result.facts)
                for tally in result.tallies:
                    left_out = self._add_block(result.key, tally)
                    if left_out:
                        lost[result.key] = joined([*lost.get(result.key, ()), *left_out])
        return lost

    def _add_run(self, key: str, identity: str, what: dict[str, Label], facts: Json) -> None:
        for row in self._rows(f"{_RUNS} WHERE key = ?", key):
            if row[1] != identity:
                problem = (
                    f"run {key[:12]} ({canonical(what)}) has another plan, of another version of METIS or mrac-jax"
                )
                raise StoreError(problem, source=self.path or "store", fix="use another store")
            held, known = self._as_json(row)
            if all(name in held for name in what):
                return
            what, facts = what | held, known
        texts = (key, identity, canonical(what), canonical(facts))
        self._connection.execute(
            "INSERT INTO runs VALUES (?, ?, ?, ?, ?) ON CONFLICT (key) DO UPDATE "
            "SET what = excluded.what, facts = excluded.facts, checksum = excluded.checksum",
            (*texts, checksum(*texts)),
        )

    def _add_block(self, key: str, tally: Tally) -> Ranges:
        """Unite this part of a block with the stored one; return the rejected ids."""
        block = tally.ids[0][0] // BLOCK
        left_out: Ranges = ()
        for row in self._rows(f"{_BLOCKS} WHERE key = ? AND block = ?", key, block):
            held = self._tally(row)
            new, old = without(tally.ids, held.ids), without(held.ids, tally.ids)
            if not new and not old and held != tally:
                problem = f"run {key[:12]}: the same rollouts {list(tally.ids)} have other counts here"
                raise StoreError(problem, source=self.path or "store", expected="reproducible rollouts")
            if not new:
                return ()
            if new == tally.ids:  # disjoint parts of one block add
                tally = tally + held
            elif old and tally.rollouts <= held.rollouts:
                return new
            else:
                left_out = old
        texts, blob = (key, block, canonical(tally.ids), canonical(sums_of(tally))), pack(tally)
        values = (*texts, blob, checksum(*texts, len(blob)))
        self._connection.execute("INSERT OR REPLACE INTO blocks VALUES (?, ?, ?, ?, ?, ?)", values)
        return left_out

    # A store that is damaged or merged: rows are found through the index and through the table, from both ends, since
    # a damaged page ends a scan. Each is read by its rowid and verified by its checksum; only rowids are in memory.

    def merge(self, other: Store) -> tuple[int, list[str]]:
        """Merge all intact results of another store. Returns the number of merged runs, and notes on omitted ones."""
        notes, count = list[str](), 0
        results = other.intact(notes)
        while batch := list(islice(results, MERGED)):
            notes += [f"run {key[:12]}: rollouts {list(ids)} overlap others" for key, ids in self.add(batch).items()]
            count += len(batch)
        return count, notes

    def intact(self, notes: list[str]) -> Iterator[RunResult]:
        """Every run with its intact blocks, in order of insertion; a note counts the damaged ones."""
        runs, blocks = self._reached("runs", "key"), self._reached("blocks", "key", "block")
        numbers: dict[str, list[int]] = {}
        for number, key, _ in sorted(blocks):
            numbers.setdefault(key, []).append(number)
        done, saved = set[str](), set[tuple[Any, ...]]()
        for number, key in sorted(runs):
            row = self._row(f"{_RUNS} WHERE rowid = ?", number, key)
            parts = [self._row(f"{_BLOCKS} WHERE rowid = ?", part, key) for part in numbers.get(key, ())]
            tallies: dict[int, Tally] = {}
            for part in filter(None, parts):
                with suppress(StoreError):
                    tallies[part[1]] = self._tally(part)
            if row is not None and checksum(*row[:-1]) == row[-1] and tallies:
                done.add(key)
                saved |= {(key, str(block)) for block in tallies}
                yield RunResult(key, json.loads(row[2]), json.loads(row[3]), tuple(tallies.values()))
        lost = len({key for _, key, *_ in runs | blocks} - done)
        gone = len({row[1:] for row in blocks} - saved)
        if self.problem or lost or gone:
            problem = f"{counted(lost, 'run')} and {counted(gone, 'block')} cannot be read"
            source = self.problem or printable(self.path or "store")
            notes.append(f"{source}: {problem}; lost entries of its index are not counted")

    def _reached(self, table: str, *columns: str) -> set[tuple[Any, ...]]:
        """(rowid, columns as text) of all rows that a scan reaches."""
        found = set[tuple[Any, ...]]()
        for way, names in (("NOT INDEXED", ("rowid",)), (f"INDEXED BY sqlite_autoindex_{table}_1", columns)):
            for order in ("ASC", "DESC"):
                by = ", ".join(f"{name} {order}" for name in names)
                query = f"SELECT rowid, {', '.join(columns)} FROM {table} {way} ORDER BY {by}"
                with suppress(sqlite3.DatabaseError):  # rows before a damaged page stay
                    found.update((number, *map(str, key)) for number, *key in self._connection.execute(query))
        return found

    def _row(self, query: str, number: int, key: str) -> tuple[Any, ...] | None:
        """A row if it is readable and belongs to this run."""
        with suppress(sqlite3.DatabaseError):
            for row in self._connection.execute(query, (number,)):
                return tuple(row) if row[0] == key else None
        return None

    def _run(self, row: tuple[Any, ...]) -> Run:
        what, facts = self._as_json(row)
        sums, ids = None, []
        for part, found in self._parts(row[0]):
            ids += part
            sums = found if sums is None else add_sums(sums, found)
        return Run(row[0], what, facts, joined(ids), sums)

    def _as_json(self, row: tuple[Any, ...]) -> tuple[dict[str, Label], Json]:
        """A run's labels and facts, without its blocks. Raises StoreError if they are damaged."""
        if checksum(*row[:-1]) != row[-1]:
            raise damaged(self.path, f"run {str(row[0])[:12]}")
        what = json.loads(row[2])
        what.pop("mode", None)  # a label of 0.3, which had several ways of sampling
        what = {RENAMED.get(name, name): value for name, value in what.items()}  # labels of 0.3's settings
        if isinstance(loop := what.get("plan_for"), str):
            what["plan_for"] = LOOPS.get(loop, loop)
        return what, json.loads(row[3])

    def _parts(self, key: str) -> Iterator[tuple[Any, Any]]:
        """(ids, sums) of the blocks of a run. Raises StoreError for a damaged block."""
        for *texts, length, said in self._rows(f"{_SUMS} WHERE key = ? ORDER BY block", key):
            if checksum(*texts, length) != said:
                raise damaged(self.path, f"run {key[:12]}, block {texts[1]}: wrong checksum")
            yield json.loads(texts[2]), json.loads(texts[3])

    def _tally(self, row: tuple[Any, ...]) -> Tally:
        key, block, ids, sums, blob, check = row
        try:
            if checksum(key, block, ids, sums, len(blob)) != check:
                raise ValueError("wrong checksum")
            return unpack(blob, tuple((start, stop) for start, stop in json.loads(ids)))
        except (ValueError, TypeError) as error:
            raise damaged(self.path, f"run {str(key)[:12]}, block {block}: {error}") from error


def merge_stores(path: Path, others: Sequence[Path]) -> None:
    """Copy the intact runs of other stores into the one at `path`, with a note for each. Raises InputError."""
    for other in others:
        if other.resolve() == path.resolve():
            raise UsageError(f"{argument('merge', other)} is the store itself", expected="another one")
    for other in others:
        with Store.rescue(other) as source, Store.open(path) as target:
            count, notes = target.merge(source)
        say([f"{other}: {counted(count, 'run')} taken over", *(f"left out: {note}" for note in notes)])


_BY_VISITS = """SELECT 1 FROM runs WHERE what LIKE '%"mode":"fast"%' OR what LIKE '%"mode":"step"%' LIMIT 1"""
_RUNS = "SELECT key, identity, what, facts, checksum FROM runs"
_BLOCKS = "SELECT key, block, ids, sums, tally, checksum FROM blocks"
_SUMS = "SELECT key, block, ids, sums, length(tally), checksum FROM blocks"
