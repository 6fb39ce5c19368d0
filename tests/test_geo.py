"""Maps on the Earth: georeferences, shapefiles and GeoPackages, rasters in degrees."""

import contextlib
import json
import re
import shutil
import sqlite3
import struct
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio.control
import rasterio.rpc
import shapely
import yaml
from numpy.typing import NDArray
from PIL import Image
from test_rasters import tif

from analysis.recording.contents import read_world
from planner.errors import InputError, MapError, ScenarioError, WorldError
from planner.world.frame import Frame, Georeference, around, reproject, utm_zone
from planner.world.raster_files import Raster, read_raster
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file

# Where maps lie on the Earth: kept from every kind of file to longitude and latitude, and back for shapes on them.

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
VRT = '<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>/vsicurl/http://x/</SrcDataSource></OGRVRTLayer>'
PLACES = "15,52 15.1,52 15.1,52.1"
WRONG = [
    ("a.kml", KML.format("15,52 15.001,52 15.001,52.001")[:-60], "cannot be read"),
    ("a.kml", BOMB, r"does not begin as KML does; .*delete its document type"),
    ("a.gpx", BOMB.replace("kml", "gpx"), "does not begin as GPX does; .*delete its document type"),
    ("a.kml", "<gpx></gpx>", "does not begin as KML does; expected KML"),
    ("a.gpx", VRT, "does not begin as GPX does"),
    ("a.kml", "<kml></kml>", "cannot be read .*no container el"),
    ("a.kml", KML.format("15,52 15.001,52"), r"features\[0\]: wrong coordinates"),
    ("a.kml", KML.format("15,52 15.001,nan 15.1,52.1"), "has '<coordinates>15,52 15.001,nan'"),
    ("a.kml", KML.format("500000,5761038 500010,5761038 500010,5761000"), "a point at longitude 500000"),
    ("a.kml", KML.format("15;52"), "has '<coordinates>15;'; expected longitude and latitude"),
    ("a.kml", KML.format(PLACES).replace("0.25", "high"), "property p is 'high'"),
    ("a.kml", KML.format(PLACES).replace("outerBoundaryIs", "border"), "GDAL does not read all of its 1 polygons"),
    ("a.gpx", GPX.format('<trkpt lat="52"/>' * 3), "has '<trkpt lat=.52./>'"),
    ("a.gpx", GPX.format('<trkpt lon="15" lat="five"/>' * 3), "has '<trkpt lon=.15. lat=.five./>'"),
    ("a.gpx", GPX.format('<trkpt lat="52" lon="15"/>' * 2), "holds no features"),
    ("a.kml", '<?xml version="1.0" encoding="nobody"?><kml/>', "cannot be read"),
    ("a.kml", "<kml>" + " " * 2**24 + "</kml>", "at most 16777216"),
]


@pytest.mark.parametrize(("name", "text", "words"), WRONG, ids=range(len(WRONG)))
def test_markup_that_is_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    utm_map(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        load_input(scenario(tmp_path, threats=[{"polygons": name}]))
    assert name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("number", "words"), [("0.5", ""), ("red", "'red' of field .* parsed"), ("0,3", "'0,3' of")])
def test_folders_collections_and_typed_fields_of_kml(tmp_path: Path, number: str, words: str) -> None:
    """A point beside a polygon in a folder of a folder; GDAL reads words in a field that is declared a number as 0."""
    utm_map(tmp_path)
    ring = ring_of(load_input(tmp_path / "m.tif"), 3, 5, 9, 12)
    polygon = KML.format(" ".join(f"{x},{y},7" for x, y in ring)).split("</ExtendedData>")[1].split("</Placemark>")[0]
    (tmp_path / "a.kml").write_text(
        '<kml:kml xmlns:kml="http://www.opengis.net/kml/2.2" xmlns="http://www.opengis.net/kml/2.2"><Document>'
        '<Schema name="s" id="s"><SimpleField type="float" name="p"/></Schema><!-- <Polygon/> --><Folder><Folder>'
        '<Placemark><ExtendedData><SchemaData schemaUrl="#s">'
        f'<SimpleData name="p">{number}</SimpleData></SchemaData></ExtendedData><MultiGeometry><Point><coordinates>1,2'
        f"</coordinates></Point>{polygon}</MultiGeometry></Placemark></Folder></Folder></Document></kml:kml>"
    )
    path = scenario(tmp_path, threats=[{"polygons": "a.kml"}])
    if words:
        with pytest.raises(MapError, match=words):
            load_input(path)
    else:
        assert np.argwhere(load_input(path).threat == 0.5).min(axis=0).tolist() == [3, 5]


