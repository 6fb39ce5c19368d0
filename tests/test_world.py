"""The world, scenario files and random worlds."""

import errno
import hashlib
import math
import os
import time
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import FOLDER, worlds_with_starts
from hypothesis import given
from scipy import ndimage

import planner.files
from planner.errors import InputError, MapError, ScenarioError, WorldError
from planner.failure_model import key_of
from planner.files import atomic_write
from planner.simulator.thresholds import threefry2x32
from planner.world.generate import OBSTACLES, PAPER_LEVELS, Stream, ThreatPattern, random_threats, random_world
from planner.world.keys import read_yaml
from planner.world.map_files import load_map
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file

# The world: what it accepts, where its cells lie on the ground, its file, its identity, and its graph.


WRONG_THREATS = [
    *(
        ([[0.0, p]], rf"threat is {p:g} at .* 0 <= p < 1".replace("+", r"\+"))
        for p in (-0.1, -0.3, 1.0, 2.0, 1e300, np.inf)
    ),
    ([[np.nan, np.nan]], "every cell is an obstacle"),
    *((shaped, "shape") for shaped in ([], [0.0, 0.1], np.zeros((0, 3)))),
    ([["a"]], "numbers"),
    ([[0.99999999]], "threat is 0.99999999 at .* at most 0.9999999"),
]


@pytest.mark.parametrize(("threat", "said"), WRONG_THREATS)
def test_wrong_threats_are_named(threat: object, said: str, tmp_path: Path) -> None:
    """Only p = 1 is called an obstacle."""
    with pytest.raises(InputError, match=said) as caught:
        World.create(threat)  # type: ignore[arg-type]
    assert ("write NaN" in str(caught.value)) == said.startswith(("threat is 1 ", "threat is 0.9"))
    np.save(tmp_path / "w.npy", threat)
    with pytest.raises(InputError, match=r"w\.npy: "):
        load_input(tmp_path / "w.npy")


WRONG_STARTS = [
    ([[0, 1]], "robot 0 starts at \\[0, 1\\], an obstacle"),
    ([[0, 0], [2, 0]], "robot 1 starts at \\[2, 0\\], outside the map"), ([[-1, 0]], "outside the map"),
    ([[0.5, 0]], "whole numbers"), ([], "shape"), ([0, 0], "shape"), (np.zeros((1025, 2), int), "at most 1024"),
]  # fmt: skip


