"""Exact expected values of the closed loop: every pattern of hits, run by the readable classical simulator.

A run is decided by which of its hit checks stop a robot. So every leaf of the tree of checks is one run, and its chance
is a product of p and 1 - p. The number of runs grows like (checks a robot) ** robots: feasible for one or two robots,
and for tiny worlds. The oracle of the closed-loop rollouts: it shares no code with the compiled simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planner.errors import PlanError
from planner.plan import Plan
from planner.planner import Problem, prepare
from planner.simulate import Run, simulate
from planner.tally import Outcome
from planner.world import World


@dataclass(frozen=True)
class ClosedLoopExact:
    """Expected values over every pattern of hits that was run.

    Attributes:
        visited, survived: cells. time: steps. alive: robots.
        complete, stopped, stuck, timeout: probabilities of the outcomes.
        remainder: probability of the patterns left out; every other value is short of their share.
        runs: patterns run.
    """

    visited: float
    survived: float
    time: float
    alive: float
    complete: float
    stopped: float
    stuck: float
    timeout: float
    remainder: float
    runs: int


def closed_loop_exact(plan: Plan, world: World, *, least: float = 0.0, most_runs: int = 1_000_000) -> ClosedLoopExact:
    """The closed loop's expected values by enumeration (SPEC section 6; the paper's Algorithm 2).

    Args:
        plan: with its allocation; not the plan of another planner.
        world: the world that it was made for.
        least: patterns that begin with hits of less probability than this are left out and counted in `remainder`.
        most_runs: stop after so many runs; what is left then is in `remainder`.

    Raises:
        PlanError: a plan without areas.
    """
    if plan.settings is None:
        raise PlanError("a plan of another planner has no areas to reallocate", expected="a plan with areas")
    problem = prepare(world, plan.starts, plan.settings)
    totals, outcomes, remainder, runs = np.zeros(4), np.zeros(len(Outcome)), 0.0, 0
    branches: list[tuple[tuple[int, ...], float]] = [((), 1.0)]
    while branches:
        hits, chance = branches.pop()
        if chance < least or runs >= most_runs:
            remainder += chance
            continue
        runs += 1
        run, threats = _scripted_run(problem, plan, hits)
        first_open = hits[-1] + 1 if hits else 0
        for check in range(first_open, len(threats)):
            branches.append(((*hits, check), chance * threats[check]))
            chance *= 1.0 - threats[check]
        totals += chance * np.array([run.visited.sum(), run.survived.sum(), run.time, run.alive.sum()])
        outcomes[run.outcome] += chance
    visited, survived, time, alive = (float(total) for total in totals)
    complete, stopped, stuck, timeout = (float(outcomes[outcome]) for outcome in list(Outcome)[:4])
    return ClosedLoopExact(visited, survived, time, alive, complete, stopped, stuck, timeout, remainder, runs)


def _scripted_run(problem: Problem, plan: Plan, hits: tuple[int, ...]) -> tuple[Run, list[float]]:
    """The run in which exactly the hit checks `hits` stop a robot, and the threat of every check that it made."""
    threat = problem.world.threat.ravel().astype(np.float64)
    checked: list[float] = []

    def hit(robot: int, step: int, cell: int) -> bool:
        if threat[cell] == 0:
            return False
        checked.append(float(threat[cell]))
        return len(checked) - 1 in hits

    run = simulate(
        problem.world.shape,
        problem.paths,
        plan.areas,
        problem.starts,
        max_steps=problem.max_steps,
        stay_inside=problem.settings.transit == "area",
        hit=hit,
    )
    return run, checked
