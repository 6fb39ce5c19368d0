"""Results as data: their classes declare the keys of the JSON object, which also make the JSON Schema.

`json_keys` of a class is a text of keys, separated by white space:

- `coverage`: the attribute of this name. `goal.target`: an attribute of an attribute; the key is `target`.
- `accessible=cells`: another key than the attribute's name. `ideal.chance=ideal_chance`: a key of a nested object.
- `value?`: omitted where the value is None or empty. `*choices`: all keys of another object.

A path through None is None, and so is a nested object whose name has the value None. A class adds its keys to those of
its base classes. A dataclass without keys has its fields as keys; if some have a title (a row of a table), only those.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum, StrEnum
from fractions import Fraction
from functools import cache, cached_property, reduce
from inspect import getdoc
from math import isfinite
from pathlib import Path, PurePath
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

import numpy as np

from planner.files import Json


class Key(NamedTuple):
    """A key of a JSON object: its name, with dots in nested objects, the path to its value, and if it may be absent."""

    name: str
    path: str
    optional: bool

    @classmethod
    def of(cls, text: str) -> Key:
        """From its declaration in `json_keys`."""
        name, _, path = text.partition("=")
        if not path:
            path = name.removesuffix("?")
            name = name.rpartition(".")[2] if not name.startswith("*") else name
        return cls(name.removesuffix("?"), path.lstrip("*"), name.endswith("?"))


@cache
def keys_of(cls: type[Any]) -> tuple[Key, ...]:
    """The declared keys of a class, or the fields of a dataclass without keys."""
    declared = [text for base in reversed(cls.__mro__) for text in vars(base).get("json_keys", "").split()]
    if declared or not is_dataclass(cls):
        return tuple(map(Key.of, declared))
    titled = [Key(one.name, one.name, True) for one in fields(cls) if "title" in one.metadata]
    return tuple(titled or (Key(one.name, one.name, False) for one in fields(cls)))


def as_json(value: Any) -> Any:
    """A JSON value: `to_json()` if it exists, objects by their keys, arrays as lists, NaN and inf as None."""
    if isinstance(value, Mapping):
        return {f"{name:g}" if isinstance(name, float) else str(name): as_json(one) for name, one in value.items()}
    if isinstance(value, list | tuple) and not hasattr(value, "json_keys"):
        return [as_json(one) for one in value]
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    if hasattr(value, "to_json") and not hasattr(value, "json_keys"):
        return as_json(value.to_json())
    if keys := keys_of(value.__class__):
        return _object(value, keys)
    if isinstance(value, StrEnum | PurePath):
        return str(value)
    if isinstance(value, Fraction):
        return float(value)
    # JSON has neither NaN nor infinity.
    return None if isinstance(value, float) and not isfinite(value) else value


def _object(value: Any, keys: tuple[Key, ...]) -> Json:
    out: Json = {}
    for name, path, optional in keys:
        found = as_json(
            reduce(lambda held, step: None if held is None else getattr(held, step), path.split("."), value)
        )
        if name.startswith("*"):
            out |= found or {}
        elif not optional or found not in (None, {}, []):
            *groups, last = name.split(".")
            held: Any = out
            for group in groups:
                held = None if held is None else held.setdefault(group, {})
            if held is not None:
                held[last] = found
    return out


class WithKeys:
    """An object with the keys that its class declares in `json_keys`; a dataclass without them has its fields."""

    json_keys = ""

    def to_json(self) -> Json:
        """The JSON object of these keys."""
        said: Json = as_json(self)
        return said


# The JSON Schema of a class: types from annotations, descriptions from docstrings.

TYPES: dict[Any, str] = {int: "integer", float: "number", bool: "boolean", str: "string", NoneType: "null"}
TYPES |= {Path: "string", Fraction: "number"}


class Schema:
    """The definitions of a JSON Schema (draft 2020-12), by class name; `of` adds those that a type needs."""

    def __init__(self) -> None:
        self.definitions: dict[str, Json] = {}

    def of(self, hint: Any) -> Json:
        """The schema of an annotation; of a class with keys, a reference to its definition."""
        origin, inner = get_origin(hint), get_args(hint)
        if origin in (Union, UnionType):
            found = [self.of(one) for one in inner]
            return {} if {} in found else {"anyOf": found}
        if origin is Literal:
            return {"enum": list(inner)}
        if hint in TYPES:
            # JSON has no NaN: a number that is not known is null.
            return {"type": [TYPES[hint], "null"] if hint is float else TYPES[hint]}
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return {"type": "object", "additionalProperties": self.of(inner[1] if inner[1:] else int)}
        if origin in (list, tuple):
            return {"type": "array", "items": self.of(inner[0])}
        if origin is np.ndarray or hint is np.ndarray:
            return {"type": "array"}
        if isinstance(hint, type) and issubclass(hint, Enum):
            return {"enum": [one.value for one in hint]}
        if isinstance(hint, type) and (
            hasattr(hint, "json_keys") or (is_dataclass(hint) and not hasattr(hint, "to_json"))
        ):
            self.add(hint)
            return {"$ref": f"#/$defs/{name_of(hint)}"}
        return self.of(_hint(hint, "to_json")) if hasattr(hint, "to_json") else {}

    def add(self, cls: type) -> None:
        """Add the definition of a class with keys."""
        if name_of(cls) not in self.definitions:
            self.definitions[name_of(cls)] = {}  # before its parts, which may refer to it
            about = " ".join((getdoc(cls) or "").partition("\n\n")[0].split())
            self.definitions[name_of(cls)] = {"description": about, **self.keys(cls)}

    def keys(self, cls: type) -> Json:
        """The properties of a class, and those that are always present."""
        properties: Json = {}
        required: list[str] = []
        for name, path, optional in keys_of(cls):
            hint, about = self.attribute(cls, path)
            if name.startswith("*"):
                if get_origin(hint) is dict and (names := self.of(get_args(hint)[0]).get("enum")):
                    properties |= {str(name): self.of(get_args(hint)[1]) for name in names}
                    continue
                inner = self.keys(get_args(hint)[0] if isinstance(hint, UnionType) else hint)
                properties |= inner["properties"]
                required += inner["required"]
                continue
            group, _, last = name.rpartition(".")
            held = properties
            for one in filter(None, group.split(".")):
                held = held.setdefault(one, {"type": "object"}).setdefault("properties", {})
            held[last] = self.of(hint) | ({"description": about} if about else {})
            if not optional and not group:
                required.append(last)
        return {"type": "object", "properties": properties, "required": required}

    def attribute(self, cls: Any, path: str) -> tuple[Any, str]:
        """The type of an attribute, and its description; the path may lead through other classes."""
        missing, about = False, ""
        for name in path.split("."):
            if not isinstance(cls, type):
                return Any, ""
            hint, about = _hint(cls, name), description(cls, name)
            inner = (
                [one for one in get_args(hint) if one is not NoneType] if get_origin(hint) in (Union, UnionType) else []
            )
            missing |= bool(inner) and NoneType in get_args(hint)
            cls = inner[0] if len(inner) == 1 else hint
        return (cls | None if missing and cls is not Any else cls), about


def name_of(cls: type) -> str:
    """The name of a class's definition: "pareto.Point"."""
    return f"{cls.__module__.rpartition('.')[2]}.{cls.__name__}"


