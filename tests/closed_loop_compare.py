"""Are two engines' tallies, single results or traces the same? If not: which array, and where."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from planner.mrac.board import Recorder
from planner.mrac.simulate import ReferenceLoop, Run
from planner.tally import RolloutResults, Tally, Trace


def followed(readable: ReferenceLoop, seed: int, rollout: int) -> tuple[Run, Trace]:
    """A rollout of the readable simulator and its trace, of one run."""
    recorder = Recorder()
    run = readable.run(seed, rollout, recorder)
    return run, recorder.trace(rollout, run.area_of, run.outcome)


def assert_same_tally(mine: Tally, other: Tally, what: str = "") -> None:
    """The same rollouts of the same thing with the same counts; steps that hold nothing do not matter."""
    said, theirs = f"tallies differ: {what}", other.counts()
    for name, counts in mine.counts().items():
        common = min(len(counts), len(theirs[name]))
        np.testing.assert_array_equal(counts[:common], theirs[name][:common], f"{said}: {name}")
    assert (mine.key, mine.shape, mine.ids) == (other.key, other.shape, other.ids), said
    assert mine == other, said


def assert_same_results(mine: RolloutResults, other: RolloutResults, what: str = "") -> None:
    """The same ids with the same results."""
    for name in (field.name for field in fields(RolloutResults)):
        np.testing.assert_array_equal(getattr(mine, name), getattr(other, name), f"results differ: {what}: {name}")


def assert_same_trace(mine: Trace, other: Trace, what: str = "") -> None:
    """Identical, event for event; what happened is compared before what follows from it."""
    said = f"traces differ: {what}: rollout {mine.rollout}"
    for name in ("rollout", "events", "cells", "doing", "areas", "area_of", "outcome"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(other, name), f"{said}: {name}")
    assert mine == other, said
