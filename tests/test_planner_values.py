"""The keys `value`, `detect`, `metrics` and `route` of scenarios, and the world files that hold values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from refusals import refused
from test_planner_rasters import tif

from planner.errors import WorldError
from planner.world.scenario import load_input, route_over
from planner.world.world import World, load_world_file

THREAT = [[0, 0.1, 0, 0.2], [0, np.nan, 0.1, 0], [0, 0, 0, 0.3]]
SQUARE = [[[1, 1], [4, 1], [4, 3], [1, 3], [1, 1]]]


def scenario(folder: Path, keys: dict[str, Any], polygons: Any = 5, points: str = "0.5,0.5,2\n0.5,0.5,3\n") -> Path:
    """A map of 3 x 4 metres, a raster of 0 .. 11 on it, a polygon on its upper right 2 x 3 cells, two points."""
    World.create(THREAT).save(folder / "map.npz", force=True)
    np.save(folder / "raster.npy", np.arange(12.0).reshape(3, 4))
    feature = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": SQUARE}}
    properties = {} if polygons is None else {"value": polygons, "detect": polygons}
    (folder / "areas.geojson").write_text(json.dumps(feature | {"properties": properties}))
    (folder / "points.csv").write_text(points)
    (folder / "s.yaml").write_text(yaml.safe_dump({"map": "map.npz", "robots": {"count": 1}} | keys))
    return folder / "s.yaml"


RASTER = np.where(np.isnan(THREAT), 0, np.arange(12.0).reshape(3, 4))
LAYERS = [
    (3, np.full((3, 4), 3.0)),
    ([{"raster": "raster.npy"}], RASTER),
    ([{"polygons": "areas.geojson"}], np.array([[1, 5, 5, 5], [1, 5, 5, 5], [1, 1, 1, 1]])),
    ([{"everywhere": 2}, {"points": "points.csv"}], np.array([[2, 2, 2, 2], [2, 2, 2, 2], [5, 2, 2, 2]])),
    (
        [{"everywhere": 0}, {"points": "points.csv", "falloff": {"kind": "disc", "radius": 1.2}}],
        np.array([[0, 0, 0, 0], [5, 0, 0, 0], [5, 5, 0, 0]]),
    ),
    ([{"polygons": "areas.geojson"}, {"raster": "raster.npy"}], RASTER),
]


@pytest.mark.parametrize(("value", "expected"), LAYERS)
def test_the_last_source_that_covers_a_cell_counts(tmp_path: Path, value: Any, expected: np.ndarray) -> None:
    world = load_input(scenario(tmp_path, {"value": value}))
    assert world.detect is None
    assert np.array_equal(world.value, np.where(np.isnan(THREAT), 0, expected))


@pytest.mark.parametrize(("rows", "cols"), [(12, 16), (6, 8), (3, 4), (12, 8)])
def test_values_on_other_pixels_are_the_same_amounts(tmp_path: Path, rows: int, cols: int) -> None:
    """On pixels of half, or twice, the side of the map's, and on oblong ones."""
    tif(tmp_path / "map.tif", np.full((6, 8), 0.05), (10, 0, 500000, 0, -10, 5400000), "EPSG:32633")
    amounts = np.kron(np.arange(12.0).reshape(3, 4), np.ones((4, 4)))
    values = amounts.reshape(rows, 12 // rows, cols, 16 // cols).sum(axis=(1, 3))
    tif(tmp_path / "value.tif", values, (80 / cols, 0, 500000, 0, -60 / rows, 5400000), "EPSG:32633")
    (tmp_path / "s.yaml").write_text("map: map.tif\nvalue: [{raster: value.tif}]\nrobots: {count: 1}\n")
    assert np.allclose(load_input(tmp_path / "s.yaml").value, 4 * amounts[::2, ::2], rtol=1e-9)


def test_values_in_degrees_keep_their_sum(tmp_path: Path) -> None:
    """But for pixels on the edge, whose middle is outside of the map."""
    place = (0.0002, 0, 15.0, 0, -0.0001, 52.0)
    tif(tmp_path / "map.tif", np.full((100, 120), 0.05), place, "EPSG:4326")
    tif(tmp_path / "value.tif", np.full((100, 120), 1 / 12000), place, "EPSG:4326")
    (tmp_path / "s.yaml").write_text("map: map.tif\nvalue: [{raster: value.tif}]\nrobots: {count: 1}\n")
    assert 0.98 < load_input(tmp_path / "s.yaml").value.sum() <= 1 + 1e-9


def test_values_of_pixels_add_up_and_chances_are_averaged(tmp_path: Path) -> None:
    """A cell of 2 x 2 pixels."""
    World.create(np.zeros((2, 4))).save(tmp_path / "fine.npz")
    np.save(tmp_path / "r.npy", np.array([[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8]]))
    layers = {"value": [{"raster": "r.npy"}], "detect": [{"raster": "r.npy"}]}
    world = load_input(scenario(tmp_path, {"map": "fine.npz", "cell_size": 2} | layers))
    assert world.value == pytest.approx(np.array([[1.4, 2.2]]))
    assert world.detect == pytest.approx(np.array([[0.35, 0.55]]))
    named = World.create(np.zeros((2, 4)), value=np.arange(8.0).reshape(2, 4), detect=0.5)
    named.save(tmp_path / "fine.npz", force=True)
    world = load_input(scenario(tmp_path, {"map": "fine.npz", "cell_size": 2}))
    assert world.value.tolist() == [[10, 18]] and world.detect.tolist() == [[0.5, 0.5]]


def test_a_world_file_keeps_its_values(tmp_path: Path) -> None:
    world = World.create(THREAT, value=RASTER, detect=0.25)
    world.save(tmp_path / "w.npz")
    again = load_world_file(tmp_path / "w.npz")
    assert np.array_equal(again.value, RASTER)
    assert np.array_equal(again.detect, np.where(np.isnan(THREAT), 0, 0.25))
    assert again.sha256 == World.create(THREAT).sha256  # no part of the map's identity


WRONG: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"value": -1}, {}, "`value` is -1; expected a number, 0 to 1e+09"),
    ({"value": float("nan")}, {}, "`value` is nan; expected"),
    ({"value": 0}, {}, "value is 0 in every free cell; expected a cell that is worth something"),
    ({"value": [{"everywhere": 0}]}, {}, "value is 0 in every free cell"),
    ({"value": [{"raster": "no.npy"}]}, {}, "`value[0].raster`: no such file"),
    ({"value": [{"raster": "small.npy"}]}, {}, "expected the map's 3 x 4 pixels or its 3 x 4 cells; the raster has"),
    ({"value": [{"raster": "holes.npy"}]}, {}, "names holes.npy, which is nan (no data) at [0, 0] (1 such cell)"),
    ({"value": [{"raster": "negative.npy"}]}, {}, "says value = -1 at [0, 0] (1 such cell); expected a number, 0"),
    ({"value": [{"polygons": "areas.geojson"}]}, {"polygons": -2}, "property value is -2; expected a number, 0"),
    ({"value": [{"polygons": "areas.geojson"}]}, {"polygons": None}, "or give value in the scenario"),
    ({"value": [{"points": "points.csv"}]}, {"points": "0.5,0.5,-3\n"}, "line 1: strength is -3; expected a number, 0"),
    ({"value": [{"points": "points.csv"}]}, {"points": "900,1,3\n"}, "is said of no cell: x 900 .. 900"),
    ({"value": [{"polygon": "areas.geojson"}]}, {}, "did you mean 'polygons'?"),
    ({"value": [{"raster": "raster.npy", "rule": {}}]}, {}, "unknown key `value[0].rule`"),
    ({"detect": 1.5}, {}, "`detect` is 1.5; expected a chance, 0 to 1"),
    ({"detect": [{"raster": "raster.npy"}]}, {}, "says detect = 2 at [0, 2] (9 such cells); expected a chance, 0 to 1"),
    ({"metrics": "rescue"}, {}, "`metrics` is 'rescue'; expected coverage or search or clearance"),
    ({"route": [[0, 0]]}, {}, "`route` is [[0, 0]]; expected a list of two [row, col] or more"),
    ({"route": [[0, 0], [0, 9]]}, {}, "`route`: leaves the map"),
    ({"route": [[1, 0], [1, 3]]}, {}, "`route`: meets an obstacle at [1, 1]; expected free cells all the way"),
    ({"route": [[0, 0], [0, 1]], "route_xy": [[0, 0], [1, 1]]}, {}, "expected route or route_xy, not both"),
]


