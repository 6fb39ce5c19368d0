"""The pictures of `docs/policies.md` from its tables: `python docs/examples/policies_pictures.py FOLDER`.

`docs/tables/policies-gains.csv` and `policies-robot-value.csv` are results of `experiments.py policies` (500 maps).
Teams of 2 and 4 robots, the robot values 5, 20 and 160, and the steps 60 and 150 are from an earlier run, whose other
results differ by 0.1 points.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

from matplotlib.figure import Figure

from analysis.page.charts import charts_figure
from analysis.page.elements import Chart, Series
from analysis.pictures import INK, ROBOT_COLOURS, picture_style
from analysis.statistics.estimates import Estimate

TABLES = Path(__file__).parent.parent / "tables"
KINDS = ("contiguous", "scattered")
LABELS = {"no value": (3, 7), "160": (7, -4), "end": (4, -14)}
"""Offsets of labels right of their points, in printer's points; the others are above (`per_cell`) or below (`mrac`)."""


def rows_of(name: str) -> list[list[str]]:
    """The rows of a table without its heading."""
    with (TABLES / name).open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))[1:]


def gains(kind: str) -> Chart:
    """Points more than `mrac` by team size, with 95 % intervals."""
    rows = [(int(row[0].split()[1]), row) for row in rows_of("policies-gains.csv") if row[0].split()[0] == kind]
    rows = [(robots, row) for robots, row in rows if len(row[0].split()) == 2]
    series = []
    for column, name in ((2, "per_cell"), (3, "per_cell, risk cap 1/4")):
        found = [(robots, *map(float, row[column].split(" ± "))) for robots, row in rows if row[column]]
        estimates = [
            Estimate(mean / 100, half / 196, ((mean - half) / 100, (mean + half) / 100)) for _, mean, half in found
        ]
        series.append(Series.of(name, [robots for robots, _, _ in found], estimates, dashed=column == 3))
    return Chart(f"Points more than mrac, {kind}", tuple(series), "robots", "more covered", unit="%")


def front() -> Figure:
    """Coverage against lost robots: `per_cell` by the value of a robot, `mrac` by the step at which it is ended."""
    figure = Figure(figsize=(8.2, 3.9), layout="constrained")
    figure.suptitle(
        "Coverage against losses of 8 robots\nlabels: value of a robot, in cells (per_cell); last step (mrac)",
        x=0.02, ha="left", size=11,
    )  # fmt: skip
    for place, (kind, axes) in enumerate(zip(KINDS, figure.subplots(1, 2, sharey=True), strict=True)):
        for number, policy in enumerate(("per_cell", "mrac")):
            rows = [row for row in rows_of("policies-robot-value.csv") if row[0].split(",")[0] == policy]
            points = [tuple(map(float, row[1 + place].split(" / "))) for row in rows]
            colour, name = ((ROBOT_COLOURS[0], "per_cell with a robot value"), (INK, "mrac, ended at a step"))[number]
            covered, lost = zip(*points, strict=True)
            axes.plot(lost, covered, marker="o", color=colour, ls="-" if policy == "per_cell" else ":", label=name)
            for row, (share, losses) in zip(rows, points, strict=True):
                text = row[0].rpartition(" ")[2].replace("mrac", "end").replace("none", "no value")
                offset = LABELS.get(text, (-6, 6) if policy == "per_cell" else (6, -12))
                axes.annotate(
                    text, (losses, share), offset, textcoords="offset points", color=colour, size=8,
                    ha="left" if offset[0] > 0 else "right",
                )  # fmt: skip
        axes.set(xlim=(0, 9.3), ylim=(0, 100), xlabel="robots lost, of 8", title=kind)
    figure.axes[0].set_ylabel("covered, %")
    figure.axes[0].legend(loc="lower right", frameon=False)
    return figure


def main(folder: Path) -> None:
    """Write both pictures."""
    folder.mkdir(exist_ok=True, parents=True)
    with picture_style():
        charts_figure([gains(kind) for kind in KINDS]).savefig(folder / "policies-gains.png")
        front().savefig(folder / "policies-front.png", dpi=144)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
