"""MCAP logs read with checks: a whole file or a clear error, in bounded memory, whatever the file claims."""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap import records
from mcap.opcode import Opcode

from analysis.recording.mcap.container import PARTIAL, RECOVERED
from planner import mcap as wire
from planner.errors import InputError
from planner.mcap import MAX_DESCRIPTIONS, Damaged, Descriptions, LogMessage

MAX_EXTRAS = 10_000
"""Most attachments, and most metadata records, that a log may have."""


@dataclass(frozen=True)
class Summary:
    """The end of a log: where it begins, whether it has a checksum, the counts, schemas and channels."""

    start: int
    checked: bool
    statistics: records.Statistics | None
    described: Descriptions


def read_summary(data: memoryview) -> Summary:
    """The summary of a whole file, its checksum looked at. Raises Damaged."""
    end, size = data[-wire.FOOTER_SIZE :], len(data)
    if len(end) < wire.FOOTER_SIZE or end[-len(wire.MAGIC) :] != wire.MAGIC:
        raise Damaged("the end is missing")
    if wire.HEAD.unpack_from(end) != (Opcode.FOOTER, 20):
        raise Damaged("the footer is not where it should be")
    footer = wire.parsed(records.Footer, end[wire.HEAD.size : -len(wire.MAGIC)])
    start = footer.summary_start or size - wire.FOOTER_SIZE
    if not len(wire.MAGIC) <= start <= size - wire.FOOTER_SIZE:
        raise Damaged("the footer points outside the file")
    if footer.summary_crc not in (0, zlib.crc32(data[start : size - wire.AFTER_SUMMARY_CRC])):
        raise Damaged("the summary has a wrong checksum")
    statistics, described = None, Descriptions()
    for _, opcode, body in wire.records_in(data[start : size - wire.FOOTER_SIZE]):
        described.add(opcode, body)
        if opcode == Opcode.STATISTICS:
            statistics = wire.parsed(records.Statistics, body)
    return Summary(start, footer.summary_crc != 0, statistics, described)


class Log:
    """An open log, checked from end to end but for the insides of its chunks, which are checked as they are read.

    Attributes:
        path: the file.
        library: what wrote it.
        channels, schemas: by id, as the summary lists them.
        attachments: in the file's order.
        metadata: (name, items) in the file's order, without checksums.
        partial: why it is not the whole log ("" when it is).
    """

    def __init__(self, path: Path, data: memoryview) -> None:
        self.path, self._data, self.library = path, data, ""
        self.attachments: list[records.Attachment] = []
        self.metadata: list[tuple[str, dict[str, str]]] = []
        if data[: len(wire.MAGIC)] != wire.MAGIC:
            raise InputError("is not an MCAP file", source=path, expected="a log that `mrac-jax record` wrote")
        summary = read_summary(data)
        self._described, self._data_end = summary.described, summary.start
        self.channels, self.schemas = summary.described.channels, summary.described.schemas
        self._read_data_section()
        reasons = [items.get("reason", "cut short") for name, items in self.metadata if name in (PARTIAL, RECOVERED)]
        self.partial = "; ".join(reasons)

    def attachment(self, name: str) -> bytes:
        """The first attachment of that name. Raises InputError when there is none."""
        for attached in self.attachments:
            if attached.name == name:
                return attached.data
        raise InputError(f"has no attachment {name!r}", source=self.path)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """The messages in the file's order, which in our own logs is that of their log times.

        `topics`: only these; None for all. Raises InputError at the first chunk that is damaged.
        """
        try:
            section = self._data[len(wire.MAGIC) : self._data_end]
            for message in self._described.copy().messages(wire.all_records(section)):
                if topics is None or message.topic in topics:
                    yield message
        except Damaged as error:
            raise refusal(self.path, str(error)) from error

    def _read_data_section(self) -> None:
        """Every record's length, attachments and metadata, and the checksum of all of it."""
        finished, metadata_bytes, first = False, 0, len(wire.MAGIC)
        for at, opcode, body in wire.records_in(self._data[first : self._data_end]):
            if finished or (at == 0) != (opcode == Opcode.HEADER):
                raise Damaged("its records are out of order")
            if opcode == Opcode.HEADER:
                self.library = wire.parsed(records.Header, body).library
            elif opcode == Opcode.ATTACHMENT:
                self.attachments.append(wire.attachment(body))
            elif opcode == Opcode.METADATA:
                metadata_bytes += len(body)
                record = wire.metadata(body)
                record.metadata.pop(wire.CHECK, None)
                self.metadata.append((record.name, record.metadata))
            elif opcode == Opcode.DATA_END:
                finished, self._data_end = True, first + at
                checksum = wire.parsed(records.DataEnd, body).data_section_crc
                if checksum not in (0, zlib.crc32(self._data[: self._data_end])):
                    raise Damaged("its data have a wrong checksum")
            if max(len(self.attachments), len(self.metadata)) > MAX_EXTRAS or metadata_bytes > MAX_DESCRIPTIONS:
                raise Damaged(f"more than {MAX_EXTRAS} attachments or {MAX_DESCRIPTIONS} bytes of metadata")
        if not finished:
            raise Damaged("its data section has no end")


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
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({error})", source=path, expected="an MCAP file") from error


def refusal(path: Path, problem: str) -> InputError:
    """What a reader says of a log that is cut or damaged."""
    return InputError(f"truncated or damaged: {problem}", source=path, fix=f"try `mrac-jax recover {path}`")
