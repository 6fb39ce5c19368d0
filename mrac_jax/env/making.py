"""`mrac.env`: the environment of a world and a team, with the API of a library."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any, Literal, get_args

from numpy.typing import ArrayLike

from mrac_jax.env.area_env import Actions, AreaEnv, make_env
from planner.arguments import argument, check_word, whole
from planner.errors import UsageError
from planner.settings import Policy
from planner.world.world import World

Face = Literal["pettingzoo", "gymnasium", "vector", "jax"]
FACES: tuple[Face, ...] = get_args(Face)
LEFT = ("jumanji", "pymarl")
RENDERED = ("pettingzoo", "gymnasium")
EXTRA = {"pettingzoo": "mrac-jax[env]", "gymnasium": "mrac-jax[env]"}
"""Extra that installs the package of a face."""


def env(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    actions: Actions = "moves",
    view: int | None = None,
    rule: Policy | None = None,
    offers: int | None = None,
    robot_value: float = 0.0,
    max_steps: int | None = None,
    face: Face = "pettingzoo",
    num_envs: int = 1,
    render_mode: Literal["rgb_array"] | None = None,
) -> Any:
    """The mission as an environment for learning policies.

    Every robot is an agent. In each step it stays or moves to a neighbour. A move visits the cell and may destroy the
    robot, with the rules and random numbers of `evaluate`. It observes float32 planes `[6, h, w]` (threat, obstacles,
    visited, itself, others, share of the team alive). Its reward is the number of cells that it visits first, minus
    `robot_value` when it is lost.

    Args:
        robots, starts: as in `plan`.
        actions: "moves"; "areas": a step runs until a robot needs an area, which is its action, and the planner drives
            the robot. Observations are its offers, float32 `[offers, 8]` (`mrac_jax.env.area_env`).
        view: range of observations in rows and columns; None: the whole map.
        rule: policy of `plan` that moves the robots and orders the offers; None: "mrac".
        offers: largest number of offered areas; None: 8.
        robot_value: penalty for a lost robot, in cells.
        max_steps: end of an episode; None: twice the accessible cells, with areas the planner's step limit.
        face: "pettingzoo": a `ParallelEnv`; "gymnasium": an `Env`, "vector": a `VectorEnv` of `num_envs`, with the team
            as one agent; "jax": the underlying class, with JaxMARL's conventions, for moves only.
        num_envs: size of a "vector" environment.
        render_mode: "rgb_array": `render()` of PettingZoo's or Gymnasium's environment draws a picture.

    Returns:
        The environment.

    Raises:
        InputError: an invalid argument, or a world that environments do not support.
    """
    if face in LEFT:
        raise UsageError(f"{argument('face', face)} left with release 0.4", fix="use release 0.3, or face='jax'")
    check_word("face", face, FACES)
    whole(1).check("num_envs", num_envs)
    if render_mode is not None:
        check_word("render_mode", render_mode, ("rgb_array",))
        if face not in RENDERED:
            raise UsageError(f"{argument('face', face)} draws no pictures", fix=f"omit {argument('render_mode')}")
    package = "gymnasium" if face == "vector" else face
    if package in EXTRA and find_spec(package) is None:
        raise UsageError(f"{package} is not installed", fix=f"pip install '{EXTRA[package]}'")
    made = make_env(
        world, robots, starts=starts, actions=actions, view=view, robot_value=robot_value, rule=rule, offers=offers,
        max_steps=max_steps,
    )  # fmt: skip
    if face == "vector":
        from mrac_jax.env.gymnasium_env import TeamVectorEnv

        return TeamVectorEnv(made, num_envs=num_envs)
    if face == "gymnasium":
        from mrac_jax.env.gymnasium_env import TeamEnv

        return TeamEnv(made, render_mode=render_mode)
    if face == "pettingzoo":
        from mrac_jax.env.pettingzoo_env import CoverageParallelEnv

        return CoverageParallelEnv(made, render_mode)
    if isinstance(made, AreaEnv):
        problem = f"{argument('face', face)}, with {argument('actions', actions)}"
        raise UsageError(problem, expected="'pettingzoo', 'gymnasium' or 'vector'")
    return made
