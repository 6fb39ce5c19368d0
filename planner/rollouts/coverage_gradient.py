"""The gradient of the closed loop's expected coverage in p, with every decision of the robots held fixed.

`p` destroys, and the plan's map decides: costs, levels and the order of areas stay. A rollout then depends on p only
through its losses. The likelihood ratio gives, for every cell c with p_c > 0,

    d E[C] / dp_c = E[(C - b) (losses_c / p_c - passes_c / (1 - p_c))]

C: cells visited; losses_c: robots lost in c; passes_c: visits of c that a robot survived; b: any constant, here the
mean of C. Four sums by cell suffice: losses, passes, and each of them times C.

Source: the score function (likelihood ratio) method, Glynn 1990, "Likelihood ratio gradient estimation for stochastic
systems". Axis `B` = blocks of rollouts, `A` accessible cells.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import argument
from planner.errors import PlanError, UsageError, WorldError
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.exact_tree import WHOLE
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.runners import Runner, singles_of
from planner.world.world import World

BLOCKS = 64
"""Blocks of rollouts, whose scatter gives the standard error; its own relative error is 1 / sqrt(2 * 63)."""
LEAST_LOSSES = 10
"""Losses in a cell below which its standard error is NaN: with fewer the scatter is poorly estimated."""
MOST_HISTORIES = 3e8
"""Most histories times cells of an exact tree."""


@dataclass(frozen=True, eq=False)
class CoverageGradient:
    """d E[cells visited] / dp of each cell, with decisions held. NaN on obstacles and where p = 0.

    Attributes:
        mean: float64 `[H, W]`, in cells; 0 in cells that no robot enters.
        standard_error: float64 `[H, W]`, of `mean`; 0 where it is exact, NaN where fewer than LEAST_LOSSES losses were
            seen in a cell that was visited.
        losses: float64 `[H, W]`, robots lost in each cell, a rollout.
        coverage: mean cells visited.
        rollouts: how many; 0: the values are exact.
    """

    mean: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    losses: NDArray[np.float64]
    coverage: float
    rollouts: int


def closed_loop_gradient(
    world: World,
    plan: Plan,
    p: ArrayLike | None = None,
    *,
    rollouts: int = 65_536,
    seed: int = 0,
    exact: bool = False,
    threads: int | None = None,
) -> CoverageGradient:
    """Sensitivity of coverage to each cell's threat, for a fixed plan: d E[cells visited] / dp in the closed loop.

    Surviving robots take over from those that are lost; all decisions stay those on the plan's map, for any `p`. The
    result is the effect of a small change of p in one cell. It does not say which threats to remove: a plan for another
    map decides otherwise (`mrac.clear`).

    Args:
        world: the map of the plan.
        plan: of robots that are all alike, with threats checked at every visit.
        p: `[H, W]`, the probability that a visit destroys a robot, ignored on obstacles; None: the map's.
        rollouts: at least 1,024, ids 0, 1, ...
        seed: of the random numbers.
        exact: use the exact tree instead of rollouts, for teams of a few robots.
        threads: None: one per core. No result depends on it.

    Raises:
        PlanError: a plan of another map, or robots that differ or wear out.
        WorldError: an uncertain map, moving or changing threats, an online mission; p outside of 0 <= p < 1.
        UsageError: too few rollouts; a tree that is too large.
    """
    world.require_certain_map("the closed loop's gradient")
    if not plan.failure_model.is_plain:
        problem = f"the closed loop's gradient requires one p for all visits; here: {plan.failure_model.description}"
        raise PlanError(problem, fix="leave `weibull_shape`, `hazard_multiplier` and `types` out")
    given = world.threat if p is None else np.asarray(p, dtype=np.float32)
    if given.shape != world.shape:
        raise WorldError(f"p: shape {list(given.shape)}", expected=f"{list(world.shape)}, the map's [H, W]")
    bad = np.argwhere(world.free & ~((given >= 0) & (given < 1)))
    if len(bad):
        row, col = bad[0].tolist()
        raise WorldError(f"p: {given[row, col]} at [{row}, {col}]", expected="0 <= p < 1 in every free cell")
    # Decisions stay those of the plan's map: only the threats are exchanged.
    truth = World.create(np.where(world.free, given, np.nan))
    loop = compile_closed_loop(plan, world).with_threat(truth).scoring()
    if exact:
        return _gradient(loop, truth, _tree_sums(loop)[None], 0)
    if rollouts < 16 * BLOCKS:
        raise UsageError(argument("rollouts", rollouts), expected=f"at least {16 * BLOCKS:,}", fix="or use `exact`")
    return _gradient(loop, truth, _block_sums(loop, seed, rollouts, threads), rollouts)


Sums = NDArray[np.float64]
"""`[5, A]`: robots lost in each cell, passes, each of them times the cells covered, and (in all columns) the cells
covered; sums over a block of rollouts or over a tree."""


def _sums_of(runner: Runner) -> Sums:
    counts = runner.counts
    passes = counts.visits - counts.stops
    covered = float(counts.visited.astype(np.float64) @ np.arange(len(counts.visited)))
    return np.stack([counts.stops, passes, *counts.passes.T, np.full(len(passes), covered)]).astype(np.float64)


def _tree_sums(loop: ClosedLoop) -> Sums:
    """Sums over the exact tree, as probabilities."""
    runner = Runner(loop, 0, loop.robots + 1)
    most = int(MOST_HISTORIES / len(loop.cells))
    counts = runner.grow(WHOLE, 1, most)
    if not runner.has_levels or counts.left_visited.any():
        raise UsageError(
            f"the exact tree of {loop.robots} robots has more than {most:,} histories", fix="leave `exact` out"
        )
    return _sums_of(runner) / WHOLE


def _block_sums(loop: ClosedLoop, seed: int, rollouts: int, threads: int | None) -> NDArray[np.float64]:
    """`Sums` of each block, `[B, 5, A]`."""
    bounds = _bounds(rollouts).tolist()
    none = singles_of(loop, 0, 0)

    def run(blocks: range) -> list[Sums]:
        runner, found = Runner(loop, seed, rollouts // BLOCKS + 1), []
        before = _sums_of(runner)
        for block in blocks:
            runner.run(bounds[block], bounds[block + 1], none)
            # Counts add up over a runner's blocks: whole numbers, so their differences are exact.
            after = _sums_of(runner)
            found.append(after - before)
            before = after
        return found

    if threads == 1:
        return np.array(run(range(BLOCKS)))
    with ThreadPoolExecutor(threads) as pool:
        tasks = [range(first, min(first + 4, BLOCKS)) for first in range(0, BLOCKS, 4)]
        return np.array([one for found in pool.map(run, tasks) for one in found])


def _bounds(rollouts: int) -> NDArray[np.int64]:
    """Begin and end of the blocks, int64 `[B + 1]`."""
    return np.arange(BLOCKS + 1) * rollouts // BLOCKS


def _gradient(loop: ClosedLoop, truth: World, sums: NDArray[np.float64], rollouts: int) -> CoverageGradient:
    """The gradient from the sums of blocks, `[B, 5, A]`; of a tree `[1, 5, A]`, with `rollouts` 0."""
    p = truth.threat.ravel()[loop.cells].astype(np.float64)
    losses, passes, covered_losses, covered_passes, covered = (sums[:, number] for number in range(5))
    count = rollouts or 1
    coverage = float(covered[:, 0].sum() / count)
    with np.errstate(divide="ignore", invalid="ignore"):
        # The mean of C as baseline: it changes no expectation, and removes most of the variance.
        of_each = (covered_losses - coverage * losses) / p - (covered_passes - coverage * passes) / (1 - p)
    mean, error = of_each.sum(axis=0) / count, np.zeros(len(p))
    if rollouts:
        scatter = of_each - np.diff(_bounds(rollouts))[:, None] * mean
        error = np.sqrt((scatter**2).sum(axis=0) * BLOCKS / (BLOCKS - 1)) / rollouts
        # A cell without losses would show a standard error of 0, as if its gradient were known.
        error[(losses.sum(axis=0) < LEAST_LOSSES) & ((losses + passes).sum(axis=0) > 0)] = np.nan
        mean *= rollouts / (rollouts - 1)  # the baseline, the mean of C, is from the same rollouts

    def grid(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(truth.threat > 0, loop.on_grid(values).reshape(loop.shape), np.nan)

    return CoverageGradient(
        grid(mean), grid(error), np.nan_to_num(grid(losses.sum(axis=0) / count)), coverage, rollouts
    )
