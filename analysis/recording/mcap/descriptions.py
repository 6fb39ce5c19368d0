"""Messages of a log with what describes them: their channel and its schema."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass

from mcap import records
from mcap.opcode import Opcode

from analysis.recording.mcap import wire
from analysis.recording.mcap.wire import Damaged

MAX_DESCRIPTIONS = 2**24
"""Most bytes of schemas and channels, and of metadata, that are kept of one log."""


@dataclass(frozen=True)
class LogMessage:
    """One message: times in nanoseconds, `data` as encoded by its channel's schema (None: no schema)."""

    channel: records.Channel
    schema: records.Schema | None
    log_time: int
    publish_time: int
    sequence: int
    data: bytes

    @property
    def topic(self) -> str:
        return self.channel.topic


class Descriptions:
    """The schemas and channels seen so far, by id; the same id twice must say the same."""

    def __init__(self) -> None:
        self.schemas: dict[int, records.Schema] = {}
        self.channels: dict[int, records.Channel] = {}
        self._held = 0

    def copy(self) -> Descriptions:
        """The same, to be added to."""
        other = copy(self)
        other.schemas, other.channels = dict(self.schemas), dict(self.channels)
        return other

    def add(self, opcode: int, body: memoryview) -> None:
        """Take a record if it is a schema or a channel. Raises Damaged if it contradicts an earlier one."""
        kinds = {Opcode.SCHEMA: (records.Schema, self.schemas), Opcode.CHANNEL: (records.Channel, self.channels)}
        if opcode not in kinds:
            return
        kind, known = kinds[opcode]
        new = wire.parsed(kind, body)
        if opcode == Opcode.SCHEMA and new.id == 0:
            raise Damaged("a schema with id 0")
        if new.id not in known:
            self._held += len(body)
            if self._held > MAX_DESCRIPTIONS:
                raise Damaged(f"more than {MAX_DESCRIPTIONS} bytes of schemas and channels")
        if known.setdefault(new.id, new) != new:
            raise Damaged(f"{kind.__name__.lower()} {new.id} is described twice, differently")

    def messages(self, found: Iterable[tuple[int, int, memoryview]]) -> Iterator[LogMessage]:
        """The messages of `records_in` some bytes. Raises Damaged where nothing there or before describes one."""
        for _, opcode, body in found:
            if opcode != Opcode.MESSAGE:
                self.add(opcode, body)
                continue
            message = wire.message(body)
            channel = self.channels.get(message.channel_id)
            if channel is None:
                raise Damaged(f"a message of channel {message.channel_id}, which nothing describes")
            schema = self.schemas.get(channel.schema_id)
            if schema is None and channel.schema_id:
                raise Damaged(f"channel {channel.id} has schema {channel.schema_id}, which nothing describes")
            yield LogMessage(channel, schema, message.log_time, message.publish_time, message.sequence, message.data)
