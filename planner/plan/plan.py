"""The plan as data: each robot's nominal path with its legs, the areas with their owners, and the plan file (JSON)."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from planner.arguments import MAX_PLAN_BYTES
from planner.errors import PlanError
from planner.failure_model import PLAIN, FailureModel
from planner.files import Json, check_new, write_json
from planner.formatting import counted, html_of, text_of
from planner.plan.state import MissionState
from planner.policies import DEFAULT
from planner.settings import Settings
from planner.simulator.codes import Outcome
from planner.world.world import EXAMPLE, World

FORMAT, VERSION = "mrac-plan", 2
MOST_SHOWN = 12
"""Robots of a plan that its text shows."""

NO_MORE = "ends with cells left from which no robot could return to base"
"""Clause for `no_progress` where robots return to base, instead of the outcome's own."""


LegKind = Literal["travel", "cover"]


@dataclass(frozen=True)
class Leg:
    """A stretch `[start, stop)` of a robot's path. The entry into an area belongs to its cover leg.

    Attributes:
        kind: "travel" (on the way to `area`) or "cover" (covering it).
        area: area id. level: index of its threat level.
        start, stop: half-open range over the path's steps. Steps without a move belong to no leg.
    """

    kind: LegKind
    area: int
    level: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Area:
    """A connected area (Def. 2), or a part of one.

    Attributes:
        level: index of its threat level (0 = safe).
        robot: its robot at t = 0, or NO_ROBOT.
        cells: int64 `[cells]`, indices `row * W + col` in increasing order.
    """

    level: int
    robot: int
    cells: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RobotPlan:
    """One robot's nominal path.

    Attributes:
        path: int64 `[steps + 1]`, the cell index at each step from t = 0; equal neighbours = waiting.
        legs: its legs in order; empty for an external plan.
    """

    path: NDArray[np.int64]
    legs: tuple[Leg, ...] = ()

    @cached_property
    def entered(self) -> NDArray[np.int64]:
        """int64, the steps at which it enters a cell: `entries` of its path."""
        return entries(self.path)


