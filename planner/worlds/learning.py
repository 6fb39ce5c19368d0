"""Worlds whose robots are not told the map, made from arrays, or from a scenario's keys `truth`, `prior`, `sense`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import check_word
from planner.errors import WorldError
from planner.worlds.doubt import Hazard, Uncertain
from planner.worlds.evidence import make_detector
from planner.worlds.keys import Key, read_yaml
from planner.worlds.knowledge import make_knowledge, make_sense
from planner.worlds.quantities import PROBABILITY
from planner.worlds.sight import Sense
from planner.worlds.world import World, check_starts

Obstacles = Literal["unknown", "known"]
OBSTACLES: tuple[Obstacles, ...] = ("unknown", "known")
KEYS = ("truth", "prior", "sense")
DETECTS = ("detect", "false_alarm")
"""What a `sense` says besides where robots learn about hazards."""
Given = float | Sense | Mapping[str, Any]
"""A range in cells, or `{range, sight}`."""


def with_truth(world: World, truth: World | ArrayLike, sense: Given = 0) -> World:
    """The world as robots believe it, but what they meet is the truth: p `[H, W]`, NaN = obstacle, or a world.

    `sense`: how many cells they see, 0: they learn nothing, and the obstacles must be the same. Raises WorldError.
    """
    _check_plain(world)
    true = truth if isinstance(truth, World) else World.create(truth, source=f"{world.source}: truth")
    _check_plain(true)
    return _knowing(world, world.threat, true.threat, sense)


def with_prior(world: World, p: float, obstacles: Obstacles = "unknown", sense: Given = 0) -> World:
    """The world as the truth of robots that know nothing of it: they believe every cell free, with threat p.

    `obstacles="known"`: but for its obstacles, which they are told. Where maps are in doubt the truth is the one that
    is drawn. Raises WorldError.
    """
    check_word("obstacles", obstacles, OBSTACLES, WorldError, world.source)
    PROBABILITY.check("prior", p, WorldError, world.source)
    truth, nowhere = world.met, np.zeros(world.shape, dtype=np.bool_)
    belief = np.where(~world.free if obstacles == "known" else nowhere, np.nan, p).astype(np.float32)
    return _knowing(world, belief, truth, sense)


def with_sense(world: World, sense: Given) -> World:
    """The same with other sensors: of robots that are not told the map, or whose map is in doubt. Raises WorldError.

    Of robots that learn about hazards: a detector, `{range, sight, detect, false_alarm}`.
    """
    if world.learned_hazard is not None:
        return replace(world, doubt=replace(world.learned_hazard, detector=make_detector(sense, world.source)))
    if world.knowledge is None and not isinstance(world.doubt, Uncertain):
        problem = "robots are told the map, and there is nothing to sense"
        hazard = "give the hazard `learn: true`" if isinstance(world.doubt, Hazard) else ""
        fix = hazard or "give a `truth`, a `prior`, or `uncertain` maps"
        raise WorldError(problem, source=world.source, fix=fix)
    return _knowing(world, world.threat, world.met, sense)


def seeing(world: World, far: float) -> World:
    """The same whose robots see so many cells far, as sharply as before: past obstacles or not. Raises WorldError."""
    sight = world.knowledge is not None and world.knowledge.sense.sight and far < inf
    return with_sense(world, Sense(far, sight))


def _check_plain(world: World) -> None:
    for of in (world.doubt, world.knowledge):
        if of is not None:
            raise WorldError(f"a truth beside a map that is in doubt itself: {of.said}", source=world.source)


def _knowing(world: World, belief: NDArray[np.float32], truth: NDArray[np.float32], sense: Given) -> World:
    if world.doubt is not None and not isinstance(world.doubt, Uncertain):
        problem = f"robots would have to learn from what happens to them; here: {world.doubt.said}"
        named = "phases" if world.phases is not None else "hazard" if world.movers is None else "movers"
        fix = f"leave `{named}` out, or `truth`, `prior` and `sense`"
        raise WorldError(problem, source=world.source, fix=fix)
    looks = make_sense(sense, world.source)
    if isinstance(world.doubt, Uncertain) and not world.doubt.whole and looks.range > 0:
        problem = "robots that learn which of several maps is true need maps; here a number is drawn for each level"
        raise WorldError(problem, source=world.source, fix="draw one for the whole map, `by: common`")
    belief.setflags(write=False)
    knowledge = make_knowledge(belief, truth, looks, world.source)
    starts = None if world.starts is None else check_starts(world.starts, truth, world.source)
    return replace(world, threat=belief, knowledge=knowledge, starts=starts)


def read_knowledge(keys: dict[str, Key], world: World, load: Callable[[Path], World]) -> World:
    """The world of a scenario with what its keys `truth`, `prior`, `sense` say; `load`: reads any input file."""
    named = [name for name in KEYS if name in keys]
    if not named:
        return world
    if "truth" in keys:
        truth = load(_plain_input(keys["truth"]))
        with keys["truth"].naming():
            belief = world.threat
            world = with_truth(world, truth, inf)
            if "prior" in keys:  # the scenario's own map is neither believed nor true
                world = replace(world, threat=belief)
    if "prior" in keys:
        prior = keys["prior"].mapping(("p",), optional=("obstacles",))
        obstacles: Any = prior["obstacles"].choice(OBSTACLES) if "obstacles" in prior else OBSTACLES[0]
        with keys["prior"].naming():
            world = with_prior(world, prior["p"].number(PROBABILITY), obstacles, inf)
    key = keys.get("sense", keys[named[0]])
    with key.naming():
        further = () if world.learned_hazard is None else DETECTS
        return with_sense(world, _sense(keys["sense"], further) if "sense" in keys else 0)


def _plain_input(key: Key) -> Path:
    """The file of a truth: no scenario that names a truth of its own, or it might be this one."""
    path = key.file("an input file")
    top = read_yaml(path).value if path.suffix.lower() in (".yaml", ".yml") else None
    if isinstance(top, dict) and any(name in top for name in KEYS):
        raise key.wrong(f"an input without {', '.join(KEYS)}")
    return path


def _sense(key: Key, more: tuple[str, ...]) -> Given:
    if not isinstance(key.value, dict):
        return key.value
    return {name: one.value for name, one in key.mapping(("range", *more), optional=("sight",)).items()}


def as_it_is(world: World) -> World:
    """The true world, told; the world itself where robots are told it, or it is drawn."""
    return replace(world, threat=world.met, knowledge=None)


def as_planned(world: World, starts: ArrayLike) -> World:
    """The world that robots at `starts` `[K, 2]` plan on, known: what they believe once they have looked about.

    Where the truth is drawn nobody has looked yet. The world itself where robots are told it.
    """
    known = world.knowledge
    if known is None:
        return world
    threat = world.threat
    if world.doubt is None and known.sense.range > 0:
        placed = check_starts(starts, known.truth, world.source)
        cells = placed[:, 0] * world.shape[1] + placed[:, 1]
        seen = known.sense.views(known.free, np.unique(cells))[1]
        threat = threat.copy()
        threat.flat[seen] = known.truth.flat[seen]
        threat.setflags(write=False)
    return replace(world, threat=threat, knowledge=None, doubt=None)
