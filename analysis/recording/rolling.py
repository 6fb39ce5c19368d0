"""The rollouts that a recording is about: evaluated as a stream, chosen ones in full."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from analysis.kit.compiling import compiles_for
from analysis.kit.notes import Progress
from analysis.recording import contents
from analysis.recording.pick import Pick, Picker
from analysis.recording.viewers import schemas
from analysis.recording.viewers.topics import Message
from planner.arguments import SEED, Numbers, argument, check_word
from planner.errors import UsageError
from planner.limits import BLOCK
from planner.luck_names import LUCKS, LuckName
from planner.plans.plan import Plan
from planner.rollouts.names import ENGINES, EngineName
from planner.tally import RolloutResults, Tally
from planner.worlds.world import World

if TYPE_CHECKING:
    from planner.rollouts.engine import Engine

OUTCOME_COLUMNS = ("visited", "survived", "time", "alive", "outcome")


@dataclass(frozen=True)
class Request:
    """What to record.

    Attributes:
        ids: rollouts in full; empty: those that `picks` choose.
        picks: out of the evaluated ones. evaluated: how many, ids from 0; 0: only those in `ids`.
        outcomes: keep every evaluated rollout's outcome.
        loop, seed, engine, first_only: as in `analysis.evaluation.evaluate`; no byte of the file depends on the engine.
        luck: by which robots are stopped. step_seconds: time of a step.
        made: the plan is the planner's own, not a given one.
        scenario: the text of the scenario file, if there is one.
    """

    ids: tuple[int, ...] = ()
    picks: tuple[Pick, ...] = ()
    evaluated: int = 0
    outcomes: bool = False
    loop: Literal["closed", "open"] = "closed"
    seed: int = 0
    engine: EngineName = "auto"
    first_only: bool = False
    luck: LuckName = "tolerance"
    step_seconds: float = 1.0
    made: bool = True
    scenario: bytes | None = None

    def settings(self, ids: tuple[int, ...], picks: dict[str, int]) -> contents.Settings:
        """What the file says of it, once it is known which rollouts it holds."""
        return contents.Settings(
            self.loop, "first_visit" if self.first_only else "every_visit", self.seed, ids, picks, self.evaluated,
            self.outcomes, self.step_seconds, "made" if self.made else "given", contents.own_version(), luck=self.luck,
        )  # fmt: skip

    def check(self) -> None:
        """Raise UsageError for what cannot be recorded."""
        low, high = contents.STEP_SECONDS
        check_word("loop", self.loop, ("closed", "open"))
        check_word("engine", self.engine, ENGINES)
        check_word("luck", self.luck, LUCKS)
        SEED.check("seed", self.seed)
        Numbers(low, high, "seconds").check("step_seconds", self.step_seconds)
        if not self.ids and not self.picks:
            raise UsageError("nothing to record", expected=f"{argument('ids')} or {argument('picks')}")
        among = f"{argument('picks')} chooses among" if self.picks else f"{argument('outcomes')} are those of"
        if (self.picks or self.outcomes) and not self.evaluated:
            problem = f"{among} evaluated rollouts, and there are none"
            raise UsageError(problem, expected=argument("evaluated"))
        if self.first_only and self.loop == "open":
            problem = f"{argument('first_only', True)} needs the closed loop"
            raise UsageError(problem, fix=f"use {argument('loop', 'closed')}")


def engine_of(world: World, plan: Plan, request: Request) -> Engine:
    """Rolls out as the request says. Raises InputError."""
    from planner.rollouts.engine import Rolling, make_engine

    compiles_for(plan, request.loop)
    how = Rolling(request.loop, "step", request.first_only, request.seed, request.luck)
    return make_engine(plan, world, how, request.engine)


def tally_of(engine: Engine, ids: Iterable[int]) -> Tally:
    """The tally of some rollouts."""
    known = np.sort(np.fromiter(ids, dtype=np.int64))
    spans = np.split(known, np.flatnonzero(np.diff(known) != 1) + 1)
    tallies = [engine.tally(int(span[0]), len(span)) for span in spans]
    return sum(tallies[1:], start=tallies[0])


def chunks(engine: Engine, count: int, progress: Progress | None) -> Iterator[tuple[Tally, RolloutResults]]:
    """Rollouts 0 .. count - 1 as they come: (tally so far, results of the next ids)."""
    from planner.rollouts.engine import run_chunks

    for chunk in run_chunks(engine, count, results=True):
        assert chunk.results is not None
        yield chunk.tally, chunk.results
        if progress is not None:
            progress(chunk.tally.rollouts, count, chunk.seconds)


def evaluate(
    engine: Engine, request: Request, write: Callable[[Message], None], progress: Progress | None
) -> tuple[Tally, tuple[int, ...], dict[str, int]]:
    """(tally, ids to record, picks): everything that is evaluated, its outcomes written as they come."""
    if not request.evaluated:
        return tally_of(engine, request.ids), request.ids, {}
    picker, columns = Picker(engine.accessible), OutcomeColumns()
    for so_far, results in chunks(engine, request.evaluated, progress):
        tally = so_far
        if request.picks:
            picker.add(results)
        if request.outcomes:
            for message in columns.add(results):
                write(message)
    for message in columns.rest():
        write(message)
    picks = {pick.name: picker.choose(pick, request.seed) for pick in request.picks}
    return tally, request.ids or tuple(dict.fromkeys(picks.values())), picks


class OutcomeColumns:
    """Results as they come, as `/outcomes` messages of aligned blocks of BLOCK ids, all at time 0."""

    def __init__(self) -> None:
        self._waiting: RolloutResults | None = None

    def add(self, results: RolloutResults) -> Iterator[Message]:
        """The blocks that these results, of the next ids, complete."""
        known = results if self._waiting is None else RolloutResults.join([self._waiting, results])
        at = 0
        while (stop := (known.start + at) // BLOCK * BLOCK + BLOCK - known.start) <= len(known.visited):
            yield _outcome_message(known, at, stop)
            at = stop
        self._waiting = part_of(known, at, len(known.visited))

    def rest(self) -> Iterator[Message]:
        """The last block, if it is not full."""
        if self._waiting is not None and len(self._waiting.visited):
            yield _outcome_message(self._waiting, 0, len(self._waiting.visited))


def part_of(results: RolloutResults, start: int, stop: int) -> RolloutResults:
    """Rows `start .. stop - 1` of results."""
    names = ("visited", "survived", "time", "alive", "outcome", "bisected", "divided")
    columns = {name: getattr(results, name)[start:stop] for name in names}
    return replace(results, start=results.start + start, **columns)


def _outcome_message(results: RolloutResults, start: int, stop: int) -> Message:
    part = part_of(results, start, stop)
    columns = {name: getattr(part, name).astype(np.int64).tolist() for name in OUTCOME_COLUMNS}
    return Message("/outcomes", 0, schemas.Outcomes(first=part.start, **columns).SerializeToString())
