"""Rollouts of a policy, of a random walk and of plans on the same luck, and the bound that no strategy exceeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.judging.rolling import roll_policy
from analysis.kit.notes import Progress, quiet
from analysis.report.answer import Answer
from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.differences import Paired, difference
from analysis.statistics.estimate import Z95, Estimate, mean_estimate
from analysis.theory.any_strategy import most_cells
from planner.plan_team import plan_team
from planner.settings import Choices
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
        coverage, random: mean visited coverage of the policy and of a random walk (of areas: random areas), fractions
            of the accessible cells. walk: what that is, in words.
        losses: robots lost. steps: of a rollout.
        bound: coverage that no strategy exceeds on average, certified.
        score: (coverage - random) / (bound - random); None where the two do not differ.
        plans: by policy, those of the planner on the same luck, ended at the same step.
    """

    reported_by = "analysis.judging.report:report"

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
    walk: str
    partial: bool = False


def judge(
    world: World,
    policy: Callable[..., Any],
    env: Any,
    choices: RolloutChoices,
    against: Iterable[str],
    processes: int | None = None,
    progress: Progress = quiet,
) -> Judged:
    """Roll out the policy in the environment `env` of the world, and what stands beside it. Raises InputError."""
    count, cells, robots = choices.rollouts, env.accessible, env.num_agents
    plans, until = {}, replace(choices, deadline=env.max_steps)
    asked = {name: Choices(policy=name).settings(world.team.settings, world.pace, by=world.source) for name in against}
    rivals = {name: plan_team(world, env.starts, settings, None) for name, settings in asked.items()}
    visited, lost, steps = roll_policy(env, policy, choices.seed, count, processes, progress)
    walked = roll_policy(env, None, choices.seed, count)[0]
    bound = most_cells(world, env.starts) / cells
    for name, plan in rivals.items():
        found = make_singles(world, plan, until)(0, count)
        ahead = difference(Paired.of(found.visited, visited), 1 / cells, 1 / cells, 1.0).estimate
        plans[name] = Beside(share_of(found.visited, cells), mean_of(robots - found.alive, robots), ahead)
    scores = scores_of(visited / cells, walked / cells, bound)
    return Judged(
        world, env.starts, cells, env.max_steps, choices, share_of(visited, cells), mean_of(lost, robots),
        mean_of(steps, env.max_steps), share_of(walked, cells), bound, None if scores is None else estimate_of(scores),
        plans, env.walk,
    )  # fmt: skip


def scores_of(policy: NDArray[np.float64], walk: NDArray[np.float64], bound: float) -> NDArray[np.float64] | None:
    """(J - J_random) / (bound - J_random) of coverage by rollout `[B]`: its mean is that, and its scatter that of the
    ratio, by linearisation. None where there is no room above the walk."""
    room = bound - float(walk.mean())
    if room <= 0 or len(policy) < 2:
        return None
    score = float(policy.mean() - walk.mean()) / room
    return score + (policy - policy.mean() - (1 - score) * (walk - walk.mean())) / room


def estimate_of(values: NDArray[np.float64]) -> Estimate:
    """The mean of `[B]` with its interval."""
    mean, se = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(len(values))
    return Estimate(mean, se, (mean - Z95 * se, mean + Z95 * se))


def share_of(visited: NDArray[Any], cells: int) -> Estimate:
    """Mean coverage, of cells visited by rollout."""
    return mean_estimate(np.bincount(visited, minlength=cells + 1), 1 / cells)


def mean_of(values: NDArray[Any], most: int) -> Estimate:
    """The mean of whole numbers by rollout."""
    return mean_estimate(np.bincount(values, minlength=most + 1), 1.0)
