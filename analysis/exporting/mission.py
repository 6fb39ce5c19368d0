"""What every format writes: a plan on its world, with each robot's chances, and its path as straight runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.theory.exact import OpenLoopExact, open_loop_exact
from planner.arguments import Numbers
from planner.pace import SPEEDS
from planner.plans.plan import Plan, last_move
from planner.worlds.georeference import principal
from planner.worlds.world import World

DEGREES = 9
"""Decimals of longitude and latitude: a tenth of a millimetre."""
ALTITUDE, SPEED = 20.0, 3.0
"""Metres above the place of take-off, and metres a second, where nobody says."""
HIGHEST = 10_000.0


class Stop(NamedTuple):
    """Where a robot turns, waits or ends: the step at which it arrives, the cell, and how many steps it waits there."""

    step: int
    cell: int
    waits: int


@dataclass(frozen=True, eq=False)
class Mission:
    """A plan to be driven.

    Attributes:
        world, plan: the map and the paths on it.
        altitude: metres above the place of take-off; 0: on the ground. speed: metres a second.
    """

    world: World
    plan: Plan
    altitude: float
    speed: float

    def check(self) -> None:
        """Raise UsageError for an altitude or a speed that nothing flies, PlanError for the plan of another map."""
        Numbers(0, HIGHEST, "metres above the ground").check("altitude", self.altitude)
        SPEEDS.check("speed", self.speed)
        self.plan.require(self.world)

    @cached_property
    def exact(self) -> OpenLoopExact:
        """What the open loop is worth, exactly."""
        return open_loop_exact(self.plan, self.world)

    @property
    def believed(self) -> str:
        """What precedes the name of a figure of the map that robots believe, where that is not the true one."""
        return "" if self.world.knowledge is None else "believed_"

    def unknown(self, figures: tuple[str, ...]) -> tuple[str, ...]:
        """A note that names those of these figures that are not known of every cell or robot, and why."""
        doubt = self.world.doubt or self.world.knowledge
        if not figures or doubt is None:
            return ()
        covered, lost, survival = self.exact.visited_by_cell, self.exact.stops_by_cell, self.exact.survival
        of = {"covered": covered, "losses": lost, "residual": covered, "chance_of_loss": survival}
        left = [name for name in figures if np.isnan(of[name]).any()]
        if not left:
            return ()
        names = " and ".join(filter(None, (", ".join(left[:-1]), left[-1])))
        return (f"{names} left out where the open loop has no exact value, which `evaluate` samples: {doubt.said}",)

    @property
    def step_seconds(self) -> float:
        """Seconds that a step takes."""
        return self.world.cell_size / self.speed

    def stops(self, robot: int) -> list[Stop]:
        """The path of a robot as the ends of its straight runs."""
        return straight_runs(self.plan.robots[robot].path)

    def lonlat(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """(longitude, latitude) of the centres of cells. Raises MapError where nobody says where the map lies."""
        return rounded(principal(self.on_earth(self.world.to_xy(cells))))

    def on_earth(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(longitude, latitude) of points (x, y) of the map's frame; longitudes go on across 180. Raises MapError."""
        height, width = self.world.shape
        middle = self.world.to_lonlat(self.world.at(height / 2, width / 2))
        assert self.world.georeference is not None
        return self.world.georeference.to_lonlat(points, about=middle[0])


def rounded(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(longitude, latitude) as files hold them, without a minus before 0."""
    return np.round(places, DEGREES) + 0.0


def make_mission(world: World, plan: Plan, altitude: float | None = None, speed: float | None = None) -> Mission:
    """A mission, checked; what is None is ALTITUDE, and what the world says or SPEED. Raises InputError."""
    if speed is None:
        speed = SPEED if world.pace.seconds is None else world.cell_size / world.pace.seconds
    mission = Mission(world, plan, ALTITUDE if altitude is None else altitude, speed)
    mission.check()
    return mission


def straight_runs(path: NDArray[np.int64]) -> list[Stop]:
    """The ends of a path's straight runs, the start and the last cell among them; waiting at the end is left out."""
    path = path[: last_move(path) + 1]
    moves = np.diff(path)
    stops = [Stop(0, int(path[0]), 0)]
    for step, end in pairwise(np.unique([0, *np.flatnonzero(np.diff(moves)) + 1, len(moves)]).tolist()):
        if moves[step] == 0:
            stops[-1] = stops[-1]._replace(waits=end - step)
        else:
            stops.append(Stop(end, int(path[end]), 0))
    return stops
