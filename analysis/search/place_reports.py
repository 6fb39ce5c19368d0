"""Reports of `mrac-jax starts`, `clear` and `attack`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import yaml
from rich.table import Table

from analysis.page.elements import CellLayer
from analysis.report.model import CellMaps, KeyFigure, Report, Section
from analysis.report.result import search_report, share_figure, sourced, team_figure
from analysis.search.start_positions import Place, Starts
from analysis.search.threats import Attack, Clearing, Gain, Threat, ThreatCost, by_cell
from analysis.statistics.estimates import between, losses_sentence, of_all
from analysis.utils.tables import Column, in_percents, json_text, table_of, without_level
from planner.formatting import chance, counted, percent
from planner.world.scenario import team_keys

STARTS_SHOWN = 10
"""Places in the table; the JSON object holds all."""


def starts_report(starts: Starts) -> Report:
    """The best start positions, the map, the simulated places, and the plan from the best."""
    choices, maps = starts.choices, lambda: _starts_maps(starts)
    all_of_all = len(starts.candidates) * choices.rollouts
    # For teams of starts the number of alternatives is astronomically large, so no share is given.
    share = f", {percent(starts.rolled / all_of_all)} of simulating every one in full" if starts.depot else ""
    return search_report(
        starts, "starts", "where to start?", starts_summary(starts),
        f"{'one depot' if starts.depot else 'a start each'}, {counted(len(starts.candidates), 'candidate')}, "
        f"{counted(len(starts.simulated), 'place')} simulated",
        f"{counted(starts.rolled, 'rollout')}, {choices.rollouts:,} of the last two{share}; ",
        findings=list(starts_findings(starts)), figures=_starts_key_figures(starts), picture=maps,
        parts=[Section("Places", [_starts_table(starts)], _starts_footnotes(starts))], pictures={"starts.png": maps},
        files={"plan.json": lambda: json_text(starts.plan().to_json(), compact=True)},
    )  # fmt: skip


def starts_summary(starts: Starts) -> str:
    """The best starts, their coverage, and the gain over the present starts, by fresh rollouts."""
    robots, best, again = counted(len(starts.starts), "robot"), starts.places[starts.best], starts.confirmed
    if starts.partial:
        return f"Interrupted. Best found so far for {robots}: {best.at}."
    covered = ""
    if again is not None and again.counted is not None:
        covered = f"{percent(again.counted.mean)} {starts.covered} on average" + " (exact)" * starts.exact
    if starts.stay and not starts.depot:
        return f"Keep {present_starts(starts)}: no place found is significantly better; {covered}."
    what = f"Best {'depot' if starts.depot else 'starts'} found for {robots}: {best.at}, {covered}"
    if starts.gain is None:
        return f"{what}{', the present starts' * (starts.best == starts.here)}."
    if starts.stay:
        return f"{what}; not significantly better than {present_starts(starts)}: keep those unless a depot is needed."
    return f"{what}, {without_level(starts.gain.describe(100, ' points'))} more than from {present_starts(starts)}."


def present_starts(starts: Starts) -> str:
    """Name of the present starts."""
    named = starts.world.starts is not None and len(starts.world.starts) >= len(starts.starts)
    return "the starts of the input" if named else f"the default starts ({starts.world.team.start})"


def starts_findings(starts: Starts) -> Iterator[str]:
    """The figures with their intervals, the comparison with other places, and the command to evaluate."""
    again = starts.confirmed
    if again is not None and again.coverage is not None and again.losses is not None:
        valued = "" if again.value is None else f"{again.value.describe(100, ' %')} of the value and "
        cells = "" if again.value is None else " of the cells"
        covered = f"{valued}{again.coverage.describe(100, ' %')}{cells} covered"
        yield sourced(
            again.rollouts, without_level(f"{covered}, {losses_sentence(again.losses, len(starts.starts))} lost.")
        )
    best = starts.places[starts.best]
    if starts.gain is not None and starts.stay:
        low, high = (100 * end for end in starts.gain.ci95)
        mean = f"{100 * starts.gain.mean:+.2f} points ({'exact' if low == high else f'{between(low, high)}, 95 %'})"
        yield f"The best {'depot' if starts.depot else 'other place'} found, {best.at}, against it: {mean} of coverage."
    others = [place for place in starts.simulated if place is not best]
    if others:
        worst = min((p.counted.mean for p in others if p.counted), default=0.0)
        of_value = "" if starts.world.value is None else " of the value"
        how = "exact" if starts.exact else "simultaneous 95 %"
        yield (
            f"Significantly better than {starts.beaten} of {counted(len(others), 'other place')} simulated ({how}); "
            f"the worst covers {percent(worst)}{of_value}."
        )
    if starts.command:
        yield f"run it: {starts.command}"


def _starts_key_figures(starts: Starts) -> list[KeyFigure]:
    out, again = list[KeyFigure](), starts.confirmed
    if again is not None and again.counted is not None and again.losses is not None:
        name = f"{starts.choices.metric} on average" if again.value is None else "of the value visited"
        fresh = "" if starts.exact else ", fresh rollouts"
        out = [share_figure(again.counted, name, fresh), team_figure(again.losses, len(starts.starts))]
    if starts.gain is not None:
        low, high = (100 * end for end in starts.gain.ci95)
        note = f"{'exact' if low == high else between(low, high)}, against {present_starts(starts)}"
        out.append(KeyFigure(f"{100 * starts.gain.mean:+.2f} points", "best found", note))
    how = "" if starts.exact else ", simultaneous 95 %"
    others = f"of {counted(len(starts.simulated) - 1, 'other')} simulated{how}"
    return [*out, KeyFigure(f"{starts.beaten}", "significantly worse", others)]


def _starts_maps(starts: Starts) -> CellMaps:
    """The map of coverage by depot, for simulated depots, and of threat."""
    from matplotlib.colors import Normalize

    world = starts.world
    threat = np.nan_to_num(np.where(world.accessible(starts.starts), world.threat, 0.0).astype(np.float64))
    layers = [CellLayer("Threat", "Probability that one visit destroys the robot.", threat, "threat", "%", digits=2)]
    if starts.depot:
        covered, known = np.zeros(world.shape), [place for place in starts.simulated if place.counted is not None]
        for place in known:
            covered[tuple(place.starts[0])] = place.counted.mean if place.counted else 0.0
        # The scale starts at the least simulated coverage: 0 means "not simulated".
        low, high = covered[covered > 0].min(initial=1.0), covered.max()
        about = f"Share {starts.covered} on average if all robots start in the cell; 0 where it was not simulated."
        layers.insert(0, CellLayer("Coverage by depot", about, covered, "covered", "%", digits=2, short="Depots",
                                   norm=Normalize(low, high if high > low else low + 0.01), discs=True,
                                   labels=tuple(np.linspace(low, high, 4 if high > low else 1))))  # fmt: skip
    return CellMaps(world, starts.starts, layers)


def _starts_table(starts: Starts) -> Table:
    """The simulated places, best first."""
    valued, best = starts.world.value is not None, starts.places[starts.best]

    def behind(place: Place) -> str:
        low, high = (100 * end for end in place.behind or (0.0, 0.0))
        return "" if place.behind is None else f"{low:.2f}" if low == high else between(low, high, 1)

    columns = (
        Column("starts", lambda p: p.at.replace(", ", ","), words=True),
        Column("bound", lambda p: f"{p.screen:.1f}"),
        Column("one robot", lambda p: None if p.one_robot is None else f"{p.one_robot:.1f}"),
        in_percents("value, %", lambda p: p.value, shown=valued),
        in_percents(f"{starts.choices.metric}, %", lambda p: p.coverage),
        Column("lost", lambda p: p.losses and of_all(p.losses.mean, len(starts.starts))),
        Column("behind, points", behind),
        Column("rollouts", lambda p: f"{p.rollouts:,}" if p.rollouts else ""),
        Column("", lambda p: ", ".join(["best"] * (p is best) + ["now"] * p.now), words=True),
    )
    # The present starts are always shown, even below the cut of the table.
    shown = (*starts.simulated[:STARTS_SHOWN], *(place for place in starts.simulated[STARTS_SHOWN:] if place.now))
    return table_of(columns, shown, "Simulated on common random numbers, the best first",
                    ("one robot", "bound", "rollouts", "lost"), padding=(0, 1, 0, 0))  # fmt: skip


def _starts_footnotes(starts: Starts) -> list[str]:
    counts = "cells" if starts.world.value is None else "value"
    more = len(starts.simulated) - STARTS_SHOWN
    return [
        f"bound: {counts} visited at most on average, for any policy; one robot: eq. (4), "
        f"{counts} of one robot's plan."
        + " ±: half the 95 % interval, in brackets its ends; behind: simultaneous 95 % intervals; "
        "places that were eliminated early have few rollouts." * (not starts.exact),
        *([f"The JSON object has {counted(more, 'further place')}."] if more > 0 else []),
    ]


# The report of `threats --remove`: the threats to remove, the gain, all threats on the map and in figures.

KINDS = {"areas": "connected areas of equal threat", "sources": "polygons, points and sites of the scenario"}
KINDS_OF_GAIN = {"cells": "Cells", "of value": "Value"}
CLEAR_SHOWN = 12
"""Threats in the table; the JSON object holds all."""


def clear_report(clearing: Clearing) -> Report:
    """The threat to remove first, the map of gains, and every threat."""
    return search_report(
        clearing, "clear", "which threat to remove first?", removal_summary(clearing),
        f"{counted(len(clearing.options), 'threat')} ({KINDS[clearing.remove]})", _last_two(clearing),
        findings=list(clear_findings(clearing)), figures=_clear_key_figures(clearing),
        picture=lambda: _clear_maps(clearing),
        parts=[Section("Threats", [_clear_table(clearing)], _clear_footnotes(clearing))],
        pictures={"clear.png": lambda: _clear_maps(clearing, 0)}
        | ({} if clearing.world.uncertainty else {"risk_paid.png": lambda: _clear_maps(clearing, 2)}),
    )  # fmt: skip


def _last_two(search: Clearing | Attack) -> str:
    return f"{counted(search.choices.rollouts, 'rollout')} of the last two, the same ids for all; "


def removal_summary(clearing: Clearing) -> str:
    """The threat to remove first, and the gain on fresh rollouts."""
    picks, gain = clearing.picks, clearing.gain
    first = f"Best threat found to remove first: {place_words(picks[0])}"
    if gain is None:
        return f"Interrupted. {first}: {_more(clearing, clearing.turns[0].picked.known)}, on the search's rollouts."
    if len(picks) > 1:
        first = f"Best threats found to remove, in this order: {', '.join(threat.name for threat in picks)}"
    return f"{first}: {_more(clearing, gain)} on average, after replanning."


def place_words(threat: Threat) -> str:
    """A threat's name, size, probability and position."""
    row, col = threat.at
    most = "" if threat.thing is None else "at most "
    at = f"{'' if len(threat.cells) == 1 else 'from '}row {row}, column {col}"
    return f"{threat.name} ({counted(len(threat.cells), 'cell')}, {most}p = {chance(threat.p)}, {at})"


