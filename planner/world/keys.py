"""Checked reading of YAML files: every value keeps its key path, so that errors can name `threats[1].rule.kind`."""

from __future__ import annotations

import difflib
import itertools
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from planner.arguments import ANY, Numbers, did_you_mean, whole
from planner.errors import InputError, ScenarioError, WorldError, warn_renamed, with_new_names
from planner.files import printable, why_no_file
from planner.formatting import counted, seconds_of
from planner.settings import Setting

MAX_YAML_BYTES = 2**18
"""Largest YAML file that is parsed: about 25,000 starts."""
MAX_NODES = 20_000
"""Most keys and values in one YAML file, counted as often as aliases and merge keys repeat them."""
MAX_ALIASES = 50
"""Most aliases (`*name`) in one YAML file."""
PLACE = whole(-(2**31) + 1, 2**31 - 1)
"""A row or column in a file that can belong to some map."""


@dataclass(frozen=True)
class Key:
    """A value of a YAML or JSON file and its place.

    Attributes:
        value: as loaded.
        path: key path, for example `threats[1].rule.kind`; "" at the top.
        source: the file.
        error: the exception for a wrong value. fix: default fix in messages.
    """

    value: Any
    path: str
    source: str | Path
    error: type[InputError] = ScenarioError
    fix: str = ""

    def wrong(self, expected: str, fix: str = "") -> InputError:
        """The error for this value; it names key path, value and expectation."""
        return self.fault(f"is {reprlib.repr(self.value)}", expected, fix)

    def fault(self, problem: str, expected: str = "", fix: str = "") -> InputError:
        """The error for another problem with it: "`threats[0].raster` gives ..."."""
        where = f"`{self.path}`" if self.path else "the file"
        return self.error(f"{where} {problem}", source=self.source, expected=expected, fix=fix or self.fix)

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Context in which a WorldError about this value names it."""
        try:
            yield
        except WorldError as error:
            # Builders that read keys name them already.
            named = error.problem.startswith(f"`{self.path}")
            problem = error.problem if named else f"`{self.path}`: {error.problem}"
            raise self.error(problem, source=self.source, expected=error.expected, fix=error.fix) from error

    def mapping(
        self,
        required: Iterable[str] = (),
        optional: Iterable[str] = (),
        defaults: Mapping[str, Any] | None = None,
        strict: bool = True,
    ) -> dict[str, Key]:
        """The keys of the value.

        Args:
            required: names that must be there.
            optional: further names.
            defaults: names that are always there, with their defaults.
            strict: whether unknown keys are errors.

        Raises:
            InputError: of `error`, for a missing or unknown key.
        """
        defaults = {} if defaults is None else defaults
        required = list(required)
        allowed = [*required, *optional, *defaults]
        if not isinstance(self.value, dict):
            raise self.wrong(f"keys ({', '.join(allowed)})")
        # Names of release 0.3 are read first, so that errors name today's keys.
        given = with_new_names(self.value, allowed, self.source)
        unknown = [name for name in given if name not in allowed]
        dot = f"{self.path}." if self.path else ""
        if unknown and strict:
            problem, fix = f"unknown key `{dot}{str(unknown[0])[:60]}`", did_you_mean(unknown[0], allowed) or self.fix
            raise self.error(problem, source=self.source, expected=f"one of {', '.join(allowed)}", fix=fix)
        for name in required:
            if name not in given:
                close = difflib.get_close_matches(name, [str(other) for other in unknown], n=1)
                fix = f"did you mean it by {close[0]!r}?" if close else ""
                raise self.error(f"key `{dot}{name}` is missing", source=self.source, fix=fix or self.fix)
        values = {**defaults, **given}
        return {name: self._child(values[name], f"{dot}{name}") for name in allowed if name in values}

    def items(self, expected: str, least: int = 1, exactly: int = 0) -> list[Key]:
        """The elements of a list.

        Args:
            expected: for messages.
            least: fewest elements.
            exactly: number of elements, 0: any.

        Raises:
            InputError: of `error`, for another value.
        """
        if not isinstance(self.value, list) or len(self.value) < least or exactly not in (0, len(self.value)):
            raise self.wrong(expected)
        return [self._child(value, f"{self.path}[{index}]") for index, value in enumerate(self.value)]

    def number(self, of: Numbers = ANY, expected: str = "") -> Any:
        """A checked number, int if `of` is whole, else float; `expected`: for messages, instead of `of`'s."""
        if not of.accepts(self.value):
            raise self.wrong(expected or of.expected, of.meant(self.value))
        return int(self.value) if of.whole else float(self.value)

    def numbers(self, of: Numbers, expected: str, count: int = 0) -> list[Any]:
        """A list of checked numbers, `count` of them unless 0."""
        return [item.number(of, expected) for item in self.items(expected, exactly=count)]

    def setting(self, setting: Setting) -> Any:
        """A checked value of a planner setting: also a list by robot, or a duration such as `45min`."""
        if setting.words and not setting.places:
            word = self.choice(setting.words, setting.before)
            if word != self.value:
                warn_renamed(f"`{self.path}: {self.value}`", f"`{word}`", self.source)
            return word
        if setting.time and isinstance(self.value, str) and seconds_of(self.value) is not None:
            return self.value
        value = tuple(self.value) if isinstance(self.value, list) else self.value
        if setting.places and isinstance(value, tuple):
            value = tuple(tuple(place) if isinstance(place, list) else place for place in value)
        if not setting.accepts(value):
            raise self.wrong(
                setting.expected("null"), setting.numbers.meant(value) or did_you_mean(value, setting.words)
            )
        return setting.plain(value)

    def text(self, expected: str) -> str:
        """A string that is not empty."""
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.wrong(expected)
        return self.value

    def choice(self, options: Iterable[str], before: Mapping[str, str] | None = None) -> str:
        """One of `options`; `before`: words of earlier releases, with today's words."""
        options = list(options)
        value = self.value
        if before and isinstance(value, str) and value in before:
            value = before[value]
        if not isinstance(value, str) or value not in options:
            raise self.wrong(" or ".join(options), did_you_mean(self.value, options))
        return value

    def file(self, expected: str, folder: Callable[[Path], bool] = lambda path: False) -> Path:
        """A path relative to the file that names it.

        Args:
            expected: for messages.
            folder: whether a folder is accepted in place of a file.

        Raises:
            InputError: of `error`, if there is no such file.
        """
        path = Path(self.source).parent / self.text(expected)
        problem = why_no_file(path)
        if problem and not folder(path):
            problem = f"`{self.path}`: {problem}: {printable(path)!r}"
            raise self.error(problem, source=self.source, expected=expected)
        return path

    def _child(self, value: Any, path: str) -> Key:
        return Key(value, path, self.source, self.error, self.fix)


