"""The pictures of `docs/teams.md` and `docs/mission.md`: robots half as fast, radio, and batteries that are charged.

python docs/examples/team_pictures.py FOLDER writes `teams-speeds.png`, `teams-radio.png` and `mission-recharge.png`.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import mrac_jax as mrac
from analysis.pictures import ROBOT_COLOURS, picture_style

REACH = 6
RANGE, CHARGE = 120, 10


SITE = """
map: site.csv
threats:
  - {generate: {kind: contiguous, ratio: 0.3, areas: 3, levels: [0.04, 0.08], seed: 1}}
  - {generate: {kind: scattered, ratio: 0.1, levels: [0.1], seed: 2}}
"""


def site() -> mrac.World:
    """The site of `docs/teams.md` without its types."""
    with TemporaryDirectory() as folder:
        np.savetxt(Path(folder, "site.csv"), np.zeros((20, 20)), delimiter=",")
        Path(folder, "site.yaml").write_text(SITE, encoding="utf-8")
        return mrac.load(Path(folder, "site.yaml"))


def places(plan: mrac.Plan) -> NDArray[np.int64]:
    """int64 `[T + 1, K]`: the cell of each robot at each step, if no robot is lost."""
    last = max(len(robot.path) for robot in plan.robots)
    return np.array([np.pad(robot.path, (0, last - len(robot.path)), mode="edge") for robot in plan.robots]).T


def firsts(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """int64 `[T + 1, K]`: how many cells each robot was the first in, up to each step."""
    seen: set[int] = set()
    new = np.zeros(cells.shape, dtype=np.int64)
    for step, row in enumerate(cells.tolist()):
        for robot, cell in enumerate(row):
            new[step, robot] = cell not in seen
            seen.add(cell)
    return new.cumsum(axis=0)


def links(at: NDArray[np.int64], bases: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Who hears whom: from the bases on, of each robot in touch where it is, and the robot or base that it hears.

    `at` int64 `[K, 2]`, `bases` `[B, 2]`.
    """
    found, reached, left = [], list(bases), list(at)
    while near := [(one, by) for one in left for by in reached if ((one - by) ** 2).sum() <= REACH**2]:
        one, by = near[0]
        found.append((one, by))
        reached.append(one)
        left = [other for other in left if other is not one]
    return found


def speeds(world: mrac.World) -> Figure:
    """Cells that each robot is the first in, over time: all as fast, and two of four half as fast."""
    figure = Figure((8, 3.2), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for axis, paces, name in zip(axes, (None, [1, 1, 2, 2]), ("All as fast", "2 and 3 half as fast"), strict=True):
        found = firsts(places(mrac.plan(world, 4, steps_per_move=paces)))
        for robot, curve in enumerate(found.T):
            axis.plot(curve, color=ROBOT_COLOURS[robot], label=f"robot {robot}: {curve[-1]} cells")
        axis.set(title=f"{name}: all done at step {len(found) - 1}", xlabel="step")
        axis.legend(loc="lower right")
    axes[0].set_ylabel("cells that it was the first in")
    return figure


def radio(world: mrac.World) -> Figure:
    """Who hears whom at the moment at which most hear each other through others; and what is visited by when."""
    plans = {reach: mrac.plan(world, 4, radio=reach) for reach in (None, 9, REACH)}
    cells, width, bases = places(plans[REACH]), world.shape[1], np.unique(plans[REACH].starts, axis=0)
    steps = [np.stack(np.divmod(row, width), axis=1) for row in cells]
    chains = [links(at, bases) for at in steps]
    relayed = [
        sum(any((by == at).all(axis=1)) and len(chain) < 4 for _, by in chain)
        for at, chain in zip(steps, chains, strict=True)
    ]
    step = int(np.argmax(relayed))
    figure = Figure((8, 3.6), layout="constrained")
    on_map, over_time = figure.subplots(1, 2, width_ratios=(1, 1.25))
    on_map.imshow(world.threat, cmap="Reds", vmax=0.3)
    heard = {tuple(one) for one, _ in chains[step]}
    turn = np.linspace(0, 2 * np.pi, 100)
    for place in (*bases, *(np.array(one) for one in heard)):
        on_map.plot(place[1] + REACH * np.cos(turn), place[0] + REACH * np.sin(turn), color="#5b6470", linewidth=0.6)
    for one, by in chains[step]:
        on_map.plot([one[1], by[1]], [one[0], by[0]], color="#20242b", linewidth=1)
    on_map.plot(bases[:, 1], bases[:, 0], "^", color="#20242b", markersize=7)
    for robot, (row, col) in enumerate(steps[step].tolist()):
        look = {"markerfacecolor": ROBOT_COLOURS[robot] if (row, col) in heard else "white"}
        on_map.plot(col, row, "o", color=ROBOT_COLOURS[robot], markersize=9, markeredgewidth=2, **look)
    on_map.set(xlim=(-0.5, width - 0.5), ylim=(world.shape[0] - 0.5, -0.5), xticks=[], yticks=[])
    on_map.set_title(f"Radio {REACH}, step {step}: who hears whom")
    for (reach, plan), style in zip(plans.items(), ("-", "--", ":"), strict=True):
        curve = firsts(places(plan)).sum(axis=1)
        name = "everybody hears everybody" if reach is None else f"radio {reach}"
        over_time.plot(curve, color="#20242b", linestyle=style, label=f"{name}: step {len(curve) - 1}")
    over_time.set(xlabel="step", title="Cells visited, if no robot is lost")
    over_time.legend(loc="lower right")
    return figure


def recharge() -> Figure:
    """Moves left and cells visited, over time, of four robots that are charged at their starts."""
    world = mrac.load("example:paper")
    plan = mrac.plan(world, 4, range=RANGE, return_to="home", recharge=CHARGE)
    cells = places(plan)
    figure = Figure((8, 3.6), layout="constrained")
    left, done = figure.subplots(2, 1, sharex=True)
    for robot, path in enumerate(cells.T.tolist()):
        moves, curve, stood = RANGE, [RANGE], 0
        for before, now in pairwise(path):
            stood = stood + 1 if before == now else 0
            moves = RANGE if stood >= CHARGE and now == path[0] else moves - (before != now)
            curve.append(moves)
        left.plot(curve, color=ROBOT_COLOURS[robot], label=f"robot {robot}")
    left.set(ylabel="moves left", title="Four robots of 120 moves, ten steps to charge: if no robot is lost")
    left.set_ylim(-5, 175)
    left.legend(ncols=4, loc="upper right")
    done.plot(firsts(cells).sum(axis=1), color="#20242b", label="charged")
    without = mrac.plan(world, 4, range=RANGE, return_to="home")
    curve = firsts(places(without)).sum(axis=1)
    done.plot(
        np.pad(curve, (0, len(cells) - len(curve)), mode="edge"), color="#20242b", linestyle="--", label="not charged"
    )
    done.set(xlabel="step", ylabel="cells visited")
    done.legend(loc="lower right")
    return figure


def main(folder: Path) -> None:
    """Draw all of them."""
    with picture_style():
        drawn = {"teams-speeds": speeds(site()), "teams-radio": radio(site()), "mission-recharge": recharge()}
        for name, figure in drawn.items():
            figure.savefig(folder / f"{name}.png", dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
