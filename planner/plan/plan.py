"""The plan as data: every robot's nominal path with its legs, the areas with their owners, and the plan file (JSON)."""

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
from planner.failure_model import PLAIN, Bearing
from planner.files import Json, check_new, write_json
from planner.formatting import counted, html_of, text_of
from planner.plan.state import MissionState
from planner.policies import DEFAULT
from planner.settings import Settings
from planner.simulator.codes import Outcome
from planner.world.world import EXAMPLE, World

FORMAT, VERSION = "mrac-plan", 2
MOST_SHOWN = 12
"""Robots of a plan that it shows of itself."""

NO_MORE = "ends with cells left too far to come home from"
"""What users read beside `no_progress` where robots come home, in the place of the outcome's own clause."""


LegKind = Literal["travel", "cover"]


@dataclass(frozen=True)
class Leg:
    """A stretch `[start, stop)` of a robot's path. The entry that enters an area belongs to its cover leg.

    Attributes:
        kind: "travel" (on the way to `area`) or "cover" (covering it).
        area: area id; level: index of its threat level.
        start, stop: half-open range over the path's steps. Steps that only wait belong to no leg.
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
        robot: the robot that it is given to at t = 0, or NO_ROBOT.
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
        legs: its stretches in order; empty for the plan of another planner.
    """

    path: NDArray[np.int64]
    legs: tuple[Leg, ...] = ()

    @cached_property
    def entered(self) -> NDArray[np.int64]:
        """The steps at which it enters a cell: `entries` of its path."""
        return entries(self.path)


