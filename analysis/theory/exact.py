"""Exact expected values of the open loop: the closed form of SPEC section 6, per cell, per robot and over time.

The oracle of the rollouts: the two share only plain types. Axis letters: `K` robots, `N` = H * W cells, `T` makespan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from planner.failure_model import PLAIN, FailureModel
from planner.plan.plan import Plan, RobotPlan
from planner.world.moving_threats import ANYWHERE, MovingThreat
from planner.world.uncertain_maps import Hazard, Uncertain
from planner.world.world import World

# Threats on a robot's path with latent hazards, or with one of several maps (SPEC section 13). Axis `E` = entries.
#
# Given the true state of the world the robots of an open loop are independent. With one map of M, exact values are the
# mean over the M maps. With persistent hazards a robot is independent of the others but in the cells that both enter:
# there the product over robots is replaced by a sum over sets of robots (`_joint`).
#
# A single robot needs neither. After m survived entries into a cell with hazard probability q and threat h, the
# hazard is present with probability q (1 - h)**m / (1 - q + q (1 - h)**m), and the next entry destroys the robot with h
# times that.

MOST_TERMS = 5 * 10**8
"""Most products of a set of robots and a shared cell that are computed: some seconds."""


def alone(plan: Plan, world: World) -> list[NDArray[np.float64]]:
    """Threat of each entry of each robot, given that it is made, float64 `[E]`, without the effect of other robots."""
    uncertainty = world.uncertainty
    if isinstance(uncertainty, Uncertain):
        return [_by_level(robot, uncertainty) for robot in plan.robots]
    if isinstance(uncertainty, Hazard):
        return [_by_hazard(robot, uncertainty.q, uncertainty.h) for robot in plan.robots]
    return [_met(robot, world) for robot in plan.robots]


def _entered(values: NDArray[np.float32], robot: RobotPlan) -> NDArray[np.float64]:
    """float64 `[E]`: the value of each cell entered."""
    return values.ravel()[robot.path[robot.entered]].astype(np.float64)


def _by_hazard(robot: RobotPlan, q: NDArray[np.float32], h: NDArray[np.float32]) -> NDArray[np.float64]:
    """Threat of each entry with latent hazards; see the comment above."""
    cells, there, hit = robot.path[robot.entered], _entered(q, robot), _entered(h, robot)
    order = np.argsort(cells, kind="stable")
    begins = np.concatenate([[True], cells[order][1:] != cells[order][:-1]])
    place = np.arange(len(cells))
    before = np.empty(len(cells), dtype=np.int64)
    before[order] = place - np.maximum.accumulate(np.where(begins, place, 0))
    still = there * (1 - hit) ** before
    left = 1 - there + still
    return hit * np.divide(still, left, out=np.zeros_like(still), where=left > 0)


def _by_level(robot: RobotPlan, uncertainty: Uncertain) -> NDArray[np.float64]:
    """Threat of each entry if the levels' maps are independent: survival is a product of means over the levels."""
    cells = robot.path[robot.entered]
    number, column = uncertainty.number.ravel()[cells], uncertainty.column.ravel()[cells]
    reach = np.ones(len(cells) + 1)
    for one in np.unique(number):
        passed = np.where(number == one, 1.0 - uncertainty.chances[:, column].astype(np.float64), 1.0)
        reach[1:] *= np.cumprod(passed, axis=1).mean(axis=0)
    return 1.0 - reach[1:] / reach[:-1]


def _shared(plan: Plan, hazard: Hazard) -> NDArray[np.int64]:
    """Cells in which several robots may meet an uncertain hazard, int64."""
    mine = [np.unique(robot.path[robot.entered]) for robot in plan.robots]
    cells, robots = np.unique(np.concatenate(mine), return_counts=True)
    uncertain = hazard.q.ravel()[cells] < 1  # with q = 1, visits of a persistent hazard are independent
    return cells[(robots > 1) & (hazard.threat.ravel()[cells] > 0) & (uncertain | (hazard.kind == "consumed"))]


