"""What is found of what the cells are worth, in the words of the field that asks (SPEC section 13).

The open loop's figures are exact. In the closed loop every rollout keeps how often each cell was visited and survived,
up to MOST_PASSES times: `P(found in c) = sum_n P(n or more) d (1 - d)^(n - 1)`, from integer counts. Of further visits
the visits and stops of the cell tell how many there are on average, m a run that makes MOST_PASSES. What they add is
`(1 - d)^MOST_PASSES P(MOST_PASSES or more) E[1 - (1 - d)^J]` with E[J] = m, J whole: most if all runs make as many, m
rounded down or up. The mean counts them so; the interval's lower end does without them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.evaluation.outputs.value_figures import ValueFigures
from analysis.evaluation.outputs.value_words import SENTENCES, value_table
from analysis.sampling import make_engine_for
from analysis.statistics.control import LEAST, tally_mean
from analysis.statistics.differences import CommonLuck
from analysis.statistics.estimate import Estimate, exactly
from analysis.statistics.mission import at_least, robots_left
from analysis.theory.any_strategy import MOST_CELLS, value_bound
from analysis.theory.reachable import trimmed
from analysis.theory.value import Worth, open_loop_found
from analysis.trials.exact_loop import TreeTruth
from analysis.trials.measured import stated
from analysis.trials.valuing import mean_value, units_of
from planner.arguments import argument, check_word
from planner.errors import UsageError
from planner.files import Json
from planner.kernels.state import MOST_PASSES
from planner.kernels.tree import Tree
from planner.rollouts.blocks import run_ranges
from planner.rollouts.by_luck import luck_classes
from planner.tally import Tally
from planner.worlds.reported import METRICS
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.page.cell_maps import CellLayer


@dataclass(frozen=True, eq=False)
class Value(ValueFigures, Output):
    """The figures, measured beside the rollouts that were done."""

    @classmethod
    def check(cls, asked: str, world: World) -> None:
        check_word("metrics", asked, METRICS)
        world.check_settled("the value covered and found", ", or `value`, `detect`, `route` and `metrics`")

    @classmethod
    def measure(cls, asked: str, run: Run) -> Iterator[Self]:
        worth, tally, most = Worth.of(run.world), run.last.tally, None
        bounded = not run.choices.first_only and run.world.doubt is None and run.plan.state is None
        bounded = bounded and run.plan.bearing.is_plain
        if bounded and tally.accessible <= MOST_CELLS:
            most = value_bound(trimmed(run.world, run.plan), run.plan.starts)
        tree = run.closed if isinstance(run.closed, TreeTruth) else None
        if run.choices.loop == "open" or (run.closed is not None and tree is None and not run.certain):
            if run.world.doubt is not None:
                problem = "what is found in the open loop of a map in doubt is not known exactly"
                raise UsageError(problem, fix=f"use {argument('loop', 'closed')}")
            visited, found = run.exact.visited_by_cell, open_loop_found(run.plan, run.world)
            covered, known = (exactly(float(worth.value @ chance)) for chance in (visited, found))
            lost = exactly(run.exact.expected_losses)
            alive = [exactly(float(chance)) for chance in at_least(run.exact.alive_chance)]
            yield cls(asked, run.world, worth, covered, known, visited, found, 0.0, most, tally, lost, alive)
            return
        if tree is not None and tree.masses is not None and worth.is_plain:
            n, chances = tree.masses.rollouts, (tree.masses.covered_visited, tree.masses.covered_survived)
            visited, found = (of / n for of in chances)
            found = worth.detect * found
            covered, known = (exactly(float(worth.value @ chance)) for chance in (visited, found))
            yield cls(asked, run.world, worth, covered, known, visited, found, 0.0, most, tally, *_left(tree.tree))
            return
        run.doing("value covered and found")
        units = Units.of(worth)
        counted, columns = units.roll_out(run)
        found, rest = found_chances(counted, worth)
        luck = run.choices.seed if run.choices.luck == "tolerance" else None
        covered, known = (units.estimate(column, run.certain, tally.robots, luck) for column in columns)
        (low, high), total = known.ci95, worth.total
        least = low + rest if run.certain else low
        known = Estimate(min(known.mean + rest, total), known.se, (min(least, total), min(high + rest, total)))
        if run.certain:
            covered = exactly(float(worth.value @ (counted.covered_visited / counted.rollouts)))
        visited, lost = counted.covered_visited / counted.rollouts, tally_mean(tally, "lost", certain=run.certain)
        alive = robots_left(tally, run.certain)
        if tree is not None:
            lost, alive = _left(tree.tree)
            if tree.masses is not None:
                visited = tree.masses.covered_visited / tree.masses.rollouts
                covered = exactly(float(worth.value @ visited))
        yield cls(asked, run.world, worth, covered, known, visited, found, rest, most, tally, lost, alive)

    def as_json(self) -> Json:
        return self.to_json()

    def blocks(self) -> Blocks:
        beyond = (
            f"visits beyond the {MOST_PASSES}th of a cell find at most {self.remainder:.3g}: the mean counts it, "
            "the interval has room for less"
        )
        return Blocks(
            leads=[SENTENCES[self.metrics](self)], tables=[value_table(self)], notes=[beyond] * (self.remainder > 0),
            layers={"left.png": self.layer}, settings={"metrics": self.metrics},
        )  # fmt: skip

    def layer(self) -> CellLayer:
        """What is left of what each cell is worth."""
        from analysis.page.cell_maps import CellLayer
        from analysis.pictures.style import LOSSES

        about = f"Value times the chance that it is not found. {self.left.mean:.4g} of {self.worth.total:.4g} in all."
        left = self.left_by_cell.reshape(self.world.shape)
        return CellLayer("Value left", about, left, LOSSES, root=True, blocks="sum", short="Left")


def _left(tree: Tree) -> tuple[Estimate, list[Estimate]]:
    """Robots lost, and the chances that at least 1, ..., K are left, of all that can happen."""
    robots, (least, most) = len(tree.counts.alive) - 1, tree.alive()
    chances = (stated(tree.chance(int(mass)), 1.0, 1.0) for mass in at_least(tree.counts.alive))
    return stated((robots - most, robots - least), 1.0, robots), list(chances)


@dataclass(frozen=True, eq=False)
class Units:
    """Values as whole numbers (`analysis.trials.valuing`).

    Attributes:
        worth: of the cells. covered: int64 `[N]`. found: int64 `[N, MOST_PASSES + 1]`, by survived visits.
    """

    worth: Worth
    covered: NDArray[np.int64]
    found: NDArray[np.int64]

    @classmethod
    def of(cls, worth: Worth) -> Self:
        """What each cell adds to the sums of a rollout."""
        share = units_of(worth)
        missed = (1.0 - worth.detect[:, None]) ** np.arange(MOST_PASSES + 1)
        return cls(worth, np.rint(share).astype(np.int64), np.rint(share[:, None] * (1.0 - missed)).astype(np.int64))

    def roll_out(self, run: Run) -> tuple[Tally, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """The ids of the evaluation once more: a tally with survived visits; units covered and found, `[B]` each."""
        engine = make_engine_for(run.world, run.plan, run.choices, kept=run.kept).weighing(self.covered, self.found)
        tally, parts, seconds, count = None, [], 0.0, run.last.tally.rollouts
        for start, size, (part, singles), took in run_ranges(engine.run, 0, count, unit=engine.least):
            tally, seconds = part if tally is None else tally + part, seconds + took
            parts.append((singles.worth_covered, singles.worth_found))
            run.progress(start + size, count, seconds)
        assert tally is not None
        covered, found = (np.concatenate(column) for column in zip(*parts, strict=True))
        return tally, (covered, found)

    def estimate(self, column: NDArray[np.int64], certain: bool, robots: int, seed: int | None) -> Estimate:
        """The mean of units `[B]` of rollouts 0 .. B - 1, as a value; `seed`: of luck by tolerance, or None."""
        count, luck = len(column), None
        if seed is not None and count >= LEAST:
            luck = CommonLuck.of(robots, luck_classes(seed, 0, count, robots), column, column)
        return mean_value(column, self.worth.total, len(self.covered), certain, luck)


def found_chances(tally: Tally, worth: Worth) -> tuple[NDArray[np.float64], float]:
    """P(found in c) of rollouts whose survived visits were counted, float64 `[N]`, and what it may hold too much of."""
    at_least = tally.passes.reshape(-1, MOST_PASSES) / tally.rollouts
    counts, missed = tally.passes.reshape(-1, MOST_PASSES), 1.0 - worth.detect
    further = np.maximum(tally.visits - tally.stops - counts.sum(axis=1), 0) / np.maximum(counts[:, -1], 1)
    whole = np.floor(further)
    left = 1.0 - missed**whole * (1.0 - (further - whole) * worth.detect)
    rest = missed**MOST_PASSES * at_least[:, -1] * left
    return worth.detect * _weighted(at_least, missed) + rest, float(worth.value @ rest)


def _weighted(at_least: NDArray[np.float64], missed: NDArray[np.float64]) -> NDArray[np.float64]:
    """`sum_n at_least[c, n] missed[c]^n`, float64 `[N]`."""
    total = np.zeros(len(missed))
    for column in at_least.T[::-1]:
        total = column + missed * total
    return total
