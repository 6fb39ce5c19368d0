"""The public JAX API, also `mrac.functional`: pure functions of a plan's arrays for `jit`, `vmap` and `grad`.

    arrays = mrac.functional.arrays(world, plan)             paths of the plan, as a frozen pytree
    rollout(key, arrays, p) -> Outcome                       one open-loop rollout
    rollouts(key, arrays, p, n) -> Counts                    integer counts of n rollouts, batch after batch
    expected_coverage(arrays, p, value=None)                 exact, differentiable in p
    survival(arrays, p)                                      probability that a robot reaches its first entry of a cell
    thresholds(key, ids, robots)                             failure thresholds, as every engine draws them
    book(world, plan)                                        the closed loop's decisions, as a frozen pytree
    closed_rollouts(book, thresholds) -> Closed              rollouts in which survivors take over work
    closed_gradient(key, book, p, n) -> Gradient             of the closed loop's expected coverage in p

All but the last three are of the open loop: robots follow their nominal paths, and no work is reassigned
(docs/spec.md, section 6). The closed loop is described in `mrac_jax/closed_loop/README.md`.

Axes: `K` robots, `E` entries of a path, `H`, `W` rows and columns of the map, `N = H * W` cells (index
`row * W + col`), `T` steps.

`p` `[H, W]` is the probability that a visit of a cell destroys a robot; it may differ from the map of the plan.
Cells that are obstacles in the world are ignored: `p` and `value` may be NaN there, and gradients are 0. In all other
cells NaN, p < 0 and p >= 1 are an InputError where `p` is concrete. Under a trace values cannot be checked, and the
result is undefined. Shapes are checked in both cases.

`key` is a seed, a whole number `0 <= seed < 2**64` or an integer scalar of JAX, or a key of `jax.random`. Rollouts
0, 1, ... of a seed are those of the other engines, robot by robot; a key of `jax.random` draws the seed. Nothing here
changes a setting of JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mrac_jax.arrays import STATIC, Array, robot_words, threefry2x32, threshold_pairs
from mrac_jax.closed_loop.counting import roll_out, scores, with_hazards
from mrac_jax.closed_loop.engine import JaxClosedLoop
from mrac_jax.closed_loop.lanes import DONE, TIME, Book
from planner.errors import InputError, PlanError, UsageError
from planner.failure_model import OWN_KEYS, THRESHOLD_DRAW, key_of, weibull_nodes, weibull_scale
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.coverage_gradient import LEAST_LOSSES
from planner.rollouts.open_loop import compile_plan
from planner.simulator.thresholds import LOGARITHMS, SCALE, UNIT, log_units
from planner.world.world import World

Key: TypeAlias = int | Array
MOST_ROLLOUTS = 2**31 - 1
"""Limit of rollouts of one call: counts are int32."""
NOT_LOST = -1
"""Step and cell of the loss of a robot that is not lost."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class PlanArrays:
    """A plan's nominal paths. An entry is a move that enters a cell; entry 0 is the start, at step 0.

    Attributes:
        cell: int32 `[K, E]`, cell entered; N: padding.
        step: int32 `[K, E]`, step of the entry; padding repeats the last one.
        first: int32 `[K, N]`, entry at which the robot first enters each cell; E: it never does.
        free: bool `[H, W]`, False for obstacles.
        multiplier: int32 `[K]`, hazard multiplier of each robot, in units of 2**-16.
        steps: T, the last step of any entry. weibull_shape: of the failure thresholds; 1: exponential. Both are static.
    """

    cell: Array
    step: Array
    first: Array
    free: Array
    multiplier: Array
    steps: int = field(metadata=STATIC)
    weibull_shape: float = field(metadata=STATIC)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Outcome:
    """One rollout.

    Attributes:
        visited: bool `[H, W]`, cells that some robot entered. survived: those where one of them was not lost.
        lost_at, lost_in: int32 `[K]`, step and cell of each robot's loss; NOT_LOST: none.
        time: int32, step of the last move.
    """

    visited: Array
    survived: Array
    lost_at: Array
    lost_in: Array
    time: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Counts:
    """Counts of rollouts, int32. Counts of different ids add: `jax.tree.map(jnp.add, a, b)`.

    Attributes:
        rollouts: their number. visited, survived: `[H, W]`, rollouts in which a cell is.
        visits, losses: `[H, W]`, visits of each cell, and robots lost there.
        cells_visited, cells_survived: `[N + 1]`, rollouts by number of cells.
        time: `[T + 1]`, rollouts by step of the last move. alive: `[K + 1]`, by robots that finish their paths.
    """

    rollouts: Array
    visited: Array
    survived: Array
    visits: Array
    losses: Array
    cells_visited: Array
    cells_survived: Array
    time: Array
    alive: Array


