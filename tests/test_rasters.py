"""Rasters on the ground, and samples of a survey interpolated over a map."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml
from numpy.typing import NDArray

from planner.errors import InputError, MapError, ScenarioError
from planner.world.frame import degree_sides
from planner.world.raster_bands import AMOUNTS
from planner.world.raster_files import jacksboro, read_elevation, read_raster, square_metres
from planner.world.scenario import load_input
from planner.world.world import World

# Rasters on the ground: GeoTIFF, degrees and oblong pixels made square metres, and the elevation model that ships.


def tif(
    path: Path,
    values: np.ndarray,
    transform: tuple[float, ...] = (),
    crs: str | None = None,
    edit: Callable[[Any], object] = id,
    **more: Any,
) -> Path:
    """A GeoTIFF; `transform`: (pixel width, 0, left, 0, -pixel height, top); `edit`: sets what it says besides."""
    keys = {"height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": values.dtype, "crs": crs} | more
    if transform:
        keys["transform"] = rasterio.Affine(*transform)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(path, "w", driver="GTiff", **keys) as out:
            out.write(values, 1)
            edit(out)
    return path


VALUES = np.arange(35, dtype=np.float32).reshape(5, 7) / 100


def test_square_metres_in_a_projection(tmp_path: Path) -> None:
    raster = read_raster(tif(tmp_path / "a.tif", VALUES, (10, 0, 500, 0, -10, 900), "EPSG:32633"))
    assert raster.values.tolist() == VALUES.astype(float).tolist()
    assert raster.frame.size == 10
    assert raster.frame.origin == (500, 850, 0)
    world = load_input(tmp_path / "a.tif")
    assert world.threat.tolist() == VALUES.tolist()
    assert world.to_xy(0).tolist() == [505, 895]


def test_south_up_is_turned_and_feet_become_metres(tmp_path: Path) -> None:
    raster = read_raster(tif(tmp_path / "a.tif", VALUES, (10, 0, 500, 0, 10, 850), "EPSG:2263"))
    assert raster.values.tolist() == VALUES[::-1].astype(float).tolist()
    assert raster.frame.size == pytest.approx(10 * 1200 / 3937)
    assert raster.frame.origin[1] == pytest.approx(850 * 1200 / 3937)


@pytest.mark.parametrize("key", ["threats: [{raster: a.tif}]", "value: [{raster: a.tif}]", "detect: [{raster: a.tif}]"])
def test_a_raster_without_a_place_is_laid_cell_on_cell_with_a_note(tmp_path: Path, key: str) -> None:
    tif(tmp_path / "map.tif", VALUES * 0, (10, 0, 0, 0, -10, 50), "EPSG:32633")
    note = "a.tif has no position: it is laid on the map cell on cell, its row 0 on the map's"
    for transform, crs in (((), None), ((10, 0, 0, 0, -10, 50), "EPSG:32633")):
        tif(tmp_path / "a.tif", VALUES, transform, crs)
        (tmp_path / "s.yaml").write_text(f"map: map.tif\n{key}\n")
        world = load_input(tmp_path / "s.yaml")
        assert sum(one.endswith(f"]: {note}") for one in world.notes) == (not transform)
        if "threats" in key:
            assert world.threat[4].tolist() == VALUES[4].tolist()


def test_no_data_is_an_obstacle_and_an_error_under_a_free_cell(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[1, 2] = -9999
    tif(tmp_path / "a.tif", values, (10, 0, 0, 0, -10, 50), "EPSG:32633", nodata=-9999)
    assert np.argwhere(~load_input(tmp_path / "a.tif").free).tolist() == [[1, 2]]
    tif(tmp_path / "map.tif", VALUES, (10, 0, 0, 0, -10, 50), "EPSG:32633")
    with pytest.raises(ScenarioError, match=r"nan \(no data\) at \[1, 2\]"):
        load_input(scenario(tmp_path, map={"file": "map.tif"}, threats=[{"raster": "a.tif"}]))


def test_degrees_too_wide_for_utm_become_square_metres(tmp_path: Path) -> None:
    """Rows and columns of the file, the upper-left corner where it was."""
    step = 0.5
    values = np.add.outer(np.arange(40.0), np.zeros(50)).astype(np.float32) / 100
    path = tif(tmp_path / "a.tif", values, (step, 0, 10.0, 0, -step, 70.0), "EPSG:4326")
    raster = read_raster(path, cell_size=100_000)
    north, east = degree_sides(60.0)
    assert raster.frame.size == pytest.approx(25_000)  # the largest part of 100 km within a pixel's 27.9 km
    assert raster.values.shape == (math.floor(40 * step * north / 25e3), math.floor(50 * step * east / 25e3))
    assert raster.values[0, 0] == 0
    rows = np.floor((np.arange(raster.values.shape[0]) + 0.5) * 25e3 / (step * north))
    assert raster.values[:, 3] == pytest.approx(rows / 100, abs=1e-6)
    assert "40 x 50 pixels" in raster.notes[0]


def test_degrees_have_the_lengths_of_the_ellipsoid() -> None:
    assert degree_sides(0) == pytest.approx((110574.3, 111319.5), abs=1)
    assert degree_sides(45) == pytest.approx((111131.8, 78846.8), abs=1)
    assert degree_sides(60) == pytest.approx((111412.2, 55800.0), abs=1)


def test_oblong_pixels_are_resampled_nearest_or_linear() -> None:
    values = np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]])
    near, side = square_metres(values, (2.0, 1.0), None, smooth=False)
    assert side == 1.0
    assert near.tolist() == [[0, 1, 2], [0, 1, 2], [10, 11, 12], [10, 11, 12]]
    linear, _ = square_metres(values, (2.0, 1.0), None, smooth=True)
    assert linear[:, 0].tolist() == [0, 2.5, 7.5, 10]
    assert square_metres(values, (2.0, 1.0), 3.0, smooth=False)[1] == 1.0
    assert square_metres(values, (2.0, 1.5), 2.0, smooth=False)[1] == 1.0


def test_a_raster_of_other_ground(tmp_path: Path) -> None:
    tif(tmp_path / "dem.tif", VALUES, (10, 0, 500, 0, -10, 900), "EPSG:32633")
    tif(tmp_path / "dose.tif", VALUES, (10, 0, 800, 0, -10, 900), "EPSG:32633")
    path = scenario(tmp_path, map={"elevation": "dem.tif"}, threats=[{"raster": "dose.tif"}])
    with pytest.raises(ScenarioError, match="data on the ground of the map"):
        load_input(path)
    tif(tmp_path / "dose.tif", VALUES, (10, 0, 500, 0, -10, 900), "EPSG:32633")
    assert load_input(path).threat.tolist() == VALUES.tolist()


def test_elevation_and_dose_in_degrees_stay_aligned(tmp_path: Path) -> None:
    place = (0.001, 0, 10.0, 0, -0.001, 60.04)
    dose = np.zeros((40, 50), dtype=np.float32)
    dose[20:, :] = 0.25
    tif(tmp_path / "dem.tif", np.zeros((40, 50), dtype=np.float32), place, "EPSG:4326")
    tif(tmp_path / "dose.tif", dose, place, "EPSG:4326")
    sources = [{"raster": "dose.tif"}]
    world = load_input(scenario(tmp_path, map={"elevation": "dem.tif"}, cell_size=200, threats=sources))
    assert world.shape == (22, 14)
    assert world.free.sum() > 0.7 * 22 * 14  # the meridian leans by a cell in the zone's metres
    assert set(np.unique(world.threat[world.free])) == {0.0, 0.25}
    north = world.to_lonlat(world.at(*(np.argwhere(world.free) + 0.5).T))[:, 1]
    threat = world.threat[world.free]
    assert (threat[north < 60.018] == 0.25).all() and not threat[north > 60.022].any()


REFUSED_GROUNDS = [
    ({"transform": (10, 2, 0, 0, -10, 50)}, "rotated"),
    ({"transform": (-10, 0, 0, 0, -10, 50)}, "rotated"),
    ({"transform": (10, 0, 0, 0, -10, 95), "crs": "EPSG:4326"}, "latitudes"),
]


@pytest.mark.parametrize(("changes", "names"), REFUSED_GROUNDS)
def test_grounds_that_are_refused(tmp_path: Path, changes: dict, names: str) -> None:
    with pytest.raises(MapError, match=names):
        read_raster(tif(tmp_path / "a.tif", VALUES, **changes))


def test_several_bands_and_broken_files(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="2 bands"):
        read_raster(tif(tmp_path / "a.tif", VALUES, (10, 0, 0, 0, -10, 50), count=2))
    whole = tif(tmp_path / "b.tif", np.random.default_rng(1).random((50, 60))).read_bytes()
    for data in (b"", b"II*\0", whole[: len(whole) // 2], b"hello"):
        (tmp_path / "b.tif").write_bytes(data)
        with pytest.raises(MapError, match=r"b\.tif"):
            read_raster(tmp_path / "b.tif")


def test_a_tiny_tif_that_claims_to_be_huge(tmp_path: Path) -> None:
    whole = bytearray(tif(tmp_path / "a.tif", np.zeros((3, 5), dtype=np.uint8)).read_bytes())
    for tag in (256, 257):  # ImageWidth, ImageLength: type and count, then the value
        at = next(i for i in range(8, len(whole)) if whole[i : i + 2] == tag.to_bytes(2, "little"))
        whole[at + 2 : at + 12] = (4).to_bytes(2, "little") + (1).to_bytes(4, "little") + (8000).to_bytes(4, "little")
    (tmp_path / "a.tif").write_bytes(bytes(whole))
    with pytest.raises(MapError, match="claim 64000000 pixels"):
        read_raster(tmp_path / "a.tif")


GRID = (10, 0, 500_000, 0, -10, 5_200_200)
"""Pixels of 10 m in UTM zone 32."""
US_FOOT = 1200 / 3937


def says(path: Path, values: np.ndarray, **said: Any) -> Path:
    """A GeoTIFF on GRID that says `names` of its numbers; the rest as of `tif`."""
    names = ("scale", "offset", "units", "tags", "description")
    own = {name: said.pop(name) for name in names if name in said}

    def edit(out: Any) -> None:
        out.scales, out.offsets = (own.get("scale", 1.0),), (own.get("offset", 0.0),)
        out.units = (own.get("units", ""),)
        out.update_tags(1, **own.get("tags", {}))
        out.descriptions = (own.get("description", ""),)

    return tif(path, values, GRID, said.pop("crs", "EPSG:32632"), edit, **said)


def scenario(folder: Path, **keys: Any) -> Path:
    (folder / "s.yaml").write_text(yaml.safe_dump(keys))
    return folder / "s.yaml"


def bare(folder: Path) -> str:
    """A map without threats on GRID."""
    return tif(folder / "map.tif", np.zeros((4, 6), dtype=np.float32), GRID, "EPSG:32632").name


def ramp(degrees: float, unit: float = 1.0) -> np.ndarray:
    """Heights `[4, 6]` that rise eastwards by so many degrees, in units of so many metres."""
    return np.tile(np.arange(6) * 10 * math.tan(math.radians(degrees)) / unit, (4, 1))


SCALED = [
    (0, {"scale": 0.01, "offset": 0.05}, 0.05),
    (51, {"scale": 1 / 255}, 0.2),
    (7, {"units": "%"}, 0.07),
    (70, {"units": "Percent", "scale": 0.1}, 0.07),
    (20, {"units": "\u2030"}, 0.02),
    (20, {"units": "0.001"}, 0.02),
    (7, {"tags": {"units": "percent"}}, 0.07),
    (0, {"units": "probability", "offset": 0.25}, 0.25),
    (0.25, {"crs": "EPSG:32632+6360"}, 0.25),  # the unit of heights, which GDAL takes for the band's
]


@pytest.mark.parametrize(("number", "said", "p"), SCALED)
def test_a_map_of_probabilities_is_what_its_file_says(tmp_path: Path, number: float, said: dict, p: float) -> None:
    """Scale, offset and unit: read everywhere where chances are."""
    dtype = np.uint8 if isinstance(number, int) else np.float32
    path = says(tmp_path / "p.tif", np.full((4, 6), number, dtype=dtype), **said)
    assert (load_input(path).threat == np.float32(p)).all()
    keys: dict[str, Any] = {"map": bare(tmp_path), "threats": [{"raster": "p.tif"}]}
    assert (load_input(scenario(tmp_path, **keys)).threat == np.float32(p)).all()
    world = load_input(scenario(tmp_path, map="map.tif", detect=[{"raster": "p.tif"}]))
    assert world.detect == pytest.approx(np.full((4, 6), p))
    world = load_input(scenario(tmp_path, map="map.tif", latent_hazard={"kind": "persistent", "q": 0.5, "h": "p.tif"}))
    assert world.threat == pytest.approx(np.full((4, 6), p / 2))
    is_scaled = bool({"scale", "offset"} & said.keys())
    assert is_scaled == any("* number" in note and note.startswith("latent_hazard.h") for note in world.notes)
    world = load_input(scenario(tmp_path, map="map.tif", map_uncertainty={"maps": ["p.tif", "map.tif"]}))
    assert world.threat == pytest.approx(np.full((4, 6), p / 2))


def test_doses_and_values_are_what_their_files_say(tmp_path: Path) -> None:
    """A rule counts in the raster's own unit, which a note names; values are amounts."""
    dose = np.zeros((4, 6), dtype=np.int16)
    dose[0, 0] = 100
    says(tmp_path / "dose.tif", dose, scale=0.1, units="mSv/h")
    rules = (
        ({"kind": "exposure", "rate": 0.01}, -math.expm1(-0.1)),
        ({"kind": "linear", "scale": 0.03}, 0.3),
        ({"kind": "classes", "edges": [9.5, 50], "p": [0, 0.4, 0.8]}, 0.4),
    )
    for rule, p in rules:
        path = scenario(tmp_path, map=bare(tmp_path), threats=[{"raster": "dose.tif", "rule": rule}])
        world = load_input(path)
        assert world.threat[0, 0] == pytest.approx(p) and not world.threat[1:].any()
        assert any("mSv/h" in note for note in world.notes) and any("0.1 * number" in note for note in world.notes)
    says(tmp_path / "percent.tif", dose, units="%")
    rule = {"kind": "linear", "scale": 0.005}
    path = scenario(tmp_path, map="map.tif", threats=[{"raster": "percent.tif", "rule": rule}])
    assert load_input(path).threat[0, 0] == np.float32(0.5)  # of a rule, percent is a unit as any other
    says(tmp_path / "value.tif", dose, scale=0.5, offset=1, units="EUR")
    world = load_input(scenario(tmp_path, map="map.tif", value=[{"raster": "value.tif"}]))
    assert world.value is not None and world.value[0].tolist() == [51, 1, 1, 1, 1, 1]
    assert "value[0]: its values are in EUR" in world.notes


