"""The closed loop without rollouts: by formulas where they are all of it, else by the tree of all that can happen."""

from __future__ import annotations

from math import log, log1p

from analysis.theory.exact import OpenLoopExact, robot_chances
from analysis.theory.truth import ClosedTruth, Truth, exact_truth
from planner.errors import PlanError
from planner.kernels.tables import AllPairs
from planner.kernels.tree import Tree, grow_tree
from planner.plans.plan import Plan
from planner.worlds.world import World

SLACK = 1e-4
"""Of the cells: a mean that is known as closely counts as exact."""
EFFORT = 3e8
"""Histories of a tree times cells that are worth an exact value: a second or two, on every machine the same."""
MOST_CELLS = 5_000
"""Of maps whose tables are worth it."""
PATTERNS = 1e11
"""Patterns of hits that the nominal paths allow for, from which on no tree is begun."""


def closed_truth(
    plan: Plan, world: World, exact: OpenLoopExact, first_only: bool = False, kept: AllPairs | None = None
) -> ClosedTruth | None:
    """The closed loop's figures within SLACK of the cells, or None where that is too dear.

    `exact`: the open loop's. `kept`: where all-pairs tables are kept.
    """
    known = exact_truth(plan, world, exact, first_only, effort=0.0)
    if known is not None:
        return known
    tree = closed_tree(plan, world, first_only, kept)
    return exact_truth(plan, world, exact, first_only) if tree is None else _truth_of(tree)


def closed_tree(
    plan: Plan, world: World, first_only: bool = False, kept: AllPairs | None = None, effort: float = EFFORT
) -> Tree | None:
    """The tree of a plan's closed loop with at most SLACK of the cells unknown, or None where that is too dear."""
    from planner.kernels.closed_loop import compile_closed_loop

    cells = int(world.accessible(plan.starts).sum())
    if world.doubt is not None or cells > MOST_CELLS:
        return None
    dangerous = sum(int((robot_chances(robot, world).threat > 0).sum()) for robot in plan.robots)
    if len(plan.robots) * log1p(dangerous) > log(PATTERNS):
        return None
    try:
        loop = compile_closed_loop(plan, world, first_only=first_only, kept=kept, luck="tolerance")
    except PlanError:  # a rule that is not compiled
        return None
    return grow_tree(loop, SLACK * cells, int(effort / cells))


def _truth_of(tree: Tree) -> ClosedTruth:
    visited, survived = (_between(*tree.covered(figure)) for figure in ("visited", "survived"))
    low, high = tree.chance_left()
    alive, time = tree.alive(), tree.mean_time
    return ClosedTruth(
        visited, survived, _between(low, high), None, 0, sum(alive) / 2, time, tree.histories, tree.left
    )  # fmt: skip


def _between(low: float, high: float) -> Truth:
    return Truth((low + high) / 2, low, high, "tree")
