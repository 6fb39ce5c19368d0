"""A second opinion on plans: checks what SPEC sections 1, 4 and 5 guarantee, and shares no code with the planner.

Only the plain types are imported; map identity, accessibility, components and visits are worked out here, in other ways
than the planner's. Costs and ties are not checked. Each rule reports its first offence per robot or area, with a count.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from planner.plan import Area, Leg, Plan, RobotPlan
from planner.world import World

NEVER = np.iinfo(np.int64).max
NO_AREA = -1
OUTCOMES = ("complete", "stuck", "timeout", "paths")


@dataclass(frozen=True)
class Violation:
    """One broken rule. `robot`, `step` and `cell` (row, col) are None where the rule is about none.

    Attributes:
        rule: short name of the rule, for programs. message: one line that names robot, step and cell [row, col].
    """

    rule: str
    robot: int | None
    step: int | None
    cell: tuple[int, int] | None
    message: str


@dataclass(frozen=True, eq=False)
class _Facts:
    """What the rules share. Axis `N` = H * W cells.

    Attributes:
        threat: float32 `[N]`. region: `[N]`, component of the free cells; only meaningful on them.
        accessible: bool `[N]`. first: int64 `[N]`, step at which somebody first enters the cell, or NEVER.
        last: the step of the last move of all.
    """

    plan: Plan
    width: int
    threat: NDArray[np.float32]
    region: NDArray[np.int32]
    accessible: NDArray[np.bool_]
    first: NDArray[np.int64]
    last: int

    def broken(
        self, rule: str, what: str, *, robot: int | None = None, step: int | None = None, cell: int | None = None
    ) -> Violation:
        return _violation(self.width, rule, what, robot, step, cell)


def validate(plan: Plan, world: World) -> list[Violation]:
    """Every rule that `plan` breaks on `world`; an empty list if it is sound.

    Rules on paths come first, then on areas, then on legs; a plan whose paths or areas leave the map, or whose legs
    are out of range, is not looked at any further. The plan of another planner answers for its paths alone.

    Cost: O(cells + path entries + area sizes). Raises nothing: what is wrong with the plan is the result.
    Source: SPEC sections 1, 3 (positive costs), 4 and 5; Theorem 1.
    """
    if found := list(_map_rules(plan, world)):
        return found
    facts = _facts(plan, world)
    for robot in range(len(plan.robots)):
        found += _path_rules(facts, robot)
    found += _end_rules(facts)
    if plan.is_foreign:
        return found
    if outside := list(_area_shape_rules(facts)):
        return found + outside
    holder, divided = _holders(plan, len(facts.threat)), list(_partition_rules(facts))
    if divided:
        return found + divided
    found += [*_initial_area_rules(facts, holder, world.shape), *_level_rules(facts, holder), *_owner_rules(facts)]
    parents = list(_take_added(facts, holder, found))
    found += _share_rules(facts, parents)
    if misplaced := [item for robot in range(len(plan.robots)) for item in _leg_shape_rules(facts, robot)]:
        return found + misplaced
    for robot in range(len(plan.robots)):
        found += _leg_rules(facts, robot, holder, set(parents))
    return found + list(_claim_rules(facts, set(parents)))


# --- map and paths ---


def _map_rules(plan: Plan, world: World) -> Iterator[Violation]:
    """map, path-empty, off-map: without these nothing else can be looked at."""
    height, width = world.shape
    digest = hashlib.sha256(world.threat.astype("<f4").tobytes(order="C")).hexdigest()
    if plan.shape != (height, width) or plan.sha256 != digest:
        yield _violation(width, "map", f"the plan is for another map, of {list(plan.shape)} cells")
        return
    if not plan.robots:
        yield _violation(width, "path-empty", "the plan has no robots")
    for robot, given in enumerate(plan.robots):
        if not len(given.path):
            yield _violation(width, "path-empty", "has no path, not even a start", robot)
        off = np.flatnonzero((given.path < 0) | (given.path >= height * width))
        if len(off):
            cell = int(given.path[off[0]])
            what = f"cell index {cell} is off the map{_count(off)}"
            yield Violation("off-map", robot, int(off[0]), divmod(cell, width), f"robot {robot}, step {off[0]}: {what}")


def _path_rules(facts: _Facts, robot: int) -> Iterator[Violation]:
    """obstacle, jump: every entry is free, neighbours are 4-adjacent or equal."""
    path = facts.plan.robots[robot].path
    blocked = np.flatnonzero(np.isnan(facts.threat[path]))
    if len(blocked):
        step = int(blocked[0])
        yield facts.broken("obstacle", f"an obstacle{_count(blocked)}", robot=robot, step=step, cell=path[step])
    rows, cols = np.divmod(path, facts.width)
    jumps = np.flatnonzero(np.abs(np.diff(rows)) + np.abs(np.diff(cols)) > 1) + 1
    if len(jumps):
        step = int(jumps[0])
        before = _row_col(path[step - 1], facts.width)
        what = f"a jump from {list(before)}{_count(jumps)}"
        yield facts.broken("jump", what, robot=robot, step=step, cell=path[step])


def _end_rules(facts: _Facts) -> Iterator[Violation]:
    """outcome, theorem-1, time: how the run ends follows from who visited what when."""
    plan, firsts = facts.plan, facts.first[facts.accessible]
    if plan.outcome not in OUTCOMES or plan.is_foreign != (plan.outcome == "paths"):
        yield facts.broken("outcome", f"outcome {plan.outcome!r} of a plan {_with(plan)} settings")
        return
    missed = np.flatnonzero(facts.accessible & (facts.first == NEVER))
    if len(missed) and plan.outcome in ("complete", "stuck"):
        what = f"accessible, but nobody visits it (outcome {plan.outcome}){_count(missed)}"
        yield facts.broken("theorem-1", what, cell=missed[0])
    end = {"complete": int(firsts.max(initial=0)), "paths": facts.last}.get(plan.outcome)
    if plan.outcome == "timeout" and plan.settings is not None:
        end = plan.settings.max_steps
    if plan.outcome in ("stuck", "timeout") and not len(missed):
        yield facts.broken("time", f"ends as {plan.outcome} with every cell visited", step=plan.time)
    elif not (plan.outcome == "complete" and len(missed)) and end is not None and plan.time != end:
        yield facts.broken("time", f"the run ends then, but {plan.outcome} means step {end}", step=plan.time)
    if facts.last > plan.time:
        robot, path = next((i, r.path) for i, r in enumerate(plan.robots) if _last_move(r.path) == facts.last)
        what = f"moves after the end of the run at step {plan.time}"
        yield facts.broken("time", what, robot=robot, step=facts.last, cell=path[facts.last])


# --- areas ---


def _area_shape_rules(facts: _Facts) -> Iterator[Violation]:
    """area-empty, area-off-map, area-sorted, area-robot: what an area is made of, before anything is asked of it."""
    plan = facts.plan
    for number, area in enumerate(plan.areas + plan.areas_added):
        cells = area.cells
        if not len(cells):
            yield facts.broken("area-empty", f"area {number} has no cells")
        elif cells.min() < 0 or cells.max() >= len(facts.threat):
            wrong = int(cells[(cells < 0) | (cells >= len(facts.threat))][0])
            yield facts.broken("area-off-map", f"area {number}: off the map", cell=wrong)
        elif len(unsorted := np.flatnonzero(np.diff(cells) <= 0)):
            what = f"area {number}: its cells are not increasing{_count(unsorted)}"
            yield facts.broken("area-sorted", what, cell=cells[unsorted[0] + 1])
        if not -1 <= area.robot < len(plan.robots):
            yield facts.broken("area-robot", f"area {number} is given to a robot that does not exist", robot=area.robot)


def _partition_rules(facts: _Facts) -> Iterator[Violation]:
    """partition: every accessible cell in exactly one area at t = 0, and no other cell in any."""
    counts = np.zeros(len(facts.threat), dtype=np.int64)
    for area in facts.plan.areas:
        counts[area.cells] += 1
    wrong = np.flatnonzero(counts != facts.accessible)
    if len(wrong):
        kind = "accessible" if facts.accessible[wrong[0]] else "not accessible"
        what = f"{kind}, and in {counts[wrong[0]]} areas{_count(wrong)}"
        yield facts.broken("partition", what, cell=wrong[0])


def _initial_area_rules(facts: _Facts, holder: NDArray[np.int64], shape: tuple[int, int]) -> Iterator[Violation]:
    """area-connected, area-whole, area-order: connected; whole unless split among owners; ids as in SPEC section 4."""
    areas = facts.plan.areas
    level_of = np.full(len(holder), NO_AREA, dtype=np.int64)
    for area in areas:
        level_of[area.cells] = area.level
    part = _components(holder.reshape(shape)).ravel()
    whole = _components(level_of.reshape(shape)).ravel()
    lowest = _lowest_cell(whole)
    pieces = Counter(int(whole[area.cells[0]]) for area in areas)
    keys = []
    for number, area in enumerate(areas):
        apart = area.cells[part[area.cells] != part[area.cells[0]]]
        if len(apart):
            what = f"area {number} is not connected: cut off from {list(_row_col(area.cells[0], facts.width))}"
            yield facts.broken("area-connected", what, cell=apart[0])
        component = int(whole[area.cells[0]])
        is_split = pieces[component] > 1
        if is_split and area.robot < 0:
            what = f"area {number} is a part of a larger area of its level, but no robot's"
            yield facts.broken("area-whole", what, cell=area.cells[0])
        keys.append((is_split, area.level, int(lowest[component]), int(area.cells[0])))
    for number in range(1, len(keys)):
        if keys[number] < keys[number - 1]:
            what = f"area {number} should come before area {number - 1}: by level, by lowest cell, split ones last"
            yield facts.broken("area-order", what, cell=areas[number].cells[0])


def _level_rules(facts: _Facts, holder: NDArray[np.int64]) -> Iterator[Violation]:
    """level-*: 0 iff p = 0; one level a p; none merged without need; never falling with p; without gaps; not too many."""
    plan = facts.plan
    most = plan.settings.levels if plan.settings is not None else 0
    cells = np.flatnonzero(holder != NO_AREA)
    levels = np.array([area.level for area in plan.areas], dtype=np.int64)[holder[cells]]
    order = np.argsort(facts.threat[cells], kind="stable")
    cells, levels = cells[order], levels[order]
    threat = facts.threat[cells]
    rise, climb = np.diff(threat) > 0, np.diff(levels)
    quantised = len(np.unique(facts.threat[facts.threat > 0])) + 1 > most
    gaps = ~np.isin(levels - 1, np.append(levels, [-1, 0]))
    for rule, bad, what in (
        ("level-zero", (levels == 0) != (threat == 0), "level 0 is p = 0, and nothing else"),
        ("level-split", np.append(False, ~rise & (climb != 0)), "cells of the same p have different levels"),
        ("level-merged", np.append(False, rise & (climb == 0) & (not quantised)), "levels of different p are merged"),
        ("level-falls", np.append(False, rise & (climb < 0)), "a larger p has a smaller level"),
        ("level-gap", gaps, "no cell has the level below"),
        ("level-count", levels >= most, f"more than {most} levels"),
    ):
        wrong = np.flatnonzero(bad)
        if len(wrong):
            at = wrong[0]
            where = f"area {holder[cells[at]]} of level {levels[at]}, p = {threat[at]:g}"
            yield facts.broken(rule, f"{where}: {what}{_count(wrong)}", cell=cells[at])


def _owner_rules(facts: _Facts) -> Iterator[Violation]:
    """owner-*: a robot is given at most one area before the start, a safe one, and one that it can reach."""
    seen: set[int] = set()
    for number, area in enumerate(facts.plan.areas):
        if area.robot < 0:
            continue
        cell, start = area.cells[0], facts.plan.robots[area.robot].path[0]
        if area.robot in seen:
            yield facts.broken("owner-many", f"area {number} is its second", robot=area.robot, step=0, cell=cell)
        seen.add(area.robot)
        if area.level != 0:
            what = f"area {number} of level {area.level} is given to it before the start: not safe"
            yield facts.broken("owner-safe", what, robot=area.robot, step=0, cell=cell)
        if facts.region[cell] != facts.region[start]:
            yield facts.broken("owner-reach", f"cannot reach its area {number}", robot=area.robot, step=0, cell=cell)


def _take_added(facts: _Facts, holder: NDArray[np.int64], found: list[Violation]) -> Iterator[int]:
    """added-inside, added-level, added-connected; moves the cells in `holder` and yields the area each is cut from."""
    plan = facts.plan
    for number, area in enumerate(plan.areas_added, start=len(plan.areas)):
        parent = int(holder[area.cells[0]])
        other = area.cells[(holder[area.cells] != parent) | (parent == NO_AREA)]
        if len(other):
            what = f"added area {number} is no part of one area (of area {parent} and of {holder[other[0]]})"
            found.append(facts.broken("added-inside", what, cell=other[0]))
        elif area.level != plan.area(parent).level:
            what = f"added area {number} has level {area.level}, area {parent} has {plan.area(parent).level}"
            found.append(facts.broken("added-level", what, cell=area.cells[0]))
        apart = _cut_off(area.cells, facts.width)
        if len(apart):
            found.append(facts.broken("added-connected", f"added area {number} is not connected", cell=apart[0]))
        holder[area.cells] = number
        yield parent


def _share_rules(facts: _Facts, parents: list[int]) -> Iterator[Violation]:
    """share-*: an area is shared once, into two parts or more, ids in order of lowest cell; `shares` counts that."""
    plan = facts.plan
    shared: set[int] = set()
    number = len(plan.areas)
    for parent, group in groupby(parents):
        parts = [plan.area(number + i).cells[0] for i in range(len(list(group)))]
        if parent in shared:
            yield facts.broken("share-once", f"area {parent} is shared, but it was completed before", cell=parts[0])
        if len(parts) < 2:
            yield facts.broken("share-parts", f"area {parent} is shared into one part", cell=parts[0])
        if parts != sorted(parts):
            yield facts.broken("share-order", f"the parts of area {parent} are not by lowest cell", cell=parts[0])
        shared.add(parent)
        number += len(parts)
    if len(shared) != plan.shares:
        yield facts.broken("share-count", f"{len(shared)} areas were cut, the plan says {plan.shares}")


# --- legs ---


def _leg_shape_rules(facts: _Facts, robot: int) -> Iterator[Violation]:
    """leg-kind, leg-area, leg-range, leg-overlap, leg-level: what a leg is made of."""
    plan, given = facts.plan, facts.plan.robots[robot]
    areas = plan.areas + plan.areas_added
    before = 0
    for number, leg in enumerate(given.legs):
        if leg.kind not in ("travel", "cover"):
            yield facts.broken("leg-kind", f"leg {number} is a {leg.kind!r}", robot=robot, step=leg.start)
        if not 0 <= leg.start < leg.stop <= len(given.path):
            what = f"leg {number} is [{leg.start}, {leg.stop}) of a path of {len(given.path)} entries"
            yield facts.broken("leg-range", what, robot=robot, step=leg.start)
        elif leg.start < before:
            what = f"leg {number} begins before the one before it ends ({before})"
            yield facts.broken("leg-overlap", what, robot=robot, step=leg.start, cell=given.path[leg.start])
        if not 0 <= leg.area < len(areas):
            yield facts.broken("leg-area", f"leg {number} is about area {leg.area}: none", robot=robot, step=leg.start)
        elif leg.level != areas[leg.area].level:
            what = f"leg {number} has level {leg.level}, area {leg.area} has {areas[leg.area].level}"
            yield facts.broken("leg-level", what, robot=robot, step=leg.start)
        before = max(before, leg.stop)


def _leg_rules(facts: _Facts, robot: int, holder: NDArray[np.int64], shared: set[int]) -> Iterator[Violation]:
    """leg-missing, leg-waits, and the rules of each leg. `holder`: the area of each cell at the end."""
    given = facts.plan.robots[robot]
    moves = np.append(False, given.path[1:] != given.path[:-1])
    inside = np.zeros(len(given.path), dtype=np.bool_)
    for leg in given.legs:
        inside[leg.start : leg.stop] = True
    missing, waits = np.flatnonzero(moves & ~inside), np.flatnonzero(~moves & inside)
    for rule, steps, what in (("leg-missing", missing, "moves in no leg"), ("leg-waits", waits[waits > 0], "waits")):
        if len(steps):
            step = int(steps[0])
            what = f"{what}{' inside a leg' if rule == 'leg-waits' else ''}{_count(steps)}"
            yield facts.broken(rule, what, robot=robot, step=step, cell=given.path[step])
    for number, leg in enumerate(given.legs):
        if leg.kind == "travel":
            following = given.legs[number + 1] if number + 1 < len(given.legs) else None
            yield from _travel_rules(facts, robot, leg, following, shared)
        else:
            yield from _cover_rules(facts, robot, leg, holder, shared)


def _travel_rules(facts: _Facts, robot: int, leg: Leg, following: Leg | None, shared: set[int]) -> Iterator[Violation]:
    """travel-inside, travel-ends: outside its area all the way, and then at once into it.

    Every cost is positive, so only the last cell of the path to an area lies in it, and that one is the cover leg's.
    Only sharing and the end of the run can cut a travel leg short.
    """
    path = facts.plan.robots[robot].path
    entered = np.flatnonzero(np.isin(path[leg.start : leg.stop], facts.plan.area(leg.area).cells))
    if len(entered):
        step = leg.start + int(entered[0])
        what = f"already in area {leg.area} while it travels there"
        yield facts.broken("travel-inside", what, robot=robot, step=step, cell=path[step])
    arrives = following is not None and (following.kind, following.area, following.start) == (
        "cover",
        leg.area,
        leg.stop,
    )
    if not arrives and leg.area not in shared and leg.stop <= facts.plan.time:
        what = f"stops its travel to area {leg.area}, and does not cover it next"
        yield facts.broken("travel-ends", what, robot=robot, step=leg.stop - 1, cell=path[leg.stop - 1])


def _cover_rules(
    facts: _Facts, robot: int, leg: Leg, holder: NDArray[np.int64], shared: set[int]
) -> Iterator[Violation]:
    """cover-begins, cover-leaves (`transit="area"`), cover-ends, cover-all.

    A robot that gets the area it idles in covers it from where it stands: then the entry before the leg lies in it.
    What sharing left in the area was visited by the step after its owner's last entry: owners that act later in that
    step are cut off before it. At the end of the run a leg may be unfinished.
    """
    plan, path = facts.plan, facts.plan.robots[robot].path
    cells = plan.area(leg.area).cells
    inside = np.isin(path[max(leg.start - 1, 0) : leg.stop], cells)
    own = inside[min(leg.start, 1) :]
    if not (own[0] or inside[0]):
        what = f"covers area {leg.area} from outside it"
        yield facts.broken("cover-begins", what, robot=robot, step=leg.start, cell=path[leg.start])
    outside = np.flatnonzero(~own)
    if len(outside) and plan.settings is not None and plan.settings.transit == "area":
        step = leg.start + int(outside[0])
        what = f"leaves area {leg.area} while it covers it{_count(outside)}"
        yield facts.broken("cover-leaves", what, robot=robot, step=step, cell=path[step])
    if leg.stop > plan.time:
        return
    if not own[-1] and leg.area not in shared:
        what = f"ends its cover of area {leg.area} outside it"
        yield facts.broken("cover-ends", what, robot=robot, step=leg.stop - 1, cell=path[leg.stop - 1])
    kept = cells[holder[cells] == leg.area]
    late = kept[facts.first[kept] > (leg.stop if leg.area in shared else leg.stop - 1)]
    if len(late):
        what = f"ends its cover of area {leg.area} before this cell of it is visited{_count(late)}"
        yield facts.broken("cover-all", what, robot=robot, step=leg.stop - 1, cell=late[0])


def _claim_rules(facts: _Facts, shared: set[int]) -> Iterator[Violation]:
    """claim-*: an area is one robot's, travelled to at most once and covered at most once; the first leg is the one given."""
    plan = facts.plan
    claims: dict[int, tuple[int, set[str]]] = {}
    for robot, given in enumerate(plan.robots):
        for leg in given.legs:
            owner, kinds = claims.setdefault(leg.area, (robot, set()))
            given_to = plan.area(leg.area).robot
            cell = given.path[leg.start]
            if robot != (given_to if given_to >= 0 else owner):
                what = f"works on area {leg.area}, which is robot {given_to if given_to >= 0 else owner}'s"
                yield facts.broken("claim-owner", what, robot=robot, step=leg.start, cell=cell)
            elif leg.kind in kinds or (leg.kind == "travel" and kinds):
                what = f"goes to area {leg.area} a second time"
                yield facts.broken("claim-twice", what, robot=robot, step=leg.start, cell=cell)
            kinds.add(leg.kind)
    for number, area in enumerate(plan.areas):
        if area.robot >= 0 and number not in shared and plan.time > 0:
            legs = plan.robots[area.robot].legs
            if not legs or legs[0].area != number:
                what = f"is given area {number} before the start, but does not go there first"
                yield facts.broken("claim-first", what, robot=area.robot, step=0, cell=area.cells[0])
