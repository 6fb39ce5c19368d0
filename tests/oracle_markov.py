"""The closed loop as a Markov chain: its states, equal ones merged, with what a step adds; for solvers of other hands.

A state is what stands between two steps: the live robots, their areas and paths ahead, the cells covered in both
meanings, the quiet steps. The step itself is left out where no run can reach T_max, and is part of the state where
one can. Axis `S` = states: 0 is the team before it enters its starts, the last ones are the outcomes, which nothing
leaves.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from oracle_tree import ENDS, OUTCOMES, Branch, Chance, Tree, alive, state_key
from scipy import sparse
from scipy.sparse.linalg import spsolve

from planner.errors import PlanError
from planner.files import atomic_write
from planner.mrac.executive import NOT_BEGUN
from planner.plan.plan import Plan
from planner.tally import Outcome
from planner.world.world import World

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
        plan: with its allocation. world: the one that it was made for. first_only: `threat_checks="first_visit"`.
        exact: chances and rewards are Fractions, exact for the float32 threats; for tiny worlds.
        most_states: more are refused.

    Raises:
        PlanError: a plan without areas or for another map, or more than `most_states` states.
    """
    loop = Tree(plan, world, first_only=first_only, number=Fraction if exact else float)
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
        self._place(self.loop.start())
        while self.waiting:
            self._play(*self.waiting.popleft())

    def _place(self, branch: Branch) -> int:
        """The number of the branch's state; a new one waits to be played, with chance 1."""
        step = branch.run.step if self.timed else None
        number = self.number.setdefault((step, state_key(branch)), len(self.number))
        if number == len(self.moves):
            if number >= self.most_states:
                raise PlanError(f"more than {self.most_states} states", expected="a smaller world or team")
            self.moves.append({})
            self.rewards.append([0] * len(REWARDS))
            self.waiting.append((number, Branch(branch.run, branch.turn, self.loop.certain)))
        return number

    def _play(self, number: int, branch: Branch) -> None:
        """One step from a state: chance and rewards of whatever its hits may be."""
        loop, steps = self.loop, int(branch.run.step != NOT_BEGUN)
        visited, survived = loop.covered(branch.run)
        lost = loop.robots - alive(branch.run)
        going, ends = loop.step(branch, loop.max_steps if self.timed else ENDLESS)
        for end in ends:
            gain = end.visited - visited, end.survived - survived, steps, loop.robots - end.alive - lost
            self._add(number, _place_of(end.outcome), end.chance, gain)
        for after in going:
            by_now = loop.covered(after.run)
            gain = by_now[0] - visited, by_now[1] - survived, steps, loop.robots - alive(after.run) - lost
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


def _place_of(outcome: Outcome) -> int:
    """The target that stands for an outcome until the chain is made."""
    return -1 - ENDS.index(outcome)


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