@pytest.mark.parametrize("units", ["mSv/h", "m", "dB", "bananas"])
def test_a_unit_that_is_not_understood_is_named(tmp_path: Path, units: str) -> None:
    says(tmp_path / "p.tif", np.zeros((4, 6), dtype=np.float32), units=units)
    for path in (tmp_path / "p.tif", scenario(tmp_path, map=bare(tmp_path), threats=[{"raster": "p.tif"}])):
        with pytest.raises(MapError, match=rf"p\.tif: its values are in '{units}', read as probabilities; expected no"):
            load_input(path)
    if units != "m":
        with pytest.raises(MapError, match=rf"'{units}', read as heights; expected m, dm"):
            load_input(scenario(tmp_path, map={"elevation": "p.tif"}))


def test_packed_numbers_that_only_the_metadata_tell_of(tmp_path: Path) -> None:
    """NetCDF's items, left by a converter that may have unpacked the numbers, or not: nobody knows."""
    path = says(tmp_path / "p.tif", np.ones((4, 6), dtype=np.uint8), tags={"scale_factor": "0.1"})
    with pytest.raises(MapError, match=r"scale_factor = 0\.1, its band the scale 1; .*gdal_edit"):
        load_input(path)
    path = says(tmp_path / "p.tif", np.ones((4, 6), dtype=np.uint8), scale=0.1, tags={"scale_factor": "0.1"})
    assert (load_input(path).threat == np.float32(0.1)).all()
    with pytest.raises(MapError, match=r"0 \* number"):
        load_input(says(tmp_path / "p.tif", np.ones((4, 6), dtype=np.uint8), scale=0.0))


