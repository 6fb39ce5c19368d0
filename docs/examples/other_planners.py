"""The table of `docs/other-planners.md`: plans of others, open and closed, beside MRAC's from the same starts.

python docs/examples/other_planners.py ROLLOUTS MAPS MAP NAME=PLAN [NAME=PLAN ...]; 4,096 and 10 are behind it.
"""

from __future__ import annotations

import sys

import numpy as np

import mrac_jax as mrac
from analysis.statistics.estimates import over_maps
from planner.world.generate import Kind, ThreatPattern, random_threats

KINDS: tuple[Kind, ...] = ("contiguous", "scattered")
LEVELS = (0.02, 0.05, 0.1)
SHARES = (0.02, 0.05)


def visited(world: mrac.World, plan: mrac.Plan, rollouts: int) -> list[float]:
    """Percent of the accessible cells, open loop (exact) and closed."""
    answer = mrac.evaluate(world, plan, rollouts=rollouts, advice=False, band=False, loop="closed")
    cells = answer.tally.accessible
    return [100 * answer.closed_form.visited / cells, 100 * answer.figures.visited.mean.mean / cells]


def row(kind: Kind, share: float, maps: int, file: str, plans: list[str], rollouts: int) -> str:
    """Means over threats drawn `maps` times on the map's free cells, with intervals over these."""
    free = mrac.load(file).free
    found = []
    for seed in range(maps):
        threat = random_threats(free, round(share * free.sum()), ThreatPattern(kind, levels=LEVELS, seed=seed))
        world = mrac.World.create(np.where(free, threat, np.nan), source=file)
        read = [mrac.read_plan(plan, world) for plan in plans]
        starts = [(int(row), int(col)) for row, col in read[0].starts]
        found.append([visited(world, plan, rollouts) for plan in [*read, mrac.plan(world, starts=starts)]])
    cells = []
    for values in np.array(found).reshape(maps, -1).T:
        mean = over_maps(values)
        cells.append(f"{mean.mean:.1f} ± {mean.half_width:.1f}")
    return f"| {kind}, {100 * share:g} % | {' | '.join(cells)} |\n"


def main(rollouts: int, maps: int, file: str, *named: str) -> None:
    """A row for each kind and share of threats."""
    names, plans = zip(*(one.split("=", 1) for one in named), strict=True)
    heads = [f"{name}, {loop}" for name in (*names, "MRAC") for loop in ("open", "closed")]
    sys.stdout.write(f"| threats | {' | '.join(heads)} |\n|---|{'---|' * len(heads)}\n")
    for kind in KINDS:
        for share in SHARES:
            sys.stdout.write(row(kind, share, maps, file, list(plans), rollouts))
            sys.stdout.flush()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
