"""Times: how long a step takes changes what is said and which deadlines can be given, and nothing else."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.report.minutes import with_minutes
from planner.errors import InputError, UsageError
from planner.formatting import UNITS, UNPACED, Pace, seconds_of
from planner.world.scenario import load_input
from planner.world.world import World

CELLS = np.array([[0.0, 0.0, 0.3, 0.0], [0.0, np.nan, 0.0, 0.2], [0.0, 0.0, 0.1, 0.0]])
ONE: dict[str, Any] = {"rollouts": 256, "advice": False, "exact": "never"}


def scenario(folder: Path, *lines: str) -> Path:
    np.save(folder / "map.npy", CELLS)
    (folder / "s.yaml").write_text("\n".join(["map: map.npy", "robots: {count: 2}", *lines]))
    return folder / "s.yaml"


def without_minutes(said: Any) -> Any:
    if isinstance(said, list):
        return [without_minutes(one) for one in said]
    if not isinstance(said, dict):
        return said
    return {key: without_minutes(value) for key, value in said.items() if not key.endswith("_minutes")}


def test_times_are_hours_minutes_and_seconds() -> None:
    for text, seconds in {
        "45min": 2700,
        "1h30min": 5400,
        "90s": 90,
        "1.5 h": 5400,
        "2h 5 min 1s": 7501,
        "0s": 0,
    }.items():
        assert seconds_of(text) == seconds, text
    for text in (
        "",
        "45",
        "10m",
        "30min1h",
        "1h1h",
        "-5s",
        "1e3s",
        "nan",
        "h",
        "5 s s",
        "1.s",
        "\u0661s",
        "9999999999s",
    ):
        assert seconds_of(text) is None, text


def test_a_deadline_is_the_last_step_that_is_over_by_then() -> None:
    """Against fractions, which lose nothing: the float nearest to a whole number of steps counts as it."""
    rng = np.random.default_rng(1)
    for _ in range(2_000):
        tenths, unit, count = int(rng.integers(1, 400)), rng.choice(list(UNITS)), int(rng.integers(0, 9_999))
        found = Pace(tenths / 10).last_step("deadline", f"{count}{unit}")
        assert found == Fraction(count) * int(UNITS[unit]) // Fraction(tenths, 10)
    assert Pace(2.0).last_step("deadline", 450) == 450
    assert UNPACED.last_step("deadline", 450) == 450 and UNPACED.last_step("deadline", None) is None


def test_what_is_said() -> None:
    assert Pace(3.0).step(450) == "step 450 (22 min 30 s)"
    assert Pace(3.0).steps(1) == "1 step (3 s)"
    assert Pace(0.05).also(3) == " (0.15 s)"
    assert (UNPACED.step(450), UNPACED.steps(1), UNPACED.also(9)) == ("step 450", "1 step", "")


def test_minutes_stand_beside_steps() -> None:
    said = {
        "time": {"mean": 30.0, "se": 3.0, "ci95": [24.0, 36.0], "quantiles": {"0.5": 30}},
        "time_to": {"0.5": 12, "0.9": None},
        "plan": {"makespan": 60, "deadline": None}, "control": {"time": 0.5}, "orders": [{"step": 6, "robot": 6}],
    }  # fmt: skip
    assert with_minutes(said, UNPACED) is said
    found = with_minutes(said, Pace(10.0))
    assert without_minutes(found) == said
    assert found["time_minutes"] == {"mean": 5.0, "se": 0.5, "ci95": [4.0, 6.0]}
    assert found["time_to_minutes"] == {"0.5": 2.0, "0.9": None}
    assert found["plan"] == {"makespan": 60, "makespan_minutes": 10.0, "deadline": None}
    assert found["control"] == {"time": 0.5}
    assert found["orders"] == [{"step": 6, "step_minutes": 1.0, "robot": 6}]


def test_a_pace_changes_nothing_but_what_is_said() -> None:
    plain = mrac.load(CELLS)
    paced = mrac.load(CELLS, step_seconds=30)
    assert paced.pace == Pace(30.0)
    assert (paced.sha256, paced.luck_sha256) == (plain.sha256, plain.luck_sha256)
    one = mrac.evaluate(plain, 2, deadline=4, **ONE)
    other = mrac.evaluate(paced, 2, deadline="2 min", **ONE)
    assert one.tally == other.tally
    assert mrac.plan(plain, 2, deadline=4).to_json() == mrac.plan(paced, 2, deadline="2min").to_json()


def test_the_command_line_says_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a pace no word of minutes; with one the same answer, and the minutes of it."""
    source = str(scenario(tmp_path))
    words = ("evaluate", source, "--rollouts", "256", "--no-advice", "--exact", "never", "--json")

    def answer(*more: str) -> dict[str, Any]:
        assert run([*words, *more]) == 0
        return json.loads(capsys.readouterr().out)

    def timeless(said: dict[str, Any]) -> dict[str, Any]:
        kept = without_minutes(said)
        return {key: kept[key] for key in ("coverage", "time", "losses", "outcomes", "bounds", "plan")}

    plain = answer("--deadline", "6")
    paced = answer("--deadline", "3min", "--step-seconds", "30")
    assert "_minutes" not in json.dumps(plain) and "step_seconds" not in plain
    assert timeless(paced) == timeless(plain)
    assert paced["step_seconds"] == 30 and paced["time_minutes"]["mean"] == pytest.approx(plain["time"]["mean"] / 2)
    assert run([*words[:-1], "--deadline", "3min", "--step-seconds", "30"]) == 0
    assert "By step 6 (3 min): " in capsys.readouterr().out


