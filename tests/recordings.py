"""Shared by the tests of recordings: small worlds with their plans, and recordings rewritten with something changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from analysis.recording.log_reader import open_log
from analysis.recording.log_writer import LogSchema, LogWriter
from analysis.recording.record import Request, record
from planner.mcap import LogMessage
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan, RobotPlan
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

SEED = 5


def small_task(robots: int = 3, shape: tuple[int, int] = (6, 9), seed: int = 2) -> tuple[World, Plan]:
    """A world that is not square, turned and moved, with robots that are often stopped."""
    made = random_world(*shape, ThreatPattern(areas=4, levels=(0.05, 0.1, 0.2), seed=seed))
    world = World.create(made.threat, cell_size=0.5, origin=(10.0, -20.0, 0.7))
    starts, _ = place_starts(world, robots)
    return world.with_starts(starts), make_plan(world, starts, Settings())


def foreign_plan(world: World, plan: Plan) -> Plan:
    """The same paths as another planner's plan."""
    robots = tuple(RobotPlan(robot.path) for robot in plan.robots)
    return Plan(world.shape, world.sha256, None, robots, outcome="end_of_paths", time=plan.makespan)


def small_recording(path: Path, **choices: Any) -> tuple[World, Plan]:
    """Rollouts 3 and 4 of `small_task` in a file."""
    world, plan = small_task()
    record(world, plan, Request(**{"ids": (3, 4), "seed": SEED} | choices), path)
    return world, plan


Change = Callable[[LogMessage], Iterator[tuple[str, int, bytes]]]
"""What becomes of a message: (topic, log time, data) of those in its place."""


def keep(message: LogMessage) -> Iterator[tuple[str, int, bytes]]:
    """Leave it as it is."""
    yield message.topic, message.log_time, bytes(message.data)


def rewrite(
    source: Path,
    target: Path,
    *,
    change: Change = keep,
    attachments: dict[str, bytes | None] | None = None,
    metadata: Callable[[dict[str, str]], dict[str, str]] = lambda items: items,
    schema: Callable[[LogSchema], LogSchema] = lambda known: known,
) -> None:
    """A valid copy of a log with something changed: `attachments` by name (None: left out), the rest by functions."""
    log, replaced = open_log(source), attachments or {}
    channels = {channel.topic: channel for channel in log.channels.values()}
    with LogWriter(target, ordered=False) as out:
        for attached in log.attachments:
            data = replaced.get(attached.name, attached.data)
            if data is not None:
                out.attach(attached.name, attached.media_type, bytes(data))
        for name, items in log.metadata:
            out.metadata(name, metadata(dict(items)))
        for message in log.messages():
            for topic, time, data in change(message):
                channel = channels.get(topic, message.channel)
                known = log.schemas[channel.schema_id]
                described = schema(LogSchema(known.name, known.encoding, bytes(known.data), channel.message_encoding))
                out.write(out.channel(topic, described), time, data)


def nth(topic: str, number: int, edit: Callable[[bytes], bytes | None]) -> Change:
    """Change message `number` of a topic: its new data, or None to leave it out."""
    seen = iter(range(10**9))

    def change(message: LogMessage) -> Iterator[tuple[str, int, bytes]]:
        if message.topic == topic and next(seen) == number:
            data = edit(bytes(message.data))
            if data is not None:
                yield topic, message.log_time, data
        else:
            yield from keep(message)

    return change


def edited(kind: Any, edit: Callable[[Any], None]) -> Callable[[bytes], bytes]:
    """An edit of a protobuf message."""

    def change(data: bytes) -> bytes:
        message = kind.FromString(data)
        edit(message)
        return bytes(message.SerializeToString())

    return change


def world_with(world: World, **changes: Any) -> World:
    """The same world with something changed."""
    facts = {
        "threat": world.threat.copy(),
        "starts": world.starts,
        "cell_size": world.cell_size,
        "origin": world.origin,
    }
    return World.create(**(facts | changes))


def positions(world: World, cells: np.ndarray) -> np.ndarray:
    """Centres of cells in metres, told plainly: float64 `[..., 2]`."""
    x, y, yaw = world.origin
    out = np.zeros((*cells.shape, 2))
    for place, cell in np.ndenumerate(cells):
        row, col = divmod(int(cell), world.shape[1])
        across, up = (col + 0.5) * world.cell_size, (world.shape[0] - row - 0.5) * world.cell_size
        out[place] = x + np.cos(yaw) * across - np.sin(yaw) * up, y + np.sin(yaw) * across + np.cos(yaw) * up
    return out
