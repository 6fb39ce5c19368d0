"""The command `mrac-jax suite`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from analysis.cli.console import check_folder
from analysis.cli.deliver import deliver
from analysis.cli.options import Json, OutPath, Seed, Text, Whole, one_of, path, verbatims
from planner.errors import UsageError

ROLLOUTS = 1000


def suite(
    *,
    policy: Annotated[Path | None, Parameter(converter=path)] = None,
    actions: Annotated[Literal["moves", "areas"] | None, Parameter(converter=one_of("moves", "areas"))] = None,
    plans: Annotated[list[str] | None, Parameter(converter=verbatims, negative="")] = None,
    only: Text = None,
    rollouts: Whole = None,
    seed: Seed = None,
    processes: Whole = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Thirty named worlds, the same for everybody: who covers most, and how much is left to gain?

    The planner's policies, its open loop, a random walk, a policy of your own and plans of other planners, all on the
    same random numbers, with the proven bound for every strategy.

    Args:
        policy: A Python file that defines `policy`: a function of what the robots observe, as `mrac.judge` takes it,
            or a planner's Rule.
        actions: What the function chooses: a move of each robot, or the next area (default: moves).
        plans: NAME=FOLDER with another planner's plans, ID.json for the world ID; more than one may be given.
        only: Worlds by name or pattern, "contiguous-10-??-k1,terrain-k8" (default: all).
        rollouts: On each world (default: 1000).
        processes: Worlds at a time (default: one a core).
        out: Write the page, tables (Markdown, CSV), JSON and the worlds as files to this folder.
    """
    from analysis.cli.progress import show_pool_progress
    from analysis.standings.entries import own_of
    from analysis.standings.search import run_suite
    from analysis.standings.worlds import choose
    from planner.policies import RULES

    check_folder(out)
    names, folders = choose(only), {}
    for given in plans or []:
        name, found, folder = given.partition("=")
        if not (name and found and folder):
            raise UsageError(f"--plans {given!r}", expected="NAME=FOLDER")
        if name in folders:
            raise UsageError(f"--plans {given!r}: {name!r} is named twice", expected="a name of its own for each")
        folders[name] = folder
    if policy is None and actions is not None:
        raise UsageError(f"--actions {actions} without --policy", fix="add --policy, or leave it out")
    own = None if policy is None else own_of(policy, actions or "moves")
    count = ROLLOUTS if rollouts is None else rollouts
    with show_pool_progress("worlds", RULES) as progress:
        answer = run_suite(names, own, folders, count, seed or 0, processes, progress)
    return deliver(answer, out=out, as_json=as_json)
