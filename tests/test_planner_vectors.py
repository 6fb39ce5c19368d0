"""Shapefiles and GeoPackages: the cells that their polygons hold, in any CRS, and every way to be no such file."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from test_planner_rasters import tif

from planner.errors import InputError
from planner.world.scenario import load_input

pytest.importorskip("rasterio")
pyogrio = pytest.importorskip("pyogrio")
pyproj = pytest.importorskip("pyproj")
LEFT, TOP, SIDE = 500_000.0, 5_761_038.0, 10.0
"""Of a map of 20 x 30 cells in UTM zone 33."""
KINDS = ("shp", "gpkg")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    tif(tmp_path / "m.tif", np.zeros((20, 30), dtype=np.float32), (SIDE, 0, LEFT, 0, -SIDE, TOP), "EPSG:32633")
    return tmp_path


def box(top: int, left: int, bottom: int, right: int) -> NDArray[np.float64]:
    """A closed ring around cells `[top:bottom, left:right]`, x and y."""
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
    return corners * (SIDE, -SIDE) + (LEFT, TOP)


def polygon(*rings: NDArray[np.float64]) -> bytes:
    """A Polygon in WKB."""
    body = b"".join(struct.pack("<I", len(ring)) + ring.astype("<f8").tobytes() for ring in rings)
    return struct.pack("<BII", 1, 3, len(rings)) + body


def multi(*polygons: bytes) -> bytes:
    return struct.pack("<BII", 1, 6, len(polygons)) + b"".join(polygons)


def write(path: Path, shapes: list[bytes | None], p: list[float], crs: str | None = "EPSG:32633", **more: Any) -> Path:
    """The polygons with a field `p`, by GDAL's writer."""
    keys = {"geometry_type": "MultiPolygon", "crs": crs, "fields": ["p"]} | more
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # files without a CRS are meant
        pyogrio.raw.write(path, np.array(shapes, dtype=object), [np.array(p)], **keys)
    return path


def threat(folder: Path, **source: Any) -> NDArray[np.float32]:
    (folder / "s.yaml").write_text(yaml.safe_dump({"map": "m.tif"} | source))
    return load_input(folder / "s.yaml").threat


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326", "EPSG:25832"])
def test_polygons_with_holes_in_any_crs(folder: Path, kind: str, crs: str) -> None:
    """Two features, the second of two parts; pyproj puts the corners into the file's CRS."""
    there = pyproj.Transformer.from_crs("EPSG:32633", crs, always_xy=True)
    rings = [
        np.stack(there.transform(*box(*edges).T), -1)
        for edges in ((2, 3, 12, 20), (4, 5, 8, 9), (14, 1, 18, 4), (13, 22, 19, 29))
    ]
    shapes = [multi(polygon(rings[0], rings[1])), multi(polygon(rings[2]), polygon(rings[3]))]
    path = write(folder / f"a.{kind}", shapes, [0.125, 0.5], crs)
    expected = np.zeros((20, 30), dtype=np.float32)
    expected[2:12, 3:20], expected[4:8, 5:9], expected[14:18, 1:4], expected[13:19, 22:29] = 0.125, 0, 0.5, 0.5
    np.testing.assert_array_equal(threat(folder, threats=[{"polygons": path.name}]), expected)
    kept_out = threat(folder, keepout=[{"polygons": path.name}])
    np.testing.assert_array_equal(np.isnan(kept_out), expected > 0)


@pytest.mark.parametrize("kind", KINDS)
def test_fields_and_maps_without_a_place(folder: Path, kind: str) -> None:
    """A number beside the file where it has none; an upper-case field; metres of a map that is nowhere on the Earth."""
    shapes = [multi(polygon(box(2, 3, 12, 20)))]
    write(folder / f"a.{kind}", shapes, [0.25], fields=["P"])
    assert (threat(folder, threats=[{"polygons": f"a.{kind}"}]) == 0.25).sum() == 170
    write(folder / f"b.{kind}", shapes, [np.nan])
    assert (threat(folder, threats=[{"polygons": f"b.{kind}", "p": 0.5}]) == 0.5).sum() == 170
    np.save(folder / "n.npy", np.zeros((20, 30), dtype=np.float32))
    write(folder / f"c.{kind}", [multi(polygon((box(2, 3, 12, 20) - (LEFT, TOP)) / SIDE + (0, 20)))], [0.25], None)
    found = threat(folder, map="n.npy", threats=[{"polygons": f"c.{kind}"}])
    assert (found[2:12, 3:20] == 0.25).all() and (found > 0).sum() == 170


