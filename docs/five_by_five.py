"""The map of five by five cells of `how-it-works.md`: its plan, its runs, and how they are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

import mrac_jax as mrac
from planner.mrac.problem import prepare
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.single_run import Hit, SingleRun, play
from planner.simulator.codes import EventKind
from planner.tally import Trace

X = np.nan
threat = np.array(
    [
        [0, 0, 0, 0.1, 0.1],
        [0, X, 0, 0.1, 0.1],
        [0, 0, 0, 0, 0],
        [0.05, 0.05, 0, X, 0],
        [0.05, 0.05, 0, 0, 0.1],
    ]
)
world = mrac.load(threat)
plan = mrac.plan(world, robots=2)
problem = prepare(world, plan.starts, mrac.Settings())
loop = compile_closed_loop(plan, world, problem=problem, interpreted=True)

COLOURS = {0.0: "#eef3ea", 0.05: "#f9d9a6", 0.1: "#ef9a76"}
WALL, DONE, LINE = "#4a4f57", "#b9c4d6", "#333333"
ROBOTS = ("#1457a8", "#a3195b")


def board(
    axes: Axes,
    title: str,
    words: Sequence[Sequence[str]] = (),
    areas: NDArray[np.int64] | None = None,
    visited: NDArray[np.bool_] | None = None,
    path: NDArray[np.int64] | None = None,
) -> None:
    """The map: what each cell says, borders of `areas` `[5, 5]`, cells visited in grey, a path of cells."""
    for (row, col), p in np.ndenumerate(threat):
        done = visited is not None and visited[row, col]
        colour = WALL if np.isnan(p) else DONE if done else COLOURS[p]
        axes.add_patch(plt.Rectangle((col, row), 1, 1, facecolor=colour, edgecolor="white"))
        if words and not np.isnan(p):
            axes.text(col + 0.5, row + 0.5, words[row][col], ha="center", va="center", fontsize=9)
    if areas is not None:
        borders(axes, areas)
    if path is not None:
        rows, cols = np.divmod(path, 5)
        axes.plot(cols + 0.5, rows + 0.5, color=LINE, linewidth=2)
        axes.plot(cols[-1:] + 0.5, rows[-1:] + 0.5, "o", color=LINE)
    axes.set(xlim=(0, 5), ylim=(5, 0), aspect="equal")
    axes.set_title(title, fontsize=10)
    axes.axis("off")


def borders(axes: Axes, areas: NDArray[np.int64]) -> None:
    """Lines between different areas; -1 is none."""
    for row, col in np.ndindex(5, 5):
        below, right = ((col, col + 1), (row + 1, row + 1)), ((col + 1, col + 1), (row, row + 1))
        for other, line in (((row + 1, col), below), ((row, col + 1), right)):
            if max(other) < 5 and areas[row, col] != areas[other] and min(areas[row, col], areas[other]) >= 0:
                axes.plot(*line, color=LINE, linewidth=1.8)


def boards(count: int) -> NDArray:
    """So many empty pictures beside each other."""
    _, axes = plt.subplots(1, count, figsize=(3.2 * count, 3.5), layout="constrained")
    return axes


def run(hit: Hit = lambda robot, step, cell: False) -> Trace:
    """The run in which `hit(robot, step, cell)` says who is stopped."""
    return play(SingleRun(loop, hit=hit)).trace


def robots_at(axes: Axes, trace: Trace, step: int) -> None:
    """Where the robots are; a lost one is a cross."""
    for robot, cell in enumerate(trace.cells[step]):
        row, col = divmod(int(cell), 5)
        lost = any(e[2] == EventKind.HIT and e[1] == robot and e[0] <= step for e in trace.events)
        axes.plot(col + 0.5, row + 0.5, "X" if lost else "o", color=ROBOTS[robot], markersize=17)
        axes.text(col + 0.5, row + 0.5, str(robot), color="white", ha="center", va="center", fontsize=9)


def visited_by(trace: Trace, step: int) -> NDArray[np.bool_]:
    """Bool `[5, 5]`: visited by the end of a step."""
    seen = np.zeros(25, bool)
    seen[trace.cells[: step + 1]] = True
    return seen.reshape(5, 5)


def happened(trace: Trace, step: int) -> set[tuple[int, str]]:
    """(robot, what) of a step."""
    return {(int(e[1]), EventKind(e[2]).name) for e in trace.events if e[0] == step}


def draw_map() -> None:
    """p, and the areas."""
    number = np.full(25, -1)
    for index, area in enumerate(plan.areas):
        number[area.cells] = index
    number = number.reshape(5, 5)
    left, right = boards(2)
    board(left, "p, in %", [[f"{100 * p:.0f}" for p in row] for row in threat])
    board(right, "areas by number", [[str(a) for a in row] for row in number], areas=number)
    assert len(plan.areas) == 5 and [area.level for area in plan.areas] == [1, 2, 2, 0, 0]
    assert [area.robot for area in plan.areas] == [-1, -1, -1, 0, 1]


def draw_costs() -> None:
    """What entering each cell costs, and a safest path."""
    costs = problem.costs.reshape(5, 5) / 25
    path = np.array([23, *problem.paths.path(23, 14)])
    left, right = boards(2)
    board(left, "cost of entering", [[f"{c:.2g}" for c in row] for row in costs])
    board(right, "safest path: 5 moves; the shortest has 3", path=path)
    assert np.isclose(costs[0, 0], 1 / 25) and costs[4, 0] == 1 and costs[0, 4] == 2
    assert not threat.ravel()[path].any() and len(path) == 6


def draw_steps(trace: Trace, steps: Sequence[int]) -> None:
    """A run at four steps."""
    for axes, step in zip(boards(len(steps)), steps, strict=True):
        board(axes, f"step {step}", visited=visited_by(trace, step))
        robots_at(axes, trace, step)


def draw_calm() -> None:
    """The run without losses."""
    calm = run()
    draw_steps(calm, (0, 7, 12, 16))
    assert (0, "ALLOCATED") in happened(calm, 7) and (1, "ALLOCATED") in happened(calm, 12)
    assert (0, "SHARED") in happened(calm, 16) and calm.time == 19
    assert calm.areas[7, 0] == 0 and set(calm.areas[12]) == {1, 2}


def draw_hurt() -> None:
    """The run in which robot 0 is stopped at step 9."""
    hurt = run(lambda robot, step, cell: robot == 0 and step == 9)
    draw_steps(hurt, (8, 9, 17, 27))
    assert {(0, "HIT"), (0, "REALLOCATED")} == happened(hurt, 9) and hurt.time == 27
    assert visited_by(hurt, 27)[~np.isnan(threat)].all()
    assert [int(e[3]) for e in hurt.events if e[2] == EventKind.ALLOCATED and e[1] == 1] == [5, 2, 1]