def _said(search: Clearing | Attack, gain: Gain) -> str:
    return gain.counted.describe(unit=f" {search.unit}")


def _more(clearing: Clearing, gain: Gain | None) -> str:
    return "" if gain is None else gain.counted.more(unit=f" {clearing.unit}")


def clear_findings(clearing: Clearing) -> Iterator[str]:
    """The gain with its interval, the comparison with other threats, gains with the old plan, and further removals."""
    first, gain = clearing.turns[0], clearing.gain
    if gain is not None:
        yield sourced(gain.rollouts, f"after replanning, {gain.describe('more')}.")
    yield first.certainty("better to remove")
    unknown = first.best_unknown
    most, own = (_said(clearing, one.unknown) for one in (unknown, first.picked))
    then = "" if unknown is first.picked else f"; {first.picked.threat.name}: {own}"
    yield f"With the old plan, removing {unknown.threat.name} gains most: {most}{then}."
    for turn in clearing.turns[1:]:
        gained = _more(clearing, turn.picked.known)
        yield f"Then {place_words(turn.picked.threat)}: {gained} in addition."


def _clear_key_figures(clearing: Clearing) -> list[KeyFigure]:
    gain, first, unit, out = clearing.gain, clearing.turns[0], clearing.unit, list[KeyFigure]()
    if gain is not None:
        mean, interval = gain.counted.columns()
        fresh = ", fresh rollouts" if gain.rollouts else ""
        out.append(KeyFigure(f"{mean} {unit}", "gained after replanning", f"{interval}{fresh}"))
    unknown = first.best_unknown
    return [
        *out,
        KeyFigure(f"{unknown.unknown.counted.mean:.1f} {unit}", "largest gain, old plan", unknown.threat.name),
        KeyFigure(f"{len(clearing.options)}", "threats", f"{len(first.simulated)} replanned"),
    ]


