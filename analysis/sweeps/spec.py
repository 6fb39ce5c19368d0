"""A sweep file: what is crossed with what, on how many maps, as jobs in order of maps.

    base: {kind: contiguous, size: 20x20}    # settings for all; a scenario's keys, or input: FILE, for another world
    maps: 50                                 # random maps; with an input: of its `generate` threats, else left out
    first_seed: 0                            # of the first map
    rollouts: 1000                           # of each setting on each map
    seed: 0                                  # of the rollouts on the first map
    sweep:                                   # crossed in the order given, each a list of values
      robots: [1, 2, 4]                      # names: SETTINGS; or a place in the scenario, as "threats[0].scale"

Common random numbers: every setting meets the same maps (world seeds `first_seed ..`), and on map i the same rollouts
(seed `seed + i`), so that differences between settings are sharp.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from analysis.sweeps.cases import Case, Label, Places
from analysis.sweeps.engine import Job
from analysis.sweeps.spec_settings import (
    INPUT,
    MODEL,
    PAPER,
    SCENARIO,
    SETTINGS,
    WORLD,
    case_of,
    check_settings,
    generators,
    is_path,
    label_of,
    model_of,
    scenario_of,
)
from analysis.sweeps.worlds import MOST_MAPS
from planner.errors import InputError, ScenarioError
from planner.files import Json
from planner.limits import MOST_ROLLOUTS
from planner.policies import DEFAULT
from planner.rollouts.blocks import MOST_SEED
from planner.worlds.keys import Key, read_yaml

DEFAULTS = {"base": {}, "sweep": {}, "first_seed": 0, "rollouts": 1000, "seed": 0}
DEFAULT_MAPS = 50
MOST_CHECKED = 100
"""Values of a name that are tried before the first rollout."""


@dataclass(frozen=True, eq=False)
class Spec:
    """A sweep. A setting is one choice of a value for every name; they are numbered in the order of the product.

    Attributes:
        source: the file. base: values by name; scenario: the base's scenario keys (with `map`), or None.
        swept: (name, values), names in the order given.
        maps: how many random maps, or None for the one map that the input describes. first_seed: seed of the first.
        rollouts: on each map of each setting. seed: of the rollouts on the first map.
    """

    source: Path
    base: Json
    scenario: Json | None
    swept: tuple[tuple[str, tuple[Any, ...]], ...]
    maps: int | None
    first_seed: int
    rollouts: int

    @property
    def settings(self) -> int:
        """Number of settings."""
        return self.cases * self.models

    @property
    def policies(self) -> tuple[Any, ...]:
        """The policies of its cases."""
        given = {"policy": DEFAULT} | (self.scenario or {}) | self.base
        return dict(self.swept).get("policy", (given["policy"],))

    @property
    def cases(self) -> int:
        """Cases on a map: settings apart from the models'."""
        return _count(values for name, values in self.swept if name not in MODEL)

    @property
    def models(self) -> int:
        """Models of a case."""
        return _count(values for name, values in self.swept if name in MODEL)

    def labels(self, case: int, model: int) -> dict[str, Label]:
        """The swept values of setting (case, model), by name in the order given."""
        chosen = self._chosen(case, MODEL, False) | self._chosen(model, MODEL, True)
        return {name: label_of(name, chosen[name], self.source.parent) for name, _ in self.swept}

    def jobs(self, first: int = 0, stop: int | None = None) -> Iterator[Job]:
        """The jobs of maps `first .. stop - 1` (None: all), map by map; `tag` numbers them: map * cases + case."""
        for number in range(first, (self.maps or 1) if stop is None else stop):
            for case in range(self.cases):
                yield self.job(number, case)

    def job(self, number: int, case: int) -> Job:
        """The case `case` on map `number` with all its models. Raises InputError."""
        values = self.base | self._chosen(case, MODEL, False)
        models = tuple(model_of(values | self._chosen(m, MODEL, True), number) for m in range(self.models))
        return Job(self.case(values, number), models, self.rollouts, tag=number * self.cases + case)

    def case(self, values: Json, number: int) -> Case:
        """The case of these values on map `number`. Raises InputError."""
        seed = self.first_seed + number
        folder = self.source.parent
        named = {n: label_of(n, v, folder) for n, v in values.items() if n not in MODEL}
        if self.maps is not None:
            named["map"] = seed
        scenario: tuple[Json, str] | None = None
        if "input" in values:
            scenario = scenario_of(values["input"])
        elif self.scenario is not None:
            scenario = (self.scenario, str(self.source))
        else:
            named = {"kind": values.get("kind", "contiguous"), "ratio": values.get("ratio", 0.25)} | named
        return case_of(values, scenario, None if self.maps is None else seed, tuple(named.items()))

    def _chosen(self, number: int, names: Any, inside: bool) -> Json:
        """The values of the swept names that are (or are not) in `names`, of combination `number`."""
        chosen = {}
        for name, values in reversed([each for each in self.swept if (each[0] in names) == inside]):
            number, index = divmod(number, len(values))
            chosen[name] = values[index]
        return chosen


def _count(lists: Any) -> int:
    total = 1
    for values in lists:
        total *= len(values)
    return total


