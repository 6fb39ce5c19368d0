"""What the commands say while they work, each of what it counts; how that is shown: `analysis.kit.progress`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.kit.compiling import compiling_elsewhere
from analysis.kit.progress import Watch, show_progress

if TYPE_CHECKING:
    from analysis.inputs import Asked
    from planner.plans.plan import Plan
    from planner.settings import Policy
    from planner.worlds.world import World


@contextmanager
def show_pool_progress(things: str, policies: Iterable[Policy]) -> Iterator[Watch]:
    """What processes do that roll out by these policies; `things`: what is counted."""
    with compiling_elsewhere(policies), show_progress(things) as watch:
        yield watch


def load_or_make_plan(
    asked: Asked, plan_file: Path | None = None, state: Path | None = None, **how: Any
) -> tuple[World, Plan, tuple[str, ...]]:
    """`analysis.inputs.load_or_make_plan`, watched."""
    from analysis.inputs import load_or_make_plan as load
    from analysis.trials.best import plan_best

    with show_progress() as watch:
        watch.doing("the map")
        return load(asked, plan_file, state, find_best=plan_best, doing=watch.doing, **how)
