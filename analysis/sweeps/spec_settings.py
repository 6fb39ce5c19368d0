"""The settings of a sweep by name: what values each takes, and how they become worlds, teams and models."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from analysis.inputs import input_path, map_size
from analysis.sweeps.cases import Case, Label, Model, canonical
from analysis.sweeps.worlds import Generated, Written
from planner.errors import InputError, UsageError
from planner.files import Json
from planner.luck_names import LUCKS
from planner.settings import SETTINGS as PLANNER_SETTINGS
from planner.settings import Choices, Setting, Settings
from planner.worlds.generate import PAPER_LEVELS, check_pattern
from planner.worlds.generate import ThreatPattern as Pattern
from planner.worlds.keys import Key, is_small, read_yaml
from planner.worlds.world import MAX_ROBOTS

Reader = Callable[[Key], Any]


def _robots(key: Key) -> int:
    return key.integer(f"a whole number 1..{MAX_ROBOTS}", lambda n: 1 <= n <= MAX_ROBOTS)


def _starts(key: Key) -> tuple[tuple[int, int], ...]:
    expected = "[[row, col], ...], one pair a robot"
    pairs = [item.items(expected) for item in key.items(expected)]
    if any(len(pair) != 2 for pair in pairs):
        raise key.wrong(expected)
    return tuple((row.integer(expected, is_small), col.integer(expected, is_small)) for row, col in pairs)


def _fraction(key: Key) -> float:
    return key.number("a fraction 0..1", lambda value: 0 <= value <= 1)


def _levels(key: Key) -> tuple[float, ...]:
    return tuple(key.numbers("threat levels, probabilities above 0"))


def _size(key: Key) -> tuple[int, int]:
    height, width = map_size(key.text("HxW in cells, as 20x30"))
    if not (1 <= height <= 2**13 and 1 <= width <= 2**13):
        raise key.wrong("HxW in cells, 1 to 8192 each")
    return height, width


def _file(key: Key) -> str:
    return str(key.file("a file"))


def _input(key: Key) -> str:
    name = key.text("an INPUT, as of `evaluate`")
    return str(input_path(name)) if name.startswith("example:") else str(key.file("an INPUT, as of `evaluate`"))


def _word(*words: str) -> Reader:
    return lambda key: key.choice(words)


def _whole(expected: str, least: int) -> Reader:
    return lambda key: key.integer(expected, lambda value: value >= least)


def _of(setting: Setting) -> Reader:
    """The reader of one of the planner's settings."""
    if setting.kind == "word":
        return _word(*setting.words)
    read, expected = Key.number if setting.kind in ("number", "numbers") else Key.integer, setting.expected("null")

    def one_or_each(key: Key) -> Any:
        if setting.kind in ("wholes", "numbers") and isinstance(key.value, list):
            return tuple(read(item, expected, setting.accepts) for item in key.items(expected))
        return read(key, expected, setting.accepts)

    return one_or_each


TEAM: dict[str, Reader] = {"robots": _robots, "starts": _starts, "plan": _file}
PLANNER: dict[str, Reader] = {name: _of(setting) for name, setting in PLANNER_SETTINGS.items()}
MODEL: dict[str, Reader] = {
    "loop": _word("closed", "open"),
    "threat_checks": _word("every_visit", "first_visit"),
    "luck": _word(*LUCKS),
    "mode": _word("fast", "step"),
    "seed": lambda key: key.integer("a whole number 0 <= seed < 2**64", lambda seed: 0 <= seed < 2**64),
}
WORLD: dict[str, Reader] = {
    "kind": _word("contiguous", "scattered"),
    "ratio": _fraction,
    "areas": _whole("a whole number >= 1", 1),
    "threat_levels": _levels,
}
PAPER: dict[str, Reader] = {"obstacles": _fraction, "size": _size}
"""Settings of the paper's random worlds alone; those of WORLD are also a scenario's, where it has generated threats."""
INPUT: dict[str, Reader] = {"input": _input}
SETTINGS = {**INPUT, **WORLD, **PAPER, **TEAM, **PLANNER, **MODEL}
SCENARIO = ("map", "cell_size", "unknown", "threats", "combine")
"""Keys of a scenario file that `base` may hold; `robots` and `levels` are settings too."""
PART = re.compile(r"([A-Za-z_][A-Za-z_0-9]*)|\[([0-9]+)\]")


def is_path(name: str) -> bool:
    """True for a place within a scenario, as `threats[0].scale` or `cell_size`."""
    first = re.match(r"[A-Za-z_]+", name)
    return bool(first and first.group() in SCENARIO and PART.sub("", name).strip(".") == "")


