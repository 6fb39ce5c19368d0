"""Worlds with phases, latent hazards, or an uncertain map: from arrays or the keys of a scenario (SPEC 13, 16)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import Numbers, check_word
from planner.errors import WorldError
from planner.world.grid import Ground
from planner.world.keys import CHANCE, Key
from planner.world.levels import find_levels, require_single_uncertainty
from planner.world.moving_threats import PLAN_ON, Foresight, Phases, check_phases
from planner.world.robot_types import COMBINE
from planner.world.threats import all_threats, raster_threat, raster_values
from planner.world.uncertain_maps import (
    AMOUNTS,
    HAZARDS,
    MOST_CHANCES,
    MOST_LEVELS,
    SHARED,
    SPREADS,
    Hazard,
    Uncertain,
    make_hazard,
    maps_of,
    spread_of,
)
from planner.world.world import World

FIRST = PLAN_ON[0]


def with_phases(world: World, phases: Sequence[tuple[Any, World | ArrayLike]], plan_on: Foresight = FIRST) -> World:
    """`World.with_phases`."""
    require_single_uncertainty(world, "phases")
    check_word("plan_on", plan_on, PLAN_ON, WorldError, world.source)
    for number, pair in enumerate(phases):
        if not (isinstance(pair, tuple | list) and len(pair) == 2):
            expected = "pairs (step, threats), e.g. (40, numpy.zeros((20, 20)))"
            raise WorldError(f"phases[{number}] is {type(pair).__name__}", source=world.source, expected=expected)
    begins, maps = [begin for begin, _ in phases], []
    for number, (_, threats) in enumerate(phases):
        name = f"{world.source}: phases[{number}]"
        maps.append((threats if isinstance(threats, World) else World.create(threats, source=name)).threat)
        if maps[-1].shape != world.shape:
            problem = f"phases[{number}] has shape {list(maps[-1].shape)}"
            raise WorldError(problem, source=world.source, expected=f"that of the map, {list(world.shape)}")
    check_phases(begins, np.stack(maps or [world.threat]), world.free, world.source)
    # The world's own threats hold until the first phase.
    if begins[0] != 0:
        begins, maps = [0, *begins], [world.threat, *maps]
    if len(begins) == 1:
        return replace(world, threat=maps[0])
    found = Phases(np.array(begins, dtype=np.int64), np.stack(maps), plan_on)
    return replace(world, threat=found.planned, uncertainty=found)


def read_phases(keys: dict[str, Key], world: World, ground: Ground) -> World:
    """The world of a scenario with `phases: [{from: t, threats: [...]}, ...]` and `plan_on`.

    The threats of a phase replace those of the scenario; they are combined with the map's own.

    Args:
        keys: of the scenario.
        world: its map.
        ground: its cells.

    Raises:
        ScenarioError, MapError: a key or file is invalid.
    """
    pairs, combine, notes = [], keys["combine"].choice(COMBINE), list(world.notes)
    for item in keys["phases"].items("a list of phases, each {from: a step, threats: [...]}"):
        given = item.mapping(("from", "threats"))
        threat, said, *_ = all_threats(given["threats"].items("a list of sources", least=0), combine, ground, {})
        notes.extend(said)
        with item.naming():
            cells = World.create(np.where(ground.free, threat, np.nan), source=world.source)
        pairs.append((given["from"].value, cells))
    if pairs[0][0] == 0 and keys["threats"].value:
        fix = "leave `threats` out, or begin later"
        raise keys["phases"].fault("begin at step 0, where `threats` are to hold", fix=fix)
    plan_on: Any = keys["plan_on"].choice(PLAN_ON) if "plan_on" in keys else FIRST
    with keys["phases"].naming():
        return with_phases(replace(world, notes=tuple(notes)), pairs, plan_on)


# Uncertain worlds: `threat` is the robots' map, and `uncertainty` is the source of draws
# (`planner.world.uncertain_maps`).

FROM_SOURCES = "threats"
"""Instead of a number or a raster: the probabilities of the scenario's `threats`."""
AMOUNT = {"lognormal": "sigma", "beta": "sample_size"}
"""Key for the width of each kind of spread."""
PLANNED_QUANTILE = Numbers(0, 1, above=True, below=True, text="mean, or a number between 0 and 1")
PRIOR_LAST = "; a prior is given after the maps"


def with_hazard(world: World, kind: str, q: ArrayLike, h: ArrayLike = 1.0, learn: bool = False) -> World:
    """`World.with_latent_hazard`."""
    require_single_uncertainty(world, "latent_hazard", over=Hazard)
    if learn and kind == "independent":
        problem = "hazards drawn independently for every visit cannot be estimated"
        raise WorldError(problem, source=world.source, expected="persistent or consumed ones", fix="leave `learn` out")
    hazard = make_hazard("persistent" if kind == "independent" else kind, q, h, world.free, world.source)
    hazard = replace(hazard, learn=bool(learn))
    return replace(world, threat=_frozen(hazard.threat), uncertainty=None if kind == "independent" else hazard)


def with_maps(world: World, maps: Sequence[ArrayLike] | NDArray, plan_on: float | None = None) -> World:
    """`World.with_maps`."""
    require_single_uncertainty(world, "maps", Uncertain, PRIOR_LAST)
    if len(maps) == 0:
        raise WorldError("uncertain maps is empty", source=world.source, expected="a map or more")
    checked = [World.create(one, source=f"{world.source}: maps[{place}]") for place, one in enumerate(maps)]
    for one in checked:
        if one.shape != world.shape or (one.free != world.free).any():
            raise WorldError("has other obstacles or another shape", source=one.source, expected="those of the world")
    if len(checked) * world.threat.size > MOST_CHANCES:
        problem = f"{len(checked)} maps of {world.threat.size} cells"
        raise WorldError(problem, source=world.source, expected=f"at most {MOST_CHANCES} cells in all")
    uncertain = maps_of(np.stack([one.threat for one in checked]), f"one of {len(checked)} equally likely maps")
    return _uncertain_world(world, uncertain, plan_on)