def arrays(world: World, plan: Plan) -> PlanArrays:
    """The plan's paths as arrays, in O(K (E + N)). Weibull shape and hazard multipliers are those of the plan.

    Args:
        world: the plan's map, `[H, W]`.
        plan: paths of K robots.

    Raises:
        PlanError: the plan is for another map, starts from a mission's state, or has robots of several types.
        WorldError: the map is not known, or its threats change, move or depend on the robot.
    """
    plan.require(world)
    world.require_certain_map("mrac.functional")
    if plan.failure_model.types is not None:
        raise PlanError(
            f"mrac.functional has one map p for all robots; here: {plan.failure_model.description}",
            fix="leave `types` out",
        )
    compile_plan(plan, world)  # checks paths, and that no state is given
    entered = [robot.entered for robot in plan.robots]
    cells, robots, entries = world.threat.size, len(plan.robots), max(map(len, entered))
    cell, first = np.full((robots, entries), cells), np.full((robots, cells), entries)
    step = np.zeros((robots, entries), dtype=np.int32)
    for number, (robot, steps) in enumerate(zip(plan.robots, entered, strict=True)):
        path = robot.path[steps]
        cell[number, : len(path)] = path
        step[number] = np.pad(steps, (0, entries - len(path)), mode="edge")
        first[number, path[::-1]] = np.arange(len(path))[::-1]  # reversed: the first of several entries is written last
    return PlanArrays(
        cell=jnp.asarray(cell, jnp.int32),
        step=jnp.asarray(step),
        first=jnp.asarray(first, jnp.int32),
        free=jnp.asarray(world.free),
        multiplier=jnp.asarray(plan.failure_model.times(robots), jnp.int32),
        steps=int(step.max()),
        weibull_shape=float(plan.failure_model.shape),
    )


def stack(plans: Sequence[PlanArrays]) -> PlanArrays:
    """Plans on maps of one shape as one pytree with a leading axis, for `jax.vmap`. All padding is done here.

    Entries are padded up to those of the longest path, teams up to the largest one: a robot of the padding has no
    entry, visits nothing, is never lost and is not counted as alive.

    Args:
        plans: of `arrays`.

    Raises InputError for no plans, or for maps of several shapes or several Weibull shapes.
    """
    if not plans:
        raise InputError("plans: none", expected="at least one")
    kinds = {(one.free.shape, one.weibull_shape) for one in plans}
    if len(kinds) > 1:
        shapes = ", ".join(sorted(f"{height}x{width} (shape {shape:g})" for (height, width), shape in kinds))
        raise InputError(f"plans: {shapes}", expected="maps of one shape, and one Weibull shape")
    robots, entries = (max(one.cell.shape[axis] for one in plans) for axis in (0, 1))
    steps = max(one.steps for one in plans)

    def pad(one: PlanArrays) -> PlanArrays:
        (team, length), cells = one.cell.shape, one.free.size
        more, longer = (0, robots - team), (0, entries - length)
        first = jnp.where(one.first == length, entries, one.first)
        return PlanArrays(
            cell=jnp.pad(one.cell, (more, longer), constant_values=cells),
            step=jnp.pad(jnp.pad(one.step, ((0, 0), longer), mode="edge"), (more, (0, 0))),
            first=jnp.pad(first, (more, (0, 0)), constant_values=entries),
            free=one.free,
            multiplier=jnp.pad(one.multiplier, more, constant_values=SCALE),
            steps=steps,
            weibull_shape=one.weibull_shape,
        )

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(pad, plans))


# Exact values.


