"""The closed loop as a tree of everything that can happen, and as a Markov chain, from the plain oracle alone."""

from __future__ import annotations

import tempfile
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from oracle_simulator import Paper, PerCell
from scipy import sparse
from scipy.sparse.linalg import spsolve

from planner.errors import PlanError
from planner.files import atomic_write
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.codes import NO_ROBOT
from planner.world.world import World

# The closed loop as a tree of everything that can happen, played by the plain oracle: exact expected values.
#
# A run is decided by which of its checked visits stop a robot. So all runs begin as one branch, and at each dangerous
# visit a branch parts in two: one in which the robot is stopped, and one in which it goes on. Branches are played
# step by step side by side, and those that come to equal states are joined. The cost grows like (dangerous visits of
# a robot) ** (robots - 1) steps. The oracle of the rollouts and of `planner.rollouts.exact_tree`; it shares no code
# with them.

Chance = Any
"""float, or what else counts chances, as Fraction (no union: nobody mixes them)."""
OUTCOMES = ("complete", "all_robots_lost", "no_progress", "step_limit", "not_worth_the_risk")
"""How rollouts of the closed loop can end; the last one is never the oracle's."""
RULES = {"mrac": Paper, "per_cell": PerCell}


def plain_run(plan: Plan, world: World) -> Paper:
    """The plan's closed loop before its first step.

    Raises PlanError of a plan for another map, ValueError of one with what the oracle knows nothing of.
    """
    settings = plan.require(world)
    asked = settings.policy, settings.transit, settings.max_steps, settings.density, settings.levels
    policy, transit, last, density, levels = asked
    plain = Settings(policy=policy, transit=transit, max_steps=last, density=density, levels=levels)
    odd = world.knowledge, world.uncertainty, world.value, world.types, world.movers, plan.state
    if settings != plain or policy not in RULES or plan.is_external or any(one is not None for one in odd):
        raise ValueError("the plain oracle knows `mrac` and `per_cell` alone, without limits, on a map that is known")
    starts = [(row, col) for row, col in plan.starts.tolist()]
    run = RULES[policy](world.threat.astype(np.float64), starts, plain_areas(plan), last, inside=transit == "area")
    if len(run.scale) > levels:
        raise ValueError("the plain oracle knows no bins of threats")
    return run


def plain_areas(plan: Plan) -> list[tuple[int, int | None, list[tuple[int, int]]]]:
    """The plan's allocation as the oracle has it."""
    width = plan.shape[1]
    return [
        (area.level, None if area.robot == NO_ROBOT else area.robot, [divmod(c, width) for c in area.cells.tolist()])
        for area in plan.areas
    ]


@dataclass(eq=False)
class Branch:
    """A run in progress. `turn`: the robot that acts next in its step. `chance`: of everything that has happened."""

    run: Paper
    turn: int
    chance: Chance


@dataclass(frozen=True)
class End:
    """A run that is over: how, and with how many cells covered, at which step, with how many robots left."""

    chance: Chance
    outcome: str
    visited: int
    survived: int
    time: int
    alive: int


