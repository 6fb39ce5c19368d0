"""Every message of one rollout, in order: the exact data topics, and what viewers draw.

The messages depend on world, plan, trace and clock alone, so that a replay compares them byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log

from analysis.recording.discovery import Discovery
from analysis.recording.events import ENDS_WITH_ERROR, end_text, event_line
from analysis.recording.frames import Frames, make_frames
from analysis.recording.viewers import ros as drawn_ros
from analysis.recording.viewers import schemas
from analysis.recording.viewers.map import MapDrawer
from analysis.recording.viewers.movers import MoverDrawer
from analysis.recording.viewers.robots import DRIVEN_HEIGHT, PLANNED_HEIGHT, PathLines, RobotDrawer
from analysis.recording.viewers.topics import Clock, Message, Stage
from planner.none import NO_STEP
from planner.plans.waypoints import headings
from planner.roaming import ways_of_movers
from planner.trace import Doing, Trace

DRIVEN_LOOKS, DRIVEN_PATHS = 40, 4
"""How often the paths driven so far are written in a rollout, each time in full, so that a viewer can jump: as lines,
and as nav_msgs/Path."""
MOST_PATHS = 64
"""Robots that have nav_msgs/Path topics of their own."""
MOST_WORDS = 16
"""Robots of which `/stats` says in words what they are doing."""
GRID_BYTES = 2**26
"""Grids of visits that a rollout may take, in bytes before compression; beyond, they are written at fewer steps."""


Said = Iterator[tuple[str, Any]]
"""Topics with what is said on them at one time: a protobuf message, or the bytes of another."""


def rollout_messages(stage: Stage, trace: Trace, clock: Clock) -> Iterator[Message]:
    """Everything that is recorded of one rollout, in order of time."""
    drawer = RolloutDrawer(stage, trace, clock)
    for step in range(trace.time + 1):
        time = clock.at(step)
        for topic, said in drawer.said(time, step):
            yield Message(topic, time, said if isinstance(said, bytes) else said.SerializeToString())


class RolloutDrawer:
    """Makes the messages of one rollout."""

    def __init__(self, stage: Stage, trace: Trace, clock: Clock) -> None:
        self.stage, self.trace = stage, trace
        world, state = stage.world, stage.plan.state
        accessible = world.accessible(stage.plan.starts)
        self.accessible = int(accessible.sum())
        self.frames: Frames = make_frames(trace, state)
        self.map = MapDrawer(world, accessible)
        self.robots = RobotDrawer(world, trace.cells, self.frames.alive)
        self.movers = MoverDrawer(world, ways_of_movers(world, stage.seed, trace.rollout, trace.time + 1))
        self.driven = PathLines(world, trace.cells.shape[1], "driven", DRIVEN_HEIGHT, 1.0, 2.0)
        self.cuts = self.frames.events_by_step()
        self.areas, self.open_areas = stage.area_maps(trace), 0
        self.next_areas = next(self.areas, None)
        self.discovery, self.shown = stage.discovery(trace), NO_STEP
        length = max(trace.time + 1, *(len(robot.path) for robot in stage.plan.robots))
        self.stamps = np.array([clock.at(step) for step in range(length)], dtype=np.int64)
        self.step_seconds = clock.step_seconds
        steps, size = trace.time + 1, (9 if self.discovery is None else 26) * world.threat.size
        self.every = -(-steps * size // GRID_BYTES)
        self.driven_every, self.paths_every = (-(-steps // looks) for looks in (DRIVEN_LOOKS, DRIVEN_PATHS))

    def said(self, time: int, step: int) -> Said:
        """Everything of one step; steps come one after the other."""
        if step == 0:
            yield from self._begin(time)
        if self.next_areas is not None and self.next_areas.step == step:
            self.map.hold(self.next_areas)
            self.open_areas = self.next_areas.open
            self.next_areas = next(self.areas, None)
        phases = self.stage.world.phases
        if phases is not None and (phases.begins[1:] == step).any():
            self.map.change(phases.threats[phases.number_at(step)])
            yield from self._known(time)
        yield from self._data(time, step)
        if self.discovery is not None and self._looks(step, self.every):
            yield from self._discovered(self.discovery, time, step)
        yield from self._map(time, step)
        yield from self._drawn(time, step)
        if step == self.trace.time:
            yield from self._end(time)

    def _begin(self, time: int) -> Said:
        stage, trace = self.stage, self.trace
        if stage.plan.state is not None:  # in the colour of one more robot: who did it is not known
            before = stage.plan.state.visited.astype(np.int32)
            self.map.first_visit(before, np.full_like(before, trace.cells.shape[1]))
        height, width = stage.world.shape
        start = schemas.Start(rollout=trace.rollout, robots=trace.cells.shape[1], cells=trace.cells[0].tolist())
        start.height, start.width, start.accessible = height, width, self.accessible
        start.loop, start.seed, start.step_seconds = stage.loop, stage.seed, self.step_seconds
        yield "/rollout/start", start
        if self.discovery is None:
            yield from self._known(time)
        else:
            yield "/map/truth", self.map.truth(time, self.discovery.truth)
        paths = [robot.path for robot in stage.plan.robots]
        lines = PathLines(stage.world, len(paths), "plan", PLANNED_HEIGHT, 0.5, 1.0)
        yield "/plans", lines.message(time, paths)
        for number, path in enumerate(paths[:MOST_PATHS]):
            xy, yaw = stage.world.to_xy(path.astype(np.int32)), headings(path.astype(np.int64), stage.world)
            yield f"/robots/{number}/plan", drawn_ros.path(time, self.stamps[: len(path)], xy, yaw)

    def _known(self, time: int) -> Said:
        """The map as robots know it."""
        yield "/map/threat", self.map.threat(time)
        yield "/map/threat_occ", self.map.threat_occupancy(time)
        yield "/map/obstacles", self.map.obstacles(time)

    def _discovered(self, discovery: Discovery, time: int, step: int) -> Said:
        """The map as it is believed, and what nobody has seen yet, where that is not as it was."""
        if step == 0 or ((discovery.when > self.shown) & (discovery.when <= step)).any():
            self.map.believe(discovery.believed(step), discovery.seen(step))
            yield from self._known(time)
            yield "/map/fog", self.map.fog(time, discovery.when)
            self.shown = step

    def _data(self, time: int, step: int) -> Said:
        """The exact topics of one step, and the events in words."""
        trace, frames = self.trace, self.frames
        state = schemas.Step(rollout=trace.rollout, step=step, cells=trace.cells[step].tolist())
        state.doing.extend(trace.doing[step].tolist())
        state.areas.extend(trace.areas[step].tolist())
        state.visited, state.survived = int(frames.visited[step]), int(frames.survived[step])
        state.alive, state.unassigned = int(frames.alive_count[step]), self.open_areas
        yield "/rollout/step", state
        for row in trace.events[self.cuts[step] : self.cuts[step + 1]]:
            _, robot, kind, area, other = row.tolist()
            event = schemas.Event(rollout=trace.rollout, step=step, robot=robot, kind=kind, area=area, other=other)
            yield "/rollout/event", event
            line = event_line(row, self.stage.world, self.stage.plan)
            yield "/events", _log(time, line.level, f"robot {robot}", line.text)

    def _map(self, time: int, step: int) -> Said:
        """Grids of what is visited, and by whom."""
        trace, frames = self.trace, self.frames
        entered = trace.cells[step][frames.moved[step]]
        new = np.unique(entered[frames.visited_at[entered] == step])
        self.map.enter(entered)
        self.map.first_visit(new, frames.visited_by[new])
        if self._looks(step, self.every):
            yield "/map/visited", self.map.visited(time)
            if self.stage.areas and self.map.changed:
                yield "/areas", self.map.areas(time)
                yield "/areas_voxels", self.map.areas_voxels(time)
                self.map.changed = False

    def _drawn(self, time: int, step: int) -> Said:
        """Robots and figures."""
        trace, frames = self.trace, self.frames
        yield from self.robots.messages(time, step)
        yield from self.movers.messages(time, step)
        changed = np.ones(len(trace.cells[0]), dtype=np.bool_)
        if step > 0:
            changed = (trace.cells[step] != trace.cells[step - 1]) | (frames.alive[step] != frames.alive[step - 1])
        for robot in np.flatnonzero(changed[:MOST_PATHS]).tolist():
            yield f"/robots/{robot}/voxel", self.robots.voxel(time, step, robot)
        if self._looks(step, self.driven_every):
            yield "/driven", self.driven.message(time, list(trace.cells[: step + 1].T.astype(np.int64)))
        if self._looks(step, self.paths_every):
            yield from self._paths(time, step)
        covered = (frames.visited[step] / self.accessible, frames.survived[step] / self.accessible)
        yield "/coverage", drawn_ros.array(*covered)
        stats = schemas.Stats(rollout=trace.rollout, step=step, alive=float(frames.alive_count[step]))
        stats.coverage_visited, stats.coverage_survived = covered
        stats.unassigned_areas = float(self.open_areas)
        stats.doing.extend(Doing(doing).name.lower() for doing in trace.doing[step, :MOST_WORDS].tolist())
        yield "/stats", stats

    def _looks(self, step: int, every: int) -> bool:
        return step % every == 0 or step == self.trace.time

    def _paths(self, time: int, step: int) -> Said:
        """The path that each robot has driven."""
        for robot in range(min(self.trace.cells.shape[1], MOST_PATHS)):
            entered = np.flatnonzero(self.frames.moved[: step + 1, robot])
            xy, yaw = self.robots.xy[entered, robot], self.robots.yaw[entered, robot]
            yield f"/robots/{robot}/driven", drawn_ros.path(time, self.stamps[entered], xy, yaw)

    def _end(self, time: int) -> Said:
        trace, frames = self.trace, self.frames
        visited, survived, alive = int(frames.visited[-1]), int(frames.survived[-1]), int(frames.alive_count[-1])
        ended = self.stage.plan.ending(trace.outcome)
        text, level = end_text(trace, ended, visited, survived, self.accessible, alive), Log.INFO
        yield "/events", _log(time, Log.ERROR if ended in ENDS_WITH_ERROR else level, "rollout", text)
        end = schemas.End(rollout=trace.rollout, outcome=int(trace.outcome), time=trace.time, visited=visited)
        end.survived, end.alive = survived, alive
        end.area_of.extend(trace.area_of.tolist())
        yield "/rollout/end", end


def _log(time: int, level: int, name: str, text: str) -> Any:
    log = Log(level=level, message=text, name=name)  # type: ignore[arg-type]
    log.timestamp.FromNanoseconds(time)
    return log
