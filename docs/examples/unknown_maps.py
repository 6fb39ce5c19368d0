"""The table of `docs/unknown.md`: robots that are told the map, that learn it, and that are blind, on random maps.

python docs/examples/unknown_maps.py MAPS ROLLOUTS ROBOTS...; 500, 40 and 1 2 4 are behind the table.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from math import inf

from moving_threats import tell

import mrac_jax as mrac
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts

KINDS: tuple[Kind, ...] = ("contiguous", "scattered")
NOTHING, OBSTACLES = "know nothing, see", "know the obstacles, see"
LESS = {
    "told the map": f"{NOTHING} 2",
    f"{OBSTACLES} 3": f"{OBSTACLES} 0",
}
"""What is compared with what, on the same maps and luck."""


def teams(kind: Kind, robots: int, seed: int) -> Iterator[tuple[str, mrac.World]]:
    """A map of the paper's kind, 20 x 20 cells with 25 % threats, and what robots know of it."""
    world = random_world(20, 20, ThreatPattern(kind, seed=seed), threats=0.25)
    world = world.with_starts(place_starts(world, robots)[0])
    for far in (1, 2, 3, 5):
        yield f"{NOTHING} {far}", mrac.with_prior(world, 0.04, sense=far)
    for far in (0, 1, 3):
        yield f"{OBSTACLES} {far}", mrac.with_prior(world, 0.04, "known", sense=far)
    yield "told the map", mrac.with_prior(world, 0.04, sense=inf)


def main(maps: int, rollouts: int, *sizes: int) -> None:
    """Both kinds of map, for teams of each size."""
    for kind in KINDS:
        for robots in sizes:
            tell(f"{kind}, {robots} robots,", partial(teams, kind, robots), LESS, maps, rollouts)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
