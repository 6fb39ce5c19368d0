"""A run whose robots do not always do what was decided: they are pushed, late, held up, found again, or recharged."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import MAX_STEP, as_whole, is_whole
from planner.errors import StateError
from planner.files import Json
from planner.mrac.problem import Problem
from planner.plan.plan import Plan
from planner.plan.reading import at
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.single_run import NOT_BEGUN, SingleRun, holds
from planner.simulator.codes import NO_AREA, NONE, Doing, Outcome
from planner.simulator.jit import interpreted
from planner.simulator.offers import Offer
from planner.simulator.state import AREA_BITS, MOVES, SURVIVED, TO_DO, VISITED


class Fleet(SingleRun):
    """A team that reports what happens to it. In each step: `begin_step`, every robot's turn, `end_step`.

    A turn is `decide`, then `enter`, `displace` or `wait`, then `stop` or `survive`.

    Attributes:
        problem: the world made ready, with the range of each robot as far as it is known.
        gain: share of the cost of its way that another target must save for a robot to leave its own; 1: nothing does.
        aside: numbers of robots that make no progress, and get nothing.
    """

    under_way = False
    _moves_now = False
    """Whether the robot that decided last was to make a move, which counts as made."""

    def __init__(self, problem: Problem, plan: Plan, gain: float = 1.0, last_update: int = 0) -> None:
        """`last_update`: the step from which the last announced phase holds, 0: none."""
        super().__init__(compile_closed_loop(plan, problem.world, problem=problem, interpreted=True))
        # A visit may destroy a robot in any cell: it is survived only once that is reported.
        self.t = self.t._replace(
            bound=np.zeros_like(self.t.bound), phases=np.zeros(1, dtype=np.int64), phased=True, notes=None,
            last_update=last_update,
        )  # fmt: skip
        self.problem, self.gain, self.aside = problem, gain, set[int]()
        if self.step != NOT_BEGUN:
            self._review()

    def fork(self) -> Self:
        """As of a run."""
        other = super().fork()
        other.aside = self.aside.copy()
        return other

    # --- steps ---

    @property
    def step(self) -> int:
        """The step that is under way, or the last one that is over."""
        return int(self.raw.marks["step"]) - (self.outcome is None and not self.under_way)

    def begin_step(self) -> None:
        """The next step."""
        self._make_room()
        marks = self.s.marks
        if self.outcome is not None:
            marks.step, self.outcome = marks.step + 1, None
        self.log.events[0, 0], marks.progress, self.under_way = 0, 0, True
        self.raw.robots["sure"] = NONE  # where robots may be displaced, nothing is settled
        if self.p is not None:
            interpreted("replanning").begin(self.t, self.s, self.w)
        interpreted("step").forget(self.t, self.p, self.s, self.w)

    def end_step(self) -> None:
        """Every robot has had its turn."""
        with np.errstate(over="ignore"):
            found = interpreted("step").end_step(self.t, self.p, self.s, self.c, self.w, self.log, self.how, self.ids)
        self.under_way = False
        self.outcome = None if found == NONE else Outcome(int(found))
        self.take_events()
        if self.raw.marks["over"]:
            self._call_home_from_aside()

    def reopen_step(self) -> None:
        """The last step, which is over, is under way again."""
        if self.outcome is None:
            self.s.marks.step -= 1
        self.outcome, self.under_way = None, True

    @contextmanager
    def _between(self) -> Iterator[None]:
        """Something happens between two steps, after the last one."""
        last = self.s.marks.step = self.step
        self.under_way, self.log.events[0, 0] = True, 0
        yield
        self.under_way, self.s.marks.step = False, last + (self.outcome is None)

    def _review(self) -> None:
        """Whether the run is over, after something has happened between two steps."""
        with self._between():
            step = interpreted("step")
            found = step.over_by(self.t, self.p, self.s, self.w, int(step.end_of(self.t, self.s, self.how)))
            self.outcome = None if found == NONE else Outcome(int(found))

    # --- a robot's turn ---

    def decide(self, number: int) -> int | None:
        """What the robot does in this step: the cell that it enters, or None, it stays where it is.

        At t = 0 that is its start, entered like any other cell.
        """
        s, step, me = self.s, self.s.marks.step, self.s.robots[number]
        s.marks.robot, self._moves_now = number, False
        if not int(interpreted("step").acting(self.t, self.p, s, number // 64, NONE)) >> number % 64 & 1:
            return None
        if self.gain < 1 and step > 0 and me.doing == Doing.TRAVELING and s.areas[me.area].left > 0:
            self._look_round(number)
        if self.p is None:
            turn = interpreted("fixed_paths").act(self.t, s, self.w, self.log, self.how, number)
        else:
            turn = interpreted("replanning").act(self.t, self.p, s, self.w, self.log, self.how, number)
        if turn != MOVES:
            s.marks.progress |= turn
            return None
        cell, self._moves_now = me.next if step > 0 else me.cell, step > 0
        if step > 0 and me.doing == Doing.FOLLOWING and cell == me.cell:  # a step of waiting on its path
            s.marks.progress = 1
            self._arrive(number)
            return None
        return int(self.loop.cells[cell])

    def enter(self, number: int) -> None:
        """The robot has entered the cell that was decided."""
        me = self.s.robots[number]
        self._enter(number, me.next if self.s.marks.step > 0 else me.cell)

    def _enter(self, number: int, cell: int) -> None:
        s = self.s
        s.marks.progress = 1
        if self.p is not None:
            s.marks.changes += interpreted("replanning").is_news(s, number, cell)
            s.home[cell] = int(s.home[cell]) & ~TO_DO
        interpreted("visits").enter(self.t, s, self.c, self.w, self.log, self.how, self.ids, number, cell)

    def stop(self, number: int) -> None:
        """The robot, which has just entered its cell, is lost there."""
        self.left[number] = self.moves_left(number)
        interpreted("visits").lose(self.t, self.s, self.c, self.w, self.log, number)
        interpreted("areas").unsettle(self.s)

    def survive(self, number: int) -> None:
        """The robot, which has just entered the cell that was decided, goes on."""
        interpreted("visits").survive(self.s, self.c, self.s.robots[number].cell)
        self._arrive(number)

    def _arrive(self, number: int) -> None:
        me = self.s.robots[number]
        interpreted("step").arrive(self.t, self.p, self.s, self.w, self.log, self.how, number, me.cell)

    def wait(self, number: int) -> None:
        """The robot is on its way, and has not got there yet: the step is none of rest."""
        me = self.s.robots[number]
        self.s.marks.progress = 1
        if holds(self.raw.movers, number):
            me.until += 1  # as many moves are left as before
        if me.doing == Doing.FOLLOWING:
            self._insert(number, [me.cell])

    def displace(self, number: int, cell: int) -> None:
        """The robot is at a cell that it was not to enter now: it is visited, and the robot goes on from there."""
        step, me, width = self.s.marks.step, self.s.robots[number], self.problem.world.shape[1]
        ahead = self.path_ahead(number)
        before = ahead if me.doing == Doing.COVERING else ahead[-1:]
        here, there = divmod(int(self.loop.cells[me.cell]), width), divmod(cell, width)
        left = max(
            0, self.moves_left(number) + self._moves_now - sum(abs(a - b) for a, b in zip(here, there, strict=True))
        )
        if holds(self.raw.movers, number) or holds(self.raw.waiting, number):
            me.until = left + (step if holds(self.raw.movers, number) else 0)
        else:
            self.left[number] = left
        at = int(np.searchsorted(self.loop.cells, cell))
        self._enter(number, at)
        self._set_out(number, before)

    def go_on(self, number: int) -> None:
        """The robot, which was displaced or has no more moves, survived: it goes on from where it is."""
        t, p, s, w, log, how, me = self.t, self.p, self.s, self.w, self.log, self.how, self.s.robots[number]
        interpreted("visits").survive(s, self.c, me.cell)
        if t.returns and me.doing == Doing.RETURNING:
            interpreted("return_home").go_home(t, s, log, number)
        elif self.moves_left(number) == 0:
            if number not in self.left:
                interpreted("return_home").stay(t, s, w, log, number)
                self.left[number] = 0
        elif me.doing == Doing.FOLLOWING:
            self._arrive(number)
        elif interpreted("areas").has_area(s.robots, number):
            if s.marks.step == 0 and int(s.home[me.cell]) >> AREA_BITS == me.area:
                me.target = me.cell  # it begins in its area
            ended = me.cell == me.target or s.areas[me.area].left == 0
            if p is None and (me.cell == me.target or (me.doing == Doing.COVERING and me.left == 0)):
                interpreted("fixed_paths").settle(t, s, w, log, how, number)
            elif p is not None and ended:
                interpreted("replanning").end_leg(t, p, s, w, log, how, number)

    def _set_out(self, number: int, before: list[int]) -> None:
        """A new way to what the robot is about; `before`: cells that it was about to do."""
        t, s, w, me = self.t, self.s, self.w, self.s.robots[number]
        if number in self.turned and t.returns:
            ahead = interpreted("range_budget").moves_home(t, number, me.cell)
            if ahead < 0:
                interpreted("state").drop(s.movers, number)
                me.doing = Doing.DONE
            elif holds(self.raw.movers, number) or ahead > 0:
                me.doing, me.next = Doing.RETURNING, t.onward[t.home_of[number], me.cell]
                interpreted("state").put(s.movers, number)
        elif me.doing == Doing.FOLLOWING:
            step = s.marks.step
            due = int(t.given[number, min(max(step, 1), t.length[number])])
            self._insert(number, [me.cell, *self._way(number, due)[:-1]])
        elif interpreted("areas").has_area(s.robots, number) and s.areas[me.area].left > 0:
            self._aim_as_before(number, before)
        elif interpreted("areas").has_area(s.robots, number):
            if self.p is None:
                me.doing, me.left = Doing.COVERING, 0
                interpreted("fixed_paths").settle(t, s, w, self.log, self.how, number)
            else:
                interpreted("replanning").allocate_next(t, self.p, s, w, self.log, number, False)

    def _insert(self, number: int, cells: list[int]) -> None:
        """The robot that follows a path is in these cells from this step on, before it goes on along the path."""
        t, step = self.t, self.s.marks.step
        path = t.given[number, : t.length[number] + 1].tolist()
        path = [*path[:step], *cells, *path[step:]] if step > 0 else [*cells, *path[1:]]
        longest = max(len(path), t.given.shape[1])
        given = np.pad(t.given, ((0, 0), (0, longest - t.given.shape[1])), mode="edge")
        given[number], length = path[-1], t.length.copy()
        given[number, : len(path)], length[number] = path, len(path) - 1
        self.t = t._replace(given=given, length=length)
        self.s.robots[number].next = given[number, min(step + 1, length[number])]

    def _way(self, number: int, target: int) -> list[int]:
        """The cells entered on the safest path from where the robot is, as numbers of accessible cells."""
        way = self.problem.paths_of(number).path(*self.loop.cells[[self.s.robots[number].cell, target]].tolist())
        return np.searchsorted(self.loop.cells, way).tolist()

    def _cost(self, way: list[int]) -> int:
        return int(self.problem.costs[self.loop.cells[way]].sum())

    def _saves(self, cost: int, of: int) -> bool:
        return of - cost > self.gain * of

    def _aim_as_before(self, number: int, before: list[int]) -> None:
        """To what it was about to do next, or to what is nearest of its area now, if that is worth it."""
        s, me = self.s, self.s.robots[number]
        cells = s.order[s.areas[me.area].begin : s.areas[me.area].end]
        left = [int(cell) for cell in cells if s.home[cell] & VISITED == 0]
        target = next((cell for cell in before if cell in left), None)
        way = [] if target is None else self._way(number, target)
        nearest = self.problem.paths_of(number).cost_to(int(self.loop.cells[me.cell]), self.loop.cells[left])
        if me.doing == Doing.COVERING:
            mine = self.raw.home >> AREA_BITS == me.area
            self.raw.home[mine] &= ~np.array(TO_DO, dtype=self.raw.home.dtype)
        me.doing = Doing.TRAVELING
        if self._saves(nearest, self._cost(way)) or not way:
            self._travel(number)
        else:
            self._head_for(number, way[-1])

    def _travel(self, number: int) -> None:
        """The safest path to the target of the robot's area."""
        s, me = self.s, self.s.robots[number]
        if self.p is None:
            self._head_for(number, interpreted("paths").entry_of(self.t, s, self.w, number, me.area))
        else:
            costs = interpreted("areas").costs_from(self.t, s, self.w, number)
            self._head_for(number, interpreted("next_area").see(self.t, s, costs, number, me.cell, me.area)[0])

    def _head_for(self, number: int, target: int) -> None:
        interpreted("next_area").head_for(self.t, self.s, self.w, number, int(target))

    # --- what else may happen ---

    def _look_round(self, number: int) -> None:
        """The first of the unassigned areas, if the policy has it before the robot's own, and the way saves enough."""
        t, p, s, w, me = self.t, self.p, self.s, self.w, self.s.robots[number]
        left = self._cost(self.path_ahead(number))
        s.marks.now = 1
        if p is None:
            area, target = interpreted("areas").find_next_area(t, s, w, number)
            cost = self._cost(self._way(number, target)) if area != NONE else 0
        else:
            area, target, cost = interpreted("next_area").first_area(t, p, s, w, number, NONE, True)
        takes = area != NONE and self._saves(int(cost), left)
        if takes and p is not None:
            takes = not interpreted("next_area").has_to_wait(t, p, s, w, number, area, cost)
        if takes and self._key(number, int(area), int(cost)) < self._key(number, me.area, left):
            areas = interpreted("areas")
            areas.note(self.log, s, number, areas.LOOKED_AGAIN_EVENT, me.area, me.next)
            areas.reopen(s, me.area)
            if p is not None:
                interpreted("replanning").take(t, p, s, w, self.log, number, area, target)
            else:
                areas.give(s, number, area)
                self._head_for(number, target)
                areas.note(self.log, s, number, areas.ALLOCATED_EVENT, area, target)
            self.s.marks.progress = 1
            if me.cell == me.target:
                self.go_on(number)
        s.marks.now = 0

    def _key(self, number: int, area: int, cost: int) -> Any:
        """By what the rule orders an area whose target costs so much to reach."""
        if self.p is not None:
            return self.loop.rule.key(
                Offer(*interpreted("policy").offer_of(self.t, self.p, self.s, number, area, cost))
            )
        level = interpreted("robot_types").own_level(self.t, number, self.s.areas[area].level)
        return int(level), cost

    def visit(self, number: int, cell: int) -> None:
        """The robot has been at the cell, at some time before."""
        at, s = int(np.searchsorted(self.loop.cells, cell)), self.s
        if s.home[at] & VISITED == 0:
            interpreted("visits").visit(s, self.c, self.log, s.marks.step, number, at, 1, VISITED | SURVIVED)
            if self.p is not None:
                s.home[at] = int(s.home[at]) & ~TO_DO
        elif s.home[at] & SURVIVED == 0:
            interpreted("visits").mark_survived(s, self.c, at)

    def find(self, number: int) -> None:
        """A lost robot is back."""
        self.s.marks.alive += 1
        self.turned.discard(number)
        self.s.robots[number].held = 0
        self._bring_back(number, Doing.IDLE)

    def bring_back(self, number: int) -> None:
        """The robot makes progress again."""
        if number in self.aside:
            self.aside.discard(number)
            me = self.s.robots[number]
            if me.doing == Doing.DONE and number not in self.turned:
                self._bring_back(number, Doing.DONE)

    def _bring_back(self, number: int, doing: Doing) -> None:
        """The robot may get an area, if it has moves left."""
        me, left = self.s.robots[number], self.moves_left(number)
        me.doing, me.until = doing if left > 0 else Doing.DONE, left
        self.left.pop(number, None)
        if left > 0:
            interpreted("state").put(self.s.waiting, number)
        else:
            self.left[number] = 0

    def set_aside(self, number: int) -> None:
        """The robot makes no progress: its work is for others, until it moves."""
        self._lay_down(number)
        self.aside.add(number)

    def _lay_down(self, number: int) -> None:
        """It is done, and what it leaves is for others."""
        t, s, w, log, me = self.t, self.s, self.w, self.log, self.s.robots[number]
        owns, followed, area = interpreted("areas").has_area(s.robots, number), me.doing == Doing.FOLLOWING, me.area
        self.left[number] = self.moves_left(number)
        interpreted("state").drop(s.movers, number)
        interpreted("state").drop(s.waiting, number)
        me.doing = Doing.DONE
        home = interpreted("return_home")
        if owns:
            home.leave(t, s, w, log, number, area)
        for left in range(len(t.owner)) if followed else ():
            if t.owner[left] == number and s.areas[left].left > 0:
                home.leave(t, s, w, log, number, left)

    def call_off(self) -> None:
        """The operator ends the mission between two steps: robots that return to base start their return.

        What had ended it before stays the reason.
        """
        self._call_home(Outcome.ENDED_BY_OPERATOR)

    def come_home(self) -> None:
        """Nothing may be left to do between two steps: then the robots that return to base start their return."""
        if self.problem.home is not None and self.unvisited == 0:
            self._call_home(Outcome.COMPLETE)

    def _call_home(self, why: Outcome) -> None:
        with self._between():
            over, self.s.marks.over = self.s.marks.over, 0
            why = Outcome(over - 1) if over else why
            interpreted("return_home").call_home(self.t, self.s, self.w, self.log, int(why))
            self.take_events()
            self._call_home_from_aside()
        self._review()

    def _call_home_from_aside(self) -> None:
        """Robots that make no progress start their return too."""
        for number in sorted(self.aside - self.turned):
            if self.s.robots[number].doing != Doing.DEAD and self.moves_left(number) > 0:
                self.s.robots[number].until = self.left.pop(number) + self._turns(number)
                interpreted("return_home").turn_home(self.t, self.s, self.w, self.log, number, False)
                self.take_events()

    @property
    def over(self) -> Outcome | None:
        """How the mission ended for which all have started their return; None: it goes on."""
        over = int(self.raw.marks["over"])
        return Outcome(over - 1) if over else None

    def retire(self, number: int) -> None:
        """The robot does no more."""
        with self._between():
            self.limit(number, 0)
            if self.s.robots[number].doing != Doing.DEAD:
                self._lay_down(number)

    def limit(self, number: int, moves: int) -> None:
        """The robot can still make so many moves, whatever was known of its range."""
        me, ranges = self.s.robots[number], self.problem.range.copy()
        made = max(int(ranges[number]) - self.moves_left(number), 1)
        ranges[number] = made + moves
        self.problem = replace(self.problem, range=ranges)
        if holds(self.raw.movers, number):
            me.until = moves + self._turns(number)
        elif holds(self.raw.waiting, number):
            me.until = moves
        else:
            self.left[number] = moves
        rests = me.doing in (Doing.IDLE, Doing.DONE) and not holds(self.raw.waiting, number)
        if moves > 0 and rests and self.over is None:
            self.turned.discard(number)  # with a new battery it gets work again
            if number not in self.aside:
                self._bring_back(number, Doing(me.doing))


