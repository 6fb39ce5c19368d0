"""Replays, traces worked out step by step, pictures and animations of a rollout."""

import contextlib
import io
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop_worlds import SurveyWorld, first_worlds
from foxglove_schemas_protobuf.Log_pb2 import Log
from helpers import rollout_results
from PIL import Image
from recordings import SEED, Change, edited, foreign_plan, nth, places, rewrite, small_recording, small_task, world_with

from analysis.estimators.racing import plan_best
from analysis.inputs import Asked, load_or_make_plan
from analysis.pictures import OBSTACLE, SAFE, picture_style
from analysis.recording import contents
from analysis.recording import pictures as animation
from analysis.recording.container import LogMessage, open_log, recover
from analysis.recording.contents import read_outcomes, read_rollouts
from analysis.recording.frames import AreaMap, Held, area_maps, event_line, make_frames
from analysis.recording.pictures import RolloutPicture, animation_gif, boxes_for, durations, picture_png, shown_steps
from analysis.recording.record import Request, parse_picks, record
from analysis.recording.replay import inspect, replay, replayed
from analysis.recording.viewers import topics as schemas
from analysis.recording.viewers.topics import DATA_TOPICS, Stage
from planner.errors import InputError, UsageError
from planner.files import npz_bytes
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop, trace_rollouts
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.open_loop_events import open_loop_trace
from planner.rollouts.single_run import PythonLoop, SingleRun
from planner.settings import Choices
from planner.simulator.codes import NO_AREA, NO_ROBOT, NO_STEP, Doing, EventKind, Outcome
from planner.simulator.jit import interpreted
from planner.tally import Trace
from planner.world.world import World

# Replays: the same for every recording that is as it was, and every change found and named.


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "good.mcap"
    small_recording(path, picks=parse_picks("worst,best"), ids=(), evaluated=200, outcomes=True)
    return path


@pytest.mark.parametrize("engine", ["numba", "jax"])
@pytest.mark.usefixtures("few_lanes")
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


@pytest.mark.parametrize(
    ("one", "engines"),
    [pytest.param(one, ("numba",), id=one.name) for one in first_worlds(3)]
    + [pytest.param(one, ("numba", "jax"), id=f"{one.name}-both", marks=pytest.mark.slow) for one in first_worlds(50)],
)
def test_replays_on_many_worlds(tmp_path: Path, one: SurveyWorld, engines: tuple[Any, ...]) -> None:
    """A recording of each engine is the same file, and each engine replays it."""
    request = Request(ids=(0, 5), seed=one.seed, first_only=one.first_only)
    files = []
    for engine in engines:
        path = tmp_path / f"{engine}.mcap"
        record(one.world, one.plan(), replace(request, engine=engine), path)
        files.append(path.read_bytes())
        found = replay(path, engine)
        assert (found.difference, found.rollouts) == ("", 2)
    assert len(set(files)) == 1


# --- what was changed is found, and named ---

EVENT = "/rollout/event"


def swapped(messages: list[LogMessage]) -> None:
    """The first event and the message after it change places."""
    first = places(messages, EVENT)[0]
    messages[first : first + 2] = messages[first : first + 2][::-1]


def doubled(messages: list[LogMessage]) -> None:
    first = places(messages, EVENT)[0]
    messages.insert(first, messages[first])


def moved(messages: list[LogMessage]) -> None:
    """The second step a nanosecond later."""
    second = places(messages, "/stats")[1]
    messages[second] = messages[second]._replace(log_time=10**9 + 1)


def field(kind: Any, name: str, value: Any) -> Any:
    """Set a field to what `value` makes of it."""
    return edited(kind, lambda message: setattr(message, name, value(getattr(message, name))))


def entry(name: str, place: int, kind: Any = schemas.Step) -> Any:
    """One more in an entry of a repeated field."""

    def edit(message: Any) -> None:
        getattr(message, name)[place] += 1

    return edited(kind, edit)


def and_one(value: int) -> int:
    return value + 1


