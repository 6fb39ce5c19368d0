"""Sources of threat: rules, layers, points, polygons, line of sight."""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from drawn_worlds import fields, load, raster, world_file
from matplotlib.path import Path as Outline
from PIL import Image

import planner.world.points
import planner.world.vector_files
from planner.errors import InputError, MapError, ScenarioError
from planner.world.frame import Frame
from planner.world.points import inside, point_spreads, read_points
from planner.world.raster_files import slope_degrees, visible
from planner.world.robot_types import Thing, combined
from planner.world.scenario import load_input
from planner.world.world import World

# Sources of threat: rules, layers, generated ones, and how they combine.

RULE = {"kind": "linear", "scale": 0.001}


def ruled(kind: str, **keys: Any) -> dict[str, Any]:
    """A raster of 6 x 9 pixels with such a rule."""
    return {"raster": "r.npy", "rule": {"kind": kind} | keys}


def laid(folder: Path, ground: np.ndarray, values: list, resolution: float, at: list[float], **keys: Any) -> np.ndarray:
    """Threat on a map of 1 m cells under a ROS scale map with these values 0..100."""
    Image.fromarray(np.rint(255 - np.array(values) * 2.55).astype(np.uint8)).save(folder / "layer.png")
    about = {"image": "layer.png", "mode": "scale", "resolution": resolution, "origin": at}
    about |= {"negate": 0, "occupied_thresh": 1.0, "free_thresh": 0.0}
    (folder / "layer.yaml").write_text(yaml.safe_dump(about))
    origin = keys.pop("origin", (0, 0, 0))
    return load(folder, [{"layer": "layer.yaml"} | keys], map={"file": world_file(folder, ground, origin=origin)})


VALUES = np.arange(54, dtype=np.float64).reshape(6, 9)


RULES = [
    ({"kind": "linear", "scale": 0.01}, VALUES * 0.01),
    ({"kind": "exposure", "rate": 0.02}, 1 - np.exp(-0.02 * VALUES)),
    ({"kind": "classes", "edges": [10, 20.5], "p": [0, 0.1, 0.3]}, 0.1 * (VALUES >= 10) + 0.2 * (VALUES >= 20.5)),
]


@pytest.mark.parametrize(("rule", "expected"), RULES)
def test_rules(tmp_path: Path, rule: dict, expected: np.ndarray) -> None:
    threat = load(tmp_path, [{"raster": raster(tmp_path, VALUES), "rule": rule}])
    free = ~np.isnan(threat)
    assert not free[0, 1] and threat[free] == pytest.approx(expected[free], abs=1e-7)


def test_without_a_rule_values_are_probabilities_and_csv_works(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "r.csv", VALUES / 100, delimiter=",")
    assert load(tmp_path, [{"raster": "r.csv"}])[5, 8] == np.float32(0.53)


def test_what_lies_on_obstacles_does_not_matter(tmp_path: Path) -> None:
    values = VALUES / 100
    for wrong in (np.nan, -1.0, 7.0, np.inf):
        values[0, 1] = wrong
        assert np.isnan(load(tmp_path, [{"raster": raster(tmp_path, values)}])[0, 1])


NO_PROBABILITIES = [
    (np.nan, RULE, "nan (no data) at [2, 4]"), (np.inf, RULE, "infinite at [2, 4]"),
    (-3.0, RULE, "p = -0.003 for the value -3 at [2, 4]"), (1500.0, RULE, "p = 1.5 for the value 1500 at [2, 4]"),
    (1000.0, RULE, "lower scale"), (1e9, {"kind": "exposure", "rate": 1.0}, "p = 1 for the value 1e+09 at [2, 4]"),
    (-1e300, {"kind": "exposure", "rate": 1e9}, "at [2, 4]"), (1.0, None, "give a rule"),
]  # fmt: skip


@pytest.mark.parametrize(("wrong", "rule", "names"), NO_PROBABILITIES)
def test_a_raster_that_gives_no_probability(tmp_path: Path, wrong: float, rule: dict | None, names: str) -> None:
    values = np.zeros((6, 9))
    values[2, 4] = wrong
    with pytest.raises(ScenarioError, match=r"`threats\[0\]\.(raster|rule)`") as caught:
        load(tmp_path, [{"raster": raster(tmp_path, values)} | ({"rule": rule} if rule else {})])
    assert names in str(caught.value)


def test_a_raster_of_another_size_names_both(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"6 x 9 pixels or its 3 x 4 cells; the raster has 5 x 9"):
        load(tmp_path, [{"raster": raster(tmp_path, VALUES[1:])}], cell_size=2)


