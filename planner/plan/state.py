"""The state of a mission as data: visited cells, robots, areas (SPEC section 12)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planner.arguments import MAX_PLAN_BYTES
from planner.errors import StateError
from planner.files import Json, check_new, write_json
from planner.simulator.codes import NO_AREA

FORMAT, VERSION = "mrac-state", 1
NAT = 2**32
"""Units of cumulative hazard per nat."""
ON_ITS_WAY = ("traveling", "covering")
RETURNING = "returning"
STATUSES = ("idle", *ON_ITS_WAY, RETURNING, "done", "dead")
NO_CELLS = np.zeros(0, dtype=np.int64)
AREA_STATES = ("unassigned", "assigned", "completed")


@dataclass(frozen=True, eq=False)
class RobotState:
    """A robot at the end of a step.

    Attributes:
        cell: its cell. status: one of STATUSES. area: its area's id, or NO_AREA.
        ahead: int64, the cells of its path still to enter, the next one first.
        to_do: int64, the cells that its coverage path still has to reach, increasing.
        moves: made so far. held: kept from areas at risk (`risk_cap`).
        exposure: its cumulative hazard, in units of 2**-32 nat; None: not known.
        home: its first cell, None: not known. turned: whether it has started its return to base (SPEC section 19).
        undelivered: int64, the cells that it has visited since it was last at a base.
    """

    cell: int
    status: str
    area: int = NO_AREA
    ahead: NDArray[np.int64] = field(default_factory=lambda: NO_CELLS)
    to_do: NDArray[np.int64] = field(default_factory=lambda: NO_CELLS)
    moves: int = 0
    held: bool = False
    exposure: int | None = None
    home: int | None = None
    turned: bool = False
    undelivered: NDArray[np.int64] = field(default_factory=lambda: NO_CELLS)

    @property
    def alive(self) -> bool:
        """Whether the robot is not lost."""
        return self.status != "dead"

    @property
    def at_rest(self) -> RobotState:
        """The robot without area and path."""
        rests = "idle" if self.status in ON_ITS_WAY else self.status
        return replace(self, status=rests, area=NO_AREA, ahead=NO_CELLS, to_do=NO_CELLS)


@dataclass(frozen=True, eq=False)
class AreaState:
    """An area at the end of a step: level, robot (or NO_ROBOT), one of AREA_STATES, cells (int64, increasing)."""

    level: int
    robot: int
    state: str
    cells: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MissionState:
    """The state of a mission at the end of a step.

    Attributes:
        shape, sha256: of the world. step: t.
        visited, survived: int64, cells, increasing.
        robots: one each. areas: in id order, every accessible cell in one of them; none: to be allocated again.
        quiet: steps in a row without a move or an allocation.
        over: outcome of the mission for which all robots return to base; None: it goes on.
        delivered: int64, cells delivered, increasing; None: not known.
    """

    shape: tuple[int, int]
    sha256: str
    step: int
    visited: NDArray[np.int64]
    survived: NDArray[np.int64]
    robots: tuple[RobotState, ...]
    areas: tuple[AreaState, ...] = ()
    quiet: int = 0
    over: str | None = None
    delivered: NDArray[np.int64] | None = None

    def homes(self, return_to: object) -> NDArray[np.int64] | None:
        """The robots' first cells, int64 `[K]`; None if robots do not return.

        Args:
            return_to: of the settings.

        Raises:
            StateError: they are needed, but not known.
        """
        if return_to is None:
            return None
        for number, robot in enumerate(self.robots):
            if robot.home is None and isinstance(return_to, str):
                problem = f"robot {number} returns to base, but its start is not given"
                raise StateError(problem, expected='"home": [row, col] of each robot', fix="or name bases to return to")
        return np.array([NO_AREA if robot.home is None else robot.home for robot in self.robots], dtype=np.int64)

    @property
    def starts(self) -> NDArray[np.int64]:
        """(row, col) of each robot, int64 `[K, 2]`."""
        return np.array([divmod(robot.cell, self.shape[1]) for robot in self.robots], dtype=np.int64)

    @property
    def exposures(self) -> tuple[int, ...]:
        """Cumulative hazard of each robot, 0 if not known."""
        return tuple(robot.exposure or 0 for robot in self.robots)

    @property
    def lost(self) -> int:
        """Number of robots that are lost."""
        return sum(not robot.alive for robot in self.robots)

    def to_json(self) -> Json:
        """Object of the state file."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "world": {"shape": list(self.shape), "sha256": self.sha256},
            "step": self.step,
            "visited": self.visited.tolist(),
            "survived": self.survived.tolist(),
            "robots": [
                {"cell": r.cell, "status": r.status, "area": r.area, "ahead": r.ahead.tolist(), "moves": r.moves}
                | ({} if r.exposure is None else {"exposure": r.exposure / NAT})
                | ({} if r.home is None else {"home": r.home})
                | ({"turned": True} if r.turned else {})
                | ({"undelivered": r.undelivered.tolist()} if len(r.undelivered) else {})
                for r in self.robots
            ],
            "areas": [
                {"level": a.level, "robot": a.robot, "state": a.state, "cells": a.cells.tolist()} for a in self.areas
            ],
            "to_do": [robot.to_do.tolist() for robot in self.robots],
            "held": [number for number, robot in enumerate(self.robots) if robot.held],
            "quiet": self.quiet,
            **({} if self.over is None else {"over": self.over}),
            **({} if self.delivered is None else {"delivered": self.delivered.tolist()}),
        }

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the state file atomically.

        Args:
            path: the file.
            force: replace an existing file; else that is a UsageError.

        Raises:
            StateError: the file would be too large to be read again.
        """
        check_new(path, force=force)
        write_json(Path(path), self.to_json(), MAX_PLAN_BYTES, StateError)
