"""The open loop's expected coverage as a differentiable function of the map, and its gradient by JAX."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mrac_jax.names import check_jax
from planner.plans.plan import Plan, entries
from planner.worlds.world import World


def coverage_gradient(plan: Plan, world: World) -> NDArray[np.float64]:
    """d E[cells visited] / d p of every cell, `[H, W]`, for robots that go on along the same paths; 0 or below.

    E is the closed form `sum_c 1 - prod_i (1 - S_i(c))` (SPEC section 6), differentiated in float32. A robot that
    enters a cell for certain makes all that others do there count for nothing, as in the closed form.
    Raises UsageError where JAX is not installed.
    """
    check_jax()
    import jax
    import jax.numpy as jnp

    paths = [robot.path[entries(robot.path)] for robot in plan.robots]
    longest = max(map(len, paths))
    cell = np.zeros((len(paths), longest), dtype=np.int32)
    first, held = np.zeros((2, *cell.shape), dtype=np.float32)
    for robot, path in enumerate(paths):
        cell[robot, : len(path)], held[robot, : len(path)] = path, 1.0
        first[robot, np.unique(path, return_index=True)[1]] = 1.0
    robots = np.arange(len(paths))[:, None]

    @jax.jit
    def missed(threat: jax.Array) -> jax.Array:
        """Expected cells that nobody visits, of all of the grid."""
        risk = jnp.cumsum(held * jnp.log1p(-threat[cell]), axis=1)
        reach = jnp.exp(jnp.pad(risk[:, :-1], ((0, 0), (1, 0))))
        chance = jnp.zeros((len(paths), threat.size), jnp.float32).at[robots, cell].add(first * reach)
        return jnp.prod(1.0 - chance, axis=0).sum()

    gradient = jax.grad(missed)(jnp.asarray(np.nan_to_num(world.threat).ravel()))
    return -np.asarray(gradient, dtype=np.float64).reshape(world.shape)
