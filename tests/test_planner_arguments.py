"""Arguments of the Python interface: unknown words are errors in its own words, and options are named as typed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from analysis.checking.survey import make_survey
from analysis.cli.app import run
from analysis.inputs import Asked, load_task, parse_starts
from analysis.sampling import RolloutChoices
from analysis.search.team_size import make_goal
from planner.arguments import COMMAND_LINE, Numbers, argument, is_real, is_whole, nearest
from planner.errors import InputError, PlanError, UsageError, WorldError
from planner.mrac.make_plan import make_plan
from planner.settings import Choices, Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

WORLD = World.create(np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"loop": "both"}, "loop='both'; expected 'open' or 'closed'"),
        ({"loop": None}, "loop=None; expected 'open' or 'closed'"),
        ({"loop": "opn"}, "did you mean 'open'?"),
        ({"loop": ["open"]}, "loop=['open']"),
        ({"engine": "cuda"}, "engine='cuda'; expected 'auto' or 'jax' or 'numba'"),
        ({"rollouts": 0}, "rollouts=0; expected a whole number, 1 to 4294967296"),
        ({"rollouts": 1e6 + 0.5}, "rollouts=1000000.5; expected a whole number"),
        ({"rollouts": True}, "rollouts=True"),
        ({"rollouts": "100"}, "rollouts='100'"),
        ({"precision": 2}, "precision=2; expected a fraction of the accessible cells in (0, 1); did you mean 0.02?"),
        ({"engine": "Num-ba"}, "did you mean 'numba'?"),
        ({"precision": "0.1"}, "precision='0.1'"),
        ({"seed": -1}, "seed=-1; expected a whole number"),
        ({"deadline": 2.5}, "deadline=2.5; expected steps, as 450, or a time"),
        (
            {"deadline": 10**10},
            "deadline=10000000000; expected steps, as 450, or a time, as 45min, 1h30min or 90s, at most",
        ),
        ({"first_only": True, "loop": "open"}, "first_only=True needs the closed loop; use loop='closed'"),
    ],
)
def test_choices_of_rollouts_speak_python(choices: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError) as caught:
        RolloutChoices(**choices)
    assert said in str(caught.value)
    assert "--" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"risk": "brave"}, "risk='brave'; expected 'paper' or 'log'"),
        ({"transit": "air"}, "transit='air'; expected 'grid' or 'area'"),
        ({"levels": 2.5}, "levels is 2.5"),
        ({"density": "4"}, "density is '4'"),
        ({"max_steps": 1e3}, "max_steps is 1000.0"),
    ],
)
def test_settings_are_checked_before_planning(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(PlanError) as caught:
        make_plan(WORLD, [[0, 0]], Settings(**settings))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: make_goal(0.9, None, False, "seen"), "meaning='seen'"),  # type: ignore[arg-type]
        (lambda: make_goal(2, None, False), "target=2"),
        (lambda: make_goal(0.5, None, True), "both complete and target"),
        (lambda: make_survey(0, None, None, (1,), Choices()), "worlds=0"),
        (lambda: make_survey(1, "patchy", None, (1,), Choices()), "kind='patchy'"),  # type: ignore[arg-type]
        (lambda: random_world(pattern=ThreatPattern(kind="patchy")), "kind='patchy'"),  # type: ignore[arg-type]
        (lambda: random_world(pattern=ThreatPattern(seed=1.5)), "seed=1.5"),  # type: ignore[arg-type]
        (lambda: place_starts(WORLD, 1, "middle"), "start rule 'middle'"),
        (lambda: parse_starts("0,x"), "starts: '0,x'"),
        (lambda: load_task(Asked("example:paper", Choices(), 0)), "robots=0"),
        (lambda: load_task(Asked("example:paper", Choices(risk="brave"))), "risk='brave'"),  # type: ignore[arg-type]
    ],
)
def test_the_rest_of_the_interface_speaks_python(call: Any, said: str) -> None:
    with pytest.raises((InputError, WorldError)) as caught:
        call()
    assert said in str(caught.value)
    assert "--" not in str(caught.value)


def test_the_command_line_names_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert argument("step_seconds", 0.5) == "step_seconds=0.5"
    told = COMMAND_LINE.set(True)
    assert argument("step_seconds", 0.5) == "--step-seconds 0.5"
    assert argument("first_only", True) == "--threat-checks first_visit"
    COMMAND_LINE.reset(told)
    assert run(["evaluate", "example:paper", "--rollouts", "0"]) == 2
    assert "--rollouts 0; expected" in capsys.readouterr().err
    assert argument("rollouts", 0) == "rollouts=0"


def test_whole_and_real_numbers() -> None:
    assert is_whole(np.int64(3), 0, 3)
    assert not any(is_whole(value, 0, 9) for value in (True, 3.0, "3", None, 10, -1))
    assert is_real(np.float32(0.5))
    assert not any(is_real(value) for value in (True, "1", None, float("nan"), float("inf"), 10**400))


def test_a_percentage_in_the_place_of_a_fraction_is_meant_as_one() -> None:
    share = Numbers(0, 1)
    assert [share.meant(value) for value in (5, 95.5, 100)] == [f"did you mean {n}?" for n in ("0.05", "0.955", "1")]
    assert [share.meant(value) for value in (1, 0.5, -5, 101, True, "5", None)] == [""] * 7
    assert Numbers(0, 10).meant(50) == Numbers(0, 0.1).meant(50) == ""


def test_the_nearest_word_is_found_whatever_its_case_and_hyphens() -> None:
    words = ("per_cell", "mrac", "every-visit")
    assert [nearest(given, words) for given in ("percell", "PER CELL", "mrack", "every_visit", "x")] == [
        "per_cell", "per_cell", "mrac", "every-visit", "",
    ]  # fmt: skip
