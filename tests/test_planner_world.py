"""The world: what it accepts, where its cells lie on the ground, its file, its identity, and its graph."""

from __future__ import annotations

import errno
import hashlib
import os
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER, worlds_with_starts
from hypothesis import given

import planner.csv_tables
import planner.files
from planner.errors import InputError, MapError, WorldError
from planner.files import atomic_write
from planner.mrac.paths import to_networkx
from planner.world.map_files import load_map
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file


@pytest.mark.parametrize(
    ("threat", "said"),
    [
        ([[0.0, -0.1]], "threat is -0.1 at"),
        ([[0.0, 1.0]], "threat is 1 at"),
        ([[0.0], [np.inf]], "threat is inf at"),
        ([[np.nan, np.nan]], "every cell is an obstacle"),
        ([], "shape"),
        ([0.0, 0.1], "shape"),
        (np.zeros((0, 3)), "shape"),
        ([["a"]], "numbers"),
        ([[0.99999999]], "threat is"),
    ],
)
def test_wrong_threats_are_named(threat: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        World.create(threat)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("starts", "said"),
    [
        ([[0, 1]], "robot 0 starts at \\[0, 1\\], an obstacle"),
        ([[0, 0], [2, 0]], "robot 1 starts at \\[2, 0\\], outside the map"),
        ([[-1, 0]], "outside the map"),
        ([[0.5, 0]], "whole numbers"),
        ([], "shape"),
        ([0, 0], "shape"),
        (np.zeros((1025, 2), int), "at most 1024"),
    ],
)
def test_wrong_starts_are_named(starts: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        World.create([[0.0, np.nan, 0.0], [0.0, 0.0, 0.0]], starts)  # type: ignore[arg-type]


@pytest.mark.parametrize(("size", "origin"), [(0.0, (0, 0, 0)), (-1.0, (0, 0, 0)), (np.nan, (0, 0, 0)), (1.0, (0, 0))])
def test_wrong_frames_are_named(size: float, origin: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"cell_size|origin"):
        World.create([[0.0]], cell_size=size, origin=origin)


def test_masked_cells_are_obstacles() -> None:
    """NumPy hands out the numbers under the mask to whoever asks for an array: they are no threats."""
    threat = np.ma.masked_array([[0.0, 0.25], [0.5, 7.0]], mask=[[True, False], [False, True]])
    np.testing.assert_array_equal(World.create(threat).threat, np.array([[np.nan, 0.25], [0.5, np.nan]]))
    whole = np.ma.masked_equal(np.array([[0, -1], [-1, 0]]), -1)
    np.testing.assert_array_equal(World.create(whole).free, [[True, False], [False, True]])
    assert World.create(np.ma.masked_array([[0.0, 0.5]])).free.all()
    with pytest.raises(WorldError, match="masked"):
        World.create(np.zeros((2, 2)), starts=np.ma.masked_array([[0, 1]], mask=[[False, True]]))


def test_masked_values_are_missing_under_free_cells_alone() -> None:
    """As pixels of a raster without data are."""
    given = np.ma.masked_array([[1.0, 0.25], [0.5, 0.75]], mask=[[True, False], [False, True]])
    obstacles = np.array([[np.nan, 0], [0, np.nan]])
    world = World.create(obstacles).with_values(given, given)
    for layer in (world.value, world.detect):
        assert layer is not None and layer.tolist() == [[0, 0.25], [0.5, 0]]
    for name in ("value", "detect"):
        with pytest.raises(WorldError, match=rf"{name} is masked at \[0, 0\] \(2 such cells\)"):
            World.create(np.zeros((2, 2))).with_values(**{name: given})
    with pytest.raises(WorldError, match="value is masked"):
        World.create(np.zeros((2, 2)), value=np.ma.masked)


def test_csv_is_read_in_batches_and_a_wrong_line_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner.csv_tables, "CSV_BATCH", 40)
    file, rows = tmp_path / "w.csv", [f"0.{n:03d}, nan,{' ' * (n % 3)}-1,0.5e-3" for n in range(200)]
    file.write_text("\ufeff" + "\r\n\r\n".join(rows) + "\n\n")
    expected = np.array([[n / 1000, np.nan, np.nan, 0.0005] for n in range(200)], dtype=np.float32)
    np.testing.assert_array_equal(load_world_file(file).threat, expected)
    for line, problem in (
        ("0,0,0", "line 151 has 3 values; expected 4"),
        ("0,0,x,0", "line 151, column 2: 'x' is no number"),
    ):
        file.write_text("\n".join([*rows[:150], line, *rows[150:]]))
        with pytest.raises(MapError, match=problem):
            load_world_file(file)
    file.write_text("1_0e-2,0\n")  # Python's own reading of numbers
    assert load_world_file(file).threat.tolist()[0] == pytest.approx([0.1, 0])