def survival(arrays: PlanArrays, p: ArrayLike) -> Array:
    """Probability that each robot reaches its first entry of each cell, `[K, H, W]`; 0 if it has none.

    `S_i(c)` of docs/spec.md, section 6, before that entry's own check: `exp(-hazard)` of the entries before it. With a
    Weibull shape below 1 the derivative at a cumulative hazard of 0 is infinite; gradients have 0 there.

    Args:
        arrays: of `arrays`.
        p: `[H, W]`, probability that a visit destroys a robot; ignored on obstacles.

    Source: paper, eq. (1).
    """
    entries = arrays.cell.shape[1]
    own = -jnp.log1p(-_probabilities(arrays, p))
    own = jnp.append(own.reshape(-1), jnp.zeros(1, own.dtype))[arrays.cell]  # padding adds none
    before = _effective_hazard(arrays, jnp.cumsum(jnp.pad(own, ((0, 0), (1, 0))), axis=1)[:, :-1])
    reached = jnp.exp(-jnp.take_along_axis(before, jnp.minimum(arrays.first, entries - 1), axis=1))
    reached = jnp.where(arrays.first < entries, reached, 0.0)
    return reached.reshape(-1, *arrays.free.shape)


def expected_coverage(arrays: PlanArrays, p: ArrayLike, value: ArrayLike | None = None) -> Array:
    """Expected number of cells that some robot enters; exact, and differentiable in p and in the value.

    `sum_c value_c (1 - prod_i (1 - S_i(c)))`: robots are lost independently of each other. Cost: O(K (E + N)).

    Args:
        arrays: of the plan.
        p: `[H, W]`. The precision of the result is that of p.
        value: `[H, W]`, of each cell; None: 1 each.
    """
    visited = 1.0 - jnp.prod(1.0 - survival(arrays, p), axis=0)
    if value is None:
        return visited.sum()
    values = _layer(arrays, "value", value, np.isfinite, "a finite number in every free cell")
    return (visited * values.astype(visited.dtype)).sum()


def _effective_hazard(arrays: PlanArrays, hazard: Array) -> Array:
    """The hazards `[K, E]` to a robot whose threshold is Exp(1): `(a_i E / s)**B` (docs/spec.md, section 14)."""
    shape, dtype = arrays.weibull_shape, hazard.dtype
    hazard = hazard * (arrays.multiplier.astype(dtype) / SCALE)[:, None]
    if shape == 1:
        return hazard
    some = hazard > 0  # the derivative of 0**B is infinite or NaN for B < 1
    return jnp.where(some, (jnp.where(some, hazard, 1.0) / weibull_scale(shape)) ** shape, 0.0)


# Rollouts: the word from which on a robot is lost at an entry, then a comparison of words.


def thresholds(key: Key, ids: ArrayLike, robots: int) -> Array:
    """Failure thresholds, Exp(1), of robots 0 .. `robots` - 1 in these rollouts: uint32 `[.., K, 2]`.

    Whole units of 2**-32 nat, as two words of 32 bits, the leading one first (`exp1_thresholds` of the
    same seed and ids); in nats they are `thresholds[..., 0] + thresholds[..., 1] * 2.0**-32`.

    Args:
        key: a seed or a key of `jax.random`.
        ids: uint32 `[..]`, rollout ids.
        robots: K.
    """
    return threshold_pairs(_words_of(_seed_words(key), _ids("ids", ids), robots))


def _ids(name: str, given: ArrayLike) -> Array:
    """Rollout ids, uint32. Raises InputError."""
    ids = jnp.asarray(given)
    if not jnp.issubdtype(ids.dtype, jnp.integer):
        raise InputError(f"{name}: {ids.dtype}", expected="whole numbers, 0 .. 2**32 - 1")
    return ids.astype(jnp.uint32)


def _words_of(seed: Array, ids: Array, robots: int) -> Array:
    purpose = threefry2x32(seed, jnp.uint32(OWN_KEYS), jnp.uint32(THRESHOLD_DRAW))
    return robot_words(jnp.stack(purpose), ids, robots)


def _seed_words(key: Key) -> Array:
    """The two halves of the seed, uint32 `[2]`, low first."""
    if isinstance(key, int | np.integer) and not isinstance(key, bool) and 0 <= key < 2**64:
        return jnp.asarray(np.array(key_of(int(key)), dtype=np.uint32))
    kind, shape = getattr(key, "dtype", None), getattr(key, "shape", None)
    traced = isinstance(key, jax.core.Tracer)
    if isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jnp.integer) and shape == () and (traced or key >= 0):
        high = (key >> 32).astype(jnp.uint32) if key.dtype.itemsize == 8 else jnp.uint32(0)
        return jnp.stack([key.astype(jnp.uint32), high])
    typed = kind is not None and jnp.issubdtype(kind, jax.dtypes.prng_key) and shape == ()
    if not typed and not (isinstance(key, jax.Array) and kind == jnp.uint32 and shape in ((2,), (4,))):
        said = repr(key) if kind is None else f"an array {kind}{list(shape or ())}"
        raise InputError(
            f"key: {said}", expected="a seed (0 .. 2**64 - 1) or one key of jax.random",
            fix="use jax.random.key(seed); for several keys, jax.vmap",
        )  # fmt: skip
    return jax.random.bits(key, (2,), dtype=jnp.uint32)


