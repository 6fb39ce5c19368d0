"""Tasks for a pool of processes: they import next to nothing, so that processes start quickly."""

import os
import random
import time

ENDS_WITH_US = "import ctypes; ctypes.CDLL(None).prctl(1, 9)\n"
"""In a process's script: it is killed when its parent ends, so that a test run that is killed leaves nobody (Linux)."""


def answer(size: int, number: int) -> tuple[int, bytes]:
    """So many bytes that follow from the task's number alone, after a few milliseconds."""
    draw = random.Random(number)
    time.sleep(draw.uniform(0, 0.01))
    return number, draw.randbytes(size)


def pause(seconds: float) -> float:
    """Sleep; for ever, as near as makes no difference, where it is more than an hour."""
    time.sleep(seconds)
    return seconds


def spin(number: int) -> int:
    """Work that never ends and never leaves Python."""
    while True:
        number += 1


def die(number: int) -> None:
    """End the process, where the number is odd."""
    if number % 2:
        os._exit(9)


class Odd(Exception):
    """An exception that cannot be pickled and read again."""

    def __init__(self, number: int, more: str) -> None:
        super().__init__(f"{number} {more}")


def fail(number: int) -> object:
    """Answers that are errors, or cannot be pickled."""
    if number == 0:
        raise ValueError("no zero")
    if number == 1:
        raise Odd(1, "more")
    return lambda: number
