"""`mrac-jax inspect`: its contents, and its rollouts run again and compared message by message (`--replay`)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from rich.table import Table

from analysis.recording import contents
from analysis.recording.container import RECOVERED, Log, Recovered, open_log
from analysis.recording.contents import RecordedOutcomes, RecordedRollout, decode, outcomes_of_log, rollouts_of
from analysis.recording.frames import end_text, event_line
from analysis.recording.record import (
    OUTCOME_COLUMNS,
    Picker,
    Recorded,
    chunks,
    parse_picks,
    recorded_messages,
    tally_of,
)
from analysis.recording.viewers import topics as schemas
from analysis.recording.viewers.topics import DATA_TOPICS, Message, Stage, type_of
from analysis.report.model import Part, Report
from analysis.theory.bounds import all_bounds
from analysis.utils.notes import ProgressCallback
from analysis.utils.progress import compiles_for
from analysis.utils.tables import make_table
from planner.arguments import argument
from planner.errors import PER_VISIT, InputError, PlanError
from planner.files import Json
from planner.formatting import counted, in_percent
from planner.make_plan import confirm_plan, make_plan
from planner.mcap import LogMessage
from planner.plan.plan import Plan
from planner.simulator.codes import EventKind
from planner.tally import RolloutResults
from planner.world.world import World

if TYPE_CHECKING:
    from planner.rollouts.engine import Engine
    from planner.rollouts.names import EngineName

# A stored message against the one that a replay makes: the same, or what differs, in words.

_REPEATED = ("/rollout/event", "/events")
"""Topics with several messages at one time."""


class Difference(Exception):
    """Something is not as recorded; its text says what."""


def may_be_lost(stored: LogMessage, made: Message) -> bool:
    """Whether the next message that is stored, in a log with gaps, can be a later one than this one of the replay."""
    if stored.log_time != made.time:
        return stored.log_time > made.time
    return stored.topic != made.topic or (made.topic in _REPEATED and stored.data != made.data)


def compare(stored: LogMessage, made: Message, stage: Stage, rollout: int, source: Path) -> None:
    """Raise Difference unless the stored message is the one that the replay made."""
    where = f"rollout {rollout}, {seconds_text(made.time)}"
    if (stored.topic, stored.log_time) == (made.topic, made.time) and stored.data == made.data:
        if stored.publish_time != made.time:
            raise Difference(f"{where}: {made.topic} says that it was published at {stored.publish_time} ns")
        return
    if stored.topic != made.topic:
        said, expected = _words(stored.topic, stored.data, stage), _words(made.topic, made.data, stage)
        raise Difference(f"{where}: recorded {said}; the replay has {expected}")
    if stored.log_time != made.time:
        raise Difference(f"{where}: {made.topic} is at {seconds_text(stored.log_time)}")
    if made.topic not in DATA_TOPICS:
        raise Difference(f"{where}: {made.topic} differs")
    raise Difference(f"{where}: {_fields(stored, made, stage, source)}")


def compare_outcomes(recorded: RecordedOutcomes, results: RolloutResults) -> None:
    """Raise Difference unless the recorded outcomes of these rollouts, as far as they are there, are the same."""
    stop = results.start + len(results.visited)
    there = slice(*np.searchsorted(recorded.ids, (results.start, stop)))
    ids = recorded.ids[there]
    for column in OUTCOME_COLUMNS:
        mine, theirs = getattr(results, column)[ids - results.start], getattr(recorded, column)[there]
        wrong = np.flatnonzero(mine != theirs)
        if len(wrong):
            said = f"{column} recorded {theirs[wrong[0]]}, replayed {mine[wrong[0]]}"
            raise Difference(f"/outcomes: rollout {ids[wrong[0]]}: {said}")


def _fields(stored: LogMessage, made: Message, stage: Stage, source: Path) -> str:
    """Which fields of a data message differ."""
    if made.topic == "/rollout/event":
        said, expected = _words(made.topic, stored.data, stage), _words(made.topic, made.data, stage)
        return f"recorded {said}; the replay has {expected}"
    try:
        old = decode(stored, source)
    except InputError as error:
        return error.problem
    new = type(old).FromString(made.data)
    for field in new.DESCRIPTOR.fields:
        left, right = getattr(old, field.name), getattr(new, field.name)
        if left == right:
            continue
        if not hasattr(right, "append"):
            return f"{made.topic}: {field.name} recorded {left}, replayed {right}"
        if len(left) != len(right):
            return f"{made.topic}: {field.name} has {len(left)} entries, replayed {len(right)}"
        place = next(i for i, (a, b) in enumerate(zip(left, right, strict=True)) if a != b)
        whose = "cell" if field.name == "area_of" else "robot"
        return f"{made.topic}: {field.name} of {whose} {place} recorded {left[place]}, replayed {right[place]}"
    return f"{made.topic}: encoded otherwise"


def _words(topic: str, data: bytes, stage: Stage) -> str:
    """A message in words."""
    if topic != "/rollout/event":
        return topic
    try:
        event = schemas.Event.FromString(bytes(data))
        row = np.array([event.step, event.robot, event.kind, event.area, event.other])
        return f'event "{event_line(row, stage.world, stage.plan).text}"'
    except (ValueError, IndexError, DecodeError):  # a cell off the map, a kind that is none
        return f"{topic} that means nothing"


def seconds_text(nanoseconds: int) -> str:
    """A time of the file."""
    return f"{nanoseconds / 1e9:g} s"


OUTCOMES = "/outcomes"
ENDS_EARLY = "ends early"


@dataclass
class Replayed:
    """What a replay found, as far as it has come.

    Attributes:
        path: the file. settings: what it says was recorded.
        difference: the first thing that is not the same, in words; "" when everything is.
        rollouts, messages: compared and found the same, rollouts from beginning to end. asked: rollouts that there
            should be. partial: the file says that it is not whole, or it ends early; "" or how, in words.
        drawn: drawn messages were compared too, byte for byte; else data alone.
        everything: the evaluated rollouts were run again too, for tally, outcomes and picks.
        engine: that ran. seconds: the replay took.
    """

    path: Path
    settings: contents.Settings
    difference: str = ""
    rollouts: int = 0
    messages: int = 0
    asked: int = 0
    partial: str = ""
    drawn: bool = True
    everything: bool = True
    engine: EngineName = "auto"
    seconds: float = 0.0

    @property
    def identical(self) -> bool:
        """Whether nothing differs, as far as a partial file goes."""
        return not self.difference


def replay(
    path: str | Path, engine: EngineName = "auto", *, everything: bool = False, progress: ProgressCallback | None = None
) -> Replayed:
    """Run a recording again and compare.

    Plan and formulas are checked too: the plan must be what follows from its allocation (and the allocation what the
    planner makes, unless a plan file was given). A recording of another version of this program is compared by its
    data topics alone. Of one that ends early every message must be the same; of a recovered one too, and what was lost
    in between may be missing.

    Args:
        engine: to run with; the answer is the same.
        everything: also run all evaluated rollouts, and compare tally, outcomes and picks.

    Raises:
        InputError: the file cannot be read, holds no recording, or one with random numbers for each visit.
    """
    from planner.rollouts.engine import choose_engine

    log, clock = open_log(path), time.perf_counter()
    settings = contents.read_settings(log.attachment(contents.SETTINGS), str(path))
    if settings.per_visit:
        raise InputError(PER_VISIT, source=path)
    found = Replayed(
        path=Path(path),
        settings=settings,
        asked=len(settings.ids),
        partial="partial" if log.partial else "",
        drawn=(settings.mrac_jax, settings.version) == (contents.own_version(), contents.VERSION),
        everything=everything or not settings.evaluated,
        engine=choose_engine(engine).name,
    )
    try:
        _Comparison(log, found, progress).run()
    except Difference as difference:
        found.difference = str(difference)
    found.seconds = time.perf_counter() - clock
    return found


class _Comparison:
    def __init__(self, log: Log, found: Replayed, progress: ProgressCallback | None) -> None:
        self.log, self.found, self.settings, self.progress = log, found, found.settings, progress
        self.recovered = any(name == RECOVERED for name, _ in log.metadata)
        if self.recovered:
            found.partial = "recovered"

    def run(self) -> None:
        """Raise Difference at the first one."""
        from planner.rollouts.engine import Rolling, make_engine

        source = str(self.log.path)
        world = contents.read_world(self.log.attachment(contents.WORLD), source)
        plan = self._plan(world, source)
        self._descriptions(world, plan)
        first_only = self.settings.threat_checks == "first_visit"
        how = Rolling(self.settings.loop, first_only, self.settings.seed)
        compiles_for(plan, self.settings.loop)
        engine = make_engine(plan, world, how, self.found.engine)
        self._rollouts(Stage(world, plan, self.settings.loop, self.settings.seed, first_only), engine)
        if self.found.everything:
            self._evaluated(engine)

    # --- what stands beside the messages ---

    def _plan(self, world: World, source: str) -> Plan:
        """The plan, if it is what the planner makes; one that was given, if it is what follows from its allocation."""
        data = self.log.attachment(contents.PLAN)
        try:
            plan = contents.read_plan(data, world, source)
            if self.settings.plan == "given" or plan.settings is None:
                follows = confirm_plan(plan, world, source)
            else:
                follows = make_plan(world, plan.starts, plan.settings)
        except PlanError as error:
            raise Difference(f"{contents.PLAN}: {error.problem}") from error
        if [_area_facts(area) for area in follows.areas] != [_area_facts(area) for area in plan.areas]:
            raise Difference(f"{contents.PLAN}: its areas are not those that the planner makes")
        if self.found.drawn and contents.plan_bytes(follows) != data:
            raise Difference(f"{contents.PLAN}: not the plan that the planner makes")
        return follows

    def _descriptions(self, world: World, plan: Plan) -> None:
        """Metadata, formulas, and that nothing is there twice."""
        names = [attached.name for attached in self.log.attachments]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise Difference(f"the attachment {twice[0]} is there {names.count(twice[0])} times")
        expected = contents.metadata_of(self.settings, world, len(plan.robots))
        for name, items in self.log.metadata:
            said_of = {key: value for key, value in items.items() if key != "mode"}  # which 0.3 said too
            if name == contents.METADATA and said_of != expected:
                wrong = sorted(key for key in {*said_of, *expected} if said_of.get(key) != expected.get(key))[0]
                said = f"{said_of.get(wrong)!r} where the attachments say {expected.get(wrong)!r}"
                raise Difference(f"metadata: {wrong} is {said}")
        if self.found.drawn:
            formulas = contents.bounds_bytes(all_bounds(plan, world))
            if not self._is_lost(contents.BOUNDS) and self.log.attachment(contents.BOUNDS) != formulas:
                raise Difference(f"{contents.BOUNDS}: not the formulas of this plan")
            for channel in self.log.channels.values():
                self._check_schema(channel.topic, channel.schema_id, channel.message_encoding)

    def _check_schema(self, topic: str, schema_id: int, encoding: str) -> None:
        schema = self.log.schemas.get(schema_id)
        try:
            own = type_of(topic)
        except KeyError:
            raise Difference(f"a topic that is none of a recording's: {topic[:80]!r}") from None
        found = None if schema is None else (schema.name, schema.encoding, bytes(schema.data), encoding)
        if found != (own.name, own.encoding, own.data, own.message_encoding):
            raise Difference(f"{topic}: another schema than {own.name}")

    # --- the rollouts in full ---

    def _rollouts(self, stage: Stage, engine: Engine) -> None:
        topics = None if self.found.drawn else DATA_TOPICS
        stored = (message for message in self.log.messages(topics) if message.topic != OUTCOMES)
        kept = next(stored, None)
        for trace, made in recorded_messages(stage, engine.traces(self.settings.ids), self.settings.step_seconds):
            whole = True
            for message in made:
                if not self.found.drawn and message.topic not in DATA_TOPICS:
                    continue
                if kept is None:
                    self.found.partial = self.found.partial or ENDS_EARLY
                    return
                if self.recovered and may_be_lost(kept, message):
                    whole = False
                    continue
                compare(kept, message, stage, trace.rollout, self.log.path)
                self.found.messages += 1
                kept = next(stored, None)
            self.found.rollouts += whole
        if kept is not None:
            raise Difference(f"after the last rollout there is more: {kept.topic} at {seconds_text(kept.log_time)}")

    # --- what all evaluated rollouts came to ---

    def _evaluated(self, engine: Engine) -> None:
        count = self.settings.evaluated
        if self._is_lost(contents.TALLY) or self._is_lost(contents.TALLY_CELLS):
            return
        text, cells = (self.log.attachment(name) for name in (contents.TALLY, contents.TALLY_CELLS))
        stored = contents.read_tally(text, cells, str(self.log.path))
        outcomes = outcomes_of_log(self.log) if self.settings.outcomes else None
        if not count:
            self._same_tally(tally_of(engine, self.settings.ids), stored)
            return
        if outcomes is not None and not self._are_all(outcomes.ids, count):
            raise Difference(f"{OUTCOMES}: {len(outcomes.ids)} outcomes, expected ids 0 to {count - 1}")
        picker = Picker(engine.accessible)
        for so_far, results in chunks(engine, count, self.progress):
            tally = so_far
            picker.add(results)
            if outcomes is not None:
                compare_outcomes(outcomes, results)
        self._same_tally(tally, stored)
        for name, chosen in self.settings.picks.items():
            found = picker.choose(parse_picks(name)[0], self.settings.seed)
            if found != chosen:
                raise Difference(f"{contents.SETTINGS}: {name} is rollout {found}, not {chosen}")

    def _is_lost(self, name: str) -> bool:
        return self.recovered and all(attached.name != name for attached in self.log.attachments)

    def _are_all(self, ids: NDArray[np.int64], count: int) -> bool:
        """Whether the ids of outcomes are those that there should be, as far as they can have been recovered."""
        return bool(ids.max(initial=0) < count) if self.recovered else np.array_equal(ids, np.arange(count))

    def _same_tally(self, made: Any, stored: Any) -> None:
        stored = replace(stored, key=made.key) if not self.found.drawn else stored
        if made != stored:
            raise Difference(f"{contents.TALLY}: not the tally of these rollouts")


def _area_facts(area: Any) -> tuple[int, int, list[int]]:
    return area.level, area.robot, area.cells.tolist()


# `mrac-jax inspect`: what is in a recording, and each rollout with its events in words.


@dataclass(frozen=True)
class Inspection:
    """What is in a recording.

    Attributes:
        partial: why it is cut short. settings: None for a log that holds none of ours. shape: of the world.
        topics: schema and number of messages of each. attachments: bytes of each.
        rollouts: those in full, as the JSON object tells them: coverage as fractions of the accessible cells, how it
            ended (`text`), and the events in words.
    """

    path: Path
    bytes: int
    library: str
    seconds: float
    partial: str
    settings: contents.Settings | None
    shape: tuple[int, int] | None
    topics: dict[str, Json]
    attachments: dict[str, int]
    metadata: dict[str, dict[str, str]]
    rollouts: list[Json]


def inspect(path: str | Path) -> Inspection:
    """Look into a log. One that is not ours is listed by its topics. Raises InputError for one that cannot be read."""
    log = open_log(path)
    names = [attached.name for attached in log.attachments]
    ours = contents.SETTINGS in names and contents.WORLD in names
    settings, world, plan = None, None, None
    if ours:
        settings = contents.read_settings(log.attachment(contents.SETTINGS), str(path))
        world = contents.read_world(log.attachment(contents.WORLD), str(path))
        plan = contents.read_plan(log.attachment(contents.PLAN), world, str(path)) if contents.PLAN in names else None
    topics: dict[str, Json] = {}
    last = 0
    for message in log.messages():
        schema = "" if message.schema is None else message.schema.name
        topics.setdefault(message.topic, {"schema": schema, "messages": 0})["messages"] += 1
        last = max(last, message.log_time)
    return Inspection(
        path=Path(path),
        bytes=Path(path).stat().st_size,
        library=log.library,
        seconds=last / 1e9,
        partial=log.partial,
        settings=settings,
        shape=None if world is None else world.shape,
        topics=dict(sorted(topics.items())),
        attachments={attached.name: len(attached.data) for attached in log.attachments},
        metadata=dict(log.metadata),
        rollouts=[] if world is None else [_rollout(one, world, plan, log.path) for one in rollouts_of(log)],
    )


def _rollout(one: RecordedRollout, world: World, plan: Plan | None, source: Path) -> Json:
    trace = one.trace
    try:
        lines = [event_line(row, world, plan) for row in trace.events]
    except (ValueError, IndexError) as error:
        raise InputError(f"rollout {trace.rollout}: an event that means nothing ({error})", source=source) from error
    cells = max(one.accessible, 1)
    visited, survived, alive = (int(values[-1]) for values in (one.visited, one.survived, one.alive))
    ended = trace.outcome if plan is None else plan.ending(trace.outcome)
    return {
        "rollout": trace.rollout,
        "begins_seconds": float(one.times[0]) / 1e9,
        "outcome": ended.word,
        "time": trace.time,
        "visited": visited / cells,
        "survived": survived / cells,
        "robots": trace.cells.shape[1],
        "alive": alive,
        "text": end_text(trace, ended, visited, survived, cells, alive),
        "events": [
            {"step": line.step, "kind": line.kind.name.lower(), "robot": line.robot, "text": line.text}
            for line in lines
        ],
    }


# What `record`, `replay`, `inspect` and `recover` say.

MOST_LINES = 40
"""Events shown of a rollout: losses, reallocations and shares first."""
FIRST = {kind.name.lower() for kind in (EventKind.HIT, EventKind.REALLOCATED, EventKind.SHARED)}


# --- record ---


def report(done: Recorded) -> Report:
    """The file, and what its rollouts came to."""
    kept = f"{done.bytes / 1e6:.2f} MB, {counted(done.steps, 'step')} in full"
    return Report(
        "record", "record", str(done.path), f"{done.path}: {kept}", lambda: _recorded_json(done),
        heading=[f"{counted(done.tally.rollouts, 'rollout')} evaluated"],
        parts=[Part("Rollouts in full", [_rollouts_table(done)])], pace=done.pace,
    )  # fmt: skip


def _rollouts_table(done: Recorded) -> Table:
    cells, pace = done.tally.accessible, done.pace
    of, figures = ("rollout", "picked as", "ends", "step"), ("visited, %", "survived, %", "alive", "events")
    columns = (*of, *["minutes"] * bool(pace), *figures)
    table = make_table(columns, left=("picked as", "ends"), dropped=("events", "survived, %"))
    for row in done.rows:
        ends = row.outcome.replace("_", " ")
        shares = (in_percent(Fraction(count, cells)) for count in (row.visited, row.survived))
        times = (str(row.time), *[f"{pace.minutes * row.time:,.1f}"] * bool(pace))
        table.add_row(str(row.rollout), ", ".join(row.picks), ends, *times, *shares, str(row.alive), str(row.events))
    return table


def _recorded_json(done: Recorded) -> Json:
    """Of an interrupted recording, the rollouts that were done."""
    cells = done.tally.accessible
    rows = [
        asdict(row) | {"visited": row.visited / cells, "survived": row.survived / cells, "cells_visited": row.visited}
        for row in done.rows
    ]
    return {
        **({"partial": True} if done.partial else {}),
        "file": str(done.path),
        "bytes": done.bytes,
        "steps": done.steps,
        "rollouts": rows,
        "settings": done.settings.to_json(),
        "accessible": cells,
        "evaluate_seconds": done.evaluate_seconds,
        "record_seconds": done.record_seconds,
    }


def interrupted_lines(done: Recorded, asked: Path) -> list[str]:
    """What is said of an interrupted recording that should have gone to `asked`; nothing of a whole one."""
    if not done.partial:
        return []
    stays = "" if done.path == asked else f"; {asked} was there before and stays"
    count = f"{len(done.rows):,} of {counted(len(done.settings.ids), 'rollout')}"
    return [f"interrupted: {done.path} holds {count}{stays}"]


# --- replay ---


def replayed(found: Replayed) -> Report:
    """Whether everything is the same, as far as it was compared; JSON's `partial`: the file is not whole."""
    changed = {"path": str(found.path), "settings": found.settings.to_json(), "partial": bool(found.partial)}
    findings = []
    if not found.drawn:
        verdict = "rollouts identical, drawings not compared" if found.identical else "drawings not compared"
        findings = [f"made by another version (mrac-jax {found.settings.mrac_jax}): {verdict}"]
    return Report(
        "replay", "replay", str(found.path), f"{found.path}: {_verdict(found)}",
        lambda: asdict(found) | changed | {"identical": found.identical}, findings,
        took=[f"run again in {found.seconds:.1f} s, {found.engine}"],
    )  # fmt: skip


