"""A planner's setting is one line: everything that speaks of it follows from there."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest
from plan_files import load_plan

from analysis.cli.groups import Planning, PlanningToTheEnd, Second
from analysis.sweeps.spec import PLANNER
from planner.arguments import COMMAND_LINE
from planner.errors import PlanError
from planner.mrac.make_plan import make_plan
from planner.settings import SETTINGS, Choices, Settings
from planner.world.world import World

OTHER = {
    "levels": 3, "density": 2.5, "risk": "log", "transit": "area", "max_steps": 99,
    "policy": "per_cell", "reserve": 0.5, "worth": 7.5,
    "plan_for": "open", "effort": 7, "range": 9, "deadline": 30,
    "wear": 2.5, "susceptibility": 0.5, "return_to": "nearest", "recharge": 4,
    "in_area": "boustrophedon", "types": "rover", "steps_per_move": 2, "radio": 4.5,
    "priority": 5,
}  # fmt: skip
WRONG = {
    "levels": 1, "density": 1.0, "risk": "brave", "transit": "air", "max_steps": 0,
    "policy": "bold", "reserve": 1.5, "worth": 0.0,
    "plan_for": "both", "effort": -1, "range": -1, "deadline": -1,
    "wear": 0.1, "susceptibility": 65.0, "return_to": "base", "recharge": 0,
    "in_area": "spiral", "types": "", "steps_per_move": 0, "radio": 0.0,
    "priority": 0,
}  # fmt: skip
NEEDS = {name: {"policy": "per_cell"} for name in ("reserve", "worth", "priority")} | {"effort": {"plan_for": "open"}}
NEEDS |= {"recharge": {"range": 9, "return_to": "home"}}
"""What else has to be chosen."""


def test_everything_that_speaks_of_settings_follows_from_the_table() -> None:
    assert set(SETTINGS) == {field.name for field in fields(Settings)} == set(OTHER) == set(WRONG)
    found = {name for name, setting in SETTINGS.items() if setting.found}
    assert set(SETTINGS) <= {field.name for field in fields(Choices)}
    for group, without in ((PlanningToTheEnd, found), (Planning, found | {"deadline"}), (Second, found | {"deadline"})):
        assert set(SETTINGS) - {field.name for field in fields(group)} == without
    assert set(PLANNER) == set(SETTINGS)
    typed = {name: value for name, value in OTHER.items() if name not in found}
    assert PlanningToTheEnd(**typed).choices().given() == typed
    assert Settings(**Choices().given()) == Settings()
    assert len(Settings().shown()) == len(SETTINGS)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_value_out_of_range_is_refused_everywhere(name: str, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=name):
        Settings(**NEEDS.get(name, {}), **{name: WRONG[name]}).check()
    world, other = World.create([[0.0, 0.1, 0.2]]), NEEDS.get(name, {}) | {name: OTHER[name]}
    plan = replace(make_plan(world, [[0, 0]]), settings=Settings(**other))
    plan.save(tmp_path / "plan.json")
    assert asdict(load_plan(tmp_path / "plan.json", world).settings) == asdict(Settings()) | other
    text = (tmp_path / "plan.json").read_text()
    for right, wrong in ((f'"{OTHER[name]}"', f'"{WRONG[name]}"'), (f": {OTHER[name]}", f": {WRONG[name]}")):
        text = text.replace(right, wrong) if isinstance(OTHER[name], str) else text
    if not isinstance(OTHER[name], str):
        text = text.replace(f'"{name}":{OTHER[name]}', f'"{name}":{WRONG[name]}')
    (tmp_path / "wrong.json").write_text(text)
    with pytest.raises(PlanError, match=f"`settings.{name}` is"):
        load_plan(tmp_path / "wrong.json", world)


def test_a_command_line_names_options_and_a_file_its_keys() -> None:
    def told(source: str = "", **wrong: object) -> str:
        with pytest.raises(PlanError) as caught:
            Settings(**wrong).check(source)  # type: ignore[arg-type]
        return str(caught.value)

    token = COMMAND_LINE.set(True)
    try:
        assert told(range=-3) == "--range -3; expected a whole number, 1 to 4194302, or a list of one a robot"
        assert told(range=(0, 5)).startswith("--range 0,5; expected")
        assert told(worth=5.0).startswith(
            "--worth 5 with --policy mrac; expected --policy per_cell or frontier or watchful;"
        )
        assert told(effort=5) == "--effort 5 with --plan-for closed; expected --plan-for open; leave --effort out"
        assert told("plan.json", range=-3).startswith("plan.json: range is -3; expected") and told(
            "plan.json", range=-3
        ).endswith("1 to 4194302, or a list of one a robot, or null")
    finally:
        COMMAND_LINE.reset(token)
    assert told(range=-3).startswith("range is -3; expected") and told(range=-3).endswith("or None")
