"""Exact expected values of the open loop: the closed form of SPEC section 6, per cell, per robot and over time.

The oracle of the rollouts: it shares plain types with them and nothing else. Axis letters: `K` robots, `N` = H * W
cells, `T` the makespan.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from planner.failure_model import PLAIN, Bearing
from planner.plan.plan import Plan, RobotPlan
from planner.world.moving_threats import ANYWHERE, Mover, Movers, Phases
from planner.world.uncertain_maps import Hazard, Uncertain
from planner.world.world import World

# What stops robots on their paths where hazards are there or not, or the map is one of several (SPEC section 13).
#
# Given what is true the robots of an open loop are independent. So its exact values are those of a few *ways* that the
# world may be, weighted: each is a chance for every entry of every path, given that it is made. Axis `E` = entries.
#
# One robot alone needs no ways. With m earlier entries of its own, survived, into a cell with the chances q and h, the
# hazard is there with q (1 - h)**m / (1 - q + q (1 - h)**m): the entry stops it with h times that.

MOST_SHARED = 10
"""Dangerous cells on the ways of several robots up to which every pattern of hazards is looked at."""


@dataclass(frozen=True, eq=False)
class Way:
    """One way that the world may be: its chance, and per robot float64 `[E]`, what each entry stops it with."""

    chance: float
    threats: list[NDArray[np.float64]]


def ways(plan: Plan, world: World) -> Iterator[Way] | None:
    """Every way that matters for the plan; None where there are too many, or robots are not independent given one.

    The map is one of M: M ways. Hazards: the patterns of those that several robots meet, if these are few; `consumed`,
    none of them may be, and by level there may be one robot. Threats that move or change: none.
    """
    doubt = world.doubt
    if isinstance(doubt, Movers | Phases):
        return None
    if doubt is None or world.draws is None or not any(world.draws.bound[robot.path].any() for robot in plan.robots):
        return iter([Way(1.0, [_entered(world.met, robot) for robot in plan.robots])])
    if isinstance(doubt, Uncertain):
        if doubt.whole:
            maps = map(doubt.threat_at, range(doubt.count))
            return (Way(1.0 / doubt.count, [_entered(threat, robot) for robot in plan.robots]) for threat in maps)
        return iter([Way(1.0, alone(plan, world))]) if len(plan.robots) == 1 else None
    shared = _shared(plan, doubt)
    if len(shared) > (MOST_SHARED if doubt.kind == "persistent" else 0):
        return None
    return _patterns(plan, doubt, shared)


def alone(plan: Plan, world: World) -> list[NDArray[np.float64]]:
    """Of each robot, as if there were no other, float64 `[E]`: what each entry stops it with, given that it is made."""
    doubt = world.doubt
    if isinstance(doubt, Uncertain):
        return [_by_level(robot, doubt) for robot in plan.robots]
    if isinstance(doubt, Hazard):
        return [_by_hazard(robot, doubt.q, doubt.h) for robot in plan.robots]
    return [_entered(world.met, robot) for robot in plan.robots]


def _entered(values: NDArray[np.float32], robot: RobotPlan) -> NDArray[np.float64]:
    """float64 `[E]`: the value of each cell entered."""
    return values.ravel()[robot.path[robot.entered]].astype(np.float64)


def _by_hazard(robot: RobotPlan, q: NDArray[np.float32], h: NDArray[np.float32]) -> NDArray[np.float64]:
    """See the module's docstring."""
    cells, there, hit = robot.path[robot.entered], _entered(q, robot), _entered(h, robot)
    order = np.argsort(cells, kind="stable")
    begins = np.concatenate([[True], cells[order][1:] != cells[order][:-1]])
    place = np.arange(len(cells))
    before = np.empty(len(cells), dtype=np.int64)
    before[order] = place - np.maximum.accumulate(np.where(begins, place, 0))
    still = there * (1 - hit) ** before
    left = 1 - there + still
    return hit * np.divide(still, left, out=np.zeros_like(still), where=left > 0)


