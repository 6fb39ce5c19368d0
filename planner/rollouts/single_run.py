"""One rollout, a step at a time: the simulator as Python (`planner.simulator.jit.interpreted`).

It is the rollout of the same seed and id that the compiled programs count, event for event.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from planner.mrac.problem import Problem, ready_loop
from planner.plan.plan import Area, Leg, LegKind, Plan
from planner.plan.state import NO_CELLS, AreaState, MissionState, RobotState
from planner.rollout_sampling import rows_met
from planner.rollouts.closed_loop import compile_closed_loop, logged_rollouts, trace_from
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.runners import Runner
from planner.rollouts.tables import first_frames
from planner.settings import AGAIN
from planner.simulator.areas import FRAME_AREA, FRAME_DOING, FRAME_ROWS, Log
from planner.simulator.codes import ACTS, LANDING, NO_AREA, NO_ROBOT, NONE, STARTING, Doing, EventKind, Outcome
from planner.simulator.jit import interpreted
from planner.simulator.state import AREA_BITS, MOST_NARROW, SURVIVED, TO_DO, VISITED, State, Work, first_room, make_work
from planner.tally import Trace
from planner.world.world import World

holds = interpreted("state").holds
Hit = Callable[[int, int, int], bool]
"""`hit(robot, step, cell)`: whether the robot is lost as it enters the cell at this step."""
OWN = "left", "at", "met", "begin"
"""Scratch arrays that belong to the rollout, not to the world."""
TRAVELING, COVERING = int(Doing.TRAVELING), int(Doing.COVERING)  # an array takes long to compare with an enum's member
NOT_BEGUN = -1
"""The step before t = 0, at which robots enter their starts."""


class Notes:
    """The areas made during a run, each with its cells at that moment.

    Attributes:
        made: in id order.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        self.made, self._loop, self._known = list[Area](), loop, len(loop.tables.level)

    def move(self, s: Any, robot: int) -> None:
        """Called before the robot enters its next cell."""

    def areas(self, s: Any) -> None:
        """Called after areas have been made."""
        home = s.home[:-1] >> AREA_BITS
        for number in range(self._known, int(s.marks.areas)):
            self.made.append(Area(int(s.areas[number].level), NO_ROBOT, self._loop.cells[home == number]))
        self._known = int(s.marks.areas)