def test_pixels_become_cells_by_the_largest_free_one(tmp_path: Path) -> None:
    values = np.zeros((6, 9))
    values[2:4, 2:4] = [[0.1, 0.2], [0.3, 0.05]]
    fine = load(tmp_path, [{"raster": raster(tmp_path, values)}], cell_size=2)
    assert fine.shape == (3, 4) and fine[1, 1] == np.nansum(fine) == np.float32(0.3)
    coarse = load(tmp_path, [{"raster": raster(tmp_path, np.full((3, 4), 0.2))}], cell_size=2)
    assert np.isnan(coarse[0, 0]) and (coarse[1:] == np.float32(0.2)).all()


def test_a_layer_is_laid_over_the_map_by_both_origins(tmp_path: Path) -> None:
    # the map: 6 x 9 cells of 1 m with its lower-left corner at (10, 20); the layer: 2 m, at (12, 20), 2 x 3 pixels
    values = [[100, 0, 60], [20, 40, 0]]
    threat = laid(tmp_path, np.zeros((6, 9)), values, 2.0, [12, 20, 0], scale=0.2, origin=(10, 20, 0))
    expected = np.zeros((6, 9))
    expected[2:6, 2:8] = np.kron(values, np.ones((2, 2))) * 0.2 / 100
    assert threat == pytest.approx(expected, abs=1e-6)
    notes = load_input(tmp_path / "scenario.yaml").notes
    assert notes == ("threats[0]: the layer is unknown or missing at 30 free pixels: no threat from it there",)


def test_a_finer_layer_gives_its_largest_value(tmp_path: Path) -> None:
    values = np.zeros((4, 6))
    values[0, 1], values[3, 5] = 80, 40
    threat = laid(tmp_path, np.zeros((2, 3)), values, 0.5, [0, 0, 0], scale=0.5)
    assert threat == pytest.approx(np.array([[0.4, 0, 0], [0, 0, 0.2]]), abs=1e-6)


def test_a_turned_layer(tmp_path: Path) -> None:
    # the layer's frame is turned by 90 degrees about (3, 0): its columns run along the map's y axis
    threat = laid(tmp_path, np.zeros((2, 3)), [[10, 20], [30, 40], [50, 60]], 1.0, [3, 0, math.pi / 2], scale=1.0)
    assert threat == pytest.approx(np.array([[0.2, 0.4, 0.6], [0.1, 0.3, 0.5]]), abs=1e-6)


def test_a_layer_that_would_kill_for_certain(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="lower scale"):
        laid(tmp_path, np.zeros((2, 3)), np.full((2, 3), 100), 1.0, [0, 0, 0])


def test_sources_combine_with_each_other_and_with_the_maps_own(tmp_path: Path) -> None:
    ground = {"file": world_file(tmp_path, np.array([[np.nan, 0.1, 0.1], [0.1] * 3]))}
    sources = [{"raster": raster(tmp_path, np.full((2, 3), p), f"{p}.npy")} for p in (0.2, 0.0)]
    assert load(tmp_path, sources, map=ground)[1, 2] == np.float32(1 - 0.9 * 0.8)
    assert load(tmp_path, sources, map=ground, combine="max")[1, 2] == np.float32(0.2)
    assert load(tmp_path, sources[1:], map=ground)[1, 2] == np.float32(0.1)


def test_generated_threats_count_the_free_cells(tmp_path: Path) -> None:
    source = {"generate": {"kind": "contiguous", "ratio": 0.25, "areas": 3, "levels": [0.1, 0.2], "seed": 7}}
    threat = load(tmp_path, [source])
    assert (threat > 0).sum() == round(0.25 * 53) == 13
    assert set(np.unique(threat[threat > 0])) == {np.float32(0.1), np.float32(0.2)}


WRONG_RULES = (
    ({"kind": "lineal", "scale": 1}, "did you mean 'linear'"),
    ({"kind": "linear"}, "`threats[0].rule.scale` is missing"),
    ({"kind": "linear", "scale": 1, "rate": 2}, "unknown key `threats[0].rule.rate`"),
    ({"kind": "linear", "scale": 0}, "`threats[0].rule.scale` is 0"),
    *(({"kind": "exposure", "rate": rate}, f"`threats[0].rule.rate` is {rate}") for rate in (math.nan, -1, True)),
    ({"kind": "classes", "edges": [2, 1], "p": [0, 0, 0]}, "increasing numbers"),
    ({"kind": "classes", "edges": [1, 2], "p": [0, 0.1]}, "3 probabilities 0 <= p < 1"),
    *(({"kind": "classes", "edges": [1], "p": [0, p]}, f"`threats[0].rule.p[1]` is {p}") for p in (1, -0.1)),
    ({"kind": "classes", "edges": "1", "p": [0, 0.1]}, "`threats[0].rule.edges`"),
)