# What robots are told, and what they tell.

Why = Literal["travel", "cover", "follow", "return", "hold", "idle"]
"""`travel` to its area, `cover` it, `follow` another planner's path, `return` home; `hold`: it waits its turn, has no
moves left or makes no progress; `idle`: nothing is left for it."""
Cell = tuple[int, int]


@dataclass(frozen=True)
class Order:
    """What a robot is to do in the step that is under way.

    Attributes:
        robot: its number. cell: (row, col), where it is to be at the end of the step.
        path: cells that it is to enter after that one, as things stand.
        area: the id of the area that it works on, or NO_AREA. why: what it does.
    """

    robot: int
    cell: Cell
    path: tuple[Cell, ...] = ()
    area: int = NO_AREA
    why: Why = "idle"

    def to_json(self) -> Json:
        """As a JSON object."""
        path = [list(cell) for cell in self.path]
        return {"robot": self.robot, "cell": list(self.cell), "path": path, "area": self.area, "why": self.why}


@dataclass(frozen=True)
class Report:
    """What a robot, or who watches it, said of the step that is under way.

    Attributes:
        cell: index of the cell where it is. stopped: it is lost there. found: it was lost before, and is back.
        moves_left: that it can still make; None: as known.
    """

    cell: int
    stopped: bool = False
    found: bool = False
    moves_left: int | None = None


