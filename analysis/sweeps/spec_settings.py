"""The settings of a sweep by name: what values each takes, and how they become worlds, cases and models."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from copy import deepcopy
from math import isfinite
from pathlib import Path
from typing import Any

from analysis.inputs import input_path, map_size
from analysis.sampling import RolloutChoices
from analysis.sweeps.cases import Label, canonical
from analysis.sweeps.worlds import BESIDE, Generated, Written
from planner.arguments import ANY, FRACTION, SEED, Numbers, whole
from planner.errors import UsageError
from planner.files import Json
from planner.luck_names import LUCKS
from planner.rollouts.blocks import MOST_SEED
from planner.settings import SETTINGS as PLANNER_SETTINGS
from planner.settings import Setting
from planner.worlds.keys import PLACE, Key, read_yaml
from planner.worlds.world import MAX_ROBOTS

Reader = Callable[[Key], Any]


def _starts(key: Key) -> tuple[tuple[int, int], ...]:
    expected = "[[row, col], ...], one pair a robot"
    pairs = [item.numbers(PLACE, expected, 2) for item in key.items(expected)]
    return tuple((row, col) for row, col in pairs)


def _levels(key: Key) -> tuple[float, ...]:
    return tuple(key.numbers(ANY, "threat levels, probabilities above 0"))


def _size(key: Key) -> tuple[int, int]:
    height, width = map_size(key.text("HxW in cells, as 20x30"))
    if not (1 <= height <= 2**13 and 1 <= width <= 2**13):
        raise key.wrong("HxW in cells, 1 to 8192 each")
    return height, width


def _input(key: Key) -> str:
    name = key.text("an INPUT, as of `evaluate`")
    return str(input_path(name)) if name.startswith("example:") else str(key.file("an INPUT, as of `evaluate`"))


def _word(*words: str) -> Reader:
    return lambda key: key.choice(words)


def _one_of(numbers: Numbers) -> Reader:
    return lambda key: key.number(numbers)


def _of(setting: Setting) -> Reader:
    return lambda key: key.setting(setting)


INPUT: dict[str, Reader] = {"input": _input}
WORLD: dict[str, Reader] = {
    "kind": _word("contiguous", "scattered"),
    "ratio": _one_of(FRACTION),
    "areas": _one_of(whole(1)),
    "threat_levels": _levels,
}
"""Of the paper's random worlds, and of an input's generated threats."""
PAPER: dict[str, Reader] = {"obstacles": _one_of(FRACTION), "size": _size}
"""Of the paper's random worlds alone."""
UNSAID: dict[str, Reader] = {name: lambda key: key.value for name in BESIDE}
"""Keys of a scenario, of any world; null: without it."""
TEAM: dict[str, Reader] = {
    "robots": _one_of(whole(1, MAX_ROBOTS)),
    "starts": _starts,
    "plan": lambda key: str(key.file("a file")),
}
PLANNER: dict[str, Reader] = {name: _of(setting) for name, setting in PLANNER_SETTINGS.items()}
MODEL: dict[str, Reader] = {
    "loop": _word("closed", "open"),
    "threat_checks": _word("every_visit", "first_visit"),
    "luck": _word(*LUCKS),
    "seed": _one_of(SEED),
}
SETTINGS = {**INPUT, **WORLD, **PAPER, **UNSAID, **TEAM, **PLANNER, **MODEL}
PLACES = ("map", "cell_size", "unknown", "threats", "combine", "truth", *BESIDE)
"""Keys of a scenario in which a place may be swept: `threats[0].scale`."""
PART = re.compile(r"([A-Za-z_][A-Za-z_0-9]*)|\[([0-9]+)\]")


def is_path(name: str) -> bool:
    """True for a place within a scenario, as `threats[0].scale` or `cell_size`."""
    return _first(name) in PLACES and PART.sub("", name).strip(".") == ""


