"""Traces and tallies."""

import json
import re
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import pytest
from helpers import play_both_ways
from hypothesis import given
from hypothesis import strategies as st

from analysis.recording.contents import read_tally, tally_bytes
from analysis.sweeps.store_files import pack, unpack
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.settings import Settings
from planner.simulator.codes import NO_AREA, NO_ROBOT, Doing, EventKind, Outcome
from planner.tally import (
    ByRobots,
    RolloutResults,
    Tally,
    TallyError,
    counts_by_word,
    counts_of_words,
    no_counts,
    tally_key,
)
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# Traces: the compiled simulator's are those of it as Python, event for event, and tell what the counts tell.

TEAMS = ((6, 9, 1), (9, 6, 3), (7, 7, 6), (3, 14, 4), (5, 8, 20))
KINDS: tuple[Kind, ...] = ("contiguous", "scattered")


def random_case(seed: int, settings: Settings | None = None) -> tuple[World, Plan]:
    height, width, robots = TEAMS[seed % len(TEAMS)]
    world = random_world(height, width, ThreatPattern(KINDS[seed % 2], 4, seed=seed))
    return world, make_plan(world, place_starts(world, robots)[0], settings or Settings())


def test_a_trace_tells_what_was_counted() -> None:
    for seed in range(6):
        world, plan = random_case(seed)
        loop = compile_closed_loop(plan, world)
        _, singles = run_range(loop, 5, 0, 12, singles=True)
        for trace in trace_rollouts(loop, 5, range(12)):
            one = trace.rollout
            assert len(np.unique(trace.cells)) == singles.visited[one]
            assert (trace.time, int(trace.outcome)) == (singles.time[one], singles.outcome[one])
            assert np.count_nonzero(trace.doing[-1] != Doing.DEAD) == singles.alive[one]
            kinds = trace.events[:, 2].tolist()
            assert kinds.count(EventKind.SHARED) == singles.bisected[one] + singles.divided[one]
            assert kinds.count(EventKind.HIT) == plan.starts.shape[0] - singles.alive[one]


def test_events_announce_every_area() -> None:
    """Ids follow one another: those of t = 0, then as many as REALLOCATED and SHARED say."""
    for seed in range(10):
        world, plan = random_case(seed)
        for trace in trace_rollouts(compile_closed_loop(plan, world), 5, range(8)):
            made = np.isin(trace.events[:, 2], (EventKind.REALLOCATED, EventKind.SHARED))
            total = len(plan.areas) + int(trace.events[made, 4].sum())
            assert trace.area_of.max() < total
            assert np.array_equal(trace.area_of == NO_AREA, ~world.accessible(plan.starts).ravel())
            assert (trace.areas[trace.doing == Doing.DEAD] == NO_AREA).all()
            got = trace.events[trace.events[:, 2] == EventKind.ALLOCATED, 3]
            given = [number for number, area in enumerate(plan.areas) if area.robot != NO_ROBOT]
            assert set(trace.areas[trace.areas != NO_AREA].tolist()) <= set(got.tolist()) | set(given)


def test_traces_need_no_order_and_no_neighbours() -> None:
    world, plan = random_case(3)
    loop = compile_closed_loop(plan, world)
    whole = trace_rollouts(loop, 5, range(9))
    assert trace_rollouts(loop, 5, [7, 2]) == [whole[7], whole[2]]
    assert whole[7] != whole[2]
    assert trace_rollouts(loop, 5, []) == []


def test_an_owner_that_shares_before_it_has_entered_its_start() -> None:
    nan = np.nan
    for threat, starts in (
        ([[nan, 0, nan], [0, 0, 0]], [(0, 1), (1, 0)]),
        ([[0, nan, 0], [0, 0.2, 0]], [(0, 0), (1, 0)]),
    ):
        world = World.create(np.array(threat, dtype=np.float32))
        play_both_ways(make_plan(world, np.array(starts)), world, 3, 20)


# Tallies add exactly, in any order, and refuse what would count twice.

EMPTY = Tally.empty("plan/open/fast/0", (2, 3), robots=2, accessible=5, last_step=4)


def holding(start: int, stop: int) -> Tally:
    """A tally whose every count is the number of its rollouts."""
    counts = {name: values + (stop - start) for name, values in EMPTY.counts().items()}
    return replace(EMPTY, ids=((start, stop),), **counts)


@given(st.lists(st.integers(0, 40), min_size=1, max_size=8, unique=True), st.randoms(use_true_random=False))
def test_parts_in_any_order_add_to_the_whole(cuts: list[int], random: Random) -> None:
    edges = [0, *(cut + 1 for cut in sorted(cuts)), 50]
    parts = [holding(a, b) for a, b in pairwise(edges)]
    random.shuffle(parts)
    assert sum(parts, start=EMPTY) == holding(0, 50)


def test_gaps_stay_gaps() -> None:
    total = holding(10, 20) + holding(0, 5) + holding(20, 21)
    assert total.ids == ((0, 5), (10, 21))
    assert total.rollouts == 16
    assert total != holding(0, 16)


