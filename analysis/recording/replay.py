"""`mrac-jax inspect`: its contents, and its rollouts run again and compared message by message (`--replay`)."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from rich.table import Table

from analysis.recording import contents
from analysis.recording.container import RECOVERED, Log, LogMessage, Recovered, open_log
from analysis.recording.contents import RecordedOutcomes, RecordedRollout, decode, read_outcomes, read_rollouts
from analysis.recording.frames import Line, end_text, event_line
from analysis.recording.record import Picker, Recorded, chunks, parse_picks, recorded_messages, tally_of
from analysis.recording.viewers import topics as schemas
from analysis.recording.viewers.topics import DATA_TOPICS, Message, Stage, type_of
from analysis.report.model import Report, Section
from analysis.sampling import RolloutChoices, make_engine_for
from analysis.theory.bounds import all_bounds
from analysis.utils.notes import ProgressCallback
from analysis.utils.tables import make_table
from planner.arguments import argument
from planner.errors import PER_VISIT, InputError, PlanError
from planner.formatting import counted, in_percent
from planner.json_objects import WithKeys
from planner.make_plan import confirm_plan, make_plan
from planner.plan.plan import Plan
from planner.simulator.codes import EventKind
from planner.tally import RolloutResults
from planner.world.world import World

if TYPE_CHECKING:
    from planner.rollouts.engine import Engine
    from planner.rollouts.names import EngineName

# Comparison of a stored message with the replayed one.

_REPEATED = ("/rollout/event", "/events")
"""Topics with several messages at one time."""


class Difference(Exception):
    """The replay differs from the recording; the text says how."""


def may_be_lost(stored: LogMessage, made: Message) -> bool:
    """Whether the next stored message of a log with gaps can be later than this message of the replay."""
    if stored.log_time != made.time:
        return stored.log_time > made.time
    return stored.topic != made.topic or (made.topic in _REPEATED and stored.data != made.data)


def compare(stored: LogMessage, made: Message, stage: Stage, rollout: int, source: Path) -> None:
    """Raise Difference unless the stored message equals the replayed one."""
    where = f"rollout {rollout}, {seconds_text(made.time)}"
    # Most messages are equal, so bytes are compared before anything is decoded.
    if (stored.topic, stored.log_time) == (made.topic, made.time) and stored.data == made.data:
        if stored.publish_time != made.time:
            raise Difference(f"{where}: {made.topic} says that it was published at {stored.publish_time} ns")
        return
    if stored.topic != made.topic:
        said, expected = _text(stored.topic, stored.data, stage), _text(made.topic, made.data, stage)
        raise Difference(f"{where}: recorded {said}; the replay has {expected}")
    if stored.log_time != made.time:
        raise Difference(f"{where}: {made.topic} is at {seconds_text(stored.log_time)}")
    if made.topic not in DATA_TOPICS:
        raise Difference(f"{where}: {made.topic} differs")
    raise Difference(f"{where}: {_fields(stored, made, stage, source)}")


def compare_outcomes(recorded: RecordedOutcomes, results: RolloutResults) -> None:
    """Raise Difference unless the recorded outcomes of these rollouts equal the replayed ones."""
    stop = results.start + len(results.visited)
    there = slice(*np.searchsorted(recorded.ids, (results.start, stop)))
    ids = recorded.ids[there]
    for column in contents.OUTCOME_COLUMNS:
        mine, theirs = getattr(results, column)[ids - results.start], getattr(recorded, column)[there]
        wrong = np.flatnonzero(mine != theirs)
        if len(wrong):
            said = f"{column} recorded {theirs[wrong[0]]}, replayed {mine[wrong[0]]}"
            raise Difference(f"/outcomes: rollout {ids[wrong[0]]}: {said}")


def _fields(stored: LogMessage, made: Message, stage: Stage, source: Path) -> str:
    """The first difference between the fields of two data messages."""
    if made.topic == "/rollout/event":
        said, expected = _text(made.topic, stored.data, stage), _text(made.topic, made.data, stage)
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
    return f"{made.topic}: another encoding"


def _text(topic: str, data: bytes, stage: Stage) -> str:
    """A message as text."""
    if topic != "/rollout/event":
        return topic
    try:
        event = schemas.Event.FromString(bytes(data))
        row = np.array([event.step, event.robot, event.kind, event.area, event.other])
        return f'event "{event_line(row, stage.world, stage.plan).text}"'
    except (ValueError, IndexError, DecodeError):  # a cell off the map, an unknown kind
        return f"{topic} with invalid values"


def seconds_text(nanoseconds: int) -> str:
    """A time in the file."""
    return f"{nanoseconds / 1e9:g} s"


OUTCOMES = "/outcomes"
ENDS_EARLY = "ends early"


@dataclass
class Replayed(WithKeys):
    """The result of a replay, also while it runs.

    Attributes:
        path: the file. settings: of the recording.
        difference: the first difference as text; "" if there is none.
        rollouts, messages: numbers of equal complete rollouts and messages. asked: rollouts in the recording.
        partial: "" for a complete file, else how it is incomplete.
        drawn: drawn messages were also compared, byte for byte; else only data messages.
        everything: the evaluated rollouts were also repeated, for tally, outcomes and picks.
        engine: engine of the rollouts. seconds: run time.
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
    json_keys = """
        path settings difference rollouts messages asked partial=is_partial drawn everything engine seconds identical
    """

    @property
    def is_partial(self) -> bool:
        """Whether the file is incomplete."""
        return bool(self.partial)

    @property
    def identical(self) -> bool:
        """Whether no difference was found, in a partial file up to its end."""
        return not self.difference


