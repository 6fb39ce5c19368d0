"""Who stands in the table besides the planner: a policy from a file or a function, and plans of other planners."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from planner.arguments import argument
from planner.errors import UsageError
from planner.files import check_file
from planner.plan_team import read_plan
from planner.plans.plan import Plan
from planner.policies.rule import Rule
from planner.worlds.world import World

WANTED = "policy"
"""What a policy's file is to define."""


@dataclass(frozen=True)
class Own:
    """A policy of one's own.

    Attributes:
        name: in the table. said: in errors.
        given: the function, the planner's `Rule`, or the file that defines one as `policy`.
        actions: what a function chooses, as of `mrac.env`.
    """

    name: str
    said: str
    given: Callable[..., Any] | Rule | Path
    actions: Literal["moves", "areas"] = "moves"

    def load(self) -> Callable[..., Any] | Rule:
        """The function or rule itself. Raises InputError."""
        return load_policy(self.given) if isinstance(self.given, Path) else self.given


def own_of(given: Callable[..., Any] | Rule | str | Path, actions: Literal["moves", "areas"]) -> Own:
    """The policy that is given, looked at once. Raises InputError."""
    if isinstance(given, str | Path):
        load_policy(Path(given))
        return Own(Path(given).stem, str(given), Path(given), actions)
    if isinstance(given, Rule):
        return Own(given.name, given.name, given)
    if not callable(given):
        raise UsageError(argument("policy", given), expected="a function of what the robots observe, a Rule, or a file")
    name = getattr(given, "__name__", type(given).__name__)
    return Own(name, name, given, actions)


def load_policy(path: Path) -> Callable[..., Any] | Rule:
    """What a Python file defines as `policy`; it may import what lies beside it. Raises InputError."""
    check_file(path, f"a Python file that defines `{WANTED}`")
    if str(path.parent.resolve()) not in sys.path:
        sys.path.append(str(path.parent.resolve()))
    try:
        found = runpy.run_path(str(path), run_name=path.stem).get(WANTED)
    except (Exception, SystemExit) as error:
        raise UsageError(f"raised {type(error).__name__}: {error}", source=path, expected="a Python file") from error
    if not (callable(found) or isinstance(found, Rule)):
        problem = f"defines no `{WANTED}`" if found is None else f"`{WANTED}` is {found!r}"
        raise UsageError(problem, source=path, expected=f"`def {WANTED}(observations)`, or a planner's Rule")
    return found


def plan_files(plans: Mapping[str, str | Path], names: tuple[str, ...]) -> dict[str, dict[str, Path]]:
    """By planner and world the files ID.* of the folders. Raises UsageError for a folder that has none of them."""
    found = {}
    for planner, folder in plans.items():
        files = {path.stem: path for path in sorted(Path(folder).glob("*")) if path.stem in names}
        if not files:
            raise UsageError(f"no plan of {planner}", source=folder, expected=f"files named {names[0]}.json, ...")
        found[planner] = files
    return found


def read_foreign(path: Path, world: World) -> Plan:
    """The plan of another planner, for the robots of the world. Raises PlanError, UsageError."""
    plan = read_plan(path, world)
    assert world.starts is not None
    if sorted(plan.starts.tolist()) != sorted(world.starts.tolist()):
        problem = f"its robots start at {plan.starts.tolist()[:8]}"
        raise UsageError(problem, source=path, expected=f"{world.starts.tolist()[:8]}, the starts of {world.source}")
    return plan
