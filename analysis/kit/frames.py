"""Tables as pandas DataFrames (the extra `pandas`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from planner.errors import UsageError


def frame_of(table: Mapping[str, Any] | Iterable[Mapping[str, Any]]) -> Any:
    """Columns by name, or rows of JSON types: `coverage.mean` is a column, an interval two. Raises UsageError."""
    try:
        import pandas
    except ImportError as error:
        raise UsageError("pandas is not installed", fix="pip install pandas") from error
    return pandas.DataFrame(table if isinstance(table, Mapping) else [dict(_flat(row)) for row in table])


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _flat(one, f"{name}.{key}" if name else key)
    elif name.endswith("ci95") and value is not None:
        yield from zip((f"{name}.low", f"{name}.high"), value, strict=True)
    else:
        yield name, value