class Tree:
    """A closed loop, to be played as a tree.

    Args:
        root: the run before its first step. threat: p of its cells `[H, W]`.
        first_only: `threat_checks="first_visit"`. number: what chances are counted in.

    Attributes:
        accessible: cells. robots: K. max_steps: T_max. certain: the chance 1.
    """

    def __init__(
        self, root: Paper, threat: NDArray, *, first_only: bool = False, number: Callable[[float], Chance] = float
    ) -> None:
        self._root, self._first_only, self.certain = root, first_only, number(1)
        self.accessible, self.robots, self.max_steps = len(root.goal), len(root.team), root.last
        self._threat = {cell: number(float(threat[cell])) for cell in root.goal}

    def start(self, last: int | None = None) -> Branch:
        """The run before any robot has entered its start; it is cut off at step `last`, None: T_max."""
        run = self._root.fork()
        run.last = self.max_steps if last is None else last
        return Branch(run, 0, self.certain)

    def step(self, branch: Branch) -> tuple[list[Branch], list[End]]:
        """All that can happen in the branch's next step: the branches that go on after it, and the ends.

        `branch` itself becomes the one in which nobody is stopped.
        """
        to_play, going, ends = [branch], [], []
        while to_play:
            branch = to_play.pop()
            for found in self._play(branch):
                if isinstance(found, End):
                    ends.append(found)
                else:
                    to_play.append(found)
            if branch.run.outcome:
                ends.append(self._end(branch.run, branch.chance, branch.run.outcome))
            else:
                going.append(branch)
        return going, ends

    def _play(self, branch: Branch) -> Iterator[Branch | End]:
        """The rest of the step, in which nobody is stopped; what else may happen: copies in mid-step, or ends."""
        run = branch.run
        for robot in range(branch.turn, self.robots):
            cell = run.decide(robot)
            if cell is None:
                continue
            threat = 0 if self._first_only and cell in run.visited else self._threat[cell]
            run.enter(robot)
            if threat:
                chance = branch.chance * threat
                branch.chance *= 1 - threat
                if alive(run) == 1:  # nothing follows: no copy is needed
                    outcome = "complete" if run.goal <= run.visited else "all_robots_lost"
                    yield self._end(run, chance, outcome, lost=1)
                else:
                    other = run.fork()
                    other.lose(robot)
                    yield Branch(other, robot + 1, chance)
            run.survive(robot)
        run.end_step()
        branch.turn = 0

    def _end(self, run: Paper, chance: Chance, outcome: str, lost: int = 0) -> End:
        return End(chance, outcome, len(run.visited), len(run.survived), run.step, alive(run) - lost)


def alive(run: Paper) -> int:
    """Robots not stopped so far."""
    return sum(walker.doing != "dead" for walker in run.team)


@dataclass(frozen=True, eq=False)
class ClosedLoopExact:
    """Expected values and distributions over everything that can happen. Axes: `A` accessible cells, `K` robots.

    Attributes:
        visited, survived: cells. time: steps. alive: robots.
        complete, all_robots_lost, no_progress, step_limit, not_worth_the_risk: probabilities of the outcomes.
        visited_chance, survived_chance: float64 `[A + 1]`, chance of so many cells. alive_chance: float64 `[K + 1]`,
            chance that so many robots are alive at the end. time_chance: float64 `[T + 1]`, chance that the run ends at
            that step.
        branches: played from one parting to the next. ends: reached, those of equal states counted once.
    """

    visited: float
    survived: float
    time: float
    alive: float
    complete: float
    all_robots_lost: float
    no_progress: float
    step_limit: float
    not_worth_the_risk: float
    visited_chance: NDArray[np.float64]
    survived_chance: NDArray[np.float64]
    alive_chance: NDArray[np.float64]
    time_chance: NDArray[np.float64]
    branches: int
    ends: int


def closed_loop_exact(plan: Plan, world: World, *, first_only: bool = False) -> ClosedLoopExact:
    """The closed loop's expected values and distributions (SPEC section 6; the paper's Algorithm 2).

    Args:
        plan, world: as of `plain_run`, which may raise.
        first_only: `threat_checks="first_visit"`.
    """
    return exactly(Tree(plain_run(plan, world), world.threat, first_only=first_only))


def exactly(tree: Tree) -> ClosedLoopExact:
    """The same of any run."""
    ends: list[End] = []
    branches, now = 0, [tree.start()]
    while now:
        after: list[Branch] = []
        for branch in now:
            going, over = tree.step(branch)
            branches += bool(over or len(going) > 1)
            after += going
            ends += over
        now = _joined(after)
    return _summed(ends, branches, tree)


