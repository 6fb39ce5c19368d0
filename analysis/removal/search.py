"""Which threat to remove first, for robots that know that it is gone; greedy for several."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Doing, Progress, quiet
from analysis.removal.answer import Clearing, Remove
from analysis.removal.threat import Threat, Turn
from analysis.removal.turns import Search
from analysis.sampling import RolloutChoices
from analysis.trials.halving import check_search, screened
from planner.arguments import argument, check_word, whole
from planner.errors import UsageError
from planner.mrac.areas import find_areas
from planner.settings import Settings
from planner.shown import counted
from planner.worlds.levels import find_levels
from planner.worlds.world import World

SIMULATED = 64
"""Threats that are planned for anew, at most."""


def threats_of(
    world: World, starts: NDArray[np.int64], levels: int, remove: Remove | None = None
) -> tuple[Remove, list[Threat], tuple[str, ...]]:
    """What kind of threat, those that robots at `starts` `[K, 2]` can reach, and notes.

    `remove`: the areas, or the sources of the scenario; None: the sources where there are several. Raises UsageError
    where there is none.
    """
    if remove is not None:
        check_word("remove", remove, ("areas", "sources"))
    things = _things_of(world, starts)
    if remove is None:
        remove = "sources" if len(things) > 1 else "areas"
    threats = things if remove == "sources" else _areas_of(world, starts, levels)
    if not threats and remove == "sources":
        problem = f"{world.source}: no polygon, point or site of its threats lies where a robot can get"
        raise UsageError(problem, fix=f"use {argument('remove', 'areas')}")
    if not threats:
        raise UsageError(f"{world.source}: no cell that a robot can reach is dangerous", expected="a threat to clear")
    return remove, threats, _apart(world, remove, things)


def _apart(world: World, remove: Remove, things: Sequence[Threat]) -> tuple[str, ...]:
    """What is left as it is."""
    if remove == "areas" or world.sources is None:
        return ()
    beyond = len(world.sources.things) - len(things)
    return (f"{counted(beyond, 'threat')} of the scenario threaten no cell that a robot can reach",) if beyond else ()


def _things_of(world: World, starts: NDArray[np.int64]) -> list[Threat]:
    """The polygons, points and sites of a scenario that threaten a cell of theirs, as the scenario orders them."""
    sources = world.sources
    if sources is None or not np.array_equal(sources.threat(), world.threat, equal_nan=True):
        return []  # a world that was changed since it was loaded
    reached, threats = world.accessible(starts).reshape(-1), []
    for number, name in enumerate(sources.names):
        p = np.where(reached, sources.alone(number), 0.0)
        if p.any():
            threats.append(Threat(name, np.flatnonzero(p), float(p.max()), number))
    return threats


def _areas_of(world: World, starts: NDArray[np.int64], levels: int) -> list[Threat]:
    """The connected dangerous areas that robots at `starts` `[K, 2]` can reach: level by level, then by lowest cell."""
    found = find_levels(world, world.accessible(starts), levels)
    areas = [(level, cells) for level, cells in find_areas(world.shape, found) if level > 0]
    return [Threat(f"area {number}", cells, float(found.values[level])) for number, (level, cells) in enumerate(areas)]


def find_clearing(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    *,
    count: int = 1,
    remove: Remove | None = None,
    progress: Progress | None = None,
    doing: Doing | None = None,
) -> Clearing:
    """The threat whose removal gains robots that know of it most cells; `count` of them, one after the other.

    `choices`: rollouts of the last two threats that are left, the same ids for all. An interruption (KeyboardInterrupt)
    leaves the picks so far, `partial`; before the first, it is raised again. `remove`: as of `threats_of`. Raises
    InputError.
    """
    choices = choices.timed(world.pace)
    check_search(world, settings, choices, "a search for what to clear")
    chosen, threats, notes = threats_of(world, starts, settings.levels, remove)
    whole(1, len(threats), "a whole number of threats").check("count", count)
    search = Search(world, starts, settings, choices, progress, doing or quiet, most=SIMULATED)
    turns: list[Turn] = []
    left, now, gain, stopped = threats, world, None, False
    try:
        for _ in range(count):
            turns.append(search.turn(now, left))
            now = turns[-1].picked.threat.cleared(now)
            left = [threat for threat in left if threat is not turns[-1].picked.threat]
        (gain,) = search.confirm([search.anew(world), search.anew(now)])
    except KeyboardInterrupt:
        if not turns:
            raise
        stopped = True
    return Clearing(
        **search.asked(world),
        remove=chosen,
        turns=tuple(turns),
        gain=gain,
        partial=stopped,
        notes=notes + _notes(len(threats), search.room) + screened(settings),
    )


def _notes(threats: int, simulated: int) -> tuple[str, ...]:
    if threats <= simulated:
        return ()
    return (f"of {counted(threats, 'threat')}, those {simulated} by which the bound rises most were planned for anew",)
