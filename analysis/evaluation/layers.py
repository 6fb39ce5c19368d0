"""The results of an evaluation by cell, as layers of one map, for the page and for pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import NDArray

from analysis.evaluation.figures import NAMES, Expected, Rest
from analysis.page.elements import CellLayer, Run
from analysis.page.maps import MOST_CELLS, area_layers, chance_layers, p_text
from analysis.recording.record import Picker, parse_picks
from analysis.sampling import RolloutChoices, make_engine_for
from planner.formatting import counted, percent, share
from planner.plan.plan import Plan
from planner.rollout_sampling import threat_paths
from planner.simulator.codes import NO_STEP, Doing
from planner.tally import Trace
from planner.world.world import World

KINDS = ListedColormap(["#cfe3c3", "#8f96a3", "#b98fb5"])
"""Cells to do, done, and too far, as numbered in `analysis.evaluation.figures`."""


@dataclass(frozen=True, eq=False)
class Layers:
    """Values by cell.

    Attributes:
        plan: the threat, drawn below the plan's paths. threat, chance, losses: p, probability of coverage, robots lost.
        left: residual risk. areas: assignment of areas to robots; empty for plans without areas.
        to_do: remaining cells of a mission with a range or from a state.
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
    """Layers of the expected values.

    Args:
        how_known: source of the values. rest: remaining part of the mission, if it is not the whole.
        lines: description of the paths that a page draws on the map.
    """
    lost = expected.stops_by_cell
    threat, chance, losses = chance_layers(world, plan, expected.visited_by_cell, lost, how_known)
    rare = counted(int((expected.visited_by_cell[accessible.ravel()] < 0.5).sum()), "cell")
    covered = f" {percent(expected.visited / accessible.sum())} of the cells on average; {rare} below 50 %."
    left = CellLayer("Residual risk", "Threat times the chance that the cell is not covered.",
                     threat.values * (1 - chance.values), "losses", "%", root=True, digits=2)  # fmt: skip
    about = f"Colour: {p_text(plan, world)}. Paths: {lines}."
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
    about = f"Green: to visit; grey: visited before; violet: {rest.too_far}."
    return CellLayer("Cells to visit", about, rest.kinds.astype(np.float64), KINDS, norm=Normalize(0, len(NAMES) - 1),
                     names=NAMES, short="To visit")  # fmt: skip


# The runs that an evaluation's page plays: the plan without losses, and its median, worst and best rollout.

PICKS = parse_picks("median,worst,best")
SHARE, MOST = 20, 5_000
"""The runs are selected from one rollout in SHARE, at most MOST, so that this takes a small part of the total time."""
FEW = (10, 100)
"""Fewest rollouts considered, on large and on small maps; in between, WORK decides."""
WORK = 2_000_000
"""Robot steps that take negligible time."""


def runs(world: World, plan: Plan, choices: RolloutChoices, rollouts: int, certain: bool) -> tuple[list[Run], str]:
    """The runs and their caption; empty for maps that are shown in blocks of cells.

    The number of rollouts considered depends on `rollouts` only, not on time, so that equal results give equal runs.
    """
    if world.threat.size > MOST_CELLS:
        return [], ""
    if not looks(world, choices):
        played, note = [nominal(plan)], "The plan: the run without losses."
    else:  # the plan follows the prior map, and no robot drives it
        played, note = [], "Dark: cells not yet seen by any robot."
    if not certain:
        found, ids, looked_at = picked(world, plan, choices, rollouts)
        played += found
        some = counted(looked_at, "rollout")
        note += f" Median, worst and best by cells visited of the first {some}: numbers {', '.join(map(str, ids))}."
    return played, note


def looks(world: World, choices: RolloutChoices) -> bool:
    """Whether robots learn the map with a sensor."""
    return choices.loop == "closed" and world.knowledge is not None and world.knowledge.sensor.range > 0


def nominal(plan: Plan) -> Run:
    """The plan's own paths; a robot that has finished waits at its last cell."""
    cells = np.empty((plan.makespan + 1, len(plan.robots)), dtype=np.int32)
    for number, robot in enumerate(plan.robots):
        path = robot.path[: plan.makespan + 1]  # an external plan may wait at its end
        cells[: len(path), number] = path
        cells[len(path) :, number] = path[-1]
    return Run("plan", cells, np.full(len(plan.robots), NO_STEP))


def picked(world: World, plan: Plan, choices: RolloutChoices, total: int) -> tuple[list[Run], list[int], int]:
    """The runs of PICKS, their ids, and the number of rollouts considered, as `record` picks them."""
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
    """A rollout in the form that the page plays."""
    dead = trace.doing == Doing.DEAD
    moving = world.moving_threats is not None
    threats = threat_paths(world, choices.seed, trace.rollout, len(trace.cells)) if moving else None
    known = world.knowledge if looks(world, choices) else None
    seen = None if known is None else known.first_seen(trace.cells, ~dead)
    return Run(name, trace.cells, np.where(dead.any(axis=0), dead.argmax(axis=0), NO_STEP), threats, seen)
