"""Scenario files: what they give, and that every wrong one is one line naming file, key and value."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from planner.errors import InputError, MapError, ScenarioError, WorldError
from planner.world.keys import read_yaml
from planner.world.scenario import load_input
from planner.world.world import World

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
    assert cells.starts is not None
    assert cells.starts.tolist() == [[0, 6], [3, 0], [0, 6]]
    metres = load_input(write(folder, robots={"starts_xy": [[6.5, 3.5], [0.1, 0.9], [6, 3]], "count": 3}))
    assert metres.starts is not None
    assert metres.starts.tolist() == [[0, 6], [3, 0], [0, 6]]


def test_starts_in_metres_follow_the_turned_origin(folder: Path) -> None:
    World.create(np.zeros((3, 5)), cell_size=2.0, origin=(10, 20, math.pi / 2)).save(folder / "w.npz", force=True)
    # turned by 90 degrees: columns run along +y, rows (upwards) along -x
    scenario = load_input(write(folder, map={"file": "w.npz"}, robots={"starts_xy": [[9, 21], [5, 29]]}))
    assert scenario.starts is not None
    assert scenario.starts.tolist() == [[2, 0], [0, 4]]
    assert scenario.to_xy([10, 4]).tolist() == [pytest.approx([9, 21]), pytest.approx([5, 29])]


def test_world_files_bring_their_starts_along(folder: Path) -> None:
    World.create(np.zeros((4, 6)), starts=[[1, 2], [3, 5]], cell_size=0.5).save(folder / "w.npz", force=True)
    direct = load_input(folder / "w.npz")
    assert direct.starts is not None and len(direct.starts) == 2
    assert direct.cell_size == 0.5
    inside = load_input(write(folder, map="w.npz", cell_size=1.0))
    assert inside.starts is not None
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


@pytest.mark.parametrize(
    ("array", "names"),
    [
        ([[0.0, -0.1, 0.0]], "threat is -0.1 at [0, 1]"),
        ([[0.0, 0.1, 1.0]], "threat is 1 at [0, 2]"),
        ([[0.0, 0.1, np.inf]], "inf"),
        ([[np.nan, np.nan]], "every cell is an obstacle"),
        ([0.0, 0.1], "shape (2,)"),
        (np.zeros((0, 3)), "shape (0, 3)"),
    ],
)
def test_arrays_that_are_no_worlds(folder: Path, array: object, names: str) -> None:
    np.save(folder / "w.npy", array)
    with pytest.raises(InputError) as caught:
        load_input(folder / "w.npy")
    assert names in str(caught.value) or (names == "shape (0, 3)" and "w.npy" in str(caught.value))


@pytest.mark.parametrize(
    ("keys", "names"),
    [
        ({"cellsize": 1}, "unknown key `cellsize`"),
        ({"movers": [{"walk": 0.5, "h": "none"}]}, "`movers[0].h` is 'none'; expected a chance, 0 to 1, or threats"),
        ({"prior": {"p": 0.1}, "sense": 1, "phases": [{"from": 2, "threats": []}]}, "leave `phases` out"),
        ({"cell_sise": 1}, "did you mean 'cell_size'"),
        ({"cell_size": 0}, "`cell_size` is 0"),
        ({"cell_size": -1}, "`cell_size` is -1"),
        ({"cell_size": math.nan}, "`cell_size` is nan"),
        ({"cell_size": math.inf}, "`cell_size` is inf"),
        ({"cell_size": True}, "`cell_size` is True"),
        ({"cell_size": "1 m"}, "`cell_size` is '1 m'"),
        ({"cell_size": None}, "`cell_size` is None"),
        ({"cell_size": 10**400}, "`cell_size` is "),
        ({"cell_size": 1.5}, "a whole number of pixels"),
        ({"cell_size": 100}, "hold no cell"),
        ({"unknown": "obstacles"}, "did you mean 'obstacle'"),
        ({"combine": "sum"}, "product or max"),
        ({"combine": ["max"]}, "`combine` is ['max']"),
        ({"levels": 1}, "`levels` is 1"),
        ({"levels": 6.0}, "`levels` is 6.0"),
        ({"levels": True}, "`levels` is True"),
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
        ({"robots": {"count": 0}}, "`robots.count` is 0"),
        ({"robots": {"count": -2}}, "`robots.count` is -2"),
        ({"robots": {"count": 1025}}, "1 to 1024"),
        ({"robots": {"count": 2.0}}, "`robots.count` is 2.0"),
        ({"robots": {"count": True}}, "`robots.count` is True"),
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
    ],
)
def test_a_wrong_value_is_named(folder: Path, keys: dict, names: str) -> None:
    path = write(folder, **keys)
    with pytest.raises(InputError) as caught:
        load_input(path)
    message = str(caught.value)
    assert names in message
    assert "\n" not in message
    assert str(folder) in message


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("map: {file: a.map\ncell_size: 1\n", "line 2"),
        ("map: a.map\n\tlevels: 3\n", "line 2"),
        ("map: a.map\nlevels: 3\nlevels: 4\n", "line 3: key 'levels' twice"),
        ("map: !!python/object/apply:os.system ['true']\n", "line 1"),
        ("map: *nowhere\n", "line 1"),
        ("map: a.map\n---\nmap: b.map\n", "line 2"),
        ("", "the file is None"),
        ("- a\n- b\n", "the file is ['a', 'b']"),
        ("mop: a.map\n", "did you mean 'map' by 'mop'"),
        ("levels: 4\n", "neither a scenario nor a ROS map"),
        ("levels: " + "[" * 5000, "YAML"),
        ("# " + "x" * 2**20, "bytes"),
        ("? [a, b]\n: 3\nmap: a.map\n", "line 1: found unhashable key"),
    ],
)
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


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("map: a.map\nlevels: [" + "1," * 20_000 + "1]", "more than 20000 keys and values"),
        ("map: a.map\n" + "".join(f"k{i}: &a{i} 1\n" for i in range(10_000)), "more than 20000 keys and values"),
        ("# " + "x" * 2**18 + "\nmap: a.map", "more than 262144 bytes"),
    ],
)
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


@pytest.mark.parametrize(
    "text",
    [
        "map: !!timestamp x",
        "map: !!timestamp 2020-01-01",
        "map: !!bool x",
        "map: !!int x",
        "map: !!int 1:30",
        "map: !!float x",
        "map: !!binary x",
        "map: !!set {a}",
        "map: !!omap [a: 1]",
        "map: !!map x",
        "map: !!seq x",
        "map: !!str [a]",
        "? [a]\n: 1",
        "map: !!python/name:os.system x",
    ],
)
def test_wrong_tags_are_one_line(folder: Path, text: str) -> None:
    with pytest.raises(ScenarioError, match=r"s\.yaml: line 1") as caught:
        load_input(write(folder, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("17", 17),
        ("-0", 0),
        ("017", 17),
        ("+5", 5),
        ("1e-3", 1e-3),
        ("1.5E+2", 150.0),
        (".5", 0.5),
        ("-2.", -2.0),
        ("-.inf", -math.inf),
        ("1:30", "1:30"),
        ("1:30.5", "1:30.5"),
        ("0x1F", "0x1F"),
        ("0b11", "0b11"),
        ("0o17", "0o17"),
        ("1_000", "1_000"),
        ("1_0.5", "1_0.5"),
        ("2020-01-01", "2020-01-01"),
        ("=", "="),
        ("e5", "e5"),
        (".", "."),
        ("true", True),
        ("~", None),
        ("!!float 3", 3.0),
    ],
)
def test_numbers_are_those_of_yaml_1_2(folder: Path, text: str, value: object) -> None:
    got = read_yaml(write(folder, f"a: {text}")).value["a"]
    assert got == value
    assert type(got) is type(value)


@pytest.mark.parametrize("size", ["1:30", "0x10", "1_0", "1e308", "1e-320", "2e6"])
def test_cell_sizes_that_cannot_be(folder: Path, size: str) -> None:
    with pytest.raises(ScenarioError, match=r"s\.yaml: `cell_size` is .*; expected .* 1e-05 to 1e\+06"):
        load_input(write(folder, f"map: a.map\ncell_size: {size}\n"))


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
    sensed = {"sense": {"range": 2.5, "sight": True}}

    def read(**keys: object) -> World:
        return load_input(write(folder, **({"map": "told.csv"} | keys)))

    world = read(truth="true.csv", **sensed)
    assert np.array_equal(world.threat, told) and np.array_equal(world.met, true, equal_nan=True)
    assert world.knowledge is not None and (world.knowledge.sense.range, world.knowledge.sense.sight) == (2.5, True)
    world = read(map="true.csv", prior={"p": 0.04}, sense=1)
    assert (world.threat == np.float32(0.04)).all() and np.array_equal(world.met, true, equal_nan=True)
    world = read(map="true.csv", prior={"p": 0.04, "obstacles": "known"})
    assert np.array_equal(np.isnan(world.threat), np.isnan(true)) and world.knowledge.sense.range == 0
    world = read(prior={"p": 0.04}, truth="true.csv", sense=math.inf)
    assert (world.threat == np.float32(0.04)).all() and np.array_equal(world.met, true, equal_nan=True)
    spread = {"spread": {"kind": "beta", "sample_size": 9}}
    assert read(uncertain=spread, sense=1, prior={"p": 0.04}).doubt is not None
    for wrong, message in (
        ({"truth": "true.csv"}, r"`truth`: robots that see nothing are wrong about an obstacle at \[0, 1\]"),
        ({"prior": {"p": 1}}, r"`prior\.p` is 1; expected a probability"),
        ({"prior": {"p": 0.1, "obstacles": "no"}}, r"`prior\.obstacles` is 'no'; expected unknown or known"),
        ({"sense": 1}, r"`sense`: robots are told the map"),
        ({"prior": {"p": 0.1}, "sense": 0.5}, r"`sense`: sense is 0\.5; expected 0, or a number of cells from 1 on"),
        ({"prior": {"p": 0.1}, "sense": {"sight": True}}, r"key `sense\.range` is missing"),
        ({"prior": {"p": 0.1}, "sense": {"range": 1, "sight": 1}}, "sight: true or false"),
        ({"truth": "s.yaml", "sense": 1}, "an input without truth, prior, sense"),
        ({"truth": "a.map", "sense": 1}, r"the truth has shape \[4, 7\]"),
        ({"prior": {"p": 0.1}, "hazard": {"kind": "persistent", "q": "threats"}}, "leave `hazard` out"),
        ({"truth": "true.csv", "sense": 1, "uncertain": spread}, "a truth beside a map that is in doubt"),
        ({"sense": 1, "uncertain": {"spread": spread["spread"] | {"by": "level"}}}, "`by: common`"),
    ):
        with pytest.raises(InputError, match=message):
            read(**wrong)
