"""A driven mission: orders out, reports in.

The same step as in the closed loop, with reports in the place of random failures. Reports that agree with a rollout's
failure sampling give the same run, event for event (`planner.rollouts.single_run`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from planner.arguments import FRACTION, MAX_STEP, is_whole, whole
from planner.errors import StateError
from planner.failure_model import exposure_of
from planner.files import Json, check_new
from planner.make_plan import allocated_plan, make_plan
from planner.mission import map_updates
from planner.mission.map_updates import HazardUpdates, Seen
from planner.mission.team_control import Fleet, Order, Report, Reports, Why
from planner.mrac.problem import NO_LIMIT, ready_loop
from planner.plan.plan import Plan
from planner.plan.state import MissionState
from planner.rollouts.single_run import NOT_BEGUN, state_of
from planner.settings import AGAIN, Settings
from planner.simulator.codes import Doing, Outcome
from planner.world.world import World

PATIENCE = 20
"""Steps in a row without progress of a robot that was to move, after which its work is reassigned."""
WHY: dict[Doing, Why] = {Doing.TRAVELING: "travel", Doing.COVERING: "cover", Doing.FOLLOWING: "follow"}
WHY |= {Doing.RETURNING: "return"}


class Mission:
    """A team under way. In each step: `orders`, `report` for each robot, `advance`.

    Args:
        world: the map.
        plan: for it; of a resumed mission, from its state.
        patience: steps without progress before a robot's work is reassigned; None: never.
        gain: a robot changes its target if another one saves more than this share of the cost of its path; 1: never, as
            in the closed loop.

    Attributes:
        world: the map, with everything seen, estimated and closed. given: the initial map. closed: closed cells,
            indices.
        seen: p by cell, None: an obstacle; estimates and wrecks included.
        cut_off: cells of wrecks and cells that they cut off, which count for coverage; whether they are visited.

    Raises:
        PlanError: the plan is for another map.
        WorldError: the map is unknown or uncertain.
    """

    def __init__(self, world: World, plan: Plan, *, patience: int | None = PATIENCE, gain: float = 1.0) -> None:
        FRACTION.check("gain", gain)
        whole(1).check("patience", patience, optional=True)
        if world.moving_threats is not None:
            world.require_certain_map("a mission that is driven")
        self.given, self._hazard_updates = world, HazardUpdates(world, plan)
        if self.blocks and plan.settings is not None:
            # The plan itself is without wrecks: the mission adds them to the map as observed obstacles.
            plan = replace(plan, settings=replace(plan.settings, wrecks="ignore"))
        self._file: Path | None = None
        if self._hazard_updates:
            # The plan uses the map as known at the start; `_hazard_updates` adds what robots learn.
            settings, world = plan.require(world), replace(world, uncertainty=None)
            plan = plan if plan.state is not None else make_plan(world, plan.starts, settings)
        self.world, self.patience, self.gain = world, patience, gain
        self.closed: list[int] = []
        self.seen: Seen = {}
        self.cut_off: dict[int, bool] = {}
        self._begin(world, plan)

    def _begin(self, world: World, plan: Plan, before: Mapping[int, bool] | None = None) -> None:
        """Begin to follow a plan; `before`: cells that could be visited before a wreck blocked one."""
        # There are no rules yet for reports of robots that differ, or that recharge.
        problem, areas = ready_loop(plan, world)
        problem.settings.require_uniform("a mission that is driven", *AGAIN)
        self.world, self._plan = world, plan
        within, free = problem.levels.accessible, world.free.ravel()
        cut_off = (self.cut_off | dict(before or {})).items()
        self.cut_off = {cell: was for cell, was in cut_off if not within[cell] and (was or free[cell])}
        last_update, cut = self._hazard_updates.last_update(within), not all(self.cut_off.values())
        self._fleet = Fleet(problem, replace(plan, areas=areas), self.gain, last_update, cut)
        robots = self._fleet.loop.robots
        # A resumed mission goes on with the exposure of its state.
        self._hazards = list(plan.state.exposures) if plan.state is not None else [0] * robots
        self._waits, self._reports = [0] * robots, Reports(self._fleet)
        # Kept until a report deviates from them: orders cost a simulated step.
        self._orders: dict[int, Order] | None = None

    # --- where it stands ---

    @property
    def step(self) -> int:
        """The current step: 0 while robots enter their starts."""
        return self._fleet.step + 1

    @property
    def outcome(self) -> Outcome | None:
        """The outcome of the mission; None while it goes on."""
        outcome = self._fleet.outcome
        return None if outcome is None else outcome.by_deadline(self.settings.ends_by_deadline)

    @property
    def covered(self) -> float:
        """Share of the accessible cells that are visited."""
        return 1 - (self._fleet.unvisited + [*self.cut_off.values()].count(False)) / self.accessible

    @property
    def accessible(self) -> int:
        """Number of cells that can be visited, or could before a wreck."""
        return int(self._fleet.problem.levels.accessible.sum()) + len(self.cut_off)

    @property
    def blocks(self) -> bool:
        """Whether lost robots become obstacles."""
        return self._hazard_updates.wrecks is not None

    @property
    def robots(self) -> int:
        """Number of robots, lost ones included."""
        return self._fleet.loop.robots

    @property
    def last_step(self) -> int:
        """The step at which the mission ends in any case."""
        return self._fleet.problem.max_steps

    @property
    def lost(self) -> tuple[int, ...]:
        """Indices of the lost robots."""
        return tuple(np.flatnonzero(~self._fleet.alive).tolist())

    @property
    def _aside(self) -> list[int]:
        return sorted(self._fleet.aside)

    @property
    def settings(self) -> Settings:
        """Settings of its plan, with the reported ranges of robots."""
        return self._settings_of(self._fleet)

    def _settings_of(self, fleet: Fleet) -> Settings:
        problem = fleet.problem
        # Without any limit the settings stay as in the plan.
        if (problem.range == NO_LIMIT).all():
            return problem.settings
        return replace(problem.settings, range=tuple(np.minimum(problem.range, MAX_STEP).tolist()))

    @property
    def state(self) -> MissionState:
        """The state at the end of the last step, as in state files.

        Raises:
            StateError: the first step has not ended, or robots follow an external plan.
        """
        return self._state_of(self._fleet)

    def _state_of(self, fleet: Fleet) -> MissionState:
        self._check_kept(fleet)
        if fleet.step == NOT_BEGUN:
            raise StateError("the mission has not begun", expected="a mission whose step 0 is over")
        return state_of(fleet, fleet.problem, self._hazards)

    def _check_kept(self, fleet: Fleet) -> None:
        if (fleet.raw.robots["doing"] == Doing.FOLLOWING).any():
            # A state holds areas and paths to them, and an external plan has neither.
            problem = "robots follow an external plan, which no state of a mission holds"
            raise StateError(problem, expected="a plan with areas", fix="plan with `plan`, for the closed loop")

    def rest(
        self, without: tuple[int, ...] = (), *, nominal: bool = True, call_off: bool = False, **changes: Any
    ) -> Plan:
        """The plan of the rest, from `state`; before the first step has ended, of the whole mission.

        Args:
            without: robots that no longer take part.
            call_off: end the mission: robots start their return to base.
            nominal: include the run without losses, whose paths rollouts do not need.
            changes: settings that replace its own.

        Raises:
            StateError, PlanError: there is no such plan.
        """
        planned = make_plan if nominal else allocated_plan
        if self._fleet.step == NOT_BEGUN:
            if without:
                raise StateError("the mission has not begun", expected="a mission whose step 0 is over")
            # Nothing has happened yet, so the plan itself is the plan of the rest.
            settings = replace(self.settings, **changes)
            return self._plan if not changes else planned(self.world, self._plan.starts, settings)
        fleet = self._fleet.fork()
        # Robots without progress get no areas here, as in the mission itself.
        for number in {*map(self._number, without), *self._aside}:
            fleet.retire(number)
        if call_off:
            fleet.call_off()
        state, settings = self._state_of(fleet), replace(self._settings_of(fleet), **changes)
        if settings.policy != self.settings.policy:  # paths of another rule do not apply: areas are allocated again
            state = replace(state, areas=(), robots=tuple(robot.at_rest for robot in state.robots))
        return planned(replace(self.world, uncertainty=None), state.starts, settings, state=state)

    # --- orders out, reports in ---

    def orders(self) -> dict[int, Order]:
        """The order of each robot alive in this step, by its index; empty once the mission is over.

        It takes the reports of this step into account, and assumes that other robots reach their cells. A different
        report can change the orders of others: ask again.
        """
        if self._orders is None:
            self._orders = self._simulated(self._reports)
        return self._orders

    def first_orders(self) -> dict[int, Order]:
        """The orders of this step before its first report, without cells closed since."""
        return self._simulated(Reports(self._fleet))

    def _simulated(self, reports: Reports) -> dict[int, Order]:
        """The orders of this step: it is simulated in a copy, in which robots without a report reach their cells."""
        return {} if self.outcome is not None else self._play(self._fleet.fork(), reports, True)

    def report(
        self,
        robot: int,
        cell: ArrayLike | None = None,
        *,
        stopped: bool = False,
        found: bool = False,
        moves_left: int | None = None,
        step: int | None = None,
        seen: Any = None,
    ) -> None:
        """Report a robot's cell, or its loss. It takes effect in `advance`; repeating it changes nothing.

        Args:
            robot: index.
            cell: (row, col) of the robot, ordered or not; None: unchanged.
            stopped: whether it is lost there.
            found: whether it was lost before, and is back.
            moves_left: moves that it can still make, for example after a battery change.
            step: of the report; None: this one. A late report says where the robot was.
            seen: observed cells, `[[row, col, p], ...]`, p None for an obstacle: in the map from the end of the step
                on; changes update areas and paths (SPEC section 15).

        Raises:
            StateError: the report cannot be true; the mission is unchanged.
        """
        number, late = self._number(robot), len(self._reports.passed)
        if found and cell is None and self.blocks:
            raise StateError(f"robot {number} is found without a cell", expected="its cell: lost robots are obstacles")
        before, there = self._reports.seen, {one: report.cell for one, report in self._reports.now.items()}
        if seen is not None:
            # Stored before the report is checked: a robot cannot be in a cell that it reports as an obstacle.
            self._reports.seen = before | map_updates.seen_by(seen, self._fleet, there)
        try:
            new = self._reports.hear(number, cell, step, moves_left, stopped=bool(stopped), found=bool(found))
        except StateError:
            self._reports.seen = before
            raise
        # A report that the robot is where it was ordered confirms the cached orders of the others.
        due = None if self._orders is None else self._orders.get(number)
        as_ordered = due is not None and new == Report(self._index(due.cell)) and len(self._reports.passed) == late
        if new is not None and not as_ordered:
            self._orders = None

    def _number(self, robot: int) -> int:
        robots = self.robots
        if not is_whole(robot, 0, robots - 1):
            raise StateError(f"robot {robot!r} reports", expected=f"a robot of the mission, 0 to {robots - 1}")
        return int(robot)

    def _index(self, cell: tuple[int, int]) -> int:
        return cell[0] * self.world.shape[1] + cell[1]

    def advance(self) -> None:
        """End the step. A robot without report is where it was, or at t = 0 at its start."""
        fleet = self._fleet
        self._play(fleet, self._reports, False)
        # Announced phases and estimates first: a reported value replaces them.
        held, reported = fleet.places.values(), self._reports.seen
        found = self._hazard_updates.at_end(fleet.step, self.world, held) | reported
        wrecks = self._hazard_updates.new_wrecks(fleet.places)
        # A cell that an operator has closed stays closed, whatever is observed there.
        seen = {cell: p for cell, p in (found | dict.fromkeys(wrecks)).items() if cell not in self.closed}
        self._reports.clear()
        self._orders = None
        changed = map_updates.map_changes(self.world, seen)
        # Taken before the new allocation, which replaces the problem.
        known = fleet.problem.levels.accessible
        # A new allocation needs robots that are alive and steps that are left.
        if len(changed) and held and fleet.step < self.last_step:
            world = map_updates.seen_world(self.world, seen, self.given)
            state, got = map_updates.learned_state(self.state, world, changed, self.settings)
            plan = allocated_plan(replace(world, uncertainty=None), state.starts, self.settings, state=state)
            cells = np.flatnonzero(known) if wrecks else changed[:0]
            self._go_on(world, plan, dict(zip(cells.tolist(), fleet.visited[cells].tolist(), strict=True)))
            # A map update is progress, as in a simulated run (SPEC section 15).
            known = known | self._fleet.problem.levels.accessible
            progress = bool(fleet.s.marks.progress) or got or bool(known[changed].any())
            self._fleet.reopen_step()
            self._fleet.s.marks.progress = int(progress)
            self.seen |= {cell: seen[cell] for cell in changed.tolist()}
        self._fleet.end_step()

    @property
    def awaited(self) -> tuple[int, ...]:
        """Robots with a move in this step that have not reported."""
        return self.awaited_of(self.orders())

    def awaited_of(self, orders: dict[int, Order]) -> tuple[int, ...]:
        """Robots with a move in these orders of this step that have not reported.

        Args:
            orders: by robot.
        """
        fleet, begins = self._fleet, self.step == 0
        return tuple(
            robot
            for robot, order in orders.items()
            if robot not in self._reports.now and (begins or self._index(order.cell) != fleet.cell(robot))
        )

    def _play(self, fleet: Fleet, reports: Reports, ahead: bool) -> dict[int, Order]:
        """Play the step in `fleet` up to its end; its orders. `ahead`: robots without report reach their cells."""
        orders: dict[int, Order] = {}
        fleet.begin_step()
        for number, cell in reports.passed:
            fleet.visit(number, cell)
            if not ahead:
                self._hazard_updates.learn(number, cell, stopped=False)
        for number in range(self.robots):
            report = reports.now.get(number)
            if report is not None and report.found and not fleet.alive[number]:
                fleet.find(number)
            # A robot set aside for lack of progress gets work again once it moves or is recharged.
            if report is not None and (report.cell != fleet.cell(number) or report.moves_left):
                fleet.bring_back(number)
            if not fleet.alive[number]:
                continue
            due = fleet.decide(number)
            orders[number] = self._order(fleet, number, due)
            # At t = 0 robots are placed at their starts, so no report is needed for that.
            if report is None and due is not None and (ahead or fleet.step == 0):
                report = Report(due)
            came = self._turn(fleet, number, due, report)
            if not ahead:
                self._keep_count(number, came, due)
        return orders

    def _order(self, fleet: Fleet, number: int, due: int | None) -> Order:
        """The order from a robot's decision; a robot that gets its area in this step stays and sees its path."""
        ahead, width = fleet.loop.cells[fleet.path_ahead(number)].tolist(), self.world.shape[1]
        # The ordered cell comes first in `cells`, so it must not be listed twice.
        if due is not None and ahead[:1] == [due]:
            ahead = ahead[1:]
        waits = fleet.raw.robots["held"][number] or number in fleet.aside or fleet.moves_left(number) == 0
        why = WHY.get(fleet.doing(number), "hold" if waits else "idle")
        cells = [divmod(cell, width) for cell in [fleet.cell(number) if due is None else due, *ahead]]
        return Order(number, cells[0], tuple(cells[1:]), fleet.area(number), why)

    def _turn(self, fleet: Fleet, number: int, due: int | None, report: Report | None) -> bool:
        """Play the turn of a robot that was to enter `due`; True if it entered a cell."""
        here = fleet.cell(number)
        report = report or Report(here)
        came = report.cell == due or report.cell != here
        if report.cell == due:
            fleet.enter(number)
        elif came:
            fleet.displace(number, report.cell)
        elif due is not None:
            fleet.wait(number)
        if report.moves_left is not None:
            fleet.limit(number, report.moves_left)
        if report.stopped:
            fleet.stop(number)
        elif report.cell == due:
            fleet.survive(number)
        elif came or report.moves_left == 0:
            fleet.go_on(number)
        return came

    def _keep_count(self, number: int, came: bool, due: int | None) -> None:
        """Update a robot's cumulative hazard, its report, and its number of steps without a move."""
        fleet, cell = self._fleet, self._fleet.cell(number)
        if came:
            self._hazards[number] += int(exposure_of(self._hazard_updates.met(fleet.step, self.world).flat[cell]))
        if came or not fleet.alive[number]:
            self._hazard_updates.learn(number, cell, stopped=not fleet.alive[number])
        self._waits[number] = 0 if came or due is None else self._waits[number] + 1
        if self.patience is not None and self._waits[number] >= self.patience and fleet.doing(number) in WHY:
            fleet.set_aside(number)

    def call_off(self) -> None:
        """End the mission: all robots return to base.

        Raises:
            StateError: the first step has not ended, or robots do not return to base.
        """
        if self.settings.return_to is None or self._fleet.step == NOT_BEGUN:
            problem = "a mission cannot be ended before it has begun, or if its robots do not return to base"
            raise StateError(problem, expected="robots on a mission with `return_to`", fix="give them no more orders")
        self._fleet.call_off()
        self._orders = None

    def close(self, cells: ArrayLike) -> None:
        """Close cells: they become obstacles. Robots keep their areas, and drive around.

        Args:
            cells: `[[row, col], ...]`.

        Raises:
            StateError: a robot is on one of them, or has reported so; they separate a robot from the cell that it
                reported in this step; or they are not on the map.
        """
        closed, world = map_updates.closed_by(cells, self._reports)
        if self._fleet.step == NOT_BEGUN:
            plan = make_plan(world, self._plan.starts, self.settings)
        else:
            state = map_updates.closed_state(self.state, world, self.settings.levels)
            plan = make_plan(replace(world, uncertainty=None), state.starts, self.settings, state=state)
        self._go_on(world, plan)
        self._fleet.come_home()
        self.closed = sorted({*self.closed, *closed.tolist()})

    def _go_on(self, world: World, plan: Plan, before: Mapping[int, bool] | None = None) -> None:
        """Continue with another plan, on an updated map; `before`: as in `_begin`."""
        kept, reports, aside = (self._hazards, self._waits), self._reports, self._aside
        self._begin(world, plan, before)
        self._hazards, self._waits = kept
        # Reports made before cells were closed still hold.
        self._reports.carry(reports)
        self._set_aside(aside)

    # --- kept in a file ---

    @classmethod
    def resume(cls, path: str | Path, world: World, plan: Plan, **how: Any) -> Self:
        """The mission that `save` wrote.

        Args:
            path: the file.
            world: the map before any cell was closed.
            plan: whose settings apply.
            how: `patience` and `gain` of the mission.

        Raises:
            StateError: the file is invalid.
        """
        known, rest, keys = map_updates.read_rest(path, world, plan)
        mission = cls(known, rest, **how)
        mission.given, mission._file = world, Path(path).resolve()
        if plan.settings is not None and plan.settings.blocks:
            cell, robot = whole(0, world.threat.size - 1), whole(0, mission.robots - 1)
            mission._hazard_updates.wrecks = map_updates.read_pairs(keys["wrecks"], "[robot, cell]", robot, cell)
            mission._begin(known, rest, map_updates.read_pairs(keys["cut_off"], "[cell, visited]", cell, whole(0, 1)))
        heard, waits = (keys[name].items("a list of steps", least=0) for name in ("heard", "waits"))
        for steps in (heard, waits):
            if steps and len(steps) != mission.robots:
                problem, expected = f"holds a mission of {len(steps)} robots", f"one of {mission.robots}, as planned"
                raise StateError(problem, source=path, expected=expected, fix="give the robots of the mission")
        mission._waits[: len(waits)] = [one.number(whole(0)) for one in waits]
        robot = whole(0, mission.robots - 1, what="the number of a robot")
        mission._set_aside([one.number(robot) for one in keys["aside"].items("a list of robots", least=0)])
        mission.closed = [one.value for one in keys["closed"].items("a list of cells", least=0)]
        mission.seen, mission._reports.seen = map_updates.read_seen(keys["seen"]), map_updates.read_seen(keys["sees"])
        mission._hazard_updates.read(keys["odds"])
        for report in keys["reports"].items("a list of reports", least=0):
            map_updates.hand_on(mission.report, report)
        step = whole(NOT_BEGUN, mission.step, what="a step that is not to come")
        mission._reports.heard[: len(heard)] = [one.number(step) for one in heard]
        return mission

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the mission, with the reports of the current step, so that it can be resumed.

        The data is on the disk before this returns. The file that it was resumed from, or has written before, is
        replaced.

        Args:
            path: the file.
            force: replace another existing file; else that is a UsageError.

        Raises:
            StateError: robots follow an external plan.
        """
        file = Path(path).resolve()
        if file != self._file:
            check_new(path, force=force)
        self._check_kept(self._fleet)
        state = self.state.to_json() if self.step > 0 else None
        more: Json = {"seen": _pairs(self.seen), "sees": _pairs(self.sees)}
        more |= {"closed": self.closed, "range": self.settings.range, "aside": self._aside}
        more |= {"reports": self.as_json(), "heard": self._reports.heard, "waits": self._waits}
        more |= {"odds": self._hazard_updates.to_json()}
        if self._hazard_updates.wrecks is not None:
            cut_off = [[cell, int(was)] for cell, was in self.cut_off.items()]
            more |= {"wrecks": [*self._hazard_updates.wrecks.items()], "cut_off": cut_off}
        more |= {} if self.outcome is None else {"ended": self.known()}
        map_updates.write_mission(path, self.world, state, more)
        self._file = file

    def known(self) -> Json:
        """Status for files and `drive`: the current step, or the one at which the mission ended."""
        ended = {} if self.outcome is None else {"outcome": self.outcome.word}
        step = self.step if self.outcome is None else self._fleet.step
        return ended | {"step": step, "covered": self.covered, "lost": list(self.lost)}

    @property
    def sees(self) -> Seen:
        """Cells observed in the current step, as in `seen`."""
        return dict(self._reports.seen)

    def as_json(self) -> list[Json]:
        """The reports of the current step, as in files."""
        return self._reports.as_json()

    def _set_aside(self, robots: list[int]) -> None:
        """Mark robots without progress, as in another fleet."""
        for number in robots:
            if self._fleet.s.robots[number].doing != Doing.DEAD:
                self._fleet.set_aside(number)
            self._fleet.aside.add(number)


def _pairs(seen: Seen) -> list[list[float | None]]:
    """Observed cells as in files."""
    return [[cell, p] for cell, p in sorted(seen.items())]
