"""The band of a raster file: its numbers as physical values, and the ways in which files give its position."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import library_errors
from planner.formatting import counted
from planner.world.frame import TURN, WGS84, Bounds, Frame, Georeference, near, no_way, reproject, same_crs, turn_of
from planner.world.image_files import plausible

# Meaning of the numbers of a raster: scale, offset and unit, and undeclared no-data values.

LOWEST, HIGHEST = -12_000.0, 9_000.0
"""Metres: all ground on Earth lies between them."""
FILL = (-9999, -99999, -999999, -32767, -32768, -(2**31), -(2**63))
"""Numbers that files use for no data, in any type of number."""
OWN_FILL = {True: -10_000, False: -999}
"""One more if none is declared: for heights (True), and for all else; a sea may be 999 m deep."""
NEAR = 1.0
"""Largest distance of a number from the first of FILL: -9999.9 and -9999.25 are in use."""
HUGE = 1e20
"""Magnitude from which on a finite number means no data: 1e20, 9.97e36, the largest float32 and float64."""
MOST_NAMED = 2
"""Different numbers that a note names."""
SAME_UNIT = 1e-5
"""Relative difference of two units up to which they are the same: a foot and a US survey foot differ by 2e-6."""
NO_UNIT = ("", "none", "unknown", "n a")

METRE = {"": 1.0, "deci": 0.1, "centi": 0.01, "milli": 0.001, "kilo": 1000.0}
LENGTHS = {
    **dict.fromkeys(NO_UNIT, 1.0),
    **{f"{prefix}{metre}": size for prefix, size in METRE.items() for metre in ("metre", "metres", "meter", "meters")},
    **{f"{prefix[:1]}m": size for prefix, size in METRE.items()},
    **dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet", "ft int", "intl ft"), 0.3048),
    **{
        f"{before}{foot}{after}": 1200 / 3937
        for foot in ("foot", "feet", "ft")
        for before, after in (
            ("us survey ", ""), ("survey ", ""), ("us ", ""), ("us", ""), ("", "us"), ("", " us"), ("", " us survey"),
        )
    },
    **dict.fromkeys(("yd", "yard", "yards"), 0.9144),
    **dict.fromkeys(("fathom", "fathoms"), 1.8288),
}  # fmt: skip
"""Metres of each unit of height, by its name in lower case without punctuation (`plain`)."""
SHARES = {
    **dict.fromkeys(NO_UNIT, 1.0),
    **dict.fromkeys(("1", "0 1", "unity", "unitless", "dimensionless", "fraction", "ratio"), 1.0),
    **dict.fromkeys(("probability", "probabilities", "chance", "p"), 1.0),
    **dict.fromkeys(("%", "percent", "per cent", "percents", "percentage", "pct"), 0.01),
    **dict.fromkeys(("‰", "per mille", "permille", "promille", "per mil", "permil", "per thousand"), 0.001),
    **dict.fromkeys(("ppm", "parts per million"), 1e-6),
}
"""Size of each unit of probability, by its name in the same form."""


class Meaning(NamedTuple):
    """Kind of quantity in a raster.

    Attributes:
        name: for messages.
        units: factor of each accepted unit, by its plain name; None: any unit.
        expected, fix: for the error about another unit.
    """

    name: str
    units: Mapping[str, float] | None = None
    expected: str = ""
    fix: str = ""


PROBABILITIES = Meaning(
    "probabilities", SHARES, "no unit, 1, percent, per mille or ppm",
    "heights are given as `map: {elevation: ...}`, measured values by `raster:` and a `rule`",
)  # fmt: skip
HEIGHTS = Meaning(
    "heights", LENGTHS, "m, dm, cm, mm, km, ft, US survey foot, yard or fathom", "convert it, or correct its unit"
)
AMOUNTS = Meaning("amounts")
"""Measured values, which a rule turns into probabilities, and values of cells: in any unit."""


class Unit(NamedTuple):
    """Unit of heights of a coordinate reference system: metres per unit; negative: depths, downwards."""

    name: str
    size: float


class Metadata(NamedTuple):
    """Metadata on a file's numbers: value = scale * number + offset, in `unit`.

    Attributes:
        vertical: the unit of heights of its coordinate reference system, or None.
        fill: numbers that the metadata name as no data, but that readers do not mask.
        declared: whether no data is declared in a way that readers know.
    """

    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    vertical: Unit | None = None
    fill: tuple[float, ...] = ()
    declared: bool = False


class Physical(NamedTuple):
    """Values float64 `[H, W]` (NaN = no data), notes, and a description of undeclared voids ("": none)."""

    values: NDArray[np.float64]
    notes: tuple[str, ...]
    voids: str


def plain(unit: str) -> str:
    """A unit's name in lower case without punctuation: `U.S. survey foot` and `us-survey-foot` are the same."""
    words = re.sub(r"[\s._()\[\]-]+", " ", unit.casefold()).strip()
    return re.sub(r" (above|asl|a s l|amsl|msl|over)( .*)?$", "", re.sub(r"\bu s\b", "us", words))