class SingleRun:
    """A rollout in progress.

    Attributes:
        loop: the closed loop. rollout: the number of the rollout. outcome: None until the rollout ends.
        raw: the state, as arrays. `s` holds the same memory as records, for the simulator as Python; `t`, `p`, `w`,
            `c`, `how` and `log` are the other arguments of its functions.
        new_events: int32 `[n, 5]`, the events of the last step, with cells as numbers of accessible cells.
        turned: robots that have started their return to base, which they never abort.
        records: whether steps are kept for `trace` and `legs`, which costs a tenth of a step's time.
    """

    records = True

    def __init__(
        self, loop: ClosedLoop, seed: int = 0, rollout: int = 0, known: Work | None = None, hit: Hit | None = None
    ) -> None:
        """Prepare the rollout.

        Args:
            loop: the closed loop.
            seed: of the random numbers.
            rollout: id.
            known: scratch arrays of another run of the loop, with its path costs.
            hit: decides every loss instead of the random numbers.
        """
        runner = Runner(loop, seed, 1, None if known is None else [known])
        self.loop, self.rollout = loop, rollout
        self.p, self.c, self.w, self.notes = runner.policy, runner.counts, runner.work, Notes(loop)
        # Scratch is shared by the runs of one loop, which may advance in turn. So each run has its own `begin`, and
        # finds coverage paths leg by leg, since cached ones belong to the run that is made first.
        self.w = self.w._replace(paths=self.w.paths[:0], begin=np.array([rollout], dtype=np.int64))
        self.t = runner.tables._replace(notes=self.notes)
        self.how = runner.how._replace(pause=True, in_area=loop.in_area)
        if hit is not None:
            cells = loop.cells

            def loses(robot: int, step: int, cell: int) -> bool:
                return hit(robot, step, int(cells[cell]))

            self.t = self.t._replace(bound=np.ones_like(self.t.bound), loses=loses)
        self.ids = np.array([rollout], dtype=np.uint32)
        if loop.is_uncertain:
            self.w.left[:1] = loop.failure_model.thresholds(seed, self.ids, loop.robots)
        if loop.moving_threats is not None:
            self.w.at[:1] = loop.first_places(seed, self.ids)
        truth = 0 if loop.uncertainty is None else int(rows_met(loop.uncertainty, seed, rollout)[0])
        # Cells and areas take 32 bits: there is always room for more areas.
        first = loop.first_state(max(first_room(loop.tables), MOST_NARROW + 1))
        self._take(State._make(row[truth : truth + 1].copy() for row in first))
        self.raw.marks["last"] = 1
        self._recall()
        rows = 8 * len(loop.cells) + 16 * loop.robots + 256
        frames, legs = np.zeros((1, FRAME_ROWS, loop.robots), np.int32), np.full((1, loop.robots), NONE, np.int32)
        self.log = Log(np.zeros((rows, 5), np.int32), frames, legs, True)
        self.outcome: Outcome | None = None
        self.new_events = self.log.events[:0]
        given = () if loop.state is None else loop.state.robots
        self.turned = {robot for robot, one in enumerate(given) if one.turned}
        self._moved = self.raw.moving.copy()
        self._steps: list[tuple[NDArray[np.int32], ...]] = []

    def _take(self, stack: State) -> None:
        """Use level 0 of the stack as the state."""
        self._stack, self.raw = stack, State._make(row[0] for row in stack)
        self.s: Any = interpreted("struct_pointers").with_records(self.raw)
        # Copying rows as bytes is several times faster than as records.
        kept = stack._replace(areas=stack.areas[:, :0])
        rows = stack.areas, *kept, self.w.left, self.w.at, self.w.met
        self._bytes = [row.reshape(-1).view(np.uint8) for row in rows if row.size]

    def _recall(self) -> None:
        """Write this run's estimate of the map to the scratch, which another run may have used."""
        if self.loop.learns:
            interpreted("map_belief").recall(self.t, self.s, self.w)

    def fork(self) -> Self:
        """An independent copy of the rollout, at the same step."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other.w = self.w._replace(**{name: getattr(self.w, name).copy() for name in OWN})
        other._take(State._make(row.copy() for row in self._stack))
        other.log = self.log._replace(events=np.zeros_like(self.log.events), frames=self.log.frames.copy())
        other.log.events[: self.log.events[0, 0] + 1] = self.log.events[: self.log.events[0, 0] + 1]
        # Callbacks belong to the original run: a copy decides by the rule and records nothing.
        other.t, other.turned, other._steps = self.t._replace(asks=None, notes=None), self.turned.copy(), [*self._steps]
        return other

    def __getstate__(self) -> dict[str, Any]:
        """All but the views of the state and the scratch, which may be large."""
        # Views and scratch are made again from the state, which keeps pickles small.
        kept = {name: value for name, value in vars(self).items() if name not in ("raw", "s", "_bytes")}
        return kept | {"w": {name: getattr(self.w, name) for name in OWN}}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        work = make_work(kept["loop"].tables, 1, False)._replace(**kept["w"])
        vars(self).update(kept | {"w": work})
        self._take(self._stack)

    def save(self) -> list[NDArray[np.uint8]]:
        """A copy of all that the next step may change, except `notes`: the argument of `take_back`."""
        self._make_room()
        return [row.copy() for row in self._changing(int(self.raw.marks["areas"]))]

    def take_back(self, saved: list[NDArray[np.uint8]]) -> None:
        """Undo an unfinished step that began after `save`."""
        areas = len(saved[0]) // self.raw.areas.itemsize
        for row, before in zip(self._changing(areas), saved, strict=True):
            row[:] = before

    def _changing(self, areas: int) -> Iterator[NDArray[np.uint8]]:
        """The bytes of the state with this number of areas, and of the rollout's own part of the scratch."""
        yield self._bytes[0][: areas * self.raw.areas.itemsize]
        yield from self._bytes[1:]

    # --- steps ---

    @property
    def step(self) -> int:
        """The last completed step, NOT_BEGUN before t = 0."""
        return int(self.raw.marks["step"]) - (self.outcome is None)

    def advance(self) -> Outcome | None:
        """Advance by one step and return the outcome, None while the rollout continues."""
        self._make_room()
        self.log.events[0, 0], self.log.legs[:] = 0, NONE
        marks = self.s.marks
        marks.robot, marks.verdict = 0, ACTS
        with np.errstate(over="ignore"):
            found = interpreted("step").advance(self.t, self.p, self.s, self.c, self.w, self.log, self.how, self.ids)
        self.outcome = None if found == NONE else Outcome(int(found))
        self.take_events()
        if self.records:
            self._steps.append((self.frame(), self.new_events, self.log.legs[0].copy()))
        return self.outcome

    def learn(self) -> bool:
        """Repeat the map update at the end of the last step; True if a robot got an area."""
        self._make_room()
        # The state is already in the next step; the update belongs to the end of the last one.
        self.s.marks.step -= 1
        step = interpreted("step")
        step.forget(self.t, self.p, self.s, self.w)
        self.log.events[0, 0] = 0
        step.learn(self.t, self.p, self.s, self.w, self.log, self.how, self.ids)
        self.take_events()
        self.s.marks.step += 1
        return bool((self.new_events[:, 2] == EventKind.ALLOCATED).any())

    def take_events(self) -> None:
        """Read the events of this step from the log, and the moves left of robots that have stopped moving."""
        self.new_events = self.log.events[1 : int(self.log.events[0, 0]) + 1].copy()
        if len(self.new_events):
            self.turned |= set(self.new_events[self.new_events[:, 2] == EventKind.TURNED_HOME, 1].tolist())
        self._count_moves()

    def _count_moves(self) -> None:
        """Make `until` the moves left of robots that have stopped moving; of a moving robot it is a turn."""
        if self._moved.tobytes() == self.raw.moving.tobytes():  # in most steps
            return
        stopped = self._moved & ~(self.raw.moving | self.raw.waiting)
        for robot in range(self.loop.robots):
            if holds(stopped, robot):
                self.raw.robots["until"][robot] -= self._turns(robot)
        self._moved = self.raw.moving.copy()

    def _make_room(self) -> None:
        """Grow the arrays so that they hold all areas that a step may make."""
        room, wanted = len(self.raw.areas), int(self.raw.marks["areas"]) + len(self.loop.cells) + 2
        if room > wanted:
            return
        more = dict[str, NDArray]()
        for name in ("areas", "open", "lowest", "fate"):
            row = getattr(self._stack, name)
            if row.shape[1]:
                more[name] = np.zeros((1, 2 * row.shape[1] + wanted), dtype=row.dtype)
                more[name][:, : row.shape[1]] = row
        self._take(self._stack._replace(**more))
        if self.loop.learns:  # the last area stands for none
            self._number_none(room - 1, len(self.raw.areas) - 1)

    def _number_none(self, old: int, new: int) -> None:
        """Renumber NO_AREA, which is the last row of `areas`."""
        home = self.raw.home
        none = home >> AREA_BITS == old
        # The last element stands for blocked neighbours and keeps its value.
        none[-1] = False
        home[none] = home[none] & ((1 << AREA_BITS) - 1) | new << AREA_BITS
        self.raw.areas[new], self.raw.areas[old] = self.raw.areas[old].copy(), np.zeros((), self.raw.areas.dtype)

    # --- the current state ---

    def cell(self, robot: int) -> int:
        """The cell of the robot, `row * W + col`."""
        return int(self.loop.cells[self.raw.robots["cell"][robot]])

    def moves_left(self, robot: int) -> int:
        """The number of moves that the robot can still make, at the end of a step."""
        until, moved = int(self.raw.robots["until"][robot]), self.raw.moving | (self._moved & ~self.raw.waiting)
        return until - self._turns(robot) if holds(moved, robot) else until

    def _turns(self, robot: int) -> int:
        """The number of the robot's turns by the end of the last step."""
        return int(interpreted("robot_types").own_turn(self.t, robot, max(self.step, 0)))

    @property
    def unvisited(self) -> int:
        """The number of cells that count for coverage and are not visited."""
        return self.loop.accessible - int(self.raw.marks["covered"])

    @property
    def visited(self) -> NDArray[np.bool_]:
        """bool `[N]`: cells that are visited."""
        return self.loop.flagged(self.raw, VISITED)

    @property
    def survived(self) -> NDArray[np.bool_]:
        """bool `[N]`: cells that a robot entered without being lost."""
        return self.loop.flagged(self.raw, SURVIVED)

    @property
    def area_of(self) -> NDArray[np.int32]:
        """int32 `[N]`: the area of each cell, NO_AREA if it is in none."""
        return self.loop.area_of(self.raw)

    @property
    def open(self) -> list[int]:
        """The ids of unassigned areas."""
        return [number for number in range(int(self.raw.marks["areas"])) if holds(self.raw.open, number)]

    @property
    def alive(self) -> NDArray[np.bool_]:
        """bool `[K]`: robots that are not lost."""
        return np.asarray(self.raw.robots["doing"] != Doing.DEAD)

    def frame(self) -> NDArray[np.int32]:
        """Cell, doing and area of each robot at the end of a step: int32 `[3, K]`, as in `Log.frames`."""
        robots = self.raw.robots
        frame = np.empty((FRAME_ROWS, len(robots)), np.int32)
        frame[:] = robots["cell"], robots["doing"], robots["area"]
        doing = frame[FRAME_DOING]
        frame[FRAME_AREA, (doing != TRAVELING) & (doing != COVERING)] = NO_AREA
        return frame

    def doing(self, robot: int) -> Doing:
        """The status of the robot."""
        code = int(self.raw.robots["doing"][robot])
        return Doing({LANDING: Doing.IDLE, STARTING: Doing.TRAVELING}.get(code, code))

    def area(self, robot: int) -> int:
        """The id of the robot's area, NO_AREA if it has none."""
        return int(self.raw.robots["area"][robot]) if self.doing(robot) in (TRAVELING, COVERING) else NO_AREA

    def to_do(self, robot: int) -> NDArray[np.int64]:
        """The cells that the robot's coverage path still has to reach; no leg crosses one of them."""
        if self.doing(robot) is not Doing.COVERING:
            return np.zeros(0, dtype=np.int64)
        flags = self.loop.on_grid(self.raw.home[:-1] & TO_DO != 0) if self.p is None else ~self.visited
        return np.flatnonzero((self.area_of == self.area(robot)) & flags)

    def path_ahead(self, robot: int) -> list[int]:
        """The cells of the robot's current path, as numbers of accessible cells, the next one first."""
        return list(self._ahead(robot))

    def _ahead(self, robot: int) -> Iterator[int]:
        me, t, s, w = self.s.robots[robot], self.t, self.s, self.w
        doing = self.doing(robot)
        if doing is Doing.FOLLOWING:
            yield from map(int, t.given[robot, max(s.marks.step, 0) + (s.marks.step == 0) : t.length[robot] + 1])
        elif doing is Doing.RETURNING:
            cell, onward = int(me.next), t.onward[t.home_of[robot]]
            yield cell
            while int(onward[cell]) != cell:
                cell = int(onward[cell])
                yield cell
        elif me.doing == STARTING or doing in (Doing.TRAVELING, Doing.COVERING):
            # The functions that find legs change the state: it is restored below.
            self._recall()
            kept = self.raw.robots[robot].copy(), self.raw.legs[robot : robot + 1].copy(), self.raw.home.copy()
            paths = interpreted("paths")
            if me.doing == STARTING:
                paths.set_out(t, s, w, robot, paths.entry_of(t, s, w, robot, me.area), t.searches)
            found = list[int]()
            while me.cell != me.target or me.left > 0:
                if me.cell == me.target:
                    if doing is not Doing.COVERING or self.p is not None:
                        break
                    paths.next_leg(t, s, w, self.how, robot)
                cell = int(me.next)
                found.append(cell)
                me.cell = cell
                if cell == me.target:
                    s.home[cell] = int(s.home[cell]) & ~TO_DO
                    me.left -= 1
                    if doing is not Doing.COVERING or self.p is not None or me.left <= 0:
                        break
                else:
                    paths.go_on(t, s, w, robot)
            self.raw.robots[robot], self.raw.legs[robot : robot + 1], self.raw.home[:] = kept
            yield from found

    # --- a whole run ---

    def play(self) -> Self:
        """Advance to the end."""
        while self.outcome is None:
            self.advance()
        return self

    @property
    def trace(self) -> Trace:
        """The trace of a finished rollout, which begins at t = 0 even if the mission was resumed later."""
        assert self.outcome is not None
        frames, events, _ = zip(*self._steps, strict=True)
        before = () if self.loop.state is None else first_frames(self.loop.state, self.loop.cells)
        made = np.array([*before, *frames]), np.concatenate(events)
        return trace_from(self.loop, self.rollout, *made, self.area_of, self.outcome)

    @property
    def legs(self) -> tuple[tuple[Leg, ...], ...]:
        """The travel and cover legs of each robot so far."""
        return legs_of(self.loop, np.array([legs for *_, legs in self._steps]), self.raw.areas["level"])

    @property
    def home(self) -> NDArray[np.bool_]:
        """bool `[K]`: robots that are not lost and are at a base; none if robots do not return (SPEC section 19)."""
        if not self.loop.comes_home:
            return np.zeros(self.loop.robots, dtype=np.bool_)
        return self.alive & (self.t.home_steps[self.t.home_of, self.raw.robots["cell"]] == 0)