def with_spread(world: World, kind: str, amount: float, by: str = "common", plan_on: float | None = None) -> World:
    """`World.with_spread`."""
    require_single_uncertainty(world, "spread", or_else=PRIOR_LAST)
    levels = find_levels(world, world.free, MOST_LEVELS).of_cell.reshape(world.shape)
    uncertain, cut = spread_of(world.threat, levels, kind, amount, by, world.source)
    notes = (f"the spread on p is cut off below 1 in {cut} cells: their mean is lower than the map's",) if cut else ()
    found = _uncertain_world(world, uncertain, plan_on)
    # The mean of the spread is p up to rounding: the map's own values keep its levels exact.
    return replace(found, threat=world.threat if plan_on is None else found.threat, notes=(*world.notes, *notes))


def _uncertain_world(world: World, uncertain: Uncertain, plan_on: float | None) -> World:
    PLANNED_QUANTILE.check("plan_on", plan_on, WorldError, world.source, optional=True)
    return replace(world, threat=_frozen(uncertain.plan_on(plan_on)), uncertainty=uncertain)


def _frozen(threat: NDArray[np.float32]) -> NDArray[np.float32]:
    threat.setflags(write=False)
    return threat


def read_hazard(key: Key, world: World, ground: Ground) -> World:
    """The world of a scenario with `latent_hazard: {kind, q, h, learn}`; default: q by `threats`, h 1.

    Args:
        key: of the hazard.
        world: the scenario's map.
        ground: its cells.

    Raises:
        ScenarioError, MapError: a key or file is invalid.
    """
    keys = key.mapping(("kind",), optional=("q", "h", "learn"))
    kind = keys["kind"].choice(("independent", *HAZARDS))
    learn = keys["learn"].value if "learn" in keys else False
    if not isinstance(learn, bool):
        raise keys["learn"].wrong("true or false")
    named = [name for name in ("q", "h") if name in keys]
    if kind == "independent":
        if learn:
            raise keys["learn"].wrong(
                "false: every visit is an independent draw: nothing can be estimated", "leave it out"
            )
        if named:
            raise keys[named[0]].wrong("none: independent hazards are the `threats` themselves", "leave it out")
        return world
    given = {"q": Key(FROM_SOURCES, f"{key.path}.q", key.source), "h": Key(1, f"{key.path}.h", key.source)} | keys
    from_sources = [name for name in ("q", "h") if given[name].value == FROM_SOURCES]
    if len(from_sources) == 2:
        raise given["h"].wrong(f"a number or a raster: q is {FROM_SOURCES} already")
    if not from_sources and (world.threat > 0).any():
        raise given["q"].wrong(f"{FROM_SOURCES}, or no threats at all", "leave q out, or the threats")
    (q, more), (h, notes) = (_chances(given[name], world, ground) for name in ("q", "h"))
    with key.naming():
        return with_hazard(replace(world, notes=(*world.notes, *more, *notes)), kind, q, h, learn)


def _chances(key: Key, world: World, ground: Ground) -> tuple[ArrayLike, tuple[str, ...]]:
    """A number, or an array `[H, W]` of probabilities: of the scenario's sources, or of a raster; notes."""
    expected = f"a chance 0..1, a raster file, or {FROM_SOURCES}"
    if key.value == FROM_SOURCES:
        return np.where(world.free, world.threat, 0.0), ()
    if not isinstance(key.value, str):
        return key.number(CHANCE, expected), ()
    found = raster_values(key, ground)
    return found.p, tuple(f"{key.path}: {note}" for note in found.notes)


def read_uncertain(key: Key, world: World, ground: Ground, combine: str) -> World:
    """The world of a scenario with `map_uncertainty: {maps or spread, plan_on}`.

    Args:
        key: of the uncertainty.
        world: the scenario's map.
        ground: its cells.
        combine: how maps combine with the scenario's `threats`, key of `COMBINE`.

    Raises:
        ScenarioError, MapError: a key or file is invalid.
    """
    keys = key.mapping(optional=("maps", "rule", "spread", "plan_on"))
    if ("maps" in keys) == ("spread" in keys):
        raise key.wrong("either maps or spread")
    plan_on = None
    if "plan_on" in keys and keys["plan_on"].value != "mean":
        plan_on = keys["plan_on"].number(PLANNED_QUANTILE)
    with key.naming():
        if "spread" in keys:
            return _read_spread(keys["spread"], world, plan_on)
        maps, notes, rule = [], list(world.notes), {name: keys[name] for name in ("rule",) if name in keys}
        for item in keys["maps"].items("a list of raster files"):
            source = raster_threat({"raster": item} | rule, combine, ground)
            threat = COMBINE[combine](np.where(world.free, world.threat, 0.0), np.where(world.free, source.p, 0.0))
            maps.append(np.where(world.free, threat, np.nan))
            notes.extend(f"{item.path}: {note}" for note in source.notes)
        return with_maps(replace(world, notes=tuple(notes)), maps, plan_on)


def _read_spread(key: Key, world: World, plan_on: float | None) -> World:
    keys = key.mapping(("kind",), optional=("by", *AMOUNT.values()))
    kind = keys["kind"].choice(SPREADS)
    keys = key.mapping(("kind", AMOUNT[kind]), optional=("by",))
    amount = keys[AMOUNT[kind]].number(AMOUNTS)
    by = keys["by"].choice(SHARED) if "by" in keys else SHARED[0]
    return with_spread(world, kind, amount, by, plan_on)
