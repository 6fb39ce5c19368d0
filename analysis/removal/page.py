"""The page of `mrac-jax clear --out`: what each threat costs, on the map and in figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.kit.words import counted
from analysis.page.cell_maps import CellLayer, cell_maps_html
from analysis.page.document import KeyFigure, Section
from analysis.page.markup import Html
from analysis.page.parts import answer_page, input_name, map_settings, noted_tables
from analysis.page.tables import from_rich
from analysis.pictures.style import COVERED, LOSSES
from analysis.removal.answer import Clearing
from analysis.removal.picture import PAID
from analysis.removal.table import KINDS, KINDS_OF_GAIN, findings, footnotes, headline, threats_table


def clearing_page(clearing: Clearing, command: str, pictures: Mapping[str, bytes], files: Sequence[str]) -> str:
    """The page as HTML; the same answer gives the same bytes. Arguments as of `sweep_page`."""
    height, width = clearing.world.shape
    threats = noted_tables([from_rich(threats_table(clearing))], footnotes(clearing))
    return answer_page(
        f"{input_name(clearing.world.source)}, {counted(len(clearing.starts), 'robot')}: what to clear first?",
        headline(clearing), (Section("Threats", threats),), command, pictures,
        files, kind="clear", findings=(), words=list(findings(clearing)), picture=_maps(clearing),
        broad=width > 1.6 * height, settings=_settings(clearing),
        figures=_key_figures(clearing),
        warnings=("Interrupted: these are the picks until then.",) if clearing.partial else (),
    )  # fmt: skip


def _key_figures(clearing: Clearing) -> tuple[KeyFigure, ...]:
    gain, first = clearing.gain, clearing.turns[0]
    unknown = first.best_unknown
    shown = []
    if gain is not None:
        ends = f"{_ends(gain.counted.ci95)}, fresh rollouts"
        shown.append(KeyFigure(f"{gain.counted.mean:.1f} {clearing.unit}", "won after replanning", ends))
    return (
        *shown,
        KeyFigure(f"{unknown.unknown.counted.mean:.1f} {clearing.unit}", "most with the old plan", unknown.threat.name),
        KeyFigure(f"{len(clearing.options)}", "threats", f"{len(first.simulated)} planned for anew"),
    )


def _ends(interval: tuple[float, float]) -> str:
    return f"{interval[0]:.1f} .. {interval[1]:.1f}"


def _maps(clearing: Clearing) -> Html:
    """Gains after replanning and with the old plan, and where risk is paid, cell by cell."""
    world = clearing.world
    known, unknown = clearing.by_cell(lambda one: one.known), clearing.by_cell(lambda one: one.unknown)
    won = f"{KINDS_OF_GAIN[clearing.unit]} won"
    layers = [
        CellLayer(f"{won}, replanned", "By clearing the threat that the cell is in; planned anew.", known, COVERED,
                  short="Replanned"),
        CellLayer(f"{won}, old plan", "By clearing the threat; they do as before.", unknown, COVERED,
                  short="Old plan"),
        CellLayer("Where risk is paid", f"{PAID}, open loop, same paths. No advice on what to clear.",
                  np.maximum(clearing.risk_paid, 0.0), LOSSES, root=True, blocks="sum", short="Risk paid"),
    ]  # fmt: skip
    accessible = world.accessible(clearing.starts)
    return cell_maps_html(layers, world.free, accessible, clearing.starts, world.cell_size, world.origin)


def _settings(clearing: Clearing) -> dict[str, object]:
    world, choices = clearing.world, clearing.choices
    return {
        **map_settings(world),
        "accessible cells": f"{clearing.cells:,}",
        "robots": f"{len(clearing.starts)}",
        "threats": KINDS[clearing.remove],
        "rollouts": f"{choices.rollouts:,} of the last two threats, the same ids for all",
        "seed": f"{choices.seed}",
        "engine": clearing.engine,
        **clearing.settings.shown(),
    }