def _clear_maps(clearing: Clearing, only: int | None = None) -> CellMaps:
    """Maps of the gains after replanning and with the old plan, and of marginal risk by cell; `only`: one of them."""
    options, shape = clearing.options, clearing.world.shape
    known, unknown = by_cell(options, shape, lambda one: one.known), by_cell(options, shape, lambda one: one.unknown)
    won = f"{KINDS_OF_GAIN[clearing.unit]} gained"
    paid = "Cells lost for each percent of threat added to a cell: open loop, same paths. Not the gain of removing it."
    risk = clearing.world.uncertainty is None  # the gradient is not that of latent hazards
    layers = [
        CellLayer(f"{won}, replanned", "Gain of removing the threat in the cell; the team replans.", known, "covered",
                  short="Replanned"),
        CellLayer(f"{won}, old plan", "Gain of removing the threat; the team keeps its plan.", unknown, "covered",
                  short="Old plan"),
        *([CellLayer("Marginal risk", paid, np.maximum(clearing.risk_paid, 0.0), "losses", root=True, blocks="sum",
                     short="Risk")] if risk else []),
    ]  # fmt: skip
    ranked = [one.threat for one in _ranked(clearing)] if only == 0 else []
    parts = [(threat.name, threat.cells, threat in clearing.picks) for threat in ranked]
    return CellMaps(clearing.world, clearing.starts, layers if only is None else layers[only : only + 1], parts)