HEIGHTS = [
    ({"scale": 0.1}, 0.1, np.int16),
    ({"scale": 0.01, "offset": -100}, 0.01, np.int32),
    ({"units": "US survey foot"}, US_FOOT, np.float32),
    ({"units": "ft"}, 0.3048, np.float32),
    ({"units": "feet", "scale": 0.5}, 0.1524, np.int16),
    ({"units": "cm"}, 0.01, np.int32),
    ({"units": "m a.s.l."}, 1.0, np.float32),
    ({"crs": "EPSG:32632+6360"}, US_FOOT, np.float32),
    ({"crs": "EPSG:32632+8228"}, 0.3048, np.float32),
    ({"crs": "EPSG:32632+5703"}, 1.0, np.float32),
    ({"crs": "EPSG:32632+5715"}, -1.0, np.float32),  # depths
]


@pytest.mark.parametrize(("said", "unit", "dtype"), HEIGHTS)
def test_heights_are_metres_before_slopes_are_taken(tmp_path: Path, said: dict, unit: float, dtype: type) -> None:
    offset = said.get("offset", 0.0)
    for degrees, free in ((20, 24), (45, 0)):
        heights = ramp(degrees)
        numbers = (heights - offset) / unit
        numbers = np.rint(numbers) if np.dtype(dtype).kind == "i" else numbers
        says(tmp_path / "dem.tif", numbers.astype(dtype), **said)
        raster = read_elevation(tmp_path / "dem.tif")
        assert raster.values == pytest.approx(heights, abs=0.51 * abs(unit) if np.dtype(dtype).kind == "i" else 1e-4)
        path = scenario(tmp_path, map={"elevation": "dem.tif", "max_slope_deg": 28})
        if free:
            assert load_input(path).free.sum() == free
        else:
            with pytest.raises(MapError, match="every pixel of 10 m is steeper than 28 degrees"):
                load_input(path)