def label_of(name: str, value: Any, folder: Path) -> Label:
    """A setting's value as results are found by it; files relative to the sweep's folder."""
    if name in ("input", "plan"):
        path = Path(value)
        return str(path.relative_to(folder)) if path.is_relative_to(folder) else path.name
    if name == "size":
        return f"{value[0]}x{value[1]}"
    if name == "starts":
        return ";".join(f"{row},{col}" for row, col in value)
    return value if isinstance(value, str | int | float | bool) else canonical(value)


def model_of(values: Mapping[str, Any], offset: int) -> Model:
    """The model of some settings; `offset`, the map's number, goes to the seed: no two maps are to share their luck."""
    loop, checks = values.get("loop", "closed"), values.get("threat_checks", "every_visit")
    mode = values.get("mode") if loop == "open" else None
    seed = (int(values.get("seed", 0)) + offset) % 2**64
    return Model(loop, checks == "first_visit", seed, mode, values.get("luck", "step"))


def scenario_of(name: str) -> tuple[Json, str]:
    """(scenario's keys, source) of an INPUT: a scenario's own, or a scenario of that map alone. Raises InputError."""
    path = Path(name)
    if path.suffix.lower() in (".yaml", ".yml"):
        top = read_yaml(path)
        if isinstance(top.value, dict) and "map" in top.value and "image" not in top.value:
            return dict(top.value), name
    return {"map": {"file": path.name}}, name


def case_of(
    values: Mapping[str, Any],
    scenario: tuple[Mapping[str, Any], str] | None,
    seed: int | None,
    labels: tuple[tuple[str, Label], ...],
) -> Case:
    """The case of some settings. `scenario`: (its keys, its source), None for the paper's worlds; `seed`: the map's.

    `seed` None: the one that the scenario has.
    """
    given = {name: values[name] for name in PLANNER if name in values}
    world: Generated | Written
    robots = values.get("robots")
    if scenario is None:
        height, width = values.get("size", (20, 20))
        world = Generated(
            kind=values.get("kind", "contiguous"),
            ratio=values.get("ratio", 0.25),
            seed=seed or 0,
            height=height,
            width=width,
            areas=values.get("areas", Pattern.areas),
            levels=values.get("threat_levels", PAPER_LEVELS),
            obstacles=values.get("obstacles", 0.25),
        )
    else:
        keys, source = scenario
        changed = json.loads(canonical(dict(keys)))
        for name, value in values.items():
            if is_path(name):
                _put(changed, name, value, source)
        _generate(changed, {n: v for n, v in values.items() if n in WORLD}, seed)
        if "robots" in values or "starts" in values or "plan" in values:
            rule = changed.pop("robots", None)
            if isinstance(rule, dict) and "start" in rule and robots is not None:
                changed["robots"] = {"start": rule["start"], "count": robots}
        world = Written(canonical(changed), source)
    return Case(world, robots, values.get("starts"), Choices(**given), values.get("plan"), labels)


def generators(scenario: Mapping[str, Any]) -> list[Json]:
    """The `generate` entries of a scenario's threats."""
    threats = scenario.get("threats")
    found = (
        [t["generate"] for t in threats if isinstance(t, dict) and "generate" in t] if isinstance(threats, list) else []
    )
    return [entry for entry in found if isinstance(entry, dict)]


def _generate(scenario: Json, values: Mapping[str, Any], seed: int | None) -> None:
    """Let the scenario's generated threats have this seed and these settings."""
    for entry in generators(scenario):
        if seed is not None:
            entry["seed"] = seed
        for name, value in values.items():
            entry["levels" if name == "threat_levels" else name] = value


def _put(scenario: Json, name: str, value: Any, source: str) -> None:
    """Set the value at a place such as `threats[0].scale`. Raises UsageError if there is no such place."""
    parts: list[Any] = [word or int(number) for word, number in PART.findall(name)]
    place: Any = scenario
    try:
        for part in parts[:-1]:
            place = place[part]
        if isinstance(parts[-1], int):
            place[parts[-1]]
        place[parts[-1]] = value
    except (KeyError, IndexError, TypeError):
        raise UsageError(f"there is no {name} to sweep", source=source, expected="a key of the scenario") from None


def check_settings(values: Mapping[str, Any]) -> None:
    """Raise InputError for settings whose values are out of range or contradict each other."""
    Settings(**{name: values[name] for name in PLANNER if name in values}).check("settings")
    check_pattern(
        Pattern(values.get("kind", "contiguous"), values.get("areas", 10), values.get("threat_levels", PAPER_LEVELS))
    )
    if "plan" in values and any(name in values for name in ("robots", "starts", *PLANNER)):
        raise InputError("a plan file with robots, starts or planner settings", fix="leave them to the plan file")
    if "robots" in values and "starts" in values and len(values["starts"]) != values["robots"]:
        raise InputError(f"{values['robots']} robots and {len(values['starts'])} starts", fix="leave robots out")
    model_of(values, 0)
