"""Who is stopped in one rollout, visit by visit, readable: what all engines answer to (SPEC sections 6, 13 and 14)."""

from __future__ import annotations

from collections import defaultdict
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import WorldError
from planner.failure_model import PLAIN, Bearing, exposure_of, own_key
from planner.simulator.thresholds import threefry2x32
from planner.world.moving_threats import ANYWHERE, Movers, Phases
from planner.world.uncertain_maps import HAZARD_DRAW, MAP_DRAW, UNIT, Hazard, Uncertain, bounds_of
from planner.world.world import World


class Luck:
    """One rollout's. Ask in the order of the run: what was hit may be gone, and robots have borne what they met."""

    def __init__(self, world: World, seed: int, rollout: int, bearing: Bearing = PLAIN) -> None:
        types = bearing.types
        self._own = world.of_robots(types, len(types) if isinstance(types, tuple) else 1)
        self._world, self._seed, self._rollout, self._bearing = world, seed, rollout, bearing
        self._tolerance: dict[int, int] = {}
        self._spent: set[int] = set()
        self._exposure: defaultdict[int, int] = defaultdict(int)

    def hits(self, robot: int, step: int, cell: int) -> bool:
        """Whether the robot is stopped as it enters the cell at this step."""
        chance = self._chance(robot, cell, step)
        if chance == 0 or not self._reaches_threshold(robot, chance):
            return False
        if isinstance(self._world.doubt, Hazard) and self._world.doubt.kind == "consumed":
            self._spent.add(cell)
        return True

    def _reaches_threshold(self, robot: int, chance: np.float32) -> bool:
        if robot not in self._tolerance:
            self._tolerance[robot] = int(self._bearing.tolerances(self._seed, [self._rollout], robot + 1)[0, robot])
        self._exposure[robot] += _exposure(chance)
        return self._exposure[robot] >= self._tolerance[robot]

    def borne(self, robot: int) -> int:
        """The robot's exposure so far, that before the rollout included."""
        return self._exposure[robot] + (self._bearing.begun[robot] if self._bearing.begun else 0)

    def _chance(self, robot: int, cell: int, step: int) -> np.float32:
        """That a visit of the cell in this step, as it is in this rollout, stops the robot."""
        doubt = self._world.doubt
        place = np.unravel_index(cell, self._world.shape)
        if isinstance(doubt, Phases):
            return doubt.threats[doubt.number_at(step)][place]
        if doubt is None or isinstance(doubt, Movers):
            return self._own[min(robot, len(self._own) - 1)].met[place]
        if isinstance(doubt, Hazard):
            return doubt.h[place] if self._are_there(doubt, np.array([cell]))[0] else np.float32(0)
        return doubt.chances[self._row(doubt, int(doubt.number[place])), doubt.column[place]]

    def _are_there(self, doubt: Hazard, cells: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Whether a hazard is in each of the cells `[n]`, and has not been consumed."""
        words, _ = threefry2x32(own_key(self._seed, HAZARD_DRAW), self._rollout, cells)
        drawn = (words >> np.uint32(8)) < doubt.q.ravel()[cells].astype(np.float64) * UNIT
        return np.asarray(drawn & ~np.isin(cells, list(self._spent)))

    def _row(self, doubt: Uncertain, number: int) -> int:
        """Which of the maps is true, or for a level."""
        return self._number(MAP_DRAW, number) * doubt.count // UNIT

    def _number(self, purpose: int, counter: int) -> int:
        """u * 2**24 of the numbers that say what is true in the rollout."""
        word, _ = threefry2x32(own_key(self._seed, purpose), self._rollout, counter)
        return int(word) >> 8


@cache
def _exposure(chance: np.float32) -> int:
    return int(exposure_of(chance))


def true_map(doubt: Uncertain, seed: int, rollout: int) -> NDArray[np.float32]:
    """float32 `[H, W]`, the map that a rollout meets."""
    return doubt.threat_at(rows_met(doubt, seed, rollout))


def hazards_met(doubt: Hazard, seed: int, rollouts: ArrayLike) -> NDArray[np.bool_]:
    """bool `[..., N]`: in which cells a hazard is at first in these rollouts `[...]`."""
    words, _ = threefry2x32(own_key(seed, HAZARD_DRAW), np.asarray(rollouts)[..., None], np.arange(doubt.q.size))
    return np.asarray((words >> np.uint32(8)) < doubt.q.ravel().astype(np.float64) * UNIT)


def rows_met(doubt: Uncertain, seed: int, rollouts: ArrayLike) -> NDArray[np.int64]:
    """int64 `[..., numbers]`, the rows of `doubt.chances` that rollouts `[...]` meet, one for each of their numbers."""
    numbers = np.arange(int(doubt.number.max()) + 1)
    words, _ = threefry2x32(own_key(seed, MAP_DRAW), np.asarray(rollouts)[..., None], numbers)
    return (words >> np.uint32(8)).astype(np.int64) * doubt.count // UNIT


# Where the movers of one rollout go and whom they stop, readable: what all engines answer to (SPEC section 16).
#
# Their ways depend on the seed and the rollout alone, so they can be told without a run.

MOVE_DRAW, MEETING_DRAW = 3, 4
"""Second words of the counters under which moves, and hits of those who are met, have their keys."""


class Roaming:
    """The movers of a rollout and a team of so many robots."""

    def __init__(self, movers: Movers, seed: int, rollout: int, robots: int) -> None:
        self._movers, self._rollout, self._robots = movers, rollout, robots
        self._moves, self._meets = own_key(seed, MOVE_DRAW), own_key(seed, MEETING_DRAW)
        self._free = ~np.isnan(movers.own)
        self._places: list[int] = first_places(movers, seed, [rollout])[0].tolist()

    @property
    def cells(self) -> list[int]:
        """The cell of each mover."""
        each = zip(self._movers.members, self._places, strict=True)
        return [mover.route[place] if mover.patrols else place for mover, place in each]

    def move(self, step: int) -> None:
        """Each of them moves, after the robots' moves of this step."""
        count = len(self._places)
        stays, where = threefry2x32(self._moves, self._rollout, (step + 1) * count + np.arange(count))
        for number, mover in enumerate(self._movers.members):
            if mover.patrols:
                self._places[number] = (self._places[number] + 1) % len(mover.route)
            elif int(stays[number]) >> 8 >= chance_bound(mover.stay):
                self._places[number] = self._neighbour(self._places[number], int(where[number]) >> 8)

    def _neighbour(self, cell: int, number: int) -> int:
        """The free neighbour that a number below UNIT means, of N, W, E, S; the cell itself if it has none."""
        height, width = self._free.shape
        row, col = divmod(cell, width)
        places = ((row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col))
        ways = [r * width + c for r, c in places if 0 <= r < height and 0 <= c < width and self._free[r, c]]
        return ways[number * len(ways) // UNIT] if ways else cell

    def meets(self, robot: int, step: int, cell: int) -> bool:
        """Whether a robot that is in the cell at the end of this step is stopped by a mover."""
        return any(self._hits(robot, step, number) for number, place in enumerate(self.cells) if place == cell)

    def _hits(self, robot: int, step: int, number: int) -> bool:
        counter = (step * len(self._places) + number) * self._robots + robot
        word = threefry2x32(self._meets, self._rollout, counter)[0]
        return int(word) >> 8 < chance_bound(self._movers.members[number].hit)


def chance_bound(chance: float) -> int:
    """Of so many numbers below UNIT a chance is made: u < chance."""
    return int(bounds_of(np.array([chance], dtype=np.float32))[0])


def first_places(movers: Movers, seed: int, rollouts: ArrayLike) -> NDArray[np.int64]:
    """int64 `[B, M]`: where movers are before they first move: cells, or places on their routes."""
    ids, total = np.asarray(rollouts, dtype=np.uint32), np.cumsum(movers.weight.ravel())
    places = np.empty((len(ids), len(movers.members)), dtype=np.int64)
    for number, mover in enumerate(movers.members):
        if mover.place != ANYWHERE:
            places[:, number] = mover.place
            continue
        word = threefry2x32(own_key(seed, MOVE_DRAW), ids, number)[0].astype(np.int64)
        size = len(mover.route) if mover.patrols else int(total[-1])
        drawn = word * size >> 32
        places[:, number] = drawn if mover.patrols else np.searchsorted(total, drawn, side="right")
    return places


def ways_of_movers(world: World, seed: int, rollout: int, steps: int) -> NDArray[np.int64]:
    """int64 `[steps, M]`: the cell of each mover at the end of steps 0, 1, ...; no columns where nothing moves."""
    if world.movers is None:
        return np.zeros((steps, 0), dtype=np.int64)
    roaming, ways = Roaming(world.movers, seed, rollout, 1), []
    for step in range(steps):
        roaming.move(step)
        ways.append(roaming.cells)
    return np.array(ways, dtype=np.int64)


def check_counters(world: World, robots: int, last_step: int) -> None:
    """Raise WorldError where a run has more meetings than the random-number counter can address."""
    if world.movers is not None and (last_step + 1) * len(world.movers.members) * robots >= 2**32:
        movers = len(world.movers.members)
        raise WorldError(
            f"{movers} movers, {robots} robots and {last_step:,} steps", source=world.source,
            expected="a product below 2**32", fix="fewer movers, or a deadline",
        )  # fmt: skip
