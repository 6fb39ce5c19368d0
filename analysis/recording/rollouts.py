"""Recordings read back into arrays: every rollout in full as a trace, and the outcomes of all evaluated ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from analysis.recording.mcap.reading import Log, open_log
from analysis.recording.viewers.topics import DATA_TOPICS, OWN
from planner.errors import InputError
from planner.mcap import LogMessage
from planner.tally import Outcome
from planner.trace import Trace
from planner.worlds.world import MAX_CELLS, MAX_ROBOTS

MOST_VALUES, MOST_EVENTS = 2**25, 2**22
"""Most numbers of one rollout's steps (steps x robots), and most events, that are read."""
MOST_OUTCOMES = 2**27
"""Most outcomes that are read."""


@dataclass(frozen=True, eq=False)
class RecordedRollout:
    """A rollout as it was recorded. Axis letters: `T` = time + 1 steps, `K` robots.

    Attributes:
        trace: the rollout, equal to what the engine made.
        times: int64 `[T]`, nanoseconds of each step in the file.
        visited, survived, alive, unassigned: int64 `[T]`, at the end of each step: cells so far, robots, areas.
        loop: "closed" or "open". seed: of the rollouts. shape: (H, W). accessible: cells that count.
    """

    trace: Trace
    times: NDArray[np.int64]
    visited: NDArray[np.int64]
    survived: NDArray[np.int64]
    alive: NDArray[np.int64]
    unassigned: NDArray[np.int64]
    loop: str
    seed: int
    shape: tuple[int, int]
    accessible: int


@dataclass(frozen=True, eq=False)
class RecordedOutcomes:
    """What every evaluated rollout came to, in order of ids. Axis `B` = rollouts.

    Attributes:
        ids: int64 `[B]`. visited, survived: int32 `[B]`, cells. time: int32 `[B]`, steps. alive: int32 `[B]`.
        outcome: int8 `[B]`, values of `planner.tally.Outcome`.
    """

    ids: NDArray[np.int64]
    visited: NDArray[np.int32]
    survived: NDArray[np.int32]
    time: NDArray[np.int32]
    alive: NDArray[np.int32]
    outcome: NDArray[np.int8]


def read_rollouts(path: str | Path) -> Iterator[RecordedRollout]:
    """The rollouts of a recording, one after the other; one is held at a time.

    Of a partial or recovered recording, rollouts that are not all there are left out. Raises InputError.
    """
    return rollouts_of(open_log(path))


def rollouts_of(log: Log) -> Iterator[RecordedRollout]:
    """`read_rollouts` of an open log."""

    def broken(problem: str) -> None:
        if not log.partial:
            raise InputError(problem, source=log.path)

    collected: _Collected | None = None
    for message in log.messages(DATA_TOPICS):
        decoded = decode(message, log.path)
        if message.topic == "/rollout/start":
            if collected is not None:
                broken(f"rollout {collected.start.rollout} has no end")
            collected = _Collected(decoded, log.path)
        elif collected is None or not collected.add(message, decoded):
            broken(f"{message.topic}: not of a rollout that has begun")
            collected = None
        elif message.topic == "/rollout/end":
            if decoded.time + 1 == len(collected.steps):
                yield collected.finish(decoded)
            else:
                broken(f"rollout {decoded.rollout} is not all there")
            collected = None
    if collected is not None:
        broken(f"rollout {collected.start.rollout} has no end")


def read_outcomes(path: str | Path) -> RecordedOutcomes:
    """Every outcome that `record --outcomes` wrote, none if it did not. Raises InputError."""
    return outcomes_of_log(open_log(path))


