"""Evaluation of a policy against a random walk, plans and the upper bound, with common random numbers."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.report.model import KeyFigure, Report, Section
from analysis.report.result import Result, asked, map_text, share_figure
from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.estimates import Z95, Estimate, mean_estimate
from analysis.statistics.variance_reduction import Paired, difference
from analysis.theory.upper_bound import most_cells
from analysis.utils.notes import ProgressCallback, quiet
from analysis.utils.pool import answers, wanted_processes
from analysis.utils.tables import make_table, without_level
from planner.arguments import argument
from planner.errors import UsageError
from planner.formatting import ceiled, counted, percent
from planner.open_loop import plan_team
from planner.rollouts.names import of_jax
from planner.settings import Choices
from planner.world.world import World

# Rollouts of a policy: in parallel if it is not compiled and can be sent to other processes.


def roll_policy(
    env: Any,
    policy: Callable[..., Any] | None,
    seed: int,
    count: int,
    processes: int | None = 1,
    progress: ProgressCallback = quiet,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Cells visited, robots lost and steps, int64 `[count]` each, of rollouts 0 .. count - 1 of the seed.

    They do not depend on `processes` (None: one for each core). policy: None for a random walk. Raises InputError.
    """
    rolled = of_jax("policy")(env, policy, seed, count)
    spans, begun = rolled.spans, time.monotonic()
    wanted = 1 if rolled.compiled else wanted_for(policy, processes, len(spans))
    found, done = {}, 0
    for span, ended in answers(rolled, spans, wanted, lambda span: f"rollouts {span[0]} to {span[1] - 1}"):
        found[span], done = ended, done + span[1] - span[0]
        progress(done, count, time.monotonic() - begun)
    visited, lost, steps = (np.concatenate(of) for of in zip(*(found[span] for span in spans), strict=True))
    return visited, lost, steps


def wanted_for(policy: Any, processes: int | None, tasks: int) -> int:
    """Number of processes to use. Raises UsageError for several if the policy cannot be sent to them."""
    wanted = wanted_processes(processes, tasks)
    if wanted == 1 or can_be_sent(policy):
        return wanted
    if processes is None:
        return 1
    problem = f"{argument('processes', processes)}, but the policy cannot be sent to other processes"
    raise UsageError(problem, fix="put it into a file that can be imported, or omit the option")


def can_be_sent(policy: Any) -> bool:
    """Whether another process can unpickle it: no lambda, and nothing defined in the main script or notebook."""
    try:
        # Objects of the main script cannot be imported by another process.
        return b"__main__" not in pickle.dumps(policy)
    except Exception:
        return False


@dataclass(frozen=True)
class Compared:
    """A plan that the policy is compared with.

    Attributes:
        coverage: mean, a fraction of the accessible cells. losses: robots lost.
        ahead: the policy's coverage minus the plan's, with common random numbers.
    """

    coverage: Estimate
    losses: Estimate
    ahead: Estimate


@dataclass(frozen=True, eq=False, repr=False)
class PolicyEvaluation(Result):
    """The evaluation of a policy on a world.

    Attributes:
        starts: int64 `[K, 2]`. cells: number of accessible cells. max_steps: every rollout ends there.
        coverage, random: mean visited coverage of the policy and of a random walk (for actions on areas: random areas),
            fractions of the accessible cells. walk: name of the latter.
        losses: robots lost. steps: of a rollout.
        bound: policy-independent upper bound of the mean coverage, certified.
        score: (coverage - random) / (bound - random); None: the two do not differ.
        plans: by policy, plans of the planner with the same random numbers and the same last step.
    """

    reported_by = "analysis.policy_evaluation.policy_evaluation:report"

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
    plans: dict[str, Compared]
    walk: str
    partial: bool = False
    json_keys = """
        answer=summary robots starts accessible=cells choices.rollouts choices.seed max_steps
        coverage losses steps random bound score plans
    """

    @property
    def robots(self) -> int:
        """Number of robots."""
        return len(self.starts)


def judge(
    world: World,
    policy: Callable[..., Any],
    env: Any,
    choices: RolloutChoices,
    against: Iterable[str],
    processes: int | None = None,
    progress: ProgressCallback = quiet,
) -> PolicyEvaluation:
    """Evaluate the policy in the environment `env` of the world, and compare it with plans. Raises InputError."""
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
        plans[name] = Compared(share_of(found.visited, cells), mean_of(robots - found.alive, robots), ahead)
    scores = scores_of(visited / cells, walked / cells, bound)
    return PolicyEvaluation(
        world, env.starts, cells, env.max_steps, choices, share_of(visited, cells), mean_of(lost, robots),
        mean_of(steps, env.max_steps), share_of(walked, cells), bound, None if scores is None else estimate_of(scores),
        plans, env.walk,
    )  # fmt: skip


def scores_of(policy: NDArray[np.float64], walk: NDArray[np.float64], bound: float) -> NDArray[np.float64] | None:
    """(J - J_random) / (bound - J_random) of coverage by rollout, `[B]`: the mean is the score, and the scatter is that
    of the ratio, by linearisation (delta method). None if the bound is not above the walk."""
    # The denominator is estimated too; the linearisation below includes its error.
    room = bound - float(walk.mean())
    if room <= 0 or len(policy) < 2:
        return None
    score = float(policy.mean() - walk.mean()) / room
    return score + (policy - policy.mean() - (1 - score) * (walk - walk.mean())) / room


def estimate_of(values: NDArray[np.float64]) -> Estimate:
    """The mean of `[B]` values with its normal 95 % interval."""
    mean, se = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(len(values))
    return Estimate(mean, se, (mean - Z95 * se, mean + Z95 * se))


def share_of(visited: NDArray[Any], cells: int) -> Estimate:
    """Mean coverage from the cells visited in each rollout."""
    return mean_estimate(np.bincount(visited, minlength=cells + 1), 1 / cells)


def mean_of(values: NDArray[Any], most: int) -> Estimate:
    """The mean of an integer in each rollout."""
    return mean_estimate(np.bincount(values, minlength=most + 1), 1.0)


# The report of `mrac.judge`.


def report(judged: PolicyEvaluation) -> Report:
    """The policy's coverage and score between a random walk, or random areas, and the bound."""
    robots = len(judged.starts)
    score = [] if judged.score is None else [KeyFigure(judged.score.columns(100.0)[0] + " %", "score")]
    rows = [
        ("the policy", *judged.coverage.columns(100.0, 100), judged.losses.columns()[0], ""),
        *((name, *one.coverage.columns(100.0, 100), one.losses.columns()[0], one.ahead.describe(100))
          for name, one in judged.plans.items()),
        (judged.walk, *judged.random.columns(100.0, 100), "", ""),
        ("upper bound", ceiled(judged.bound, unit=""), "certified", "", ""),
    ]  # fmt: skip
    table = make_table(("", "visited, %", "from .. to", "lost", "policy ahead, points"), rows=rows)
    score_is = f"score: (policy - {judged.walk}) / (bound - {judged.walk})"
    note = f"{score_is}; all with common random numbers and the same last step"
    level = "± half the 95 % interval, in brackets its ends"
    return Report(
        "policy", "judge", asked(judged.world, robots, "how good is the policy?"), summary(judged),
        judged, figures=[share_figure(judged.coverage, "visited on average"), *score],
        heading=(map_text(judged.world, judged.cells, robots),
                 f"{counted(judged.choices.rollouts, 'rollout')}, seed {judged.choices.seed}, at most "
                 f"{judged.world.pace.steps(judged.max_steps)}"),
        parts=[Section("Common random numbers", [table], [note, level])], pace=judged.world.pace,
    )  # fmt: skip


def summary(judged: PolicyEvaluation) -> str:
    """Coverage of the policy, of the best plan, and the bound."""
    best = max(judged.plans.items(), key=lambda item: item[1].coverage.mean, default=None)
    plan = "" if best is None else f"; `{best[0]}`: {percent(best[1].coverage.mean)}"
    said = "a random walk" if judged.walk == "random walk" else judged.walk
    walk, bound, covers = percent(judged.random.mean), ceiled(judged.bound, 1), judged.coverage.describe(100, " %")
    return f"It covers {without_level(covers)}{plan}; {said}: {walk}, upper bound: {bound}."
