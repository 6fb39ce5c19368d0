"""The environment in JAX, by JaxMARL's conventions: every robot is an agent that stays or moves to a neighbour.

The rules are SPEC's: a robot that enters a cell visits it, and is stopped by the first visit at which its exposure
reaches its tolerance; staying is no visit, and robots may share cells. All is a pure function of a state, a pytree of
fixed shapes: `jit`, `vmap` and `scan` take it. The class mirrors `jaxmarl.environments.multi_agent_env.MultiAgentEnv`
and does not need it.

Axis letters: `K` robots, `N = H * W` cells, `P` planes, `h, w` the map or what a robot sees of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrac_jax.environment.asked import asked_of
from mrac_jax.environment.spaces import Box, Discrete, check_agents, checked_actions
from mrac_jax.process import require_jax
from mrac_jax.threefry import threefry2x32
from mrac_jax.two_words import is_reached, less, tolerance_words, two_words
from planner.arguments import Numbers, whole
from planner.mrac.costs import neighbour_table
from planner.none import NO_CELL
from planner.threefry import OWN_KEYS
from planner.tolerance import LUCK_DRAW
from planner.worlds.doubt import Draws, Hazard
from planner.worlds.starts import starts_of
from planner.worlds.world import World

ACTIONS = ("stay", "north", "west", "east", "south")
"""What an action's number means; a move that an obstacle or the border is in the way of is to stay."""
PLANES = ("threat", "obstacles", "visited", "self", "others", "alive")
"""What a robot observes, a plane each, 0 .. 1: the chance that a visit stops it, what cannot be entered, what was
visited, where it is (nowhere once it is lost), where others are who are not lost, and the share of the team alive."""
AT_ONCE = 32
"""Episodes of a batch that begin together."""
Stepped: TypeAlias = tuple[
    dict[str, jax.Array], "State", dict[str, jax.Array], dict[str, jax.Array], dict[str, jax.Array]
]
"""Observations, state, rewards, dones, infos."""


@partial(jax.tree_util.register_dataclass, meta_fields=[],
         data_fields=["cell", "left", "alive", "visited", "covered", "step", "done", "harmless"])  # fmt: skip
@dataclass(frozen=True)
class State:
    """Where an episode stands.

    Attributes:
        cell: int32 `[K]`, `row * W + col` of each robot. alive: bool `[K]`, not lost.
        left: uint32 `[K, 2]`, what each still bears (`mrac_jax.two_words`).
        visited: bool `[N]`. covered: int32, how many cells that is.
        step: int32, team steps so far. done: bool, whether the episode is over.
        harmless: bool `[N]`, where no hazard is, or is left; None where every visit is drawn from the threat.
    """

    cell: jax.Array
    left: jax.Array
    alive: jax.Array
    visited: jax.Array
    covered: jax.Array
    step: jax.Array
    done: jax.Array
    harmless: jax.Array | None = None


