"""One rollout, a step at a time: the simulator as Python (`planner.simulator.jit.interpreted`).

It is the rollout of the same seed and id that the compiled programs count, event for event.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from planner.mrac.problem import Problem, ready_loop
from planner.plan.plan import Area, Leg, Plan, last_move
from planner.plan.state import NO_CELLS, AreaState, MissionState, RobotState
from planner.rollout_sampling import rows_met
from planner.rollouts.closed_loop import compile_closed_loop, logged_rollouts, trace_from
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.runners import Runner
from planner.rollouts.tables import first_frames
from planner.simulator.areas import FRAME_ROWS, Log
from planner.simulator.codes import NO_AREA, NO_ROBOT, NONE, Doing, EventKind, Outcome
from planner.simulator.jit import interpreted
from planner.simulator.state import (
    ACTS,
    AREA_BITS,
    MOST_NARROW,
    OUT,
    SURVIVED,
    TO_DO,
    VISITED,
    State,
    Tables,
    Work,
    first_room,
    make_work,
)
from planner.tally import Trace
from planner.world.world import World

holds = interpreted("state").holds
Hit = Callable[[int, int, int], bool]
"""`hit(robot, step, cell)`: whether the robot is lost as it enters the cell at this step."""
OWN = "left", "at", "met", "begin"
"""Scratch arrays that belong to the rollout, not to the world."""
NOT_BEGUN = -1
"""The step before t = 0, at which robots enter their starts."""


@dataclass(frozen=True, eq=False)
class Run:
    """What happened in one run. Axis `K` = robots, `N` = H * W cells.

    Attributes:
        paths: per robot int64 `[steps + 1]`: its cell at each step from t = 0 to its last move.
        legs: per robot, its travel and cover legs.
        areas_added: areas made during the run, by sharing or reallocation, in id order.
        outcome, time: how and at which step it ended.
        bisected, divided: areas shared whose unvisited cells were one component, and that lay in several already.
        visited, survived: bool `[N]`, cells entered, and entered without being lost there.
        alive: bool `[K]`. home: bool `[K]`, alive and at a base, of robots that return to base (SPEC section 19).
        area_of: int32 `[N]`, id of the last area that each cell belonged to, -1 where inaccessible.
        trace: the same as every engine reports it.
    """

    paths: tuple[NDArray[np.int64], ...]
    legs: tuple[tuple[Leg, ...], ...]
    areas_added: tuple[Area, ...]
    bisected: int
    divided: int
    visited: NDArray[np.bool_]
    survived: NDArray[np.bool_]
    alive: NDArray[np.bool_]
    home: NDArray[np.bool_]
    trace: Trace

    @property
    def outcome(self) -> Outcome:
        """The outcome of the run."""
        return self.trace.outcome

    @property
    def time(self) -> int:
        """The step at which the run ended."""
        return self.trace.time

    @property
    def area_of(self) -> NDArray[np.int32]:
        """int32 `[N]`: the last area of each cell, -1 where inaccessible."""
        return self.trace.area_of

    @property
    def shares(self) -> int:
        """The number of areas shared."""
        return self.bisected + self.divided


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
    """

    def __init__(
        self,
        loop: ClosedLoop,
        seed: int = 0,
        rollout: int = 0,
        known: Work | None = None,
        hit: Hit | None = None,
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
            self.w.left[:1] = loop.failure_model.tolerances(seed, self.ids, loop.robots)
        if loop.movers is not None:
            self.w.at[:1] = loop.first_places(seed, self.ids)
        truth = 0 if loop.uncertainty is None else int(rows_met(loop.uncertainty, seed, rollout)[0])
        # Cells and areas take 32 bits: there is always room for more areas.
        first = loop.first_state(max(first_room(loop.tables), MOST_NARROW + 1))
        self._take(State._make(row[truth : truth + 1].copy() for row in first))
        self.raw.marks["last"] = 1
        self._recall()
        rows = 8 * len(loop.cells) + 16 * loop.robots + 256
        self.log = Log(
            np.zeros((rows, 5), dtype=np.int32),
            np.zeros((1, FRAME_ROWS, loop.robots), np.int32),
            np.full((1, loop.robots), NONE, np.int32),
            True,
        )
        self.outcome: Outcome | None = None
        self.new_events = self.log.events[:0]
        # Moves left of robots that neither move nor wait; for a moving robot `until` is a turn instead.
        self.left = dict[int, int]()
        self.turned, self._acting = set[int](), b""
        for robot, given in enumerate(() if loop.state is None else loop.state.robots):
            if given.turned:
                self.turned.add(robot)
            if not (holds(self.raw.movers, robot) or holds(self.raw.waiting, robot)):
                self.left[robot] = int(self.raw.robots["until"][robot])

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
        other.t, other.left, other.turned = self.t._replace(asks=None, notes=None), self.left.copy(), self.turned.copy()
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
        # Most steps change neither set, so the loop over robots is skipped.
        acting = self.raw.movers.tobytes() + self.raw.waiting.tobytes()
        if acting == self._acting:
            return
        self._acting = acting
        for robot in range(self.loop.robots):
            if holds(self.raw.movers, robot) or holds(self.raw.waiting, robot):
                self.left.pop(robot, None)
            elif robot not in self.left:
                self.left[robot] = int(self.raw.robots["until"][robot]) - self._turns(robot)

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

    @property
    def robots(self) -> list[RobotNow]:
        """The robots, in index order."""
        return [RobotNow(self, number) for number in range(self.loop.robots)]

    def cell(self, robot: int) -> int:
        """The cell of the robot, `row * W + col`."""
        return int(self.loop.cells[self.raw.robots["cell"][robot]])

    def moves_left(self, robot: int) -> int:
        """The number of moves that the robot can still make, at the end of a step."""
        until = int(self.raw.robots["until"][robot])
        if robot in self.left or holds(self.raw.waiting, robot):
            return self.left.get(robot, until)
        return until - self._turns(robot)

    def _turns(self, robot: int) -> int:
        """The number of the robot's turns by the end of the last step."""
        return int(interpreted("robot_types").own_turn(self.t, robot, max(self.step, 0)))

    @property
    def unvisited(self) -> int:
        """The number of cells that count for coverage and are not visited."""
        return self.loop.accessible - int(self.raw.marks["covered"])

    @property
    def visited(self) -> NDArray[np.bool_]:
        """bool `[A]`: accessible cells that are visited."""
        return flagged(self.loop, self.raw, VISITED)

    @property
    def survived(self) -> NDArray[np.bool_]:
        """bool `[A]`: accessible cells that a robot entered without being lost."""
        return flagged(self.loop, self.raw, SURVIVED)

    @property
    def area_of(self) -> NDArray[np.int32]:
        """int32 `[A]`: the area of each accessible cell, NO_AREA if it is in none."""
        found = (self.raw.home[:-1] >> AREA_BITS).astype(np.int32)
        return np.where(found == len(self.raw.areas) - 1, NO_AREA, found) if self.loop.learns else found

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
        has_area = (robots["doing"] == Doing.TRAVELING) | (robots["doing"] == Doing.COVERING)
        return np.stack([robots["cell"], robots["doing"], np.where(has_area, robots["area"], NO_AREA)])

    def doing(self, robot: int) -> Doing:
        """The status of the robot."""
        state, code = interpreted("state"), int(self.raw.robots["doing"][robot])
        return Doing({state.LANDING: Doing.IDLE, state.STARTING: Doing.TRAVELING}.get(code, code))

    def path_ahead(self, robot: int) -> list[int]:
        """The cells of the robot's current path, as numbers of accessible cells, the next one first."""
        return list(self._ahead(robot))

    def _ahead(self, robot: int) -> Iterator[int]:
        me, t, s, w = self.s.robots[robot], self.t, self.s, self.w
        state, doing = interpreted("state"), self.doing(robot)
        if doing is Doing.FOLLOWING:
            yield from map(int, t.given[robot, max(s.marks.step, 0) + (s.marks.step == 0) : t.length[robot] + 1])
        elif doing is Doing.RETURNING:
            cell, onward = int(me.next), t.onward[t.home_of[robot]]
            yield cell
            while int(onward[cell]) != cell:
                cell = int(onward[cell])
                yield cell
        elif me.doing == state.STARTING or doing in (Doing.TRAVELING, Doing.COVERING):
            # The functions that find legs change the state: it is restored below.
            self._recall()
            kept = self.raw.robots[robot].copy(), self.raw.legs[robot : robot + 1].copy(), self.raw.home.copy()
            paths = interpreted("paths")
            if me.doing == state.STARTING:
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


class RobotNow:
    """A robot in the current state of a run. Cells are indices `row * W + col`.

    Attributes:
        number: its index.
    """

    def __init__(self, run: SingleRun, number: int) -> None:
        self._run, self.number = run, number

    @property
    def _me(self) -> Any:
        return self._run.raw.robots[self.number]

    @property
    def cell(self) -> int:
        """The cell of the robot."""
        return int(self._run.loop.cells[self._me["cell"]])

    @property
    def status(self) -> Doing:
        """The status of the robot."""
        return self._run.doing(self.number)

    @property
    def alive(self) -> bool:
        """True if the robot is not lost."""
        return self.status is not Doing.DEAD

    @property
    def on_its_way(self) -> bool:
        """True if the robot travels to an area or covers one."""
        return self.status in (Doing.TRAVELING, Doing.COVERING)

    @property
    def busy(self) -> bool:
        """True if the robot has a path: to or in its area, to its base, or an external plan's."""
        return self.on_its_way or self.status in (Doing.FOLLOWING, Doing.RETURNING)

    @property
    def area(self) -> int:
        """The id of its area, NO_AREA if it has none."""
        return int(self._me["area"]) if self.on_its_way else NO_AREA

    @property
    def held(self) -> bool:
        """True if the cap on robots at risk (`risk_cap`) keeps it from areas with threats, until it gets an area."""
        return bool(self._me["held"])

    @property
    def ahead(self) -> list[int]:
        """The cells of its current path, the next one first."""
        return self._run.loop.cells[self._run.path_ahead(self.number)].tolist()

    @property
    def to_do(self) -> NDArray[np.int64]:
        """The cells that its coverage path still has to reach; no leg crosses one of them."""
        run = self._run
        if self.status is not Doing.COVERING:
            return np.zeros(0, dtype=np.int64)
        mine = run.area_of == self.area
        flags = ~run.visited if run.p is not None else run.raw.home[:-1] & TO_DO != 0
        return run.loop.cells[mine & flags]

    @property
    def moves(self) -> int:
        """The number of moves that the robot can still make."""
        return self._run.moves_left(self.number)

    @property
    def turned(self) -> bool:
        """True if the robot has started its return to base, which it never aborts."""
        return self.number in self._run.turned


def play(run: SingleRun) -> Run:
    """Advance the run to its end."""
    loop, frames, events, legs = run.loop, list[NDArray](), list[NDArray](), list[NDArray]()
    if loop.state is not None:
        # A trace begins at t = 0 even if the mission is resumed later.
        frames += list(first_frames(loop.state, loop.cells))
    while run.outcome is None:
        run.advance()
        frames.append(run.frame())
        events.append(run.new_events)
        legs.append(run.log.legs[0].copy())
    trace = trace_from(loop, run.rollout, np.array(frames), np.concatenate(events), run.area_of, run.outcome)
    return _as_run(loop, run.t, run.raw, trace, np.array(legs), tuple(run.notes.made))


def play_compiled(loop: ClosedLoop) -> Run:
    """Rollout 0 by the compiled engine, for large maps: of a known map and a built-in policy."""
    ((trace, legs, runner),) = logged_rollouts(loop, 0, (0,), legs=True)
    first = 0 if loop.state is None else loop.state.step + 1
    made = areas_made(loop, trace, runner.state.areas["level"])
    return _as_run(loop, runner.tables, runner.state, trace, legs[first:], made)


def _as_run(
    loop: ClosedLoop, tables: Tables, raw: State, trace: Trace, legs: NDArray[np.int32], made: tuple[Area, ...]
) -> Run:
    """The run that ended in the state `raw`. `legs`: `Log.legs` of its own steps."""
    alive, home = raw.robots["doing"] != Doing.DEAD, np.zeros(loop.robots, dtype=np.bool_)
    return Run(
        paths=tuple(path[: last_move(path) + 1] for path in trace.cells.T.astype(np.int64)),
        legs=legs_of(loop, legs, raw.areas["level"]),
        areas_added=made,
        bisected=int(raw.marks["bisected"]),
        divided=int(raw.marks["divided"]),
        visited=loop.on_grid(flagged(loop, raw, VISITED)),
        survived=loop.on_grid(flagged(loop, raw, SURVIVED)),
        alive=alive,
        home=at_base(tables, raw) if loop.comes_home else home,
        trace=trace,
    )


def flagged(loop: ClosedLoop, raw: State, flag: int) -> NDArray[np.bool_]:
    """bool `[A]`: accessible cells with this flag, VISITED or SURVIVED."""
    has_it = raw.home[:-1] & flag != 0
    # While robots learn the map, an unvisited cell in no area has both flags.
    return has_it & (raw.known & OUT == 0) if loop.learns else has_it


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
    return tuple(
        Area(int(level[number]), NO_ROBOT, np.sort(inside[number]).astype(np.int64))
        for number in range(given, given + len(parents))
    )


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
        rows = zip(
            of[moves[begins]].tolist(),
            (first + moves[begins]).tolist(),
            (first + moves[ends] + 1).tolist(),
            strict=True,
        )
        found.append(
            tuple(
                Leg("cover" if code & 1 else "travel", code >> 1, int(level[code >> 1]), start, stop)
                for code, start, stop in rows
            )
        )
    return tuple(found)


def at_base(tables: Tables, raw: State) -> NDArray[np.bool_]:
    """bool `[K]`: robots that are not lost and are at a base. Only for robots that return to base."""
    return (tables.home_steps[tables.home_of, raw.robots["cell"]] == 0) & (raw.robots["doing"] != Doing.DEAD)


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
    settings.require_no_recharge("the state of a mission")
    settings.require_uniform("the state of a mission")
    known, home, cells, delivers = None, problem.home, loop.cells, loop.delivers
    if cumulative_hazard is not None and settings.weibull_shape != 1:
        known = np.minimum(cumulative_hazard, settings.failure_model().most(loop.robots)).tolist()
    area_of, visited, areas = run.area_of, run.visited, list[AreaState]()
    owner = {int(robot.area): robot.number for robot in run.robots if robot.on_its_way}
    place = dict[int, int]()
    for number in range(int(run.raw.marks["areas"])):
        inside = area_of == number
        if not inside.any():
            continue
        place[number] = len(areas)
        left, status = int(run.raw.areas["left"][number]), "completed"
        if holds(run.raw.open, number):
            status = "unassigned"
        elif number in owner and left > 0:
            status = "assigned"
        areas.append(AreaState(int(run.raw.areas["level"][number]), owner.get(number, NO_ROBOT), status, cells[inside]))
    robots = tuple(
        RobotState(
            cell=robot.cell,
            status=robot.status.name.lower(),
            area=place[robot.area] if robot.on_its_way else NO_AREA,
            ahead=np.array(robot.ahead if robot.on_its_way else [], dtype=np.int64),
            to_do=robot.to_do,
            moves=int(problem.range[robot.number]) - robot.moves,
            held=robot.held,
            exposure=None if known is None else known[robot.number],
            home=None if home is None else int(home.starts[robot.number]),
            turned=robot.turned,
            carried=cells[_members(run.raw.carried[robot.number], len(cells))] if delivers else NO_CELLS,
        )
        for robot in run.robots
    )
    over, quiet = int(run.raw.marks["over"]), int(run.raw.marks["quiet"])
    if run.outcome is None:  # the run waits for an announced phase: that is not yet no progress
        quiet = min(quiet, int(run.t.quiet_steps) - 1)
    return MissionState(
        world.shape,
        world.sha256,
        run.step,
        cells[visited],
        cells[run.survived],
        robots,
        tuple(areas),
        0 if over else quiet,
        Outcome(over - 1).word if over else None,
        cells[_members(run.raw.carried[-1], len(cells))] if delivers else None,
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

    def run(self, seed: int, rollout: int) -> Run:
        """A whole rollout."""
        return play(self.begin(seed, rollout))

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
                return state_of(run, self.problem, run.raw.robots["borne"].tolist())
        return None
