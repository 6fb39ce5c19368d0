"""Sources of threat: rules, layers, generated ones, and how they combine."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from threat_sources import load, raster, world_file

from planner.errors import InputError, ScenarioError
from planner.world.scenario import load_input

RULE = {"kind": "linear", "scale": 0.001}


def ros_layer(folder: Path, values: np.ndarray, resolution: float, origin: list[float]) -> str:
    """A ROS scale map with these values 0..100."""
    Image.fromarray(np.rint(255 - values * 2.55).astype(np.uint8)).save(folder / "layer.png")
    keys = {"image": "layer.png", "mode": "scale", "resolution": resolution, "origin": origin}
    keys |= {"negate": 0, "occupied_thresh": 1.0, "free_thresh": 0.0}
    (folder / "layer.yaml").write_text(yaml.safe_dump(keys))
    return "layer.yaml"


VALUES = np.arange(54, dtype=np.float64).reshape(6, 9)


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ({"kind": "linear", "scale": 0.01}, VALUES * 0.01),
        ({"kind": "exposure", "rate": 0.02}, 1 - np.exp(-0.02 * VALUES)),
        (
            {"kind": "classes", "edges": [10, 20.5], "p": [0, 0.1, 0.3]},
            np.where(VALUES < 10, 0, np.where(VALUES < 20.5, 0.1, 0.3)),
        ),
    ],
)
def test_rules(tmp_path: Path, rule: dict, expected: np.ndarray) -> None:
    threat = load(tmp_path, [{"raster": raster(tmp_path, VALUES), "rule": rule}])
    assert np.isnan(threat[0, 1])
    free = ~np.isnan(threat)
    assert threat[free] == pytest.approx(expected[free], abs=1e-7)


def test_without_a_rule_values_are_probabilities_and_csv_works(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "r.csv", VALUES / 100, delimiter=",")
    assert load(tmp_path, [{"raster": "r.csv"}])[5, 8] == np.float32(0.53)


def test_what_lies_on_obstacles_does_not_matter(tmp_path: Path) -> None:
    values = VALUES / 100
    for wrong in (np.nan, -1.0, 7.0, np.inf):
        values[0, 1] = wrong
        assert np.isnan(load(tmp_path, [{"raster": raster(tmp_path, values)}])[0, 1])


@pytest.mark.parametrize(
    ("wrong", "rule", "names"),
    [
        (np.nan, RULE, "nan (no data) at [2, 4]"),
        (np.inf, RULE, "infinite at [2, 4]"),
        (-3.0, RULE, "p = -0.003 for the value -3 at [2, 4]"),
        (1500.0, RULE, "p = 1.5 for the value 1500 at [2, 4]"),
        (1000.0, RULE, "lower scale"),
        (1e9, {"kind": "exposure", "rate": 1.0}, "p = 1 for the value 1e+09 at [2, 4]"),
        (-1e300, {"kind": "exposure", "rate": 1e9}, "at [2, 4]"),
        (1.0, None, "give a rule"),
    ],
)
def test_a_raster_that_gives_no_probability(tmp_path: Path, wrong: float, rule: dict | None, names: str) -> None:
    values = np.zeros((6, 9))
    values[2, 4] = wrong
    with pytest.raises(ScenarioError, match=r"`threats\[0\]\.(raster|rule)`") as caught:
        load(tmp_path, [{"raster": raster(tmp_path, values)} | ({"rule": rule} if rule else {})])
    assert names in str(caught.value)


@pytest.mark.parametrize(
    ("rule", "names"),
    [
        ({"kind": "lineal", "scale": 1}, "did you mean 'linear'"),
        ({"kind": "linear"}, "`threats[0].rule.scale` is missing"),
        ({"kind": "linear", "scale": 1, "rate": 2}, "unknown key `threats[0].rule.rate`"),
        ({"kind": "linear", "scale": 0}, "`threats[0].rule.scale` is 0"),
        ({"kind": "exposure", "rate": math.nan}, "`threats[0].rule.rate` is nan"),
        ({"kind": "exposure", "rate": -1}, "is -1"),
        ({"kind": "exposure", "rate": True}, "is True"),
        ({"kind": "classes", "edges": [2, 1], "p": [0, 0, 0]}, "rising"),
        ({"kind": "classes", "edges": [1, 2], "p": [0, 0.1]}, "3 probabilities 0 <= p < 1 for 2 edges"),
        ({"kind": "classes", "edges": [1], "p": [0, 1]}, "`threats[0].rule.p[1]` is 1"),
        ({"kind": "classes", "edges": [1], "p": [0, -0.1]}, "`threats[0].rule.p[1]` is -0.1"),
        ({"kind": "classes", "edges": "1", "p": [0, 0.1]}, "`threats[0].rule.edges`"),
    ],
)
def test_wrong_rules(tmp_path: Path, rule: dict, names: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load(tmp_path, [{"raster": raster(tmp_path, VALUES), "rule": rule}])
    assert names in str(caught.value)


def test_a_raster_of_another_size_names_both(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"6 x 9 pixels or its 3 x 4 cells; the raster has 5 x 9"):
        load(tmp_path, [{"raster": raster(tmp_path, VALUES[1:])}], cell_size=2)


def test_pixels_become_cells_by_the_largest_free_one(tmp_path: Path) -> None:
    values = np.zeros((6, 9))
    values[2:4, 2:4] = [[0.1, 0.2], [0.3, 0.05]]
    fine = load(tmp_path, [{"raster": raster(tmp_path, values)}], cell_size=2)
    assert fine.shape == (3, 4)
    assert fine[1, 1] == np.float32(0.3)
    assert np.nansum(fine) == np.float32(0.3)
    coarse = load(tmp_path, [{"raster": raster(tmp_path, np.full((3, 4), 0.2))}], cell_size=2)
    assert np.isnan(coarse[0, 0])
    assert (coarse[1:] == np.float32(0.2)).all()


def test_a_layer_is_laid_over_the_map_by_both_origins(tmp_path: Path) -> None:
    # the map: 6 x 9 cells of 1 m with its lower-left corner at (10, 20); the layer: 2 m, at (12, 20), 2 x 3 pixels
    ground = world_file(tmp_path, np.zeros((6, 9)), origin=(10, 20, 0))
    values = np.array([[100, 0, 60], [20, 40, 0]])
    source = {"layer": ros_layer(tmp_path, values, 2.0, [12, 20, 0]), "scale": 0.2}
    threat = load(tmp_path, [source], map={"file": ground})
    expected = np.zeros((6, 9))
    expected[2:6, 2:8] = np.kron(values, np.ones((2, 2))) * 0.2 / 100
    assert threat == pytest.approx(expected, abs=1e-6)
    notes = load_input(tmp_path / "scenario.yaml").notes
    assert notes == ("threats[0]: 30 free pixels lie where the layer is unknown or does not reach: no threat from it",)


def test_a_finer_layer_gives_its_largest_value(tmp_path: Path) -> None:
    values = np.zeros((4, 6))
    values[0, 1], values[3, 5] = 80, 40
    source = {"layer": ros_layer(tmp_path, values, 0.5, [0, 0, 0]), "scale": 0.5}
    threat = load(tmp_path, [source], map={"file": world_file(tmp_path, np.zeros((2, 3)))})
    assert threat == pytest.approx(np.array([[0.4, 0, 0], [0, 0, 0.2]]), abs=1e-6)


def test_a_turned_layer(tmp_path: Path) -> None:
    # the layer's frame is turned by 90 degrees about (3, 0): its columns run along the map's y axis
    values = np.array([[10, 20], [30, 40], [50, 60]])
    source = {"layer": ros_layer(tmp_path, values, 1.0, [3, 0, math.pi / 2]), "scale": 1.0}
    threat = load(tmp_path, [source], map={"file": world_file(tmp_path, np.zeros((2, 3)))})
    assert threat == pytest.approx(np.array([[0.2, 0.4, 0.6], [0.1, 0.3, 0.5]]), abs=1e-6)


def test_a_layer_that_would_kill_for_certain(tmp_path: Path) -> None:
    source = {"layer": ros_layer(tmp_path, np.full((2, 3), 100), 1.0, [0, 0, 0])}
    with pytest.raises(ScenarioError, match="lower scale"):
        load(tmp_path, [source], map={"file": world_file(tmp_path, np.zeros((2, 3)))})


def test_sources_combine_with_each_other_and_with_the_maps_own(tmp_path: Path) -> None:
    own = np.full((2, 3), 0.1)
    own[0, 0] = np.nan
    ground = {"file": world_file(tmp_path, own)}
    sources = [
        {"raster": raster(tmp_path, np.full((2, 3), 0.2))},
        {"raster": raster(tmp_path, np.zeros((2, 3)), "z.npy")},
    ]
    assert load(tmp_path, sources, map=ground)[1, 2] == np.float32(1 - 0.9 * 0.8)
    assert load(tmp_path, sources, map=ground, combine="max")[1, 2] == np.float32(0.2)
    assert load(tmp_path, sources[1:], map=ground)[1, 2] == np.float32(0.1)


def test_generated_threats_count_the_free_cells(tmp_path: Path) -> None:
    source = {"generate": {"kind": "contiguous", "ratio": 0.25, "areas": 3, "levels": [0.1, 0.2], "seed": 7}}
    threat = load(tmp_path, [source])
    assert (threat > 0).sum() == round(0.25 * 53) == 13
    assert set(np.unique(threat[threat > 0])) == {np.float32(0.1), np.float32(0.2)}


@pytest.mark.parametrize(
    ("keys", "names"),
    [
        ({"kind": "contiguos", "ratio": 0.2}, "did you mean 'contiguous'"),
        ({"kind": "scattered"}, "generate.ratio` is missing"),
        ({"kind": "scattered", "ratio": 1.5}, "generate.ratio` is 1.5"),
        ({"kind": "scattered", "ratio": 0.2, "areas": 0}, "generate.areas` is 0"),
        ({"kind": "scattered", "ratio": 0.2, "levels": []}, "generate.levels"),
        ({"kind": "scattered", "ratio": 0.2, "levels": [0.1, 1]}, "generate.levels[1]` is 1"),
        ({"kind": "scattered", "ratio": 0.2, "seed": -1}, "generate.seed` is -1"),
        ({"kind": "scattered", "ratio": 0.2, "seed": 1.0}, "generate.seed` is 1.0"),
        ({"kind": "scattered", "ratio": 0.2, "level": [0.1]}, "did you mean 'levels'"),
    ],
)
def test_wrong_generate(tmp_path: Path, keys: dict, names: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load(tmp_path, [{"generate": keys}])
    assert names in str(caught.value)


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ({"rastr": "r.npy"}, "did you mean 'raster'"),
        ({"raster": "gone.npy"}, "`threats[0].raster`: no such file"),
        ({"raster": "scenario.yaml"}, "unknown raster format '.yaml'"),
        ({"raster": 3}, "`threats[0].raster` is 3"),
        ({"raster": "a", "layer": "b"}, "not both raster and layer"),
        ({"raster": "a", "scale": 2}, "unknown key `threats[0].scale`"),
        ({}, "one of raster"),
        ("fire", "`threats[0]` is 'fire'"),
        ({"points": "scenario.yaml"}, "falloff"),
        ({"points": "scenario.yaml", "falloff": {"kind": "cone", "radius": 1}}, "falloff.kind` is 'cone'"),
        ({"points": "scenario.yaml", "falloff": {"kind": "disc", "radius": 0}}, "falloff.radius` is 0"),
        ({"layer": "scenario.yaml", "scale": 0}, "scale` is 0"),
    ],
)
def test_wrong_sources(tmp_path: Path, source: object, names: str) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, [source])
    assert names in str(caught.value)


@pytest.mark.parametrize(
    ("p", "said"),
    [
        (1e300, r"nan \(no data\) .* \(54 pixels of 1e\+300, a mark of no data"),
        (1.0, "gives p = "),
        (-0.1, "gives p = "),
    ],
)
def test_probabilities_that_are_none(tmp_path: Path, p: float, said: str) -> None:
    (tmp_path / "a.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1]]]}))
    with pytest.raises(ScenarioError, match=r"threats\[0\]\.p` is"):
        load(tmp_path, [{"polygons": "a.geojson", "p": p}])
    with pytest.raises(ScenarioError, match=said):
        load(tmp_path, [{"raster": raster(tmp_path, np.full((6, 9), p))}])


def test_a_raster_too_small_for_float32_is_noted(tmp_path: Path) -> None:
    name = raster(tmp_path, VALUES)
    threat = load(tmp_path, [{"raster": name, "rule": {"kind": "linear", "scale": 1e-300}}])
    assert not np.nan_to_num(threat).any()
    notes = load_input(tmp_path / "scenario.yaml").notes
    assert [note for note in notes if "52 cells have a threat too small" in note]


def test_generated_areas_and_levels_have_limits(tmp_path: Path) -> None:
    def pattern(**keys: object) -> list:
        return [{"generate": {"kind": "contiguous", "ratio": 0.1, **keys}}]

    with pytest.raises(ScenarioError, match=r"generate\.areas` is 55; expected .* on this map, 1 to 54"):
        load(tmp_path, pattern(areas=55))
    with pytest.raises(ScenarioError, match=r"generate\.levels\[0\]` is 1e-60; expected .*1e-30"):
        load(tmp_path, pattern(levels=[1e-60]))
    assert (load(tmp_path, pattern(areas=54)) > 0).sum() == 5
    notes = load_input(tmp_path / "scenario.yaml").notes
    assert "threats[0]: 5 dangerous cells make 5 areas of one cell, not 54" in notes
