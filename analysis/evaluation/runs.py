"""The runs that an evaluation's page plays: the plan without losses, and its median, worst and best rollout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from analysis.page.cell_maps import MOST_CELLS
from analysis.page.runs import Run
from analysis.recording.pick import Picker, parse_picks
from analysis.sampling import RolloutChoices, make_engine_for
from planner.none import NO_STEP
from planner.plans.plan import Plan
from planner.roaming import ways_of_movers
from planner.shown import counted, share
from planner.trace import Doing, Trace
from planner.worlds.world import World

PICKS = parse_picks("median,worst,best")
SHARE, MOST = 20, 5_000
"""The runs are chosen out of one rollout in SHARE, MOST of them: a small part of the time that all took."""
FEW = (10, 100)
"""Least rollouts that are looked at, on large maps and on small ones, and WORK between the two."""
WORK = 2_000_000
"""Steps of single robots that are always worth their time."""


def runs(world: World, plan: Plan, choices: RolloutChoices, rollouts: int, certain: bool) -> tuple[list[Run], str]:
    """The runs and where they come from; none for maps that are shown in blocks of cells.

    The same answer gives the same runs: how many of its `rollouts` are looked at depends on no clock.
    """
    if world.threat.size > MOST_CELLS:
        return [], ""
    if not looks(world, choices):
        played, note = [nominal(plan)], "The plan: the run in which nobody is lost."
    else:  # what is planned is what robots believe at first, and nobody drives it
        played, note = [], "Dark: what nobody has seen yet."
    if not certain:
        found, ids, looked_at = picked(world, plan, choices, rollouts)
        played += found
        some = counted(looked_at, "rollout")
        note += f" Median, worst and best by cells visited of the first {some}: numbers {', '.join(map(str, ids))}."
    return played, note


def looks(world: World, choices: RolloutChoices) -> bool:
    """Whether robots come to know the map by what they see."""
    return choices.loop == "closed" and world.knowledge is not None and world.knowledge.sense.range > 0


def nominal(plan: Plan) -> Run:
    """The plan's own paths; who has ended waits where it is."""
    cells = np.empty((plan.makespan + 1, len(plan.robots)), dtype=np.int32)
    for number, robot in enumerate(plan.robots):
        path = robot.path[: plan.makespan + 1]  # another planner's may wait at its end
        cells[: len(path), number] = path
        cells[len(path) :, number] = path[-1]
    return Run("plan", cells, np.full(len(plan.robots), NO_STEP))


def picked(world: World, plan: Plan, choices: RolloutChoices, total: int) -> tuple[list[Run], list[int], int]:
    """The runs of PICKS, their ids, and out of how many rollouts they were picked, as `record` picks them."""
    few = int(np.clip(WORK // ((plan.makespan + 1) * len(plan.robots)), *FEW))
    count = min(total, max(few, min(total // SHARE, MOST)))
    choices = replace(choices, deadline=None)
    if choices.luck == "step":
        choices = replace(choices, mode="step")
    engine = make_engine_for(world, plan, choices)
    results, picker = engine.results(0, count), Picker(engine.accessible)
    picker.add(results)
    ids = [picker.choose(pick, choices.seed) for pick in PICKS]
    shares = [share(int(results.visited[number]), engine.accessible) for number in ids]
    names = [f"{pick.name}, {covered}" for pick, covered in zip(PICKS, shares, strict=True)]
    traces = zip(names, engine.traces(ids), strict=True)
    return [run_of(name, trace, world, choices) for name, trace in traces], ids, count


def run_of(name: str, trace: Trace, world: World, choices: RolloutChoices) -> Run:
    """A rollout as the page plays it."""
    dead = trace.doing == Doing.DEAD
    told = world.movers is not None
    movers = ways_of_movers(world, choices.seed, trace.rollout, len(trace.cells)) if told else None
    known = world.knowledge if looks(world, choices) else None
    seen = None if known is None else known.first_seen(trace.cells, ~dead)
    return Run(name, trace.cells, np.where(dead.any(axis=0), dead.argmax(axis=0), NO_STEP), movers, seen)