def read_spec(path: Path) -> Spec:
    """The sweep in a YAML file; every value, and the settings of the first map, are checked. Raises InputError."""
    top = read_yaml(path)
    if isinstance(top.value, dict) and {"map", "image"} & top.value.keys():
        fix = f"a sweep over it has `base: {{input: {path.name}}}`"
        raise ScenarioError("is a scenario or a map", source=path, expected="a sweep file", fix=fix)
    keys = top.mapping(optional=("maps",), defaults=DEFAULTS)
    base_keys = keys["base"].mapping(optional=(*SETTINGS, *SCENARIO))
    scenario = {name: key.value for name, key in base_keys.items() if name in SCENARIO}
    base = {}
    for name, key in base_keys.items():
        if name == "robots" and isinstance(key.value, dict):
            scenario["robots"] = key.value
        elif name in SETTINGS:
            base[name] = SETTINGS[name](key)
    base["seed"] = MODEL["seed"](keys["seed"])
    if scenario and "map" not in scenario:
        raise ScenarioError(f"`base` has {', '.join(scenario)} but no map", source=path, expected="map, or input")
    if scenario and "input" in base:
        raise ScenarioError("`base` has both a map and an input", source=path, expected="one of them")
    swept = tuple((name, _values(name, key)) for name, key in _swept(keys["sweep"]).items())
    rollouts = keys["rollouts"].integer("a whole number >= 1", lambda n: 1 <= n <= MOST_ROLLOUTS)
    first = MODEL["seed"](keys["first_seed"])
    spec = Spec(path, base, scenario or None, swept, None, first, rollouts)
    _check_worlds(spec)
    if _is_generated(spec):
        papers = scenario == {} and "input" not in _names(spec)
        if "maps" in keys or papers or keys["first_seed"].value:
            count = keys["maps"].integer(f"1..{MOST_MAPS}", lambda n: 1 <= n <= MOST_MAPS) if "maps" in keys else None
            spec = replace(spec, maps=count or DEFAULT_MAPS)
            if first + MOST_MAPS >= MOST_SEED:
                raise keys["first_seed"].wrong(f"at most 2**64 - {MOST_MAPS}")
    elif "maps" in keys or keys["first_seed"].value:
        raise keys["maps" if "maps" in keys else "first_seed"].wrong(
            "no maps, since the input is one", "leave it out, or give the input threats that are generated"
        )
    places = Places()
    for name, values in swept or (("base", (None,)),):  # what is wrong is found before the first rollout
        for value in values[:MOST_CHECKED]:
            _check_value(spec, places, name, value)
    return spec


def _swept(key: Key) -> dict[str, Key]:
    """The swept names: settings, or places in a scenario."""
    if not isinstance(key.value, dict):
        raise key.wrong("names of settings with lists of values")
    for name in key.value:
        if name not in SETTINGS and not is_path(str(name)):
            close = difflib.get_close_matches(str(name)[:60], [*SETTINGS, *SCENARIO], n=1)
            fix = f"did you mean {close[0]!r}?" if close else ""
            expected = f"one of {', '.join(SETTINGS)}, or a place in the scenario as threats[0].scale"
            raise ScenarioError(
                f"unknown setting `sweep.{str(name)[:60]}`", source=key.source, expected=expected, fix=fix
            )
    return {name: Key(value, f"sweep.{name}", key.source) for name, value in key.value.items()}


def _values(name: str, key: Key) -> tuple[Any, ...]:
    items = key.items("a list of values")
    values = tuple(SETTINGS[name](item) if name in SETTINGS else item.value for item in items)
    twice = [value for at, value in enumerate(values) if value in values[:at]]
    if twice:
        raise key.wrong(f"every value once, not {twice[0]!r} twice")
    return values


def _check_worlds(spec: Spec) -> None:
    """Raise ScenarioError for settings of worlds that this sweep does not have."""
    names = {*spec.base, *(name for name, _ in spec.swept)}
    inputs = "input" in names
    written = inputs or spec.scenario is not None
    for name in sorted(names):
        if (name in PAPER and written) or (is_path(name) and spec.scenario is None and not inputs):
            expected = "the paper's random worlds" if name in PAPER else "a map or an input in `base`"
            raise ScenarioError(f"{name} is for {expected}", source=spec.source, fix="leave it out")
        if name in WORLD and written and not _is_generated(spec):
            fix = "give it threats with `generate`, or leave it out"
            raise ScenarioError(f"{name}: the input has no generated threats", source=spec.source, fix=fix)
    if names >= {"input"} and spec.scenario is not None:
        raise ScenarioError("an input and a map", source=spec.source, expected="one of them")


def _is_generated(spec: Spec) -> bool:
    """True if a map's seed changes the worlds of this sweep."""
    inputs = [spec.base["input"]] if "input" in spec.base else []
    inputs += [value for name, values in spec.swept if name in INPUT for value in values]
    if inputs:
        return any(generators(scenario_of(name)[0]) for name in inputs)
    return bool(generators(spec.scenario)) if spec.scenario is not None else "plan" not in _names(spec)


def _names(spec: Spec) -> set[str]:
    return {*spec.base, *(name for name, _ in spec.swept)}


def _check_value(spec: Spec, places: Places, name: str, value: Any) -> None:
    """Raise InputError, naming the file, if this value cannot be, with the first values of the others."""
    chosen = spec.base | {other: values[0] for other, values in spec.swept}
    chosen |= {name: value} if name != "base" else {}
    try:
        check_settings(chosen)
        places.team(spec.case(chosen, 0))
    except InputError as error:
        parts = [f"sweep.{name}" if name != "base" else "", error.source, error.problem]
        problem = ": ".join(part for part in parts if part)
        raise ScenarioError(problem, source=spec.source, expected=error.expected, fix=error.fix) from error
