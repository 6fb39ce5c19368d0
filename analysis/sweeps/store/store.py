"""The store: tallies of runs by aligned block of 4,096 rollout ids, in one file that survives being killed.

A run is found by its key (`cases.run_key`), so that whoever wants it again finds it, whatever the sweep. Blocks only
grow: a part of a block that is there already is never counted twice, and stores merge by union.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from itertools import islice
from operator import add
from pathlib import Path
from typing import Any

from analysis.sweeps.cases import Label, canonical
from analysis.sweeps.store.file import StoreError, checksum, damaged, open_file, told, transaction
from analysis.sweeps.store.packed import add_sums, pack, sums_of, unpack
from analysis.sweeps.store.ranges import Ranges, joined, without
from analysis.sweeps.store.salvage import rows_of
from analysis.sweeps.tasks import RunResult
from planner.files import Json, printable
from planner.limits import BLOCK
from planner.shown import counted
from planner.tally import Tally

MERGED = 256
"""Runs of another store that are taken over in one transaction."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run as the store knows it.

    Attributes:
        key: `cases.run_key`. what: the labels that it is found by. facts: `tasks.facts_of`.
        ids: the rollouts held. sums: `packed.sums_of` over them; None without any.
    """

    key: str
    what: dict[str, Label]
    facts: Json
    ids: Ranges
    sums: Json | None

    @property
    def rollouts(self) -> int:
        """How many rollouts it holds."""
        return sum(stop - start for start, stop in self.ids)


class Store:
    """Runs and their tallies. Only one thread of a process uses a store; several processes may use one file."""

    def __init__(self, connection: sqlite3.Connection, path: Path | None, problem: str = "") -> None:
        """Use `Store.open` or `Store.rescue`. `problem`: what is wrong with the file's structure."""
        self._connection, self.path, self.problem = connection, path, problem

    @classmethod
    def open(cls, path: str | Path, *, write: bool = True) -> Store:
        """The store in this file; with `write` it is made if there is none. Raises StoreError."""
        return cls(open_file(Path(path), write=write), Path(path))

    @classmethod
    def rescue(cls, path: str | Path) -> Store:
        """The store in this file, to be merged into another: whatever is still intact of it. Raises StoreError."""
        try:
            return cls.open(path, write=False)
        except StoreError as error:
            try:
                connection = open_file(Path(path), write=False, whole=False)
                return cls(connection, Path(path), f"{error.source}: {error.problem}")
            except StoreError as again:
                fix = "take an older copy, or run the sweep again into another store"
                raise StoreError(again.problem, source=again.source, expected=again.expected, fix=fix) from error

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()

    def forget(self, keys: Iterable[str]) -> None:
        """Nobody asks for these runs again: a file keeps them."""

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with told(self.path, write=False):
            return self._connection.execute(query, values).fetchall()

    def __len__(self) -> int:
        """How many runs it holds."""
        return int(self._rows("SELECT count(*) FROM runs")[0][0])

    def held(self, key: str) -> Ranges:
        """The rollout ids of a run that are here: sorted, disjoint, not touching."""
        return joined(pair for ids, _ in self._parts(key) for pair in ids)

    def missing(self, key: str, start: int, stop: int) -> Ranges:
        """The ids of `start .. stop - 1` of a run that are not here."""
        return without(((start, stop),) if start < stop else (), self.held(key))

    def tally(self, key: str) -> Tally | None:
        """Everything that is held of a run, or None. Raises StoreError for a damaged block."""
        tallies = [self._tally(row) for row in self._rows(f"{_BLOCKS} WHERE key = ? ORDER BY block", key)]
        return reduce(add, tallies) if tallies else None

    def run(self, key: str) -> Run | None:
        """A run, or None."""
        rows = self._rows(f"{_RUNS} WHERE key = ?", key)
        return self._run(rows[0]) if rows else None

    def runs(self) -> Iterator[Run]:
        """All runs, in the order in which they were added."""
        with told(self.path, write=False):
            for row in self._connection.execute(f"{_RUNS} ORDER BY rowid"):
                yield self._run(row)

    def labels(self) -> Iterator[dict[str, Label]]:
        """The labels of all runs."""
        with told(self.path, write=False):
            for row in self._connection.execute(_RUNS):
                yield self._said(row)[0]

    def label(self, key: str, what: Mapping[str, Label]) -> None:
        """Let a run be found by these labels too; those that it has stay as they are."""
        for row in self._rows(f"{_RUNS} WHERE key = ?", key):
            if not what.keys() <= self._said(row)[0].keys():
                with told(self.path), transaction(self._connection):
                    self._add_run(key, row[1], dict(what), {})

    def add(self, results: Iterable[RunResult]) -> dict[str, Ranges]:
        """Keep results, in one transaction. Returns the ids that could not be: of parts that overlap what is here.

        A part that is here already is left as it is, one that holds all that is here replaces it; of two that overlap
        otherwise (two processes at once) the larger is kept, and the ids of the other are to be run again. Raises
        StoreError if the file cannot be written (then nothing of it is), or if the same ids have other counts.
        """
        lost: dict[str, Ranges] = {}
        with told(self.path), transaction(self._connection):
            for result in results:
                for identity in {tally.key for tally in result.tallies}:
                    self._add_run(result.key, identity, result.what, result.facts)
                for tally in result.tallies:
                    left_out = self._add_block(result.key, tally)
                    if left_out:
                        lost[result.key] = joined([*lost.get(result.key, ()), *left_out])
        return lost

    def merge(self, other: Store) -> tuple[int, list[str]]:
        """Take over everything that is intact in another store: (runs taken over, what was left out and why)."""
        notes, count = list[str](), 0
        results = other._results(notes)
        while batch := list(islice(results, MERGED)):
            notes += [f"run {key[:12]}: rollouts {list(ids)} overlap others" for key, ids in self.add(batch).items()]
            count += len(batch)
        return count, notes

    def _results(self, notes: list[str]) -> Iterator[RunResult]:
        """Every run with its blocks, whatever of them is intact; what is not is counted in a note."""
        rows, runs, blocks = rows_of(self._connection), 0, set[tuple[str, int]]()
        for key, numbers in rows.runs.items():
            own = [row for n in numbers if (row := self._row(f"{_RUNS} WHERE rowid = ?", n, key)) and _is_run(row)]
            tallies = {tally.ids[0][0] // BLOCK: tally for tally in self._intact(key, rows.blocks.get(key, ()))}
            if own and tallies:
                runs += 1
                blocks |= {(key, block) for block in tallies}
                yield RunResult(key, json.loads(own[0][2]), json.loads(own[0][3]), tuple(tallies.values()))
        lost, gone = len({key for key, _ in rows.named} | rows.runs.keys()) - runs, len(rows.named - blocks)
        if self.problem or lost or gone:
            told_of = f"{counted(lost, 'run')} and {counted(gone, 'block')} that it names cannot be read"
            source = self.problem or printable(self.path or "store")
            notes.append(f"{source}: {told_of}; whatever it does not name any more is not counted")

    def _intact(self, key: str, numbers: Iterable[int]) -> Iterator[Tally]:
        """The blocks of a run in these rows that are whole."""
        for number in sorted(numbers):
            row = self._row(f"{_BLOCKS} WHERE rowid = ?", number, key)
            if row is not None:
                with suppress(StoreError):
                    yield self._tally(row)

    def _row(self, query: str, number: int, key: str) -> tuple[Any, ...] | None:
        """A row that says that it is of this run, or None: the file may be damaged."""
        with suppress(sqlite3.DatabaseError):
            for row in self._connection.execute(query, (number,)):
                return tuple(row) if row[0] == key else None
        return None

    def _add_run(self, key: str, identity: str, what: dict[str, Label], facts: Json) -> None:
        for row in self._rows(f"{_RUNS} WHERE key = ?", key):
            check_identity(key, row[1], identity, what, self.path)
            held, known = self._said(row)
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
        """Union of this part of a block with what is here; the ids that could not be kept."""
        block = tally.ids[0][0] // BLOCK
        left_out: Ranges = ()
        for row in self._rows(f"{_BLOCKS} WHERE key = ? AND block = ?", key, block):
            held = self._tally(row)
            tally, left_out = united(key, held, tally, self.path)
            if tally is held:
                return left_out
        texts, blob = (key, block, canonical(tally.ids), canonical(sums_of(tally))), pack(tally)
        values = (*texts, blob, checksum(*texts, len(blob)))
        self._connection.execute("INSERT OR REPLACE INTO blocks VALUES (?, ?, ?, ?, ?, ?)", values)
        return left_out

    def _run(self, row: tuple[Any, ...]) -> Run:
        what, facts = self._said(row)
        sums, ids = None, []
        for part, found in self._parts(row[0]):
            ids += part
            sums = found if sums is None else add_sums(sums, found)
        return Run(row[0], what, facts, joined(ids), sums)

    def _said(self, row: tuple[Any, ...]) -> tuple[dict[str, Label], Json]:
        """A run's labels and facts, without reading its blocks. Raises StoreError for a damaged one."""
        if not _is_run(row):
            raise damaged(self.path, f"run {str(row[0])[:12]}")
        return json.loads(row[2]), json.loads(row[3])

    def _parts(self, key: str) -> Iterator[tuple[Any, Any]]:
        """(ids, sums) of the blocks of a run. Raises StoreError for a damaged one."""
        for *texts, length, said in self._rows(f"{_SUMS} WHERE key = ? ORDER BY block", key):
            if checksum(*texts, length) != said:
                raise damaged(self.path, f"run {key[:12]}, block {texts[1]}: another checksum")
            yield json.loads(texts[2]), json.loads(texts[3])

    def _tally(self, row: tuple[Any, ...]) -> Tally:
        key, block, ids, sums, blob, check = row
        try:
            if checksum(key, block, ids, sums, len(blob)) != check:
                raise ValueError("another checksum")
            return unpack(blob, tuple((start, stop) for start, stop in json.loads(ids)))
        except (ValueError, TypeError) as error:
            raise damaged(self.path, f"run {str(key)[:12]}, block {block}: {error}") from error


def check_identity(key: str, held: str, identity: str, what: Mapping[str, Label], path: Path | None) -> None:
    """Raise StoreError where a run's rollouts would be of another identity than those that are `held`."""
    if held != identity:
        problem = f"run {key[:12]} ({canonical(what)}) was planned otherwise, by another METIS or mrac-jax"
        raise StoreError(problem, source=path or "store", fix="use another store")


def united(key: str, held: Tally, tally: Tally, path: Path | None) -> tuple[Tally, Ranges]:
    """What is kept of two parts of a block, and the ids that cannot be; `held` itself, if nothing is new in `tally`.

    Raises StoreError if the same ids have other counts.
    """
    new, old = without(tally.ids, held.ids), without(held.ids, tally.ids)
    if not new and not old and held != tally:
        problem = f"run {key[:12]}: the same rollouts {list(tally.ids)} have other counts here"
        raise StoreError(problem, source=path or "store", expected="rollouts that repeat")
    if not new or not old:
        return (tally if new else held), ()
    if new == tally.ids:
        return tally + held, ()
    return (tally, old) if tally.rollouts > held.rollouts else (held, new)


def _is_run(row: tuple[Any, ...]) -> bool:
    return checksum(*row[:-1]) == row[-1]


_RUNS = "SELECT key, identity, what, facts, checksum FROM runs"
_BLOCKS = "SELECT key, block, ids, sums, tally, checksum FROM blocks"
_SUMS = "SELECT key, block, ids, sums, length(tally), checksum FROM blocks"
