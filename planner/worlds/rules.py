"""From measured values to p: the `rule` of a threat's raster, and of its samples."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from planner.arguments import ANY, POSITIVE
from planner.worlds.keys import Key
from planner.worlds.quantities import PROBABILITY, first_of

RULES = ("linear", "exposure", "classes")
"""`scale * value`, `1 - exp(-rate * value)`, or p by class."""


def check_p(p: NDArray[np.float64], values: NDArray[np.float64], key: Key, fix: str) -> None:
    """An error that names `key`, the first p `[H, W]` that is no probability, and the value that it comes from."""
    with np.errstate(over="ignore", under="ignore"):
        wrong = ~((p >= 0) & (p.astype(np.float32) < 1))
    if wrong.any():
        at, where = first_of(wrong)
        raise key.fault(f"gives p = {p[at]:g} for the value {values[at]:g} {where}", PROBABILITY.expected, fix)


def has_classes(rule: Key | None) -> bool:
    """Whether values are classes, which are never averaged."""
    return rule is not None and isinstance(rule.value, dict) and rule.value.get("kind") == "classes"


def by_rule(key: Key | None, values: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """p of the values, and what to change where it is no probability."""
    if key is None:
        return values, "give a rule: {kind: linear, scale: ...}"
    kind = key.mapping(("kind",), optional=("scale", "rate", "edges", "p"))["kind"].choice(RULES)
    if kind == "linear":
        keys = key.mapping(("kind", "scale"))
        return values * keys["scale"].number(POSITIVE), "lower scale"
    if kind == "exposure":
        keys = key.mapping(("kind", "rate"))
        return -np.expm1(-keys["rate"].number(POSITIVE) * values), "lower rate; values must not be negative"
    keys = key.mapping(("kind", "edges", "p"))
    edges = keys["edges"].numbers(ANY, "a list of numbers")
    if any(low >= high for low, high in itertools.pairwise(edges)):
        raise keys["edges"].wrong("rising numbers")
    expected = f"{len(edges) + 1} probabilities 0 <= p < 1 for {len(edges)} edges: below the first, ..., above the last"
    p = keys["p"].numbers(PROBABILITY, expected, len(edges) + 1)
    return np.array(p)[np.searchsorted(edges, values, side="right")], "change p"