def test_a_scenario_says_it(tmp_path: Path) -> None:
    timed = load_input(scenario(tmp_path, "step: {seconds: 2}", "deadline: 11s"))
    plain = load_input(scenario(tmp_path, "deadline: 5"))
    assert timed.pace == Pace(2.0) and timed.sha256 == plain.sha256
    assert mrac.plan(timed).to_json()["robots"] == mrac.plan(plain).to_json()["robots"]
    assert mrac.plan(timed).settings.deadline == 5
    np.savez(tmp_path / "map.npz", threat=CELLS, cell_size=3.0)
    for text, seconds in (("speed: 0.5", 6.0), ("speed: 2", 1.5)):
        (tmp_path / "m.yaml").write_text(f"map: map.npz\n{text}\n")
        assert load_input(tmp_path / "m.yaml").pace == Pace(seconds)
    assert load_input(tmp_path / "m.yaml").with_pace(7).pace == Pace(7.0), "options stand in its place"
    np.save(tmp_path / "cells.npy", CELLS)
    (tmp_path / "m.yaml").write_text("map: {file: cells.npy, resolution: 0.5}\nspeed: 2\n")
    world = load_input(tmp_path / "m.yaml")
    assert world.pace == Pace(0.25) and world.cell_size == 0.5 and world.shape == (3, 4)
    (tmp_path / "m.yaml").write_text("map: {file: map.npz, resolution: 0.5}\n")
    with pytest.raises(InputError, match="the file says that a pixel has 3 m"):
        load_input(tmp_path / "m.yaml")


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (("step: {seconds: 0}",), "`step.seconds` is 0; expected seconds, 1e-06 to 1e\\+06"),
        (("step: 2",), "`step`"),
        (("step: {seconds: 2}", "speed: 1"), "`speed` is 1; expected none beside step"),
        (("speed: 1",), "nobody says how many metres a cell has.*resolution: 0.5"),
        (("deadline: 20q",), "`deadline` is '20q'.*or a time, as 45min"),
    ],
)
def test_a_scenario_that_is_wrong(tmp_path: Path, lines: tuple[str, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_input(scenario(tmp_path, *lines))


def test_what_nobody_says_is_asked_for(tmp_path: Path) -> None:
    world = World.create(CELLS, cell_size=2.0)
    soon = tmp_path / "soon.yaml"
    soon.write_text("map: cells.npy\nrobots: {count: 1}\ndeadline: 20s\n")
    np.save(tmp_path / "cells.npy", np.zeros((3, 3)))
    with pytest.raises(UsageError, match=r"soon.yaml: `deadline` is 20s, but nobody .* give the scenario's `step:"):
        mrac.plan(mrac.load(soon))
    with pytest.raises(UsageError, match="nobody says how long a step takes"):
        mrac.plan(world, 1, deadline="45min")
    with pytest.raises(UsageError, match="'soon'"):
        mrac.plan(world.with_pace(1), 1, deadline="soon")
    with pytest.raises(UsageError, match="both"):
        world.with_pace(1, 1)
    with pytest.raises(UsageError, match="makes a step of 2 m take"):
        world.with_pace(speed=1e-9)
    for wrong in (0, -1, float("nan"), "1"):
        with pytest.raises(UsageError, match="seconds"):
            world.with_pace(wrong)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="how many metres a cell has"):
        mrac.load(CELLS, speed=1)
    assert mrac.load(CELLS, speed=4, cell_size=2).pace == Pace(0.5)
