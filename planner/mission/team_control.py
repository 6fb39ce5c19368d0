"""A run whose robots deviate from decisions (displaced, late, blocked, found, recharged), by orders and reports."""

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
from planner.simulator.codes import MOVES, NO_AREA, NONE, Doing, Outcome
from planner.simulator.jit import interpreted
from planner.simulator.offers import Offer
from planner.simulator.state import AREA_BITS, SURVIVED, TO_DO, VISITED


class Fleet(SingleRun):
    """A team that reports events. In each step: `begin_step`, every robot's turn, `end_step`.

    A turn is `decide`, then `enter`, `displace` or `wait`, then `stop` or `survive`.

    Attributes:
        problem: of the plan, with the known range of each robot.
        gain: share of the cost of its path that another target must save for a robot to change; 1: it never does.
        aside: indices of robots without progress, which get no areas.
    """

    under_way = False
    _moves_now = False
    """Whether the robot that decided last has a move, which counts as made."""

    def __init__(
        self, problem: Problem, plan: Plan, gain: float = 1.0, last_update: int = 0, cut_off: bool = False
    ) -> None:
        """Prepare the team.

        Args:
            problem, plan, gain: as in the class.
            last_update: begin of the last announced phase that changes the map, 0: none.
            cut_off: whether wrecks cut unvisited cells off, so that the mission is never complete.
        """
        super().__init__(compile_closed_loop(plan, problem.world, problem=problem, interpreted=True))
        # A visit may destroy a robot in any cell: it counts as survived only once that is reported.
        phases: dict[str, Any] = {"phases": np.zeros(1, dtype=np.int64), "phased": True, "last_update": last_update}
        self.t = self.t._replace(bound=np.zeros_like(self.t.bound), notes=None, **phases)
        self.problem, self.gain, self.aside = problem, gain, set[int]()
        self.s.marks.unfinished += cut_off
        # A resumed state may be complete already, before any step.
        if self.step != NOT_BEGUN:
            self._review()

    def fork(self) -> Self:
        """An independent copy, see `SingleRun.fork`."""
        other = super().fork()
        other.aside = self.aside.copy()
        return other

    @property
    def places(self) -> dict[int, int]:
        """The cell of each robot that is not lost."""
        return {number: self.cell(number) for number in np.flatnonzero(self.alive).tolist()}

    # --- steps ---

    @property
    def step(self) -> int:
        """The current step, or the last one that is over."""
        return int(self.raw.marks["step"]) - (self.outcome is None and not self.under_way)

    def begin_step(self) -> None:
        """Begin the next step."""
        # Reports can split areas more often than a run without deviations does.
        self._make_room()
        marks = self.s.marks
        if self.outcome is not None:
            marks.step, self.outcome = marks.step + 1, None
        self.log.events[0, 0], marks.progress, self.under_way = 0, 0, True
        self.raw.robots["sure"] = NONE  # a displaced robot compares all areas again
        if self.p is not None:
            interpreted("replanning").begin(self.t, self.s, self.w)
        interpreted("step").forget(self.t, self.p, self.s, self.w)

    def end_step(self) -> None:
        """End the step after every robot's turn."""
        t, p, s, w, log, how = self.t, self.p, self.s, self.w, self.log, self.how
        with np.errstate(over="ignore"):
            found = interpreted("step").learn_and_end(t, p, s, self.c, w, log, how, self.ids)
        self.under_way = False
        self.outcome = None if found == NONE else Outcome(int(found))
        self.take_events()
        if self.raw.marks["over"]:
            self._call_home_from_aside()

    def reopen_step(self) -> None:
        """Reopen the last step, which was over."""
        # A step that is over has already been counted, unless the run ended in it.
        if self.outcome is None:
            self.s.marks.step -= 1
        self.outcome, self.under_way = None, True

    @contextmanager
    def _between(self) -> Iterator[None]:
        """Context for a change between two steps, after the last one."""
        # Events between two steps are recorded as events of the step that is over.
        last = self.s.marks.step = self.step
        self.under_way, self.log.events[0, 0] = True, 0
        yield
        self.under_way, self.s.marks.step = False, last + (self.outcome is None)

    def _review(self) -> None:
        """End the run if a change between two steps has completed it."""
        with self._between():
            step = interpreted("step")
            found = step.over_by(self.t, self.p, self.s, self.w, int(step.end_of(self.t, self.s, self.how)))
            self.outcome = None if found == NONE else Outcome(int(found))

    # --- a robot's turn ---

    def decide(self, number: int) -> int | None:
        """The robot's decision in this step: the cell that it enters, or None if it stays.

        At t = 0 that is its start, entered like any other cell.

        Args:
            number: index of the robot.
        """
        s, step, me = self.s, self.s.marks.step, self.s.robots[number]
        s.marks.robot, self._moves_now = number, False
        # The kernels keep the active robots as bits of 64-bit words.
        if not int(interpreted("step").acting(self.t, self.p, s, number // 64, NONE)) >> number % 64 & 1:
            return None
        # With gain 1 this is never done, so that reports without deviations reproduce the closed loop.
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

    def enter(self, number: int, cell: int | None = None) -> None:
        """The robot has entered the cell that was decided, or the accessible cell of this number."""
        s, me, step = self.s, self.s.robots[number], self.s.marks.step
        s.marks.progress, decided = 1, me.next if step > 0 else me.cell
        cell = decided if cell is None else cell
        if self.p is not None:
            # Before the cell is marked as visited: afterwards it is no cell to do.
            s.marks.changes += interpreted("replanning").visits_other_area(s, number, cell)
            s.home[cell] = int(s.home[cell]) & ~TO_DO
        interpreted("visits").enter(self.t, s, self.c, self.w, self.log, self.how, self.ids, step, number, cell, 1)

    def stop(self, number: int) -> None:
        """The robot, which has just entered its cell, is lost there."""
        self._count_moves()  # it may have begun to move in this step
        interpreted("visits").lose(self.t, self.s, self.c, self.w, self.log, number)
        # A comparison that a robot made before may be outdated by the loss.
        interpreted("areas").compare_again(self.s)

    def survive(self, number: int) -> None:
        """The robot has survived the cell that it has just entered."""
        interpreted("visits").survive(self.t, self.s, self.c, self.s.marks.step, number, self.s.robots[number].cell, 1)
        self._arrive(number)

    def _arrive(self, number: int) -> None:
        me = self.s.robots[number]
        interpreted("step").arrive(self.t, self.p, self.s, self.w, self.log, self.how, number, me.cell)

    def wait(self, number: int) -> None:
        """The robot is on its way and has not arrived yet: the step counts as progress."""
        me = self.s.robots[number]
        self.s.marks.progress = 1
        if holds(self.raw.moving, number):
            me.until += 1  # as many moves left as before
        if me.doing == Doing.FOLLOWING:
            self._insert(number, [me.cell])

    def displace(self, number: int, cell: int) -> None:
        """The robot is in another cell than decided: the cell is visited, and the robot continues from there.

        Args:
            number: index of the robot.
            cell: index `row * W + col`.
        """
        me, width = self.s.robots[number], self.problem.world.shape[1]
        ahead = self.path_ahead(number)
        before = ahead if me.doing == Doing.COVERING else ahead[-1:]
        here, there = divmod(int(self.loop.cells[me.cell]), width), divmod(cell, width)
        # The robot used as many moves as the distance from where it was, instead of the one that was decided.
        used = sum(abs(a - b) for a, b in zip(here, there, strict=True)) - self._moves_now
        self._set_moves(number, max(0, self.moves_left(number) - used))
        # Kernels number the accessible cells only, in the order of their indices.
        self.enter(number, int(np.searchsorted(self.loop.cells, cell)))
        self._set_out(number, before)

    def go_on(self, number: int) -> None:
        """A displaced robot, or one at the end of its range, has survived: it continues from its cell."""
        t, p, s, w, log, how, me = self.t, self.p, self.s, self.w, self.log, self.how, self.s.robots[number]
        interpreted("visits").survive(t, s, self.c, s.marks.step, number, me.cell, 1)
        if t.returns and me.doing == Doing.RETURNING:
            interpreted("return_home").move_to_base(t, s, log, number)
        elif self.moves_left(number) == 0:
            if holds(self.raw.moving, number) or holds(self.raw.waiting, number):
                interpreted("return_home").stay(t, s, w, log, number)
        elif me.doing == Doing.FOLLOWING:
            self._arrive(number)
        elif interpreted("areas").has_area(s.robots, number):
            if s.marks.step == 0 and int(s.home[me.cell]) >> AREA_BITS == me.area:
                me.target = me.cell  # it starts covering in its area
            ended = me.cell == me.target or s.areas[me.area].left == 0
            if p is None and (me.cell == me.target or (me.doing == Doing.COVERING and me.left == 0)):
                interpreted("fixed_paths").after_move(t, s, w, log, how, number)
            elif p is not None and ended:
                interpreted("replanning").end_leg(t, p, s, w, log, how, number)

    def _set_out(self, number: int, before: list[int]) -> None:
        """Compute a new path to the robot's work; `before`: the next cells that it was to cover."""
        t, s, w, me = self.t, self.s, self.w, self.s.robots[number]
        if number in self.turned and t.returns:
            ahead = interpreted("range_budget").moves_home(t, number, me.cell)
            if ahead < 0:
                interpreted("state").drop(s.moving, number)
                me.doing = Doing.DONE
            elif holds(self.raw.moving, number) or ahead > 0:
                me.doing, me.next = Doing.RETURNING, t.onward[t.home_of[number], me.cell]
                self._move_again(number)
        elif me.doing == Doing.FOLLOWING:
            step = s.marks.step
            due = int(t.given[number, min(max(step, 1), t.length[number])])
            self._insert(number, [me.cell, *self._way(number, due)[:-1]])
        elif interpreted("areas").has_area(s.robots, number) and s.areas[me.area].left > 0:
            self._aim_as_before(number, before)
        elif interpreted("areas").has_area(s.robots, number):
            if self.p is None:
                # The area is complete: the robot ends it as if it had covered its last cell on its path.
                me.doing, me.left = Doing.COVERING, 0
                interpreted("fixed_paths").after_move(t, s, w, self.log, self.how, number)
            else:
                interpreted("replanning").allocate_next(t, self.p, s, w, self.log, number, False)

    def _insert(self, number: int, cells: list[int]) -> None:
        """Insert these cells into the path of a robot that follows an external plan."""
        t, step = self.t, self.s.marks.step
        path = t.given[number, : t.length[number] + 1].tolist()
        # The entries up to the current step are history; the rest of the path is delayed by the inserted cells.
        path = [*path[:step], *cells, *path[step:]] if step > 0 else [*cells, *path[1:]]
        longest = max(len(path), t.given.shape[1])
        # All robots' paths are rows of one array: the others wait at their ends, as before.
        given = np.pad(t.given, ((0, 0), (0, longest - t.given.shape[1])), mode="edge")
        given[number], length = path[-1], t.length.copy()
        given[number, : len(path)], length[number] = path, len(path) - 1
        self.t = t._replace(given=given, length=length)
        self.s.robots[number].next = given[number, min(step + 1, length[number])]

    def _way(self, number: int, target: int) -> list[int]:
        """The cells entered on the safest path from the robot's cell, as numbers of accessible cells."""
        way = self.problem.paths_of(number).path(*self.loop.cells[[self.s.robots[number].cell, target]].tolist())
        return np.searchsorted(self.loop.cells, way).tolist()

    def _cost(self, way: list[int]) -> int:
        return int(self.problem.costs[self.loop.cells[way]].sum())

    def _saves(self, cost: int, of: int) -> bool:
        return of - cost > self.gain * of

    def _aim_as_before(self, number: int, before: list[int]) -> None:
        """Head for the next of the cells `before`, or for the nearest cell of its area if that saves enough."""
        s, me = self.s, self.s.robots[number]
        cells = s.order[s.areas[me.area].begin : s.areas[me.area].end]
        left = [int(cell) for cell in cells if s.home[cell] & VISITED == 0]
        # The interrupted coverage path goes on at its first cell that is not visited yet.
        target = next((cell for cell in before if cell in left), None)
        way = [] if target is None else self._way(number, target)
        nearest = self.problem.paths_of(number).cost_to(int(self.loop.cells[me.cell]), self.loop.cells[left])
        if me.doing == Doing.COVERING:
            mine = self.raw.home >> AREA_BITS == me.area
            # The coverage path is computed anew when the robot arrives.
            self.raw.home[mine] &= ~np.array(TO_DO, dtype=self.raw.home.dtype)
        me.doing = Doing.TRAVELING
        if self._saves(nearest, self._cost(way)) or not way:
            self._travel(number)
        else:
            self._head_for(number, way[-1])

    def _travel(self, number: int) -> None:
        """Set the safest path to the target of the robot's area."""
        s, me = self.s, self.s.robots[number]
        if self.p is None:
            self._head_for(number, interpreted("paths").entry_of(self.t, s, self.w, number, me.area))
        else:
            costs = interpreted("areas").costs_from(self.t, s, self.w, number)
            self._head_for(number, interpreted("next_area").see(self.t, s, costs, number, me.cell, me.area)[0])

    def _head_for(self, number: int, target: int) -> None:
        interpreted("next_area").head_for(self.t, self.s, self.w, number, int(target))

    # --- other events ---

    def _look_round(self, number: int) -> None:
        """Take the first unassigned area if the policy prefers it to the robot's own and the path saves enough."""
        t, p, s, w, me = self.t, self.p, self.s, self.w, self.s.robots[number]
        left = self._cost(self.path_ahead(number))
        s.marks.now = 1
        if p is None:
            area, target = interpreted("areas").find_next_area(t, s, w, number)
            cost = self._cost(self._way(number, target)) if area != NONE else 0
        else:
            area, target, cost = interpreted("next_area").first_area(t, p, s, w, number, NONE, True)
        # A threshold on the saving: without it, small differences of cost would make robots turn back and forth.
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
        """Sort key of an area whose target costs `cost` to reach."""
        if self.p is not None:
            return self.loop.rule.key(
                Offer(*interpreted("policy").offer_of(self.t, self.p, self.s, number, area, cost))
            )
        level = interpreted("robot_types").own_level(self.t, number, self.s.areas[area].level)
        return int(level), cost

    def visit(self, number: int, cell: int) -> None:
        """Mark a cell that the robot visited in an earlier step."""
        at, s = int(np.searchsorted(self.loop.cells, cell)), self.s
        if s.home[at] & VISITED == 0:
            interpreted("visits").visit(s, self.c, self.log, s.marks.step, number, at, 1, VISITED | SURVIVED)
            if self.p is not None:
                s.home[at] = int(s.home[at]) & ~TO_DO
        elif s.home[at] & SURVIVED == 0:
            interpreted("visits").mark_survived(s, self.c, s.marks.step, at, 1)
        if len(s.undelivered):
            interpreted("state").put(s.undelivered[number], at)
            interpreted("visits").deliver(self.t, s, number, at)

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
        """Make the robot available for areas, if it has moves left."""
        me, left = self.s.robots[number], self.moves_left(number)
        me.doing, me.until = doing if left > 0 else Doing.DONE, left
        if left > 0:
            interpreted("state").put(self.s.waiting, number)

    def set_aside(self, number: int) -> None:
        """The robot makes no progress: its work is reassigned until it moves."""
        self._lay_down(number)
        self.aside.add(number)

    def _lay_down(self, number: int) -> None:
        """Release the robot's work."""
        t, s, w, log, me = self.t, self.s, self.w, self.log, self.s.robots[number]
        owns, followed, area = interpreted("areas").has_area(s.robots, number), me.doing == Doing.FOLLOWING, me.area
        self._count_moves()
        interpreted("state").drop(s.moving, number)
        interpreted("state").drop(s.waiting, number)
        self._count_moves()
        me.doing = Doing.DONE
        home = interpreted("return_home")
        if owns:
            home.leave(t, s, w, log, number, area)
        for left in range(len(t.owner)) if followed else ():
            if t.owner[left] == number and s.areas[left].left > 0:
                home.leave(t, s, w, log, number, left)

    def call_off(self) -> None:
        """The operator ends the mission between two steps: robots that return to base start their return.

        An earlier reason for the end is kept.
        """
        self._call_home(Outcome.ENDED_BY_OPERATOR)

    def come_home(self) -> None:
        """Start the return to base if nothing is left to do between two steps."""
        if self.problem.home is not None and self.s.marks.unfinished == 0:
            self._call_home(Outcome.COMPLETE)

    def _call_home(self, why: Outcome) -> None:
        with self._between():
            over, self.s.marks.over = self.s.marks.over, 0
            why = Outcome(over - 1) if over else why
            interpreted("return_home").start_returns(self.t, self.s, self.w, self.log, int(why))
            self.take_events()
            self._call_home_from_aside()
        self._review()

    def _call_home_from_aside(self) -> None:
        """Start the return of robots without progress too."""
        for number in sorted(self.aside - self.turned):
            if self.s.robots[number].doing != Doing.DEAD and self.moves_left(number) > 0:
                self._move_again(number)
                self._count_moves()
                interpreted("return_home").start_return(self.t, self.s, self.w, self.log, number, False)
                self.take_events()

    @property
    def over(self) -> Outcome | None:
        """The outcome for which all robots have started their return; None: the mission goes on."""
        over = int(self.raw.marks["over"])
        return Outcome(over - 1) if over else None

    def retire(self, number: int) -> None:
        """The robot no longer takes part."""
        with self._between():
            self.limit(number, 0)
            if self.s.robots[number].doing != Doing.DEAD:
                self._lay_down(number)

    def limit(self, number: int, moves: int) -> None:
        """Set the number of moves that the robot can still make, whatever its known range."""
        me, ranges = self.s.robots[number], self.problem.range.copy()
        made = max(int(ranges[number]) - self.moves_left(number), 1)
        ranges[number] = made + moves
        self.problem = replace(self.problem, range=ranges)
        self._set_moves(number, moves)
        rests = me.doing in (Doing.IDLE, Doing.DONE) and not holds(self.raw.waiting, number)
        if moves > 0 and rests and self.over is None:
            self.turned.discard(number)  # with a new battery it is given work again
            if number not in self.aside:
                self._bring_back(number, Doing(me.doing))

    def _move_again(self, number: int) -> None:
        """Let a robot that rests move: `until` becomes a turn again."""
        if not holds(self.raw.moving, number):
            self.s.robots[number].until += self._turns(number)
            interpreted("state").put(self.s.moving, number)

    def _set_moves(self, number: int, moves: int) -> None:
        turns = self._turns(number) if holds(self.raw.moving, number) else 0
        self.s.robots[number].until = moves + turns


# Orders and reports.

Why = Literal["travel", "cover", "follow", "return", "hold", "idle"]
"""`travel` to its area, `cover` it, `follow` an external path, `return` to base; `hold`: it waits for the cap on robots
at risk, has no moves left or makes no progress; `idle`: there is no work for it."""
Cell = tuple[int, int]


@dataclass(frozen=True)
class Order:
    """Order of a robot for the current step.

    Attributes:
        robot: index. cell: (row, col) at the end of the step.
        path: cells that it would enter after that.
        area: the id of its area, or NO_AREA. why: its activity.
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
    """Report on a robot in the current step.

    Attributes:
        cell: index of its cell. stopped: whether it is lost there. found: whether it was lost before, and is back.
        moves_left: moves that it can still make; None: as known.
    """

    cell: int
    stopped: bool = False
    found: bool = False
    moves_left: int | None = None


# Reports of the current step: their consistency, and late ones.


class Reports:
    """Reports to a fleet.

    Attributes:
        fleet: at the end of the last step.
        now: reports of the current step, by robot. passed: (robot, cell) of late reports.
        heard: last step that each robot reported of. seen: p of observed cells, None for an obstacle.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.now: dict[int, Report] = {}
        self.passed: list[tuple[int, int]] = []
        self.heard = [fleet.step] * fleet.loop.robots
        self.seen: dict[int, float | None] = {}

    def carry(self, before: Reports) -> None:
        """Take over the reports before cells were closed; late ones only if their cells are still reachable.

        Args:
            before: the reports.
        """
        self.now, self.heard, self.seen = before.now, before.heard, before.seen
        self.passed = [one for one in before.passed if self.fleet.problem.part[one[1]]]

    def clear(self) -> None:
        """End the step."""
        self.now, self.passed, self.seen = {}, [], {}

    def hear(self, number: int, cell: ArrayLike | None, step: Any, moves_left: Any, **flags: bool) -> Report | None:
        """Check and store a report.

        A late report counts for an earlier step; the result is then the report of where the robot was.

        Args:
            number: index of the robot.
            cell, step, moves_left, flags: as in `Mission.report`.

        Returns:
            The report that now holds for this step; None if nothing is new.

        Raises:
            StateError: it cannot be true; nothing is stored.
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
        """Index of the reported cell of a robot, checked."""
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
        """The report, if consistent with what is known; missing parts as reported before in this step."""
        before = self.now.get(number)
        lost = (not self.fleet.alive[number] and (before is None or not before.found)) or (
            before is not None and before.stopped
        )
        where = self.fleet.cell(number) if before is None else before.cell
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

    def as_json(self) -> list[Json]:
        """The reports as in files."""
        width, late = self.fleet.problem.world.shape[1], self.fleet.step
        found = [({"robot": robot, "step": late}, cell) for robot, cell in self.passed]
        found += [({"robot": robot, **asdict(report)}, report.cell) for robot, report in self.now.items()]
        return [report | {"cell": list(divmod(cell, width))} for report, cell in found]


def whole_numbers(given: ArrayLike) -> NDArray[np.int64]:
    """Whole numbers as an int64 array; an empty one for anything else."""
    try:
        found = np.asarray(given)
    except ValueError:  # lists of unequal length
        found = np.zeros(0)
    return found if found.dtype.kind in "iu" else np.zeros(0, dtype=np.int64)
