"""Progress of rollouts and surveys on standard error: done, rate and remaining time; silent when nobody watches."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from analysis.sweeps.sweep import Standing, Watch

if TYPE_CHECKING:
    from analysis.sweeps.engine import Done


@contextmanager
def show_progress() -> Iterator[Callable[[int, int, float], None]]:
    """A function `(done, total, seconds)` to call after every chunk; `total` 0 when it is not known."""
    with _bar() as update:
        yield lambda done, total, seconds: update("", done, total, seconds)


@contextmanager
def show_team_progress() -> Iterator[Callable[[int, int, int, float], None]]:
    """A function `(robots, done, total, seconds)` to call after every chunk of a team's rollouts; `total` at most."""
    with _bar() as update:
        yield lambda robots, done, total, seconds: update(f"{robots} robots: ", done, total, seconds)


@contextmanager
def show_world_progress() -> Iterator[Callable[[int, int, float], None]]:
    """A function `(done, total, seconds)` to call after every world of a survey."""
    with _bar("worlds") as update:
        yield lambda done, total, seconds: update("", done, total, seconds)


@contextmanager
def show_job_progress() -> Iterator[Callable[[Done], None]]:
    """A function to call with the state of a sweep after every job."""
    with _bar("jobs") as update:
        yield lambda done: update("", done.jobs, done.total, done.seconds)


@contextmanager
def _bar(things: str = "rollouts") -> Iterator[Callable[[str, int, int, float], None]]:
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}{task.completed:,.0f} " + things),
        BarColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=None, rate="")

        def update(what: str, done: int, total: int, seconds: float) -> None:
            rate = f"{done / seconds:,.3g}/s" if 0 < done < 100 * seconds else f"{done / max(seconds, 1e-9):,.0f}/s"
            bar.update(task, description=what, completed=done, total=total or None, rate=rate)

        yield update


@contextmanager
def show_sweep_progress() -> Iterator[Watch]:
    """Jobs done, rate, remaining time and the widest interval so far, on standard error; silent when nobody watches."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.completed:,.0f} of {task.total:,.0f} jobs"),
        BarColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[widest]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=1, rate="", widest="")

        def update(now: Standing) -> None:
            rate = f"{now.jobs / max(now.seconds, 1e-9):,.3g}/s"
            widest = "" if math.isnan(now.widest) else f"widest ± {100 * now.widest:.2f} points"
            bar.update(task, completed=now.jobs, total=now.total, rate=rate, widest=widest)

        yield update
