"""Tables of the compiled simulator, made once for a plan. Axis letters: `A` accessible cells, `M` areas."""

from __future__ import annotations

from math import floor
from typing import Any

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numba.extending import register_jitable
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import PlanError
from planner.failure_model import PLAIN, FailureModel
from planner.mrac.problem import Problem, Unknown
from planner.plan.plan import Area
from planner.plan.state import ON_ITS_WAY, MissionState, RobotState
from planner.policies.rules import Rule, most_at_risk
from planner.rollout_sampling import chance_bound
from planner.simulator.codes import NO_CELL, Doing, Outcome
from planner.simulator.jit import UNCOUNTED
from planner.simulator.offers import NO_REFUSAL, Offer, by_cost_and_frontier, by_cost_per_cell
from planner.simulator.paths import all_pairs, to_areas
from planner.simulator.policy import Policy
from planner.simulator.searches import BY_INDEX, UNREACHED, SafestPaths, find_safe_parts, neighbour_table
from planner.simulator.state import (
    AREA_BITS,
    MOST_CELLS,
    NO_LEVEL,
    OUT,
    RANKED,
    SURVIVED,
    TO_DO,
    VISITED,
    WORD,
    State,
    Tables,
    fill,
)
from planner.world.map_knowledge import Evidence
from planner.world.moving_threats import MovingThreats
from planner.world.uncertain_maps import bounds_of
from planner.world.world import World

STUCK_AFTER = 2
"""Steps in a row without a move or an allocation after which a run ends with no progress."""
EPSILON = 1e-9
"""Squared distances are whole numbers: a radius of 5 includes (3, 4)."""
NEAR_CELLS = 500
"""Cells that a search passes before the long-range search takes over."""
ASKED_BEFORE = 2
"""Searches for the next area from a cell before its costs to all cells are kept, on maps of MOST_CELLS or more: there a
row costs as much as several searches, on smaller maps hardly more than one."""
DRAWN = "own_counter", "there", "column", "spent", "phases"
"""Fields of `Tables` for draws of uncertain cells and for phases."""
NO_VIEWS = np.zeros(2, dtype=np.int64), np.zeros(0, dtype=np.int32)
UNITS = 2**40
"""The value of all cells in integer units, which add exactly."""
STRIP = 2**20
"""Pairs of a cell and an area sorted at a time, of 40 bytes each."""


class AllPairs:
    """All-pairs tables, kept for other teams on the same accessible cells with the same costs."""

    def __init__(self) -> None:
        self._of: tuple[NDArray[np.int32], NDArray[np.int64]] | None = None
        self._tables: tuple[NDArray, NDArray, NDArray] | None = None

    def tables(
        self, near: NDArray[np.int32], entry: NDArray[np.int64], wide: np.dtype, narrow: np.dtype
    ) -> tuple[NDArray, NDArray, NDArray]:
        """`all_pairs` with these arguments, made again only if cells or costs differ from the last ones."""
        same = self._of is not None and np.array_equal(self._of[0], near) and np.array_equal(self._of[1], entry)
        if self._tables is None or not same:
            self._of, self._tables = (near, entry), all_pairs(near, entry, wide, narrow)
        return self._tables


