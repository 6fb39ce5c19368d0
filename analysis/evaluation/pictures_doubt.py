"""Mean coverage by map, where the map is uncertain: doubt about the map beside the luck of a mission on it."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from analysis.evaluation.outputs.map_doubt import MapDoubt
from analysis.kit.words import percent
from analysis.pictures.style import heading

MEAN, LUCK = "#1f4e86", "#9fb9d3"


def draw_doubt(axes: Axes, doubt: MapDoubt) -> None:
    """The share of maps on which the mean is at most so much, and a standard deviation of single runs around each."""
    means = doubt.means
    share = (np.arange(len(means)) + 0.5) / len(means)
    low, high = np.clip(means - doubt.luck, 0, 1), np.clip(means + doubt.luck, 0, 1)
    axes.fill_betweenx(share, low, high, color=LUCK, alpha=0.5, linewidth=0, label="single runs on it, ± 1 sd of luck")
    axes.plot(means, share, color=MEAN, marker="o" if len(means) <= 20 else "", label="mean coverage on a map")
    axes.set_ylim(0, 1)
    axes.set_xlabel("visited, share of the accessible cells")
    axes.set_ylabel("share of the maps")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.17), ncols=2, borderaxespad=0)
    low_map, _, high_map = map(percent, doubt.quantiles.values())
    title = f"Which map is true: {low_map} to {high_map} on average"
    heading(axes, title, f"5 % to 95 % of {doubt.behind}")
