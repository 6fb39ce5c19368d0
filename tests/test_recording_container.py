"""Logs: the same bytes for the same input, accepted by an independent reader, finished whatever happens."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import FrameType

import pytest
from mcap.reader import make_reader
from recordings import GRID, POSE, TOPICS, heard, parts_of, sample

from analysis.recording.container import PARTIAL, LogSchema, LogWriter, open_log, recover
from planner.errors import InputError, UsageError


def test_same_input_same_bytes(tmp_path: Path) -> None:
    sample(tmp_path / "a.mcap")
    sample(tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "b.mcap"]


def test_an_independent_reader_finds_everything(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    said = sample(path)
    assert heard(path) == said
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        attached = {a.name: (a.media_type, len(a.data)) for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert summary is not None and summary.statistics is not None
    statistics = summary.statistics
    parts = parts_of(path.read_bytes())
    assert statistics.message_count == len(said)
    assert statistics.chunk_count == sum(bool(part.said) for part in parts) > 3
    assert (statistics.message_start_time, statistics.message_end_time) == (said[0][1], said[-1][1])
    counts = {summary.channels[i].topic: count for i, count in statistics.channel_message_counts.items()}
    assert counts == {topic: sum(m[0] == topic for m in said) for topic in TOPICS}
    assert (statistics.attachment_count, statistics.metadata_count) == (3, 2)
    assert (statistics.schema_count, statistics.channel_count) == (2, 4)
    assert attached["tally.json"] == ("application/json", 14) and len(attached) == 3
    assert metadata["mrac-jax"]["seed"] == "7" and set(metadata) == {"mrac-jax", "end"}


def test_reading_gives_back_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    said = sample(path)
    log = open_log(path)
    assert [(m.topic, m.log_time, m.sequence, m.data) for m in log.messages()] == said
    assert log.metadata == [("mrac-jax", {"version": "1", "seed": "7"}), ("end", {"outcome": "complete"})]
    assert [attached.name for attached in log.attachments] == ["world.npz", "tally.json", "last.bin"]
    assert log.attachment("tally.json") == b'{"visited": 3}'
    assert {c.topic for c in log.channels.values()} == set(TOPICS) and log.partial == ""
    some = [m for m in said if m[0] in ("/grid", "/raw")]
    chosen = log.messages(["/grid", "/raw"])
    assert [(m.topic, m.log_time, m.sequence, m.data) for m in chosen] == some
    kinds = {m.topic: (m.schema.name, m.schema.data) if m.schema else None for m in log.messages()}
    assert kinds["/poses"] == (POSE.name, POSE.data) and kinds["/grid"] == (GRID.name, GRID.data)
    assert kinds["/raw"] is None
    with pytest.raises(InputError, match="no attachment 'x'"):
        log.attachment("x")


@pytest.mark.parametrize("chunk_size", [1, 150, 2**20])
def test_messages_are_read_in_the_order_of_their_times(tmp_path: Path, chunk_size: int) -> None:
    """Within chunks, over chunks that overlap, and of equal times as the file has them; as the mcap library reads."""
    times = [50, 10, 30, 30, 90, 20, 20, 70, 30, 60]
    with LogWriter(tmp_path / "a.mcap", chunk_size=chunk_size, ordered=False) as log:
        channel = log.channel("/poses", POSE)
        for number, time in enumerate(times):
            log.write(channel, time, bytes([number]) * 40)
    order = sorted(range(len(times)), key=lambda number: times[number])
    found = [(message.log_time, message.data[0]) for message in open_log(tmp_path / "a.mcap").messages()]
    assert found == [(times[number], number) for number in order]
    with (tmp_path / "a.mcap").open("rb") as stream:
        theirs = [message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=True)]
    assert theirs == [time for time, _ in found]


def test_messages_are_written_in_order(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="in order"), LogWriter(tmp_path / "b.mcap") as log:
        channel = log.channel("/x", POSE)
        log.write(channel, 5, b"")
        log.write(channel, 4, b"")


def test_an_empty_log_is_valid(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.channel("/never", POSE)
    assert heard(tmp_path / "a.mcap") == [] == list(open_log(tmp_path / "a.mcap").messages())


def test_a_channel_is_one_by_what_it_says(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        one = log.channel("/x", POSE, {"a": "1", "b": "2"})
        assert log.channel("/x", POSE, {"b": "2", "a": "1"}) == one
        others = {log.channel("/x", GRID), log.channel("/x", POSE), log.channel("/y", POSE)}
        assert len(others | {one}) == 4


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no such robot")])
def test_an_exception_leaves_a_valid_log_marked_partial(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(type(error)), LogWriter(path, chunk_size=200) as log:
        channel = log.channel("/x", POSE)
        for i in range(30):
            log.write(channel, i, b"%d" % i * 10)
        raise error
    assert [m[1] for m in heard(path)] == list(range(30))
    said = "interrupted" if isinstance(error, KeyboardInterrupt) else "ValueError: no such robot"
    assert open_log(path).partial == said and log.placed == path
    assert [name for name, _ in open_log(path).metadata] == [PARTIAL]
    assert not log.partial.exists()


def test_a_log_that_is_cut_short_replaces_none(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"older")
    with pytest.raises(KeyboardInterrupt), LogWriter(path) as log:
        log.write(log.channel("/x", POSE), 0, b"1")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"older" and log.placed == tmp_path / "a.interrupted.mcap"
    assert len(heard(log.placed)) == 1
    with pytest.raises(KeyboardInterrupt), LogWriter(path, discard=True):
        raise KeyboardInterrupt
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.interrupted.mcap", "a.mcap"]


def test_two_writers_of_one_name(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as first:
        with (
            pytest.raises(
                UsageError, match=r"a\.mcap\.partial is left .*`mrac-jax inspect --repair OUT .*` or remove it"
            ),
            LogWriter(path),
        ):
            pass
        first.write(first.channel("/x", POSE), 0, b"1")
    assert len(heard(path)) == 1 and not first.partial.exists()


@pytest.fixture
def nothing_is_collected() -> Iterator[None]:
    """Python swallows an interrupt that meets a callback of its collector, at what earlier tests left."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("nothing_is_collected")
