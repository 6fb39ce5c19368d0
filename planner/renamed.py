"""Names of release 0.3 that are still read in 0.4, each with one warning that gives the new name."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from typing import Any

RENAMED = {
    "worth": "robot_value", "reserve": "risk_cap", "worths": "robot_values", "reserves": "risk_caps",
    "wear": "weibull_shape", "susceptibility": "hazard_multiplier", "sense": "sensor_range", "prior": "prior_map",
    "truth": "true_map", "movers": "moving_threats", "hazard": "latent_hazard", "uncertain": "map_uncertainty",
}  # fmt: skip
"""Settings, arguments, options (`--robot-value`) and keys of files: old to new."""
LOOPS = {"closed": "closed_loop", "open": "open_loop"}
"""Values of `plan_for`: old to new."""
_OLD = {new: old for old, new in RENAMED.items()}


class RenamedWarning(FutureWarning):
    """A name of release 0.3 was used; release 0.5 does not read it."""


def warn_renamed(old: str, new: str, source: object = "") -> None:
    """Say once that `old` is now `new`; `source`: the file that has the old name."""
    where = f"{source}: " if str(source) else ""
    warnings.warn(f"{where}{old} is now {new}; release 0.5 no longer reads {old}", RenamedWarning, stacklevel=3)


def with_new_names(given: Mapping[Any, Any], allowed: Collection[str], source: object = "") -> dict[Any, Any]:
    """The same values under today's names, where `allowed` has the new name and not the old one."""
    found = dict(given)
    for old in [name for name in found if isinstance(name, str) and name in RENAMED and name not in allowed]:
        if (new := RENAMED[old]) in allowed and new not in found:
            warn_renamed(f"`{old}`", f"`{new}`", source)
            found = {new if name == old else name: value for name, value in found.items()}
    return found


def names_of_0_3(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings under the names of 0.3. Identities hash these names, so that stores and plans of 0.3 keep theirs."""
    values = {new: old for old, new in LOOPS.items()}
    found = {_OLD.get(name, name): value for name, value in settings.items()}
    return found | ({"plan_for": values[found["plan_for"]]} if found.get("plan_for") in values else {})
