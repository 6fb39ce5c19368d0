"""Algorithm 2's decisions, robot by robot: what each is to do next, and what follows from what happened to it.

The seam that everything which runs a team shares (SPEC section 5): a simulator answers with luck (`simulate`), a
mission with what its robots report (`planner.mission`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from planner.mrac.areas import bisect, choose_parts
from planner.mrac.board import Board, Choice, Recorder, Robot, State, can_go_on, has_to_leave, is_home, moves_left
from planner.mrac.choose import (
    drives_back,
    first_area,
    first_of_idle,
    first_to_share,
    has_to_wait,
    hears,
    is_at_risk,
    is_full,
)
from planner.mrac.problem import Problem
from planner.plan.plan import Area, LegKind
from planner.plan.state import MissionState
from planner.simulator.codes import NO_AREA, Doing, EventKind, Outcome
from planner.simulator.offers import NO_REFUSAL
from planner.simulator.searches import NOT_WANTED, coverage_path

Split = Callable[[tuple[int, int], NDArray[np.int64]], Sequence[NDArray[np.int64]]]
"""`(shape, cells of a connected area of at least 2) -> its two connected parts`, in any order."""
NOT_BEGUN = -1
"""The step before t = 0, at which robots enter their starts."""
STUCK_AFTER = 2
"""Steps in a row without a move or an allocation that end a run as one of no progress."""


class Executive(Board):
    """A run in progress. In each step: `begin_step`, then of every robot in index order its turn, then `end_step`.

    A turn is `decide`; if that names a cell, `enter` it, and then `stop` or `survive`.

    Args:
        problem: the world made ready, with the robots' starts.
        allocation: the areas at t = 0 in id order; together they hold every accessible cell once.
        split: halves the one component of a shared area. recorder: writes down the run for its trace.
        state: of a mission under way, to go on from; `allocation` are its areas.
    """

    def __init__(
        self,
        problem: Problem,
        allocation: tuple[Area, ...],
        split: Split = bisect,
        recorder: Recorder | None = None,
        state: MissionState | None = None,
    ) -> None:
        super().__init__(problem, allocation)
        self.split, self.recorder = split, recorder
        self.step, self.quiet, self.bisected, self.divided, self.progress = NOT_BEGUN, 0, 0, 0, False
        self.over: Outcome | None = None
        self.last_update = 0 if problem.unknown is None else problem.unknown.last_update
        if state is not None:
            self.set_back_to(state)
            self.step, self.quiet, self.next_move = state.step, state.quiet, state.step + 1
            self.over = None if state.over is None else Outcome[state.over.upper()]
            for _ in range(state.step + 1):
                self._look()
            return
        for robot in self.robots:
            if robot.on_its_way:
                self._travel(robot)

    def begin_step(self) -> None:
        """The next step."""
        self.step += 1
        self.progress, self.next_move = False, self.step + 1

    def end_step(self) -> None:
        """Every robot has had its turn."""
        self.quiet = 0 if self.progress else self.quiet + 1
        if self._awaits_update():
            self.quiet = min(self.quiet, self._most_quiet - 1)
        if self.problem.home is not None:
            self._call_home()
        self._look()

    def outcome(self, max_steps: int) -> Outcome | None:
        """How the run ends after this step; None if it goes on."""
        if self.problem.home is None:
            over = self._over()
        elif not any(robot.alive for robot in self.robots):
            over = Outcome.ALL_ROBOTS_LOST
        else:
            away = any(robot.status is Doing.RETURNING for robot in self.robots)
            over = None if away else self.over
        if over is None and self.step >= max_steps:
            over = Outcome.STEP_LIMIT
        return over if over is None or self.unvisited else Outcome.COMPLETE

    def _over(self) -> Outcome | None:
        """How there is nothing more to be done; None: there is."""
        if self.unvisited == 0:
            return Outcome.COMPLETE
        if not any(robot.alive for robot in self.robots):
            return Outcome.ALL_ROBOTS_LOST
        if self.quiet >= self._most_quiet:
            could = (robot.able and first_area(self, robot, refusing=False) for robot in self.robots)
            return Outcome.NOT_WORTH_THE_RISK if self._refuses() and any(could) else Outcome.NO_PROGRESS
        return None

    @property
    def _most_quiet(self) -> int:
        """Steps in a row without progress after which the run ends."""
        return STUCK_AFTER * max(self.problem.settings.paces, default=1)

    def _awaits_update(self) -> bool:
        """Whether a robot that can move waits for an announced phase that changes the map."""
        return self.step + 1 < self.last_update and any(robot.able for robot in self.robots)

    def _refuses(self) -> bool:
        """Whether areas may be left that somebody could go to."""
        return self.problem.theta < NO_REFUSAL

    # --- a robot's turn ---

    def has_turn(self, number: int) -> bool:
        """Whether this step is one in which the robot acts: one whose move takes m steps does in every m-th."""
        return self.step % self.problem.pace(number) == 0

    def wait(self, number: int) -> None:
        """The robot's move takes longer than this step."""
        robot = self.robots[number]
        if robot.alive:
            robot.path.append(robot.cell)

    def decide(self, number: int) -> int | None:
        """What the robot does in this step: the cell that it enters, or None, it stays where it is.

        At t = 0 that is its start, entered like any other cell.
        """
        robot = self.robots[number]
        if self.step == 0:
            return robot.cell
        if robot.status is Doing.FOLLOWING and robot.ahead[-1] == robot.cell:
            self.progress = True  # a cell that comes twice in a row is a step of waiting
            robot.path.append(robot.ahead.pop())
            self._finish_paths(robot)
            return None
        if robot.status is Doing.CHARGING:
            self._charge(robot)
            robot.path.append(robot.cell)
            self._finish_paths(robot)
            return None
        if robot.on_its_way and self.rule.attentive:
            self.next_move = self.step
            self._look_up(robot)
            self.next_move = self.step + 1
        elif robot.able and not robot.busy and drives_back(self, robot):
            return robot.ahead[-1]
        elif robot.able and not robot.busy and (self._allocate_next(robot, idle=True) or robot.turned):
            robot.path.append(robot.cell)
            self._finish_paths(robot)
            return None
        home = self.problem.home
        if home is not None and robot.on_its_way:
            left = moves_left(home, robot, self.step, self.problem.pace(number))
            if not can_go_on(self, home, robot, left):
                self._turn_home(robot, charges=not can_go_on(self, home, robot, robot.moves))
        if robot.busy:
            return robot.ahead[-1]
        if robot.alive:
            robot.path.append(robot.cell)
        return None

    def enter(self, number: int) -> None:
        """The robot has entered the cell that was decided: mark it, complete its area."""
        robot = self.robots[number]
        in_area = robot.status is Doing.COVERING or len(robot.ahead) == 1
        if self.step == 0:
            in_area = self._begins_in_its_area(robot)
        else:
            robot.cell = robot.ahead.pop()
            robot.moves -= robot.status is not Doing.FOLLOWING
        robot.path.append(robot.cell)
        self.progress = True
        if robot.on_its_way and (in_area or self.step > 0):
            self._log_leg(robot, "cover" if in_area else "travel")
        self._mark(robot, robot.cell)

    def stop(self, number: int) -> None:
        """The robot, which has just entered its cell, is stopped there."""
        robot = self.robots[number]
        robot.status = Doing.DEAD
        self._note(EventKind.HIT, robot, robot.area, robot.cell)
        for number in self._left_by(robot):
            self._reallocate(robot, number)

    def survive(self, number: int) -> None:
        """The robot, which has just entered its cell, goes on."""
        robot = self.robots[number]
        self.survived[robot.cell] = True
        if robot.status is Doing.RETURNING:
            if not robot.ahead or robot.moves == 0:
                self._arrive(robot)
        elif robot.moves == 0:
            self._stay(robot)
        elif self.step == 0 and robot.on_its_way:
            if self._begins_in_its_area(robot):
                self._cover(robot)
            elif self.rule.attentive and self.visited[robot.ahead[0]]:
                self._travel(robot)
        self._finish_paths(robot)

    def _begins_in_its_area(self, robot: Robot) -> bool:
        """At t = 0: a robot that stands in its area begins to cover it."""
        return robot.on_its_way and bool(self.area_of[robot.cell] == robot.area)

    def _stay(self, robot: Robot) -> None:
        """The end of the robot's range: it is done for good, and others may have what is left of its area."""
        home = self.problem.home
        if home is not None and is_home(home, robot):
            self._turn_home(robot, charges=True)
            return
        self._note(EventKind.RANGE_ENDED, robot, robot.area, robot.cell)
        self._lay_down(robot)

    def _lay_down(self, robot: Robot) -> None:
        """It is done, and what it leaves is for others."""
        for number in self._left_by(robot):
            self._reallocate(robot, number)
        robot.status, robot.area, robot.ahead = Doing.DONE, NO_AREA, []

    # --- coming home ---

    def _call_home(self) -> None:
        """At the end of a step: all turn once nothing more is to be done, before that who would come too late."""
        home = self.problem.home
        assert home is not None
        self.over = self._over() if self.over is None else self.over
        for robot in self.robots:
            if robot.status is Doing.CHARGING and self.over is not None:
                robot.status = Doing.DONE
            pace = self.problem.pace(robot.number)
            late = robot.able and not robot.busy and has_to_leave(home, robot, self.step, pace)
            can = robot.alive and robot.moves > 0 and not robot.turned
            if can and (late or self.over is not None):
                self._turn_home(robot)

    def _charge(self, robot: Robot) -> None:
        """A step at the base; at its end the robot has its range again, and looks for an area."""
        self.progress = True
        if self.step < robot.ready:
            return
        robot.moves, robot.turned, robot.charges = int(self.problem.range[robot.number]), False, False
        robot.status = Doing.IDLE
        self._note(EventKind.CHARGED, robot, NO_AREA, robot.cell)
        self._allocate_next(robot)

    def _rest(self, robot: Robot, *, waits: bool = False) -> None:
        """Nothing is left that it can afford: it is charged, if there is something else; else it waits."""
        used = robot.moves < self.problem.range[robot.number]
        charges = self.problem.settings.recharge is not None and used and self._would_take(robot)
        if charges or not waits:
            robot.status, robot.area, robot.ahead = Doing.DONE, NO_AREA, []
        if charges:
            self._turn_home(robot, charges=True)

    def _would_take(self, robot: Robot) -> bool:
        """Whether there is an area for the robot, however far away."""
        self.limited = False
        first = first_area(self, robot)
        self.limited = True
        return first is not None

    def _turn_home(self, robot: Robot, *, charges: bool = False) -> None:
        """The robot turns for home: others may have what is left of its area. `charges`: if it does, not for good."""
        used = robot.moves < self.problem.range[robot.number]
        robot.charges = charges and used and self.problem.settings.recharge is not None
        home = self.problem.home
        assert home is not None
        way = home.way(robot.number, robot.cell)
        base = way[-1] if way else robot.cell
        self._note(EventKind.TURNED_HOME, robot, robot.area, base)
        self._lay_down(robot)
        robot.turned, robot.held, robot.ahead = True, False, way[::-1]
        if way:
            robot.status = Doing.RETURNING
        elif is_home(home, robot):
            self._arrive(robot)

    def _arrive(self, robot: Robot) -> None:
        """It is home; or at the end of its range, which was less than it thought."""
        kind = EventKind.RANGE_ENDED if robot.ahead else EventKind.HOME
        robot.status, robot.ahead = Doing.DONE, []
        self._note(kind, robot, NO_AREA, robot.cell)
        if robot.charges and kind is EventKind.HOME and self.over is None:
            assert self.problem.settings.recharge is not None
            robot.status, robot.ready = Doing.CHARGING, self.step + self.problem.settings.recharge

    def _mark(self, robot: Robot, cell: int) -> None:
        """The robot visits the cell."""
        if self.visited[cell]:
            return
        self.visited[cell] = True
        self.unvisited -= 1
        holder = int(self.area_of[cell])
        self.areas[holder].unvisited -= 1
        self.changes += holder in self.unassigned
        if self.areas[holder].unvisited == 0:
            self.complete(holder)
            self._note(EventKind.COMPLETED, robot, holder, cell)

    def _look_up(self, robot: Robot) -> None:
        """What an attentive robot notices before it moves: what others visited, and that a danger lies ahead."""
        if self.areas[robot.area].unvisited == 0:
            self._allocate_next(robot)
            return
        wary = self.rule.looks_again and (self.rule.breaks_off or robot.status is Doing.TRAVELING)
        if (
            wary
            and self.problem.is_dangerous(robot.number, self.problem.levels.of_cell[robot.ahead[-1:]])
            and hears(self, robot)
        ):
            self._look_again(robot)
        if robot.on_its_way and self.visited[robot.ahead[0]]:
            self._aim(robot)

    def _look_again(self, robot: Robot) -> None:
        """Another area may be better by now than the one behind the danger; or none is worth it any more."""
        first = self.choose(robot, own=True)
        waits = self.rule.breaks_off and first is not None and has_to_wait(self, robot, first)
        if first is not None and first.area == robot.area and not waits:
            return
        self._note(EventKind.LOOKED_AGAIN, robot, robot.area, robot.ahead[-1])
        self.release(robot)
        robot.ahead = []
        robot.held |= waits
        if first is not None and not waits:
            self._take(robot, first)
        else:
            self._share_or_rest(robot)

    def _log_leg(self, robot: Robot, kind: LegKind) -> None:
        legs, since = robot.legs, self.step - self.problem.pace(robot.number) + 1
        if legs and legs[-1][0] == kind and legs[-1][1] == robot.area and since <= legs[-1][3] <= self.step:
            legs[-1] = (kind, robot.area, legs[-1][2], self.step + 1)
        else:
            legs.append((kind, robot.area, self.step, self.step + 1))

    def _finish_paths(self, robot: Robot) -> None:
        """A path with no cells left is finished at once, in the same step; so is the next one, if it has none."""
        while not robot.ahead:
            leg_by_leg = self.rule.attentive and robot.on_its_way and self.areas[robot.area].unvisited > 0
            if robot.status is Doing.TRAVELING or leg_by_leg:
                self._cover(robot)
            elif robot.status is Doing.COVERING:
                self.complete(robot.area)
                self._allocate_next(robot)
            elif robot.status is Doing.FOLLOWING:
                self._allocate_next(robot)
            else:
                return

    def _aim(self, robot: Robot) -> None:
        """On to the next target, the one before having been visited by another robot."""
        if robot.status is Doing.TRAVELING:
            self._travel(robot)
        else:
            self._cover(robot)

    def _cover(self, robot: Robot) -> None:
        """The coverage path of what is left of the robot's area; of an attentive robot its first leg."""
        inside = None
        if self.problem.stay_inside:
            inside = np.zeros(len(self.visited), dtype=np.bool_)
            inside[self.areas[robot.area].cells] = True
        to_do, order = self.to_do(robot.area), self.problem.settings.in_area
        robot.to_do, robot.since = to_do, len(robot.path)
        most = 1 if self.rule.attentive else None
        legs = coverage_path(
            self.problem.paths_of(robot.number), robot.cell, to_do, inside, order, self.problem.sides, most
        )
        robot.ahead = legs[::-1].tolist()
        robot.status = Doing.COVERING

    def _travel(self, robot: Robot) -> None:
        """The safest path to the target of the robot's area; none if it has no cell to head for."""
        goals = self.goals(robot.area)
        rank = np.full(len(self.visited), NOT_WANTED, dtype=np.int32)
        rank[goals] = 0
        target = self.problem.paths_of(robot.number).nearest(robot.cell, rank)
        if target is None and len(goals):
            raise ValueError(f"area {robot.area} cannot be reached from cell {robot.cell}")
        robot.ahead = [] if target is None else self._way(robot, target.cell)
        robot.status = Doing.TRAVELING

    def _way(self, robot: Robot, target: int) -> list[int]:
        return self.problem.paths_of(robot.number).path(robot.cell, target)[::-1].tolist()

    # --- who gets what ---

    def choose(self, robot: Robot, *, idle: bool = False, own: bool = False) -> Choice | None:
        """The area that the robot is to have next, by the rule; None: none of those that nobody has.

        `idle`: it has been without one. `own`: the one that it has is among them.
        """
        return first_of_idle(self, robot) if idle else first_area(self, robot, own=own)

    def _allocate_next(self, robot: Robot, *, idle: bool = False) -> bool:
        """`Allocate Next Area`, else `Find Area To Share`, else done. True if the robot got an area.

        `idle`: it has been without one; unless it is held, it does not try to share again.
        """
        first = self.choose(robot, idle=idle)
        if first is None:
            if not idle or robot.held:
                return self._share_or_rest(robot)
            self._rest(robot, waits=True)
            return False
        if has_to_wait(self, robot, first):
            robot.held = True
            return self._share_or_rest(robot)
        self._take(robot, first)
        return True

    def _take(self, robot: Robot, choice: Choice) -> None:
        self.give(robot, choice.area)
        robot.ahead = self._way(robot, choice.target)
        self._note(EventKind.ALLOCATED, robot, choice.area, choice.target)
        self.progress = True

    def _share_or_rest(self, robot: Robot) -> bool:
        """`Find Area To Share`, else done; a robot that is held shares without danger alone. True if it got an area."""
        first = first_to_share(self, robot)
        if first is not None and is_at_risk(self, first) and (robot.held or is_full(self, robot)):
            robot.held = True
            first = None
        if first is not None:
            self._share(robot, first.area)
            return True
        if self.problem.settings.worth is not None and not robot.held and robot.status is not Doing.DONE:
            refused = first_area(self, robot, refusing=False)
            if refused is not None:
                self._note(EventKind.REFUSED, robot, refused.area, refused.target)
        self._rest(robot)
        return False

    def _share(self, helper: Robot, number: int) -> None:
        """The area of another live robot is split between the two."""
        owner = self.robots[self.areas[number].robot]
        parts = self._replace(number, split=True)
        cells = [self.areas[part].cells for part in parts]
        of = [(robot.cell, self.problem.paths_of(robot.number)) for robot in (owner, helper)]
        costs = ([paths.cost_to(cell, part) for part in cells] for cell, paths in of)
        chosen = choose_parts(*costs)
        self.give(owner, parts[chosen.owner])
        self.give(helper, parts[chosen.helper])
        self._note(EventKind.SHARED, helper, number, len(parts))
        for robot in (owner, helper):
            self._travel(robot)
            # at t = 0 an owner that acts later may stand in its part: it has not entered its start yet
            target = robot.ahead[0] if robot.ahead else robot.cell
            self._note(EventKind.ALLOCATED, robot, robot.area, target)
        self.progress = True

    def _left_by(self, robot: Robot) -> list[int]:
        """The areas that a stopped robot leaves: its own, or those of the path that it followed."""
        if robot.area != NO_AREA:
            return [robot.area]
        if not self.problem.given:
            return []
        mine = (State.ASSIGNED, robot.number)
        return [number for number, area in enumerate(self.areas) if (area.state, area.robot) == mine]

    def _reallocate(self, robot: Robot, number: int) -> None:
        """`Reallocate Area`: what the robot leaves unvisited becomes unassigned areas of their own."""
        if parts := self._replace(number, split=False):
            self._note(EventKind.REALLOCATED, robot, number, len(parts))

    def _replace(self, number: int, *, split: bool) -> list[int]:
        """Complete the area; the components of its unvisited cells become new areas. `split`: at least two."""
        parts = self.cut(number)
        if split and len(parts) > 1:
            self.divided += 1
        elif split:
            self.bisected += 1
            parts = sorted(self.split(self.problem.world.shape, parts[0]), key=lambda part: int(part[0]))
        return [self.append_area(self.areas[number].level, part) for part in parts]

    # --- what is told about the run ---

    def _note(self, kind: EventKind, robot: Robot, area: int, other: int) -> None:
        if self.recorder is not None:
            self.recorder.note(self.step, robot.number, kind, area, other)

    def _look(self) -> None:
        if self.recorder is not None:
            self.recorder.look([(robot.cell, robot.status, robot.area) for robot in self.robots])