def _verdict(found: Replayed) -> str:
    messages = counted(found.messages, "message")
    if not found.identical:
        verb = "is" if found.messages == 1 else "are"
        return f"NOT identical: {found.difference} ({messages} before it {verb} the same)"
    rest = "" if found.everything else "; tally and outcomes were not run again: --all"
    if found.partial:
        how = f"the file {found.partial}" if found.partial == ENDS_EARLY else f"the file is {found.partial}"
        rollouts = f"{found.rollouts:,} of {counted(found.asked, 'rollout')}"
        return f"identical as far as it goes: {rollouts}; {how} ({messages}){rest}"
    what = "every message, drawn ones byte for byte" if found.drawn else "every event and step"
    return f"identical: {what}, of {counted(found.rollouts, 'rollout')} ({messages}){rest}"


# --- inspect ---


def inspected(found: Inspection, most_events: int | None) -> Report:
    """Contents, then each rollout with at most so many events of its timeline (None: all)."""
    kept = f"{found.bytes / 1e6:.2f} MB, {found.seconds:g} s, written by {found.library}"
    cut = [f"not the whole log: {found.partial}"] if found.partial else []
    parts = [Part(f"Rollout {one['rollout']}", notes=["", *_timeline(one, most_events)]) for one in found.rollouts]
    return Report(
        "inspect", "inspect", str(found.path), f"{found.path}: {kept}", lambda: _inspection_json(found),
        cut, heading=[_settings_line(found)], parts=[_topics(found), *parts],
    )  # fmt: skip


