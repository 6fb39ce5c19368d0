"""Progress: counts and compilations, as a bar, a changing line, or repeated lines; and interrupts."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from analysis.utils.notes import Doing, ProgressCallback, quiet, say
from analysis.utils.tables import SafeConsole
from planner.arguments import argument, check_word
from planner.errors import UsageError
from planner.formatting import duration
from planner.simulator.jit import COMPILES_JAX, NO_CACHE

if TYPE_CHECKING:
    from planner.plan.plan import Plan
    from planner.settings import Policy


# Compilations: the code that is being compiled, and the time so far, a minute or more in a machine's first run.

PATIENCE = 1.0
"""Seconds after which a compilation is reported."""


def compiling_line(code: str, seconds: float) -> str:
    """ "compiling per_cell, first such run, 35 s so far"."""
    kept = os.environ.get(NO_CACHE, "") in ("", "0")
    when = "first such run" if kept else "in every run, as compiled code is not kept"
    return f"compiling {code}, {when}, {duration(seconds)} so far"


class Announcer:
    """Tracks compilations; `what`: the code that is compiled next, a policy's name."""

    def __init__(self) -> None:
        self.what = "the planner"
        self._lock, self._depth, self._began, self._earlier = threading.Lock(), 0, 0.0, dict[str, float]()
        self._current = self.what

    def begins(self) -> None:
        """A compilation begins, possibly inside another."""
        with self._lock:
            self._depth += 1
            # Nested compilations are part of the outermost one.
            if self._depth == 1:
                self._began, self._current = time.monotonic(), self.what

    def ends(self) -> None:
        """A compilation ends."""
        with self._lock:
            self._depth = max(self._depth - 1, 0)
            if self._depth == 0:
                self._earlier[self._current] = self._seconds() + self._earlier.get(self._current, 0.0)

    def line(self) -> str:
        """`compiling_line` of a compilation longer than PATIENCE, with the time of earlier ones of this code; or ""."""
        with self._lock:
            if self._depth == 0 or (seconds := self._seconds()) < PATIENCE:
                return ""
            return compiling_line(self._current, seconds + self._earlier.get(self._current, 0.0))

    def _seconds(self) -> float:
        return time.monotonic() - self._began


ANNOUNCER = Announcer()


@cache
def notice_compiling() -> None:
    """Report all later compilations of Numba and JAX in this process to ANNOUNCER; cached code is not compiled."""
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            ANNOUNCER.begins()

        def on_end(self, event: Any) -> None:
            ANNOUNCER.ends()

    for kind in ("numba:compile", COMPILES_JAX):
        event.register(kind, Listener())


def announce_compilation(plan: Plan, loop: str = "closed") -> None:
    """Later compilations are reported as the simulator of this plan in this loop."""
    ANNOUNCER.what = "the open loop" if loop == "open" or plan.settings is None else _named(plan.settings.policy)


def _named(policy: Policy) -> str:
    return policy if isinstance(policy, str) else "the policy"


@contextmanager
def compiling_elsewhere(policies: Iterable[Policy]) -> Iterator[None]:
    """Report that worker processes compile the simulators of those policies, unless they are cached."""
    from planner.simulator.jit import is_cached
    from planner.simulator.rollouts import run_group_tasks

    if is_cached(run_group_tasks):
        yield
        return
    ANNOUNCER.what = " and ".join(map(_named, policies))
    ANNOUNCER.begins()
    try:
        yield
    finally:
        ANNOUNCER.ends()


# Progress: a bar on a terminal, a changing line in a notebook, repeated lines elsewhere.

FIRST, EVERY = 1.0, 2.0
"""Seconds to the first line of a run without a terminal, and between lines. Their sum, at most 3, is the longest
silence, also if one stage ends just before its line and the next one begins.
"""
REFRESH = 0.5
"""Seconds between updates of a notebook's line; it appears with the second update."""


