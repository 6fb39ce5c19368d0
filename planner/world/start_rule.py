"""A team before its mission: its starts (SPEC section 8), the map that it plans on, the version of its rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import argument, did_you_mean, whole
from planner.errors import UsageError, WorldError
from planner.formatting import counted
from planner.settings import Settings
from planner.world.moving_threats import JOINED
from planner.world.world import MAX_ROBOTS, World, check_starts

RULES = ("upper-left",)
"""Start rules by name."""


def check_robots(robots: int | None) -> None:
    """Check a user's number of robots; None is valid.

    Raises:
        UsageError: it is out of range.
    """
    whole(1, MAX_ROBOTS).check("robots", robots, optional=True)


def check_same_team(robots: int | None, starts: NDArray[np.int64], where: str) -> None:
    """Check that a user's number of robots agrees with starts.

    Args:
        robots: or None.
        starts: int64 `[K, 2]`.
        where: source of the starts, for the message.

    Raises:
        UsageError: they contradict each other.
    """
    check_robots(robots)
    if robots is not None and robots != len(starts):
        raise UsageError(
            f"{argument('robots', robots)} contradicts the {counted(len(starts), 'start')} of {where}",
            fix=f"leave {argument('robots')} out, or give as many {argument('starts')}",
        )


def starts_of(world: World, robots: int | None, starts: ArrayLike | None) -> NDArray[np.int64]:
    """Starts for a user's request.

    Args:
        world: the map.
        robots: number of robots, or None.
        starts: `[K, 2]`, or None.

    Returns:
        int64 `[K, 2]`: the given starts; else the world's own, if `robots` agrees; else by the start rule, by default
        for one robot.

    Raises:
        UsageError, WorldError: an invalid or contradictory request.
    """
    check_robots(robots)
    if starts is not None:
        placed = check_starts(starts, world.met, argument("starts"))
        check_same_team(robots, placed, argument("starts"))
        return placed
    if world.starts is not None and robots in (None, len(world.starts)):
        return world.starts
    return place_starts(world, world.team.robots or 1 if robots is None else robots, world.team.start)[0]


def place_starts(world: World, robots: int, rule: str = "upper-left") -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Place robots by a start rule.

    In the largest free component (on a tie that with the lowest cell index) the first start is the safe cell of least
    row + col (then index). From it a breadth-first search through free cells gives the safe cells by (distance, index),
    one robot each, and from the first again if there are fewer cells than robots. Without a safe cell in the component:
    the same over its cells of least p, with a note. Cost: O(cells).

    Args:
        world: the map.
        robots: K.
        rule: name of the rule.

    Returns:
        (starts int64 `[K, 2]`, notes).

    Raises:
        UsageError: an invalid number or rule.

    Source: SPEC section 8.
    """
    check_robots(robots)
    if rule not in RULES:
        raise UsageError(f"start rule {rule!r}", expected=" or ".join(RULES), fix=did_you_mean(rule, RULES))
    component = _largest_component(world)
    wanted = component & (world.met == 0)
    notes: tuple[str, ...] = ()
    if not wanted.any():
        least = world.met[component].min()
        wanted = component & (world.met == least)
        notes = (f"no safe cell in the largest free part of the map: robots start on cells of least threat {least:g}",)
    rows, cols = np.nonzero(wanted)
    first = np.argmin(rows + cols)
    order = _breadth_first(component, int(rows[first]) * world.shape[1] + int(cols[first]), wanted, robots)
    starts = order[np.arange(robots) % len(order)]
    return np.stack(np.divmod(starts, world.shape[1]), axis=1), notes


def _largest_component(world: World) -> NDArray[np.bool_]:
    labels = world.components
    names, lowest, sizes = np.unique(labels[labels > 0], return_index=True, return_counts=True)
    # On a tie the component with the lowest cell: the same on every platform.
    best = np.lexsort((lowest, -sizes))[0]
    return labels == names[best]


def _breadth_first(free: NDArray[np.bool_], source: int, wanted: NDArray[np.bool_], enough: int) -> NDArray[np.int64]:
    """The wanted cells by (distance from `source`, index), int64; at least `enough` unless there are fewer."""
    width = free.shape[1] + 2  # a closed border on every side
    framed = np.zeros((2, len(free) + 2, width), dtype=np.bool_)
    framed[:, 1:-1, 1:-1] = free, wanted
    unseen, padded_wanted = framed.reshape(2, -1)
    layer = np.array([(source // free.shape[1] + 1) * width + source % free.shape[1] + 1])
    unseen[layer] = False
    found: list[NDArray[np.int64]] = []
    count = 0
    while len(layer) and count < enough:
        found.append(layer[padded_wanted[layer]])
        count += len(found[-1])
        near = np.unique(np.concatenate([layer - width, layer - 1, layer + 1, layer + width]))
        layer = near[unseen[near]]
        unseen[layer] = False
    cells = np.concatenate(found)
    return (cells // width - 1) * free.shape[1] + cells % width - 1


# The map that robots plan on (SPEC sections 15, 16).


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
    if world.uncertainty is None and known.sensor.range > 0:
        placed = check_starts(starts, known.truth, world.source)
        cells = placed[:, 0] * world.shape[1] + placed[:, 1]
        seen = known.sensor.views(known.free, np.unique(cells))[1]
        threat = threat.copy()
        # Only cells in range of the starts: a plan must not know more than its robots.
        threat.flat[seen] = known.truth.flat[seen]
        threat.setflags(write=False)
    return replace(world, threat=threat, knowledge=None, uncertainty=None)


def as_before(world: World) -> World:
    """The world as releases before 0.4 made it: with `plan_on` "joined" if it was not given.

    Unchanged if they made the same world, or rejected it (p = 1).
    """
    if world.moving_threats is None or not world.moving_threats.by_default:
        return world
    try:
        threats = replace(world.moving_threats, by_default=False)
        return replace(world, threat=threats.planned(JOINED, world.source), uncertainty=threats)
    except WorldError:
        return world


# Version of the closed loop's rules: rollouts under different rules are never added up.
#
# Release 0.4 changed (docs/spec.md, sections 15, 16, 19, 22): the end of a run with phases and detectors, and with all
# robots lost on the way to base; ties between areas for several robot types; the default of `plan_on` for moving
# threats. All else is as in release 0.3, and its results remain usable.

BEFORE, NOW = 1, 2
"""Versions of the rules: of releases before 0.4, and of release 0.4."""


def rules_of(world: World, settings: Settings, *, closed: bool = True) -> int:
    """The last version that changed a rule used by the team's rollouts.

    Args:
        world: the map.
        settings: of the plan.
        closed: for the closed loop.
    """
    announced = world.phases is not None and world.phases.are_announced
    mixed = settings.types is not None and not isinstance(settings.types, str) and len(set(settings.types)) > 1
    by_default = world.moving_threats is not None and world.moving_threats.by_default
    detects = world.learned_hazard is not None and world.learned_hazard.detector is not None
    # The nominal run is a closed loop too, and the open loop follows its paths.
    ends_otherwise = closed and (detects or settings.return_to is not None)
    return NOW if announced or mixed or by_default or ends_otherwise else BEFORE
