"""Fields: their boundary as the map, rows and swaths."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import yaml
from numpy.typing import NDArray
from test_geo import polygon, write

import mrac_jax as mrac
from planner.errors import InputError
from planner.world.frame import Frame, reproject
from planner.world.scenario import load_input
from planner.world.vector_files import touched
from planner.world.world import World

# A field's boundary as the map: which cells are free, where they lie, and every way to be no field.

EAST, NORTH = 8.0, 47.5
"""Corner of the fields that are in degrees."""
L_SHAPE = [[0, 0], [60, 0], [60, 20], [40, 20], [40, 40], [0, 40], [0, 0]]
RECTANGLE = [[0, 0], [410, 0], [410, 210], [0, 210], [0, 0]]
HOLE = [[10, 10], [20, 10], [20, 20], [10, 20], [10, 10]]
CROSS = {"type": "name", "properties": {"name": "EPSG:25832"}}


def geojson(path: Path, *polygons: list[Any], crs: Any = None, **properties: Any) -> Path:
    feature = {"type": "Feature", "properties": properties}
    features = [feature | {"geometry": {"type": "Polygon", "coordinates": rings}} for rings in polygons]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features} | ({"crs": crs} if crs else {})))
    return path


def scenario(folder: Path, **keys: Any) -> World:
    (folder / "s.yaml").write_text(yaml.safe_dump(keys))
    return load_input(folder / "s.yaml")


def drawn(world: World) -> list[str]:
    return ["".join(".#"[int(np.isnan(p))] for p in row) for row in world.threat]


def test_a_field_with_a_hole_and_a_second_part(tmp_path: Path) -> None:
    """Cells of 10 m; the second part of another file's feature ends within a row of cells."""
    path = geojson(tmp_path / "f.geojson", [L_SHAPE, HOLE], [[[80, 0], [100, 0], [100, 35], [80, 35], [80, 0]]])
    world = load_input(path, 10)
    assert drawn(world) == ["....######", "....####..", ".#......##"[:6] + "##..", "......##.."]
    assert world.cell_size == 10 and world.origin == (0, 0, 0) and world.georeference is None
    assert any("read as metres" in note for note in world.notes)
    assert any("2 cells lie on the field's boundary" in note for note in world.notes)


def test_cells_whose_centre_is_inside_are_free_if_asked(tmp_path: Path) -> None:
    geojson(tmp_path / "f.geojson", [[[0, 0], [26, 0], [26, 20], [0, 20], [0, 0]]])
    whole = scenario(tmp_path, map={"polygons": "f.geojson"}, cell_size=10)
    centre = scenario(tmp_path, map={"polygons": "f.geojson", "boundary": "centre"}, cell_size=10)
    assert drawn(whole) == ["..#", "..#"] and drawn(centre) == ["...", "..."]
    assert drawn(scenario(tmp_path, map="f.geojson", cell_size=10)) == drawn(whole)


