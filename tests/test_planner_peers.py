"""Other planners' instances: MAPS, LS-MCPP and DORA-Explorer, as their own readers understand them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from planner.errors import InputError
from planner.world.scenario import load_input

MAPS = {
    "agents_placement": [[0, 2], [1, 3], [2, 0]],
    "n_agents": 2,
    "obstacles_location": [[1, 1], [0, 0]],
    "threat_location": [[0, 0, 0.3], [2.0, 3.0, 0.25], [1, 2, 1]],
    "torodial": False,
    "world_shape": [3, 4],
    "random_placement": False,
}
MAP = "type octile\nheight 3\nwidth 5\nmap\n.....\n.@@..\n.....\n"


def maps(folder: Path, **changes: Any) -> Path:
    (folder / "m.yaml").write_text(yaml.safe_dump(MAPS | changes))
    return folder / "m.yaml"


def test_a_maps_world(tmp_path: Path) -> None:
    """`adv_coverage.py`: an obstacle wins over a threat, the first n_agents of the placements are there."""
    world = load_input(maps(tmp_path))
    expected = np.zeros((3, 4), dtype=np.float32)
    expected[2, 3], expected[0, 0], expected[1, 1], expected[1, 2] = 0.25, np.nan, np.nan, np.nan
    np.testing.assert_array_equal(world.threat, expected)
    assert world.starts is not None and world.starts.tolist() == [[0, 2], [1, 3]]
    assert world.notes == ("cells that stop every visit (p = 1) and so count as obstacles: 1",)
    assert load_input(maps(tmp_path, random_placement=True)).starts is None
    (tmp_path / "s.yaml").write_text("map: m.yaml\nrobots: {count: 1, start: upper-left}\n")
    assert load_input(tmp_path / "s.yaml").team.robots == 1


def test_a_maps_world_of_several_types(tmp_path: Path) -> None:
    """`adv_coverage.py`: p of a threat of type b on an agent of type a is `types_matrix[a][b]` times its p."""
    threats = [[0, 1, 0.5, 0], [2, 3, 0.25, 1]]
    path = maps(tmp_path, threat_location=threats, types_matrix=[[1.0, 0.4], [0.0, 2.0]], agents_type=[1, 0, 0])
    world = load_input(path)
    assert world.types is not None and world.types.names == ("0", "1")
    found = {name: of[[0, 2], [1, 3]].tolist() for name, of in zip("01", world.types.threat, strict=True)}
    assert found == {"0": pytest.approx([0.5, 0.1]), "1": pytest.approx([0.0, 0.5])}
    assert world.team.settings == {"types": ("1", "0")}
    (tmp_path / "s.yaml").write_text("map: m.yaml\nrobots: {types: '1'}\n")
    assert load_input(tmp_path / "s.yaml").team.settings == {"types": "1"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"world_shape": [3]}, r"`world_shape` is \[3\]; expected \[row, col\]"),
        ({"world_shape": [0, 4]}, "1 to 67108864 cells"),
        ({"world_shape": [10**9, 10**9]}, "`world_shape` is|world_shape"),
        ({"torodial": True}, "torodial"),
        ({"threat_location": [[0, 1, 1.5]]}, r"`threat_location\[0\]\[2\]` is 1.5"),
        ({"threat_location": [[0, 1]]}, r"`threat_location\[0\]` is \[0, 1\]; expected \[row, col, p\]"),
        ({"obstacles_location": [[3, 0]]}, r"`obstacles_location\[0\]\[0\]` is 3; expected \[row, col\], row 0..2"),
        ({"obstacles_location": [[0.5, 0]]}, r"is \[0.5, 0\]; expected"),
        ({"n_agents": 0}, "n_agents"),
        ({"agents_placement": [[1, 1]], "n_agents": 1}, "an obstacle"),
        ({"types_matrix": [[1.0], [1.0, 2.0]]}, "`types_matrix` is"),
        ({"types_matrix": [[1.0]]}, r"expected \[row, col, p, type\]"),
        ({"types_matrix": [[1.0]], "threat_location": [[0, 1, 0.5, 1]]}, r"`threat_location\[0\]\[3\]` is 1"),
        ({"types_matrix": [[3.0]], "threat_location": [[0, 1, 0.5, 0]]}, "type 0 is stopped with p = 1.5"),
    ],
)
def test_maps_that_are_refused(tmp_path: Path, changes: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_input(maps(tmp_path, **changes))


def test_an_instance_of_ls_mcpp(tmp_path: Path) -> None:
    """`benchmark/instance.py`: root is [column, row], or column * height + row; maps lie in `gridmaps`."""
    for folder in ("instances/a", "gridmaps/a"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "gridmaps" / "a.map").write_text(MAP)
    (tmp_path / "gridmaps" / "a" / "0.1-2.map").write_text(MAP.replace(".@@", "@@@"))
    for name, root, obstacles in (("a", [[4, 0], [0, 2]], 2), ("a/0.1-2", [12, 2], 3)):
        (tmp_path / "instances" / f"{name}.mcpp").write_text(
            f"map: a\nroot: {root}\nweighted: False\nincomplete: True\n"
        )
        world = load_input(tmp_path / "instances" / f"{name}.mcpp")
        assert world.starts is not None and world.starts.tolist() == [[0, 4], [2, 0]]
        assert int((~world.free).sum()) == obstacles and world.threat[1, 3] == 0
    (tmp_path / "a.map").write_text(MAP)
    for text, words in (
        ("map: a\nroot: [[1, 1]]\n", r"robot 0 starts at \[1, 1\], an obstacle"),
        ("map: a\nroot: [[9, 1]]\n", r"robot 0 starts at \[1, 9\], outside the map"),
        ("map: a\nroot: [[0, 1, 2]]\n", r"`root\[0\]` is \[0, 1, 2\]; expected \[column, row\]"),
        ("map: a\nroot: [x]\n", r"`root\[0\]` is 'x'"),
        ("map: b\nroot: [[0, 1]]\n", "`map` is 'b'; expected a map b.map beside it"),
        ("map: a\n", "`root` is missing"),
        ("map: a\nroot: [[0, 1", "line 2: expected"),
    ):
        (tmp_path / "a.mcpp").write_text(text)
        with pytest.raises(InputError, match=words) as caught:
            load_input(tmp_path / "a.mcpp")
        assert "a.mcpp" in str(caught.value)


def test_sources_of_dora_explorer(tmp_path: Path) -> None:
    """Cell by cell: a robot that drives 1 m at 0.8 m/s has 6.25 steps of 0.2 s, nine of ten of them with a check."""
    sources = [(-3.1, 0.5, 0.38), (6.0, -8.0, 0.9), (6.0, -7.5, 0.7)]
    text = {"sources": [{"x": x, "y": y, "intensity": strength} for x, y, strength in sources]}
    (tmp_path / "radiation_sources0.json").write_text(json.dumps(text))
    world = load_input(tmp_path / "radiation_sources0.json")
    assert world.shape == (17, 17) and world.cell_size == 1 and world.free.all()
    for row in range(17):
        for col in range(17):
            x, y = col - 8, 8 - row  # north is up
            i = sum(strength / (1 + 0.2 * ((x - a) ** 2 + (y - b) ** 2)) for a, b, strength in sources)
            p = min(max(0.0, (i - 0.2) / 0.8), 1.0)
            assert world.threat[row, col] == pytest.approx(1 - (1 - p) ** (6.25 * 0.9), abs=1e-6)
    assert 0 < world.threat[8, 5] < 1 and world.threat[0, 0] == 0 and 0.999 < world.threat[16, 14] < 1
    for wrong, words in (
        ({}, "holds no map"),
        ({"sources": []}, r"`sources` is \[\]"),
        ({"sources": [{"x": 0, "y": 0}]}, r"`sources\[0\].intensity` is missing"),
        ({"sources": [{"x": 0, "y": "a", "intensity": 1}]}, r"`sources\[0\].y` is 'a'; expected metres"),
        ({"sources": [{"x": 0, "y": 0, "intensity": -1}]}, "intensity` is -1"),
    ):
        (tmp_path / "s.json").write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=words):
            load_input(tmp_path / "s.json")