def test_an_interrupt_at_any_moment_leaves_a_valid_log(tmp_path: Path) -> None:
    """Ctrl-C arrives between any two steps of the writer; whatever is in the log is a beginning of what was said."""
    lengths = set()
    for attempt in range(8):
        path = tmp_path / f"{attempt}.mcap"
        main = threading.main_thread().ident
        assert main is not None
        timer = threading.Timer(0.002 + 0.001 * attempt, signal.pthread_kill, (main, signal.SIGINT))
        with pytest.raises(KeyboardInterrupt), LogWriter(path, chunk_size=300) as log:
            timer.start()
            channel = log.channel("/x", POSE)
            for i in range(1_000_000):
                log.write(channel, i, b"%d" % i)
        said, found = heard(path), open_log(path)
        assert [m[1:] for m in said] == [(i, i, b"%d" % i) for i in range(len(said))]
        assert found.partial == "interrupted" and len(list(found.messages())) == len(said)
        lengths.add(len(said))
    assert len(lengths) > 3


def interrupted_at(line: int) -> Callable[[FrameType, str, object], object]:
    """A tracer that raises KeyboardInterrupt before the given line, counted from 0, that `_finish` and below run."""
    left = [line]

    def trace(frame: FrameType, event: str, _: object) -> object:
        if frame.f_code.co_name not in ("_finish", "flush", "_put"):
            return None
        if event == "line":
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
        return trace

    return trace


def test_an_interrupt_while_a_log_is_finished_leaves_a_whole_one(tmp_path: Path) -> None:
    for line in range(100):
        path, found = tmp_path / f"{line}.mcap", None
        try:
            with LogWriter(path, discard=True) as log:
                log.write(log.channel("/x", POSE), 7, b"1")
                before = sys.gettrace()
                sys.settrace(interrupted_at(line))
        except KeyboardInterrupt as error:
            found = error
        finally:
            sys.settrace(before)
        assert [one.name for one in tmp_path.iterdir()] == [path.name] and log.placed == path
        assert len(heard(path)) == 1 and open_log(path).partial == ""
        path.unlink()
        if found is None:
            break
    assert 30 < line < 99


