"""What is going on, on standard error: a bar with words on a terminal; elsewhere a line now and then in a long run."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from analysis.cli.compiling import compiling_elsewhere, say_when_compiling
from analysis.kit.notes import say
from analysis.kit.safe_console import SafeConsole

if TYPE_CHECKING:
    from analysis.sweeps.engine import Done
    from analysis.sweeps.sweep import Standing
    from planner.plans.plan import Plan
    from planner.plans.settings import Policy
    from planner.worlds.world import World

LINES_AT = (5.0, 15.0, 30.0)
"""Seconds after which a run that nobody watches says where it is; then once a minute."""


class Watch:
    """Says what is being done, `doing`, and how far it has come, `(done, total, seconds)`, `total` 0: not known."""

    def __init__(self, bar: Progress, things: str) -> None:
        self._bar, self._things = bar, things
        self.doing(things)

    def doing(self, what: str) -> None:
        """Something else begins, of which nothing is done yet and nobody knows how much there is."""
        self._what, self._done, self._total = what, 0, 0
        for old in self._bar.task_ids:
            self._bar.remove_task(old)
        self._task = self._bar.add_task(what, total=None, count="", rate="")

    def __call__(self, done: int, total: int, seconds: float, more: str = "") -> None:
        """So much is done; `more`: words before it."""
        self._done, self._total = done, total
        rate = f"{done / seconds:,.3g}/s" if 0 < done < 100 * seconds else f"{done / max(seconds, 1e-9):,.0f}/s"
        count = more + self._count()
        self._bar.update(
            self._task, description=self._what, completed=done, total=total or None, count=count, rate=rate
        )

    def _count(self) -> str:
        of = f" of {self._total:,}" if self._total else ""
        return f"{self._done:,}{of} {self._things}"

    def line(self) -> str:
        """Where it stands."""
        return f"{self._what} ..." + (f" {self._count()}" if self._done else "")


@contextmanager
def show_progress(things: str = "rollouts") -> Iterator[Watch]:
    """A `Watch`: a bar on a terminal, lines elsewhere."""
    say_when_compiling()
    console = SafeConsole(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        watch = Watch(bar, things)
        if console.is_terminal:
            yield watch
        else:
            with lines_now_and_then(watch.line):
                yield watch


@contextmanager
def lines_now_and_then(line: Callable[[], str]) -> Iterator[None]:
    """Says `line()` on standard error after LINES_AT seconds and then once a minute, for as long as it takes."""
    over, clock = threading.Event(), time.monotonic()

    def speak() -> None:
        number = 0
        while True:
            at = LINES_AT[number] if number < len(LINES_AT) else 60.0 * (number - len(LINES_AT) + 1)
            if over.wait(max(clock + at - time.monotonic(), 0.0)):
                return
            say([f"{line()} ({at:.0f} s)"])
            number += 1

    speaker = threading.Thread(target=speak, daemon=True)
    speaker.start()
    try:
        yield
    finally:
        over.set()
        speaker.join()


@contextmanager
def show_team_progress() -> Iterator[Callable[[int, int, int, float], None]]:
    """A function `(robots, done, total, seconds)` to call after every chunk of a team's rollouts; `total` at most."""
    with show_progress() as watch:
        team = 0

        def update(robots: int, done: int, total: int, seconds: float) -> None:
            nonlocal team
            if robots != team:
                watch.doing(f"{robots} robots")
                team = robots
            watch(done, total, seconds)

        yield update


@contextmanager
def show_world_progress(policy: Policy) -> Iterator[Callable[[int, int, float], None]]:
    """A function `(done, total, seconds)` to call after every world of a survey by this policy."""
    with compiling_elsewhere([policy]), show_progress("worlds") as watch:
        yield watch


@contextmanager
def show_job_progress(policies: Iterable[Policy]) -> Iterator[Callable[[Done], None]]:
    """A function to call with the state of a sweep over these policies after every job."""
    with compiling_elsewhere(policies), show_progress("jobs") as watch:
        yield lambda done: watch(done.jobs, done.total, done.seconds)


@contextmanager
def show_sweep_progress(policies: Iterable[Policy]) -> Iterator[Callable[[Standing], None]]:
    """Jobs done, rate, remaining time and the widest interval so far, on standard error."""
    with compiling_elsewhere(policies), show_progress("jobs") as watch:

        def update(now: Standing) -> None:
            widest = "" if math.isnan(now.widest) else f"widest ± {100 * now.widest:.2f} points: "
            watch(now.jobs, now.total, now.seconds, widest)

        yield update


def load_or_make_plan(
    *given: Any, seconds: float | None = None, state: Path | None = None, first: Callable[[World], None] | None = None
) -> tuple[World, Plan, tuple[str, ...]]:
    """`analysis.inputs.load_or_make_plan`, watched."""
    from analysis.inputs import load_or_make_plan as load

    with show_progress() as watch:
        watch.doing("the map")
        name, plan_file, robots, starts, choices, cell_size = given
        return load(name, plan_file, robots, starts, choices, cell_size, watch.doing, seconds, state, first)
