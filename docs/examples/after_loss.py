"""What `docs/policies.md` says of looking ahead: is a better order of areas found once a first robot is lost?

python docs/examples/after_loss.py ROBOTS MAPS RUNS TRIES; 2 12 6 100 are behind the figures. Runs by the order
that was found beforehand are driven to their first loss; from there orders are tried, each known exactly.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import get_args

import numpy as np

import mrac_jax as mrac
from analysis.estimators.racing import order_areas
from analysis.estimators.trial import Trial
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import over_maps
from planner.make_plan import allocated_plan, make_plan
from planner.plan.state import MissionState
from planner.rollouts.tables import AllPairs
from planner.settings import MOST_PRIORITY, Settings
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.start_rule import place_starts

CHOICES = RolloutChoices(rollouts=4096, seed=10**6)


def at_first_loss(world: mrac.World, plan: mrac.Plan, draw: np.random.Generator) -> MissionState | None:
    """Where a run stands after its first loss; None where nothing is left to decide."""
    mission = mrac.drive(world, plan)
    while mission.outcome is None and not mission.lost:
        for order in mission.orders().values():
            stopped = bool(draw.random() < world.threat[order.cell])
            mission.report(order.robot, cell=order.cell, stopped=stopped)
        mission.advance()
    return None if mission.outcome is not None or len(mission.lost) == mission.robots else mission.state


def gained(world: mrac.World, state: MissionState, settings: Settings, tries: int, draw: np.random.Generator) -> float:
    """Points that the best of so many orders from a state covers more than the order before."""

    def covered(priority: np.ndarray) -> float:
        chosen = replace(settings, priority=tuple(priority.tolist()))
        found = Trial(world, allocated_plan(world, state.starts, chosen, state), CHOICES).known()
        return -1.0 if found is None else found.share

    areas = allocated_plan(world, state.starts, settings, state).areas
    size, best = np.sqrt([len(area.cells) for area in areas]), np.array(settings.priority)
    first = most = covered(best)
    for _ in range(tries):
        tried = best.astype(np.float64)
        few = min(int(draw.integers(1, 4)), len(areas))
        for area in draw.choice(len(areas), size=few, p=size / size.sum()):
            tried[areas[area].cells] *= 2.0 ** (draw.choice((-1, 1)) * 2.0 ** (int(draw.integers(5)) - 3))
        whole = np.maximum(np.rint(MOST_PRIORITY * tried / tried.max()), 1).astype(np.int64)
        if (found := covered(whole)) >= most:
            best, most = whole, found
    return 100 * (most - first) if first >= 0 else 0.0


def main(robots: int, maps: int, runs: int, tries: int) -> None:
    """Prints the mean of the maps with its 95 % interval, by kind."""
    for kind in get_args(Kind):
        means = []
        for seed in range(maps):
            world = random_world(pattern=ThreatPattern(kind, seed=seed))
            starts = place_starts(world, robots)[0]
            fair = Settings(policy="watchful", risk_cap=1 / robots)
            settings = order_areas(world, starts, fair, CHOICES, AllPairs(), 300 if robots < 4 else 150, lambda: True)
            plan, gains = make_plan(world, starts, settings), []
            for run in range(runs):
                draw = np.random.default_rng([seed, run])
                state = at_first_loss(world, plan, draw)
                gains.append(0.0 if state is None else gained(world, state, settings, tries, draw))
            means.append(float(np.mean(gains)))
        mean = over_maps(np.array(means))
        sys.stdout.write(f"{kind}, {robots} robots, {maps} maps: {mean.mean:.3f} ± {mean.half_width:.3f} points\n")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
