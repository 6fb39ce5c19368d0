"""A sweep file: settings to cross, on how many maps, as jobs in order of maps.

    base: {kind: contiguous, size: 20x20}    # common settings: names of SETTINGS; `input: FILE` for another world
    maps: 50                                 # number of random maps; with an input: of its `generate` threats
    first_seed: 0                            # seed of the first map
    rollouts: 1000                           # for each setting on each map
    seed: 0                                  # seed of the rollouts on the first map
    sweep:                                   # crossed in the given order, each a list of values
      robots: [1, 2, 4]                      # names: SETTINGS; or a path in the scenario, as "threats[0].scale"

Common random numbers: all settings have the same maps (world seeds `first_seed ..`), and on map i the same rollouts
(seed `seed + i`), so that differences between settings have a small variance.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from math import isfinite
from pathlib import Path
from typing import Any

from analysis.inputs import input_path, map_size
from analysis.sampling import RolloutChoices
from analysis.sweeps.cases import MOST_MAPS, SCENARIO_KEYS, Case, Generated, Label, Places, Written, canonical
from analysis.sweeps.engine import Job
from planner.arguments import ANY, FRACTION, MOST_ROLLOUTS, did_you_mean, whole
from planner.errors import PER_VISIT, RENAMED, InputError, ScenarioError, UsageError, with_new_names
from planner.files import Json
from planner.policies import DEFAULT
from planner.rollouts.engine import MOST_SEED
from planner.settings import OPTIONS, Choices
from planner.settings import SETTINGS as PLANNER_SETTINGS
from planner.world.keys import PLACE, Key, read_yaml

# The settings of a sweep by name, with readers of their values; and their worlds, cases and models.

Reader = Callable[[Key], Any]


def _starts(key: Key) -> tuple[tuple[int, int], ...]:
    expected = "[[row, col], ...], one pair for each robot"
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
    name = key.text("an INPUT, as in `evaluate`")
    return str(input_path(name)) if name.startswith("example:") else str(key.file("an INPUT, as in `evaluate`"))


def _left(key: Key) -> str:
    raise key.error(f"`{key.path}`: {PER_VISIT}", source=key.source)


INPUT: dict[str, Reader] = {"input": _input}
WORLD: dict[str, Reader] = {
    "kind": partial(Key.choice, options=("contiguous", "scattered")),
    "ratio": partial(Key.number, of=FRACTION),
    "areas": partial(Key.number, of=whole(1)),
    "threat_levels": _levels,
}
"""For the paper's random worlds, and for an input's generated threats."""
PAPER: dict[str, Reader] = {"obstacles": partial(Key.number, of=FRACTION), "size": _size}
"""For the paper's random worlds only."""
UNSAID: dict[str, Reader] = {name: lambda key: key.value for name in SCENARIO_KEYS}
"""Keys of a scenario, for any world; null removes the key."""
TEAM: dict[str, Reader] = {
    "robots": partial(Key.number, of=OPTIONS["robots"].numbers),
    "starts": _starts,
    "plan": lambda key: str(key.file("a file")),
}
PLANNER: dict[str, Reader] = {name: partial(Key.setting, setting=setting) for name, setting in PLANNER_SETTINGS.items()}
MODEL: dict[str, Reader] = {
    "loop": partial(Key.choice, options=OPTIONS["loop"].words),
    "threat_checks": partial(Key.choice, options=OPTIONS["threat_checks"].words),
    "luck": _left,
    "seed": partial(Key.number, of=OPTIONS["seed"].numbers),
}
SETTINGS = {**INPUT, **WORLD, **PAPER, **UNSAID, **TEAM, **PLANNER, **MODEL}
PLACES = ("map", "cell_size", "unknown", "threats", "combine", "true_map", *SCENARIO_KEYS)
"""Keys of a scenario in which a path may be swept: `threats[0].scale`."""
PART = re.compile(r"([A-Za-z_][A-Za-z_0-9]*)|\[([0-9]+)\]")