def _by_level(robot: RobotPlan, doubt: Uncertain) -> NDArray[np.float64]:
    """The levels' maps are drawn apart, so a robot's chance to get so far is a product of means over each level's."""
    cells = robot.path[robot.entered]
    number, column = doubt.number.ravel()[cells], doubt.column.ravel()[cells]
    reach = np.ones(len(cells) + 1)
    for one in np.unique(number):
        passed = np.where(number == one, 1.0 - doubt.chances[:, column].astype(np.float64), 1.0)
        reach[1:] *= np.cumprod(passed, axis=1).mean(axis=0)
    return 1.0 - reach[1:] / reach[:-1]


def _shared(plan: Plan, hazard: Hazard) -> NDArray[np.int64]:
    """Cells in which several robots may meet a hazard that may or may not be there, int64."""
    mine = [np.unique(robot.path[robot.entered]) for robot in plan.robots]
    cells, robots = np.unique(np.concatenate(mine), return_counts=True)
    doubtful = hazard.q.ravel()[cells] < 1  # else every visit of a persistent one is drawn for itself
    return cells[(robots > 1) & (hazard.threat.ravel()[cells] > 0) & (doubtful | (hazard.kind == "consumed"))]


def _patterns(plan: Plan, hazard: Hazard, shared: NDArray[np.int64]) -> Iterator[Way]:
    """The hazards of the shared cells there or not, in every pattern."""
    chances = hazard.q.ravel()[shared].astype(np.float64)
    for pattern in itertools.product((False, True), repeat=len(shared)):
        there = np.array(pattern, dtype=bool)
        q = hazard.q.copy()
        q.ravel()[shared] = there
        threats = [_by_hazard(robot, q, hazard.h) for robot in plan.robots]
        yield Way(float(np.where(there, chances, 1 - chances).prod()), threats)


# What a robot on a given path survives among threats that move: the forward algorithm of each (SPEC section 16).
#
# Given the path movers are independent, and so is what they do to the robot: its survival is the product of what it
# survives of each. For a mover it carries the chance that the robot is not stopped by it and the mover is there; every
# step the mover moves, and of its chance to be where the robot is h is lost. Axis `T` = steps of the path.

SIDES = ((-1, 0), (0, -1), (0, 1), (1, 0))
MOST_WORK = 3 * 10**8
"""Cells times steps times kinds of walkers that are worth it: some seconds."""


def is_worth_it(world: World, steps: int) -> bool:
    """Whether `passed_movers` of a path of so many steps is."""
    assert world.movers is not None
    kinds = {mover for mover in world.movers.members if not mover.patrols}
    return len(kinds) * world.threat.size * steps <= MOST_WORK


def passed_movers(path: NDArray[np.int64], world: World) -> NDArray[np.float64]:
    """float64 `[T]`: the chance that no mover stops a robot at a step of its path `[T]`, if none did before.

    Cost O(T N) for each kind of walker, O(T L) for each kind of patrol.
    """
    passed, known = np.ones(len(path)), {}
    assert world.movers is not None
    for mover in world.movers.members:
        if mover not in known:
            known[mover] = _passed_patrol(path, mover) if mover.patrols else _passed_walker(path, mover, world)
        passed *= known[mover]
    return passed


def _passed_patrol(path: NDArray[np.int64], mover: Mover) -> NDArray[np.float64]:
    route = np.array(mover.route)
    chance = np.full(len(route), 1.0 / len(route))
    if mover.start != ANYWHERE:
        chance = (np.arange(len(route)) == mover.place).astype(np.float64)
    left = np.ones(len(path) + 1)
    for step, cell in enumerate(path):
        chance = np.roll(chance, 1)
        chance[route == cell] *= 1.0 - mover.hit
        left[step + 1] = chance.sum()
    return _ratios(left)


