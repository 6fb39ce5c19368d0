"""The one band of a raster file: its numbers as physical values, and all the ways in which a file gives their place."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from planner.errors import MapError
from planner.files import foreign_errors
from planner.shown import counted
from planner.worlds.georeference import near, rasterio_for, turn_of
from planner.worlds.grid import Bounds
from planner.worlds.images import plausible
from planner.worlds.physical import HEIGHTS, LENGTHS, NO_UNIT, SAME_UNIT, Meaning, Said, Unit, edited, physical, plain
from planner.worlds.warp import Band, span

EXACT = 0.1
"""Pixels that control points may lie off a north-up grid that is then taken for their place, without resampling."""
PACKED = {"scale_factor": "scale", "add_offset": "offset"}
"""Items of metadata that NetCDF packs numbers by, and what a band calls them."""
FILL_TAGS = ("_fillvalue", "missing_value")
"""Items of metadata that name a number for no data."""
UNIT_TAGS = ("units", "unit", "vertical_units", "vertical_unit", "z_units")
"""Items of metadata that name the unit; from the third on, of heights alone."""
UNPLACED = {
    "RPC": ("rational polynomials (RPCs)", "gdalwarp -rpc -to RPC_DEM=dem.tif"),
    "GEOLOCATION": ("a geolocation array", "gdalwarp -geoloc"),
}
"""Domains of metadata that give a place which is not read: in words, and the command that warps such a raster."""
FINE, DEGREES = 0.005, 180.0
"""Pixels below so many metres, within so many of (0, 0), are taken for degrees where the file names no CRS."""
Place = tuple[Bounds | None, tuple[Any, ...], tuple[str, ...]]
"""Bounds, control points (none: the bounds say it all), notes."""


def read_band(path: Path, of: Meaning) -> Band:
    """The band of a GeoTIFF or an Arc/Info ASCII grid. Raises MapError, also for a unit or a place that is not read."""
    rasterio = rasterio_for(f"reading {path.suffix}", path, fix=", or convert to .npy")
    driver = "AAIGrid" if path.suffix.lower() == ".asc" else "GTiff"
    with foreign_errors("cannot be read as a raster", path, "GeoTIFF"), rasterio.open(path, driver=driver) as data:
        plausible(data.width * data.height, path)
        if data.count != 1 or np.dtype(data.dtypes[0]).kind not in "fiu":
            problem = f"{data.count} bands of {data.dtypes[0]}"
            raise MapError(problem, source=path, expected="one band of real numbers")
        crs, vertical = _split(data.crs or data.gcps[1] or _crs_beside(path, data, rasterio), path, rasterio)
        said = _said(data, vertical, of, path)
        numbers = data.read(1, masked=True)
        bounds, points, notes = _place(data, crs, path)
        if not data.transform.is_identity and data.transform.e > 0:  # stored south-up
            numbers = numbers[::-1]
    values, more, voids = physical(np.ma.getdata(numbers), ~np.ma.getmaskarray(numbers), said, of, str(path))
    feet = crs is not None and crs.is_projected and crs.linear_units_factor[1] != 1
    if of is HEIGHTS and feet and said.vertical is None and plain(said.unit) in NO_UNIT:
        unit, command = crs.linear_units_factor[0], edited(str(path), "--units", "ft")
        more += (
            f"its heights are taken for metres: they name no unit, though its CRS is in {unit} (if not: {command})",
        )
    return Band(values, bounds, crs, points, (*notes, *more), voids)


def _said(data: Any, vertical: Unit | None, of: Meaning, path: Path) -> Said:
    """What the file says about its numbers. Raises MapError where the band and its metadata contradict each other."""
    tags = {name.casefold(): text for name, text in {**data.tags(), **data.tags(1)}.items()}
    own = {"scale": data.scales[0], "offset": data.offsets[0]}
    for tag, name in PACKED.items():
        packed = _number(tags.get(tag, ""), own[name])
        if packed != own[name]:
            problem = f"its metadata name {tag} = {packed:g}, its band the {name} {own[name]:g}"
            fix = f"set the band's {name} (gdal_edit.py -{name} {packed:g}), or take the item out"
            raise MapError(problem, source=path, expected="the same twice", fix=fix)
    fill = tuple(_number(tags[tag], math.nan) for tag in FILL_TAGS if tag in tags)
    unit = _unit(data, tags, of, path)
    declared = "all_valid" not in [flag.name for flag in data.mask_flag_enums[0]]
    return Said(own["scale"], own["offset"], unit, vertical, fill, declared)


def _unit(data: Any, tags: dict[str, str], of: Meaning, path: Path) -> str:
    """The unit that a band, its metadata or its description name; "": none. Raises MapError where two of them differ.

    A description ends in it, in brackets: `Elevation (feet)`. What is no unit there is a remark.
    """
    last = re.search(r"[(\[]([^()\[\]]+)[)\]]\s*$", data.descriptions[0] or "")
    remark = last[1] if last and plain(last[1]) in {**LENGTHS, **(of.units or {})} else ""
    named = [data.units[0] or "", *(tags.get(tag, "") for tag in UNIT_TAGS[: None if of is HEIGHTS else 2]), remark]
    said = [unit for unit in named if plain(unit) not in NO_UNIT]
    known = [(unit, of.units[plain(unit)]) for unit in said if of.units and plain(unit) in of.units]
    for unit, size in known[1:]:
        if abs(size / known[0][1] - 1) > SAME_UNIT:
            problem = f"it names two units, {known[0][0]!r} and {unit!r}"
            raise MapError(problem, source=path, expected="the same twice", fix=edited(str(path), "--units", unit))
    return next(iter(said), next(filter(None, named), ""))


def _number(text: str, otherwise: float) -> float:
    try:
        return float(text)
    except ValueError:
        return otherwise


def _split(crs: Any, path: Path, rasterio: Any) -> tuple[Any, Unit | None]:
    """The horizontal part of a CRS, and the unit that its heights are in, if it names one.

    Vertical axes are found in PROJJSON: rasterio tells of horizontal ones alone.
    """
    if crs is None:
        return None, _vertical_beside(path)
    whole = crs.to_dict(projjson=True)
    parts = _bare(whole).get("components", [whole])
    upright = [axis for axis in _bare(parts[-1])["coordinate_system"]["axis"] if axis["direction"] in ("up", "down")]
    if len(parts) > 1:
        crs = rasterio.crs.CRS.from_user_input(json.dumps(parts[0]))
    if not upright:
        return crs, _vertical_beside(path)
    unit = upright[0].get("unit", "metre")
    name, size = (unit["name"], unit["conversion_factor"]) if isinstance(unit, dict) else (unit, 1.0)
    return crs, Unit(name, -size if upright[0]["direction"] == "down" else size)


def _bare(part: dict[str, Any]) -> dict[str, Any]:
    """A CRS in PROJJSON, without the transformation that it may be bound to."""
    bare: dict[str, Any] = part.get("source_crs", part)
    return bare


def _beside(path: Path) -> str:
    """The text of the `.prj` beside a raster; "" where there is none, or it is a shapefile's."""
    for suffix in (".prj", ".PRJ"):
        beside = path.with_suffix(suffix)
        if beside.is_file() and not path.with_suffix(".shp").exists():
            return beside.read_text(encoding="utf-8", errors="replace")[: 2**14]
    return ""