WRONG_SOURCES = [
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
    *(
        ({"points": "scenario.yaml", "falloff": {"kind": kind, "radius": radius}}, "falloff.radius` is ")
        for kind in ("disc", "gaussian")
        for radius in (0, 1e300, 1e308, 1e-320, 1e10)
    ),
    ({"layer": "scenario.yaml", "scale": 0}, "scale` is 0"),
    ({"viewshed": {"sites": [[0, 0]], "range": 5, "p": 0.1}}, "needs heights"),
    *(({"raster": "r.npy", "rule": rule}, said) for rule, said in WRONG_RULES),
    ({"generate": {"kind": "contiguos", "ratio": 0.2}}, "did you mean 'contiguous'"),
    ({"generate": {"kind": "scattered"}}, "generate.ratio` is missing"),
    *(
        ({"generate": {"kind": "scattered", "ratio": 0.2} | wrong}, f"generate.{said}")
        for wrong, said in (
            ({"ratio": 1.5}, "ratio` is 1.5"),
            ({"areas": 0}, "areas` is 0"),
            ({"levels": []}, "levels"),
            ({"levels": [0.1, 1]}, "levels[1]` is 1"),
            ({"seed": -1}, "seed` is -1"),
            ({"seed": 1.0}, "seed` is 1.0"),
            ({"level": [0.1]}, "level`; expected one of kind, ratio, areas, levels, seed; did you mean 'levels'"),
        )
    ),
]


@pytest.mark.parametrize(("source", "names"), WRONG_SOURCES)
def test_wrong_sources(tmp_path: Path, source: object, names: str) -> None:
    raster(tmp_path, VALUES)
    with pytest.raises(InputError, match=re.escape(names)) as caught:
        load(tmp_path, [source])
    assert isinstance(caught.value, ScenarioError) or "threats[0]" not in str(caught.value)


NOT_P = [
    (1e300, r"nan \(no data\) .* \(54 pixels of 1e\+300, a mark of no data"),
    (1.0, "gives p = "),
    (-0.1, "gives p = "),
]


@pytest.mark.parametrize(("p", "said"), NOT_P)
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


# Threats from points and polygons.


def test_points_at_the_centres(tmp_path: Path) -> None:
    frame = Frame((5, 8), 2.0, (1.0, -3.0, 0.4))
    points, centres = np.array([[4.0, 2.0, 0.5], [9.0, 4.0, 0.3], [-90.0, 5.0, 0.9]]), frame.centres()
    for kind, far in (("disc", 3.0), ("gaussian", 9.0)):
        passed = np.ones(frame.shape)
        for x, y, strength in points:
            distance = np.hypot(centres[..., 0] - x, centres[..., 1] - y)
            p = strength * (np.exp(-(distance**2) / 18) if kind == "gaussian" else 1.0)
            passed *= 1 - np.where(distance <= far, p, 0)
        things = [Thing("", "", *spread) for spread in point_spreads(points, kind, 3.0, frame)]
        found = combined(things, "product", frame.shape[0] * frame.shape[1]).reshape(frame.shape)
        assert found == pytest.approx(1 - passed, abs=1e-12)
        assert passed.min() < 0.8


BROKEN_POINTS = [
    ("", "is empty"), ("x,y,strength\n", "no points"), ("1,2\n", "line 1 has 2 values"),
    ("1,2,0.5\n1,2\n", "line 2 has 2 values"), ("1,1,0.5\n1e308,1,0.5\n", "line 2: x is '1e308'"),
    ("1,2,1\n", "line 1: strength is 1"), ("1,2,-0.1\n", "line 1: strength is -0.1"),
    ("x,y,strength\n1,nan,0.1\n", "line 2: y is 'nan'"),
    ("x,y,strength\n1,2,strong\n", "line 2: strength is 'strong'"), ("x,y,z,w\n1,2,3,4\n", "columns x, y, z, w"),
    ("x;y;strength\n1,5;2;0.5\n3;4;0,25\n", "strength: line 3 has '0,25' and line 2 '0.5'"),
    ("x;y;strength\n1,234;2,345;0\n", "x: line 2: '1,234' may be 1.234 or 1234"),
    ("x;y;strength\n1.234;2,3;0\n", "x: line 2: '1.234' may be 1.234 or 1234"),
    ("x;y;strength\n1.234,5;2;0\n", "x: line 2: '1.234,5' has marks between thousands"),
    ("x;1\ty\n1;2\t3\n", "its columns may be separated by semicolons or by tabs"),
    ("x,y,strength\n1;2;0.5\n", "line 2 has 1 values, and semicolons; expected 3 as above, separated by commas"),
    ("x,y,strength\n1,0,2,0,0,5\n", "if its numbers have decimal commas, separate the columns by semicolons"),
    ("1,0,2,0,0,5\n", "if its numbers have decimal commas, separate the columns by semicolons"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "names"), BROKEN_POINTS)
def test_broken_points_files(tmp_path: Path, text: str, names: str) -> None:
    """Such as a table that can be read in two ways."""
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(MapError, match=re.escape(names)) as caught:
        read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))
    assert "p.csv" in str(caught.value)


SQUARE = [[1.2, 1.1], [7.3, 0.4], [8.1, 4.2], [3.3, 5.7], [1.2, 1.1]]