def make_tables(
    problem: Problem,
    cells: NDArray[np.int64],
    areas: tuple[Area, ...],
    tabled: bool,
    kept: AllPairs | None = None,
    failure_model: FailureModel = PLAIN,
) -> Tables:
    """Make the tables of a problem with this allocation.

    Args:
        problem: world, costs and starts.
        cells: int64 `[A]`, increasing, the accessible cells; in online missions all that may become reachable.
        areas: the areas at t = 0 in id order.
        tabled: with all-pairs tables (6 to 12 bytes per pair of cells), else for searches (a few hundred bytes per
            cell); not in online missions.
        kept: where all-pairs tables are kept from team to team.
        bearing: the failure model.
    """
    compact = np.full(problem.costs.size, NO_CELL, dtype=np.int32)
    compact[cells] = np.arange(len(cells), dtype=np.int32)
    grid = neighbour_table(problem.world.shape, compact != NO_CELL)[cells]
    near = np.where(grid == NO_CELL, NO_CELL, compact[grid])
    entry = problem.costs[cells]
    order = np.concatenate([compact[:0], *(compact[area.cells] for area in areas)])
    begin = np.concatenate([[0], np.cumsum([len(area.cells) for area in areas])]).astype(np.int32)
    level = np.array([area.level for area in areas], dtype=np.int32)
    narrow = np.uint16 if len(cells) < MOST_CELLS else np.uint32
    # Half the bytes of the largest tables if no path can cost more; each width is a separate program.
    unknown = problem.unknown if problem.learns else None
    small = _are_small(problem, near, entry, compact[problem.starts])
    cost = area_cost = np.zeros((0, 0), dtype=np.int32 if small else np.int64)  # each a program
    hop = ranked = area_entry = np.zeros((0, 0), dtype=narrow)
    # With several robot types each has its own costs, so its tables; they are concatenated, type after type.
    if tabled:
        entries = [entry] if problem.own is None else problem.own.costs[:, cells]
        kept = kept if kept and problem.own is None else AllPairs()
        of_types = [kept.tables(near, one, cost.dtype, hop.dtype) for one in entries]
        areas_of = [to_areas(of_type[0], hop.dtype, order, begin) for of_type in of_types]
        cost, hop, ranked = of_types[0] if problem.own is None else map(np.concatenate, zip(*of_types, strict=True))
        area_cost, area_entry = map(np.concatenate, zip(*areas_of, strict=True))
    searches = not tabled or problem.settings.transit == "area"
    beside = np.where(near == NO_CELL, len(cells), near).astype(narrow)
    sides = problem.sides[cells]
    types = None if problem.own is None else problem.settings.types
    tables = Tables(
        near=beside,
        sweep=beside if (sides == BY_INDEX).all() else np.take_along_axis(beside, sides, axis=1),
        cost_to=cost,
        hop_to=hop,
        ranked=ranked,
        area_cost=area_cost,
        area_entry=area_entry,
        **by_price(problem, area_cost, cells, order, begin, level),
        entry=entry if searches else entry[:0],
        **_for_searches(near, entry[: 0 if tabled or unknown else len(cells)], narrow),
        **visit_tables(kinds_of(problem.world, types, len(problem.starts)), cells),
        **failure_tables(failure_model, len(problem.starts)),
        **moving_threat_tables(problem.world.moving_threats, compact, len(cells)),
        **_clocks(problem.settings.paces),
        **_radio(problem, cells),
        starts=compact[problem.starts],
        range=problem.range,
        order=order,
        begin=begin,
        level=level,
        owner=np.array([area.robot for area in areas], dtype=np.int32),
        given=_given(problem, compact, narrow),
        length=np.array([len(path) - 1 for path in problem.given], dtype=np.int32),
        **_ways_home(problem, cells, compact, narrow),
        in_view=np.zeros(0, dtype=narrow),
        quiet_steps=STUCK_AFTER * max(problem.settings.paces, default=1),
    )
    if problem.own is not None:
        tables = tables._replace(type_of=problem.own.of, own_level=problem.own.level)
    if problem.home is not None:
        tables = tables._replace(last_step=problem.home.last, **_trips(problem, cells))
    if unknown is not None:  # a search passes all that is near enough to matter: nothing is far
        goal, learning = int(unknown.accessible.sum()), _learning(unknown, problem.entry, cells, compact, narrow)
        tables = tables._replace(nearby=len(cells), goal=goal, last_update=unknown.last_update, **learning)
    return tables


