"""A stored message against the one that a replay makes: the same, or what differs, in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from analysis.recording.events import event_line
from analysis.recording.rolling import OUTCOME_COLUMNS
from analysis.recording.rollouts import RecordedOutcomes, decode
from analysis.recording.viewers import schemas
from analysis.recording.viewers.topics import DATA_TOPICS, Message, Stage
from planner.errors import InputError
from planner.mcap import LogMessage
from planner.tally import RolloutResults

_REPEATED = ("/rollout/event", "/events")
"""Topics with several messages at one time."""


class Difference(Exception):
    """Something is not as recorded; its text says what."""


def may_be_lost(stored: LogMessage, made: Message) -> bool:
    """Whether the next message that is stored, in a log with gaps, can be a later one than this one of the replay."""
    if stored.log_time != made.time:
        return stored.log_time > made.time
    return stored.topic != made.topic or (made.topic in _REPEATED and stored.data != made.data)


def compare(stored: LogMessage, made: Message, stage: Stage, rollout: int, source: Path) -> None:
    """Raise Difference unless the stored message is the one that the replay made."""
    where = f"rollout {rollout}, {seconds_text(made.time)}"
    if (stored.topic, stored.log_time) == (made.topic, made.time) and stored.data == made.data:
        if stored.publish_time != made.time:
            raise Difference(f"{where}: {made.topic} says that it was published at {stored.publish_time} ns")
        return
    if stored.topic != made.topic:
        said, expected = _words(stored.topic, stored.data, stage), _words(made.topic, made.data, stage)
        raise Difference(f"{where}: recorded {said}; the replay has {expected}")
    if stored.log_time != made.time:
        raise Difference(f"{where}: {made.topic} is at {seconds_text(stored.log_time)}")
    if made.topic not in DATA_TOPICS:
        raise Difference(f"{where}: {made.topic} differs")
    raise Difference(f"{where}: {_fields(stored, made, stage, source)}")


def compare_outcomes(recorded: RecordedOutcomes, results: RolloutResults) -> None:
    """Raise Difference unless the recorded outcomes of these rollouts, as far as they are there, are the same."""
    stop = results.start + len(results.visited)
    there = slice(*np.searchsorted(recorded.ids, (results.start, stop)))
    ids = recorded.ids[there]
    for column in OUTCOME_COLUMNS:
        mine, theirs = getattr(results, column)[ids - results.start], getattr(recorded, column)[there]
        wrong = np.flatnonzero(mine != theirs)
        if len(wrong):
            said = f"{column} recorded {theirs[wrong[0]]}, replayed {mine[wrong[0]]}"
            raise Difference(f"/outcomes: rollout {ids[wrong[0]]}: {said}")


def _fields(stored: LogMessage, made: Message, stage: Stage, source: Path) -> str:
    """Which fields of a data message differ."""
    if made.topic == "/rollout/event":
        said, expected = _words(made.topic, stored.data, stage), _words(made.topic, made.data, stage)
        return f"recorded {said}; the replay has {expected}"
    try:
        old = decode(stored, source)
    except InputError as error:
        return error.problem
    new = type(old).FromString(made.data)
    for field in new.DESCRIPTOR.fields:
        left, right = getattr(old, field.name), getattr(new, field.name)
        if left == right:
            continue
        if not hasattr(right, "append"):
            return f"{made.topic}: {field.name} recorded {left}, replayed {right}"
        if len(left) != len(right):
            return f"{made.topic}: {field.name} has {len(left)} entries, replayed {len(right)}"
        place = next(i for i, (a, b) in enumerate(zip(left, right, strict=True)) if a != b)
        whose = "cell" if field.name == "area_of" else "robot"
        return f"{made.topic}: {field.name} of {whose} {place} recorded {left[place]}, replayed {right[place]}"
    return f"{made.topic}: encoded otherwise"


def _words(topic: str, data: bytes, stage: Stage) -> str:
    """A message in words."""
    if topic != "/rollout/event":
        return topic
    try:
        event = schemas.Event.FromString(bytes(data))
        row = np.array([event.step, event.robot, event.kind, event.area, event.other])
        return f'event "{event_line(row, stage.world, stage.plan).text}"'
    except (ValueError, IndexError, DecodeError):  # a cell off the map, a kind that is none
        return f"{topic} that means nothing"


def seconds_text(nanoseconds: int) -> str:
    """A time of the file."""
    return f"{nanoseconds / 1e9:g} s"
