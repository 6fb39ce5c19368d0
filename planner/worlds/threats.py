"""A scenario's sources of threat, each made into a probability a cell, and combined."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.arguments import SEED, Numbers, whole
from planner.shown import counted
from planner.worlds.elevation import HIGHEST, band_threat, visible
from planner.worlds.generate import LEVEL, PAPER_LEVELS, ThreatPattern, most_areas, random_threats
from planner.worlds.grid import Frame, Grid, Ground
from planner.worlds.keys import Key
from planner.worlds.points import COLUMNS, read_points
from planner.worlds.polygons import read_polygons, rings_of
from planner.worlds.quantities import DISTANCE, PROBABILITY, SAMPLE, SHARE, first_of
from planner.worlds.rasters import Raster, read_raster
from planner.worlds.ros_map import read_ros_map
from planner.worlds.rules import by_rule, check_p, has_classes
from planner.worlds.samples import KINDS, farthest, interpolated
from planner.worlds.shapes import misplaced, point_spreads, values_over
from planner.worlds.sources import COMBINE, Sources, Thing, Things, combined
from planner.worlds.typed import TYPE, Matrix, check_types
from planner.worlds.warp import How


class Threat(NamedTuple):
    """What a source gives: p float64 `[H, W]` on the cells (any value on obstacles), notes, and its things."""

    p: NDArray[np.float64]
    notes: tuple[str, ...] = ()
    things: Things | None = None


def all_threats(
    keys: list[Key], combine: str, ground: Ground, matrix: Matrix
) -> tuple[NDArray[np.float64], tuple[str, ...], Sources | None, NDArray[np.float64]]:
    """Threat of every cell, float64 `[H, W]` (0 on obstacles), from the map's own and every source; notes; both apart;
    and that of each type of robot in the matrix, float64 `[Y, H, W]`, for which each source's p has its factor.

    Every source is first brought to the cells (the largest of a cell's free pixels), then they combine. Points,
    polygons and sites of one source combine in the same way. Raises ScenarioError or MapError.
    """
    shape, types = ground.frame.shape, check_types(keys, matrix)
    threat = np.zeros(shape) if ground.grid.threat is None else ground.largest(ground.grid.threat)
    by_type = np.repeat(np.where(ground.free, threat, 0.0)[None], len(matrix), axis=0)
    notes: list[str] = []
    layers: list[Things | NDArray[np.float64]] = [threat]
    for key, of in zip(keys, types, strict=True):
        source = _source(key, combine, ground)
        p = np.where(ground.free, source.p, 0.0)
        threat = COMBINE[combine](threat, p)
        for mine, row in zip(by_type, matrix.values(), strict=True):
            mine[:] = COMBINE[combine](mine, row.get(of, 1.0) * p)
        layers.append(p if source.things is None else source.things)
        notes.extend(f"{key.path}: {note}" for note in source.notes)
    apart = any(isinstance(layer, Things) for layer in layers)
    sources = Sources(combine, ground.free, tuple(layers)) if apart else None
    return np.where(ground.free, threat, 0.0), tuple(notes), sources, by_type


def _of_things(things: Sequence[Thing], combine: str, ground: Ground, notes: tuple[str, ...]) -> Threat:
    """Of things at the map's pixels."""
    frame, (height, width) = ground.grid.frame, ground.frame.shape

    def cell_of(pixels: NDArray[np.int64]) -> NDArray[np.int64]:
        row, col = (place // ground.ratio for place in np.divmod(pixels, frame.shape[1]))
        on = (row < height) & (col < width)
        cells = np.where(on, row * width + col, 0)
        return np.where(on & ground.free.reshape(-1)[cells], cells, -1)

    pixels = combined(things, combine, frame.shape[0] * frame.shape[1]).reshape(frame.shape)
    return Threat(ground.largest(pixels), notes, Things.on(things, cell_of))


def _source(key: Key, combine: str, ground: Ground) -> Threat:
    kind = one_source(key, SOURCES)
    options, read = SOURCES[kind]
    return read(key.mapping((kind,), optional=(*options, TYPE)), combine, ground)


def one_source(key: Key, sources: Collection[str]) -> str:
    """The one kind of these `sources` that a list item names. Raises ScenarioError for none or several."""
    given = [kind for kind in sources if isinstance(key.value, dict) and kind in key.value]
    if len(given) > 1:
        raise key.wrong(f"one of them: not both {given[0]} and {given[1]}")
    if not given:
        key.mapping(optional=sources)
        raise key.wrong(f"one of {', '.join(sources)}")
    return given[0]


def raster_threat(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """A raster on the map's pixels, or on the cells, through a rule from values to p (none: they are p themselves)."""
    raster, free, pixels = raster_on(keys["raster"], ground, "nearest" if has_classes(keys.get("rule")) else "average")
    with np.errstate(over="ignore", invalid="ignore"):
        p, fix = by_rule(keys.get("rule"), np.where(free, raster.values, 0.0))
    check_p(np.where(free, p, 0.0), raster.values, keys.get("rule", keys["raster"]), fix)
    return Threat(ground.largest(p) if pixels else p, raster.notes)


def raster_values(key: Key, ground: Ground) -> Threat:
    """A raster's values on the cells, finite wherever they are free; they need not be probabilities."""
    raster, free, pixels = raster_on(key, ground, "average")
    values = np.where(free, raster.values, 0.0)
    return Threat(ground.largest(values) if pixels else values, raster.notes)


def raster_on(key: Key, ground: Ground, how: How) -> tuple[Raster, NDArray[np.bool_], bool]:
    """(raster, which of its places are free, whether they are the map's pixels)."""
    raster = read_raster(key.file("a raster file"), ground.frame.size, how, ground)
    _check_ground(key, ground.grid, raster)
    pixels = raster.values.shape == ground.grid.frame.shape
    if not pixels and raster.values.shape != ground.frame.shape:
        raise key.wrong(
            f"the map's {_shape(ground.grid.frame.shape)} pixels or its {_shape(ground.frame.shape)} cells",
            f"the raster has {_shape(raster.values.shape)}",
        )
    free = ground.free_pixels if pixels else ground.free
    _check_values(raster.values, free, key)
    return raster, free, pixels


def _check_ground(key: Key, grid: Grid, raster: Raster) -> None:
    """An error for a raster that lies elsewhere than the map, where both say where."""
    if grid.georeference is not None and raster.georeference is not None:
        if np.isnan(raster.values).all():
            raise key.wrong("data on the ground of the map", "it has none there: does it lie elsewhere?")
        return
    if grid.bounds is None or raster.bounds is None:
        return
    pixel = (raster.bounds[2] - raster.bounds[0]) / raster.values.shape[1]
    if np.abs(np.subtract(grid.bounds, raster.bounds)).max() > pixel / 2:
        raise key.wrong(f"the ground of the map: {grid.bounds}", f"the raster covers {raster.bounds}")


def _check_values(values: NDArray[np.float64], free: NDArray[np.bool_], key: Key) -> None:
    wrong = free & ~np.isfinite(values)
    if wrong.any():
        at, where = first_of(wrong)
        what = "nan (no data)" if np.isnan(values[at]) else "infinite"
        expected, fix = "a finite number wherever the map is free", "fill it, or make these cells obstacles in the map"
        raise key.fault(f"names {key.value}, which is {what} {where}", expected, fix)


def _layer(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """p = scale * value / 100 of a ROS map laid over this one (`values_over`).

    Where the layer is unknown or does not reach: p = 0, counted in the notes.
    """
    path = keys["layer"].file("a map_server YAML file")
    scale = keys["scale"].number(SHARE) if "scale" in keys else 1.0
    layer = read_ros_map(path)
    value = values_over(layer, ground.grid.frame)
    missing = int((ground.free_pixels & (value < 0)).sum())
    p, said = scale * np.maximum(value, 0) / 100.0, keys.get("scale", keys["layer"])
    check_p(np.where(ground.free_pixels, p, 0.0), value.astype(np.float64), said, "give a lower scale")
    notes = (f"{missing} free pixels lie where the layer is unknown or does not reach: no threat from it",)
    return Threat(ground.largest(p), (*layer.notes, *(notes if missing else ())))


def _points(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    if "interpolate" in keys:
        return _samples(keys, ground)
    if "falloff" not in keys:
        spread = "falloff: {kind: gaussian | disc, radius: metres} beside it"
        raise keys["points"].wrong(f"{spread} (or of samples interpolate: {{kind: {' | '.join(KINDS)}}})")
    if "rule" in keys:
        raise keys["rule"].wrong("none beside falloff: there strength is p itself", "leave it out")
    kind, radius = read_falloff(keys["falloff"])
    path = keys["points"].file("a CSV file with x, y, strength")
    points, names = read_points(path, ground.grid.georeference, said=columns_said(keys))
    frame = ground.grid.frame
    spreads = point_spreads(points, kind, radius, frame)
    things = [Thing(*name, *spread) for name, spread in zip(names, spreads, strict=True)]
    at = frame.pixels(points[:, :2])
    outside = int((~frame.holds(at)).sum())
    if points[:, 2].any() and not any(thing.p.any() for thing in things):
        check_place(keys["points"], points[:, :2], frame, "threatens nothing")
    notes: tuple[str, ...] = (f"{outside} of {len(points)} points lie off the map",) if outside else ()
    if len(np.unique(points[:, :2], axis=0)) > 1 and len(np.unique(at, axis=0)) == 1:
        notes += (f"all {len(points)} points lie in one pixel: are x and y in metres?",)
    return _of_things(things, combine, ground, notes)


def _samples(keys: dict[str, Key], ground: Ground) -> Threat:
    """Measured values, interpolated at the cells' centres, through a rule from values to p (none: they are p)."""
    key, free = keys["points"], ground.free
    if "falloff" in keys:
        raise keys["falloff"].wrong("none beside interpolate: samples are of a field, not of points", "leave one out")
    path = key.file("a CSV file with x, y, strength")
    samples, _ = read_points(path, ground.grid.georeference, SAMPLE, columns_said(keys))
    frame = ground.grid.frame
    if not frame.holds(frame.pixels(samples[:, :2])).any():
        check_place(key, samples[:, :2], frame, "says nothing of the map")
    values, notes = np.zeros(free.shape), tuple[str, ...]()
    if free.any():
        centres = ground.frame.centres()[free]
        values[free] = interpolated(keys["interpolate"], samples, centres)
        far = farthest(samples, centres)
        notes = (f"{len(samples)} samples, interpolated; the farthest free cell is {far:.4g} m from one",)
    with np.errstate(over="ignore", invalid="ignore"):
        p, fix = by_rule(keys.get("rule"), values)
    check_p(np.where(free, p, 0.0), values, keys.get("rule", key), fix)
    return Threat(p, notes)


def columns_said(keys: dict[str, Key]) -> dict[str, str]:
    """Which columns of a points file a scenario says are x, y and strength."""
    return {what: keys[what].text("the name of a column") for what in COLUMNS if what in keys}


def read_falloff(key: Key) -> tuple[str, float]:
    """Kind and radius in metres of what points spread over."""
    falloff = key.mapping(("kind", "radius"))
    return falloff["kind"].choice(("gaussian", "disc")), falloff["radius"].number(DISTANCE)


def check_place(key: Key, points: NDArray[np.float64], frame: Frame, what: str) -> None:
    """An error for shapes at `points` `[points, 2]` that touch no pixel and lie off the map, as degrees do."""
    wrong = misplaced(points, frame)
    if wrong is not None:
        raise key.fault(f"names {key.value}, which {what}: {wrong[0]}", "metres on the map", wrong[1])


def _polygon(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    default = keys["p"].number(PROBABILITY) if "p" in keys else None
    frame, path = ground.grid.frame, keys["polygons"].file("a file of polygons")
    features = read_polygons(path, default, frame, ground.grid.georeference)
    things: list[Thing] = []
    notes = []
    for index, feature in enumerate(features):
        at = np.flatnonzero(feature.mask(frame))
        if not len(at):
            notes.append(f"features[{index}] holds no pixel's centre: no threat from it")
        things.append(Thing(feature.name, f"features[{index}] of {path.name}", at, np.full(len(at), feature.number)))
    if len(notes) == len(features):
        check_place(keys["polygons"], np.concatenate(rings_of(features)), frame, "threatens nothing")
    return _of_things(things, combine, ground, tuple(notes))


def _viewshed(source: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """p (or p by bands of range) wherever one of the sites sees the ground; sites are cells of the final grid."""
    key = source["viewshed"]
    keys = key.mapping(("sites",), optional=("range", "p", "bands"), defaults={"height": 2.0})
    elevation = ground.elevation()
    if elevation is None:
        raise key.fault("needs heights, and the map has none", "map: {elevation: ...}")
    height = keys["height"].number(Numbers(0, HIGHEST, "metres above the ground"))
    bands = _bands(key, keys)
    things = []
    for key in keys["sites"].items("a list of [row, col]"):
        site = _site(key, ground)
        if np.isnan(elevation[site]):
            raise key.wrong("a cell whose elevation is known")
        seen = visible(elevation, site, height, bands[-1][0], ground.frame.size)
        p = band_threat(seen, bands).reshape(-1)
        at = np.flatnonzero(p)
        things.append(Thing("", f"site [{site[0]}, {site[1]}]", at, p[at]))
    shape = ground.frame.shape
    free = ground.free.reshape(-1)
    threat = combined(things, combine, len(free)).reshape(shape)
    return Threat(threat, (), Things.on(things, lambda cells: np.where(free[cells], cells, -1)))


def _bands(key: Key, keys: dict[str, Key]) -> list[tuple[float, float]]:
    if "bands" not in keys:
        if not {"range", "p"} <= keys.keys():
            raise key.wrong("range and p, or bands: [[range, p], ...]")
        return [(keys["range"].number(DISTANCE), keys["p"].number(PROBABILITY))]
    if {"range", "p"} & keys.keys():
        raise key.wrong("bands, or range and p, not both")
    bands: list[tuple[float, float]] = []
    for band in keys["bands"].items("a list of [range, p]"):
        reach, p = band.items("[range in metres, p]", exactly=2)
        if bands and reach.number(DISTANCE) <= bands[-1][0]:
            raise band.wrong("[range in metres, p], ranges rising")
        bands.append((reach.number(DISTANCE), p.number(PROBABILITY)))
    return bands


def _site(key: Key, ground: Ground) -> tuple[int, int]:
    height, width = ground.frame.shape
    row, col = key.items(f"[row, col] on the grid of {height} x {width} cells", exactly=2)
    return row.number(whole(0, height - 1, "a row")), col.number(whole(0, width - 1, "a column"))


def _generate(source: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """Random threats on `ratio` of the *free* cells (the paper's worlds count all cells).

    Contiguous areas have a cell at least: where more are asked for than there are dangerous cells, a note says so.
    """
    key = source["generate"]
    defaults = {"areas": 10, "levels": list(PAPER_LEVELS), "seed": 0}
    keys = key.mapping(("kind", "ratio"), defaults=defaults)
    ratio = keys["ratio"].number(Numbers(0, 1, "a part of the free cells"))
    most = most_areas(ground.free.size)
    pattern = ThreatPattern(
        kind=keys["kind"].choice(("contiguous", "scattered")),  # type: ignore[arg-type]
        areas=keys["areas"].number(whole(1, most, "a whole number of areas on this map")),
        levels=tuple(keys["levels"].numbers(LEVEL, f"a list of {LEVEL.expected}")),
        seed=keys["seed"].number(SEED),
    )
    count = round(ratio * int(ground.free.sum()))
    notes: tuple[str, ...] = ()
    if pattern.kind == "contiguous" and 0 < count < pattern.areas:
        notes = (f"{counted(count, 'dangerous cell')} make {counted(count, 'area')} of one cell, not {pattern.areas}",)
    return Threat(random_threats(ground.free, count, pattern).astype(np.float64), notes)


SOURCES: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Key], str, Ground], Threat]]] = {
    "raster": (("rule",), raster_threat),
    "layer": (("scale",), _layer),
    "points": (("falloff", "interpolate", "rule", *COLUMNS), _points),
    "polygons": (("p",), _polygon),
    "viewshed": ((), _viewshed),
    "generate": ((), _generate),
}
"""Every kind of source: the keys that may stand beside it, and what reads it."""


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in shape)
