"""The figures of `docs/moving.md` on patrols: what is it worth to know their routes?

python docs/examples/patrols.py MAPS ROLLOUTS; 100 and 300 are behind the figures.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import mrac_jax as mrac
from planner.make_plan import make_plan
from planner.rollouts.engine import Rolling, make_engine
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts

ROBOTS = 8
NAMES = ("planned on p", "planned on p joined")


def guarded(seed: int) -> Iterator[tuple[str, mrac.World]]:
    """An empty map on which 20 patrols go round four cells each."""
    empty = random_world(20, 20, ThreatPattern(seed=seed), threats=0.0)
    empty, free = empty.with_starts(place_starts(empty, ROBOTS)[0]), empty.free
    corners = np.argwhere(free[:-1, :-1] & free[1:, :-1] & free[:-1, 1:] & free[1:, 1:])
    chosen = np.random.default_rng(seed).choice(corners, 20, replace=False).tolist()
    threats = [{"patrol": [[r, c], [r, c + 1], [r + 1, c + 1], [r + 1, c]], "h": 0.5} for r, c in chosen]
    yield NAMES[0], empty.with_moving_threats(threats, plan_on="own")
    yield NAMES[1], empty.with_moving_threats(threats, plan_on="joined")


def main(maps: int, rollouts: int) -> None:
    """Mean coverage in % of both, and the difference, with 95 % intervals over maps."""
    found: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    for seed in range(maps):
        for name, world in guarded(seed):
            for policy in ("mrac", "per_cell"):
                plan = make_plan(world, world.starts, mrac.Settings(policy=policy))
                engine = make_engine(plan, world, Rolling(seed=seed), "numba")
                visited = engine.results(0, rollouts).visited
                found[name, policy].append(100 * float(visited.mean()) / engine.accessible)
    for policy in ("mrac", "per_cell"):
        without, with_routes = (np.array(found[name, policy]) for name in NAMES)
        say(f"{policy}: {NAMES[1]}", with_routes)
        say(f"{policy}: {NAMES[1]}, less {NAMES[0]}", with_routes - without)


def say(what: str, values: NDArray[np.float64]) -> None:
    """A mean and its interval."""
    half = 1.96 * values.std(ddof=1) / len(values) ** 0.5
    sys.stdout.write(f"{what:60} {values.mean():5.1f} ± {half:.1f}\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
