"""A scenario's sources of threat, each made into a probability a cell, and combined."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.arguments import ANY, POSITIVE, SEED, Numbers, whole
from planner.formatting import counted
from planner.world.generate import LEVEL, PAPER_LEVELS, ThreatPattern, most_areas, random_threats
from planner.world.grid import Frame, Georeference, Grid, Ground
from planner.world.image_files import read_ros_map
from planner.world.keys import DETECT, DISTANCE, PROBABILITY, SAMPLE, SHARE, VALUE, Key, Quantity, first_of
from planner.world.points import (
    COLUMNS,
    CUT_OFF,
    KINDS,
    farthest,
    interpolated,
    misplaced,
    point_spreads,
    point_threat,
    read_points,
    values_over,
)
from planner.world.raster_bands import AMOUNTS, PROBABILITIES, How, Meaning
from planner.world.raster_files import TALLEST, Raster, band_threat, read_raster, visible
from planner.world.robot_types import COMBINE, TYPE, Matrix, Sources, Thing, Things, check_types, combined
from planner.world.vector_files import read_polygons, rings_of

# From measured values to p: the `rule` of a threat's raster, and of its samples.

RULES = ("linear", "exposure", "classes")
"""`scale * value`, `1 - exp(-rate * value)`, or p by class."""


def check_p(p: NDArray[np.float64], values: NDArray[np.float64], key: Key, fix: str) -> None:
    """An error that names `key`, the first p `[H, W]` that is no probability, and the value that it comes from."""
    with np.errstate(over="ignore", under="ignore"):
        wrong = ~((p >= 0) & (p.astype(np.float32) < 1))
    if wrong.any():
        at, where = first_of(wrong)
        raise key.fault(f"gives p = {p[at]:g} for the value {values[at]:g} {where}", PROBABILITY.expected, fix)


def has_classes(rule: Key | None) -> bool:
    """Whether values are classes, which are never averaged."""
    return rule is not None and isinstance(rule.value, dict) and rule.value.get("kind") == "classes"


def by_rule(key: Key | None, values: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """p of the values, and what to change where it is no probability."""
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
        raise keys["edges"].wrong("rising numbers")
    expected = f"{len(edges) + 1} probabilities 0 <= p < 1 for {len(edges)} edges: below the first, ..., above the last"
    p = keys["p"].numbers(PROBABILITY, expected, len(edges) + 1)
    return np.array(p)[np.searchsorted(edges, values, side="right")], "change p"


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
    rule = keys.get("rule")
    how: How = "nearest" if has_classes(rule) else "average"
    raster, free, pixels = raster_on(keys["raster"], ground, how, PROBABILITIES if rule is None else AMOUNTS)
    with np.errstate(over="ignore", invalid="ignore"):
        p, fix = by_rule(rule, np.where(free, raster.values, 0.0))
    check_p(np.where(free, p, 0.0), raster.values, rule or keys["raster"], fix)
    return Threat(ground.largest(p) if pixels else p, raster.notes)


def raster_values(key: Key, ground: Ground) -> Threat:
    """A raster of chances on the cells, finite wherever they are free; that they lie in 0..1 is not checked."""
    raster, free, pixels = raster_on(key, ground, "average", PROBABILITIES)
    values = np.where(free, raster.values, 0.0)
    return Threat(ground.largest(values) if pixels else values, raster.notes)


def raster_on(key: Key, ground: Ground, how: How, of: Meaning) -> tuple[Raster, NDArray[np.bool_], bool]:
    """(raster, which of its places are free, whether they are the map's pixels)."""
    raster = read_raster(key.file("a raster file"), ground.frame.size, how, ground, of)
    _check_ground(key, ground.grid, raster)
    pixels = raster.values.shape == ground.grid.frame.shape
    if not pixels and raster.values.shape != ground.frame.shape:
        raise key.wrong(
            f"the map's {_shape(ground.grid.frame.shape)} pixels or its {_shape(ground.frame.shape)} cells",
            f"the raster has {_shape(raster.values.shape)}",
        )
    free = ground.free_pixels if pixels else ground.free
    _check_values(raster, free, key)
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
    frame, place = ground.grid.frame, ground.grid.georeference
    points, names, notes = read_points(path, frame, place, said=columns_said(keys))
    spreads = point_spreads(points, kind, radius, frame)
    things = [Thing(*name, *spread) for name, spread in zip(names, spreads, strict=True)]
    at = frame.pixels(points[:, :2])
    outside = int((~frame.holds(at)).sum())
    if points[:, 2].any() and not any(thing.p.any() for thing in things):
        check_place(keys["points"], points[:, :2], frame, place, "threatens nothing")
    notes += (f"{outside} of {len(points)} points lie off the map",) if outside else ()
    if len(np.unique(points[:, :2], axis=0)) > 1 and len(np.unique(at, axis=0)) == 1:
        notes += (f"all {len(points)} points lie in one pixel: are x and y in metres?",)
    return _of_things(things, combine, ground, notes)


def _samples(keys: dict[str, Key], ground: Ground) -> Threat:
    """Measured values, interpolated at the cells' centres, through a rule from values to p (none: they are p)."""
    key, free = keys["points"], ground.free
    if "falloff" in keys:
        raise keys["falloff"].wrong("none beside interpolate: samples are of a field, not of points", "leave one out")
    path = key.file("a CSV file with x, y, strength")
    frame, place = ground.grid.frame, ground.grid.georeference
    samples, _, notes = read_points(path, frame, place, SAMPLE, columns_said(keys))
    if not frame.holds(frame.pixels(samples[:, :2])).any():
        check_place(key, samples[:, :2], frame, place, "says nothing of the map")
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
    """Which columns of a points file a scenario says are x, y and strength."""
    return {what: keys[what].text("the name of a column") for what in COLUMNS if what in keys}


def read_falloff(key: Key) -> tuple[str, float]:
    """Kind and radius in metres of what points spread over."""
    falloff = key.mapping(("kind", "radius"))
    return falloff["kind"].choice(("gaussian", "disc")), falloff["radius"].number(DISTANCE)


def check_place(key: Key, points: NDArray[np.float64], frame: Frame, place: Georeference | None, what: str) -> None:
    """An error for shapes at `points` `[points, 2]` that touch no pixel and lie off the map, as degrees do."""
    wrong = misplaced(points, frame, place)
    if wrong is not None:
        raise key.fault(f"names {key.value}, which {what}: {wrong[0]}", "metres on the map", wrong[1])


def _polygon(keys: dict[str, Key], combine: str, ground: Ground) -> Threat:
    default = keys["p"].number(PROBABILITY) if "p" in keys else None
    frame, path = ground.grid.frame, keys["polygons"].file("a file of polygons")
    features, _, said = read_polygons(path, default, frame, ground.grid.georeference)
    things: list[Thing] = []
    notes = []
    for index, feature in enumerate(features):
        at = np.flatnonzero(feature.mask(frame))
        if not len(at):
            notes.append(f"features[{index}] holds no pixel's centre: no threat from it")
        things.append(Thing(feature.name, f"features[{index}] of {path.name}", at, np.full(len(at), feature.number)))
    if len(notes) == len(features):
        corners = np.concatenate(rings_of(features))
        check_place(keys["polygons"], corners, frame, ground.grid.georeference, "threatens nothing")
    return _of_things(things, combine, ground, (*said, *notes))


def _viewshed(source: dict[str, Key], combine: str, ground: Ground) -> Threat:
    """p (or p by bands of range) wherever one of the sites sees the ground; sites are cells of the final grid."""
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


# What cells are worth and how well a visit detects: the keys `value` and `detect` of a scenario (SPEC section 13).

Layer = NDArray[np.float64]
NOWHERE = "is said of no cell"


class Says(NamedTuple):
    """What a source says, float64 `[H, W]`, and of which cells, bool `[H, W]`; notes."""

    layer: Layer
    where: NDArray[np.bool_]
    notes: tuple[str, ...] = ()


def layers(keys: dict[str, Key], ground: Ground) -> tuple[dict[str, Layer | None], tuple[str, ...]]:
    """The arguments `value` and `detect` of `World.create`, float64 `[H, W]`, None if nothing is said; notes."""
    found = {of.name: _value_layer(keys.get(of.name), of, ground) for of in (VALUE, DETECT)}
    return {name: layer for name, (layer, _) in found.items()}, sum((notes for _, notes in found.values()), ())


def _value_layer(key: Key | None, of: Quantity, ground: Ground) -> tuple[Layer | None, tuple[str, ...]]:
    """The map's own layer, else 1 everywhere; then source by source, of which the last one counts in a cell; notes."""
    own = getattr(ground.grid, of.name)
    own = None if own is None else _over_pixels(of, ground)(own)
    notes: tuple[str, ...] = ()
    if key is None:
        return own, notes
    if of is VALUE and ground.grid.swath is not None:
        raise key.wrong("none of a map with a swath, where it counts the field's cells", "leave one of the two out")
    if not isinstance(key.value, list):
        return np.full(
            ground.frame.shape, key.number(of.numbers, f"{of.numbers.expected}, or a list of sources")
        ), notes
    layer = np.ones(ground.frame.shape) if own is None else own
    for source in key.items("a list of sources"):
        says = _value_source(source, of, ground)
        layer = np.where(says.where, says.layer, layer)
        notes += tuple(f"{source.path}: {note}" for note in says.notes)
    return layer, notes


def _over_pixels(of: Quantity, ground: Ground) -> Callable[[Layer], Layer]:
    """What a cell has of its pixels: the sum of their values, the mean of their chances."""
    return ground.total if of is VALUE else ground.mean


def _value_source(key: Key, of: Quantity, ground: Ground) -> Says:
    kind = one_source(key, VALUE_SOURCES)
    options, read = VALUE_SOURCES[kind]
    return read(key.mapping((kind,), optional=[of.name if name == "" else name for name in options]), of, ground)


def _everywhere(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    shape = ground.frame.shape
    return Says(np.full(shape, keys["everywhere"].number(of.numbers)), np.ones(shape, dtype=bool))


def _raster(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """A raster on the map's pixels, or on the cells, of the numbers themselves: values are amounts, and add up."""
    key = keys["raster"]
    how: How = "sum" if of is VALUE else "average"
    raster, free, pixels = raster_on(key, ground, how, AMOUNTS if of is VALUE else PROBABILITIES)
    values = np.where(free, raster.values, 0.0)
    wrong = ~((values >= 0) & (values <= of.numbers.most))
    if wrong.any():
        at, where = first_of(wrong)
        problem = f"names {key.value}, which says {of.name} = {values[at]:g} {where}"
        raise key.fault(problem, of.numbers.expected, "mend the raster")
    return Says(_over_pixels(of, ground)(values) if pixels else values, ground.free, raster.notes)


def _polygons(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """The number of the last polygon that holds the centre of a cell."""
    default = keys[of.name].number(of.numbers) if of.name in keys else None
    frame, place = ground.frame, ground.grid.georeference
    features, _, notes = read_polygons(keys["polygons"].file("a file of polygons"), default, frame, place, of)
    says, where = np.zeros(frame.shape), np.zeros(frame.shape, dtype=bool)
    for feature in features:
        held = feature.mask(frame)
        says, where = np.where(held, feature.number, says), where | held
    if not where.any():
        check_place(keys["polygons"], np.concatenate(rings_of(features)), frame, place, NOWHERE)
    return Says(says, where, notes)


def _value_points(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """Points with a strength each, over what `falloff` says, else in the cell that holds them.

    Where several reach a cell their values add up, and of the chances to detect the best one counts.
    """
    key, frame, place = keys["points"], ground.frame, ground.grid.georeference
    path = key.file("a CSV file with x, y, strength")
    points, _, notes = read_points(path, frame, place, of, columns_said(keys))
    merge = np.add if of is VALUE else np.maximum
    if "falloff" in keys:
        kind, radius = read_falloff(keys["falloff"])
        says = point_threat(points, kind, radius, frame, merge)
        touched = np.column_stack([points[:, :2], np.ones(len(points))])
        where = point_threat(touched, "disc", radius if kind == "disc" else CUT_OFF * radius, frame, np.maximum) > 0
    else:
        at = frame.pixels(points[:, :2])
        held = frame.holds(at)
        says, where = np.zeros(frame.shape), np.zeros(frame.shape, dtype=bool)
        merge.at(says, tuple(at[held].T), points[held, 2])
        where[tuple(at[held].T)] = True
    if not where.any():
        check_place(key, points[:, :2], frame, place, NOWHERE)
    return Says(says, where, notes)


VALUE_SOURCES: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Key], Quantity, Ground], Says]]] = {
    "everywhere": ((), _everywhere),
    "raster": ((), _raster),
    "polygons": (("",), _polygons),
    "points": (("falloff", *COLUMNS), _value_points),
}
"""Every kind of source: the keys that may stand beside it ("": the quantity's own name), and what reads it."""
