"""A front in a second or two: what can be had at next to no robot lost, beside what covers most."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices
from analysis.tradeoff.front import Front
from analysis.tradeoff.search import Doing, Ladders, find_front
from planner.plans.settings import Settings
from planner.worlds.world import World

QUICK = 512
"""Rollouts of each setting."""


def quick_front(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    *,
    seconds: float = 2.0,
    doing: Doing | None = None,
) -> Front | None:
    """`mrac` and `per_cell` as they are, and `per_cell` up the ladder of `worth`, on a few rollouts of the same luck.

    `answer.ends()` are the settings to speak of, `answer.priced` the same on fresh rollouts; `point.setting.options()`
    asks for one. What is not done after so many seconds is left out, and the answer `partial`: then nothing is
    `priced`. None: not one setting was done. Raises InputError, and KeyboardInterrupt of the user's.
    """
    until, over = time.perf_counter() + seconds, False

    def stop(done: int, total: int, took: float) -> None:
        nonlocal over
        over = time.perf_counter() > until
        if over:
            raise KeyboardInterrupt

    few = replace(choices, loop="closed", rollouts=min(QUICK, choices.rollouts), precision=None, control=False)
    try:
        answer = find_front(world, starts, settings, few, ladders=Ladders((), None, ()), progress=stop, doing=doing)
    except KeyboardInterrupt:
        if not over:
            raise
        return None
    if answer.partial and not over:
        raise KeyboardInterrupt
    return answer
