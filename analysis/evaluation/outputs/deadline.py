"""Coverage by a deadline: the same rollouts, cut off at the end of a step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

from analysis.evaluation.figures import Figures
from analysis.evaluation.outputs.output import Blocks, Output, Run, coverage_row
from analysis.statistics.words import robots_words
from analysis.theory.longest import longest_run
from analysis.theory.verdicts import MEANINGS
from analysis.trials.exact_loop import TreeTruth
from planner.files import Json
from planner.kernels.tree import Tree
from planner.pace import UNPACED, Pace
from planner.shown import percent
from planner.tally import Tally


@dataclass(frozen=True, eq=False)
class Deadline(Output):
    """Coverage by the end of step `steps`.

    Attributes:
        tally: of the rollouts cut off there. exact: the open loop's expected cells visited and survived by then.
        certain: every run is the same. pace: how long a step takes, if that is known.
        losses: expected robots lost by then, where `exact` is of the loop that was evaluated; None: it is not.
        over: every run has ended by then: nothing is said twice. tree: then, of all that can happen; None: none grown.
    """

    steps: int
    tally: Tally
    exact: tuple[float, float]
    certain: bool = False
    pace: Pace = UNPACED
    losses: float | None = None
    over: bool = False
    tree: Tree | None = None

    @classmethod
    def measure(cls, asked: int, run: Run) -> Iterator[Self]:
        run.doing(f"rollouts up to the deadline, step {asked:,}")
        choices = replace(run.choices, rollouts=run.last.tally.rollouts, precision=None)
        for stage in run.roll_out(choices, asked):
            tally = stage.tally
            run.progress(tally.rollouts, choices.rollouts, stage.seconds)
        own = run.choices.loop == "open" or (run.closed is not None and not isinstance(run.closed, TreeTruth))
        over = longest_run(run.world, run.plan, run.choices.loop) <= asked
        tree = run.closed.tree if over and isinstance(run.closed, TreeTruth) else None
        lost = run.exact.losses_by(asked) if own else None
        yield cls(asked, tally, run.exact.by_deadline(asked), run.certain, run.world.pace, lost, over, tree)

    @cached_property
    def figures(self) -> Figures:
        """What these rollouts come to; exact where that is known."""
        found = Figures.of(self.tally, self.certain)
        if self.tree is not None:
            return found.with_tree(self.tree)
        return found if self.losses is None else found.with_means(*self.exact, self.losses)

    def as_json(self) -> Json:
        return {
            "steps": self.steps,
            **self.figures.coverage_json(),
            "losses": self.figures.losses.to_json(),
            "exact": {"open_loop": dict(zip(MEANINGS, self.exact, strict=True))},
        }

    def blocks(self) -> Blocks:
        if self.over:
            return Blocks(marks=[(self.steps, "deadline")], settings={"deadline": self.pace.step(self.steps)})
        found, cells = self.figures, self.tally.accessible
        mean, known = found.visited.mean.mean / cells, found.visited.mean.half_width == 0
        reached = percent(mean, 2) + " (exact)" if known else percent(mean)
        lost = robots_words(found.losses.mean, self.tally.robots, found.losses.decimals) + " lost"
        lost += " on average" * (found.losses.mean > 0)
        by = f"by step {self.steps}{self.pace.also(self.steps)}"
        return Blocks(
            opens=[f"By {self.pace.step(self.steps)}: {reached} visited, {lost}."],
            rows=[
                coverage_row(f"{meaning} {by}", getattr(found, meaning), cells, exact)
                for meaning, exact in zip(MEANINGS, self.exact, strict=True)
            ],
            marks=[(self.steps, "deadline")],
            settings={"deadline": self.pace.step(self.steps)},
        )
