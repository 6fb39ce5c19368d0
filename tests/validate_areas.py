"""The validator's rules on areas: Algorithm 1's allocation, and the areas that sharing adds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from validate_facts import Facts, Violation, components, cut_off

from planner.ids import NO_AREA, NO_ROBOT, NONE
from planner.plan.plan import Plan


@dataclass(frozen=True, eq=False)
class History:
    """Who held which cell: int64 `[N]` area ids, NO_AREA outside areas.

    Attributes:
        at_start: the area of each cell at t = 0. holder: at the end, when shared areas keep what was visited.
        parents: for each added area the area that its first cell was cut from. shared: those areas.
    """

    at_start: NDArray[np.int64]
    holder: NDArray[np.int64]
    parents: tuple[int, ...]
    shared: frozenset[int]


def area_history(plan: Plan, cells: int) -> History:
    """Replay the areas in id order: each added area takes its cells from the one that held them."""
    holder = np.full(cells, NO_AREA, dtype=np.int64)
    for number, area in enumerate(plan.areas):
        holder[area.cells] = number
    at_start, parents = holder.copy(), []
    for number, area in enumerate(plan.areas_added, start=len(plan.areas)):
        parents.append(int(holder[area.cells[0]]))
        holder[area.cells] = number
    return History(at_start, holder, tuple(parents), frozenset(parents))


def area_rules(facts: Facts, history: History, shape: tuple[int, int]) -> list[Violation]:
    """Every rule on areas; where they do not partition the accessible cells, that alone."""
    if found := list(_partition_rules(facts)):
        return found
    found += _initial_area_rules(facts, history.at_start, shape)
    found += _level_rules(facts, history.at_start)
    found += _owner_rules(facts)
    found += _added_rules(facts, history)
    return found + list(_share_rules(facts, history.parents))


def area_shape_rules(facts: Facts) -> Iterator[Violation]:
    """area-empty, area-off-map, area-sorted, area-robot: what an area is made of, before anything is asked of it."""
    plan = facts.plan
    for area in plan.areas + plan.areas_added:
        cells = area.cells
        if not len(cells):
            yield facts.broken("area-empty")
        elif cells.min() < 0 or cells.max() >= len(facts.threat):
            wrong = int(cells[(cells < 0) | (cells >= len(facts.threat))][0])
            yield facts.broken("area-off-map", cell=wrong)
        elif len(unsorted := np.flatnonzero(np.diff(cells) <= 0)):
            yield facts.broken("area-sorted", cell=cells[unsorted[0] + 1])
        if not NO_ROBOT <= area.robot < len(plan.robots):
            yield facts.broken("area-robot", robot=area.robot)


def _partition_rules(facts: Facts) -> Iterator[Violation]:
    """partition: every accessible cell in exactly one area at t = 0, and no other cell in any."""
    counts = np.zeros(len(facts.threat), dtype=np.int64)
    for area in facts.plan.areas:
        counts[area.cells] += 1
    yield from facts.first_cell("partition", np.flatnonzero(counts != facts.accessible))


def _initial_area_rules(facts: Facts, holder: NDArray[np.int64], shape: tuple[int, int]) -> Iterator[Violation]:
    """area-connected, area-whole, area-order: connected; whole unless split among owners; ids as in SPEC section 4."""
    areas = facts.plan.areas
    level_of = np.full(len(holder), NONE, dtype=np.int64)
    for area in areas:
        level_of[area.cells] = area.level
    part = components(holder.reshape(shape)).ravel()
    whole = components(level_of.reshape(shape)).ravel()
    pieces = Counter(int(whole[area.cells[0]]) for area in areas)
    lowest = {int(component): int(cell) for component, cell in zip(*np.unique(whole, return_index=True), strict=True)}
    keys = []
    for area in areas:
        apart = area.cells[part[area.cells] != part[area.cells[0]]]
        yield from facts.first_cell("area-connected", apart)
        component = int(whole[area.cells[0]])
        is_split = pieces[component] > 1
        if is_split and area.robot < 0:
            yield facts.broken("area-whole", cell=area.cells[0])
        keys.append((is_split, area.level, lowest[component], int(area.cells[0])))
    for number in range(1, len(keys)):
        if keys[number] < keys[number - 1]:
            yield facts.broken("area-order", cell=areas[number].cells[0])


def _level_rules(facts: Facts, holder: NDArray[np.int64]) -> Iterator[Violation]:
    """level-*: 0 iff p = 0; one level a p, rising with p, merged only if there are too many; no gaps; not too many."""
    plan = facts.plan
    most = plan.settings.levels if plan.settings is not None else 0
    cells = np.flatnonzero(holder != NO_AREA)
    levels = np.array([area.level for area in plan.areas], dtype=np.int64)[holder[cells]]
    order = np.argsort(facts.threat[cells], kind="stable")
    cells, levels = cells[order], levels[order]
    threat = facts.threat[cells]
    rise, climb = np.diff(threat) > 0, np.diff(levels)
    quantised = len(np.unique(facts.threat[facts.threat > 0])) + 1 > most
    bad = {
        "level-zero": (levels == 0) != (threat == 0),
        "level-split": np.append(False, ~rise & (climb != 0)),
        "level-merged": np.append(False, rise & (climb == 0) & (not quantised)),
        "level-falls": np.append(False, rise & (climb < 0)),
        "level-gap": ~np.isin(levels - 1, np.append(levels, [-1, 0])),
        "level-count": levels >= most,
    }
    for rule, wrong in bad.items():
        yield from facts.first_cell(rule, cells[wrong])


def _owner_rules(facts: Facts) -> Iterator[Violation]:
    """owner-*: a robot is given at most one area before the start, a safe one, and one that it can reach."""
    seen: set[int] = set()
    for area in facts.plan.areas:
        if area.robot < 0:
            continue
        cell, start = area.cells[0], facts.plan.robots[area.robot].path[0]
        if area.robot in seen:
            yield facts.broken("owner-many", robot=area.robot, step=0, cell=cell)
        seen.add(area.robot)
        if area.level != 0:
            yield facts.broken("owner-safe", robot=area.robot, step=0, cell=cell)
        if facts.region[cell] != facts.region[start]:
            yield facts.broken("owner-reach", robot=area.robot, step=0, cell=cell)


def _added_rules(facts: Facts, history: History) -> Iterator[Violation]:
    """added-inside, added-level, added-connected: an added area is a connected part of one area, at its level."""
    plan, holder = facts.plan, history.at_start.copy()
    for number, area in enumerate(plan.areas_added, start=len(plan.areas)):
        parent = history.parents[number - len(plan.areas)]
        other = area.cells[(holder[area.cells] != parent) | (parent == NO_AREA)]
        yield from facts.first_cell("added-inside", other)
        if not len(other) and area.level != plan.area(parent).level:
            yield facts.broken("added-level", cell=area.cells[0])
        yield from facts.first_cell("added-connected", cut_off(area.cells, facts.width))
        holder[area.cells] = number


def _share_rules(facts: Facts, parents: tuple[int, ...]) -> Iterator[Violation]:
    """share-*: an area is cut once, into two parts or more if by sharing, ids in order of lowest cell; `shares` counts
    those that were shared, not what robots left at the end of their range.
    """
    plan = facts.plan
    shared: set[int] = set()
    left = set(facts.ended.values())
    number = len(plan.areas)
    for parent, group in groupby(parents):
        parts = [plan.area(number + i).cells[0] for i in range(len(list(group)))]
        if parent in shared:
            yield facts.broken("share-once", cell=parts[0])
        if len(parts) < 2 and parent not in left:
            yield facts.broken("share-parts", cell=parts[0])
        if parts != sorted(parts):
            yield facts.broken("share-order", cell=parts[0])
        shared.add(parent)
        number += len(parts)
    if len(shared - left) != plan.shares:
        yield facts.broken("share-count")
