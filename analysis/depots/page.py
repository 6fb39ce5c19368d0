"""The page of `mrac-jax starts --out`: where to start, on the map and in figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.depots.answer import Starts
from analysis.depots.table import findings, footnotes, headline, places_table, standing_words
from analysis.kit.words import between, counted
from analysis.page.cell_maps import CellLayer, cell_maps_html
from analysis.page.document import KeyFigure, Section
from analysis.page.markup import Html
from analysis.page.parts import answer_page, input_name, map_settings, noted_tables
from analysis.page.tables import from_rich
from analysis.pictures.style import COVERED, THREAT


def starts_page(starts: Starts, command: str, pictures: Mapping[str, bytes], files: Sequence[str]) -> str:
    """The page as HTML; the same answer gives the same bytes. Arguments as of `sweep_page`."""
    height, width = starts.world.shape
    places = noted_tables([from_rich(places_table(starts))], footnotes(starts))
    return answer_page(
        f"{input_name(starts.world.source)}, {counted(len(starts.starts), 'robot')}: where to start?",
        headline(starts), (Section("Places", places),), command, pictures, files,
        kind="starts", findings=(), picture=_maps(starts), broad=width > 1.6 * height,
        words=list(findings(starts)), settings=_settings(starts), figures=_key_figures(starts),
        warnings=("Interrupted: this is the best of what was done until then.",) if starts.partial else (),
    )  # fmt: skip


def _key_figures(starts: Starts) -> tuple[KeyFigure, ...]:
    others = f"of {len(starts.simulated) - 1} others simulated, all together with 95 %"
    beaten = KeyFigure(f"{starts.beaten}", "surely beaten", others)
    if starts.gain is not None:
        ends = [100 * end for end in starts.gain.ci95]
        more = f"{between(ends[0], ends[1])}, against {standing_words(starts)}"
        beaten = KeyFigure(f"{100 * starts.gain.mean:+.2f} points", "best found", more)
    confirmed = starts.confirmed
    if confirmed is None or confirmed.counted is None or confirmed.losses is None:
        return (beaten,)
    counted, losses = confirmed.counted, confirmed.losses
    low, high = (f"{100 * end:.2f}" for end in counted.ci95)
    lost = " .. ".join(f"{end:.2f}" for end in losses.ci95)
    what = "visited on average" if confirmed.value is None else "of the value visited"
    return (
        KeyFigure(f"{100 * counted.mean:.1f} %", what, f"{low} .. {high} %, fresh rollouts"),
        KeyFigure(f"{losses.mean:.2f} of {len(starts.starts)}", "robots lost", lost),
        beaten,
    )


def _maps(starts: Starts) -> Html:
    """Threats, and coverage by depot where it was simulated."""
    world = starts.world
    accessible = world.accessible(starts.starts)
    threat = np.where(accessible, np.nan_to_num(world.threat.astype(np.float64)), 0.0)
    layers = [CellLayer("Threat", "Chance that one visit of the cell stops the robot.", threat, THREAT, "%", digits=2)]
    if starts.depot:
        covered = np.zeros(world.shape)
        for place in starts.simulated:
            if place.counted is not None:
                covered[tuple(place.starts[0])] = place.counted.mean
        what = "Covered" if starts.world.value is None else "Share of the value covered"
        about = f"{what} on average if all robots start in the cell; 0 where that was not simulated."
        layers.append(CellLayer("Coverage by depot", about, covered, COVERED, "%", digits=2, short="Depots"))
    places = np.unique(starts.starts, axis=0)
    return cell_maps_html(layers, world.free, accessible, places, world.cell_size, world.origin)


def _settings(starts: Starts) -> dict[str, object]:
    world, choices = starts.world, starts.choices
    return {
        **map_settings(world),
        "accessible cells": f"{starts.cells:,}",
        "robots": f"{len(starts.starts)}, " + ("one depot" if starts.depot else "a start each"),
        "candidates": f"{len(starts.candidates):,}",
        "rollouts": f"{choices.rollouts:,} of the last two places, the same ids for all",
        "seed": f"{choices.seed}",
        "engine": starts.engine,
        **starts.settings.shown(),
    }
