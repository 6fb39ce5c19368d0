"""A second opinion on plans: checks what SPEC sections 1, 4 and 5 guarantee, and shares no code with the planner.

Only the plain types are imported; map identity, accessibility, components and visits are worked out here, in other ways
than the planner's. Costs and ties are not checked. Each rule reports its first offence per robot or area, with a count.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np
from validate_areas import History, area_history, area_rules, area_shape_rules
from validate_facts import (
    NEVER,
    Facts,
    Violation,
    facts_of,
    last_move,
    moves_of,
    row_col,
)

from planner.plan.plan import Leg, Plan
from planner.world.world import World

__all__ = ["Violation", "validate"]

OUTCOMES = (
    "complete", "no_progress", "step_limit", "deadline", "not_worth_the_risk", "ended_by_operator", "end_of_paths",
)  # fmt: skip


def validate(plan: Plan, world: World) -> list[Violation]:
    """Every rule that `plan` breaks on `world`; an empty list if it is sound.

    Rules on paths come first, then on areas, then on legs; a plan whose paths or areas leave the map, or whose legs
    are out of range, is not looked at any further. The plan of another planner and the rest of a mission answer for
    their paths alone.

    Cost: O(cells + path entries + area sizes). Raises nothing: what is wrong with the plan is the result.
    Source: SPEC sections 1, 3 (positive costs), 4 and 5; Theorem 1.
    """
    if found := list(_map_rules(plan, world)):
        return found
    facts = facts_of(plan, world)
    for robot in range(len(plan.robots)):
        found += _path_rules(facts, robot)
    if plan.state is not None:
        return found
    found += _end_rules(facts)
    if plan.is_foreign:
        return found
    if unusable := list(area_shape_rules(facts)):
        return found + unusable
    history = area_history(plan, len(facts.threat))
    found += area_rules(facts, history, world.shape)
    if misplaced := [item for robot in range(len(plan.robots)) for item in _leg_shape_rules(facts, robot)]:
        return found + misplaced
    for robot in range(len(plan.robots)):
        found += _leg_rules(facts, robot, history)
    return found + list(_claim_rules(facts, history.shared))


# --- map and paths ---


def _map_rules(plan: Plan, world: World) -> Iterator[Violation]:
    """map, path-empty, off-map: without these nothing else can be looked at."""
    height, width = world.shape
    digest = hashlib.sha256(world.threat.astype("<f4").tobytes(order="C")).hexdigest()
    if plan.shape != (height, width) or plan.sha256 != digest:
        yield Violation("map")
        return
    if not plan.robots:
        yield Violation("path-empty")
    for robot, given in enumerate(plan.robots):
        if not len(given.path):
            yield Violation("path-empty", robot)
        for step in np.flatnonzero((given.path < 0) | (given.path >= height * width))[:1].tolist():
            yield Violation("off-map", robot, step, row_col(given.path[step], width))


def _path_rules(facts: Facts, robot: int) -> Iterator[Violation]:
    """obstacle, jump, range: every entry is free, neighbours are 4-adjacent or equal, no move beyond the range."""
    path = facts.plan.robots[robot].path
    rows, cols = np.divmod(path, facts.width)
    jumps = np.flatnonzero(np.abs(np.diff(rows)) + np.abs(np.diff(cols)) > 1) + 1
    moves, most = np.flatnonzero(np.diff(path)) + 1, moves_of(facts.plan)[robot]
    beyond = moves[int(most) :] if len(moves) > most else moves[:0]
    yield from facts.first_step("obstacle", robot, np.flatnonzero(np.isnan(facts.threat[path])))
    yield from facts.first_step("jump", robot, jumps)
    yield from facts.first_step("range", robot, beyond)


def _end_rules(facts: Facts) -> Iterator[Violation]:
    """outcome, called-off, theorem-1, time: how the run ends follows from who visited what when."""
    plan, firsts = facts.plan, facts.first[facts.accessible]
    if plan.outcome not in OUTCOMES or plan.is_foreign != (plan.outcome == "end_of_paths"):
        yield facts.broken("outcome")
        return
    able = [int(facts.region[r.path[0]]) for i, r in enumerate(plan.robots) if i not in facts.ended]
    missed = np.flatnonzero(facts.accessible & (facts.first == NEVER))
    reachable = missed[np.isin(facts.region[missed], able)]
    if plan.outcome == "not_worth_the_risk" and (plan.settings is None or plan.settings.worth is None):
        yield facts.broken("called-off", step=plan.time)
    left_out = missed if plan.outcome == "complete" else reachable
    if len(left_out) and plan.outcome in ("complete", "no_progress"):
        yield facts.broken("theorem-1", cell=left_out[0])
    end = {"complete": int(firsts.max(initial=0)), "end_of_paths": facts.last}.get(plan.outcome)
    if plan.outcome in ("step_limit", "deadline") and plan.settings is not None:
        end = plan.settings.last_step
    finished = plan.outcome in OUTCOMES[1:5] and not len(missed)
    unfinished = plan.outcome == "complete" and len(missed)
    if finished or (end is not None and plan.time != end and not unfinished):
        yield facts.broken("time", step=plan.time)
    if facts.last > plan.time:
        robot, path = next((i, r.path) for i, r in enumerate(plan.robots) if last_move(r.path) == facts.last)
        yield facts.broken("time", robot=robot, step=facts.last, cell=path[facts.last])


# --- legs ---


def _leg_shape_rules(facts: Facts, robot: int) -> Iterator[Violation]:
    """leg-kind, leg-area, leg-range, leg-overlap, leg-level: what a leg is made of."""
    plan, given = facts.plan, facts.plan.robots[robot]
    areas = plan.areas + plan.areas_added
    before = 0
    for leg in given.legs:
        if leg.kind not in ("travel", "cover"):
            yield facts.broken("leg-kind", robot=robot, step=leg.start)
        if not 0 <= leg.start < leg.stop <= len(given.path):
            yield facts.broken("leg-range", robot=robot, step=leg.start)
        elif leg.start < before:
            yield facts.broken("leg-overlap", robot=robot, step=leg.start, cell=given.path[leg.start])
        if not 0 <= leg.area < len(areas):
            yield facts.broken("leg-area", robot=robot, step=leg.start)
        elif leg.level != areas[leg.area].level:
            yield facts.broken("leg-level", robot=robot, step=leg.start)
        before = max(before, leg.stop)


def _leg_rules(facts: Facts, robot: int, history: History) -> Iterator[Violation]:
    """leg-missing, leg-waits, and the rules of each leg."""
    given = facts.plan.robots[robot]
    moves = np.append(False, given.path[1:] != given.path[:-1])
    inside = np.zeros(len(given.path), dtype=np.bool_)
    for leg in given.legs:
        inside[leg.start : leg.stop] = True
    missing, waits = np.flatnonzero(moves & ~inside), np.flatnonzero(~moves & inside)
    waits = waits[waits > 0]
    yield from facts.first_step("leg-missing", robot, missing)
    yield from facts.first_step("leg-waits", robot, waits)
    for number, leg in enumerate(given.legs):
        if leg.kind == "travel" and facts.adaptive:
            yield from _wary_travel_rules(facts, robot, leg)
        elif leg.kind == "travel":
            following = given.legs[number + 1] if number + 1 < len(given.legs) else None
            yield from _travel_rules(facts, robot, leg, following, history.shared)
        else:
            yield from _cover_rules(facts, robot, leg, history)


def _travel_rules(
    facts: Facts, robot: int, leg: Leg, following: Leg | None, shared: frozenset[int]
) -> Iterator[Violation]:
    """travel-inside, travel-ends: outside its area all the way, and then at once into it.

    Every cost is positive, so only the last cell of the path to an area lies in it, and that one is the cover leg's.
    Only sharing and the end of the run can cut a travel leg short.
    """
    path = facts.plan.robots[robot].path
    entered = np.flatnonzero(np.isin(path[leg.start : leg.stop], facts.plan.area(leg.area).cells))
    yield from facts.first_step("travel-inside", robot, leg.start + entered)
    next_leg = following and (following.kind, following.area, following.start)
    ends = leg.stop > facts.plan.time or facts.ended.get(robot) == leg.area
    if next_leg != ("cover", leg.area, leg.stop) and leg.area not in shared and not ends:
        yield facts.broken("travel-ends", robot=robot, step=leg.stop - 1, cell=path[leg.stop - 1])


def _wary_travel_rules(facts: Facts, robot: int, leg: Leg) -> Iterator[Violation]:
    """travel-inside, for a policy whose robots head for unvisited cells and may change their minds (SPEC section 11).

    Only the last cell of such a path was not visited before, and that one is the cover leg's.
    """
    plan, steps = facts.plan, np.arange(leg.start, leg.stop)
    path = plan.robots[robot].path[steps]
    new = np.isin(path, plan.area(leg.area).cells) & (facts.first[path] == steps)
    for step in steps[new].tolist():
        cell = plan.robots[robot].path[step]
        if sum(step < len(other.path) and other.path[step] == cell for other in plan.robots) == 1:
            yield facts.broken("travel-inside", robot=robot, step=step, cell=cell)


def _cover_rules(facts: Facts, robot: int, leg: Leg, history: History) -> Iterator[Violation]:
    """cover-begins, cover-leaves (`transit="area"`), cover-ends, cover-all.

    A robot that gets the area it idles in covers it from where it stands: then the entry before the leg lies in it.
    What sharing left in the area was visited by the step after its owner's last entry: owners that act later in that
    step are cut off before it; so are robots that drop an area when others have visited the rest of it (SPEC section
    11). At the end of the run a leg may be unfinished.
    """
    plan, path = facts.plan, facts.plan.robots[robot].path
    cells = plan.area(leg.area).cells
    inside = np.isin(path[max(leg.start - 1, 0) : leg.stop], cells)
    own = inside[min(leg.start, 1) :]
    if not (own[0] or inside[0]):
        yield facts.broken("cover-begins", robot=robot, step=leg.start, cell=path[leg.start])
    outside = np.flatnonzero(~own)
    if plan.settings is not None and plan.settings.transit == "area":
        yield from facts.first_step("cover-leaves", robot, leg.start + outside)
    if leg.stop > plan.time or facts.ended.get(robot) == leg.area:
        return
    cut_short = facts.adaptive or leg.area in history.shared
    if not own[-1] and not cut_short:
        yield facts.broken("cover-ends", robot=robot, step=leg.stop - 1, cell=path[leg.stop - 1])
    kept = cells[history.holder[cells] == leg.area]
    late = kept[facts.first[kept] > (leg.stop if cut_short else leg.stop - 1)]
    if len(late) and not facts.breaks_off:
        yield facts.broken("cover-all", robot=robot, step=leg.stop - 1, cell=late[0])


def _claim_rules(facts: Facts, shared: frozenset[int]) -> Iterator[Violation]:
    """claim-*: an area is one robot's, gone to and covered at most once; a robot goes first to the one it was given.

    Where robots look again an area is free until somebody covers it: then it is covered by one robot, once.
    """
    plan = facts.plan
    if facts.adaptive:
        yield from () if facts.breaks_off else _cover_claims(facts)
        return
    claims: dict[int, tuple[int, set[str]]] = {}
    for robot, given in enumerate(plan.robots):
        for leg in given.legs:
            owner, kinds = claims.setdefault(leg.area, (robot, set()))
            given_to = plan.area(leg.area).robot
            cell = given.path[leg.start]
            if robot != (given_to if given_to >= 0 else owner):
                yield facts.broken("claim-owner", robot=robot, step=leg.start, cell=cell)
            elif leg.kind in kinds or (leg.kind == "travel" and kinds):
                yield facts.broken("claim-twice", robot=robot, step=leg.start, cell=cell)
            kinds.add(leg.kind)
    for number, area in enumerate(plan.areas):
        if area.robot >= 0 and number not in shared and plan.time > 0:
            legs = plan.robots[area.robot].legs
            if not legs or legs[0].area != number:
                yield facts.broken("claim-first", robot=area.robot, step=0, cell=area.cells[0])


def _cover_claims(facts: Facts) -> Iterator[Violation]:
    """claim-twice of a policy whose robots may give an area back before they cover it."""
    covered: set[int] = set()
    for robot, given in enumerate(facts.plan.robots):
        for leg in given.legs:
            if leg.kind == "cover" and leg.area in covered:
                yield facts.broken("claim-twice", robot=robot, step=leg.start, cell=given.path[leg.start])
            covered |= {leg.area} if leg.kind == "cover" else set()
