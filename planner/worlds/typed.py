"""How a scenario says what types of robots and threats there are: a threat's `type`, `robots: {matrix: ...}`."""

from __future__ import annotations

from collections.abc import Mapping

from planner.arguments import Numbers, did_you_mean
from planner.worlds.keys import Key

FACTOR = Numbers(0, 1e6, "a factor of p")
TYPE = "type"
"""The key of a source of threats that says of which type it is."""
Matrix = Mapping[str, Mapping[str, float]]
"""Factor of p by type of robot and type of threat; what it does not name has 1."""


def read_matrix(robots: Key | None) -> dict[str, dict[str, float]]:
    """The factors under `robots: {matrix: ...}` of a scenario, by type of robot; none: there are no types."""
    if robots is None or not isinstance(robots.value, dict) or "matrix" not in robots.value:
        return {}
    top = Key(robots.value["matrix"], f"{robots.path}.matrix", robots.source)
    rows = top.mapping(optional=_names(top, "of robots"))
    return {
        name: {of: key.number(FACTOR) for of, key in row.mapping(optional=_names(row, "of threats")).items()}
        for name, row in rows.items()
    }


def _names(key: Key, what: str) -> list[str]:
    """The names that a mapping has for keys."""
    names = list(key.value) if isinstance(key.value, dict) else []
    if not names or not all(isinstance(name, str) and name for name in names):
        raise key.wrong(f"types {what} by name, as {{drone: {{mine: 0, radiation: 1}}, rover: {{radiation: 0.2}}}}")
    return names


def check_types(keys: list[Key], matrix: Matrix) -> list[str]:
    """The type of each source of threats, "" of none. Raises ScenarioError for one that the matrix does not know."""
    known = {name for row in matrix.values() for name in row}
    found = []
    for key in keys:
        given = key.value.get(TYPE, "") if isinstance(key.value, dict) else ""
        if given and given not in known:
            of = Key(given, f"{key.path}.{TYPE}", key.source)
            expected = " or ".join(sorted(known)) or "none without `robots: {matrix: ...}`"
            raise of.wrong(expected, did_you_mean(given, sorted(known)) or "name it in the matrix")
        found.append(given)
    return found