STEP, END = "/rollout/step", "/rollout/end"
OTHER_EVENT = "replay has event"
MESSAGES: dict[str, tuple[Change, str]] = {
    "event's cell": (nth(EVENT, 2, field(schemas.Event, "other", and_one)), OTHER_EVENT),
    "event's robot": (nth(EVENT, 0, field(schemas.Event, "robot", and_one)), OTHER_EVENT),
    "event's kind": (nth(EVENT, 0, field(schemas.Event, "kind", lambda v: (v + 1) % 5)), OTHER_EVENT),
    "event's area": (nth(EVENT, 0, field(schemas.Event, "area", and_one)), OTHER_EVENT),
    "event's step": (nth(EVENT, 0, field(schemas.Event, "step", and_one)), OTHER_EVENT),
    "event with invalid values": (nth(EVENT, 0, field(schemas.Event, "other", lambda v: 10**6)), "event"),
    "event that is none": (nth(EVENT, 0, lambda data: b"\xff\xff"), "with invalid values"),
    "step that is none": (nth(STEP, 1, lambda data: b"\xff\xff"), "an invalid message"),
    "event left out": (nth(EVENT, 1, lambda data: None), "recorded"),
    "step's cell": (nth(STEP, 3, entry("cells", 1)), "cells of robot 1 recorded"),
    "step's doing": (nth(STEP, 3, entry("doing", 0)), "doing of robot 0 recorded"),
    "step's area": (nth(STEP, 3, entry("areas", 2)), "areas of robot 2 recorded"),
    "step's figure": (nth(STEP, 3, field(schemas.Step, "visited", and_one)), "visited recorded"),
    "step left out": (nth(STEP, 2, lambda data: None), STEP),
    "start's id": (nth("/rollout/start", 0, field(schemas.Start, "rollout", and_one)), "rollout recorded"),
    "start's seed": (nth("/rollout/start", 0, field(schemas.Start, "seed", and_one)), "seed recorded"),
    "end's outcome": (nth(END, 1, field(schemas.End, "outcome", lambda v: (v + 1) % 5)), "outcome recorded"),
    "drawn grid": (nth("/map/visited", 4, lambda data: data[:-1] + bytes([data[-1] ^ 1])), "/map/visited differs"),
    "drawn log": (nth("/events", 0, field(Log, "message", lambda v: v + "!")), "/events differs"),
    "event twice": (doubled, "recorded"),
    "event out of turn": (swapped, "recorded"),
    "time": (moved, "/stats is at"),
}


def difference(good: Path, *, everything: bool = False, **how: Any) -> str:
    """What a replay of the recording finds after these changes (`rewrite`)."""
    bad = good.with_name("bad.mcap")
    rewrite(good, bad, **how)
    found = replay(bad, everything=everything)
    assert found.identical == (not found.difference)
    return found.difference


@pytest.mark.parametrize("what", MESSAGES)
def test_a_changed_message_is_found(good: Path, what: str) -> None:
    change, said = MESSAGES[what]
    found = difference(good, change=change)
    assert said in found and "rollout " in found


def until(count: int) -> Change:
    """The first messages alone, after all `/outcomes`, which are written first."""

    def change(messages: list[LogMessage]) -> None:
        del messages[len(places(messages, "/outcomes")) + count :]

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


def renamed(messages: list[LogMessage]) -> None:
    """A drawn topic that this program does not know, as in a file of version 1."""
    for place in places(messages, "/areas_voxels"):
        messages[place] = messages[place]._replace(channel=replace(messages[place].channel, topic="/areas_of_old"))


@pytest.mark.parametrize(
    ("written", "change"), [({"version": 1}, renamed), ({"mrac_jax": "0.0.9"}, MESSAGES["drawn log"][0])]
)
def test_a_recording_of_another_version_is_compared_by_its_data(
    good: Path, tmp_path: Path, written: dict[str, Any], change: Change
) -> None:
    old, said = tmp_path / "old.mcap", {name: str(value) for name, value in written.items()}
    how: Any = {"attachments": {contents.SETTINGS: settings_with(good, **written)}}
    how["metadata"] = lambda items: items | said
    rewrite(good, old, change=change, **how)
    found = replay(old, everything=True)
    assert (found.difference, found.drawn, found.rollouts) == ("", False, 2)
    assert vars(found.settings).items() >= written.items() and inspect(old).settings == found.settings
    assert "written by another version" in replayed(found).findings[0]
    assert "rollouts identical, drawings not compared" in replayed(found).findings[0]
    assert OTHER_EVENT in difference(good, change=MESSAGES["event's cell"][0], **how)


