"""Counts over rollouts: outcome codes, results of single rollouts, and tallies, which add up.

Axis letters: `K` robots, `T` the last step counted, `N = H * W` cells, `B` rollouts.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Annotated, Any, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from planner.errors import MracError
from planner.simulator.codes import Outcome


class TallyError(MracError):
    """Tallies that cannot be added: of different plans, or with the same rollouts."""


COUNTS_OF_0_3 = {"by_luck": "by_threshold"}
"""Counts of a tally in files of release 0.3: old to new name."""
WORDS_OF_0_3 = {
    "stopped": "all_robots_lost",
    "stuck": "no_progress",
    "timeout": "step_limit",
    "path_end": "end_of_paths",
    "paths": "end_of_paths",
    "called_off": "not_worth_the_risk",
}
"""Names of outcomes in releases up to 0.3, and today's; the old ones are still read."""


def counts_by_word(counts: Sequence[int] | NDArray[np.int64], deadline: bool) -> dict[str, int]:
    """Rollouts by the name of each outcome.

    Args:
        counts: by code; those of older files are shorter.
        deadline: whether a deadline cuts runs off.
    """
    found = dict.fromkeys((outcome.word for outcome in Outcome), 0)
    for code, count in enumerate(counts):
        found[Outcome(code).by_deadline(deadline).word] += int(count)
    return found


def counts_of_words(found: Mapping[str, int]) -> list[int]:
    """Counts by code, from the result of `counts_by_word` or a file of release 0.3.

    Raises:
        KeyError: an unknown name.
    """
    counts = [0] * len(Outcome)
    for word, count in found.items():
        outcome = Outcome[WORDS_OF_0_3.get(word, word).upper()]
        counts[Outcome.STEP_LIMIT if outcome is Outcome.DEADLINE else outcome] += count
    return counts


OF_CLOSED_LOOP = tuple(outcome for outcome in Outcome if outcome is not Outcome.END_OF_PATHS)
"""Outcomes of closed-loop rollouts."""


OPTIONAL: dict[str, Any] = dict.fromkeys(("bisected", "divided", "home", "delivered"), np.int32)
OPTIONAL |= dict.fromkeys(("value_covered", "value_found"), np.int64)
"""Columns of `RolloutResults` that may be missing."""


def _no_column() -> NDArray:
    return np.zeros(0, dtype=np.int32)


@dataclass(frozen=True, eq=False)
class RolloutResults:
    """Results of single rollouts, in order of their ids `start .. start + B - 1`.

    Attributes:
        start: the first rollout id.
        visited: int32 `[B]`, accessible cells entered by any robot, including one that was lost there.
        survived: int32 `[B]`, accessible cells that some robot entered and survived.
        time: int32 `[B]`, steps: open loop, the last step at which a live robot moves; closed loop, the run's time.
        alive: int32 `[B]`, robots not lost.
        outcome: int8 `[B]`, values of `Outcome`.
        bisected, divided: int32 `[B]`, shared areas whose unvisited cells were one component and had to be bisected,
            and those that had several components already (SPEC section 5). Missing: zeros, as in the open loop.
        home: int32 `[B]`, robots alive at a base at the end (SPEC section 19). Missing: zeros.
        delivered: int32 `[B]`, cells delivered (SPEC section 19). Missing: zeros.
        value_covered, value_found: int64 `[B]`, values of cells visited, and found (`ClosedLoop.with_cell_weights`).
            Missing: zeros.
    """

    start: int
    visited: NDArray[np.int32]
    survived: NDArray[np.int32]
    time: NDArray[np.int32]
    alive: NDArray[np.int32]
    outcome: NDArray[np.int8]
    bisected: NDArray[np.int32] = field(default_factory=_no_column)
    divided: NDArray[np.int32] = field(default_factory=_no_column)
    home: NDArray[np.int32] = field(default_factory=_no_column)
    delivered: NDArray[np.int32] = field(default_factory=_no_column)
    value_covered: NDArray = field(default_factory=_no_column)
    value_found: NDArray = field(default_factory=_no_column)

    def __post_init__(self) -> None:
        for name, kind in OPTIONAL.items():
            if len(getattr(self, name)) == 0:
                object.__setattr__(self, name, np.zeros(len(self.visited), dtype=kind))

    @classmethod
    def join(cls, parts: Iterable[RolloutResults]) -> RolloutResults:
        """The results of consecutive ranges of ids as one.

        Raises:
            TallyError: they are not consecutive.
        """
        parts = list(parts)
        for left, right in itertools.pairwise(parts):
            if left.start + len(left.visited) != right.start:
                raise TallyError(f"results from id {right.start} do not follow {left.start + len(left.visited)}")
        columns = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)[1:]}
        return cls(parts[0].start, **columns)


