"""Environment steps per second: `python docs/examples/bench_environments.py`.

1,024 environments, 8 robots, 20x20 cells. Random actions, 200 steps in one compiled scan, the best of several runs. For
comparison, if installed: Jumanji's Cleaner (20x20, 8 agents), and STORM, JaxMARL's grid world with as many agents (its
8-agent arena). Columns: only rewards are read, so that the compiler removes observations; or observations too. Episodes
restart (Cleaner: a new maze, by Jumanji's `AutoResetWrapper`); this project and Cleaner are also run without. Last:
choices of areas per second of one environment in Python (`actions="areas"`), always the first offer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console

from analysis.utils.tables import make_table
from planner.policies import RULES
from planner.rollouts.names import of_jax
from planner.world.generate import random_world

ENVIRONMENTS, STEPS, SIDE, ROBOTS, TURNS = 1024, 200, 20, 8, 5
SLOW = 10.0
"""A run of this many seconds is not repeated."""
Step = Callable[[jax.Array, Any], tuple[Any, jax.Array, Any]]
"""From a key and a batch of states: the next states, the sum of the rewards, and the observations."""


def any_of(key: jax.Array, count: int) -> jax.Array:
    """A random action for each robot, int32 `[B, K]`, by a hash: `jax.random` would dominate the run time."""
    place = jnp.arange(ENVIRONMENTS * ROBOTS, dtype=jnp.uint32).reshape(ENVIRONMENTS, ROBOTS)
    word = jax.random.bits(key) + place * jnp.uint32(2654435761)
    word = (word ^ (word >> 15)) * jnp.uint32(0x2C1B3C6D)
    return ((word ^ (word >> 12)) >> 8).astype(jnp.int32) % count


def ours(view: int | None = None, planes: bool = False, anew: bool = True) -> tuple[Any, Step]:
    """States and step of this project's environment; observations are the planes of all robots, or the team's state.

    `anew`: episodes restart.
    """
    env = of_jax("environment")(random_world(SIDE, SIDE), ROBOTS, view=view)
    take = env.step if anew else env.step_env

    def step(key: jax.Array, states: Any) -> tuple[Any, jax.Array, Any]:
        first, second = jax.random.split(key)
        legal, chosen = jax.vmap(env.legal)(states), any_of(first, 5).T
        actions = dict(zip(env.agents, chosen, strict=True))
        seen, after, rewards, _, _ = jax.vmap(take)(jax.random.split(second, ENVIRONMENTS), states, actions)
        return after, sum(rewards.values()), seen if planes else (after.visited, after.cell, legal, after.step)

    return jax.vmap(env.reset)(jax.random.split(jax.random.key(0), ENVIRONMENTS))[1], step


def cleaner(anew: bool = True) -> tuple[Any, Step]:
    """Jumanji's Cleaner: a maze whose tiles are to be visited, without threats."""
    from jumanji.environments import Cleaner
    from jumanji.environments.routing.cleaner.generator import RandomGenerator
    from jumanji.wrappers import AutoResetWrapper

    alone = Cleaner(generator=RandomGenerator(SIDE, SIDE, ROBOTS))
    env = AutoResetWrapper(alone) if anew else alone

    def step(key: jax.Array, states: Any) -> tuple[Any, jax.Array, Any]:
        after, result = jax.vmap(env.step)(states, any_of(key, 4))
        return after, result.reward, result.observation

    return jax.vmap(env.reset)(jax.random.split(jax.random.key(0), ENVIRONMENTS))[0], step


def storm() -> tuple[Any, Step]:
    """JaxMARL's STORM: agents that collect coins on a grid of 8 x 8 and play a matrix game."""
    import jaxmarl

    env = jaxmarl.make("storm_np", num_agents=ROBOTS)
    actions = env.num_actions

    def step(key: jax.Array, states: Any) -> tuple[Any, jax.Array, Any]:
        first, second = jax.random.split(key)
        chosen = any_of(first, actions).T
        given = dict(zip(env.agents, chosen, strict=True))
        seen, after, rewards, _, _ = jax.vmap(env.step)(jax.random.split(second, ENVIRONMENTS), states, given)
        return after, jnp.stack(jax.tree.leaves(rewards)).sum(0), seen

    return jax.vmap(env.reset)(jax.random.split(jax.random.key(0), ENVIRONMENTS))[1], step


def scanned(begin: Any, step: Step, read: bool) -> Callable[[jax.Array], Any]:
    """A compiled run of all steps that returns the sum of the rewards, with `read` also of all observations."""

    def one(carried: Any, key: jax.Array) -> tuple[Any, None]:
        states, total = carried
        states, rewards, seen = step(key, states)
        total += rewards.sum()
        if read:
            total += sum(jnp.sum(leaf, dtype=jnp.float32) for leaf in jax.tree.leaves(seen))
        return (states, total), None

    return jax.jit(lambda key: jax.lax.scan(one, (begin, jnp.float32(0)), jax.random.split(key, STEPS))[0][1])


def contenders() -> dict[str, tuple[Any, Step]]:
    """The installed environments, by name."""
    found = {
        "mrac, no new episodes, state of the team": ours(anew=False),
        "mrac, state of the team": ours(),
        "mrac, planes of the whole map": ours(planes=True),
        "mrac, planes within 2 cells": ours(2, planes=True),
    }
    peers = (
        ("jumanji", "Jumanji Cleaner 20x20, no new episodes", lambda: cleaner(False)),
        ("jumanji", "Jumanji Cleaner 20x20", cleaner), ("jaxmarl", "JaxMARL STORM 8x8", storm),
    )  # fmt: skip
    return found | {name: make() for package, name, make in peers if find_spec(package)}


def choices(rule: str, missions: int = 30) -> float:
    """Choices of areas per second of this process, over `missions` missions."""
    env = of_jax("environment")(random_world(SIDE, SIDE), ROBOTS, actions="areas", rule=rule)
    made, clock = 0, time.process_time()
    for rollout in range(missions):
        run = env.begin(0, rollout)
        run.go_on()
        while run.decision is not None:
            env.observe(run), env.legal(run)
            run.go_on(0)
            made += 1
    return made / (time.process_time() - clock)


def main() -> None:
    """Print a line for every environment."""
    made = contenders()
    runs = {(name, read): scanned(*one, read) for name, one in made.items() for read in (False, True)}
    best = dict.fromkeys(runs, float("inf"))
    for turn in range(TURNS + 1):
        for case, run in runs.items():
            if SLOW < best[case] < float("inf"):
                continue
            clock = time.perf_counter()
            jax.block_until_ready(run(jax.random.key(turn)))
            took = time.perf_counter() - clock
            if turn or took > 10 * SLOW:  # the first one compiles
                best[case] = min(best[case], took)
    table = make_table(("environment, 1,024 at once, 8 robots", "rewards, steps/s", "observations too, steps/s"))
    for name in made:
        table.add_row(name, *(f"{ENVIRONMENTS * STEPS / best[name, read]:,.0f}" for read in (False, True)))
    Console(highlight=False).print(table)
    chosen = make_table(('actions="areas", one, 8 robots', "choices/s"))
    for rule in RULES:
        chosen.add_row(rule, f"{choices(rule):,.0f}")
    Console(highlight=False).print(chosen)


if __name__ == "__main__":
    main()
