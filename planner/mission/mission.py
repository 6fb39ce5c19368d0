"""A mission that is driven: orders out, reports in.

What simulates, drives and learns differs in who answers the orders. Luck that answers them robot by robot makes the
closed loop, event for event (`planner.rollouts.single_run` is that, without what robots do against orders).
"""

from __future__ import annotations

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
from planner.mission.map_updates import (
    Lessons,
    Seen,
    closed_by,
    closed_state,
    hand_on,
    learned_state,
    read_rest,
    read_seen,
    seen_by,
    seen_world,
    surprises,
    write_mission,
)
from planner.mission.team_control import Fleet, Order, Report, Reports, Why
from planner.mrac.problem import NO_LIMIT, ready_loop
from planner.plan.plan import Plan
from planner.plan.state import MissionState
from planner.rollouts.single_run import NOT_BEGUN, RobotNow, state_of
from planner.settings import Settings
from planner.simulator.codes import Doing, Outcome
from planner.world.world import World

PATIENCE = 20
"""Steps in a row in which a robot that was to move did not, after which others get its work."""
WHY: dict[Doing, Why] = {Doing.TRAVELING: "travel", Doing.COVERING: "cover", Doing.FOLLOWING: "follow"}
WHY |= {Doing.RETURNING: "return"}


