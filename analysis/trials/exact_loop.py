"""The closed loop without rollouts: by formulas where they are all of it, else by the tree of all that can happen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.statistics.estimate import QUANTILES
from analysis.theory.exact import OpenLoopExact
from analysis.theory.truth import ClosedTruth, Truth, as_stated, exact_truth
from analysis.theory.verdicts import MEANINGS
from planner.errors import PlanError
from planner.kernels.loop import ClosedLoop
from planner.kernels.state import Counts
from planner.kernels.tables import AllPairs
from planner.kernels.tree import CHEAP, WHOLE, Tree, grow_tree
from planner.plans.plan import Plan, is_certain
from planner.tally import Tally
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.sampling import RolloutChoices

SLACK = 1e-4
"""Of the cells: a mean that is known as closely counts as exact."""
EFFORT = 3e8
"""Histories of a tree times cells that take about a second: so much is done on every machine, busy or not."""
LARGE = 8
"""Robots above which a history takes longer, by their number, and by its cube where they come home (64: 366 times) or
do not hear each other everywhere (35: 40 times)."""
MOST_CELLS = 5_000
"""Of maps whose tables are worth it."""


@dataclass(frozen=True)
class TreeTruth(ClosedTruth):
    """The closed loop's figures from a tree.

    Attributes:
        tree: all that can happen, or next to all. masses: chances as a tally counts rollouts; None: too much was left.
    """

    tree: Tree = field(kw_only=True)
    masses: Tally | None = field(kw_only=True)

    @property
    def is_all(self) -> bool:
        """Whether rollouts have nothing to add: only what is next to nothing was left."""
        return self.masses is not None and self.time is not None

    @property
    def further(self) -> dict[str, Any]:
        tree, robots, (least, most) = self.tree, len(self.tree.counts.alive) - 1, self.tree.alive()
        return {
            "losses": _said(robots - most, robots - least),
            "complete": _said(*tree.chance_complete()),
            "quantiles": {
                figure: {f"{q:g}": _said(*tree.quantile(figure, q)) for q in QUANTILES} for figure in MEANINGS
            },
            "histories": tree.histories,
            "cut": tree.share_cut,
            "mass_cut": tree.left,
            "seconds": tree.seconds,
        }


def closed_truth(
    plan: Plan,
    world: World,
    exact: OpenLoopExact,
    choices: RolloutChoices,
    kept: AllPairs | None = None,
    fine_seconds: float = 0.0,
) -> ClosedTruth | None:
    """The closed loop's figures within SLACK of the cells, or a tenth of the precision asked for; None: too dear.

    `exact`: the open loop's. `kept`: where all-pairs tables are kept. `fine_seconds`: as of `tree_of`.
    """
    known = exact_truth(plan, world, exact, choices.first_only)
    if choices.exact == "never" or is_certain(world, plan) or (known is not None and not fine_seconds):
        return known
    slack = min(SLACK, (choices.precision or 1.0) / 10)
    loop = _loop_of(plan, world, choices.first_only, kept)
    tree = None if loop is None else tree_of(loop, choices.exact_seconds, slack, fine_seconds)
    return known if loop is None or tree is None else _truth_of(tree, loop, plan, world)


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

    if (world.doubt is not None and world.phases is None) or int(world.accessible(plan.starts).sum()) > MOST_CELLS:
        return None
    try:
        return compile_closed_loop(plan, world, first_only=first_only, kept=kept, luck="tolerance")
    except PlanError:  # a rule that is not compiled
        return None


def tree_of(loop: ClosedLoop, seconds: float, slack: float = SLACK, fine_seconds: float = 0.0) -> Tree | None:
    """The same of a loop. One history is always worth it: nothing can happen, or one robot is alone.

    `fine_seconds`: a tree that takes no longer is grown until next to nothing is left.
    """
    cells = loop.accessible
    slower = max(loop.robots / LARGE, 1.0) ** (3 if loop.comes_home or len(loop.tables.reach) else 1)
    most, cheap = (
        max(int(time * EFFORT / cells / slower), 2) if cells <= MOST_CELLS else 2 for time in (seconds, fine_seconds)
    )
    return grow_tree(loop, slack * cells, most, max(cheap, CHEAP))


def _truth_of(tree: Tree, loop: ClosedLoop, plan: Plan, world: World) -> TreeTruth:
    from planner.kernels.closed_loop import tally_from

    visited, survived, some_left = (
        _between(*one) for one in (tree.covered("visited"), tree.covered("survived"), tree.chance_left())
    )
    stated = as_stated(plan, world, tree.counts.outcomes / WHOLE, "tree")
    counts = [Counts(*map(np.copy, tree.counts))]  # a state's own cells are added in place
    masses = tally_from(loop, 0, 0, WHOLE, counts) if tree.left <= SLACK else None
    alive, time = tree.mean_alive, tree.mean_time
    return TreeTruth(visited, survived, some_left, stated, 0, alive, time, tree=tree, masses=masses)


def _between(low: float, high: float) -> Truth:
    return Truth((low + high) / 2, low, high, "tree")


def _said(low: float, high: float) -> float | list[float]:
    """A value, or the two between which it is certain to be."""
    return low if low == high else [low, high]