def physical(raw: NDArray, known: NDArray[np.bool_], said: Metadata, of: Meaning, source: str) -> Physical:
    """Physical values of a file's numbers: probabilities 0..1, metres, amounts.

    Numbers that look like no data, but are not declared as such, become NaN too (`Physical.voids`).

    Args:
        raw: `[H, W]`, the numbers.
        known: bool `[H, W]`, numbers that are not masked.
        said: metadata.
        of: kind of quantity.
        source: for messages.

    Raises:
        MapError: an unknown unit, or an invalid scale.
    """
    if not (math.isfinite(said.scale) and math.isfinite(said.offset) and said.scale != 0):
        problem = f"declares values {said.scale:g} * number + {said.offset:g}"
        raise MapError(problem, source=source, expected="a finite scale other than 0, and a finite offset")
    factor, unit_notes = _factor(said, of, source)
    is_scaled = (said.scale, said.offset) != (1, 0)
    with np.errstate(over="ignore", invalid="ignore"):  # long doubles; infinite numbers
        numbers = raw.astype(np.float64)
        scaled = numbers * said.scale + said.offset if is_scaled else numbers
        values = scaled / (1 / factor) if factor != 1 else scaled  # divided by 100 for percent: 7 % are exactly 0.07
    void = known & _voids(raw, (numbers, scaled, values), said, of)
    notes = unit_notes
    if is_scaled:
        added = f" + {said.offset:g}" if said.offset else ""
        notes = (f"by its metadata, its values are {said.scale:g} * number{added}", *notes)
    return Physical(np.where(known & ~void, values, np.nan), notes, _describe(numbers[void], of, source))


def _factor(said: Metadata, of: Meaning, source: str) -> tuple[float, tuple[str, ...]]:
    """The factor of the values, and notes."""
    name, vertical = plain(said.unit), said.vertical
    own = None if vertical is None else plain(vertical.name)
    if of is not HEIGHTS and name == own:
        name = ""  # GDAL reports the vertical unit of the CRS as that of every band
    if of.units is None:
        return 1.0, () if name in NO_UNIT else (f"its values are in {said.unit}",)
    if of is HEIGHTS and vertical is not None:
        size = of.units.get(name) if name not in (own, *NO_UNIT) else abs(vertical.size)
        if size is None or abs(size / abs(vertical.size) - 1) > SAME_UNIT:
            problem = f"its heights are in {said.unit!r}, but its CRS counts heights in {vertical.name!r}"
            raise MapError(problem, source=source, expected="one unit", fix=of.fix)
        return vertical.size, _unit_note(vertical.name, vertical.size)
    factor = of.units.get(name)
    if factor is None and of is PROBABILITIES and re.fullmatch(r"[0-9.]+(e-?[0-9]+)?", said.unit.strip().casefold()):
        factor = float(said.unit)  # as UDUNITS writes percent: 0.01
    if not factor:
        problem = f"its values are in {said.unit!r}, read as {of.name}"
        raise MapError(problem, source=source, expected=of.expected, fix=of.fix)
    return factor, _unit_note(said.unit, factor) if of is HEIGHTS else ()


def _unit_note(unit: str, size: float) -> tuple[str, ...]:
    if size == 1:
        return ()
    return (f"its heights are in {unit}, {size:.7g} m each" if size > 0 else f"its values are depths, in {unit}",)