def settings_with(good: Path, **changes: Any) -> bytes:
    known = json.loads(open_log(good).attachment(contents.SETTINGS))
    return contents.json_bytes(known | changes)


def test_changed_settings_are_found(good: Path) -> None:
    log = open_log(good)
    first, second = contents.read_settings(log.attachment(contents.SETTINGS), "").ids
    world, changed = contents.read_world(log.attachment(contents.WORLD), ""), {"seed": SEED + 1, "loop": "open"}
    changed |= {"ids": [first, second + 1], "threat_checks": "first_visit", "step_seconds": 2.0}
    for name, value in changed.items():
        how: Any = {"attachments": {contents.SETTINGS: settings_with(good, **{name: value})}}
        assert f"metadata: {name}" in difference(good, **how)
        settings = contents.read_settings(how["attachments"][contents.SETTINGS], "")
        how["metadata"] = partial(lambda agreed, _: agreed, contents.metadata_of(settings, world, 3))
        assert re.search("rollout|/", difference(good, **how)), name


def test_changed_picks_tallies_and_outcomes_are_found_with_all(good: Path) -> None:
    log, all_of_it = open_log(good), partial(difference, good, everything=True)
    settings = contents.read_settings(log.attachment(contents.SETTINGS), "")
    picked = {contents.SETTINGS: settings_with(good, picks={"best": settings.picks["worst"]})}
    assert difference(good, attachments=picked) == ""
    assert "best is rollout" in all_of_it(attachments=picked)
    tally = json.loads(log.attachment(contents.TALLY))
    tally["visited"][-1] += 1
    assert "tally" in all_of_it(attachments={contents.TALLY: json.dumps(tally).encode()})
    cells = dict(np.load(io.BytesIO(log.attachment(contents.TALLY_CELLS))))
    cells["stops"][0] += 1
    assert "tally" in all_of_it(attachments={contents.TALLY_CELLS: npz_bytes(**cells)})
    change = nth("/outcomes", 0, entry("survived", 17, schemas.Outcomes))
    assert "rollout 17: survived recorded" in all_of_it(change=change)


def test_a_changed_plan_is_found(good: Path, tmp_path: Path) -> None:
    plan = json.loads(open_log(good).attachment(contents.PLAN))

    def found(**changes: Any) -> str:
        data = json.dumps(plan | changes, separators=(",", ":")).encode() + b"\n"
        return difference(good, attachments={contents.PLAN: data})

    robots, areas = (json.loads(json.dumps(plan[name])) for name in ("robots", "areas"))
    robots[0]["path"] = robots[0]["path"][:-1]
    idle = next(area for area in areas if area["robot"] >= 0)
    idle["robot"] = -1
    others = {"robots": robots, "areas": areas, "settings": plan["settings"] | {"risk": "log", "density": 2.0}}
    for name, value in (others | {"notes": ["changed"], "world": plan["world"] | {"sha256": "0" * 64}}).items():
        assert "plan.json" in found(**{name: value}), name
    assert found() == ""
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


def test_a_changed_world_is_found(good: Path) -> None:
    world = contents.read_world(open_log(good).attachment(contents.WORLD), "")
    threat = np.where(world.threat > 0, world.threat * np.float32(0.5), world.threat)
    for changes in ({"threat": threat}, {"cell_size": 1.0}, {"origin": (10.0, -20.0, 0.0)}):
        found = difference(good, attachments={contents.WORLD: world_with(world, **changes).to_bytes()})
        assert ("plan for another map" if "threat" in changes else "/map/threat") in found


def test_changed_formulas_metadata_schemas_and_topics_are_found(good: Path) -> None:
    bounds = json.loads(open_log(good).attachment(contents.BOUNDS))
    changed = {contents.BOUNDS: contents.json_bytes(bounds | {"ideal_team": 1.0})}
    assert "bounds.json" in difference(good, attachments=changed)
    assert "metadata: robots is '4'" in difference(good, metadata=lambda items: items | {"robots": "4"})
    other = difference(good, schema=lambda s: replace(s, name="mrac.Other") if s.name == "mrac.Stats" else s)
    assert "/stats: the schema is not" in other


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