@dataclass(frozen=True, eq=False)
class Plan:
    """The nominal run of Algorithm 2 (no hits), or the paths of another planner (then `areas` is empty).

    Attributes:
        shape: (H, W) of the world that it was made for; sha256: that world's identity.
        settings: what it was made with, or None for the plan of another planner.
        robots: one RobotPlan a robot.
        areas: the allocation at t = 0, position = area id.
        areas_added: the areas that sharing appended during the nominal run; ids go on from `areas`.
        outcome: how the nominal run ended, a word of `Outcome`; "end_of_paths" of another planner's plan.
        time: the step at which it ended. shares: how often an area was shared.
        notes: what a user should know about it (cells that nobody visits, ...).
        for_open_loop: the paths are those of `planner.open_loop`.
        state: of the mission under way that it goes on from: until its step the paths stand still; or None.
        bears: of paths alone, what their robots bear; else the settings say it. See `bearing`.
        source: where its map came from, as of `World`: a plan file says so.
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
    bears: Bearing = PLAIN
    source: str = ""

    @property
    def bearing(self) -> Bearing:
        """What its robots bear, and have borne."""
        if self.settings is None:
            return self.bears
        begun = () if self.state is None or self.settings.weibull_shape == 1 else self.state.exposures
        return self.settings.bearing(begun)

    def of_robots(self, **what: Any) -> Plan:
        """The same plan with another `weibull_shape` or `hazard_multiplier`, which no decision knows. Raises
        PlanError."""
        settings = replace(self.settings or self._own, **what)
        settings.check()
        settings.check_team(len(self.robots))
        return replace(self, bears=settings.bearing()) if self.is_foreign else replace(self, settings=settings)

    @property
    def _own(self) -> Settings:
        """The default settings, but for what the robots of paths alone bear."""
        return Settings(
            weibull_shape=self.bears.shape, hazard_multiplier=self.bears.hazard_multiplier, types=self.bears.types
        )

    @property
    def is_foreign(self) -> bool:
        """True for paths alone, another planner's or `planner.open_loop`'s: no areas, no settings."""
        return self.settings is None

    @property
    def plan_for(self) -> str | None:
        """The loop that it was planned for; None: another planner knows."""
        return "closed_loop" if self.settings is not None else "open_loop" if self.for_open_loop else None

    @property
    def usual_loop(self) -> Literal["open", "closed"]:
        """The loop that it is rolled out in if nobody says."""
        return "open" if self.is_foreign else "closed"

    @property
    def origin(self) -> str:
        """What it is, in words."""
        if self.settings is not None:
            return "MRAC plan"
        return "plan for the open loop" if self.for_open_loop else "plan of another planner"

    @property
    def starts(self) -> NDArray[np.int64]:
        """(row, col) of each robot at t = 0 (or in the state), int64 `[K, 2]`."""
        return np.array([divmod(int(robot.path[0]), self.shape[1]) for robot in self.robots], dtype=np.int64)

    @property
    def comes_home(self) -> bool:
        """True if its robots are to come home (SPEC section 19)."""
        return self.settings is not None and self.settings.return_to is not None

    def ends_home(self, step: int | None = None) -> bool:
        """True if all do, if nobody is stopped; `step`: at which the run is cut off."""
        if self.settings is None or self.settings.return_to is None:
            return False
        to, starts = self.settings.return_to, [int(robot.path[0]) for robot in self.robots]
        bases = starts if isinstance(to, str) else [row * self.shape[1] + col for row, col in to]
        own = ({start} if to == "home" else set(bases) for start in starts)
        ends = [robot.path[-1 if step is None else min(step, len(robot.path) - 1)] for robot in self.robots]
        return all(int(cell) in at for cell, at in zip(ends, own, strict=True))

    @property
    def makespan(self) -> int:
        """The step of the last move of any robot on its nominal path."""
        return max((int(robot.entered[-1]) for robot in self.robots), default=0)

    def require(self, world: World) -> Settings:
        """What it was made with; of paths alone the default. Raises PlanError if it is for another map than `world`.

        Paths alone may leave the map's hash out.
        """
        known = ("", world.sha256) if self.is_foreign else (world.sha256,)
        if self.shape != world.shape or self.sha256 not in known:
            raise PlanError(
                f"plan for another map: made for {self.shape[0]}x{self.shape[1]} {self.sha256[:12]}",
                expected=f"{world.shape[0]}x{world.shape[1]} {world.sha256[:12]}",
            )
        return self.settings or self._own

    def until(self, step: int) -> Plan:
        """The paths as driven until the end of `step`: open-loop rollouts cover what the whole plan's have by then."""
        robots = tuple(RobotPlan(robot.path[: step + 1]) for robot in self.robots)
        return replace(self, settings=None, areas=(), areas_added=(), robots=robots, bears=self.bearing)

    def area(self, number: int) -> Area:
        """The area with this id, those added by sharing included."""
        return (self.areas + self.areas_added)[number]

    @property
    def ends(self) -> str:
        """How the run without losses ends: "if nobody is lost, the mission visits every accessible cell"."""
        return f"if nobody is lost, the mission {self.clause_of(Outcome[self.outcome.upper()])}"

    def ending(self, outcome: Outcome) -> Outcome:
        """How a run of it ended, of the code that counts and recordings hold: DEADLINE where that cuts runs off."""
        return outcome.by_deadline(self.ends_by_deadline)

    @property
    def ends_by_deadline(self) -> bool:
        """Whether it is a deadline that cuts its runs off, not the step limit."""
        return self.settings is not None and self.settings.ends_by_deadline

    def clause_of(self, outcome: Outcome) -> str:
        """What users read of a run that ended so, after "the mission"; `outcome`: as counts hold it."""
        return NO_MORE if self.comes_home and outcome is Outcome.NO_PROGRESS else self.ending(outcome).clause

    def _rows(self) -> list[tuple[str, str]]:
        rows = [("makespan", counted(self.makespan, "step"))]
        if self.settings is not None and self.settings.deadline is not None:
            rows.append(("deadline", f"the mission ends at step {self.settings.deadline:,}"))
        if not self.is_foreign:
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
        made, ends = (self.origin, "") if self.is_foreign else (f"plan of MRAC{policy}", f"; {self.ends}")
        robots = f"{len(self.robots)} robot{'s' * (len(self.robots) != 1)}"
        return f"{made[0].upper()}{made[1:]}: {robots} on {self.shape[0]} x {self.shape[1]} cells{ends}"

    def __repr__(self) -> str:
        return text_of(self._title(), self._rows())

    def _repr_html_(self) -> str:
        return html_of(self._title(), self._rows())

    def to_json(self) -> Json:
        """The plan file's object (SPEC section 9), with `nominal` (outcome, time, shares) and `notes` added.

        Raises PlanError for a plan with a rule or an order of the user's own, which no file can hold.
        """
        if self.settings is not None and self.settings.own_words:
            raise PlanError(
                f"a plan with {self.settings.own_words} cannot be saved",
                expected="a policy that has a name",
                fix="make the plan anew where it is needed",
            )
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
            **(self.bears.to_json() if self.is_foreign else {}),
            **({"state": self.state.to_json()} if self.state is not None else {}),
        }

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the plan file, whole or not at all. Raises PlanError, also if it were too large to be read.

        `force`: replace a file that is there already; without it that is a UsageError.
        Its `world` names the file of the map from the folder of the plan, or the example; a map of neither kind is
        known by its hash alone.
        """
        check_new(path, force=force)
        data, source = self.to_json(), self.source
        if source.startswith(EXAMPLE):
            data["world"]["source"] = source
        elif Path(source).is_file():
            data["world"]["source"] = Path(os.path.relpath(source, Path(path).parent)).as_posix()
        write_json(Path(path), data, MAX_PLAN_BYTES, PlanError)


def last_move(path: NDArray[np.int64]) -> int:
    """The last step of `path` at which the robot enters a cell (0 if it never leaves its start)."""
    moved = np.flatnonzero(path[1:] != path[:-1])
    return int(moved[-1]) + 1 if len(moved) else 0


def entries(path: NDArray[np.int64]) -> NDArray[np.int64]:
    """The steps at which a cell is entered: 0, and every step that changes cell. Waiting is not a visit."""
    entered = np.ones(len(path), dtype=np.bool_)
    np.not_equal(path[1:], path[:-1], out=entered[1:])
    return np.flatnonzero(entered)


def is_certain(world: World, plan: Plan, loop: str = "closed") -> bool:
    """Whether nothing can happen: no robot's planned path enters a dangerous cell, so every run of both loops is it.

    Not where threats move. Of another planner's paths only the open loop's runs are: in the closed loop robots go on
    from their ends. Nor is it known of robots that learn the map, or about a hazard, where they go.
    """
    unknown = plan.is_foreign or world.knowledge is not None or world.learned_hazard is not None
    if world.movers is not None or (loop == "closed" and unknown):
        return False
    if world.draws is not None:
        return not any(world.draws.bound[robot.path].any() for robot in plan.robots)
    own = world.of_robots(plan.bearing.types, len(plan.robots))
    return not any((of.by_phase.max(axis=0)[robot.path] > 0).any() for of, robot in zip(own, plan.robots, strict=True))


# How far robots drive and how often they turn on the way, and what the turns cost (docs/spec.md, section 20).


@dataclass(frozen=True, eq=False)
class Drive:
    """What the robots of a run drive. Axis `K` = robots.

    Attributes:
        moves: int64 `[K]`. turns: int64 `[K]`, quarter turns, two for turning round, none before the first move.
        last: int64 `[K]`, the step of the last move.
    """

    moves: NDArray[np.int64]
    turns: NDArray[np.int64]
    last: NDArray[np.int64]

    def time(self, turn: float) -> float:
        """Steps until the last robot has arrived, where each of its quarter turns takes it `turn` steps more."""
        return float((self.last + turn * self.turns).max(initial=0.0))


def drive_of(paths: Iterable[NDArray]) -> Drive:
    """Of each path, cell indices `[steps + 1]` at every step; a cell that comes twice in a row is a step of waiting."""
    rows = [(*_moves_and_turns(path), last_move(path)) for path in paths]
    return Drive(*np.array(rows, dtype=np.int64).reshape(-1, 3).T)


def _moves_and_turns(path: NDArray) -> tuple[int, int]:
    """The moves of a path, and its quarter turns."""
    ways = np.diff(path.astype(np.int64))
    ways = ways[ways != 0]
    before, after = ways[:-1], ways[1:]
    return len(ways), int(np.count_nonzero(before != after) + np.count_nonzero(before == -after))


# Waypoints for a robot stack: each robot's nominal path as poses in metres in the map's frame (CSV).

HEADER = ("robot", "step", "x", "y", "yaw")
DECIMALS = 6
"""Of x and y: micrometres, and so exact for coordinates of a projected map (millions of metres) in float64."""


def waypoints_csv(plan: Plan, world: World) -> str:
    """One row a robot and step, `robot,step,x,y,yaw`, waiting included.

    x, y: the cell's centre in metres (`World.to_xy`). yaw: radians in (-pi, pi], see `headings`.

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
    """Which way the robot faces at each step of a path `[steps + 1]`: float64 radians `[steps + 1]` in (-pi, pi].

    The heading of the move that enters the cell, in the map's frame (the map's own yaw added; 0 = along +x). Waiting
    keeps it. Steps before the first move have that move's heading; a robot that never moves faces along its row.
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
    """The same directions in (-pi, pi]; what rounding leaves within 1e-12 of -pi is pi."""
    turned = angles - 2 * math.pi * np.round(angles / (2 * math.pi))
    return np.where(turned <= -math.pi + 1e-12, math.pi, turned)
