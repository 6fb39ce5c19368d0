"""The closed loop's mean sharpened by the open loop's exact value (`analysis.statistics.control`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from analysis.evaluation.outputs.output import Output, Row, Run
from analysis.sampling import Stage
from analysis.statistics.control import Controlled, controlled
from analysis.statistics.estimate import exactly
from analysis.theory.exact import OpenLoopExact
from analysis.theory.verdicts import MEANINGS
from planner.arguments import argument
from planner.files import Json
from planner.worlds.world import World


@dataclass(frozen=True)
class ControlVariate(Output):
    """Visited and survived coverage, fractions, with the open loop as the control.

    Attributes:
        means: both of them. known: the closed loop's expected values are known exactly, and say more.
    """

    means: tuple[Controlled, Controlled]
    known: bool
    own_rollouts = False

    @classmethod
    def check(cls, asked: bool, world: World) -> None:
        world.check_settled(argument("control_variate"))

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        yield cls(sharpened(run.last, run.exact), run.known)

    def as_json(self) -> Json:
        said = [one.estimate.to_json() | {"gain": one.gain, "weight": one.weight} for one in self.means]
        return dict(zip(MEANINGS, said, strict=True))

    def rows(self) -> Iterable[Row]:
        for meaning, one in zip(MEANINGS, self.means if not self.known else (), strict=False):
            low, high = (f"{100 * bound:.2f}" for bound in one.estimate.ci95)
            yield Row(f"{meaning}, controlled", "", (f"{100 * one.estimate.mean:.2f}", f"{low} .. {high}", "", "", ""))

    def footnotes(self) -> Iterable[str]:
        gains = [f"{one.gain:.2f}" for one in self.means]
        yield f"open loop as control variate: variance {gains[0]} (visited) and {gains[1]} (survived) times smaller"


def sharpened(stage: Stage, exact: OpenLoopExact) -> tuple[Controlled, Controlled]:
    """Visited and survived coverage of the rollouts so far; where every run is the same there is nothing to sharpen."""
    tally = stage.tally
    cells, known = tally.accessible, (exact.visited, exact.survived)
    if stage.pairs is None:
        sums = (int(counts @ np.arange(cells + 1)) for counts in (tally.visited, tally.survived))
        visited, survived = (Controlled(exactly(covered / tally.rollouts / cells), 0.0, 1.0) for covered in sums)
    else:
        visited, survived = (controlled(p, k, cells, 1.0 / cells) for p, k in zip(stage.pairs, known, strict=True))
    return visited, survived
