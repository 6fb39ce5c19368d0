"""The figures of `docs/unknown.md`, compared with MISTLab's DORA-Explorer: ten robots, ten unknown maps, one minute.

python docs/examples/dora_explorer.py CHECKOUT STARTS ROLLOUTS; CHECKOUT is a clone of its repository; 20 and 100 are
behind the figures.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

import mrac_jax as mrac
from planner.make_plan import make_plan
from planner.rollouts.engine import Rolling, make_engine

MAPS, ROBOTS = 10, 10
LAST = 299
"""The last of the 300 steps of their logs."""
DEADLINE = 48
"""Cells that their robots pass in that time: 0.2 s a step, 0.8 m/s, 1 m a cell."""
THEIRS = ("dora", "frontier", "randomwalk")
BLIND, TOLD = 0, -1
OURS: tuple[tuple[int, float, mrac.Settings], ...] = (
    (BLIND, 0.0, mrac.Settings()),
    (1, 0.0, mrac.Settings(policy="per_cell")),
    (1, 0.04, mrac.Settings()),
    (1, 0.04, mrac.Settings(policy="frontier")),
    (1, 0.04, mrac.Settings(policy="per_cell")),
    (1, 0.04, mrac.Settings(policy="per_cell", robot_value=20.0)),
    (1, 0.04, mrac.Settings(policy="per_cell", risk_cap=0.1)),
    (2, 0.04, mrac.Settings(policy="per_cell")),
    (2, 0.04, mrac.Settings(policy="per_cell", robot_value=20.0)),
    (TOLD, 0.0, mrac.Settings(policy="per_cell")),
    (TOLD, 0.0, mrac.Settings(policy="per_cell", robot_value=20.0)),
)
"""Cells that robots see, or that they know the map; the p that they expect; how they decide."""


def theirs(folder: Path) -> NDArray[np.float64]:
    """Explored cells, and robots that are left, at the end of each run, `[MAPS, 2]`."""
    found = []
    for number in range(MAPS):
        known = np.loadtxt(folder / f"result{number}.csv", delimiter=",", usecols=4)  # in every step a row a cell
        alive = np.loadtxt(folder / f"data_transmitted{number}.csv", delimiter=",", usecols=1)  # and a row a robot
        found.append([(known == LAST).sum(), (alive == LAST).sum()])
    return np.array(found, dtype=np.float64)


def ours(maps: list[mrac.World], settings: mrac.Settings, starts: int, rollouts: int) -> NDArray[np.float64]:
    """Cells visited and robots left, means over starts and rollouts, `[MAPS, 2]`."""
    found = []
    for number, world in enumerate(maps):
        random = np.random.default_rng(number)
        for seed in range(starts):
            placed = random.integers(2, 15, (ROBOTS, 2))  # theirs begin anywhere within 6 m of the middle, each way
            plan = make_plan(world, placed, settings)
            engine = make_engine(plan, world.with_starts(placed), Rolling(seed=seed), "numba").truncated_at(DEADLINE)
            results = engine.results(0, rollouts)
            found.append([results.visited.mean(), results.alive.mean()])
    return np.reshape(found, (MAPS, starts, 2)).mean(axis=1)


def say(what: str, values: NDArray[np.float64], beside: NDArray[np.float64]) -> None:
    """Means over maps, and what they are more than those `beside`, with 95 % intervals."""
    parts = []
    for of in (values, values - beside):
        half = student(MAPS - 1).ppf(0.975) * of.std(axis=0, ddof=1) / MAPS**0.5
        parts += [f"{mean:+9.2f} ± {wide:5.2f}" for mean, wide in zip(of.mean(axis=0), half, strict=True)]
    sys.stdout.write(f"{what:44}{''.join(parts)}\n")


def main(checkout: Path, starts: int, rollouts: int) -> None:
    """A row each: cells, robots left, and both less DORA's."""
    logs = [theirs(checkout / f"sim/results/{name}_{ROBOTS}") for name in THEIRS]
    for name, values in zip(THEIRS, logs, strict=True):
        say(f"their {name}", values, logs[0])
    maps = [mrac.load(checkout / f"sim/data/radiation_sources{number}.json") for number in range(MAPS)]
    for far, p, settings in OURS:
        known = maps if far == TOLD else [world.with_prior_map(p, sensor_range=far) for world in maps]
        what = "known map" if far == TOLD else f"expect {p:g}, see {far}"
        limits = f" worth {settings.robot_value} reserve {settings.risk_cap}"
        say(f"{what}: {settings.policy}{limits}", ours(known, settings, starts, rollouts), logs[0])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