def _passed_walker(path: NDArray[np.int64], mover: Mover, world: World) -> NDArray[np.float64]:
    free, (height, width) = world.free, world.shape
    around = np.pad(free, 1)

    def beside(padded: NDArray, side: tuple[int, int]) -> NDArray:
        return padded[1 + side[0] : 1 + side[0] + height, 1 + side[1] : 1 + side[1] + width]

    ways = sum(beside(around, side).astype(np.int64) for side in SIDES)
    stays = np.where(ways == 0, 1.0, mover.stay)
    goes = np.where(free, (1.0 - stays) / np.maximum(ways, 1), 0.0)
    if mover.start == ANYWHERE:
        weight = np.where(free, np.maximum(ways, 1), 0)
        chance = weight / weight.sum()
    else:
        chance = (np.arange(free.size) == mover.start).astype(np.float64).reshape(free.shape)
    left, gone = np.ones(len(path) + 1), np.zeros((height + 2, width + 2))
    for step, cell in enumerate(path):
        gone[1:-1, 1:-1] = chance * goes
        chance = np.where(free, chance * stays + sum(beside(gone, side) for side in SIDES), 0.0)
        chance.flat[cell] *= 1.0 - mover.hit
        left[step + 1] = chance.sum()
    return _ratios(left)


def _ratios(left: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is left of each step's chance, of `left` `[T + 1]`; 0 once nothing is."""
    return np.divide(left[1:], left[:-1], out=np.zeros(len(left) - 1), where=left[:-1] > 0)


@dataclass(frozen=True, eq=False)
class RobotChances:
    """What can happen to one robot that follows its path alone. Axis `E` = entries of its path (waits left out).

    Attributes:
        steps, cells: int64 `[E]`, when and which cell is entered, the start at t = 0 first.
        threat: float64 `[E]`, chance to be stopped there if it is entered: p of that cell, unless what robots bear
            is not plain (`planner.failure_model`).
        reach: float64 `[E]`, chance to enter it: the product of (1 - threat) over the entries before.
        first: bool `[E]`, True at the first entry of each cell.
    """

    steps: NDArray[np.int64]
    cells: NDArray[np.int64]
    threat: NDArray[np.float64]
    reach: NDArray[np.float64]
    first: NDArray[np.bool_]

    @property
    def passed(self) -> NDArray[np.float64]:
        """float64 `[E]`, chance to enter the cell and not be stopped there."""
        return self.reach * (1.0 - self.threat)

    @property
    def survival(self) -> float:
        """Eq. (1): chance that the robot finishes its path."""
        return float(self.passed[-1])


def robot_chances(robot: RobotPlan, world: World, bearing: Bearing = PLAIN, number: int = 0) -> RobotChances:
    """The chances along the path of robot `number`, in float64 from the world's float32 probabilities.

    Raises WorldError.
    """
    world.check_settled("what a robot survives by eq. (1)")
    threat = world.threat.ravel()[robot.path[robot.entered]].astype(np.float64)
    return chances_along(robot, threat, bearing, number)


def chances_along(
    robot: RobotPlan, threat: NDArray[np.float64], bearing: Bearing = PLAIN, number: int = 0
) -> RobotChances:
    """The same, where each entry stops the robot with the chance `threat` `[E]` if it is made, and it bears nothing.

    What it has borne by an entry: `-sum ln(1 - threat)`, of which it survives `Bearing.survival` (SPEC section 14).
    """
    steps = robot.entered
    cells = robot.path[steps]
    if not bearing.is_even:
        with np.errstate(divide="ignore"):
            left = bearing.survival(np.cumsum(-np.log1p(-threat)), number)
        reach = np.concatenate([[1.0], left[:-1]])
        threat = 1.0 - np.divide(left, reach, out=np.zeros_like(left), where=reach > 0)
    reach = np.concatenate([[1.0], np.cumprod(1.0 - threat)[:-1]])
    return RobotChances(steps, cells, threat, reach, _first_of_each(cells))


def _first_of_each(cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """bool `[E]`: True at the first of equal cells."""
    places, first = np.arange(len(cells)), np.zeros(int(cells.max()) + 1, dtype=np.int64)
    first[cells[::-1]] = places[::-1]  # of equal cells the last that is written stays
    return first[cells] == places


def chances_among(robot: RobotPlan, world: World, bearing: Bearing = PLAIN, waits: int = 0) -> RobotChances:
    """The chances of one robot alone, where threats move: of every step, waits too (`theory.moving`).

    `waits`: steps after its last move before it gives up.
    """
    moves = robot.entered
    path = np.pad(robot.path[: moves[-1] + 1], (0, waits), mode="edge")
    own = chances_along(robot, _met(robot, world), bearing)
    passed = np.ones(len(path))
    passed[moves] = 1.0 - own.threat
    passed *= passed_movers(path, world)
    first = np.zeros(len(path), dtype=np.bool_)
    first[moves[own.first]] = True
    reach = np.concatenate([[1.0], np.cumprod(passed)[:-1]])
    return RobotChances(np.arange(len(path)), path, 1.0 - passed, reach, first)


def _met(robot: RobotPlan, world: World) -> NDArray[np.float64]:
    """float64 `[E]`: p of each entry of its path, when it is made."""
    steps = robot.entered
    return world.by_phase.ravel()[world.visits(robot.path[steps], steps)].astype(np.float64)


def chances_of(plan: Plan, world: World) -> list[RobotChances]:
    """`robot_chances` of every robot. Who goes on from a state has entered its cell before; who was lost stays lost."""
    if plan.state is None:
        own = world.of_robots(plan.bearing.types, len(plan.robots))
        return [robot_chances(robot, own[number], plan.bearing, number) for number, robot in enumerate(plan.robots)]
    world.check_settled("what a robot survives by eq. (1)")
    begun = []
    for number, (robot, its) in enumerate(zip(plan.robots, plan.state.robots, strict=True)):
        threat = world.threat.ravel()[robot.path[robot.entered]].astype(np.float64)
        threat[0] = 0.0 if its.alive else 1.0
        begun.append(chances_along(robot, threat, plan.bearing, number))
    return begun


@dataclass(frozen=True, eq=False)
class OpenLoopExact:
    """The open loop's exact values, in cells and probabilities; NaN what is not known (`open_loop_exact`).

    Attributes:
        visited_by_cell, survived_by_cell: float64 `[N]`, chance that the cell is covered, in each meaning.
        visited_curve, survived_curve: float64 `[T + 1]`, expected cells covered by the end of each step.
        stops_by_cell: float64 `[N]`, expected robots lost in each cell.
        survival: float64 `[K]`, eq. (1).
        alive_chance: float64 `[K + 1]`, chance that so many robots finish.
        time_chance: float64 `[T + 1]`, chance that the last move of a live robot is made at that step.
        losses_curve: float64 `[T + 1]`, expected robots lost by the end of each step.
    """

    visited_by_cell: NDArray[np.float64]
    survived_by_cell: NDArray[np.float64]
    visited_curve: NDArray[np.float64]
    survived_curve: NDArray[np.float64]
    stops_by_cell: NDArray[np.float64]
    survival: NDArray[np.float64]
    alive_chance: NDArray[np.float64]
    time_chance: NDArray[np.float64]
    losses_curve: NDArray[np.float64]

    @property
    def is_known(self) -> bool:
        """Whether coverage is."""
        return bool(np.isfinite(self.visited))

    @property
    def visited(self) -> float:
        """Expected cells visited."""
        return float(self.visited_by_cell.sum())

    @property
    def survived(self) -> float:
        """Expected cells entered by a robot that was not stopped there."""
        return float(self.survived_by_cell.sum())

    @property
    def some_left(self) -> float:
        """Chance that some robot finishes: a sum, as 1 minus the chance that none does would lose all below 1e-16."""
        return float(self.alive_chance[1:].sum())

    @property
    def expected_losses(self) -> float:
        """Expected robots stopped before the end of their path."""
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
    """The closed form `P(cell c covered) = 1 - prod_i (1 - S_i(c))` and what follows from independence.

    `S_i(c)` is the chance that robot i gets as far as its first entry of c, before that entry's own hit check for
    `visited` and after it for `survived`. Cost: linear in the total length of the paths. Where the map is in doubt: the
    mean over the ways that it may be (`theory.doubt`); where they are too many, NaN in all that is not known. Where
    threats move robots are not independent: known of one robot alone, on maps that are not too large (`chances_among`).
    Threats that change with time: p of an entry is that of its step.
    Robots that are not told the map meet the true one; NaN for who would run into an obstacle.
    """
    if world.phases is not None:
        robots = [
            chances_along(robot, _met(robot, world), plan.bearing, number) for number, robot in enumerate(plan.robots)
        ]
        return exact_of(plan, robots, world.threat.size)
    if world.doubt is None and world.knowledge is None:
        return exact_of(plan, chances_of(plan, world), world.threat.size)
    if world.movers is not None and len(plan.robots) == 1 and is_worth_it(world, plan.makespan):
        waits = max(plan.time - plan.makespan, 0)  # of paths alone there are none
        one = chances_among(plan.robots[0], world, plan.bearing, waits)
        return exact_of(plan, [one], world.threat.size)
    doubt, plain = world.doubt, plan.bearing.is_plain
    known = ways(plan, world) if plain or doubt is None or (isinstance(doubt, Uncertain) and doubt.whole) else None
    if known is None:
        return _of_each_alone(plan, world)
    sums: dict[str, NDArray[np.float64]] = {}
    for way in known:
        robots = [
            chances_along(robot, threat, plan.bearing, number)
            for number, (robot, threat) in enumerate(zip(plan.robots, way.threats, strict=True))
        ]
        found = exact_of(plan, robots, world.threat.size)
        sums = {name: sums.get(name, 0.0) + way.chance * getattr(found, name) for name in FIELDS}
    return OpenLoopExact(**sums)


def coverage_gradient(plan: Plan, world: World) -> NDArray[np.float64]:
    """d E[cells visited] / d p of every cell, `[H, W]`, for robots that go on along the same paths; 0 or below.

    A robot that enters a cell later in its path gets there with a chance that has the factor 1 - p for each visit of
    the cell before; what it covers there and nobody else does is lost with it. Of robots that wear, or are more or less
    susceptible, as if they did not, and were not.
    """
    threat = world.threat.ravel().astype(np.float64)
    robots = [chances_along(robot, threat[robot.path[robot.entered]]) for robot in plan.robots]
    missed = np.ones((len(robots), threat.size))
    for mine, robot in zip(missed, robots, strict=True):
        mine[robot.cells[robot.first]] -= robot.reach[robot.first]
    gradient = np.zeros(threat.size)
    for one, robot in enumerate(robots):
        others = np.delete(missed, one, axis=0).prod(axis=0)
        alone = np.where(robot.first, robot.reach * others[robot.cells], 0.0)
        ahead = np.cumsum(alone[::-1])[::-1] - alone
        np.add.at(gradient, robot.cells, -ahead / (1.0 - robot.threat))
    return gradient.reshape(world.shape)


def _of_each_alone(plan: Plan, world: World) -> OpenLoopExact:
    """What is known of the robots one by one: what one hits is not gone for another. NaN elsewhere."""
    robots = [chances_along(robot, threat) for robot, threat in zip(plan.robots, alone(plan, world), strict=True)]
    found = exact_of(plan, robots, world.threat.size)
    consumed = isinstance(world.doubt, Hazard) and world.doubt.kind == "consumed"
    of_each = ("stops_by_cell", "survival", "losses_curve")
    kept = () if consumed or world.movers is not None or not plan.bearing.is_plain else of_each
    return OpenLoopExact(
        **{
            name: getattr(found, name) if name in kept else np.full_like(getattr(found, name), np.nan)
            for name in FIELDS
        }
    )


def exact_of(plan: Plan, robots: list[RobotChances], cells: int) -> OpenLoopExact:
    """The exact values of robots that are independent, from the chances along their paths."""
    horizon, state, none = 1 + max(int(r.steps[-1]) for r in robots), plan.state, np.zeros(0, dtype=np.int64)
    before = (none, none) if state is None else (state.visited, state.survived)
    turns = _turns(robots, before[0])
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
        visited_curve=np.cumsum(visited_gain),
        survived_curve=np.cumsum(survived_gain),
        stops_by_cell=stops,
        survival=survival,
        alive_chance=poisson_binomial(survival),
        time_chance=_time_chance(robots, horizon),
        losses_curve=np.cumsum(lost),
    )


Turn = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
"""Cells that are covered by somebody more, at which steps, and the places of these first entries among all."""


def _turns(robots: list[RobotChances], before: NDArray[np.int64]) -> tuple[int, list[Turn]]:
    """How many cells are covered `before`, for certain and from step 0 on, and who covers each first, second, ..."""
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
    """(chance of each cell `[N]`, expected new cells of each step `[T + 1]`) from the robots' first entries."""
    before, of_each = turns
    chance = np.concatenate([np.ones(before), *chances])
    covered, missed, gain = np.zeros(cells), np.ones(cells), np.zeros(horizon)
    for cell, step, now in of_each:
        new = missed[cell] * chance[now]
        np.add.at(gain, step, new)
        covered[cell] += new  # 1 - missed would lose all below 1e-16
        missed[cell] *= 1.0 - chance[now]
    return np.minimum(covered, 1.0), gain


def _time_chance(robots: list[RobotChances], horizon: int) -> NDArray[np.float64]:
    """Distribution of the last step at which a live robot moves: the latest of independent robots."""
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


# What cells are worth: the open loop's expected value covered and found, exactly, per cell (SPEC section 13).


@dataclass(frozen=True, eq=False)
class Worth:
    """What the cells of a map are worth and show. Axis `N` = H * W cells; what nobody can reach is in them too.

    Attributes:
        value: float64 `[N]`. detect: float64 `[N]`, chance that a survived visit finds what is there.
    """

    value: NDArray[np.float64]
    detect: NDArray[np.float64]

    @classmethod
    def of(cls, world: World) -> Worth:
        """1 each where nobody said; 0 on obstacles."""
        free = world.free
        value, detect = (layer if layer is not None else free.astype(float) for layer in (world.value, world.detect))
        return cls(value.ravel(), detect.ravel())

    @property
    def is_plain(self) -> bool:
        """Whether one survived visit of a cell tells what more of them would: it finds all, or nothing, or no value."""
        return bool((((self.detect == 0) | (self.detect == 1)) | (self.value == 0)).all())

    @property
    def total(self) -> float:
        """Of all free cells."""
        return float(self.value.sum())


def open_loop_found(plan: Plan, world: World) -> NDArray[np.float64]:
    """P(found in c) of the open loop, float64 `[N]`: the chance that what is in the cell is found, if it is there.

    `P(found in c) = 1 - prod_i E[(1 - d)^(N_i)]`, N_i the survived visits of c by robot i: robots are stopped
    independently of each other, and every survived visit detects with d on its own. N_i is j or more iff the robot
    passes its j-th entry of c, which has chance s_ij: what it survives of its entries up to that one. So
    `E[(1 - d)^(N_i)] = 1 - sum_j s_ij ((1 - d)^(j - 1) - (1 - d)^j) = 1 - d sum_j s_ij (1 - d)^(j - 1)`.
    """
    detect = Worth.of(world).detect
    total, missed = np.zeros(world.threat.size), np.ones(world.threat.size)
    for number, path in enumerate(plan.robots):
        robot = robot_chances(path, world, plan.bearing, number)
        order = np.argsort(robot.cells, kind="stable")
        cells = robot.cells[order]
        first = np.flatnonzero(np.diff(cells, prepend=-1))
        turn = np.arange(len(cells)) - np.repeat(first, np.diff(first, append=len(cells)))
        found = np.zeros(world.threat.size)
        np.add.at(found, cells, detect[cells] * robot.passed[order] * (1.0 - detect[cells]) ** turn)
        total += missed * found  # 1 - missed would lose all below 1e-16
        missed *= 1.0 - found
    return np.minimum(total, 1.0)