# Traces worked out step by step, against the simulator's own books.

SURVEY = [one for one in first_worlds(90) if not one.first_only]


def check_against_simulation(plan: Plan, world: World, seed: int, trace: Trace) -> None:
    """The state of the same rollout at the end of every step."""
    frames, had = make_frames(trace), {number: area.robot for number, area in enumerate(plan.areas)}
    maps = {areas.step: areas for areas in area_maps(trace, plan.areas)}
    areas = maps[0]
    for step, run in enumerate(PythonLoop(plan, world).runs(seed, trace.rollout)):
        assert frames.visited[step] == run.visited.sum()
        assert frames.survived[step] == run.survived.sum()
        assert frames.alive[step].tolist() == run.alive.tolist()
        areas = maps.get(step, areas)
        assert areas.open == run.raw.marks["open"]
        had |= {run.area(robot): robot for robot in range(run.loop.robots)}
        check_areas(areas, run, had)
    assert step == trace.time
    assert np.array_equal(frames.visited_at != NO_STEP, run.visited)
    assert np.array_equal(frames.survived_at != NO_STEP, run.survived)


def check_areas(areas: AreaMap, run: SingleRun, had: dict[int, int]) -> None:
    """`had`: who has each area, or had it last."""
    assert np.array_equal(areas.area, run.area_of)
    inside = areas.area != NO_AREA
    for number in np.unique(areas.area[inside]).tolist():
        held = Held.COMPLETED if run.raw.areas["left"][number] == 0 else Held.ASSIGNED
        held = Held.UNASSIGNED if interpreted("state").holds(run.raw.open, number) else held
        assert set(areas.held[areas.area == number].tolist()) == {held}, number
        assert set(areas.robot[areas.area == number].tolist()) == {had.get(number, NO_ROBOT)}
    assert (areas.robot[~inside] == NO_ROBOT).all()


@pytest.mark.parametrize(
    ("one", "rollouts"),
    [pytest.param(one, range(2), id=one.name) for one in SURVEY[:14]]
    + [pytest.param(one, range(3, 9), id=f"{one.name}-more", marks=pytest.mark.slow) for one in SURVEY],
)
def test_frames_are_the_simulators_state_at_every_step(one: SurveyWorld, rollouts: range) -> None:
    plan = one.plan()
    for trace in trace_rollouts(one.loop(plan), one.seed, rollouts):
        check_against_simulation(plan, one.world, one.seed, trace)


def test_first_visitors() -> None:
    world, plan = small_task()
    (trace,) = trace_rollouts(compile_closed_loop(plan, world), 3, [11])
    frames = make_frames(trace)
    for cell in range(world.threat.size):
        entered = np.argwhere((trace.cells == cell) & frames.moved)
        if len(entered):
            assert (frames.visited_at[cell], frames.visited_by[cell]) == tuple(entered[0])
        else:
            assert frames.visited_at[cell] == frames.visited_by[cell] == NO_STEP


def test_events_that_do_not_fit_are_refused() -> None:
    world, plan = small_task()
    (trace,) = trace_rollouts(compile_closed_loop(plan, world), 3, [11])
    with pytest.raises(ValueError, match="areas, but"):
        next(area_maps(trace, plan.areas[:1]))


# --- the open loop ---


@pytest.mark.parametrize("robots", [1, 4])
def test_open_loop_traces_come_to_what_the_engine_counts(robots: int) -> None:
    world, plan = small_task(robots, (9, 14), seed=6)
    results = rollout_results(compile_plan(plan, world), seed=9, start=100, count=60)
    for place, rollout in enumerate(range(100, 160)):
        trace = open_loop_trace(plan, world, 9, rollout)
        frames = make_frames(trace)
        assert trace.time == results.time[place]
        assert frames.visited[-1] == results.visited[place]
        assert frames.survived[-1] == results.survived[place]
        assert frames.alive_count[-1] == results.alive[place]
        assert trace.outcome == results.outcome[place]
        hits = trace.events[trace.events[:, 2] == EventKind.HIT]
        assert len(hits) == robots - results.alive[place]
        assert [trace.doing[step, robot] for step, robot, *_ in hits.tolist()] == [Doing.DEAD] * len(hits)