def test_segments_of_a_track_are_joined(tmp_path: Path) -> None:
    """Also one of a single point; the route, which comes first, keeps its name."""
    utm_map(tmp_path)
    ring = ring_of(load_input(tmp_path / "m.tif"), 3, 5, 9, 12)
    one, *rest = [f'<trkpt lon="{east}" lat="{north}"/>' for east, north in ring]
    route = "".join(point.replace("trkpt", "rtept") for point in (one, *rest))
    text = GPX.format(f"{one}</trkseg><trkseg>{''.join(rest)}")
    (tmp_path / "a.gpx").write_text(text.replace("<trk>", f"<rte><name>patrol</name>{route}</rte><trk>"))
    world = load_input(scenario(tmp_path, threats=[{"polygons": "a.gpx", "p": 0.25}]))
    assert world.threat.max() == 0.4375 and (world.threat == 0.4375).sum() == 42
    assert world.sources is not None and list(world.sources.names) == ["patrol", "features[1] of a.gpx"]


def test_coordinates_that_contradict(tmp_path: Path) -> None:
    utm_map(tmp_path)
    world = load_input(tmp_path / "m.tif")
    degrees, metres = ring_of(world, 3, 5, 9, 12), world.at([3, 3, 9], [5, 12, 12]).tolist()
    geojson(tmp_path, degrees, metres)
    with pytest.raises(MapError, match="mixes longitude and latitude with other coordinates"):
        load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}]))
    geojson(tmp_path, [[2.0, 48.0], [2.1, 48.0], [2.1, 48.1234567]])
    with pytest.raises(ScenarioError, match=r"at 51\.9991 N 15\.0022 E"):
        load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}]))
    geojson(tmp_path, degrees, crs={"type": "name", "properties": {"name": "EPSG:999999"}})
    with pytest.raises(MapError, match=r"a\.geojson: no way from the CRS 'EPSG:999999'"):
        load_input(scenario(tmp_path, threats=[{"polygons": "a.geojson"}]))
    (tmp_path / "p.csv").write_text("lon,lat,strength\n15,52,0.1\n500000,5761038,0.1\n")
    with pytest.raises(MapError, match=r"line 3: a point at longitude 500000, latitude 5.76104e\+06"):
        load_input(scenario(tmp_path, threats=[{"points": "p.csv", "falloff": {"kind": "disc", "radius": 10}}]))
    with pytest.raises(ScenarioError, match=r"`datum` is .*; expected none: the map has a georeference"):
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
    both = (text + other[other.index("<Polygon>") :]).replace("</Placemark>", "</MultiGeometry></Placemark>")
    (tmp_path / "a.kml").write_text(both.replace("<Polygon>", "<MultiGeometry><Polygon>", 1))
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
        (f"x,y,strength\n{north},{east},0.1\n", "in columns named lon and lat"),
        (f"x,y,strength\n{east},{north},0.1\n", "in columns named lon and lat"),
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


# Shapefiles and GeoPackages: the cells that their polygons hold, in any CRS, and every way to be no such file.

LEFT, TOP, SIDE = 500_000.0, 5_761_038.0, 10.0
"""Of a map of 20 x 30 cells in UTM zone 33."""
KINDS = ("shp", "gpkg")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    utm_map(tmp_path)
    return tmp_path


def box(top: int, left: int, bottom: int, right: int) -> NDArray[np.float64]:
    """A closed ring around cells `[top:bottom, left:right]`, x and y."""
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
    return corners * (SIDE, -SIDE) + (LEFT, TOP)


def polygon(*rings: NDArray[np.float64]) -> shapely.Polygon:
    return shapely.Polygon(rings[0], rings[1:])


def multi_vectors(*polygons: shapely.Polygon) -> shapely.MultiPolygon:
    return shapely.MultiPolygon(polygons)


def write(path: Path, shapes: list[Any], p: Any, crs: str | None = "EPSG:32633", **more: Any) -> Path:
    """The shapes with a field `p` (or several `fields`), by GDAL's writer."""
    keys = {"geometry_type": "MultiPolygon", "crs": crs, "fields": ["p"]} | more
    columns = [np.array(column) for column in (p if len(keys["fields"]) > 1 else [p])]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # files without a CRS are meant
        pyogrio.raw.write(path, shapely.to_wkb(np.array(shapes, dtype=object)), columns, **keys)
    return path


def threat(folder: Path, **source: Any) -> NDArray[np.float32]:
    return load_input(scenario(folder, **source)).threat


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326", "EPSG:25832"])
def test_polygons_with_holes_in_any_crs(folder: Path, kind: str, crs: str) -> None:
    """Two features, the second of two parts; pyproj puts the corners into the file's CRS."""
    there = pyproj.Transformer.from_crs("EPSG:32633", crs, always_xy=True)
    rings = [
        np.stack(there.transform(*box(*edges).T), -1)
        for edges in ((2, 3, 12, 20), (4, 5, 8, 9), (14, 1, 18, 4), (13, 22, 19, 29))
    ]
    shapes = [multi_vectors(polygon(rings[0], rings[1])), multi_vectors(polygon(rings[2]), polygon(rings[3]))]
    path = write(folder / f"a.{kind}", shapes, [0.125, 0.5], crs)
    expected = np.zeros((20, 30), dtype=np.float32)
    expected[2:12, 3:20], expected[4:8, 5:9], expected[14:18, 1:4], expected[13:19, 22:29] = 0.125, 0, 0.5, 0.5
    np.testing.assert_array_equal(threat(folder, threats=[{"polygons": path.name}]), expected)
    kept_out = threat(folder, keepout=[{"polygons": path.name}])
    np.testing.assert_array_equal(np.isnan(kept_out), expected > 0)