def replay(
    path: str | Path, engine: EngineName = "auto", *, everything: bool = False, progress: ProgressCallback | None = None
) -> Replayed:
    """Repeat a recording and compare.

    Plan and formulas are checked too: the plan must follow from its allocation (and the allocation from the planner,
    unless a plan file was given). A recording of another version of the program is compared by its data topics only. In
    a file that ends early or was recovered, all stored messages must be equal; lost ones may be missing.

    Args:
        path: the recording. engine: for the rollouts; the result does not depend on it.
        everything: also repeat all evaluated rollouts, and compare tally, outcomes and picks.
        progress: called while evaluated rollouts are repeated.

    Raises:
        InputError: the file cannot be read, is not a recording, or has random numbers for each visit.
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
        """Raise Difference at the first difference."""
        source, settings = str(self.log.path), self.settings
        world = contents.read_world(self.log.attachment(contents.WORLD), source)
        plan = self._plan(world, source)
        self._descriptions(world, plan)
        stage = Stage(world, plan, settings.loop, settings.seed, settings.threat_checks == "first_visit")
        choices = RolloutChoices(stage.loop, engine=self.found.engine, seed=stage.seed, first_only=stage.first_only)
        engine = make_engine_for(world, plan, choices)
        self._rollouts(stage, engine)
        if self.found.everything:
            self._evaluated(engine)

    # --- attachments and metadata ---

    def _plan(self, world: World, source: str) -> Plan:
        """The plan of the planner; a given plan file must follow from its allocation. Raises Difference."""
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
        """Check metadata, formulas and schemas, and that no attachment occurs twice."""
        names = [attached.name for attached in self.log.attachments]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise Difference(f"the attachment {twice[0]} occurs {names.count(twice[0])} times")
        expected = contents.metadata_of(self.settings, world, len(plan.robots))
        for name, items in self.log.metadata:
            said_of = {key: value for key, value in items.items() if key != "mode"}  # 0.3 wrote it too
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
            raise Difference(f"an unknown topic: {topic[:80]!r}") from None
        found = None if schema is None else (schema.name, schema.encoding, bytes(schema.data), encoding)
        if found != (own.name, own.encoding, own.data, own.message_encoding):
            raise Difference(f"{topic}: the schema is not {own.name}")

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
            raise Difference(f"messages after the last rollout: {kept.topic} at {seconds_text(kept.log_time)}")

    # --- results of all evaluated rollouts ---

    def _evaluated(self, engine: Engine) -> None:
        count = self.settings.evaluated
        if self._is_lost(contents.TALLY) or self._is_lost(contents.TALLY_CELLS):
            return
        text, cells = (self.log.attachment(name) for name in (contents.TALLY, contents.TALLY_CELLS))
        stored = contents.read_tally(text, cells, str(self.log.path))
        outcomes = read_outcomes(self.log) if self.settings.outcomes else None
        if not count:
            self._same_tally(tally_of(engine, self.settings.ids), stored)
            return
        # Check the ids first: a missing outcome would otherwise pass.
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
        """Whether the ids of outcomes are the expected ones; recovered files may lack some."""
        return bool(ids.max(initial=0) < count) if self.recovered else np.array_equal(ids, np.arange(count))

    def _same_tally(self, made: Any, stored: Any) -> None:
        # Another version may have another key for equal counts.
        stored = replace(stored, key=made.key) if not self.found.drawn else stored
        if made != stored:
            raise Difference(f"{contents.TALLY}: not the tally of these rollouts")


def _area_facts(area: Any) -> tuple[int, int, list[int]]:
    return area.level, area.robot, area.cells.tolist()


# `mrac-jax inspect`: contents of a recording, and each rollout with its events as text.


@dataclass(frozen=True)
class Topic:
    """The schema of a topic, and its number of messages."""

    schema: str
    messages: int


@dataclass(frozen=True)
class Timeline:
    """A recorded rollout.

    Attributes:
        begins_seconds: in the file. time: steps. visited, survived: fractions of the accessible cells.
        robots, alive: numbers, the second at the end. text: its end. events: in order.
    """

    rollout: int
    begins_seconds: float
    outcome: str
    time: int
    visited: float
    survived: float
    robots: int
    alive: int
    text: str
    events: list[Line]


@dataclass(frozen=True)
class Inspection(WithKeys):
    """Contents of a log.

    Attributes:
        partial: why it is incomplete. settings: None for a log of another program. shape: of the world.
        topics, rollouts: of the file. attachments: bytes of each.
    """

    path: Path
    bytes: int
    library: str
    seconds: float
    partial: str
    settings: contents.Settings | None
    shape: tuple[int, int] | None
    topics: dict[str, Topic]
    attachments: dict[str, int]
    metadata: dict[str, dict[str, str]]
    rollouts: list[Timeline]


def inspect(path: str | Path) -> Inspection:
    """List the contents of a log; of other programs' logs only the topics. Raises InputError if it cannot be read."""
    log = open_log(path)
    names = [attached.name for attached in log.attachments]
    ours = contents.SETTINGS in names and contents.WORLD in names
    settings, world, plan = None, None, None
    if ours:
        settings = contents.read_settings(log.attachment(contents.SETTINGS), str(path))
        world = contents.read_world(log.attachment(contents.WORLD), str(path))
        plan = contents.read_plan(log.attachment(contents.PLAN), world, str(path)) if contents.PLAN in names else None
    schemas_of, counts, last = dict[str, str](), Counter[str](), 0
    for message in log.messages():
        schemas_of.setdefault(message.topic, "" if message.schema is None else message.schema.name)
        counts[message.topic] += 1
        last = max(last, message.log_time)
    return Inspection(
        path=Path(path),
        bytes=Path(path).stat().st_size,
        library=log.library,
        seconds=last / 1e9,
        partial=log.partial,
        settings=settings,
        shape=None if world is None else world.shape,
        topics={topic: Topic(schemas_of[topic], counts[topic]) for topic in sorted(counts)},
        attachments={attached.name: len(attached.data) for attached in log.attachments},
        metadata=dict(log.metadata),
        rollouts=[] if world is None else [_rollout(one, world, plan, log.path) for one in read_rollouts(log)],
    )


