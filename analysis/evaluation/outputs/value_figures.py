"""Value covered, found and left, and what missions are judged by beside it, for every field's words (SPEC 13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Estimate
from analysis.statistics.mission import TAIL, tail_mean, times_to
from analysis.theory.value import Worth
from planner.files import Json
from planner.tally import Tally
from planner.worlds.world import World


@dataclass(frozen=True, eq=False)
class ValueFigures:
    """Value covered, found and left. Axis `N` = H * W cells.

    Attributes:
        metrics: in whose words. world: the map. worth: of its cells.
        covered, found: expected value of the cells visited, and of what is found.
        covered_by_cell, found_by_cell: float64 `[N]`, chance that the cell is visited, that what is in it is found.
        remainder: of `found`, not counted by visit. most: expected value that no strategy exceeds, or None.
        tally: of the evaluation. losses: expected robots lost. robots_left: P(at least 1, ..., K are left at the end).
    """

    metrics: str
    world: World
    worth: Worth
    covered: Estimate
    found: Estimate
    covered_by_cell: NDArray[np.float64]
    found_by_cell: NDArray[np.float64]
    remainder: float
    most: float | None
    tally: Tally
    losses: Estimate
    robots_left: list[Estimate]

    @property
    def left(self) -> Estimate:
        """Expected value that is not found: that of all free cells without what is."""
        total, (low, high) = self.worth.total, self.found.ci95
        return Estimate(total - self.found.mean, self.found.se, (total - high, total - low))

    @property
    def left_by_cell(self) -> NDArray[np.float64]:
        """float64 `[N]`: expected value left in each cell."""
        return self.worth.value * (1.0 - self.found_by_cell)

    @property
    def scale(self) -> float:
        """What makes chances of values: 1 where they add up to at most 1, else one over their sum."""
        return 1.0 if self.worth.total <= 1 + 1e-6 else 1.0 / self.worth.total

    @property
    def detection(self) -> float | None:
        """Probability of detection: found of what was covered; None where nothing was."""
        return self.found.mean / self.covered.mean if self.covered.mean > 0 else None

    @property
    def route_left(self) -> tuple[float, float] | None:
        """Expected value left on the route, and that of its worst cell; None without a route.

        Read as chances, something is left on the route with a chance between the second and the first.
        """
        if self.world.team.route is None:
            return None
        rows, cols = self.world.team.route.T
        left = self.left_by_cell[np.unique(rows * self.world.shape[1] + cols)]
        return float(left.sum()), float(left.max())

    @property
    def cvar(self) -> float:
        """Mean coverage of the worst runs, a share TAIL of all: a fraction of the accessible cells."""
        return tail_mean(self.tally.visited) / self.tally.accessible

    def per_robot_lost(self, amount: float) -> float | None:
        """So much a robot lost; None where none is."""
        return amount / self.losses.mean if self.losses.mean > 0 else None

    @property
    def square_metres(self) -> float:
        """Expected ground visited."""
        return float(self.covered_by_cell.sum()) * self.world.cell_size**2

    def to_json(self) -> Json:
        """All of them, but those by cell."""
        shares = {name: getattr(self, name).to_json() for name in ("covered", "found", "left")}
        route = self.route_left
        return {
            "metrics": self.metrics,
            "total": self.worth.total,
            **shares,
            "remainder": self.remainder,
            "any_strategy": self.most,
        } | {
            "search": {
                "containment": self.covered.mean * self.scale,
                "detection": self.detection,
                "success": self.found.mean * self.scale,
            },
            "clearance": {
                "cleared": self.found.mean / self.worth.total,
                "remaining": self.left.mean,
                "route": None if route is None else {"remaining": route[0], "risk": [route[1], min(route[0], 1.0)]},
            },
            "square_metres": self.square_metres,
            "per_robot_lost": {
                "value": self.per_robot_lost(self.covered.mean),
                "square_metres": self.per_robot_lost(self.square_metres),
            },
            "robots_left": [chance.to_json() for chance in self.robots_left],
            "time_to": {f"{share:g}": step for share, step in times_to(self.tally).items()},
            "cvar": {f"{TAIL:g}": self.cvar},
        }