# What robots said of the step under way: whether it can be true, and what of it was late.


class Reports:
    """Reports to a fleet.

    Attributes:
        fleet: as it stands at the end of the last step.
        now: by robot, what holds at the end of this one. passed: (robot, cell) where it was in a step before.
        heard: of each robot the last step that it reported of. seen: p of cells that were seen, None of an obstacle.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.now: dict[int, Report] = {}
        self.passed: list[tuple[int, int]] = []
        self.heard = [fleet.step] * len(fleet.robots)
        self.seen: dict[int, float | None] = {}

    def carry(self, before: Reports) -> None:
        """Take over what was reported before cells were closed; of late ones what can be reached still."""
        self.now, self.heard, self.seen = before.now, before.heard, before.seen
        self.passed = [one for one in before.passed if self.fleet.problem.part[one[1]]]

    def clear(self) -> None:
        """The step is over."""
        self.now, self.passed, self.seen = {}, [], {}

    def hear(self, number: int, cell: ArrayLike | None, step: Any, moves_left: Any, **flags: bool) -> Report | None:
        """A report, arguments as of `Mission.report`; what holds of this step by it, None if nothing is new.

        What is late is taken to hold of a step before, and the report of where the robot was is given back.
        Raises StateError, and nothing is taken.
        """
        there, current = self._cell(number, cell), self.fleet.step + 1
        if moves_left is not None and not is_whole(moves_left, 0, MAX_STEP):
            raise StateError(f"robot {number}: moves_left is {moves_left!r}", expected=f"0 to {MAX_STEP}")
        said = current if step is None else as_whole(step)
        if not is_whole(said, 0, current):
            raise StateError(f"robot {number} reports of step {said!r}", expected=f"a step up to {current}")
        if said < current and said <= self.heard[number] and not any(flags.values()):
            self.passed.append((number, there))
            return Report(there)
        before = self.now.get(number)
        if before is not None and said > self.heard[number] and not before.stopped and there != before.cell:
            self.passed.append((number, before.cell))  # it was late itself
            self.now[number] = replace(before, cell=there)
        report = self._agreed(number, Report(there, moves_left=moves_left, **flags))
        self.heard[number] = max(said, self.heard[number])
        self.now[number] = report
        return None if report == before else report

    def _cell(self, number: int, cell: ArrayLike | None) -> int:
        """The index of the cell that a robot says it is at."""
        if cell is None:
            return self.now[number].cell if number in self.now else self.fleet.cell(number)
        world, part, found = self.fleet.problem.world, self.fleet.problem.part, whole_numbers(cell)
        height, width = world.shape
        expected = f"[row, col] of a cell that it can reach, row 0..{height - 1} and col 0..{width - 1}"
        if found.shape != (2,):
            raise StateError(f"robot {number} is at {cell!r:.60}", expected=expected)
        row, col = map(int, found)
        index, where = row * width + col, f"robot {number} is at [{row}, {col}]"
        if not (0 <= row < height and 0 <= col < width):
            raise StateError(f"{where}, off the map", expected=expected)
        if not world.free[row, col] or (index in self.seen and self.seen[index] is None):
            raise StateError(f"{where}, an obstacle", expected=expected)
        if part[index] != part[self.fleet.cell(number)]:
            raise StateError(f"{where}, with no way there", expected=expected)
        return index

    def _agreed(self, number: int, new: Report) -> Report:
        """The report, if it can be true with what is known; what it leaves out as it was said before in this step."""
        robot, before = self.fleet.robots[number], self.now.get(number)
        lost = (not robot.alive and (before is None or not before.found)) or (before is not None and before.stopped)
        where = robot.cell if before is None else before.cell
        if lost and not new.found:
            if new.stopped and new.cell == where:
                return before or replace(new, moves_left=None)
            what = "moves" if new.cell != where else "reports"
            raise StateError(f"robot {number} is lost, and {what}", expected="found, if it was found again")
        if lost and self.seen.get(new.cell, 0.0) is None:
            found = f"robot {number} is found at {at(new.cell, self.fleet.problem.world)}, seen to be an obstacle"
            raise StateError(found, expected="the cell where it is")
        if before is None or lost:
            return replace(new, found=lost and new.found)
        if new.cell != before.cell:
            places = " and ".join(at(cell, self.fleet.problem.world) for cell in (before.cell, new.cell))
            raise StateError(
                f"robot {number} is at {places} in step {self.fleet.step + 1}", expected="one place a step"
            )
        moves_left = before.moves_left if new.moves_left is None else new.moves_left
        return Report(new.cell, new.stopped, before.found, moves_left)

    def said(self) -> list[Json]:
        """They as files hold them."""
        width, late = self.fleet.problem.world.shape[1], self.fleet.step
        passed = [{"robot": robot, "cell": list(divmod(cell, width)), "step": late} for robot, cell in self.passed]
        return passed + [
            {"robot": number, **asdict(report), "cell": list(divmod(report.cell, width))}
            for number, report in self.now.items()
        ]


def whole_numbers(given: ArrayLike) -> NDArray[np.int64]:
    """They as an array; an empty one for anything else."""
    try:
        found = np.asarray(given)
    except ValueError:  # ragged
        found = np.zeros(0)
    return found if found.dtype.kind in "iu" else np.zeros(0, dtype=np.int64)