@dataclass(frozen=True, eq=False)
class Plan:
    """The nominal run of Algorithm 2 (no losses), or an external plan (then `areas` is empty).

    Attributes:
        shape: (H, W) of its world. sha256: that world's identity.
        settings: of the plan, or None for an external plan.
        robots: one RobotPlan per robot.
        areas: the allocation at t = 0, position = area id.
        areas_added: areas added by sharing during the nominal run; their ids continue those of `areas`.
        outcome: of the nominal run, a word of `Outcome`; "end_of_paths" for an external plan.
        time: the step at which it ended. shares: number of shared areas.
        notes: for users (cells on no path, ...).
        for_open_loop: whether the paths are those of `planner.open_loop`.
        state: of the mission that the plan resumes: until its step the paths stand still; or None.
        failures: failure model of an external plan; else the settings determine it. See `failure_model`.
        source: origin of its map, as in `World`: plan files hold it.
    """

    shape: tuple[int, int]
    sha256: str
    settings: Settings | None
    robots: tuple[RobotPlan, ...]
    areas: tuple[Area, ...] = ()
    areas_added: tuple[Area, ...] = ()
    outcome: str = "complete"
    time: int = 0
    shares: int = 0
    notes: tuple[str, ...] = field(default=())
    for_open_loop: bool = False
    state: MissionState | None = None
    failures: FailureModel = PLAIN
    source: str = ""

    @property
    def failure_model(self) -> FailureModel:
        """The failure model of its robots, with their cumulative hazards so far."""
        if self.settings is None:
            return self.failures
        begun = () if self.state is None or self.settings.weibull_shape == 1 else self.state.exposures
        return self.settings.failure_model(begun)

    def of_robots(self, **what: Any) -> Plan:
        """A copy with another `weibull_shape` or `hazard_multiplier`, which affect no decision.

        Args:
            what: these settings.

        Raises:
            PlanError: a value is invalid.
        """
        settings = replace(self.settings or self._own, **what)
        settings.check()
        settings.check_team(len(self.robots))
        if self.is_external:
            return replace(self, failures=settings.failure_model())
        return replace(self, settings=settings)

    @property
    def _own(self) -> Settings:
        """The default settings with the failure model of an external plan."""
        own = self.failures
        return Settings(weibull_shape=own.shape, hazard_multiplier=own.hazard_multiplier, types=own.types)

    @property
    def is_external(self) -> bool:
        """True for an external plan or one of `planner.open_loop`: paths without areas and settings."""
        return self.settings is None

    @property
    def plan_for(self) -> str | None:
        """The loop that it was planned for; None for an external plan."""
        return "closed_loop" if self.settings is not None else "open_loop" if self.for_open_loop else None

    @property
    def usual_loop(self) -> Literal["open", "closed"]:
        """The loop that it is rolled out in by default."""
        return "open" if self.is_external else "closed"

    @property
    def origin(self) -> str:
        """Its kind, as text."""
        if self.settings is not None:
            return "MRAC plan"
        return "plan for the open loop" if self.for_open_loop else "external plan"

    @property
    def team(self) -> int:
        """Number of robots."""
        return len(self.robots)

    @property
    def starts(self) -> NDArray[np.int64]:
        """(row, col) of each robot at t = 0 (or in the state), int64 `[K, 2]`."""
        return np.array([divmod(int(robot.path[0]), self.shape[1]) for robot in self.robots], dtype=np.int64)

    @property
    def comes_home(self) -> bool:
        """True if its robots return to base (SPEC section 19)."""
        return self.settings is not None and self.settings.return_to is not None

    def ends_home(self, step: int | None = None) -> bool:
        """True if all robots end at base in a run without losses, truncated at `step` if given."""
        ends = [robot.path[-1 if step is None else min(step, len(robot.path) - 1)] for robot in self.robots]
        return self.comes_home and all(int(cell) in own for cell, own in zip(ends, self.bases, strict=True))

    @property
    def bases(self) -> list[set[int]]:
        """The base cells of each robot; empty if robots do not return."""
        if self.settings is None or (to := self.settings.return_to) is None:
            return []
        known = None if self.state is None else self.state.homes(to)
        homes = [int(robot.path[0]) for robot in self.robots] if known is None else known.tolist()
        bases = homes if isinstance(to, str) else [row * self.shape[1] + col for row, col in to]
        return [{home} if to == "home" else set(bases) for home in homes]

    @property
    def makespan(self) -> int:
        """The last step at which any robot moves on its nominal path."""
        return max((int(robot.entered[-1]) for robot in self.robots), default=0)

    def require(self, world: World) -> Settings:
        """Check that the plan is for a map.

        An external plan may lack the map's hash.

        Args:
            world: the map.

        Returns:
            Its settings; for an external plan the default.

        Raises:
            PlanError: it is for another map.
        """
        known = ("", world.sha256) if self.is_external else (world.sha256,)
        if self.shape != world.shape or self.sha256 not in known:
            made, expected = (f"{of.shape[0]}x{of.shape[1]} {of.sha256[:12]}" for of in (self, world))
            raise PlanError(f"plan for another map: made for {made}", expected=expected)
        return self.settings or self._own

    def truncated_at(self, step: int) -> Plan:
        """The plan truncated at the end of `step`: open-loop rollouts are the first steps of the whole plan's."""
        robots = tuple(RobotPlan(robot.path[: step + 1]) for robot in self.robots)
        return replace(self, settings=None, areas=(), areas_added=(), robots=robots, failures=self.failure_model)

    def area(self, number: int) -> Area:
        """The area with this id, including those added by sharing."""
        return (self.areas + self.areas_added)[number]

    @property
    def ends(self) -> str:
        """How the run without losses ends: "if no robot is lost, the mission visits every accessible cell"."""
        return f"if no robot is lost, the mission {self.clause_of(Outcome[self.outcome.upper()])}"

    def ending(self, outcome: Outcome) -> Outcome:
        """The outcome for the code in counts and recordings: DEADLINE if a deadline cuts runs off."""
        return outcome.by_deadline(self.ends_by_deadline)

    @property
    def ends_by_deadline(self) -> bool:
        """Whether a deadline cuts its runs off, not the step limit."""
        return self.settings is not None and self.settings.ends_by_deadline

    def clause_of(self, outcome: Outcome) -> str:
        """Text on a run with this outcome (as in counts), after "the mission"."""
        return NO_MORE if self.comes_home and outcome is Outcome.NO_PROGRESS else self.ending(outcome).clause

    def _rows(self) -> list[tuple[str, str]]:
        rows = [("makespan", counted(self.makespan, "step"))]
        if self.settings is not None and self.settings.deadline is not None:
            rows.append(("deadline", f"the mission ends at step {self.settings.deadline:,}"))
        if not self.is_external:
            rows += [("areas", f"{len(self.areas)}, {self.shares} of them shared in the run without losses")]
        for number, robot in enumerate(self.robots[:MOST_SHOWN]):
            covered = sum(leg.kind == "cover" for leg in robot.legs)
            areas = f", {counted(covered, 'area')}" * bool(robot.legs)
            start, moves = [int(n) for n in divmod(robot.path[0], self.shape[1])], len(robot.entered) - 1
            rows.append((f"robot {number}", f"from {start}, {counted(moves, 'move')}" + areas))
        more = len(self.robots) - MOST_SHOWN
        return rows + [("", f"and {more} more")] * (more > 0) + [("note", note) for note in self.notes[:4]]

    def _title(self) -> str:
        policy = "" if self.settings is None or self.settings.policy == DEFAULT else f" by {self.settings.rule.name}"
        made, ends = (self.origin, "") if self.is_external else (f"plan of MRAC{policy}", f"; {self.ends}")
        robots = f"{len(self.robots)} robot{'s' * (len(self.robots) != 1)}"
        return f"{made[0].upper()}{made[1:]}: {robots} on {self.shape[0]} x {self.shape[1]} cells{ends}"

    def __repr__(self) -> str:
        return text_of(self._title(), self._rows())

    def _repr_html_(self) -> str:
        return html_of(self._title(), self._rows())

    def to_json(self) -> Json:
        """Object of the plan file (SPEC section 9), with `nominal` (outcome, time, shares) and `notes`.

        Raises:
            PlanError: the plan has a user's rule or order, which files cannot hold.
        """
        if self.settings is not None and self.settings.own_words:
            problem, fix = f"a plan with {self.settings.own_words} cannot be saved", "make the plan again where needed"
            raise PlanError(problem, expected="a policy that has a name", fix=fix)
        # Cells as [row, col]: files are read by people and by other programs.
        width = self.shape[1]

        def path_of(robot: RobotPlan) -> list[list[int]]:
            return np.stack(np.divmod(robot.path, width), axis=1).tolist()

        def area_of(area: Area) -> Json:
            return {"level": area.level, "robot": area.robot, "cells": area.cells.tolist()}

        return {
            "format": FORMAT,
            "version": VERSION,
            "world": {"shape": list(self.shape), "sha256": self.sha256},
            "settings": None if self.settings is None else self.settings.to_json(),
            "nominal": {"outcome": self.outcome, "time": self.time, "shares": self.shares},
            "robots": [{"path": path_of(r), "legs": [asdict(leg) for leg in r.legs]} for r in self.robots],
            "areas": [area_of(area) for area in self.areas],
            "areas_added": [area_of(area) for area in self.areas_added],
            "notes": list(self.notes),
            **({"plan_for": "open_loop"} if self.for_open_loop else {}),
            **(self.failures.to_json() if self.is_external else {}),
            **({"state": self.state.to_json()} if self.state is not None else {}),
        }

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the plan file atomically.

        Its `world` names the map's file, relative to the plan's folder, or the example; any other map is identified by
        its hash only.

        Args:
            path: the file.
            force: replace an existing file; else that is a UsageError.

        Raises:
            PlanError: the plan cannot be saved, or would be too large to be read again.
        """
        check_new(path, force=force)
        data, source = self.to_json(), self.source
        if source.startswith(EXAMPLE):
            data["world"]["source"] = source
        elif Path(source).is_file():
            data["world"]["source"] = Path(os.path.relpath(source, Path(path).parent)).as_posix()
        write_json(Path(path), data, MAX_PLAN_BYTES, PlanError)


def last_move(path: NDArray[np.int64]) -> int:
    """The last step of `path` (int64 `[steps + 1]`) at which the robot enters a cell, 0 if it never moves."""
    moved = np.flatnonzero(path[1:] != path[:-1])
    return int(moved[-1]) + 1 if len(moved) else 0


def entries(path: NDArray[np.int64]) -> NDArray[np.int64]:
    """The steps of `path` (int64 `[steps + 1]`) at which a cell is entered: 0, and each move. Waiting is no visit."""
    entered = np.ones(len(path), dtype=np.bool_)
    np.not_equal(path[1:], path[:-1], out=entered[1:])
    return np.flatnonzero(entered)


def is_certain(world: World, plan: Plan, loop: str = "closed") -> bool:
    """Whether no robot's planned path enters a dangerous cell, so that every run equals the nominal one.

    False for moving threats, for unknown maps and hazard estimates, and for the closed loop of an external plan, whose
    robots continue from the ends of their paths.

    Args:
        world: the map.
        plan: for it.
        loop: "open" or "closed".
    """
    unknown = plan.is_external or world.knowledge is not None or world.learned_hazard is not None
    if world.moving_threats is not None or (loop == "closed" and unknown):
        return False
    if world.draws is not None:
        return not any(world.draws.bound[robot.path].any() for robot in plan.robots)
    # Each robot's own threats: a cell may be safe for one type and not for another.
    own = world.of_robots(plan.failure_model.types, len(plan.robots))
    return not any((of.by_phase.max(axis=0)[robot.path] > 0).any() for of, robot in zip(own, plan.robots, strict=True))


# Moves and turns of robots, and the time that turns cost (docs/spec.md, section 20).


@dataclass(frozen=True, eq=False)
class Drive:
    """Moves and turns of a run. Axis `K` = robots.

    Attributes:
        moves: int64 `[K]`. turns: int64 `[K]`, quarter turns, two for a reversal, none before the first move.
        last: int64 `[K]`, the step of the last move.
    """

    moves: NDArray[np.int64]
    turns: NDArray[np.int64]
    last: NDArray[np.int64]

    def time(self, turn: float) -> float:
        """Steps until the last robot has arrived, if each of its quarter turns takes `turn` additional steps."""
        return float((self.last + turn * self.turns).max(initial=0.0))


def drive_of(paths: Iterable[NDArray]) -> Drive:
    """Moves and turns of paths.

    Args:
        paths: `[steps + 1]` each, the cell index at every step; equal neighbours = waiting.
    """
    rows = [(*_moves_and_turns(path), last_move(path)) for path in paths]
    return Drive(*np.array(rows, dtype=np.int64).reshape(-1, 3).T)


def _moves_and_turns(path: NDArray) -> tuple[int, int]:
    """Number of moves of a path, and of quarter turns."""
    ways = np.diff(path.astype(np.int64))
    ways = ways[ways != 0]
    before, after = ways[:-1], ways[1:]
    return len(ways), int(np.count_nonzero(before != after) + np.count_nonzero(before == -after))


# Waypoints for a robot stack: nominal paths as poses in metres in the map's frame (CSV).

HEADER = ("robot", "step", "x", "y", "yaw")
DECIMALS = 6
"""Of x and y: micrometres, and still exact in float64 for coordinates of a projected map (millions of metres)."""


def waypoints_csv(plan: Plan, world: World) -> str:
    """The nominal paths as CSV: one row per robot and step, `robot,step,x,y,yaw`, waiting included.

    x, y: the cell's centre in metres (`World.to_xy`). yaw: radians in (-pi, pi], see `headings`.

    Args:
        plan: for this world.
        world: the map.

    Source: SPEC section 9 (`origin`: the pose of the lower-left corner, yaw included).
    """
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(HEADER)
    for number, robot in enumerate(plan.robots):
        points = np.round(world.to_xy(robot.path), DECIMALS) + 0.0  # + 0.0: no "-0.000000"
        yaws = headings(robot.path, world)
        for step, ((x, y), yaw) in enumerate(zip(points.tolist(), yaws.tolist(), strict=True)):
            rows.writerow((number, step, f"{x:.{DECIMALS}f}", f"{y:.{DECIMALS}f}", repr(yaw)))
    return out.getvalue()


def headings(path: NDArray[np.int64], world: World) -> NDArray[np.float64]:
    """Heading of the robot at each step of a path.

    The heading of the move into the cell, in the map's frame (with the map's own yaw; 0 = along +x). Waiting keeps it.
    Steps before the first move have that move's heading; a robot that never moves faces along its row.

    Args:
        path: int64 `[steps + 1]`.
        world: the map.

    Returns:
        float64 `[steps + 1]`, radians in (-pi, pi].
    """
    rows, cols = np.divmod(path, world.shape[1])
    north, east = -np.diff(rows), np.diff(cols)
    moves = np.flatnonzero((north != 0) | (east != 0))
    if not len(moves):
        return np.full(len(path), _normalised(np.array(world.origin[2])))
    latest = np.searchsorted(moves, np.arange(len(path)) - 1, side="right") - 1  # move i enters step i + 1
    move = moves[np.maximum(latest, 0)]
    return _normalised(np.arctan2(north[move], east[move]) + world.origin[2])


def _normalised(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same directions in (-pi, pi]; values within 1e-12 of -pi become pi."""
    turned = angles - 2 * math.pi * np.round(angles / (2 * math.pi))
    return np.where(turned <= -math.pi + 1e-12, math.pi, turned)
