"""`mrac.env`: the environment of a world and a team, for the library that one uses."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any, Literal, get_args

from numpy.typing import ArrayLike

from mrac_jax.environment.area_env import Actions, AreaEnv, make_env
from planner.arguments import argument, check_word, whole
from planner.errors import UsageError
from planner.settings import Policy
from planner.world.world import World

Face = Literal["pettingzoo", "gymnasium", "vector", "jax"]
FACES: tuple[Face, ...] = get_args(Face)
LEFT = ("jumanji", "pymarl")
RENDERED = ("pettingzoo", "gymnasium")
EXTRA = {"pettingzoo": "mrac-jax[env]", "gymnasium": "mrac-jax[env]"}
"""What brings the package of a face."""


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
    """The mission as an environment, in which policies are learned.

    Every robot is an agent. Each step it stays or moves to a neighbour; what it enters is visited and may stop it, by
    the rules and the luck of `evaluate`. It observes float32 planes `[6, h, w]` (threat, obstacles, visited, itself,
    others, share of the team alive); its reward is the cells it visits first, less `robot_value` when it is lost.

    Args:
        robots, starts: as of `plan`.
        actions: "moves"; "areas": a step goes on until a robot needs an area, which is its action, and the planner
            drives it there and over it. Observed are its offers, float32 `[offers, 8]`
            (`mrac_jax.environment.area_env`).
        view: how many rows and columns away a robot sees; None: the whole map.
        rule: by which robots travel and cover, and offers are in order: a policy of `plan`; None: "mrac".
        offers: areas that a robot is shown at most; None: 8.
        worth: what a lost robot takes off its reward, in cells.
        max_steps: at which an episode is cut off; None: twice the accessible cells, with areas the planner's own end.
        face: "pettingzoo": a `ParallelEnv`; "gymnasium": an `Env`, "vector": a `VectorEnv` of `num_envs`, the team as
            one agent; "jax": the class that all stand on, by JaxMARL's conventions, with moves alone.
        render_mode: "rgb_array": `render()` of PettingZoo's or Gymnasium's face draws a picture.
    """
    if face in LEFT:
        raise UsageError(f"{argument('face', face)} left with release 0.4", fix="use release 0.3, or face='jax'")
    check_word("face", face, FACES)
    whole(1).check("num_envs", num_envs)
    if render_mode is not None:
        check_word("render_mode", render_mode, ("rgb_array",))
        if face not in RENDERED:
            raise UsageError(f"{argument('face', face)} draws no pictures", fix=f"leave {argument('render_mode')} out")
    package = "gymnasium" if face == "vector" else face
    if package in EXTRA and find_spec(package) is None:
        raise UsageError(f"{package} is not installed", fix=f"pip install '{EXTRA[package]}'")
    given: dict[str, Any] = {
        "starts": starts,
        "actions": actions,
        "view": view,
        "robot_value": robot_value,
        "rule": rule,
    }
    made = make_env(world, robots, **given, offers=offers, max_steps=max_steps)
    if face == "vector":
        from mrac_jax.environment.gymnasium_env import TeamVectorEnv

        return TeamVectorEnv(made, num_envs=num_envs)
    if face == "gymnasium":
        from mrac_jax.environment.gymnasium_env import TeamEnv

        return TeamEnv(made, render_mode=render_mode)
    if face == "pettingzoo":
        from mrac_jax.environment.pettingzoo_env import CoverageParallelEnv

        return CoverageParallelEnv(made, render_mode)
    if isinstance(made, AreaEnv):
        problem = f"{argument('face', face)}, with {argument('actions', actions)}"
        raise UsageError(problem, expected="'pettingzoo', 'gymnasium' or 'vector'")
    return made
