"""The project's own messages in a recording: those of `mrac.proto`, built at run time without a compiler."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Any

from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

_BLOCK = re.compile(r"^(enum|message) (\w+) \{(.*?)^\}", re.DOTALL | re.MULTILINE)
_VALUE = re.compile(r"^  (\w+) = (\d+);", re.MULTILINE)
_FIELD = re.compile(r"^  (repeated )?(\w+) (\w+) = (\d+);", re.MULTILINE)
"""A value of an enumeration, and a field of a message: all that the file is made of."""


def _messages() -> dict[str, Any]:
    """The class of every message."""
    text = files("analysis.recording.viewers").joinpath("mrac.proto").read_text(encoding="utf-8")
    file, names = FileDescriptorProto(name="mrac.proto", package="mrac", syntax="proto3"), list[str]()
    for kind, name, body in _BLOCK.findall(text):
        if kind == "enum":
            values = file.enum_type.add(name=name)
            for value, number in _VALUE.findall(body):
                values.value.add(name=value, number=int(number))
            continue
        names.append(name)
        message = file.message_type.add(name=name)
        for repeated, of, field, number in _FIELD.findall(body):
            added = message.field.add(name=field, number=int(number))
            added.label = FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL
            added.type = getattr(FieldDescriptorProto, f"TYPE_{of.upper()}", FieldDescriptorProto.TYPE_ENUM)
            if added.type == FieldDescriptorProto.TYPE_ENUM:
                added.type_name = f".mrac.{of}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"mrac.{name}")) for name in names}


_MESSAGES = _messages()
Start, Step, Event = _MESSAGES["Start"], _MESSAGES["Step"], _MESSAGES["Event"]
End, Stats, Outcomes = _MESSAGES["End"], _MESSAGES["Stats"], _MESSAGES["Outcomes"]
