"""Opening a store's file: SQLite in WAL mode, made, checked, versioned; what SQLite says when it cannot, in our words.

Crash-safe: a transaction is there whole or not at all, whenever the process is killed. Two processes may write at once:
each waits for the other's transaction. Power cut: in WAL mode with `synchronous = NORMAL` the file is whole, and holds
all but the last transactions. A flipped bit: rows carry checksums of their own, since SQLite has none, and SQLite's
check of the whole structure (`integrity_check`: no row is missing from an index or the table) is run whenever a store
is opened, at 1.6 s of CPU a gigabyte: little beside what reading its runs takes.
"""

from __future__ import annotations

import os
import sqlite3
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from planner.errors import InputError
from planner.files import printable, why_no_file

MARK = 0x4D524143
"""SQLite's application id of a store: "MRAC" in ASCII."""
VERSION = 1
"""Of the tables below."""
BUSY_SECONDS = 60.0
"""How long a transaction waits for another process's."""
TABLES = """
CREATE TABLE runs (
    key TEXT PRIMARY KEY, identity TEXT NOT NULL, what TEXT NOT NULL, facts TEXT NOT NULL, checksum INTEGER NOT NULL
);
CREATE TABLE blocks (
    key TEXT NOT NULL, block INTEGER NOT NULL, ids TEXT NOT NULL, sums TEXT NOT NULL, tally BLOB NOT NULL,
    checksum INTEGER NOT NULL, PRIMARY KEY (key, block)
);
"""


class StoreError(InputError):
    """A store that cannot be read or written; nothing that it held before is lost."""


def open_file(path: Path, *, write: bool, whole: bool = True) -> sqlite3.Connection:
    """A connection to the store at `path`; a new one is made if `write` and there is none. Raises StoreError.

    `whole`: its structure is checked too: pages, tables and indexes must agree, or rows may be missing.
    """
    problem = why_no_file(path)
    if problem and (problem != "no such file" or not write or path.is_symlink()):
        raise StoreError(problem, source=printable(path), expected="a store (`mrac-jax sweep` makes one)")
    if problem and not path.parent.is_dir():
        fix = f"make {printable(path.parent)} first"
        raise StoreError("cannot be made: its folder does not exist", source=printable(path), fix=fix)
    with told(path, write=write):
        connection = _connect(path, "mode=rwc") if write else _readable(path)
        try:
            if write:
                _prepare(connection, path)
            found = str(connection.execute("PRAGMA integrity_check(1)").fetchone()[0]) if whole else "ok"
            if found != "ok":
                raise damaged(path, found.replace("*** in database main ***", ""))
            if write:
                with transaction(connection):  # a file that cannot be written says so now
                    connection.execute("PRAGMA user_version").fetchone()
                    connection.execute(f"PRAGMA user_version = {VERSION}")
        except BaseException:
            connection.close()
            raise
    return connection


def _connect(path: Path, parameters: str) -> sqlite3.Connection:
    address = f"file:{quote(os.fsencode(path.absolute()))}?{parameters}"
    connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=BUSY_SECONDS)
    connection.text_factory = _text
    return connection


def _text(data: bytes) -> str:
    """Text of a row, damaged or not: its checksum tells."""
    return data.decode("utf-8", "surrogateescape")


def _readable(path: Path) -> sqlite3.Connection:
    connection = _connect(path, "mode=rw")  # who may write clears away SQLite's -wal and -shm when it is the last
    try:
        connection.execute("PRAGMA query_only = ON")
        _check(connection, path)
    except sqlite3.OperationalError:  # a folder or a disk that cannot be written has no room for SQLite's index of WAL
        connection.close()
        if path.with_name(path.name + "-wal").exists():
            raise
        connection = _connect(path, "mode=ro&immutable=1")
        _check(connection, path)
    return connection


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    if _is_new(connection):
        _make(connection)
    _check(connection, path)
    wal = connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    connection.execute(f"PRAGMA synchronous = {'NORMAL' if wal else 'FULL'}")  # without WAL less is not safe


