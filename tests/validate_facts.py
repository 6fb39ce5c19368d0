"""What the validator's rules share: a broken rule, the facts of a plan on its world, and a flood fill of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from planner.ids import NO_AREA
from planner.plan.plan import Plan
from planner.world.world import World

NEVER = np.iinfo(np.int64).max


class Violation(NamedTuple):
    """One broken rule, by name. `robot`, `step` and `cell` (row, col) are None where the rule is about none."""

    rule: str
    robot: int | None = None
    step: int | None = None
    cell: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class Facts:
    """What the rules share. Axis `N` = H * W cells.

    Attributes:
        threat: float32 `[N]`. region: `[N]`, component of the free cells; only meaningful on them.
        accessible: bool `[N]`. first: int64 `[N]`, step at which somebody first enters the cell, or NEVER.
        last: the step of the last move of all.
        ended: by robot, the area of its last leg if it made all moves of its range.
    """

    plan: Plan
    width: int
    threat: NDArray[np.float32]
    region: NDArray[np.int32]
    accessible: NDArray[np.bool_]
    first: NDArray[np.int64]
    last: int
    ended: dict[int, int]

    @property
    def adaptive(self) -> bool:
        """The plan follows another policy than the paper's: its robots may change their minds (SPEC section 11)."""
        return self.plan.settings is not None and self.plan.settings.policy != "mrac"

    @property
    def breaks_off(self) -> bool:
        """Its robots may change their minds while they cover, too."""
        return self.plan.settings is not None and self.plan.settings.rule.breaks_off

    def broken(
        self, rule: str, *, robot: int | None = None, step: int | None = None, cell: int | None = None
    ) -> Violation:
        return Violation(rule, robot, step, None if cell is None else row_col(cell, self.width))

    def first_step(self, rule: str, robot: int, steps: NDArray[np.int64]) -> Iterator[Violation]:
        """The first of the steps at which the robot breaks the rule, if it does."""
        for step in steps[:1].tolist():
            yield self.broken(rule, robot=robot, step=step, cell=self.plan.robots[robot].path[step])

    def first_cell(self, rule: str, cells: NDArray[np.int64]) -> Iterator[Violation]:
        """The first of the cells in which the rule is broken, if it is."""
        for cell in cells[:1].tolist():
            yield self.broken(rule, cell=cell)


def facts_of(plan: Plan, world: World) -> Facts:
    """The facts of a plan whose paths lie on the map."""
    threat = world.threat.ravel()
    free = ~np.isnan(threat)
    region = components(np.where(free, 0, NO_AREA).reshape(world.shape)).ravel()
    starts = np.array([robot.path[0] for robot in plan.robots], dtype=np.int64)
    accessible = free & np.isin(region, region[starts[free[starts]]])
    first = np.full(len(threat), NEVER, dtype=np.int64)
    for robot in plan.robots:
        np.minimum.at(first, robot.path, np.arange(len(robot.path)))
    last = max(last_move(robot.path) for robot in plan.robots)
    return Facts(plan, world.shape[1], threat, region, accessible, first, last, _at_end_of_range(plan))


def _at_end_of_range(plan: Plan) -> dict[int, int]:
    ranges = moves_of(plan)
    return {
        number: robot.legs[-1].area
        for number, robot in enumerate(plan.robots)
        if robot.legs and np.count_nonzero(np.diff(robot.path)) >= ranges[number]
    }


def moves_of(plan: Plan) -> NDArray[np.float64]:
    """The moves that each robot can make, `[K]`; infinity where nothing limits it."""
    given = None if plan.settings is None else plan.settings.range
    return np.broadcast_to(np.asarray(np.inf if given is None else given, dtype=np.float64), len(plan.robots))


def row_col(cell: int | np.integer, width: int) -> tuple[int, int]:
    """(row, col) of a cell index."""
    return (int(cell) // width, int(cell) % width)


def last_move(path: NDArray[np.int64]) -> int:
    """The last step at which the cell changes; 0 if it never does."""
    return int(np.max(np.flatnonzero(np.diff(path)), initial=-1)) + 1


def components(labels: NDArray[np.int64]) -> NDArray[np.int32]:
    """Number of the 4-connected component of equal labels that each cell is in, `[H, W]`; NO_AREA joins nothing."""
    number = np.arange(labels.size).reshape(labels.shape)
    right = (labels[:, 1:] == labels[:, :-1]) & (labels[:, 1:] != NO_AREA)
    down = (labels[1:] == labels[:-1]) & (labels[1:] != NO_AREA)
    ends = (
        np.concatenate([number[:, 1:][right], number[1:][down]]),
        np.concatenate([number[:, :-1][right], number[:-1][down]]),
    )
    edges = coo_array((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(labels.size, labels.size))
    return connected_components(edges, directed=False)[1].reshape(labels.shape)


def cut_off(cells: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """The cells of an area that are not connected, inside it, with its first cell: none for a connected area."""
    rows, cols = np.divmod(cells, width)
    rows, cols = rows - rows.min(), cols - cols.min()
    labels = np.full((rows.max() + 1, cols.max() + 1), NO_AREA, dtype=np.int64)
    labels[rows, cols] = 0
    part = components(labels)[rows, cols]
    return cells[part != part[0]]
