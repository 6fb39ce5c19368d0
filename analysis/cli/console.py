"""Output of the command line: console, file checks, progress, interrupts, and the end of every command."""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import tempfile
import threading
from collections.abc import Iterable
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from analysis.utils.notes import say
from planner.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from analysis.inputs import Asked
    from analysis.report.model import Report
    from analysis.report.result import Result
    from planner.plan.plan import Plan
    from planner.world.world import World


# Results go to standard output, notes to standard error. Output files are checked before any work.

COMMAND: ContextVar[tuple[str, ...]] = ContextVar("command", default=())
"""The words of the command line that runs, without the program's name."""
PIPE_WIDTH = 110
"""Width of tables in columns if neither a terminal nor COLUMNS defines it."""


def command_line() -> str:
    """The command that runs, as it would be typed."""
    return shlex.join(["mrac-jax", *COMMAND.get()])


def check_streams() -> None:
    """Raise UsageError without a standard output; print characters that the terminal cannot show as escapes."""
    if sys.stdout is None:
        raise UsageError("standard output is closed", expected="somewhere to print the answer")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def output_console() -> Any:
    """The console on standard output."""
    from analysis.utils.tables import SafeConsole

    terminal = sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit()
    return SafeConsole(width=None if terminal else PIPE_WIDTH)


def check_folder(out: Path | None) -> None:
    """Refuse an invalid output folder before any work is done."""
    if out is None:
        return
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out} is a file", expected="a folder, new or not")
    nearest = next(parent for parent in (out.absolute(), *out.absolute().parents) if parent.exists())
    try:
        with tempfile.TemporaryDirectory(prefix=".", dir=nearest):
            pass
    except OSError as error:
        problem = f"--out {out} cannot be made in {nearest} ({error.strerror})"
        raise UsageError(problem, expected="a folder to write to") from error


def may_replace(out: Path | None, force: bool) -> bool:
    """True if the path is free, or may be replaced: by `force`, or as the user at a terminal answers.

    Raises UsageError without a terminal.
    """
    if out is None or force or not out.exists():
        return True
    if sys.stdin is None or not (sys.stdin.isatty() and sys.stderr.isatty()):
        from planner.files import check_new

        check_new(out)
    say([f"{out} is there already. Replace it? [y/N]"])
    if sys.stdin.readline().strip().lower() in ("y", "yes"):
        return True
    say([f"{out} is unchanged; nothing was written"])
    return False


def check_files(
    source: str | None, *outputs: Path | None, suffix: str = "", also_read: tuple[Path | None, ...] = ()
) -> None:
    """Refuse output files that cannot be written, that are inputs, or that coincide, before any work is done.

    Inputs are INPUT, the files `also_read`, and the files that scenarios among them name.
    """
    from analysis.inputs import read_files

    taken = [file.resolve() for file in read_files(source, *also_read)]
    for out in outputs:
        if out is None:
            continue
        if not out.parent.is_dir():
            raise UsageError(
                f"{out}: there is no folder {out.parent}", expected="a folder that is there", fix="make it"
            )
        if not os.access(out.parent, os.W_OK | os.X_OK) or (out.exists() and not out.is_file()):
            raise UsageError(f"{out} cannot be written", expected="a file, new or not, in a folder to write to")
        if suffix and out.suffix != suffix:
            raise UsageError(f"{out} does not end in {suffix}", expected=f"a {suffix} file")
        if out.resolve() in taken:
            raise UsageError(f"{out} is an input, or is written twice", expected="another file")
        taken.append(out.resolve())


# Interrupts that would be lost.
#
# Python raises KeyboardInterrupt between any two steps of the main thread. Inside a callback of the garbage collector
# (JAX registers one that runs at every collection), inside a `__del__`, or in a callback of compiled code, no caller
# can catch it: it goes to `sys.unraisablehook`, which prints it, and the program runs on. This code sends it again, a
# moment later and repeatedly, until it is raised where it ends the work. Native code that resolves overloads turns it
# into a TypeError: a handler of such an error can therefore ask whether an interrupt came before.

AGAIN_SECONDS = 0.02