def play_compiled(loop: ClosedLoop) -> tuple[Trace, tuple[tuple[Leg, ...], ...], tuple[Area, ...]]:
    """Rollout 0 by the compiled engine, for large maps: of a known map and a built-in policy.

    Returns:
        (trace, `SingleRun.legs`, areas made).
    """
    ((trace, legs, runner),) = logged_rollouts(loop, 0, (0,), legs=True)
    first, level = 0 if loop.state is None else loop.state.step + 1, runner.state.areas["level"]
    return trace, legs_of(loop, legs[first:], level), areas_made(loop, trace, level)


def areas_made(loop: ClosedLoop, trace: Trace, level: NDArray[np.int32]) -> tuple[Area, ...]:
    """The areas made in a run without map updates, each with the cells of the areas that were later split from it."""
    given, events = len(loop.tables.level), trace.events
    made = events[np.isin(events[:, 2], (EventKind.REALLOCATED, EventKind.SHARED))]
    parents = np.repeat(made[:, 3], made[:, 4])
    order = np.argsort(trace.area_of, kind="stable")
    begin = np.searchsorted(trace.area_of[order], np.arange(given + len(parents) + 1))
    inside = [order[begin[number] : begin[number + 1]] for number in range(given + len(parents))]
    # From the last area to the first: a part may have been split again, so its own parts are added first.
    for number in range(len(parents) - 1, -1, -1):
        inside[parents[number]] = np.concatenate([inside[parents[number]], inside[given + number]])
    cells = (np.sort(of).astype(np.int64) for of in inside[given:])
    return tuple(Area(int(of), NO_ROBOT, mine) for of, mine in zip(level[given:], cells, strict=False))


