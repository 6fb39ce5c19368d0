"""The closed loop as pure functions of frozen pytrees, for `jit` and `vmap`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from mrac_jax.closed_loop.engine import JaxClosedLoop
from mrac_jax.closed_loop.events import begin, ended, next_event
from mrac_jax.closed_loop.lanes import DONE, RUN, TIME, Book
from planner.errors import UsageError
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.world.world import World

ALIVE, OUTCOME = 3, 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Closed:
    """Rollouts of a closed loop. Axes: `B` rollouts, `W` words.

    Attributes:
        visited, survived: uint32 `[B, W]`, bit c % 32 of word c // 32 is accessible cell c, in rising index.
        time, alive, outcome: int32 `[B]`, the last step, robots alive, `planner.simulator.codes.Outcome`.
        missing: bool `[B]`, the book lacks a decision of the rollout: the rest of it is that of where it stopped.
    """

    visited: jax.Array
    survived: jax.Array
    time: jax.Array
    alive: jax.Array
    outcome: jax.Array
    missing: jax.Array


def book(world: World, plan: Plan, *, seed: int = 0, rollouts: int = 4096, lanes: int = 256) -> Book:
    """The decisions of a plan's closed loop, as those of so many rollouts need them: a frozen pytree of fixed shapes.

    More rollouts of other seeds meet few decisions more: `Closed.missing` names them.

    Raises InputError for a plan of another world, and for a mission that the book does not hold.
    """
    engine = JaxClosedLoop(compile_closed_loop(plan, world), seed, lanes=lanes, devices=1)
    engine.run(0, rollouts)
    return engine.book()


def closed_rollouts(book: Book, thresholds: ArrayLike) -> Closed:
    """Closed-loop rollouts with these failure thresholds, uint32 `[B, K, 2]` (`closed_loop.engine.thresholds`).

    Raises UsageError for another shape or dtype, when it is traced.
    """
    left = jnp.asarray(thresholds)
    team, room = left.shape[1:2], book.milestones.shape[0]
    if left.ndim != 3 or left.shape[2] != 2 or left.dtype != jnp.uint32 or not 0 < team[0] <= room:
        raise UsageError(
            f"thresholds are {left.dtype}{list(left.shape)}",
            expected=f"uint32[B, K, 2], K up to {room}",
            fix="draw them by thresholds(seed, ids, robots)",
        )
    left = jnp.pad(left, ((0, 0), (0, room - team[0]), (0, 0)), constant_values=np.uint32(2**30))
    # The program broadcasts, whatever the caller's own code may do.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        lanes = begin(book, left, jnp.zeros(left.shape[0], jnp.int32))[0]
        lanes = jax.lax.while_loop(
            lambda lanes: (lanes.mode == RUN).any(), lambda lanes: next_event(book, lanes, None)[0], lanes
        )
        missing = lanes.mode != DONE
        result = ended(book, replace(lanes, last=jnp.maximum(lanes.last, 0)))[0]
    time, alive, outcome = (result.numbers[:, column] for column in (TIME, ALIVE, OUTCOME))
    return Closed(result.visited, result.survived, time, alive, outcome, missing)
