"""Unknown, uncertain and changing maps in a scenario: the keys of SPEC sections 13, 15 and 16; what robots plan on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from planner.world.grid import Ground
from planner.world.keys import CHANCE, PROBABILITY, Key, read_yaml
from planner.world.moving_threats import FORESIGHTS, PLAN_ON
from planner.world.robot_types import COMBINE
from planner.world.threats import all_threats, raster_threat, raster_values
from planner.world.uncertain_maps import AMOUNTS, HAZARDS, SHARED, SPREADS
from planner.world.world import OBSTACLES, PLANNED_QUANTILE, SensorRange, World

KEYS = ("true_map", "prior_map", "sensor_range")
DETECTS = ("detect", "false_alarm")
"""Further keys of `sensor_range` for robots that estimate hazards."""
DEFAULT = (
    "`plan_on` is not given: robots plan on the moving threats that have a route (patrols); before release 0.4 they "
    "planned on all of them, which `plan_on: joined` still does"
)
"""The note on a scenario that leaves `plan_on` out."""
FROM_SOURCES = "threats"
"""Instead of a number or a raster: the probabilities of the scenario's `threats`."""
AMOUNT = {"lognormal": "sigma", "beta": "sample_size"}
"""Key for the width of each kind of spread."""


def read_knowledge(keys: dict[str, Key], world: World, load: Callable[[Path], World]) -> World:
    """The world of a scenario with the keys `true_map`, `prior_map`, `sensor_range`.

    Args:
        keys: of the scenario.
        world: its map.
        load: reads an input file.

    Raises:
        ScenarioError: a key is invalid.
    """
    named = [name for name in KEYS if name in keys]
    if not named:
        return world
    if "true_map" in keys:
        truth = load(_plain_input(keys["true_map"]))
        with keys["true_map"].naming():
            belief = world.threat
            # Unlimited range for now, which accepts any pair of maps; the scenario's range is set last.
            world = world.with_true_map(truth, inf)
            if "prior_map" in keys:  # the scenario's own map is neither the prior nor the true map
                world = replace(world, threat=belief)
    if "prior_map" in keys:
        prior = keys["prior_map"].mapping(("p",), optional=("obstacles",))
        obstacles: Any = prior["obstacles"].choice(OBSTACLES) if "obstacles" in prior else OBSTACLES[0]
        with keys["prior_map"].naming():
            world = world.with_prior_map(prior["p"].number(PROBABILITY), obstacles, inf)
    key = keys.get("sensor_range", keys[named[0]])
    with key.naming():
        further = () if world.learned_hazard is None else DETECTS
        return world.with_sensor_range(_sensor(keys["sensor_range"], further) if "sensor_range" in keys else 0)


def _plain_input(key: Key) -> Path:
    """The file of a true map: not a scenario with a true map, which might be this one."""
    path = key.file("an input file")
    top = read_yaml(path).value if path.suffix.lower() in (".yaml", ".yml") else None
    if isinstance(top, dict) and any(name in top for name in KEYS):
        raise key.wrong(f"an input without {', '.join(KEYS)}")
    return path


def _sensor(key: Key, more: tuple[str, ...]) -> SensorRange:
    if not isinstance(key.value, dict):
        return key.value
    return {name: one.value for name, one in key.mapping(("range", *more), optional=("sight",)).items()}


def read_moving_threats(keys: dict[str, Key], world: World, ground: Ground) -> World:
    """The world of a scenario with `moving_threats: [{walk: s | patrol: [[r, c], ...], start, h, count}, ...]`.

    Args:
        keys: of the scenario.
        world: its map.
        ground: its cells.

    Raises:
        ScenarioError: a key is invalid.
    """
    key, plan_on = keys["moving_threats"], keys.get("plan_on")
    items = key.items("a list of moving threats, each {walk or patrol, h}")
    chosen: Any = None if plan_on is None else plan_on.choice(PLAN_ON)
    with key.naming():
        found = world.with_moving_threats([item.value for item in items], chosen)
    return replace(found, notes=(*found.notes, DEFAULT)) if plan_on is None else found


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
        pairs.append((given["from"].value, np.where(ground.free, threat, np.nan)))
    if pairs[0][0] == 0 and keys["threats"].value:
        fix = "leave `threats` out, or begin later"
        raise keys["phases"].fault("begin at step 0, where `threats` are to hold", fix=fix)
    plan_on: Any = keys["plan_on"].choice(FORESIGHTS) if "plan_on" in keys else FORESIGHTS[0]
    with keys["phases"].naming():
        return replace(world, notes=tuple(notes)).with_phases(pairs, plan_on)


