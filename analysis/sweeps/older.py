"""Runs of a store that follow rules which a later release changed (`planner.rules`): told apart, and never mixed.

Runs by the rules of release 0.4, where an earlier release had others, have the label RULES. A sweep gives this label to
the earlier runs that it leaves alone, and so it is with other runs of the same setting, which differ in the map alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from analysis.sweeps.cases import RULES, Label, canonical
from analysis.sweeps.store.store import Run, Store
from planner.rules import BEFORE, NOW, RELEASES
from planner.shown import counted

MAP_LABELS = ("map", "rollout_seed")
"""Labels that tell the maps of a setting apart; all others tell settings apart."""
EARLIER, LATEST = RELEASES[BEFORE], RELEASES[NOW]
DETECTOR = re.compile(r"~[0-9a-f]+\[.+\]")
"""In the identity of a world whose robots have a detector."""
CHANGES = "?"
"""In the identity of a world whose threats change, move, or are in doubt."""


def setting_of(what: Mapping[str, Label]) -> str:
    """What all maps of a run's setting share."""
    return canonical({name: value for name, value in what.items() if name not in (*MAP_LABELS, RULES)})


class Older:
    """What is known of a store's runs by earlier rules. `settings`: those of which it has runs by the latest rules."""

    def __init__(self, store: Store) -> None:
        self.settings = {setting_of(what) for what in store.labels() if what.get(RULES) == LATEST}

    def labelled(self, run: Run) -> Run:
        """The run with the label EARLIER, if that is what it is."""
        if RULES in run.what or setting_of(run.what) not in self.settings:
            return run
        return replace(run, what=run.what | {RULES: EARLIER})


def is_older(run: Run, store: Store, homes: dict[str, bool]) -> bool | None:
    """Whether a run without the label RULES follows rules that release 0.4 changed; None: it may.

    `homes`: by setting whether robots come home, of settings that were asked about: a block is read for the first.
    """
    what, world = run.what, str(run.facts["world"])
    if what.get("loop") == "closed":
        if DETECTOR.search(world) or what.get("return_to") is not None:
            return True
        setting = setting_of(what)
        if setting not in homes:
            tally = store.tally(run.key)
            homes[setting] = tally is not None and len(tally.home) > 0
        if homes[setting]:
            return True
    told = what.get("plan_on")
    if what.get("phases") is not None:
        return told in (None, "now")
    if what.get("movers") is not None:
        return told is None
    in_doubt = any(what.get(name) is not None for name in ("hazard", "uncertain"))
    return None if CHANGES in world and not in_doubt else False


def older_note(sure: int, unsure: int) -> list[str]:
    """What is to be said of so many runs that follow, and that may follow, rules which release 0.4 changed."""
    if not sure + unsure:
        return []
    follow = "follows" if sure == 1 else "follow"
    parts = [f"{counted(sure, 'run')} {follow} rules that release 0.4 changed"] if sure else []
    parts += [f"{counted(unsure, 'run')} may, if threats change with time or `plan_on` is left out"] if unsure else []
    changed = "phases, detectors, return home, moving threats"
    return [f"{', and '.join(parts)} ({changed}): run the sweep again to renew them"]