def _voids(raw: NDArray, stages: tuple[NDArray[np.float64], ...], said: Metadata, of: Meaning) -> NDArray[np.bool_]:
    """bool `[H, W]`: no-data numbers. `stages`: the file's numbers, scaled, and in the unit of `of`."""
    numbers, scaled, values = stages
    void = (np.abs(numbers) >= HUGE) & np.isfinite(numbers)
    fill = FILL if said.declared else (*FILL, OWN_FILL[of is HEIGHTS])
    for stage in {id(stage): stage for stage in (numbers, scaled, values)}.values():
        low = stage < max(fill) + NEAR
        if low.any():
            void[low] |= np.isin(stage[low], fill) | (np.abs(stage[low] - FILL[0]) < NEAR)
    if raw.dtype.kind in "iu" and not said.declared and (raw.dtype.itemsize > 1 or of is PROBABILITIES):
        void |= numbers == float(np.iinfo(raw.dtype).max)
    if of is HEIGHTS:
        void |= (values < LOWEST) | (values > HIGHEST)
    if of is PROBABILITIES:
        void &= (values < 0) | (values > 1)
    return void | np.isin(numbers, said.fill)


def _describe(numbers: NDArray[np.float64], of: Meaning, source: str) -> str:
    """Description of voids by their numbers in the file; "" if there are none."""
    if not numbers.size:
        return ""
    which = np.unique(numbers)
    many = len(which) > MOST_NAMED
    named = f"{which[0]:.7g} .. {which[-1]:.7g}" if many else ", ".join(f"{number:.7g}" for number in which)
    what = "a mark of no data" + ", or no height on Earth" * (of is HEIGHTS)
    return (
        f"{counted(numbers.size, 'pixel')} of {named}, {what}, count as no data though none is declared; declare it "
        f"({edited(source, '--nodata', f'{which[0]:.17g}')}), or the unit if they are no metres, or write nan there"
    )


def edited(source: str, option: str, value: str) -> str:
    """The rasterio command that sets metadata of a GeoTIFF."""
    name = re.split(r"[\\/]", source)[-1]
    return f"`rio edit-info {option} {value} {name}`"


# Rasters laid over other grids by their positions on the Earth, as GDAL warps them.

How = Literal["average", "sum", "bilinear", "nearest"]
"""Value of a new pixel: the mean over its area (probabilities), the sum over its area, by the share of each pixel
(amounts), the linear value at its centre (elevations), or the pixel under its centre (classes). No data is always
decided by the nearest pixel."""
WORDS: dict[How, str] = {"average": "averaged", "sum": "summed up", "bilinear": "linear", "nearest": "nearest"}
STRIP = 32
"""Columns warped at a time: GDAL approximates a stretch of a row as straight, up to an eighth of a pixel off."""
LATTICE = 21
"""Places per side at which the edges of a raster with control points are evaluated."""
SQUARE = 1e-6
"""Relative difference of a pixel's sides up to which it is square."""


class Band(NamedTuple):
    """A raster as in its file, north up.

    Attributes:
        values: float64 `[H, W]`, physical values; NaN = no data.
        bounds: its edges in its CRS, or None if not given. crs: or None.
        points: ground control points that place its pixels; (): pixels fill the bounds evenly.
        notes: effects of reading that a user should know. voids: description of undeclared voids.
    """

    values: NDArray[np.float64]
    bounds: Bounds | None
    crs: Any
    points: tuple[Any, ...] = ()
    notes: tuple[str, ...] = ()
    voids: str = ""


def side_of_pixels(shortest: float, cell_size: float | None) -> float:
    """The largest whole part of `cell_size` that does not exceed the `shortest` side of a pixel; metres."""
    if cell_size is None or cell_size <= shortest:
        return shortest
    return cell_size / math.ceil(cell_size / shortest - SQUARE)


def affine(frame: Frame, place: Georeference) -> tuple[float, ...]:
    """(a, b, c, d, e, f): pixel (col, row) is at x = a col + b row + c, y = d col + e row + f in the CRS."""
    corner, right, down = place.to_crs(frame.at([0, 0, 1], [0, 1, 0]))
    (a, d), (b, e) = right - corner, down - corner
    return tuple(map(float, (a, b, corner[0], d, e, corner[1])))


def edges_in(bounds: Bounds, crs: Any, target: str, source: str) -> Bounds:
    """The rectangle (left, bottom, right, top) in the CRS `target` around `bounds`.

    Raises:
        MapError: the edges cannot be transformed.
    """
    from rasterio.warp import transform_bounds

    with no_way(crs, target, source):
        edges: Bounds = transform_bounds(crs, target, *bounds)
        if not np.isfinite(edges).all():
            raise ValueError("its edges are nowhere in it")
    return edges


