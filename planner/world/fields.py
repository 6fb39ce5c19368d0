"""A field as a map: polygons, cut into square cells, are what robots may drive on; all around them is obstacle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import foreign_errors
from planner.world.grid import (
    FREE,
    OCCUPIED,
    TURN,
    WGS84,
    WHOLE,
    Frame,
    Georeference,
    Grid,
    degree_sides,
    principal,
    rasterio_for,
    reproject,
    turn_of,
)
from planner.world.image_files import FULL, read_ros_map
from planner.world.keys import COORDINATE, Key
from planner.world.longitudes import Rings, Unrolled, check_range, closed, extent, fine, in_range, unrolled
from planner.world.points import inside, values_over
from planner.world.raster_files import describe, true_metres
from planner.world.vector_files import Shapes, read_polygons, read_shapes
from planner.world.world import MAX_CELLS

SUFFIXES = (".geojson", ".kml", ".gpx", ".shp", ".gpkg")
"""Files that are a field when they are given as a map; `map: {polygons: ...}` takes all that hold polygons."""
BOUNDARIES = ("whole", "centre")
"""Which cells are free: those that lie whole within the field, or those whose centre does."""
WIDEST = 3.0
"""Degrees that a field spans at most: coordinates that span more are metres of a frame of their own."""


def read_field(
    path: Path, cell_size: float, boundary: str = BOUNDARIES[0], direction: float = 0.0, swath: float | None = None
) -> Grid:
    """The polygons of a file, all together, in cells of `cell_size` metres from their upper-left corner.

    `direction`: of the rows, radians counter-clockwise from x (east). `swath`: side of the squares of cells that a
    visit covers, a whole number of cells; each cell is then worth 1, so that what is covered is counted on them.

    `boundary` "whole": a cell is free if it lies within a polygon and no edge of any runs through it, as a cell is an
    obstacle as soon as one pixel is; "centre": if its centre lies within one. In degrees the frame is metres east and
    north of their lower-left corner, to scale on the middle latitude; in another CRS its own metres. Raises MapError.
    """
    shapes = read_shapes(path)
    (polygons, borders), place, notes = _in_metres(shapes, path, cell_size)
    notes = (*shapes.notes, *notes)
    blocks = 1 if swath is None else round(swath / cell_size)
    frame = _frame(polygons, cell_size, path, direction, blocks)
    if place is not None:
        notes += true_metres(frame, place, str(path), "ogr2ogr -t_srs")
    held, crossed = np.zeros(frame.shape, dtype=bool), np.zeros(frame.shape, dtype=bool)
    for rings in polygons:
        held |= inside(rings, frame)
    for rings in borders if boundary == "whole" else ():
        crossed |= touched(rings, frame)
    free = held & ~crossed
    if not free.any():
        raise _no_cell(polygons, place, cell_size, boundary, path)
    lost = int((held & crossed).sum())
    if lost:
        notes += (
            f"{lost} cells lie on the field's boundary with their centre inside: they are obstacles "
            "(in a scenario, `map: {polygons: ..., boundary: centre}` makes them free)",
        )
    if any(feature.number is not None for feature in shapes.features):
        notes += ("its property p is not read, as this is the map: name the file under `threats` of a scenario too",)
    state = np.where(free, FREE, OCCUPIED).astype(np.uint8)
    worth = None if swath is None else np.ones(frame.shape)
    return Grid(state, frame, str(path), notes=notes, georeference=place, value=worth, swath=swath)


def touched(rings: Rings, frame: Frame) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells through whose inside an edge of the rings `[points, 2]` runs.

    Edges within 1e-6 of a cell's side run along it. Cost O(edges * H + H * W).
    """
    height, width = frame.shape
    counts = np.zeros((height, width + 1), dtype=np.int64)
    for ring in rings:
        corners = frame.local(ring) / frame.size
        corners[:, 1] = height - corners[:, 1]
        corners = np.where(np.abs(corners - np.rint(corners)) < WHOLE, np.rint(corners), corners)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            low, high = sorted((y0, y1))
            rows = np.arange(max(math.floor(low), 0), min(math.ceil(high), height))
            if not len(rows):
                continue  # along a side, or off the grid
            slope = (x1 - x0) / (y1 - y0) if y1 != y0 else 0.0
            at = [x0 + (np.clip(edge, low, high) - y0) * slope for edge in (rows, rows + 1)]
            at = at if slope or x0 == x1 else [np.array([x0]), np.array([x1])]
            first = np.clip(np.floor(np.minimum(*at) + WHOLE), 0, width).astype(int)
            after = np.clip(np.ceil(np.maximum(*at) - WHOLE), 0, width).astype(int)
            counts[rows, first] += 1
            counts[rows, np.maximum(first, after)] -= 1
    return np.cumsum(counts, axis=1)[:, :width] > 0


