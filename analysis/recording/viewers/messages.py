"""Every message of one rollout, in order: the exact data topics, and what viewers draw.

The messages depend on world, plan, trace and clock alone, so that a replay compares them byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log

from analysis.recording.events import END_LEVELS, end_text, event_line
from analysis.recording.frames import Frames, area_maps, make_frames
from analysis.recording.viewers import ros as drawn_ros
from analysis.recording.viewers import schemas
from analysis.recording.viewers.map import MapDrawer
from analysis.recording.viewers.robots import DRIVEN_HEIGHT, PLANNED_HEIGHT, PathLines, RobotDrawer
from analysis.recording.viewers.topics import Clock, Message, Stage
from planner.trace import Doing, Trace

DRIVEN_LOOKS, DRIVEN_PATHS = 40, 4
"""How often the paths driven so far are written in a rollout, each time in full, so that a viewer can jump: as lines,
and as nav_msgs/Path."""
MOST_PATHS = 64
"""Robots that have nav_msgs/Path topics of their own."""
WORDS = {int(doing): doing.name.lower() for doing in Doing}
MOST_WORDS = 16
"""Robots of which `/stats` says in words what they are doing."""
GRID_BYTES = 2**26
"""Grids of visits that a rollout may take, in bytes before compression; beyond, they are written at fewer steps."""


def rollout_messages(stage: Stage, trace: Trace, clock: Clock) -> Iterator[Message]:
    """Everything that is recorded of one rollout, in order of time."""
    return RolloutDrawer(stage, trace, clock).messages()


class RolloutDrawer:
    """Makes the messages of one rollout."""

    def __init__(self, stage: Stage, trace: Trace, clock: Clock) -> None:
        self.stage, self.trace, self.clock = stage, trace, clock
        world = stage.world
        accessible = world.accessible(stage.plan.starts)
        self.accessible = int(accessible.sum())
        self.frames: Frames = make_frames(trace, stage.areas, stage.plan.state)
        self.map = MapDrawer(world, accessible)
        self.robots = RobotDrawer(world, trace.cells, self.frames.alive)
        self.driven = PathLines(world, trace.cells.shape[1], "driven", DRIVEN_HEIGHT, 1.0, 2.0)
        self.cuts = self.frames.events_by_step()
        steps, size = trace.time + 1, 9 * world.threat.size
        self.every = -(-steps * size // GRID_BYTES)
        self.driven_every, self.paths_every = (-(-steps // looks) for looks in (DRIVEN_LOOKS, DRIVEN_PATHS))

    def messages(self) -> Iterator[Message]:
        """Everything, in order of time."""
        yield from self._begin()
        changes = area_maps(self.trace, self.stage.areas, self.stage.plan.state) if self.stage.areas else iter(())
        change = next(changes, None)
        for step in range(self.trace.time + 1):
            time = self.clock.at(step)
            yield from self._data(time, step)
            if change is not None and change.step == step:
                self.map.hold(change)
                change = next(changes, None)
            yield from self._map(time, step)
            yield from self._drawn(time, step)
        yield from self._end()

    def _begin(self) -> Iterator[Message]:
        stage, trace, time = self.stage, self.trace, self.clock.at(0)
        start = schemas.Start(
            rollout=trace.rollout,
            robots=trace.cells.shape[1],
            cells=trace.cells[0].tolist(),
            height=stage.world.shape[0],
            width=stage.world.shape[1],
            accessible=self.accessible,
            loop=stage.loop,
            seed=stage.seed,
            step_seconds=self.clock.step_seconds,
        )
        if stage.plan.state is not None:  # in the colour of one more robot: who did it is not known
            before = stage.plan.state.visited.astype(np.int32)
            self.map.first_visit(before, np.full_like(before, trace.cells.shape[1]))
        yield Message("/rollout/start", time, start.SerializeToString())
        yield Message("/map/threat", time, self.map.threat(time))
        yield Message("/map/threat_occ", time, self.map.threat_occupancy(time))
        yield Message("/map/obstacles", time, self.map.obstacles(time))
        paths = [robot.path for robot in stage.plan.robots]
        lines = PathLines(stage.world, len(paths), "plan", PLANNED_HEIGHT, 0.5, 1.0)
        yield Message("/plans", time, lines.message(time, paths))
        for number, path in enumerate(paths[:MOST_PATHS]):
            drawer = RobotDrawer(stage.world, path[:, None].astype(np.int32), np.ones((len(path), 1), dtype=np.bool_))
            stamps = np.array([self.clock.at(step) for step in range(len(path))], dtype=np.int64)
            data = drawn_ros.path(time, stamps, drawer.xy[:, 0], drawer.yaw[:, 0])
            yield Message(f"/robots/{number}/plan", time, data)

    def _data(self, time: int, step: int) -> Iterator[Message]:
        """The exact topics of one step, and the events in words."""
        trace, frames = self.trace, self.frames
        state = schemas.Step(
            rollout=trace.rollout,
            step=step,
            cells=trace.cells[step].tolist(),
            doing=trace.doing[step].tolist(),
            areas=trace.areas[step].tolist(),
            visited=int(frames.visited[step]),
            survived=int(frames.survived[step]),
            alive=int(frames.alive_count[step]),
            unassigned=int(frames.unassigned[step]),
        )
        yield Message("/rollout/step", time, state.SerializeToString())
        for row in trace.events[self.cuts[step] : self.cuts[step + 1]]:
            _, robot, kind, area, other = row.tolist()
            event = schemas.Event(
                rollout=trace.rollout,
                step=step,
                robot=robot,
                kind=kind,
                area=area,
                other=other,
            )
            yield Message("/rollout/event", time, event.SerializeToString())
            line = event_line(row, self.stage.world)
            yield Message("/events", time, self._log(time, line.level, f"robot {robot}", line.text))

    def _map(self, time: int, step: int) -> Iterator[Message]:
        """Grids of what is visited, and by whom."""
        trace, frames = self.trace, self.frames
        entered = trace.cells[step][frames.moved[step]]
        new = np.unique(entered[frames.visited_at[entered] == step])
        self.map.enter(entered)
        self.map.first_visit(new, frames.visited_by[new])
        if self._looks(step, self.every):
            yield Message("/map/visited", time, self.map.visited(time))
            if self.stage.areas and self.map.changed:
                yield Message("/areas", time, self.map.areas(time))
                yield Message("/areas_voxels", time, self.map.areas_voxels(time))
                self.map.changed = False

    def _drawn(self, time: int, step: int) -> Iterator[Message]:
        """Robots and figures."""
        trace, frames = self.trace, self.frames
        yield Message("/tf", time, self.robots.transforms(time, step))
        yield Message("/robots/poses", time, self.robots.poses(time, step))
        yield Message("/robots/points", time, self.robots.points(time, step))
        yield Message("/robots/markers", time, self.robots.markers(time, step))
        changed = np.ones(len(trace.cells[0]), dtype=np.bool_)
        if step > 0:
            changed = (trace.cells[step] != trace.cells[step - 1]) | (frames.alive[step] != frames.alive[step - 1])
        for robot in np.flatnonzero(changed[:MOST_PATHS]).tolist():
            yield Message(f"/robots/{robot}/voxel", time, self.robots.voxel(time, step, robot))
        if self._looks(step, self.driven_every):
            yield Message("/driven", time, self.driven.message(time, list(trace.cells[: step + 1].T.astype(np.int64))))
        if self._looks(step, self.paths_every):
            yield from self._paths(time, step)
        covered = (frames.visited[step] / self.accessible, frames.survived[step] / self.accessible)
        stats = schemas.Stats(
            rollout=trace.rollout,
            step=step,
            coverage_visited=covered[0],
            coverage_survived=covered[1],
            alive=float(frames.alive_count[step]),
            unassigned_areas=float(frames.unassigned[step]),
            doing=[WORDS[doing] for doing in trace.doing[step, :MOST_WORDS].tolist()],
        )
        yield Message("/coverage", time, drawn_ros.array(*covered))
        yield Message("/stats", time, stats.SerializeToString())

    def _looks(self, step: int, every: int) -> bool:
        return step % every == 0 or step == self.trace.time

    def _paths(self, time: int, step: int) -> Iterator[Message]:
        """The path that each robot has driven."""
        stamps = np.array([self.clock.at(past) for past in range(step + 1)], dtype=np.int64)
        for robot in range(min(self.trace.cells.shape[1], MOST_PATHS)):
            entered = np.flatnonzero(self.frames.moved[: step + 1, robot])
            data = drawn_ros.path(
                time, stamps[entered], self.robots.xy[entered, robot], self.robots.yaw[entered, robot]
            )
            yield Message(f"/robots/{robot}/driven", time, data)

    def _end(self) -> Iterator[Message]:
        trace, frames, time = self.trace, self.frames, self.clock.at(self.trace.time)
        visited, survived, alive = int(frames.visited[-1]), int(frames.survived[-1]), int(frames.alive_count[-1])
        text = end_text(trace, visited, survived, self.accessible, alive)
        yield Message("/events", time, self._log(time, END_LEVELS.get(trace.outcome, Log.ERROR), "rollout", text))
        end = schemas.End(
            rollout=trace.rollout,
            outcome=int(trace.outcome),
            time=trace.time,
            visited=visited,
            survived=survived,
            alive=alive,
            area_of=trace.area_of.tolist(),
        )
        yield Message("/rollout/end", time, end.SerializeToString())

    def _log(self, time: int, level: int, name: str, text: str) -> bytes:
        log = Log(level=level, message=text, name=name)  # type: ignore[arg-type]
        log.timestamp.FromNanoseconds(time)
        data: bytes = log.SerializeToString()
        return data
