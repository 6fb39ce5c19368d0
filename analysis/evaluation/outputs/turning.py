"""How far the robots drive, how often they turn, and how long the mission takes with that: of runs in full."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.kit.tables import make_table
from analysis.sampling import make_engine_for
from analysis.statistics.estimate import Estimate, mean_of
from analysis.theory.longest import longest_run
from planner.files import Json
from planner.pace import TURNS, UNPACED, Pace
from planner.plans.turns import Drive, drive_of
from planner.shown import counted
from planner.worlds.world import World

LEAST, MOST, WORK = 100, 1000, 2_000_000
"""Rollouts that are run in full, and steps of single robots that are worth their time."""
FINE = 1000
"""Times with turns are told in thousandths of a step."""


@dataclass(frozen=True, eq=False)
class Turning(Output):
    """What robots drive in a run of the loop that was evaluated, and in the run without losses.

    Attributes:
        turn: steps that a quarter turn costs. nominal: of the plan. rollouts: run in full, the first ones.
        moves, turns: of all robots. time: steps, turns in it. pace: how long a step takes, if that is known.
    """

    turn: float
    nominal: Drive
    rollouts: int
    moves: Estimate
    turns: Estimate
    time: Estimate
    pace: Pace = UNPACED

    @classmethod
    def check(cls, asked: object, world: World) -> None:
        TURNS.check("turn", asked)

    @classmethod
    def measure(cls, asked: float, run: Run) -> Iterator[Self]:
        plan, choices = run.plan, replace(run.choices, deadline=None)
        if choices.luck == "step":
            choices = replace(choices, mode="step")
        worth = int(np.clip(WORK // ((plan.makespan + 1) * len(plan.robots)), LEAST, MOST))
        count = min(run.last.tally.rollouts, worth)
        run.doing(f"turns of {counted(count, 'rollout')}")
        traces = make_engine_for(run.world, plan, choices).traces(range(count))
        drives = [drive_of(trace.cells.T) for trace in traces]
        steps = longest_run(run.world, plan, choices.loop)

        def mean(values: list[int], most: float, unit: float = 1.0) -> Estimate:
            return mean_of(*np.unique(values, return_counts=True), unit, int(most), run.certain)

        robots = len(plan.robots)
        yield cls(
            asked,
            drive_of(robot.path for robot in plan.robots),
            count,
            mean([int(one.moves.sum()) for one in drives], robots * steps),
            mean([int(one.turns.sum()) for one in drives], 2 * robots * steps),
            mean([round(FINE * one.time(asked)) for one in drives], FINE * steps * (1 + 2 * asked), 1 / FINE),
            run.world.pace,
        )

    def as_json(self) -> Json:
        return {
            "cost": self.turn,
            "rollouts": self.rollouts,
            "moves": self.moves.to_json(),
            "quarter_turns": self.turns.to_json(),
            "time": self.time.to_json(),
            "nominal": {
                "moves": int(self.nominal.moves.sum()),
                "quarter_turns": int(self.nominal.turns.sum()),
                "time": self.nominal.time(self.turn),
            },
        }

    def blocks(self) -> Blocks:
        """A row for what is driven, one for what it takes."""
        table = make_table(("", "mean", "95 % interval", "nobody lost"), "What the robots drive")
        nominal, pace, cost = self.nominal, self.pace, counted(float(self.turn), "step")
        for name, found, known in (
            ("moves", self.moves, f"{int(nominal.moves.sum()):,}"),
            ("quarter turns", self.turns, f"{int(nominal.turns.sum()):,}"),
            ("time with turns, steps", self.time, f"{nominal.time(self.turn):,.1f}"),
        ):
            table.add_row(name, *found.columns(), known)
        if pace:
            known = f"{pace.minutes * nominal.time(self.turn):,.1f}"
            table.add_row("time with turns, minutes", *self.time.columns(pace.minutes), known)
        note = (
            f"A quarter turn costs {cost}; the mean is of the first {counted(self.rollouts, 'rollout')}. "
            "Turns lengthen the time that is said here, and nothing else."
        )
        return Blocks(tables=[table], notes=[note], settings={"a quarter turn": cost})