def outcomes_of_log(log: Log) -> RecordedOutcomes:
    """`read_outcomes` of an open log. Memory: 25 bytes a rollout."""
    kinds = {"visited": np.int32, "survived": np.int32, "time": np.int32, "alive": np.int32, "outcome": np.int8}
    ids, columns = [np.zeros(0, dtype=np.int64)], {name: [np.zeros(0, dtype=kind)] for name, kind in kinds.items()}
    last = -1
    for message in log.messages(("/outcomes",)):
        block = decode(message, log.path)
        if len({len(getattr(block, name)) for name in kinds}) != 1:
            raise InputError("/outcomes: columns of unequal length", source=log.path)
        if not last < block.first < 2**32:
            raise InputError("/outcomes: ids out of order", source=log.path)
        ids.append(np.arange(len(block.outcome), dtype=np.int64) + block.first)
        last = block.first + len(block.outcome) - 1
        if last >= MOST_OUTCOMES:
            raise InputError(f"more than {MOST_OUTCOMES} outcomes", source=log.path)
        for name, kind in kinds.items():
            columns[name].append(np.array(getattr(block, name), dtype=np.int64).astype(kind))
    return RecordedOutcomes(np.concatenate(ids), **{name: np.concatenate(parts) for name, parts in columns.items()})


def decode(message: LogMessage, source: Path) -> Any:
    """One of the project's own messages. Raises InputError if it is none."""
    kind = OWN[message.topic]
    name = None if message.schema is None else message.schema.name
    if name != kind.DESCRIPTOR.full_name or message.channel.message_encoding != "protobuf":
        raise InputError(f"{message.topic} holds {name!r}"[:200], source=source, expected=kind.DESCRIPTOR.full_name)
    try:
        return kind.FromString(bytes(message.data))
    except DecodeError as error:
        raise InputError(f"{message.topic}: a message that cannot be read", source=source) from error


class _Collected:
    """The messages of one rollout so far."""

    def __init__(self, start: Any, source: Path) -> None:
        self.start, self._source = start, source
        self._times: list[int] = []
        self.steps: list[Any] = []
        self._events: list[tuple[int, int, int, int, int]] = []
        if not 1 <= start.robots <= MAX_ROBOTS or start.height * start.width > MAX_CELLS:
            self._refuse(f"rollout {start.rollout}: {start.robots} robots on {start.height} x {start.width} cells")

    def _refuse(self, problem: str) -> None:
        raise InputError(problem, source=self._source, expected="what record wrote")

    def add(self, message: LogMessage, decoded: Any) -> bool:
        """Take a message; False if it does not follow."""
        robots = self.start.robots
        if decoded.rollout != self.start.rollout:
            return False
        if message.topic == "/rollout/step":
            if {len(decoded.cells), len(decoded.doing), len(decoded.areas)} != {robots}:
                self._refuse(f"step {decoded.step} of rollout {decoded.rollout}: not {robots} robots")
            if decoded.step != len(self.steps):
                return False
            self.steps.append(decoded)
            self._times.append(message.log_time)
        elif message.topic == "/rollout/event":
            self._events.append((decoded.step, decoded.robot, decoded.kind, decoded.area, decoded.other))
        if len(self.steps) * robots > MOST_VALUES or len(self._events) > MOST_EVENTS:
            self._refuse(f"rollout {decoded.rollout}: more than {MOST_VALUES} numbers or {MOST_EVENTS} events")
        return True

    def finish(self, end: Any) -> RecordedRollout:
        """The rollout, whose steps are all there."""
        start = self.start
        if end.outcome not in tuple(Outcome) or len(end.area_of) != start.height * start.width:
            self._refuse(f"the end of rollout {end.rollout}")
        trace = Trace(
            rollout=end.rollout,
            cells=self._of_steps("cells").astype(np.int32),
            doing=self._of_steps("doing").astype(np.int8),
            areas=self._of_steps("areas").astype(np.int32),
            events=np.array(self._events, dtype=np.int64).astype(np.int32).reshape(-1, 5),
            area_of=np.array(end.area_of, dtype=np.int32),
            outcome=Outcome(end.outcome),
        )
        figures = {name: self._of_steps(name) for name in ("visited", "survived", "alive", "unassigned")}
        times, shape = np.array(self._times, dtype=np.int64), (start.height, start.width)
        return RecordedRollout(trace, times, **figures, loop=start.loop, seed=start.seed, shape=shape,
                               accessible=start.accessible)  # fmt: skip

    def _of_steps(self, name: str) -> NDArray[np.int64]:
        return np.array([getattr(step, name) for step in self.steps], dtype=np.int64)
