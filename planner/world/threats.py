"""A scenario's sources of threat: each gives a probability per cell, and they are combined."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.arguments import ANY, POSITIVE, SEED, Numbers, whole
from planner.formatting import counted
from planner.world.frame import Frame
from planner.world.generate import LEVEL, PAPER_LEVELS, ThreatPattern, most_areas, random_threats
from planner.world.grid import Grid, Ground
from planner.world.image_files import read_ros_map
from planner.world.keys import DETECT, DISTANCE, PROBABILITY, SAMPLE, SHARE, THREAT, VALUE, Key, Quantity, first_of
from planner.world.points import (
    COLUMNS,
    KINDS,
    check_place,
    farthest,
    interpolated,
    point_spreads,
    read_points,
    values_over,
)
from planner.world.raster_bands import AMOUNTS, PROBABILITIES, How, Meaning
from planner.world.raster_files import TALLEST, Raster, band_threat, read_raster, size_of, visible
from planner.world.robot_types import COMBINE, TYPE, Matrix, Sources, Thing, Things, check_types, combined
from planner.world.vector_files import read_polygons, rings_of

# From measured values to p: the `rule` of a raster of threats, and of samples.

RULES = ("linear", "exposure", "classes")
"""`scale * value`, `1 - exp(-rate * value)`, or p by class."""


def check_p(p: NDArray[np.float64], values: NDArray[np.float64], key: Key, fix: str) -> None:
    """Check that rule values are probabilities.

    Args:
        p: float64 `[H, W]`, results of the rule.
        values: float64 `[H, W]`, its inputs.
        key: named in the error.
        fix: of the error.

    Raises:
        ScenarioError: names the first cell with an invalid p.
    """
    # As float32, which engines use: 0.99999999 is 1 there.
    with np.errstate(over="ignore", under="ignore"):
        wrong = ~((p >= 0) & (p.astype(np.float32) < 1))
    if wrong.any():
        at, where = first_of(wrong)
        raise key.fault(f"gives p = {p[at]:g} for the value {values[at]:g} {where}", PROBABILITY.expected, fix)


def by_rule(key: Key | None, values: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Apply a rule to values.

    Args:
        key: the rule of a scenario; None: values are p.
        values: float64.

    Returns:
        (p, fix for an invalid p).

    Raises:
        ScenarioError: the rule is invalid.
    """
    if key is None:
        return values, "give a rule: {kind: linear, scale: ...}"
    kind = key.mapping(("kind",), optional=("scale", "rate", "edges", "p"))["kind"].choice(RULES)
    if kind == "linear":
        keys = key.mapping(("kind", "scale"))
        return values * keys["scale"].number(POSITIVE), "lower scale"
    if kind == "exposure":
        keys = key.mapping(("kind", "rate"))
        return -np.expm1(-keys["rate"].number(POSITIVE) * values), "lower rate; values must not be negative"
    keys = key.mapping(("kind", "edges", "p"))
    edges = keys["edges"].numbers(ANY, "a list of numbers")
    if any(low >= high for low, high in itertools.pairwise(edges)):
        raise keys["edges"].wrong("increasing numbers")
    expected = f"{len(edges) + 1} probabilities 0 <= p < 1 for {len(edges)} edges: below the first, ..., above the last"
    p = keys["p"].numbers(PROBABILITY, expected, len(edges) + 1)
    return np.array(p)[np.searchsorted(edges, values, side="right")], "change p"


class Threat(NamedTuple):
    """Threat of a source: p float64 `[H, W]` on the cells (any value on obstacles), notes, and its objects."""

    p: NDArray[np.float64]
    notes: tuple[str, ...] = ()
    things: Things | None = None