class Watch:
    """Shows the current stage, `doing`, and its progress, `(done, total, seconds)`; `total` 0: unknown."""

    says_things = True

    def __init__(self, bar: Progress, things: str) -> None:
        self._bar, self._usual, self._things = bar, things, things
        self.doing(things)

    def doing(self, stage: str) -> None:
        """A stage begins; its total is unknown."""
        self._what, self._things, self._began = stage, self._usual, time.monotonic()
        self._done, self._total, self._left = 0, 0, 0.0
        for old in self._bar.task_ids:
            self._bar.remove_task(old)
        self._task = self._bar.add_task(stage, total=None, count="", rate="")

    def __call__(self, done: int, total: int, seconds: float, more: str = "", things: str = "") -> None:
        """Report progress; `more`: text before it. `things`: the unit that is counted now."""
        self._done, self._total, self._things = done, total, things or self._usual
        took = seconds or time.monotonic() - self._began
        self._left = took * (total - done) / done if done else 0.0
        rate = f"{done / took:,.3g}/s" if 0 < done < 100 * took else f"{done / max(took, 1e-9):,.0f}/s"
        count = more + self._count()
        self._bar.update(
            self._task, description=self._what, completed=done, total=total or None, count=count, rate=rate
        )

    def _count(self) -> str:
        of = f" of {self._total:,}" if self._total else ""
        return f"{self._done:,}{of} {self._things}"

    def line(self) -> str:
        """The current stage, its progress, and the remaining time if known."""
        left = f", {duration(self._left)} left" if self._left > 0 else ""
        return f"{self._what} ..." + (f" {self._count()}{left}" if self._done else "")

    def line_after(self, seconds: float) -> str:
        """The line after so many seconds; during a compilation, that and its time so far."""
        return with_compiling(self._what) if ANNOUNCER.line() else f"{self.line()} ({duration(seconds)})"

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Hide the bar meanwhile, so that results can be printed."""
        self._bar.stop()
        try:
            yield
        finally:
            self._bar.start()


def with_compiling(stage: str) -> str:
    """The stage after the compilation, if any: "compiling mrac, ..., 35 s so far; rollouts"."""
    return "; ".join(filter(None, (ANNOUNCER.line(), stage)))


class _What(ProgressColumn):
    """The current stage, evaluated at every refresh, because it shows the seconds of a compilation."""

    def render(self, task: Task) -> Text:
        return Text(with_compiling(task.description))


@contextmanager
def show_progress(things: str = "rollouts", *, asked: bool = True) -> Iterator[Watch]:
    """A `Watch`: a bar on a terminal, a line in a notebook; elsewhere repeated lines, if `asked`."""
    console = SafeConsole(stderr=True)
    notebook, terminal = console.is_jupyter, console.is_terminal and not console.is_jupyter
    if terminal or notebook or asked:
        notice_compiling()
    columns = (
        _What(),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    quiet = Console(quiet=True, force_jupyter=False)  # a hidden bar must not ask a notebook for a display
    with Progress(*columns, console=console if terminal else quiet, transient=True, disable=not terminal) as bar:
        watch = Watch(bar, things)
        if terminal or not (notebook or asked):
            yield watch
        else:
            with notebook_line(watch.line_after) if notebook else lines_now_and_then(watch.line_after):
                yield watch


@contextmanager
def lines_now_and_then(line: Callable[[float], str]) -> Iterator[None]:
    """Print `line(seconds)` on standard error after FIRST seconds, then at intervals from EVERY on, unless ""."""
    with _repeated(lambda seconds: say([*filter(None, [line(seconds)])]), FIRST, EVERY, 0.5):
        yield


@contextmanager
def notebook_line(line: Callable[[float], str]) -> Iterator[None]:
    """Show `line(seconds)` below a notebook's cell while it runs, and remove it afterwards."""
    display = import_module("IPython.display").display
    shown: list[Any] = []

    def show(seconds: float) -> None:
        text = {"text/plain": line(seconds)}
        if shown:
            shown[0].update(text, raw=True)
        else:
            shown.append(display(text, raw=True, display_id=True))

    with _repeated(show, 2 * REFRESH, REFRESH):
        yield
    for handle in shown:
        handle.update({"text/plain": ""}, raw=True)