def legs_of(loop: ClosedLoop, noted: NDArray[np.int32], level: NDArray[np.int32]) -> tuple[tuple[Leg, ...], ...]:
    """Travel and cover legs of each robot, from `Log.legs` of successive steps, `[T, K]`.

    A leg ends where the robot waits longer than its pace. `level`: the threat level of each area.
    """
    first, found = 0 if loop.state is None else loop.state.step + 1, list[tuple[Leg, ...]]()
    for robot, of in enumerate(noted.T.astype(np.int64)):
        moves = np.flatnonzero(of != NONE)
        if len(moves) == 0:
            found.append(())
            continue
        pace = int(loop.tables.pace[robot]) if len(loop.tables.pace) else 1
        # A leg begins where area or kind changes, or after a wait.
        begins = np.flatnonzero((np.diff(of[moves], prepend=NONE - 1) != 0) | (np.diff(moves, prepend=-pace) > pace))
        ends = np.append(begins[1:], len(moves)) - 1
        rows = np.stack([of[moves[begins]], first + moves[begins], first + moves[ends] + 1], axis=1).tolist()
        kinds: tuple[LegKind, LegKind] = "travel", "cover"
        found.append(tuple(Leg(kinds[of & 1], of >> 1, int(level[of >> 1]), *span) for of, *span in rows))
    return tuple(found)


