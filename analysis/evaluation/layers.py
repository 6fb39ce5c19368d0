"""What an evaluation says cell by cell, as layers of one map: for the page and for pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import NDArray

from analysis.evaluation.figures import NAMES, Expected, Rest
from analysis.page.maps import MOST_CELLS, CellLayer, Run, area_layers, chance_layers, p_words
from analysis.pictures import LOSSES
from analysis.recording.record import Picker, parse_picks
from analysis.sampling import RolloutChoices, make_engine_for
from planner.formatting import counted, percent, share
from planner.plan.plan import Plan
from planner.rollout_sampling import ways_of_movers
from planner.simulator.codes import NO_STEP, Doing
from planner.tally import Trace
from planner.world.world import World

KINDS = ListedColormap(["#cfe3c3", "#8f96a3", "#b98fb5"])
"""Cells to do, done, and too far, as `analysis.evaluation.figures` numbers them."""


@dataclass(frozen=True, eq=False)
class Layers:
    """A value for each cell.

    Attributes:
        plan: the threat, below the plan's paths. threat, chance, losses: of the map, covered, robots lost.
        left: what is left of the risk. areas: who holds which; none of paths alone.
        to_do: what is left to do, of a mission that is limited or under way.
    """

    plan: CellLayer
    threat: CellLayer
    chance: CellLayer
    losses: CellLayer
    left: CellLayer
    areas: list[CellLayer]
    to_do: list[CellLayer]


def layers_of(
    world: World, plan: Plan, accessible: NDArray[np.bool_], expected: Expected, how_known: str, rest: Rest | None,
    lines: str = "the plan",
) -> Layers:  # fmt: skip
    """Of expected values; `how_known`, and what the `lines` over the map are, which a page draws on demand: in words.

    `rest`: of the mission, where that is not all of it.
    """
    lost = expected.stops_by_cell
    threat, chance, losses = chance_layers(world, plan, expected.visited_by_cell, lost, how_known)
    rare = counted(int((expected.visited_by_cell[accessible.ravel()] < 0.5).sum()), "cell")
    covered = f" {percent(expected.visited / accessible.sum())} of the cells on average; {rare} below 50 %."
    left = CellLayer("Residual risk", "Threat times the chance that the cell is not covered.",
                     threat.values * (1 - chance.values), LOSSES, "%", root=True, digits=2)  # fmt: skip
    about = f"Colour: {p_words(plan, world)}. Paths: {lines}."
    return Layers(
        replace(threat, name="The map and the plan", about=about),
        threat,
        replace(chance, about=chance.about + covered),
        replace(losses, about=f"{losses.about} {lost.sum():.2f} in all."),
        left,
        list(area_layers(plan)),
        [] if rest is None else [_to_do(rest)],
    )


def _to_do(rest: Rest) -> CellLayer:
    about = f"Green: to do; grey: visited before; violet: {rest.too_far}."
    return CellLayer("What is to do", about, rest.kinds.astype(np.float64), KINDS, norm=Normalize(0, len(NAMES) - 1),
                     names=NAMES, short="To do")  # fmt: skip


# The runs that an evaluation's page plays: the plan without losses, and its median, worst and best rollout.

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