def all_threats(
    keys: list[Key], combine: str, ground: Ground, matrix: Matrix
) -> tuple[NDArray[np.float64], tuple[str, ...], Sources | None, NDArray[np.float64]]:
    """Combine the map's own threat with every source.

    Every source is first brought to the cells (the largest p of a cell's free pixels), then they are combined. Points,
    polygons and sites of one source are combined in the same way.

    Args:
        keys: sources of the scenario.
        combine: key of `COMBINE`.
        ground: the cells.
        matrix: factors by robot type.

    Returns:
        (threat float64 `[H, W]`, 0 on obstacles; notes; the sources, None if they have no objects; threat of each robot
        type, float64 `[Y, H, W]`, with the factors of the matrix).

    Raises:
        ScenarioError, MapError: an invalid source or file.
    """
    shape, types = ground.frame.shape, check_types(keys, matrix)
    threat = np.zeros(shape) if ground.grid.world is None else ground.largest(ground.grid.world.threat)
    # The map's own threat has no type: its factor is 1 for all robots.
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
    """The threat of objects at the map's pixels."""
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
    """The only kind in `sources` that a list item names.

    Raises:
        ScenarioError: it names none or several.
    """
    given = [kind for kind in sources if isinstance(key.value, dict) and kind in key.value]
    if len(given) > 1:
        raise key.wrong(f"one of them: not both {given[0]} and {given[1]}")
    if not given:
        key.mapping(optional=sources)
        raise key.wrong(f"one of {', '.join(sources)}")
    return given[0]


