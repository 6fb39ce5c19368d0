"""Coverage by a deadline: the same rollouts, cut off at the end of a step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Self

from analysis.evaluation.outputs.output import Output, Row, Run, coverage_row
from analysis.kit.words import percent
from analysis.statistics.control import tally_mean
from analysis.statistics.coverage import coverage_json, expected_losses, losses_shown
from planner.files import Json
from planner.tally import Tally


@dataclass(frozen=True, eq=False)
class Deadline(Output):
    """Coverage by the end of step `steps`.

    Attributes:
        tally: of the rollouts cut off there. exact: the open loop's expected cells visited and survived by then.
        certain: every run is the same.
    """

    steps: int
    tally: Tally
    exact: tuple[float, float]
    certain: bool = False

    @classmethod
    def measure(cls, asked: int, run: Run) -> Iterator[Self]:
        run.doing(f"rollouts up to the deadline, step {asked:,}")
        choices = replace(run.choices, rollouts=run.last.tally.rollouts, precision=None)
        for stage in run.roll_out(choices, asked):
            tally = stage.tally
            run.progress(tally.rollouts, choices.rollouts, stage.seconds)
        yield cls(asked, tally, run.exact.by_deadline(asked), run.certain)

    def as_json(self) -> Json:
        exact = dict(zip(("visited", "survived"), self.exact, strict=True))
        return {
            "steps": self.steps,
            **coverage_json(self.tally, self.certain),
            "losses": expected_losses(self.tally, self.certain).to_json(),
            "exact": {"open_loop": exact},
        }

    def rows(self) -> Iterable[Row]:
        for meaning, exact in zip(("visited", "survived"), self.exact, strict=True):
            tally, name = self.tally, f"{meaning} by step {self.steps}"
            yield coverage_row(name, tally, meaning, tally.accessible, exact, self.certain)

    def sentences(self) -> Iterable[str]:
        reached = tally_mean(self.tally, "visited", 1.0 / self.tally.accessible, certain=self.certain)
        low, high = map(percent, reached.ci95)
        yield f"By the deadline, step {self.steps:,}, {percent(reached.mean)} are visited on average ({low} to {high})."

    def footnotes(self) -> Iterable[str]:
        lost, _ = losses_shown(expected_losses(self.tally), self.tally.robots)
        yield f"robots lost by step {self.steps:,}: {lost} on average"

    def settings(self) -> dict[str, str]:
        return {"deadline": f"step {self.steps:,}"}
