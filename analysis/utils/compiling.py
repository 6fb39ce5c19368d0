"""Knows that code is being compiled, what for, and for how long so far: a minute or more in a machine's first run."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

from planner.formatting import duration
from planner.jit import COMPILES_JAX, NO_CACHE

if TYPE_CHECKING:
    from planner.plan.plan import Plan
    from planner.settings import Policy

PATIENCE = 1.0
"""Seconds that one compilation may take without a word about it."""


def compiling_line(what: str, seconds: float) -> str:
    """ "compiling per_cell, first run only, 35 s so far"."""
    kept = os.environ.get(NO_CACHE, "") in ("", "0")
    when = "first run only" if kept else "in every run, as compiled code is not kept"
    return f"compiling {what}, {when}, {duration(seconds)} so far"


class Announcer:
    """Is told when a compilation begins and ends; `what`: whose code is compiled next, a policy's name."""

    def __init__(self) -> None:
        self.what = "the planner"
        self._lock, self._depth, self._began, self._earlier = threading.Lock(), 0, 0.0, dict[str, float]()
        self._current = self.what

    def begins(self) -> None:
        """A compilation begins, maybe inside another."""
        with self._lock:
            self._depth += 1
            if self._depth == 1:
                self._began, self._current = time.monotonic(), self.what

    def ends(self) -> None:
        """It is done."""
        with self._lock:
            self._depth = max(self._depth - 1, 0)
            if self._depth == 0:
                self._earlier[self._current] = self._seconds() + self._earlier.get(self._current, 0.0)

    def line(self) -> str:
        """`compiling_line` of a compilation that has gone on for PATIENCE, with earlier ones of this code; or ""."""
        with self._lock:
            if self._depth == 0 or (seconds := self._seconds()) < PATIENCE:
                return ""
            return compiling_line(self._current, seconds + self._earlier.get(self._current, 0.0))

    def _seconds(self) -> float:
        return time.monotonic() - self._began


ANNOUNCER = Announcer()


@cache
def notice_compiling() -> None:
    """From now on, in this process, ANNOUNCER hears what Numba and JAX compile; code in the cache is not compiled."""
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            ANNOUNCER.begins()

        def on_end(self, event: Any) -> None:
            ANNOUNCER.ends()

    for kind in ("numba:compile", COMPILES_JAX):
        event.register(kind, Listener())


def compiles_for(plan: Plan, loop: str = "closed") -> None:
    """What is compiled from now on is the simulator that this plan needs in this loop."""
    ANNOUNCER.what = "the open loop" if loop == "open" or plan.settings is None else _named(plan.settings.policy)


def _named(policy: Policy) -> str:
    return policy if isinstance(policy, str) else "the policy"


def not_compiled(policies: Iterable[Policy]) -> list[Policy]:
    """Those policies whose compiled simulator is not in the cache."""
    from planner.jit import is_cached
    from planner.policies import rule_of
    from planner.simulator.attentive import run_attentive
    from planner.simulator.rollouts import run_set

    return [policy for policy in policies if not is_cached(run_attentive if rule_of(policy).attentive else run_set)]


@contextmanager
def compiling_elsewhere(policies: Iterable[Policy]) -> Iterator[None]:
    """While this goes on, processes of ours compile the simulators of those policies that are not in the cache."""
    missing = not_compiled(policies)
    if not missing:
        yield
        return
    ANNOUNCER.what = " and ".join(map(_named, missing))
    ANNOUNCER.begins()
    try:
        yield
    finally:
        ANNOUNCER.ends()