def _inspection_json(found: Inspection) -> Json:
    settings = None if found.settings is None else found.settings.to_json()
    return asdict(found) | {"path": str(found.path), "settings": settings}


def _settings_line(found: Inspection) -> str:
    settings, shape = found.settings, found.shape
    if settings is None or shape is None:
        return "no recording of mrac-jax: no settings and no world in it"
    some = f"{counted(settings.evaluated, 'rollout')} evaluated"
    evaluated = some if settings.evaluated else "these rollouts alone evaluated"
    kept = ", their outcomes kept" if settings.outcomes else ""
    checks = "" if settings.threat_checks == "every_visit" else ", threats at first visits alone"
    return (
        f"{settings.loop} loop{checks} on {shape[0]} x {shape[1]} cells, seed {settings.seed}, {evaluated}{kept}, "
        f"{settings.step_seconds:g} s a step, mrac-jax {settings.mrac_jax}"
    )


def _topics(found: Inspection) -> Part:
    table, later = make_table(("topic", "schema", "messages"), left=("topic", "schema")), 0
    for topic, kind in found.topics.items():
        parts = topic.split("/")
        if len(parts) == 4 and parts[1] == "robots" and parts[2] != "0":
            later += 1
        else:
            table.add_row(topic, kind["schema"], f"{kind['messages']:,}")
    others = [f"and {counted(later, 'topic')} like those of robot 0 for the other robots"] if later else []
    attached = ", ".join(f"{name} ({counted(size, 'byte')})" for name, size in found.attachments.items())
    return Part("Topics", [table], [*others, f"attachments: {attached}"])


