"""The environment in JAX with JaxMARL's conventions: every robot is an agent that stays or moves to a neighbour.

The rules are those of docs/spec.md: a robot that enters a cell visits it, and is lost at the first visit at which its
cumulative hazard reaches its failure threshold; staying is not a visit, and robots may share cells. All functions are
pure functions of a state, a pytree of fixed shapes, for `jit`, `vmap` and `scan`. The class has the methods of
`jaxmarl.environments.multi_agent_env.MultiAgentEnv` without importing it.

Axis letters: `K` robots, `N = H * W` cells, `P` planes, `h, w` the map or a robot's view of it.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrac_jax.arrays import is_reached, less, threefry2x32, threshold_pairs, uint64_pairs
from mrac_jax.process import fixed_flags, require_jax
from planner.arguments import SEED, Numbers, argument, did_you_mean, whole
from planner.errors import PlanError, UsageError
from planner.failure_model import OWN_KEYS, THRESHOLD_DRAW, key_of
from planner.settings import Choices, Settings
from planner.simulator.codes import NO_CELL
from planner.simulator.searches import neighbour_table
from planner.world.start_rule import starts_of
from planner.world.uncertain_maps import Draws, Hazard
from planner.world.world import World

# Spaces of an agent, named as in JaxMARL; and checks of given actions.


class Discrete(NamedTuple):
    """Actions 0 .. n - 1."""

    n: int
    shape: tuple[int, ...] = ()
    dtype: Any = jnp.int32


class Box(NamedTuple):
    """Arrays of a shape with values between two bounds."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32


def checked_actions(given: Any, shape: tuple[int, ...], count: int, name: str = "actions") -> Any:
    """The actions as an array of this shape, each an integer 0 .. `count` - 1. Raises UsageError for other input.

    Under a JAX trace values are unknown: only shape and type are checked, and an action out of range is undefined.
    """
    traced = isinstance(given, jax.core.Tracer)
    try:
        actions = given if traced else np.asarray(given)
    except ValueError:  # lists of different lengths
        actions = np.array(None)
    each = f"whole numbers, 0 to {count - 1}, of shape {shape}" if shape else f"a whole number, 0 to {count - 1}"
    if actions.shape != shape or actions.dtype.kind not in "iu":
        shown = f"{actions.dtype} of shape {actions.shape}" if traced else reprlib.repr(given)
        raise UsageError(f"{name}: {shown}", expected=each)
    if traced:
        return actions
    # Name the first action out of range: JAX would clamp its index silently.
    for place in map(tuple, np.argwhere((actions < 0) | (actions >= count)).tolist()):
        raise UsageError(f"{name}{list(place) if place else ''}: {actions[place]}", expected=each)
    return actions


def check_agents(given: Any, agents: Sequence[str], needed: Sequence[str]) -> None:
    """Raise UsageError unless `given` is a mapping from names of agents, with all that are `needed`."""
    expected = f"a dict from names of agents, {agents[0]!r} to {agents[-1]!r}, to actions"
    if not isinstance(given, Mapping):
        raise UsageError(f"actions: {reprlib.repr(given)}", expected=expected)
    for name in given:
        if name not in agents:
            raise UsageError(f"actions of {name!r}", expected=expected, fix=did_you_mean(name, agents))
    missing = [repr(name) for name in needed if name not in given]
    if missing:
        raise UsageError(f"no action for {', '.join(missing)}", expected=expected)


# Settings of a world in an environment, and settings that no environment supports.


def supported_settings(world: World, **given: Any) -> Settings:
    """The settings of a world, with `given` ones instead of its own, as in `evaluate`.

    Raises InputError that names the world for settings that an environment does not simulate as `evaluate` does.
    """
    settings = Choices(**given).settings(world.team.settings, world.pace, by=world.source)
    settings.require_uniform("the environment")
    failure_model = settings.failure_model()
    unlike = {
        "plan_for": settings.plan_for != "closed_loop",
        "weibull_shape": failure_model.shape != 1,
        "hazard_multiplier": not failure_model.is_even,
        "range": settings.range is not None,
        "return_to": settings.return_to is not None,
        "deadline": settings.deadline is not None,
    }
    for name in (name for name, is_so in unlike.items() if is_so):
        fix = f"omit {argument(name)}" + (f", and give {argument('max_steps')}" if name == "deadline" else "")
        raise PlanError(f"the environment with {argument(name)}", source=world.source, fix=fix)
    return settings