@pytest.mark.parametrize(("starts", "said"), WRONG_STARTS)
def test_wrong_starts_are_named(starts: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        World.create([[0.0, np.nan, 0.0], [0.0, 0.0, 0.0]], starts)  # type: ignore[arg-type]


def test_masked_cells_are_obstacles() -> None:
    """NumPy hands out the numbers under the mask to whoever asks for an array: they are no threats."""
    threat = np.ma.masked_array([[0.0, 0.25], [0.5, 7.0]], mask=[[True, False], [False, True]])
    np.testing.assert_array_equal(World.create(threat).threat, np.array([[np.nan, 0.25], [0.5, np.nan]]))
    whole = np.ma.masked_equal(np.array([[0, -1], [-1, 0]]), -1)
    np.testing.assert_array_equal(World.create(whole).free, [[True, False], [False, True]])
    assert World.create(np.ma.masked_array([[0.0, 0.5]])).free.all()
    with pytest.raises(WorldError, match="starts are"):
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


def test_csv_is_read_and_a_wrong_line_is_named(tmp_path: Path) -> None:
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
        out.truncate(planner.files.MAX_CSV_BYTES + 1)
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
    graph = World.create([[0.0, 0.1], [np.nan, 0.2]], cell_size=2.0).to_networkx()
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


SIZES = (0.0, -1.0, np.nan, 1e308, 1e-320, np.array("x"), True, 1 + 0j, [1.0, 2.0])
ORIGINS = ([0, 0], [1e308, 0, 0], [0, -1e17, 0], ["a", "b", "c"], [True, False, False], [0j, 0j, 0j], [0, np.nan, 0])


@pytest.mark.parametrize("frame", [*({"cell_size": size} for size in SIZES), *({"origin": at} for at in ORIGINS)])
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


UNWRITABLE = [
    ("x" * 300, "name too long"), ("nul\0", "no file can have this name"), ("folder", "is a folder"),
    ("pipe", "no regular file"), ("loop", "no file can have this name"), ("gone/x.json", "folder does not exist"),
    ("file/x.json", "Not a directory"), ("/proc/x.json", "cannot be written"), ("/dev/null", "no regular file"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "reason"), UNWRITABLE)
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
def test_grids_between_other_separators(tmp_path: Path, text: str, separator: str, decimal: str) -> None:
    (tmp_path / "w.csv").write_bytes(text.encode())
    world = load_world_file(tmp_path / "w.csv")
    np.testing.assert_array_equal(world.threat, [[0, 0.5], [np.nan, np.nan]])
    note = f"columns are read as separated by {separator}, numbers as written with decimal {decimal}"
    assert world.notes == (note,)
    (tmp_path / "s.yaml").write_text("map: m.npy\nthreats:\n- {raster: w.csv}\n")
    np.save(tmp_path / "m.npy", np.where(world.free, 0, np.nan))
    assert f"threats[0]: {note}" in load_input(tmp_path / "s.yaml").notes


AMBIGUOUS_GRIDS = [
    ("0;0,5\n0;0.5\n", "line 1 has '0,5' and line 2 '0.5'"),
    ("\n\n\n0;0\n0;0,5\n0;0\n0;0.5\n", "line 5 has '0,5' and line 7 '0.5'"),
    ("0;1,234\n0;2,345\n", "line 1: '1,234' may be 1.234 or 1234"),
    ("0;1.234,5\n", "line 1: '1.234,5' has marks between thousands"),
    ("0,0,0,5\n0,0,0,2,5\n", "separate the columns by semicolons"),
    ("a;b\n0;1\n", "line 1, column 0: 'a' is no number; expected numbers without a header, separated by semicolons"),
]


@pytest.mark.parametrize(("text", "words"), AMBIGUOUS_GRIDS)
def test_grids_that_can_be_read_in_two_ways(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "w.csv").write_text(text)
    with pytest.raises(MapError) as caught:
        load_world_file(tmp_path / "w.csv")
    assert words in str(caught.value) and "w.csv" in str(caught.value)


# Scenario files: what they give, and that every wrong one is one line naming file, key and value.

MAZE = "type octile\nheight 4\nwidth 7\nmap\n.......\n.@@....\n.......\n....@..\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.map").write_text(MAZE)
    return tmp_path


def write(folder: Path, text: str | None = None, **keys: object) -> Path:
    path = folder / "s.yaml"
    path.write_text(yaml.safe_dump({"map": {"file": "a.map"}} | keys) if text is None else text)
    return path


@pytest.mark.parametrize(("cells", "shape"), [("", (4, 6)), ("cell_size: 2", (4, 6)), ("cell_size: 4", (2, 3))])
def test_metres_of_a_maps_pixels_that_its_file_does_not_say(cells: str, shape: tuple[int, int], tmp_path: Path) -> None:
    np.save(tmp_path / "field.npy", np.zeros((4, 6)))
    (tmp_path / "s.yaml").write_text("map: {file: field.npy, resolution: 2}\n" + cells)
    world = load_input(tmp_path / "s.yaml")
    assert world.shape == shape and world.cell_size == 8 / shape[0] and world.measured
    (tmp_path / "s.yaml").write_text("map: {file: field.npy, resolution: 0}\n")
    with pytest.raises(InputError, match=r"`map\.resolution` is 0"):
        load_input(tmp_path / "s.yaml")


def test_a_whole_scenario(folder: Path) -> None:
    path = write(
        folder,
        """
        map: {file: a.map}   # relative to this file
        cell_size: 1
        unknown: free
        combine: max
        threats:
          - generate: {kind: scattered, ratio: 0.5, levels: [1e-1, 2.e-1], seed: 3}
        levels: 6
        robots: {count: 3, start: upper-left}
        """,
    )
    scenario = load_input(path)
    assert scenario.shape == (4, 7)
    assert (scenario.threat > 0).sum() == 12
    assert scenario.source == str(path)
    assert (scenario.team.robots, scenario.team.start, scenario.team.settings) == (3, "upper-left", {"levels": 6})
    assert scenario.starts is None
    assert scenario.notes == ()


