"""`mrac-jax replay`: roll the recorded rollouts out again from what is in the file, and compare message by message."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.kit.compiling import compiles_for
from analysis.kit.notes import Progress
from analysis.recording import contents
from analysis.recording.comparison import Difference, compare, compare_outcomes, may_be_lost, seconds_text
from analysis.recording.mcap.container import RECOVERED
from analysis.recording.mcap.reading import Log, open_log
from analysis.recording.pick import Picker, parse_picks
from analysis.recording.record import recorded_messages
from analysis.recording.rolling import chunks, tally_of
from analysis.recording.rollouts import outcomes_of_log
from analysis.recording.viewers.topics import DATA_TOPICS, Stage, type_of
from analysis.theory.bounds import all_bounds
from planner.errors import PlanError
from planner.mrac.make_plan import confirm_plan, make_plan
from planner.plans.plan import Plan
from planner.worlds.world import World

if TYPE_CHECKING:
    from planner.rollouts.engine import Engine
    from planner.rollouts.names import EngineName

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
    path: str | Path, engine: EngineName = "auto", *, everything: bool = False, progress: Progress | None = None
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
        InputError: the file cannot be read, or holds no recording.
    """
    from planner.rollouts.engine import choose_engine

    log, clock = open_log(path), time.perf_counter()
    settings = contents.read_settings(log.attachment(contents.SETTINGS), str(path))
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
    def __init__(self, log: Log, found: Replayed, progress: Progress | None) -> None:
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
        first_only, luck = self.settings.threat_checks == "first_visit", self.settings.luck
        how = Rolling(self.settings.loop, "step", first_only, self.settings.seed, luck)
        compiles_for(plan, self.settings.loop)
        engine = make_engine(plan, world, how, self.found.engine)
        self._rollouts(Stage(world, plan, self.settings.loop, self.settings.seed, first_only, luck), engine)
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
            if name == contents.METADATA and items != expected:
                wrong = sorted(key for key in {*items, *expected} if items.get(key) != expected.get(key))[0]
                said = f"{items.get(wrong)!r} where the attachments say {expected.get(wrong)!r}"
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
