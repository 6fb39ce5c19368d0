"""The closed loop without rollouts: by formulas where they are all of it, else by the tree of all that can happen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.statistics.estimate import QUANTILES
from analysis.theory.exact import OpenLoopExact
from analysis.theory.truth import ClosedTruth, Truth, as_stated, exact_truth
from planner.errors import PlanError
from planner.kernels.loop import ClosedLoop
from planner.kernels.state import Counts
from planner.kernels.tables import AllPairs
from planner.kernels.tree import WHOLE, Tree, grow_tree
from planner.plans.plan import Plan
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.sampling import RolloutChoices

SLACK = 1e-4
"""Of the cells: a mean that is known as closely counts as exact."""
EFFORT = 3e8
"""Histories of a tree times cells that take about a second: so much is done on every machine, busy or not."""
MOST_CELLS = 5_000
"""Of maps whose tables are worth it."""


def closed_truth(
    plan: Plan, world: World, exact: OpenLoopExact, choices: RolloutChoices, kept: AllPairs | None = None
) -> ClosedTruth | None:
    """The closed loop's figures within SLACK of the cells, or a tenth of the precision asked for; None: too dear.

    `exact`: the open loop's. `kept`: where all-pairs tables are kept.
    """
    known = exact_truth(plan, world, exact, choices.first_only)
    if known is not None or choices.exact == "never":
        return known
    slack = min(SLACK, (choices.precision or 1.0) / 10)
    loop = _loop_of(plan, world, choices.first_only, kept)
    tree = None if loop is None else tree_of(loop, choices.exact_seconds, slack)
    return None if loop is None or tree is None else _truth_of(tree, loop, plan, world)


def closed_tree(
    plan: Plan,
    world: World,
    first_only: bool = False,
    kept: AllPairs | None = None,
    seconds: float = 2.0,
    slack: float = SLACK,
) -> Tree | None:
    """The tree of a plan's closed loop with at most `slack` of the cells unknown, or None where that is too dear."""
    loop = _loop_of(plan, world, first_only, kept)
    return None if loop is None else tree_of(loop, seconds, slack)


def _loop_of(plan: Plan, world: World, first_only: bool, kept: AllPairs | None) -> ClosedLoop | None:
    """What a tree is grown of, or None where there is none, or it would be too dear."""
    from planner.kernels.closed_loop import compile_closed_loop

    if world.doubt is not None or int(world.accessible(plan.starts).sum()) > MOST_CELLS:
        return None
    try:
        return compile_closed_loop(plan, world, first_only=first_only, kept=kept, luck="tolerance")
    except PlanError:  # a rule that is not compiled
        return None


def tree_of(loop: ClosedLoop, seconds: float, slack: float = SLACK) -> Tree | None:
    """The same of a loop. One history is always worth it: nothing can happen, or one robot is alone."""
    cells = len(loop.cells)
    effort = seconds * EFFORT if cells <= MOST_CELLS else 0.0
    return grow_tree(loop, slack * cells, max(int(effort / cells), 2))


def _truth_of(tree: Tree, loop: ClosedLoop, plan: Plan, world: World) -> ClosedTruth:
    from planner.kernels.closed_loop import tally_from

    visited, survived, some_left = (
        _between(*one) for one in (tree.covered("visited"), tree.covered("survived"), tree.chance_left())
    )
    stated = as_stated(plan, world, tree.counts.outcomes / WHOLE, "tree")
    least, most = tree.alive()
    robots = len(tree.counts.alive) - 1
    further = {
        "losses": _said(robots - most, robots - least),
        "complete": _said(*tree.chance_complete()),
        "quantiles": {
            figure: {f"{q:g}": _said(*tree.quantile(figure, q)) for q in QUANTILES}
            for figure in ("visited", "survived")
        },
        "histories": tree.histories,
        "cut": tree.share_cut,
        "mass_cut": tree.left,
        "seconds": tree.seconds,
    }
    counts = [Counts(*map(np.copy, tree.counts))]  # a state's own cells are added in place
    masses = tally_from(loop, 0, 0, WHOLE, counts) if tree.left <= SLACK else None
    return ClosedTruth(visited, survived, some_left, stated, 0, (least + most) / 2, tree.mean_time, further, masses)


def _between(low: float, high: float) -> Truth:
    return Truth((low + high) / 2, low, high, "tree")


def _said(low: float, high: float) -> float | list[float]:
    """A value, or the two between which it is certain to be."""
    return low if low == high else [low, high]