# A run as the state of a mission (SPEC section 12).


def state_of(run: SingleRun, problem: Problem, cumulative_hazard: Sequence[int] | None = None) -> MissionState:
    """The mission state of a run between two steps (SPEC section 12). Completed areas without cells are dropped.

    Args:
        run: between two steps.
        problem: of its plan.
        cumulative_hazard: of each robot, in units of 2**-32 nat; kept if the Weibull shape is not 1. That of a real
            robot may exceed every threshold that can be drawn: then the largest possible value is kept.
    """
    world, settings, loop = problem.world, problem.settings, run.loop
    settings.require_uniform("the state of a mission", *AGAIN)
    known, home, cells, delivers = None, problem.home, loop.cells, loop.delivers
    if cumulative_hazard is not None and settings.weibull_shape != 1:
        known = np.minimum(cumulative_hazard, settings.failure_model().most(loop.robots)).tolist()
    area_of, (places, doing, area), areas = run.area_of, run.frame().tolist(), list[AreaState]()
    owner = {number: robot for robot, number in enumerate(area) if number != NO_AREA}
    place = {NO_AREA: NO_AREA}
    for number in range(int(run.raw.marks["areas"])):
        inside = np.flatnonzero(area_of == number)
        if not len(inside):
            continue
        place[number] = len(areas)
        left, status = int(run.raw.areas["left"][number]), "completed"
        if holds(run.raw.open, number):
            status = "unassigned"
        elif number in owner and left > 0:
            status = "assigned"
        areas.append(AreaState(int(run.raw.areas["level"][number]), owner.get(number, NO_ROBOT), status, inside))
    robots = tuple(
        RobotState(
            cell=int(cells[places[robot]]),
            status=Doing(doing[robot]).name.lower(),
            area=place[area[robot]],
            ahead=cells[run.path_ahead(robot) if area[robot] != NO_AREA else []],
            to_do=run.to_do(robot),
            moves=int(problem.range[robot]) - run.moves_left(robot),
            held=bool(run.raw.robots["held"][robot]),
            exposure=None if known is None else known[robot],
            home=None if home is None else int(home.starts[robot]),
            turned=robot in run.turned,
            undelivered=cells[_members(run.raw.undelivered[robot], len(cells))] if delivers else NO_CELLS,
        )
        for robot in range(loop.robots)
    )
    over, quiet = int(run.raw.marks["over"]), int(run.raw.marks["quiet"])
    if run.outcome is None:  # the run waits for an announced phase: that is not yet no progress
        quiet = min(quiet, int(run.t.quiet_steps) - 1)
    return MissionState(
        world.shape,
        world.sha256,
        run.step,
        np.flatnonzero(run.visited),
        np.flatnonzero(run.survived),
        robots,
        tuple(areas),
        0 if over else quiet,
        Outcome(over - 1).word if over else None,
        cells[_members(run.raw.undelivered[-1], len(cells))] if delivers else None,
    )