@pytest.mark.parametrize("kind", KINDS)
def test_fields_and_maps_without_a_place(folder: Path, kind: str) -> None:
    """A number beside the file where it has none; an upper-case field; metres of a map that is nowhere on the Earth."""
    shapes = [multi_vectors(polygon(box(2, 3, 12, 20)))]
    write(folder / f"a.{kind}", shapes, [0.25], fields=["P"])
    assert (threat(folder, threats=[{"polygons": f"a.{kind}"}]) == 0.25).sum() == 170
    write(folder / f"b.{kind}", shapes, [np.nan])
    assert (threat(folder, threats=[{"polygons": f"b.{kind}", "p": 0.5}]) == 0.5).sum() == 170
    np.save(folder / "n.npy", np.zeros((20, 30), dtype=np.float32))
    write(
        folder / f"c.{kind}", [multi_vectors(polygon((box(2, 3, 12, 20) - (LEFT, TOP)) / SIDE + (0, 20)))], [0.25], None
    )
    found = threat(folder, map="n.npy", threats=[{"polygons": f"c.{kind}"}])
    assert (found[2:12, 3:20] == 0.25).all() and (found > 0).sum() == 170


@pytest.mark.parametrize("kind", KINDS)
def test_threats_are_named_as_the_file_names_them(folder: Path, kind: str) -> None:
    shapes = [multi_vectors(polygon(box(2, 3, 12, 20))), multi_vectors(polygon(box(14, 1, 18, 4)))]
    names = np.array(["quarry", None], dtype=object)
    write(folder / f"a.{kind}", shapes, [names, [0.25, 0.5]], fields=["NAME", "p"])
    threat(folder, threats=[{"polygons": f"a.{kind}"}])
    sources = load_input(folder / "s.yaml").sources
    assert sources is not None and list(sources.names) == ["quarry", f"features[1] of a.{kind}"]


def wrong(folder: Path, name: str) -> str:
    """What is said of the file, as one line that names it."""
    with pytest.raises(InputError) as caught:
        threat(folder, threats=[{"polygons": name, "p": 0.25}])
    said = str(caught.value)
    assert name in said and "\n" not in said
    return said


