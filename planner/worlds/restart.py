"""A scenario file anew, with other starts: what `mrac-jax starts --scenario-out` writes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from planner.files import atomic_write
from planner.pace import Pace
from planner.worlds.keys import read_yaml
from planner.worlds.maps import YAML
from planner.worlds.scenario import SETTINGS
from planner.worlds.timed import KEYS as TIMED


def write_scenario(
    out: Path,
    source: Path,
    starts: NDArray[np.int64],
    chosen: Mapping[str, Any],
    pace: Pace,
    cell_size: float | None = None,
) -> None:
    """Write the scenario `source`, or one of the bare map `source`, to `out` with `starts` `[K, 2]`, whole or not.

    Files that it names are named from where `out` lies; comments are lost. chosen: settings by name,
    of which those that a scenario can name replace its own. pace: where the source says none. cell_size: of a bare map.
    Raises InputError.
    """
    top = read_yaml(source).value if source.suffix.lower() in YAML else None
    if isinstance(top, dict) and "map" in top:
        keys = _moved(top, source.parent, out.parent)
    else:
        keys = {"map": {"file": _moved(source.name, source.parent, out.parent)}}
        keys |= {} if cell_size is None else {"cell_size": cell_size}
    keys |= {name: value for name, value in chosen.items() if name in SETTINGS}
    if pace.seconds is not None and not keys.keys() & set(TIMED):
        keys["step"] = {"seconds": pace.seconds}
    keys["robots"] = {"starts": starts.tolist()}
    with atomic_write(out) as stream:
        yaml.safe_dump(keys, stream, sort_keys=False, default_flow_style=None, width=120)


def _moved(value: Any, before: Path, after: Path) -> Any:
    """A value with the names of files in it as they are seen from the folder `after` instead of `before`."""
    if isinstance(value, dict):
        return {name: _moved(item, before, after) for name, item in value.items()}
    if isinstance(value, list):
        return [_moved(item, before, after) for item in value]
    if isinstance(value, str) and value and not Path(value).is_absolute() and (before / value).is_file():
        return Path(os.path.relpath(before.resolve() / value, after.resolve())).as_posix()
    return value
