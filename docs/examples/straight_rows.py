"""What `docs/fields.md` says of random maps: turns, moves, time and coverage of straight rows, paired.

python docs/examples/straight_rows.py ROLLOUTS MAPS [FILE:CELL_SIZE ...]; 100 and 20 are behind it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import numpy as np

import mrac_jax as mrac
from analysis.statistics.estimates import over_maps
from planner.world.generate import Kind, ThreatPattern, random_threats, random_world

KINDS: tuple[Kind, ...] = ("contiguous", "scattered")
NAMES = ("quarter turns", "moves", "time with turns", "visited")


def measured(world: mrac.World, robots: int, order: str, rollouts: int) -> list[float]:
    """Turns, moves and time with turns (a step each), and visited in percent, the mean of runs."""
    plan = mrac.plan(world, robots, in_area=order)
    answer = mrac.evaluate(world, plan, rollouts=rollouts, advice=False, band=False, exact="never", turn=1.0)
    found = answer.outputs["turn"]
    cells = answer.tally.accessible
    return [found.turns.mean, found.moves.mean, found.time.mean, 100 * answer.figures.visited.mean.mean / cells]


def tell(name: str, worlds: Iterable[mrac.World], robots: int, rollouts: int) -> None:
    """Mean change by `boustrophedon`, in percent of `nearest`, of coverage in points, with its interval over maps."""
    pairs = [[measured(world, robots, order, rollouts) for order in ("nearest", "boustrophedon")] for world in worlds]
    usual, straight = np.array(pairs).transpose(1, 2, 0)
    said = []
    for one, before, after in zip(NAMES, usual, straight, strict=True):
        change = after - before if one == "visited" else 100 * (after / before - 1)
        half = over_maps(change).half_width if len(change) > 1 else float("nan")
        said.append(f"{one} {before.mean():.1f} -> {after.mean():.1f} ({change.mean():+.1f} ± {half:.1f})")
    sys.stdout.write(f"{name}, {robots} robots, {len(pairs)} maps: {'; '.join(said)}\n")
    sys.stdout.flush()


def main(rollouts: int, maps: int, *files: str) -> None:
    """Random maps of the paper's kinds, then maps from files with 5 % contiguous threats on them."""
    for kind in KINDS:
        for robots in (2, 8):
            for ratio in (0.25, 0.1):
                worlds = [
                    random_world(20, 20, ThreatPattern(kind, seed=seed), obstacles=ratio, threats=ratio)
                    for seed in range(maps)
                ]
                tell(f"{kind}, {100 * ratio:g} % obstacles and threats", worlds, robots, rollouts)
    for robots in (2, 8):
        for name in files:
            path, _, size = name.partition(":")
            world = mrac.load(path, cell_size=float(size) if size else None)
            free = world.free
            threats = [
                random_threats(free, round(0.05 * free.sum()), ThreatPattern("contiguous", seed=seed))
                for seed in range(8)
            ]
            worlds = [mrac.World.create(np.where(free, threat, np.nan), source=path) for threat in threats]
            tell(path.rpartition("/")[2], worlds, robots, rollouts)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
