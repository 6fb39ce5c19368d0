"""Are two engines' tallies, single results or traces the same? If not: which array, where first, and both values."""

from __future__ import annotations

import itertools
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from planner.tally import Outcome, RolloutResults, Tally
from planner.trace import Doing, EventKind, Trace


def assert_same_tally(mine: Tally, other: Tally, what: str = "") -> None:
    """The same rollouts of the same thing with the same counts; steps that hold nothing do not matter."""
    found = [_values(name, getattr(mine, name), getattr(other, name)) for name in ("key", "shape", "ids")]
    theirs = other.counts()
    for name, counts in mine.counts().items():
        length = max(len(counts), len(theirs[name])) if name in ("time", "new_visited", "new_survived") else 0
        found.append(_arrays(name, _longer(counts, length), _longer(theirs[name], length)))
    _report("tallies", what, found)
    assert mine == other, f"tallies differ: {what}"


def assert_same_results(mine: RolloutResults, other: RolloutResults, what: str = "") -> None:
    """The same ids with the same results; an index names a rollout, counted from `start`."""
    found = [_values("start", mine.start, other.start)]
    found += [_arrays(f.name, getattr(mine, f.name), getattr(other, f.name)) for f in fields(RolloutResults)[1:]]
    _report("results", what, found)


def assert_same_trace(mine: Trace, other: Trace, what: str = "") -> None:
    """Identical, event for event; the arrays per step are compared as far as both go."""
    steps = min(len(mine.cells), len(other.cells))
    found = [
        _values("rollout", mine.rollout, other.rollout),
        _values("outcome", Outcome(mine.outcome).name, Outcome(other.outcome).name),
        _values("time", mine.time, other.time),
        _events(mine.events, other.events),
        _arrays("cells (step, robot)", mine.cells[:steps], other.cells[:steps]),
        _arrays("doing (step, robot)", mine.doing[:steps], other.doing[:steps], Doing),
        _arrays("areas (step, robot)", mine.areas[:steps], other.areas[:steps]),
        _arrays("area_of", mine.area_of, other.area_of),
    ]
    _report("traces", what or f"rollout {mine.rollout}", found)
    assert mine == other, f"traces differ: {what}"


def describe_event(row: NDArray[np.int32]) -> str:
    """A row of `Trace.events` in words."""
    step, robot, kind, area, other = (int(value) for value in row)
    return f"(step {step}, robot {robot}, {EventKind(kind).name}, area {area}, other {other})"


def _longer(counts: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    return np.pad(counts, (0, max(0, length - len(counts))))


def _values(name: str, mine: object, other: object) -> str:
    return "" if mine == other else f"{name}: {mine!r} and {other!r}"


def _arrays(name: str, mine: NDArray, other: NDArray, names: type[Doing] | None = None) -> str:
    """What tells two arrays apart, "" for nothing: their shapes, else the first place in C order, and how many."""
    if mine.shape != other.shape:
        return f"{name}: shapes {mine.shape} and {other.shape}"
    places = np.argwhere(mine != other)
    if len(places) == 0:
        return ""
    at = tuple(places[0].tolist())
    pair = [names(int(one[at])).name if names else one[at].item() for one in (mine, other)]
    return f"{name}{list(at)}: {pair[0]} and {pair[1]} ({len(places)} of {mine.size} differ)"


def _events(mine: NDArray[np.int32], other: NDArray[np.int32]) -> str:
    for number, (left, right) in enumerate(itertools.zip_longest(mine.reshape(-1, 5), other.reshape(-1, 5))):
        if left is None or right is None or not np.array_equal(left, right):
            said = ["none" if row is None else describe_event(row) for row in (left, right)]
            return f"events[{number}]: {said[0]} and {said[1]}"
    return ""


def _report(things: str, what: str, found: list[str]) -> None:
    lines = [line for line in found if line]
    assert not lines, "\n  ".join([f"{things} differ: {what}", *lines])
