"""Which rollout is picked: against sorting all of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.recording.record import Pick, Picker, parse_ids, parse_picks
from planner.errors import UsageError
from planner.tally import RolloutResults

ROWS = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.integers(0, 4)), min_size=1, max_size=60)


def results(rows: list[tuple[int, int, int]], start: int) -> RolloutResults:
    visited, survived, time = (np.array(column, dtype=np.int32) for column in zip(*rows, strict=True))
    alive = np.zeros(len(rows), dtype=np.int32)
    return RolloutResults(start, visited, survived, time, alive, alive.astype(np.int8))


def picker_of(rows: list[tuple[int, int, int]], cut: int) -> Picker:
    """All rows, handed over in parts of `cut`."""
    picker = Picker(5)
    for start in range(0, len(rows), cut):
        picker.add(results(rows[start : start + cut], start))
    return picker


@given(rows=ROWS, cut=st.integers(1, 60), q=st.sampled_from([0.001, 0.05, 0.25, 0.5, 0.9, 0.999]))
def test_a_quantile_is_the_best_of_those_with_that_coverage(
    rows: list[tuple[int, int, int]], cut: int, q: float
) -> None:
    chosen = picker_of(rows, cut).choose(Pick("quantile", q), 0)
    at = sorted(visited for visited, _, _ in rows)[max(int(np.ceil(q * len(rows) - 1e-9)) - 1, 0)]
    same = [(-survived, time, number) for number, (visited, survived, time) in enumerate(rows) if visited == at]
    assert chosen == min(same)[2]


@given(rows=ROWS, cut=st.integers(1, 60))
def test_worst_and_best(rows: list[tuple[int, int, int]], cut: int) -> None:
    picker = picker_of(rows, cut)
    worst = min((visited, survived, -time, number) for number, (visited, survived, time) in enumerate(rows))
    best = min((-visited, -survived, time, number) for number, (visited, survived, time) in enumerate(rows))
    assert picker.choose(*parse_picks("worst"), 0) == worst[3]
    assert picker.choose(*parse_picks("best"), 0) == best[3]


def test_random_is_any_of_them_by_the_seed_alone() -> None:
    rows = [(1, 1, 1)] * 10
    chosen = [picker_of(rows, 3).choose(Pick("random", None), seed) for seed in range(300)]
    assert chosen == [picker_of(rows, 7).choose(Pick("random", None), seed) for seed in range(300)]
    assert set(chosen) == set(range(10))


def test_names() -> None:
    assert [pick.q for pick in parse_picks("worst,median,best,random,quantile:0.05,quantile:.9")] == [
        0.0,
        0.5,
        1.0,
        None,
        0.05,
        0.9,
    ]
    assert len(parse_picks("best,best")) == 1


@pytest.mark.parametrize(
    "text", ["", "Best", "quantile", "quantile:", "quantile:0", "quantile:1", "quantile:1.5", "quantile:-.5", "best,",
             "quantile:nan", "quantile:1e-3"],
)  # fmt: skip
def test_wrong_names_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"^pick "):
        parse_picks(text)


def test_ids() -> None:
    assert parse_ids("0,5,7-9,8", 10) == (0, 5, 7, 8, 9)
    assert parse_ids("4294967295", 10) == (2**32 - 1,)


@pytest.mark.parametrize("text", ["", "a", "-1", "5-3", "1,", "1.5", "4294967296", "0-10", "0-99999999999", "٣"])
def test_wrong_ids_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"^ids "):
        parse_ids(text, 10)
