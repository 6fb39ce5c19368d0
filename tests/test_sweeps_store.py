"""The store of sweeps: blocks that never count twice, union, bad and damaged files."""

import os
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_reader import refused

from analysis.cli.app import run
from analysis.sampling import RolloutChoices
from analysis.sweeps import cases
from analysis.sweeps import store as store_file
from analysis.sweeps.results import collect
from analysis.sweeps.spec import read_spec
from analysis.sweeps.store import Store, StoreError
from analysis.sweeps.store_files import add_sums, joined, pack, sums_of, unpack, without
from analysis.sweeps.sweep import Sweep, run_sweep
from planner.errors import PER_VISIT
from planner.tally import Tally

# The store: keys of content, blocks that grow and never count twice, union, and clear words for every bad file.

CASE = cases.generated_case("contiguous", 0.2, 2, seed=3, size=(7, 9))


def results_of(
    *ids: tuple[int, int], case: cases.Case = CASE, model: RolloutChoices | None = None
) -> list[cases.RunResult]:
    team, model = cases.Places().team(case), model or RolloutChoices(seed=5)
    return cases.run_task(cases.Task(case, team, (cases.RunRequest(cases.run_key(team, model), model, ids),)))


def key_of(case: cases.Case = CASE, model: RolloutChoices | None = None) -> str:
    return cases.run_key(cases.Places().team(case), model or RolloutChoices(seed=5))


def test_tally_survives_packing() -> None:
    tally = results_of((0, 100))[0].tallies[0]
    blob = pack(tally)
    assert unpack(blob, tally.ids) == tally
    assert len(blob) < 3000
    sums, values = sums_of(tally), np.arange(len(tally.visited))
    assert sums["visited"] == [int(tally.visited @ values), int(tally.visited @ values**2)]
    assert sums["rollouts"] == 100 == sum(sums["outcomes"]) == sums["luck"][0]
    half, other = (results_of(ids)[0].tallies[0] for ids in ((0, 40), (40, 100)))
    assert add_sums(sums_of(half), sums_of(other)) == sums
    before = {name: values for name, values in sums_of(half).items() if name != "luck"}
    assert add_sums(before, sums_of(other)) == add_sums(sums_of(other), before) != sums  # of an earlier release
    for broken in (blob[:-5], blob[:30] + bytes([blob[30] ^ 1]) + blob[31:], b""):
        with pytest.raises(ValueError, match="no tally"):
            unpack(broken, tally.ids)


def test_large_counts_survive_packing() -> None:
    tally = Tally.empty("key", (2, 3), 1, 5)
    for most in (0, 255, 256, 65_536, 2**32, 2**40):
        changed = replace(tally, ids=((0, 9),), visits=np.array([most, 0, 1, 2, 3, 4], dtype=np.int64))
        assert unpack(pack(changed), changed.ids) == changed


def test_key_is_of_content_alone() -> None:
    base = key_of()
    assert key_of(replace(CASE, labels=(("other", 1),))) == base
    assert base != key_of(model=RolloutChoices(seed=6)) != key_of(model=RolloutChoices(seed=5, loop="open"))
    assert key_of(model=RolloutChoices(first_only=True, seed=5)) != base != key_of(replace(CASE, robots=3))
    team = cases.Places().team(CASE)
    again = cases.Team(team.world, team.starts.copy(), team.settings)
    assert cases.run_key(again, RolloutChoices(seed=5)) == base
    turned = replace(again, starts=team.starts[::-1].copy())
    assert cases.run_key(turned, RolloutChoices(seed=5)) != base or len(set(team.starts)) == 1


def test_key_knows_the_shape() -> None:
    team = cases.Places().team(cases.Case(cases.Generated(size=(4, 6), ratio=0, obstacles=0), starts=((0, 0),)))
    other = cases.Places().team(cases.Case(cases.Generated(size=(6, 4), ratio=0, obstacles=0), starts=((0, 0),)))
    assert team.world.sha256 == other.world.sha256
    assert cases.run_key(team, RolloutChoices()) != cases.run_key(other, RolloutChoices())


def blocks_of(store: Store) -> list[int]:
    """Rollouts of each of its blocks."""
    return [tally.rollouts for result in store.intact([]) for tally in result.tallies]


def sql(path: Path, statement: str) -> list[tuple]:
    """The rows of a statement on a file, committed."""
    with closing(sqlite3.connect(path)) as connection, connection:
        return connection.execute(statement).fetchall()


@pytest.fixture
def store() -> Iterator[Store]:
    with Store() as opened:
        yield opened


