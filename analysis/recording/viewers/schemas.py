"""The project's own messages in a recording: protobuf, described here and built at run time without a compiler.

`mrac.Start`, `mrac.Step`, `mrac.Event` and `mrac.End` hold a rollout exactly (`planner.trace.Trace`); `mrac.Stats` is
for plots; `mrac.Outcomes` holds what many rollouts came to. Axis letters: `K` robots, `N = H * W` cells, `B` rollouts.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from planner.tally import Outcome
from planner.trace import Doing, EventKind

DOUBLE, UINT64, STRING, UINT32, ENUM, SINT32 = 1, 4, 9, 13, 14, 17
"""Field types of `FieldDescriptorProto`."""
OPTIONAL, REPEATED = 1, 3
Kind = int | type[IntEnum]
Field = tuple[str, Kind, int]

FIELDS: dict[str, tuple[Field, ...]] = {
    "Start": (
        ("rollout", UINT64, OPTIONAL),
        ("robots", UINT32, OPTIONAL),
        ("cells", UINT32, REPEATED),  # [K], where each robot starts: row * width + col
        ("height", UINT32, OPTIONAL),
        ("width", UINT32, OPTIONAL),
        ("accessible", UINT32, OPTIONAL),
        ("loop", STRING, OPTIONAL),
        ("seed", UINT64, OPTIONAL),
        ("step_seconds", DOUBLE, OPTIONAL),
    ),
    "Step": (
        ("rollout", UINT64, OPTIONAL),
        ("step", UINT32, OPTIONAL),
        ("cells", UINT32, REPEATED),  # [K]
        ("doing", UINT32, REPEATED),  # [K], values of mrac.Doing
        ("areas", SINT32, REPEATED),  # [K], -1: none
        ("visited", UINT32, OPTIONAL),  # cells so far
        ("survived", UINT32, OPTIONAL),
        ("alive", UINT32, OPTIONAL),
        ("unassigned", UINT32, OPTIONAL),  # areas that nobody has
    ),
    "Event": (
        ("rollout", UINT64, OPTIONAL),
        ("step", UINT32, OPTIONAL),
        ("robot", SINT32, OPTIONAL),
        ("kind", EventKind, OPTIONAL),
        ("area", SINT32, OPTIONAL),
        ("other", SINT32, OPTIONAL),
    ),
    "End": (
        ("rollout", UINT64, OPTIONAL),
        ("outcome", Outcome, OPTIONAL),
        ("time", UINT32, OPTIONAL),
        ("visited", UINT32, OPTIONAL),
        ("survived", UINT32, OPTIONAL),
        ("alive", UINT32, OPTIONAL),
        ("area_of", SINT32, REPEATED),  # [N]
    ),
    "Stats": (
        ("rollout", UINT64, OPTIONAL),
        ("step", UINT32, OPTIONAL),
        ("coverage_visited", DOUBLE, OPTIONAL),  # fractions of the accessible cells
        ("coverage_survived", DOUBLE, OPTIONAL),
        ("alive", DOUBLE, OPTIONAL),
        ("unassigned_areas", DOUBLE, OPTIONAL),
        ("doing", STRING, REPEATED),  # of the first robots, in words
    ),
    "Outcomes": (
        ("first", UINT64, OPTIONAL),  # id of the first rollout
        ("visited", UINT32, REPEATED),  # [B]
        ("survived", UINT32, REPEATED),
        ("time", UINT32, REPEATED),
        ("alive", UINT32, REPEATED),
        ("outcome", Outcome, REPEATED),
    ),
}
"""Every message with its fields in order: name, type, OPTIONAL or REPEATED (packed). Field i has the number i + 1."""


def _build() -> dict[str, Any]:
    file = descriptor_pb2.FileDescriptorProto(name="mrac.proto", package="mrac", syntax="proto3")
    for enum in (Doing, EventKind, Outcome):
        values = file.enum_type.add(name=enum.__name__)
        for member in enum:
            values.value.add(name=member.name, number=int(member))
    for message, fields in FIELDS.items():
        described = file.message_type.add(name=message)
        for number, (name, kind, label) in enumerate(fields, start=1):
            field = described.field.add(name=name, number=number, label=label)
            if isinstance(kind, int):
                field.type = kind
            else:
                field.type, field.type_name = ENUM, f".mrac.{kind.__name__}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"mrac.{name}")) for name in FIELDS}


_MESSAGES = _build()
Start, Step, Event = _MESSAGES["Start"], _MESSAGES["Step"], _MESSAGES["Event"]
End, Stats, Outcomes = _MESSAGES["End"], _MESSAGES["Stats"], _MESSAGES["Outcomes"]
