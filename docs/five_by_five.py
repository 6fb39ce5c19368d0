"""A map of five by five cells, its plan and its runs: the pictures of `how-it-works.md` and `all-of-it.md`."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

import mrac_jax as mrac
from planner.mrac.problem import prepare
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.single_run import Hit, SingleRun
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


def draw_grid(
    axes: Axes,
    title: str,
    labels: Sequence[Sequence[str]] = (),
    areas: NDArray[np.int64] | None = None,
    visited: NDArray[np.bool_] | None = None,
    path: NDArray[np.int64] | None = None,
) -> None:
    """Draw the map: a label in each cell, borders of `areas` `[5, 5]`, visited cells in grey, a path."""
    for (row, col), p in np.ndenumerate(threat):
        done = visited is not None and visited[row, col]
        colour = WALL if np.isnan(p) else DONE if done else COLOURS[p]
        axes.add_patch(plt.Rectangle((col, row), 1, 1, facecolor=colour, edgecolor="white"))
        if labels and not np.isnan(p):
            axes.text(col + 0.5, row + 0.5, labels[row][col], ha="center", va="center", fontsize=9)
    if areas is not None:
        draw_borders(axes, areas)
    if path is not None:
        rows, cols = np.divmod(path, 5)
        axes.plot(cols + 0.5, rows + 0.5, color=LINE, linewidth=2)
        axes.plot(cols[-1:] + 0.5, rows[-1:] + 0.5, "o", color=LINE)
    axes.set(xlim=(0, 5), ylim=(5, 0), aspect="equal")
    axes.set_title(title, fontsize=10)
    axes.axis("off")


def draw_borders(axes: Axes, areas: NDArray[np.int64]) -> None:
    """Draw lines between different areas; -1: no area."""
    for row, col in np.ndindex(5, 5):
        below, right = ((col, col + 1), (row + 1, row + 1)), ((col + 1, col + 1), (row, row + 1))
        for other, line in (((row + 1, col), below), ((row, col + 1), right)):
            if max(other) < 5 and areas[row, col] != areas[other] and min(areas[row, col], areas[other]) >= 0:
                axes.plot(*line, color=LINE, linewidth=1.8)


def panels(count: int) -> NDArray:
    """Return `count` empty axes in one row."""
    _, axes = plt.subplots(1, count, figsize=(3.2 * count, 3.5), layout="constrained")
    return axes


def run(hit: Hit = lambda robot, step, cell: False) -> Trace:
    """Return the run in which robot `robot` is lost at step `step` where `hit(robot, step, cell)` is true."""
    return SingleRun(loop, hit=hit).play().trace


def draw_robots(axes: Axes, trace: Trace, step: int) -> None:
    """Draw the robots at a step: a circle each, a cross if lost."""
    for robot, cell in enumerate(trace.cells[step]):
        row, col = divmod(int(cell), 5)
        lost = any(e[2] == EventKind.HIT and e[1] == robot and e[0] <= step for e in trace.events)
        axes.plot(col + 0.5, row + 0.5, "X" if lost else "o", color=ROBOTS[robot], markersize=17)
        axes.text(col + 0.5, row + 0.5, str(robot), color="white", ha="center", va="center", fontsize=9)


def visited_by(trace: Trace, step: int) -> NDArray[np.bool_]:
    """Return bool `[5, 5]`: the cells visited by the end of a step."""
    seen = np.zeros(25, bool)
    seen[trace.cells[: step + 1]] = True
    return seen.reshape(5, 5)


def events_at(trace: Trace, step: int) -> set[tuple[int, str]]:
    """Return the (robot, event) pairs of a step."""
    return {(int(e[1]), EventKind(e[2]).name) for e in trace.events if e[0] == step}


def draw_map() -> None:
    """Draw p and the areas."""
    number = np.full(25, -1)
    for index, area in enumerate(plan.areas):
        number[area.cells] = index
    number = number.reshape(5, 5)
    left, right = panels(2)
    draw_grid(left, "p, in %", [[f"{100 * p:.0f}" for p in row] for row in threat])
    draw_grid(right, "areas by number", [[str(a) for a in row] for row in number], areas=number)
    assert len(plan.areas) == 5 and [area.level for area in plan.areas] == [1, 2, 2, 0, 0]
    assert [area.robot for area in plan.areas] == [-1, -1, -1, 0, 1]


def draw_costs() -> None:
    """Draw the cost of entering each cell, and a safest path."""
    costs = problem.costs.reshape(5, 5) / 25
    path = np.array([23, *problem.paths.path(23, 14)])
    left, right = panels(2)
    draw_grid(left, "cost of entering", [[f"{c:.2g}" for c in row] for row in costs])
    draw_grid(right, "safest path: 5 moves; the shortest has 3", path=path)
    assert np.isclose(costs[0, 0], 1 / 25) and costs[4, 0] == 1 and costs[0, 4] == 2
    assert not threat.ravel()[path].any() and len(path) == 6


def draw_steps(trace: Trace, steps: Sequence[int]) -> None:
    """Draw a run at some steps."""
    for axes, step in zip(panels(len(steps)), steps, strict=True):
        draw_grid(axes, f"step {step}", visited=visited_by(trace, step))
        draw_robots(axes, trace, step)


def draw_nominal() -> None:
    """Draw the run without losses."""
    nominal = run()
    draw_steps(nominal, (0, 7, 12, 16))
    assert (0, "ALLOCATED") in events_at(nominal, 7) and (1, "ALLOCATED") in events_at(nominal, 12)
    assert (0, "SHARED") in events_at(nominal, 16) and nominal.time == 19
    assert nominal.areas[7, 0] == 0 and set(nominal.areas[12]) == {1, 2}


def draw_loss() -> None:
    """Draw the run in which robot 0 is lost at step 9."""
    loss = run(lambda robot, step, cell: robot == 0 and step == 9)
    draw_steps(loss, (8, 9, 17, 27))
    assert {(0, "HIT"), (0, "REALLOCATED")} == events_at(loss, 9) and loss.time == 27
    assert visited_by(loss, 27)[~np.isnan(threat)].all()
    assert [int(e[3]) for e in loss.events if e[2] == EventKind.ALLOCATED and e[1] == 1] == [5, 2, 1]


def draw_thresholds() -> None:
    """Draw the cumulative hazard of each robot in the run without losses, with a failure threshold for each."""
    cells = run().cells
    moved = np.vstack([np.zeros((1, 2), bool), cells[1:] != cells[:-1]])  # a robot that waits makes no visit
    hazard = np.cumsum(np.where(moved, -np.log1p(-np.nan_to_num(threat.ravel()))[cells], 0), axis=0)
    _, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for robot, threshold in enumerate((0.17, 0.5)):
        axes.step(range(len(cells)), hazard[:, robot], where="post", color=ROBOTS[robot], label=f"robot {robot}")
        axes.axhline(threshold, linestyle="--", color=ROBOTS[robot])
        lost = np.flatnonzero(hazard[:, robot] >= threshold)[:1]
        axes.plot(lost, hazard[lost, robot], "X", color=ROBOTS[robot], markersize=12)
    axes.set(xlabel="step", ylabel="cumulative hazard", title="A robot is lost where its hazard reaches its threshold")
    axes.legend(loc="center left")
    assert (hazard[-1] < 0.5).all() and hazard[-1, 0] >= 0.17


def draw_gradient() -> None:
    """Draw the exact gradient of the expected coverage in p, open loop: cells lost per point of p."""
    import jax

    functional = mrac.functional
    arrays = functional.arrays(world, plan)
    gradient = np.asarray(jax.grad(functional.expected_coverage, argnums=1)(arrays, world.threat)) / 100
    left, right = panels(2)
    draw_grid(left, "p, in %", [[f"{100 * p:.0f}" for p in row] for row in threat])
    draw_grid(right, "cells covered, for 1 point more of p", [[f"{g:.3f}" for g in row] for row in gradient])
    assert (gradient[~np.isnan(threat)] <= 0).all() and gradient.min() < -0.01


def draw_value() -> None:
    """Draw the steps of first visits by `per_cell`: all cells of equal value, and the lower right worth 10."""
    value = np.ones((5, 5))
    value[3:, 3:] = 10
    visits = []
    for axes, values, title in zip(panels(2), (1, value), ("equal values", "lower right: value 10"), strict=True):
        paths = [robot.path for robot in mrac.plan(mrac.load(threat, value=values), 2, policy="per_cell").robots]
        step = np.full(25, 99)
        for path in paths:
            np.minimum.at(step, path, np.arange(len(path)))
        visits.append(step.reshape(5, 5))
        draw_grid(axes, f"step of first visit, {title}", [[str(s) for s in row] for row in visits[-1]])
    assert visits[1][4, 4] < visits[0][4, 4] and max(v[~np.isnan(threat)].max() for v in visits) < 99
