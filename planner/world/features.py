"""Worlds with an unknown map or moving threats: from arrays, or from the keys of a scenario (SPEC sections 15, 16)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import check_word, whole
from planner.errors import WorldError
from planner.settings import Settings
from planner.world.keys import CHANCE, PLACE, PROBABILITY, Key, read_yaml
from planner.world.levels import require_single_uncertainty
from planner.world.map_knowledge import Sense, make_detector, make_knowledge, make_sense
from planner.world.moving_threats import ANYWHERE, MOST_MOVERS, MovingThreat, MovingThreats, checked
from planner.world.uncertain_maps import Hazard, Uncertain
from planner.world.world import World, check_starts

Obstacles = Literal["unknown", "known"]
OBSTACLES: tuple[Obstacles, ...] = ("unknown", "known")
KEYS = ("true_map", "prior_map", "sensor_range")
DETECTS = ("detect", "false_alarm")
"""Further keys of `sensor_range` for robots that estimate hazards."""
Given = float | Sense | Mapping[str, Any]
"""A range in cells, or `{range, sight}`."""


def with_truth(world: World, truth: World | ArrayLike, sense: Given = 0) -> World:
    """`World.with_true_map`."""
    _check_plain(world)
    true = truth if isinstance(truth, World) else World.create(truth, source=f"{world.source}: truth")
    _check_plain(true)
    return _knowing(world, world.threat, true.threat, sense)


def with_prior(world: World, p: float, obstacles: Obstacles = "unknown", sense: Given = 0) -> World:
    """`World.with_prior_map`."""
    check_word("obstacles", obstacles, OBSTACLES, WorldError, world.source)
    PROBABILITY.check("prior_map", p, WorldError, world.source)
    truth, nowhere = world.met, np.zeros(world.shape, dtype=np.bool_)
    belief = np.where(~world.free if obstacles == "known" else nowhere, np.nan, p).astype(np.float32)
    return _knowing(world, belief, truth, sense)


def with_sense(world: World, sense: Given) -> World:
    """`World.with_sensor_range`."""
    if world.learned_hazard is not None:
        return replace(world, uncertainty=replace(world.learned_hazard, detector=make_detector(sense, world.source)))
    if world.knowledge is None and not isinstance(world.uncertainty, Uncertain):
        problem = "the map is known: a sensor range has no effect"
        hazard = "give `latent_hazard` the key `learn: true`" if isinstance(world.uncertainty, Hazard) else ""
        fix = hazard or "give a `true_map`, a `prior_map`, or `map_uncertainty`"
        raise WorldError(problem, source=world.source, fix=fix)
    return _knowing(world, world.threat, world.met, sense)


def seeing(world: World, far: float) -> World:
    """A copy with another sensor range in cells; obstacles block the view as before.

    Raises:
        WorldError: the map is known.
    """
    sight = world.knowledge is not None and world.knowledge.sense.sight and far < inf
    return with_sense(world, Sense(far, sight))


def _check_plain(world: World) -> None:
    for of in (world.uncertainty, world.knowledge):
        if of is not None:
            raise WorldError(f"a true map together with another uncertainty: {of.description}", source=world.source)


def _knowing(world: World, belief: NDArray[np.float32], truth: NDArray[np.float32], sense: Given) -> World:
    if world.uncertainty is not None and not isinstance(world.uncertainty, Uncertain):
        problem = f"map updates do not support this uncertainty: {world.uncertainty.description}"
        named = "phases" if world.phases is not None else "latent_hazard" if world.movers is None else "moving_threats"
        fix = f"leave out `{named}`, or `true_map`, `prior_map` and `sensor_range`"
        raise WorldError(problem, source=world.source, fix=fix)
    looks = make_sense(sense, world.source)
    # Sensors compare whole maps: with a quantile per level there would be one map for each combination.
    if isinstance(world.uncertainty, Uncertain) and not world.uncertainty.whole and looks.range > 0:
        problem = "sensors need whole maps to choose from; this uncertainty draws one quantile for each level"
        raise WorldError(problem, source=world.source, fix="draw one for the whole map: `by: common`")
    belief.setflags(write=False)
    knowledge = make_knowledge(belief, truth, looks, world.source)
    starts = None if world.starts is None else check_starts(world.starts, truth, world.source)
    return replace(world, threat=belief, knowledge=knowledge, starts=starts)


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
            world = with_truth(world, truth, inf)
            if "prior_map" in keys:  # the scenario's own map is neither the prior nor the true map
                world = replace(world, threat=belief)
    if "prior_map" in keys:
        prior = keys["prior_map"].mapping(("p",), optional=("obstacles",))
        obstacles: Any = prior["obstacles"].choice(OBSTACLES) if "obstacles" in prior else OBSTACLES[0]
        with keys["prior_map"].naming():
            world = with_prior(world, prior["p"].number(PROBABILITY), obstacles, inf)
    key = keys.get("sensor_range", keys[named[0]])
    with key.naming():
        further = () if world.learned_hazard is None else DETECTS
        return with_sense(world, _sense(keys["sensor_range"], further) if "sensor_range" in keys else 0)


def _plain_input(key: Key) -> Path:
    """The file of a true map: not a scenario with a true map, which might be this one."""
    path = key.file("an input file")
    top = read_yaml(path).value if path.suffix.lower() in (".yaml", ".yml") else None
    if isinstance(top, dict) and any(name in top for name in KEYS):
        raise key.wrong(f"an input without {', '.join(KEYS)}")
    return path


def _sense(key: Key, more: tuple[str, ...]) -> Given:
    if not isinstance(key.value, dict):
        return key.value
    return {name: one.value for name, one in key.mapping(("range", *more), optional=("sight",)).items()}


def true_world(world: World) -> World:
    """The true map as a known map; unchanged if the map is known, or if the true map is drawn."""
    return replace(world, threat=world.met, knowledge=None)


def as_planned(world: World, starts: ArrayLike) -> World:
    """The known map that robots plan on: the prior map with the cells in sensor range of the starts updated.

    A true map that is drawn updates nothing. A known map is returned unchanged.

    Args:
        world: the map.
        starts: `[K, 2]`, (row, col).
    """
    known = world.knowledge
    if known is None:
        return world
    threat = world.threat
    if world.uncertainty is None and known.sense.range > 0:
        placed = check_starts(starts, known.truth, world.source)
        cells = placed[:, 0] * world.shape[1] + placed[:, 1]
        seen = known.sense.views(known.free, np.unique(cells))[1]
        threat = threat.copy()
        # Only cells in range of the starts: a plan must not know more than its robots.
        threat.flat[seen] = known.truth.flat[seen]
        threat.setflags(write=False)
    return replace(world, threat=threat, knowledge=None, uncertainty=None)


# Moving threats: from movers, or from a scenario's key `moving_threats` (`planner.world.moving_threats`).

AT, STAYS = "[row, col], whole numbers", "a chance to stay, 0 to 1"
PlannedOn = Literal["patrols", "joined", "own"]
PLAN_ON: tuple[PlannedOn, ...] = get_args(PlannedOn)
PATROLS, JOINED = PLAN_ON[:2]
"""Robots plan on p joined with the long-run positions of moving threats that have a route, the default; or of all
moving threats, the default before release 0.4."""
DEFAULT = (
    "`plan_on` is not given: robots plan on the moving threats that have a route (patrols); before release 0.4 they "
    "planned on all of them, which `plan_on: joined` still does"
)
"""The note on a scenario that leaves `plan_on` out."""
THREATS = "threats"
"""Value of h for walkers that are the threats of the map."""


def with_movers(
    world: World, movers: Iterable[MovingThreat | Mapping[str, Any]], plan_on: PlannedOn | None = None
) -> World:
    """`World.with_moving_threats`."""
    chosen = PATROLS if plan_on is None else plan_on
    check_word("plan_on", chosen, PLAN_ON, WorldError, world.source)
    require_single_uncertainty(world, "moving_threats")
    members: list[MovingThreat] = []
    own = world.threat
    for number, one in enumerate(movers):
        given = Key(one, f"moving_threats[{number}]", world.source, WorldError)
        if isinstance(one, MovingThreat):
            members.append(one)
        elif _is_of_the_map(given):
            members += _threats_that_walk(given, world)
            # The threats move away from their cells, which are safe from then on.
            own = np.where(world.free, np.float32(0), np.float32(np.nan))
        else:
            members += _read_each(given, world)
    # Without free walkers both defaults give the same map.
    by_default = plan_on is None and not all(one.patrols for one in members)
    found = checked(MovingThreats(own, tuple(members), by_default), world.source)
    return _planned_on(replace(world, uncertainty=found), found, chosen)


def _planned_on(world: World, movers: MovingThreats, plan_on: PlannedOn) -> World:
    told = [one for one in movers.members if plan_on == JOINED or (one.patrols and plan_on == PATROLS)]
    return replace(world, threat=movers.joined(told, world.source), uncertainty=movers)


def as_before(world: World) -> World:
    """The world as releases before 0.4 made it: with `plan_on` "joined" if it was not given.

    Unchanged if they made the same world, or rejected it (p = 1).
    """
    if world.movers is None or not world.movers.by_default:
        return world
    try:
        return _planned_on(world, replace(world.movers, by_default=False), JOINED)
    except WorldError:
        return world


def read_movers(key: Key, plan_on: Key | None, world: World) -> World:
    """The world of a scenario with `moving_threats: [{walk: s | patrol: [[r, c], ...], start, h, count}, ...]`.

    Args:
        key: of the moving threats.
        plan_on: of the scenario, or None.
        world: its map.

    Raises:
        ScenarioError: a key is invalid.
    """
    items = key.items("a list of moving threats, each {walk or patrol, h}")
    members = [one for item in items for one in ([item.value] if _is_of_the_map(item) else _read_each(item, world))]
    chosen: Any = None if plan_on is None else plan_on.choice(PLAN_ON)
    with key.naming():
        found = with_movers(world, members, chosen)
    return replace(found, notes=(*found.notes, DEFAULT)) if plan_on is None else found


def _is_of_the_map(key: Key) -> bool:
    return isinstance(key.value, dict) and isinstance(key.value.get("h"), str)


def _threats_that_walk(key: Key, world: World) -> list[MovingThreat]:
    """A walker for each dangerous cell of the map, with its p as h."""
    keys = key.mapping(("walk", "h"))
    if keys["h"].value != THREATS:
        raise keys["h"].wrong(f"{CHANCE.expected}, or {THREATS}")
    stay = keys["walk"].number(CHANCE, STAYS)
    return [MovingThreat(float(p), stay) for p in world.threat[world.threat > 0]]


def _read_each(key: Key, world: World) -> list[MovingThreat]:
    """A mover, repeated `count` times."""
    keys = key.mapping(("h",), optional=("walk", "patrol", "start", "count"))
    if ("walk" in keys) == ("patrol" in keys):
        raise key.wrong("either walk or patrol")
    stay, start = 0.0, ANYWHERE
    route: tuple[int, ...] = ()
    if "walk" in keys:
        stay = keys["walk"].number(CHANCE, STAYS)
    else:
        route = tuple(_cell(item, world) for item in keys["patrol"].items("a list of two cells [row, col] or more", 2))
    if "start" in keys and keys["start"].value != "anywhere":
        start = _cell(keys["start"], world)
    one = MovingThreat(keys["h"].number(CHANCE), stay, start, route)
    with key.naming():
        checked(MovingThreats(world.threat, (one,)), world.source, named=False)
    return [one] * (keys["count"].number(whole(1, MOST_MOVERS)) if "count" in keys else 1)


def _cell(key: Key, world: World) -> int:
    """The index of a cell of the map."""
    row, col = key.numbers(PLACE, AT, 2)
    height, width = world.shape
    if not (0 <= row < height and 0 <= col < width):
        raise key.wrong(f"a cell of the map: row 0..{height - 1} and col 0..{width - 1}")
    return int(row * width + col)


# Version of the closed loop's rules: rollouts under different rules are never added up.
#
# Release 0.4 changed (docs/spec.md, sections 15, 16, 19, 22): the end of a run with phases and detectors, and with all
# robots lost on the way to base; ties between areas for several robot types; the default of `plan_on` for moving
# threats. All else is as in release 0.3, and its results remain usable.

BEFORE, NOW = 1, 2
"""Versions of the rules: of releases before 0.4, and of release 0.4."""
RELEASES = {BEFORE: "before 0.4", NOW: "0.4"}


def rules_of(world: World, settings: Settings, *, closed: bool = True) -> int:
    """The last version that changed a rule used by the team's rollouts.

    Args:
        world: the map.
        settings: of the plan.
        closed: for the closed loop.
    """
    told = world.phases is not None and world.phases.told
    mixed = settings.types is not None and not isinstance(settings.types, str) and len(set(settings.types)) > 1
    by_default = world.movers is not None and world.movers.by_default
    detects = world.learned_hazard is not None and world.learned_hazard.detector is not None
    # The nominal run is a closed loop too, and the open loop follows its paths.
    ends_otherwise = closed and (detects or settings.return_to is not None)
    return NOW if told or mixed or by_default or ends_otherwise else BEFORE
