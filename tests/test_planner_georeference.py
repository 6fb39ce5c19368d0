"""Where maps lie on the Earth: kept from every kind of file to longitude and latitude, and back for shapes on them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from test_planner_rasters import tif

import planner.world.vector_files
from analysis.recording.contents import read_world
from planner.errors import InputError, MapError, ScenarioError, WorldError
from planner.world.grid import Georeference, around, reproject
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file

pytest.importorskip("rasterio")
UTM = ((10, 0, 500_000, 0, -10, 5_761_038), "EPSG:32633")
"""Its upper-left corner is 15 degrees east; 52 north, within a metre."""
KML = (
    '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><ExtendedData><Data name="p"><value>0.25</value></Data>'
    "</ExtendedData><Polygon><outerBoundaryIs><LinearRing><coordinates>{}</coordinates></LinearRing></outerBoundaryIs>"
    "</Polygon></Placemark></kml>"
)
GPX = '<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{}</trkseg></trk></gpx>'


def utm_map(folder: Path, **more: Any) -> None:
    """A GeoTIFF of 20 x 30 pixels of 10 m without danger."""
    tif(folder / "m.tif", np.zeros((20, 30), dtype=np.float32), *UTM, **more)


def ring_of(world: World, top: int, left: int, bottom: int, right: int) -> list[list[float]]:
    """Longitudes and latitudes around cells `[top:bottom, left:right]`."""
    corners = world.at([top, top, bottom, bottom, top], [left, right, right, left, left])
    return world.to_lonlat(corners).tolist()


def scenario(folder: Path, **keys: Any) -> Path:
    (folder / "s.yaml").write_text(yaml.safe_dump({"map": "m.tif"} | keys))
    return folder / "s.yaml"


def geojson(folder: Path, *rings: list[list[float]], **more: Any) -> None:
    features = [
        {"type": "Feature", "properties": {"p": 0.25}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
        for ring in rings
    ]
    (folder / "a.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features} | more))


def test_a_projection_in_metres_or_feet_is_kept(tmp_path: Path) -> None:
    """(500 km east in UTM zone 33) is its central meridian; New York's plane, in feet, starts at 74 W 40 N 10'."""
    utm_map(tmp_path)
    world = load_input(tmp_path / "m.tif", 20.0)
    assert world.georeference == Georeference("EPSG:32633")
    corner = world.to_lonlat(world.at(0, 0))
    assert corner[0] == pytest.approx(15, abs=1e-9) and corner[1] == pytest.approx(52, abs=1e-5)
    tif(tmp_path / "f.tif", np.zeros((4, 4), dtype=np.float32), (10, 0, 984_250, 0, -10, 40), "EPSG:2263")
    world = load_input(tmp_path / "f.tif")
    assert world.to_lonlat(world.at(4, 0)) == pytest.approx((-74, 40 + 1 / 6), abs=1e-6)


def test_metres_that_are_none_are_said(tmp_path: Path) -> None:
    """Mercator is stretched by 1 / cos(latitude), by 2 at 60 degrees north (on the sphere that EPSG:3857 takes)."""
    north = 6378137 * np.log(np.tan(np.pi / 4 + np.radians(60) / 2))
    tif(tmp_path / "m.tif", np.zeros((4, 4), dtype=np.float32), (10, 0, 0, 0, -10, north + 20), "EPSG:3857")
    (note,) = load_input(tmp_path / "m.tif").notes
    assert note.startswith("a metre of EPSG:3857 is 0.501 m on the ground here")
    utm_map(tmp_path)
    assert not load_input(tmp_path / "m.tif").notes


def test_degrees_go_back_exactly(tmp_path: Path) -> None:
    """In rows and columns of degrees a corner of the grid is where the file said, to a tenth of a millimetre."""
    tif(tmp_path / "d.tif", np.zeros((20, 50), dtype=np.float32), (0.5, 0, 10.0, 0, -0.5, 60.0), "EPSG:4326")
    world = load_input(tmp_path / "d.tif")
    assert world.to_lonlat(world.at(0, 0)) == pytest.approx((10.0, 60.0), abs=1e-9)
    assert any("metres east and north of 50 N 10 E, 13 % off" in note for note in world.notes)
    terrain = load_input(Path(__file__).parent.parent / "analysis" / "examples" / "terrain.yaml")
    assert terrain.to_lonlat(terrain.at(0, 0)) == pytest.approx((-84.41375, 36.73291667), abs=1e-8)


def test_a_datum_puts_a_map_on_the_earth(tmp_path: Path) -> None:
    """1 km on the ellipsoid: degree lengths at 52 N by their series (WGS 84), 111,267.9 and 68,677.5 m."""
    np.save(tmp_path / "m.npy", np.zeros((1000, 1000), dtype=np.float32))
    path = scenario(tmp_path, map="m.npy", datum={"latitude": 52.0, "longitude": 15.0})
    world = load_input(path)
    places = world.to_lonlat(world.at([1000, 0, 1000], [0, 0, 1000]))
    assert places[0] == pytest.approx((15, 52), abs=1e-9)
    assert places[1] == pytest.approx((15, 52 + 1000 / 111_267.9), abs=1e-6)
    assert places[2] == pytest.approx((15 + 1000 / 68_677.5, 52), abs=2e-6)


def test_a_ros_map_may_say_its_datum(tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.full((4, 6), 255, dtype=np.uint8)).save(tmp_path / "m.png")
    content = {"image": "m.png", "resolution": 0.5, "origin": [-1, -1, 0], "occupied_thresh": 0.6, "free_thresh": 0.2}
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(content | {"datum": {"latitude": 52.0, "longitude": 15.0}}))
    world = load_input(tmp_path / "m.yaml")
    assert world.to_lonlat([0.0, 0.0]) == pytest.approx((15, 52), abs=1e-12)
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(content | {"datum": {"latitude": 95, "longitude": 15.0}}))
    with pytest.raises(MapError, match=r"`datum\.latitude` is 95; expected degrees, -89 to 89"):
        load_input(tmp_path / "m.yaml")


def test_files_keep_it(tmp_path: Path) -> None:
    place = Georeference("EPSG:4326", (-84.4, 36.6), (1.1e-5, 9e-6))
    world = World.create(np.zeros((2, 3)), georeference=place)
    world.save(tmp_path / "w.npz")
    assert load_world_file(tmp_path / "w.npz").georeference == place
    assert read_world(world.to_bytes(), "a log").georeference == place
    assert world.sha256 == replace(world, georeference=None).sha256
    for name, value, words in (
        ("crs", np.array(3.0), "expected the text of a CRS"),
        ("crs", np.array(""), "expected the text of a CRS"),
        ("crs_origin", np.array([np.nan, 0]), "crs_origin is"),
        ("crs_scale", np.array([0.0, 1.0]), "crs_scale is"),
        ("crs_scale", np.array([1.0]), "crs_scale is"),
    ):
        np.savez(tmp_path / "w.npz", **(world.arrays() | {name: value}))
        with pytest.raises(WorldError, match=words):
            load_world_file(tmp_path / "w.npz")


def test_a_crs_that_is_none() -> None:
    world = World.create(np.zeros((2, 3)), georeference=Georeference("EPSG:nonsense"))
    with pytest.raises(MapError, match="no way from the CRS 'EPSG:nonsense'"):
        world.to_lonlat([0.0, 0.0])
    with pytest.raises(MapError, match=r"no way from the CRS|is no place in"):
        reproject([[np.inf, 0.0]], "EPSG:4326", "EPSG:32633")
    assert around(-33.5, 151.0).to_lonlat([[0.0, 0.0]])[0] == pytest.approx((151, -33.5), abs=1e-12)


def test_polygons_of_every_format_in_degrees(tmp_path: Path) -> None:
    utm_map(tmp_path)
    ring = ring_of(load_input(tmp_path / "m.tif"), 3, 5, 9, 12)
    geojson(tmp_path, ring)
    (tmp_path / "a.kml").write_text(KML.format(" ".join(f"{east},{north},0" for east, north in ring)))
    (tmp_path / "a.gpx").write_text(GPX.format("".join(f'<trkpt lat="{n}" lon="{e}"/>' for e, n in ring)))
    (tmp_path / "p.csv").write_text("lat,lon,strength\n" + "".join(f"{n},{e},0.25\n" for e, n in ring))
    expected = np.zeros((20, 30), dtype=np.float32)
    expected[3:9, 5:12] = 0.25
    for name in ("a.geojson", "a.kml", "a.gpx"):
        source = {"polygons": name} | ({"p": 0.25} if name == "a.gpx" else {})
        np.testing.assert_array_equal(load_input(scenario(tmp_path, threats=[source])).threat, expected)
    source = {"points": "p.csv", "falloff": {"kind": "disc", "radius": 10.0}}
    held = load_input(scenario(tmp_path, threats=[source])).threat > 0
    assert {tuple(cell) for cell in np.argwhere(held)} == {
        (row + i, col + j) for row in (3, 9) for col in (5, 12) for i in (-1, 0) for j in (-1, 0)
    }


def test_polygons_in_metres_or_another_crs(tmp_path: Path) -> None:
    """Metres of the map without a `crs`; zone 32 is the same ground in other numbers."""
    utm_map(tmp_path)
    world = load_input(tmp_path / "m.tif")
    metres = world.at([3, 3, 9, 9], [5, 12, 12, 5])
    for points, crs in ((metres, {}), (reproject(metres, "EPSG:32633", "EPSG:32632"), "urn:ogc:def:crs:EPSG::32632")):
        geojson(tmp_path, points.tolist(), **({"crs": {"type": "name", "properties": {"name": crs}}} if crs else {}))
        held = load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}])).threat > 0
        assert np.argwhere(held).min(axis=0).tolist() == [3, 5] and held.sum() == 42


def test_keepout_adds_obstacles(tmp_path: Path) -> None:
    from PIL import Image

    utm_map(tmp_path)
    world = load_input(tmp_path / "m.tif")
    geojson(tmp_path, ring_of(world, 3, 5, 9, 12))
    picture = np.full((20, 30), 255, dtype=np.uint8)
    picture[15:, :4] = 0
    Image.fromarray(picture).save(tmp_path / "k.png")
    x, y = world.origin[:2]
    layer = {"image": "k.png", "resolution": 10.0, "origin": [x, y, 0], "occupied_thresh": 0.6, "free_thresh": 0.2}
    (tmp_path / "k.yaml").write_text(yaml.safe_dump(layer))
    path = scenario(tmp_path, keepout=[{"polygons": "a.geojson"}, {"layer": "k.yaml"}], cell_size=20)
    found = load_input(path)
    blocked = np.zeros((20, 30), dtype=bool)
    blocked[3:9, 5:12], blocked[15:, :4] = True, True
    cells = blocked.reshape(10, 2, 15, 2).any(axis=(1, 3))
    np.testing.assert_array_equal(~found.free, cells)
    assert "keepout[1]: 20 pixels are kept out of" in found.notes
    geojson(tmp_path, [[14.0, 51.0], [14.1, 51.0], [14.1, 51.1]])
    for keepout, words in (
        ([{"polygons": "a.geojson"}], "keeps robots out of no pixel"),
        ([{}], "one of polygons and layer"),
        ([{"poligons": "a.geojson"}], "did you mean 'polygons'"),
        ([], "a list of"),
    ):
        with pytest.raises(ScenarioError, match=words):
            load_input(scenario(tmp_path, keepout=keepout))


BOMB = '<!DOCTYPE kml [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><kml>&b;</kml>'
WRONG = [
    ("a.kml", KML.format("15,52 15.001,52 15.001,52.001")[:-60], "no XML"),
    ("a.kml", BOMB, r"has a document type \(DOCTYPE\)"),
    ("a.gpx", BOMB.replace("kml", "gpx"), "has a document type"),
    ("a.kml", "<gpx></gpx>", "its top element is 'gpx'; expected kml"),
    ("a.kml", "<kml></kml>", "holds no features"),
    ("a.kml", KML.format("15,52 15.001,52"), "Placemark 0 has 2 points"),
    ("a.kml", KML.format("15,52 15.001,nan 15.1,52.1"), "latitude nan"),
    ("a.kml", KML.format("500000,5761038 500010,5761038 500010,5761000"), "a point at longitude 500000"),
    ("a.kml", KML.format("15;52"), "Placemark 0: could not convert"),
    ("a.kml", KML.format("15,52 15.1,52 15.1,52.1").replace("0.25", "high"), "property p is 'high'"),
    ("a.kml", KML.format("15,52 15.1,52 15.1,52.1").replace("outerBoundaryIs", "border"), "without a boundary"),
    ("a.gpx", GPX.format('<trkpt lat="52"/>' * 3), "longitude nan"),
    ("a.gpx", GPX.format('<trkpt lat="52" lon="15"/>' * 2), "holds no features"),
    ("a.kml", '<?xml version="1.0" encoding="nobody"?><kml/>', "no XML|cannot be read as XML"),
]


@pytest.mark.parametrize(("name", "text", "words"), WRONG)
def test_markup_that_is_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    utm_map(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        load_input(scenario(tmp_path, threats=[{"polygons": name}]))
    assert name in str(caught.value) and "\n" not in str(caught.value)
    if text in (BOMB, BOMB.replace("kml", "gpx")):  # the refusal is told once, as it is
        assert str(caught.value).count(name) == 1 and "cannot be read" not in str(caught.value)
        assert caught.value.fix == "delete that line"


def test_markup_that_is_too_long(tmp_path: Path) -> None:
    (tmp_path / "a.kml").write_text("<kml>" + " " * 300 + "</kml>")
    with pytest.raises(MapError, match="at most 200"):
        planner.world.vector_files.read_kml(tmp_path / "a.kml", 200)


def test_coordinates_that_contradict(tmp_path: Path) -> None:
    utm_map(tmp_path)
    world = load_input(tmp_path / "m.tif")
    degrees, metres = ring_of(world, 3, 5, 9, 12), world.at([3, 3, 9], [5, 12, 12]).tolist()
    geojson(tmp_path, degrees, metres)
    with pytest.raises(MapError, match="mixes longitude and latitude with coordinates that are none"):
        load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}]))
    geojson(tmp_path, [[2.0, 48.0], [2.1, 48.0], [2.1, 48.1234567]])
    with pytest.raises(ScenarioError, match="look like longitude and latitude"):
        load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}]))
    geojson(tmp_path, degrees, crs={"type": "name", "properties": {"name": "EPSG:999999"}})
    with pytest.raises(MapError, match=r"a\.geojson: no way from the CRS 'EPSG:999999'"):
        load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}]))
    (tmp_path / "p.csv").write_text("lon,lat,strength\n15,52,0.1\n500000,5761038,0.1\n")
    with pytest.raises(MapError, match=r"line 3: a point at longitude 500000, latitude 5.76104e\+06"):
        load_input(scenario(tmp_path, threats=[{"points": "p.csv", "falloff": {"kind": "disc", "radius": 10}}]))
    with pytest.raises(ScenarioError, match=r"`datum` is .*; expected none: the map says where it lies"):
        load_input(scenario(tmp_path, datum={"latitude": 1, "longitude": 2}))


FIJI = "EPSG:32760"
"""UTM zone 60 south, whose eastern edge is longitude 180."""


def fiji(folder: Path) -> World:
    """20 x 20 pixels of 10 m without danger, their middle at longitude 180, 17 south."""
    (x, y), *_ = np.round(reproject([[180.0, -17.0]], "EPSG:4326", FIJI), -1).tolist()
    tif(folder / "m.tif", np.zeros((20, 20), dtype=np.float32), (10, 0, x - 100, 0, -10, y + 100), FIJI)
    return load_input(folder / "m.tif")


def multi(folder: Path, *polygons: list[Any]) -> None:
    geometry = {"type": "MultiPolygon", "coordinates": polygons}
    (folder / "a.geojson").write_text(json.dumps({"type": "Feature", "properties": {"p": 0.25}, "geometry": geometry}))


def halves(ring: list[list[float]]) -> tuple[list[list[float]], list[list[float]]]:
    """A ring across longitude 180 as RFC 7946, 3.1.9, has it: what is east of 180 is moved there, and back."""
    east = [[min(x % 360, 180), y] for x, y in ring]
    return east, [[max(x % 360, 180) - 360, y] for x, y in ring]


def test_shapes_across_longitude_180(tmp_path: Path) -> None:
    """Cut in two, uncut with a step from 179.99 to -179.99, beyond 180 on either side: the same 12 x 12 cells."""
    world = fiji(tmp_path)
    assert not world.notes and (np.abs(ring_of(world, 0, 0, 20, 20))[:, 0] <= 180).all()
    ring = ring_of(world, 4, 4, 16, 16)
    expected = np.zeros((20, 20), dtype=np.float32)
    expected[4:16, 4:16] = 0.25
    for rings in (halves(ring), [ring], [[[x % 360, y] for x, y in ring]], [[[x % 360 - 360, y] for x, y in ring]]):
        multi(tmp_path, *([one] for one in rings))
        path = scenario(tmp_path, threats=[{"polygons": "a.geojson"}])
        np.testing.assert_array_equal(load_input(path).threat, expected)
    east, west = halves(ring)
    text = KML.format(" ".join(f"{x},{y}" for x, y in east)).removesuffix("</Placemark></kml>")
    other = KML.format(" ".join(f"{x},{y}" for x, y in west))
    (tmp_path / "a.kml").write_text(text + other[other.index("<Polygon>") :])
    np.testing.assert_array_equal(load_input(scenario(tmp_path, threats=[{"polygons": "a.kml"}])).threat, expected)
    multi(tmp_path, [east], [west])
    kept = load_input(
        scenario(tmp_path, keepout=[{"polygons": "a.geojson"}], value=[{"polygons": "a.geojson", "value": 2}])
    )
    np.testing.assert_array_equal(~kept.free, expected > 0)
    longitude = 180 - ring[0][0] + 180
    for name in (longitude, longitude - 360):
        (tmp_path / "p.csv").write_text(f"lon,lat,strength\n{name},{ring[0][1]},0.5\n")
        source = {"points": "p.csv", "falloff": {"kind": "disc", "radius": 10.0}}
        held = np.argwhere(load_input(scenario(tmp_path, threats=[source])).threat)
        assert len(held) and np.abs(held - (3.5, 15.5)).max() <= 1.5


@pytest.mark.parametrize(("west", "crs"), [(165.0, "EPSG:4326"), (-195.0, "EPSG:4326"), (165.0, "EPSG:3857")])
def test_wide_shapes_on_a_map_in_degrees_or_mercator(tmp_path: Path, west: float, crs: str) -> None:
    """30 x 10 degrees about longitude 180: what is asked for is held, on both sides, and the whole world is."""
    side = 0.5 if crs == "EPSG:4326" else 0.5 * 111_319.49079327357
    transform = (side, 0, west / 0.5 * side, 0, -side, -10 / 0.5 * side)
    tif(tmp_path / "m.tif", np.zeros((20, 60), dtype=np.float32), transform, crs)

    def box(left: float, right: float) -> list[list[list[float]]]:
        return [[[left, -18.0], [right, -18.0], [right, -12.0], [left, -12.0], [left, -18.0]]]

    halves = [box(175, 180), box(-180, -175)]
    for polygons in (halves, [*halves, box(178, 180)], [box(175, -175)], [box(175, 185)], [box(-185, -175)]):
        multi(tmp_path, *polygons)
        held = load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}])).threat > 0
        assert np.flatnonzero(held.any(axis=0)).tolist() == list(range(20, 40))
    multi(tmp_path, box(-180, 180))
    held = load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}])).threat > 0
    assert held.any(axis=0).all()


def test_a_datum_beyond_180_is_the_place_a_turn_away(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.zeros((10, 10), dtype=np.float32))
    for longitude in (179.9999, -180.0001):
        world = load_input(scenario(tmp_path, map="m.npy", datum={"latitude": 0, "longitude": longitude}))
        places = world.to_lonlat([[0.0, 0.0], [1000.0, 0.0]])
        assert places[0] == pytest.approx((179.9999, 0), abs=1e-9)
        assert places[1] == pytest.approx((-180.0001 + 1000 / 111_319.49, 0), abs=1e-6)


RING = '{{"type": "Polygon", "coordinates": [[{}]]%s}}'
CRS84 = ', "crs": {{"type": "name", "properties": {{"name": "CRS84"}}}}'
SWAPPED = [
    ("a.geojson", RING % "", "[{1}, {0}]", ", "),
    ("a.geojson", RING % CRS84, "[{1}, {0}]", ", "),
    ("a.kml", KML, "{1},{0}", " "),
    ("a.gpx", GPX, '<trkpt lon="{1}" lat="{0}"/>', ""),
    ("a.csv", "lon,lat\n{}", "{1},{0}", "\n"),
]


@pytest.mark.parametrize(("name", "text", "place", "between"), SWAPPED)
def test_latitude_first_is_said(tmp_path: Path, name: str, text: str, place: str, between: str) -> None:
    utm_map(tmp_path)
    ring = ring_of(load_input(tmp_path / "m.tif"), 3, 5, 9, 12)
    (tmp_path / name).write_text(text.format(between.join(place.format(*corner) for corner in ring)))
    for keys in ({"threats": [{"polygons": name, "p": 0.1}]}, {"keepout": [{"polygons": name}]}):
        with pytest.raises(MapError, match=rf"{name}: latitude stands first, as in 51\.99.* 15\.00.*; swap the two"):
            load_input(scenario(tmp_path, **keys))
    east, north = ring[0]
    source = {"points": "p.csv", "falloff": {"kind": "disc", "radius": 10}}
    for head, words in (
        (f"lon,lat,strength\n{north},{east},0.1\n", r"p\.csv: latitude stands first"),
        (f"lat,lon,strength\n{-122.5},{37.5},0.1\n", r"line 2: latitude stands first, as in 37\.5, -122\.5"),
        (f"x,y,strength\n{north},{east},0.1\n", "name the columns lat and lon"),
        (f"x,y,strength\n{east},{north},0.1\n", "name the columns lon and lat"),
    ):
        (tmp_path / "p.csv").write_text(head)
        with pytest.raises(InputError, match=words):
            load_input(scenario(tmp_path, threats=[source]))
    np.save(tmp_path / "m.npy", np.zeros((10, 10), dtype=np.float32))
    with pytest.raises(ScenarioError, match=r"`datum\.latitude` is 151; .* latitude and longitude .* swap them"):
        load_input(scenario(tmp_path, map="m.npy", datum={"latitude": 151, "longitude": -33.9}))


def test_metres_that_would_lie_on_the_map_as_latitude_and_longitude_are_metres(tmp_path: Path) -> None:
    """A map of 100 m at 15 east, 52 north: x = 52, y = 15 on it is no latitude."""
    np.save(tmp_path / "m.npy", np.zeros((100, 100), dtype=np.float32))
    geojson(tmp_path, [[50.0, 13.0], [54.0, 13.0], [54.0, 17.0], [50.0, 17.0]])
    world = load_input(
        scenario(tmp_path, map="m.npy", datum={"latitude": 52, "longitude": 15}, threats=[{"polygons": "a.geojson"}])
    )
    assert np.argwhere(world.threat).min(axis=0).tolist() == [83, 50] and (world.threat > 0).sum() == 16
