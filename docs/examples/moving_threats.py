"""The table of `docs/moving.md`: threats that stand, and as many that walk, on random maps of the paper's kind.

python docs/examples/moving_threats.py MAPS ROLLOUTS [contiguous|scattered|guarded]; 100 and 300 are behind the table.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

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


def guarded(seed: int) -> Iterator[tuple[str, mrac.World]]:
    """An empty map on which 20 patrols go round four cells each."""
    empty = random_world(20, 20, ThreatPattern(seed=seed), threats=0.0)
    empty, free = empty.with_starts(place_starts(empty, ROBOTS)[0]), empty.free
    corners = np.argwhere(free[:-1, :-1] & free[1:, :-1] & free[:-1, 1:] & free[1:, 1:])
    chosen = np.random.default_rng(seed).choice(corners, 20, replace=False).tolist()
    movers = [{"patrol": [[r, c], [r, c + 1], [r + 1, c + 1], [r + 1, c]], "h": 0.5} for r, c in chosen]
    yield "patrols, planned on p", mrac.with_movers(empty, movers, plan_on="own")
    yield "patrols, planned on p joined", mrac.with_movers(empty, movers)


KINDS = {"contiguous": partial(worlds, "contiguous"), "scattered": partial(worlds, "scattered"), "guarded": guarded}
LESS = {
    "walking, planned on p": "standing, not told, planned on p",
    "walking, planned on p joined": "walking, planned on p",
    "patrols, planned on p joined": "patrols, planned on p",
}
"""What is compared with what, on the same maps."""


def main(maps: int, rollouts: int, *kinds: str) -> None:
    """All kinds by default."""
    for kind in kinds or KINDS:
        tell(kind, KINDS[kind], LESS, maps, rollouts)


def tell(
    what: str, worlds: Callable[[int], Iterator[tuple[str, mrac.World]]], less: dict[str, str], maps: int, rollouts: int
) -> None:
    """Mean coverage in % of each of the `worlds` that a seed makes, and differences, with 95 % intervals over maps."""
    found: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    for seed in range(maps):
        for name, world in worlds(seed):
            for policy in ("mrac", "per_cell"):
                plan = make_plan(world, world.starts, mrac.Settings(policy=policy))
                engine = make_engine(plan, world, Rolling(seed=seed), "numba")
                visited = engine.results(0, rollouts).visited
                found[name, policy].append(100 * float(visited.mean()) / engine.accessible)
    for (name, policy), values in found.items():
        say(f"{what} {policy}: {name}", np.array(values))
        if name in less:
            say(f"{what} {policy}: {name}, less {less[name]}", np.array(values) - found[less[name], policy])


def say(what: str, values: NDArray[np.float64]) -> None:
    """A mean and its interval."""
    half = 1.96 * values.std(ddof=1) / len(values) ** 0.5
    sys.stdout.write(f"{what:104} {values.mean():5.1f} ± {half:.1f}\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
