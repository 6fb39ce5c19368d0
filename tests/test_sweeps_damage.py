"""A damaged store: nothing is missing without a word, no error is SQLite's own, and what is intact can be saved."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from test_sweeps_store import key_of, results_of

from analysis.cli.app import run
from analysis.sweeps.cases import generated_case
from analysis.sweeps.results import collect
from analysis.sweeps.store import Memory, Store, StoreError
from planner.tally import Tally

CASES = [generated_case("scattered", 0.2, 1, seed=seed, size=(5, 6)) for seed in range(6)]
IDS = ((0, 20), (4096, 4106), (8192, 8202))
PAGE = 4096


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of six runs of three blocks each, with pages that were freed again."""
    path = tmp_path_factory.mktemp("store") / "whole.store"
    with Store.open(path) as store:
        for case in CASES:
            store.add(results_of(*IDS, case=case))
    connection = sqlite3.connect(path)
    connection.executescript("CREATE TABLE more (a); INSERT INTO more VALUES (zeroblob(20000)); DROP TABLE more")
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    return path


def tallies(store: Store) -> dict[str, Tally | None]:
    return {key_of(case): store.tally(key_of(case)) for case in CASES}


def places(path: Path) -> dict[str, range]:
    """Bytes of the file by what lies there."""
    connection = sqlite3.connect(path)
    roots = dict(connection.execute("SELECT name, rootpage FROM sqlite_master").fetchall())
    assert connection.execute("PRAGMA freelist_count").fetchone()[0] > 0
    connection.close()
    free = int.from_bytes(path.read_bytes()[32:36], "big")
    pages = {"runs": roots["runs"], "index of runs": roots["sqlite_autoindex_runs_1"], "freelist": free}
    pages |= {"blocks": roots["blocks"], "index of blocks": roots["sqlite_autoindex_blocks_1"]}
    found = {name: range((page - 1) * PAGE, page * PAGE) for name, page in pages.items()}
    return found | {"header": range(100), "schema": range(100, PAGE), "all": range(path.stat().st_size)}


def read(path: Path, right: dict[str, Tally | None]) -> bool:
    """True if everything that it says is right."""
    with Store.open(path, write=False) as store:
        found = collect(store, {})
        return found.runs == len(CASES) and tallies(store) == right


def merged(path: Path, right: dict[str, Tally | None]) -> bool:
    """True if all is there, or what is not was said."""
    with Store.rescue(path) as store, Memory() as rescued:
        _, notes = rescued.merge(store)
        return bool(notes) or tallies(rescued) == right


def resumed(path: Path, right: dict[str, Tally | None]) -> bool:
    """True if the store holds the right counts after what it lacks was run again."""
    with Store.open(path) as store:
        for case in CASES:
            missing = [ids for start, stop in IDS for ids in store.missing(key_of(case), start, stop)]
            if missing:
                store.add(results_of(*missing, case=case))
        return tallies(store) == right


@pytest.mark.parametrize("use", [read, merged, resumed])
def test_one_flipped_bit(whole: Path, tmp_path: Path, use: Callable[[Path, dict[str, Tally | None]], bool]) -> None:
    """Three flips in each part of the file: what is right, or a StoreError or note about this file."""
    with Store.open(whole, write=False) as store:
        right = tallies(store)
    data, random, refused = whole.read_bytes(), np.random.default_rng(0), 0
    for name, place in places(whole).items():
        for trial in range(3):
            bad, at = tmp_path / f"{name}{trial}.store", int(random.choice(place))
            bad.write_bytes(data[:at] + bytes([data[at] ^ 1 << int(random.integers(8))]) + data[at + 1 :])
            try:
                assert use(bad, right), (name, at)
            except StoreError as error:
                refused += 1
                assert bad.name in str(error) and "\n" not in str(error)
    assert refused < 20 and (refused >= 2 or use is merged)


def hide_a_block(path: Path) -> None:
    """Let the index of blocks say one entry less than it has: its last run seems to have fewer rollouts."""
    at = places(path)["index of blocks"].start
    data = bytearray(path.read_bytes())
    assert data[at] == 10  # a leaf; its number of cells stands at 3 and 4
    data[at + 4] -= 1
    path.write_bytes(data)


def test_a_hidden_block_is_said_and_saved(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad, new = tmp_path / "bad.store", tmp_path / "new.store"
    bad.write_bytes(whole.read_bytes())
    hide_a_block(bad)
    for write in (True, False):
        with pytest.raises(StoreError, match=r"bad.store: is damaged.*--merge"):
            Store.open(bad, write=write)
    refused(capsys, "results", str(bad))
    assert run(["results", str(new), "--merge", str(bad)]) == 0
    said = capsys.readouterr()
    assert "6 runs taken over" in said.err and "0 runs and 0 blocks that it names cannot be read" in said.err
    with Store.open(whole, write=False) as right, Store.open(new, write=False) as saved:
        assert tallies(saved) == tallies(right)


def test_what_cannot_be_saved_is_counted(whole: Path, tmp_path: Path) -> None:
    """A leaf of the table of blocks is overwritten: its rows are gone, the index still names them."""
    bad = tmp_path / "bad.store"
    data = bytearray(whole.read_bytes())
    connection = sqlite3.connect(whole)
    found = connection.execute("SELECT pageno FROM dbstat WHERE name = 'blocks' AND pagetype = 'leaf'").fetchall()
    connection.close()
    page = found[len(found) // 2][0] - 1
    data[page * PAGE : (page + 1) * PAGE] = bytes(PAGE)
    bad.write_bytes(data)
    with Store.rescue(bad) as store, Memory() as rescued:
        count, (note,) = rescued.merge(store)
        held = sum(rescued.held(key_of(case)) == IDS for case in CASES)
        blocks = sum(len(rescued.held(key_of(case))) for case in CASES)
    assert 0 < held < 6 and count == len(rescued_runs(note, blocks))


def rescued_runs(note: str, blocks: int) -> range:
    """The runs that a note leaves over; it counts what is lost."""
    lost_runs, lost_blocks = (int(words.split()[0]) for words in note.split(": ")[-1].split(" and ")[:2])
    assert lost_blocks == 18 - blocks > 0
    return range(6 - lost_runs)


def test_what_survives_a_power_cut_is_asked_for(tmp_path: Path) -> None:
    """docs/sweeps.md says what this promises."""
    path = tmp_path / "a.store"
    for _ in range(2):
        with Store.open(path) as store:
            assert store._connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
            assert store._connection.execute("PRAGMA synchronous").fetchone() == (1,)  # NORMAL
    connection = sqlite3.connect(path)
    assert connection.execute("PRAGMA journal_mode = DELETE").fetchone() == ("delete",)
    connection.close()
    with Store.open(path) as store:
        assert store._connection.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL
