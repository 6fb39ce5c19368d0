"""What `replay` found, in words and as JSON."""

from __future__ import annotations

from dataclasses import asdict

from analysis.recording.replay import ENDS_EARLY, Replayed
from planner.files import Json
from planner.shown import counted


def replayed_json(found: Replayed) -> Json:
    """The JSON object of `replay --json`; `partial` is true for a file that is not whole."""
    changed = {"path": str(found.path), "settings": found.settings.to_json(), "partial": bool(found.partial)}
    return asdict(found) | changed | {"identical": found.identical}


def replayed_lines(found: Replayed) -> list[str]:
    """The same in words."""
    messages = counted(found.messages, "message")
    if not found.identical:
        verb = "is" if found.messages == 1 else "are"
        before = f"{messages} before it {verb} the same"
        text = f"NOT identical: {found.difference} ({before})"
    elif found.partial:
        how = f"the file {found.partial}" if found.partial == ENDS_EARLY else f"the file is {found.partial}"
        rollouts = f"{found.rollouts:,} of {counted(found.asked, 'rollout')}"
        text = f"identical as far as it goes: {rollouts}; {how} ({messages})"
    else:
        what = "every message, drawn ones byte for byte" if found.drawn else "every event and step"
        text = f"identical: {what}, of {counted(found.rollouts, 'rollout')} ({messages})"
    if found.identical and not found.everything:
        text += "; tally and outcomes were not run again: --all"
    lines = [f"{found.path}: {text}"]
    if not found.drawn:
        verdict = "rollouts identical, drawings not compared" if found.identical else "drawings not compared"
        lines.append(f"made by another version (mrac-jax {found.settings.mrac_jax}): {verdict}")
    return lines
