"""The table of `docs/unknown.md`: robots that are told the map, that learn it, and that are blind, on random maps.

python docs/examples/unknown_maps.py MAPS ROLLOUTS ROBOTS...; 500, 40 and 1 2 4 are behind the table.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator
from math import inf

import numpy as np
from numpy.typing import NDArray

import mrac_jax as mrac
from planner.mrac.make_plan import make_plan
from planner.rollouts.engine import Rolling, make_engine
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts

KINDS: tuple[Kind, ...] = ("contiguous", "scattered")
NOTHING, OBSTACLES = "know nothing, see", "know the obstacles, see"
LESS = {
    "told the map": f"{NOTHING} 2",
    f"{OBSTACLES} 3": f"{OBSTACLES} 0",
}
"""What is compared with what, on the same maps and luck."""


def teams(kind: Kind, seed: int, robots: int) -> Iterator[tuple[str, mrac.World]]:
    """A map of the paper's kind, 20 x 20 cells with 25 % threats, and what robots know of it."""
    world = random_world(20, 20, ThreatPattern(kind, seed=seed), threats=0.25)
    world = world.with_starts(place_starts(world, robots)[0])
    for far in (1, 2, 3, 5):
        yield f"{NOTHING} {far}", mrac.with_prior(world, 0.04, sense=far)
    for far in (0, 1, 3):
        yield f"{OBSTACLES} {far}", mrac.with_prior(world, 0.04, "known", sense=far)
    yield "told the map", mrac.with_prior(world, 0.04, sense=inf)


def main(maps: int, rollouts: int, *sizes: int) -> None:
    """Mean coverage of each team, and differences, in % of the cells, with 95 % intervals over maps."""
    for kind in KINDS:
        for robots in sizes:
            found: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
            for seed in range(maps):
                for name, world in teams(kind, seed, robots):
                    for policy in ("mrac", "per_cell"):
                        plan = make_plan(world, world.starts, mrac.Settings(policy=policy))
                        engine = make_engine(plan, world, Rolling(seed=seed), "numba")
                        visited = engine.results(0, rollouts).visited
                        found[name, policy].append(100 * float(visited.mean()) / engine.accessible)
            for (name, policy), values in found.items():
                what = f"{kind}, {robots} robots, {policy}: {name}"
                say(what, np.array(values))
                if name in LESS:
                    say(f"{what}, less {LESS[name]}", np.array(values) - found[LESS[name], policy])


def say(what: str, values: NDArray[np.float64]) -> None:
    """A mean and its interval."""
    half = 1.96 * values.std(ddof=1) / len(values) ** 0.5
    sys.stdout.write(f"{what:96} {values.mean():5.1f} ± {half:.1f}\n")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
