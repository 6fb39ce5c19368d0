"""`mrac-jax replay`: roll the recorded rollouts out again from what is in the file, and compare message by message."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.bounds import all_bounds
from analysis.recording import contents
from analysis.recording.comparison import Difference, compare, seconds_text
from analysis.recording.pick import Picker, parse_picks
from analysis.recording.reading import Log, open_log
from analysis.recording.record import recorded_messages
from analysis.recording.rolling import (
    OUTCOME_COLUMNS,
    Progress,
    Request,
    Runner,
    make_runner,
)
from analysis.recording.rollouts import outcomes_of_log
from analysis.recording.topics import DATA_TOPICS, Stage, topic_types, type_of
from planner.errors import PlanError
from planner.plan import Plan
from planner.planner import confirm_plan, make_plan
from planner.world import World

if TYPE_CHECKING:
    from mrac_jax.batch import Engine

OUTCOMES = "/outcomes"


@dataclass(frozen=True)
class Replayed:
    """What a replay found.

    Attributes:
        path: the file. settings: what it says was recorded.
        difference: the first thing that is not the same, in words; "" when everything is.
        rollouts, messages: compared and found the same. drawn: drawn messages too, byte for byte; else data alone.
        everything: the evaluated rollouts were run again too, for tally, outcomes and picks.
        engine: that ran. seconds: the replay took.
    """

    path: Path
    settings: contents.Settings
    difference: str
    rollouts: int
    messages: int
    drawn: bool
    everything: bool
    engine: str
    seconds: float

    @property
    def identical(self) -> bool:
        """Whether nothing differs."""
        return not self.difference


def replay(
    path: str | Path, engine: Engine = "auto", *, everything: bool = False, progress: Progress | None = None
) -> Replayed:
    """Run a recording again and compare.

    Plan and formulas are checked too: the plan must be what follows from its allocation (and the allocation what the
    planner makes, unless a plan file was given). A recording of another version of this program is compared by its
    data topics alone.

    Args:
        engine: to run with; the answer is the same.
        everything: also run all evaluated rollouts, and compare tally, outcomes and picks.

    Raises:
        InputError: the file cannot be read, or holds no recording.
    """
    log, clock = open_log(path), time.perf_counter()
    settings = contents.read_settings(log.attachment(contents.SETTINGS), str(path))
    comparison = _Comparison(log, settings, engine, everything, progress)
    difference = ""
    try:
        comparison.run()
    except Difference as found:
        difference = str(found)
    return Replayed(
        path=Path(path),
        settings=settings,
        difference=difference,
        rollouts=comparison.rollouts,
        messages=comparison.messages,
        drawn=comparison.drawn,
        everything=everything or not settings.evaluated,
        engine=comparison.engine,
        seconds=time.perf_counter() - clock,
    )


class _Comparison:
    def __init__(
        self, log: Log, settings: contents.Settings, engine: Engine, everything: bool, progress: Progress | None
    ) -> None:
        from mrac_jax.batch import choose_engine

        self.log, self.settings, self.everything, self.progress = log, settings, everything, progress
        self.engine: Engine = choose_engine(engine)
        self.drawn = settings.mrac_jax == contents.own_version()
        self.rollouts = self.messages = 0

    def run(self) -> None:
        """Raise Difference at the first one."""
        source = str(self.log.path)
        world = contents.read_world(self.log.attachment(contents.WORLD), source)
        plan = self._plan(world, source)
        self._descriptions(world, plan)
        request = Request(
            ids=self.settings.ids,
            loop=self.settings.loop,
            seed=self.settings.seed,
            engine=self.engine,
            first_only=self.settings.threat_checks == "first_visit",
        )
        runner = make_runner(world, plan, request)
        stage = Stage(world, plan, self.settings.loop, self.settings.seed)
        self._rollouts(stage, runner)
        if self.everything or not self.settings.evaluated:
            self._evaluated(runner)

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
        if self.drawn and contents.plan_bytes(follows) != data:
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
            if name == contents.METADATA and items != expected:
                wrong = sorted(key for key in {*items, *expected} if items.get(key) != expected.get(key))[0]
                said = f"{items.get(wrong)!r} where the attachments say {expected.get(wrong)!r}"
                raise Difference(f"metadata: {wrong} is {said}")
        if self.drawn:
            if contents.bounds_bytes(all_bounds(plan, world)) != self.log.attachment(contents.BOUNDS):
                raise Difference(f"{contents.BOUNDS}: not the formulas of this plan")
            types = topic_types()
            for channel in self.log.channels.values():
                self._check_schema(channel.topic, channel.schema_id, channel.message_encoding, types)

    def _check_schema(self, topic: str, schema_id: int, encoding: str, types: dict[str, Any]) -> None:
        schema = self.log.schemas.get(schema_id)
        try:
            own = type_of(topic, types)
        except KeyError:
            raise Difference(f"a topic that is none of a recording's: {topic[:80]!r}") from None
        found = None if schema is None else (schema.name, schema.encoding, bytes(schema.data), encoding)
        if found != (own.name, own.encoding, own.data, own.message_encoding):
            raise Difference(f"{topic}: another schema than {own.name}")

    # --- the rollouts in full ---

    def _rollouts(self, stage: Stage, runner: Runner) -> None:
        topics = None if self.drawn else DATA_TOPICS
        stored = (message for message in self.log.messages(topics) if message.topic != OUTCOMES)
        for trace, made in recorded_messages(stage, runner.traces(self.settings.ids), self.settings.step_seconds):
            for message in made:
                if self.drawn or message.topic in DATA_TOPICS:
                    compare(next(stored, None), message, stage, trace.rollout, self.log.path)
                    self.messages += 1
            self.rollouts += 1
        extra = next(stored, None)
        if extra is not None:
            raise Difference(f"after the last rollout there is more: {extra.topic} at {seconds_text(extra.log_time)}")

    # --- what all evaluated rollouts came to ---

    def _evaluated(self, runner: Runner) -> None:
        count = self.settings.evaluated
        text, cells = (self.log.attachment(name) for name in (contents.TALLY, contents.TALLY_CELLS))
        stored = contents.read_tally(text, cells, str(self.log.path))
        outcomes = outcomes_of_log(self.log) if self.settings.outcomes else None
        if not count:
            self._same_tally(runner.tally_of(self.settings.ids), stored)
            return
        if outcomes is not None and not np.array_equal(outcomes.ids, np.arange(count)):
            raise Difference(f"{OUTCOMES}: {len(outcomes.ids)} outcomes, expected ids 0 to {count - 1}")
        picker = Picker(runner.accessible)
        for chunk in runner.chunks(0, count):
            results = chunk.results
            assert results is not None
            picker.add(results)
            for column in OUTCOME_COLUMNS if outcomes is not None else ():
                mine = getattr(results, column)
                theirs = getattr(outcomes, column)[results.start : results.start + len(mine)]
                wrong = np.flatnonzero(mine != theirs)
                if len(wrong):
                    said = f"{column} recorded {theirs[wrong[0]]}, replayed {mine[wrong[0]]}"
                    raise Difference(f"{OUTCOMES}: rollout {results.start + wrong[0]}: {said}")
            if self.progress is not None:
                self.progress(chunk.tally.rollouts, count, chunk.seconds)
            tally = chunk.tally
        self._same_tally(tally, stored)
        for name, chosen in self.settings.picks.items():
            found = picker.choose(parse_picks(name)[0], self.settings.seed)
            if found != chosen:
                raise Difference(f"{contents.SETTINGS}: {name} is rollout {found}, not {chosen}")

    def _same_tally(self, made: Any, stored: Any) -> None:
        stored = replace(stored, key=made.key) if not self.drawn else stored
        if made != stored:
            raise Difference(f"{contents.TALLY}: not the tally of these rollouts")


def _area_facts(area: Any) -> tuple[int, int, list[int]]:
    return area.level, area.robot, area.cells.tolist()