def _joined(branches: list[Branch]) -> list[Branch]:
    """Branches of equal states as one. Only those whose robots stand alike are compared: states are long."""
    alike: defaultdict[tuple[object, ...], list[Branch]] = defaultdict(list)
    for branch in branches:
        where = tuple(walker.doing != "dead" and walker.at for walker in branch.run.team)
        alike[len(branch.run.visited), where].append(branch)
    kept: list[Branch] = []
    for group in alike.values():
        same: dict[tuple[object, ...], Branch] = {}
        for branch in group:
            one = same.setdefault(branch.run.state_key() if len(group) > 1 else (), branch)
            if one is not branch:
                one.chance += branch.chance
        kept += same.values()
    return kept


def _summed(ends: list[End], branches: int, tree: Tree) -> ClosedLoopExact:
    weights = np.array([end.chance for end in ends])
    outcomes = np.bincount([OUTCOMES.index(end.outcome) for end in ends], weights, len(OUTCOMES))
    values: dict[str, Any] = dict(zip(OUTCOMES, outcomes.tolist(), strict=True))
    cells = tree.accessible + 1
    for figure, size in (("visited", cells), ("survived", cells), ("time", 0), ("alive", tree.robots + 1)):
        chance = np.bincount([getattr(end, figure) for end in ends], weights, size)
        values |= {figure: float(chance @ np.arange(len(chance))), f"{figure}_chance": chance}
    return ClosedLoopExact(**values, branches=branches, ends=len(ends))


# The closed loop as a Markov chain: its states, equal ones merged, with what a step adds; for solvers of other hands.
#
# A state is what stands between two steps: the live robots, their areas and paths ahead, the cells covered in both
# meanings, the quiet steps. The step itself is left out where no run can reach T_max, and is part of the state where
# one can. Axis `S` = states: 0 is the team before it enters its starts, the last ones are the outcomes, which nothing
# leaves.

REWARDS = ("visited", "survived", "time", "lost")
"""Columns of `Chain.rewards`: cells covered for the first time in the two meanings, steps, robots stopped."""
ENDLESS = 2**62


@dataclass(frozen=True, eq=False)
class Chain:
    """A discrete-time Markov chain. Numbers are floats, or Fractions if it was made with `exact=True`.

    Attributes:
        moves: `[S]`, chance of each next state; the outcomes have none.
        rewards: `[S]` of 4, what one step from the state is expected to add, in the order of REWARDS.
        robots: K. timed: True if the step is part of the state.
    """

    moves: tuple[dict[int, Chance], ...]
    rewards: tuple[tuple[Chance, ...], ...]
    robots: int
    timed: bool

    @property
    def states(self) -> int:
        """S."""
        return len(self.moves)

    @property
    def inner(self) -> int:
        """States that are no outcome: the first ones."""
        return len(self.moves) - len(OUTCOMES)


@dataclass(frozen=True)
class ChainValues:
    """A chain's expected values (cells, steps, robots), and its outcomes' probabilities; Fractions if it is exact."""

    visited: Chance
    survived: Chance
    time: Chance
    alive: Chance
    complete: Chance
    all_robots_lost: Chance
    no_progress: Chance
    step_limit: Chance
    not_worth_the_risk: Chance


def closed_loop_chain(
    plan: Plan, world: World, *, first_only: bool = False, exact: bool = False, most_states: int = 200_000
) -> Chain:
    """The chain of a plan's closed loop (SPEC section 5). It has about as many states as the tree of hits has steps.

    Args:
        plan, world: as of `plain_run`. first_only: `threat_checks="first_visit"`.
        exact: chances and rewards are Fractions, exact for the float32 threats; for tiny worlds.
        most_states: more are refused.

    Raises:
        PlanError: a plan for another map, or more than `most_states` states.
    """
    number: Callable[[float], Chance] = Fraction if exact else float
    loop = Tree(plain_run(plan, world), world.threat, first_only=first_only, number=number)
    builder = _Builder(loop, most_states, timed=False)
    builder.explore()
    if builder.longest() > loop.max_steps:
        builder = _Builder(loop, most_states, timed=True)
        builder.explore()
    return builder.chain()