@pytest.mark.parametrize(("keys", "files", "said"), WRONG)
def test_bad_values_are_one_line_and_nothing_is_written(tmp_path: Path, capsys, keys, files, said: str) -> None:
    path = scenario(tmp_path, keys, **files)
    np.save(tmp_path / "small.npy", np.ones((2, 4)))
    for name, value in (("holes", np.nan), ("negative", -1.0)):
        np.save(tmp_path / f"{name}.npy", np.where(np.arange(12).reshape(3, 4) == 0, value, 1.0))
    assert said in refused(capsys, "evaluate", str(path), "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("layers", "said"),
    [
        ({"value": np.full((3, 4), -1.0)}, "value is -1 at [0, 0] (11 such cells)"),
        ({"value": np.full((3, 4), np.nan)}, "value is nan at [0, 0]"),
        ({"value": np.ones((4, 3))}, "value has shape [4, 3]; expected the map's, [3, 4]"),
        ({"value": np.zeros((3, 4))}, "value is 0 in every free cell"),
        ({"value": [["a"]]}, "value holds <U1; expected numbers"),
        ({"detect": 1.01}, "detect is 1.01 at [0, 0]"),
    ],
)
def test_bad_arrays(layers: dict[str, Any], said: str) -> None:
    with pytest.raises(WorldError) as raised:
        World.create(THREAT, **layers)
    assert said in str(raised.value)


def test_a_route_is_the_cells_that_its_line_meets(tmp_path: Path) -> None:
    world = World.create(np.zeros((4, 6)))
    assert route_over(world, [[0.5, 0.5], [0.5, 2.5], [2.5, 2.5]]).tolist() == [[0, 0], [0, 1], [0, 2], [1, 2], [2, 2]]
    keys = {"route_xy": [[0.5, 0.5], [3.5, 0.5]], "metrics": "clearance"}
    team = load_input(scenario(tmp_path, keys)).team
    assert team.metrics == "clearance"
    assert team.route is not None and team.route.tolist() == [[2, 0], [2, 1], [2, 2], [2, 3]]
