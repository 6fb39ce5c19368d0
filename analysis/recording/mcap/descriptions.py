"""Messages of a log with what describes them: their channel and its schema."""

from __future__ import annotations

from dataclasses import dataclass

from mcap import records
from mcap.opcode import Opcode

from analysis.recording.mcap import wire
from analysis.recording.mcap.wire import Damaged

MAX_DESCRIPTIONS = 2**24
"""Most bytes of schemas, channels and metadata that are kept of one log."""


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
    """The schemas and channels seen so far, by id; the same id twice must say the same.

    Args:
        known: where to look for those that are not among them.
    """

    def __init__(self, known: Descriptions | None = None) -> None:
        self._known = known
        self.schemas: dict[int, records.Schema] = {}
        self.channels: dict[int, records.Channel] = {}
        self._held = 0

    def add(self, opcode: int, body: memoryview) -> None:
        """Take a record if it is a schema or a channel. Raises Damaged if it contradicts an earlier one."""
        if opcode == Opcode.SCHEMA:
            schema = wire.schema(body)
            self._check(schema, self.schemas.setdefault(schema.id, schema), len(body))
        elif opcode == Opcode.CHANNEL:
            channel = wire.channel(body)
            self._check(channel, self.channels.setdefault(channel.id, channel), len(body))

    def _check(self, new: records.Schema | records.Channel, known: object, size: int) -> None:
        if new is known:
            self._held += size
            if self._held > MAX_DESCRIPTIONS:
                raise Damaged(f"more than {MAX_DESCRIPTIONS} bytes of schemas and channels")
        elif new != known:
            raise Damaged(f"{type(new).__name__.lower()} {new.id} is described twice, differently")

    def merge(self, other: Descriptions) -> None:
        """Take what is new of another's, as long as there is room."""
        self._held += 0 if other._held > MAX_DESCRIPTIONS - self._held else self._merge(other)

    def _merge(self, other: Descriptions) -> int:
        before = len(self.schemas) + len(self.channels)
        self.schemas = {**other.schemas, **self.schemas}
        self.channels = {**other.channels, **self.channels}
        return other._held if len(self.schemas) + len(self.channels) > before else 0

    def resolve(self, message: records.Message) -> LogMessage:
        """The message with its channel and schema. Raises Damaged where they are missing."""
        known = self._known or self
        channel = self.channels.get(message.channel_id) or known.channels.get(message.channel_id)
        if channel is None:
            raise Damaged(f"a message of channel {message.channel_id}, which nothing describes")
        schema = self.schemas.get(channel.schema_id) or known.schemas.get(channel.schema_id)
        if schema is None and channel.schema_id:
            raise Damaged(f"channel {channel.id} has schema {channel.schema_id}, which nothing describes")
        return LogMessage(channel, schema, message.log_time, message.publish_time, message.sequence, message.data)
