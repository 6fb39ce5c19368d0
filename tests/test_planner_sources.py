"""Threats apart: a map without one of its polygons, points or sites is that of a scenario that never named it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from planner.world.scenario import load_input
from planner.world.world import World

FIELDS = [
    ("north", 0.2, [1, 7, 6, 12]),
    ("", 0.3, [4, 2, 9, 8]),
    ("south", 0.2, [0, 0, 5, 3]),
    ("", 0.1, [30, 30, 31, 31]),
]
POINTS = [("well", 6.2, 7.4, 0.4), ("gate", 2.0, 2.0, 0.3), ("gate", 11.0, 3.0, 0.2), ("gate", 7.0, 7.0, 0.1)]


def square(west: float, south: float, east: float, north: float) -> dict[str, Any]:
    corners = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {"type": "Polygon", "coordinates": [corners]}


def world_of(folder: Path, fields: list, points: list, combine: str, cell_size: float) -> World:
    """A scenario of a threatened map, points, a raster and fields, in this order."""
    rng = np.random.default_rng(5)
    own = np.where(rng.random((12, 14)) < 0.1, np.nan, np.where(rng.random((12, 14)) < 0.2, 0.05, 0.0))
    own[0, 0] = 0.0
    World.create(own).save(folder / "map.npz", force=True)
    np.save(folder / "raster.npy", rng.random((12, 14)) * (rng.random((12, 14)) < 0.3))
    features = [{"properties": {"name": name, "p": p}, "geometry": square(*at)} for name, p, at in fields]
    (folder / "fields.json").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    rows = ["name,x,y,strength", *(",".join(map(str, point)) for point in points)]
    (folder / "points.csv").write_text("\n".join(rows))
    sources: list[dict[str, Any]] = [{"raster": "raster.npy"}]
    if points:
        sources.insert(0, {"points": "points.csv", "falloff": {"kind": "gaussian", "radius": 2.5}})
    if fields:
        sources.append({"polygons": "fields.json"})
    said = {"map": "map.npz", "cell_size": cell_size, "combine": combine, "threats": sources}
    (folder / "scenario.yaml").write_text(yaml.safe_dump(said))
    return load_input(folder / "scenario.yaml")


@pytest.mark.parametrize(("combine", "cell_size"), [("product", 1.0), ("max", 1.0), ("product", 2.0), ("max", 2.0)])
def test_a_world_without_one_is_that_of_a_scenario_without_it(tmp_path: Path, combine: str, cell_size: float) -> None:
    whole = world_of(tmp_path, FIELDS, POINTS, combine, cell_size)
    sources = whole.sources
    assert sources is not None
    np.testing.assert_array_equal(sources.threat(), whole.threat)
    named = ["well", *(f"gate (line {line} of points.csv)" for line in (3, 4, 5))]
    assert list(sources.names) == [*named, "north", "features[1] of fields.json", "south", "features[3] of fields.json"]
    changed = 0
    for thing in range(len(sources.names)):
        points, fields = POINTS[:], FIELDS[:]
        del (points if thing < 4 else fields)[thing % 4]
        expected = world_of(tmp_path, fields, points, combine, cell_size).threat
        np.testing.assert_array_equal(sources.without(thing).threat(), expected)
        own = sources.alone(thing).reshape(whole.shape)
        where = expected != np.where(np.isnan(expected), expected, whole.threat)
        assert ((own > 0) | np.isnan(expected))[where].all()
        changed += int((expected[~np.isnan(expected)] < whole.threat[~np.isnan(expected)]).any())
    assert changed >= 4
    two = world_of(tmp_path, [FIELDS[0], *FIELDS[2:]], POINTS[1:], combine, cell_size).threat
    np.testing.assert_array_equal(sources.without(0).without(5).threat(), two)


def test_observers_are_told_apart_and_a_map_alone_has_no_sources(tmp_path: Path) -> None:
    np.save(tmp_path / "heights.npy", np.zeros((8, 8)))

    def seen(*sites: list[int]) -> World:
        keys = {"sites": list(sites), "height": 5, "range": 3, "p": 0.1}
        said = {"map": {"elevation": "heights.npy", "resolution": 1.0}, "threats": [{"viewshed": keys}]}
        (tmp_path / "seen.yaml").write_text(yaml.safe_dump(said))
        return load_input(tmp_path / "seen.yaml")

    both = seen([1, 1], [5, 5])
    assert both.sources is not None and both.sources.names == ("site [1, 1]", "site [5, 5]")
    np.testing.assert_array_equal(both.sources.without(0).threat(), seen([5, 5]).threat)
    World.create(np.zeros((3, 3))).save(tmp_path / "map.npz")
    assert load_input(tmp_path / "map.npz").sources is None
    assert World.create(np.zeros((3, 3))).sources is None


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.kml", "<kml><Placemark><name> East  field</name><Polygon><outerBoundaryIs><coordinates>{}"
                  "</coordinates></outerBoundaryIs></Polygon></Placemark></kml>"),
        ("a.gpx", "<gpx><trk><name>East field</name><trkseg>{}</trkseg></trk></gpx>"),
    ],
)  # fmt: skip
def test_kml_and_gpx_say_names_too(tmp_path: Path, name: str, text: str) -> None:
    corners = [(8.0, 47.0), (8.001, 47.0), (8.001, 47.001), (8.0, 47.001)]
    tuples = " ".join(f"{lon},{lat}" for lon, lat in corners)
    points = "".join(f'<trkpt lon="{lon}" lat="{lat}"/>' for lon, lat in corners)
    (tmp_path / name).write_text(text.format(tuples if name.endswith("kml") else points))
    World.create(np.zeros((9, 9)), cell_size=10.0).save(tmp_path / "map.npz")
    said = {"map": "map.npz", "datum": {"latitude": 47.0, "longitude": 8.0}, "threats": [{"polygons": name, "p": 0.1}]}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(said))
    sources = load_input(tmp_path / "s.yaml").sources
    assert sources is not None and sources.names == ("East field",)