# Survival of a robot on a given path among moving threats: the forward algorithm of each threat (SPEC section 16).
#
# Given the path the moving threats are independent, and so are their effects: the robot's survival is a product over
# them. For each threat the algorithm carries the probability that the robot has survived it and the threat is in a
# cell. In every step the threat moves, and the probability at the robot's cell is multiplied by 1 - h. Axis `T` =
# steps.

SIDES = ((-1, 0), (0, -1), (0, 1), (1, 0))
MOST_WORK = 3 * 10**8
"""Largest number of cells times steps times kinds of walkers that is computed: some seconds."""


def is_worth_it(world: World, steps: int) -> bool:
    """Whether `passed_moving_threats` is fast enough for a path of `steps` steps."""
    assert world.moving_threats is not None
    kinds = {member for member in world.moving_threats.members if not member.patrols}
    return len(kinds) * world.threat.size * steps <= MOST_WORK


def passed_moving_threats(path: NDArray[np.int64], world: World) -> NDArray[np.float64]:
    """float64 `[T]`: probability that no moving threat destroys a robot at a step of its path `[T]`, given survival.

    Cost O(T N) for each kind of walker, O(T L) for each kind of patrol.
    """
    passed, known = np.ones(len(path)), {}
    assert world.moving_threats is not None
    for member in world.moving_threats.members:
        if member not in known:
            known[member] = _passed_patrol(path, member) if member.patrols else _passed_walker(path, member, world)
        passed *= known[member]
    return passed


def _passed_patrol(path: NDArray[np.int64], member: MovingThreat) -> NDArray[np.float64]:
    route = np.array(member.route)
    chance = np.full(len(route), 1.0 / len(route))
    if member.start != ANYWHERE:
        chance = (np.arange(len(route)) == member.place).astype(np.float64)
    left = np.ones(len(path) + 1)
    for step, cell in enumerate(path):
        chance = np.roll(chance, 1)
        chance[route == cell] *= 1.0 - member.hit
        left[step + 1] = chance.sum()
    return _ratios(left)


def _passed_walker(path: NDArray[np.int64], member: MovingThreat, world: World) -> NDArray[np.float64]:
    free, (height, width) = world.free, world.shape
    around = np.pad(free, 1)

    def beside(padded: NDArray, side: tuple[int, int]) -> NDArray:
        return padded[1 + side[0] : 1 + side[0] + height, 1 + side[1] : 1 + side[1] + width]

    ways = sum(beside(around, side).astype(np.int64) for side in SIDES)
    stays = np.where(ways == 0, 1.0, member.stay)
    goes = np.where(free, (1.0 - stays) / np.maximum(ways, 1), 0.0)
    if member.start == ANYWHERE:
        weight = np.where(free, np.maximum(ways, 1), 0)
        chance = weight / weight.sum()
    else:
        chance = (np.arange(free.size) == member.start).astype(np.float64).reshape(free.shape)
    left, gone = np.ones(len(path) + 1), np.zeros((height + 2, width + 2))
    for step, cell in enumerate(path):
        gone[1:-1, 1:-1] = chance * goes
        chance = np.where(free, chance * stays + sum(beside(gone, side) for side in SIDES), 0.0)
        chance.flat[cell] *= 1.0 - member.hit
        left[step + 1] = chance.sum()
    return _ratios(left)


def _ratios(left: NDArray[np.float64]) -> NDArray[np.float64]:
    """Conditional survival of each step, from survival `left` `[T + 1]`; 0 once that is 0."""
    return np.divide(left[1:], left[:-1], out=np.zeros(len(left) - 1), where=left[:-1] > 0)


