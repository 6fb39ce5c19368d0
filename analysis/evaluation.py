"""What an evaluation holds: the plan, its exact values and bounds, and the tally of its rollouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.bounds import Bounds
from analysis.exact import OpenLoopExact
from planner.plan import Plan
from planner.tally import Tally
from planner.world import World


@dataclass(frozen=True, eq=False)
class Deadline:
    """Coverage by the end of step `steps`. `tally` counts the rollouts of the plan cut off there."""

    steps: int
    tally: Tally


@dataclass(frozen=True, eq=False)
class Band:
    """Quantiles of coverage (visited, cells) over time, of sampled rollouts. Axis `G` = steps looked at.

    Attributes:
        steps: int64 `[G]`. low, median, high: int64 `[G]`, the 5 %, 50 % and 95 % quantiles.
    """

    steps: NDArray[np.int64]
    low: NDArray[np.int64]
    median: NDArray[np.int64]
    high: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One evaluated plan.

    Attributes:
        world, plan: what was evaluated. exact: the open loop's closed form. bounds: the paper's formulas.
        loop: "open". mode: "fast" or "step". engine: "jax" or "numba". seed: of the rollouts.
        tally: the counts. deadline: coverage by a deadline, if asked. band: coverage over time, if asked.
        seconds: spent on rollouts, compilation left out. compile_seconds: spent on that.
        partial: True if it was interrupted; the tally holds what was done.
        notes: what a user should know.
    """

    world: World
    plan: Plan
    exact: OpenLoopExact
    bounds: Bounds
    loop: str
    mode: str
    engine: str
    seed: int
    tally: Tally
    seconds: float
    compile_seconds: float
    deadline: Deadline | None = None
    band: Band | None = None
    partial: bool = False
    notes: tuple[str, ...] = ()