def _rollout(one: RecordedRollout, world: World, plan: Plan | None, source: Path) -> Timeline:
    trace = one.trace
    try:
        lines = [event_line(row, world, plan) for row in trace.events]
    except (ValueError, IndexError) as error:
        raise InputError(f"rollout {trace.rollout}: an invalid event ({error})", source=source) from error
    cells = max(one.accessible, 1)
    visited, survived, alive = (int(values[-1]) for values in (one.visited, one.survived, one.alive))
    ended = trace.outcome if plan is None else plan.ending(trace.outcome)
    text = end_text(trace, ended, visited, survived, cells, alive)
    return Timeline(
        trace.rollout, float(one.times[0]) / 1e9, ended.word, trace.time, visited / cells, survived / cells,
        trace.cells.shape[1], alive, text, lines,
    )  # fmt: skip


# Reports of `record`, `replay`, `inspect` and `recover`.

MOST_LINES = 40
"""Events shown for a rollout: losses, reallocations and shares take precedence."""
OF_LATER = re.compile(r"/robots/(?!0/)[^/]*/[^/]*")
"""Topics of the robots after the first."""
FIRST = {EventKind.HIT, EventKind.REALLOCATED, EventKind.SHARED}


# --- record ---


def report(done: Recorded) -> Report:
    """The file, and the results of its rollouts."""
    kept = f"{done.bytes / 1e6:.2f} MB, {counted(done.steps, 'step')} in full"
    return Report(
        "record", "record", str(done.path), f"{done.path}: {kept}", done,
        heading=[f"{counted(done.tally.rollouts, 'rollout')} evaluated"],
        parts=[Section("Rollouts in full", [_rollouts_table(done)])], pace=done.pace,
    )  # fmt: skip