ByCoverage = Annotated[NDArray[np.int64], "cells covered"]
ByStep = Annotated[NDArray[np.int64], "step"]
ByRobots = Annotated[NDArray[np.int64], "robots"]
ByOutcome = Annotated[NDArray[np.int64], "outcome"]
ByCell = Annotated[NDArray[np.int64], "cell"]
ByPasses = Annotated[NDArray[np.int64], "cell and survived visits"]
ByThreshold = Annotated[NDArray[np.int64], "class of the threshold sum and figure"]
ByHome = Annotated[NDArray[np.int64], "robots at home"]
ByDelivered = Annotated[NDArray[np.int64], "cells delivered"]
"""Counts int64 `[accessible + 1]`, `[T + 1]`, `[K + 1]`, `[len(Outcome)]`, `[N]`, `[N * P]` (P per cell), and sums.

A field of `Tally` with such a type is a count: adding, comparing, stores and recordings follow from its declaration.
With `= field(default_factory=no_counts)` it may be missing, from engines that do not count it and from older files: it
is then empty.
"""


def no_counts() -> NDArray[np.int64]:
    """Value of a missing count."""
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Tally:
    """Integer counts over a set of rollouts. `a + b` adds them exactly, in any order; overlapping ids are an error.

    Attributes:
        key: identity of the rollouts (`tally_key`); tallies with different keys do not add.
        shape: (H, W) of the world.
        ids: the rollout ids: disjoint, sorted, not adjacent ranges `(start, stop)`, stop excluded.
        visited, survived: rollouts by cells covered, in the two meanings of SPEC section 2.
        time, alive, outcomes: rollouts by time in steps, by robots alive at the end, by outcome.
        new_visited, new_survived: cells covered for the first time at each step, over all rollouts.
        visits, stops: entries into each cell (re-visits included), and robots lost there.
        covered_visited, covered_survived: rollouts in which the cell was covered.
        passes: rollouts with 1, 2, ... P or more survived visits of the cell (`ClosedLoop.with_cell_weights`).
        by_threshold: sums of figures by class of the team's total failure threshold
            (`planner.rollouts.threshold_classes`).
        home: rollouts by robots alive at a base at the end; empty if robots do not return.
        delivered: rollouts by cells delivered (SPEC section 19); empty if these are not counted.
    """

    key: str
    shape: tuple[int, int]
    ids: tuple[tuple[int, int], ...]
    visited: ByCoverage
    survived: ByCoverage
    time: ByStep
    alive: ByRobots
    outcomes: ByOutcome
    new_visited: ByStep
    new_survived: ByStep
    visits: ByCell
    stops: ByCell
    covered_visited: ByCell
    covered_survived: ByCell
    passes: ByPasses = field(default_factory=no_counts)
    by_threshold: ByThreshold = field(default_factory=no_counts)
    home: ByHome = field(default_factory=no_counts)
    delivered: ByDelivered = field(default_factory=no_counts)

    @classmethod
    def empty(cls, key: str, shape: tuple[int, int], robots: int, accessible: int, last_step: int = 0) -> Self:
        """The tally of no rollouts: every count 0, no ids.

        Args:
            key, shape: see `Tally`.
            robots: K.
            accessible: accessible cells.
            last_step: T.
        """
        sizes = {"cells covered": accessible + 1, "step": last_step + 1, "robots": robots + 1}
        sizes |= {"outcome": len(Outcome), "cell": shape[0] * shape[1]}
        zeros = {name: np.zeros(sizes.get(axis, 0), dtype=np.int64) for name, axis in cls.axes().items()}
        return cls(key, shape, (), **zeros)

    @classmethod
    def axes(cls) -> dict[str, str]:
        """The axis of every count by its name."""
        return _axes(cls)  # type: ignore[arg-type]  # a class can be hashed

    @property
    def rollouts(self) -> int:
        """Number of rollouts."""
        return sum(stop - start for start, stop in self.ids)

    @property
    def robots(self) -> int:
        """K."""
        return len(self.alive) - 1

    @property
    def accessible(self) -> int:
        """Number of accessible cells."""
        return len(self.visited) - 1

    def counts(self) -> dict[str, NDArray[np.int64]]:
        """Every array of counts by its name, without missing ones."""
        return {name: array for name in self.axes() if len(array := getattr(self, name))}

    def __add__(self, other: Self) -> Self:
        """Both sets of rollouts in one tally.

        Raises:
            TallyError: the tallies are of different plans, or overlap.
        """
        if self.key != other.key or self.shape != other.shape:
            raise TallyError(f"tallies of different plans cannot be added: {self.key} and {other.key}")
        if self.robots != other.robots or self.accessible != other.accessible:
            raise TallyError("tallies of different teams or maps cannot be added")
        added: dict[str, Any] = {name: add_padded(getattr(self, name), getattr(other, name)) for name in self.axes()}
        if self.ids and other.ids and not (len(self.delivered) and len(other.delivered)):
            added["delivered"] = no_counts()  # not counted in all of these rollouts
        return replace(self, ids=_merge_ids(self.ids, other.ids), **added)

    def __eq__(self, other: object) -> bool:
        """The same rollouts of the same plan with the same counts (steps without counts do not matter)."""
        if not isinstance(other, Tally):
            return NotImplemented
        if (self.key, self.shape, self.ids) != (other.key, other.shape, other.ids):
            return False
        return all(_equal_padded(getattr(self, name), getattr(other, name)) for name in self.axes())

    __hash__ = None  # type: ignore[assignment]


