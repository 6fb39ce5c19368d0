"""Rollouts of a policy, of a random walk and of plans on the same luck, and the bound that no strategy exceeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.report.answer import Answer
from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.differences import Paired, difference
from analysis.statistics.estimate import Z95, Estimate, mean_estimate
from analysis.theory.any_strategy import any_strategy
from planner.plan_team import plan_team
from planner.rollouts.names import of_jax
from planner.settings import Settings
from planner.worlds.world import World


@dataclass(frozen=True)
class Beside:
    """A plan beside the policy.

    Attributes:
        coverage: its mean, a fraction of the accessible cells. losses: robots lost.
        ahead: by how much the policy covers more, on common luck.
    """

    coverage: Estimate
    losses: Estimate
    ahead: Estimate


@dataclass(frozen=True, eq=False, repr=False)
class Judged(Answer):
    """What a policy is worth on a world.

    Attributes:
        starts: int64 `[K, 2]`. cells: accessible ones. max_steps: at which every rollout was cut off.
        coverage, random: mean visited coverage of the policy and of a random walk, fractions of the accessible cells.
        losses: robots lost. steps: of a rollout.
        bound: coverage that no strategy exceeds on average, certified.
        score: (coverage - random) / (bound - random); None where the two do not differ.
        plans: by policy, those of the planner on the same luck, ended at the same step.
    """

    world: World
    starts: NDArray[np.int64]
    cells: int
    max_steps: int
    choices: RolloutChoices
    coverage: Estimate
    losses: Estimate
    steps: Estimate
    random: Estimate
    bound: float
    score: Estimate | None
    plans: dict[str, Beside]
    partial: bool = False


def judge(
    world: World, policy: Callable[..., Any], env: Any, choices: RolloutChoices, against: Iterable[str]
) -> Judged:
    """Roll out the policy in the environment `env` of the world, and what stands beside it. Raises InputError."""
    count, cells, robots, roll_out = choices.rollouts, env.accessible, env.num_agents, of_jax("policy")
    visited, lost, steps = roll_out(env, policy, choices.seed, count)
    walked = roll_out(env, None, choices.seed, count)[0]
    bound = any_strategy(world, env.starts).cells / cells
    plans = {}
    for name in against:
        settings = Settings(policy=name)
        plan = plan_team(world, env.starts, settings, None)
        found = make_singles(world, plan, replace(choices, deadline=env.max_steps))(0, count)
        ahead = difference(Paired.of(found.visited, visited), 1 / cells, 1 / cells, 1.0).estimate
        plans[name] = Beside(_share(found.visited, cells), _mean(robots - found.alive, robots), ahead)
    score = score_of(visited / cells, walked / cells, bound)
    return Judged(
        world, env.starts, cells, env.max_steps, choices, _share(visited, cells), _mean(lost, robots),
        _mean(steps, env.max_steps), _share(walked, cells), bound, score, plans,
    )  # fmt: skip


def score_of(policy: NDArray[np.float64], walk: NDArray[np.float64], bound: float) -> Estimate | None:
    """(J - J_random) / (bound - J_random) of coverage by rollout `[B]`, its interval by linearisation of the ratio."""
    room = bound - float(walk.mean())
    if room <= 0 or len(policy) < 2:
        return None
    score = float(policy.mean() - walk.mean()) / room
    se = float((policy - (1 - score) * walk).std(ddof=1)) / math.sqrt(len(policy)) / room
    return Estimate(score, se, (score - Z95 * se, score + Z95 * se))


def _share(visited: NDArray[Any], cells: int) -> Estimate:
    return mean_estimate(np.bincount(visited, minlength=cells + 1), 1 / cells)


def _mean(values: NDArray[Any], most: int) -> Estimate:
    return mean_estimate(np.bincount(values, minlength=most + 1), 1.0)