def _rollouts_table(done: Recorded) -> Table:
    pace = done.pace
    of, figures = ("rollout", "picked as", "ends", "step"), ("visited, %", "survived, %", "alive", "events")
    columns = (*of, *["minutes"] * bool(pace), *figures)
    rows = []
    for row in done.rows:
        ends = row.outcome.replace("_", " ")
        shares = in_percent(row.visited), in_percent(row.survived)
        times = (str(row.time), *[f"{pace.minutes * row.time:,.1f}"] * bool(pace))
        rows.append((str(row.rollout), ", ".join(row.picks), ends, *times, *shares, str(row.alive), str(row.events)))
    return make_table(columns, rows=rows, left=("picked as", "ends"), dropped=("events", "survived, %"))


def interrupted_lines(done: Recorded, asked: Path) -> list[str]:
    """The note on an interrupted recording for the target `asked`; empty for a complete one."""
    if not done.partial:
        return []
    stays = "" if done.path == asked else f"; {asked} existed before and is kept"
    count = f"{len(done.rows):,} of {counted(len(done.settings.ids), 'rollout')}"
    return [f"interrupted: {done.path} holds {count}{stays}"]


# --- replay ---


def replayed(found: Replayed) -> Report:
    """The result of the comparison; JSON's `partial`: the file is incomplete."""
    findings = []
    if not found.drawn:
        verdict = "rollouts identical, drawings not compared" if found.identical else "drawings not compared"
        findings = [f"written by another version (mrac-jax {found.settings.mrac_jax}): {verdict}"]
    return Report(
        "replay", "replay", str(found.path), f"{found.path}: {_verdict(found)}",
        found, findings,
        took=[f"repeated in {found.seconds:.1f} s, {found.engine}"],
    )  # fmt: skip


