"""`python -m mrac_jax.env.suite`: policies on the thirty named worlds of the benchmark suite."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence

from cyclopts import App

from analysis.cli.app import ALL, run
from analysis.cli.console import COMMAND, check_folder, deliver
from analysis.cli.options import Command, Given, of, option
from planner.errors import UsageError
from planner.settings import OPTIONS, SURVEY

NAME = "python -m mrac_jax.env.suite"
OWN = "Policies"


def suite(given: Given) -> int:
    """Coverage of policies on thirty fixed worlds, with the bound for every strategy.

    The planner's policies, its open loop, a random walk, a policy of your own and plans of other planners run on the
    same random numbers.
    """
    from analysis.policy_evaluation.leaderboard import Suite
    from analysis.utils.progress import compiling_elsewhere
    from planner.policies import RULES

    check_folder(given.out)
    folders: dict[str, str] = {}
    for text in given.plans or []:
        name, found, folder = text.partition("=")
        if not (name and found and folder):
            raise UsageError(f"--plans {text!r}", expected="NAME=FOLDER")
        if name in folders:
            raise UsageError(f"--plans {text!r}: {name!r} is named twice", expected="a different name for each")
        folders[name] = folder
    if given.policy is None and given.actions is not None:
        raise UsageError(f"--actions {given.actions} without --policy", fix="add --policy, or leave it out")
    with compiling_elsewhere(RULES):
        answer = given.call(Suite(given.only).judge, plans=folders)
    line = shlex.join([*NAME.split(), *COMMAND.get()])
    return deliver(answer, out=given.out, as_json=given.json, command=line)


SUITE = Command(suite, "suite", "", {
    "policy": option(OWN, "Python file that defines `policy`: a function as `mrac.judge` takes it, or a Rule.", "path"),
    "actions": option(OWN, "Actions of the function: moves of robots, or next areas (default: moves).", "", "moves",
                      "areas"),
    "plans": option(OWN, "NAME=FOLDER: plans of another planner, ID.json for the world ID; may be repeated.", "texts"),
    "only": option(SURVEY, 'Worlds by name or pattern: "contiguous-10-??-k1,terrain-k8" (default: all).', "text"),
    "rollouts": of("rollouts", help="Number of rollouts on each world (default: 1000)."),
    "seed": OPTIONS["seed"],
    "processes": OPTIONS["processes"],
    "out": of("out", help="Write the page, tables (Markdown, CSV), JSON and the worlds to this folder."),
    "json": OPTIONS["json"],
})  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line; returns the exit status, as of `mrac-jax`."""
    app = App(name=NAME, help_flags=("--help", "-h", ALL), version_flags=(), result_action="return_value")
    app.default(SUITE.bound(everything=True))
    return run(arguments, app)


if __name__ == "__main__":
    sys.exit(main())