def test_a_scenario_is_the_same_from_anywhere(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder)
    monkeypatch.chdir(folder)
    assert load_input("s.yaml").sha256 == load_input(folder / "s.yaml").sha256


def test_the_name_of_a_map_is_enough_and_nothing_else_is_needed(folder: Path) -> None:
    scenario = load_input(write(folder, "map: a.map\n"))
    assert (scenario.team.robots, scenario.team.settings, scenario.team.start) == (None, {}, "upper-left")
    assert not np.nansum(scenario.threat)


def test_starts_in_cells_and_in_metres(folder: Path) -> None:
    cells = load_input(write(folder, robots={"starts": [[0, 6], [3, 0], [0, 6]]}))
    assert cells.starts.tolist() == [[0, 6], [3, 0], [0, 6]]
    metres = load_input(write(folder, robots={"starts_xy": [[6.5, 3.5], [0.1, 0.9], [6, 3]], "count": 3}))
    assert metres.starts.tolist() == [[0, 6], [3, 0], [0, 6]]


def test_starts_in_metres_follow_the_turned_origin(folder: Path) -> None:
    World.create(np.zeros((3, 5)), cell_size=2.0, origin=(10, 20, math.pi / 2)).save(folder / "w.npz", force=True)
    # turned by 90 degrees: columns run along +y, rows (upwards) along -x
    scenario = load_input(write(folder, map={"file": "w.npz"}, robots={"starts_xy": [[9, 21], [5, 29]]}))
    assert scenario.starts.tolist() == [[2, 0], [0, 4]]
    assert scenario.to_xy([10, 4]).tolist() == [pytest.approx([9, 21]), pytest.approx([5, 29])]


def test_world_files_bring_their_starts_along(folder: Path) -> None:
    World.create(np.zeros((4, 6)), starts=[[1, 2], [3, 5]], cell_size=0.5).save(folder / "w.npz", force=True)
    direct = load_input(folder / "w.npz")
    assert direct.starts is not None and len(direct.starts) == 2
    assert direct.cell_size == 0.5
    inside = load_input(write(folder, map="w.npz", cell_size=1.0))
    assert inside.starts.tolist() == [[0, 1], [1, 2]]
    assert load_input(write(folder, map="w.npz", robots={"count": 2})).starts is not None
    anew = load_input(write(folder, map="w.npz", robots={"count": 5, "start": "upper-left"}))
    assert (anew.team.robots, anew.starts) == (5, None)
    with pytest.raises(ScenarioError, match=r"`robots\.count` is 3; expected 2.*start: upper-left"):
        load_input(write(folder, map="w.npz", robots={"count": 3}))


def test_a_start_in_a_partial_block_is_off_the_coarsened_map(folder: Path) -> None:
    World.create(np.zeros((5, 6)), starts=[[4, 0]]).save(folder / "w.npz", force=True)
    with pytest.raises(WorldError, match="outside the map"):
        load_input(write(folder, map="w.npz", cell_size=2))


def test_arrays_are_worlds(folder: Path) -> None:
    threat = np.array([[0, 0.1, -1], [0.2, 0, 0]])
    np.savetxt(folder / "w.csv", threat, delimiter=",")
    np.save(folder / "w.npy", np.where(threat < 0, np.nan, threat))
    assert load_input(folder / "w.csv").sha256 == load_input(folder / "w.npy").sha256
    assert load_input(folder / "w.csv").free.sum() == 5


BAD_SIZES = (0, -1, math.nan, math.inf, 1e308, 1e-320, 2e6)