def crossed_by_sampling(ring: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Cells of 1 m that dense points on the edges lie inside of."""
    points = np.concatenate([np.linspace(a, b, 20_001) for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)])
    places = np.stack([shape[0] - points[:, 1], points[:, 0]], axis=1)
    cells = np.floor(places)
    held = (np.abs(places - cells - 0.5) < 0.4999).all(axis=1) & (cells >= 0).all(axis=1) & (cells < shape).all(axis=1)
    found = np.zeros(shape, dtype=bool)
    found[tuple(cells[held].astype(int).T)] = True
    return found


@pytest.mark.parametrize("grain", [0.0, 0.5, 1.0])
def test_cells_that_an_edge_runs_through(grain: float) -> None:
    """Random rings, also with corners on the sides and in the middle of cells, and beyond the grid."""
    random = np.random.default_rng(7)
    for _ in range(12):
        ring = random.uniform((-3, -3), (20, 15), (5, 2))
        ring = np.round(ring / grain) * grain if grain else ring
        np.testing.assert_array_equal(touched([ring], Frame((12, 17), 1.0)), crossed_by_sampling(ring, (12, 17)))


def degrees(ring: list[list[float]]) -> list[list[float]]:
    """Metres from the corner as longitude and latitude, by the radii of the ellipsoid there."""
    across, up = 111_320 * np.cos(np.radians(NORTH)) * 1.00182, 111_180.0
    return [[float(EAST + x / across), NORTH + y / up] for x, y in ring]


def test_a_field_in_degrees_lies_where_it_came_from(tmp_path: Path) -> None:
    """GeoJSON without a CRS is in degrees; what goes back to degrees (export) is at the corner that it came from."""
    world = load_input(geojson(tmp_path / "f.geojson", [degrees(RECTANGLE)]), 20)
    assert world.shape == (11, 21) and world.free[:10, :20].all() and world.free.sum() == 200
    assert world.georeference is not None and world.georeference.crs == "EPSG:4326"
    frame = Frame(world.shape, world.cell_size, world.origin)
    np.testing.assert_allclose(world.georeference.to_lonlat(frame.at(0, 0)), degrees(RECTANGLE)[3], atol=1e-9)
    (tmp_path / "f.kml").write_text(
        "<kml><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>"
        + " ".join(f"{x!r},{y!r},0" for x, y in degrees(RECTANGLE))
        + "</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
    )
    np.testing.assert_array_equal(load_input(tmp_path / "f.kml", 20).threat, world.threat)


@pytest.mark.parametrize("kind", ["shp", "gpkg", "geojson"])
def test_a_field_in_a_crs_of_metres(tmp_path: Path, kind: str) -> None:
    """It lies on its own coordinates, and pyproj agrees with where that is on the Earth."""
    ring = [[x + 500_000, y + 5_200_000] for x, y in L_SHAPE]
    path = tmp_path / f"f.{kind}"
    if kind == "geojson":
        geojson(path, [ring], crs=CROSS)
    else:
        write(path, [polygon(np.array(ring))], [0.5], "EPSG:25832", geometry_type="Polygon")
    world = load_input(path, 20)
    assert drawn(world) == ["..#", "..."] and world.origin[:2] == (500_000, 5_200_000)
    there = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(500_010, 5_200_010)
    np.testing.assert_allclose(world.georeference.to_lonlat([500_010, 5_200_010]), there, atol=1e-9)
    assert (kind != "geojson") == any("its property p is not read" in note for note in world.notes)


def test_corners_in_a_csv_file_and_a_threat_on_them(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text("x_m,y_m\n0,0\n40,0\n40,20\n0,20\n0,0\n")
    (tmp_path / "t.csv").write_text("x,y\n0,0\n10,0\n10,10\n0,10\n")
    world = scenario(tmp_path, map={"polygons": "c.csv"}, cell_size=10, threats=[{"polygons": "t.csv", "p": 0.25}])
    assert world.threat.tolist() == [[0, 0, 0, 0], [0.25, 0, 0, 0]]


NAN = '{"type": "Polygon", "coordinates": [[[0, 0], [NaN, 0], [1, 1]]]}'


NO_FIELDS = [
    ("f.geojson", '{"type": "FeatureCollection", "features": []}', 10, "holds no features"),
    ("f.geojson", NAN, 10, "wrong coordinates"),
    ("f.geojson", "", 10, "no JSON"),
    ("f.geojson", '{"type": "Point", "coordinates": [1, 2]}', 10, "geometry is 'Point'"),
    ("f.gpx", "<gpx></gpx>", 10, "holds no features"),
    ("f.kml", "<kml><Placemark/></kml>", 10, "holds no features"),
    ("f.csv", "x,y\n1,2\n3,4\n", 10, "2 corners"),
    ("f.csv", "x,y\n" + "1,2\n" * 131_073, 10, "at most 131072"),
    ("f.csv", "x,y\n1,2\nnan,4\n5,6\n", 10, "line 3: x is 'nan'"),
    ("f.csv", "a,b,c\n1,2,3\n", 10, "columns x and y, or lon and lat"),
    ("f.csv", "lon,lat\n8,200\n9,1\n9,2\n", 10, "line 2: latitude stands first, as in 8, 200: 200 is no latitude"),
    ("f.csv", "lon,lat\n8,20\n12,20\n12,22\n", 10, "a field of at most 3 degrees"),
    ("f.csv", "0,0\n1e6,0\n1e6,1e6\n", 0.5, "expected at most 67108864; give larger cells"),
    ("f.csv", "0,0\n4,0\n4,4\n", 10, "no cell of 10 m lies in the field of 4 x 4 m; give smaller cells"),
]


@pytest.mark.parametrize(("name", "text", "cell_size", "said"), NO_FIELDS)
def test_what_is_no_field(tmp_path: Path, name: str, text: str, cell_size: float, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        scenario(tmp_path, map={"polygons": name}, cell_size=cell_size)
    assert said in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


def test_a_field_needs_a_size_of_cells_and_a_crs_that_is_known(tmp_path: Path) -> None:
    path = geojson(tmp_path / "f.geojson", [L_SHAPE])
    with pytest.raises(InputError, match="a field has no pixels; give cell_size, the side of a cell in metres"):
        load_input(path)
    with pytest.raises(InputError, match=r"`map\.polygons` has no pixels; give `cell_size:`, metres, next to `map:`"):
        scenario(tmp_path, map={"polygons": "f.geojson"})
    for crs in ("EPSG:999999", "Mars"):
        geojson(path, [L_SHAPE], crs={"type": "name", "properties": {"name": crs}})
        with pytest.raises(InputError, match="expected a CRS that PROJ knows"):
            load_input(path, 10)


CUT = [[-90, -60], [160, -60], [160, 60], [60, 60], [60, 0], [-40, 0], [-40, 60], [-90, 60], [-90, -60]]
"""Metres about a place at longitude 180, with a bay in the north that it runs through."""


def across_180(turn: float, ring: list[list[float]] = CUT) -> list[list[float]]:
    """That ring in degrees, whole; its longitudes about 180, or about -180 (`turn` -360)."""
    return [[180 + turn + x / 106_470, -17 + y / 110_650] for x, y in ring]


def cut_at_180() -> list[list[list[float]]]:
    """The same, cut there by hand: from the west, the south-eastern part and the two arms of the bay are one or two."""
    west = [[-90, -60], [0, -60], [0, 0], [-40, 0], [-40, 60], [-90, 60], [-90, -60]]
    east = [[0, -60], [160, -60], [160, 60], [60, 60], [60, 0], [0, 0], [0, -60]]
    return [across_180(0, west), across_180(-360, east)]


def test_a_field_across_longitude_180(tmp_path: Path) -> None:
    """However it is written: the same cells, none an obstacle for the cut, and their corner in -180..180."""
    whole = load_input(geojson(tmp_path / "f.geojson", [across_180(0)]), 10)
    assert whole.free.sum() > 150 and not whole.free[:5, 6:14].any() and whole.free[7:11, 1:24].all()
    stepped = [[x if x <= 180 else x - 360, y] for x, y in across_180(0)]
    east, west = cut_at_180()
    multi = {"type": "MultiPolygon", "coordinates": [[east], [west]]}
    (tmp_path / "m.geojson").write_text(json.dumps(multi))
    (tmp_path / "f.csv").write_text("lon;lat\n" + "".join(f"{x};{y}\n".replace(".", ",") for x, y in stepped))
    files = [
        geojson(tmp_path / "n.geojson", [across_180(-360)]),
        geojson(tmp_path / "s.geojson", [stepped]),
        geojson(tmp_path / "p.geojson", [east], [west]),
        tmp_path / "m.geojson",
        tmp_path / "f.csv",
    ]
    for path in files:
        world = scenario(tmp_path, map={"polygons": path.name}, cell_size=10)
        np.testing.assert_array_equal(world.free, whole.free)
        np.testing.assert_allclose(world.to_lonlat(world.at(0, 0)), whole.to_lonlat(whole.at(0, 0)), atol=1e-9)
    assert any("semicolons, numbers as written with decimal commas" in note for note in world.notes)
    mercator = np.pi / 180 * 6_378_137
    rings = [
        [[x * mercator, mercator * np.degrees(np.arcsinh(np.tan(np.radians(y))))] for x, y in one]
        for one in (east, west)
    ]
    path = geojson(
        tmp_path / "g.geojson", *([ring] for ring in rings), crs={"type": "name", "properties": {"name": "EPSG:3857"}}
    )
    found = load_input(path, 10)  # a metre of Mercator is 0.956 m there
    assert found.shape[1] == 27 and not found.free[:5, 7:14].any() and found.free[8:11, 1:25].all()


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_a_cut_at_longitude_180_that_stops_short_of_it(tmp_path: Path, crs: str) -> None:
    """1 m on either side: no wall of obstacles, and a note; fields that lie 30 or 300 m apart stay two."""
    places = {"type": "name", "properties": {"name": crs}}
    for short, joined, said in ((1, True, True), (15, False, True), (150, False, False)):
        fields = []
        for side in (1, -1):
            ring = [[0, -60], [100, -60], [100, 60], [0, 60], [0, -60]]
            about = [[side * (180 - (x + short) / 106_470), -17 + y / 110_650] for x, y in ring]
            fields.append([reproject(about, "EPSG:4326", crs).tolist()])
        world = load_input(geojson(tmp_path / "f.geojson", *fields, crs=places), 10)
        notes = [note for note in world.notes if "m apart where longitudes come round, " in note]
        assert len(notes) == said and all(("are joined there" in note) == joined for note in notes)
        walls = ~world.free[1:-2].any(axis=0)
        assert walls[2:-2].any() != joined


def test_metres_of_a_field_that_are_none_are_said(tmp_path: Path) -> None:
    """100 x 100 m at 60 N are 200 x 200 of Mercator's, and UTM's own metres need no note."""
    square = [
        [500_000, 6_651_400],
        [500_100, 6_651_400],
        [500_100, 6_651_500],
        [500_000, 6_651_500],
        [500_000, 6_651_400],
    ]
    for crs, words in (("EPSG:3857", "a metre of EPSG:3857 is 0.501 m"), ("EPSG:32632", "")):
        ring = reproject(square, "EPSG:32632", crs).tolist()
        files = [geojson(tmp_path / "f.geojson", [ring], crs={"type": "name", "properties": {"name": crs}})]
        for kind in ("gpkg", "shp"):
            files.append(tmp_path / f"f.{kind}")
            write(files[-1], [polygon(np.array(ring))], [0.5], crs, geometry_type="Polygon")
        for path in files:
            notes = [note for note in load_input(path, 10).notes if "a metre of" in note]
            assert len(notes) == bool(words) and all(note.startswith(words) for note in notes)
            assert all(note.endswith("(ogr2ogr -t_srs)") for note in notes)


def test_a_field_whose_latitude_stands_first(tmp_path: Path) -> None:
    """-122 is no latitude; where both may be one, the note says where the field is taken to lie."""
    for digits in (3, 7):
        ring = [[37.41, -122.06], [37.411, -122.06], [round(37.4112345, digits), -122.059], [37.41, -122.06]]
        with pytest.raises(InputError, match=r"f\.geojson: latitude stands first, as in 37\.41, -122\.06: .*swap"):
            load_input(geojson(tmp_path / "f.geojson", [ring]), 10)
    world = load_input(geojson(tmp_path / "f.geojson", [[[y, x] for x, y in degrees(RECTANGLE)]]), 20)
    assert any("metres east and north of 8 N 47.5 E" in note for note in world.notes)
    with pytest.raises(InputError, match=r"in the field of .* at 8 N 47\.5 E; .*swap latitude and longitude"):
        load_input(tmp_path / "f.geojson", 500)


def test_metres_beyond_90_are_no_latitudes(tmp_path: Path) -> None:
    """A field of 2 x 2 m at (10, 120) of a frame of its own is one, in cells that fit in."""
    world = load_input(geojson(tmp_path / "f.geojson", [[[10, 120], [12, 120], [12, 122], [10, 122]]]), 0.5)
    assert world.free.sum() == 16 and world.georeference is None


# Fields whose rows run in a direction, and that are driven by swaths: what is covered is counted on smaller cells.


def scenario_swaths(folder: Path, rings: list[list[list[float]]], *lines: str) -> Path:
    (folder / "farm.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": rings}))
    (folder / "farm.yaml").write_text("\n".join(lines))
    return folder / "farm.yaml"


def test_rows_run_in_the_direction_that_is_asked_for(tmp_path: Path) -> None:
    """A rectangle of 40 x 20 m that lies askew: by its own rows it is cut into whole cells, all of them within it."""
    turn = math.radians(30)
    along, across = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    corners = [5000 + a * along + b * across for a, b in ((0, 0), (40, 0), (40, 20), (0, 20), (0, 0))]
    rings = [[corner.tolist() for corner in corners]]
    world = mrac.load(scenario_swaths(tmp_path, rings, "map: {polygons: farm.geojson, direction: 30}", "cell_size: 2"))
    assert world.shape == (10, 20) and world.free.all()
    places = world.to_xy(np.arange(200)) - 5000
    row, col = np.divmod(np.arange(200), 20)
    np.testing.assert_allclose(places @ along, 2 * col + 1, atol=1e-6)
    np.testing.assert_allclose(places @ across, 19 - 2 * row, atol=1e-6)
    askew = mrac.load(scenario_swaths(tmp_path, rings, "map: {polygons: farm.geojson}", "cell_size: 2"))
    assert askew.free.sum() < 180


def test_swaths_are_driven_and_the_field_s_cells_are_counted(tmp_path: Path) -> None:
    """By hand: 10 x 10 m in swaths of 4 m from the upper left; half a swath is enough, a quarter is not."""
    square = [[[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]]
    lines = ("map: {polygons: farm.geojson, swath: 4}", "cell_size: 1")
    world = mrac.load(scenario_swaths(tmp_path, square, *lines))
    assert (world.shape, world.cell_size) == ((3, 3), 4.0)
    assert np.where(world.free, world.value, 0).tolist() == [[16, 16, 8], [16, 16, 8], [8, 8, 0]]
    assert not world.free[2, 2]
    assert any("hold 96.00 % of the field's cells of 1 m" in note for note in world.notes)
    np.testing.assert_allclose(world.to_xy([0, 8]), [[2, 8], [10, 0]])
    plan = mrac.plan(world, starts=[[0, 0]], deadline=3)
    answer = mrac.evaluate(world, plan, rollouts=8, advice=False)
    fine = np.zeros((12, 12), dtype=bool)  # visit by visit: what lies within half a swath of its centre
    for cell in plan.robots[0].path.tolist():
        (x, y), at = world.to_xy([cell])[0], np.arange(12) + 0.5
        fine |= (abs(10 - at - y) <= 2)[:, None] & (abs(at - x) <= 2)
    covered = fine[:10, :10].sum()
    assert answer.outputs["value"].covered.mean == pytest.approx(covered) and covered < 96


WRONG_SWATHS = [
    ("map: {polygons: farm.geojson, swath: 2.5}", r"`map.swath` is 2.5 m; expected a whole number of cells of 1 m"),
    ("map: {polygons: farm.geojson, swath: 0.5}", r"`map.swath` is 0.5 m"),
    ("map: {polygons: farm.geojson, direction: 200}", r"`map.direction` is 200; expected degrees, -180 to 180"),
    ("map: {polygons: farm.geojson, swath: 2}\nvalue: 3", r"`value` is 3; expected none for a map with a swath"),
    ("map: {file: farm.geojson, swath: 2}", "swath"),
]


@pytest.mark.parametrize(("line", "said"), WRONG_SWATHS)
def test_swaths_and_directions_that_are_none(tmp_path: Path, line: str, said: str) -> None:
    square = [[[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]]
    with pytest.raises(InputError, match=said):
        mrac.load(scenario_swaths(tmp_path, square, line, "cell_size: 1"))