class _Builder:
    """Every state that can be reached, each played once. Outcomes are targets below 0 until the chain is made."""

    def __init__(self, loop: Tree, most_states: int, timed: bool) -> None:
        self.loop, self.most_states, self.timed = loop, most_states, timed
        self.number: dict[object, int] = {}
        self.moves: list[dict[int, Chance]] = []
        self.rewards: list[list[Chance]] = []
        self.waiting: deque[tuple[int, Branch]] = deque()

    def explore(self) -> None:
        self._place(self.loop.start(None if self.timed else ENDLESS))
        while self.waiting:
            self._play(*self.waiting.popleft())

    def _place(self, branch: Branch) -> int:
        """The number of the branch's state; a new one waits to be played, with chance 1."""
        step = branch.run.step if self.timed else None
        number = self.number.setdefault((step, branch.run.state_key()), len(self.number))
        if number == len(self.moves):
            if number >= self.most_states:
                raise PlanError(f"more than {self.most_states} states", expected="a smaller world or team")
            self.moves.append({})
            self.rewards.append([0] * len(REWARDS))
            self.waiting.append((number, Branch(branch.run, branch.turn, self.loop.certain)))
        return number

    def _play(self, number: int, branch: Branch) -> None:
        """One step from a state: chance and rewards of whatever its hits may be."""
        loop, steps = self.loop, int(branch.run.step > 0)
        visited, survived = len(branch.run.visited), len(branch.run.survived)
        lost = loop.robots - alive(branch.run)
        going, ends = loop.step(branch)
        for end in ends:
            gain = end.visited - visited, end.survived - survived, steps, loop.robots - end.alive - lost
            self._add(number, -1 - OUTCOMES.index(end.outcome), end.chance, gain)
        for after in going:
            by_now = len(after.run.visited) - visited, len(after.run.survived) - survived
            gain = *by_now, steps, loop.robots - alive(after.run) - lost
            self._add(number, self._place(after), after.chance, gain)

    def _add(self, number: int, target: int, chance: Chance, gain: tuple[int, ...]) -> None:
        self.moves[number][target] = self.moves[number].get(target, 0) + chance
        for reward, amount in enumerate(gain):
            self.rewards[number][reward] += chance * amount

    def longest(self) -> int:
        """Steps of the longest run; ENDLESS if some run may never end."""
        order = _sources_first(self.moves)
        if order is None:
            return ENDLESS
        depth = [0] * len(self.moves)
        for state in order:
            for target in self.moves[state]:
                if target >= 0:
                    depth[target] = max(depth[target], depth[state] + 1)
        return max(depth)

    def chain(self) -> Chain:
        states = len(self.moves)
        named = [{t if t >= 0 else states - 1 - t: p for t, p in moves.items()} for moves in self.moves]
        nothing: list[tuple[Chance, ...]] = [(0,) * len(REWARDS)] * len(OUTCOMES)
        rewards = [*(tuple(reward) for reward in self.rewards), *nothing]
        return Chain((*named, *({} for _ in OUTCOMES)), tuple(rewards), self.loop.robots, self.timed)


def _sources_first(moves: list[dict[int, Chance]] | tuple[dict[int, Chance], ...]) -> list[int] | None:
    """The states so that each comes before those that it leads to (targets below 0 are none); None: in circles."""
    entering = [0] * len(moves)
    for row in moves:
        for target in row:
            if target >= 0:
                entering[target] += 1
    order = [state for state, count in enumerate(entering) if count == 0]
    for state in order:
        for target in moves[state]:
            if target >= 0:
                entering[target] -= 1
                if entering[target] == 0:
                    order.append(target)
    return order if len(order) == len(moves) else None


