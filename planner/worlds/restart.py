"""What is written as a scenario file: one anew with other starts (`starts --scenario-out`), and a team's settings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from planner.files import atomic_write
from planner.pace import Pace
from planner.settings import Settings
from planner.worlds.keys import read_yaml
from planner.worlds.maps import YAML
from planner.worlds.scenario import OF_ROBOTS, SETTINGS
from planner.worlds.timed import KEYS as TIMED

PLACED = ("count", "start", "starts", "starts_xy")
"""Keys of `robots` that say how many there are, and where."""


def said(team: dict[str, Any], settings: Settings, pace: Pace) -> dict[str, Any]:
    """The keys of a scenario that name these settings and this pace, and a `team`, keys of `robots`."""
    usual = Settings()
    given = {name: value for name, value in vars(settings).items() if value != getattr(usual, name)}
    keys = {name: given[name] for name in SETTINGS if name in given}
    keys |= {"wear": {"shape": settings.wear}} if "wear" in given else {}
    keys |= {"step": {"seconds": pace.seconds}} if pace else {}
    keys |= {"turn": pace.turn} if pace.turn else {}
    return {"robots": team | {name: given[name] for name in OF_ROBOTS if name in given}} | keys


def write_scenario(
    out: Path,
    source: Path,
    starts: NDArray[np.int64],
    settings: Settings,
    pace: Pace,
    cell_size: float | None = None,
) -> None:
    """Write the scenario `source`, or one of the bare map `source`, to `out` with `starts` `[K, 2]`, whole or not.

    Files that it names are named from where `out` lies; comments are lost. Of the `settings` those that a scenario can
    name are in it, and the pace. cell_size: of a bare map. Raises InputError.
    """
    top = read_yaml(source).value if source.suffix.lower() in YAML else None
    if isinstance(top, dict) and "map" in top:
        keys = _moved(top, source.parent, out.parent)
    else:
        keys = {"map": {"file": _moved(source.name, source.parent, out.parent)}}
        keys |= {} if cell_size is None else {"cell_size": cell_size}
    team = {name: key for name, key in keys.pop("robots", {}).items() if name not in (*PLACED, *OF_ROBOTS, "speed")}
    keys = {name: key for name, key in keys.items() if name not in (*SETTINGS, *TIMED)}
    keys |= said({"starts": starts.tolist()} | team, settings, pace)
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