class CoverageEnv:
    """The mission of a team on a world, `[K, ...]` inside and keyed by agent outside.

    Attributes:
        agents: "agent_0" .. "agent_K-1". num_agents: K. accessible: cells that count.
        max_steps: at which an episode is cut off. view: how far a robot sees, in cells; None: the whole map.
        worth: what a lost robot takes off its reward, in cells. walk: what a policy without a thought does, in words.
    """

    walk = "random walk"

    def __init__(
        self,
        world: World,
        robots: int | None = None,
        *,
        starts: ArrayLike | None = None,
        view: int | None = None,
        worth: float = 0.0,
        max_steps: int | None = None,
    ) -> None:
        """Raises InputError for starts or numbers that are none, and for uncertain maps, values, or a team (`asked_of`)
        that it does not play."""
        placed = starts_of(world, robots, starts)
        self._hazards = world.draws if isinstance(world.doubt, Hazard) else None
        (world.check_settled if self._hazards is None else world.check_told)("the environment")
        world.check_alike("the environment")
        asked_of(world)
        Numbers(0).check("worth", worth)
        whole(0).check("view", view, optional=True)
        whole(1).check("max_steps", max_steps, optional=True)
        accessible = world.accessible(placed)
        self.world, self.starts, self.view, self.worth = world, placed, view, float(worth)
        self.num_agents, self.accessible = len(placed), int(accessible.sum())
        self.max_steps = 2 * self.accessible if max_steps is None else int(max_steps)
        self.agents = [f"agent_{robot}" for robot in range(self.num_agents)]
        self._start = (placed[:, 0] * world.shape[1] + placed[:, 1]).astype(np.int32)
        self._next = _moves(world)
        self._legal = np.column_stack([np.ones(len(self._next), bool), self._next[:, 1:] != self._next[:, :1]])
        self._exposure = two_words(world.exposures[0])
        self._still = np.stack([np.nan_to_num(world.threat), ~world.free]).astype(np.float32)
        size = world.shape if view is None else (2 * view + 1, 2 * view + 1)
        self._box, self._discrete = Box(0.0, 1.0, (len(PLANES), *size)), Discrete(len(ACTIONS))

    @property
    def name(self) -> str:
        """Of the environment."""
        return type(self).__name__

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """All agents are alike."""
        return {"robot": self.agents}

    def action_space(self, agent: str) -> Discrete:
        """A number of ACTIONS."""
        return self._discrete

    def observation_space(self, agent: str) -> Box:
        """float32 `[P, h, w]` of PLANES."""
        return self._box

    def reset(self, key: jax.Array) -> tuple[dict[str, jax.Array], State]:
        """Observations and state at t = 0. The luck of `jax.random.key(seed)` is that of rollout 0 of the seed."""
        require_jax()
        return self._reset(key)

    @partial(jax.jit, static_argnums=0)
    def _reset(self, key: jax.Array) -> tuple[dict[str, jax.Array], State]:
        state = self.begin(_seed_of(key), jnp.uint32(0))
        return self.get_obs(state), state

    def step(
        self, key: jax.Array, state: State, actions: dict[str, jax.Array], reset_state: State | None = None
    ) -> Stepped:
        """As `step_env`; where the episode is over, the observations and state are those of the next one."""
        require_jax()
        return self._step(key, state, self._given(actions), reset_state)

    @partial(jax.jit, static_argnums=0)
    def _step(self, key: jax.Array, state: State, actions: jax.Array, reset_state: State | None) -> Stepped:
        after, rewards, dones, infos = self._taken(state, actions)
        if reset_state is None:
            chosen = self._renewed(_seed_of(key), after)
        else:
            chosen = jax.tree.map(lambda new, old: jnp.where(after.done, new, old), reset_state, after)
        return self.get_obs(chosen), chosen, rewards, dones, infos

    def step_env(self, key: jax.Array, state: State, actions: dict[str, jax.Array]) -> Stepped:
        """One step of the team: observations, state, rewards, dones (`__all__` too), infos; `key` is not needed.

        A robot's reward is the cells that it was the first to enter (of robots that enter one cell in one step the
        first by number), minus `worth` when it is lost; then it is done, may only stay, and has reward 0. infos:
        `covered`, a fraction of the accessible cells, `lost` robots, `truncated`.

        Raises UsageError for other agents, and for an action outside the space. Under `jit`, `vmap` or `scan` values
        are not known: there such an action is not noticed, and what it does is undefined.
        """
        require_jax()
        after, rewards, dones, infos = self._taken(state, self._given(actions))
        return self.get_obs(after), after, rewards, dones, infos

    def _given(self, actions: dict[str, jax.Array]) -> jax.Array:
        """The actions by agent as an array, int32 `[K]`."""
        check_agents(actions, self.agents, self.agents)
        each = [checked_actions(actions[name], (), len(ACTIONS), f"action of {name}") for name in self.agents]
        return jnp.stack([jnp.asarray(one, jnp.int32) for one in each])

    def _taken(self, state: State, actions: jax.Array) -> tuple[State, dict, dict, dict]:
        after, rewards = self.advance(state, actions)
        over = dict(zip(self.agents, ~after.alive | after.done, strict=True)) | {"__all__": after.done}
        return after, dict(zip(self.agents, rewards, strict=True)), over, self.infos(after)

    def get_obs(self, state: State) -> dict[str, jax.Array]:
        """What each robot observes, float32 `[P, h, w]`."""
        return dict(zip(self.agents, self.observe(state), strict=True))

    def get_avail_actions(self, state: State) -> dict[str, jax.Array]:
        """Which actions are open to each robot, bool `[5]`: to a lost one, to stay."""
        return dict(zip(self.agents, self.legal(state), strict=True))

    def begin(self, seed: jax.Array, rollout: jax.Array) -> State:
        """The state at t = 0 of a rollout (uint32) of a seed, uint32 `[2]` (low, high): SPEC's luck, bit for bit."""
        key = jnp.stack(threefry2x32(seed, jnp.uint32(OWN_KEYS), jnp.uint32(LUCK_DRAW)))
        words = threefry2x32(key, rollout, jnp.arange(self.num_agents, dtype=jnp.uint32))[0]
        none, no = jnp.int32(0), jnp.bool_(False)
        everybody = jnp.ones(self.num_agents, bool)
        start, unvisited = jnp.asarray(self._start), jnp.zeros(len(self._next), bool)
        harmless = None if self._hazards is None else self._without(self._hazards, seed, rollout)
        state = State(start, tolerance_words(words), everybody, unvisited, none, none, no, harmless)
        return self._entered(state, state.cell, everybody)[0]

    def _without(self, hazards: Draws, seed: jax.Array, rollout: jax.Array) -> jax.Array:
        """Cells in which no hazard is in this rollout, bool `[N]`."""
        key = jnp.stack(threefry2x32(seed, jnp.uint32(OWN_KEYS), jnp.uint32(hazards.purpose)))
        word = threefry2x32(key, rollout, jnp.asarray(hazards.counter))[0] >> jnp.uint32(8)
        return word >= jnp.asarray(hazards.there)

    def _renewed(self, seed: jax.Array, state: State) -> State:
        """The state, or where its episode is over rollout 0 of the seed; of a batch, luck is drawn for those alone."""

        @jax.custom_batching.custom_vmap
        def one(seed: jax.Array, state: State) -> State:
            return jax.lax.cond(state.done, lambda: self.begin(seed, jnp.uint32(0)), lambda: state)

        @one.def_vmap
        def many(size: int, batched: Any, *given: Any) -> tuple[State, Any]:
            wide = lambda of, is_wide: of if is_wide else jnp.broadcast_to(of, (size, *jnp.shape(of)))  # noqa: E731
            seeds, states = jax.tree.map(wide, given, tuple(batched))

            def some(states: State) -> State:
                (over,) = jnp.nonzero(states.done, size=min(size, AT_ONCE), fill_value=size)
                fresh = jax.vmap(self.begin, (0, None))(seeds[over], jnp.uint32(0))
                return jax.tree.map(lambda of, new: of.at[over].set(new, mode="drop"), states, fresh)

            states = jax.lax.while_loop(lambda states: states.done.any(), some, states)
            return states, jax.tree.map(lambda of: True, states)

        return one(seed, state)

    def advance(self, state: State, actions: jax.Array) -> tuple[State, jax.Array]:
        """The state after a team step with these actions, int `[K]`, and the rewards, float32 `[K]`."""
        actions = checked_actions(actions, (self.num_agents,), len(ACTIONS))
        cell = jnp.asarray(self._next)[state.cell, actions]
        cell = jnp.where(state.alive, cell, state.cell)
        after, new = self._entered(state, cell, cell != state.cell)
        step = state.step + 1
        done = (after.covered == self.accessible) | ~after.alive.any() | (step >= self.max_steps)
        rewards = new.astype(jnp.float32) - self.worth * (state.alive & ~after.alive).astype(jnp.float32)
        return replace(after, step=step, done=done), rewards

    def _entered(self, state: State, cell: jax.Array, enters: jax.Array) -> tuple[State, jax.Array]:
        """The state once these robots have entered these cells, and who was the first in one, bool `[K]`."""
        together, lower = cell[:, None] == cell[None], np.tri(self.num_agents, k=-1, dtype=bool)
        with_lower = together & enters[None] & lower
        new = enters & ~state.visited[cell] & ~with_lower.any(axis=1)
        exposure, harmless = jnp.asarray(self._exposure)[cell], state.harmless
        if harmless is not None:
            exposure = jnp.where(harmless[cell][:, None], jnp.uint32(0), exposure)
        hit = enters & is_reached(state.left, exposure)
        if harmless is not None and self._hazards is not None and self._hazards.spends:
            exposure, hit = self._spent(state.left, exposure, cell, hit)
            harmless = harmless.at[cell].max(hit)
        left = jnp.where((enters & ~hit)[:, None], less(state.left, exposure), state.left)
        visited = state.visited.at[cell].set(True)  # who stays is where it has been
        covered = state.covered + new.sum(dtype=jnp.int32)
        return State(cell, left, state.alive & ~hit, visited, covered, state.step, state.done, harmless), new

    def _spent(
        self, left: jax.Array, exposure: jax.Array, cell: jax.Array, hit: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Exposures and hits where the first hit removes a hazard: who enters later in the step, by number, is safe."""
        together, first = cell[:, None] == cell[None], jnp.tri(self.num_agents, k=-1, dtype=bool)
        after = (together & first & hit[None]).any(axis=1)
        return jnp.where(after[:, None], jnp.uint32(0), exposure), hit & ~after

    def infos(self, state: State) -> dict[str, jax.Array]:
        """What there is to know beside the rewards."""
        unfinished = (state.covered < self.accessible) & state.alive.any()
        covered = state.covered.astype(jnp.float32) / self.accessible
        lost = self.num_agents - state.alive.sum(dtype=jnp.int32)
        return {"covered": covered, "lost": lost, "truncated": state.done & unfinished}

    def legal(self, state: State) -> jax.Array:
        """bool `[K, 5]`: the actions of `get_avail_actions`."""
        only_stay = jnp.asarray([[True, False, False, False, False]])
        return jnp.where(state.alive[:, None], jnp.asarray(self._legal)[state.cell], only_stay)

    def observe(self, state: State) -> jax.Array:
        """float32 `[K, P, h, w]`: the observations of all robots."""
        robots, (height, width) = self.num_agents, self.world.shape
        count = jnp.zeros(len(self._next), jnp.float32).at[state.cell].add(state.alive.astype(jnp.float32))
        changing = jnp.stack([state.visited.astype(jnp.float32), count]).reshape(2, height, width)
        shared = jnp.concatenate([jnp.asarray(self._still), changing])
        if self.view is None:
            seen, own = jnp.broadcast_to(shared, (robots, *shared.shape)), state.cell
        else:
            seen, own = self._windows(shared, state.cell, self.view), jnp.full(robots, 2 * self.view * (self.view + 1))
        here = jnp.where(state.alive[:, None], jax.nn.one_hot(own, seen[0, 0].size, dtype=jnp.float32), 0.0)
        here = here.reshape(robots, 1, *seen.shape[2:])
        others = (seen[:, 3:] > here).astype(jnp.float32)
        alive = jnp.full_like(here, state.alive.mean(dtype=jnp.float32))
        return jnp.concatenate([seen[:, :3], here, others, alive], axis=1)

    def _windows(self, planes: jax.Array, cell: jax.Array, view: int) -> jax.Array:
        """What lies within `view` rows and columns of each robot, `[K, 4, h, w]`; beyond the map is an obstacle."""
        beyond = jnp.array([0.0, 1.0, 0.0, 0.0], jnp.float32)[:, None, None]
        padded = jnp.pad(planes - beyond, ((0, 0), (view, view), (view, view))) + beyond
        size = (len(planes), 2 * view + 1, 2 * view + 1)
        rows, cols = jnp.divmod(cell, self.world.shape[1])
        return jax.vmap(lambda row, col: jax.lax.dynamic_slice(padded, (jnp.int32(0), row, col), size))(rows, cols)


def _seed_of(key: jax.Array) -> jax.Array:
    """uint32 `[2]` (low, high): what `jax.random.key` was made of."""
    return jax.random.key_data(key).ravel()[-2:][::-1]


def _moves(world: World) -> NDArray[np.int32]:
    """The cell in which each of ACTIONS ends, int32 `[N, 5]`."""
    here = np.arange(world.threat.size, dtype=np.int32)[:, None]
    near = neighbour_table(world.shape, world.free.ravel())
    return np.hstack([here, np.where(near == NO_CELL, here, near)])
