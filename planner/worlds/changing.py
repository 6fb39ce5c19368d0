"""Worlds with threats that change, made from arrays, or from a scenario's key `phases` (`planner.worlds.phases`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from planner.arguments import check_word
from planner.errors import WorldError
from planner.worlds.beside import check_alone
from planner.worlds.grid import Ground
from planner.worlds.keys import Key
from planner.worlds.phases import PLAN_ON, Foresight, Phases, check_phases
from planner.worlds.sources import COMBINE
from planner.worlds.threats import all_threats
from planner.worlds.world import World

FIRST = PLAN_ON[0]


def with_phases(world: World, phases: Sequence[tuple[Any, World | ArrayLike]], plan_on: Foresight = FIRST) -> World:
    """The world with threats that change with time, beginning with its own.

    Args:
        phases: pairs `(begin, threats)`, in order of time: from step `begin` on p of a visit is that of `threats`, an
            array `[H, W]` (NaN = obstacle, as in the world) or a world. One of step 0 takes the place of the world's.
        plan_on: "now": robots are told of a change as it comes; "first": they go by the first map for good; "worst":
            by the cell-wise maximum.

    Raises WorldError for phases that are none, for a world that is not known, or has types of robots.
    """
    check_alone(world, "phases")
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
    if begins[0] != 0:
        begins, maps = [0, *begins], [world.threat, *maps]
    if len(begins) == 1:
        return replace(world, threat=maps[0])
    found = Phases(np.array(begins, dtype=np.int64), np.stack(maps), plan_on)
    return replace(world, threat=found.planned, doubt=found)


def read_phases(keys: dict[str, Key], world: World, ground: Ground) -> World:
    """The world of a scenario with `phases: [{from: t, threats: [...]}, ...]`, `plan_on`.

    A phase's threats stand where those of the scenario do at first: they combine with the map's own.
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