WRONG_VALUES = [
    ({"cellsize": 1}, "unknown key `cellsize`"),
    (
        {"moving_threats": [{"walk": 0.5, "h": "none"}]},
        "`moving_threats[0].h` is 'none'; expected a chance, 0 to 1, or threats",
    ),
    ({"prior_map": {"p": 0.1}, "sensor_range": 1, "phases": [{"from": 2, "threats": []}]}, "leave out `phases`"),
    ({"cell_sise": 1}, "did you mean 'cell_size'"),
    *(({"cell_size": n}, f"`cell_size` is {n}; expected a number of metres, 1e-05 to 1e+06") for n in BAD_SIZES),
    *(({"cell_size": size}, "`cell_size` is ") for size in (True, "1 m", "1:30", None, 10**400)),
    ({"cell_size": 1.5}, "a whole number of pixels"),
    ({"cell_size": 100}, "hold no cell"),
    ({"unknown": "obstacles"}, "did you mean 'obstacle'"),
    ({"combine": "sum"}, "product or max"),
    ({"combine": ["max"]}, "`combine` is ['max']"),
    *(({"levels": levels}, f"`levels` is {levels}") for levels in (1, 6.0, True)),
    ({"threats": {"raster": "a"}}, "`threats` is {"),
    ({"threats": "fire"}, "`threats` is 'fire'"),
    ({"map": {}}, "`map` is {}"),
    ({"map": 5}, "`map` is 5"),
    ({"map": {"fil": "a.map"}}, "did you mean 'file'"),
    ({"map": "gone.map"}, "no such file"),
    ({"map": "s.yaml"}, "this is a scenario"),
    ({"map": {"file": ["a.map"]}}, "`map.file` is ['a.map']"),
    ({"map": {"file": "a\0b.map"}}, "no such file"),
    ({"robots": 4}, "`robots` is 4"),
    ({"robots": {}}, "a count, or starts"),
    *(({"robots": {"count": n}}, f"`robots.count` is {n}; expected a whole") for n in (0, -2, 1025, 2.0, True)),
    ({"robots": {"count": 2, "start": "upper-right"}}, "did you mean 'upper-left'"),
    ({"robots": {"start": "upper-left"}}, "a count, or starts"),
    ({"robots": {"count": 2, "starts": [[0, 0]]}}, "`robots.count` is 2; expected 1"),
    ({"robots": {"starts": [[0, 0]], "start": "upper-left"}}, "not both start and starts"),
    ({"robots": {"starts": []}}, "`robots.starts` is []"),
    ({"robots": {"starts": [0, 0]}}, "`robots.starts[0]` is 0"),
    ({"robots": {"starts": [[0, 0, 0]]}}, "`robots.starts[0]` is [0, 0, 0]"),
    ({"robots": {"starts": [[0, 0.5]]}}, "`robots.starts[0][1]` is 0.5"),
    ({"robots": {"starts": [[0, math.nan]]}}, "`robots.starts[0][1]` is nan"),
    ({"robots": {"starts": [[1, 1]]}}, "robot 0 starts at [1, 1], an obstacle"),
    ({"robots": {"starts": [[0, 0], [4, 0]]}}, "robot 1 starts at [4, 0], outside the map"),
    ({"robots": {"starts": [[0, -1]]}}, "outside the map"),
    ({"robots": {"starts": [[0, 10**30]]}}, "`robots.starts[0][1]`"),
    ({"robots": {"starts_xy": [[-0.1, 0]]}}, "outside the map"),
    ({"robots": {"starts_xy": [[1.5, 2.5]]}}, "[1, 1], an obstacle"),
    ({"robots": {"starts_xy": [[1e300, 0]]}}, "outside the map"),
    ({"robots": {"starts_xy": [[math.inf, 0]]}}, "`robots.starts_xy[0][0]` is inf"),
]


@pytest.mark.parametrize(("keys", "names"), WRONG_VALUES)
def test_a_wrong_value_is_named(folder: Path, keys: dict, names: str) -> None:
    path = write(folder, **keys)
    with pytest.raises(InputError) as caught:
        load_input(path)
    message = str(caught.value)
    assert names in message
    assert "\n" not in message
    assert str(folder) in message