class Mission:
    """A team under way. Of each step: `orders`, `report` of each robot, `advance`.

    Args:
        world: the map. plan: for it; of the rest of a mission, from its state.
        patience: steps without progress after which a robot's work is others'; None: however many.
        gain: a robot leaves what it is under way to where another target saves more than this share of the cost of its
            way; 1: it never does, as in the closed loop.

    Attributes:
        world: the map, with what was seen, learned and closed. given: as it was. closed: those cells, indices.
        seen: p by cell, None: an obstacle; what was learned, too.

    Raises PlanError for a plan of another map, WorldError for one that robots are not told.
    """

    def __init__(
        self,
        world: World,
        plan: Plan,
        *,
        patience: int | None = PATIENCE,
        gain: float = 1.0,
    ) -> None:
        FRACTION.check("gain", gain)
        whole(1).check("patience", patience, optional=True)
        if world.movers is not None:
            world.check_settled("a mission that is driven")
        self.given, self._lessons = world, Lessons(world, plan)
        self._file: Path | None = None
        if self._lessons:
            settings, world = plan.require(world), replace(world, doubt=None)
            plan = plan if plan.state is not None else make_plan(world, plan.starts, settings)
        self.world, self.patience, self.gain = world, patience, gain
        self.closed: list[int] = []
        self.seen: Seen = {}
        self._begin(world, plan)

    def _begin(self, world: World, plan: Plan) -> None:
        problem, areas = ready_loop(plan, world)
        problem.settings.check_not_charged("a mission that is driven")
        problem.settings.check_alike("a mission that is driven")
        self.world, self._plan = world, plan
        last_update = self._lessons.last_update(problem.levels.accessible)
        self._fleet = Fleet(problem, replace(plan, areas=areas), self.gain, last_update)
        robots = self._fleet.loop.robots
        self._borne = list(plan.state.exposures) if plan.state is not None else [0] * robots
        self._waits, self._reports = [0] * robots, Reports(self._fleet)
        self._orders: dict[int, Order] | None = None

    # --- where it stands ---

    @property
    def step(self) -> int:
        """The step that is under way: 0 while robots enter their starts."""
        return self._fleet.step + 1

    @property
    def outcome(self) -> Outcome | None:
        """How the mission has ended; None while it goes on."""
        outcome = self._fleet.outcome
        return None if outcome is None else outcome.by_deadline(self.settings.ends_by_deadline)

    @property
    def covered(self) -> float:
        """Share of the accessible cells that are visited."""
        return 1 - self._fleet.unvisited / self.accessible

    @property
    def accessible(self) -> int:
        """Cells that can be visited."""
        return int(self._fleet.problem.levels.accessible.sum())

    @property
    def robots(self) -> int:
        """How many there are, lost ones too."""
        return self._fleet.loop.robots

    @property
    def last_step(self) -> int:
        """At which it ends, whatever is left."""
        return self._fleet.problem.max_steps

    @property
    def lost(self) -> tuple[int, ...]:
        """Numbers of the robots that are lost."""
        return tuple(robot.number for robot in self._fleet.robots if not robot.alive)

    @property
    def _aside(self) -> list[int]:
        return sorted(self._fleet.aside)

    @property
    def settings(self) -> Settings:
        """What it is planned by, with what robots said of their range."""
        return self._settings_of(self._fleet)

    def _settings_of(self, fleet: Fleet) -> Settings:
        problem = fleet.problem
        if (problem.range == NO_LIMIT).all():
            return problem.settings
        return replace(problem.settings, range=tuple(np.minimum(problem.range, MAX_STEP).tolist()))

    @property
    def state(self) -> MissionState:
        """Where it stands at the end of the last step, as state files hold it.

        Raises StateError before the first step has ended, and of robots on another planner's paths.
        """
        return self._state_of(self._fleet)

    def _state_of(self, fleet: Fleet) -> MissionState:
        self._check_kept(fleet)
        if fleet.step == NOT_BEGUN:
            raise StateError("the mission has not begun", expected="a mission whose step 0 is over")
        return state_of(fleet, fleet.problem, self._borne)

    def _check_kept(self, fleet: Fleet) -> None:
        if any(robot.status is Doing.FOLLOWING for robot in fleet.robots):
            problem = "robots follow the paths of another planner, which no state of a mission holds"
            raise StateError(problem, expected="a plan with areas", fix="plan with `plan`, for the closed loop")

    def rest(
        self, without: tuple[int, ...] = (), *, nominal: bool = True, call_off: bool = False, **changes: Any
    ) -> Plan:
        """The plan of what is left, from `state`; before the first step has ended, of the whole.

        Args:
            without: robots that do no more. changes: settings in the place of its own.
            call_off: nothing more is done: robots that come home turn.
            nominal: with the run without losses, its paths, which rollouts do not need.

        Raises StateError, PlanError.
        """
        planned = make_plan if nominal else allocated_plan
        if self._fleet.step == NOT_BEGUN:
            if without:
                raise StateError("the mission has not begun", expected="a mission whose step 0 is over")
            settings = replace(self.settings, **changes)
            return self._plan if not changes else planned(self.world, self._plan.starts, settings)
        fleet = self._fleet.fork()
        for number in {*map(self._number, without), *self._aside}:
            fleet.retire(number)
        if call_off:
            fleet.call_off()
        state, settings = self._state_of(fleet), replace(self._settings_of(fleet), **changes)
        if settings.policy != self.settings.policy:  # another rule goes on from other paths: areas are given anew
            state = replace(state, areas=(), robots=tuple(robot.at_rest for robot in state.robots))
        return planned(replace(self.world, doubt=None), state.starts, settings, state=state)

    # --- orders out, reports in ---

    def orders(self) -> dict[int, Order]:
        """What each robot that is not lost is to do in this step, by its number; nothing once the mission is over.

        As far as robots have reported already, from what they said; of the others as if they get there. A report of
        another thing changes what is right for the others: ask again.
        """
        if self._orders is None:
            self._orders = {} if self.outcome is not None else self._play(self._fleet.fork(), True)
        return self._orders

    def first_orders(self) -> dict[int, Order]:
        """The orders of this step as they were before anybody reported of it, what was closed since left out."""
        kept, self._reports = self._reports, Reports(self._fleet)
        try:
            return {} if self.outcome is not None else self._play(self._fleet.fork(), True)
        finally:
            self._reports = kept

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
        """Where a robot is, or that it is lost. Nothing happens before `advance`; saying it twice changes nothing.

        Args:
            cell: (row, col) where it is, ordered or not; None: where it was.
            stopped: it is lost there. found: it was lost before, and is back.
            moves_left: that it can still make, as after a look at its battery, or a swap of it.
            step: of which that was said; None: this one. What is said late is where it was, if it says more.
            seen: cells as it sees them, `[[row, col, p], ...]`, p None of an obstacle: believed from the end of the
                step on, and what surprises changes areas and ways (SPEC section 15).

        Raises StateError for what cannot be, and the mission is as before.
        """
        number, late = self._number(robot), len(self._reports.passed)
        before, there = self._reports.seen, {one: report.cell for one, report in self._reports.now.items()}
        if seen is not None:
            self._reports.seen = before | seen_by(seen, self._fleet, there)
        try:
            new = self._reports.hear(number, cell, step, moves_left, stopped=bool(stopped), found=bool(found))
        except StateError:
            self._reports.seen = before
            raise
        due = None if self._orders is None else self._orders.get(number)
        as_told = due is not None and new == Report(self._index(due.cell)) and len(self._reports.passed) == late
        if new is not None and not as_told:
            self._orders = None

    def _number(self, robot: int) -> int:
        robots = self.robots
        if not is_whole(robot, 0, robots - 1):
            raise StateError(f"robot {robot!r} reports", expected=f"a robot of the mission, 0 to {robots - 1}")
        return int(robot)

    def _index(self, cell: tuple[int, int]) -> int:
        return cell[0] * self.world.shape[1] + cell[1]

    def advance(self) -> None:
        """End the step: every robot is where it reported; who did not is where it was, or at t = 0 where it starts."""
        fleet = self._fleet
        self._play(fleet, False)
        held, reported = [robot.cell for robot in fleet.robots if robot.alive], self._reports.seen
        told = self._lessons.at_end(fleet.step, self.world, held) | reported
        seen = {cell: p for cell, p in told.items() if cell not in self.closed}
        self._reports.clear()
        self._orders = None
        changed = surprises(self.world, seen)
        known = fleet.problem.levels.accessible
        if len(changed) and held and fleet.step < self.last_step:
            world = seen_world(self.world, seen, self.given)
            state, got = learned_state(self.state, world, changed, self.settings)
            self._go_on(world, allocated_plan(replace(world, doubt=None), state.starts, self.settings, state=state))
            # A map update is progress, as in a simulated run (SPEC section 15).
            known = known | self._fleet.problem.levels.accessible
            progress = bool(fleet.s.marks.progress) or got or bool(known[changed].any())
            self._fleet.reopen_step()
            self._fleet.s.marks.progress = int(progress)
            self.seen |= {cell: seen[cell] for cell in changed.tolist()}
        self._fleet.end_step()

    @property
    def awaited(self) -> tuple[int, ...]:
        """Robots that are to move in this step and have not reported."""
        return self.awaited_of(self.orders())

    def awaited_of(self, orders: dict[int, Order]) -> tuple[int, ...]:
        """Robots that are to move by these orders of this step and have not reported."""
        cells = [robot.cell for robot in self._fleet.robots]
        begins = self.step == 0
        return tuple(
            order.robot
            for order in orders.values()
            if order.robot not in self._reports.now and (begins or self._index(order.cell) != cells[order.robot])
        )

    def _play(self, fleet: Fleet, ahead: bool) -> dict[int, Order]:
        """The step in `fleet` up to its end, and its orders; `ahead`: who has not reported gets there."""
        orders: dict[int, Order] = {}
        fleet.begin_step()
        for number, cell in self._reports.passed:
            fleet.visit(number, cell)
            if not ahead:
                self._lessons.learn(cell, stopped=False)
        for robot in fleet.robots:
            number, report = robot.number, self._reports.now.get(robot.number)
            if report is not None and report.found and not robot.alive:
                fleet.find(number)
            if report is not None and (report.cell != robot.cell or report.moves_left):
                fleet.bring_back(number)
            if not robot.alive:
                continue
            due = fleet.decide(number)
            orders[number] = self._order(fleet, robot, due)
            if report is None and due is not None and (ahead or fleet.step == 0):
                report = Report(due)
            came = self._turn(fleet, number, due, report)
            if not ahead:
                self._keep_count(robot, came, due)
        return orders

    def _order(self, fleet: Fleet, robot: RobotNow, due: int | None) -> Order:
        """What was decided, as it is told; a robot that gets its area in this step stays and looks at its way."""
        ahead, width = robot.ahead, self.world.shape[1]
        if due is not None and ahead[:1] == [due]:
            ahead = ahead[1:]
        waits = robot.held or robot.number in fleet.aside or robot.moves == 0
        why = WHY.get(robot.status, "hold" if waits else "idle")
        cells = [divmod(cell, width) for cell in [robot.cell if due is None else due, *ahead]]
        return Order(robot.number, cells[0], tuple(cells[1:]), robot.area, why)

    def _turn(self, fleet: Fleet, number: int, due: int | None, report: Report | None) -> bool:
        """What became of a robot that was to enter `due`; True if it entered a cell."""
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

    def _keep_count(self, robot: RobotNow, came: bool, due: int | None) -> None:
        """What the robot bore on the cell it came to, what it says of it, and for how many steps it has not moved."""
        number = robot.number
        if came:
            p = self._lessons.met(self._fleet.step, self.world).flat[robot.cell]
            self._borne[number] += int(exposure_of(p))
        if came or not robot.alive:
            self._lessons.learn(robot.cell, stopped=not robot.alive)
        self._waits[number] = 0 if came or due is None else self._waits[number] + 1
        if self.patience is not None and self._waits[number] >= self.patience and robot.busy:
            self._fleet.set_aside(number)

    def call_off(self) -> None:
        """From now on all go home. Raises StateError before the first step has ended, and where nobody comes home."""
        if self.settings.return_to is None or self._fleet.step == NOT_BEGUN:
            problem = "a mission is called off whose robots do not come home, or have not set out"
            raise StateError(problem, expected="robots on a mission with `return_to`", fix="give them no more orders")
        self._fleet.call_off()
        self._orders = None

    def close(self, cells: ArrayLike) -> None:
        """These cells, `[[row, col], ...]`, are no-go from now on: robots keep their areas, and go round.

        Raises StateError where a robot is on one of them, or has reported so; where they would lie between a robot and
        what it reported in this step; and for what is no cell of the map.
        """
        closed, world = closed_by(cells, self._reports)
        if self._fleet.step == NOT_BEGUN:
            plan = make_plan(world, self._plan.starts, self.settings)
        else:
            state = closed_state(self.state, world, self.settings.levels)
            plan = make_plan(replace(world, doubt=None), state.starts, self.settings, state=state)
        self._go_on(world, plan)
        self._fleet.come_home()
        self.closed = sorted({*self.closed, *closed.tolist()})

    def _go_on(self, world: World, plan: Plan) -> None:
        """By another plan, on a map that is known better."""
        kept, reports, aside = (self._borne, self._waits), self._reports, self._aside
        self._begin(world, plan)
        self._borne, self._waits = kept
        self._reports.carry(reports)
        self._set_aside(aside)

    # --- kept in a file ---

    @classmethod
    def resume(cls, path: str | Path, world: World, plan: Plan, **how: Any) -> Self:
        """The mission that `save` wrote, on its `world` before anything was closed, by the settings of `plan`.

        `how`: patience and gain, as of the mission. Raises StateError.
        """
        known, rest, keys = read_rest(path, world, plan)
        mission = cls(known, rest, **how)
        mission.given, mission._file = world, Path(path).resolve()
        heard, waits = (keys[name].items("a list of steps", least=0) for name in ("heard", "waits"))
        for steps in (heard, waits):
            if steps and len(steps) != mission.robots:
                problem, expected = f"holds a mission of {len(steps)} robots", f"one of {mission.robots}, as planned"
                raise StateError(problem, source=path, expected=expected, fix="give the robots of the mission")
        mission._waits[: len(waits)] = [one.number(whole(0)) for one in waits]
        robot = whole(0, mission.robots - 1, what="the number of a robot")
        mission._set_aside([one.number(robot) for one in keys["aside"].items("a list of robots", least=0)])
        mission.closed = [one.value for one in keys["closed"].items("a list of cells", least=0)]
        mission.seen, mission._reports.seen = read_seen(keys["seen"]), read_seen(keys["sees"])
        mission._lessons.read(keys["odds"])
        for report in keys["reports"].items("a list of reports", least=0):
            hand_on(mission.report, report)
        step = whole(NOT_BEGUN, mission.step, what="a step that is not to come")
        mission._reports.heard[: len(heard)] = [one.number(step) for one in heard]
        return mission

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write where it stands, with what was reported of the step under way, to go on from (`missions.saved`).

        What is written is on the disk before this returns. Its own file, which it was resumed from or has written, is
        replaced; another file that is there already only by `force`. Raises UsageError for such a file, StateError for
        another planner's paths.
        """
        file = Path(path).resolve()
        if file != self._file:
            check_new(path, force=force)
        self._check_kept(self._fleet)
        state = self.state.to_json() if self.step > 0 else None
        more: Json = {"seen": _pairs(self.seen), "sees": _pairs(self.sees)}
        more |= {"closed": self.closed, "range": self.settings.range, "aside": self._aside}
        more |= {"reports": self.said(), "heard": self._reports.heard, "waits": self._waits}
        more |= {"odds": self._lessons.to_json()}
        more |= {} if self.outcome is None else {"ended": self.known()}
        write_mission(path, self.world, state, more)
        self._file = file

    def known(self) -> Json:
        """Where it stands, as files and `drive` say it: the step that is under way, or at which it ended."""
        ended = {} if self.outcome is None else {"outcome": self.outcome.word}
        step = self.step if self.outcome is None else self._fleet.step
        return ended | {"step": step, "covered": self.covered, "lost": list(self.lost)}

    @property
    def sees(self) -> Seen:
        """What was seen in the step under way, as `seen` has it."""
        return dict(self._reports.seen)

    def said(self) -> list[Json]:
        """The reports of the step under way, as files hold them."""
        return self._reports.said()

    def _set_aside(self, robots: list[int]) -> None:
        """As it was known before, in another fleet."""
        for number in robots:
            if self._fleet.s.robots[number].doing != Doing.DEAD:
                self._fleet.set_aside(number)
            self._fleet.aside.add(number)


def _pairs(seen: Seen) -> list[list[float | None]]:
    """As files hold it."""
    return [[cell, p] for cell, p in sorted(seen.items())]