def test_a_csv_file_too_large_is_refused_at_once(tmp_path: Path) -> None:
    with (tmp_path / "w.csv").open("wb") as out:
        out.truncate(planner.csv_tables.MAX_CSV_BYTES + 1)
    with pytest.raises(MapError, match=r"67108865 bytes; expected .* of at most 67108864; save it as \.npz"):
        load_world_file(tmp_path / "w.csv")


def test_row_0_has_the_largest_y() -> None:
    world = World.create(np.zeros((2, 3)), cell_size=0.5, origin=(10.0, 20.0, 0.0))
    np.testing.assert_allclose(world.to_xy([0, 5]), [[10.25, 20.75], [11.25, 20.25]])
    turned = World.create(np.zeros((2, 3)), cell_size=0.5, origin=(10.0, 20.0, np.pi / 2))
    np.testing.assert_allclose(turned.to_xy(0), [10 - 0.75, 20.25])


@given(worlds_with_starts())
def test_points_and_cells_are_inverse(given_world: tuple[World, np.ndarray]) -> None:
    world = World.create(given_world[0].threat, cell_size=0.7, origin=(-3.0, 8.0, 0.6))
    cells = np.arange(world.threat.size)
    rows, cols = world.to_cells(world.to_xy(cells)).T
    np.testing.assert_array_equal(rows * world.shape[1] + cols, cells)


def test_file_round_trip(tmp_path: Path) -> None:
    world = World.create([[0.0, 0.25, np.nan]], [[0, 1]], 0.5, (1.0, 2.0, 0.3))
    world.save(tmp_path / "world.npz")
    again = load_world_file(tmp_path / "world.npz")
    np.testing.assert_array_equal(again.threat, world.threat)
    assert again.starts is not None
    assert again.starts.tolist() == [[0, 1]]
    assert (again.cell_size, again.origin, again.sha256) == (world.cell_size, world.origin, world.sha256)


def test_identity_is_the_hash_of_the_threat_bytes() -> None:
    path = FOLDER / "scattered-14x23-1000.npz"
    with np.load(path) as data:
        raw = np.ascontiguousarray(data["threat"], dtype="<f4").tobytes()
    assert load_world_file(path).sha256 == hashlib.sha256(raw).hexdigest()


def test_accessible_cells_are_those_some_robot_reaches() -> None:
    world = World.create([[0.0, np.nan, 0.2, 0.0], [0.0, np.nan, np.nan, np.nan]])
    assert world.accessible([[0, 0]]).tolist() == [[True, False, False, False], [True, False, False, False]]
    assert world.accessible([[1, 0], [0, 3]]).sum() == 4


def test_graph_has_threats_positions_and_costs() -> None:
    graph = to_networkx(World.create([[0.0, 0.1], [np.nan, 0.2]], cell_size=2.0))
    assert set(graph.nodes) == {(0, 0), (0, 1), (1, 1)}
    assert graph.nodes[0, 1]["threat"] == pytest.approx(0.1)
    assert graph.nodes[0, 0]["pos"] == (1.0, 3.0)
    assert graph.edges[(0, 0), (0, 1)]["cost"] == 4
    assert graph.edges[(0, 1), (1, 1)]["cost"] == 8
    assert graph.edges[(0, 1), (0, 0)]["cost"] == 1
    assert graph.edges[(0, 1), (1, 1)]["hazard"] == pytest.approx(-np.log(0.8), rel=1e-6)