def test_units_of_heights_that_contradict_each_other_or_are_presumed(tmp_path: Path) -> None:
    says(tmp_path / "dem.tif", ramp(20), crs="EPSG:32632+6360", units="m")
    with pytest.raises(MapError, match="heights are in 'm', but its CRS counts heights in 'US survey foot'"):
        read_elevation(tmp_path / "dem.tif")
    tif(tmp_path / "dem.tif", ramp(20), (10, 0, 500, 0, -10, 900), "EPSG:2263")
    assert any("CRS is in US survey foot" in note for note in read_elevation(tmp_path / "dem.tif").notes)


UNITS = [
    ({}, "Elevation (feet)", 0.3048),
    ({}, "Height [US survey foot]", US_FOOT),
    ({}, "DEM (m)", 1.0),
    ({}, "Elevation (NAVD88)", 1.0),
    ({"VERTICAL_UNITS": "feet"}, "", 0.3048),
    ({"VERTICAL_UNITS": "centimeters"}, "Heights", 0.01),
]


@pytest.mark.parametrize(("tags", "description", "unit"), UNITS)
def test_units_of_heights_in_words(tmp_path: Path, tags: dict, description: str, unit: float) -> None:
    says(tmp_path / "dem.tif", ramp(20), tags=tags, description=description)
    assert read_elevation(tmp_path / "dem.tif").values == pytest.approx(ramp(20) * unit)