HOLE = [[3.0, 2.0], [5.1, 2.2], [4.4, 4.1], [3.0, 2.0]]


def test_polygons_agree_with_matplotlib() -> None:
    frame = Frame((12, 17), 0.5, (0.3, -0.2, 0.15))
    rings = [np.array(SQUARE), np.array(HOLE)]
    centres = frame.centres().reshape(-1, 2)
    expected = Outline(SQUARE).contains_points(centres) & ~Outline(HOLE).contains_points(centres)
    assert inside(rings, frame).reshape(-1).tolist() == expected.tolist()
    assert 0 < expected.sum() < expected.size


def geojson(folder: Path, *features: dict) -> str:
    (folder / "a.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return "a.geojson"


def feature(coordinates: list, p: object = 0.2, kind: str = "Polygon") -> dict:
    properties = {} if p is None else {"p": p}
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def test_polygons_with_holes_and_overlap(tmp_path: Path) -> None:
    box = [[0, 0], [6, 0], [6, 4], [0, 4]]  # not closed: taken as closed
    hole = [[2, 1], [4, 1], [4, 3], [2, 3]]
    both = [[[box[0], box[1], box[2], box[3]], hole], [[[8, 0], [9, 0], [9, 6], [8, 6]]]]
    name = geojson(tmp_path, feature(both, 0.2, "MultiPolygon"), feature([[[0, 0], [9, 0], [9, 1], [0, 1]]], None))
    threat = load(tmp_path, [{"polygons": name, "p": 0.5}])
    expected = np.zeros((6, 9))
    expected[2:6, 0:6] = 0.2
    expected[3:5, 2:4] = 0
    expected[:, 8] = 0.2
    expected[5] = np.where(expected[5] > 0, 1 - 0.8 * 0.5, 0.5)
    expected[0, 1] = np.nan
    assert threat == pytest.approx(expected, abs=1e-7, nan_ok=True)


MUNICH = [[11.57549, 48.13743], [11.57812, 48.13743], [11.57812, 48.13901]]


POLYGONS_NOT_MEANT = [
    (MUNICH, ["x 11.57549 .. 11.57812", "reproject"]),
    ([[11.50549, 1.13743], [11.57812, 1.13743], [11.57812, 1.13901]], ["reproject"]),
    ([[1.50549, 1.53743], [1.50812, 1.53743], [1.50812, 1.53901]], ["reproject"]),
    ([[691000, 5334000], [691050, 5334000], [691050, 5334050]], ["the map is 9 x 6 m from (0, 0)"]),
    ([[20, 1], [30, 1], [30, 3]], ["x 20 .. 30, y 1 .. 3"]),
]


@pytest.mark.parametrize(("ring", "names"), POLYGONS_NOT_MEANT)
def test_polygons_that_cannot_be_meant_are_refused(tmp_path: Path, ring: list, names: list[str]) -> None:
    with pytest.raises(ScenarioError) as caught:
        load(tmp_path, [{"polygons": geojson(tmp_path, feature([ring]))}])
    assert all(name in str(caught.value) for name in ["`threats[0].polygons`", "a.geojson", *names])
    assert load(tmp_path, [{"polygons": geojson(tmp_path, feature([ring]), feature([SQUARE]))}])[1:].any()


@pytest.mark.parametrize("name", ["urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "urn:ogc:def:crs:EPSG::4258"])
def test_a_crs_of_degrees_is_refused_and_one_of_metres_is_not(tmp_path: Path, name: str) -> None:
    data = {"type": "FeatureCollection", "features": [feature([SQUARE])]}
    for crs, fits in ((name, False), ("urn:ogc:def:crs:EPSG::32632", True)):
        (tmp_path / "a.geojson").write_text(json.dumps({**data, "crs": {"type": "name", "properties": {"name": crs}}}))
        if fits:
            assert np.nansum(load(tmp_path, [{"polygons": "a.geojson"}])) > 0
        else:
            with pytest.raises(MapError, match="degrees; expected metres; reproject"):
                load(tmp_path, [{"polygons": "a.geojson"}])


POINTS_NOT_MEANT = [
    ("lon,lat,strength\n1,2,0.5\n", "lon, lat, strength"),
    ("longitude,latitude,weight\n1,2,0.5\n", "expected x, y in metres"),
    ("11.57549,48.13743,0.5\n", "reproject"),
    ("691000,5334000,0.5\n691001,5334000,0.5\n", "covers no cell: x 691000 .. 691001"),
]


@pytest.mark.parametrize(("text", "names"), POINTS_NOT_MEANT)
def test_points_that_cannot_be_meant_are_refused(tmp_path: Path, text: str, names: str) -> None:
    with pytest.raises(InputError, match=re.escape(names)):
        pointed(tmp_path, text, 2)


def pointed(folder: Path, text: str, radius: float = 1, kind: str = "disc") -> tuple[np.ndarray, Sequence[str]]:
    """Threat and notes of a scenario with the points of this table."""
    (folder / "p.csv").write_text(text)
    threat = load(folder, [{"points": "p.csv", "falloff": {"kind": kind, "radius": radius}}])
    return threat, load_input(folder / "scenario.yaml").notes


def test_points_in_a_scenario_and_their_notes(tmp_path: Path) -> None:
    threat, notes = pointed(tmp_path, "2.5,2.5,0.5\n100,100,0.5\n")
    assert np.argwhere(threat > 0).tolist() == [[2, 2], [3, 1], [3, 2], [3, 3], [4, 2]]
    assert "threats[0]: 1 of 2 points lie off the map" in notes
    assert np.nansum(pointed(tmp_path, "-1,3,0.5\n", 2)[0]) > 0, "off the map, and reaches it"
    assert not np.nansum(pointed(tmp_path, "-50,3,0\n", 2)[0])
    notes = pointed(tmp_path, "1.57549,2.13743,0.5\n1.57812,2.13901,0.5\n")[1]
    assert "threats[0]: all 2 points lie in one pixel: are x and y in metres?" in notes


@pytest.mark.parametrize("radius", [1e300, 1e308, 1e-320, 1e10])
@pytest.mark.parametrize("kind", ["disc", "gaussian"])
def test_a_radius_that_cannot_be(tmp_path: Path, kind: str, radius: float) -> None:
    with pytest.raises(ScenarioError, match=r"`threats\[0\]\.falloff\.radius` is .*1e\+09"):
        pointed(tmp_path, "1,1,0.5\n", radius, kind)


def test_points_beyond_the_world_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="line 2: x is '1e308'"):
        pointed(tmp_path, "1,1,0.5\n1e308,1,0.5\n", 1e9)


def test_shapes_beyond_the_limits_are_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "p.csv").write_text("1,2,0.5\n" * 4)
    points = {"points": "p.csv", "falloff": {"kind": "disc", "radius": 1}}
    polygons = {"polygons": geojson(tmp_path, feature([SQUARE]))}
    for limits, most, said in ((("MAX_POINTS", "MAX_CORNERS"), 3, "at most 3"),
                               (("MAX_BYTES",) * 2, 30, r"bytes; expected .* of at most 30")):  # fmt: skip
        monkeypatch.setattr(planner.world.points, limits[0], most)
        monkeypatch.setattr(planner.world.vector_files, limits[1], most)
        for source in (points, polygons):
            with pytest.raises(MapError, match=said):
                load(tmp_path, [source])


def test_a_polygon_between_the_centres_is_noted(tmp_path: Path) -> None:
    name = geojson(tmp_path, feature([[[1.6, 1.6], [1.9, 1.6], [1.9, 1.9]]]))
    assert not np.nansum(load(tmp_path, [{"polygons": name}]))
    notes = load_input(tmp_path / "scenario.yaml").notes
    assert "threats[0]: features[0] holds no pixel's centre: no threat from it" in notes


RINGS: list[Any] = [
    [[1e308, 1e308], [-1e308, 1e308], [0, -1e308]], [["0", "0"], ["5", "0"], ["5", "5"]],
    [[False, False], [True, False], [True, True]], [[0], [5], [5]], ["00", "50", "55"],
    [[0, 0], [5, 0], [10**400, 5]], [[0, 0], [5, 0], [None, 5]], [{"x": 1, "y": 2}] * 3,
]  # fmt: skip
"""Coordinates that cannot be."""


BROKEN_POLYGONS = [
    (feature([SQUARE], 1), "features[0]: property p is 1"), (feature([SQUARE], None), "property p is missing"),
    (feature([SQUARE], "high"), "'high'"), (feature([SQUARE], math.nan), "nan"),
    (feature(SQUARE, 0.1), "wrong coordinates"), (feature([SQUARE[:2]], 0.1), "three finite points"),
    (feature([[[0, 0], [1, math.inf], [1, 1]]], 0.1), "three finite points"),
    (feature([0, 0], 0.1, "Point"), "'Point'"), ({"type": "Feature", "properties": [1]}, "properties"),
    *((feature([ring], 0.5), "a.geojson: features[0]: wrong coordinates (a point is ") for ring in RINGS),
]  # fmt: skip


@pytest.mark.parametrize(("wrong", "names"), BROKEN_POLYGONS)
def test_broken_polygons(tmp_path: Path, wrong: dict, names: str) -> None:
    with pytest.raises(MapError, match=re.escape(names)) as caught:
        load(tmp_path, [{"polygons": geojson(tmp_path, wrong)}])
    assert len(str(caught.value)) < 500


TABLES = [
    ("1,2,0.5\n3,4,0.25\n", "", ""),
    ("x,y,strength\n1,2,0.5\n3,4,0.25\n", "", ""),
    ("a,b,c\n1,2,0.5\n\n3,4,0.25\n", "", ""),
    ("id,p,y_m,x_m\nfirst,0.5,2,1\nsecond,0.25,4,3\n", "", ""),
    ("x;y;strength\n1;2;0.5\n3;4;0.25\n", "semicolons", "points"),
    ("x;y;strength\r\n1,0;2;0,5\r\n\r\n3;4;0,25\r\n", "semicolons", "commas"),
    ("1,0\t2\t0,5\n3\t4\t0,25\n", "tabs", "commas"),
    ("sep=;\nid;x;y;strength;\n3.1;1;2;,5;\n3.2;3;4;0,25;\n", "semicolons", "commas"),
    ('"x","y","strength"\n"1,0","2","0,5"\n"3","4","0,25"\n', "commas", "commas"),
    ("x y strength\n1 2  0.5\n3   4 0.25\n", "spaces", "points"),
    ("x|y|strength\n1,000|2,000|5,0e-1\n3|4|0,250\n", "bars", "commas"),
]
"""The same two points; separator and decimal sign that a note names."""


@pytest.mark.parametrize(("text", "separator", "decimal"), TABLES)
def test_points_files(tmp_path: Path, text: str, separator: str, decimal: str) -> None:
    (tmp_path / "p.csv").write_bytes(text.encode())
    found = read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))
    assert found.places.tolist() == [[1, 2, 0.5], [3, 4, 0.25]]
    note = f"columns are read as separated by {separator}, numbers as written with decimal {decimal}"
    assert found.notes == ((note,) if separator else ())
    np.save(tmp_path / "m.npy", np.zeros((9, 9)))
    for key in ("threats", "value") if separator else ():
        notes = scenario(
            tmp_path, **{"map": "m.npy", key: [{"points": "p.csv", "falloff": {"kind": "disc", "radius": 1}}]}
        ).notes
        assert f"{key}[0]: {note}" in notes