def _clear_table(clearing: Clearing) -> Table:
    """Every threat as the first to be removed, best first."""
    columns = (
        Column("threat", lambda one: one.threat.name, words=True),
        Column("at", lambda one: "{},{}".format(*one.threat.at), words=True,
               shown=clearing.remove == "areas"),
        Column("cells", lambda one: len(one.threat.cells)),
        Column("p, %", lambda one: chance(one.threat.p, unit="")),
        Column("lost in it", lambda one: f"{one.hits:.3f}"),
        *_gain_columns("replanned", "old plan"),
    )  # fmt: skip
    title = f"{KINDS_OF_GAIN[clearing.unit]} gained on average by removing one threat"
    dropped = ("rollouts", "bound", "lost in it", *["at"] * (clearing.remove == "areas"), "from .. to")
    return table_of(columns, _ranked(clearing)[:CLEAR_SHOWN], title, dropped, padding=(0, 1, 0, 0))


def _gain_columns(known: str, unknown: str) -> tuple[Column, ...]:
    """The columns of the bound, of the gains if the team replans and if it keeps its plan, and of rollouts."""
    return (
        Column("bound", lambda one: None if one.screen is None else f"{one.screen:.2f}"),
        Column(known, lambda one: one.known and one.known.counted, "from .. to"),
        Column(unknown, lambda one: one.unknown.counted, "from .. to"),
        Column("rollouts", lambda one: f"{one.known.rollouts:,}" if one.known and one.known.rollouts else ""),
    )


def _ranked(clearing: Clearing) -> list[ThreatCost]:
    rest = [one for one in clearing.options if one.known is None]
    return [*clearing.turns[0].simulated, *sorted(rest, key=lambda one: -(one.screen or 0.0))]


def _clear_footnotes(clearing: Clearing) -> list[str]:
    lines = [
        "replanned: plan for the map without the threat. old plan: the present plan on that map. "
        "from .. to: pointwise 95 % intervals.",
        "bound: rise of the policy-independent upper bound. lost in it: robots lost there per rollout.",
    ]
    if len(clearing.options) > CLEAR_SHOWN:
        lines.append(f"The JSON object has {counted(len(clearing.options) - CLEAR_SHOWN, 'further threat')}.")
    if clearing.remove == "sources":
        lines.append("p: the largest of this threat alone; threats that overlap it remain.")
    return lines


# The report of `threats --add`: the worst cells, the cost with and without knowledge of them, every cell on the map.

ATTACK_SHOWN = 12
"""Cells in the table; the JSON object holds all."""
KNOWN, HIDDEN = "informed robots", "uninformed robots"


def attack_report(attack: Attack) -> Report:
    """The worst positions, with maps of the cost of a threat in each cell."""
    threats = f"{counted(len(attack.known.threats), 'threat')} of {chance(attack.p)}"
    hidden = len(attack.hidden.threats) > 0  # none: it was interrupted before
    return search_report(
        attack, "attack", "where would a threat cost most?", placement_summary(attack),
        f"{threats}, {counted(len(attack.turn.options), 'cell')} searched", _last_two(attack),
        findings=list(attack_findings(attack)), figures=_attack_key_figures(attack),
        picture=lambda: _attack_maps(attack),
        parts=[Section("Cells", [_attack_table(attack)], _attack_footnotes(attack))],
        pictures={"attack.png": lambda: _attack_maps(attack, 0)}
        | ({"hidden.png": lambda: _attack_maps(attack, 1)} if hidden else {}),
        files={"known.npz": attack.known_world.to_bytes}
        | ({"hidden.npz": attack.hidden_world.to_bytes} if hidden else {})
        | ({} if attack.settings.own_words else {"known.yaml": lambda: _scenario(attack)}),
    )  # fmt: skip


