"""The tables of `docs/policies.md` on what is left to gain: rules, an order of areas, and the bound for every strategy.

python docs/examples/gaps.py FILE MAPS [ROBOTS ...]; teams of 1, 2, 4, 8, 20 if none is named. FILE keeps a line for
each map and team: run again, it goes on from there.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np

import mrac_jax as mrac
from analysis.estimators.racing import order_areas
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import over_maps
from analysis.theory.upper_bound import any_strategy
from planner.make_plan import make_plan
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.start_rule import place_starts

TRIES = {1: 300, 2: 300, 4: 400, 8: 300, 20: 25}
"""Orders of areas that are tried, by the robots of the team; of other teams as of the next smaller."""
ROLLOUTS = 4096
SEARCH_SEED = 10**6
"""Seed of the search; its results are evaluated on other random numbers."""
Row = dict[str, float | str]


def covered(world: mrac.World, plan: mrac.Plan) -> float:
    """Points: exact where a tree tells it, else of ROLLOUTS rollouts."""
    answer = mrac.evaluate(world, plan, rollouts=ROLLOUTS, advice=False, band=False)
    return 100 * answer.figures.visited.mean.mean / answer.tally.accessible


def measured(kind: Kind, robots: int, seed: int) -> Row:
    """Points that each rule covers and that no strategy exceeds, and CPU seconds of the order and of the bound."""
    world = random_world(pattern=ThreatPattern(kind, seed=seed))
    starts = place_starts(world, robots)[0]
    plain = Settings(policy="watchful")
    fair = Settings(policy="watchful", risk_cap=1 / robots if robots > 1 else None)
    rules = {"per_cell": Settings(policy="per_cell"), "watchful": plain, "reserve 1/k": fair}
    row: Row = {"kind": kind, "robots": robots, "seed": seed}
    row |= {name: covered(world, make_plan(world, starts, rule)) for name, rule in rules.items()}
    begun = time.process_time()
    choices, tries = (
        RolloutChoices(rollouts=ROLLOUTS, seed=SEARCH_SEED),
        TRIES[max(team for team in TRIES if team <= robots)],
    )
    found = order_areas(world, starts, fair, choices, AllPairs(), tries, lambda: True)
    row["order s"] = time.process_time() - begun
    row["order"] = covered(world, make_plan(world, starts, found))
    begun = time.process_time()
    row["bound"] = 100 * any_strategy(world, starts, flow=True).cells / int(world.accessible(starts).sum())
    return row | {"bound s": time.process_time() - begun}


def kept(file: Path) -> Iterator[Row]:
    """What a file has already."""
    yield from map(json.loads, file.read_text().splitlines() if file.exists() else [])


def table(rows: list[Row]) -> Iterator[str]:
    """Lines of means over maps, with 95 % intervals, of what each rule lacks."""
    names = ("per_cell", "watchful", "reserve 1/k", "order")
    yield "| threats, robots | maps | bound | " + " | ".join(names) + " | s | bound s |"
    yield "|---|" + "---:|" * 8
    for kind in get_args(Kind):
        for robots in sorted({int(row["robots"]) for row in rows}):
            here = [row for row in rows if row["kind"] == kind and row["robots"] == robots]
            if len(here) > 1:
                of = {name: np.array([row[name] for row in here]) for name in (*names, "bound", "order s", "bound s")}
                left = [over_maps(of["bound"] - of[name]) for name in names]
                said = " | ".join(f"{one.mean:.1f} ± {one.half_width:.1f}" for one in left)
                cost = f"{of['order s'].mean():.1f} | {of['bound s'].mean():.1f}"
                yield f"| {kind}, {robots} | {len(here)} | {of['bound'].mean():.1f} | {said} | {cost} |"


def main(file: Path, maps: int, teams: tuple[int, ...]) -> None:
    """Measures what FILE lacks, map by map, and prints the table."""
    done = {(row["kind"], row["robots"], row["seed"]): row for row in kept(file)}
    for seed in range(maps):
        for robots in teams:
            for kind in get_args(Kind):
                if (kind, robots, seed) not in done:
                    done[kind, robots, seed] = row = measured(kind, robots, seed)
                    with file.open("a") as out:
                        out.write(json.dumps(row) + "\n")
    sys.stdout.write("\n".join(table(list(done.values()))) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), tuple(map(int, sys.argv[3:])) or tuple(TRIES))
