"""Successive halving on common luck, and the intervals of its verdicts."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from analysis.estimators.racing import Halving, schedule
from analysis.estimators.trial import Known, Sampled
from analysis.statistics.estimates import bet_interval
from planner.simulator.exact_tree import WHOLE, Tree
from planner.simulator.state import make_counts
from planner.tally import RolloutResults, Tally

CELLS = 100


class Fake:
    """Rollout r of a contender visits `40 + 2 contender + luck(r)` cells, the same luck for all; or that is known."""

    def __init__(self, asked: list[tuple[int, int, int]], contender: int, known: bool = False) -> None:
        self.asked, self.contender, self.is_known = asked, contender, known

    def sample(self, start: int, count: int) -> Sampled:
        self.asked.append((self.contender, start, count))
        luck = np.random.default_rng(7).integers(0, 20, 10_000)[start : start + count]
        return sampled((40 + 2 * self.contender + luck).astype(np.int32), start)

    def known(self, share: float) -> Known | None:
        return known(40 + 2 * self.contender) if self.is_known else None


def sampled(visited: np.ndarray, start: int = 0, lost: int = 0, robots: int = 4) -> Sampled:
    zeros = np.zeros(len(visited), dtype=np.int32)
    results = RolloutResults(start, visited, visited, zeros, zeros + robots - lost, zeros.astype(np.int8))
    tally = replace(Tally.empty("", (1, CELLS), robots, CELLS), ids=((start, start + len(visited)),))
    return Sampled(replace(tally, visited=np.bincount(visited, minlength=CELLS + 1)), results)


def known(visited: int) -> Known:
    counts = make_counts(CELLS, CELLS, 4, 10, False)
    counts.visited[visited] = WHOLE
    return Known(Tree(counts, 1))


def test_every_look_halves_those_left_and_doubles_their_rollouts() -> None:
    assert schedule(1, 1000) == [(1, 1000)]
    assert schedule(2, 1000) == [(2, 1000)]
    assert schedule(8, 1024) == [(8, 256), (4, 512), (2, 1024)]
    assert schedule(10, 4096) == [(10, 512), (5, 1024), (3, 2048), (2, 4096)]
    assert schedule(3, 5) == [(3, 3), (2, 5)]


@pytest.mark.parametrize("room", [1, 64])
def test_all_roll_out_the_same_ids_and_the_best_comes_through(room: int) -> None:
    asked: list[tuple[int, int, int]] = []
    made: list[int] = []

    def make(contender: int):  # type: ignore[no-untyped-def]
        made.append(contender)
        return Fake(asked, contender)

    race = Halving([partial(make, contender) for contender in range(9)], 800, room)
    race.run()
    assert (
        race.best == 8
        and sorted(race.runs[contender].rollouts for contender in range(9)) == [100] * 4 + [200] * 2 + [400] + [800] * 2
    )
    assert race.rolled == sum(count for _, _, count in asked)
    for contender in range(9):
        parts = [(start, count) for who, start, count in asked if who == contender]
        assert [start for start, _ in parts] == np.cumsum([0] + [count for _, count in parts])[:-1].tolist()
    assert (len(made) == 9) == (room == 64)
    again = race.confirm(8)
    assert again.rollouts == 800 and asked[-1] == (8, 800, 800)
    for contender in range(8):
        low, high = race.behind(contender)
        assert low < 2 * (8 - contender) / CELLS < high


def test_the_best_of_those_that_are_kept_goes_on_whatever_its_rank() -> None:
    asked: list[tuple[int, int, int]] = []
    race = Halving([partial(Fake, asked, contender) for contender in range(9)], 800, kept=[{0}, {1, 2, 3}])
    race.run()
    assert race.best == 8 and race.best_of({1, 2, 3}) == 3 and race.best_of([0]) == 0
    assert [race.runs[contender].rollouts for contender in (0, 3, 7, 8)] == [800] * 4
    assert race.runs[1].rollouts == race.runs[2].rollouts == 100 and race.runs[5].rollouts == 200
    low, high = race.behind(0, ahead=3)
    assert low < 6 / CELLS < high


@pytest.mark.parametrize("unknown", [None, 0, 8])
def test_it_is_exact_where_all_of_them_are_and_else_none(unknown: int | None) -> None:
    asked: list[tuple[int, int, int]] = []
    race = Halving([partial(Fake, asked, number, number != unknown) for number in range(9)], 800)
    race.run()
    assert race.best == 8 and len(race.runs) == 9 and race.exact == (unknown is None)
    assert bool(asked) == bool(race.rolled) == (unknown is not None)
    if unknown is None:
        assert race.ranked == list(range(9))[::-1] and race.confirm(8) is race.runs[8]
        assert race.behind(5) == (0.06, 0.06) and race.behind(3, ahead=4) == (0.02, 0.02)
    forced = Halving([partial(Fake, asked, number, True) for number in range(9)], 800, exact=False)
    forced.run()
    assert not forced.exact and forced.best == 8


def test_gains_are_paired_on_the_rollouts_that_both_have() -> None:
    luck = np.random.default_rng(3).integers(0, 50, 500).astype(np.int32)
    base, better = sampled(luck, lost=2), sampled(luck[:200] + 3, lost=1)
    gain, spared = better.ahead(base, "visited"), base.ahead(better, "lost")
    assert gain.mean == 3 and spared.mean == 1
    assert gain.ci95[0] < 3 < gain.ci95[1] and gain.half_width < 3.0


def test_bets_hold_whenever_one_looks() -> None:
    """Skewed values, looked at after every one: the interval ever misses the mean no more often than alpha."""
    draw, runs, alpha = np.random.default_rng(11), 30, 0.2
    for values, chances in (((1.0, -0.02), (0.03, 0.97)), ((0.5, -0.4), (0.5, 0.5))):
        mean = float(np.dot(values, chances))
        missed = 0
        for _ in range(runs):
            sample = draw.choice(values, 200, p=chances)
            looks = (bet_interval(sample[:n], alpha) for n in (5, 40, 200))
            missed += any(not low <= mean <= high for low, high in looks)
        assert missed / runs <= alpha + 3 * np.sqrt(alpha * (1 - alpha) / runs)


@pytest.mark.parametrize("mean", [-0.997, -0.5, 0.3])
def test_an_interval_by_bets_ends_where_they_come_to_2_over_alpha(mean: float) -> None:
    """The mean of the fortunes of those who bet that the mean is above its lower end, worked out bet by bet."""
    sample, alpha = mean + 0.002 * np.cos(np.arange(60)), 0.05
    low, _ = bet_interval(sample, alpha)
    shares = [0.99, 0.9, 0.75, *(2.0**-power for power in range(1, 12))]
    fortunes = [np.prod([1 - share + share * (1 + x) / (1 + low) for x in sample.tolist()]) for share in shares]
    assert np.mean(fortunes) == pytest.approx(2 / alpha, rel=1e-6)


def test_bets_are_as_sharp_as_they_are_said_to_be() -> None:
    sample = np.random.default_rng(2).normal(0.02, 0.05, 4096)
    low, high = bet_interval(sample, 1e-4)
    assert low < sample.mean() < high and high - low < 2 * 0.0045
    assert bet_interval(-sample, 1e-4) == pytest.approx((-high, -low), abs=1e-9)
    assert bet_interval(np.ones(3), 0.05)[1] == 1.0 and bet_interval(-np.ones(3), 0.05)[0] == -1.0