def test_files_that_are_not_whole(folder: Path) -> None:
    rings = [multi_vectors(polygon(box(2, 3, 12, 20)))] * 200
    whole = {kind: write(folder / f"w.{kind}", rings, [0.25] * 200) for kind in KINDS}
    for part in ("shp", "shx", "dbf"):
        for end in ("shp", "shx", "dbf", "prj"):
            shutil.copy(folder / f"w.{end}", folder / f"a.{end}")
        data = (folder / f"w.{part}").read_bytes()
        for cut in (len(data) // 2, len(data) - 5, 20, 0):
            (folder / f"a.{part}").write_bytes(data[:cut])
            said = wrong(folder, "a.shp")
            assert re.search(r"cannot be read|does not begin as|features\[\d+\]: geometry is 'none'", said)
    (folder / "a.shx").unlink()
    shutil.copy(folder / "w.shp", folder / "a.shp")
    assert "Unable to open" in wrong(folder, "a.shp")
    data = whole["gpkg"].read_bytes()
    for cut in (len(data) // 2, len(data) - 4096, 50):
        (folder / "a.gpkg").write_bytes(data[:cut])
        assert "is damaged" in wrong(folder, "a.gpkg")


def test_files_of_another_kind(folder: Path) -> None:
    for data in (b"", b"hello", b"PK\3\4" + bytes(100), VRT.encode()):
        for kind in KINDS:
            (folder / f"a.{kind}").write_bytes(data)
            assert "does not begin as a" in wrong(folder, f"a.{kind}")
    (folder / "a.gpkg").unlink()
    with contextlib.closing(sqlite3.connect(folder / "a.gpkg")) as database:
        database.execute("CREATE TABLE t (x)")
    assert "is damaged (no such table: gpkg_contents)" in wrong(folder, "a.gpkg")
    line = shapely.LineString([[LEFT, TOP], [LEFT + 50, TOP - 50]])
    for kind in KINDS:
        write(folder / f"l.{kind}", [line], [0.25], geometry_type="LineString")
        assert "geometry is 'LineString'; expected Polygon or MultiPolygon" in wrong(folder, f"l.{kind}")
        write(folder / f"n.{kind}", [None], [0.25])
        assert "features[0]: geometry is 'none'" in wrong(folder, f"n.{kind}")
    pyogrio.raw.write(folder / "t.gpkg", None, [np.array([0.25])], ["p"], driver="GPKG")
    assert "its layers are t (None); expected one layer of polygons" in wrong(folder, "t.gpkg")
    (folder / "a.zip").write_bytes(b"PK")
    assert "no polygons are read from '.zip'; expected .geojson .json .csv .shp .gpkg .kml .gpx" in wrong(
        folder, "a.zip"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_that_are_wrong(folder: Path, kind: str) -> None:
    """No CRS; metres said to be degrees; one ring of each; the neighbour's zone; numbers that are no places."""
    good, name = box(2, 3, 12, 20), f"a.{kind}"
    write(folder / name, [multi_vectors(polygon(good))], [0.25], None)
    assert any(
        words in wrong(folder, name) for words in ("names no coordinate reference system", "no way from the CRS")
    )
    degrees = np.stack(pyproj.Transformer.from_crs(32633, 4326, always_xy=True).transform(*good.T), -1)
    for rings in ([good], [degrees, good]):
        write(folder / name, [multi_vectors(*map(polygon, rings))], [0.25], "EPSG:4326")
        assert f"a point at longitude {good[0, 0]:g}, latitude {good[0, 1]:g}" in wrong(folder, name)
    write(folder / name, [multi_vectors(polygon(good))], [0.25], "EPSG:32632")
    assert "covers no cell" in wrong(folder, name)
    write(folder / name, [multi_vectors(polygon(np.where(good == good[0, 0], 1e300, good)))], [0.25])
    assert "wrong coordinates" in wrong(folder, name)


@pytest.mark.parametrize("key", ["p", "value", "detect"])
def test_text_in_a_column_of_numbers_is_no_zero(folder: Path, key: str) -> None:
    """GDAL reads such text as 0, and the threat would be gone: the second feature's is named, whatever it is of."""
    shapes = [multi_vectors(polygon(box(2, 3, 12, 20))), multi_vectors(polygon(box(14, 1, 18, 4)))]
    numbers = np.array([0.25, 0.5])
    write(folder / "a.gpkg", shapes, numbers, fields=[key.upper()])
    write(folder / "a.shp", shapes, numbers, fields=[key])
    table = (folder / "a.dbf").read_bytes()
    for end in ("shp", "shx", "prj"):
        shutil.copy(folder / f"a.{end}", folder / f"b.{end}")
    for word in ("red", "", "0,3", "abcde", "0.3m") if key == "p" else ("red", ""):
        shutil.copy(folder / "a.gpkg", folder / "b.gpkg")
        with contextlib.closing(sqlite3.connect(folder / "b.gpkg")) as database:
            for (trigger,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f'DROP TRIGGER "{trigger}"')
            database.execute(f"UPDATE a SET {key} = ? WHERE fid = 2", (word,))
            database.commit()
        (folder / "b.dbf").write_bytes(table.replace(b"0.500000000000000", f"{word:>17}".encode()))
        lost = (
            f"Value '{word}' of field b.{key} parsed incompletely"
            if word
            else rf"features\[1\]: property {key} is missing"
        )
        for name, said in (("b.gpkg", f"feature 2: property {key} is text"), ("b.shp", lost)):
            with pytest.raises(InputError, match=f"{name}: {said}"):
                threat(folder, **{"threats" if key == "p" else key: [{"polygons": name}]})


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_that_are_fine_or_not_there(folder: Path, kind: str) -> None:
    """In a field that comes second; an empty one takes the default; text of a record that is deleted is nobody's."""
    shapes = [multi_vectors(polygon(box(*edges))) for edges in ((2, 3, 12, 20), (14, 1, 18, 4), (0, 0, 1, 1))]
    write(folder / f"a.{kind}", shapes, [[7, 8, 9], [np.nan, 0.5, 0.75]], fields=["row", "p"])
    if kind == "shp":
        table = bytearray((folder / "a.dbf").read_bytes())
        skip, each = struct.unpack_from("<HH", table, 8)
        table[skip + 2 * each : skip + 2 * each + 1] = b"*"
        (folder / "a.dbf").write_bytes(table.replace(b"0.750000000000000", b"far too high many"))
    found = threat(folder, threats=[{"polygons": f"a.{kind}", "p": 0.125}])
    assert (found == 0.125).sum() == 170 and (found == 0.5).sum() == 12
    assert (found == 0.75).sum() == (kind == "gpkg")


def test_hostile_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A table that claims two thousand million rows is read; views and columns that compute, and many corners, no."""
    shapes = [multi_vectors(polygon(box(2, 3, 12, 20)))]
    write(folder / "a.shp", shapes, [0.25])
    table = bytearray((folder / "a.dbf").read_bytes())
    table[4:8] = struct.pack("<I", 2**31 - 1)
    (folder / "a.dbf").write_bytes(table)
    assert (threat(folder, threats=[{"polygons": "a.shp"}]) == 0.25).sum() == 170
    path = write(folder / "a.gpkg", shapes, [0.25])
    numbers = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
    endless = f"{numbers} SELECT i AS fid, zeroblob(1000000) AS geom FROM n"
    for change in (
        f"ALTER TABLE a RENAME TO b; CREATE VIEW a AS {endless}",
        f"DROP TABLE gpkg_ogr_contents; CREATE VIEW gpkg_ogr_contents AS {endless}",
        "ALTER TABLE a ADD COLUMN q BLOB GENERATED ALWAYS AS (zeroblob(1000000000)) VIRTUAL",
    ):
        shutil.copy(path, folder / "b.gpkg")
        with contextlib.closing(sqlite3.connect(folder / "b.gpkg")) as database:
            for (trigger,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f'DROP TRIGGER "{trigger}"')
            database.executescript(change)
        assert "is a view, or has computed columns" in wrong(folder, "b.gpkg")
    write(folder / "c.gpkg", shapes, [0.25])
    write(folder / "c.gpkg", shapes, [0.25], layer="other", append=True)
    assert "its layers are c (MultiPolygon), other (MultiPolygon); expected one layer" in wrong(folder, "c.gpkg")
    monkeypatch.setattr("planner.world.vector_files.MAX_CORNERS", 4)
    assert "corners; expected at most 4" in wrong(folder, "a.gpkg")


# Rasters in degrees on the metres of their UTM zone, held against pyproj, asked point by point.

SHAPE = (60, 80)
PLACES = {
    "EPSG:32632": (0.001, 10.0, 60.0),  # 56 x 111 m a pixel, and east of the zone's middle
    "EPSG:32756": (0.00003, 150.0, -30.0),  # 3 m, south and west
    "EPSG:32601": (0.0003, 179.99, 5.0),  # across 180 degrees
}
"""Degrees a pixel, west and north edge, by the zone that they belong to."""


def degrees_at(frame: Frame, crs: str, west: float) -> NDArray[np.float64]:
    """Longitude (not below `west`) and latitude of every pixel's centre, `[H, W, 2]`."""
    to_degrees = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    x, y = np.moveaxis(frame.centres(), -1, 0)
    longitude, latitude = to_degrees.transform(x, y)
    return np.stack([(longitude - west) % 360 + west, latitude], axis=-1)


def in_pixels(raster: Raster, step: float, west: float, north: float) -> NDArray[np.float64]:
    """Where the raster's pixels lie in the file, (row, col) `[H, W, 2]`; centres are at .5."""
    places = degrees_at(raster.frame, raster.georeference.crs, west - 1)
    return np.stack([(north - places[..., 1]) / step, (places[..., 0] - west) / step], axis=-1)


def degrees(path: Path, values: NDArray[Any], step: float, west: float, north: float, **more: Any) -> Path:
    return tif(path, values, (step, 0, west, 0, -step, north), "EPSG:4326", **more)


@pytest.mark.parametrize("crs", PLACES)
@pytest.mark.parametrize("cell_size", [None, 1000.0])
def test_every_pixel_lies_where_pyproj_puts_it(tmp_path: Path, crs: str, cell_size: float | None) -> None:
    """Linear fields stay linear: the rows and columns that pixels were taken from, to a fiftieth of one."""
    place = PLACES[crs]
    for axis in (0, 1):
        field = np.indices(SHAPE)[axis] + 0.5
        raster = read_raster(degrees(tmp_path / "a.tif", field, *place), cell_size, "bilinear")
        assert raster.georeference is not None and raster.georeference.crs == crs
        assert raster.frame is not None and f"({crs}), linear" in raster.notes[0]
        assert cell_size is None or (cell_size / raster.frame.size) % 1 == pytest.approx(0, abs=1e-9)
        at = in_pixels(raster, *place)
        within = ((at > 0.6) & (at < np.array(SHAPE) - 0.6)).all(axis=-1)
        assert within.mean() > 0.85
        assert np.abs(raster.values - at[..., axis])[within].max() < 0.02
        off = ((at < -0.02) | (at > np.array(SHAPE) + 0.02)).any(axis=-1)
        assert np.isnan(raster.values[off]).all() and not np.isnan(raster.values[within]).any()


def test_classes_are_taken_whole_and_missing_data_stays_missing(tmp_path: Path) -> None:
    """Every pixel is of the class that its centre lies in, unless that is within a fiftieth of an edge."""
    place = PLACES["EPSG:32632"]
    classes = np.arange(np.prod(SHAPE), dtype=np.float64).reshape(SHAPE)
    classes[10:20, 30:50] = -1
    path = degrees(tmp_path / "a.tif", classes, *place, nodata=-1)
    for how in ("nearest", "average", "bilinear"):
        raster = read_raster(path, None, how)  # type: ignore[arg-type]
        at = in_pixels(raster, *place)
        sure = (np.abs(at - np.rint(at)) > 0.02).all(axis=-1)
        row, col = np.moveaxis(np.floor(at).astype(int), -1, 0)
        held = (row >= 0) & (row < SHAPE[0]) & (col >= 0) & (col < SHAPE[1])
        expected = np.full(held.shape, np.nan)
        expected[held] = np.where(classes < 0, np.nan, classes)[row[held], col[held]]
        np.testing.assert_array_equal(np.isnan(raster.values[sure]), np.isnan(expected[sure]))
        if how == "nearest":
            np.testing.assert_array_equal(raster.values[sure], expected[sure])


def test_probabilities_are_averaged_over_the_pixels_of_the_map(tmp_path: Path) -> None:
    """The mean of 60 x 60 points of each map pixel, looked up in the file by pyproj; classes are the centre's."""
    step, west, north = 0.0001, 15.0, 52.0
    p = np.random.default_rng(5).choice([0.0, 0.2, 0.4], (200, 300)).astype(np.float32)
    degrees(tmp_path / "p.tif", p, step, west, north)
    left, top = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True).transform(15.003, 51.998)
    tif(tmp_path / "m.tif", np.zeros((8, 10), dtype=np.float32), (100, 0, left, 0, -100, top), "EPSG:32633")
    for rule in ({}, {"rule": {"kind": "classes", "edges": [0.1, 0.3], "p": [0.0, 0.2, 0.4]}}):
        world = load_input(scenario(tmp_path, threats=[{"raster": "p.tif"} | rule]))
        assert world.georeference is not None and world.shape == (8, 10)
        fine = 60 if not rule else 1
        frame = Frame((8 * fine, 10 * fine), 100 / fine, world.origin)
        places = degrees_at(frame, "EPSG:32633", 0)
        row, col = ((north - places[..., 1]) / step).astype(int), ((places[..., 0] - west) / step).astype(int)
        expected = p[row, col].reshape(8, fine, 10, fine).mean(axis=(1, 3))
        assert np.abs(world.threat - expected).max() < (0.005 if not rule else 1e-6)
        assert any("EPSG:4326, 200 x 300 pixels, laid over the map's" in note for note in world.notes)


def test_rasters_of_other_ground_and_other_zones(tmp_path: Path) -> None:
    """The same places in the neighbour's zone; half of the map; nothing of it."""
    values = np.zeros((20, 30), dtype=np.float32)
    tif(tmp_path / "m.tif", values, (10, 0, 500_000, 0, -10, 5_761_038), "EPSG:32633")
    left, top = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:32632").transform(499_900, 5_761_100)
    tif(tmp_path / "d.tif", np.full((50, 50), 0.25, np.float32), (10, 0, left, 0, -10, top), "EPSG:32632")
    assert (load_input(scenario(tmp_path, threats=[{"raster": "d.tif"}])).threat == 0.25).all()
    tif(tmp_path / "d.tif", np.full((50, 15), 0.25, np.float32), (10, 0, 500_000, 0, -10, 5_761_138), "EPSG:32633")
    with pytest.raises(ScenarioError, match=r"d\.tif, which is nan \(no data\) at \[0, 15\] \(300 such cells\)"):
        load_input(tmp_path / "s.yaml")
    tif(tmp_path / "d.tif", np.full((50, 15), 0.25, np.float32), (10, 0, 900_000, 0, -10, 5_761_138), "EPSG:32633")
    with pytest.raises(ScenarioError, match="data on the ground of the map; it has none there"):
        load_input(tmp_path / "s.yaml")


def test_zones_and_what_is_too_wide_for_one(tmp_path: Path) -> None:
    """Zone 33 is 12..18 east; what reaches more than 6 degrees from its middle, or to the poles, stays in degrees."""
    assert utm_zone(12.0, 52.0, 17.9, 53.0) == ("UTM zone 33 north", "EPSG:32633")
    assert utm_zone(-71.0, -34.0, -70.0, -33.0) == ("UTM zone 19 south", "EPSG:32719")
    assert utm_zone(179.9, -1.0, 180.2, 1.5) == ("UTM zone 1 north", "EPSG:32601")
    for far in ((8.0, 52.0, 21.5, 53.0), (10.0, 80.0, 11.0, 85.0), (10.0, -85.0, 11.0, -79.0)):
        assert utm_zone(*far) is None
    raster = read_raster(degrees(tmp_path / "a.tif", np.zeros((4, 8)), 2.0, 0.0, 50.0))
    assert raster.georeference is not None and raster.georeference.crs == "EPSG:4326"
    assert "degrees: worked on in metres east and north of 42 N 0 E" in raster.notes[-1]


def test_what_cannot_be_warped_is_one_line(tmp_path: Path) -> None:
    values = np.zeros((4, 5), dtype=np.float32)
    for step, words in ((1e-12, "pixels of"), (2.0, "latitudes")):
        with pytest.raises(MapError, match=words) as caught:
            read_raster(degrees(tmp_path / "a.tif", values, step, 10.0, 90.0 if step == 2.0 else 50.0))
        assert "a.tif" in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(MapError, match="after resampling to squares"):
        tif(tmp_path / "a.tif", np.zeros((1000, 2)), (1.0, 0, 10.0, 0, -0.00001, 50.0), "EPSG:4326")
        read_raster(tmp_path / "a.tif")


def placed(path: Path, values: NDArray[Any], at: Any, crs: str | None, count: int = 5, **more: Any) -> Path:
    """A GeoTIFF placed by `count` ground control points: `at(row, col)` is (x, y) in pixels from the upper left."""
    height, width = values.shape
    spots = [(0, 0), (0, width), (height, 0), (height, width), (height / 2, width / 2)]
    points = [rasterio.control.GroundControlPoint(row, col, *at(row, col), 0.0) for row, col in spots[:count]]
    return tif(path, values, crs=crs, gcps=points, **more)


def test_control_points_on_a_north_up_grid_are_its_place(tmp_path: Path) -> None:
    """Pixels of 10 m, and of 10 feet, are not resampled; degrees go to their zone as with a transform."""
    p = np.zeros((6, 8), dtype=np.float32)
    p[0, 0] = 0.1
    for crs, unit in (("EPSG:32632", 1.0), ("EPSG:2263", 1200 / 3937)):
        path = placed(tmp_path / "a.tif", p, lambda row, col: (500_000 + 10 * col, 200_000 - 10 * row), crs)
        world = load_input(path)
        assert np.array_equal(world.threat, p) and world.cell_size == pytest.approx(10 * unit)
        assert world.to_xy(0) == pytest.approx(np.array([500_005, 199_995]) * unit)
        assert any("5 ground control points" in note for note in world.notes)
    place = PLACES["EPSG:32632"]
    field = np.arange(60 * 80, dtype=np.float32).reshape(SHAPE)
    step, west, north = place
    by_points = placed(tmp_path / "b.tif", field, lambda row, col: (west + step * col, north - step * row), "EPSG:4326")
    there = read_raster(degrees(tmp_path / "c.tif", field, *place), None, "bilinear")
    raster = read_raster(by_points, None, "bilinear")
    assert raster.frame is not None and there.frame is not None and raster.frame.size == pytest.approx(there.frame.size)
    np.testing.assert_allclose(raster.values, there.values, atol=0.5)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_control_points_across_longitude_180(tmp_path: Path, crs: str, turned: bool) -> None:
    """They place a raster as those of the same pixels 5 degrees to the west do, north-up or turned."""
    field = np.arange(60 * 80, dtype=np.float32).reshape(SHAPE)
    found = []
    for middle in (175.0, 180.0):

        def at(row: float, col: float, middle: float = middle) -> tuple[float, float]:
            east, north = 1e-5 * (col - 40), 1e-5 * (30 - row)
            east, north = (east + north / 2, north - east / 2) if turned else (east, north)
            x = middle + east
            return tuple(reproject([x - 360 * (x > 180), 1e-4 + north], "EPSG:4326", crs).tolist())

        found.append(read_raster(placed(tmp_path / "a.tif", field, at, crs), None, "bilinear"))
    west, across = found
    assert across.frame.size == pytest.approx(west.frame.size, rel=0.01)
    assert np.abs(np.subtract(across.values.shape, west.values.shape)).max() <= 2
    assert np.nanmean(across.values) == pytest.approx(np.nanmean(west.values), rel=0.01)
    middle = across.georeference.to_lonlat(across.frame.at(*np.array(across.frame.shape) / 2))
    assert abs(abs(middle[0]) - 180) < 2e-5
    tif(tmp_path / "m.tif", np.zeros((4, 8), np.float32), (10, 0, 833_938, 0, -10, 34), "EPSG:32660")
    p = np.full(SHAPE, 0.4, np.float32)
    placed(tmp_path / "p.tif", p, lambda row, col: at(row * 4, col * 4), crs)
    assert load_input(scenario(tmp_path, threats=[{"raster": "p.tif"}])).threat == pytest.approx(0.4)


CONTROL_POINTS = [
    ("EPSG:32632", "EPSG:32632", (8.0, 6.0), (6.0, -8.0)),  # turned by 37 degrees
    ("EPSG:2263", "EPSG:2263", (30.0, -9.0), (-9.0, -30.0)),  # feet
    ("EPSG:4326", "EPSG:32632", (0.0004, 0.0001), (0.0002, -0.0003)),  # degrees, sheared
]


@pytest.mark.parametrize(("crs", "target", "right", "down"), CONTROL_POINTS)
def test_control_points_on_no_grid_are_warped_by(
    tmp_path: Path, crs: str, target: str, right: tuple[float, float], down: tuple[float, float]
) -> None:
    """Linear fields stay linear: the rows and columns of the file, as pyproj and the plain formula have them."""
    corner = np.array({"EPSG:32632": (500_000, 5_200_000), "EPSG:2263": (1e6, 2e5), "EPSG:4326": (10.0, 47.0)}[crs])
    steps = np.array([down, right])
    for axis in (0, 1):
        field = np.indices(SHAPE)[axis] + 0.5
        path = placed(tmp_path / "a.tif", field, lambda row, col: corner + [row, col] @ steps, crs)
        raster = read_raster(path, None, "bilinear")
        assert raster.frame is not None and raster.georeference is not None and raster.georeference.crs == target
        there = raster.georeference.to_crs(raster.frame.centres())
        if crs != target:
            there = np.stack(
                pyproj.Transformer.from_crs(target, crs, always_xy=True).transform(*np.moveaxis(there, -1, 0)), -1
            )
        at = (there - corner) @ np.linalg.inv(steps)
        within = ((at > 0.6) & (at < np.array(SHAPE) - 0.6)).all(axis=-1)
        assert within.sum() > 3000 and np.abs(raster.values - at[..., axis])[within].max() < 0.05
        off = ((at < -0.05) | (at > np.array(SHAPE) + 0.05)).any(axis=-1)
        assert np.isnan(raster.values[off]).all() and not np.isnan(raster.values[within]).any()


def test_control_points_of_a_threat_laid_over_a_map(tmp_path: Path) -> None:
    """p of 0.4 south of a line that is turned by 37 degrees; of numbers that are scaled."""
    tif(tmp_path / "m.tif", np.zeros((12, 12), np.float32), (10, 0, 500_000, 0, -10, 5_200_120), "EPSG:32632")
    p = np.zeros((80, 80), dtype=np.uint8)
    p[40:] = 40
    middle = np.array((500_060, 5_200_060))
    placed(
        tmp_path / "p.tif",
        p,
        lambda row, col: middle + [row - 40, col - 40] @ np.array([(1.8, -2.4), (2.4, 1.8)]),
        "EPSG:32632",
        edit=lambda out: setattr(out, "scales", (0.01,)),
    )
    world = load_input(scenario(tmp_path, threats=[{"raster": "p.tif"}]))
    x, y = np.moveaxis(world.frame.centres() - middle, -1, 0)
    beyond = (1.8 * x - 2.4 * y) / 3  # metres down the raster's rows
    assert world.threat[beyond > 8] == pytest.approx(0.4) and not world.threat[beyond < -8].any()


def test_places_that_are_not_read_are_refused(tmp_path: Path) -> None:
    values, path = np.zeros((6, 8), np.float32), tmp_path / "a.tif"
    for count, crs, words in ((1, "EPSG:32632", "by 1 ground control point;"), (2, "EPSG:32632", "2 ground")):
        placed(path, values, lambda row, col: (col + row, 3 * col - row), crs, count)
        with pytest.raises(MapError, match=words):
            load_input(path)
    tif(path, values)
    spots = "".join(f'<GCP Pixel="{x}" Line="{y}" X="{x}" Y="{-y}"/>' for x, y in ((0, 0), (8, 0), (0, 6)))
    beside = path.with_name("a.tif.aux.xml")
    beside.write_text(f"<PAMDataset><GCPList>{spots}</GCPList></PAMDataset>")
    with pytest.raises(MapError, match="control points name no CRS"):
        load_input(path)
    beside.unlink()
    rpcs = rasterio.rpc.RPC(0, 500, 50, 1, [0] * 20, [1] + [0] * 19, 2, 1, 9, 1, [0] * 20, [1] + [0] * 19, 2, 1)
    tif(path, values, rpcs=rpcs)
    with pytest.raises(MapError, match=r"RPCs.*gdalwarp -rpc"):
        load_input(path)
    geolocation = {"X_DATASET": "x.tif", "Y_DATASET": "y.tif", "SRS": "EPSG:4326"}
    tif(path, values, edit=lambda out: out.update_tags(ns="GEOLOCATION", **geolocation))
    with pytest.raises(MapError, match=r"geolocation array.*gdalwarp -geoloc"):
        load_input(path)
    tif(path, values, (0.01, 0, 2, 0, -0.01, 50), "EPSG:4807")
    with pytest.raises(MapError, match="counts in grad"):
        load_input(path)


def test_a_place_that_files_beside_it_give(tmp_path: Path) -> None:
    """A world file, with and without a `.prj`; no place at all; a picture's world file."""
    values = np.zeros((6, 8), np.float32)
    path = tif(tmp_path / "a.tif", values)
    assert any("has no position: a pixel is 1 m" in note for note in load_input(path).notes)
    (tmp_path / "a.tfw").write_text("10\n0\n0\n-10\n500005\n5200055\n")
    world = load_input(path)
    assert world.cell_size == 10 and world.georeference is None and any("names no CRS" in note for note in world.notes)
    (tmp_path / "a.prj").write_text(pyproj.CRS(32632).to_wkt("WKT1_ESRI"))
    world = load_input(path)
    assert world.georeference is not None and world.georeference.crs == "EPSG:32632" and not world.notes
    (tmp_path / "a.prj").write_text("nonsense")
    with pytest.raises(MapError, match=r"a\.tif: its \.prj file cannot be read"):
        load_input(path)
    (tmp_path / "a.prj").unlink()
    (tmp_path / "a.tfw").write_text("0.0003\n0\n0\n-0.0003\n10.1\n47.2\n")
    with pytest.raises(MapError, match=r"names no CRS, and pixels of 0\.0003 at .* look like degrees.*--crs EPSG:4326"):
        load_input(path)
    local = 'LOCAL_CS["site",UNIT["foot",0.3048]]'
    world = load_input(tif(tmp_path / "b.tif", values, (10, 0, 0, 0, -10, 60), local))
    assert world.cell_size == pytest.approx(3.048) and "names no place on the Earth" in world.notes[0]
    Image.fromarray(np.full((4, 6), 255, np.uint8)).save(tmp_path / "c.png")
    assert not any("is not read" in note for note in load_input(tmp_path / "c.png").notes)
    (tmp_path / "c.pgw").write_text("0.5\n0\n0\n-0.5\n0\n0\n")
    assert any("its world file c.pgw is not read" in note for note in load_input(tmp_path / "c.png").notes)