ACTIONS = ("stay", "north", "west", "east", "south")
"""Meaning of an action; a move into an obstacle or off the map is a stay."""
PLANES = ("threat", "obstacles", "visited", "self", "others", "alive")
"""Observed planes, 0 .. 1: probability that a visit destroys the robot, obstacles and border, visited cells, the own
cell (empty once the robot is lost), cells of other live robots, and the share of the team alive."""
AT_ONCE = 32
"""Episodes of a batch that are started together."""
Stepped: TypeAlias = tuple[
    dict[str, jax.Array], "State", dict[str, jax.Array], dict[str, jax.Array], dict[str, jax.Array]
]
"""Observations, state, rewards, dones, infos."""


@partial(jax.tree_util.register_dataclass, meta_fields=[],
         data_fields=["cell", "left", "alive", "visited", "covered", "step", "done", "harmless"])  # fmt: skip
@dataclass(frozen=True)
class State:
    """State of an episode.

    Attributes:
        cell: int32 `[K]`, `row * W + col` of each robot. alive: bool `[K]`, not lost.
        left: uint32 `[K, 2]`, each robot's remaining threshold (`mrac_jax.arrays`).
        visited: bool `[N]`. covered: int32, number of visited cells.
        step: int32, team steps so far. done: bool, whether the episode is over.
        harmless: bool `[N]`, cells without a hazard; None: every visit is drawn from the threat.
    """

    cell: jax.Array
    left: jax.Array
    alive: jax.Array
    visited: jax.Array
    covered: jax.Array
    step: jax.Array
    done: jax.Array
    harmless: jax.Array | None = None


class Mission:
    """A team on a world, as all environments have it.

    Attributes:
        agents: "agent_0" .. "agent_K-1". num_agents: K. accessible: number of accessible cells. starts: int64 `[K, 2]`.
        robot_value: penalty for a lost robot, in cells. settings: of the planner.
    """

    def __init__(
        self, world: World, robots: int | None, starts: ArrayLike | None, robot_value: float, **given: Any
    ) -> None:
        """`given`: as of `supported_settings`. Raises InputError."""
        self.world, self.starts = world, starts_of(world, robots, starts)
        # Latent hazards are sampled once for each rollout; other uncertain maps are not supported.
        hazards = isinstance(world.uncertainty, Hazard)
        (world.require_known_map if hazards else world.require_certain_map)("the environment")
        world.require_uniform("the environment")
        self.settings = supported_settings(world, **given)
        Numbers(0).check("robot_value", robot_value)
        self.robot_value, self.num_agents = float(robot_value), len(self.starts)
        self.accessible = int(world.accessible(self.starts).sum())
        self.agents = [f"agent_{robot}" for robot in range(self.num_agents)]