def span(
    points: Sequence[Any], shape: tuple[int, int], crs: Any, target: str, source: str
) -> tuple[Bounds, tuple[float, float]]:
    """Position of a raster with ground control points in another CRS.

    Args:
        points: ground control points.
        shape: (H, W).
        crs: of the points.
        target: the other CRS.
        source: for messages.

    Returns:
        (edges (left, bottom, right, top), mean sides of a pixel (height, width)), in units of `target`.

    Raises:
        MapError: the points cannot be transformed.
    """
    import rasterio.warp

    rows, cols = (ends.ravel() for ends in np.meshgrid(*(np.linspace(0, n, LATTICE) for n in shape), indexing="ij"))
    with no_way(crs, target, source), rasterio.transform.GCPTransformer(points) as places:
        found = np.stack(places.xy(rows.tolist(), cols.tolist(), offset="ul"), axis=-1)
    found = reproject(found, crs.to_string(), target, source)
    down, right, _ = np.linalg.lstsq(np.stack([rows, cols, np.ones(rows.shape)], axis=-1), found, rcond=None)[0]
    (left, bottom), (east, top) = found.min(axis=0).tolist(), found.max(axis=0).tolist()
    return (left, bottom, east, top), (float(np.hypot(*down)), float(np.hypot(*right)))


def _off_the_seam(band: Band, place: Georeference, source: str) -> Band:
    """A raster whose x continues across the seam of its CRS, in a CRS with the seam elsewhere; unchanged otherwise.

    GDAL requests places only on the other side of the seam, except for degrees without control points.
    """
    assert band.bounds is not None
    crs, points = band.crs, band.points
    turn = turn_of(crs.to_string())[0]
    if not turn or same_crs(crs.to_string(), place.crs) or (crs.is_geographic and not points):
        return band
    text = crs.to_dict(projjson=True)
    text = text.get("source_crs", text)
    origins = [item for item in text.get("conversion", {}).get("parameters", []) if "ongitude" in item["name"]]
    middle = 0.0 if crs.is_geographic else sum(item["value"] for item in origins)
    middle = float(reproject([middle, 0.0], WGS84, crs.to_string(), source)[0])
    if max(abs(band.bounds[0] - middle), abs(band.bounds[2] - middle)) <= turn / 2 or len(origins) > 1:
        return band
    from rasterio.crs import CRS

    moved = -turn / 2
    if crs.is_geographic:
        about = (band.bounds[0] + band.bounds[2]) / 2
        crs = CRS.from_string(f"+proj=longlat +datum=WGS84 +lon_wrap={about:.6f} +no_defs +type=crs")
        found = reproject([[point.x, point.y] for point in points], band.crs.to_string(), WGS84, source)
        found[:, 0] = near(found[:, 0], about, TURN)
    else:
        for item in origins:
            item["value"] = float(near(item["value"] + TURN / 2, 0.0, TURN))
        text.pop("id", None)
        text["name"] = "about its own middle"  # else GDAL takes it for the CRS of the old name
        crs = CRS.from_user_input(json.dumps(text))
        found = np.array([[point.x + moved, point.y] for point in points])
    points = tuple(
        type(point)(point.row, point.col, *xy, point.z) for point, xy in zip(points, found.tolist(), strict=True)
    )
    left, bottom, right, top = band.bounds
    return band._replace(crs=crs, points=points, bounds=(left + moved, bottom, right + moved, top))


def lay_over(band: Band, frame: Frame, place: Georeference, how: How, source: str) -> NDArray[np.float64]:
    """Resample a raster on the pixels of a frame.

    Positions are PROJ's within 0.02 pixels of the file (0.06 for pixels of kilometres). XSCALE is given, since GDAL
    would estimate the ratio of pixels strip by strip, and blur.

    Args:
        band: the raster.
        frame: of the new pixels.
        place: position of the frame on the Earth.
        how: resampling.
        source: for messages.

    Returns:
        float64 `[H, W]`; NaN outside of the raster, or for no data.

    Raises:
        MapError: its CRS cannot be transformed.
    """
    import rasterio.warp

    band = _off_the_seam(band, place, source)
    assert band.bounds is not None
    left, bottom, right, top = band.bounds
    rows, cols = band.values.shape
    a, b, c, d, e, f = affine(frame, place)
    laid = np.empty(frame.shape)
    evenly = rasterio.Affine((right - left) / cols, 0, left, 0, (bottom - top) / rows, top)
    keys = {
        **({"gcps": band.points} if band.points else {"src_transform": evenly}),
        "src_crs": band.crs, "src_nodata": math.nan, "dst_crs": place.crs, "dst_nodata": math.nan,
    }  # fmt: skip
    for start in range(0, frame.shape[1], STRIP):
        keys["dst_transform"] = rasterio.Affine(a, b, c + a * start, d, e, f + d * start)
        strip = laid[:, start : start + STRIP]
        for method in dict.fromkeys((how, "nearest")):
            part = np.full(strip.shape, math.nan)
            keys["resampling"] = rasterio.warp.Resampling[method]
            with no_way(band.crs, place.crs, source):
                rasterio.warp.reproject(band.values, part, XSCALE=1, YSCALE=1, **keys)
            if method == how:
                strip[:] = part
            else:
                strip[np.isnan(part)] = math.nan
    return laid


