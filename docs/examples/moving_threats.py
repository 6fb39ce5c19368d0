"""The table of `docs/moving.md`: threats that stand, and as many that walk, on random maps of the paper's kind.

python docs/examples/moving_threats.py [MAPS] [ROLLOUTS]
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

import mrac_jax as mrac
from planner.mrac.make_plan import make_plan
from planner.rollouts.engine import Rolling, make_engine
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts

ROBOTS = 8


def worlds(kind: Kind, seed: int) -> Iterator[tuple[str, mrac.World]]:
    """The map with its threats where everybody knows them; then each of them somewhere else, standing or walking."""
    standing = random_world(20, 20, ThreatPattern(kind, seed=seed), threats=0.25)
    empty = random_world(20, 20, ThreatPattern(kind, seed=seed), threats=0.0).with_starts(
        place_starts(standing, ROBOTS)[0]
    )
    levels, counts = np.unique(standing.threat[standing.threat > 0], return_counts=True)
    each = [(float(p), int(count)) for p, count in zip(levels, counts, strict=True)]
    yield "standing, told", standing.with_starts(empty.starts)
    for name, stays in (("standing, not told", 1.0), ("walking", 0.5)):
        movers = [{"walk": stays, "h": p, "count": count} for p, count in each]
        yield f"{name}, planned on p", mrac.with_movers(empty, movers, plan_on="own")
        yield f"{name}, planned on p joined", mrac.with_movers(empty, movers)


def main(maps: int, rollouts: int) -> None:
    """Mean coverage and robots lost, with 95 % intervals over maps."""
    for kind in ("contiguous", "scattered"):
        found: defaultdict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
        for seed in range(maps):
            for name, world in worlds(kind, seed):
                for policy in ("mrac", "per_cell"):
                    plan = make_plan(world, world.starts, mrac.Settings(policy=policy))
                    engine = make_engine(plan, world, Rolling(seed=seed), "numba")
                    results = engine.results(0, rollouts)
                    covered = 100 * results.visited.mean() / engine.accessible
                    found[name, policy].append((covered, ROBOTS - results.alive.mean()))
        for (name, policy), rows in found.items():
            means, half = np.mean(rows, axis=0), 1.96 * np.std(rows, axis=0, ddof=1) / maps**0.5
            words = f"{kind:11} {policy:9} {name:36}"
            lost = f"lost {means[1]:.2f} ± {half[1]:.2f} of {ROBOTS}"
            sys.stdout.write(f"{words} visited {means[0]:5.1f} ± {half[0]:.1f} %, {lost}\n")


if __name__ == "__main__":
    main(*(int(word) for word in [*sys.argv[1:], *("100", "500")[len(sys.argv) - 1 :]]))