class CoverageEnv(Mission):
    """The mission of a team on a world; arrays `[K, ...]` inside, dicts by agent outside.

    Attributes:
        max_steps: end of an episode. view: range of observations, in cells; None: the whole map.
        walk: name of the random baseline policy.
    """

    walk = "random walk"

    def __init__(
        self,
        world: World,
        robots: int | None = None,
        *,
        starts: ArrayLike | None = None,
        view: int | None = None,
        robot_value: float = 0.0,
        max_steps: int | None = None,
    ) -> None:
        """Raises InputError for invalid starts or numbers, and for uncertain maps, values, or team settings
        (`supported_settings`) that are not supported."""
        super().__init__(world, robots, starts, robot_value)
        self._hazards = world.draws if isinstance(world.uncertainty, Hazard) else None
        whole(0).check("view", view, optional=True)
        whole(1).check("max_steps", max_steps, optional=True)
        self.view, self.max_steps = view, 2 * self.accessible if max_steps is None else int(max_steps)
        self._start = (self.starts[:, 0] * world.shape[1] + self.starts[:, 1]).astype(np.int32)
        self._next = _moves(world)
        # A blocked move is a stay, so it is offered only as "stay".
        self._legal = np.column_stack([np.ones(len(self._next), bool), self._next[:, 1:] != self._next[:, :1]])
        # Environments have no phases, so the first map is the only one.
        self._exposure = uint64_pairs(world.exposures[0])
        self._still = np.stack([np.nan_to_num(world.threat), ~world.free]).astype(np.float32)
        size = world.shape if view is None else (2 * view + 1, 2 * view + 1)
        self._box, self._discrete = Box(0.0, 1.0, (len(PLANES), *size)), Discrete(len(ACTIONS))

    @property
    def name(self) -> str:
        """Name of the environment."""
        return type(self).__name__

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """One class: all agents are equal."""
        return {"robot": self.agents}

    def action_space(self, agent: str) -> Discrete:
        """Indices of ACTIONS."""
        return self._discrete

    def observation_space(self, agent: str) -> Box:
        """float32 `[P, h, w]` of PLANES."""
        return self._box

    def reset(self, key: jax.Array) -> tuple[dict[str, jax.Array], State]:
        """Observations and state at t = 0. `jax.random.key(seed)` gives the random numbers of rollout 0 of the seed."""
        require_jax()
        return self._reset(key)

    @partial(jax.jit, static_argnums=0)
    def _reset(self, key: jax.Array) -> tuple[dict[str, jax.Array], State]:
        state = self.begin(_seed_of(key), jnp.uint32(0))
        return self.get_obs(state), state

    def step(
        self, key: jax.Array, state: State, actions: dict[str, jax.Array], reset_state: State | None = None
    ) -> Stepped:
        """As `step_env`; after the end of an episode, observations and state are those of the next one."""
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
        """One step of the team: observations, state, rewards, dones (also `__all__`), infos; `key` is not used.

        A robot's reward is the number of cells that it is the first to enter (of robots that enter a cell in the same
        step, the first by number), minus `robot_value` when it is lost. A lost robot is done, may only stay, and has
        reward 0. infos: `covered`, a fraction of the accessible cells, `lost` robots, `truncated`.

        Raises UsageError for unknown agents, and for an action out of range. Under `jit`, `vmap` or `scan` values are
        unknown: there such an action is not detected, and its effect is undefined.
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
        """The observation of each robot, float32 `[P, h, w]`."""
        return dict(zip(self.agents, self.observe(state), strict=True))

    def get_avail_actions(self, state: State) -> dict[str, jax.Array]:
        """The legal actions of each robot, bool `[5]`; a lost robot can only stay."""
        return dict(zip(self.agents, self.legal(state), strict=True))

    def begin(self, seed: jax.Array, rollout: jax.Array) -> State:
        """The state at t = 0 of a rollout (uint32) of a seed, uint32 `[2]` (low, high), bit for bit as in the spec."""
        key = jnp.stack(threefry2x32(seed, jnp.uint32(OWN_KEYS), jnp.uint32(THRESHOLD_DRAW)))
        words = threefry2x32(key, rollout, jnp.arange(self.num_agents, dtype=jnp.uint32))[0]
        none, no = jnp.int32(0), jnp.bool_(False)
        everyone = jnp.ones(self.num_agents, bool)
        start, unvisited = jnp.asarray(self._start), jnp.zeros(len(self._next), bool)
        harmless = None if self._hazards is None else self._without(self._hazards, seed, rollout)
        state = State(start, threshold_pairs(words), everyone, unvisited, none, none, no, harmless)
        return self._entered(state, state.cell, everyone)[0]

    def _without(self, hazards: Draws, seed: jax.Array, rollout: jax.Array) -> jax.Array:
        """Cells without a hazard in this rollout, bool `[N]`."""
        key = jnp.stack(threefry2x32(seed, jnp.uint32(OWN_KEYS), jnp.uint32(hazards.purpose)))
        word = threefry2x32(key, rollout, jnp.asarray(hazards.counter))[0] >> jnp.uint32(8)
        return word >= jnp.asarray(hazards.there)

    def _renewed(self, seed: jax.Array, state: State) -> State:
        """The state, or rollout 0 of the seed if the episode is over; in a batch, only these are sampled."""

        @jax.custom_batching.custom_vmap
        def one(seed: jax.Array, state: State) -> State:
            return jax.lax.cond(state.done, lambda: self.begin(seed, jnp.uint32(0)), lambda: state)

        @one.def_vmap
        def many(size: int, batched: Any, *given: Any) -> tuple[State, Any]:
            wide = lambda of, is_wide: of if is_wide else jnp.broadcast_to(of, (size, *jnp.shape(of)))  # noqa: E731
            seeds, states = jax.tree.map(wide, given, tuple(batched))

            def some(states: State) -> State:
                # A fixed number of episodes starts at once: shapes must be static. Rows beyond are dropped.
                (over,) = jnp.nonzero(states.done, size=min(size, AT_ONCE), fill_value=size)
                fresh = jax.vmap(self.begin, (0, None))(seeds[over], jnp.uint32(0))
                return jax.tree.map(lambda of, new: of.at[over].set(new, mode="drop"), states, fresh)

            states = jax.lax.while_loop(lambda states: states.done.any(), some, states)
            return states, jax.tree.map(lambda of: True, states)

        return one(seed, state)

    def advance(self, state: State, actions: jax.Array) -> tuple[State, jax.Array]:
        """The state after a team step with actions int `[K]`, and the rewards, float32 `[K]`."""
        actions = checked_actions(actions, (self.num_agents,), len(ACTIONS))
        cell = jnp.asarray(self._next)[state.cell, actions]
        # Lost robots stay in place, whatever their action.
        cell = jnp.where(state.alive, cell, state.cell)
        after, new = self._entered(state, cell, cell != state.cell)
        step = state.step + 1
        # The three outcomes of a mission without a risk limit.
        done = (after.covered == self.accessible) | ~after.alive.any() | (step >= self.max_steps)
        rewards = new.astype(jnp.float32) - self.robot_value * (state.alive & ~after.alive).astype(jnp.float32)
        return replace(after, step=step, done=done), rewards

    def _entered(self, state: State, cell: jax.Array, enters: jax.Array) -> tuple[State, jax.Array]:
        """The state after these robots enter these cells, and whether each is the first in its cell, bool `[K]`."""
        together, lower = cell[:, None] == cell[None], np.tri(self.num_agents, k=-1, dtype=bool)
        # Of robots that enter a cell in the same step, the first by number gets the reward.
        with_lower = together & enters[None] & lower
        new = enters & ~state.visited[cell] & ~with_lower.any(axis=1)
        exposure, harmless = jnp.asarray(self._exposure)[cell], state.harmless
        if harmless is not None:
            exposure = jnp.where(harmless[cell][:, None], jnp.uint32(0), exposure)
        hit = enters & is_reached(state.left, exposure)
        if harmless is not None and self._hazards is not None and self._hazards.spends:
            exposure, hit = self._spent(state.left, exposure, cell, hit)
            harmless = harmless.at[cell].max(hit)
        # A lost robot's threshold stays, as a further subtraction would wrap around.
        left = jnp.where((enters & ~hit)[:, None], less(state.left, exposure), state.left)
        visited = state.visited.at[cell].set(True)  # a robot that stays is in a visited cell
        covered = state.covered + new.sum(dtype=jnp.int32)
        return State(cell, left, state.alive & ~hit, visited, covered, state.step, state.done, harmless), new

    def _spent(
        self, left: jax.Array, exposure: jax.Array, cell: jax.Array, hit: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Hazards and losses if the first loss removes a hazard: robots of higher number in the step are safe."""
        together, first = cell[:, None] == cell[None], jnp.tri(self.num_agents, k=-1, dtype=bool)
        after = (together & first & hit[None]).any(axis=1)
        return jnp.where(after[:, None], jnp.uint32(0), exposure), hit & ~after

    def infos(self, state: State) -> dict[str, jax.Array]:
        """Information in addition to the rewards."""
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
        # Robots may share a cell, so the plane of the others needs a count.
        count = jnp.zeros(len(self._next), jnp.float32).at[state.cell].add(state.alive.astype(jnp.float32))
        changing = jnp.stack([state.visited.astype(jnp.float32), count]).reshape(2, height, width)
        shared = jnp.concatenate([jnp.asarray(self._still), changing])
        if self.view is None:
            seen, own = jnp.broadcast_to(shared, (robots, *shared.shape)), state.cell
        else:
            seen, own = self._windows(shared, state.cell, self.view), jnp.full(robots, 2 * self.view * (self.view + 1))
        here = jnp.where(state.alive[:, None], jax.nn.one_hot(own, seen[0, 0].size, dtype=jnp.float32), 0.0)
        here = here.reshape(robots, 1, *seen.shape[2:])
        # The robot itself is subtracted: another robot in the same cell still shows.
        others = (seen[:, 3:] > here).astype(jnp.float32)
        alive = jnp.full_like(here, state.alive.mean(dtype=jnp.float32))
        return jnp.concatenate([seen[:, :3], here, others, alive], axis=1)

    def _windows(self, planes: jax.Array, cell: jax.Array, view: int) -> jax.Array:
        """Windows of `view` rows and columns around each robot, `[K, 4, h, w]`; cells off the map are obstacles."""
        beyond = jnp.array([0.0, 1.0, 0.0, 0.0], jnp.float32)[:, None, None]
        # Shift by the fill values, since `pad` has one constant for all planes.
        padded = jnp.pad(planes - beyond, ((0, 0), (view, view), (view, view))) + beyond
        size = (len(planes), 2 * view + 1, 2 * view + 1)
        rows, cols = jnp.divmod(cell, self.world.shape[1])
        return jax.vmap(lambda row, col: jax.lax.dynamic_slice(padded, (jnp.int32(0), row, col), size))(rows, cols)