@cache
def _axes(kind: type[Tally]) -> dict[str, str]:
    hints = get_type_hints(kind, include_extras=True).items()
    return {name: hint.__metadata__[0] for name, hint in hints if hasattr(hint, "__metadata__")}


def tally_key(plan: str, loop: str, seed: int) -> str:
    """The identity of a kind of rollout: plan and world, loop, failure sampling, seed.

    Args:
        plan: hash of world and plan.
        loop: "open" or "closed".
        seed: of the random numbers.
    """
    return f"{plan}/{loop}/tolerance/{seed}"


def _merge_ids(left: Iterable[tuple[int, int]], right: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Sorted union of ranges of ids, adjacent ones joined; TallyError names the first id that both hold."""
    merged: list[tuple[int, int]] = []
    for start, stop in sorted([*left, *right]):
        if merged and start < merged[-1][1]:
            raise TallyError(f"rollout {start} is in both tallies; it would be counted twice")
        if merged and start == merged[-1][1]:
            merged[-1] = (merged[-1][0], stop)
        else:
            merged.append((start, stop))
    return tuple(merged)


def add_padded(left: NDArray[np.int64], right: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sum of two arrays of counts; the shorter one is continued with zeros."""
    longer, shorter = (left, right) if len(left) >= len(right) else (right, left)
    total = longer.copy()
    # Times that no rollout of the shorter array reached count 0.
    total[: len(shorter)] += shorter
    return total


def _equal_padded(left: NDArray[np.int64], right: NDArray[np.int64]) -> bool:
    shared = min(len(left), len(right))
    return bool(np.array_equal(left[:shared], right[:shared]) and not left[shared:].any() and not right[shared:].any())


@dataclass(frozen=True, eq=False)
class Trace:
    """One rollout, step by step.

    Attributes:
        rollout: id.
        cells: int32 `[T, K]`, cell index (row * W + col) of each robot at the end of each step from t = 0.
        doing: int8 `[T, K]`, values of `Doing`, at the end of the step.
        areas: int32 `[T, K]`, id of each robot's area at the end of the step; NO_AREA for none (also once lost).
        events: int32 `[E, 5]`, rows (step, robot, kind, area, other), in order.
        area_of: int32 `[N]`, id of the last area that each cell belonged to; NO_AREA for inaccessible cells. Together
            with `events` it determines every area's cells at every step.
        outcome: of the rollout; its time is `T - 1`.
    """

    rollout: int
    cells: NDArray[np.int32]
    doing: NDArray[np.int8]
    areas: NDArray[np.int32]
    events: NDArray[np.int32]
    area_of: NDArray[np.int32]
    outcome: Outcome

    @property
    def time(self) -> int:
        """The step at which the rollout ended."""
        return len(self.cells) - 1

    def __eq__(self, other: object) -> bool:
        """Identical, event for event."""
        if not isinstance(other, Trace):
            return NotImplemented
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    __hash__ = None  # type: ignore[assignment]