@jax.jit
def _limits(arrays: PlanArrays, p: Array) -> tuple[Array, Array]:
    """(limits uint32 `[K, E]`, counts int32 `[K]`): a robot passes an entry if its word is below the limit, or if the
    entry is one of the first ones, which have hazard 0.

    The same integers as in the other engines (`planner.failure_model.exposure_of`, `least_word`): 64 bits are needed.
    """
    with jax.enable_x64(True):  # only for values traced here
        chance = jnp.append(jax.lax.stop_gradient(p).astype(jnp.float64).reshape(-1), 0.0)
        # float64 rounds differently from the exact value about once in 10,000 cells: a limit moves by at most one word.
        own = jnp.rint(-jnp.log1p(-chance) * UNIT).astype(jnp.int64)
        hazard = jnp.cumsum(own[arrays.cell], axis=1)
        hazard = _to_fresh_robot(hazard, arrays.multiplier.astype(jnp.int64)[:, None], arrays.weibull_shape)
        word = jnp.ceil(jnp.exp(-hazard.astype(jnp.float64) / UNIT) * (UNIT - 0.53) - 0.50001).astype(jnp.int64)
        word = jnp.clip(word, 0, UNIT - 1)
        for _ in range(3):  # the guess is at most two words too low
            odd = 2 * word + 1
            lasts = log_units(odd, 63 - jax.lax.clz(odd), jnp.asarray(LOGARITHMS)) > hazard
            word = jnp.minimum(word + lasts.astype(jnp.int64), UNIT - 1)
        return word.astype(jnp.uint32), (hazard == 0).sum(axis=1, dtype=jnp.int32)