def _is_new(connection: sqlite3.Connection) -> bool:
    """True for a file without a table and without a mark: it was made a moment ago, or its maker was killed."""
    mark = connection.execute("PRAGMA application_id").fetchone()[0]
    tables = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
    return mark == 0 and tables == 0


def _make(connection: sqlite3.Connection) -> None:
    patience = time.monotonic() + BUSY_SECONDS
    while True:
        try:  # another process may be making it too; SQLite does not wait here by itself
            connection.execute("PRAGMA journal_mode = WAL")
            break
        except sqlite3.OperationalError as error:
            if not _is_busy(error) or time.monotonic() > patience:
                raise
            time.sleep(0.02)
    with transaction(connection):
        if _is_new(connection):
            for statement in TABLES.split(";"):
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {MARK}")
            connection.execute(f"PRAGMA user_version = {VERSION}")


def _check(connection: sqlite3.Connection, path: Path) -> None:
    mark = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if mark != MARK:
        what = "is empty" if _is_new(connection) else "is a database of another program"
        raise StoreError(what, source=printable(path), expected="a store (`mrac-jax sweep` makes one)")
    if version > VERSION:
        raise StoreError(
            f"is a store of version {version}, of a newer mrac-jax",
            source=printable(path),
            expected=f"version {VERSION} at most",
            fix="update mrac-jax, or use another store",
        )
    if version < 1:
        raise damaged(path, f"version {version}")
    found = {" ".join(str(sql).split()) for (sql,) in connection.execute("SELECT sql FROM sqlite_master")}
    wanted = {" ".join(statement.split()) for statement in TABLES.split(";")} - {""}
    if not wanted <= found:
        raise damaged(path, "other tables")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """All or nothing, alone: other writers wait until it is over."""
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
def told(path: Path | None, *, write: bool = True) -> Iterator[None]:
    """SQLite's errors as StoreErrors that name the file, what is wrong and what to do."""
    try:
        yield
    except UnicodeDecodeError as error:  # of SQLite's own message, which cites what it cannot read
        raise damaged(path, "text that is no UTF-8") from error
    except sqlite3.DatabaseError as error:
        source = printable(path) if path else "store"
        code = getattr(error, "sqlite_errorname", "") or ""
        text = str(error)
        if code.startswith("SQLITE_NOTADB"):
            raise StoreError("is no store", source=source, expected="a file that `mrac-jax sweep` made") from error
        if code.startswith("SQLITE_CORRUPT") or "malformed" in text:
            raise damaged(path, text) from error
        if code.startswith(("SQLITE_FULL", "SQLITE_IOERR")):
            fix = "make room on the disk and run the same command again: what it held is still there"
            raise StoreError(f"cannot be {'written' if write else 'read'} ({text})", source=source, fix=fix) from error
        if code.startswith(("SQLITE_READONLY", "SQLITE_CANTOPEN")):
            expected = f"a file {'and a folder to write to' if write else 'that can be read'}"
            raise StoreError(
                f"cannot be {'written' if write else 'opened'} ({text})", source=source, expected=expected
            ) from error
        if _is_busy(error):
            expected = "a store that others leave alone for a moment"
            raise StoreError(
                f"another process held it for {BUSY_SECONDS:g} s", source=source, expected=expected
            ) from error
        if code == "SQLITE_ERROR" and "no such" in text:
            raise damaged(path, text) from error
        raise StoreError(f"cannot be used ({text})", source=source) from error


def damaged(path: Path | None, what: str) -> StoreError:
    """The error for a store whose bytes are not those that were written."""
    fix = "save what is intact: mrac-jax results NEW --merge THIS"
    what = " ".join(what.split())[:120]
    return StoreError(f"is damaged ({what})", source=printable(path) if path else "store", fix=fix)


def checksum(*parts: object) -> int:
    """crc32 of a row's columns."""
    total = 0
    for part in parts:
        data = part if isinstance(part, bytes) else str(part).encode("utf-8", "surrogateescape")
        total = zlib.crc32(data + b"\0", total)
    return total


def _is_busy(error: sqlite3.Error) -> bool:
    return (getattr(error, "sqlite_errorname", "") or "").startswith(("SQLITE_BUSY", "SQLITE_LOCKED"))