def _no_cell(
    polygons: list[Rings], place: Georeference | None, cell_size: float, boundary: str, path: Path
) -> MapError:
    """The error for a field without a free cell: it says how large the field is, and where a file in degrees lies."""
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    across, up = np.ptp(corners, axis=0).tolist()
    problem = f"no cell of {cell_size:g} m lies {'whole' if boundary == 'whole' else 'with its centre'} in the field"
    problem, fix = f"{problem} of {across:.4g} x {up:.4g} m", "give smaller cells"
    if place is not None:
        (east, north), *_ = principal(place.to_lonlat(corners[:1], str(path))).tolist()
        problem += f" at {describe(east, north)}"
    if place is not None and place.crs == WGS84:
        fix += ", or swap latitude and longitude if it does not lie there"
    return MapError(problem, source=path, fix=fix)


def _frame(polygons: list[Rings], cell_size: float, path: Path, yaw: float, blocks: int) -> Frame:
    """Cells from the upper-left corner of all polygons, where blocks of pixels begin too, to beyond the lower-right.

    Corners, rows and columns are those of a frame that is turned by `yaw`; `blocks` x `blocks` cells are not cut.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    turned = np.concatenate([ring for rings in polygons for ring in rings]) @ [[cos, -sin], [sin, cos]]
    low, high = turned.min(axis=0), turned.max(axis=0)
    side = blocks * cell_size
    width, height = (blocks * max(math.ceil(span / side - WHOLE), 1) for span in high - low)
    if height * width > MAX_CELLS:
        problem = f"a field of {high[0] - low[0]:g} x {high[1] - low[1]:g} m makes {width} x {height} cells"
        raise MapError(problem, source=path, expected=f"at most {MAX_CELLS}", fix="give larger cells")
    left, bottom = float(low[0]), float(high[1]) - height * cell_size
    return Frame((height, width), cell_size, (cos * left - sin * bottom, sin * left + cos * bottom, yaw))


def _in_metres(shapes: Shapes, path: Path, cell_size: float) -> tuple[Unrolled, Georeference | None, tuple[str, ...]]:
    """The polygons in metres of the map's frame, where that lies on the Earth, and notes."""
    polygons = [rings for feature in shapes.features for rings in feature.polygons]
    if not polygons:
        raise MapError("holds no polygon", source=path, expected="the boundary of a field")
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    small, swapped = _spans_a_field(corners), _spans_a_field(corners[:, ::-1])
    tiny = bool((np.ptp(corners, axis=0) < cell_size).all())
    if not shapes.crs and swapped and not small and (tiny or fine(corners)):
        check_range(corners, "", path)
    if shapes.crs is None and small:
        fix = "say it in QGIS, or ogr2ogr -a_srs; a shapefile's is in the .prj beside it"
        raise MapError("names no CRS, and looks like degrees", source=path, expected="a CRS", fix=fix)
    crs = shapes.crs or (WGS84 if shapes.crs == "" and small else "")
    if not crs:
        return (
            Unrolled(polygons, polygons),
            None,
            ("its coordinates are taken for metres of a frame of its own: it names no CRS",),
        )
    if crs == WGS84:
        return _degrees(polygons, path, cell_size)
    with foreign_errors(f"its CRS is {crs[:60]!r}", path, "a CRS that PROJ knows, in degrees or metres"):
        known = rasterio_for("another coordinate reference system", path).crs.CRS.from_user_input(crs)
        if known.is_geographic:
            check_range(corners, "", path)
            moved = [[reproject(ring, crs, WGS84) for ring in rings] for rings in polygons]
            return _degrees(moved, path, cell_size)
        unit = float(known.linear_units_factor[1])
    place, turn = Georeference(crs, scale=(1 / unit, 1 / unit)), turn_of(crs)[0]
    polygons, width = closed(polygons, turn, cell_size / unit)
    shape = unrolled(polygons, *extent(corners[:, 0], turn), turn)
    if not all(COORDINATE.accepts(float(np.abs(ring).max() * unit)) for rings in shape.areas for ring in rings):
        raise MapError("a corner too far away", source=path, expected=COORDINATE.expected)
    return _moved(shape, lambda ring: ring * unit), place, _of_the_cut(width * unit, cell_size)


