"""PPO on `mrac.env`, 8 x 8 cells: one network for all robots learns in minutes, and is judged by `mrac.judge`.

pip install 'mrac-jax[learn]'; python ppo.py --updates 600 --seed 0
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import mrac_jax as mrac

MAP = """
........
..##....
...11...
..1221.#
..1221..
#..11...
.....##.
..1.....
"""
"""A digit: the chance that a visit stops a robot, in tenths; # an obstacle. Both start in the upper left corner."""
ROBOTS = 2


@dataclass(frozen=True)
class Choices:
    """What PPO is run by. envs: side by side. steps: of each between two updates."""

    updates: int = 600
    envs: int = 64
    steps: int = 64
    epochs: int = 4
    minibatches: int = 4
    rate: float = 1e-3
    discount: float = 0.99
    trace: float = 0.95
    clip: float = 0.2
    entropy: float = 0.01


class Taken(NamedTuple):
    """Steps of all robots, `[steps, envs, K]`. there: not lost before. over: the robot, or the episode, is after."""

    seen: jax.Array
    action: jax.Array
    chance: jax.Array
    value: jax.Array
    reward: jax.Array
    there: jax.Array
    over: jax.Array


class Network(eqx.Module):
    """What one robot observes `[P, h, w]` -> logits of its actions, and the reward that it expects."""

    layers: list[eqx.nn.Linear]
    actor: eqx.nn.Linear
    critic: eqx.nn.Linear

    def __init__(self, planes: tuple[int, ...], actions: int, key: jax.Array, width: int = 128) -> None:
        sizes = (int(np.prod(planes)), width), (width, width), (width, actions), (width, 1)
        keys = jax.random.split(key, len(sizes))
        *self.layers, self.actor, self.critic = map(lambda of, key: eqx.nn.Linear(*of, key=key), sizes, keys)

    def __call__(self, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
        inner = seen.ravel()
        for layer in self.layers:
            inner = jax.nn.relu(layer(inner))
        return self.actor(inner), self.critic(inner)[0]


def forward(network: Network, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Log chances of the actions `[..., 5]` and values `[...]` of observations `[..., P, h, w]`."""
    logits, values = jax.vmap(network)(seen.reshape(-1, *seen.shape[-3:]))
    return jax.nn.log_softmax(logits).reshape(*seen.shape[:-3], -1), values.reshape(seen.shape[:-3])


def world() -> mrac.World:
    """MAP."""
    chances = {"#": np.nan, ".": 0.0, "1": 0.1, "2": 0.2}
    return mrac.load(np.array([[chances[sign] for sign in row] for row in MAP.split()]))


def play(env: Any, network: Network, states: Any, key: jax.Array, choices: Choices) -> tuple[Any, Taken, jax.Array]:
    """So many steps of every environment; one that is over begins anew. And what the episodes that ended covered."""

    def step(states: Any, key: jax.Array) -> tuple[Any, tuple[Taken, jax.Array]]:
        first, second = jax.random.split(key)
        seen, there = jax.vmap(env.observe)(states), states.alive
        logs, value = forward(network, seen)
        action = jax.random.categorical(first, logs)
        chance = jnp.take_along_axis(logs, action[..., None], axis=-1)[..., 0]
        keys, actions = jax.random.split(second, choices.envs), dict(zip(env.agents, action.T, strict=True))
        _, states, rewards, dones, infos = jax.vmap(env.step)(keys, states, actions)
        reward, over = (jnp.stack([of[name] for name in env.agents], axis=-1) for of in (rewards, dones))
        ended = jnp.stack([dones["__all__"], dones["__all__"] * infos["covered"]])
        return states, (Taken(seen, action, chance, value, reward, there, over), ended)

    states, (taken, ended) = jax.lax.scan(step, states, jax.random.split(key, choices.steps))
    count, covered = ended.sum(axis=(0, 2))
    return states, taken, covered / jnp.maximum(count, 1)


def advantages(taken: Taken, last: jax.Array, choices: Choices) -> jax.Array:
    """Generalised advantage estimation, `[steps, envs, K]`; `last`: values after the last step."""

    def back(carried: tuple[jax.Array, jax.Array], step: Taken) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        gain, following = carried
        goes_on = choices.discount * (1.0 - step.over)
        gain = step.reward + goes_on * following - step.value + goes_on * choices.trace * gain
        return (gain, step.value), gain

    return jax.lax.scan(back, (jnp.zeros_like(last), last), taken, reverse=True)[1]


def loss(network: Network, taken: Taken, gain: jax.Array, choices: Choices) -> jax.Array:
    """PPO's clipped objective, the squared error of values, the entropy; of robots that were there."""
    logs, value = forward(network, taken.seen)
    ratio = jnp.exp(jnp.take_along_axis(logs, taken.action[:, None], axis=-1)[:, 0] - taken.chance)
    mean = lambda of: (of * taken.there).sum() / taken.there.sum()  # noqa: E731
    scaled = (gain - mean(gain)) / jnp.sqrt(mean((gain - mean(gain)) ** 2) + 1e-8)
    clipped = jnp.clip(ratio, 1 - choices.clip, 1 + choices.clip)
    error, entropy = (value - gain - taken.value) ** 2, -(jnp.exp(logs) * logs).sum(axis=-1)
    return mean(error / 4 - jnp.minimum(ratio * scaled, clipped * scaled) - choices.entropy * entropy)


def make_update(env: Any, choices: Choices) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`begin(key)` and `update(carried, key)`; carried: network, what the optimiser keeps, states."""
    many = choices.epochs * choices.minibatches * choices.updates
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(optax.linear_schedule(choices.rate, 0.0, many)))

    def begin(key: jax.Array) -> tuple[Network, Any, Any]:
        first, second = jax.random.split(key)
        network = Network(env.observation_space(env.agents[0]).shape, env.action_space(env.agents[0]).n, first)
        return network, optimiser.init(network), jax.vmap(env.reset)(jax.random.split(second, choices.envs))[1]

    def learn(carried: tuple[Network, Any], batch: tuple[Taken, jax.Array]) -> tuple[tuple[Network, Any], None]:
        network, kept = carried
        change, kept = optimiser.update(jax.grad(loss)(network, *batch, choices), kept)
        return (eqx.apply_updates(network, change), kept), None

    @jax.jit
    def update(carried: tuple[Network, Any, Any], key: jax.Array) -> tuple[tuple[Network, Any, Any], jax.Array]:
        network, kept, states = carried
        first, *others = jax.random.split(key, 1 + choices.epochs)
        states, taken, covered = play(env, network, states, first, choices)
        gain = advantages(taken, forward(network, jax.vmap(env.observe)(states))[1], choices)
        flat = jax.tree.map(lambda of: of.reshape(-1, *of.shape[3:]), (taken, gain))
        for other in others:
            order = jax.random.permutation(other, len(flat[1])).reshape(choices.minibatches, -1)
            (network, kept), _ = jax.lax.scan(learn, (network, kept), jax.tree.map(itemgetter(order), flat))
        return (network, kept, states), covered

    return begin, update


def train(env: Any, choices: Choices, seed: int = 0, tell: Callable[[str], object] = sys.stdout.write) -> Network:
    """The network after all updates."""
    (begin, update), key, clock = make_update(env, choices), jax.random.key(seed), time.perf_counter()
    carried = begin(key)
    for number in range(choices.updates):
        carried, covered = update(carried, jax.random.fold_in(key, number + 1))
        if (number + 1) % max(choices.updates // 10, 1) == 0:
            took, steps = time.perf_counter() - clock, (number + 1) * choices.envs * choices.steps
            tell(f"{took:5.0f} s, {steps:9,} steps of the team: {float(covered):.1%} covered\n")
    return carried[0]


def policy_of(network: Network) -> Callable[..., jax.Array]:
    """The network as `mrac.judge` takes it: observations of all robots and a key -> an action each."""
    return jax.jit(lambda seen, key: jax.random.categorical(key, forward(network, seen)[0]))


def main() -> None:
    """Train, and say what it is worth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--updates", type=int, default=Choices.updates)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    network = train(mrac.env(world(), ROBOTS, face="jax"), Choices(given.updates), given.seed)
    judged = mrac.judge(world(), policy_of(network), ROBOTS, rollouts=10_000)
    behind = [100 * (to - judged.coverage.mean) for to in (judged.plans["per_cell"].coverage.mean, judged.bound)]
    sys.stdout.write(f"{judged}\n{behind[0]:.1f} points behind per_cell, {behind[1]:.1f} below the proven bound\n")


if __name__ == "__main__":
    main()