def test_a_column_that_is_not_read_may_hold_anything(tmp_path: Path) -> None:
    """Names with semicolons among commas; marks between thousands, and the other decimal sign."""
    (tmp_path / "p.csv").write_text('name,x,y,strength\n"Pit; north",1,2,0.5\nHill,3,4,0.25\n')
    found = read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))
    assert found.names[0][0] == "Pit; north" and not found.notes
    (tmp_path / "p.csv").write_text("x;y;strength;seen;id\n1;2;0,5;1.234;3.1\n3;4;0,25;7,5;3,2\n")
    assert read_points(tmp_path / "p.csv", Frame((9, 9), 1.0)).places.tolist() == [[1, 2, 0.5], [3, 4, 0.25]]


# Threats apart: a map without one of its polygons, points or sites is that of a scenario that never named it.

FIELDS = [("north", 0.2, 1, 7, 6, 12), ("", 0.3, 4, 2, 9, 8), ("south", 0.2, 0, 0, 5, 3), ("", 0.1, 30, 30, 31, 31)]
POINTS = [("well", 6.2, 7.4, 0.4), ("gate", 2.0, 2.0, 0.3), ("gate", 11.0, 3.0, 0.2), ("gate", 7.0, 7.0, 0.1)]


def scenario(folder: Path, **said: Any) -> World:
    (folder / "scenario.yaml").write_text(yaml.safe_dump(said))
    return load_input(folder / "scenario.yaml")


