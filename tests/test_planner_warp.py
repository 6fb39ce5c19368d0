"""Rasters in degrees on the metres of their UTM zone, held against pyproj, asked point by point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from PIL import Image
from test_planner_rasters import tif

from planner.errors import MapError, ScenarioError
from planner.world.grid import Frame, reproject, utm_zone
from planner.world.raster_files import Raster, read_raster
from planner.world.scenario import load_input

pytest.importorskip("rasterio")
pyproj = pytest.importorskip("pyproj")
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
    assert raster.frame is not None and raster.georeference is not None
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
        keys = {"map": "m.tif", "threats": [{"raster": "p.tif"} | rule]}
        (tmp_path / "s.yaml").write_text(yaml.safe_dump(keys))
        world = load_input(tmp_path / "s.yaml")
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
    (tmp_path / "s.yaml").write_text(yaml.safe_dump({"map": "m.tif", "threats": [{"raster": "d.tif"}]}))
    assert (load_input(tmp_path / "s.yaml").threat == 0.25).all()
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
    assert (
        utm_zone(8.0, 52.0, 21.5, 53.0)
        is utm_zone(10.0, 80.0, 11.0, 85.0)
        is utm_zone(10.0, -85.0, 11.0, -79.0)
        is None
    )
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
    control = pytest.importorskip("rasterio.control")
    height, width = values.shape
    spots = [(0, 0), (0, width), (height, 0), (height, width), (height / 2, width / 2)]
    points = [control.GroundControlPoint(row, col, *at(row, col), 0.0) for row, col in spots[:count]]
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
    assert west.frame is not None and across.frame is not None and across.georeference is not None
    assert across.frame.size == pytest.approx(west.frame.size, rel=0.01)
    assert np.abs(np.subtract(across.values.shape, west.values.shape)).max() <= 2
    assert np.nanmean(across.values) == pytest.approx(np.nanmean(west.values), rel=0.01)
    middle = across.georeference.to_lonlat(across.frame.at(*np.array(across.frame.shape) / 2))
    assert abs(abs(middle[0]) - 180) < 2e-5
    tif(tmp_path / "m.tif", np.zeros((4, 8), np.float32), (10, 0, 833_938, 0, -10, 34), "EPSG:32660")
    p = np.full(SHAPE, 0.4, np.float32)
    placed(tmp_path / "p.tif", p, lambda row, col: at(row * 4, col * 4), crs)
    (tmp_path / "s.yaml").write_text(yaml.safe_dump({"map": "m.tif", "threats": [{"raster": "p.tif"}]}))
    assert load_input(tmp_path / "s.yaml").threat == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("crs", "target", "right", "down"),
    [
        ("EPSG:32632", "EPSG:32632", (8.0, 6.0), (6.0, -8.0)),  # turned by 37 degrees
        ("EPSG:2263", "EPSG:2263", (30.0, -9.0), (-9.0, -30.0)),  # feet
        ("EPSG:4326", "EPSG:32632", (0.0004, 0.0001), (0.0002, -0.0003)),  # degrees, sheared
    ],
)
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
    (tmp_path / "s.yaml").write_text(yaml.safe_dump({"map": "m.tif", "threats": [{"raster": "p.tif"}]}))
    world = load_input(tmp_path / "s.yaml")
    x, y = np.moveaxis(world.frame.centres() - middle, -1, 0)
    beyond = (1.8 * x - 2.4 * y) / 3  # metres down the raster's rows
    assert world.threat[beyond > 8] == pytest.approx(0.4) and not world.threat[beyond < -8].any()


def test_places_that_are_not_read_are_refused(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    values, path = np.zeros((6, 8), np.float32), tmp_path / "a.tif"
    for count, crs, words in (
        (1, "EPSG:32632", "by 1 ground control point;"),
        (2, "EPSG:32632", "2 ground"),
    ):
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
    assert any("gives no place: a pixel is 1 m" in note for note in load_input(path).notes)
    (tmp_path / "a.tfw").write_text("10\n0\n0\n-10\n500005\n5200055\n")
    world = load_input(path)
    assert world.cell_size == 10 and world.georeference is None and any("names no CRS" in note for note in world.notes)
    (tmp_path / "a.prj").write_text(pyproj.CRS(32632).to_wkt("WKT1_ESRI"))
    world = load_input(path)
    assert world.georeference is not None and world.georeference.crs == "EPSG:32632" and not world.notes
    (tmp_path / "a.prj").write_text("nonsense")
    with pytest.raises(MapError, match=r"a\.tif: the \.prj beside it cannot be read"):
        load_input(path)
    (tmp_path / "a.prj").unlink()
    (tmp_path / "a.tfw").write_text("0.0003\n0\n0\n-0.0003\n10.1\n47.2\n")
    with pytest.raises(MapError, match=r"names no CRS, and pixels of 0\.0003 at .* look like degrees.*--crs EPSG:4326"):
        load_input(path)
    local = 'LOCAL_CS["site",UNIT["foot",0.3048]]'
    world = load_input(tif(tmp_path / "b.tif", values, (10, 0, 0, 0, -10, 60), local))
    assert world.cell_size == pytest.approx(3.048) and "names no place on the Earth" in world.notes[0]
    Image.fromarray(np.full((4, 6), 255, np.uint8)).save(tmp_path / "c.png")
    assert not any("beside it" in note for note in load_input(tmp_path / "c.png").notes)
    (tmp_path / "c.pgw").write_text("0.5\n0\n0\n-0.5\n0\n0\n")
    assert any("c.pgw beside it is not read" in note for note in load_input(tmp_path / "c.png").notes)
