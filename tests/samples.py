"""Many samples of rollouts from one long run, which costs a fraction of as many short ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np

from analysis.statistics.control_variate import LEAST
from planner.rollouts.engine import Engine
from planner.rollouts.threshold_classes import sums_by_luck
from planner.tally import RolloutResults, Tally

AT_ONCE = 128
"""Samples that are rolled out together."""
SINGLE = {"visited": "visited", "survived": "survived", "time": "time", "alive": "alive", "outcomes": "outcome"}
"""Histograms of a tally, and what they are of."""


def samples(engine: Engine, count: int, seed: int | None, first: int = 0) -> Iterator[Tally]:
    """So many samples of LEAST rollouts each, from id `first` on: their histograms, and nothing by step or cell.

    `seed`: of the thresholds, by whose total figures are summed up too; None: they are not.
    """
    for start in range(0, count, AT_ONCE):
        many = min(AT_ONCE, count - start)
        tally, results = engine.run(first + start * LEAST, many * LEAST)
        for begin in range(0, many * LEAST, LEAST):
            yield part(tally, results, begin, begin + LEAST, seed)


def part(tally: Tally, results: RolloutResults, begin: int, end: int, seed: int | None) -> Tally:
    """Of rollouts `begin .. end - 1` of the `results`, counted from their first one."""
    columns = {field.name: getattr(results, field.name)[begin:end] for field in fields(results)[1:]}
    own = RolloutResults(results.start + begin, **columns)
    counts = {name: np.zeros(0, dtype=np.int64) for name in Tally.axes()}
    counts |= {
        name: np.bincount(getattr(own, column), minlength=len(getattr(tally, name))) for name, column in SINGLE.items()
    }
    if seed is not None:
        counts["by_luck"] = sums_by_luck(own, seed, tally.robots)
    return replace(tally, ids=((own.start, own.start + end - begin),), **counts)