def solve_chain(chain: Chain) -> ChainValues:
    """The chain's expected values from its start.

    Exact chains: by substitution from the ends, in Fractions. Others: by one sparse linear system, (I - P) x = r.
    Raises ValueError for an exact chain with states that lead back to themselves.
    """
    solved = _substituted(chain) if isinstance(chain.rewards[0][0], Fraction) else _solved(chain)
    visited, survived, time, lost, *chances = solved
    return ChainValues(visited, survived, time, chain.robots - lost, *chances)


def _solved(chain: Chain) -> list[float]:
    entries = [(source, target, p) for source, row in enumerate(chain.moves) for target, p in row.items()]
    source, target, chance = zip(*entries, strict=True)
    rows = sparse.csc_array((chance, (source, target)), shape=(chain.states, chain.states))
    system = sparse.eye_array(chain.inner, format="csc") - rows[: chain.inner, : chain.inner]
    ends = rows[: chain.inner, chain.inner :].toarray()
    right = np.hstack([np.array(chain.rewards[: chain.inner], dtype=np.float64), ends])
    first: list[float] = spsolve(system, right).reshape(chain.inner, -1)[0].tolist()
    return first


def _substituted(chain: Chain) -> list[Chance]:
    order = _sources_first(chain.moves)
    if order is None:
        raise ValueError("a chain with circles has no substitution from its ends")
    values: list[list[Chance]] = [[]] * chain.states
    for state in reversed(order):
        ends = [int(state == chain.inner + outcome) for outcome in range(len(OUTCOMES))]
        value = [*chain.rewards[state], *ends]
        for target, chance in chain.moves[state].items():
            value = [mine + chance * other for mine, other in zip(value, values[target], strict=True)]
        values[state] = value
    return values[0]


def write_drn(chain: Chain, path: str | Path) -> None:
    """Write the chain in Storm's explicit format (`.drn`), with its rewards, and the outcomes and "over" as labels.

    Fractions are written as such, floats with all their digits.
    """
    with atomic_write(Path(path)) as out:
        out.write("@type: DTMC\n@parameters\n\n@reward_models\n" + " ".join(REWARDS) + "\n")
        out.write(f"@nr_states\n{chain.states}\n@nr_choices\n{chain.states}\n@model\n")
        for state, (row, rewards) in enumerate(zip(chain.moves, chain.rewards, strict=True)):
            outcome = state - chain.inner
            label = "init" if state == 0 else f"{OUTCOMES[outcome]} over" if outcome >= 0 else ""
            out.write(f"state {state} [{', '.join(str(reward) for reward in rewards)}] {label}".rstrip())
            out.write("\n\taction 0\n")
            out.writelines(f"\t\t{target} : {chance}\n" for target, chance in sorted((row or {state: 1}).items()))


# A chain's values by the model checker Storm: an oracle that nobody here wrote (extra `oracle`, GPL-3, tests only).


def storm_values(chain: Chain) -> ChainValues:
    """The expected values of the chain: Fractions of an exact one, else floats (Storm's sound methods).

    Raises ImportError without stormpy 2.
    """
    import stormpy

    exact = isinstance(chain.rewards[0][0], Fraction)
    build = stormpy.build_model_from_drn[stormpy.Rational] if exact else stormpy.build_model_from_drn
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "chain.drn"
        write_drn(chain, file)
        model = build(str(file))

    def value(formula: str) -> Chance:
        (asked,) = stormpy.parse_properties(formula)
        found = stormpy.model_checking(model, asked).get_value(model.initial_states[0])
        return Fraction(str(found)) if exact else float(found)

    visited, survived, time, lost = (value(f'R{{"{reward}"}}=? [F "over"]') for reward in REWARDS)
    chances = (value(f'P=? [F "{outcome}"]') for outcome in OUTCOMES)
    return ChainValues(visited, survived, time, chain.robots - lost, *chances)
