"""Replays: the same for every recording that is as it was, and every change found and named."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop_worlds import first_worlds
from foxglove_schemas_protobuf.Log_pb2 import Log
from recordings import SEED, Change, edited, foreign_plan, keep, nth, rewrite, small_recording, small_task, world_with

from analysis.recording import contents
from analysis.recording.contents import read_outcomes, read_rollouts
from analysis.recording.log_reader import open_log, recover
from analysis.recording.record import Request, parse_picks, record
from analysis.recording.replay import inspect, replay
from analysis.recording.viewers import topics as schemas
from analysis.recording.viewers.topics import DATA_TOPICS
from planner.errors import InputError
from planner.files import npz_bytes
from planner.mcap import LogMessage


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "good.mcap"
    small_recording(path, picks=parse_picks("worst,best"), ids=(), evaluated=200, outcomes=True)
    return path


@pytest.mark.parametrize("engine", ["numba", "jax"])
@pytest.mark.usefixtures("few_lanes", "small_traces")
def test_a_recording_replays_on_either_engine(good: Path, engine: Any) -> None:
    found = replay(good, engine, everything=True)
    assert (found.difference, found.identical, found.rollouts, found.engine) == ("", True, 2, engine)
    assert found.drawn
    assert found.messages == sum(message.topic != "/outcomes" for message in open_log(good).messages())


@pytest.mark.parametrize("kind", ["own", "foreign", "given"])
def test_open_loops_and_given_plans_replay(tmp_path: Path, kind: str) -> None:
    world, plan = small_task()
    chosen = foreign_plan(world, plan) if kind == "foreign" else plan
    loop: Any = "closed" if kind == "given" else "open"
    record(world, chosen, Request(ids=(0, 6), seed=SEED, loop=loop, made=kind == "own"), tmp_path / "r.mcap")
    found = replay(tmp_path / "r.mcap")
    assert (found.difference, found.everything) == ("", True)


def worlds(count: int) -> list[Any]:
    return first_worlds(count)


@pytest.mark.parametrize("one", worlds(3), ids=lambda one: one.name)
def test_replays_on_a_few_worlds(tmp_path: Path, one: Any) -> None:
    check_world(tmp_path, one, ("numba",))


@pytest.mark.slow
@pytest.mark.parametrize("one", worlds(50), ids=lambda one: one.name)
def test_replays_on_fifty_worlds_and_both_engines(tmp_path: Path, one: Any) -> None:
    check_world(tmp_path, one, ("numba", "jax"))


def check_world(folder: Path, one: Any, engines: tuple[Any, ...]) -> None:
    """A recording of each engine is the same file, and each engine replays it."""
    request = Request(ids=(0, 5), seed=one.seed, first_only=one.first_only)
    files = []
    for engine in engines:
        path = folder / f"{engine}.mcap"
        record(one.world, one.plan(), replace(request, engine=engine), path)
        files.append(path.read_bytes())
        found = replay(path, engine)
        assert (found.difference, found.rollouts) == ("", 2)
    assert len(set(files)) == 1


# --- what was changed is found, and named ---

EVENT = "/rollout/event"


def swapped(topic: str) -> Change:
    """The first message of a topic and the one after it change places."""
    held: list[LogMessage] = []
    done = False

    def change(message: LogMessage) -> Iterator[tuple[str, int, bytes]]:
        nonlocal done
        if not done and not held and message.topic == topic:
            held.append(message)
            return
        yield from keep(message)
        if held and not done:
            yield from keep(held[0])
            done = True

    return change


def doubled(topic: str) -> Change:
    done = False

    def change(message: LogMessage) -> Iterator[tuple[str, int, bytes]]:
        nonlocal done
        yield from keep(message)
        if message.topic == topic and not done:
            done = True
            yield from keep(message)

    return change


def moved(message: LogMessage) -> Iterator[tuple[str, int, bytes]]:
    """The second step a nanosecond later."""
    later = message.topic == "/stats" and message.log_time == 10**9
    yield message.topic, message.log_time + later, bytes(message.data)


def field(kind: Any, name: str, value: Any) -> Any:
    """Set a field to what `value` makes of it."""
    return edited(kind, lambda message: setattr(message, name, value(getattr(message, name))))


def entry(name: str, place: int) -> Any:
    """One more in an entry of a repeated field of a step."""

    def edit(message: Any) -> None:
        getattr(message, name)[place] += 1

    return edited(schemas.Step, edit)


MESSAGES: dict[str, tuple[Callable[[], Change], str]] = {
    "event's cell": (lambda: nth(EVENT, 2, field(schemas.Event, "other", lambda v: v + 1)), "replay has event"),
    "event's robot": (lambda: nth(EVENT, 0, field(schemas.Event, "robot", lambda v: v + 1)), "replay has event"),
    "event's kind": (lambda: nth(EVENT, 0, field(schemas.Event, "kind", lambda v: (v + 1) % 5)), "replay has event"),
    "event's area": (lambda: nth(EVENT, 0, field(schemas.Event, "area", lambda v: v + 1)), "replay has event"),
    "event's step": (lambda: nth(EVENT, 0, field(schemas.Event, "step", lambda v: v + 1)), "replay has event"),
    "event that means nothing": (lambda: nth(EVENT, 0, field(schemas.Event, "other", lambda v: 10**6)), "event"),
    "event that is none": (lambda: nth(EVENT, 0, lambda data: b"\xff\xff"), "means nothing"),
    "step that is none": (lambda: nth("/rollout/step", 1, lambda data: b"\xff\xff"), "cannot be read"),
    "event left out": (lambda: nth(EVENT, 1, lambda data: None), "recorded"),
    "event twice": (lambda: doubled(EVENT), "recorded"),
    "event out of turn": (lambda: swapped(EVENT), "recorded"),
    "step's cell": (lambda: nth("/rollout/step", 3, entry("cells", 1)), "cells of robot 1 recorded"),
    "step's doing": (lambda: nth("/rollout/step", 3, entry("doing", 0)), "doing of robot 0 recorded"),
    "step's area": (lambda: nth("/rollout/step", 3, entry("areas", 2)), "areas of robot 2 recorded"),
    "step's figure": (
        lambda: nth("/rollout/step", 3, field(schemas.Step, "visited", lambda v: v + 1)),
        "visited recorded",
    ),
    "step left out": (lambda: nth("/rollout/step", 2, lambda data: None), "/rollout/step"),
    "start's id": (
        lambda: nth("/rollout/start", 0, field(schemas.Start, "rollout", lambda v: v + 1)),
        "rollout recorded",
    ),
    "start's seed": (lambda: nth("/rollout/start", 0, field(schemas.Start, "seed", lambda v: v + 1)), "seed recorded"),
    "end's outcome": (
        lambda: nth("/rollout/end", 1, field(schemas.End, "outcome", lambda v: (v + 1) % 5)),
        "outcome recorded",
    ),
    "drawn grid": (
        lambda: nth("/map/visited", 4, lambda data: data[:-1] + bytes([data[-1] ^ 1])),
        "/map/visited differs",
    ),
    "drawn log": (lambda: nth("/events", 0, field(Log, "message", lambda v: v + "!")), "/events differs"),
    "time": (lambda: moved, "/stats is at"),
}


@pytest.mark.parametrize("what", MESSAGES)
def test_a_changed_message_is_found(good: Path, tmp_path: Path, what: str) -> None:
    change, said = MESSAGES[what]
    rewrite(good, tmp_path / "bad.mcap", change=change())
    found = replay(tmp_path / "bad.mcap")
    assert not found.identical
    assert said in found.difference
    assert "rollout " in found.difference


def until(count: int) -> Change:
    """The first messages alone, without `/outcomes`."""
    seen = iter(range(10**9))

    def change(message: LogMessage) -> Iterator[tuple[str, int, bytes]]:
        if message.topic == "/outcomes" or next(seen) < count:
            yield from keep(message)

    return change


def test_a_file_that_ends_early_is_identical_as_far_as_it_goes(good: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    whole = replay(good)
    assert (whole.rollouts, whole.asked, whole.partial) == (2, 2, "")
    first = [m.topic for m in open_log(good).messages() if m.topic != "/outcomes"].index("/rollout/end") + 1
    for count, rollouts in ((0, 0), (first - 1, 0), (first, 1), (first + 30, 1), (whole.messages - 1, 1)):
        rewrite(good, cut, change=until(count))
        found = replay(cut, everything=True)
        assert (found.difference, found.messages, found.rollouts) == ("", count, rollouts)
        assert (found.identical, found.partial, found.asked) == (True, "ends early", 2)
    rewrite(good, tmp_path / "bad.mcap", change=nth("/stats", 1, lambda data: data[:-1] + b"x"))
    rewrite(tmp_path / "bad.mcap", cut, change=until(first))
    assert "/stats differs" in replay(cut).difference


def test_a_recovered_recording_is_identical_as_far_as_it_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chunk in the middle is destroyed: what is left is the same; a message of it that is changed is found."""
    monkeypatch.setattr("analysis.recording.record.CHUNK_SIZE", 20_000)
    small_recording(tmp_path / "r.mcap", ids=(3, 4, 9))
    data = bytearray((tmp_path / "r.mcap").read_bytes())
    for place in (len(data) // 3, len(data) * 2 // 3):
        data[place : place + 50] = bytes(50)
    (tmp_path / "bad.mcap").write_bytes(data)
    report = recover(tmp_path / "bad.mcap", tmp_path / "saved.mcap")
    assert len(report.lost) and report.lost_messages
    found = replay(tmp_path / "saved.mcap")
    assert (found.difference, found.partial) == ("", "recovered")
    assert found.messages == report.messages
    assert found.rollouts < found.asked == 3
    for kind, topic in ((schemas.Event, EVENT), (schemas.Step, "/rollout/step")):
        change = nth(topic, 5, field(kind, "step", lambda v: v + 1))
        rewrite(tmp_path / "saved.mcap", tmp_path / "changed.mcap", change=change)
        assert not replay(tmp_path / "changed.mcap").identical


def test_a_file_of_another_format_version_is_compared_by_its_data(good: Path, tmp_path: Path) -> None:
    """A drawn topic that this program does not know, in a file of version 1."""
    from analysis.recording.replay import replayed

    def renamed(message: LogMessage) -> Iterator[tuple[str, int, bytes]]:
        topic = "/areas_of_old" if message.topic == "/areas_voxels" else message.topic
        yield topic, message.log_time, bytes(message.data)

    old = tmp_path / "old.mcap"
    say: Any = lambda items: items | {"version": "1"}  # noqa: E731
    rewrite(good, old, attachments={contents.SETTINGS: settings_with(good, version=1)}, metadata=say, change=renamed)
    found = replay(old, everything=True)
    assert (found.difference, found.drawn, found.rollouts, found.settings.version) == ("", False, 2, 1)
    assert "made by another version" in replayed(found).findings[0]
    assert "rollouts identical, drawings not compared" in replayed(found).findings[0]
    assert inspect(old).settings == found.settings


def settings_with(good: Path, **changes: Any) -> bytes:
    known = json.loads(open_log(good).attachment(contents.SETTINGS))
    return contents.json_bytes(known | changes)


def test_changed_settings_are_found(good: Path, tmp_path: Path) -> None:
    log = open_log(good)
    ids = list(contents.read_settings(log.attachment(contents.SETTINGS), "").ids)
    cases: dict[str, tuple[dict[str, Any], str]] = {
        "seed": ({"seed": SEED + 1}, "metadata: seed"),
        "ids": ({"ids": [ids[0], ids[1] + 1]}, "metadata: ids"),
        "loop": ({"loop": "open"}, "metadata: loop"),
        "checks": ({"threat_checks": "first_visit"}, "metadata: threat_checks"),
        "time": ({"step_seconds": 2.0}, "metadata: step_seconds"),
    }
    for name, (changes, said) in cases.items():
        bad = tmp_path / f"{name}.mcap"
        rewrite(good, bad, attachments={contents.SETTINGS: settings_with(good, **changes)})
        assert said in replay(bad).difference, name
        world = contents.read_world(log.attachment(contents.WORLD), "")
        settings = contents.read_settings(settings_with(good, **changes), "")
        agreed = contents.metadata_of(settings, world, 3)
        rewrite(good, bad, attachments={contents.SETTINGS: settings_with(good, **changes)}, metadata=lambda _: agreed)  # noqa: B023
        found = replay(bad)
        assert not found.identical, name
        assert "rollout" in found.difference or "/" in found.difference, name


def test_changed_picks_tallies_and_outcomes_are_found_with_all(good: Path, tmp_path: Path) -> None:
    log, bad = open_log(good), tmp_path / "bad.mcap"
    settings = contents.read_settings(log.attachment(contents.SETTINGS), "")
    rewrite(good, bad, attachments={contents.SETTINGS: settings_with(good, picks={"best": settings.picks["worst"]})})
    assert replay(bad).identical
    assert "best is rollout" in replay(bad, everything=True).difference
    tally = json.loads(log.attachment(contents.TALLY))
    tally["visited"][-1] += 1
    rewrite(good, bad, attachments={contents.TALLY: json.dumps(tally).encode()})
    assert "tally" in replay(bad, everything=True).difference
    cells = dict(np.load(io.BytesIO(log.attachment(contents.TALLY_CELLS))))
    cells["stops"][0] += 1
    rewrite(good, bad, attachments={contents.TALLY_CELLS: npz_bytes(**cells)})
    assert "tally" in replay(bad, everything=True).difference

    def edit(block: Any) -> None:
        block.survived[17] += 1

    rewrite(good, bad, change=nth("/outcomes", 0, edited(schemas.Outcomes, edit)))
    assert "rollout 17: survived recorded" in replay(bad, everything=True).difference


def test_a_changed_plan_is_found(good: Path, tmp_path: Path) -> None:
    plan = json.loads(open_log(good).attachment(contents.PLAN))

    def found(**changes: Any) -> str:
        data = json.dumps(plan | changes, separators=(",", ":")).encode() + b"\n"
        rewrite(good, tmp_path / "bad.mcap", attachments={contents.PLAN: data})
        return replay(tmp_path / "bad.mcap").difference

    robots = json.loads(json.dumps(plan["robots"]))
    robots[0]["path"] = robots[0]["path"][:-1]
    assert "plan.json" in found(robots=robots)
    areas = json.loads(json.dumps(plan["areas"]))
    idle = next(area for area in areas if area["robot"] >= 0)
    idle["robot"] = -1
    assert "plan.json" in found(areas=areas)
    assert "plan.json" in found(settings=plan["settings"] | {"risk": "log", "density": 2.0})
    assert "plan.json" in found(notes=["changed"])
    assert found() == ""
    assert "plan.json" in found(world=plan["world"] | {"sha256": "0" * 64})
    made = contents.read_plan(open_log(good).attachment(contents.PLAN), small_task()[0], "")
    data = contents.plan_bytes(foreign_plan(small_task()[0], made))
    rewrite(good, tmp_path / "bad.mcap", attachments={contents.PLAN: data})
    assert not_the_same(tmp_path / "bad.mcap")


def not_the_same(path: Path) -> bool:
    """Found by a replay, or refused."""
    try:
        return not replay(path, everything=True).identical
    except InputError:
        return True


def test_a_changed_world_is_found(good: Path, tmp_path: Path) -> None:
    world = contents.read_world(open_log(good).attachment(contents.WORLD), "")
    threat = world.threat.copy()
    threat[threat > 0] *= np.float32(0.5)
    for name, changed in {
        "threat": world_with(world, threat=threat),
        "cells": world_with(world, cell_size=1.0),
        "origin": world_with(world, origin=(10.0, -20.0, 0.0)),
    }.items():
        rewrite(good, tmp_path / "bad.mcap", attachments={contents.WORLD: changed.to_bytes()})
        found = replay(tmp_path / "bad.mcap")
        assert not found.identical, name
        assert ("plan for another map" if name == "threat" else "/map/threat") in found.difference


def test_changed_formulas_metadata_schemas_and_topics_are_found(good: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bounds = json.loads(open_log(good).attachment(contents.BOUNDS))
    rewrite(good, bad, attachments={contents.BOUNDS: contents.json_bytes(bounds | {"ideal_team": 1.0})})
    assert "bounds.json" in replay(bad).difference
    rewrite(good, bad, metadata=lambda items: items | {"robots": "4"})
    assert "metadata: robots is '4'" in replay(bad).difference
    rewrite(good, bad, schema=lambda s: replace(s, name="mrac.Other") if s.name == "mrac.Stats" else s)
    assert "/stats: another schema" in replay(bad).difference


def test_another_versions_recording_is_compared_by_its_data(good: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    data = settings_with(good, mrac_jax="0.0.9")
    say: Any = lambda items: items | {"mrac_jax": "0.0.9"}  # noqa: E731
    rewrite(good, other, attachments={contents.SETTINGS: data}, metadata=say, change=MESSAGES["drawn log"][0]())
    found = replay(other)
    assert (found.difference, found.drawn, found.rollouts) == ("", False, 2)
    change = nth(EVENT, 2, field(schemas.Event, "other", lambda v: v + 1))
    rewrite(good, other, attachments={contents.SETTINGS: data}, metadata=say, change=change)
    assert "replay has event" in replay(other).difference


def test_what_is_no_recording_is_refused(good: Path, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_bytes(b"hello")
    with pytest.raises(InputError, match="not an MCAP"):
        replay(tmp_path / "text.mcap")
    for name in (contents.SETTINGS, contents.WORLD, contents.PLAN, contents.BOUNDS):
        rewrite(good, tmp_path / "bad.mcap", attachments={name: None})
        with pytest.raises(InputError, match=name):
            replay(tmp_path / "bad.mcap")
    for name in (contents.SETTINGS, contents.WORLD):
        rewrite(good, tmp_path / "bad.mcap", attachments={name: b"\x00\x01rubbish"})
        with pytest.raises(InputError, match=name):
            replay(tmp_path / "bad.mcap")


def test_nothing_in_a_message_makes_a_reader_fall_over(good: Path, tmp_path: Path) -> None:
    """Random bytes in data messages: an answer or an InputError, nothing else, and a replay always notices."""
    draw, bad = np.random.default_rng(3), tmp_path / "bad.mcap"

    def spoil(data: bytes) -> bytes:
        spoilt = bytearray(data)
        for place in draw.integers(0, len(spoilt), size=draw.integers(1, 4)):
            spoilt[place] = draw.integers(0, 256)
        return bytes(spoilt)

    for topic in (*DATA_TOPICS, "/outcomes"):
        for _ in range(3):
            rewrite(good, bad, change=nth(topic, int(draw.integers(0, 2)), spoil))
            if any(a.data != b.data for a, b in zip(open_log(good).messages(), open_log(bad).messages(), strict=True)):
                assert not_the_same(bad)
            for read in (lambda path: list(read_rollouts(path)), inspect, read_outcomes):
                with contextlib.suppress(InputError):
                    read(bad)