def _scenario(attack: Attack) -> bytes:
    """The scenario of the map with the known threats and the team."""
    team = team_keys({"starts": attack.starts.tolist()}, attack.settings, attack.world.pace)
    return yaml.safe_dump({"map": {"file": "known.npz"}} | team, sort_keys=False).encode()


def placement_summary(attack: Attack) -> str:
    """The worst positions in both cases, and their cost on fresh rollouts."""
    known, hidden = attack.known, attack.hidden
    if known.known is None or hidden.hidden is None:
        return f"Interrupted. Worst found so far for {KNOWN}: {_at(known.threats)}."
    return (
        f"Worst found for {KNOWN}: {_at(known.threats)}, {_fewer(attack, known.known)} on average; "
        f"for {HIDDEN}: {_at(hidden.threats)}, {_fewer(attack, hidden.hidden)}."
    )


def _at(threats: tuple[Threat, ...]) -> str:
    return ", ".join(threat.name.removeprefix("cell ") for threat in threats)


def _fewer(attack: Attack, gain: Gain) -> str:
    return gain.counted.more(unit=f" {attack.unit}", words=("fewer", "more"))


def attack_findings(attack: Attack) -> Iterator[str]:
    """Cost in cells and robots, each placement in the other case, and the comparison with other cells."""
    for placed, own, kind in ((attack.known, attack.known.known, KNOWN), (attack.hidden, attack.hidden.hidden, HIDDEN)):
        if own is not None:
            yield sourced(own.rollouts, f"{_at(placed.threats)} against {kind}: {own.describe('fewer')}.")
    known, hidden = attack.known.hidden, attack.hidden.known
    if known is not None and hidden is not None:
        yield (
            f"Exchanged: {_at(attack.known.threats)} would cost {HIDDEN} {_said(attack, known)}, "
            f"and {_at(attack.hidden.threats)} {KNOWN} {_said(attack, hidden)}."
        )
    yield f"A single threat costs {KNOWN} most in {attack.turn.picked.threat.name}. {attack.turn.certainty('worse')}"


def _attack_key_figures(attack: Attack) -> list[KeyFigure]:
    return [
        KeyFigure(f"{gain.counted.columns()[0]} {attack.unit}", f"lost by {kind}", gain.counted.columns()[1])
        for gain, kind in ((attack.known.known, KNOWN), (attack.hidden.hidden, HIDDEN))
        if gain is not None
    ]


def _attack_maps(attack: Attack, only: int | None = None) -> CellMaps:
    """Maps of the cost of one threat in each cell, in both cases; `only`: one map, the worst positions outlined."""
    options, shape = attack.turn.options, attack.world.shape
    lost = "Value lost" if attack.world.value is not None else "Cells lost"
    known = np.maximum(by_cell(options, shape, lambda one: one.known), 0.0)
    hidden = np.maximum(by_cell(options, shape, lambda one: one.unknown), 0.0)
    layers = [
        CellLayer(f"{lost}, {KNOWN}", f"By one threat of {chance(attack.p)} in the cell; the team replans.", known,
                  "losses", short="Known"),
        CellLayer(f"{lost}, {HIDDEN}", "By the same threat; the team keeps its plan.", hidden, "losses",
                  short="Hidden"),
    ]  # fmt: skip
    placed = (attack.known, attack.hidden)[only or 0].threats
    parts = [] if only is None else [(threat.name.removeprefix("cell "), threat.cells, True) for threat in placed]
    return CellMaps(attack.world, attack.starts, layers if only is None else layers[only : only + 1], parts)


def _attack_table(attack: Attack) -> Table:
    """The worst cells for one threat."""
    threat = attack.world.threat.reshape(-1)
    columns = (
        Column("cell", lambda one: one.threat.name.removeprefix("cell "), words=True),
        Column("p there, %", lambda one: chance(float(threat[one.threat.cells[0]]), unit="")),
        *_gain_columns("known", "hidden"),
    )
    shown = [one for one in attack.turn.simulated[:ATTACK_SHOWN] if one.known is not None]
    title = f"{'Cells' if attack.world.value is None else 'Value'} lost on average by one threat"
    return table_of(columns, shown, title, ("rollouts", "bound", "from .. to"))


def _attack_footnotes(attack: Attack) -> list[str]:
    return [
        "known: plan for the map with the threat. hidden: the present plan on that map. "
        "from .. to: pointwise 95 % intervals.",
        *(["bound: fall of the policy-independent upper bound."] if attack.turn.picked.screen is not None else []),
    ]