@pytest.mark.parametrize(("first", "second"), [((0, 10), (9, 12)), ((5, 6), (0, 10)), ((3, 4), (3, 4))])
def test_overlapping_ids_are_an_error(first: tuple[int, int], second: tuple[int, int]) -> None:
    with pytest.raises(TallyError, match="counted twice"):
        holding(*first) + holding(*second)


def test_different_things_are_an_error() -> None:
    for other in (replace(EMPTY, key=tally_key("plan", "closed", 1)), replace(EMPTY, shape=(3, 2))):
        with pytest.raises(TallyError, match="different plans"):
            EMPTY + other
    with pytest.raises(TallyError, match="different teams"):
        EMPTY + Tally.empty(EMPTY.key, EMPTY.shape, robots=3, accessible=5)


def test_times_of_different_lengths_add() -> None:
    long = Tally.empty(EMPTY.key, EMPTY.shape, robots=2, accessible=5, last_step=9)
    total = holding(0, 3) + long
    assert len(total.time) == len(total.new_visited) == 10
    assert total == holding(0, 3)
    assert total.time[:5].sum() == 15 and total.time[5:].sum() == 0


def test_adding_changes_neither_part() -> None:
    first, second = holding(0, 3), holding(3, 5)
    _ = first + second
    assert first == holding(0, 3) and second == holding(3, 5)
    assert (first + second).visits.dtype == np.int64


def test_every_outcome_has_its_place() -> None:
    assert [outcome.value for outcome in Outcome] == list(range(len(EMPTY.outcomes)))


def test_the_table_of_outcomes_is_that_of_the_docs() -> None:
    text = (Path(__file__).parent.parent / "docs" / "mission.md").read_text(encoding="utf-8")
    rows = re.findall(r"^(\d+)\. `(\w+)`", text, re.MULTILINE)
    assert rows == [(str(int(outcome)), outcome.word) for outcome in Outcome]


def test_counts_have_the_code_of_the_step_limit_for_a_deadline() -> None:
    cut = counts_by_word([1, 0, 0, 5, 0, 2], deadline=True)
    assert cut == dict.fromkeys(cut, 0) | {"complete": 1, "deadline": 5, "not_worth_the_risk": 2}
    limit = counts_by_word([1, 0, 0, 5], deadline=False)
    assert limit == dict.fromkeys((outcome.word for outcome in Outcome), 0) | {"complete": 1, "step_limit": 5}
    assert counts_of_words(cut) == [1, 0, 0, 5, 0, 2, 0, 0]
    with pytest.raises(KeyError):
        counts_of_words({"abandoned": 1})


def test_a_tally_in_a_recording_of_0_3_is_read() -> None:
    tally = replace(EMPTY, ids=((0, 21),), outcomes=np.array([6, 5, 4, 3, 2, 1, 0, 0]))
    for deadline in (False, True):
        text, cells = tally_bytes(tally, deadline)
        said = json.loads(text)
        assert said["outcomes"]["deadline" if deadline else "step_limit"] == 3
        assert read_tally(text, cells, "here") == tally
    said["outcomes"] = {"complete": 6, "stopped": 5, "stuck": 4, "timeout": 3, "path_end": 2, "called_off": 1}
    assert read_tally(json.dumps(said).encode(), cells, "here") == tally


def test_results_join_only_in_sequence() -> None:
    def results(start: int, count: int) -> RolloutResults:
        numbers = np.arange(start, start + count, dtype=np.int32)
        return RolloutResults(start, numbers, numbers, numbers, numbers, np.zeros(count, np.int8))

    joined = RolloutResults.join([results(4, 3), results(7, 2)])
    assert joined.start == 4 and joined.visited.tolist() == [4, 5, 6, 7, 8]
    with pytest.raises(TallyError, match="do not follow"):
        RolloutResults.join([results(4, 3), results(8, 2)])


@dataclass(frozen=True, eq=False)
class WithHelp(Tally):
    helped: ByRobots = field(default_factory=no_counts)
    """Rollouts by robots that took over another's area: one line, and everything below."""


def test_a_new_count_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    old = WithHelp(EMPTY.key, EMPTY.shape, ((0, 5),), **EMPTY.counts())
    new = replace(WithHelp.empty(EMPTY.key, EMPTY.shape, 2, 5, 4), ids=((5, 8),), helped=np.array([0, 2, 1]))
    assert "helped" not in old.counts() and old.helped.size == 0
    both = old + new
    assert isinstance(both, WithHelp) and both.ids == ((0, 8),) and both.helped.tolist() == [0, 2, 1]
    assert (both + replace(new, ids=((9, 12),))).helped.tolist() == [0, 4, 2]
    assert both != replace(both, helped=np.array([0, 2, 2])) and both == replace(both, helped=np.array([0, 2, 1, 0]))
    assert pack(replace(old, key="k")) == pack(replace(EMPTY, key="k"))  # an empty one leaves no trace in a store
    monkeypatch.setattr("analysis.sweeps.store_files.Tally", WithHelp)
    for tally in (old, new):
        assert unpack(pack(tally), tally.ids) == tally
    monkeypatch.setattr("analysis.recording.contents.Tally", WithHelp)
    monkeypatch.setattr("analysis.recording.contents.AXES", WithHelp.axes())
    for tally in (old, new):
        assert read_tally(*tally_bytes(tally), "here") == tally