def is_path(name: str) -> bool:
    """True for a path within a scenario, as `threats[0].scale` or `cell_size`."""
    return _first(name) in PLACES and PART.sub("", name).strip(".") == ""


def is_scenario_path(name: str) -> bool:
    """True for a path that any world may have, as `sensor_range` or `moving_threats[0].walk`."""
    return is_path(name) and _first(name) in SCENARIO_KEYS


def _first(name: str) -> str:
    found = re.match(r"[A-Za-z_]+", name)
    return found.group() if found else ""


def label_of(name: str, value: Any, folder: Path) -> Label:
    """A setting's value as a label; files relative to the sweep's folder."""
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
    """The model of some settings; `offset`, the map's number, is added to the seed: maps share no random numbers."""
    first_only = values.get("threat_checks") == "first_visit"
    given = {name: values[name] for name in ("loop",) if name in values}
    return RolloutChoices(seed=(values.get("seed", 0) + offset) % MOST_SEED, first_only=first_only, **given)


def generated_world(values: Mapping[str, Any], seed: int) -> Generated:
    """The paper's random world with these settings and this seed."""
    unsaid: Json = {}
    _put_all(unsaid, {name: value for name, value in values.items() if is_scenario_path(name)}, "random map")
    given = {name: values[name] for name in (*WORLD, *PAPER) if name in values}
    return Generated(seed=seed, unsaid=canonical(unsaid), **given)


def written_world(values: Mapping[str, Any], seed: int | None) -> Written:
    """The world of the `input` setting; `seed`: of its generated threats, None: unchanged."""
    scenario = scenario_of(values["input"])
    _put_all(scenario, {name: value for name, value in values.items() if is_path(name)}, values["input"])
    for entry in generators(scenario):
        entry |= {} if seed is None else {"seed": seed}
        entry |= {"levels" if name == "threat_levels" else name: values[name] for name in WORLD if name in values}
    return Written(canonical(scenario), values["input"])


def scenario_of(name: str) -> Json:
    """The keys of an INPUT: a scenario's own, or those of a minimal scenario of a map. Raises InputError."""
    path = Path(name)
    if path.suffix.lower() in (".yaml", ".yml"):
        top = read_yaml(path)
        if isinstance(top.value, dict) and "map" in top.value and "image" not in top.value:
            found: Json = json.loads(canonical(with_new_names(top.value, PLACES, name)))
            return found
    return {"map": {"file": path.name}}


def generators(scenario: Mapping[str, Any]) -> list[Json]:
    """The `generate` entries of a scenario's threats."""
    threats = scenario.get("threats")
    listed = threats if isinstance(threats, list) else []
    found = [threat["generate"] for threat in listed if isinstance(threat, dict) and "generate" in threat]
    return [entry for entry in found if isinstance(entry, dict)]


def _put_all(scenario: Json, values: Json, source: str) -> None:
    """Set the swept values; `plan_on` is omitted if moving threats or phases are removed."""
    for name, value in values.items():
        if name != "plan_on" or None not in (values.get("moving_threats", name), values.get("phases", name)):
            _put(scenario, name, value, source)


def _put(scenario: Json, name: str, value: Any, source: str) -> None:
    """Set the value at a path such as `threats[0].scale`; None removes it. Raises UsageError for an unknown path."""
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


DEFAULTS = {"base": {}, "sweep": {}, "first_seed": 0, "rollouts": 1000, "seed": 0}
DEFAULT_MAPS = 50
MOST_CHECKED = 100
"""Values of a name that are checked before the first rollout."""
Swept = tuple[tuple[str, tuple[Any, ...]], ...]
"""(name, values), names in the given order."""


