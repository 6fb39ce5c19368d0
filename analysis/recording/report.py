"""What `record`, `replay`, `inspect` and `recover` say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path

from rich.table import Table

from analysis.kit.tables import make_table
from analysis.recording.inspect import Inspection
from analysis.recording.record import Recorded
from analysis.recording.recover import Recovered
from analysis.recording.replay import ENDS_EARLY, Replayed
from analysis.report.blocks import Part, Report
from planner.arguments import argument
from planner.files import Json
from planner.shown import counted, in_percent
from planner.trace import EventKind

MOST_LINES = 40
"""Events shown of a rollout: losses, reallocations and shares first."""
FIRST = {kind.name.lower() for kind in (EventKind.HIT, EventKind.REALLOCATED, EventKind.SHARED)}


# --- record ---


def report(done: Recorded) -> Report:
    """The file, and what its rollouts came to."""
    kept = f"{done.bytes / 1e6:.2f} MB, {counted(done.steps, 'step')} in full"
    return Report(
        "record", "record", str(done.path), f"{done.path}: {kept}", lambda: _recorded_json(done),
        heading=[f"{counted(done.tally.rollouts, 'rollout')} evaluated"],
        parts=[Part("Rollouts in full", [_rollouts_table(done)])], pace=done.pace,
    )  # fmt: skip


def _rollouts_table(done: Recorded) -> Table:
    cells, pace = done.tally.accessible, done.pace
    of, figures = ("rollout", "picked as", "ends", "step"), ("visited, %", "survived, %", "alive", "events")
    columns = (*of, *["minutes"] * bool(pace), *figures)
    table = make_table(columns, left=("picked as", "ends"), dropped=("events", "survived, %"))
    for row in done.rows:
        ends = "all lost" if row.outcome == "stopped" else row.outcome.replace("_", " ")
        shares = (in_percent(Fraction(count, cells)) for count in (row.visited, row.survived))
        times = (str(row.time), *[f"{pace.minutes * row.time:,.1f}"] * bool(pace))
        table.add_row(str(row.rollout), ", ".join(row.picks), ends, *times, *shares, str(row.alive), str(row.events))
    return table


def _recorded_json(done: Recorded) -> Json:
    """Of an interrupted recording, the rollouts that were done."""
    cells = done.tally.accessible
    rows = [
        asdict(row) | {"visited": row.visited / cells, "survived": row.survived / cells, "cells_visited": row.visited}
        for row in done.rows
    ]
    return {
        **({"partial": True} if done.partial else {}),
        "file": str(done.path),
        "bytes": done.bytes,
        "steps": done.steps,
        "rollouts": rows,
        "settings": done.settings.to_json(),
        "accessible": cells,
        "evaluate_seconds": done.evaluate_seconds,
        "record_seconds": done.record_seconds,
    }


def interrupted_lines(done: Recorded, asked: Path) -> list[str]:
    """What is said of an interrupted recording that should have gone to `asked`; nothing of a whole one."""
    if not done.partial:
        return []
    stays = "" if done.path == asked else f"; {asked} was there before and stays"
    count = f"{len(done.rows):,} of {counted(len(done.settings.ids), 'rollout')}"
    return [f"interrupted: {done.path} holds {count}{stays}"]


# --- replay ---


def replayed(found: Replayed) -> Report:
    """Whether everything is the same, as far as it was compared; JSON's `partial`: the file is not whole."""
    changed = {"path": str(found.path), "settings": found.settings.to_json(), "partial": bool(found.partial)}
    findings = []
    if not found.drawn:
        verdict = "rollouts identical, drawings not compared" if found.identical else "drawings not compared"
        findings = [f"made by another version (mrac-jax {found.settings.mrac_jax}): {verdict}"]
    return Report(
        "replay", "replay", str(found.path), f"{found.path}: {_verdict(found)}",
        lambda: asdict(found) | changed | {"identical": found.identical}, findings,
        took=[f"run again in {found.seconds:.1f} s, {found.engine}"],
    )  # fmt: skip