def _crs_beside(path: Path, data: Any, rasterio: Any) -> Any:
    """The CRS in the `.prj` beside a raster that is placed but names none: GDAL reads those of `.asc` alone."""
    text = "" if data.transform.is_identity or path.suffix.lower() == ".asc" else _beside(path)
    if not text:
        return None
    with foreign_errors("the .prj beside it cannot be read", path, "a CRS in WKT"):
        return rasterio.crs.CRS.from_wkt(text, morph_from_esri_dialect=True)


def _vertical_beside(path: Path) -> Unit | None:
    """The unit of heights that the old kind of `.prj` names: `Zunits FEET`, or how many make a metre."""
    found = re.search(r"^\s*zunits\s+(\S+)", _beside(path), re.IGNORECASE | re.MULTILINE)
    if found is None or found[1].casefold() == "no":
        return None
    named = {"meters": ("metre", 1.0), "feet": ("foot", 0.3048)}.get(found[1].casefold())
    many = _number(found[1], 0.0)
    if named is None and not many > 0:
        problem = f"the .prj beside it names Zunits {found[1][:20]}"
        raise MapError(problem, source=path, expected="METERS, FEET, NO, or how many make a metre")
    return Unit(*named) if named else Unit(f"1 / {many:g} m", 1 / many)