INTEGER, FLOAT = r"[-+]?[0-9]+", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
INFINITE = r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
"""Numbers of YAML 1.2's core schema: `1e-3` is a number, `1:30`, `0x1F` and `1_000` are text, `017` is 17."""
TAG = "tag:yaml.org,2002:"


class _Loader(yaml.SafeLoader):
    """The safe loader with YAML 1.2's numbers, without dates, duplicate keys and sets.

    Time and memory are proportional to the file, whatever its anchors, aliases and merge keys expand to.
    """

    yaml_constructors: ClassVar[dict[str | None, Any]] = {
        tag: make
        for tag, make in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag in {TAG + name for name in ("null", "str", "seq", "map")}
    }
    aliases = nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """The next node, counted; an error beyond MAX_NODES nodes or MAX_ALIASES aliases."""
        self.nodes += 1
        self.aliases += self.check_event(yaml.AliasEvent)
        for count, most, what in (self.nodes, MAX_NODES, "keys and values"), (self.aliases, MAX_ALIASES, "aliases"):
            if count > most:
                mark = self.peek_event().start_mark
                raise yaml.MarkedYAMLError(problem=f"more than {most} {what}", problem_mark=mark)
        return super().compose_node(parent, index)

    def get_single_node(self) -> yaml.Node | None:
        """The top node; an error if it contains itself, or exceeds MAX_NODES with aliases and merges expanded."""
        top = super().get_single_node()
        if top is not None:
            self._expanded(top, {})
        return top

    def _expanded(self, node: yaml.Node, known: dict[yaml.Node, int]) -> int:
        """Number of nodes of `node` with aliases expanded; `known`: results, 0 while a node is being counted."""
        if node not in known:
            # 0 marks a node in progress: meeting it again means a cycle.
            known[node] = 0
            parts = node.value if isinstance(node, yaml.CollectionNode) else ()
            parts = itertools.chain.from_iterable(parts) if isinstance(node, yaml.MappingNode) else parts
            known[node] = 1 + sum(self._expanded(part, known) for part in parts)
        if not 0 < known[node] <= MAX_NODES:
            what = f"more than {MAX_NODES} keys and values, aliases followed" if known[node] else "it holds itself"
            raise yaml.MarkedYAMLError(problem=what, problem_mark=node.start_mark)
        return known[node]

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping of a node; an error if it has a key twice, which YAML itself accepts."""
        if not isinstance(node, yaml.MappingNode):
            raise yaml.MarkedYAMLError(problem="expected keys and values", problem_mark=node.start_mark)
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:merge" and isinstance(key.value, str):
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"key {key.value!r} twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def scalar(self, node: yaml.Node) -> bool | int | float:
        """A boolean or a number; an error if the text does not match the tag."""
        text, kind = str(node.value), node.tag.removeprefix(TAG)
        if kind == "bool" and text.lower() in self.bool_values:
            return self.bool_values[text.lower()]
        if kind in ("int", "float") and re.fullmatch(INTEGER if kind == "int" else FLOAT, text):
            return int(text) if kind == "int" else float(text)
        if kind == "float" and re.fullmatch(INFINITE, text):
            return float(text.replace(".", ""))
        raise yaml.MarkedYAMLError(problem=f"{text[:40]!r} is no {kind}", problem_mark=node.start_mark)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in known if tag in (TAG + "bool", TAG + "null", TAG + "merge")]
    for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _kind, _pattern, _first in (("int", INTEGER, "-+0123456789"), ("float", f"{FLOAT}|{INFINITE}", "-+.0123456789")):
    _Loader.add_implicit_resolver(TAG + _kind, re.compile(rf"(?:{_pattern})\Z"), list(_first))
for _kind in ("bool", "int", "float"):
    _Loader.add_constructor(TAG + _kind, _Loader.scalar)


def read_yaml(path: Path, error: type[InputError] = ScenarioError) -> Key:
    """Read a YAML file, with numbers by YAML 1.2's core rules.

    Args:
        path: the file.
        error: exception for malformed text, which names file and line.
    """
    problem = why_no_file(path)
    if problem:
        raise error(problem, source=printable(path), expected="a YAML file")
    try:
        with path.open("rb") as stream:
            # One byte more than allowed is enough to detect a larger file.
            data = stream.read(MAX_YAML_BYTES + 1)
        if len(data) > MAX_YAML_BYTES:
            raise error(f"more than {MAX_YAML_BYTES} bytes", source=path, expected="a small YAML file")
        value = yaml.load(data.decode("utf-8-sig"), Loader=_Loader)  # a SafeLoader
    except yaml.MarkedYAMLError as wrong:
        mark = wrong.problem_mark or wrong.context_mark
        line = f"line {mark.line + 1}: " if mark else ""
        raise error(f"{line}{wrong.problem or wrong.context}", source=path, expected="YAML") from wrong
    except InputError:
        raise
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError, OSError) as wrong:
        raise error(f"cannot be read as YAML ({wrong})", source=path, expected="YAML in UTF-8") from wrong
    return Key(value, "", path, error)


def named_files(value: Any, folder: Path) -> Iterator[Path]:
    """Files in `folder` that are named by texts in a YAML value."""
    if isinstance(value, str):
        if value and why_no_file(folder / value) == "":
            yield folder / value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from named_files(item, folder)


# Numbers of a cell, a point or a polygon: its threat, its value, its detection probability.

LARGEST_VALUE = 1e9
"""Largest value of a cell."""


class Quantity(NamedTuple):
    """A number in files.

    Attributes:
        name: property of a feature, and column of a points file (besides `strength`).
        numbers: valid numbers.
    """

    name: str
    numbers: Numbers


PROBABILITY = Numbers(0, 1 - 2**-25, below=True, text="a probability 0 <= p < 1")
"""Valid float64 numbers are also below 1 as float32."""
CHANCE = Numbers(0, 1, "a chance")
CELL_SIZE = Numbers(1e-5, 1e6, "a number of metres")
"""Side of a cell: centres stay distinct in micrometres, the resolution of waypoints."""
FARTHEST = 1e9
"""Largest coordinate accepted, in metres: beyond it float64 cannot distinguish the smallest cells."""
DISTANCE = Numbers(CELL_SIZE.least, FARTHEST, "a number of metres")
COORDINATE = Numbers(-FARTHEST, FARTHEST, text=f"metres, none beyond {FARTHEST:g}")
POSE = f"three numbers [x, y, yaw], none beyond {FARTHEST:g}"
SCALE = Numbers(1e-7, 1e4)
"""Units of a CRS per metre: a degree has 1e5 metres, a foot 0.3."""
SHARE = Numbers(0, 1, above=True)
THREAT = Quantity("p", PROBABILITY)
VALUE = Quantity("value", Numbers(0, LARGEST_VALUE))
DETECT = Quantity("detect", CHANCE)
SAMPLE = Quantity("value", ANY)
"""A measured value, before a rule turns it into p."""


def first_of(wrong: NDArray[np.bool_]) -> tuple[tuple[int, int], str]:
    """The first wrong cell, for messages.

    Args:
        wrong: bool `[H, W]`.

    Returns:
        ((row, col), text as "at [0, 3] (2 such cells)").
    """
    row, col = np.argwhere(wrong)[0].tolist()
    return (row, col), f"at [{row}, {col}] ({counted(int(wrong.sum()), 'such cell')})"


def as_numbers(given: ArrayLike, name: str, source: str, kinds: str = "fiu") -> NDArray:
    """An array of real numbers.

    Args:
        given: of any shape.
        name, source: for messages.
        kinds: accepted kinds of data types.

    Raises:
        WorldError: rows of different lengths, or no numbers.
    """
    try:
        array = np.asarray(given)
    except ValueError:
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in kinds:
        problem = f"{name} holds {array.dtype}"
        raise WorldError(problem, source=source, expected="numbers, in rows of one length")
    return array


def checked_layer(
    given: ArrayLike | None, of: Quantity, free: NDArray[np.bool_], source: str
) -> NDArray[np.float64] | None:
    """A checked number for each free cell.

    Args:
        given: `[H, W]`, or one number for all cells; None: not given.
        of: the quantity.
        free: bool `[H, W]`.
        source: for messages.

    Returns:
        float64 `[H, W]`, 0 on obstacles, or None.

    Raises:
        WorldError: names the first invalid cell.
    """
    if given is None:
        return None
    array = as_numbers(given, of.name, source)
    # A masked value would otherwise count as the number under the mask.
    unsaid = free & np.ma.getmaskarray(given) if isinstance(given, np.ma.MaskedArray) else np.zeros_like(free)
    if (array.ndim and array.shape != free.shape) or unsaid.any():
        problem = f"{of.name} is masked {first_of(unsaid)[1]}" if unsaid.any() else f"{of.name} has shape {array.shape}"
        expected = f"one number, or one in every free cell of the map, {list(free.shape)}"
        raise WorldError(
            problem, source=source, expected=expected, fix="fill it, as by .filled(1)" * bool(unsaid.any())
        )
    layer = np.where(free, array.astype(np.float64), 0.0)
    wrong = ~((layer >= 0) & (layer <= of.numbers.most))
    if wrong.any():
        at, where = first_of(wrong)
        raise WorldError(f"{of.name} is {layer[at]:g} {where}", source=source, expected=of.numbers.expected)
    if of is VALUE and not layer.any():
        raise WorldError("value is 0 in every free cell", source=source, expected="a cell with a value above 0")
    layer.setflags(write=False)
    return layer
