"""An event loop that an interrupt ends, wherever it comes."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from analysis.utils.progress import run_loop

EVERYWHERE = """
import asyncio, signal, sys
from analysis.utils.progress import run_loop

def handler(number, frame):  # as the command line has it: not Python's own
    raise KeyboardInterrupt

async def busy():
    while True:
        await asyncio.sleep(0)

async def main():
    other = asyncio.create_task(busy())
    await asyncio.Event().wait()

def interrupted_at(line):
    def traced(frame, event, arg):
        if event == "line":
            left.pop()
            if not left:
                signal.raise_signal(signal.SIGINT)
                sys.settrace(None)
                return None
        return traced
    left = [None] * line
    return lambda frame, event, arg: traced if frame.f_code.co_name == "_run_once" else None

signal.signal(signal.SIGINT, handler)
for line in range(1, 61):  # of the loop's first steps
    sys.settrace(interrupted_at(line))
    try:
        run_loop(main())
    except KeyboardInterrupt:
        print(line, signal.getsignal(signal.SIGINT) is handler)
"""


def test_an_interrupt_between_any_two_steps_of_a_loop_ends_it() -> None:
    root = str(Path(__file__).parent.parent)
    command = [sys.executable, "-c", EVERYWHERE]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, timeout=60)
    assert (done.stdout, done.stderr) == ("".join(f"{line} True\n" for line in range(1, 61)), "")


def test_an_interrupt_that_comes_too_late_to_cancel_anything_is_not_lost() -> None:
    async def answer() -> int:
        signal.raise_signal(signal.SIGINT)
        return 42

    with pytest.raises(KeyboardInterrupt):
        run_loop(answer())


def test_it_ends_with_what_its_task_returns_or_raises() -> None:
    async def answer() -> int:
        await asyncio.sleep(0)
        return 42

    async def gives_up() -> None:
        raise asyncio.CancelledError

    before = signal.getsignal(signal.SIGINT)
    assert run_loop(answer()) == 42
    with pytest.raises(asyncio.CancelledError):
        run_loop(gives_up())
    assert signal.getsignal(signal.SIGINT) is before