def world_of(folder: Path, named: list, points: list, combine: str, cell_size: float) -> World:
    """A scenario of a threatened map, points, a raster and fields, in this order."""
    rng = np.random.default_rng(5)
    own = np.where(rng.random((12, 14)) < 0.1, np.nan, np.where(rng.random((12, 14)) < 0.2, 0.05, 0.0))
    own[0, 0] = 0.0
    World.create(own).save(folder / "map.npz", force=True)
    np.save(folder / "raster.npy", rng.random((12, 14)) * (rng.random((12, 14)) < 0.3))
    fields(folder / "fields.json", *named)
    (folder / "points.csv").write_text("\n".join(["name,x,y,strength", *(",".join(map(str, one)) for one in points)]))
    falloff = {"kind": "gaussian", "radius": 2.5}
    sources = [{"points": "points.csv", "falloff": falloff}, {"raster": "raster.npy"}, {"polygons": "fields.json"}]
    return scenario(folder, map="map.npz", cell_size=cell_size, combine=combine, threats=sources)


@pytest.mark.parametrize(("combine", "cell_size"), [("product", 1.0), ("max", 1.0), ("product", 2.0), ("max", 2.0)])
def test_a_world_without_one_is_that_of_a_scenario_without_it(tmp_path: Path, combine: str, cell_size: float) -> None:
    whole = world_of(tmp_path, FIELDS, POINTS, combine, cell_size)
    sources, changed = whole.sources, 0
    np.testing.assert_array_equal(sources.threat(), whole.threat)
    named = ["well", *(f"gate (line {line} of points.csv)" for line in (3, 4, 5))]
    assert list(sources.names) == [*named, "north", "features[1] of fields.json", "south", "features[3] of fields.json"]
    for thing in range(len(sources.names)):
        points, named = POINTS[:], FIELDS[:]
        del (points if thing < 4 else named)[thing % 4]
        expected = world_of(tmp_path, named, points, combine, cell_size).threat
        np.testing.assert_array_equal(sources.without(thing).threat(), expected)
        free, own = ~np.isnan(expected), sources.alone(thing).reshape(whole.shape)
        assert (own > 0)[free & (expected != whole.threat)].all()
        changed += int((expected < whole.threat)[free].any())
    assert changed >= 4
    two = world_of(tmp_path, [FIELDS[0], *FIELDS[2:]], POINTS[1:], combine, cell_size).threat
    np.testing.assert_array_equal(sources.without(0).without(5).threat(), two)