def _trips(problem: Problem, cells: NDArray[np.int64]) -> dict[str, Any]:
    """Fields of `Tables` for robots that go on after a return."""
    settings, value = problem.settings, problem.world.value
    found: dict[str, Any] = {name: getattr(settings, name) or 0 for name in ("recharge", "deliver_every")}
    if (most := settings.deliver_value) is None:
        return found
    if value is None:
        raise PlanError(f"{argument('deliver_value')} on a map without values", fix="give value, or deliver_every")
    unit = UNITS / max(value.ravel()[cells].sum(), most)
    # Rounded up, and the limit down: cells whose values add up to the limit in decimals always reach it.
    units = np.ceil(value.ravel()[cells] * unit).astype(np.int64)
    return found | {"cell_value": units, "deliver_value": max(int(most * unit * (1 - 1e-9)), 1)}


def _are_small(problem: Problem, near: NDArray[np.int32], entry: NDArray[np.int64], starts: NDArray[np.int32]) -> bool:
    """Whether costs fit into 32 bits on every map that the team may have."""
    if problem.learns and problem.unknown is not None:
        most = problem.unknown.highest
        return bool(problem.entry[most.of_cell[most.accessible]].sum() < 2**31)
    return bool(entry.sum() < 2**31) or most_cost(near, entry, starts) < 2**31


def _learning(
    unknown: Unknown, price: NDArray[np.int64], cells: NDArray[np.int64], compact: NDArray[np.int32], narrow: type
) -> dict[str, Any]:
    """Fields of `Tables` for online missions."""
    begin, seen = unknown.views if unknown.evidence is None or unknown.evidence.detector else NO_VIEWS
    truths, belief = np.ascontiguousarray(unknown.truths[:, cells]), unknown.belief[cells]
    found: dict[str, Any] = {"truths": truths, "belief": belief, "price": price, "view_begin": begin}
    return found | {"in_view": compact[seen].astype(narrow)} | _evidence(unknown.evidence, cells)


def _evidence(evidence: Evidence | None, cells: NDArray[np.int64]) -> dict[str, Any]:
    """Fields of `Tables` for hazard estimates."""
    if evidence is None:
        return {}
    numbers = [evidence.stop, evidence.more, evidence.less, 0, 0, 0, 0]
    # Probabilities as bounds on 24 random bits: the comparison is of whole numbers on every platform.
    if (detector := evidence.detector) is not None:
        bounds = bounds_of(np.array([detector.detect, detector.false_alarm], dtype=np.float32)).tolist()
        numbers[3:] = [detector.alarm, detector.silence, *bounds]
    rows = {"odds": evidence.prior, "survival": evidence.survival, "step": evidence.step}
    return {name: row[cells] for name, row in rows.items()} | {"evidence": np.array(numbers)}


def most_cost(near: NDArray[np.int32], entry: NDArray[np.int64], starts: NDArray[np.int32]) -> int:
    """An upper bound on the cost of all safest paths: by way of a start, from and to the most expensive cells.

    Args:
        near: int32 `[A, 4]`, neighbours, NO_CELL if none.
        entry: int64 `[A]`, entry costs; all cells are reachable from a start.
        starts: int32 `[K]`.
    """
    paths, most, left = SafestPaths(near, entry), 0, np.unique(starts)
    # One search for each connected part that holds a start.
    while len(left):
        start = int(left[0])
        costs = paths.to_all(start)
        back = int((costs - entry)[costs != UNREACHED].max()) + int(entry[start])
        most, left = max(most, back + int(costs.max())), left[costs[left] == UNREACHED]
    return most


def moving_threat_tables(threats: MovingThreats | None, compact: NDArray[np.int32], beyond: int) -> dict[str, Any]:
    """Fields of `Tables` for moving threats.

    Args:
        threats: of the map.
        compact: int32 `[N]`, index of each accessible cell.
        beyond: index for the other cells of routes.
    """
    if threats is None:
        return {}
    ends = np.cumsum([len(one.route) for one in threats.members]).tolist()
    rows = [
        (chance_bound(one.stay), chance_bound(one.hit), end - len(one.route), len(one.route))
        for one, end in zip(threats.members, ends, strict=True)
    ]
    routes = compact[np.array([cell for one in threats.members for cell in one.route], dtype=np.int64)].astype(np.int64)
    return {"moving_threats": np.array(rows, dtype=np.int64), "routes": np.where(routes == NO_CELL, beyond, routes)}