def test_one_robot_does_the_same_in_both_loops() -> None:
    """But for what it plans after it has been stopped, and for how an end is called."""
    for seed in range(6):
        world, plan = small_task(1, (7, 10), seed=seed)
        loop = compile_closed_loop(plan, world)
        for closed in trace_rollouts(loop, 1, range(8)):
            opened = open_loop_trace(plan, world, 1, closed.rollout)
            last = opened.time + 1
            assert np.array_equal(opened.cells, closed.cells[:last])
            ended = closed.outcome == Outcome.COMPLETE
            upto = last - 1 if ended else last  # a complete closed loop ends before it turns to what is next
            assert np.array_equal(opened.doing[:upto], closed.doing[:upto]), (seed, closed.rollout)
            assert np.array_equal(opened.areas[:upto], closed.areas[:upto])
            told = [EventKind.COMPLETED, EventKind.HIT, EventKind.ALLOCATED]
            kept = closed.events[np.isin(closed.events[:, 2], told) & (closed.events[:, 0] < last)]
            kinds = kept[kept[:, 2] != EventKind.COMPLETED], opened.events[opened.events[:, 2] != EventKind.COMPLETED]
            assert np.array_equal(kinds[0][:, [0, 1, 2, 3]], kinds[1][:, [0, 1, 2, 3]]), (seed, closed.rollout)


# The picture and the animation of a rollout: what they show, how large they are, and that they are repeatable.


def rollout(world: World, starts: Sequence[Sequence[int]], seed: int = 0) -> tuple[Trace, Plan, World]:
    plan = make_plan(world, np.array(starts))
    return trace_rollouts(compile_closed_loop(plan, world), seed, [0])[0], plan, world


def small(height: int = 5, width: int = 9, threat: float = 0.3, robots: int = 3) -> tuple[Trace, Plan, World]:
    cells = np.zeros((height, width))
    cells[1:, 2:5] = threat
    cells[0, width - 1] = np.nan
    return rollout(World.create(cells), [[0, 0]] * robots)


@pytest.fixture(scope="module")
def paper() -> tuple[Trace, Plan, World]:
    world, plan, _ = load_or_make_plan(Asked("example:paper", Choices(), 8), find_best=plan_best)
    return trace_rollouts(compile_closed_loop(plan, world), 0, [3])[0], plan, world


def stage(plan: Plan, world: World, loop: str = "closed") -> Stage:
    return Stage(world, plan, loop, 0)


def opened(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data))


def test_picture_of_any_step_and_the_last_one_by_default(paper: tuple[Trace, Plan, World]) -> None:
    trace, plan, world = paper
    last = picture_png(trace, stage(plan, world))
    assert opened(last).size[0] == 1200
    assert last == picture_png(trace, stage(plan, world), trace.time)
    assert last != picture_png(trace, stage(plan, world), 0)
    assert len(last) < 300_000


@pytest.mark.parametrize("step", [-1, 10**6])
def test_a_step_that_is_none_is_named(step: int) -> None:
    trace, plan, world = small()
    with pytest.raises(UsageError, match=f"step {step}"):
        picture_png(trace, stage(plan, world), step)


@pytest.fixture(scope="module")
def three_frames() -> bytes:
    return animation_gif(small()[0], stage(*small()[1:]), most_frames=3)


def test_animation_shows_first_to_last_and_is_repeatable(three_frames: bytes) -> None:
    trace, plan, world = small()
    gif = opened(three_frames)
    assert gif.n_frames == 3 < trace.time + 1
    assert gif.size[0] == 800
    assert gif.info["loop"] == 0
    assert three_frames == animation_gif(trace, stage(plan, world), most_frames=3)


def test_frames_are_what_the_pictures_show(three_frames: bytes) -> None:
    trace, plan, world = small()
    gif = opened(three_frames)
    with picture_style():
        picture = RolloutPicture(trace, stage(plan, world), animation.ANIMATION_DPI)
        for index, step in enumerate(shown_steps(trace, 3)):
            picture.show(step)
            gif.seek(index)
            shown = np.asarray(gif.convert("RGB")).astype(int)
            pixels = picture.pixels()
            assert np.abs(shown - pixels).mean() < 0.2
            for colour in ("#ffffff", SAFE, OBSTACLE):
                fill = (pixels == tuple(bytes.fromhex(colour[1:]))).all(axis=2)
                assert fill.any()
                assert (shown[fill] == pixels[fill]).all()


