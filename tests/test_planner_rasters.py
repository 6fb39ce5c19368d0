"""Rasters on the ground: GeoTIFF, degrees and oblong pixels made square metres, and the elevation model that ships."""

from __future__ import annotations

import builtins
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from planner.errors import InputError, MapError, ScenarioError
from planner.worlds.elevation import jacksboro
from planner.worlds.georeference import degree_sides
from planner.worlds.rasters import read_raster, square_metres
from planner.worlds.scenario import load_input


def tif(path: Path, values: np.ndarray, transform: tuple[float, ...] = (), crs: str | None = None, **more: Any) -> Path:
    """A GeoTIFF; `transform`: (pixel width, 0, left, 0, -pixel height, top)."""
    rasterio = pytest.importorskip("rasterio")
    affine = pytest.importorskip("affine")
    keys = {"height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": values.dtype, "crs": crs} | more
    if transform:
        keys["transform"] = affine.Affine(*transform)
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(path, "w", driver="GTiff", **keys) as out:
            out.write(values, 1)
    return path


VALUES = np.arange(35, dtype=np.float32).reshape(5, 7) / 100


def test_square_metres_in_a_projection(tmp_path: Path) -> None:
    raster = read_raster(tif(tmp_path / "a.tif", VALUES, (10, 0, 500, 0, -10, 900), "EPSG:32633"))
    assert raster.values.tolist() == VALUES.astype(float).tolist()
    assert raster.frame is not None
    assert raster.frame.size == 10
    assert raster.frame.origin == (500, 850, 0)
    world = load_input(tmp_path / "a.tif")
    assert world.threat.tolist() == VALUES.tolist()
    assert world.to_xy(0).tolist() == [505, 895]


def test_south_up_is_turned_and_feet_become_metres(tmp_path: Path) -> None:
    raster = read_raster(tif(tmp_path / "a.tif", VALUES, (10, 0, 500, 0, 10, 850), "EPSG:2263"))
    assert raster.values.tolist() == VALUES[::-1].astype(float).tolist()
    assert raster.frame is not None
    assert raster.frame.size == pytest.approx(10 * 1200 / 3937)
    assert raster.frame.origin[1] == pytest.approx(850 * 1200 / 3937)


def test_no_data_is_an_obstacle_and_an_error_under_a_free_cell(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[1, 2] = -9999
    tif(tmp_path / "a.tif", values, (10, 0, 0, 0, -10, 50), "EPSG:32633", nodata=-9999)
    assert np.argwhere(~load_input(tmp_path / "a.tif").free).tolist() == [[1, 2]]
    tif(tmp_path / "map.tif", VALUES, (10, 0, 0, 0, -10, 50), "EPSG:32633")
    scenario = {"map": {"file": "map.tif"}, "threats": [{"raster": "a.tif"}]}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(scenario))
    with pytest.raises(ScenarioError, match=r"nan \(no data\) at \[1, 2\]"):
        load_input(tmp_path / "s.yaml")


def test_degrees_too_wide_for_utm_become_square_metres(tmp_path: Path) -> None:
    """Rows and columns of the file, the upper-left corner where it was."""
    step = 0.5
    values = np.add.outer(np.arange(40.0), np.zeros(50)).astype(np.float32) / 100
    path = tif(tmp_path / "a.tif", values, (step, 0, 10.0, 0, -step, 70.0), "EPSG:4326")
    raster = read_raster(path, cell_size=100_000)
    north, east = degree_sides(60.0)
    assert raster.frame is not None
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
    scenario = {"map": {"elevation": "dem.tif"}, "threats": [{"raster": "dose.tif"}]}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(scenario))
    with pytest.raises(ScenarioError, match="data on the ground of the map"):
        load_input(tmp_path / "s.yaml")
    tif(tmp_path / "dose.tif", VALUES, (10, 0, 500, 0, -10, 900), "EPSG:32633")
    assert load_input(tmp_path / "s.yaml").threat.tolist() == VALUES.tolist()


def test_elevation_and_dose_in_degrees_stay_aligned(tmp_path: Path) -> None:
    place = (0.001, 0, 10.0, 0, -0.001, 60.04)
    dose = np.zeros((40, 50), dtype=np.float32)
    dose[20:, :] = 0.25
    tif(tmp_path / "dem.tif", np.zeros((40, 50), dtype=np.float32), place, "EPSG:4326")
    tif(tmp_path / "dose.tif", dose, place, "EPSG:4326")
    scenario = {"map": {"elevation": "dem.tif"}, "cell_size": 200, "threats": [{"raster": "dose.tif"}]}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(scenario))
    world = load_input(tmp_path / "s.yaml")
    assert world.shape == (22, 14)
    assert world.free.sum() > 0.7 * 22 * 14  # the meridian leans by a cell in the zone's metres
    assert set(np.unique(world.threat[world.free])) == {0.0, 0.25}
    north = world.to_lonlat(world.at(*(np.argwhere(world.free) + 0.5).T))[:, 1]
    threat = world.threat[world.free]
    assert (threat[north < 60.018] == 0.25).all() and not threat[north > 60.022].any()


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"transform": (10, 2, 0, 0, -10, 50)}, "rotated"),
        ({"transform": (-10, 0, 0, 0, -10, 50)}, "rotated"),
        ({"transform": (10, 0, 0, 0, -10, 95), "crs": "EPSG:4326"}, "latitudes"),
    ],
)
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


def test_without_rasterio_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.tif").write_bytes(b"II*\0")
    real = builtins.__import__

    def no_rasterio(name: str, *args: Any, **keys: Any) -> Any:
        if name.startswith("rasterio"):
            raise ImportError(name)
        return real(name, *args, **keys)

    monkeypatch.setattr(builtins, "__import__", no_rasterio)
    with pytest.raises(MapError, match=r"mrac-jax\[geo\]"):
        read_raster(tmp_path / "a.tif")


@pytest.mark.parametrize("values", [np.zeros(4), np.zeros((2, 3, 4)), np.zeros((0, 3)), np.zeros((2, 2), complex)])
def test_arrays_that_are_no_raster(tmp_path: Path, values: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(MapError, match=r"a\.npy"):
        read_raster(tmp_path / "a.npy")


def test_jacksboro_is_32_by_30_km_with_north_at_the_top() -> None:
    raster = jacksboro(400)
    assert raster.frame is not None
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
        (tmp_path / "s.yaml").write_text(yaml.safe_dump({"map": ground}))
        with pytest.raises(InputError) as caught:
            load_input(tmp_path / "s.yaml")
        assert names in str(caught.value)
