"""Progress of rollouts on standard error: done, rate and remaining time; silent when nobody watches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


@contextmanager
def show_progress() -> Iterator[Callable[[int, int, float], None]]:
    """A function `(done, total, seconds)` to call after every chunk; `total` 0 when it is not known."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.completed:,.0f} rollouts"),
        BarColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("rollouts", total=None, rate="")

        def update(done: int, total: int, seconds: float) -> None:
            rate = f"{done / seconds:,.0f}/s" if seconds > 0 else ""
            bar.update(task, completed=done, total=total or None, rate=rate)

        yield update