@dataclass(frozen=True, eq=False)
class PathChances:
    """Probabilities of one robot that follows its path alone. Axis `E` = entries of its path (waits left out).

    Attributes:
        steps, cells: int64 `[E]`, step and cell of each entry, the start at t = 0 first.
        threat: float64 `[E]`, probability that the entry destroys the robot if it is made: p of the cell, unless the
            failure model differs (`planner.failure_model`).
        reach: float64 `[E]`, probability of the entry: the product of (1 - threat) over the entries before.
        first: bool `[E]`, True at the first entry of each cell.
    """

    steps: NDArray[np.int64]
    cells: NDArray[np.int64]
    threat: NDArray[np.float64]
    reach: NDArray[np.float64]
    first: NDArray[np.bool_]

    @property
    def passed(self) -> NDArray[np.float64]:
        """float64 `[E]`, probability to enter the cell and survive."""
        return self.reach * (1.0 - self.threat)

    @property
    def survival(self) -> float:
        """Eq. (1): probability that the robot finishes its path."""
        return float(self.passed[-1])


def robot_chances(robot: RobotPlan, world: World, failure_model: FailureModel = PLAIN, number: int = 0) -> PathChances:
    """Probabilities along the path of robot `number`, in float64 from the world's float32 threats.

    Raises WorldError for moving, uncertain or changing threats.
    """
    world.require_certain_map("survival by eq. (1)")
    return chances_along(robot, _entered(world.threat, robot), failure_model, number)


def chances_along(
    robot: RobotPlan, threat: NDArray[np.float64], failure_model: FailureModel = PLAIN, number: int = 0
) -> PathChances:
    """Probabilities along a path whose entries have the given `threat` `[E]`.

    The cumulative hazard at an entry is `-sum ln(1 - threat)`, with survival `FailureModel.survival` (SPEC section 14).
    """
    steps = robot.entered
    cells = robot.path[steps]
    if not failure_model.is_even:
        with np.errstate(divide="ignore"):
            left = failure_model.survival(np.cumsum(-np.log1p(-threat)), number)
        reach = np.concatenate([[1.0], left[:-1]])
        threat = 1.0 - np.divide(left, reach, out=np.zeros_like(left), where=reach > 0)
    reach = np.concatenate([[1.0], np.cumprod(1.0 - threat)[:-1]])
    return PathChances(steps, cells, threat, reach, _first_of_each(cells))