def _verdict(found: Replayed) -> str:
    messages = counted(found.messages, "message")
    if not found.identical:
        verb = "is" if found.messages == 1 else "are"
        return f"NOT identical: {found.difference} ({messages} before it {verb} equal)"
    rest = "" if found.everything else "; tally and outcomes were not compared: add --all"
    if found.partial:
        how = f"the file {found.partial}" if found.partial == ENDS_EARLY else f"the file is {found.partial}"
        rollouts = f"{found.rollouts:,} of {counted(found.asked, 'rollout')}"
        return f"identical as far as it goes: {rollouts}; {how} ({messages}){rest}"
    what = "every message, drawn ones byte for byte" if found.drawn else "every event and step"
    return f"identical: {what}, of {counted(found.rollouts, 'rollout')} ({messages}){rest}"


# --- inspect ---


def inspected(found: Inspection, most_events: int | None) -> Report:
    """Contents, then each rollout with at most `most_events` events of its timeline (None: all)."""
    kept = f"{found.bytes / 1e6:.2f} MB, {found.seconds:g} s, written by {found.library}"
    cut = [f"incomplete log: {found.partial}"] if found.partial else []
    parts = [Section(f"Rollout {one.rollout}", notes=["", *_timeline(one, most_events)]) for one in found.rollouts]
    return Report(
        "inspect", "inspect", str(found.path), f"{found.path}: {kept}", found,
        cut, heading=[_settings_line(found)], parts=[_topics(found), *parts],
    )  # fmt: skip


def _settings_line(found: Inspection) -> str:
    settings, shape = found.settings, found.shape
    if settings is None or shape is None:
        return "not a recording of mrac-jax: no settings and no world"
    some = f"{counted(settings.evaluated, 'rollout')} evaluated"
    evaluated = some if settings.evaluated else "only these rollouts evaluated"
    kept = ", their outcomes kept" if settings.outcomes else ""
    checks = "" if settings.threat_checks == "every_visit" else ", threats act only at first visits"
    return (
        f"{settings.loop} loop{checks} on {shape[0]} x {shape[1]} cells, seed {settings.seed}, {evaluated}{kept}, "
        f"{settings.step_seconds:g} s per step, mrac-jax {settings.mrac_jax}"
    )


def _topics(found: Inspection) -> Section:
    later = set(filter(OF_LATER.fullmatch, found.topics))
    rows = [(name, of.schema, f"{of.messages:,}") for name, of in found.topics.items() if name not in later]
    table = make_table(("topic", "schema", "messages"), rows=rows, left=("topic", "schema"))
    others = [f"and {counted(len(later), 'topic')} like those of robot 0 for the other robots"] * bool(later)
    attached = ", ".join(f"{name} ({counted(size, 'byte')})" for name, size in found.attachments.items())
    return Section("Topics", [table], [*others, f"attachments: {attached}"])


def _timeline(rollout: Timeline, most: int | None) -> Iterator[str]:
    yield f"{rollout.text} (from {rollout.begins_seconds:g} s of the file)"
    events = rollout.events
    shown = sorted(range(len(events)), key=lambda place: (events[place].kind not in FIRST, place))[:most]
    step = None
    for event in (events[place] for place in sorted(shown)):
        yield f"  {'' if event.step == step else f'step {event.step}':>12}  {event.text}"
        step = event.step
    if shown and len(shown) < len(events):
        yield f"  {'':>12}  and {counted(len(events) - len(shown), 'event')} more: {argument('events', 'all')}"


# --- recover ---


def recovered(found: Recovered) -> Report:
    """The saved and the lost parts; names from the file are quoted."""
    saved = f"{counted(found.messages, 'message')} in {counted(found.chunks, 'chunk')}"
    others = counted(len(found.attachments), "attachment"), counted(len(found.metadata), "metadata record")
    findings = [f"lost {lost}" for lost in found.lost]
    if found.lost_messages:
        findings.append(f"lost {counted(found.lost_messages, 'message')} in all")
    if found.complete:
        findings.append("nothing is lost")
    return Report(
        "recover", "recover", str(found.source), f"saved {saved}, {', '.join(others)}",
        found, findings, heading=[f"written to {found.out}"],
    )  # fmt: skip
