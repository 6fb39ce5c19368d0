"""Says, on a terminal and on a pipe alike, that code is being compiled: on a first run that takes most of a minute."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

from analysis.kit.notes import say
from planner.sealed import NO_CACHE

if TYPE_CHECKING:
    from planner.settings import Policy

PATIENCE = 1.0
"""Seconds that one compilation may take unsaid."""


def compiling_line() -> str:
    """What is said."""
    if os.environ.get(NO_CACHE, "") not in ("", "0"):
        return "compiling (in every run: compiled code is not kept) ..."
    return "compiling (in the first run only, most of a minute) ..."


class Announcer:
    """Says once that something is being compiled, if one compilation takes longer than PATIENCE."""

    def __init__(self) -> None:
        self._lock, self._depth, self._said = threading.Lock(), 0, False
        self._timer: threading.Timer | None = None

    def begins(self) -> None:
        """A compilation begins, maybe inside another."""
        with self._lock:
            self._depth += 1
            if self._depth == 1 and not self._said:
                self._timer = threading.Timer(PATIENCE, self.now)
                self._timer.daemon = True
                self._timer.start()

    def ends(self) -> None:
        """It is done."""
        with self._lock:
            self._depth = max(self._depth - 1, 0)
            if self._depth == 0 and self._timer is not None:
                self._timer.cancel()

    def now(self) -> None:
        """Say it, unless that was done."""
        with self._lock:
            said, self._said = self._said, True
        if not said:
            say([compiling_line()])


ANNOUNCER = Announcer()


@cache
def say_when_compiling() -> None:
    """From now on, in this process, for Numba's compiler and for JAX's. Code found in the cache is not compiled."""
    from numba.core import event

    from planner.jit import OF_JAX

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            ANNOUNCER.begins()

        def on_end(self, event: Any) -> None:
            ANNOUNCER.ends()

    event.register("numba:compile", Listener())
    OF_JAX.append(ANNOUNCER)


@contextmanager
def compiling_elsewhere(policies: Iterable[Policy]) -> Iterator[None]:
    """Say it, if this goes on for PATIENCE, where processes of ours will not find these policies' compiled simulators
    in the cache.
    """
    from planner.jit import is_kept
    from planner.kernels.attentive import run_attentive
    from planner.kernels.rollouts import run_set
    from planner.policies import rule_of

    if all(is_kept(run_attentive if rule_of(policy).attentive else run_set) for policy in policies):
        yield
        return
    ANNOUNCER.begins()
    try:
        yield
    finally:
        ANNOUNCER.ends()
