"""A policy of one's own, judged: the luck of plans, compiled or in Python alike, a score between walk and bound."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_policies import mostly_east

import mrac_jax as mrac
from analysis.policy_evaluation.policy_evaluation import estimate_of, headline, roll_policy, scores_of
from analysis.sampling import RolloutChoices, make_singles
from mrac_jax.environment.coverage_env import ACTIONS, CoverageEnv
from planner.world.generate import random_world

CORRIDOR = mrac.World.create(np.array([[0.0, 0.0, *[0.1] * 10]]))
EAST = ACTIONS.index("east")


def test_a_policy_meets_the_luck_of_plans() -> None:
    """In a corridor every plan goes east, and so does this policy: the same cells, robots and steps, id for id."""
    plan, choices = mrac.plan(CORRIDOR, 1), RolloutChoices(rollouts=300, seed=9)
    found = make_singles(CORRIDOR, plan, choices)(0, 300)
    visited, lost, steps = roll_policy(CoverageEnv(CORRIDOR, 1), lambda seen: [EAST], 9, 300)
    assert (visited == found.visited).all() and (lost == 1 - found.alive).all() and (steps == found.time).all()
    assert 0 < lost.sum() < 300
    judged = mrac.judge(CORRIDOR, jax.jit(lambda seen: jnp.full(len(seen), EAST)), 1, rollouts=300, seed=9)
    assert judged.plans["mrac"].ahead.mean == 0 and judged.coverage.mean == visited.mean() / 12
    assert (
        judged.score is not None and judged.random.mean < judged.coverage.mean < judged.bound + 4 * judged.coverage.se
    )
    assert re.search(r"It covers [\d.]+ % ± [\d.]+; ", repr(judged)) and "95 %" not in headline(judged)
    assert "no strategy more than" in repr(judged) and judged.to_json()["score"]["mean"] == judged.score.mean


def to_new(seen: jax.Array) -> jax.Array:
    """Every robot to its first neighbour that is free and unvisited, else east."""
    place = jnp.argmax(seen[:, 3].reshape(len(seen), -1), axis=1)
    rows, cols = place // seen.shape[3], place % seen.shape[3]
    wanted = jnp.pad((seen[:, 1] == 0) & (seen[:, 2] == 0), ((0, 0), (1, 1), (1, 1)))
    sides = [(0, 1), (1, 0), (1, 2), (2, 1)]
    new = jnp.stack([wanted[jnp.arange(len(seen)), rows + down, cols + right] for down, right in sides], axis=1)
    return jnp.where(new.any(axis=1), 1 + jnp.argmax(new, axis=1), EAST)


def test_compiled_or_asked_is_the_same() -> None:
    env = CoverageEnv(random_world(6, 7, obstacles=0.15, threats=0.3), 3, max_steps=40)
    compiled = jax.jit(to_new)
    one, other = (roll_policy(env, policy, 5, 40) for policy in (compiled, lambda seen: np.asarray(compiled(seen))))
    assert all((a == b).all() for a, b in zip(one, other, strict=True))
    walk = roll_policy(env, None, 5, 40)
    assert one[0].mean() > walk[0].mean() and (roll_policy(env, None, 5, 20)[0] == walk[0][:20]).all()


def test_a_policy_may_be_random() -> None:
    env = CoverageEnv(CORRIDOR, 2, max_steps=9)
    asked = [roll_policy(env, lambda seen, draws: draws.integers(0, 5, len(seen)), 1, 6) for _ in range(2)]
    compiled = [roll_policy(env, jax.jit(lambda seen, key: jax.random.randint(key, 2, 0, 5)), 1, 6) for _ in range(2)]
    for first, second in (asked, compiled):
        assert all((a == b).all() for a, b in zip(first, second, strict=True)) and len(set(first[0].tolist())) > 1


def test_the_interval_of_a_score_holds_it() -> None:
    """In 95 of 100 samples, within 5 standard errors, where both figures are known."""
    draw, held, turns = np.random.default_rng(8), 0, 400
    for _ in range(turns):
        shared = draw.random(200) * 0.2
        scores = scores_of(0.4 + shared + draw.random(200) * 0.2, 0.1 + shared + draw.random(200) * 0.1, 0.9)
        assert scores is not None
        found = estimate_of(scores)
        held += found.ci95[0] <= (0.6 - 0.25) / (0.9 - 0.25) <= found.ci95[1]
    assert abs(held / turns - 0.95) < 5 * np.sqrt(0.95 * 0.05 / turns)
    assert scores_of(np.ones(5), np.ones(5), 1.0) is None


WRONG = [
    jax.jit(lambda seen: jnp.full(1, 7)),
    jax.jit(lambda seen: jnp.full(1, -1)),
    jax.jit(lambda seen: seen[:, 0, 0, 0]),
]
"""Compiled policies: actions that there are not."""


@pytest.mark.parametrize("wrong", WRONG)
def test_a_compiled_policy_s_actions_are_checked(wrong: object) -> None:
    with pytest.raises(mrac.InputError, match="the policy returned actions"):
        roll_policy(CoverageEnv(CORRIDOR, 1), wrong, 9, 8)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [lambda seen: 3, lambda seen: [7], lambda seen: [0.5], jax.jit(lambda seen: seen), 5])
def test_what_is_no_policy_is_refused(wrong: object) -> None:
    with pytest.raises(mrac.InputError):
        mrac.judge(CORRIDOR, wrong, 1, rollouts=2)  # type: ignore[arg-type]


def test_processes_change_no_figure() -> None:
    given = {"rollouts": 300, "seed": 4, "max_steps": 12, "against": ("mrac",), "progress": False}
    one, two = (mrac.judge(CORRIDOR, mostly_east, 2, processes=n, **given) for n in (1, 2))
    assert one.to_json() == two.to_json() and one.coverage.se > 0
    assert one.to_json() == mrac.evaluate(CORRIDOR, 2, policy=mostly_east, **given).to_json()
    with pytest.raises(mrac.InputError, match=r"processes=2, but the policy cannot be sent.*can be imported"):
        mrac.judge(CORRIDOR, lambda seen: mostly_east(seen, None), processes=2, rollouts=300)


@pytest.mark.parametrize("kind", ["persistent", "consumed"])
def test_hazards_are_those_of_plans(kind: str, tmp_path: Path) -> None:
    """Robots side by side in a corridor, so that a consumed hazard is gone for who comes after in the same step."""
    world = mrac.with_hazard(CORRIDOR, kind, np.array([[0.0, 0.0, *[0.5] * 10]]), 0.4).with_starts([[0, 0]] * 3)
    (tmp_path / "paths.json").write_text(str([[[0, col] for col in range(12)]] * 3))
    plan = mrac.read_plan(tmp_path / "paths.json", world)
    choices = RolloutChoices(loop="open", rollouts=400, seed=3)
    found = make_singles(world, plan, choices)(0, 400)
    visited, lost, _ = roll_policy(CoverageEnv(world), lambda seen: [EAST] * 3, 3, 400)
    assert (visited == found.visited).all() and (lost == 3 - found.alive).all() and len(set(lost.tolist())) > 2
    judged = mrac.judge(world, jax.jit(lambda seen: jnp.full(len(seen), EAST)), rollouts=400, progress=False)
    assert judged.coverage.mean < judged.bound + 4 * judged.coverage.se


def test_what_is_for_plans_alone_is_refused_of_a_policy() -> None:
    with pytest.raises(
        mrac.InputError, match=r"no argument 'loop' for a policy; expected one of starts, actions, view"
    ):
        mrac.evaluate(CORRIDOR, policy=mostly_east, loop="open")
    with pytest.raises(mrac.InputError, match="both a plan and a policy"):
        mrac.evaluate(CORRIDOR, mrac.plan(CORRIDOR), policy=mostly_east)  # type: ignore[call-overload]
