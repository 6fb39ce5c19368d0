"""The first answer: the first rollouts by the readable simulator, told while code is compiled."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest import MonkeyPatch

from analysis import first_answer
from analysis.first_answer import FEWEST, WHAT, first_answers, first_words
from analysis.sampling import RolloutChoices, make_singles
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts

WORLD = random_world(8, 8, ThreatPattern("contiguous", 4, seed=5), threats=0.3)
STARTS = place_starts(WORLD, 3)[0]
PLAN = make_plan(WORLD, STARTS)


def nothing_compiled(monkeypatch: MonkeyPatch) -> None:
    monkeypatch.setattr(first_answer, "_is_compiled", lambda plan: False)
    monkeypatch.setattr(first_answer, "available_cores", lambda: 2)
    monkeypatch.setattr(first_answer, "PAUSE", 0.0)


def test_it_is_that_of_the_engines_after_so_few(monkeypatch: MonkeyPatch) -> None:
    nothing_compiled(monkeypatch)
    choices = RolloutChoices(seed=7)
    told: list[str] = []
    enough = threading.Event()

    def say(words: str) -> None:
        told.append(words)
        if len(told) == 20:
            enough.set()

    with first_answers(WORLD, PLAN, choices, say) as end:
        assert enough.wait(120)
        end()
    assert told.pop() == WHAT
    heard = len(told)
    cells = int(WORLD.accessible(PLAN.starts).sum())
    visited = make_singles(WORLD, PLAN, choices)(0, FEWEST + heard).visited
    counts = [np.bincount(visited[: FEWEST + more], minlength=cells + 1) for more in range(heard)]
    assert told == [first_words(count) for count in counts]
    assert len(set(told)) > 10 and f"by {FEWEST} of" in told[0]


@pytest.mark.parametrize(("enough", "longest"), [(0.5, 99.0), (0.0, 0.0)])
def test_it_is_polite_and_ends_by_itself(monkeypatch: pytest.MonkeyPatch, enough: float, longest: float) -> None:
    """With the interval that it needs, or when its time is over; in our session, so that `nice` counts."""
    nothing_compiled(monkeypatch)
    monkeypatch.setattr(first_answer, "ENOUGH", enough)
    monkeypatch.setattr(first_answer, "LONGEST", longest)
    started: list[subprocess.Popen[bytes]] = []
    nice, popen, told, said = [], subprocess.Popen, list[str](), threading.Event()

    def start(*given: Any, **named: Any) -> subprocess.Popen[bytes]:
        started.append(popen(*given, **named))
        assert os.getsid(started[0].pid) == os.getsid(0) and os.getpgid(started[0].pid) != os.getpgid(0)
        return started[0]

    def say(words: str) -> None:
        if not told:
            nice.append(os.getpriority(os.PRIO_PROCESS, started[0].pid))
        told.append(words)
        said.set()

    monkeypatch.setattr(first_answer.subprocess, "Popen", start)
    with first_answers(WORLD, PLAN, RolloutChoices(), say):
        assert said.wait(120)
        assert started[0].wait(60) == -signal.SIGKILL
        assert len(told) == 1 and nice == [19]
    assert told[1:] == [WHAT]


def test_it_stays_away_where_it_is_of_no_use(monkeypatch: MonkeyPatch) -> None:
    def refuse(*given: object, **named: object) -> None:
        raise AssertionError("a process was started")

    nothing_compiled(monkeypatch)
    monkeypatch.setattr(first_answer.subprocess, "Popen", refuse)
    told: list[str] = []
    own = make_plan(WORLD, STARTS, Settings(policy=lambda offer: ((offer.level, 1), (offer.cost, 1))))
    open_loop = RolloutChoices(loop="open")
    for plan, choices, say in (
        (PLAN, RolloutChoices(), None),
        (PLAN, open_loop, told.append),
        (own, RolloutChoices(), told.append),
    ):
        with first_answers(WORLD, plan, choices, say) as end:
            end()
    monkeypatch.setattr(first_answer, "_is_compiled", lambda plan: True)
    with first_answers(WORLD, PLAN, RolloutChoices(), told.append):
        pass
    assert not told


def test_an_end_before_the_beginning_leaves_nothing_behind(monkeypatch: MonkeyPatch) -> None:
    nothing_compiled(monkeypatch)
    threads = threading.active_count()
    started: list[Any] = []
    popen = subprocess.Popen
    monkeypatch.setattr(
        first_answer.subprocess, "Popen", lambda *given, **named: started.append(popen(*given, **named)) or started[-1]
    )
    with first_answers(WORLD, PLAN, RolloutChoices(), lambda words: None) as end:
        end()
    assert threading.active_count() == threads
    assert [process.returncode for process in started] == [-signal.SIGKILL]


@pytest.mark.slow
def test_the_command_says_it_on_a_first_run(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mrac_jax", "evaluate", "example:paper", "--robots", "8", "--no-advice"]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [*command, "--rollouts", "2000"], env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert "of the cells visited, by" in done.stderr and "readable simulator" not in done.stdout
    again = subprocess.run(
        [*command, "--rollouts", "2000"], env=environment, capture_output=True, text=True, timeout=600
    )
    assert "readable simulator" not in again.stderr
    answers = [re.sub(r"[\d,]+ a second", "", run.stdout) for run in (done, again)]
    assert answers[0] == answers[1]