def _members(bits: NDArray[np.uint64], count: int) -> NDArray[np.bool_]:
    """bool `[count]`: whether each number is in the set."""
    return np.unpackbits(bits.view(np.uint8), bitorder="little")[:count].astype(np.bool_)


class PythonLoop:
    """The closed loop of a plan by the simulator as Python, one rollout at a time; for any policy and cell order.

    Args:
        plan: for `world`, or an external plan (`planner.mrac.problem`).
        world: the map.
        first_only: `threat_checks="first_visit"`.
        problem: the plan's problem, if available.

    Raises:
        PlanError: a plan for another map.
    """

    def __init__(self, plan: Plan, world: World, *, first_only: bool = False, problem: Problem | None = None) -> None:
        self.problem, areas = ready_loop(plan, world) if problem is None else (problem, plan.areas)
        plan = replace(plan, areas=areas)
        self.loop = compile_closed_loop(plan, world, first_only=first_only, problem=self.problem, interpreted=True)
        self._known: Work | None = None

    def begin(self, seed: int, rollout: int) -> SingleRun:
        """Rollout `rollout` (below 2**32) of `seed`, `0 <= seed < 2**64`, before its first step."""
        run = SingleRun(self.loop, seed, rollout, self._known)
        self._known = run.w
        return run

    def run(self, seed: int, rollout: int) -> SingleRun:
        """A whole rollout."""
        return self.begin(seed, rollout).play()

    def trace(self, seed: int, rollout: int) -> Trace:
        """The trace of a whole rollout, as the engines report it."""
        return self.run(seed, rollout).trace

    def runs(self, seed: int, rollout: int) -> Iterator[SingleRun]:
        """Advance a rollout step by step; yields the same run after each."""
        run = self.begin(seed, rollout)
        while run.outcome is None:
            run.advance()
            yield run

    def state_at(self, step: int, seed: int, rollout: int) -> MissionState | None:
        """The mission state at the end of a step; None if the rollout has ended before."""
        for run in self.runs(seed, rollout):
            if run.step == step and run.outcome is None:
                return state_of(run, self.problem, run.raw.robots["cumulative_hazard"].tolist())
        return None