def _place(data: Any, crs: Any, path: Path) -> Place:
    """Where the band lies. Raises MapError for a place that is given in a way that is not read."""
    transform, (points, _) = data.transform, data.gcps
    if not transform.is_identity:
        if transform.b or transform.d or not transform.a > 0 or not np.isfinite(transform).all():
            raise MapError("is rotated or mirrored", source=path, fix="warp it north-up first (gdalwarp)")
        bottom = min(transform.f, transform.f + data.height * transform.e)
        right, top = transform.c + data.width * transform.a, bottom + data.height * abs(transform.e)
        bounds = (transform.c, bottom, right, top)
        if crs is None:
            return bounds, (), _without_crs(bounds, transform.a, path)
        elsewhere = "its CRS names no place on the Earth: its coordinates are taken for those of a frame of its own"
        return bounds, (), () if crs.is_projected or crs.is_geographic else (elsewhere,)
    if points:
        return _by_points(points, crs, data.shape, path)
    for domain, (words, command) in UNPLACED.items():
        if data.tags(ns=domain):
            raise MapError(f"is placed by {words}, not read here", source=path, fix=f"warp it first ({command})")
    return None, (), ()


def _without_crs(bounds: Bounds, side: float, path: Path) -> tuple[str, ...]:
    """A note on a place in nobody's CRS. Raises MapError where it looks like degrees."""
    if side < FINE and max(map(abs, bounds)) <= DEGREES:
        fix = f"say it: {edited(str(path), '--crs', 'EPSG:4326')}"
        problem = f"names no CRS, and pixels of {side:g} at {bounds[0]:g}, {bounds[1]:g} look like degrees"
        raise MapError(problem, source=path, expected="a CRS", fix=fix)
    return ("its coordinates are taken for metres of a frame of its own: it names no CRS",)


def _by_points(points: list[Any], crs: Any, shape: tuple[int, int], path: Path) -> Place:
    """The place that ground control points give: a north-up grid if they lie on one, else they are warped by."""
    at = np.array([[point.col, point.row, 1.0] for point in points])
    if crs is not None and (turn := turn_of(crs.to_string())[0]):
        x = near([point.x for point in points], points[0].x, turn)  # across 180 neighbours stay neighbours
        points = [
            type(point)(point.row, point.col, float(to), point.y, point.z) for point, to in zip(points, x, strict=True)
        ]
    found = np.array([[point.x, point.y] for point in points])
    given = counted(len(points), "ground control point")
    if np.linalg.matrix_rank(at) < 3:
        raise MapError(f"is placed by {given}", source=path, expected="three or more, not in one line")
    if crs is None:
        raise MapError(
            "its ground control points name no CRS", source=path, fix="give them one (gdal_translate -a_srs)"
        )
    height, width = shape
    (a, d), (b, e), (left, top) = np.linalg.lstsq(at, found, rcond=None)[0].tolist()
    left, top = left + b * height / 2, top + d * width / 2
    off = np.abs(at @ [[a, 0], [0, e], [left, top]] - found)
    if a > 0 > e and (off <= EXACT * np.array([a, -e])).all():
        return (left, top + height * e, left + width * a, top), (), (f"placed by its {given}, on a north-up grid",)
    edges, _ = span(points, shape, crs, crs.to_string(), str(path))
    return edges, tuple(points), (f"placed by its {given}",)