EXACT = 0.1
"""Largest distance, in pixels, of control points from a north-up grid that replaces them, without resampling."""
PACKED = {"scale_factor": "scale", "add_offset": "offset"}
"""NetCDF metadata of packed numbers, and the names that a band has for them."""
FILL_TAGS = ("_fillvalue", "missing_value")
"""Metadata that name a number for no data."""
UNIT_TAGS = ("units", "unit", "vertical_units", "vertical_unit", "z_units")
"""Metadata that name the unit; from the third on, of heights only."""
UNPLACED = {
    "RPC": ("rational polynomials (RPCs)", "gdalwarp -rpc -to RPC_DEM=dem.tif"),
    "GEOLOCATION": ("a geolocation array", "gdalwarp -geoloc"),
}
"""Metadata of positions that are not supported: description, and a command that warps such a raster."""
FINE, DEGREES = 0.005, 180.0
"""Pixels smaller than FINE metres within DEGREES of (0, 0) are assumed to be degrees if the file names no CRS."""
Place = tuple[Bounds | None, tuple[Any, ...], tuple[str, ...]]
"""Bounds, control points (none: the bounds suffice), notes."""


def read_band(path: Path, of: Meaning) -> Band:
    """Read the band of a GeoTIFF or an Arc/Info ASCII grid.

    Args:
        path: the file.
        of: kind of quantity.

    Raises:
        MapError: it cannot be read, or its unit or position is not supported.
    """
    import rasterio

    driver = "AAIGrid" if path.suffix.lower() == ".asc" else "GTiff"
    with library_errors("cannot be read as a raster", path, "GeoTIFF"), rasterio.open(path, driver=driver) as data:
        plausible(data.width * data.height, path)
        if data.count != 1 or np.dtype(data.dtypes[0]).kind not in "fiu":
            problem = f"{data.count} bands of {data.dtypes[0]}"
            raise MapError(problem, source=path, expected="one band of real numbers")
        crs, vertical = _split(data.crs or data.gcps[1] or _crs_beside(path, data), path)
        said = _metadata(data, vertical, of, path)
        numbers = data.read(1, masked=True)
        bounds, points, notes = _place(data, crs, path)
        if not data.transform.is_identity and data.transform.e > 0:  # stored south-up
            numbers = numbers[::-1]
    values, more, voids = physical(np.ma.getdata(numbers), ~np.ma.getmaskarray(numbers), said, of, str(path))
    feet = crs is not None and crs.is_projected and crs.linear_units_factor[1] != 1
    if of is HEIGHTS and feet and said.vertical is None and plain(said.unit) in NO_UNIT:
        unit, command = crs.linear_units_factor[0], edited(str(path), "--units", "ft")
        more += (f"its heights are read as metres: they name no unit, though its CRS is in {unit} (if not: {command})",)
    return Band(values, bounds, crs, points, (*notes, *more), voids)


def _metadata(data: Any, vertical: Unit | None, of: Meaning, path: Path) -> Metadata:
    """Metadata on the file's numbers. Raises MapError if band and metadata contradict each other."""
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
    return Metadata(own["scale"], own["offset"], unit, vertical, fill, declared)


