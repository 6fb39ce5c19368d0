"""Coverage by a deadline: the same rollouts, cut off at the end of a step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

from analysis.evaluation.outputs.output import Blocks, Output, Run, coverage_row
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

    def blocks(self) -> Blocks:
        tally, certain = self.tally, self.certain
        reached = tally_mean(tally, "visited", 1.0 / tally.accessible, certain=certain)
        lost, _ = losses_shown(expected_losses(tally, certain), tally.robots)
        who = "" if "robot" in lost else " robot" + "s" * (tally.robots != 1)
        return Blocks(
            opens=[f"By step {self.steps:,}: {percent(reached.mean)} visited, {lost}{who} lost on average."],
            rows=[
                coverage_row(f"{meaning} by step {self.steps}", tally, meaning, tally.accessible, exact, certain)
                for meaning, exact in zip(("visited", "survived"), self.exact, strict=True)
            ],
            marks=[(self.steps, "deadline")],
            settings={"deadline": f"step {self.steps:,}"},
        )