def test_long_rollouts_keep_first_last_and_losses(paper: tuple[Trace, Plan, World]) -> None:
    trace, _, _ = paper
    losses = set(trace.events[trace.events[:, 2] == EventKind.HIT, 0].tolist())
    assert losses
    for most in (12, 50, 10_000):
        steps = shown_steps(trace, most)
        assert steps == sorted(set(steps))
        assert len(steps) == min(most, trace.time + 1)
        assert {0, trace.time} | losses <= set(steps)
        times = durations(trace, steps)
        assert times[-1] == animation.AT_END
        assert all(ms % 10 == 0 and ms >= animation.FASTEST for ms in times)
    assert shown_steps(trace, 2) == [0, trace.time]
    with pytest.raises(UsageError, match="1 frames"):
        animation_gif(paper[0], stage(*paper[1:]), most_frames=1)


@pytest.mark.parametrize("shape", [(1, 1), (1, 60), (40, 2), pytest.param((7, 30), marks=pytest.mark.slow), (120, 130)])
def test_every_shape_of_map_has_its_place(shape: tuple[int, int]) -> None:
    boxes = boxes_for(shape)
    for left, bottom, width, height in boxes.axes:
        assert left > 0 and bottom > 0 and width > 0 and height > 0
        assert left + width <= boxes.size[0]
        assert bottom + height < boxes.size[1]
    cells = [box[2] / shape[1] - box[3] / shape[0] for box in boxes.axes[:2]]
    assert cells == pytest.approx([0, 0])
    trace, plan, world = rollout(World.create(np.zeros(shape)), [[0, 0]])
    assert opened(picture_png(trace, stage(plan, world), 0)).size[0] in (1200, 1800)


def test_row_0_is_at_the_top() -> None:
    trace, plan, world = small()
    with picture_style():
        picture = RolloutPicture(trace, stage(plan, world), 100)
        image = picture.pixels()
    left, bottom, width, height = (100 * length for length in boxes_for(world.shape).axes[0])
    cell = width / world.shape[1]
    row = round(len(image) - bottom - height + cell / 2)
    assert tuple(image[row, round(left + width - cell / 2)]) == tuple(bytes.fromhex(OBSTACLE[1:]))


def test_it_only_moves_on() -> None:
    trace, plan, world = small()
    with picture_style():
        picture = RolloutPicture(trace, stage(plan, world), 50)
        picture.show(trace.time)
        with pytest.raises(ValueError, match="step"):
            picture.show(trace.time + 1)


def test_plans_without_areas_and_many_robots() -> None:
    trace, plan, world = small(robots=60)
    lost, areas, area_of = trace.events[:, 2] == EventKind.HIT, trace.areas, trace.area_of
    none = replace(trace, areas=np.full_like(areas, -1), events=trace.events[lost], area_of=np.full_like(area_of, -1))
    assert picture_png(none, stage(foreign_plan(world, plan), world, "open")) != picture_png(trace, stage(plan, world))


def test_events_in_words() -> None:
    world = World.create(np.full((4, 10), 0.05))

    def said(*event: int) -> tuple[str, str]:
        line = event_line(np.array(event), world)
        return line.short, line.text

    lost = "robot 3 is lost at [2, 5]"
    assert said(12, 3, EventKind.HIT, 7, 25) == (lost, f"{lost}, threat 5 %; its area was 7")
    assert said(12, 3, EventKind.HIT, -1, 25) == (lost, f"{lost}, threat 5 %")
    assert said(12, 3, EventKind.REALLOCATED, 7, 1)[0] == "area 7 is free again, in 1 part"
    assert said(12, 3, EventKind.SHARED, 7, 2)[0] == "robot 3 shares area 7, in 2 parts"
    for kind in EventKind:
        assert len(said(9_999, 99, kind, 999, 12)[0]) <= 38, "more than there is room for"