def is_beside(name: str) -> bool:
    """True for one that any world may have, as `sense` or `movers[0].walk`."""
    return is_path(name) and _first(name) in BESIDE


def _first(name: str) -> str:
    found = re.match(r"[A-Za-z_]+", name)
    return found.group() if found else ""


def label_of(name: str, value: Any, folder: Path) -> Label:
    """A setting's value as results are found by it; files relative to the sweep's folder."""
    if name in ("input", "plan"):
        path = Path(value)
        return str(path.relative_to(folder)) if path.is_relative_to(folder) else path.name
    if name == "size":
        return f"{value[0]}x{value[1]}"
    if name == "starts":
        return ";".join(f"{row},{col}" for row, col in value)
    if isinstance(value, float) and not isfinite(value):
        return str(value)
    return value if isinstance(value, str | int | float | bool) else canonical(value)


def model_of(values: Mapping[str, Any], offset: int) -> RolloutChoices:
    """The model of some settings; `offset`, the map's number, goes to the seed: no two maps are to share their luck."""
    first_only = values.get("threat_checks") == "first_visit"
    given = {name: values[name] for name in ("loop", "luck") if name in values}
    return RolloutChoices(seed=(values.get("seed", 0) + offset) % MOST_SEED, first_only=first_only, **given)


def generated_world(values: Mapping[str, Any], seed: int) -> Generated:
    """The paper's random world of some settings with this seed."""
    unsaid: Json = {}
    _put_all(unsaid, {name: value for name, value in values.items() if is_beside(name)}, "random map")
    given = {name: values[name] for name in (*WORLD, *PAPER) if name in values}
    return Generated(seed=seed, unsaid=canonical(unsaid), **given)


def written_world(values: Mapping[str, Any], seed: int | None) -> Written:
    """The world of the `input` of some settings; `seed`: of its generated threats, None: those that it has itself."""
    scenario = scenario_of(values["input"])
    _put_all(scenario, {name: value for name, value in values.items() if is_path(name)}, values["input"])
    for entry in generators(scenario):
        entry |= {} if seed is None else {"seed": seed}
        entry |= {"levels" if name == "threat_levels" else name: values[name] for name in WORLD if name in values}
    return Written(canonical(scenario), values["input"])


def scenario_of(name: str) -> Json:
    """The keys of an INPUT: a scenario's own, or those of a scenario of that map alone. Raises InputError."""
    path = Path(name)
    if path.suffix.lower() in (".yaml", ".yml"):
        top = read_yaml(path)
        if isinstance(top.value, dict) and "map" in top.value and "image" not in top.value:
            found: Json = json.loads(canonical(top.value))
            return found
    return {"map": {"file": path.name}}


def generators(scenario: Mapping[str, Any]) -> list[Json]:
    """The `generate` entries of a scenario's threats."""
    threats = scenario.get("threats")
    listed = threats if isinstance(threats, list) else []
    found = [threat["generate"] for threat in listed if isinstance(threat, dict) and "generate" in threat]
    return [entry for entry in found if isinstance(entry, dict)]


def _put_all(scenario: Json, values: Json, source: str) -> None:
    """Set what is swept; where movers or phases are left out, what robots would plan on is too."""
    for name, value in values.items():
        if name != "plan_on" or None not in (values.get("movers", name), values.get("phases", name)):
            _put(scenario, name, value, source)


def _put(scenario: Json, name: str, value: Any, source: str) -> None:
    """Set the value at a place such as `threats[0].scale`, None: clear it. Raises UsageError if there is none."""
    parts: list[Any] = [word or int(number) for word, number in PART.findall(name)]
    place: Any = scenario
    try:
        for part in parts[:-1]:
            place = place[part]
        if isinstance(parts[-1], int):
            place[parts[-1]]
        place[parts[-1]] = deepcopy(value)
        if value is None:
            del place[parts[-1]]
    except (KeyError, IndexError, TypeError):
        raise UsageError(f"there is no {name} to sweep", source=source, expected="a key of the scenario") from None