def read_hazard(keys: dict[str, Key], world: World, ground: Ground) -> World:
    """The world of a scenario with `latent_hazard: {kind, q, h, learn}`; default: q by `threats`, h 1.

    Args:
        keys: of the scenario.
        world: its map.
        ground: its cells.

    Raises:
        ScenarioError, MapError: a key or file is invalid.
    """
    key = keys["latent_hazard"]
    keys = key.mapping(("kind",), ("q", "h"), {"learn": False})
    kind, learn = keys["kind"].choice(("independent", *HAZARDS)), keys["learn"].value
    if not isinstance(learn, bool):
        raise keys["learn"].wrong("true or false")
    if kind == "independent":
        for name in ("q", "h", "learn"):
            if name in keys and keys[name].value is not False:
                raise keys[name].wrong("none: independent hazards are the `threats` themselves", "leave it out")
        return world
    given = {"q": Key(FROM_SOURCES, f"{key.path}.q", key.source), "h": Key(1, f"{key.path}.h", key.source)} | keys
    from_sources = [name for name in ("q", "h") if given[name].value == FROM_SOURCES]
    if len(from_sources) == 2:
        raise given["h"].wrong(f"a number or a raster: q is {FROM_SOURCES} already")
    if not from_sources and (world.threat > 0).any():
        raise given["q"].wrong(f"{FROM_SOURCES}, or no threats at all", "leave q out, or the threats")
    (q, more), (h, notes) = (_chances(given[name], world, ground) for name in ("q", "h"))
    with key.naming():
        return replace(world, notes=(*world.notes, *more, *notes)).with_latent_hazard(kind, q, h, learn)


def _chances(key: Key, world: World, ground: Ground) -> tuple[ArrayLike, tuple[str, ...]]:
    """A number, or an array `[H, W]` of probabilities: of the scenario's sources, or of a raster; notes."""
    if key.value == FROM_SOURCES:
        return np.where(world.free, world.threat, 0.0), ()
    if not isinstance(key.value, str):
        return key.number(CHANCE, f"a chance 0..1, a raster file, or {FROM_SOURCES}"), ()
    found = raster_values(key, ground)
    return found.p, tuple(f"{key.path}: {note}" for note in found.notes)


def read_uncertain(keys: dict[str, Key], world: World, ground: Ground) -> World:
    """The world of a scenario with `map_uncertainty: {maps or spread, plan_on}`.

    Args:
        keys: of the scenario.
        world: its map.
        ground: its cells.

    Raises:
        ScenarioError, MapError: a key or file is invalid.
    """
    # Maps combine with the scenario's `threats` as these do with each other.
    key, combine = keys["map_uncertainty"], keys["combine"].value
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
        return replace(world, notes=tuple(notes)).with_maps(maps, plan_on)


def _read_spread(key: Key, world: World, plan_on: float | None) -> World:
    kind = key.mapping(("kind",), ("by", *AMOUNT.values()))["kind"].choice(SPREADS)
    keys = key.mapping(("kind", AMOUNT[kind]), defaults={"by": SHARED[0]})
    return world.with_spread(kind, keys[AMOUNT[kind]].number(AMOUNTS), keys["by"].choice(SHARED), plan_on)


UNCERTAIN = {
    "latent_hazard": read_hazard,
    "map_uncertainty": read_uncertain,
    "moving_threats": read_moving_threats,
    "phases": read_phases,
}
"""Keys of uncertain or changing threats, of which a scenario may have one, and their readers."""