def test_units_of_probabilities_in_words(tmp_path: Path) -> None:
    """And heights are no probabilities; what contradicts itself is refused."""
    for description, p in (("probability (%)", 0.0025), ("risk [per mille]", 0.00025), ("risk (2024)", 0.25)):
        path = says(tmp_path / "p.tif", np.full((4, 6), 0.25, np.float32), description=description)
        assert load_input(path).threat == pytest.approx(p)
    says(tmp_path / "p.tif", np.full((4, 6), 0.25, np.float32), tags={"VERTICAL_UNITS": "feet"})
    assert load_input(tmp_path / "p.tif").threat == pytest.approx(0.25)
    says(tmp_path / "p.tif", np.full((4, 6), 0.25, np.float32), description="Elevation (feet)")
    with pytest.raises(MapError, match="values are in 'feet', read as probabilities"):
        load_input(tmp_path / "p.tif")
    says(tmp_path / "dem.tif", ramp(20), units="m", description="Elevation (feet)")
    with pytest.raises(MapError, match="names two units, 'm' and 'feet'"):
        read_elevation(tmp_path / "dem.tif")


@pytest.mark.parametrize(("zunits", "unit"), [("FEET", 0.3048), ("METERS", 1.0), ("100", 0.01), ("NO", 1.0)])
def test_units_of_heights_in_an_old_prj(tmp_path: Path, zunits: str, unit: float) -> None:
    (tmp_path / "dem.asc").write_text(
        "ncols 3\nnrows 2\nxllcorner 500000\nyllcorner 5000000\ncellsize 10\n0 5 9\n0 0 0\n"
    )
    (tmp_path / "dem.prj").write_text(
        f"Projection UTM\nZone 32\nDatum WGS84\nZunits {zunits}\nUnits METERS\nParameters\n"
    )
    assert read_elevation(tmp_path / "dem.asc").values[0] == pytest.approx(np.array([0, 5, 9]) * unit)


VOIDS = [
    (-9999, np.float32, {}),
    (-9999.9, np.float32, {}),
    (-32768, np.int16, {}),
    (32767, np.int16, {"scale": 0.1}),
    (-9999, np.int16, {"scale": 0.1}),
    (-9999 / 0.3048, np.float32, {"units": "ft"}),
    (-3.4028234663852886e38, np.float32, {}),
    (-1.7976931348623157e308, np.float64, {}),
    (-10_000, np.int16, {}),
    (30_000, np.float32, {"units": "ft"}),  # 9,144 m
    (9_001, np.float32, {}),
    (-12_001, np.float32, {}),
    (np.inf, np.float32, {}),
    (4242, np.float32, {"tags": {"_FillValue": "4242"}}),
]


@pytest.mark.parametrize(("void", "dtype", "said"), VOIDS)
def test_voids_that_no_file_declares_are_no_ground(tmp_path: Path, void: float, dtype: type, said: dict) -> None:
    heights = np.zeros((4, 6), dtype=dtype)
    heights[1:3, 2:5] = void
    says(tmp_path / "dem.tif", heights, **said)
    world = load_input(scenario(tmp_path, map={"elevation": "dem.tif", "max_slope_deg": 28}))
    assert np.array_equal(world.free, heights == 0)
    assert any(note.startswith("6 pixels of ") and "edit-info --nodata" in note for note in world.notes)
    says(tmp_path / "dem.tif", heights, nodata=void, **said)
    world = load_input(scenario(tmp_path, map={"elevation": "dem.tif", "max_slope_deg": 28}))
    assert np.array_equal(world.free, heights == 0) and not any("6 pixels" in note for note in world.notes)


def test_heights_in_no_metres_that_say_no_unit(tmp_path: Path) -> None:
    """Millimetres: too many different heights for marks of no data, so the note names the other remedy."""
    says(tmp_path / "dem.tif", ramp(20) * 1000)
    with pytest.raises(MapError, match=r"steeper than 28 degrees.*12 pixels of .* \.\. .*unit if they are no metres"):
        load_input(scenario(tmp_path, map={"elevation": "dem.tif", "max_slope_deg": 28}))