def kinds_of(world: World, types: str | tuple[str, ...] | None, robots: int) -> tuple[World, ...]:
    """The map of each robot type in a team, in order of first use.

    Args:
        world: the map.
        types: of the robots, as in `Settings.types`.
        robots: K.
    """
    return tuple(dict.fromkeys(world.of_robots(types, robots)))


def _clocks(paces: tuple[int, ...]) -> dict[str, Any]:
    """Fields of `Tables` for several speeds."""
    pace = np.array(paces, dtype=np.int64)
    ticks = np.unique(pace)
    clock = np.zeros((len(ticks), -(-len(pace) // WORD)), dtype=np.uint64)
    for robot, number in enumerate(np.searchsorted(ticks, pace)):
        clock[number, robot // WORD] |= np.uint64(1) << np.uint64(robot % WORD)
    return {"pace": pace, "ticks": ticks, "clock": clock}


def _radio(problem: Problem, cells: NDArray[np.int64]) -> dict[str, Any]:
    """Fields of `Tables` for radio range."""
    if problem.settings.radio is None:
        return {}
    place = np.stack(np.divmod(cells, problem.world.shape[1]), axis=1)
    return {"place": place, "bases": problem.bases, "reach": np.array([floor(problem.settings.radio**2 + EPSILON)])}


def visit_tables(kinds: tuple[World, ...], cells: NDArray[np.int64]) -> dict[str, Any]:
    """Fields of `Tables` for failure sampling at visits.

    Args:
        kinds: the map of each robot type.
        cells: int64 `[A]`, the accessible cells.
    """
    if len(kinds) > 1:
        tables = [visit_tables((kind,), cells) for kind in kinds]
        return tables[0] | {
            name: np.concatenate([of[name] for of in tables]) for name in ("exposure", "chance", "bound")
        }
    (world,) = kinds
    draws, (exposure, doses) = world.draws, world.exposures
    exposure = exposure.reshape(-1, world.threat.size)[:, cells].ravel()
    threat = world.by_phase[:, cells].ravel()
    found: dict[str, Any] = {name: Tables._field_defaults[name] for name in DRAWN}
    found |= {"exposure": exposure, "doses": doses, "chance": threat.astype(np.float64)}
    if world.phases is not None:
        found["phases"] = world.phases.begins
    if draws is None:
        return found | {"bound": bounds_of(threat)}
    # `spent` has room only if losses make cells harmless: an empty array turns the feature off (`FEATURES`).
    if draws.spends:
        found["spent"] = np.zeros(-(-len(cells) // WORD), dtype=np.uint64)
    found |= {name: getattr(draws, name)[cells] for name in ("bound", "there", "column")}
    return found | {"own_counter": draws.counter[cells]}


def failure_tables(failure_model: FailureModel, robots: int) -> dict[str, Any]:
    """Fields of `Tables` for the failure model.

    Args:
        bearing: the failure model.
        robots: K.
    """
    if failure_model.is_even:
        return {}
    times, begun = failure_model.times(robots).copy(), failure_model.exp1_begun(robots)
    return {"nodes": failure_model.nodes, "times": times, "begun": begun}


def _for_searches(near: NDArray[np.int32], entry: NDArray[np.int64], narrow: type) -> dict[str, Any]:
    """Fields of `Tables` for long-range searches; empty for an empty `entry`."""
    parts = find_safe_parts(near[: len(entry)], entry)
    # Blocked neighbours have index A, so the table needs one more element.
    node = np.append(parts.node, np.int32(NO_CELL)) if len(entry) else parts.node
    kind_cost, kind, counts = np.unique(entry, return_inverse=True, return_counts=True)
    return {
        "node": node,
        "beside": parts.begin[: len(node)],
        "border": parts.border,
        "kind": kind.astype(narrow),
        "kind_cost": kind_cost,
        "kind_begin": np.cumsum(counts) - counts,
        "nearby": NEAR_CELLS,
        "wide": parts.wide,
        "goal": len(near),
        "patience": ASKED_BEFORE if len(near) >= MOST_CELLS else 0,
    }


def _ways_home(problem: Problem, cells: NDArray[np.int64], compact: NDArray[np.int32], narrow: type) -> dict[str, Any]:
    """Fields of `Tables` for the return to base, and for drives back into radio range."""
    home = problem.home
    if home is None and problem.settings.radio is None:
        return {"onward": np.zeros((0, 0), dtype=narrow)}
    of, onward = problem.back
    onward = onward[:, cells]
    found = {"home_of": of, "onward": np.where(onward == NO_CELL, np.arange(len(cells)), compact[onward])}
    found["onward"] = found["onward"].astype(narrow)
    if home is not None:
        rows = {"home_bases": home.bases, "home_steps": home.steps, "home_cost": home.cost}
        found |= {name: np.ascontiguousarray(row[:, cells]) for name, row in rows.items()}
    return found


def _given(problem: Problem, compact: NDArray[np.int32], narrow: type) -> NDArray:
    """`Tables.given`."""
    longest = max(map(len, problem.given), default=0)
    rows = [np.pad(compact[path], (0, longest - len(path)), mode="edge") for path in problem.given]
    return np.array(rows, dtype=narrow).reshape(len(rows), longest)


def by_price(
    problem: Problem, area_cost: NDArray, cells: NDArray, order: NDArray, begin: NDArray, level: NDArray
) -> dict[str, Any]:
    """Fields of `Tables` that rank areas by price, `foremost` and `counted`.

    From a cell outside an area the path costs at least one entry, and no part of the area has more value than as many
    of its best cells. Exact: different fractions with denominators below 2**26 differ as floats too.

    Args:
        problem: values, costs and rule.
        area_cost: `[A, M]`, of `Tables`; cells: int64 `[A]`; order, begin, level: of `Tables`.
    """
    counted = size = np.diff(begin).astype(np.int64)
    dtype = np.uint16 if len(cells) < MOST_CELLS else np.uint32
    if problem.value is not None:
        counted = size * np.maximum.reduceat(np.append(problem.value[cells][order], 0), begin[:-1])
    if not (area_cost.size and problem.rule.by_price and problem.own is None):
        return {"foremost": np.zeros((0, 0), dtype=dtype), "counted": counted}
    entry, strips = problem.entry[level], np.array_split(area_cost, -(-area_cost.size // STRIP))
    ranked = [_ranked(strip, size, counted, entry)[:, :RANKED] for strip in strips]
    return {"foremost": np.concatenate(ranked).astype(dtype), "counted": counted}


def _ranked(
    cost: NDArray, size: NDArray[np.int64], counted: NDArray[np.int64], entry: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Areas of `size` `[M]` cells by price per `counted` `[M]`, those without value last; M if unreachable."""
    # Whole part and remainder are compared apart: their quotient as one float could tie different fractions.
    whole, rest = np.divmod(np.maximum(cost, entry) + (size - 1) * entry, np.maximum(counted, 1))
    first = np.lexsort((rest / np.maximum(counted, 1), whole, np.broadcast_to(counted == 0, cost.shape), cost < 0))
    return np.where(np.take_along_axis(cost, first, axis=1) < 0, len(size), first)


# A resumed mission as the compiled simulator's first state (`planner.plan.state`). Plain Python, once per thread.

DOINGS = {doing.name.lower(): int(doing) for doing in Doing}


def write_mission_state(mission: MissionState, state: State, tables: Tables, cells: NDArray[np.int64]) -> None:
    """Write the mission into a state.

    Args:
        mission: to resume.
        state: at t = 0 of the mission's areas, changed in place.
        tables: of the mission.
        cells: int64 `[A]`, the accessible cells.
    """
    state.home[np.searchsorted(cells, mission.visited)] |= VISITED
    if len(state.mind):  # a visited cell never joins an area again
        state.known[np.searchsorted(cells, mission.visited)] &= ~np.uint8(OUT)
    survived = np.searchsorted(cells, mission.survived)
    state.home[survived] |= SURVIVED
    if len(state.passes) and not tables.scores:  # a score has no visit before the state
        state.passes[survived] = 1  # the number of earlier visits is not known
    # A mission that knows what is delivered; cells closed since are no longer counted.
    if mission.delivered is not None:
        for row, kept in zip(
            state.undelivered, (*(one.undelivered for one in mission.robots), mission.delivered), strict=False
        ):
            fill(row, np.searchsorted(cells, np.intersect1d(kept, mission.visited)))
        state.marks["delivered"] = np.bitwise_count(state.undelivered[-1:]).sum()
    left = np.bincount(state.home[:-1][state.home[:-1] & VISITED == 0] >> AREA_BITS, minlength=len(mission.areas))
    state.areas["left"][: len(left)] = left
    unassigned = [number for number, area in enumerate(mission.areas) if area.state == "unassigned"]
    level, lowest = tables.level[unassigned], tables.level[unassigned].min(initial=NO_LEVEL)
    alive = sum(robot.alive for robot in mission.robots)
    marks = {
        "covered": len(mission.visited),
        "unsurvived": len(mission.visited) - len(mission.survived),
        "step": mission.step + 1,
        "quiet": mission.quiet,
        "alive": alive,
        "open": len(unassigned),
        "lowest": lowest,
        "unfinished": int(np.count_nonzero(left)),
        "over": 0 if mission.over is None else Outcome[mission.over.upper()] + 1,
    }
    for word, value in marks.items():
        state.marks[word] = value
    if len(tables.times):
        state.robots["cumulative_hazard"] = mission.exposures
    until = state.robots["until"]
    until[:] = tables.range - [robot.moves for robot in mission.robots]
    moving = np.array([robot.status in (*ON_ITS_WAY, "returning") for robot in mission.robots])
    rests = [robot.status in ("idle", "done") and not robot.turned for robot in mission.robots]
    waiting = np.array(rests) & (until > 0)
    # For a moving robot `until` is a turn, not a number of moves.
    until[moving] += mission.step
    for bits, members in (
        (state.open, unassigned),
        (state.lowest, np.array(unassigned, dtype=np.int64)[level == lowest]),
        (state.moving, np.flatnonzero(moving)),
        (state.waiting, np.flatnonzero(waiting)),
    ):
        fill(bits, members)
    for number, robot in enumerate(mission.robots):
        _put_robot(state, number, robot, cells)
        if robot.status == "returning":
            here = np.searchsorted(cells, robot.cell)
            state.robots["next"][number] = tables.onward[tables.home_of[number], here]


def _put_robot(state: State, number: int, robot: RobotState, cells: NDArray[np.int64]) -> None:
    row = state.robots[number]
    row["doing"], row["held"] = DOINGS[robot.status], robot.held
    if robot.status not in ON_ITS_WAY:
        return
    to_do, ahead = np.searchsorted(cells, robot.to_do), np.searchsorted(cells, robot.ahead)
    state.home[to_do] |= TO_DO
    # A leg ends at the next cell to do; the rest of the stored path is computed again from there.
    ends = np.flatnonzero(np.isin(ahead, to_do)) if robot.status == "covering" else ahead[:0]
    leg = ahead[: int(ends[0]) + 1] if len(ends) else ahead
    row["area"], row["left"], row["next"], row["target"] = robot.area, len(to_do), leg[0], leg[-1]
    if len(state.legs):
        row["ahead"] = len(leg) - 1
        state.legs[number, : len(leg) - 1] = leg[:0:-1]


def first_frames(mission: MissionState, cells: NDArray[np.int64]) -> NDArray[np.int32]:
    """Frames of a resumed mission for all steps up to the state's: its robots, repeated; int32 `[step + 1, 3, K]`.

    Args:
        mission: to resume.
        cells: int64 `[A]`, the accessible cells.
    """
    robots = mission.robots
    now = np.array([(robot.cell, DOINGS[robot.status], robot.area) for robot in robots], dtype=np.int32).T
    now[0] = np.searchsorted(cells, now[0])
    return np.broadcast_to(now, (mission.step + 1, 3, len(robots)))


# The policy of a plan for the simulator, and a user's rule as a compiled function.


OF_OFFER = types.int64(*[types.int64] * (1 + len(Offer._fields)))
"""Signature of `Policy.own`."""


def as_function(rule: Rule) -> Any:
    """The order of a user's rule as a function with a C signature: programs are not compiled again for each rule.

    Its arguments: which of the four numbers of `Rule.order`, and the fields of an `Offer`.

    Raises:
        PlanError: the order is not whole-number arithmetic.
    """
    order = register_jitable(**UNCOUNTED)(rule.order)

    def number(which, level, cost, unvisited, entry, value, beyond, frontier, surcharge):  # type: ignore[no-untyped-def]
        (one, two), (three, four) = order(Offer(level, cost, unvisited, entry, value, beyond, frontier, surcharge))
        # A float has no `|`: an order with floats does not compile, instead of being truncated.
        return (one if which == 0 else two if which == 1 else three if which == 2 else four) | 0

    try:
        return numba.cfunc(OF_OFFER, error_model="numpy")(number)
    except NumbaError as error:
        raise PlanError(
            f"the order of rule {rule.name} cannot be compiled",
            expected="whole-number arithmetic of an Offer: two pairs (numerator, denominator)",
            fix="roll it out with planner.rollouts.single_run.PythonLoop",
        ) from error


def dangerous(problem: Problem, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """`Policy.danger`: bool `[A]`, cells of a dangerous level; with several robot types `[Y A]`.

    Args:
        problem: levels and robot types.
        cells: int64 `[A]`, the accessible cells.
    """
    of_cell = problem.levels.of_cell[cells]
    return (of_cell if problem.own is None else problem.own.level[:, of_cell].ravel()) > 0


def make_policy(problem: Problem, cells: NDArray[np.int64], tables: Tables, *, interpreted: bool = False) -> Policy:
    """The policy of a rule that re-evaluates.

    Args:
        problem: rule, settings and costs.
        cells: int64 `[A]`, the accessible cells.
        tables: of the problem.
        interpreted: for the simulator as Python, which supports any rule; compiled programs support exact ones.

    Raises:
        PlanError: see `as_function`.
    """
    rule, settings, unknown = problem.rule, problem.settings, problem.unknown
    ahead = slice(None if rule.looks_ahead and (unknown is None or unknown.looks) else 0)
    # The cap is tabulated by robots alive, so that kernels need no floats.
    alive = range(len(problem.starts) + 1 if settings.risk_cap is not None else 0)
    # By the order, not the name: a new entry of RULES without one in `order_of` would follow `per_cell` silently.
    is_own = rule.order is not (by_cost_and_frontier if rule.looks_ahead else by_cost_per_cell)
    return Policy(
        reevaluates=rule.reevaluates,
        preempts=rule.preempts,
        # Without online updates F = 0, and both orders are the same: no code is compiled for it.
        looks_ahead=rule.looks_ahead if tables.learns is not None else None,
        by_price=rule.by_price,
        limited=rule.limited and problem.theta < NO_REFUSAL,
        entry=problem.entry,
        danger=dangerous(problem, cells),
        cells=problem.costs.size,
        theta=problem.theta,
        robot_value=settings.robot_value is not None,
        most=np.array([most_at_risk(settings.risk_cap or 1.0, robots) for robots in alive], dtype=np.int64),
        value=np.zeros(0, dtype=np.int64) if problem.value is None else problem.value[cells],
        scale=problem.scale,
        beyond=problem.beyond,
        view_begin=tables.view_begin[ahead],
        in_view=tables.in_view[ahead],
        stamp=np.zeros(len(cells) + 1, dtype=np.int64)[ahead],
        is_own=True if is_own else None,
        own=as_function(rule) if is_own and not interpreted else None,
        key=rule.key if is_own and interpreted else None,
    )
