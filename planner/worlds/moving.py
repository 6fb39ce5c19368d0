"""Worlds with threats that move, made from movers, or from a scenario's key `movers` (`planner.worlds.movers`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from planner.arguments import check_word, whole
from planner.errors import WorldError
from planner.worlds.beside import check_alone
from planner.worlds.keys import PLACE, Key
from planner.worlds.movers import ANYWHERE, MOST_MOVERS, Mover, Movers, checked
from planner.worlds.quantities import CHANCE
from planner.worlds.world import World

AT, STAYS = "[row, col], whole numbers", "a chance to stay, 0 to 1"
PlannedOn = Literal["patrols", "joined", "own"]
PLAN_ON: tuple[PlannedOn, ...] = get_args(PlannedOn)
PATROLS, JOINED = PLAN_ON[:2]
"""Robots plan on p joined with where the moving threats that have a route are in the long run, the default; with where
all moving threats are, the default before release 0.4."""
DEFAULT = (
    "`plan_on` is not given: robots plan on the moving threats that have a route (patrols); before release 0.4 they "
    "planned on all of them, which `plan_on: joined` still does"
)
"""The note on a scenario that leaves `plan_on` out."""
THREATS = "threats"
"""The h of walkers that are the threats of the map itself."""


def with_movers(world: World, movers: Iterable[Mover | Mapping[str, Any]], plan_on: PlannedOn | None = None) -> World:
    """The world with threats that move beside its own.

    Args:
        movers: each with the keys that a scenario has: `{"walk": 0.2, "h": 0.3, "count": 6}`, or
            `{"patrol": [[0, 0], [0, 1]], "h": 1}`; `{"walk": 0.5, "h": "threats"}`: a walker of each dangerous
            cell, with its p, which leaves it.
        plan_on: "patrols": robots plan on p joined with where movers that have a route are in the long run; "joined":
            with where all movers are; "own": on p alone. None: "patrols" ("joined" before release 0.4).

    Raises WorldError for movers that are none, for a world that is not known, or has types of robots.
    """
    chosen = PATROLS if plan_on is None else plan_on
    check_word("plan_on", chosen, PLAN_ON, WorldError, world.source)
    check_alone(world, "movers")
    members: list[Mover] = []
    own = world.threat
    for number, one in enumerate(movers):
        given = Key(one, f"movers[{number}]", world.source, WorldError)
        if isinstance(one, Mover):
            members.append(one)
        elif _is_of_the_map(given):
            members += _threats_that_walk(given, world)
            own = np.where(world.free, np.float32(0), np.float32(np.nan))
        else:
            members += _read_each(given, world)
    by_default = plan_on is None and not all(one.patrols for one in members)
    found = checked(Movers(own, tuple(members), by_default), world.source)
    return _planned_on(replace(world, doubt=found), found, chosen)


def _planned_on(world: World, movers: Movers, plan_on: PlannedOn) -> World:
    told = [one for one in movers.members if plan_on == JOINED or (one.patrols and plan_on == PATROLS)]
    return replace(world, threat=movers.joined(told, world.source), doubt=movers)


def as_before(world: World) -> World:
    """The world as releases before 0.4 made it: where nobody said what robots plan on, with `plan_on` "joined".

    The world itself where they made the same, or refused it (p of 1).
    """
    if world.movers is None or not world.movers.by_default:
        return world
    try:
        return _planned_on(world, replace(world.movers, by_default=False), JOINED)
    except WorldError:
        return world


def read_movers(key: Key, plan_on: Key | None, world: World) -> World:
    """The world of a scenario with `movers: [{walk: s | patrol: [[r, c], ...], start, h, count}, ...]`, `plan_on`."""
    items = key.items("a list of movers, each {walk or patrol, h}")
    members = [one for item in items for one in ([item.value] if _is_of_the_map(item) else _read_each(item, world))]
    chosen: Any = None if plan_on is None else plan_on.choice(PLAN_ON)
    with key.naming():
        found = with_movers(world, members, chosen)
    return replace(found, notes=(*found.notes, DEFAULT)) if plan_on is None else found


def _is_of_the_map(key: Key) -> bool:
    return isinstance(key.value, dict) and isinstance(key.value.get("h"), str)


def _threats_that_walk(key: Key, world: World) -> list[Mover]:
    """A walker for each dangerous cell of the map, with its p as h."""
    keys = key.mapping(("walk", "h"))
    if keys["h"].value != THREATS:
        raise keys["h"].wrong(f"{CHANCE.expected}, or {THREATS}")
    stay = keys["walk"].number(CHANCE, STAYS)
    return [Mover(float(p), stay) for p in world.threat[world.threat > 0]]


def _read_each(key: Key, world: World) -> list[Mover]:
    """A mover, as many times as its `count` says."""
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
    one = Mover(keys["h"].number(CHANCE), stay, start, route)
    with key.naming():
        checked(Movers(world.threat, (one,)), world.source, named=False)
    return [one] * (keys["count"].number(whole(1, MOST_MOVERS)) if "count" in keys else 1)


def _cell(key: Key, world: World) -> int:
    """The index of a cell of the map."""
    row, col = key.numbers(PLACE, AT, 2)
    height, width = world.shape
    if not (0 <= row < height and 0 <= col < width):
        raise key.wrong(f"a cell of the map: row 0..{height - 1} and col 0..{width - 1}")
    return int(row * width + col)