def _seed_of(key: jax.Array) -> jax.Array:
    """uint32 `[2]` (low, high): the seed of `jax.random.key`."""
    # JAX stores (high, low).
    return jax.random.key_data(key).ravel()[-2:][::-1]


def _moves(world: World) -> NDArray[np.int32]:
    """The cell after each of ACTIONS, int32 `[N, 5]`."""
    here = np.arange(world.threat.size, dtype=np.int32)[:, None]
    near = neighbour_table(world.shape, world.free.ravel())
    return np.hstack([here, np.where(near == NO_CELL, here, near)])


# Episodes driven from the host: consecutive rollouts of a seed, NumPy arrays out.


class StepBatch(NamedTuple):
    """Results of a step in B environments.

    Attributes:
        seen: float32 `[B, K, ...]`, observations. legal: bool `[B, K, actions]`.
        rewards: float32 `[B, K]`. alive: bool `[B, K]`.
        done, truncated: bool `[B]`, the episode is over; it was truncated. covered: float32 `[B]`. lost: int32 `[B]`.
        step: int32 `[B]`, steps of the team so far.
    """

    seen: NDArray[np.float32]
    legal: NDArray[np.bool_]
    rewards: NDArray[np.float32]
    alive: NDArray[np.bool_]
    done: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    covered: NDArray[np.float32]
    lost: NDArray[np.int32]
    step: NDArray[np.int32]

    def figures(self, place: int) -> dict[str, Any]:
        """Infos of one environment, without masks."""
        return {"covered": float(self.covered[place]), "lost": int(self.lost[place]), "step": int(self.step[place])}