@pytest.mark.parametrize("kind", KINDS)
def test_threats_are_named_as_the_file_names_them(folder: Path, kind: str) -> None:
    shapes = [multi(polygon(box(2, 3, 12, 20))), multi(polygon(box(14, 1, 18, 4)))]
    names, numbers = np.array(["quarry", None], dtype=object), np.array([0.25, 0.5])
    pyogrio.raw.write(
        folder / f"a.{kind}",
        np.array(shapes, dtype=object),
        [names, numbers],
        geometry_type="MultiPolygon",
        crs="EPSG:32633",
        fields=["NAME", "p"],
    )
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
    rings = [multi(polygon(box(2, 3, 12, 20)))] * 200
    whole = {kind: write(folder / f"w.{kind}", rings, [0.25] * 200) for kind in KINDS}
    for part in ("shp", "shx", "dbf"):
        for end in ("shp", "shx", "dbf", "prj"):
            shutil.copy(folder / f"w.{end}", folder / f"a.{end}")
        data = (folder / f"w.{part}").read_bytes()
        for cut, words in (
            (len(data) // 2, "claims"),
            (20, "is no part of|is cut off"),
            (0, "is no part of|is cut off"),
        ):
            (folder / f"a.{part}").write_bytes(data[:cut])
            assert any(word in wrong(folder, "a.shp") for word in words.split("|"))
    (folder / "a.shx").unlink()
    shutil.copy(folder / "w.shp", folder / "a.shp")
    assert "there is no a.shx beside it" in wrong(folder, "a.shp")
    data = whole["gpkg"].read_bytes()
    for cut in (len(data) // 2, len(data) - 4096, 50):
        (folder / "a.gpkg").write_bytes(data[:cut])
        assert "is damaged" in wrong(folder, "a.gpkg")


def test_files_of_another_kind(folder: Path) -> None:
    vrt = b'<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>/vsicurl/http://x/</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>'
    for data in (b"", b"hello", b"PK\3\4" + bytes(100), vrt):
        (folder / "a.gpkg").write_bytes(data)
        assert "is no database of SQLite" in wrong(folder, "a.gpkg")
        for end in ("shp", "shx"):
            (folder / f"a.{end}").write_bytes(data)
        assert "is no part of a shapefile" in wrong(folder, "a.shp")
    (folder / "a.gpkg").unlink()
    with contextlib.closing(sqlite3.connect(folder / "a.gpkg")) as database:
        database.execute("CREATE TABLE t (x)")
    assert "has no table gpkg_contents" in wrong(folder, "a.gpkg")
    line = struct.pack("<BII", 1, 2, 2) + np.array([[LEFT, TOP], [LEFT + 50, TOP - 50]]).tobytes()
    for kind in KINDS:
        write(folder / f"l.{kind}", [line], [0.25], geometry_type="LineString")
        assert "geometry is 'LineString'; expected Polygon or MultiPolygon" in wrong(folder, f"l.{kind}")
        write(folder / f"n.{kind}", [None], [0.25])
        assert "features[0]: geometry is 'none'" in wrong(folder, f"n.{kind}")
    pyogrio.raw.write(folder / "t.gpkg", None, [np.array([0.25])], ["p"], driver="GPKG")
    assert "has no layer with places" in wrong(folder, "t.gpkg")
    (folder / "a.zip").write_bytes(b"PK")
    assert "no polygons are read from '.zip'; expected .geojson .json .kml .gpx .csv .shp .gpkg" in wrong(
        folder, "a.zip"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_that_are_wrong(folder: Path, kind: str) -> None:
    """No CRS; metres said to be degrees; one ring of each; the neighbour's zone; numbers that are no places."""
    good, name = box(2, 3, 12, 20), f"a.{kind}"
    write(folder / name, [multi(polygon(good))], [0.25], None)
    assert any(
        words in wrong(folder, name) for words in ("names no coordinate reference system", "no way from the CRS")
    )
    degrees = np.stack(pyproj.Transformer.from_crs(32633, 4326, always_xy=True).transform(*good.T), -1)
    for rings in ([good], [degrees, good]):
        write(folder / name, [multi(*map(polygon, rings))], [0.25], "EPSG:4326")
        assert f"a point at longitude {good[0, 0]:g}, latitude {good[0, 1]:g}" in wrong(folder, name)
    write(folder / name, [multi(polygon(good))], [0.25], "EPSG:32632")
    assert "threatens nothing" in wrong(folder, name)
    write(folder / name, [multi(polygon(np.where(good == good[0, 0], 1e300, good)))], [0.25])
    assert "wrong coordinates" in wrong(folder, name)


@pytest.mark.parametrize("key", ["p", "value", "detect"])
def test_text_in_a_column_of_numbers_is_no_zero(folder: Path, key: str) -> None:
    """GDAL reads such text as 0, and the threat would be gone: the second feature's is named, whatever it is of."""
    shapes = [multi(polygon(box(2, 3, 12, 20))), multi(polygon(box(14, 1, 18, 4)))]
    numbers = np.array([0.25, 0.5])
    write(folder / "a.gpkg", shapes, numbers, fields=[key.upper()])
    write(folder / "a.shp", shapes, numbers, fields=[key])
    table = (folder / "a.dbf").read_bytes()
    for end in ("shp", "shx", "prj"):
        shutil.copy(folder / f"a.{end}", folder / f"b.{end}")
    for word in ("red", "", "0,3", "abcde", "0.3m"):
        shutil.copy(folder / "a.gpkg", folder / "b.gpkg")
        with contextlib.closing(sqlite3.connect(folder / "b.gpkg")) as database:
            for (trigger,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f'DROP TRIGGER "{trigger}"')
            database.execute(f"UPDATE a SET {key} = ? WHERE fid = 2", (word,))
            database.commit()
        (folder / "b.dbf").write_bytes(table.replace(b"0.500000000000000", f"{word:>17}".encode()))
        for name in ("b.gpkg", "b.shp"):
            said = f"'{word}', which is no number" if word or name == "b.gpkg" else "missing"
            with pytest.raises(InputError, match=rf"{name}: features\[1\]: property {key} is {said}"):
                threat(folder, **{"threats" if key == "p" else key: [{"polygons": name}]})


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_that_are_fine_or_not_there(folder: Path, kind: str) -> None:
    """In a field that comes second; an empty one takes the default; text of a record that is deleted is nobody's."""
    shapes = [multi(polygon(box(2, 3, 12, 20))), multi(polygon(box(14, 1, 18, 4))), multi(polygon(box(0, 0, 1, 1)))]
    pyogrio.raw.write(
        folder / f"a.{kind}", np.array(shapes, dtype=object), [np.array([7, 8, 9]), np.array([np.nan, 0.5, 0.75])],
        geometry_type="MultiPolygon", crs="EPSG:32633", fields=["row", "p"],
    )  # fmt: skip
    if kind == "shp":
        table = bytearray((folder / "a.dbf").read_bytes())
        skip, each = struct.unpack_from("<HH", table, 8)
        table[skip + 2 * each : skip + 2 * each + 1] = b"*"
        (folder / "a.dbf").write_bytes(table.replace(b"0.750000000000000", b"far too high many"))
    found = threat(folder, threats=[{"polygons": f"a.{kind}", "p": 0.125}])
    assert (found == 0.125).sum() == 170 and (found == 0.5).sum() == 12
    assert (found == 0.75).sum() == (kind == "gpkg")


def test_hostile_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A table that claims two thousand million rows; views and columns that compute; more corners than are drawn."""
    shapes = [multi(polygon(box(2, 3, 12, 20)))]
    write(folder / "a.shp", shapes, [0.25])
    table = bytearray((folder / "a.dbf").read_bytes())
    table[4:8] = struct.pack("<I", 2**31 - 1)
    (folder / "a.dbf").write_bytes(table)
    assert "a.dbf claims" in wrong(folder, "a.shp")
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


def test_without_the_library_the_fix_is_said(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder / "a.gpkg", [multi(polygon(box(2, 3, 12, 20)))], [0.25])
    monkeypatch.setitem(__import__("sys").modules, "pyogrio", None)
    assert "reading .gpkg needs pyogrio; pip install 'mrac-jax[geo]', or convert to GeoJSON" in wrong(folder, "a.gpkg")