@dataclass(frozen=True, eq=False)
class Spec:
    """A sweep. A setting is one value for every name; settings are numbered in the order of the product.

    Attributes:
        source: the file. base: values by name. swept: crossed values.
        maps: number of random maps, or None for the one map of the input. first_seed: seed of the first.
        rollouts: for each map and setting.
    """

    source: Path
    base: Json
    swept: Swept
    maps: int | None
    first_seed: int
    rollouts: int

    @cached_property
    def cases(self) -> list[Json]:
        """The swept values of every case on a map, without those of the model."""
        return _crossed((name, values) for name, values in self.swept if name not in MODEL)

    @cached_property
    def models(self) -> list[Json]:
        """The swept values of every model of a case."""
        return _crossed((name, values) for name, values in self.swept if name in MODEL)

    @property
    def policies(self) -> tuple[Any, ...]:
        """The policies of its cases."""
        return dict(self.swept).get("policy", (self.base.get("policy", DEFAULT),))

    def labels(self, case: int, model: int) -> dict[str, Label]:
        """The swept values of setting (case, model), by name in the given order."""
        chosen = self.cases[case] | self.models[model]
        return {name: label_of(name, chosen[name], self.source.parent) for name, _ in self.swept}

    def jobs(self, first: int = 0, stop: int | None = None) -> Iterator[Job]:
        """The jobs of maps `first .. stop - 1` (None: all), map by map; `tag`: map * cases + case."""
        for number in range(first, (self.maps or 1) if stop is None else stop):
            for place, chosen in enumerate(self.cases):
                values = self.base | chosen
                models = tuple(model_of(values | model, number) for model in self.models)
                yield Job(self.case(values, number), models, self.rollouts, tag=number * len(self.cases) + place)

    def case(self, values: Json, number: int) -> Case:
        """The case of these values on map `number`. Raises InputError."""
        seed = None if self.maps is None else self.first_seed + number
        labels = {name: label_of(name, v, self.source.parent) for name, v in values.items() if name not in MODEL}
        world = written_world(values, seed) if "input" in values else generated_world(values, seed or 0)
        if isinstance(world, Generated):
            # Kind and ratio are labels even at their defaults, so that stores of several sweeps can be compared.
            labels = {**dict[str, Label](kind=world.kind, ratio=world.ratio), **labels}
        if seed is not None:
            labels["map"] = seed
        choices = Choices(**{name: values[name] for name in PLANNER if name in values})
        team = (values.get("robots"), values.get("starts"), choices, values.get("plan"))
        return Case(world, *team, tuple(labels.items()))


def _crossed(swept: Iterable[tuple[str, tuple[Any, ...]]]) -> list[Json]:
    """All combinations of values, the last name fastest."""
    lists = [[(name, value) for value in values] for name, values in swept]
    return [dict(chosen) for chosen in product(*lists)]


def read_spec(path: Path) -> Spec:
    """The sweep in a YAML file; all values, and the settings of the first map, are checked. Raises InputError."""
    top = read_yaml(path)
    if isinstance(top.value, dict) and {"map", "image"} & top.value.keys():
        fix = f"use it in a sweep file with `base: {{input: {path.name}}}`"
        raise ScenarioError("is a scenario or a map", source=path, expected="a sweep file", fix=fix)
    keys = top.mapping(optional=("maps",), defaults=DEFAULTS)
    if isinstance(keys["base"].value, dict) and "map" in keys["base"].value:
        raise keys["base"].wrong("settings only", "put the scenario into a file and use `input: FILE`")
    given = keys["base"].mapping(optional=[name for name in SETTINGS if name != "seed"])
    base = {name: SETTINGS[name](key) for name, key in given.items()} | {"seed": MODEL["seed"](keys["seed"])}
    swept = tuple((name, _values(name, key)) for name, key in _swept(keys["sweep"]).items())
    rollouts = keys["rollouts"].number(whole(1, MOST_ROLLOUTS))
    spec = Spec(path, base, swept, _maps(keys, base, swept), MODEL["seed"](keys["first_seed"]), rollouts)
    # One cache for all checks: most values share a world.
    places = Places()
    for name, values in swept or (("base", (None,)),):  # detect errors before the first rollout
        for value in values[:MOST_CHECKED]:
            _check_value(spec, places, name, value)
    return spec