def test_nothing_is_half_written(tmp_path: Path) -> None:
    target = tmp_path / "file.txt"
    target.write_text("before")
    with pytest.raises(RuntimeError), atomic_write(target) as out:
        out.write("half")
        raise RuntimeError
    assert target.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]


@pytest.mark.parametrize(
    "frame",
    [
        {"cell_size": 1e308},
        {"cell_size": 1e-320},
        {"cell_size": np.array("x")},
        {"cell_size": True},
        {"cell_size": 1 + 0j},
        {"cell_size": [1.0, 2.0]},
        {"origin": [1e308, 0, 0]},
        {"origin": [0, -1e17, 0]},
        {"origin": ["a", "b", "c"]},
        {"origin": [True, False, False]},
        {"origin": [0j, 0j, 0j]},
        {"origin": [0, np.nan, 0]},
    ],
)
def test_frames_that_cannot_be_are_named_with_their_file(frame: dict, tmp_path: Path) -> None:
    np.savez(tmp_path / "w.npz", threat=np.zeros((2, 3)), **frame)
    with pytest.raises(WorldError) as caught:
        load_world_file(tmp_path / "w.npz")
    assert f"w.npz: {next(iter(frame))} is " in str(caught.value)
    with pytest.raises(WorldError, match=next(iter(frame))):
        World.create(np.zeros((2, 3)), **frame)


@pytest.mark.parametrize(("size", "corner"), [(1e-5, 1e9), (1e-5, -1e9), (1e6, 1e9), (1e6, 0.0)])
def test_centres_differ_in_micrometres_at_the_limits(size: float, corner: float) -> None:
    world = World.create(np.zeros((2, 2)), cell_size=size, origin=(corner, corner, 0.0))
    assert len({tuple(point) for point in np.round(world.to_xy(np.arange(4)), 6).tolist()}) == 4


@pytest.mark.parametrize(
    ("threat", "hint"), [(1.0, True), (-0.3, False), (np.inf, False), (2.0, False), (1e300, False)]
)
def test_only_p_1_is_called_an_obstacle(threat: float, hint: bool) -> None:
    with pytest.raises(WorldError) as caught:
        World.create([[0.0, threat]])
    assert ("write NaN" in str(caught.value)) == hint
    assert f"is {threat:g} " in str(caught.value)
    assert "0 <= p < 1" in str(caught.value)


@pytest.mark.parametrize("row", [1e30, -1e30, np.inf])
def test_a_start_is_shown_as_it_was_given(row: float, tmp_path: Path) -> None:
    np.savez(tmp_path / "w.npz", threat=np.zeros((2, 3)), starts=[[row, 0]])
    with pytest.raises(WorldError) as caught:
        load_world_file(tmp_path / "w.npz")
    assert f"starts at [{row:g}, 0], outside the map" in str(caught.value)
    with pytest.raises(WorldError, match=r"starts at \[1\.84467440737096e\+19, 0\]"):
        World.create(np.zeros((2, 3)), np.array([[2**64 - 1, 0]], dtype=np.uint64))


def test_threats_too_small_for_float32_count_as_safe_with_a_note() -> None:
    world = World.create(np.array([[0.0, 1e-60, 0.1], [np.nan, 1e-300, 1e-30]]))
    assert len(world.notes) == 1
    assert world.notes[0].startswith("2 cells")
    assert World.create(world.threat).notes == ()


def test_an_array_given_twice_is_refused(tmp_path: Path) -> None:
    for again in ("threat.npy", "threat"):
        np.savez(tmp_path / "w.npz", threat=np.zeros((2, 3)))
        with zipfile.ZipFile(tmp_path / "w.npz", "a") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            archive.writestr(again, archive.read("threat.npy"))
        with pytest.raises(MapError, match="holds 'threat' twice"):
            load_world_file(tmp_path / "w.npz")


@pytest.mark.parametrize("name", ["x" * 3000, "a/" * 3000 + "a", "nul\0", "half\ud800"])
@pytest.mark.parametrize("suffix", [".npz", ".npy", ".csv", ".map", ".png", ".tif", ".yaml", ".pgm"])
def test_names_that_no_file_can_have(name: str, suffix: str, tmp_path: Path) -> None:
    for read in (load_input, load_map, *([load_world_file] if suffix in (".npz", ".npy", ".csv") else [])):
        with pytest.raises(MapError, match="no such file") as caught:
            read(tmp_path / (name + suffix))
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 500