def _spans_a_field(corners: NDArray[np.float64]) -> bool:
    """True for (longitude, latitude) `[n, 2]` of a field; where they lie a turn apart, of one about 180 alone."""
    longitudes = corners[:, 0]
    about = np.ptp(longitudes) <= WIDEST or (np.abs(longitudes) >= TURN / 2 - WIDEST).all()
    west, east = extent(longitudes, TURN)
    return bool(about and east - west <= WIDEST and np.ptp(corners[:, 1]) <= WIDEST and in_range(corners).all())


def _moved(shape: Unrolled, to: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Unrolled:
    """The shape with its rings in other coordinates."""
    areas, borders = ([[to(ring) for ring in rings] for rings in part] for part in shape)
    return Unrolled(areas, borders)


def _of_the_cut(width: float, cell_size: float) -> tuple[str, ...]:
    """A note on parts that do not touch where longitudes come round, from 1 cm on."""
    if width < 0.01:
        return ()
    what = "are joined there" if width <= cell_size else "stay apart: what lies between, more than a cell, is obstacle"
    return (f"its parts, {width:.2g} m apart where longitudes come round, {what}",)


def _degrees(polygons: list[Rings], path: Path, cell_size: float) -> tuple[Unrolled, Georeference, tuple[str, ...]]:
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    check_range(corners, "", path)
    (west, east), (south, north) = extent(corners[:, 0], TURN), (corners[:, 1].min(), corners[:, 1].max())
    if max(east - west, north - south) > WIDEST or max(-south, north) > 89:
        problem = f"lies at longitude {west:.6g} .. {east:.6g}, latitude {south:.6g} .. {north:.6g}"
        expected = f"degrees, -89 .. 89 north, a field of at most {WIDEST:g} degrees"
        raise MapError(problem, source=path, expected=expected, fix="name the file's CRS, if it is another")
    up, across = degree_sides((south + north) / 2)
    place = Georeference(WGS84, (float(west), float(south)), (1 / across, 1 / up))
    off = max(abs(degree_sides(edge)[1] / across - 1) for edge in (south, north))
    note = f"degrees: worked on in metres east and north of {describe(west, float(south))}"
    note += f", {100 * off:.2g} % off at the edges" if off > 1e-3 else ""
    polygons, width = closed(polygons, TURN, cell_size / across)
    shape = unrolled(polygons, west, east, TURN)
    return (
        _moved(shape, lambda ring: place.from_crs(ring, WGS84)),
        place,
        (note, *_of_the_cut(width * across, cell_size)),
    )


# What a scenario keeps robots out of, put on the map as obstacles: polygons, and occupied pixels of another map.

KINDS = ("polygons", "layer")


def keep_out(key: Key, grid: Grid) -> Grid:
    """The map with obstacles where a polygon holds a pixel's centre, or a ROS map laid over it is occupied (100).

    Raises ScenarioError for what names neither or keeps out nothing, MapError for a file that cannot be read.
    """
    state, notes = grid.state.copy(), list(grid.notes)
    for item in key.items("a list of {polygons: ...} and {layer: ...}"):
        keys = item.mapping(optional=KINDS)
        if len(keys) != 1:
            raise item.wrong("one of polygons and layer")
        (kind,) = keys
        if kind == "layer":
            layer = read_ros_map(keys[kind].file("a map_server YAML file"))
            held = values_over(layer, grid.frame) >= FULL
            notes.extend(f"{item.path}: {note}" for note in layer.notes)
        else:
            path = keys[kind].file("a file of polygons")
            shapes = read_polygons(path, 0.0, grid.frame, grid.georeference)
            held = np.logical_or.reduce([feature.mask(grid.frame) for feature in shapes.features])
            notes += [f"{item.path}: {note}" for note in shapes.notes]
        if not held.any():
            raise keys[kind].wrong("something on the map", "it keeps robots out of no pixel: check its coordinates")
        state[held] = OCCUPIED
        notes.append(f"{item.path}: {int(held.sum())} pixels are kept out of")
    return replace(grid, state=state, notes=tuple(notes))
