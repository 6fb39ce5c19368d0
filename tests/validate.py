"""A second opinion on plans: checks what docs/spec.md, sections 1, 4 and 5, guarantees; shares no code with it."""

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from planner.plan.plan import Leg, Plan
from planner.simulator.codes import NO_AREA, NO_ROBOT, NONE
from planner.world.world import World

# What the validator's rules share: a broken rule, the facts of a plan on its world, and a flood fill of its own.

NEVER = np.iinfo(np.int64).max


class Violation(NamedTuple):
    """One broken rule, by name. `robot`, `step` and `cell` (row, col) are None where the rule is about none."""

    rule: str
    robot: int | None = None
    step: int | None = None
    cell: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class Facts:
    """What the rules share. Axis `N` = H * W cells.

    Attributes:
        threat: float32 `[N]`. region: `[N]`, component of the free cells; only meaningful on them.
        accessible: bool `[N]`. first: int64 `[N]`, step at which somebody first enters the cell, or NEVER.
        last: the step of the last move of all.
        ended: by robot, the area of its last leg if it made all moves of its range.
    """

    plan: Plan
    width: int
    threat: NDArray[np.float32]
    region: NDArray[np.int32]
    accessible: NDArray[np.bool_]
    first: NDArray[np.int64]
    last: int
    ended: dict[int, int]

    @property
    def adaptive(self) -> bool:
        """The plan follows another policy than the paper's: its robots may change their minds (SPEC section 11)."""
        return self.plan.settings is not None and self.plan.settings.policy != "mrac"

    @property
    def preempts(self) -> bool:
        """Its robots may change their minds while they cover, too."""
        return self.plan.settings is not None and self.plan.settings.rule.preempts

    def broken(
        self, rule: str, *, robot: int | None = None, step: int | None = None, cell: int | None = None
    ) -> Violation:
        return Violation(rule, robot, step, None if cell is None else row_col(cell, self.width))

    def first_step(self, rule: str, robot: int, steps: NDArray[np.int64]) -> Iterator[Violation]:
        """The first of the steps at which the robot breaks the rule, if it does."""
        for step in steps[:1].tolist():
            yield self.broken(rule, robot=robot, step=step, cell=self.plan.robots[robot].path[step])

    def first_cell(self, rule: str, cells: NDArray[np.int64]) -> Iterator[Violation]:
        """The first of the cells in which the rule is broken, if it is."""
        for cell in cells[:1].tolist():
            yield self.broken(rule, cell=cell)


def facts_of(plan: Plan, world: World) -> Facts:
    """The facts of a plan whose paths lie on the map."""
    threat = world.threat.ravel()
    free = ~np.isnan(threat)
    region = components(np.where(free, 0, NO_AREA).reshape(world.shape)).ravel()
    starts = np.array([robot.path[0] for robot in plan.robots], dtype=np.int64)
    accessible = free & np.isin(region, region[starts[free[starts]]])
    first = np.full(len(threat), NEVER, dtype=np.int64)
    for robot in plan.robots:
        np.minimum.at(first, robot.path, np.arange(len(robot.path)))
    last = max(last_move(robot.path) for robot in plan.robots)
    return Facts(plan, world.shape[1], threat, region, accessible, first, last, _at_end_of_range(plan))


def _at_end_of_range(plan: Plan) -> dict[int, int]:
    ranges = moves_of(plan)
    return {
        number: robot.legs[-1].area
        for number, robot in enumerate(plan.robots)
        if robot.legs and np.count_nonzero(np.diff(robot.path)) >= ranges[number]
    }


def moves_of(plan: Plan) -> NDArray[np.float64]:
    """The moves that each robot can make, `[K]`; infinity where nothing limits it."""
    given = None if plan.settings is None else plan.settings.range
    return np.broadcast_to(np.asarray(np.inf if given is None else given, dtype=np.float64), len(plan.robots))


def row_col(cell: int | np.integer, width: int) -> tuple[int, int]:
    """(row, col) of a cell index."""
    return (int(cell) // width, int(cell) % width)


def last_move(path: NDArray[np.int64]) -> int:
    """The last step at which the cell changes; 0 if it never does."""
    return int(np.max(np.flatnonzero(np.diff(path)), initial=-1)) + 1


def components(labels: NDArray[np.int64]) -> NDArray[np.int32]:
    """Number of the 4-connected component of equal labels that each cell is in, `[H, W]`; NO_AREA joins nothing."""
    number = np.arange(labels.size).reshape(labels.shape)
    right = (labels[:, 1:] == labels[:, :-1]) & (labels[:, 1:] != NO_AREA)
    down = (labels[1:] == labels[:-1]) & (labels[1:] != NO_AREA)
    ends = (
        np.concatenate([number[:, 1:][right], number[1:][down]]),
        np.concatenate([number[:, :-1][right], number[:-1][down]]),
    )
    edges = coo_array((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(labels.size, labels.size))
    return connected_components(edges, directed=False)[1].reshape(labels.shape)


def cut_off(cells: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """The cells of an area that are not connected, inside it, with its first cell: none for a connected area."""
    rows, cols = np.divmod(cells, width)
    rows, cols = rows - rows.min(), cols - cols.min()
    labels = np.full((rows.max() + 1, cols.max() + 1), NO_AREA, dtype=np.int64)
    labels[rows, cols] = 0
    part = components(labels)[rows, cols]
    return cells[part != part[0]]


# The validator's rules on areas: Algorithm 1's allocation, and the areas that sharing adds.


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


# A second opinion on plans: checks what SPEC sections 1, 4 and 5 guarantee, and shares no code with the planner.
#
# Only the plain types are imported; map identity, accessibility, components and visits are worked out here, in other
# ways than the planner's. Costs and ties are not checked. Each rule reports its first offence per robot or area, with
# a count.

__all__ = ["Violation", "validate"]

OUTCOMES = (
    "complete", "no_progress", "step_limit", "deadline", "not_worth_the_risk", "ended_by_operator", "end_of_paths",
)  # fmt: skip


def validate(plan: Plan, world: World) -> list[Violation]:
    """Every rule that `plan` breaks on `world`; an empty list if it is sound.

    Rules on paths come first, then on areas, then on legs; a plan whose paths or areas leave the map, or whose legs
    are out of range, is not looked at any further. The external plan and the rest of a mission answer for
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
    if plan.is_external:
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
    if plan.outcome not in OUTCOMES or plan.is_external != (plan.outcome == "end_of_paths"):
        yield facts.broken("outcome")
        return
    able = [int(facts.region[r.path[0]]) for i, r in enumerate(plan.robots) if i not in facts.ended]
    missed = np.flatnonzero(facts.accessible & (facts.first == NEVER))
    reachable = missed[np.isin(facts.region[missed], able)]
    if plan.outcome == "not_worth_the_risk" and (plan.settings is None or plan.settings.robot_value is None):
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
    if len(late) and not facts.preempts:
        yield facts.broken("cover-all", robot=robot, step=leg.stop - 1, cell=late[0])


def _claim_rules(facts: Facts, shared: frozenset[int]) -> Iterator[Violation]:
    """claim-*: an area is one robot's, gone to and covered at most once; a robot goes first to the one it was given.

    Where robots look again an area is free until somebody covers it: then it is covered by one robot, once.
    """
    plan = facts.plan
    if facts.adaptive:
        yield from () if facts.preempts else _cover_claims(facts)
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
