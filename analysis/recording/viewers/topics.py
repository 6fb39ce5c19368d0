"""The topics of a recording with their schemas, its clock, and what all rollouts of a file share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid
from mcap_protobuf.schema import build_file_descriptor_set

from analysis.recording.discovery import Discovery, discovery_of, learned_maps
from analysis.recording.frames import AreaMap, area_maps
from analysis.recording.mcap.container import LogSchema
from analysis.recording.viewers import ros as drawn_ros
from analysis.recording.viewers import schemas
from planner.luck_names import LuckName
from planner.mrac.reference import ReferenceLoop
from planner.mrac.takeover import ready_loop
from planner.plans.plan import Area, Plan
from planner.trace import Trace
from planner.worlds.world import World

GAP_SECONDS = 3.0
"""Between rollouts that follow each other in one file."""
OWN = {
    "/rollout/start": schemas.Start,
    "/rollout/step": schemas.Step,
    "/rollout/event": schemas.Event,
    "/rollout/end": schemas.End,
    "/outcomes": schemas.Outcomes,
    "/stats": schemas.Stats,
}
"""The project's own messages."""
DATA_TOPICS = ("/rollout/start", "/rollout/step", "/rollout/event", "/rollout/end")


def protobuf(message: Any) -> LogSchema:
    """The schema of a protobuf message type."""
    described = build_file_descriptor_set(message).SerializeToString(deterministic=True)
    return LogSchema(message.DESCRIPTOR.full_name, "protobuf", described, "protobuf")


@cache
def topic_types() -> dict[str, LogSchema]:
    """The schema of every topic; the topics of single robots are under `/robots/*/`."""
    messages = OWN | {
        "/map/threat": Grid,
        "/map/obstacles": Grid,
        "/map/visited": Grid,
        "/map/truth": Grid,
        "/map/fog": Grid,
        "/areas": Grid,
        "/areas_voxels": VoxelGrid,
        "/robots/*/voxel": VoxelGrid,
        "/movers/markers": SceneUpdate,
        "/movers/points": PointCloud,
        "/plans": SceneUpdate,
        "/driven": SceneUpdate,
        "/robots/markers": SceneUpdate,
        "/robots/points": PointCloud,
        "/robots/poses": PosesInFrame,
        "/tf": FrameTransforms,
        "/events": Log,
    }
    return {topic: protobuf(message) for topic, message in messages.items()} | {
        "/map/threat_occ": drawn_ros.OCCUPANCY_GRID,
        "/coverage": drawn_ros.ARRAY,
        "/robots/*/plan": drawn_ros.PATH,
        "/robots/*/driven": drawn_ros.PATH,
    }


def type_of(topic: str) -> LogSchema:
    """The schema of a topic. Raises KeyError for one that no recording has."""
    parts = topic.split("/")
    if len(parts) == 4 and parts[1] == "robots":
        parts[2] = "*"
    return topic_types()["/".join(parts)]


class Message(NamedTuple):
    """A message: topic, log time in nanoseconds, encoded data."""

    topic: str
    time: int
    data: bytes


@dataclass(frozen=True)
class Clock:
    """Steps as times: step t of a rollout is at `start + t * step_seconds`. start: nanoseconds."""

    start: int
    step_seconds: float

    def at(self, step: int) -> int:
        """Nanoseconds."""
        return self.start + round(step * self.step_seconds * 1e9)

    def after(self, last_step: int) -> Clock:
        """The clock of the rollout that follows one of this length."""
        return Clock(self.at(last_step) + round(GAP_SECONDS * 1e9), self.step_seconds)


@dataclass(frozen=True, eq=False)
class Stage:
    """What all rollouts of a file share.

    Attributes:
        loop: "closed" or "open". seed: of the rollouts. first_only, luck: as of `Request`.
        areas: those at t = 0.
    """

    world: World
    plan: Plan
    loop: str
    seed: int
    first_only: bool = False
    luck: LuckName = "tolerance"

    @cached_property
    def areas(self) -> tuple[Area, ...]:
        """Areas at t = 0: in the open loop those that the nominal run makes are there from the start."""
        if self.loop == "closed":
            return ready_loop(self.plan, self.world)[1]
        return self.plan.areas + self.plan.areas_added

    def area_maps(self, trace: Trace) -> Iterator[AreaMap]:
        """Who holds what, at the end of step 0 and of every later step that changes it; nothing without areas."""
        if self.rearranges:
            loop = ReferenceLoop(self.plan, self.world, first_only=self.first_only, luck=self.luck)
            return learned_maps(loop.teams(self.seed, trace.rollout))
        return area_maps(trace, self.areas, self.plan.state) if self.areas else iter(())

    @property
    def rearranges(self) -> bool:
        """Whether robots may make other areas of what they come to know of the map."""
        return self.loop == "closed" and ready_loop(self.plan, self.world)[0].learns

    def discovery(self, trace: Trace) -> Discovery | None:
        """What robots come to know of the map in a rollout; None where they learn nothing."""
        return discovery_of(self.world, self.seed, trace) if self.learns else None

    @property
    def learns(self) -> bool:
        """Whether robots are not told the map, and look; on a path that is given, to the end, nobody learns."""
        known = self.world.knowledge
        return self.loop == "closed" and known is not None and known.sense.range > 0
