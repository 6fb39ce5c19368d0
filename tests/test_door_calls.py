"""What a function of the door does while it works: it shows how far it is, and an interruption ends a user's loop."""

from __future__ import annotations

import inspect
import io
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import mrac_jax as mrac
from analysis.kit import progress as shown
from analysis.kit.calls import Interrupted, ask
from analysis.kit.safe_console import SafeConsole

SWEEP = "base: {kind: contiguous, size: 8x11, ratio: 0.2}\nmaps: 40\nrollouts: 30\n"


def small_world() -> mrac.World:
    threat = np.zeros((6, 9))
    threat[2:4, 3:7], threat[0, 8] = 0.2, np.nan
    return mrac.load(threat)


def after(calls: int) -> Callable[[int, int, float], None]:
    """A progress function that is interrupted in its so many-th call."""
    left = [calls]

    def tell(done: int, total: int, seconds: float) -> None:
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    return tell


def jobs(folder: Path) -> dict[str, tuple[int, Callable[..., Any]]]:
    """The calls after which something is done, and each function that can be interrupted."""
    world = small_world()
    plan = mrac.plan(world, 2)
    (folder / "a.yaml").write_text(SWEEP)
    return {
        "evaluate": (3, lambda **how: mrac.evaluate(world, plan, rollouts=100_000_000, **how)),
        "compare": (3, lambda **how: mrac.compare((world, plan), (world, mrac.plan(world, 3)), **how)),
        "size": (2, lambda **how: mrac.size(world, target=0.99, most=9, exact="never", **how)),
        "front": (3, lambda **how: mrac.front(world, 2, **how)),
        "starts": (2, lambda **how: mrac.starts(world, 1, **how)),
        "clear": (2, lambda **how: mrac.clear(world, 2, **how)),
        "attack": (2, lambda **how: mrac.attack(world, 2, **how)),
        "check": (2, lambda **how: mrac.check(world, plan, **how)),
        "record": (2, lambda **how: mrac.record(world, plan, folder / "a.mcap", ids=range(9), **how)),
        "sweep": (2, lambda **how: mrac.sweep(folder / "a.yaml", folder / "a.store", processes=1, **how)),
        "reproduce": (2, lambda **how: mrac.reproduce("fig4", maps=5, rollouts=8, processes=1, **how)),
    }


@pytest.mark.parametrize("name", ["evaluate", "compare", "size", "front", "sweep"])
def test_an_interruption_ends_a_loop_and_has_what_was_done(name: str, tmp_path: Path) -> None:
    calls, job = jobs(tmp_path)[name]
    done = []
    with pytest.raises(KeyboardInterrupt) as raised:
        for number in range(3):
            done.append(number)
            job(progress=after(calls))
    assert done == [0]
    assert isinstance(raised.value, Interrupted) and raised.value.partial is not None and raised.value.partial.partial
    if name != "sweep":  # what it did is in its store, which the second run goes on with
        answer = job(progress=after(calls), on_interrupt="return")
        assert answer.partial is True


def test_an_interruption_before_anything_is_done_is_raised_whatever_was_asked() -> None:
    world = small_world()
    for how in ("raise", "return"):
        with pytest.raises(Interrupted) as raised:
            mrac.evaluate(world, 2, progress=after(1), on_interrupt=how)  # type: ignore[arg-type]
        assert raised.value.partial is None


def test_every_function_that_shows_progress_says_how(tmp_path: Path) -> None:
    for name in jobs(tmp_path):
        function = getattr(mrac, name)
        assert {"progress", "on_interrupt"} <= set(inspect.signature(function).parameters), name
        assert "progress" in function.__doc__ and "on_interrupt" in function.__doc__, name
    with pytest.raises(mrac.InputError, match="on_interrupt"):
        mrac.evaluate(small_world(), on_interrupt="ignore")  # type: ignore[arg-type]
    with pytest.raises(mrac.InputError, match="progress='yes'"):
        mrac.evaluate(small_world(), progress="yes")  # type: ignore[arg-type]


class Done:
    partial = False


def slowly(seconds: float) -> Callable[[Any, Any], Done]:
    """Work that is at its half after a moment."""

    def work(tell: Any, doing: Any) -> Done:
        tell(30, 60, 30.0)
        time.sleep(seconds)
        return Done()

    return work


def test_a_terminal_has_a_bar_a_pipe_lines_if_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shown, "FIRST", 0.05)
    monkeypatch.setattr(shown, "EVERY", 0.05)
    ask(slowly(0.2), None, "raise")
    ask(slowly(0.2), False, "raise")
    assert capsys.readouterr().err == ""
    ask(slowly(0.2), True, "raise")
    assert "rollouts ... 30 of 60 rollouts, 30 s left (1 s)" in capsys.readouterr().err
    screen = io.StringIO()
    monkeypatch.setattr(shown, "SafeConsole", lambda **_: SafeConsole(file=screen, force_terminal=True, width=100))
    ask(slowly(0.2), None, "raise")
    assert "30 of 60 rollouts" in screen.getvalue()
    before = screen.tell()
    ask(slowly(0.2), False, "raise")
    assert screen.tell() == before


def test_a_notebook_has_a_line_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    class Handle:
        def update(self, data: dict[str, str], raw: bool) -> None:
            seen.append(data["text/plain"])

    def display(data: dict[str, str], raw: bool, display_id: bool) -> Handle:
        seen.append(data["text/plain"])
        return Handle()

    module = ModuleType("IPython.display")
    module.display = display  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    monkeypatch.setattr(shown, "SafeConsole", lambda **_: SafeConsole(file=io.StringIO(), force_jupyter=True))
    monkeypatch.setattr(shown, "REFRESH", 0.05)
    ask(slowly(0.3), None, "raise")
    assert len(seen) > 2 and seen[0].startswith("rollouts ... 30 of 60 rollouts, 30 s left") and seen[-1] == ""
    seen.clear()
    ask(slowly(0.0), None, "raise")
    assert not seen
