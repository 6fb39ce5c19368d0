"""Checked reading of YAML files: every value keeps its key path, so that an error can name `threats[1].rule.kind`."""

from __future__ import annotations

import difflib
import math
import re
import reprlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from planner.errors import InputError, ScenarioError

MAX_YAML_BYTES = 2**20
"""Largest YAML file that is parsed."""
MAX_ALIASES = 50
"""Most aliases (`*name`) in one YAML file: values are never expanded, this bounds what a reader must follow."""


@dataclass(frozen=True)
class Key:
    """One value of a YAML file and where it stands.

    Attributes:
        value: what the safe loader made of it.
        path: key path, for example `threats[1].rule.kind`; "" at the top.
        source: the file.
        error: the exception that a wrong value raises.
    """

    value: Any
    path: str
    source: Path
    error: type[InputError] = ScenarioError

    def wrong(self, expected: str, fix: str = "") -> InputError:
        """The error for this value: names key path, value, what was expected."""
        where = f"`{self.path}`" if self.path else "the file"
        return self.error(f"{where} is {reprlib.repr(self.value)}", source=self.source, expected=expected, fix=fix)

    def mapping(
        self,
        required: Iterable[str] = (),
        optional: Iterable[str] = (),
        defaults: Mapping[str, Any] | None = None,
        strict: bool = True,
    ) -> dict[str, Key]:
        """The value's keys; those in `defaults` are always there. Missing and (if `strict`) unknown ones are errors."""
        defaults = {} if defaults is None else defaults
        required = list(required)
        allowed = [*required, *optional, *defaults]
        if not isinstance(self.value, dict):
            raise self.wrong(f"keys ({', '.join(allowed)})")
        unknown = [name for name in self.value if name not in allowed]
        dot = f"{self.path}." if self.path else ""
        if unknown and strict:
            close = difflib.get_close_matches(str(unknown[0]), allowed, n=1)
            fix = f"did you mean {close[0]!r}?" if close else ""
            problem = f"unknown key `{dot}{str(unknown[0])[:60]}`"
            raise self.error(problem, source=self.source, expected=f"one of {', '.join(allowed)}", fix=fix)
        for name in required:
            if name not in self.value:
                close = difflib.get_close_matches(name, [str(other) for other in unknown], n=1)
                fix = f"did you mean it by {close[0]!r}?" if close else ""
                raise self.error(f"key `{dot}{name}` is missing", source=self.source, fix=fix)
        values = {**defaults, **self.value}
        return {name: self._child(values[name], f"{dot}{name}") for name in allowed if name in values}

    def items(self, expected: str, least: int = 1) -> list[Key]:
        """The value's elements; an error unless it is a list of at least `least`."""
        if not isinstance(self.value, list) or len(self.value) < least:
            raise self.wrong(expected)
        return [self._child(value, f"{self.path}[{index}]") for index, value in enumerate(self.value)]

    def number(self, expected: str, ok: Callable[[float], bool] = lambda value: True) -> float:
        """A finite number (no boolean) that satisfies `ok`."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.wrong(expected)
        try:
            value = float(self.value)
        except OverflowError:
            raise self.wrong(expected) from None
        if not math.isfinite(value) or not ok(value):
            raise self.wrong(expected)
        return value

    def integer(self, expected: str, ok: Callable[[int], bool] = lambda value: True) -> int:
        """A whole number (no boolean, no 8.0) that satisfies `ok`."""
        if isinstance(self.value, bool) or not isinstance(self.value, int) or not ok(self.value):
            raise self.wrong(expected)
        return self.value

    def numbers(self, expected: str, ok: Callable[[float], bool] = lambda value: True, count: int = 0) -> list[float]:
        """A list of finite numbers that satisfy `ok`; exactly `count` of them unless that is 0."""
        items = self.items(expected)
        if count and len(items) != count:
            raise self.wrong(expected)
        return [item.number(expected, ok) for item in items]

    def text(self, expected: str) -> str:
        """A string that is not empty."""
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.wrong(expected)
        return self.value

    def choice(self, options: Iterable[str]) -> str:
        """One of `options`."""
        options = list(options)
        if not isinstance(self.value, str) or self.value not in options:
            close = difflib.get_close_matches(str(self.value)[:60], options, n=1)
            raise self.wrong(" or ".join(options), f"did you mean {close[0]!r}?" if close else "")
        return self.value

    def file(self, expected: str) -> Path:
        """A path, relative to the file that names it; the error names key and file when there is none."""
        path = self.source.parent / self.text(expected)
        if "\0" in str(path) or not path.is_file():
            raise self.error(f"`{self.path}`: no such file {str(path)!r}", source=self.source, expected=expected)
        return path

    def _child(self, value: Any, path: str) -> Key:
        return Key(value, path, self.source, self.error)


class _Loader(yaml.SafeLoader):
    """The safe loader with YAML 1.2's `1e-3`, without duplicate keys and with a bound on aliases."""

    aliases = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            self.aliases += 1
            if self.aliases > MAX_ALIASES:
                mark = self.peek_event().start_mark
                raise yaml.MarkedYAMLError(problem=f"more than {MAX_ALIASES} aliases", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:merge" and isinstance(key.value, str):
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"key {key.value!r} twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_yaml(path: Path, error: type[InputError] = ScenarioError) -> Key:
    """The top of a YAML file. Malformed text is an `error` naming file and line."""
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_YAML_BYTES + 1)
        if len(data) > MAX_YAML_BYTES:
            raise error(f"more than {MAX_YAML_BYTES} bytes", source=path, expected="a small YAML file")
        value = yaml.load(data.decode("utf-8-sig"), Loader=_Loader)  # a SafeLoader
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark or problem.context_mark
        line = f"line {mark.line + 1}: " if mark else ""
        raise error(f"{line}{problem.problem or problem.context}", source=path, expected="YAML") from problem
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError, OSError) as problem:
        raise error(f"cannot be read as YAML ({problem})", source=path, expected="YAML in UTF-8") from problem
    return Key(value, "", path, error)