def _unit(data: Any, tags: dict[str, str], of: Meaning, path: Path) -> str:
    """The unit in a band's metadata or description; "": none. Raises MapError if two of them differ.

    A description ends in it, in brackets: `Elevation (feet)`. Other text in brackets is a remark.
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


def _split(crs: Any, path: Path) -> tuple[Any, Unit | None]:
    """The horizontal part of a CRS, and its unit of heights, if any.

    Vertical axes are read from PROJJSON: rasterio reports horizontal ones only.
    """
    if crs is None:
        return None, _vertical_beside(path)
    whole = crs.to_dict(projjson=True)
    parts = _bare(whole).get("components", [whole])
    upright = [axis for axis in _bare(parts[-1])["coordinate_system"]["axis"] if axis["direction"] in ("up", "down")]
    if len(parts) > 1:
        crs = type(crs).from_user_input(json.dumps(parts[0]))
    if not upright:
        return crs, _vertical_beside(path)
    unit = upright[0].get("unit", "metre")
    name, size = (unit["name"], unit["conversion_factor"]) if isinstance(unit, dict) else (unit, 1.0)
    return crs, Unit(name, -size if upright[0]["direction"] == "down" else size)


def _bare(part: dict[str, Any]) -> dict[str, Any]:
    """A CRS in PROJJSON, without a bound transformation."""
    bare: dict[str, Any] = part.get("source_crs", part)
    return bare


def _beside(path: Path) -> str:
    """Text of the `.prj` file of a raster; "" if there is none, or if it belongs to a shapefile."""
    for suffix in (".prj", ".PRJ"):
        beside = path.with_suffix(suffix)
        if beside.is_file() and not path.with_suffix(".shp").exists():
            return beside.read_text(encoding="utf-8", errors="replace")[: 2**14]
    return ""


def _crs_beside(path: Path, data: Any) -> Any:
    """The CRS in the `.prj` file of a raster without one: GDAL only reads those of `.asc` files."""
    text = "" if data.transform.is_identity or path.suffix.lower() == ".asc" else _beside(path)
    if not text:
        return None
    from rasterio.crs import CRS

    with library_errors("its .prj file cannot be read", path, "a CRS in WKT"):
        return CRS.from_wkt(text, morph_from_esri_dialect=True)


def _vertical_beside(path: Path) -> Unit | None:
    """The unit of heights in the old form of `.prj`: `Zunits FEET`, or units per metre."""
    found = re.search(r"^\s*zunits\s+(\S+)", _beside(path), re.IGNORECASE | re.MULTILINE)
    if found is None or found[1].casefold() == "no":
        return None
    named = {"meters": ("metre", 1.0), "feet": ("foot", 0.3048)}.get(found[1].casefold())
    many = _number(found[1], 0.0)
    if named is None and not many > 0:
        problem = f"its .prj file names Zunits {found[1][:20]}"
        raise MapError(problem, source=path, expected="METERS, FEET, NO, or how many make a metre")
    return Unit(*named) if named else Unit(f"1 / {many:g} m", 1 / many)


def _place(data: Any, crs: Any, path: Path) -> Place:
    """Position of the band. Raises MapError for a form that is not supported."""
    transform, (points, _) = data.transform, data.gcps
    if not transform.is_identity:
        if transform.b or transform.d or not transform.a > 0 or not np.isfinite(transform).all():
            raise MapError("is rotated or mirrored", source=path, fix="warp it north-up first (gdalwarp)")
        bottom = min(transform.f, transform.f + data.height * transform.e)
        right, top = transform.c + data.width * transform.a, bottom + data.height * abs(transform.e)
        bounds = (transform.c, bottom, right, top)
        if crs is None:
            return bounds, (), _without_crs(bounds, transform.a, path)
        elsewhere = "its CRS names no place on the Earth: its coordinates are read as those of a local frame"
        return bounds, (), () if crs.is_projected or crs.is_geographic else (elsewhere,)
    if points:
        return _by_points(points, crs, data.shape, path)
    for domain, (words, command) in UNPLACED.items():
        if data.tags(ns=domain):
            raise MapError(f"is placed by {words}, not read here", source=path, fix=f"warp it first ({command})")
    return None, (), ()


def _without_crs(bounds: Bounds, side: float, path: Path) -> tuple[str, ...]:
    """A note on a position without CRS. Raises MapError if it looks like degrees."""
    if side < FINE and max(map(abs, bounds)) <= DEGREES:
        fix = f"say it: {edited(str(path), '--crs', 'EPSG:4326')}"
        problem = f"names no CRS, and pixels of {side:g} at {bounds[0]:g}, {bounds[1]:g} look like degrees"
        raise MapError(problem, source=path, expected="a CRS", fix=fix)
    return ("its coordinates are read as metres of a local frame: it names no CRS",)


def _by_points(points: list[Any], crs: Any, shape: tuple[int, int], path: Path) -> Place:
    """Position by ground control points: a north-up grid if they lie on one, else the points for a warp."""
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