def _to_fresh_robot(hazard: Array, times: Array, shape: float) -> Array:
    """`planner.simulator.thresholds.exp1_hazard` in jnp: hazards to a robot whose threshold is Exp(1), int64 `[K,
    E]`."""
    some = (hazard > 0).astype(jnp.int64)
    after = jnp.minimum(hazard, (2**62 // jnp.maximum(times, SCALE)) << 16) + some
    multiplied = (after >> 16) * times + (((after & (SCALE - 1)) * times - some) >> 16)
    if shape == 1:
        return multiplied
    nodes = jnp.asarray(weibull_nodes(shape))
    multiplied = jnp.minimum(multiplied, nodes[-1] - 1)
    node = jnp.searchsorted(nodes, multiplied, side="right").astype(jnp.int64) - 1
    octave = jnp.maximum((node >> 6) - 1, 0)
    part = (((multiplied - nodes[node] + 1) << 16) - 1) // (nodes[node + 1] - nodes[node])
    return ((node - (octave << 6)) << octave) + ((((part + 1) << octave) - 1) >> 16)


def rollout(key: Key, arrays: PlanArrays, p: ArrayLike, rollout_id: ArrayLike = 0) -> Outcome:
    """One open-loop rollout; `jax.vmap` it over keys, rollout ids, maps p or stacked plans.

    Args:
        key: a seed or a key of `jax.random`. With a seed the rollout is that of this id in every engine.
        arrays: of the plan.
        p: `[H, W]`.
        rollout_id: uint32 scalar.
    """
    number = _ids("rollout_id", rollout_id)
    if number.shape != ():
        raise InputError(f"rollout_id: shape {list(number.shape)}", expected="one id", fix="use jax.vmap over several")
    word = _words_of(_seed_words(key), number, arrays.cell.shape[0])
    return _outcome(arrays, _lost_entry(word, *_limits(arrays, _probabilities(arrays, p))))


def _lost_entry(word: Array, limit: Array, safe: Array) -> Array:
    """The entry at which each robot is lost, int32 `[K]`; E: none. Limits fall along a path."""
    return jnp.maximum((word[:, None] < limit).sum(axis=1, dtype=jnp.int32), safe)


def _outcome(arrays: PlanArrays, lost: Array) -> Outcome:
    entries, shape = arrays.cell.shape[1], arrays.free.shape
    last, real = jnp.minimum(lost, entries - 1)[:, None], arrays.first < entries
    at, cell = (jnp.take_along_axis(table, last, axis=1)[:, 0] for table in (arrays.step, arrays.cell))
    is_lost = lost < entries
    return Outcome(
        visited=(real & (arrays.first <= lost[:, None])).any(axis=0).reshape(shape),
        survived=(real & (arrays.first < lost[:, None])).any(axis=0).reshape(shape),
        lost_at=jnp.where(is_lost, at, NOT_LOST),
        lost_in=jnp.where(is_lost, cell, NOT_LOST),
        time=at.max(),
    )


def rollouts(
    key: Key, arrays: PlanArrays, p: ArrayLike, n: ArrayLike, batch_size: int = 4096, start: ArrayLike = 0
) -> Counts:
    """Counts of rollouts `start .. start + n - 1`; they do not depend on the batch size.

    Args:
        key: a seed or a key of `jax.random`.
        arrays: of the plan.
        p: `[H, W]`.
        n: rollouts, at most 2**31 - 1; `n` and `start` may be traced.
        batch_size: rollouts at a time, static. Memory: some `batch_size * K * (E + N)` bytes.
        start: first rollout id, uint32.
    """
    for name, number, least, most in (
        ("n", n, 0, MOST_ROLLOUTS), ("start", start, 0, 2**32 - 1), ("batch_size", batch_size, 1, 2**24),
    ):  # fmt: skip
        if not isinstance(number, jax.core.Tracer) and not least <= int(np.asarray(number)) <= most:
            raise InputError(f"{name}: {number}", expected=f"{least} .. {most}")
    limits = _limits(arrays, _probabilities(arrays, p))
    ids = jnp.asarray(start).astype(jnp.uint32), jnp.asarray(n).astype(jnp.int32)
    return _count(arrays, limits, _seed_words(key), *ids, batch_size=batch_size)


@partial(jax.jit, static_argnames="batch_size")  # a loop outside of a jit would be compiled in every call
def _count(
    arrays: PlanArrays, limits: tuple[Array, Array], seed: Array, start: Array, n: Array, *, batch_size: int
) -> Counts:
    (robots, entries), cells, shape = arrays.cell.shape, arrays.free.size, arrays.free.shape
    exists = arrays.cell[:, 0] < cells
    empty = [jnp.zeros(size, jnp.int32) for size in (cells + 1, cells + 1, arrays.steps + 1, robots + 1)]
    sums = (
        jnp.zeros(shape, jnp.int32),
        jnp.zeros(shape, jnp.int32),
        jnp.zeros((robots, entries + 1), jnp.int32),
        empty,
    )
    place = jnp.arange(batch_size, dtype=jnp.int32)

    def one(asked: Array, word: Array) -> tuple[tuple[Array, Array], Array, list[Array]]:
        lost = _lost_entry(word, *limits)
        found = _outcome(arrays, lost)
        visited, survived = found.visited & asked, found.survived & asked
        alive = (exists & (lost == entries)).sum(dtype=jnp.int32)
        bins = [visited.sum(dtype=jnp.int32), survived.sum(dtype=jnp.int32), found.time, alive]
        return (visited, survived), lost, bins

    def add(number: Array, sums: Any) -> Any:
        asked = place < n - number * batch_size
        ids = start + (number * batch_size + place).astype(jnp.uint32)
        (visited, survived), lost, bins = jax.vmap(one)(asked, _words_of(seed, ids, robots))
        size = asked.astype(jnp.int32)
        robot = jnp.broadcast_to(jnp.arange(robots, dtype=jnp.int32), lost.shape)
        return (
            sums[0] + visited.sum(axis=0, dtype=jnp.int32),
            sums[1] + survived.sum(axis=0, dtype=jnp.int32),
            sums[2].at[robot, lost].add(jnp.broadcast_to(size[:, None], lost.shape)),
            [into.at[at].add(size) for into, at in zip(sums[3], bins, strict=True)],
        )

    batches = (n // batch_size) + (n % batch_size > 0).astype(jnp.int32)
    visited, survived, lost, histograms = jax.lax.fori_loop(0, batches, add, sums)
    made = n - jnp.cumsum(jnp.pad(lost, ((0, 0), (1, 0)))[:, :-1], axis=1)[:, :entries]  # in which the entry is made
    by_cell = [
        jnp.zeros(cells + 1, jnp.int32).at[arrays.cell].add(each)[:cells].reshape(shape)
        for each in (made, lost[:, :entries])
    ]
    return Counts(n, visited, survived, *by_cell, *histograms)


def _probabilities(arrays: PlanArrays | Book, p: ArrayLike) -> Array:
    """p as floats `[H, W]`, 0 on obstacles. Raises InputError."""
    return _layer(arrays, "p", p, lambda cells: (cells >= 0) & (cells < 1), "0 <= p < 1 in every free cell")


def _layer(arrays: PlanArrays | Book, name: str, given: ArrayLike, fits: Any, expected: str) -> Array:
    """A layer `[H, W]` with 0 on obstacles. Raises InputError."""
    layer, shape = jnp.asarray(given), arrays.free.shape
    if layer.shape != shape:
        raise InputError(
            f"{name}: shape {list(layer.shape)}", expected=f"{list(shape)}, the map's [H, W]",
            fix=f"use jax.vmap over several maps, jax.vmap({name} -> ...)",
        )  # fmt: skip
    if not jnp.issubdtype(layer.dtype, jnp.floating):
        layer = layer.astype(float)
    if not any(isinstance(one, jax.core.Tracer) for one in (layer, arrays.free)):
        values = np.asarray(layer)
        bad = np.argwhere(np.asarray(arrays.free) & ~fits(values))
        if len(bad):
            row, col = bad[0].tolist()
            raise InputError(
                f"{name}: {values[row, col]} at [{row}, {col}]", expected=expected, fix="only obstacles may be NaN"
            )
    return jnp.where(arrays.free, layer, 0.0)


# The closed loop.

ALIVE, OUTCOME = 3, 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Closed:
    """Rollouts of a closed loop. Axes: `B` rollouts, `W` words.

    Attributes:
        visited, survived: uint32 `[B, W]`, bit c % 32 of word c // 32 is accessible cell c, in rising index.
        time, alive, outcome: int32 `[B]`, the last step, robots alive, a `planner.simulator.codes.Outcome`.
        missing: bool `[B]`, the book lacks a decision of the rollout, which stops there: ignore its other values.
    """

    visited: jax.Array
    survived: jax.Array
    time: jax.Array
    alive: jax.Array
    outcome: jax.Array
    missing: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Gradient:
    """d E[cells visited] / dp of each cell, by the likelihood ratio.

    Attributes:
        mean: float32 `[H, W]`, in cells; 0 on obstacles and in cells that no robot enters, NaN where p = 0.
        standard_error: float32 `[H, W]`, of `mean`; NaN too where fewer than LEAST_LOSSES losses were seen in a cell
            that was visited.
        missing: int32, rollouts that are left out since the book lacks a decision: some of them bias the mean.
    """

    mean: jax.Array
    standard_error: jax.Array
    missing: jax.Array


def book(
    world: World, plan: Plan, *, p: ArrayLike | None = None, seed: int = 0, rollouts: int = 4096, lanes: int = 256
) -> Book:
    """The decisions of rollouts 0 .. `rollouts` - 1 of a seed in a plan's closed loop: a frozen pytree of fixed shapes.

    Other rollouts may need decisions that it lacks (`Closed.missing`); more rollouts leave fewer gaps.

    Args:
        world: the map of the plan. plan: as of `mrac.plan`.
        p: `[H, W]`, probability that a visit destroys a robot, in these rollouts and in those of the book; decisions
            are those of the plan's map. None: the map's.
        seed, rollouts: see above. lanes: rollouts at a time.

    Raises InputError for a plan of another world, for invalid p, and for a mission that the book does not support.
    """
    loop = compile_closed_loop(plan, world)
    if p is not None:
        loop = loop.with_threat(World.create(np.where(world.free, np.asarray(p, dtype=np.float32), np.nan)))
    engine = JaxClosedLoop(loop, seed, lanes=lanes, devices=1)
    engine.run(0, rollouts)
    free = np.isin(np.arange(world.threat.size), loop.cells).reshape(world.shape)
    cells, plain = loop.cells.astype(np.int32), np.bool_(loop.failure_model.is_plain)
    return replace(engine.book(), **jax.device_put({"free": free, "cells": cells, "plain": plain}))


def closed_rollouts(book: Book, thresholds: ArrayLike) -> Closed:
    """Closed-loop rollouts with these failure thresholds.

    Args:
        book: the decisions (`book`).
        thresholds: uint32 `[B, K, 2]`, of each robot of B rollouts, leading word first (`thresholds`).

    Returns: the results; `missing` marks rollouts with a decision that the book does not have.

    Raises UsageError for another shape or dtype, when it is traced.
    """
    left = jnp.asarray(thresholds)
    team, room = left.shape[1:2], book.met.shape[1]
    if left.ndim != 3 or left.shape[2] != 2 or left.dtype != jnp.uint32 or not 0 < team[0] <= room:
        raise UsageError(
            f"thresholds are {left.dtype}{list(left.shape)}",
            expected=f"uint32[B, K, 2], K up to {room}",
            fix="draw them by thresholds(seed, ids, robots)",
        )
    left = jnp.pad(left, ((0, 0), (0, room - team[0]), (0, 0)), constant_values=np.uint32(2**30))
    # The program relies on rank and dtype promotion, even if the caller has restricted them.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        lanes, result, _ = roll_out(book, left, jnp.bool_(True), None)
        missing = lanes.mode != DONE
    time, alive, outcome = (result.numbers[:, column] for column in (TIME, ALIVE, OUTCOME))
    return Closed(result.visited, result.survived, time, alive, outcome, missing)


GROUPS, LARGEST = 64, 4096
"""A gradient's rollouts are split into GROUPS or more, of LARGEST or fewer; their scatter gives the standard error."""


def closed_gradient(key: Key, book: Book, p: ArrayLike, n: int) -> Gradient:
    """The gradient of the closed loop's expected coverage in p, with the decisions of the book held fixed.

    `E[(C - b) (losses_c / p_c - passes_c / (1 - p_c))]` (score function method, Glynn 1990); C: cells visited, b: its
    mean, losses_c: robots lost in cell c, passes_c: visits of c that a robot survived.

    Args:
        key: a seed or a key of `jax.random`; rollouts 0 .. n - 1 of it.
        book: of a plan whose robots are alike, with Weibull shape 1.
        p: `[H, W]`, probability that a visit destroys a robot; may differ from that of the book.
        n: rollouts, static, at least 2 * GROUPS.

    Raises InputError, also for a book of other robots, unless it is traced.
    """
    if not 2 * GROUPS <= n <= MOST_ROLLOUTS:
        raise InputError(f"n: {n}", expected=f"{2 * GROUPS} .. {MOST_ROLLOUTS}")
    if not isinstance(book.plain, jax.core.Tracer) and not book.plain:
        fix = "leave `weibull_shape` and `hazard_multiplier` out"
        raise PlanError("the book's Weibull shape is not 1, or its robots differ", fix=fix)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return _closed_gradient(_seed_words(key), book, _probabilities(book, p).astype(jnp.float32), n=int(n))


@partial(jax.jit, static_argnames="n")
def _closed_gradient(seed: Array, book: Book, p: Array, *, n: int) -> Gradient:
    groups = max(GROUPS, -(-n // LARGEST))
    size, own = -(-n // groups), p.reshape(-1)[book.cells]
    decisions = with_hazards(book, own)

    def sums_of(group: Array) -> Any:
        ids = group + groups * jnp.arange(size)
        left = threshold_pairs(_words_of(seed, ids.astype(jnp.uint32), book.met.shape[1]))
        return scores(own, decisions, left, ids < n)

    count, covered, losses, score, weighed = jax.lax.map(sums_of, jnp.arange(groups))
    total = count.sum()
    of_each = weighed - covered.sum() / total * score
    mean = of_each.sum(axis=0) / total
    scatter = of_each - count[:, None] * mean
    error = jnp.sqrt((scatter**2).sum(axis=0) * groups / (groups - 1)) / total
    error = jnp.where((losses.sum(axis=0) < LEAST_LOSSES) & (score != 0).any(axis=0), jnp.nan, error)

    def grid(values: Array) -> Array:
        whole = jnp.zeros(p.size, own.dtype).at[book.cells].set(values).reshape(p.shape)
        return jnp.where(book.free & (p <= 0), jnp.nan, whole)

    # The mean of C is estimated from the same rollouts.
    return Gradient(grid(mean * total / (total - 1)), grid(error), n - total)