def _hint(cls: type, name: str) -> Any:
    """The annotation of an attribute or of a property's function; Any if it names a type that is not imported."""
    for base in cls.__mro__:
        held = vars(base).get(name)
        made = held.fget if isinstance(held, property) else getattr(held, "func", held if callable(held) else None)
        text = vars(base).get("__annotations__", {}).get(name) if made is None else made.__annotations__.get("return")
        if text is not None:
            try:
                return eval(text, vars(sys.modules[base.__module__])) if isinstance(text, str) else text
            except (NameError, TypeError):
                return Any
    return Any


def description(cls: type, name: str) -> str:
    """The description of an attribute: its property's docstring, or its part of the class's section Attributes."""
    for base in cls.__mro__:
        if isinstance(held := vars(base).get(name), property | cached_property):
            return " ".join((getdoc(held) or "").split())
        known = {**vars(base), **vars(base).get("__annotations__", {})}
        for names, text in _described(" ".join((getdoc(base) or "").split()), known):
            if name in names:
                return text
    return ""


def _described(text: str, known: Mapping[str, Any]) -> Iterator[tuple[list[str], str]]:
    """(names, description) of "a, b: description. c: description."."""
    name = "|".join(sorted(map(re.escape, known), key=len, reverse=True)) or "$"
    starts = list(re.finditer(rf"(?:^|[.;:] |`\. )((?:{name})(?:, (?:{name}))*): ", text))
    ends = [*(one.start() + 1 for one in starts[1:]), len(text)]
    for start, end in zip(starts, ends, strict=False):
        yield start[1].split(", "), text[start.end() : end].strip()