def test_heights_that_are_none_of_these_stay(tmp_path: Path) -> None:
    """The deepest sea, the highest mountain, and the largest number where another one is declared to be no data."""
    numbers = np.array([[-10_935, 8_849, -999, 32767, -1]], dtype=np.int16)
    says(tmp_path / "dem.tif", numbers, scale=0.1, nodata=-1)
    raster = read_elevation(tmp_path / "dem.tif")
    assert raster.values[0, :4] == pytest.approx(numbers[0, :4] / 10) and np.isnan(raster.values[0, 4])
    says(tmp_path / "dem.tif", numbers[:, :3])
    assert read_elevation(tmp_path / "dem.tif").values.tolist() == numbers[:, :3].tolist()


def test_voids_of_amounts_are_unknown(tmp_path: Path) -> None:
    """Whatever the size of the mark: a value of 1e10 is one, and -10000 may be."""
    for void in (-1.7976931348623157e308, 1.7976931348623157e308, 1e39):
        says(tmp_path / "v.tif", np.array([[void, 1e10, -10_000.0]]))
        values = read_raster(tmp_path / "v.tif", of=AMOUNTS).values[0]
        assert np.isnan(values[0]) and values[1:].tolist() == [1e10, -10_000]


def test_voids_of_arrays(tmp_path: Path) -> None:
    np.save(tmp_path / "dem.npy", np.where(np.eye(4), -9999.0, 5.0))
    world = load_input(scenario(tmp_path, map={"elevation": "dem.npy"}))
    assert np.array_equal(world.free, np.eye(4) == 0)
    assert any("4 pixels of -9999" in note and "write nan there" in note for note in world.notes)


VOIDS_OF_P = [
    (-9999, np.float32),
    (-32768, np.int16),
    (1e20, np.float64),
    (-1.7976931348623157e308, np.float64),
    (255, np.uint8),
]


@pytest.mark.parametrize(("void", "dtype"), VOIDS_OF_P)
def test_voids_of_probabilities_are_unknown(tmp_path: Path, void: float, dtype: type) -> None:
    """As a map they are obstacles; under a free cell of another map they are an error that counts them."""
    p = np.zeros((4, 6), dtype=dtype)
    p[0, :2] = void
    path = says(tmp_path / "p.tif", p, scale=0.01)
    world = load_input(path)
    assert np.array_equal(world.free, p == 0) and any(note.startswith("2 pixels of ") for note in world.notes)
    rules = ({}, {"rule": {"kind": "classes", "edges": [0.5], "p": [0.1, 0.2]}})
    for rule in rules[: 1 if dtype is np.uint8 else 2]:  # 255 may be a class
        path = scenario(tmp_path, map=bare(tmp_path), threats=[{"raster": "p.tif"} | rule])
        said = r"p\.tif, which is nan \(no data\) at \[0, 0\] \(2 such cells\) \(2 pixels"
        with pytest.raises(ScenarioError, match=said):
            load_input(path)


def test_no_data_is_compared_before_numbers_are_scaled(tmp_path: Path) -> None:
    numbers = np.array([[10, 20, 30]], dtype=np.uint8)
    raster = read_raster(says(tmp_path / "p.tif", numbers, scale=0.01, nodata=20))
    assert raster.values[0, [0, 2]].tolist() == [0.1, 0.3] and np.isnan(raster.values[0, 1])
    raster = read_raster(says(tmp_path / "p.tif", numbers, scale=2, offset=-10, nodata=10), of=AMOUNTS)
    assert np.isnan(raster.values[0, 0]) and raster.values[0, 1:].tolist() == [30, 50]  # 20 becomes 30, no data is 10


def test_a_scale_that_a_file_beside_says(tmp_path: Path) -> None:
    """GDAL's `.aux.xml`, of an `.asc`, which can hold none itself."""
    (tmp_path / "p.asc").write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 10\n1 2\n3 4\n")
    band = '<PAMRasterBand band="1"><UnitType>%</UnitType><Offset>3</Offset><Scale>0.5</Scale></PAMRasterBand>'
    (tmp_path / "p.asc.aux.xml").write_text(f"<PAMDataset>{band}</PAMDataset>")
    assert read_raster(tmp_path / "p.asc").values == pytest.approx(np.array([[0.035, 0.04], [0.045, 0.05]]))