WRITES_UNTIL_KILLED = """
import sys
from analysis.recording.container import LogSchema, LogWriter
with LogWriter(sys.argv[1], chunk_size=2000) as log:
    log.attach("world.npz", "x/y", b"world")
    log.metadata("mrac-jax", {"seed": "7"})
    channel, i = log.channel("/x", LogSchema("a", "jsonschema", b"{}", "json")), 0
    while True:
        log.write(channel, i, b"%d" % i)
        i += 1
        if i % 100 == 0:
            print(i, flush=True)
"""


def test_kill_9_loses_at_most_the_chunk_in_flight(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = subprocess.Popen([sys.executable, "-c", WRITES_UNTIL_KILLED, str(path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout as told:
        while int(told.readline()) < 1000:
            pass
        time.sleep(0.05)
        process.kill()
        written = [int(line) for line in told.read().split()]
    process.wait()
    partial = tmp_path / "a.mcap.partial"
    assert partial.exists() and not path.exists()
    with pytest.raises(InputError, match="inspect --repair"):
        open_log(partial)
    report = recover(partial, path)
    assert partial.exists() and report.attachments == ["world.npz"] and report.metadata == ["mrac-jax"]
    said = heard(path)
    assert [m[1:] for m in said] == [(i, i, b"%d" % i) for i in range(len(said))]
    most_in_flight = 2000 // (9 + 22 + 4)
    assert len(said) >= max(written, default=1000) - most_in_flight
    assert "the end of the file" in str(report.lost[-1]) and open_log(path).partial


def test_a_target_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"), LogWriter(tmp_path):
        pass
    with pytest.raises(InputError, match="cannot be written"), LogWriter(tmp_path / "no" / "a.mcap"):
        pass


def test_a_link_in_the_partial_files_place_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"precious")
    (tmp_path / "a.mcap.partial").symlink_to(tmp_path / "other")
    with pytest.raises(UsageError, match="is left from an earlier run"), LogWriter(tmp_path / "a.mcap"):
        pass
    assert not (tmp_path / "a.mcap").exists() and (tmp_path / "other").read_bytes() == b"precious"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_told(tmp_path: Path) -> None:
    """Whether a message meets it or the summary at the end: with what is left, and how to have it back."""
    for number, chunk_size in enumerate((10, 10**6)):
        log = LogWriter(tmp_path / f"{number}.mcap", chunk_size=chunk_size)
        with pytest.raises(InputError, match=r"mcap: cannot be written \(No space") as caught, log:
            channel = log.channel("/x", POSE)
            log._stream.close()
            log._stream = Path("/dev/full").open("wb")  # noqa: SIM115
            log.write(channel, 0, b"x" * 10_000)
        left = tmp_path / f"{number}.mcap.partial"
        assert f"{left} holds the data written so far: recover it with `mrac-jax inspect --repair OUT {left}`" in str(
            caught.value
        )
        assert left.exists()


def test_repeating_the_descriptions_costs_little(tmp_path: Path) -> None:
    """Five channels with schemas of 2 kB each: some percent of a log of full chunks."""
    schemas = [LogSchema(f"s{i}", "protobuf", os.urandom(700) * 3, "protobuf") for i in range(5)]
    sizes = []
    for chunk_size in (2**19, 2**24):
        with LogWriter(tmp_path / "a.mcap", chunk_size=chunk_size) as log:
            ids = [log.channel(f"/{schema.name}", schema) for schema in schemas]
            for i in range(3000):
                log.write(ids[i % 5], i, i.to_bytes(4, "little") * 200)
        sizes.append((tmp_path / "a.mcap").stat().st_size)
        assert len(heard(tmp_path / "a.mcap")) == 3000
    assert [a < b * 1.3 for a, b in pairwise(sizes)] == [True]
