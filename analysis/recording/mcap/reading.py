"""MCAP logs read with checks: a whole file or a clear error, in bounded memory, whatever the file claims."""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

from mcap import records
from mcap.opcode import Opcode

from analysis.recording.mcap import wire
from analysis.recording.mcap.container import PARTIAL, RECOVERED
from analysis.recording.mcap.descriptions import MAX_DESCRIPTIONS, Descriptions, LogMessage
from analysis.recording.mcap.wire import Attached, Damaged
from planner.errors import InputError

MAX_EXTRAS = 10_000
"""Most attachments, and most metadata records, that a log may have."""


class Log:
    """An open log, checked from end to end but for the insides of its chunks, which are checked as they are read.

    Attributes:
        path: the file.
        library: what wrote it.
        summary: the statistics record, or None where the file has none.
        channels, schemas: by id, as the summary lists them.
        attachments: in the file's order.
        metadata: (name, items) in the file's order, without checksums.
        partial: why it is not the whole log ("" when it is).
    """

    def __init__(self, path: Path, data: memoryview) -> None:
        self.path, self._data = path, data
        self.library = ""
        self.summary: records.Statistics | None = None
        self._described = Descriptions()
        self.attachments: list[Attached] = []
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self._data_end, self._metadata_bytes = len(data), 0
        self._read_outline()

    @property
    def channels(self) -> dict[int, records.Channel]:
        return self._described.channels

    @property
    def schemas(self) -> dict[int, records.Schema]:
        return self._described.schemas

    @property
    def partial(self) -> str:
        reasons = [items.get("reason", "cut short") for name, items in self.metadata if name in (PARTIAL, RECOVERED)]
        return "; ".join(reasons)

    def attachment(self, name: str) -> bytes:
        """The first attachment of that name. Raises InputError when there is none."""
        for attached in self.attachments:
            if attached.name == name:
                return attached.data
        raise InputError(f"has no attachment {name!r}", source=self.path)

    def messages(
        self, topics: Collection[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[LogMessage]:
        """The messages in the file's order, which in our own logs is that of their log times.

        Args:
            topics: only these; None for all.
            start, end: only log times in `[start, end)`, nanoseconds; None for no limit.

        Raises:
            InputError: at the first chunk that is damaged.
        """
        described = Descriptions()
        described.schemas, described.channels = dict(self.schemas), dict(self.channels)
        try:
            for opcode, body in self._inner_records(start, end):
                if opcode != Opcode.MESSAGE:
                    described.add(opcode, body)
                    continue
                message = described.resolve(wire.message(body))
                if (
                    (topics is None or message.topic in topics)
                    and (start is None or message.log_time >= start)
                    and (end is None or message.log_time < end)
                ):
                    yield message
        except Damaged as error:
            raise refusal(self.path, str(error)) from error

    def _inner_records(self, start: int | None, end: int | None) -> Iterator[tuple[int, memoryview]]:
        """Schemas, channels and messages, in chunks and outside; chunks out of the time range are passed over."""
        for _, opcode, body in wire.records_in(self._data[len(wire.MAGIC) : self._data_end]):
            if opcode != Opcode.CHUNK:
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    yield opcode, body
                continue
            head = wire.chunk_head(cursor := wire.Cursor(body))
            if (start is not None and head.end < start) or (end is not None and head.start >= end):
                continue
            for _, inner, inner_body in wire.records_in(memoryview(wire.chunk_data(head, cursor))):
                yield inner, inner_body

    def _read_outline(self) -> None:
        """Magic, footer, summary, and the data section record by record, with the checksums of both sections."""
        size = len(self._data)
        if bytes(self._data[: len(wire.MAGIC)]) != wire.MAGIC:
            raise InputError("is not an MCAP file", source=self.path, expected="a log that `mrac-jax record` wrote")
        footer = wire.footer(self._data)
        footer_at = size - wire.FOOTER_SIZE
        summary_at = footer.summary_start or footer_at
        if not len(wire.MAGIC) <= summary_at <= footer_at:
            raise Damaged("the footer points outside the file")
        summary = self._data[summary_at:footer_at]
        if footer.summary_crc not in (0, zlib.crc32(self._data[summary_at : size - wire.AFTER_SUMMARY_CRC])):
            raise Damaged("the summary has a wrong checksum")
        for _, opcode, body in wire.records_in(summary):
            self._described.add(opcode, body)
            if opcode == Opcode.STATISTICS:
                self.summary = wire.statistics(body)
        self._read_data_section(summary_at)

    def _read_data_section(self, end: int) -> None:
        first = len(wire.MAGIC)
        finished = False
        for at, opcode, body in wire.records_in(self._data[first:end]):
            if finished or (at == 0) != (opcode == Opcode.HEADER):
                raise Damaged("its records are out of order")
            if opcode == Opcode.HEADER:
                self.library = wire.header(body).library
            elif opcode == Opcode.ATTACHMENT:
                self.attachments.append(wire.attachment(body))
            elif opcode == Opcode.METADATA:
                self._add_metadata(body)
            elif opcode == Opcode.DATA_END:
                finished, self._data_end = True, first + at
                checksum = wire.Cursor(body).number(4)
                if checksum not in (0, zlib.crc32(self._data[: self._data_end])):
                    raise Damaged("its data have a wrong checksum")
            if max(len(self.attachments), len(self.metadata)) > MAX_EXTRAS:
                raise Damaged(f"more than {MAX_EXTRAS} attachments or metadata records")
        if not finished:
            raise Damaged("its data section has no end")

    def _add_metadata(self, body: memoryview) -> None:
        self._metadata_bytes += len(body)
        if self._metadata_bytes > MAX_DESCRIPTIONS:
            raise Damaged(f"more than {MAX_DESCRIPTIONS} bytes of metadata")
        record = wire.metadata(body)
        record.metadata.pop(wire.CHECK, None)
        self.metadata.append((record.name, record.metadata))


def open_log(path: str | Path) -> Log:
    """Open an MCAP log and check it: sections' checksums, every record's length, attachments and metadata.

    Raises:
        InputError: no such file, not an MCAP file, or one that is truncated or damaged (then it names `recover`).
    """
    path = Path(path)
    data = mapped(path)
    try:
        return Log(path, data)
    except Damaged as error:
        raise refusal(path, str(error)) from error


def mapped(path: Path) -> memoryview:
    """The file's bytes, read only as they are used. Raises InputError where it is not a plain file or is empty."""
    try:
        if not path.is_file():
            problem = "is not a plain file" if path.exists() else "does not exist"
            raise InputError(problem, source=path, expected="an MCAP file")
        with path.open("rb") as stream:
            if not path.stat().st_size:
                raise InputError("is empty", source=path, expected="an MCAP file")
            return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({error})", source=path, expected="an MCAP file") from error


def refusal(path: Path, problem: str) -> InputError:
    """What a reader says of a log that is cut or damaged."""
    return InputError(f"truncated or damaged: {problem}", source=path, fix=f"try `mrac-jax recover {path}`")