def _timeline(rollout: Json, most: int | None) -> Iterator[str]:
    yield f"{rollout['text']} (from {rollout['begins_seconds']:g} s of the file)"
    events = [*enumerate(rollout["events"])]
    shown = sorted(events, key=lambda item: (item[1]["kind"] not in FIRST, item[0]))[:most]
    step = None
    for _, event in sorted(shown, key=lambda item: item[0]):
        yield f"  {'' if event['step'] == step else 'step ' + str(event['step']):>12}  {event['text']}"
        step = event["step"]
    if shown and len(shown) < len(events):
        yield f"  {'':>12}  and {counted(len(events) - len(shown), 'event')} more: {argument('events', 'all')}"


# --- recover ---


def recovered(found: Recovered) -> Report:
    """What was saved and what is lost; names from the file are quoted."""
    saved = f"{counted(found.messages, 'message')} in {counted(found.chunks, 'chunk')}"
    others = counted(len(found.attachments), "attachment"), counted(len(found.metadata), "metadata record")
    findings = [f"lost {lost}" for lost in found.lost]
    if found.lost_messages:
        findings.append(f"lost {counted(found.lost_messages, 'message')} in all")
    if found.complete:
        findings.append("nothing is lost")
    said = {"source": str(found.source), "out": str(found.out), "losses": len(found.lost), "complete": found.complete}
    return Report(
        "recover", "recover", str(found.source), f"saved {saved}, {', '.join(others)}",
        lambda: asdict(found) | said, findings, heading=[f"written to {found.out}"],
    )  # fmt: skip
