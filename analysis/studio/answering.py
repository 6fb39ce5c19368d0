"""The answer to a board, line after line: the open loop's exact one, then the closed loop's until it is sure."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from analysis.page.cell_maps import STEPS, CellLayer, packed_layer
from analysis.page.plan_paths import path_lines, thickness
from analysis.pictures.style import COVERED, LOSSES
from analysis.sampling import RolloutChoices, make_roll_out
from analysis.statistics.control import tally_mean
from analysis.statistics.estimate import Estimate, exactly
from analysis.studio import words
from analysis.studio.sketch import Sketch
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.trials.exact_loop import closed_truth
from analysis.trials.measured import Measured
from analysis.trials.told import with_eyes
from analysis.trials.trial import alike
from planner.files import Json
from planner.kernels.tables import AllPairs
from planner.plan_team import plan_team
from planner.plans.plan import Plan, is_certain
from planner.tally import Tally

PRECISION = 0.005
"""Half the width of the 95 % interval of mean coverage at which the rollouts end, as `--precision` takes it."""
MOST_PAIRS = 2048
"""Rollouts of teams with other eyes, each: on the same luck they tell as much as several times as many."""
SHOWN_SECONDS = 0.25
"""Between two lines of rollouts that go on."""
GoOn = Callable[[], None]
"""Raises what ends the work if nobody waits for it any more."""


@dataclass(frozen=True, eq=False)
class Board:
    """A board with its plan.

    Attributes:
        accessible: bool `[H, W]`. exact: the open loop's values. certain: every run is the same.
    """

    sketch: Sketch
    plan: Plan
    accessible: NDArray[np.bool_]
    exact: OpenLoopExact
    certain: bool
    notes: tuple[str, ...]

    def open_line(self) -> Json:
        """The open loop's line, which comes first and holds the planned paths too; null: too long to draw."""
        exact = self.exact
        mean, losses = exactly(exact.visited / int(self.accessible.sum())), exactly(exact.expected_losses)
        said = words.headline(len(self.plan.robots), mean, losses, alone=True)
        line = self._line("open", said, None, None, 0, [exact.visited_by_cell, exact.stops_by_cell])
        return line | {"paths": path_lines(self.plan), "thickness": thickness(self.plan)}

    def closed_line(
        self,
        stage: str,
        tally: Tally,
        known: Estimate | None = None,
        by_deadline: Estimate | None = None,
        knowing: Sequence[Measured] = (),
    ) -> Json:
        """The closed loop's line; `known`: its mean where that is exact; `knowing`: of `with_other_eyes`."""
        mean, losses = known or visited_mean(tally), tally_mean(tally, "lost", certain=self.certain)
        said = words.headline(tally.robots, mean, losses)
        maps = [tally.covered_visited / tally.rollouts, tally.stops / tally.rollouts]
        line = self._line(stage, said, mean, losses, tally.rollouts, maps, by_deadline)
        if self.sketch.world.knowledge is None:
            return line
        figures = [*line["figures"], *words.knowledge_figures(knowing)]
        return line | {"figures": figures, "paths": None, "thickness": 0}  # nobody drives what is planned

    def _line(
        self,
        stage: str,
        headline: str,
        mean: Estimate | None,
        losses: Estimate | None,
        rollouts: int,
        maps: list[NDArray[np.float64]],
        by_deadline: Estimate | None = None,
    ) -> Json:
        """What the page is told; `maps`: chance covered and robots lost, `[N]` each."""
        world, cells = self.sketch.world, int(self.accessible.sum())
        alone = self.exact if world.knowledge is None else None
        figures = words.figures(cells, len(self.plan.robots), mean, losses, rollouts, alone)
        figures += words.deadline_figures(self.sketch.deadline, world.pace, by_deadline, alone, cells)
        covered, lost = (values.reshape(world.shape) for values in maps)
        layers = (
            CellLayer("Coverage", "", covered, COVERED, "%", digits=2),
            CellLayer("Losses", "", lost, LOSSES, root=True),
        )
        return {
            "stage": stage,
            "headline": headline,
            "figures": figures,
            "notes": self.notes,
            "rollouts": rollouts,
            "starts": self.plan.starts.tolist(),
            "steps": STEPS,
            "layers": [packed_layer(layer, ~np.isnan(world.met), self.accessible) for layer in layers],
        }


def visited_mean(tally: Tally) -> Estimate:
    """Mean visited coverage, a fraction of the accessible cells."""
    return tally_mean(tally, "visited", 1.0 / tally.accessible)


def with_other_eyes(board: Board, choices: RolloutChoices) -> list[Measured]:
    """The team that is told the map, the team itself, and where the obstacles are known one that is blind."""
    world = board.sketch.world
    assert world.knowledge is not None
    known, sees = world.knowledge, world.knowledge.sense.range
    ranges = [inf, sees, *[0.0] * (sees > 0 and known.may_be_blind(world.free))]
    teams = [with_eyes(world, board.plan, far, replace(choices, exact="never")) for far in ranges]
    return list(alike(teams, 0, choices.rollouts))


def answers(sketch: Sketch, seed: int, kept: AllPairs, go_on: GoOn) -> Iterator[Json]:
    """Lines for the page, each surer than the one before. Raises InputError, and what `go_on` raises.

    The figures are those of `evaluate` for so many rollouts of this seed; `kept` holds tables from board to board.
    """
    starts, notes = sketch.starts()
    plan = plan_team(sketch.world, starts, sketch.settings)
    go_on()
    exact, certain = open_loop_exact(plan, sketch.world), is_certain(sketch.world, plan)
    board = Board(sketch, plan, sketch.world.accessible(starts), exact, certain, (*notes, *plan.notes))
    if sketch.world.knowledge is None:
        yield board.open_line()
    choices = RolloutChoices(rollouts=1, precision=None if certain else PRECISION, seed=seed)
    roll_out = make_roll_out(sketch.world, plan, choices, kept=kept)
    looked, shown = 0, time.monotonic()
    for stage in roll_out(choices, None):
        go_on()
        tally = stage.tally
        if tally.rollouts >= 2 * looked:  # who looks more often than that stops too early
            looked = tally.rollouts
            if certain or visited_mean(tally).half_width < PRECISION:
                break
        if time.monotonic() - shown > SHOWN_SECONDS:
            yield board.closed_line("closed", tally)
            shown = time.monotonic()
    yield board.closed_line("sure", tally)
    by_deadline = None
    if sketch.deadline is not None:
        for cut in roll_out(replace(choices, rollouts=tally.rollouts, precision=None), sketch.deadline):
            go_on()
            by_deadline = tally_mean(cut.tally, "visited", 1.0 / tally.accessible, certain=certain)
    knowing: list[Measured] = []
    if sketch.world.knowledge is not None:
        knowing = with_other_eyes(board, replace(choices, rollouts=min(tally.rollouts, MOST_PAIRS), precision=None))
        yield board.closed_line("sure", tally, None, by_deadline, knowing)
    go_on()
    truth = closed_truth(plan, sketch.world, exact, choices, kept)
    known = None if truth is None else exactly(truth.visited.value / tally.accessible)
    yield board.closed_line("done", tally, known, by_deadline, knowing)