def _verdict(found: Replayed) -> str:
    messages = counted(found.messages, "message")
    if not found.identical:
        verb = "is" if found.messages == 1 else "are"
        return f"NOT identical: {found.difference} ({messages} before it {verb} the same)"
    rest = "" if found.everything else "; tally and outcomes were not run again: --all"
    if found.partial:
        how = f"the file {found.partial}" if found.partial == ENDS_EARLY else f"the file is {found.partial}"
        rollouts = f"{found.rollouts:,} of {counted(found.asked, 'rollout')}"
        return f"identical as far as it goes: {rollouts}; {how} ({messages}){rest}"
    what = "every message, drawn ones byte for byte" if found.drawn else "every event and step"
    return f"identical: {what}, of {counted(found.rollouts, 'rollout')} ({messages}){rest}"


# --- inspect ---


def inspected(found: Inspection, most_events: int | None) -> Report:
    """Contents, then each rollout with at most so many events of its timeline (None: all)."""
    kept = f"{found.bytes / 1e6:.2f} MB, {found.seconds:g} s, written by {found.library}"
    cut = [f"not the whole log: {found.partial}"] if found.partial else []
    parts = [Part(f"Rollout {one['rollout']}", notes=["", *_timeline(one, most_events)]) for one in found.rollouts]
    return Report(
        "inspect", "inspect", str(found.path), f"{found.path}: {kept}", lambda: _inspection_json(found),
        cut, heading=[_settings_line(found)], parts=[_topics(found), *parts],
    )  # fmt: skip


def _inspection_json(found: Inspection) -> Json:
    settings = None if found.settings is None else found.settings.to_json()
    return asdict(found) | {"path": str(found.path), "settings": settings}


def _settings_line(found: Inspection) -> str:
    settings, shape = found.settings, found.shape
    if settings is None or shape is None:
        return "no recording of mrac-jax: no settings and no world in it"
    some = f"{counted(settings.evaluated, 'rollout')} evaluated"
    evaluated = some if settings.evaluated else "these rollouts alone evaluated"
    kept = ", their outcomes kept" if settings.outcomes else ""
    checks = "" if settings.threat_checks == "every_visit" else ", threats at first visits alone"
    return (
        f"{settings.loop} loop{checks} on {shape[0]} x {shape[1]} cells, seed {settings.seed}, {evaluated}{kept}, "
        f"{settings.step_seconds:g} s a step, mrac-jax {settings.mrac_jax}"
    )


def _topics(found: Inspection) -> Part:
    table, later = make_table(("topic", "schema", "messages"), left=("topic", "schema")), 0
    for topic, kind in found.topics.items():
        parts = topic.split("/")
        if len(parts) == 4 and parts[1] == "robots" and parts[2] != "0":
            later += 1
        else:
            table.add_row(topic, kind["schema"], f"{kind['messages']:,}")
    others = [f"and {counted(later, 'topic')} like those of robot 0 for the other robots"] if later else []
    attached = ", ".join(f"{name} ({counted(size, 'byte')})" for name, size in found.attachments.items())
    return Part("Topics", [table], [*others, f"attachments: {attached}"])


def _timeline(rollout: Json, most: int | None) -> Iterator[str]:
    yield f"{rollout['text']} (from {rollout['begins_seconds']:g} s of the file)"
    events = [*enumerate(rollout["events"])]
    shown = sorted(events, key=lambda item: (item[1]["kind"] not in FIRST, item[0]))[:most]
    step = None
    for _, event in sorted(shown, key=lambda item: item[0]):
        yield f"  {'' if event['step'] == step else 'step ' + str(event['step']):>12}  {event['text']}"
        step = event["step"]
    if shown and len(shown) < len(events):
        yield f"  {'':>12}  and {counted(len(events) - len(shown), 'event')} more: {argument('events', 'all')}"


# --- recover ---


def recovered(found: Recovered) -> Report:
    """What was saved and what is lost; names from the file are quoted."""
    saved = f"{counted(found.messages, 'message')} in {counted(found.chunks, 'chunk')}"
    others = counted(len(found.attachments), "attachment"), counted(len(found.metadata), "metadata record")
    findings = [f"lost {lost}" for lost in found.lost]
    if found.lost_messages:
        findings.append(f"lost {counted(found.lost_messages, 'message')} in all")
    if found.complete:
        findings.append("nothing is lost")
    said = {"source": str(found.source), "out": str(found.out), "losses": len(found.lost), "complete": found.complete}
    return Report(
        "recover", "recover", str(found.source), f"saved {saved}, {', '.join(others)}",
        lambda: asdict(found) | said, findings, heading=[f"written to {found.out}"],
    )  # fmt: skip