@pytest.mark.parametrize("values", [np.zeros(4), np.zeros((2, 3, 4)), np.zeros((0, 3)), np.zeros((2, 2), complex)])
def test_arrays_that_are_no_raster(tmp_path: Path, values: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(MapError, match=r"a\.npy"):
        read_raster(tmp_path / "a.npy")


def test_jacksboro_is_32_by_30_km_with_north_at_the_top() -> None:
    raster = jacksboro(400)
    assert raster.frame.size == pytest.approx(400 / 6)
    assert raster.values.shape == (477, 450)
    assert 236 <= raster.values.min() < raster.values.max() <= 1076
    assert jacksboro().values.shape[1] == 403  # its narrower side stays


def test_elevation_scenarios_refuse_what_makes_no_sense(tmp_path: Path) -> None:
    np.save(tmp_path / "dem.npy", np.zeros((4, 6)))
    np.save(tmp_path / "inf.npy", np.full((4, 6), np.inf))
    np.save(tmp_path / "nan.npy", np.full((4, 6), np.nan))
    wrong = [
        ({"elevation": "dem.npy", "max_slope_deg": 0}, "max_slope_deg` is 0"),
        ({"elevation": "dem.npy", "max_slope_deg": 91}, "91"),
        ({"elevation": "dem.npy", "resolution": -1}, "resolution` is -1"),
        ({"elevation": "gone.npy"}, "no such file"),
        ({"elevation": "inf.npy"}, "no elevation at all: 24 pixels of inf"),
        ({"elevation": "nan.npy"}, "no elevation at all"),
        ({"elevation": "builtin:jacksborough"}, "did you mean 'builtin:jacksboro'"),
        ({"elevation": "builtin:jacksboro", "resolution": 5}, "resolution"),
        ({"elevation": "dem.npy", "file": "dem.npy"}, "not both file and elevation"),
        ({"max_slope_deg": 30}, "expected one of file, elevation, polygons"),
        ({"file": "dem.npy", "max_slope_deg": 30}, "max_slope_deg"),
    ]
    for ground, names in wrong:
        with pytest.raises(InputError) as caught:
            load_input(scenario(tmp_path, map=ground))
        assert names in str(caught.value)


# Samples of a survey interpolated over a map, held against a kriging system of its own, and every way to be none.

RANDOM = np.random.default_rng(3)
SAMPLES = np.column_stack([RANDOM.uniform((0, 0), (30, 20), (40, 2)), RANDOM.uniform(1, 9, 40)])
RULE = {"kind": "exposure", "rate": 0.02}


def survey(folder: Path, samples: NDArray[np.float64] | list[Any], header: str = "x_m,y_m,counts,rate_cps") -> None:
    """Rows of x, y, something else, value."""
    lines = [f"{x!r},{y!r},7,{value!r}" for x, y, value in np.asarray(samples, dtype=float).tolist()]
    (folder / "survey.csv").write_text("\n".join([header, *lines]) + "\n")


def scenario_samples(folder: Path, **source: Any) -> World:
    given = {"points": "survey.csv", "strength": "rate_cps", "rule": RULE} | source
    source = {key: value for key, value in given.items() if value is not None}
    np.savez(folder / "grid.npz", threat=np.zeros((10, 15), dtype=np.float32), cell_size=2.0)
    return load_input(scenario(folder, map="grid.npz", threats=[source]))


def values(world: World) -> NDArray[np.float64]:
    """What was interpolated, from p = 1 - exp(-rate * value)."""
    return -np.log1p(-world.threat.astype(np.float64)) / RULE["rate"]


def centres() -> NDArray[np.float64]:
    rows, cols = np.meshgrid(np.arange(10), np.arange(15), indexing="ij")
    return np.stack([2 * cols + 1, 2 * (9 - rows) + 1], axis=-1).reshape(-1, 2).astype(float)


def kriged(samples: NDArray[np.float64], places: NDArray[np.float64], nugget: float) -> NDArray[np.float64]:
    """The textbook's system: variogram h, less the error's variance on the diagonal, weights of sum 1."""
    count = len(samples)
    system = np.ones((count + 1, count + 1))
    between = np.linalg.norm(samples[:, None, :2] - samples[None, :, :2], axis=2)
    system[:count, :count], system[count, count] = between - nugget * np.eye(count), 0
    right = np.ones((count + 1, len(places)))
    right[:count] = np.linalg.norm(samples[:, None, :2] - places[None, :, :], axis=2)
    return samples[:, 2] @ np.linalg.solve(system, right)[:count]


@pytest.mark.parametrize("nugget", [None, 3.0])
def test_kriging_is_the_textbooks(tmp_path: Path, nugget: float | None) -> None:
    survey(tmp_path, SAMPLES)
    how = {"kind": "kriging"} | ({} if nugget is None else {"nugget": nugget})
    world = scenario_samples(tmp_path, interpolate=how)
    expected = np.clip(kriged(SAMPLES, centres(), nugget or 0.0), SAMPLES[:, 2].min(), SAMPLES[:, 2].max())
    np.testing.assert_allclose(values(world).ravel(), expected, rtol=2e-6)
    assert any("threats[0]: 40 samples, interpolated; the farthest free cell is" in note for note in world.notes)


@pytest.mark.parametrize(("power", "near"), [(None, None), (1.0, 3), (3.0, 40)])
def test_inverse_distances(tmp_path: Path, power: float | None, near: int | None) -> None:
    """Also of a sample in the very centre of a cell, which has its value."""
    samples = np.vstack([SAMPLES, [5.0, 3.0, 8.5]])
    survey(tmp_path, samples)
    asked = {"power": power, "neighbours": near}
    how = {"kind": "idw"} | {key: value for key, value in asked.items() if value is not None}
    found = values(scenario_samples(tmp_path, interpolate=how))
    distance = np.linalg.norm(centres()[:, None, :] - samples[None, :, :2], axis=2)
    for place, away in enumerate(distance):
        order = np.argsort(away)[: near or 12]
        weight = np.maximum(away[order], 1e-12) ** -(power or 2.0)
        expected = weight @ samples[order, 2] / weight.sum()
        assert found.ravel()[place] == pytest.approx(expected, rel=2e-6)
    assert found[8, 2] == pytest.approx(8.5, rel=2e-6)


@pytest.mark.parametrize("kind", ["idw", "kriging"])
def test_samples_at_one_place_count_as_their_mean(tmp_path: Path, kind: str) -> None:
    survey(tmp_path, [[5, 5, 2.0], [5, 5, 4.0]])
    np.testing.assert_allclose(values(scenario_samples(tmp_path, interpolate={"kind": kind})), 3.0, rtol=2e-6)


def test_columns_by_name(tmp_path: Path) -> None:
    """As the scenario says, whatever they are called; the error names those that there are."""
    survey(tmp_path, SAMPLES, "Easting,Northing,n,dose")
    survey_of = {"x": "Easting", "y": "northing", "strength": "dose", "interpolate": {"kind": "idw"}}
    named = scenario_samples(tmp_path, **survey_of)
    survey(tmp_path, SAMPLES)
    np.testing.assert_array_equal(named.threat, scenario_samples(tmp_path, interpolate={"kind": "idw"}).threat)
    (tmp_path / "survey.csv").write_text("east,north,p\n5,5,0.5\n")
    disc = {"falloff": {"kind": "disc", "radius": 1.5}, "rule": None}
    world = scenario_samples(tmp_path, x="east", y="north", strength="p", **disc)
    assert world.threat[7, 2] == 0.5 and (world.threat > 0).sum() == 1


HEADER = "x_m,y_m,counts,rate_cps\n"


NO_SURVEYS = [
    (HEADER + "1,1,2,3\n", {"strength": None}, "expected x, y and strength; name it in the scenario: "
     "`strength: counts | rate_cps`"),
    (HEADER + "1,1,2,3\n", {"strength": "rate"}, "expected 'rate' among them (strength)"),
    (HEADER + "1,1,2,3\n", {"strength": "rate_cp"}, "did you mean 'rate_cps'?"),
    (HEADER + "1,1,2,3\n", {"strength": 3}, "the name of a column"),
    ("1,1,3\n", {}, "has no header"),
    (HEADER, {}, "has a header and no points"),
    ("", {}, "is empty"),
    (HEADER + "1,1,2,\n", {}, "line 2: strength is ''"),
    (HEADER + "1,1,2,nan\n", {}, "line 2: strength is 'nan'"),
    (HEADER + "1,1,2,-3\n", {}, "values must not be negative"),
    (HEADER + "1,1,2,3\n", {"rule": None}, "gives p = 3"),
    (HEADER + "600000,1,2,3\n", {}, "and the map is 30 x 20 m from (0, 0)"),
    (HEADER + "11.57549,48.13743,2,3\n", {}, "reproject it into metres of the map's frame"),
    ("lon,lat,rate_cps\n11.5,48.1,3\n", {}, "expected x, y in metres"),
    (HEADER + "1,1,2,3\n" * 131_073, {}, "at most 131072 points"),
    (HEADER + "".join(f"{n % 64}.5,{n // 64}.5,2,3\n" for n in range(2100)), {}, "up to 2048"),
    (HEADER + "1,1,2,3\n", {"interpolate": {"kind": "spline"}}, "expected idw or kriging"),
    (HEADER + "1,1,2,3\n", {"interpolate": {"kind": "idw", "nugget": 3}}, "`threats[0].interpolate.nugget`"),
    (HEADER + "1,1,2,3\n", {"interpolate": {"kind": "idw", "power": -1}}, "a number above 0"),
    (HEADER + "1,1,2,3\n", {"falloff": {"kind": "disc", "radius": 2}}, "none with interpolate"),
    (HEADER + "1,1,2,.3\n", {"interpolate": None, "falloff": {"kind": "disc", "radius": 2}}, "none with falloff"),
    (HEADER + "1,1,2,3\n", {"interpolate": None}, "interpolate: {kind: idw | kriging}"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "source", "said"), NO_SURVEYS)
def test_what_is_no_survey(tmp_path: Path, text: str, source: dict[str, Any], said: str) -> None:
    (tmp_path / "survey.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        scenario_samples(tmp_path, **({"interpolate": {"kind": "kriging"}} | source))
    assert said in str(caught.value) and "\n" not in str(caught.value)
