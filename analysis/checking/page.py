"""The page of `mrac-jax check INPUT --out`: which formulas hold on this map, by how much, against what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.checking.check_map import MapCheck
from analysis.checking.table import headline, print_check, shown
from analysis.evaluation.page_maps import chance_maps
from analysis.kit.words import counted
from analysis.page.document import KeyFigure, Section
from analysis.page.markup import Html
from analysis.page.parts import answer_page, input_name, map_settings, noted_tables
from analysis.page.strips import Mark, Truth, strip_html
from analysis.page.tables import printed
from analysis.theory.formulas import Direction
from analysis.theory.verdicts import Check, Verdict

FILES = ("check.json", "check.txt")
SAYS = {
    Direction.LOWER: "at least",
    Direction.UPPER: "at most",
    Direction.EQUAL: "exactly",
    Direction.EVERY_RUN: "in every run, chance",
}


def check_page(checked: MapCheck, command: str, pictures: Mapping[str, bytes], files: Sequence[str] = FILES) -> str:
    """The page as HTML; the same check gives the same bytes. Arguments as of `analysis.page.sweep_page.sweep_page`."""
    _, tables = printed(lambda console: print_check(checked, console))
    notes, exact = _notes(checked), checked.exact
    maps = chance_maps(checked.world, checked.plan, exact.visited_by_cell, exact.stops_by_cell, "open loop, exact")
    sections = (
        Section(
            "Formulas on one scale", _strips(checked), "Expected cells visited; worst robot where it is about one."
        ),
        Section("Every formula", noted_tables(tables, notes)),
        Section("Cell by cell", maps, "The open loop, exact: what the formulas speak about."),
    )
    return answer_page(
        f"{input_name(checked.world.source)}, {counted(len(checked.plan.robots), 'robot')}: which formulas hold?",
        headline(checked), sections, command, pictures, files, kind="check", findings=_findings(checked),
        settings=_settings(checked), figures=_key_figures(checked),
        warnings=_warnings(checked),
    )  # fmt: skip


def _key_figures(checked: MapCheck) -> tuple[KeyFigure, ...]:
    cells = int(checked.world.accessible(checked.plan.starts).sum())
    exact, closed, rows = checked.exact, checked.closed, checked.rows
    out = [KeyFigure(f"{100 * exact.visited / cells:.2f} %", "visited, open loop", "exact")]
    if closed is not None:
        seen = closed.visited
        how = f"{100 * seen.low / cells:.2f} .. {100 * seen.high / cells:.2f} %" if closed.rollouts else "exact"
        out.append(KeyFigure(f"{100 * seen.value / cells:.2f} %", "visited, closed loop", how))
    for verdict, words in ((Verdict.FAILS, "comparisons fail"), (Verdict.HOLDS, "hold")):
        number = sum(check.verdict is verdict for check in rows)
        out.append(KeyFigure(f"{number}", words, f"of {len(rows)}: each formula, meaning and loop"))
    return tuple(out)


def _warnings(checked: MapCheck) -> tuple[str, ...]:
    cut = ("Interrupted: the closed loop's figures are of the rollouts that were done.",) if checked.partial else ()
    if checked.faults:
        return (*cut, "A formula that is marked as proven fails: a fault of a proof or of this program.")
    return cut


def _findings(checked: MapCheck) -> list[str]:
    out = []
    for check in checked.rows:
        if check.verdict is Verdict.FAILS:
            unit = "" if check.about.unit == "chance" else f" {check.about.unit}"
            where = "nominal run" if check.loop == "nominal" else f"{check.loop} loop"
            of = f"{check.meaning}, {where}" if check.meaning else where
            title = f"{check.about.title[0].upper()}{check.about.title[1:]}"
            truth = shown(check.truth, 2 if unit else 4)
            said = f"{SAYS[check.about.direction]} {check.value:.4g}{unit}"
            out.append(f"{title} ({of}) fails: it says {said}, the truth is {truth}.")
    return [*out, *(f"{note[0].upper()}{note[1:]}." for note in checked.left_out)]


def _notes(checked: MapCheck) -> list[str]:
    lines, _ = printed(lambda console: print_check(checked, console))
    return [line for line in lines if line.startswith(("*", "The closed loop's intervals"))]


def _strips(checked: MapCheck) -> Html:
    cells = float(checked.world.accessible(checked.plan.starts).sum())
    order = list(Verdict)
    found: dict[tuple[str, float], list[Check]] = {}
    for check in checked.rows:
        if check.about.unit == "cells" and check.meaning == "visited" and check.robot is None:
            found.setdefault((check.formula, check.value), []).append(check)
    marks = [
        Mark(
            f"{checks[0].about.title}{'' if checks[0].about.paper else ' *'}",
            value,
            tuple(
                (f"{check.loop} loop", str(check.verdict))
                for check in sorted(checks, key=lambda check: order.index(check.verdict))
            ),
            checks[0].about.direction is Direction.UPPER,
        )
        for (_, value), checks in found.items()
    ]
    truths = [Truth("open loop, exact", checked.exact.visited, "open")]
    if checked.closed is not None:
        how = "sampled" if checked.closed.rollouts else "exact"
        truths.append(Truth(f"closed loop, {how}", checked.closed.visited.value, "closed"))
    return strip_html(marks, truths, cells, "* ours, proven. Values off the scale are written at its end.")


def _settings(checked: MapCheck) -> dict[str, object]:
    world, plan, closed = checked.world, checked.plan, checked.closed
    out: dict[str, object] = {
        **map_settings(world),
        "accessible cells": f"{int(world.accessible(plan.starts).sum()):,}",
        "robots": f"{len(plan.robots)}",
        "areas shared in the nominal run": f"{plan.shares}",
        "closed loop": "left out" if closed is None else closed.visited.how,
        "seed": f"{checked.seed}",
    }
    if closed is not None and closed.rollouts:
        out |= {"rollouts": f"{closed.rollouts:,}", "chance that one interval misses": f"{checked.doubt:.3g}"}
    if plan.settings is not None:
        out |= plan.settings.shown()
    return out
