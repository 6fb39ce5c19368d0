"""Failure sampling of one rollout, visit by visit, in readable form: all engines agree with it (SPEC 6, 13, 14)."""

from __future__ import annotations

from collections import defaultdict
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import WorldError
from planner.failure_model import PLAIN, FailureModel, exposure_of, own_key
from planner.simulator.thresholds import threefry2x32
from planner.world.moving_threats import ANYWHERE, MovingThreats, Phases
from planner.world.uncertain_maps import HAZARD_DRAW, MAP_DRAW, UNIT, Hazard, Uncertain, bounds_of
from planner.world.world import World


class Luck:
    """Random numbers of one rollout, in the order of the run: threats may be spent, and hazards accumulate.

    Args:
        world: the map.
        seed: 0 <= seed < 2**64.
        rollout: id.
        bearing: the failure model.
    """

    def __init__(self, world: World, seed: int, rollout: int, failure_model: FailureModel = PLAIN) -> None:
        types = failure_model.types
        self._own = world.of_robots(types, len(types) if isinstance(types, tuple) else 1)
        self._world, self._seed, self._rollout, self._bearing = world, seed, rollout, failure_model
        self._tolerance: dict[int, int] = {}
        self._spent: set[int] = set()
        self._exposure: defaultdict[int, int] = defaultdict(int)

    def hits(self, robot: int, step: int, cell: int) -> bool:
        """Whether the robot is lost as it enters the cell at this step."""
        chance = self._chance(robot, cell, step)
        if chance == 0 or not self._reaches_threshold(robot, chance):
            return False
        if isinstance(self._world.uncertainty, Hazard) and self._world.uncertainty.kind == "consumed":
            # The first loss consumes the hazard for the rest of the rollout.
            self._spent.add(cell)
        return True

    def _reaches_threshold(self, robot: int, chance: np.float32) -> bool:
        if robot not in self._tolerance:
            self._tolerance[robot] = int(self._bearing.tolerances(self._seed, [self._rollout], robot + 1)[0, robot])
        self._exposure[robot] += _exposure(chance)
        return self._exposure[robot] >= self._tolerance[robot]

    def borne(self, robot: int) -> int:
        """The robot's cumulative hazard so far, that before the rollout included."""
        return self._exposure[robot] + (self._bearing.begun[robot] if self._bearing.begun else 0)

    def _chance(self, robot: int, cell: int, step: int) -> np.float32:
        """Probability that a visit of the cell in this step, in its state in this rollout, destroys the robot."""
        uncertainty = self._world.uncertainty
        place = np.unravel_index(cell, self._world.shape)
        if isinstance(uncertainty, Phases):
            return uncertainty.threats[uncertainty.number_at(step)][place]
        if uncertainty is None or isinstance(uncertainty, MovingThreats):
            return self._own[min(robot, len(self._own) - 1)].met[place]
        if isinstance(uncertainty, Hazard):
            return uncertainty.h[place] if self._are_there(uncertainty, np.array([cell]))[0] else np.float32(0)
        return uncertainty.chances[self._row(uncertainty, int(uncertainty.number[place])), uncertainty.column[place]]

    def _are_there(self, uncertainty: Hazard, cells: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Whether a hazard exists in each of the cells `[n]`, and has not been consumed."""
        words, _ = threefry2x32(own_key(self._seed, HAZARD_DRAW), self._rollout, cells)
        drawn = (words >> np.uint32(8)) < uncertainty.q.ravel()[cells].astype(np.float64) * UNIT
        return np.asarray(drawn & ~np.isin(cells, list(self._spent)))

    def _row(self, uncertainty: Uncertain, number: int) -> int:
        """Index of the true map, or of the map for a level."""
        return self._number(MAP_DRAW, number) * uncertainty.count // UNIT

    def _number(self, purpose: int, counter: int) -> int:
        """u * 2**24 of the numbers that determine the true map of the rollout."""
        word, _ = threefry2x32(own_key(self._seed, purpose), self._rollout, counter)
        return int(word) >> 8


@cache
def _exposure(chance: np.float32) -> int:
    return int(exposure_of(chance))


def true_map(uncertainty: Uncertain, seed: int, rollout: int) -> NDArray[np.float32]:
    """float32 `[H, W]`, the true map of a rollout."""
    return uncertainty.threat_at(rows_met(uncertainty, seed, rollout))


def hazards_met(uncertainty: Hazard, seed: int, rollouts: ArrayLike) -> NDArray[np.bool_]:
    """bool `[..., N]`: cells with a hazard at the start of rollouts `[...]`."""
    words, _ = threefry2x32(own_key(seed, HAZARD_DRAW), np.asarray(rollouts)[..., None], np.arange(uncertainty.q.size))
    return np.asarray((words >> np.uint32(8)) < uncertainty.q.ravel().astype(np.float64) * UNIT)


def rows_met(uncertainty: Uncertain, seed: int, rollouts: ArrayLike) -> NDArray[np.int64]:
    """int64 `[..., numbers]`, rows of `uncertainty.chances` in rollouts `[...]`, one for each of their numbers."""
    numbers = np.arange(int(uncertainty.number.max()) + 1)
    words, _ = threefry2x32(own_key(seed, MAP_DRAW), np.asarray(rollouts)[..., None], numbers)
    return (words >> np.uint32(8)).astype(np.int64) * uncertainty.count // UNIT


# Moving threats of one rollout, in readable form: all engines agree with it (SPEC section 16).
#
# Their paths depend only on the seed and the rollout, so they can be computed without a run.

MOVE_DRAW, MEETING_DRAW = 3, 4
"""Second counter words from which moves, and losses at encounters, get their keys."""


class MovingThreatRun:
    """The moving threats of a rollout.

    Args:
        movers: the moving threats.
        seed: 0 <= seed < 2**64.
        rollout: id.
        robots: K.
    """

    def __init__(self, movers: MovingThreats, seed: int, rollout: int, robots: int) -> None:
        self._movers, self._rollout, self._robots = movers, rollout, robots
        self._moves, self._meets = own_key(seed, MOVE_DRAW), own_key(seed, MEETING_DRAW)
        self._free = ~np.isnan(movers.own)
        self._places: list[int] = first_places(movers, seed, [rollout])[0].tolist()

    @property
    def cells(self) -> list[int]:
        """The cell of each moving threat."""
        each = zip(self._movers.members, self._places, strict=True)
        return [mover.route[place] if mover.patrols else place for mover, place in each]

    def move(self, step: int) -> None:
        """Move the threats, after the robots' moves of this step."""
        count = len(self._places)
        stays, where = threefry2x32(self._moves, self._rollout, (step + 1) * count + np.arange(count))
        for number, mover in enumerate(self._movers.members):
            if mover.patrols:
                self._places[number] = (self._places[number] + 1) % len(mover.route)
            elif int(stays[number]) >> 8 >= chance_bound(mover.stay):
                self._places[number] = self._neighbour(self._places[number], int(where[number]) >> 8)

    def _neighbour(self, cell: int, number: int) -> int:
        """The free neighbour, of N, W, E, S, that a number below UNIT selects; the cell itself if none is free."""
        height, width = self._free.shape
        row, col = divmod(cell, width)
        places = ((row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col))
        ways = [r * width + c for r, c in places if 0 <= r < height and 0 <= c < width and self._free[r, c]]
        return ways[number * len(ways) // UNIT] if ways else cell

    def meets(self, robot: int, step: int, cell: int) -> bool:
        """Whether a moving threat destroys a robot that is in the cell at the end of this step."""
        return any(self._hits(robot, step, number) for number, place in enumerate(self.cells) if place == cell)

    def _hits(self, robot: int, step: int, number: int) -> bool:
        counter = (step * len(self._places) + number) * self._robots + robot
        word = threefry2x32(self._meets, self._rollout, counter)[0]
        return int(word) >> 8 < chance_bound(self._movers.members[number].hit)


def chance_bound(chance: float) -> int:
    """Bound on numbers below UNIT for a probability: u < bound."""
    return int(bounds_of(np.array([chance], dtype=np.float32))[0])


def first_places(movers: MovingThreats, seed: int, rollouts: ArrayLike) -> NDArray[np.int64]:
    """int64 `[B, M]`: positions of moving threats before their first move: cells, or indices on their routes.

    Args:
        movers: the moving threats.
        seed: 0 <= seed < 2**64.
        rollouts: ids `[B]`.
    """
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


def threat_paths(world: World, seed: int, rollout: int, steps: int) -> NDArray[np.int64]:
    """int64 `[steps, M]`: the cell of each moving threat at the end of steps 0, 1, ...; no columns without any.

    Args:
        world: the map.
        seed: 0 <= seed < 2**64.
        rollout: id.
        steps: number of steps.
    """
    if world.movers is None:
        return np.zeros((steps, 0), dtype=np.int64)
    roaming, ways = MovingThreatRun(world.movers, seed, rollout, 1), []
    for step in range(steps):
        roaming.move(step)
        ways.append(roaming.cells)
    return np.array(ways, dtype=np.int64)


def check_counters(world: World, robots: int, last_step: int) -> None:
    """Check that the random-number counter can address all encounters of a run.

    Raises:
        WorldError: it cannot.
    """
    if world.movers is not None and (last_step + 1) * len(world.movers.members) * robots >= 2**32:
        movers = len(world.movers.members)
        raise WorldError(
            f"{movers} moving threats, {robots} robots and {last_step:,} steps", source=world.source,
            expected="a product below 2**32", fix="fewer moving threats, or a deadline",
        )  # fmt: skip