def test_blocks_grow_and_nothing_counts_twice(store: Store) -> None:
    assert store.tally(key_of()) is None and store.run(key_of()) is None
    for ids in ((0, 50), (0, 50), (50, 120), (10, 90), (0, 300), (4000, 4200)):
        assert store.add(results_of(ids)) == {}
    whole = store.tally(key_of())
    assert whole is not None and whole.ids == ((0, 300), (4000, 4200))
    straight = results_of((0, 300))[0].tallies[0]
    assert whole == straight + results_of((4000, 4096))[0].tallies[0] + results_of((4096, 4200))[0].tallies[0]
    assert store.missing(key_of(), 0, 4100) == ((300, 4000),)
    (run,) = store.runs()
    assert run.sums == sums_of(whole) and run.rollouts == 500
    assert len(store) == 1 and blocks_of(store) == [500 - 104, 104]
    store.forget([key_of()])
    assert len(store) == 0 and store.tally(key_of()) is None


def test_a_block_is_added_without_reading_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a sweep of many blocks would take the square of their number."""
    with Store.open(tmp_path / "a.store") as store:
        store.add(results_of((0, 40)))
        with monkeypatch.context() as patched:
            patched.delattr(Store, "_parts")
            store.add(results_of((40, 100)))
            store.label(key_of(), {"of": "another sweep"})
        assert blocks_of(store) == [100]


def test_overlap_keeps_the_larger_and_says_what_is_to_be_run_again(store: Store) -> None:
    store.add(results_of((0, 200)))
    assert store.add(results_of((100, 250))) == {key_of(): ((200, 250),)}
    assert store.held(key_of()) == ((0, 200),)
    assert store.add(results_of((150, 600))) == {key_of(): ((0, 150),)}
    assert store.held(key_of()) == ((150, 600),)


def test_other_counts_of_the_same_rollouts_are_an_error(store: Store) -> None:
    (result,) = results_of((0, 50))
    (tally,) = result.tallies
    wrong = replace(result, tallies=(replace(tally, visits=tally.visits + 1),))
    other_plan = replace(result, tallies=(replace(tally, key="other", ids=((50, 100),)),))
    store.add([result])
    with pytest.raises(StoreError, match="other counts"):
        store.add([wrong])
    with pytest.raises(StoreError, match="has another plan"):
        store.add([other_plan])
    assert store.tally(key_of()) == tally


def test_labels_of_two_sweeps_find_the_same_run(tmp_path: Path) -> None:
    with Store.open(tmp_path / "a.db") as store:
        store.add(results_of((0, 20)))
        store.label(key_of(), {"sweep": "second", "robots": 99})
        (run,) = store.runs()
        assert run.what["sweep"] == "second" and run.what["robots"] == 2 and run.what["kind"] == "contiguous"
        assert run.facts["exact"]["visited"] > 0


def test_merge_is_the_union_of_blocks(tmp_path: Path) -> None:
    other_model = RolloutChoices(seed=5, loop="open")
    with Store.open(tmp_path / "a.db") as one, Store.open(tmp_path / "b.db") as two:
        one.add(results_of((0, 100)))
        two.add(results_of((0, 50), (5000, 5050)))
        two.add(results_of((0, 10), model=other_model))
        assert one.merge(two) == (2, [])
        assert one.held(key_of()) == ((0, 100), (5000, 5050))
        assert one.tally(key_of(model=other_model)) == two.tally(key_of(model=other_model))
        assert one.merge(two) == (2, []) and len(one) == 2


def test_bad_files(tmp_path: Path) -> None:
    text = tmp_path / "text.db"
    text.write_text("this is no database at all, though long enough to be one" * 100)
    other = tmp_path / "other.db"
    sql(other, "CREATE TABLE things (a)")
    newer = tmp_path / "newer.db"
    Store.open(newer).close()
    sql(newer, f"PRAGMA user_version = {store_file.VERSION + 1}")
    empty = tmp_path / "empty.db"
    empty.touch()
    found = {text: "is not a store", other: "another program", newer: "newer mrac-jax", tmp_path: "is a folder"}
    for path, words in found.items():
        before = path.read_bytes() if path.is_file() else b""
        for write in (True, False):
            with pytest.raises(StoreError, match=words) as caught:
                Store.open(path, write=write)
            assert str(path) in str(caught.value) and "\n" not in str(caught.value)
        assert not path.is_file() or path.read_bytes() == before
    for path, words in {tmp_path / "none.db": "no such file", empty: "is empty"}.items():
        with pytest.raises(StoreError, match=words):
            Store.open(path, write=False)
    with pytest.raises(StoreError, match="folder does not exist"):
        Store.open(tmp_path / "no" / "a.db")
    with Store.open(empty) as store:  # its maker was killed before its first transaction
        assert len(store) == 0


def test_a_reader_leaves_nothing_behind(tmp_path: Path) -> None:
    """Nor does it take the log of a writer that goes on, and it writes nothing."""
    path = tmp_path / "store.db"
    with Store.open(path) as writer:
        writer.add(results_of((0, 20)))
        with Store.open(path, write=False) as reader:
            assert reader.held(key_of()) == ((0, 20),)
            with pytest.raises(StoreError, match=r"store.db: cannot be written \(.*readonly"):
                reader.add(results_of((20, 40)))
        assert (tmp_path / "store.db-wal").exists()
    before = path.read_bytes()
    with Store.open(path, write=False):
        pass
    assert [one.name for one in tmp_path.iterdir()] == ["store.db"] and path.read_bytes() == before


def test_read_only(tmp_path: Path) -> None:
    """A store that cannot be written is read all the same; whoever wants to write is told at once."""
    path = tmp_path / "folder" / "a.db"
    path.parent.mkdir()
    with Store.open(path) as store:
        store.add(results_of((0, 20)))
    before = path.read_bytes()
    path.chmod(0o444)
    path.parent.chmod(0o555)
    try:
        with Store.open(path, write=False) as store:
            assert store.held(key_of()) == ((0, 20),)
        if os.geteuid() != 0:  # nothing is read-only for root
            with pytest.raises(StoreError, match="cannot be written"):
                Store.open(path)
        assert path.read_bytes() == before
    finally:
        path.parent.chmod(0o755)


def test_no_room_on_the_disk(tmp_path: Path) -> None:
    """What SQLite says when the disk is full: nothing of the transaction is there, everything before it is."""
    with Store.open(tmp_path / "a.db") as store:
        store.add(results_of((0, 20)))
        pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
        store._connection.execute(f"PRAGMA max_page_count = {pages}")
        more = [results_of((0, 20), model=RolloutChoices(seed=seed))[0] for seed in range(20)]
        with pytest.raises(StoreError, match=r"disk is full.*free disk space"):
            store.add(more)
        assert len(store) == 1 and store.held(key_of()) == ((0, 20),)
        store._connection.execute("PRAGMA max_page_count = 100000")
        store.add(more)
        assert len(store) == 20


def test_ranges() -> None:
    assert joined([(5, 9), (0, 2), (2, 4), (8, 12)]) == ((0, 4), (5, 12))
    assert without(((0, 10), (20, 30)), ((2, 3), (9, 22), (29, 40))) == ((0, 2), (3, 9), (22, 29))
    assert without(((0, 10),), ()) == ((0, 10),) and without((), ((0, 1),)) == ()


# --- a store of release 0.3 ---

EARLIER_STORE = Path(__file__).parent / "fixtures" / "release-0.3.store"
"""Made by release 0.3.0 from the sweeps below, 64 rollouts a run: 2 runs that no change of the rules concerns, then 1
each of robots that come home, threats that change, and walkers without `plan_on`."""
SWEEP = "base: {size: 6x6, robots: 2%s}\nmaps: 1\nrollouts: 64\nsweep: {policy: [%s]}\n"
SAME = SWEEP % ("", "mrac, per_cell")
RENEWED = {
    "home": SWEEP % (", return_to: home", "mrac"),
    "phases": SWEEP % (", phases: [{from: 3, threats: []}]", "mrac"),
    "walkers": SWEEP % (", moving_threats: [{walk: 0.5, h: threats}]", "mrac"),
}


def swept(folder: Path, text: str, store: Store) -> Sweep:
    (folder / "sweep.yaml").write_text(text)
    return run_sweep(read_spec(folder / "sweep.yaml"), store, processes=1)


def test_a_store_of_release_0_3_goes_on_where_its_rules_are_todays(tmp_path: Path) -> None:
    shutil.copy(EARLIER_STORE, tmp_path / "a.store")
    with Store.open(tmp_path / "a.store") as store:
        assert len(store) == 5
        again = swept(tmp_path, SAME, store)
        assert (again.finished.rollouts, again.finished.reused) == (0, 128) and len(store) == 5
        # where `plan_on` is given, or nothing changes that robots are told of, the rules are those of then
        moving = "moving_threats: [{walk: 0.5, h: threats}], plan_on: own"
        for more in ("phases: [{from: 3, threats: []}], plan_on: first", moving):
            assert "rules" not in swept(tmp_path, SWEEP % (f", {more}", "mrac"), store).rows[0].labels
        assert all("rules" not in what for what in store.labels())


@pytest.mark.parametrize("name", RENEWED)
def test_it_is_never_mixed_with_runs_by_rules_that_changed(tmp_path: Path, name: str) -> None:
    shutil.copy(EARLIER_STORE, tmp_path / "a.store")
    with Store.open(tmp_path / "a.store") as store:
        for drawn, reused in ((64, 0), (0, 64)):
            made = swept(tmp_path, RENEWED[name], store)
            assert (made.finished.rollouts, made.finished.reused, len(store)) == (drawn, reused, 6)
        for by in ((), ("policy",), ("robots",)):
            found = collect(store, {}, by)
            assert {row.labels["rules"] for row in found.rows} == {None, "0.4", "before 0.4"}
            assert [row.rollouts for row in found.rows if row.labels["rules"]] == [64, 64]
        assert collect(store, {"rules": ("0.4",)}).runs == 1


@pytest.mark.parametrize("mode", ["step", "fast"])
def test_a_store_of_rollouts_drawn_visit_by_visit_names_the_release(
    mode: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "old.store"
    shutil.copy(EARLIER_STORE, old)
    sql(old, f"""UPDATE runs SET what = replace(what, '"tolerance"', '"{mode}"') WHERE rowid = 2""")
    for opened in (Store.open, Store.rescue):
        with pytest.raises(StoreError, match=re.escape(PER_VISIT)):
            opened(old)
    (tmp_path / "sweep.yaml").write_text(SAME)
    for words in (
        ["results", old],
        ["results", tmp_path / "new", "--merge", old],
        ["sweep", tmp_path / "sweep.yaml", "--store", old],
    ):
        assert run([str(word) for word in words]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line == f"error: {old}: {PER_VISIT}"


# A damaged store: nothing is missing without a word, no error is SQLite's own, and what is intact can be saved.

CASES = [cases.generated_case("scattered", 0.2, 1, seed=seed, size=(5, 6)) for seed in range(6)]
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
    roots = dict(sql(path, "SELECT name, rootpage FROM sqlite_master"))
    assert sql(path, "PRAGMA freelist_count")[0][0] > 0
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
    with Store.rescue(path) as store, Store() as rescued:
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
def test_one_flipped_bit_or_cut(
    whole: Path, tmp_path: Path, use: Callable[[Path, dict[str, Tally | None]], bool]
) -> None:
    """Three flips in each part of the file, and eight cuts: what is right, or a StoreError or note about this file."""
    with Store.open(whole, write=False) as store:
        right = tallies(store)
    data, random, refused = whole.read_bytes(), np.random.default_rng(0), {"flip": 0, "cut": 0}
    changed = [("cut", data[:at]) for at in random.integers(1, len(data), 8).tolist()]
    flipped = [at for place in places(whole).values() for at in random.choice(place, 3).tolist()]
    changed += [
        ("flip", data[:at] + bytes([data[at] ^ 1 << number % 8]) + data[at + 1 :]) for number, at in enumerate(flipped)
    ]
    for number, (how, content) in enumerate(changed):
        bad = tmp_path / f"{number}.store"
        bad.write_bytes(content)
        try:
            assert use(bad, right), (how, number)
        except StoreError as error:
            refused[how] += 1
            assert bad.name in str(error) and "\n" not in str(error)
    assert refused["flip"] < 20 and ((refused["flip"] >= 2 and refused["cut"] == 8) or use is merged)


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
    assert "6 runs taken over" in said.err and "0 runs and 0 blocks cannot be read" in said.err
    with Store.open(whole, write=False) as right, Store.open(new, write=False) as saved:
        assert tallies(saved) == tallies(right)


def test_what_cannot_be_saved_is_counted(whole: Path, tmp_path: Path) -> None:
    """A leaf of the table of blocks is overwritten: its rows are gone, the index still names them."""
    bad = tmp_path / "bad.store"
    data = bytearray(whole.read_bytes())
    found = sql(whole, "SELECT pageno FROM dbstat WHERE name = 'blocks' AND pagetype = 'leaf'")
    page = found[len(found) // 2][0] - 1
    data[page * PAGE : (page + 1) * PAGE] = bytes(PAGE)
    bad.write_bytes(data)
    with Store.rescue(bad) as store, Store() as rescued:
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
    assert sql(path, "PRAGMA journal_mode = DELETE") == [("delete",)]
    with Store.open(path) as store:
        assert store._connection.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL
