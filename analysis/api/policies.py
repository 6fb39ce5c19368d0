"""Policies of one's own, and the worlds that they are played on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import ArrayLike

from analysis.api.plans import check_world
from analysis.kit.calls import OnInterrupt, ask
from analysis.kit.notes import Doing, Progress
from analysis.sampling import RolloutChoices
from planner.arguments import argument
from planner.errors import UsageError
from planner.settings import Policy
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.judging.judge import Judged
    from analysis.standings.suite import Suite


def judge(
    world: World,
    policy: Callable[..., Any],
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    actions: Literal["moves", "areas"] = "moves",
    view: int | None = None,
    rule: Policy | None = None,
    offers: int | None = None,
    max_steps: int | None = None,
    rollouts: int = 1000,
    seed: int = 0,
    against: Sequence[str] = ("mrac", "per_cell"),
    processes: int | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Judged:
    """What is a policy of one's own worth: its coverage, and its score between a random walk and the proven bound.

    Args:
        policy: a function of what all robots observe, float32 `[K, 6, h, w]`, or of areas `[K, offers, 8]` (`env`),
            that returns an action for each; of two arguments, then of a random key (a NumPy generator) of the rollout
            too. Under `jax.jit` it runs inside the compiled rollouts, if its actions are moves.
            It is asked for many rollouts in turn, and is to remember none.
        robots, starts, actions, view, rule, offers, max_steps: as of `env`.
        rollouts, seed: rollout r of the seed has the luck that it has in `evaluate`.
        against: policies of the planner that are rolled out on the same random numbers, and ended at the same step.
        processes: that ask a policy in Python; the figures are the same. None: one a core, where it can be imported.
        progress, on_interrupt: as of `evaluate`.
    """
    from analysis.judging.judge import judge as judge_policy
    from planner.rollouts.names import of_jax

    check_world(world)
    if not callable(policy):
        raise UsageError(argument("policy", policy), expected="a function of what the robots observe")
    given: dict[str, Any] = {"starts": starts, "actions": actions, "view": view, "rule": rule, "offers": offers}
    env = of_jax("environment")(world, robots, **given, max_steps=max_steps)
    choices = RolloutChoices(rollouts=rollouts, seed=seed)

    def work(tell: Progress, doing: Doing) -> Judged:
        return judge_policy(world, policy, env, choices, against, processes, tell)

    return ask(work, progress, on_interrupt)


def suite(only: str | Sequence[str] | None = None) -> Suite:
    """Thirty named worlds, the same for ever, as a mapping from names to worlds; `.judge(policy)` plays them.

    Args:
        only: names, or patterns as ``contiguous-10-*``; None: all.
    """
    from analysis.standings.suite import Suite

    return Suite(only)