def keep_interrupts(own: signal.Signals) -> threading.Event:
    """From now on, send uncatchable interrupts again instead of printing them.

    SIGTERM, which all threads block, counts as an interrupt; SIGINT does not if the process ignores it. Both are sent
    again as the signal `own`. The returned event is set after the first one.
    """
    others, came = sys.unraisablehook, threading.Event()

    def handler(number: int, frame: FrameType | None) -> None:
        came.set()
        signal.default_int_handler(number, frame)

    def hook(lost: sys.UnraisableHookArgs) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            others(lost)
            return
        timer = threading.Timer(AGAIN_SECONDS, os.kill, (os.getpid(), own))
        timer.daemon = True
        timer.start()

    def pass_on() -> None:
        while True:
            signal.sigwait({signal.SIGTERM})
            os.kill(os.getpid(), own)

    sys.unraisablehook, waits = hook, hasattr(signal, "sigwait")  # not on Windows
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, handler)
    signal.signal(own if waits else signal.SIGTERM, handler)
    if waits:
        threading.Thread(target=pass_on, daemon=True).start()
    return came


# The end of every command: the answer as tables or as JSON, files, an exit status.

DONE, CHECK_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def deliver(
    answer: Result,
    said: Report | None = None,
    *,
    out: Path | None = None,
    as_json: bool = False,
    notes: Iterable[str] = (),
    command: str | None = None,
    source: str | None = None,
    also_read: Iterable[Path | None] = (),
    earlier: Report | None = None,
) -> int:
    """Print `answer`, save it to `out`, print the notes and the files written; returns the exit status.

    It is saved even if the reader of standard output closed the pipe (BrokenPipeError, raised afterwards).

    Args:
        said: its report, if it differs from the usual one.
        command: the command for the page, if it is not the command line that runs.
        source, also_read: the INPUT, and other files that were read: they are not replaced.
        earlier: an earlier report of it that is already printed.
    """
    from analysis.inputs import read_files
    from analysis.report.result import report_of, save_report
    from analysis.utils.progress import show_progress

    report, written, unread = said or report_of(answer), list[Path](), list[BrokenPipeError]()
    try:
        show(report, as_json, earlier)
    except BrokenPipeError as error:
        unread.append(error)
    if out is not None:
        with show_progress() as progress:
            progress.doing("writing pictures and the page")
            line = command_line() if command is None else command
            written = save_report(report, out, line, read_files(source, *also_read))
    say([*notes, *(f"wrote {file}" for file in written)])
    if unread:
        raise unread[0]
    return INTERRUPTED if answer.partial else CHECK_FAILED if report.faults else DONE


def show(report: Report, as_json: bool, earlier: Report | None = None) -> None:
    """Print a report as tables or as JSON; `earlier`: as of `print_report`."""
    from analysis.report.result import json_of, print_report

    if as_json:
        print_json(json_of(report))
    else:
        print_report(report, output_console(), earlier)


def print_json(content: object) -> None:
    """One JSON object on standard output, and nothing else."""
    print(json.dumps(content, allow_nan=False), flush=True)  # noqa: T201


# Progress of the commands; the display is in `analysis.utils.progress`.


def load_or_make_plan(
    asked: Asked, plan_file: Path | None = None, state: Path | None = None, **how: Any
) -> tuple[World, Plan, tuple[str, ...]]:
    """`analysis.inputs.load_or_make_plan` with a progress display."""
    from analysis.estimators.racing import plan_best
    from analysis.inputs import load_or_make_plan as load
    from analysis.utils.progress import show_progress

    with show_progress() as watch:
        watch.doing("the map")
        return load(asked, plan_file, state, find_best=plan_best, doing=watch.doing, **how)


# The output of `mrac-jax plan`: a line about the plan, and a row for each robot.


def print_plan(made: Plan, world: World, console: Console) -> None:
    """Print the plan; survival probabilities are those of the nominal paths."""
    from analysis.theory.exact import open_loop_exact
    from analysis.utils.tables import failure_text, plan_text, robots_table, span_text
    from planner.formatting import counted

    said = made.origin if made.is_external else plan_text(made)
    lost = 0 if made.state is None else made.state.lost
    team = f"{counted(len(made.robots), 'robot')}{f' ({lost} lost before)' if lost else ''}"
    console.print(f"{team}, {said}, {span_text(made, world.pace)}", highlight=False)
    if made.settings is not None and made.settings.deadline is not None:
        end = world.pace.step(made.settings.deadline)
        console.print(f"The mission ends at {end}, whatever is left.", highlight=False)
    if means := failure_text(made, world):
        console.print(f"Robots: {means}.", highlight=False)
    console.print(robots_table(made, open_loop_exact(made, world).survival))
