"""The example that learns by PPO: in a few updates more than a random walk, by advantages as they are defined."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mrac_jax as mrac

pytest.importorskip("equinox")
pytest.importorskip("optax")


@pytest.fixture(scope="module")
def ppo() -> Any:
    path = Path(__file__).parent.parent / "docs" / "examples" / "ppo.py"
    assert len(path.read_text().splitlines()) <= 200
    spec = importlib.util.spec_from_file_location("ppo", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules["ppo"] = importlib.util.module_from_spec(spec)  # its dataclass looks itself up
    spec.loader.exec_module(module)
    return module


def test_a_few_updates_beat_a_random_walk(ppo: Any) -> None:
    said: list[str] = []
    env = mrac.env(ppo.world(), ppo.ROBOTS, face="jax")
    network = ppo.train(env, ppo.Choices(updates=20, envs=32), 1, said.append)
    assert len(said) == 10 and "covered" in said[-1]
    judged = mrac.judge(ppo.world(), ppo.policy_of(network), ppo.ROBOTS, rollouts=256, against=(), progress=False)
    assert judged.score is not None and judged.score.mean > 5 * judged.score.se


def test_advantages_are_sums_of_errors(ppo: Any) -> None:
    """By the definition: of what follows, discounted, until the episode is over."""
    draw, choices = np.random.default_rng(0), ppo.Choices()
    reward, value, over = draw.random((9, 2, 3)), draw.random((9, 2, 3)), draw.random((9, 2, 3)) < 0.2
    last, none = draw.random((2, 3)), jnp.zeros((9, 2, 3))
    taken = ppo.Taken(none, none, none, *(jnp.asarray(of, jnp.float32) for of in (value, reward)), none, over)
    found = ppo.advantages(taken, jnp.asarray(last, jnp.float32), choices)
    for env, robot in np.ndindex(2, 3):
        for step in range(9):
            total, weight = 0.0, 1.0
            for at in range(step, 9):
                following = value[at + 1, env, robot] if at < 8 else last[env, robot]
                ends = over[at, env, robot]
                total += weight * (
                    reward[at, env, robot] + choices.discount * following * (not ends) - value[at, env, robot]
                )
                weight *= choices.discount * choices.trace
                if ends:
                    break
            assert abs(total - float(found[step, env, robot])) < 1e-4
    assert jax.tree.leaves(found)[0].dtype == jnp.float32