def _first_of_each(cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """bool `[E]`: True at the first of equal cells."""
    places, first = np.arange(len(cells)), np.zeros(int(cells.max()) + 1, dtype=np.int64)
    first[cells[::-1]] = places[::-1]  # the last write stays: the first of equal cells
    return first[cells] == places


def chances_among(robot: RobotPlan, world: World, failure_model: FailureModel = PLAIN, waits: int = 0) -> PathChances:
    """Probabilities of one robot alone among moving threats, for every step, waits included.

    `waits`: steps after its last move before it gives up.
    """
    moves = robot.entered
    path = np.pad(robot.path[: moves[-1] + 1], (0, waits), mode="edge")
    own = chances_along(robot, _met(robot, world), failure_model)
    passed = np.ones(len(path))
    passed[moves] = 1.0 - own.threat
    passed *= passed_moving_threats(path, world)
    first = np.zeros(len(path), dtype=np.bool_)
    first[moves[own.first]] = True
    reach = np.concatenate([[1.0], np.cumprod(passed)[:-1]])
    return PathChances(np.arange(len(path)), path, 1.0 - passed, reach, first)


def _met(robot: RobotPlan, world: World) -> NDArray[np.float64]:
    """float64 `[E]`: true p of each entry of its path, in the phase of its step."""
    steps = robot.entered
    return world.by_phase.ravel()[world.visits(robot.path[steps], steps)].astype(np.float64)


def chances_of(plan: Plan, world: World) -> list[PathChances]:
    """`robot_chances` of every robot. From a mission state, lost robots stay lost, and the first cell costs nothing."""
    return _all_along(plan, _known_threats(plan, world))


def _all_along(plan: Plan, threats: list[NDArray[np.float64]]) -> list[PathChances]:
    """`chances_along` of every robot, with the `threats` of its entries."""
    pairs = enumerate(zip(plan.robots, threats, strict=True))
    return [chances_along(robot, threat, plan.failure_model, number) for number, (robot, threat) in pairs]


def _known_threats(plan: Plan, world: World) -> list[NDArray[np.float64]]:
    """p of each entry of each robot on a known map, float64 `[E]`."""
    own = world.of_robots(plan.failure_model.types, len(plan.robots))
    threats = [_met(robot, of) for robot, of in zip(plan.robots, own, strict=True)]
    for threat, its in zip(threats, () if plan.state is None else plan.state.robots, strict=False):
        threat[0] = 0.0 if its.alive else 1.0
    return threats


@dataclass(frozen=True, eq=False)
class OpenLoopExact:
    """Exact values of the open loop, in cells and probabilities; NaN if unknown (`open_loop_exact`).

    Attributes:
        visited_by_cell, survived_by_cell: float64 `[N]`, probability that the cell is covered, in each meaning.
        delivered_by_cell: float64 `[N]`, probability that it is delivered; NaN without bases, or from a mission state.
        visited_curve, survived_curve: float64 `[T + 1]`, expected cells covered by the end of each step.
        stops_by_cell: float64 `[N]`, expected robots lost in each cell.
        survival: float64 `[K]`, eq. (1).
        alive_chance: float64 `[K + 1]`, probability that so many robots finish.
        time_chance: float64 `[T + 1]`, probability that the last move of a live robot is made at that step.
        losses_curve: float64 `[T + 1]`, expected robots lost by the end of each step.
    """

    visited_by_cell: NDArray[np.float64]
    survived_by_cell: NDArray[np.float64]
    delivered_by_cell: NDArray[np.float64]
    visited_curve: NDArray[np.float64]
    survived_curve: NDArray[np.float64]
    stops_by_cell: NDArray[np.float64]
    survival: NDArray[np.float64]
    alive_chance: NDArray[np.float64]
    time_chance: NDArray[np.float64]
    losses_curve: NDArray[np.float64]
    json_keys = "visited survived delivered alive losses=expected_losses time=mean_time"

    @property
    def alive(self) -> float:
        """Expected number of robots that finish their paths."""
        return float(self.survival.sum())

    @property
    def is_known(self) -> bool:
        """Whether the expected coverage is known."""
        return bool(np.isfinite(self.visited))

    @property
    def visited(self) -> float:
        """Expected number of cells visited."""
        return float(self.visited_by_cell.sum())

    @property
    def survived(self) -> float:
        """Expected number of cells that some robot entered and survived."""
        return float(self.survived_by_cell.sum())

    @property
    def delivered(self) -> float:
        """Expected number of cells delivered (SPEC section 19)."""
        return float(self.delivered_by_cell.sum())

    @property
    def some_left(self) -> float:
        """Probability that some robot finishes. A sum: 1 - P(none) would lose values below 1e-16."""
        return float(self.alive_chance[1:].sum())

    @property
    def expected_losses(self) -> float:
        """Expected number of robots lost before the end of their path."""
        return float((1.0 - self.survival).sum())

    @property
    def mean_time(self) -> float:
        """Expected step of the last move of a live robot."""
        return float(self.time_chance @ np.arange(len(self.time_chance)))

    def by_deadline(self, deadline: int) -> tuple[float, float]:
        """Expected cells (visited, survived) by the end of step `deadline`."""
        step = min(deadline, len(self.visited_curve) - 1)
        return float(self.visited_curve[step]), float(self.survived_curve[step])

    def losses_by(self, deadline: int) -> float:
        """Expected robots lost by the end of step `deadline`."""
        return float(self.losses_curve[min(deadline, len(self.losses_curve) - 1)])


FIELDS = tuple(field.name for field in fields(OpenLoopExact))


def open_loop_exact(plan: Plan, world: World) -> OpenLoopExact:
    """The closed form `P(cell c covered) = 1 - prod_i (1 - S_i(c))` and its consequences for independent robots.

    `S_i(c)` is the probability that robot i makes its first entry of c (`visited`), or survives it (`survived`).
    Cost: linear in the total length of the paths.

    - One of several maps: the mean over the maps; NaN for several robots on maps drawn by level.
    - Persistent hazards: inclusion-exclusion over sets of robots (`_joint`); NaN for consumed hazards in shared cells.
    - Moving threats make robots dependent: known for one robot, on maps that are not too large (`chances_among`).
    - Phases: p of an entry is that of its step.
    - Lost robots that block cells make robots dependent: NaN for several.
    - Robots that do not know the map meet the true map; NaN for a robot that would drive into an obstacle.

    Source: docs/spec.md, section 6.
    """
    if plan.settings is not None and plan.settings.blocks and len(plan.robots) > 1:
        return _of_each_alone(plan, world)
    if world.moving_threats is not None and len(plan.robots) == 1 and is_worth_it(world, plan.makespan):
        waits = max(plan.time - plan.makespan, 0)  # external plans have no waits
        one = chances_among(plan.robots[0], world, plan.failure_model, waits)
        return exact_of(plan, [one], world.threat.size)
    uncertainty, plain = world.uncertainty, plan.failure_model.is_plain
    if world.phases is not None or (uncertainty is None and world.knowledge is None):
        maps = [_known_threats(plan, world)]
    elif isinstance(uncertainty, Hazard):
        shared = _shared(plan, uncertainty)
        if plain and len(shared) and uncertainty.kind == "persistent":
            return _exact_joint(plan, uncertainty, shared) or _of_each_alone(plan, world)
        maps = [alone(plan, world)] if plain and not len(shared) else []
    elif isinstance(uncertainty, Uncertain) and uncertainty.whole:
        true = map(uncertainty.threat_at, range(uncertainty.count))
        maps = [[_entered(threat, robot) for robot in plan.robots] for threat in true]
    else:
        # Robots on maps drawn by level are dependent, unless none can be lost.
        draws, alike = world.draws, plain and len(plan.robots) == 1
        safe = plain and draws is not None and not any(draws.bound[robot.path].any() for robot in plan.robots)
        known = draws is not None and (alike or safe)
        maps = [alone(plan, world)] if known or uncertainty is None else []
    if not maps:
        return _of_each_alone(plan, world)
    sums: dict[str, NDArray[np.float64]] = {}
    for threats in maps:
        found = exact_of(plan, _all_along(plan, threats), world.threat.size)
        sums = {name: sums.get(name, 0.0) + getattr(found, name) * (1 / len(maps)) for name in FIELDS}
    return OpenLoopExact(**sums)


Survive = Callable[[Iterable[int], Iterable[int]], NDArray[np.float64]]
"""P(all robots of a set survive their first entries), float64 `[2**n]`; bit i of a set is the i-th robot."""


def _joint(plan: Plan, hazard: Hazard, shared: NDArray[np.int64]) -> Survive:
    """Joint survival of robots on given paths among persistent hazards; `shared`: int64 `[S]`, cells of several robots.

    A hazard destroys none of m entries with probability 1 - q + q (1 - h)**m, and hazards are independent.
    """
    elsewhere = hazard.q.copy()
    elsewhere.ravel()[shared] = 0
    q, h = (of.ravel()[shared].astype(np.float64) for of in (hazard.q, hazard.h))
    # Of each robot: survival of its first e entries outside the shared cells, and how often they enter each shared one.
    own = [np.append(1.0, np.cumprod(1.0 - _by_hazard(robot, elsewhere, hazard.h))) for robot in plan.robots]
    enters = (robot.path[robot.entered][:, None] == shared for robot in plan.robots)
    often = [np.pad(np.cumsum(each, axis=0), ((1, 0), (0, 0))) for each in enters]

    def survive(robots: Iterable[int], entries: Iterable[int]) -> NDArray[np.float64]:
        total, times = np.ones(1), np.zeros((1, len(shared)), dtype=np.int64)
        for robot, made in zip(robots, entries, strict=True):
            total = np.append(total, total * own[robot][made])
            times = np.append(times, times + often[robot][made], axis=0)
        some = times.any(axis=0)
        return np.asarray(total * (1 - q[some] + q[some] * (1 - h[some]) ** times[:, some]).prod(axis=1))

    return survive


def _firsts(together: NDArray[np.float64]) -> Iterator[float]:
    """P(the event of robot m, and of none before it), m = 0, 1, ..., from P(the events of a set of robots) `[2**n]`.

    Inclusion-exclusion, a robot at a time: every difference is a probability, so none loses digits.
    """
    while len(together) > 1:
        yield float(together[1])
        together = together[::2] - together[1::2]


def _exact_joint(plan: Plan, hazard: Hazard, shared: NDArray[np.int64]) -> OpenLoopExact | None:
    """Exact values of robots among persistent hazards, of which they share cells; None: too many sets of robots."""
    survive = _joint(plan, hazard, shared)
    robots = [chances_along(robot, _by_hazard(robot, hazard.q, hazard.h)) for robot in plan.robots]
    count, horizon = len(robots), 1 + max(int(robot.steps[-1]) for robot in robots)
    who = np.concatenate([np.full(int(r.first.sum()), number) for number, r in enumerate(robots)])
    cell, step = (np.concatenate([getattr(r, name)[r.first] for r in robots]) for name in ("cells", "steps"))
    made = np.concatenate([np.flatnonzero(r.first) for r in robots])
    delivers = np.concatenate(_deliveries(plan, robots))
    of_meanings = made, made + 1, np.where(delivers >= 0, delivers + 1, -1)
    order = np.lexsort((step, cell))
    begins = np.append(np.flatnonzero(np.diff(cell[order], prepend=-1)), len(cell))
    running = (np.array([r.steps[-1] for r in robots]) > np.arange(horizon)[:, None]).sum(axis=1)
    if float((2.0 ** np.diff(begins)).sum() + (2.0**running).sum() + 2.0**count) * len(shared) > MOST_TERMS:
        return None
    by_cell, curves = np.zeros((3, hazard.q.size)), np.zeros((3, horizon))
    for group in np.split(order, begins[1:-1]):
        for meaning, entries in enumerate(of_meanings):
            able = group[entries[group] >= 0]
            gains = list(_firsts(survive(who[able], entries[able])))
            by_cell[meaning, cell[group[0]]] = math.fsum(gains)
            np.add.at(curves[meaning], step[able], gains)
    exactly = survive(range(count), (len(r.cells) for r in robots)).reshape([2] * count)
    for axis in range(count):
        some, all_ = np.moveaxis(exactly, axis, 0)
        some -= all_
    at_most = np.ones(horizon)
    for time in range(horizon):
        late = [number for number, robot in enumerate(robots) if robot.steps[-1] > time]
        passed = [int(np.searchsorted(robots[number].steps, time, "right")) for number in late]
        at_most[time] -= math.fsum(_firsts(survive(late, passed)))
    return replace(
        exact_of(plan, robots, hazard.q.size),
        visited_by_cell=by_cell[0],
        survived_by_cell=by_cell[1],
        delivered_by_cell=by_cell[2] if plan.bases and plan.state is None else np.full_like(by_cell[2], np.nan),
        visited_curve=np.cumsum(curves[0]),
        survived_curve=np.cumsum(curves[1]),
        alive_chance=np.bincount(np.bitwise_count(np.arange(2**count)), exactly.ravel()).astype(np.float64),
        time_chance=np.diff(at_most, prepend=0.0),
    )


def coverage_gradient(plan: Plan, world: World) -> NDArray[np.float64]:
    """d E[cells visited] / d p of every cell, `[H, W]`, 0 or below, for robots on unchanged paths.

    The probability of an entry has the factor 1 - p for each earlier visit of the cell by the robot. A larger p costs
    the later cells that no other robot covers. Weibull shape and hazard multipliers are ignored.
    """
    robots = [chances_along(robot, _entered(world.threat, robot)) for robot in plan.robots]
    missed = np.ones((len(robots), world.threat.size))
    for mine, robot in zip(missed, robots, strict=True):
        mine[robot.cells[robot.first]] -= robot.reach[robot.first]
    gradient = np.zeros(world.threat.size)
    for one, robot in enumerate(robots):
        others = np.delete(missed, one, axis=0).prod(axis=0)
        alone = np.where(robot.first, robot.reach * others[robot.cells], 0.0)
        ahead = np.cumsum(alone[::-1])[::-1] - alone
        np.add.at(gradient, robot.cells, -ahead / (1.0 - robot.threat))
    return gradient.reshape(world.shape)


def _of_each_alone(plan: Plan, world: World) -> OpenLoopExact:
    """The values that hold for each robot alone; a consumed hazard couples robots. NaN elsewhere."""
    robots = [chances_along(robot, threat) for robot, threat in zip(plan.robots, alone(plan, world), strict=True)]
    found = exact_of(plan, robots, world.threat.size)
    consumed = isinstance(world.uncertainty, Hazard) and world.uncertainty.kind == "consumed"
    of_each = ("stops_by_cell", "survival", "losses_curve")
    kept = () if consumed or world.moving_threats is not None or not plan.failure_model.is_plain else of_each
    values = {name: getattr(found, name) for name in FIELDS}
    return OpenLoopExact(**{name: of if name in kept else np.full_like(of, np.nan) for name, of in values.items()})


def exact_of(plan: Plan, robots: list[PathChances], cells: int) -> OpenLoopExact:
    """Exact values of independent robots, from the probabilities along their paths."""
    horizon, state, none = 1 + max(int(r.steps[-1]) for r in robots), plan.state, np.zeros(0, dtype=np.int64)
    before = (none, none) if state is None else (state.visited, state.survived)
    turns = _turns(robots, before[0])
    delivered = np.full(cells, np.nan)
    if plan.bases and state is None:
        back = zip(robots, _deliveries(plan, robots), strict=True)
        delivered, _ = _coverage(turns, [np.append(r.passed, 0.0)[entry] for r, entry in back], cells, horizon)
    visited, visited_gain = _coverage(turns, [r.reach[r.first] for r in robots], cells, horizon)
    turns = turns if state is None else _turns(robots, before[1])
    survived, survived_gain = _coverage(turns, [r.passed[r.first] for r in robots], cells, horizon)
    first = 0 if state is None else 1
    stopped = [(robot.reach * robot.threat)[first:] for robot in robots]
    at = [robot.cells[first:] for robot in robots]
    stops = np.bincount(np.concatenate(at), np.concatenate(stopped), cells).astype(np.float64)
    survival = np.array([robot.survival for robot in robots])
    steps = np.concatenate([robot.steps for robot in robots])
    lost = np.bincount(steps, np.concatenate([robot.reach * robot.threat for robot in robots]), horizon)
    return OpenLoopExact(
        visited_by_cell=visited,
        survived_by_cell=survived,
        delivered_by_cell=delivered,
        visited_curve=np.cumsum(visited_gain),
        survived_curve=np.cumsum(survived_gain),
        stops_by_cell=stops,
        survival=survival,
        alive_chance=poisson_binomial(survival),
        time_chance=_time_chance(robots, horizon),
        losses_curve=np.cumsum(lost),
    )


def _deliveries(plan: Plan, robots: list[PathChances]) -> list[NDArray[np.int64]]:
    """Of the first entry of each cell, by robot: the entry of a base at which it is delivered; -1 if there is none."""
    found = []
    for robot, bases in zip(robots, plan.bases or [set()] * len(robots), strict=True):
        at_base = np.flatnonzero(np.isin(robot.cells, list(bases)))
        found.append(np.append(at_base, -1)[np.searchsorted(at_base, np.flatnonzero(robot.first))])
    return found


Turn = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
"""Cells, steps and positions of the first entries that are the n-th robot's of their cell."""


def _turns(robots: list[PathChances], before: NDArray[np.int64]) -> tuple[int, list[Turn]]:
    """The number of cells covered `before` step 0, and the first entries of every cell, in order of time."""
    cell = np.concatenate([before, *(r.cells[r.first] for r in robots)])
    step = np.concatenate([np.full(len(before), -1), *(r.steps[r.first] for r in robots)])
    order = np.lexsort((step, cell))
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    turn = np.arange(len(cell)) - np.repeat(begins, np.diff(begins, append=len(cell)))
    each = (order[turn == visitor] for visitor in range(int(turn.max()) + 1))
    return len(before), [(cell[now], np.maximum(step[now], 0), now) for now in each]


def _coverage(
    turns: tuple[int, list[Turn]], chances: list[NDArray[np.float64]], cells: int, horizon: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(probability of each cell `[N]`, expected new cells of each step `[T + 1]`) from the robots' first entries."""
    before, of_each = turns
    chance = np.concatenate([np.ones(before), *chances])
    covered, missed, gain = np.zeros(cells), np.ones(cells), np.zeros(horizon)
    for cell, step, now in of_each:
        new = missed[cell] * chance[now]
        np.add.at(gain, step, new)
        covered[cell] += new  # 1 - missed would lose values below 1e-16
        missed[cell] *= 1.0 - chance[now]
    return np.minimum(covered, 1.0), gain


def _time_chance(robots: list[PathChances], horizon: int) -> NDArray[np.float64]:
    """Distribution of the last step at which a live robot moves: the maximum over independent robots."""
    at_most = np.ones(horizon)
    for robot in robots:
        ends = np.bincount(robot.steps, robot.reach * robot.threat, horizon)
        ends[robot.steps[-1]] += robot.survival
        at_most *= np.cumsum(ends)
    return np.diff(at_most, prepend=0.0)


def poisson_binomial(chances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distribution of the number of successes, float64 `[K + 1]`, of independent trials with `chances` `[K]`."""
    pmf = np.zeros(len(chances) + 1)
    pmf[0] = 1.0
    for chance in chances:
        pmf[1:] = pmf[1:] * (1.0 - chance) + pmf[:-1] * chance
        pmf[0] *= 1.0 - chance
    return pmf


# The value of cells: the open loop's exact expected value covered and found, per cell (SPEC section 13).


@dataclass(frozen=True, eq=False)
class CellValues:
    """Value and detection probability of the cells of a map, also of unreachable ones. Axis `N` = H * W cells.

    Attributes:
        value: float64 `[N]`. detect: float64 `[N]`, probability that a survived visit finds the content of the cell.
    """

    value: NDArray[np.float64]
    detect: NDArray[np.float64]

    @classmethod
    def of(cls, world: World) -> CellValues:
        """The world's values and detection probabilities; the default is 1 for free cells, 0 for obstacles."""
        free = world.free
        value, detect = (layer if layer is not None else free.astype(float) for layer in (world.value, world.detect))
        return cls(value.ravel(), detect.ravel())

    @property
    def is_plain(self) -> bool:
        """Whether further survived visits of a cell add nothing: its detection is 0 or 1, or its value 0."""
        return bool((((self.detect == 0) | (self.detect == 1)) | (self.value == 0)).all())

    @property
    def total(self) -> float:
        """Value of all free cells."""
        return float(self.value.sum())


def open_loop_found(plan: Plan, world: World) -> NDArray[np.float64]:
    """P(found in c) of the open loop, float64 `[N]`: probability that the content of the cell is found.

    `P(found in c) = 1 - prod_i E[(1 - d)^(N_i)]`, N_i the survived visits of c by robot i, because robots are
    independent and every survived visit detects with d independently. N_i >= j iff the robot survives its j-th entry of
    c, which has probability s_ij. So
    `E[(1 - d)^(N_i)] = 1 - sum_j s_ij ((1 - d)^(j - 1) - (1 - d)^j) = 1 - d sum_j s_ij (1 - d)^(j - 1)`.

    Source: docs/spec.md, section 13.
    """
    detect = CellValues.of(world).detect
    total, missed = np.zeros(world.threat.size), np.ones(world.threat.size)
    for robot in chances_of(plan, world):
        order = np.argsort(robot.cells, kind="stable")
        cells = robot.cells[order]
        first = np.flatnonzero(np.diff(cells, prepend=-1))
        turn = np.arange(len(cells)) - np.repeat(first, np.diff(first, append=len(cells)))
        found = np.zeros(world.threat.size)
        np.add.at(found, cells, detect[cells] * robot.passed[order] * (1.0 - detect[cells]) ** turn)
        total += missed * found  # 1 - missed would lose values below 1e-16
        missed *= 1.0 - found
    return np.minimum(total, 1.0)