def raster_threat(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """Threat of a raster on the map's pixels or on the cells, through a rule from values to p (none: values are p)."""
    rule = keys.get("rule")
    given = None if rule is None else rule.value
    # The mean of two classes is no class.
    how: How = "nearest" if isinstance(given, dict) and given.get("kind") == "classes" else "average"
    raster, free, pixels = raster_on(keys["raster"], ground, how, PROBABILITIES if rule is None else AMOUNTS)
    with np.errstate(over="ignore", invalid="ignore"):
        p, fix = by_rule(rule, np.where(free, raster.values, 0.0))
    check_p(np.where(free, p, 0.0), raster.values, rule or keys["raster"], fix)
    return Threat(ground.largest(p) if pixels else p, raster.notes)


def raster_values(key: Key, ground: Ground) -> Threat:
    """A raster of probabilities on the cells, finite in free cells; not checked to be in 0..1.

    Args:
        key: names the raster file.
        ground: the cells.
    """
    raster, free, pixels = raster_on(key, ground, "average", PROBABILITIES)
    values = np.where(free, raster.values, 0.0)
    return Threat(ground.largest(values) if pixels else values, raster.notes)


def raster_on(key: Key, ground: Ground, how: How, of: Meaning) -> tuple[Raster, NDArray[np.bool_], bool]:
    """Read a raster for the map.

    Args:
        key: names the file.
        ground: the cells.
        how: resampling.
        of: kind of values.

    Returns:
        (raster, bool mask of its free places, whether they are the map's pixels).

    Raises:
        ScenarioError: another shape or place than the map's, or missing values.
    """
    raster = read_raster(key.file("a raster file"), ground.frame.size, how, ground, of)
    _check_ground(key, ground.grid, raster)
    pixels = raster.values.shape == ground.grid.frame.shape
    if not pixels and raster.values.shape != ground.frame.shape:
        raise key.wrong(
            f"the map's {size_of(ground.grid.frame.shape)} pixels or its {size_of(ground.frame.shape)} cells",
            f"the raster has {size_of(raster.values.shape)}",
        )
    free = ground.free_pixels if pixels else ground.free
    _check_values(raster, free, key)
    return raster, free, pixels


def _check_ground(key: Key, grid: Grid, raster: Raster) -> None:
    """Raise an error for a raster at another place than the map, if both have one."""
    if grid.georeference is not None and raster.georeference is not None:
        if np.isnan(raster.values).all():
            raise key.wrong("data on the ground of the map", "it has none there: does it lie elsewhere?")
        return
    if grid.bounds is None or raster.bounds is None:
        return
    pixel = (raster.bounds[2] - raster.bounds[0]) / raster.values.shape[1]
    if np.abs(np.subtract(grid.bounds, raster.bounds)).max() > pixel / 2:
        raise key.wrong(f"the ground of the map: {grid.bounds}", f"the raster covers {raster.bounds}")


def _check_values(raster: Raster, free: NDArray[np.bool_], key: Key) -> None:
    wrong = free & ~np.isfinite(raster.values)
    if wrong.any():
        at, where = first_of(wrong)
        what = "nan (no data)" if np.isnan(raster.values[at]) else "infinite"
        expected, fix = "a finite number wherever the map is free", "fill it, or make these cells obstacles in the map"
        voids = f" ({raster.voids})" if raster.voids else ""
        raise key.fault(f"names {key.value}, which is {what} {where}{voids}", expected, fix)


def _layer(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """p = scale * value / 100 of a ROS map laid over this one (`values_over`).

    p = 0 where the layer is unknown or has no pixel, counted in the notes.
    """
    path = keys["layer"].file("a map_server YAML file")
    scale = keys["scale"].number(SHARE) if "scale" in keys else 1.0
    layer = read_ros_map(path)
    value = values_over(layer, ground.grid.frame)
    missing = int((ground.free_pixels & (value < 0)).sum())
    p, said = scale * np.maximum(value, 0) / 100.0, keys.get("scale", keys["layer"])
    check_p(np.where(ground.free_pixels, p, 0.0), value.astype(np.float64), said, "give a lower scale")
    notes = (f"the layer is unknown or missing at {missing} free pixels: no threat from it there",)
    return Threat(ground.largest(p), (*layer.notes, *(notes if missing else ())))


def _points(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    if "interpolate" in keys:
        return _samples(keys, ground)
    if "falloff" not in keys:
        spread = "falloff: {kind: gaussian | disc, radius: metres} with it"
        raise keys["points"].wrong(f"{spread} (or of samples interpolate: {{kind: {' | '.join(KINDS)}}})")
    if "rule" in keys:
        raise keys["rule"].wrong("none with falloff: strength is p", "leave it out")
    frame = ground.grid.frame
    things, places, notes = _of_points(keys, THREAT, frame, ground)
    at = frame.pixels(places)
    outside = int((~frame.holds(at)).sum())
    notes += (f"{outside} of {len(at)} points lie off the map",) if outside else ()
    # Degrees read as metres put all points into one pixel.
    if len(np.unique(places, axis=0)) > 1 and len(np.unique(at, axis=0)) == 1:
        notes += (f"all {len(at)} points lie in one pixel: are x and y in metres?",)
    return _of_things(things, combine, ground, notes)


def _of_points(
    keys: dict[str, Key], of: Quantity, frame: Frame, ground: Ground
) -> tuple[list[Thing], NDArray[np.float64], tuple[str, ...]]:
    """Points as objects on the pixels of a frame, over the area of `falloff`, else in the pixel that holds them.

    Returns:
        (objects, their (x, y) float64 `[n, 2]`, notes).
    """
    place, falloff = ground.grid.georeference, None
    if "falloff" in keys:
        given = keys["falloff"].mapping(("kind", "radius"))
        falloff = given["kind"].choice(("gaussian", "disc")), given["radius"].number(DISTANCE)
    path = keys["points"].file("a CSV file with x, y, strength")
    points, names, notes = read_points(path, frame, place, of, columns_said(keys))
    if falloff is not None:
        spreads = list(point_spreads(points, *falloff, frame))
    else:
        at = frame.pixels(points[:, :2])
        cells = np.where(frame.holds(at), at[:, 0] * frame.shape[1] + at[:, 1], -1)
        spreads = [(cell[cell >= 0], p[cell >= 0]) for cell, p in zip(cells[:, None], points[:, 2:], strict=True)]
    things = [Thing(*name, *spread) for name, spread in zip(names, spreads, strict=True)]
    if points[:, 2].any() and not any(len(thing.at) for thing in things):
        check_place(keys["points"], points[:, :2], frame, place, "covers no cell")
    return things, points[:, :2], notes


def _samples(keys: dict[str, Key], ground: Ground) -> Threat:
    """Samples, interpolated at the cells' centres, through a rule from values to p (none: values are p)."""
    key, free = keys["points"], ground.free
    if "falloff" in keys:
        raise keys["falloff"].wrong("none with interpolate: samples describe a field, not points", "leave one out")
    path = key.file("a CSV file with x, y, strength")
    frame, place = ground.grid.frame, ground.grid.georeference
    samples, _, notes = read_points(path, frame, place, SAMPLE, columns_said(keys))
    if not frame.holds(frame.pixels(samples[:, :2])).any():
        check_place(key, samples[:, :2], frame, place, "has no sample on the map")
    values = np.zeros(free.shape)
    if free.any():
        centres = ground.frame.centres()[free]
        values[free] = interpolated(keys["interpolate"], samples, centres)
        far = farthest(samples, centres)
        notes += (f"{len(samples)} samples, interpolated; the farthest free cell is {far:.4g} m from one",)
    with np.errstate(over="ignore", invalid="ignore"):
        p, fix = by_rule(keys.get("rule"), values)
    check_p(np.where(free, p, 0.0), values, keys.get("rule", key), fix)
    return Threat(p, notes)


def columns_said(keys: dict[str, Key]) -> dict[str, str]:
    """Names of the columns x, y and strength of a points file, where a scenario gives them."""
    return {what: keys[what].text("the name of a column") for what in COLUMNS if what in keys}


def _polygon(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    things, said = _of_polygons(keys, THREAT, ground.grid.frame, ground)
    empty = [index for index, thing in enumerate(things) if not len(thing.at)]
    notes = [f"features[{index}] holds no pixel's centre: no threat from it" for index in empty]
    return _of_things(things, combine, ground, (*said, *notes))


def _of_polygons(
    keys: dict[str, Key], of: Quantity, frame: Frame, ground: Ground
) -> tuple[list[Thing], tuple[str, ...]]:
    """Polygons as objects on the pixels of a frame whose centre they hold; notes."""
    default = keys[of.name].number(of.numbers) if of.name in keys else None
    path, place = keys["polygons"].file("a file of polygons"), ground.grid.georeference
    features, _, notes = read_polygons(path, default, frame, place, of)
    things = []
    for index, feature in enumerate(features):
        at = np.flatnonzero(feature.mask(frame))
        things.append(Thing(feature.name, f"features[{index}] of {path.name}", at, np.full(len(at), feature.number)))
    if not any(len(thing.at) for thing in things):
        check_place(keys["polygons"], np.concatenate(rings_of(features)), frame, place, "covers no cell")
    return things, notes


def _viewshed(source: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """p (or p by bands of range) in cells that one of the sites sees; sites are cells of the final grid."""
    key = source["viewshed"]
    keys = key.mapping(("sites",), optional=("range", "p", "bands"), defaults={"height": 2.0})
    elevation = ground.elevation()
    if elevation is None:
        raise key.fault("needs heights, and the map has none", "map: {elevation: ...}")
    height = keys["height"].number(Numbers(0, TALLEST, "metres above the ground"))
    bands = _bands(key, keys)
    things = []
    for key in keys["sites"].items("a list of [row, col]"):
        site = _site(key, ground)
        if np.isnan(elevation[site]):
            raise key.wrong("a cell whose elevation is known")
        # One search with the longest range; bands are applied to its distances.
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
            raise band.wrong("[range in metres, p], ranges increasing")
        bands.append((reach.number(DISTANCE), p.number(PROBABILITY)))
    return bands


def _site(key: Key, ground: Ground) -> tuple[int, int]:
    height, width = ground.frame.shape
    row, col = key.items(f"[row, col] on the grid of {height} x {width} cells", exactly=2)
    return row.number(whole(0, height - 1, "a row")), col.number(whole(0, width - 1, "a column"))


def _generate(source: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """Random threats on `ratio` of the *free* cells (the paper's worlds count all cells).

    Contiguous areas have at least one cell: if there are fewer dangerous cells than areas, a note says so.
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
"""Kinds of sources: further keys, and reader."""


# Values and detection probabilities of cells: the keys `value` and `detect` of a scenario (SPEC section 13).

Layer = NDArray[np.float64]
Merge = Callable[[Layer, Layer], Layer]


class Says(NamedTuple):
    """Layer of a source: numbers float64 `[H, W]`, cells that it covers bool `[H, W]`, notes."""

    layer: Layer
    where: NDArray[np.bool_]
    notes: tuple[str, ...] = ()


def layers(keys: dict[str, Key], ground: Ground) -> tuple[dict[str, Layer | None], tuple[str, ...]]:
    """Layers of a scenario.

    Args:
        keys: of the scenario.
        ground: the cells.

    Returns:
        (arguments `value` and `detect` of `World.create`, float64 `[H, W]` or None; notes).

    Raises:
        ScenarioError, MapError: an invalid source or file.
    """
    found = {of.name: _value_layer(keys.get(of.name), of, ground) for of in (VALUE, DETECT)}
    return {name: layer for name, (layer, _) in found.items()}, sum((notes for _, notes in found.values()), ())


def _value_layer(key: Key | None, of: Quantity, ground: Ground) -> tuple[Layer | None, tuple[str, ...]]:
    """The map's own layer, else 1 everywhere, overwritten by one source after the other; notes."""
    own = np.ones(ground.grid.frame.shape) if of is VALUE and ground.grid.swath is not None else None
    own = own if ground.grid.world is None else getattr(ground.grid.world, of.name)
    own = None if own is None else _over_pixels(of, ground)(own)
    notes: tuple[str, ...] = ()
    if key is None:
        return own, notes
    if of is VALUE and ground.grid.swath is not None:
        raise key.wrong("none for a map with a swath, where it counts the field's cells", "leave one of the two out")
    if not isinstance(key.value, list):
        return np.full(
            ground.frame.shape, key.number(of.numbers, f"{of.numbers.expected}, or a list of sources")
        ), notes
    layer = np.ones(ground.frame.shape) if own is None else own
    for source in key.items("a list of sources"):
        says = _value_source(source, of, ground)
        # Later sources overwrite earlier ones where they cover a cell.
        layer = np.where(says.where, says.layer, layer)
        notes += tuple(f"{source.path}: {note}" for note in says.notes)
    return layer, notes


def _over_pixels(of: Quantity, ground: Ground) -> Callable[[Layer], Layer]:
    """Number of a cell from its pixels: the sum of values, the mean of probabilities."""
    return ground.total if of is VALUE else ground.mean


def _value_source(key: Key, of: Quantity, ground: Ground) -> Says:
    kind = one_source(key, VALUE_SOURCES)
    options, read = VALUE_SOURCES[kind]
    return read(key.mapping((kind,), optional=[of.name if name == "" else name for name in options]), of, ground)


def _everywhere(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    shape = ground.frame.shape
    return Says(np.full(shape, keys["everywhere"].number(of.numbers)), np.ones(shape, dtype=bool))


def _raster(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """A raster of the numbers themselves, on the map's pixels or on the cells: values are amounts and add up."""
    key = keys["raster"]
    how: How = "sum" if of is VALUE else "average"
    raster, free, pixels = raster_on(key, ground, how, AMOUNTS if of is VALUE else PROBABILITIES)
    values = np.where(free, raster.values, 0.0)
    wrong = ~((values >= 0) & (values <= of.numbers.most))
    if wrong.any():
        at, where = first_of(wrong)
        problem = f"names {key.value}, with {of.name} = {values[at]:g} {where}"
        raise key.fault(problem, of.numbers.expected, "fix the raster")
    return Says(_over_pixels(of, ground)(values) if pixels else values, ground.free, raster.notes)


def _objects(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """Polygons or points on the cells: the last polygon counts; of points the sum of values, the largest detection."""
    merge: Merge = np.add if of is VALUE else np.maximum
    if "polygons" in keys:
        (things, notes), merge = _of_polygons(keys, of, ground.frame, ground), lambda before, number: number
    else:
        things, _, notes = _of_points(keys, of, ground.frame, ground)
    says, where = np.zeros(ground.frame.shape), np.zeros(ground.frame.shape, dtype=bool)
    for thing in things:
        says.flat[thing.at] = merge(says.flat[thing.at], thing.p)
        where.flat[thing.at] = True
    return Says(says, where, notes)


VALUE_SOURCES: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Key], Quantity, Ground], Says]]] = {
    "everywhere": ((), _everywhere),
    "raster": ((), _raster),
    "polygons": (("",), _objects),
    "points": (("falloff", *COLUMNS), _objects),
}
"""Kinds of sources: further keys ("": the name of the layer), and reader."""