def write_text(path: Path, text: str = "new") -> None:
    with atomic_write(path) as out:
        out.write(text)


def test_a_written_file_has_the_rights_of_any_new_one(tmp_path: Path) -> None:
    """The system's own umask counts, which is not read: reading it means setting it, for all threads."""
    (tmp_path / "plain").touch()
    with atomic_write(tmp_path / "a.txt") as out:
        out.write("x")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "plain"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("x" * 300, "name too long"),
        ("nul\0", "no file can have this name"),
        ("folder", "is a folder"),
        ("pipe", "no regular file"),
        ("loop", "no file can have this name"),
        ("gone/x.json", "folder does not exist"),
        ("file/x.json", "Not a directory"),
        ("/proc/x.json", "cannot be written"),
        ("/dev/null", "no regular file"),
    ],
)
def test_what_cannot_be_written_is_named_with_the_reason(name: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(MapError, match=reason) as caught:
        write_text(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert name[:9].replace("\0", "\\x00") in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "loop", "pipe"]


def test_an_error_of_the_disk_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"a\.txt: cannot be written \(No space left"), atomic_write(tmp_path / "a.txt"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert not list(tmp_path.iterdir())


def test_writing_follows_links_and_takes_the_longest_names(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link").symlink_to("real.txt")
    (tmp_path / "dangling").symlink_to("made.txt")
    write_text(tmp_path / "link")
    write_text(tmp_path / "dangling")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real.txt").read_text() == (tmp_path / "made.txt").read_text() == "new"
    write_text(tmp_path / ("x" * 255))
    assert len(list(tmp_path.iterdir())) == 5


GRIDS = [
    ("0;0.5\nnan;-1\n", "semicolons", "points"),
    ("0;0,5\r\nnan;-1\r\n", "semicolons", "commas"),
    ("sep=\t\n0\t5,0e-1\nnan\t-1\n", "tabs", "commas"),
    ("  0.0e+00 5.0e-01\n nan  -1\n", "spaces", "points"),
]


@pytest.mark.parametrize(("text", "separator", "decimal"), GRIDS)
def test_grids_between_other_separators(
    tmp_path: Path, text: str, separator: str, decimal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planner.csv_tables, "CSV_BATCH", 5)
    (tmp_path / "w.csv").write_bytes(text.encode())
    world = load_world_file(tmp_path / "w.csv")
    np.testing.assert_array_equal(world.threat, [[0, 0.5], [np.nan, np.nan]])
    note = f"columns are read as separated by {separator}, numbers as written with decimal {decimal}"
    assert world.notes == (note,)
    (tmp_path / "s.yaml").write_text("map: m.npy\nthreats:\n- {raster: w.csv}\n")
    np.save(tmp_path / "m.npy", np.where(world.free, 0, np.nan))
    assert f"threats[0]: {note}" in load_input(tmp_path / "s.yaml").notes


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0;0,5\n0;0.5\n", "line 1 has '0,5' and line 2 '0.5'"),
        ("0;1,234\n0;2,345\n", "line 1: '1,234' may be 1.234 or 1234"),
        ("0;1.234,5\n", "line 1: '1.234,5' has marks between thousands"),
        ("0,0,0,5\n0,0,0,2,5\n", "separate the columns by semicolons"),
        (
            "a;b\n0;1\n",
            "line 1, column 0: 'a' is no number; expected numbers without a header, separated by semicolons",
        ),
    ],
)
def test_grids_that_can_be_read_in_two_ways(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "w.csv").write_text(text)
    with pytest.raises(MapError) as caught:
        load_world_file(tmp_path / "w.csv")
    assert words in str(caught.value) and "w.csv" in str(caught.value)


def test_decimal_signs_that_change_far_below(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner.csv_tables, "CSV_BATCH", 5)
    (tmp_path / "w.csv").write_text("\n\n\n0;0\n0;0,5\n0;0\n0;0.5\n")
    with pytest.raises(MapError, match="decimal commas up to line 5, decimal points below"):
        load_world_file(tmp_path / "w.csv")
