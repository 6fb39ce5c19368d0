"""How often do printed intervals hold the truth? (`make calibration`)

python tests/calibration.py [--seeds N]

Ten small worlds whose closed loop is known exactly (its tree, which other tests hold against every pattern of hits);
each is asked for so many times, of another seed each time. A table: of each figure the share of the intervals that
hold the truth, of all worlds together and of each. Status 1 where it is less than LEAST on one of them.
"""

import argparse
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mrac_jax as mrac
from analysis.statistics.estimates import Estimate
from planner.plan.plan import Plan
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

WORLDS, LEAST = 10, 0.93
QUIET: dict[str, Any] = {"bound": False, "advice": False, "band": False}
EXACT: dict[str, Any] = {"rollouts": 16, "exact": 60.0}
SAMPLED: dict[str, Any] = {"rollouts": 1024, "exact": "never"}
PRECISE: dict[str, Any] = {"precision": 0.001, "exact": "never"}
"""1,024 rollouts of one of these worlds say ± 0.0014."""
Case = tuple[World, Plan, Plan]


def drawn(number: int) -> Case:
    """A world, and two plans for its team of one to three."""
    pattern = ThreatPattern(("contiguous", "scattered")[number % 2], areas=2, seed=number)
    world = random_world(5, 6 + number % 3, pattern, obstacles=0.1, threats=0.3)
    starts = place_starts(world, 1 + number % 3)[0]
    a, b = (mrac.plan(world, starts=starts, policy=policy) for policy in ("mrac", "per_cell"))
    return world, a, b


def said_of(world: World, plan: Plan, **how: Any) -> dict[str, Estimate]:
    """What `evaluate` says, by figure."""
    told = mrac.evaluate(world, plan, **QUIET, **how)
    whole = {"visited": told.visited, "survived": told.survived, "losses": told.losses, "time": told.time}
    return whole | {"chance of completing": told.figures.complete}


def truths(world: World, a: Plan, b: Plan) -> dict[str, float]:
    """What is known exactly, by figure."""
    mine, theirs = (said_of(world, plan, **EXACT) for plan in (a, b))
    known = {name: told.mean for name, told in mine.items() if told.se == 0}
    apart = {name: theirs[name].mean - mine[name].mean for name in known if theirs[name].se == 0}
    return known | {"visited, stopped by precision": known["visited"]} | {f"difference of {n}": apart[n] for n in apart}


def intervals(world: World, a: Plan, b: Plan, seed: int) -> Iterator[tuple[str, tuple[float, float]]]:
    """(figure, its interval) of one seed."""
    for name, told in said_of(world, a, seed=seed, **SAMPLED).items():
        yield name, told.ci95
    yield "visited, stopped by precision", said_of(world, a, seed=seed, **PRECISE)["visited"].ci95
    both = mrac.compare((world, a), (world, b), seed=seed, **SAMPLED)
    for figure in ("visited", "survived", "time"):
        yield f"difference of {figure}", both.difference(figure).estimate.ci95
    low, high = both.difference("alive").estimate.ci95
    yield "difference of losses", (-high, -low)


def held(case: Case, seeds: int) -> dict[str, NDArray[np.bool_]]:
    """By figure, whether the interval of each seed holds the truth; figures that are not known exactly are left out."""
    truth = truths(*case)
    hits: dict[str, list[bool]] = {name: [] for name in truth}
    for seed in range(1, 1 + seeds):
        for name, (low, high) in intervals(*case, seed):
            if name in truth:
                hits[name].append(low - 1e-9 <= truth[name] <= high + 1e-9)
    return {name: np.array(each) for name, each in hits.items() if each}


def table(seeds: int) -> tuple[list[str], bool]:
    """The table's lines, and whether no figure is below LEAST on any world."""
    by_figure: dict[str, dict[int, float]] = {}
    for number in range(WORLDS):
        for name, hits in held(drawn(number), seeds).items():
            by_figure.setdefault(name, {})[number] = float(np.mean(hits))
    head = ["interval", "worlds", "seeds each", "held", *(f"{number}" for number in range(WORLDS))]
    lines = [f"| {' | '.join(head)} |", "|---" + "|---:" * (len(head) - 1) + "|"]
    for name, of in by_figure.items():
        shares = [f"{of[number]:.3f}" if number in of else "" for number in range(WORLDS)]
        lines.append(f"| {' | '.join([name, f'{len(of)}', f'{seeds}', f'{np.mean([*of.values()]):.3f}', *shares])} |")
    return lines, all(share >= LEAST for of in by_figure.values() for share in of.values())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=500, help="of each world")
    lines, good = table(parser.parse_args().seeds)
    sys.stdout.write("\n".join(lines) + "\n")
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
