"""Failure sampling of one rollout, visit by visit, in readable form: all engines agree with it (SPEC 6, 13, 14)."""

from __future__ import annotations

from collections import defaultdict
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import WorldError
from planner.failure_model import PLAIN, FailureModel, exposure_of, own_key
from planner.simulator.codes import NO_CELL
from planner.simulator.searches import neighbour_table
from planner.simulator.thresholds import threefry2x32
from planner.world.moving_threats import ANYWHERE, MovingThreats
from planner.world.uncertain_maps import HAZARD_DRAW, MAP_DRAW, UNIT, Hazard, Uncertain, bounds_of
from planner.world.world import World


class LossDraws:
    """Random numbers of one rollout, in the order of the run: threats may be spent, and hazards accumulate.

    Args:
        world: the map.
        seed: 0 <= seed < 2**64.
        rollout: id.
        failure_model: of the team.
    """

    def __init__(self, world: World, seed: int, rollout: int, failure_model: FailureModel = PLAIN) -> None:
        types, uncertainty = failure_model.types, world.uncertainty
        self._world, self._seed, self._rollout, self._failures = world, seed, rollout, failure_model
        self._threat = [of.by_phase for of in world.of_robots(types, len(types) if isinstance(types, tuple) else 1)]
        if isinstance(uncertainty, Hazard):
            self._threat = [np.where(hazards_met(uncertainty, seed, rollout), uncertainty.h.ravel(), np.float32(0))]
        elif isinstance(uncertainty, Uncertain):
            self._threat = [true_map(uncertainty, seed, rollout)]
        self._consumes = isinstance(uncertainty, Hazard) and uncertainty.kind == "consumed"
        self._threshold: dict[int, int] = {}
        self._spent: set[int] = set()
        self._hazard: defaultdict[int, int] = defaultdict(int)

    def hits(self, robot: int, step: int, cell: int) -> bool:
        """Whether the robot is lost as it enters the cell at this step."""
        (visit,) = self._world.visits(np.array([cell]), step).tolist()
        chance = self._threat[min(robot, len(self._threat) - 1)].ravel()[visit]
        if chance == 0 or cell in self._spent or not self._reaches_threshold(robot, chance):
            return False
        if self._consumes:
            # The first loss consumes the hazard for the rest of the rollout.
            self._spent.add(cell)
        return True

    def _reaches_threshold(self, robot: int, chance: np.float32) -> bool:
        if robot not in self._threshold:
            self._threshold[robot] = int(self._failures.thresholds(self._seed, [self._rollout], robot + 1)[0, robot])
        self._hazard[robot] += _exposure(chance)
        return self._hazard[robot] >= self._threshold[robot]


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


# Moving threats of one rollout (SPEC section 16). Their paths depend only on the seed and the rollout.

MOVE_DRAW, MEETING_DRAW = 3, 4
"""Second counter words from which moves, and losses at encounters, get their keys."""


def chance_bound(chance: float) -> int:
    """Bound on numbers below UNIT for a probability: u < bound."""
    return int(bounds_of(np.array([chance], dtype=np.float32))[0])


def first_places(threats: MovingThreats, seed: int, rollouts: ArrayLike) -> NDArray[np.int64]:
    """int64 `[B, M]`: positions of moving threats before their first move: cells, or indices on their routes.

    Args:
        threats: the moving threats.
        seed: 0 <= seed < 2**64.
        rollouts: ids `[B]`.
    """
    ids, total = np.asarray(rollouts, dtype=np.uint32), np.cumsum(threats.weight.ravel())
    places = np.empty((len(ids), len(threats.members)), dtype=np.int64)
    for number, member in enumerate(threats.members):
        if member.place != ANYWHERE:
            places[:, number] = member.place
            continue
        word = threefry2x32(own_key(seed, MOVE_DRAW), ids, number)[0].astype(np.int64)
        size = len(member.route) if member.patrols else int(total[-1])
        drawn = word * size >> 32
        places[:, number] = drawn if member.patrols else np.searchsorted(total, drawn, side="right")
    return places


def threat_paths(world: World, seed: int, rollout: int, steps: int) -> NDArray[np.int64]:
    """int64 `[steps, M]`: the cell of each moving threat at the end of steps 0, 1, ...; no columns without any.

    Args:
        world: the map.
        seed: 0 <= seed < 2**64.
        rollout: id.
        steps: number of steps.
    """
    if world.moving_threats is None:
        return np.zeros((steps, 0), dtype=np.int64)
    members, key, paths = world.moving_threats.members, own_key(seed, MOVE_DRAW), list[list[int]]()
    near = neighbour_table(world.shape, ~np.isnan(world.moving_threats.own.ravel()))
    places: list[int] = first_places(world.moving_threats, seed, [rollout])[0].tolist()
    for step in range(steps):
        words = threefry2x32(key, rollout, (step + 1) * len(members) + np.arange(len(members)))
        stays, where = np.stack(words) >> np.uint32(8)
        for number, member in enumerate(members):
            if member.patrols:
                places[number] = (places[number] + 1) % len(member.route)
            elif stays[number] >= chance_bound(member.stay):
                # The neighbour, of N, W, E, S, that the random number selects; none is free: it stays.
                ways = near[places[number]][near[places[number]] != NO_CELL].tolist()
                places[number] = ways[int(where[number]) * len(ways) // UNIT] if ways else places[number]
        paths.append([one.route[at] if one.patrols else at for one, at in zip(members, places, strict=True)])
    return np.array(paths, dtype=np.int64)


def check_counters(world: World, robots: int, last_step: int) -> None:
    """Check that the random-number counter can address all encounters of a run.

    Raises:
        WorldError: it cannot.
    """
    if world.moving_threats is not None and (last_step + 1) * len(world.moving_threats.members) * robots >= 2**32:
        threats = len(world.moving_threats.members)
        raise WorldError(
            f"{threats} moving threats, {robots} robots and {last_step:,} steps", source=world.source,
            expected="a product below 2**32", fix="fewer moving threats, or a deadline",
        )  # fmt: skip