class Next:
    """Assigns rollout ids of a seed to B environments, each id once, in order."""

    def __init__(self, count: int) -> None:
        self.count, self.seed = count, 0
        self._next: NDArray[np.uint32] | None = None

    def begin(self, seed: int | None) -> NDArray[np.uint32]:
        """Ids for all environments `[B]`: from 0 with a seed, else the next ones; at first of a random seed."""
        SEED.check("seed", seed, optional=True)
        if seed is not None or self._next is None:
            self.seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0]) if seed is None else int(seed)
            self._next = np.arange(self.count, dtype=np.uint32)
        begun, self._next = self._next, self._next + np.uint32(self.count)
        return begun

    def after(self, over: NDArray[np.bool_]) -> NDArray[np.uint32]:
        """The next id of each environment `[B]`; those that are over take it."""
        assert self._next is not None
        following, self._next = self._next, self._next + over.astype(np.uint32) * np.uint32(self.count)
        return following


class Runs:
    """B environments. Episode n of environment b since the last given seed is rollout n B + b of that seed.

    JAX starts with the first `reset`: until then the process may be forked. A copy, also a pickled one, continues from
    the state at which it was made.
    """

    def __init__(self, env: CoverageEnv, count: int = 1) -> None:
        self.env, self._next = env, Next(count)
        self._seed = np.zeros(2, np.uint32)
        self.state: State | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but compiled programs; arrays as NumPy arrays, so that unpickling does not start JAX."""
        # Compiled programs belong to their process.
        kept = {name: value for name, value in vars(self).items() if name not in ("_begin", "_advance")}
        return kept | {"state": jax.tree.map(np.asarray, self.state)}

    @cached_property
    def _begin(self) -> Any:
        return jax.jit(self._began)

    @cached_property
    def _advance(self) -> Any:
        return jax.jit(self._advanced)

    @fixed_flags()
    def reset(self, seed: int | None = None) -> StepBatch:
        """Start: rollouts from 0 with a seed, else the next ones; at first of a random seed."""
        rollouts = self._next.begin(seed)
        self._seed = np.asarray(key_of(self._next.seed), np.uint32)
        self.state, batch = self._begin(self._seed, rollouts)
        return StepBatch(*jax.device_get(batch))

    @fixed_flags()
    def step(self, actions: ArrayLike) -> StepBatch:
        """Take the actions `[B, K]`; if an episode was over, its actions are ignored and the next one starts.

        Raises UsageError for actions out of range; the state then stays unchanged.
        """
        if self.state is None:
            raise RuntimeError("step before reset")
        given = checked_actions(actions, (self._next.count, self.env.num_agents), len(ACTIONS))
        rollouts = self._next.after(np.asarray(self.state.done))
        self.state, batch = self._advance(self._seed, rollouts, self.state, given.astype(np.int32))
        return StepBatch(*jax.device_get(batch))

    def _began(self, seed: jax.Array, rollouts: jax.Array) -> tuple[State, tuple[jax.Array, ...]]:
        states = jax.vmap(self.env.begin, (None, 0))(seed, rollouts)
        return states, self._tell(states, jnp.zeros(states.alive.shape, jnp.float32))

    def _advanced(
        self, seed: jax.Array, rollouts: jax.Array, states: State, actions: jax.Array
    ) -> tuple[State, tuple[jax.Array, ...]]:
        after, rewards = jax.vmap(self.env.advance)(states, actions)
        fresh = jax.vmap(self.env.begin, (None, 0))(seed, rollouts)
        over = jax.vmap(lambda done, new, old: jax.tree.map(lambda one, other: jnp.where(done, one, other), new, old))
        chosen: Any = over(states.done, fresh, after)
        return chosen, self._tell(chosen, jnp.where(states.done[:, None], 0.0, rewards))

    def _tell(self, states: State, rewards: jax.Array) -> tuple[jax.Array, ...]:
        infos, env = jax.vmap(self.env.infos)(states), self.env
        seen, legal = jax.vmap(env.observe)(states), jax.vmap(env.legal)(states)
        ends = (states.done, infos["truncated"], infos["covered"], infos["lost"], states.step)
        return seen, legal, rewards, states.alive, *ends

    def picture(self) -> NDArray[np.uint8]:
        """Picture of the first environment, uint8 `[H * SCALE, W * SCALE, 3]`: robots blue, lost robots black."""
        if self.state is None:
            raise RuntimeError("render before reset")
        state = jax.tree.map(lambda of: np.asarray(of[0]), self.state)
        return picture_of(self.env.world, state.visited, state.cell, state.alive)


def picture_of(
    world: World, visited: NDArray[np.bool_], cell: NDArray[np.integer], alive: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Picture of a team, uint8 `[H * SCALE, W * SCALE, 3]`: robots blue, lost ones black; visited `[N]` is darker."""
    threat = np.nan_to_num(world.threat)
    pale = 1.0 - threat / max(float(threat.max()), 1e-9)
    colours = np.stack([np.ones_like(pale), pale, pale], axis=-1) * np.where(visited, 0.8, 1.0).reshape(
        (*world.shape, 1)
    )
    colours[~world.free] = 0.3
    rows, cols = np.divmod(cell, world.shape[1])
    colours[rows, cols] = np.where(alive[:, None], (0.1, 0.3, 0.9), 0.0)
    return np.kron(colours * 255, np.ones((SCALE, SCALE, 1))).astype(np.uint8)


SCALE = 8
"""Pixels for each cell."""
