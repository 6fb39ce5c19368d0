"""Threats from points and polygons."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.path import Path as Outline
from threat_sources import load

import planner.world.points
import planner.world.vector_files
from planner.errors import InputError, MapError, ScenarioError
from planner.world.grid import Frame
from planner.world.points import inside, point_threat, read_points
from planner.world.robot_types import independent
from planner.world.scenario import load_input


def test_points_at_the_centres(tmp_path: Path) -> None:
    frame = Frame((5, 8), 2.0, (1.0, -3.0, 0.4))
    points = np.array([[4.0, 2.0, 0.5], [9.0, 4.0, 0.3], [-90.0, 5.0, 0.9]])
    centres = frame.centres()
    for kind in ("disc", "gaussian"):
        expected = np.zeros(frame.shape)
        for x, y, strength in points:
            distance = np.hypot(centres[..., 0] - x, centres[..., 1] - y)
            if kind == "disc":
                p = np.where(distance <= 3.0, strength, 0)
            else:
                p = np.where(distance <= 9.0, strength * np.exp(-(distance**2) / 18), 0)
            expected = 1 - (1 - expected) * (1 - p)
        assert point_threat(points, kind, 3.0, frame, independent) == pytest.approx(expected, abs=1e-12)
        assert expected.max() > 0.2


@pytest.mark.parametrize(
    "text",
    [
        "1,2,0.5\n3,4,0.25\n",
        "x,y,strength\n1,2,0.5\n3,4,0.25\n",
        "a,b,c\n1,2,0.5\n\n3,4,0.25\n",
        "id,p,y_m,x_m\nfirst,0.5,2,1\nsecond,0.25,4,3\n",
    ],
)
def test_points_files(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    assert read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))[0].tolist() == [[1, 2, 0.5], [3, 4, 0.25]]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", "is empty"),
        ("x,y,strength\n", "no points"),
        ("1,2\n", "line 1 has 2 values"),
        ("1,2,0.5\n1,2\n", "line 2 has 2 values"),
        ("1,2,1\n", "line 1: strength is 1"),
        ("1,2,-0.1\n", "line 1: strength is -0.1"),
        ("x,y,strength\n1,nan,0.1\n", "line 2: y is 'nan'"),
        ("x,y,strength\n1,2,strong\n", "line 2: strength is 'strong'"),
        ("x,y,z,w\n1,2,3,4\n", "columns x, y, z, w"),
    ],
)
def test_broken_points_files(tmp_path: Path, text: str, names: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(MapError) as caught:
        read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))
    assert names in str(caught.value)


def test_points_in_a_scenario_and_their_note(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("2.5,2.5,0.5\n100,100,0.5\n")
    source = {"points": "p.csv", "falloff": {"kind": "disc", "radius": 1}}
    threat = load(tmp_path, [source])
    assert np.argwhere(threat > 0).tolist() == [[2, 2], [3, 1], [3, 2], [3, 3], [4, 2]]
    assert "threats[0]: 1 of 2 points lie off the map" in load_input(tmp_path / "scenario.yaml").notes


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


@pytest.mark.parametrize(
    ("ring", "names"),
    [
        (MUNICH, ["x 11.57549 .. 11.57812", "look like longitude and latitude", "reproject"]),
        ([[11.50549, 1.13743], [11.57812, 1.13743], [11.57812, 1.13901]], ["look like longitude and latitude"]),
        ([[1.50549, 1.53743], [1.50812, 1.53743], [1.50812, 1.53901]], ["look like longitude and latitude"]),
        ([[691000, 5334000], [691050, 5334000], [691050, 5334050]], ["lie off the map", "9 x 6 m from (0, 0)"]),
        ([[20, 1], [30, 1], [30, 3]], ["x 20 .. 30", "lie off the map"]),
    ],
)
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


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("lon,lat,strength\n1,2,0.5\n", "lon, lat, strength"),
        ("longitude,latitude,weight\n1,2,0.5\n", "expected x, y in metres"),
        ("11.57549,48.13743,0.5\n", "look like longitude and latitude"),
        ("691000,5334000,0.5\n691001,5334000,0.5\n", "lie off the map"),
    ],
)
def test_points_that_cannot_be_meant_are_refused(tmp_path: Path, text: str, names: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        load(tmp_path, [{"points": "p.csv", "falloff": {"kind": "disc", "radius": 2}}])
    assert names in str(caught.value)


def test_points_off_the_map_that_reach_it_are_taken(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("-1,3,0.5\n")
    assert np.nansum(load(tmp_path, [{"points": "p.csv", "falloff": {"kind": "disc", "radius": 2}}])) > 0
    (tmp_path / "p.csv").write_text("-50,3,0\n")
    assert not np.nansum(load(tmp_path, [{"points": "p.csv", "falloff": {"kind": "disc", "radius": 2}}]))


def test_points_in_one_pixel_are_noted(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("1.57549,2.13743,0.5\n1.57812,2.13901,0.5\n")
    load(tmp_path, [{"points": "p.csv", "falloff": {"kind": "disc", "radius": 1}}])
    assert (
        "threats[0]: all 2 points lie in one pixel: are x and y in metres?"
        in load_input(tmp_path / "scenario.yaml").notes
    )


def test_shapes_beyond_the_limits_are_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner.world.points, "MAX_POINTS", 3)
    monkeypatch.setattr(planner.world.vector_files, "MAX_CORNERS", 3)
    (tmp_path / "p.csv").write_text("1,2,0.5\n" * 4)
    for source in (
        {"points": "p.csv", "falloff": {"kind": "disc", "radius": 1}},
        {"polygons": geojson(tmp_path, feature([SQUARE]))},
    ):
        with pytest.raises(MapError, match="at most 3"):
            load(tmp_path, [source])
    monkeypatch.setattr(planner.world.points, "MAX_BYTES", 30)
    monkeypatch.setattr(planner.world.vector_files, "MAX_BYTES", 30)
    for source in ({"points": "p.csv", "falloff": {"kind": "disc", "radius": 1}}, {"polygons": "a.geojson"}):
        with pytest.raises(MapError, match=r"bytes; expected .* of at most 30"):
            load(tmp_path, [source])


def test_a_polygon_between_the_centres_is_noted(tmp_path: Path) -> None:
    name = geojson(tmp_path, feature([[[1.6, 1.6], [1.9, 1.6], [1.9, 1.9]]]))
    assert not np.nansum(load(tmp_path, [{"polygons": name}]))
    assert (
        "threats[0]: features[0] holds no pixel's centre: no threat from it"
        in load_input(tmp_path / "scenario.yaml").notes
    )


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        (feature([SQUARE], 1), "features[0]: property p is 1"),
        (feature([SQUARE], None), "property p is missing"),
        (feature([SQUARE], "high"), "'high'"),
        (feature([SQUARE], math.nan), "nan"),
        (feature(SQUARE, 0.1), "wrong coordinates"),
        (feature([SQUARE[:2]], 0.1), "three finite points"),
        (feature([[[0, 0], [1, math.inf], [1, 1]]], 0.1), "three finite points"),
        (feature([0, 0], 0.1, "Point"), "'Point'"),
        ({"type": "Feature", "properties": [1]}, "properties"),
    ],
)
def test_broken_polygons(tmp_path: Path, wrong: dict, names: str) -> None:
    with pytest.raises(MapError) as caught:
        load(tmp_path, [{"polygons": geojson(tmp_path, wrong)}])
    assert names in str(caught.value)


@pytest.mark.parametrize("radius", [1e300, 1e308, 1e-320, 1e10])
@pytest.mark.parametrize("kind", ["disc", "gaussian"])
def test_a_radius_that_cannot_be(tmp_path: Path, kind: str, radius: float) -> None:
    (tmp_path / "p.csv").write_text("1,1,0.5\n")
    with pytest.raises(ScenarioError, match=r"`threats\[0\]\.falloff\.radius` is .*1e\+09"):
        load(tmp_path, [{"points": "p.csv", "falloff": {"kind": kind, "radius": radius}}])


def test_points_beyond_the_world_are_refused(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("1,1,0.5\n1e308,1,0.5\n")
    with pytest.raises(MapError, match="line 2: x is '1e308'"):
        load(tmp_path, [{"points": "p.csv", "falloff": {"kind": "disc", "radius": 1e9}}])


@pytest.mark.parametrize(
    "ring",
    [
        [[1e308, 1e308], [-1e308, 1e308], [0, -1e308]],
        [["0", "0"], ["5", "0"], ["5", "5"]],
        [[False, False], [True, False], [True, True]],
        [[0], [5], [5]],
        ["00", "50", "55"],
        [[0, 0], [5, 0], [10**400, 5]],
        [[0, 0], [5, 0], [None, 5]],
        [{"x": 1, "y": 2}] * 3,
    ],
)
def test_coordinates_that_cannot_be(tmp_path: Path, ring: list) -> None:
    (tmp_path / "a.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    with pytest.raises(MapError, match=r"a\.geojson: features\[0\]: wrong coordinates \(a point is ") as caught:
        load(tmp_path, [{"polygons": "a.geojson", "p": 0.5}])
    assert len(str(caught.value)) < 500


TABLES = [
    ("x;y;strength\n1;2;0.5\n3;4;0.25\n", "semicolons", "points"),
    ("x;y;strength\r\n1,0;2;0,5\r\n\r\n3;4;0,25\r\n", "semicolons", "commas"),
    ("1,0\t2\t0,5\n3\t4\t0,25\n", "tabs", "commas"),
    ("sep=;\nid;x;y;strength;\n3.1;1;2;,5;\n3.2;3;4;0,25;\n", "semicolons", "commas"),
    ('"x","y","strength"\n"1,0","2","0,5"\n"3","4","0,25"\n', "commas", "commas"),
    ("x y strength\n1 2  0.5\n3   4 0.25\n", "spaces", "points"),
    ("x|y|strength\n1,000|2,000|5,0e-1\n3|4|0,250\n", "bars", "commas"),
]


@pytest.mark.parametrize(("text", "separator", "decimal"), TABLES)
def test_points_between_other_separators(tmp_path: Path, text: str, separator: str, decimal: str) -> None:
    (tmp_path / "p.csv").write_bytes(text.encode())
    found = read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))
    assert found.places.tolist() == [[1, 2, 0.5], [3, 4, 0.25]]
    note = f"columns are read as separated by {separator}, numbers as written with decimal {decimal}"
    assert found.notes == (note,)
    np.save(tmp_path / "m.npy", np.zeros((9, 9)))
    for key in ("threats", "value"):
        (tmp_path / "s.yaml").write_text(
            f"map: m.npy\n{key}:\n- {{points: p.csv, falloff: {{kind: disc, radius: 1}}}}\n"
        )
        assert f"{key}[0]: {note}" in load_input(tmp_path / "s.yaml").notes


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x;y;strength\n1,5;2;0.5\n3;4;0,25\n", "strength: line 3 has '0,25' and line 2 '0.5'"),
        ("x;y;strength\n1,234;2,345;0\n", "x: line 2: '1,234' may be 1.234 or 1234"),
        ("x;y;strength\n1.234;2,3;0\n", "x: line 2: '1.234' may be 1.234 or 1234"),
        ("x;y;strength\n1.234,5;2;0\n", "x: line 2: '1.234,5' has marks between thousands"),
        ("x;1\ty\n1;2\t3\n", "its columns may be separated by semicolons or by tabs"),
        ("x,y,strength\n1;2;0.5\n", "line 2 has 1 values, and semicolons; expected 3 as above, separated by commas"),
        ("x,y,strength\n1,0,2,0,0,5\n", "if its numbers have decimal commas, separate the columns by semicolons"),
        ("1,0,2,0,0,5\n", "if its numbers have decimal commas, separate the columns by semicolons"),
    ],
)
def test_tables_that_can_be_read_in_two_ways(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(MapError) as caught:
        read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))
    assert words in str(caught.value) and "p.csv" in str(caught.value)


def test_a_column_that_is_not_read_may_hold_anything(tmp_path: Path) -> None:
    """Names with semicolons among commas; marks between thousands, and the other decimal sign."""
    (tmp_path / "p.csv").write_text('name,x,y,strength\n"Pit; north",1,2,0.5\nHill,3,4,0.25\n')
    found = read_points(tmp_path / "p.csv", Frame((9, 9), 1.0))
    assert found.names[0][0] == "Pit; north" and not found.notes
    (tmp_path / "p.csv").write_text("x;y;strength;seen;id\n1;2;0,5;1.234;3.1\n3;4;0,25;7,5;3,2\n")
    assert read_points(tmp_path / "p.csv", Frame((9, 9), 1.0)).places.tolist() == [[1, 2, 0.5], [3, 4, 0.25]]
