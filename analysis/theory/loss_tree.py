"""Bounds on the closed loop's expected coverage that tighten with work: the tree of losses, cut and bounded.

A run of the closed loop is decided by which of its hit checks stop a robot (`analysis.theory.tree`). A node of the
tree is a list of checks that do; its *quiet run* makes these hits and no others, and its children are the losses that
could come next in it. Unlike `analysis.theory.tree`, which follows every child, it follows the likeliest ones and
bounds what follows each other loss: from below by what the survivors' present paths still promise
(`analysis.theory.promises`), from above by the ideal of the robots that are left. Both bounds are proven for any number
of quiet runs, and meet when all are made. It shares the simulator with that tree, and no code with the engines.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.theory.bounds import Meanings
from analysis.theory.promises import Promises
from analysis.theory.quiet_run import QuietRun, quiet_run
from planner.errors import PlanError
from planner.mrac.problem import Problem, prepare
from planner.plans.plan import Plan
from planner.worlds.world import World

RUNS = 32
"""Quiet runs unless told otherwise."""


@dataclass(frozen=True)
class LossTree:
    """What the tree says about the closed loop.

    Attributes:
        lower: at most the expected coverage in each meaning, in cells. upper: at least the expected cells visited.
        runs: quiet runs made. left: losses not followed; at 0 the bounds are the exact value, to rounding.
    """

    lower: Meanings
    upper: float
    runs: int
    left: int


@dataclass(frozen=True, eq=False)
class _Losses:
    """The losses that could come next in a quiet run, in order. Axis `L`; bounds are (visited from below, survived
    from below, visited from above).

    Attributes:
        check: int64 `[L]`, position among the run's entries. chance: float64 `[L]`, given the node.
        bounds: float64 `[L, 3]`, given the loss; exact if no robot is left.
        robots_left: after the loss.
        calm: float64 `[3]`, the chance that no further loss comes, times what is covered then.
    """

    check: NDArray[np.int64]
    chance: NDArray[np.float64]
    bounds: NDArray[np.float64]
    robots_left: int
    calm: NDArray[np.float64]


@dataclass(eq=False)
class _Node:
    """A node whose quiet run was made: its place under its parent, what its parent holds for it, what it found."""

    parent: int
    chance: float
    held: NDArray[np.float64]
    found: NDArray[np.float64]

    def best(self) -> NDArray[np.float64]:
        """The better of what was held and what was found, bound by bound."""
        return np.append(np.maximum(self.held[:2], self.found[:2]), min(self.held[2], self.found[2]))


def loss_tree(plan: Plan, world: World, *, most_runs: int = RUNS) -> LossTree:
    """Bounds on the closed loop's E[visited] and E[survived] from `most_runs` quiet runs of the simulator.

    Proof. Given that a node's hits are the first ones, the next loss comes at check a of its quiet run with chance
    p_a * prod (1 - p) over the checks between its last hit and a; with the rest of the chance none comes, and the run
    is the quiet run, whose coverage is known. If it comes at a: what was covered stays covered, and the promise of the
    survivors comes on top (proof there), which bounds the expectation from below. From above: with r robots left, the
    ideal of r robots over the unvisited cells bounds what any strategy adds. Where the child's own quiet run is made,
    the same argument bounds the child; the better bound of the two is kept. Sum over the children, up to the root.

    One quiet run, the nominal one, already gives at least `until_first_loss`. The loss with the largest chance x gap
    between its bounds is followed first, so more runs never loosen a bound. Holds for hits checked on every visit, not
    for `threat_checks="first_visit"`. Under a policy whose robots may change their minds nothing is promised: what was
    covered is all that is kept from below. Cost: for each node a run of the readable simulator and a pass over its
    losses, about 0.03 s on a 20 x 20 map with 8 robots.

    Args:
        plan: with its allocation; not the plan of another planner.
        world: the world that it was made for.
        most_runs: at least 1.

    Raises:
        PlanError: a plan without areas.
    """
    if plan.is_foreign:
        raise PlanError(f"a {plan.origin} has no areas to lose", expected="a plan of this project")
    problem = prepare(world, plan.starts, plan.require(world))
    nothing = np.array([0.0, 0.0, np.inf])
    queue: list[tuple[float, tuple[int, ...], int, float, float, NDArray[np.float64]]] = [
        (0.0, (), -1, 1.0, 1.0, nothing)
    ]
    nodes: list[_Node] = []
    while queue and len(nodes) < most_runs:
        _, hits, parent, given, chance, held = heapq.heappop(queue)
        losses = _losses(quiet_run(problem, plan, hits), problem)
        found = losses.chance @ losses.bounds + losses.calm
        for check, next_given, bounds in zip(losses.check.tolist(), losses.chance.tolist(), losses.bounds, strict=True):
            if losses.robots_left:
                weight = chance * next_given * float(bounds[2] - bounds[0])
                heapq.heappush(queue, (-weight, (*hits, check), len(nodes), next_given, chance * next_given, bounds))
        nodes.append(_Node(parent, given, held, found))
    for node in reversed(nodes[1:]):
        nodes[node.parent].found += node.chance * (node.best() - node.held)
    visited, survived, upper = nodes[0].found.tolist()
    return LossTree(Meanings(visited, survived), upper, len(nodes), len(queue))


def _losses(run: QuietRun, problem: Problem) -> _Losses:
    last_hit = run.hits[-1] if run.hits else -1
    dangerous = np.flatnonzero(run.threat > 0)
    check = dangerous[dangerous > last_hit]
    passing = np.cumprod(1.0 - run.threat[check])
    calm = float(passing[-1]) if len(check) else 1.0
    robots_left = max(len(problem.starts) - len(run.hits) - 1, 0)
    lower = np.zeros((len(check), 2))
    if robots_left and not problem.rule.attentive:  # attentive robots may leave the paths that they are on
        promises = Promises(run, problem)
        lower = np.array([promises.after(loss) for loss in check.tolist()]).reshape(-1, 2)
    visited = run.visited_by(check)
    lower += np.stack([visited, run.survived_before(check)], axis=1)
    upper = visited + _ideals(run, problem, check, robots_left)
    end = np.array([run.visited, run.survived, run.visited], dtype=np.float64)
    return _Losses(
        check=check,
        chance=np.concatenate([[1.0], passing[:-1]])[: len(check)] * run.threat[check],
        bounds=np.column_stack([lower, upper]),
        robots_left=robots_left,
        calm=calm * end,
    )


def _ideals(run: QuietRun, problem: Problem, check: NDArray[np.int64], robots: int) -> NDArray[np.float64]:
    """The ideal of a team of `robots` over the cells unvisited after each loss, float64 `[L]` (`bounds.ideal_team`)."""
    if robots == 0:
        return np.zeros(len(check))
    cells = np.flatnonzero(problem.levels.accessible)
    threat = problem.world.threat.ravel()[cells].astype(np.float64)
    safe = np.sort(run.first_visit[cells[threat == 0]])
    total = (len(safe) - np.searchsorted(safe, check, side="right")).astype(np.float64)
    order = np.argsort(threat, kind="stable")
    hits = np.zeros((len(check), robots))
    hits[:, 0] = 1.0
    for cell, p in zip(cells[order].tolist(), threat[order].tolist(), strict=True):
        if p > 0:
            open_at = np.flatnonzero(check < run.first_visit[cell])
            now = hits[open_at]
            total[open_at] += now.sum(axis=1)
            now[:, 1:] = now[:, 1:] * (1.0 - p) + now[:, :-1] * p
            now[:, 0] *= 1.0 - p
            hits[open_at] = now
    return total
