"""A first answer while code is compiled: the readable simulator rolls out the first ids, in a process of its own.

Compilation holds this process for most of a minute on a machine's first run. The other one needs no compiled code, and
its rollouts are the engines' own, since a rollout is a function of (plan, seed, id): what it says is what they will say
of so few.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import mean_estimate
from analysis.utils.compiling import not_compiled
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.rollouts.open_loop import available_cores
from planner.world.world import World

FEWEST = 8
"""Rollouts before which nothing is said."""
PAUSE = 0.5
"""Seconds between two answers."""
ENOUGH, LONGEST = 0.01, 20.0
"""Half-width of the interval, a fraction of the cells, and seconds after either of which it ends by itself."""
WHAT = "rollouts"
"""What is going on."""
BEGIN = "from analysis.first_answer import roll_out_readably; roll_out_readably()"


def roll_out_readably() -> None:
    """The process: plan, world and choices come by standard input; cells visited in each rollout go out, in id order.

    It goes on until it is ended, or no process listens any more. It yields to the compilation.
    """
    os.nice(19)
    plan, world, choices = pickle.load(sys.stdin.buffer)
    loop = ReferenceLoop(plan, world, first_only=choices.first_only)
    for rollout in range(2**32):
        sys.stdout.write(f"{int(loop.run(choices.seed, rollout).visited.sum())}\n")
        sys.stdout.flush()


@contextmanager
def first_answers(
    world: World, plan: Plan, choices: RolloutChoices, say: Callable[[str], None] | None
) -> Iterator[Callable[[], None]]:
    """Tells `say`, in words, what the rollouts so far come to; what is yielded ends that, as does the context.

    Nothing is told, and no process started, where `say` is None, where the closed loop's code is in the cache, or where
    there is one core alone, which has better to do.
    """
    if say is None or choices.loop != "closed" or available_cores() < 2 or _is_compiled(plan):
        yield lambda: None
        return
    try:
        given = pickle.dumps((plan, world, choices))
    except (
        pickle.PicklingError,
        AttributeError,
        TypeError,
    ):  # a policy of one's own that another process cannot import
        yield lambda: None
        return
    process = subprocess.Popen(
        [sys.executable, "-c", BEGIN],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        process_group=0,  # Ctrl-C of a terminal is ours alone; in a session of its own `nice` would have no effect
    )
    cells = int(world.accessible(plan.starts).sum())
    listener = threading.Thread(target=_listen, args=(process, given, cells, say), daemon=True)
    listener.start()
    over = threading.Event()

    def end() -> None:
        if not over.is_set():
            over.set()
            process.kill()
            listener.join()
            say(WHAT)

    try:
        yield end
    finally:
        end()


def _is_compiled(plan: Plan) -> bool:
    return not not_compiled(["mrac" if plan.settings is None else plan.settings.policy])


def _listen(process: subprocess.Popen[bytes], given: bytes, cells: int, say: Callable[[str], None]) -> None:
    """Until the process ends. A team has `cells` to visit."""
    assert process.stdin is not None and process.stdout is not None
    counts, said, began = np.zeros(cells + 1, dtype=np.int64), 0.0, time.monotonic()
    with suppress(BrokenPipeError), process:  # it may be ended before it has heard all
        process.stdin.write(given)
        process.stdin.close()
        for line in process.stdout:
            counts[int(line)] += 1
            if counts.sum() >= FEWEST and time.monotonic() - said >= PAUSE:
                said = time.monotonic()
                say(first_words(counts))
                if mean_estimate(counts, 1 / cells).half_width <= ENOUGH or said - began >= LONGEST:
                    process.kill()
                    break


def first_words(counts: NDArray[np.int64]) -> str:
    """A first answer, of rollouts by cells visited `[accessible + 1]`."""
    mean = mean_estimate(counts, 1 / (len(counts) - 1)).said(100, " %")
    return f"{WHAT}: so far {mean} of the cells visited, by {counts.sum():,} of the readable simulator"
