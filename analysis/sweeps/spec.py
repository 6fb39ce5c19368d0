"""A sweep file: what is crossed with what, on how many maps, as jobs in order of maps.

    base: {kind: contiguous, size: 20x20}    # settings for all: names of SETTINGS; `input: FILE` for another world
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

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

from analysis.sweeps.cases import Case, Label, Places
from analysis.sweeps.engine import Job
from analysis.sweeps.spec_settings import (
    MODEL,
    PAPER,
    PLACES,
    PLANNER,
    SETTINGS,
    WORLD,
    generated_world,
    generators,
    is_beside,
    is_path,
    label_of,
    model_of,
    scenario_of,
    written_world,
)
from analysis.sweeps.worlds import MOST_MAPS, Generated
from planner.arguments import did_you_mean, whole
from planner.errors import InputError, ScenarioError
from planner.files import Json
from planner.limits import MOST_ROLLOUTS
from planner.policies import DEFAULT
from planner.rollouts.blocks import MOST_SEED
from planner.settings import Choices
from planner.worlds.keys import Key, read_yaml

DEFAULTS = {"base": {}, "sweep": {}, "first_seed": 0, "rollouts": 1000, "seed": 0}
DEFAULT_MAPS = 50
MOST_CHECKED = 100
"""Values of a name that are tried before the first rollout."""
Swept = tuple[tuple[str, tuple[Any, ...]], ...]
"""(name, values), names in the order given."""


@dataclass(frozen=True, eq=False)
class Spec:
    """A sweep. A setting is one choice of a value for every name; they are numbered in the order of the product.

    Attributes:
        source: the file. base: values by name. swept: what is crossed.
        maps: how many random maps, or None for the one map that the input describes. first_seed: seed of the first.
        rollouts: on each map of each setting. seed: of the rollouts on the first map.
    """

    source: Path
    base: Json
    swept: Swept
    maps: int | None
    first_seed: int
    rollouts: int

    @cached_property
    def cases(self) -> list[Json]:
        """The swept values of every case on a map: of the settings apart from the models'."""
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
        """The swept values of setting (case, model), by name in the order given."""
        chosen = self.cases[case] | self.models[model]
        return {name: label_of(name, chosen[name], self.source.parent) for name, _ in self.swept}

    def jobs(self, first: int = 0, stop: int | None = None) -> Iterator[Job]:
        """The jobs of maps `first .. stop - 1` (None: all), map by map; `tag` numbers them: map * cases + case."""
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
            labels = {**dict[str, Label](kind=world.kind, ratio=world.ratio), **labels}
        if seed is not None:
            labels["map"] = seed
        choices = Choices(**{name: values[name] for name in PLANNER if name in values})
        team = (values.get("robots"), values.get("starts"), choices, values.get("plan"))
        return Case(world, *team, tuple(labels.items()))


def _crossed(swept: Iterable[tuple[str, tuple[Any, ...]]]) -> list[Json]:
    """Every choice of a value for each name, the last name's fastest."""
    lists = [[(name, value) for value in values] for name, values in swept]
    return [dict(chosen) for chosen in product(*lists)]


def read_spec(path: Path) -> Spec:
    """The sweep in a YAML file; every value, and the settings of the first map, are checked. Raises InputError."""
    top = read_yaml(path)
    if isinstance(top.value, dict) and {"map", "image"} & top.value.keys():
        fix = f"a sweep over it has `base: {{input: {path.name}}}`"
        raise ScenarioError("is a scenario or a map", source=path, expected="a sweep file", fix=fix)
    keys = top.mapping(optional=("maps",), defaults=DEFAULTS)
    if isinstance(keys["base"].value, dict) and "map" in keys["base"].value:
        raise keys["base"].wrong("settings alone", "put the scenario into a file, and name that: `input: FILE`")
    given = keys["base"].mapping(optional=[name for name in SETTINGS if name != "seed"])
    base = {name: SETTINGS[name](key) for name, key in given.items()} | {"seed": MODEL["seed"](keys["seed"])}
    swept = tuple((name, _values(name, key)) for name, key in _swept(keys["sweep"]).items())
    rollouts = keys["rollouts"].number(whole(1, MOST_ROLLOUTS))
    spec = Spec(path, base, swept, _maps(keys, base, swept), MODEL["seed"](keys["first_seed"]), rollouts)
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
            problem, fix = f"unknown setting `sweep.{str(name)[:60]}`", did_you_mean(name, [*SETTINGS, *PLACES])
            expected = f"one of {', '.join(SETTINGS)}, or a place in the scenario as threats[0].scale"
            raise ScenarioError(problem, source=key.source, expected=expected, fix=fix)
    return {name: Key(value, f"sweep.{name}", key.source) for name, value in key.value.items()}


def _values(name: str, key: Key) -> tuple[Any, ...]:
    items = key.items("a list of values")
    values = tuple(SETTINGS[name](item) if name in SETTINGS else item.value for item in items)
    twice = [value for at, value in enumerate(values) if value in values[:at]]
    if twice:
        raise key.wrong(f"every value once, not {twice[0]!r} twice")
    return values


def _maps(keys: dict[str, Key], base: Json, swept: Swept) -> int | None:
    """How many maps are asked for, None: the one of the input. Raises ScenarioError for what its worlds do not have."""
    names = sorted({*base, *dict(swept)})
    inputs = [*([base["input"]] if "input" in base else ()), *dict(swept).get("input", ())]
    generated = any(generators(scenario_of(name)) for name in inputs) if inputs else "plan" not in names
    for name in names:
        problem, fix = "", "leave it out"
        if name in PAPER and inputs:
            problem = f"{name} is for the paper's random worlds"
        elif is_path(name) and not is_beside(name) and not inputs:
            problem = f"{name} is for an input in `base`"
        elif name in WORLD and inputs and not generated:
            problem = f"{name}: the input has no generated threats"
            fix = "give it threats with `generate`, or leave it out"
        if problem:
            raise ScenarioError(problem, source=keys["base"].source, fix=fix)
    asked = [keys[name] for name in ("maps", "first_seed") if name in keys and keys[name].value != DEFAULTS.get(name)]
    if asked and not generated:
        fix = "leave it out, or give the input threats that are generated"
        raise asked[0].wrong("no maps, since the input is one", fix)
    if not generated or (inputs and not asked):
        return None
    if MODEL["seed"](keys["first_seed"]) + MOST_MAPS >= MOST_SEED:
        raise keys["first_seed"].wrong(f"at most 2**64 - {MOST_MAPS}")
    return keys["maps"].number(whole(1, MOST_MAPS)) if "maps" in keys else DEFAULT_MAPS


def _check_value(spec: Spec, places: Places, name: str, value: Any) -> None:
    """Raise InputError, naming the file, if this value cannot be, with the first values of the others."""
    chosen = spec.base | {other: values[0] for other, values in spec.swept}
    chosen |= {name: value} if name != "base" else {}
    try:
        model_of(chosen, 0)
        places.team(spec.case(chosen, 0))
    except InputError as error:
        parts = [f"sweep.{name}" if name != "base" else "", error.source, error.problem]
        problem = ": ".join(part for part in parts if part)
        raise ScenarioError(problem, source=spec.source, expected=error.expected, fix=error.fix) from error
