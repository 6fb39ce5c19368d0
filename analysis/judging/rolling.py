"""Rollouts of a policy: on all cores where Python is asked and the policy can be sent to other processes."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Progress, quiet
from analysis.kit.pool import answers, wanted_processes
from planner.arguments import argument
from planner.errors import UsageError
from planner.rollouts.names import of_jax


def roll_policy(
    env: Any,
    policy: Callable[..., Any] | None,
    seed: int,
    count: int,
    processes: int | None = 1,
    progress: Progress = quiet,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Cells visited, robots lost, steps, int64 `[count]` each, of rollouts 0 .. count - 1 of the seed.

    The same, however many processes it takes (None: one a core). policy: None for a random walk. Raises InputError.
    """
    rolled = of_jax("policy")(env, policy, seed, count)
    spans, begun = rolled.spans, time.monotonic()
    wanted = 1 if rolled.compiled else wanted_for(policy, processes, len(spans))
    found, done = {}, 0
    for span, ended in answers(rolled, spans, wanted, lambda span: f"rollouts {span[0]} to {span[1] - 1}"):
        found[span], done = ended, done + span[1] - span[0]
        progress(done, count, time.monotonic() - begun)
    visited, lost, steps = (np.concatenate(of) for of in zip(*(found[span] for span in spans), strict=True))
    return visited, lost, steps


def wanted_for(policy: Any, processes: int | None, tasks: int) -> int:
    """How many processes to use. Raises UsageError where several are asked for a policy that cannot be sent to them."""
    wanted = wanted_processes(processes, tasks)
    if wanted == 1 or can_be_sent(policy):
        return wanted
    if processes is None:
        return 1
    problem = f"{argument('processes', processes)}, but the policy cannot be sent to other processes"
    raise UsageError(problem, fix="put it into a file that can be imported, or leave it out")


def can_be_sent(policy: Any) -> bool:
    """Whether another process can make it again: no lambda, nor anything of the script or notebook that is run."""
    try:
        return b"__main__" not in pickle.dumps(policy)
    except Exception:
        return False