@contextmanager
def _repeated(speak: Callable[[float], None], first: float, every: float, grows: float = 0.0) -> Iterator[None]:
    """Call `speak(seconds so far)` repeatedly in a thread; an interval is at least `grows` times these seconds."""
    over, clock = threading.Event(), time.monotonic()

    def run() -> None:
        at = first
        # Absolute times, so that delays do not add up.
        while not over.wait(max(clock + at - time.monotonic(), 0.0)):
            speak(at)
            at += max(every, grows * at)

    speaker = threading.Thread(target=run, daemon=True)
    speaker.start()
    try:
        yield
    finally:
        over.set()
        speaker.join()


# The frame of a public function: its progress, and the result of an interruption.

OnInterrupt = Literal["raise", "return"]


class Found(Protocol):
    """A result that may be partial."""

    @property
    def partial(self) -> bool:
        """Whether it was interrupted; it then holds the part that was done."""
        ...


Kind = TypeVar("Kind", bound=Found)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, or a notebook's stop button, during a function of the public API.

    Attributes:
        partial: the result with the part that was done; None: nothing was.
    """

    def __init__(self, partial: Found | None) -> None:
        super().__init__("interrupted" if partial is None else "interrupted: the partial result is in `partial`")
        self.partial = partial


def ask(
    work: Callable[[ProgressCallback, Doing], Kind],
    progress: ProgressCallback | bool | None,
    on_interrupt: OnInterrupt,
    things: str = "rollouts",
) -> Kind:
    """The result of `work(progress, doing)`.

    Args:
        work: the computation.
        progress: None: shown on a terminal and in a notebook; True: also as lines on a pipe; False: not shown; or a
            function that is called with (done, total, seconds) after every chunk, `total` 0 if it is unknown.
        on_interrupt: "raise": an interruption is raised as `Interrupted`; "return": the partial result is returned (if
            there is none, the interruption is raised).
        things: unit of the counts.

    Raises:
        Interrupted: see `on_interrupt`. UsageError: an invalid argument.
    """
    check_word("on_interrupt", on_interrupt, ("raise", "return"))
    if not (progress is None or isinstance(progress, bool) or callable(progress)):
        raise UsageError(argument("progress", progress), expected="True, False, None or a function")
    try:
        if isinstance(progress, Watch):  # shown already, as by the command line
            answer = work(progress, progress.doing)
        elif callable(progress) or progress is False:
            tell = progress or quiet
            answer = work(lambda *now: tell(*now[:3]), quiet)
        else:
            with show_progress(things, asked=progress is True) as watch:
                answer = work(watch, watch.doing)
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(None) from None
    if answer.partial and on_interrupt == "raise":
        raise Interrupted(answer)
    return answer


# Event loops that an interrupt ends.

Result = TypeVar("Result")
ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR2") if hasattr(signal, name)]
"""Signals that end a program which handles them (`analysis.cli.console`)."""


def run_loop(main: Coroutine[Any, Any, Result]) -> Result:
    """`asyncio.run`, with interrupts that cancel `main` for any signal handler, followed by KeyboardInterrupt.

    Without this, KeyboardInterrupt is raised between any two steps of Python. An event loop that has just removed its
    next callback then loses it, and waits for its task for ever. asyncio prevents this only for Python's own handler.
    """
    came = False

    def cancel(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = True
        loop.call_soon_threadsafe(task.cancel)

    ours = threading.current_thread() is threading.main_thread()
    with asyncio.Runner() as runner:
        loop = runner.get_loop()
        task = loop.create_task(main)
        kept = {one: signal.signal(one, cancel) for one in ENDING if ours and callable(signal.getsignal(one))}
        try:
            return loop.run_until_complete(task)
        finally:
            for one, handler in kept.items():
                signal.signal(one, handler)
            if came:  # the task may have ended before it was cancelled
                raise KeyboardInterrupt