def _swept(key: Key) -> dict[str, Key]:
    """The swept names: settings, or paths in a scenario."""
    if not isinstance(key.value, dict):
        raise key.wrong("names of settings with lists of values")
    value = {_new_place(str(name)): listed for name, listed in with_new_names(key.value, SETTINGS, key.source).items()}
    for name in value:
        if name not in SETTINGS and not is_path(str(name)):
            problem, fix = f"unknown setting `sweep.{str(name)[:60]}`", did_you_mean(name, [*SETTINGS, *PLACES])
            expected = f"one of {', '.join(SETTINGS)}, or a path in the scenario as threats[0].scale"
            raise ScenarioError(problem, source=key.source, expected=expected, fix=fix)
    return {name: Key(value, f"sweep.{name}", key.source) for name, value in value.items()}


def _new_place(name: str) -> str:
    """`movers[0].walk` of release 0.3 as `moving_threats[0].walk`."""
    first = _first(name)
    return name if RENAMED.get(first) not in PLACES else RENAMED[first] + name[len(first) :]


def _values(name: str, key: Key) -> tuple[Any, ...]:
    items = key.items("a list of values")
    values = tuple(SETTINGS[name](item) if name in SETTINGS else item.value for item in items)
    twice = [value for at, value in enumerate(values) if value in values[:at]]
    if twice:
        raise key.wrong(f"distinct values, not {twice[0]!r} twice")
    return values


def _maps(keys: dict[str, Key], base: Json, swept: Swept) -> int | None:
    """Number of maps, None: the one of the input. Raises ScenarioError for settings that its worlds do not have."""
    names = sorted({*base, *dict(swept)})
    inputs = [*([base["input"]] if "input" in base else ()), *dict(swept).get("input", ())]
    generated = any(generators(scenario_of(name)) for name in inputs) if inputs else "plan" not in names
    for name in names:
        problem, fix = "", "remove it"
        if name in PAPER and inputs:
            problem = f"{name} is for the paper's random worlds"
        elif is_path(name) and not is_scenario_path(name) and not inputs:
            problem = f"{name} is for an input in `base`"
        elif name in WORLD and inputs and not generated:
            problem = f"{name}: the input has no generated threats"
            fix = "add threats with `generate`, or remove it"
        if problem:
            raise ScenarioError(problem, source=keys["base"].source, fix=fix)
    asked = [keys[name] for name in ("maps", "first_seed") if name in keys and keys[name].value != DEFAULTS.get(name)]
    if asked and not generated:
        fix = "remove it, or add threats with `generate` to the input"
        raise asked[0].wrong("no maps, since the input is a single map", fix)
    if not generated or (inputs and not asked):
        return None
    if MODEL["seed"](keys["first_seed"]) + MOST_MAPS >= MOST_SEED:
        raise keys["first_seed"].wrong(f"at most 2**64 - {MOST_MAPS}")
    return keys["maps"].number(whole(1, MOST_MAPS)) if "maps" in keys else DEFAULT_MAPS


def _check_value(spec: Spec, places: Places, name: str, value: Any) -> None:
    """Raise InputError that names the file if this value is invalid with the first values of the others."""
    chosen = spec.base | {other: values[0] for other, values in spec.swept}
    chosen |= {name: value} if name != "base" else {}
    try:
        model_of(chosen, 0)
        places.team(spec.case(chosen, 0))
    except InputError as error:
        parts = [f"sweep.{name}" if name != "base" else "", error.source, error.problem]
        problem = ": ".join(part for part in parts if part)
        raise ScenarioError(problem, source=spec.source, expected=error.expected, fix=error.fix) from error