def test_observers_are_told_apart_and_a_map_alone_has_no_sources(tmp_path: Path) -> None:
    np.save(tmp_path / "heights.npy", np.zeros((8, 8)))

    def seen(*sites: list[int]) -> World:
        keys = {"sites": list(sites), "height": 5, "range": 3, "p": 0.1}
        return scenario(tmp_path, map={"elevation": "heights.npy", "resolution": 1.0}, threats=[{"viewshed": keys}])

    both = seen([1, 1], [5, 5])
    assert both.sources.names == ("site [1, 1]", "site [5, 5]")
    np.testing.assert_array_equal(both.sources.without(0).threat(), seen([5, 5]).threat)
    World.create(np.zeros((3, 3))).save(tmp_path / "map.npz")
    assert load_input(tmp_path / "map.npz").sources is World.create(np.zeros((3, 3))).sources is None


NAMED = [
    ("a.kml", "<kml><Placemark><name> East  field</name><Polygon><outerBoundaryIs><LinearRing><coordinates>{}"
              "</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"),
    ("a.gpx", "<gpx><trk><name>East field</name><trkseg>{}</trkseg></trk></gpx>"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text"), NAMED)
def test_kml_and_gpx_say_names_too(tmp_path: Path, name: str, text: str) -> None:
    corners = [(8.0, 47.0), (8.001, 47.0), (8.001, 47.001), (8.0, 47.001)]
    tuples = " ".join(f"{lon},{lat}" for lon, lat in corners)
    points = "".join(f'<trkpt lon="{lon}" lat="{lat}"/>' for lon, lat in corners)
    (tmp_path / name).write_text(text.format(tuples if name.endswith("kml") else points))
    World.create(np.zeros((9, 9)), cell_size=10.0).save(tmp_path / "map.npz")
    threats, datum = [{"polygons": name, "p": 0.1}], {"latitude": 47.0, "longitude": 8.0}
    assert scenario(tmp_path, map="map.npz", datum=datum, threats=threats).sources.names == ("East field",)


# Threats by line of sight, and elevations.


def test_sight_over_level_ground_reaches_its_range() -> None:
    for height in (0.0, 2.0):
        distance = visible(np.full((7, 11), 3.0), (2, 4), height, 35.0, 10.0)
        rows, cols = np.indices((7, 11))
        metres = 10 * np.hypot(rows - 2, cols - 4)
        assert np.where(metres <= 35, metres, np.inf).tolist() == distance.tolist()


def test_a_ridge_hides_what_lies_behind_it() -> None:
    ground = np.zeros((1, 9))
    ground[0, 3] = 5.0
    ground[0, 8] = 40.0
    distance = visible(ground, (0, 0), 2.0, 1000.0, 10.0)
    assert np.isfinite(distance[0]).tolist() == [True, True, True, True, False, False, False, False, True]
    seen_from_above = visible(ground, (0, 0), 50.0, 1000.0, 10.0)
    assert np.isfinite(seen_from_above).all()
    unknown = visible(np.where(ground == 5, np.nan, ground), (0, 0), 2.0, 1000.0, 10.0)
    assert np.flatnonzero(~np.isfinite(unknown)).tolist() == [3]


def test_sight_agrees_with_a_fine_walk_along_each_line() -> None:
    rng = np.random.default_rng(4)
    ground = np.cumsum(np.cumsum(rng.normal(size=(13, 17)), axis=0), axis=1)
    site, height, size = (6, 3), 1.0, 5.0
    seen = np.isfinite(visible(ground, site, height, 1e6, size))
    for row, col in np.ndindex(ground.shape):
        steps = max(abs(row - site[0]), abs(col - site[1]))
        highest = -np.inf
        for step in range(1, steps):
            r, c = site[0] + (row - site[0]) * step / steps, site[1] + (col - site[1]) * step / steps
            r0, c0 = min(int(r), 11), min(int(c), 15)
            corners = ground[r0 : r0 + 2, c0 : c0 + 2]
            z = np.array([1 - (r - r0), r - r0]) @ corners @ np.array([1 - (c - c0), c - c0])
            highest = max(highest, (z - ground[site] - height) / np.hypot(r - site[0], c - site[1]))
        away = math.hypot(row - site[0], col - site[1])
        slope = (ground[row, col] - ground[site] - height) / away if away else 0
        assert seen[row, col] == (steps == 0 or slope >= highest - 1e-9), (row, col)


def viewshed(folder: Path, elevation: np.ndarray, keys: dict, **more: object) -> np.ndarray:
    np.save(folder / "dem.npy", elevation)
    return load(folder, [{"viewshed": keys}], map={"elevation": "dem.npy", "resolution": 10}, **more)


def test_viewshed_on_the_cells_in_bands(tmp_path: Path) -> None:
    keys = {"sites": [[0, 0]], "bands": [[10, 0.3], [35, 0.1]], "height": 0}
    threat = viewshed(tmp_path, np.zeros((2, 6)), keys)
    assert threat == pytest.approx(np.array([[0.3, 0.3, 0.1, 0.1, 0, 0], [0.3, 0.1, 0.1, 0.1, 0, 0]]), abs=1e-7)
    keys = {"sites": [[0, 0], [0, 1]], "range": 25, "p": 0.2}
    two = viewshed(tmp_path, np.zeros((4, 12)), keys, cell_size=20)
    assert two == pytest.approx(np.array([[0.36, 0.36, 0.2, 0, 0, 0], [0.2, 0.2, 0, 0, 0, 0]]), abs=1e-7)
    assert viewshed(tmp_path, np.zeros((4, 12)), keys, cell_size=20, combine="max").max() == np.float32(0.2)


WRONG_VIEWSHEDS = [
    ({"sites": [], "range": 5, "p": 0.1}, "viewshed.sites"),
    ({"sites": [[0, 6]], "range": 5, "p": 0.1}, "viewshed.sites[0][1]` is 6; expected a column, 0 to 5"),
    ({"sites": [[0]], "range": 5, "p": 0.1}, "viewshed.sites[0]"),
    ({"sites": [[0.5, 1]], "range": 5, "p": 0.1}, "is 0.5"),
    ({"sites": [[0, 0]], "range": 0, "p": 0.1}, "viewshed.range"),
    ({"sites": [[0, 0]], "range": 5, "p": 1}, "viewshed.p"),
    ({"sites": [[0, 0]], "range": 5, "p": 0.1, "height": -1}, "viewshed.height"),
    ({"sites": [[0, 0]]}, "range and p, or bands"),
    ({"sites": [[0, 0]], "p": 0.1, "bands": [[5, 0.1]]}, "not both"),
    ({"sites": [[0, 0]], "bands": [[5, 0.1], [4, 0.2]]}, "increasing"),
    ({"sites": [[0, 0]], "bands": [[5, math.nan]]}, "viewshed.bands[0][1]"),
]


@pytest.mark.parametrize(("keys", "names"), WRONG_VIEWSHEDS)
def test_wrong_viewsheds(tmp_path: Path, keys: dict, names: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(names)):
        viewshed(tmp_path, np.zeros((2, 6)), keys)


def test_a_site_without_elevation(tmp_path: Path) -> None:
    ground = np.zeros((2, 6))
    ground[1, 2] = np.nan
    with pytest.raises(ScenarioError, match=r"sites\[0\]` is \[1, 2\]; expected a cell whose elevation is known"):
        viewshed(tmp_path, ground, {"sites": [[1, 2]], "range": 5, "p": 0.1})


def test_slopes_and_what_has_no_elevation_are_obstacles(tmp_path: Path) -> None:
    plane = np.arange(5)[:, None] * 10 + np.zeros((5, 8))
    assert slope_degrees(plane, 10.0) == pytest.approx(np.full((5, 8), 45.0))
    assert slope_degrees(plane[:1], 10.0) == pytest.approx(np.zeros((1, 8)))
    assert slope_degrees(plane.T[:1], 10.0) == pytest.approx(np.full((1, 5), 45.0))
    steep, obstacles = np.zeros((5, 8)), np.zeros((5, 8), dtype=bool)
    steep[2, 2:], steep[0, 0] = 100, np.nan
    np.save(tmp_path / "dem.npy", steep)
    obstacles[[0, 2, 2], [0, 1, 2]] = obstacles[[1, 3], 2:] = True
    found = load(tmp_path, [], map={"elevation": "dem.npy", "resolution": 10, "max_slope_deg": 30})
    assert np.array_equal(np.isnan(found), obstacles)


@pytest.mark.parametrize("value", [1e300, -3.4e38])
def test_elevations_that_cannot_be(tmp_path: Path, value: float) -> None:
    """They are voids, which are obstacles; their neighbours do not slope towards them."""
    heights = np.zeros((6, 9))
    heights[2, 3] = value
    ground = {"elevation": raster(tmp_path, heights), "max_slope_deg": 30}
    assert np.argwhere(np.isnan(load(tmp_path, [], map=ground))).tolist() == [[2, 3]]
