"""Coverage by a deadline: the same rollouts, cut off at the end of a step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

from analysis.evaluation.figures import Figures
from analysis.evaluation.outputs.output import Blocks, Output, Run, coverage_row
from analysis.kit.words import percent
from analysis.theory.verdicts import MEANINGS
from planner.files import Json
from planner.pace import UNPACED, Pace
from planner.tally import Tally


@dataclass(frozen=True, eq=False)
class Deadline(Output):
    """Coverage by the end of step `steps`.

    Attributes:
        tally: of the rollouts cut off there. exact: the open loop's expected cells visited and survived by then.
        certain: every run is the same. pace: how long a step takes, if that is known.
    """

    steps: int
    tally: Tally
    exact: tuple[float, float]
    certain: bool = False
    pace: Pace = UNPACED

    @classmethod
    def measure(cls, asked: int, run: Run) -> Iterator[Self]:
        run.doing(f"rollouts up to the deadline, step {asked:,}")
        choices = replace(run.choices, rollouts=run.last.tally.rollouts, precision=None)
        for stage in run.roll_out(choices, asked):
            tally = stage.tally
            run.progress(tally.rollouts, choices.rollouts, stage.seconds)
        yield cls(asked, tally, run.exact.by_deadline(asked), run.certain, run.world.pace)

    @cached_property
    def figures(self) -> Figures:
        """What these rollouts come to."""
        return Figures.of(self.tally, self.certain)

    def as_json(self) -> Json:
        return {
            "steps": self.steps,
            **self.figures.coverage_json(),
            "losses": self.figures.losses.to_json(),
            "exact": {"open_loop": dict(zip(MEANINGS, self.exact, strict=True))},
        }

    def blocks(self) -> Blocks:
        found, cells = self.figures, self.tally.accessible
        reached, (lost, _) = found.visited.mean.mean * (1.0 / cells), found.losses.columns()
        by = f"by step {self.steps}{self.pace.also(self.steps)}"
        who = "" if "robot" in lost else " robot" + "s" * (self.tally.robots != 1)
        return Blocks(
            opens=[f"By {self.pace.step(self.steps)}: {percent(reached)} visited, {lost}{who} lost on average."],
            rows=[
                coverage_row(f"{meaning} {by}", getattr(found, meaning), cells, exact)
                for meaning, exact in zip(MEANINGS, self.exact, strict=True)
            ],
            marks=[(self.steps, "deadline")],
            settings={"deadline": self.pace.step(self.steps)},
        )