MALFORMED = [
    ("map: {file: a.map\ncell_size: 1\n", "line 2"), ("map: a.map\n\tlevels: 3\n", "line 2"),
    ("map: a.map\nlevels: 3\nlevels: 4\n", "line 3: key 'levels' twice"),
    ("map: !!python/object/apply:os.system ['true']\n", "line 1"), ("map: *nowhere\n", "line 1"),
    ("map: a.map\n---\nmap: b.map\n", "line 2"), ("", "the file is None"), ("- a\n- b\n", "the file is ['a', 'b']"),
    ("mop: a.map\n", "did you mean 'map' by 'mop'"), ("levels: 4\n", "neither a scenario nor a ROS map"),
    ("levels: " + "[" * 5000, "YAML"), ("# " + "x" * 2**20, "bytes"),
    ("? [a, b]\n: 3\nmap: a.map\n", "line 1: found unhashable key"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "names"), MALFORMED)
def test_malformed_yaml_names_the_line(folder: Path, text: str, names: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_input(write(folder, text))
    assert names in str(caught.value)
    assert str(folder / "s.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bytes_that_are_no_text(folder: Path) -> None:
    (folder / "s.yaml").write_bytes(b"\xff\xfe\x00map")
    with pytest.raises(ScenarioError, match=r"s\.yaml"):
        load_input(folder / "s.yaml")


def test_an_alias_bomb_is_harmless(folder: Path) -> None:
    lines = ["map: a.map", "x0: &x0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 9)}]" for i in range(1, 10)]
    start = time.perf_counter()
    with pytest.raises(ScenarioError, match="aliases"):
        load_input(write(folder, "\n".join(lines)))
    small = ["x: &x0 [1, 1, 1, 1, 1, 1]"] + [f"y{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 6)}]" for i in range(1, 9)]
    with pytest.raises(ScenarioError, match="line 4: it holds itself"):
        load_input(write(folder, "map: a.map\nrobots:\n  starts:\n    - &a\n      - [*a, *a]\n      - 2\n"))
    with pytest.raises(ScenarioError, match="more than 20000 keys and values, aliases followed"):
        load_input(write(folder, "\n".join(["map: a.map", *small])))
    merged = ["map: a.map", "m0: &m0 {p: 1, q: 2, r: 3}"]
    merged += [f"m{i}: &m{i}\n  <<: [*m{i - 1}, *m{i - 1}]" for i in range(1, 20)]
    with pytest.raises(ScenarioError, match="more than 20000 keys and values, aliases followed"):
        load_input(write(folder, "\n".join(merged)))
    assert time.perf_counter() - start < 2


LARGE_YAML = [
    ("map: a.map\nlevels: [" + "1," * 20_000 + "1]", "more than 20000 keys and values"),
    ("map: a.map\n" + "".join(f"k{i}: &a{i} 1\n" for i in range(10_000)), "more than 20000 keys and values"),
    ("# " + "x" * 2**18 + "\nmap: a.map", "more than 262144 bytes"),
]


@pytest.mark.parametrize(("text", "said"), LARGE_YAML)
def test_large_yaml_is_refused_within_its_limits(folder: Path, text: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load_input(write(folder, text))


def test_an_anchor_may_be_used(folder: Path) -> None:
    scenario = load_input(write(folder, "map: a.map\nrobots: {starts: [&a [0, 0], *a, *a]}\n"))
    assert scenario.starts is not None and len(scenario.starts) == 3


def test_errors_in_a_map_name_the_map(folder: Path) -> None:
    (folder / "a.map").write_text(MAZE[:-5])
    with pytest.raises(MapError, match=r"a\.map: line 8 has 3 characters"):
        load_input(write(folder))


TAGS = (
    "timestamp x", "timestamp 2020-01-01", "bool x", "int x", "int 1:30", "float x", "binary x", "set {a}",
    "omap [a: 1]", "map x", "seq x", "str [a]", "python/name:os.system x",
)  # fmt: skip


@pytest.mark.parametrize("text", [*(f"map: !!{tag}" for tag in TAGS), "? [a]\n: 1"])
def test_wrong_tags_are_one_line(folder: Path, text: str) -> None:
    with pytest.raises(ScenarioError, match=r"s\.yaml: line 1") as caught:
        load_input(write(folder, text))
    assert "\n" not in str(caught.value)


NUMBERS = {
    "17": 17, "-0": 0, "017": 17, "+5": 5, "1e-3": 1e-3, "1.5E+2": 150.0, ".5": 0.5, "-2.": -2.0, "-.inf": -math.inf,
    "true": True, "~": None, "!!float 3": 3.0,
}  # fmt: skip
TEXTS = ("1:30", "1:30.5", "0x1F", "0b11", "0o17", "1_000", "1_0.5", "2020-01-01", "=", "e5", ".")


@pytest.mark.parametrize(("text", "value"), [*NUMBERS.items(), *((text, text) for text in TEXTS)])
def test_numbers_are_those_of_yaml_1_2(folder: Path, text: str, value: object) -> None:
    got = read_yaml(write(folder, f"a: {text}")).value["a"]
    assert got == value
    assert type(got) is type(value)


@pytest.mark.parametrize("name", ["x" * 3000, "nul\0", "."])
def test_a_file_name_that_cannot_be(folder: Path, name: str) -> None:
    with pytest.raises(ScenarioError, match=r"`map\.file`: (no such file|is a folder)") as caught:
        load_input(write(folder, map={"file": name}))
    assert len(str(caught.value)) < 600


def test_a_linked_scenario_starts_from_the_folder_of_the_link(folder: Path) -> None:
    path = write(folder)
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "link.yaml").symlink_to(path)
    with pytest.raises(ScenarioError, match="no such file"):
        load_input(elsewhere / "link.yaml")
    (elsewhere / "a.map").write_text(MAZE.replace("@", "."))
    assert load_input(elsewhere / "link.yaml").free.all()


def test_what_robots_are_not_told(folder: Path) -> None:
    (folder / "told.csv").write_text("0,0.1\n0.2,0\n")
    (folder / "true.csv").write_text("0,-1\n0.3,0\n")
    told, true = np.float32([[0, 0.1], [0.2, 0]]), np.float32([[0, np.nan], [0.3, 0]])
    sensed = {"sensor_range": {"range": 2.5, "sight": True}}

    def read(**keys: object) -> World:
        return load_input(write(folder, **({"map": "told.csv"} | keys)))

    world = read(true_map="true.csv", **sensed)
    assert np.array_equal(world.threat, told) and np.array_equal(world.met, true, equal_nan=True)
    assert world.knowledge is not None and (world.knowledge.sensor.range, world.knowledge.sensor.sight) == (2.5, True)
    world = read(map="true.csv", prior_map={"p": 0.04}, sensor_range=1)
    assert (world.threat == np.float32(0.04)).all() and np.array_equal(world.met, true, equal_nan=True)
    world = read(map="true.csv", prior_map={"p": 0.04, "obstacles": "known"})
    assert np.array_equal(np.isnan(world.threat), np.isnan(true)) and world.knowledge.sensor.range == 0
    world = read(prior_map={"p": 0.04}, true_map="true.csv", sensor_range=math.inf)
    assert (world.threat == np.float32(0.04)).all() and np.array_equal(world.met, true, equal_nan=True)
    spread = {"spread": {"kind": "beta", "sample_size": 9}}
    assert read(map_uncertainty=spread, sensor_range=1, prior_map={"p": 0.04}).uncertainty is not None
    for wrong, message in (
        ({"true_map": "true.csv"}, r"`true_map`: robots that see nothing are wrong about an obstacle at \[0, 1\]"),
        ({"prior_map": {"p": 1}}, r"`prior_map\.p` is 1; expected a probability"),
        ({"prior_map": {"p": 0.1, "obstacles": "no"}}, r"`prior_map\.obstacles` is 'no'; expected unknown or known"),
        ({"sensor_range": 1}, r"`sensor_range`: the map is known"),
        (
            {"prior_map": {"p": 0.1}, "sensor_range": 0.5},
            r"`sensor_range`: sensor_range is 0\.5; expected 0, or a number of cells from 1 on",
        ),
        ({"prior_map": {"p": 0.1}, "sensor_range": {"sight": True}}, r"key `sensor_range\.range` is missing"),
        ({"prior_map": {"p": 0.1}, "sensor_range": {"range": 1, "sight": 1}}, "sight: true or false"),
        ({"true_map": "s.yaml", "sensor_range": 1}, "an input without true_map, prior_map, sensor_range"),
        ({"true_map": "a.map", "sensor_range": 1}, r"the true map has shape \[4, 7\]"),
        (
            {"prior_map": {"p": 0.1}, "latent_hazard": {"kind": "persistent", "q": "threats"}},
            "leave out `latent_hazard`",
        ),
        ({"true_map": "true.csv", "sensor_range": 1, "map_uncertainty": spread}, "true map together with another"),
        ({"sensor_range": 1, "map_uncertainty": {"spread": spread["spread"] | {"by": "level"}}}, "`by: common`"),
    ):
        with pytest.raises(InputError, match=message):
            read(**wrong)


# Random worlds: exact counts, the shape of areas, streams of their own, and the pinned hash of one of each kind.

PINNED = {
    "contiguous": "02e61d25c7a3b4b4584d28b19787a6c0c4956652fd486954710e263cc87e1759",
    "scattered": "85e3e4a9ff8783a6bbc3b42492304d1f97b12b4162451a67027ba03fc39fd591",
}


def areas_of(threat: np.ndarray) -> list[tuple[float, int]]:
    """(level, size) of every 4-connected set of cells of one level."""
    found = []
    for level in np.unique(threat[threat > 0]):
        labels, _ = ndimage.label(threat == level)
        found += [(float(level), int(size)) for size in np.bincount(labels.ravel())[1:]]
    return found


@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
def test_one_world_of_each_kind_is_the_same_everywhere(kind: str) -> None:
    world = random_world(14, 23, ThreatPattern(kind=kind, seed=5))  # type: ignore[arg-type]
    assert world.sha256 == PINNED[kind]


@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
@pytest.mark.parametrize("seed", [0, 1, 2**64 - 1])
def test_the_papers_worlds_have_exact_counts(kind: str, seed: int) -> None:
    world = random_world(20, 20, ThreatPattern(kind=kind, seed=seed))  # type: ignore[arg-type]
    assert (~world.free).sum() == 100
    levels, counts = np.unique(world.threat[world.threat > 0], return_counts=True)
    assert levels.tolist() == [np.float32(level) for level in PAPER_LEVELS]
    assert counts.tolist() == [20] * 5


@pytest.mark.parametrize("seed", range(30))
def test_contiguous_areas_are_ten_of_equal_size_and_apart(seed: int) -> None:
    world = random_world(20, 20, ThreatPattern(seed=seed))
    assert areas_of(world.threat) == [(np.float32(level), 10) for level in PAPER_LEVELS for _ in range(2)]


def test_sizes_differ_by_one_cell_when_the_count_does_not_divide() -> None:
    world = random_world(31, 17, ThreatPattern(areas=7, levels=(0.1, 0.2, 0.3), seed=4), obstacles=0.1, threats=0.2)
    sizes = sorted(size for _, size in areas_of(world.threat))
    assert sum(sizes) == round(0.2 * 31 * 17) == 105
    assert sizes == [15] * 7
    free = np.ones((9, 13), dtype=bool)
    assert sorted(size for _, size in areas_of(random_threats(free, 23, ThreatPattern(areas=5)))) == [4, 4, 5, 5, 5]


@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
@pytest.mark.parametrize("areas", [1, 3, 50])
def test_every_free_cell_can_become_dangerous(kind: str, areas: int) -> None:
    free = np.random.default_rng(3).random((12, 19)) < 0.55  # many small pockets
    count = int(free.sum())
    for wanted in (count, count - 1, count // 2):
        threat = random_threats(free, wanted, ThreatPattern(kind=kind, areas=areas, seed=9))  # type: ignore[arg-type]
        assert (threat > 0).sum() == wanted
        assert not threat[~free].any()


def test_no_threats_and_fewer_threats_than_areas() -> None:
    free = np.ones((3, 4), dtype=bool)
    assert not random_threats(free, 0, ThreatPattern()).any()
    assert (random_threats(free, 3, ThreatPattern(areas=10)) > 0).sum() == 3


def test_both_kinds_of_a_seed_share_their_obstacles_and_other_seeds_do_not() -> None:
    one, other = (random_world(11, 16, ThreatPattern(kind=kind, seed=8)) for kind in ("contiguous", "scattered"))
    assert (one.free == other.free).all()
    assert one.sha256 != other.sha256
    assert (random_world(11, 16, ThreatPattern(seed=9)).free != one.free).any()


def test_worlds_share_no_stream_with_the_rollouts_of_their_seed() -> None:
    seed = 2**40 + 3
    rollouts, _ = threefry2x32(key_of(seed), np.arange(64), 0)
    world = Stream(seed, OBSTACLES).words(64) & np.uint64(0xFFFFFFFF)
    assert not (rollouts == world).any()


def test_below_is_uniform() -> None:
    stream, draws, bound = Stream(1, 7), 21_000, 7
    counts = np.bincount([stream.below(bound) for _ in range(draws)], minlength=bound)
    spread = np.sqrt(draws * (1 / bound) * (1 - 1 / bound))
    assert len(counts) == bound
    assert np.abs(counts - draws / bound).max() < 5 * spread


def test_sampled_cells_are_different_and_uniform() -> None:
    hits = np.zeros(30)
    for seed in range(400):
        chosen = Stream(seed, OBSTACLES).sample(10, 30)
        assert len(set(chosen.tolist())) == 10
        hits[chosen] += 1
    assert np.abs(hits - 400 / 3).max() < 5 * np.sqrt(400 * 1 / 3 * 2 / 3)


WRONG_WORLDS = [
    (ThreatPattern(kind="round"), {}, "'round'"),  # type: ignore[arg-type]
    (ThreatPattern(areas=0), {}, "areas=0"),
    (ThreatPattern(levels=()), {}, "levels"),
    (ThreatPattern(levels=(0.1, 1.0)), {}, "levels"),
    (ThreatPattern(levels=(float("nan"),)), {}, "levels"),
    (ThreatPattern(levels=(1e-60,)), {}, "expected probabilities 1e-30 <= p < 1"),
    (ThreatPattern(levels=(1e300,)), {}, "levels"),
    (ThreatPattern(seed=-1), {}, "seed=-1"),
    (ThreatPattern(seed=2**64), {}, "seed"),
    (ThreatPattern(), {"threats": 0.8}, "320 threats"),
    (ThreatPattern(), {"obstacles": 1.0, "threats": 0.0}, "400 obstacles"),
    (ThreatPattern(), {"obstacles": -0.1}, "obstacles=-0.1"),
    (ThreatPattern(), {"threats": float("nan")}, "threats=nan"),
    (ThreatPattern(), {"height": 0}, "0 x 20"),
    (ThreatPattern(), {"height": 10**6, "width": 10**6}, "1000000 x 1000000"),
]


@pytest.mark.parametrize(("pattern", "options", "names"), WRONG_WORLDS)
def test_worlds_that_cannot_be(pattern: ThreatPattern, options: dict, names: str) -> None:
    with pytest.raises(WorldError) as caught:
        random_world(pattern=pattern, **options)
    assert names in str(caught.value)


def test_a_large_map_takes_no_time() -> None:
    start = time.perf_counter()
    world = random_world(256, 256, ThreatPattern(seed=2), obstacles=0.28)
    assert (world.threat > 0).sum() == 16384
    assert time.perf_counter() - start < 5


def test_more_areas_than_cells_are_refused_but_never_the_default() -> None:
    with pytest.raises(WorldError, match="401 areas on 400 cells"):
        random_world(pattern=ThreatPattern(areas=401))
    assert (random_world(20, 20, ThreatPattern(areas=400)).threat > 0).sum() == 100
    assert (random_world(2, 2).threat > 0).sum() == 1
    assert (random_world(pattern=ThreatPattern("scattered", areas=401)).threat > 0).sum() == 100
