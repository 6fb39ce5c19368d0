"""Pictures: of evaluations, of `mrac.plots`, of reports, of the documents."""

import io
import json
import re
import runpy
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from conftest import FOLDER
from drawn_worlds import extreme_worlds
from helpers import ROOT, run_python
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from page_reader import check_page_is_sound
from PIL import Image

import mrac_jax as mrac
from analysis import pictures as plots_style
from analysis.evaluation.evaluate import Evaluation, evaluate
from analysis.evaluation.outputs.over_time import Band, Deadline, last_shown
from analysis.evaluation.report import report
from analysis.evaluation.tables import bin_counts, histogram_bins, marks
from analysis.page.charts import charts_figure
from analysis.page.elements import Chart, Series
from analysis.pictures import label_width, map_layout, new_figure, picture_style, png_bytes, png_of, ranges
from analysis.report.rendering import figure_of
from analysis.report.result import report_of, save_report
from analysis.sampling import RolloutChoices
from planner.formatting import percent
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.simulator.codes import Outcome
from planner.world.world import World, load_world_file

# The pictures: written whole, the right way up, with the numbers of the evaluation in them.

NAN = float("nan")
PICTURES = ("world.png", "covered.png", "losses.png", "distribution.png", "over_time.png")


def evaluation_of(world: World, plan: Plan, rollouts: int = 60) -> Evaluation:
    return evaluate(world, plan, RolloutChoices(loop="open", rollouts=rollouts))


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    """Two robots on a map of 14 x 23 cells, with a band and a deadline."""
    world = load_world_file(FOLDER / "contiguous-14x23-1000.npz")
    known = evaluation_of(world, mrac.plan(world, 2))
    curve, cells = known.closed_form.visited_curve.astype(np.int64), known.tally.accessible
    band = Band(np.arange(len(curve)), curve // 2, curve, np.minimum(2 * curve, cells), 512, cells)
    deadline = Deadline(40, known.tally, known.closed_form.by_deadline(40))
    return replace(known, outputs={"band": band, "deadline": deadline})


@cache
def made(name: str, evaluation: Evaluation) -> Figure:
    with picture_style():
        return figure_of(report(evaluation), name)


@cache
def drawn(name: str, evaluation: Evaluation) -> Figure:
    """With everything where it will be."""
    figure = made(name, evaluation)
    with picture_style():
        figure.draw_without_rendering()
    return figure


def assert_inside(figure: Figure, name: str) -> None:
    with picture_style():
        box = figure.get_tightbbox()
    assert (box.min > 0).all() and (box.max < figure.get_size_inches()).all(), (name, box)


def words(figure: Figure) -> str:
    return " ".join(text.get_text() for text in figure.findobj(Text) if isinstance(text, Text))


def saved(evaluation: Evaluation, folder: Path) -> list[Path]:
    return [path for path in save_report(report(evaluation), folder, "") if path.suffix == ".png"]


def test_five_pictures_1200_pixels_wide_and_always_the_same_bytes(evaluation: Evaluation, tmp_path: Path) -> None:
    """The user's settings are the same before and after, and do not matter."""
    paths = saved(evaluation, tmp_path)
    assert [path.name for path in paths] == list(PICTURES)
    for path in paths:
        with Image.open(path) as image:
            assert image.width == 1200 and 300 < image.height < 1600 and "Software" not in image.info
    usual = [path.read_bytes() for path in paths]
    with mpl.rc_context({"font.size": 31, "axes.grid": True, "image.origin": "lower", "savefig.dpi": 20}):
        before = {name: value for name, value in mpl.rcParams.items() if name != "backend"}
        assert [path.read_bytes() for path in saved(evaluation, tmp_path)] == usual
        assert {name: value for name, value in mpl.rcParams.items() if name != "backend"} == before


def test_nothing_is_written_when_a_picture_fails(evaluation: Evaluation, tmp_path: Path) -> None:
    def broken() -> Figure:
        raise RuntimeError("no picture")

    said = report(evaluation)
    with pytest.raises(RuntimeError, match="no picture"):
        save_report(replace(said, pictures=said.pictures | {"losses.png": broken}), tmp_path, "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["world.png", "covered.png", "losses.png"])
def test_maps_are_the_right_way_up(name: str) -> None:
    """Each obstacle, and nothing else, is dark, where row and column say, on a map without symmetry."""
    threat = np.zeros((5, 9))
    threat[0, 8], threat[4, 1], threat[3, 1], threat[1, 6] = NAN, NAN, NAN, 0.3
    world = World.create(threat)
    figure = made(name, evaluation_of(world, make_plan(world, [[2, 4]]), 10))
    axes = figure.axes[0]
    image = np.asarray(Image.open(io.BytesIO(png_bytes(figure))).convert("RGB"), dtype=float) / 255
    rows, cols = np.mgrid[:5, :9]
    corners = np.stack([cols.ravel() - 0.4, rows.ravel() + 0.42], axis=1)  # off the paths, labels and frames
    x, y = axes.transData.transform(corners).T
    colours = image[(image.shape[0] - y).astype(int), x.astype(int)].reshape(5, 9, 3)
    dark = np.abs(colours - to_rgb(plots_style.OBSTACLE)).max(axis=2) < 0.02
    assert np.array_equal(dark, np.isnan(threat))
    if name == "world.png":
        safe = np.abs(colours - to_rgb(plots_style.SAFE)).max(axis=2) < 0.02
        assert np.array_equal(safe, threat == 0)


def test_titles_hold_the_numbers(evaluation: Evaluation) -> None:
    plan, exact, cells = evaluation.plan, evaluation.closed_form, evaluation.tally.accessible
    share, mean = percent(exact.visited / cells), evaluation.tally.visited @ np.arange(cells + 1) / 60
    for name, titles in {
        "world.png": (
            f"2 robots, {cells} accessible cells",
            f"{len(plan.areas)} areas",
            f"makespan {plan.makespan} steps",
        ),
        "covered.png": (f"{share} of the cells on average",),
        "losses.png": (f"{exact.expected_losses:.2f} in all", f"{exact.stops_by_cell.max():.3g}"),
        "distribution.png": (f"mean of rollouts: {percent(mean / cells)}", f"exact mean: {share}"),
        "over_time.png": ("deadline",),
    }.items():
        assert all(title in words(made(name, evaluation)) for title in titles), name
    assert "Theorem" not in words(made("distribution.png", evaluation))  # verdicts on formulas are asked for


@pytest.fixture(scope="module")
def closed() -> Evaluation:
    """The closed loop of eight robots on a map of 14 x 23 cells: it goes on long after the plan's makespan."""
    world = load_world_file(FOLDER / "scattered-14x23-1002.npz")
    return evaluate(world, mrac.plan(world, 8), RolloutChoices(loop="closed", rollouts=3000, deadline=40), band=True)


def curve(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    """(x, y) of the line whose label starts so."""
    (line,) = [line for line in axes.lines if str(line.get_label()).startswith(label)]
    x, y = line.get_data()
    return np.asarray(x, dtype=float), np.asarray(y, dtype=float)


def test_closed_loop_pictures_hold_its_own_numbers(closed: Evaluation) -> None:
    tally, cells = closed.tally, closed.tally.accessible
    mean = float(tally.visited @ np.arange(cells + 1)) / 3000
    assert abs(mean - closed.closed_form.visited) > 0.02 * cells
    lost = f"{8 - tally.alive @ np.arange(9) / 3000:.2f} in all"
    for name, titles in {
        "world.png": ("paths: the nominal ones (no robot lost)",), "over_time.png": ("deadline",),
        "covered.png": ("closed loop, sampled, 3,000 rollouts", f"{percent(mean / cells)} of the cells on average"),
        "losses.png": ("closed loop, sampled, 3,000 rollouts", lost, f"{tally.stops.max() / 3000:.3g}"),
    }.items():  # fmt: skip
        assert all(title in words(made(name, closed)) for title in titles), name
    assert "interrupted" in words(made("covered.png", replace(closed, partial=True)))


def test_open_loop_pictures_are_of_the_open_loop_alone(evaluation: Evaluation) -> None:
    assert "nominal" not in words(made("world.png", evaluation))
    assert all("closed" not in words(made(name, evaluation)) for name in PICTURES)
    labels = [str(line.get_label()) for line in made("over_time.png", evaluation).axes[0].lines]
    assert not any(label.startswith("open loop") for label in labels)


def test_closed_loop_over_time_beside_the_open_loop(closed: Evaluation) -> None:
    """Both curves at every step, and an axis that ends where at most one rollout in a thousand is still running."""
    cells, time = closed.tally.accessible, closed.tally.time
    axes = made("over_time.png", closed).axes[0]
    end = last_shown(closed.plan, "closed", closed.tally)
    assert end > closed.plan.makespan
    assert time[end + 1 :].sum() <= 3 < time[end:].sum()
    for label, sums in (
        ("mean of rollouts, visited", np.cumsum(closed.tally.new_visited) / 3000),
        ("mean of rollouts, survived", np.cumsum(closed.tally.new_survived) / 3000),
        ("open loop, exact", closed.closed_form.visited_curve),
    ):
        x, y = curve(axes, label)
        assert x[0] == 0 and x[-1] == end and (np.diff(x) > 0).all(), label
        assert np.allclose(y * cells / 100, sums[np.minimum(x.astype(int), len(sums) - 1)]), label


def test_closed_loop_that_ends_before_the_makespan(closed: Evaluation) -> None:
    """The open loop's curve is still shown to its end, and the closed loop's is held."""
    makespan, cells = closed.plan.makespan, closed.tally.accessible
    axes = made("over_time.png", shortened(closed, makespan // 2)).axes[0]
    ends = {"open loop": closed.closed_form.visited, "mean of rollouts, visited": closed.expected.visited}
    for label, end in ends.items():
        x, y = curve(axes, label)
        assert (np.diff(x) > 0).all() and x[-1] == makespan and np.isclose(y[-1] * cells / 100, end)


def test_the_distribution_s_marks_stand_at_their_values(closed: Evaluation, evaluation: Evaluation) -> None:
    """Both means of a closed loop are told apart, and every mark has a look of its own."""
    found = {name.rpartition(":")[0]: value for name, value in marks(closed).items()}
    assert found["open loop, exact"] == closed.closed_form.visited
    assert np.isclose(found["mean of rollouts"], closed.visited.cells)
    assert found["upper bound, team"] == closed.formulas.ideal_team
    assert found["upper bound, one robot, eq. (7)"] == closed.formulas.ideal_eq7
    lines = made("distribution.png", closed).axes[1].lines
    cells = closed.tally.accessible
    assert np.allclose([line.get_xdata()[0] for line in lines], [100 * value / cells for value in found.values()])
    assert len({line.get_color() for line in lines}) == len(lines)
    known = {name.rpartition(":")[0]: value for name, value in marks(evaluation).items()}
    assert known["exact mean"] == evaluation.closed_form.visited


@pytest.mark.parametrize("picture", PICTURES)
def test_closed_loop_pictures_stay_inside_the_figure(picture: str, closed: Evaluation) -> None:
    ended_at_once = replace(shortened(closed, 0), partial=True)
    for shown in (closed, ended_at_once):
        assert_inside(drawn(picture, shown), picture)


def test_one_line_a_robot_along_its_path() -> None:
    world = World.create(np.zeros((12, 17)))
    plan = mrac.plan(world, 11)
    axes = made("world.png", evaluation_of(world, plan, 4)).axes[0]
    lines = {str(line.get_gid()): line for line in axes.lines if str(line.get_gid()).startswith("robot")}
    assert sorted(lines) == sorted(f"robot {robot}" for robot in range(11))
    for number, robot in enumerate(plan.robots):
        x, y = (np.asarray(values, dtype=float) for values in lines[f"robot {number}"].get_data())
        assert np.array_equal(np.round(y).astype(int) * 17 + np.round(x).astype(int), robot.path)
    looks = {(line.get_color(), str(line.get_linestyle())) for line in lines.values()}
    assert len(looks) == 11


def test_histogram_holds_every_rollout_once(evaluation: Evaluation) -> None:
    edges = histogram_bins(evaluation.tally.visited)
    widths = np.diff(edges)
    assert bin_counts(evaluation.tally.visited, edges).sum() == 60
    assert (widths == widths[0]).all() and widths[0] == int(widths[0]) and edges[0] % 1 == 0.5
    bars = made("distribution.png", evaluation).axes[1].patches
    assert np.isclose(sum(bar.get_height() for bar in bars if isinstance(bar, Rectangle)), 100.0)


@pytest.fixture(scope="module")
def extreme() -> dict[str, Evaluation]:
    rollouts = {"tall": 1, "crowd": 3}
    return {name: evaluation_of(*one, rollouts.get(name, 60)) for name, one in extreme_worlds().items()}


def shortened(closed: Evaluation, steps: int) -> Evaluation:
    """The same counts as if every rollout had ended by step `steps`."""

    def cut(counts: np.ndarray) -> np.ndarray:
        return np.append(counts[:steps], counts[steps:].sum())

    old = closed.tally
    tally = replace(old, time=cut(old.time), new_visited=cut(old.new_visited), new_survived=cut(old.new_survived))
    return replace(closed, outputs={}, tally=tally)


def test_labels_never_overlap_and_stay_on_the_map() -> None:
    starts = np.array([[r, c] for r in range(6) for c in range(8)] + [[0, 29], [19, 29], [19, 0]])
    for points in (2.0, 6.0, 14.0, 40.0):
        labels = plots_style.group_labels(starts, (20, 30), points)
        assert sorted(robot for label in labels for robot in label.members) == list(range(len(starts)))
        for number, label in enumerate(labels):
            assert all(0 <= place < side for place, side in zip(label.place, (20, 30), strict=True))
            for other in labels[:number]:
                down, across = np.abs(np.subtract(label.place, other.place)) * points
                assert down >= 13 - 1e-9 or across >= (label_width(label.name) + label_width(other.name)) / 2 - 1e-9


def crossed(figure: Figure) -> list[str]:
    """Labels of a drawn figure that a line, a border or another label runs through, but for what opaque boxes cover."""
    off = beyond(figure)
    labels = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip() and id(t) not in off]
    boxes = np.array([text.get_window_extent().extents for text in labels]) + np.array([1, 1, -1, -1])
    lines, heights = segments(figure)
    found = []
    for number, (label, box) in enumerate(zip(labels, boxes, strict=True)):
        frame = label.get_bbox_patch()
        opaque = frame is not None and frame.get_alpha() in (None, 1) and frame.get_facecolor()[3] == 1
        if meets(lines[heights >= label.get_zorder() if opaque else slice(None)], box).any():
            found.append(f"a line through {label.get_text()!r}")
        over = np.minimum(boxes[:number, 2:], box[2:]) - np.maximum(boxes[:number, :2], box[:2])
        found += [
            f"{label.get_text()!r} on {labels[other].get_text()!r}" for other in np.flatnonzero((over > 0).all(1))
        ]
    return found


def beyond(figure: Figure) -> set[int]:
    """Labels of ticks that lie off their axis: matplotlib keeps them, and draws none."""
    every = [one for one in figure.findobj(Axes) if isinstance(one, Axes)]
    off = set()
    for axis in (axis for one in every for axis in (one.xaxis, one.yaxis)):
        low, high = sorted(axis.get_view_interval())
        for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
            if not low - 1e-9 <= tick.get_loc() <= high + 1e-9:
                off |= {id(tick.label1), id(tick.label2)}
    return off


def segments(figure: Figure) -> tuple[np.ndarray, np.ndarray]:
    """Straight pieces `[M, 4]` (x, y, x, y in pixels) of all lines, borders of areas and frames; their zorder `[M]`."""
    pieces: list[np.ndarray] = [np.zeros((0, 4))]
    heights: list[np.ndarray] = [np.zeros(0)]
    for axes in figure.axes:
        frames = [one for one in axes.patches if isinstance(one, Rectangle) and not one.get_fill()]
        drawn = [line for line in axes.lines if line.get_linestyle() != "None"]
        for thing in (*drawn, *frames, *(one for one in axes.collections if isinstance(one, LineCollection))):
            paths = thing.get_paths() if isinstance(thing, LineCollection) else [thing.get_path()]
            for path in paths:
                at = thing.get_transform().transform(path.vertices)
                if thing.get_clip_on():
                    at = np.clip(at, axes.bbox.min, axes.bbox.max)
                pieces.append(np.hstack([at[:-1], at[1:]]))
                heights.append(np.full(len(at) - 1, thing.get_zorder()))
    return np.concatenate(pieces), np.concatenate(heights)


def meets(lines: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Which straight pieces `[M, 4]` run through a box (x0, y0, x1, y1)."""
    start, along = lines[:, :2], lines[:, 2:] - lines[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(box[:2] - start) / along, (box[2:] - start) / along])
    inside = (start > box[:2]) & (start < box[2:])
    first = np.where(along == 0, np.where(inside, -np.inf, np.inf), ends.min(axis=0)).max(axis=1)
    last = np.where(along == 0, np.where(inside, np.inf, -np.inf), ends.max(axis=0)).min(axis=1)
    return np.maximum(first, 0) < np.minimum(last, 1)


@pytest.mark.parametrize("picture", PICTURES)
def test_no_line_runs_through_a_label(picture: str, evaluation: Evaluation, closed: Evaluation) -> None:
    tally = closed.tally
    done, visited = tally.outcomes.copy(), tally.visited.copy()
    done[[Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST]] = 50, 2950
    visited[-1] += 50
    some = replace(closed, tally=replace(tally, outcomes=done, visited=visited, ids=((0, 3050),)))
    shown = [evaluation, closed, *([some] if picture in ("distribution.png", "over_time.png") else [])]
    with picture_style():
        assert [crossed(drawn(picture, answer)) for answer in shown] == [[]] * len(shown)


DEAR = [pytest.param(name, marks=pytest.mark.slow) for name in ("row", "split", "foreign")]


@pytest.mark.parametrize("name", ["one", "tall", "crowd", *DEAR])
def test_extreme_worlds_are_drawn_inside_the_figure(name: str, extreme: dict[str, Evaluation]) -> None:
    for picture in PICTURES:
        assert_inside(drawn(picture, extreme[name]), picture)
        with picture_style():
            assert crossed(drawn(picture, extreme[name])) == [], picture


@pytest.mark.parametrize(
    "name, cell_size, origin",
    [("world.png", 500.0, (0, 0, 0)), ("covered.png", 0.5, (-3.0, 7.25, 0)), ("losses.png", 0.25, (1, 2, 0.4))],
)
def test_maps_have_axes_in_metres(name: str, cell_size: float, origin: tuple[float, float, float]) -> None:
    """The second axes say where the centre of each cell is, in the frame of the map."""
    world = World.create(np.where(np.arange(108).reshape(9, 12) % 7 == 3, 0.1, 0.0), cell_size=cell_size, origin=origin)
    axes, turned = drawn(name, evaluation_of(world, make_plan(world, [[0, 0]]), 8)).axes[0], origin[2] != 0
    below, beside = axes.child_axes
    assert "m" in below.get_xlabel() and "m" in beside.get_ylabel() and ("corner" in below.get_xlabel()) == turned
    at, unit = axes.transData.transform((5, 2)), 1000.0 if "km" in below.get_xlabel() else 1.0
    shown = [one.transData.inverted().transform(at)[axis] * unit for axis, one in enumerate((below, beside))]
    known = replace(world, origin=(0.0, 0.0, 0.0)) if turned else world
    assert np.allclose(shown, known.to_xy(2 * 12 + 5))
    plain = World.create(np.zeros((3, 4)))
    assert not made("world.png", evaluation_of(plain, make_plan(plain, [[0, 0]]), 4)).axes[0].child_axes


def test_words() -> None:
    assert ranges([0, 1, 2, 5, 7, 8]) == "0-2,5,7-8"
    assert [percent(x) for x in (0, 1, 0.5, 1e-6, 1 - 1e-6)] == ["0 %", "100 %", "50.0 %", "< 0.1 %", "> 99.9 %"]


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (256, 256), (1, 500), (500, 1), (74, 127)])
def test_layout_keeps_the_aspect_and_fits(shape: tuple[int, int]) -> None:
    layout = map_layout(shape, 20)
    for left, bottom, width, height in (layout.map_box, layout.bar_box):
        assert left >= 0 and bottom > 0
        assert left + width <= layout.size[0] and bottom + height <= layout.size[1]
    assert np.isclose(layout.map_box[2] / layout.map_box[3], shape[1] / shape[0])


def test_the_user_s_pyplot_is_left_alone() -> None:
    """It is never imported."""
    code = "import sys; import analysis.pictures as p\nwith p.picture_style(): p.png_bytes(p.new_figure((2, 2)))\n"
    code += "assert 'matplotlib.pyplot' not in sys.modules"
    run_python(code, options=("-W", "error"))


def test_dollars_in_words_are_no_formula() -> None:
    """In a sweep's settings, for example: matplotlib fails on half a formula while it draws."""
    with picture_style():
        figure = new_figure((2.0, 1.0))
        figure.text(0.1, 0.5, r"robots $\nothing{ $5 and $7")
        figure.add_axes((0.2, 0.2, 0.6, 0.6)).plot([1, 2], label=r"$\frac{")
        figure.axes[0].legend()
        figure.axes[0].set_xlabel(r"a $\b$ c")
        assert png_bytes(figure).startswith(b"\x89PNG")


# `mrac.plots`: pictures of worlds, plans and answers, which a notebook shows without being told to.

THREAT = np.zeros((4, 6))
THREAT[1:3, 2:5], THREAT[0, 5] = 0.2, np.nan
REFERENCE = (Path(__file__).parent.parent / "docs" / "reference.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def world() -> mrac.World:
    return mrac.load(THREAT)


@pytest.fixture(scope="module")
def answers(world: mrac.World) -> dict[str, Any]:
    """What each figure is of."""
    evaluated = mrac.evaluate(world.with_values(np.ones((4, 6)), None), 2, rollouts=300)
    return dict.fromkeys(mrac.plots.__all__, evaluated) | {
        "attack_figure": mrac.threats(world, 1, add=1, rollouts=256),
        "check_figure": mrac.check(world, 2, rollouts=300),
        "clear_figure": mrac.threats(world, 2, remove=1, rollouts=256),
        "front_figure": mrac.front(world, 2, rollouts=256),
        "size_figure": mrac.size(world, target=0.5, most=2, rollouts=256),
        "starts_figure": mrac.starts(world, 1, rollouts=256),
    }


def test_the_module_holds_figures_alone() -> None:
    names = dir(mrac.plots)
    assert sorted(mrac.plots.__all__) == names
    for name in names:
        assert name.endswith("_figure") and getattr(mrac.plots, name).__doc__
        assert re.search(rf":members:.*\b{name}\b", REFERENCE), name


def test_a_notebook_shows_every_figure(answers: dict[str, Any]) -> None:
    """IPython asks a cell's last value for `_repr_png_`, whatever backend and settings matplotlib has."""
    shown = {name: getattr(mrac.plots, name)(answer)._repr_png_() for name, answer in answers.items()}
    for name, data in shown.items():
        with Image.open(io.BytesIO(data)) as image:
            assert (image.format, image.width) == ("PNG", 1200), name
    with mpl.rc_context({"font.size": 31}):
        assert mrac.plots.world_figure(answers["world_figure"])._repr_png_() == shown["world_figure"]


FILES = {
    "attack": "attack.png hidden.npz hidden.png known.npz known.yaml", "check": "check.png",
    "clear": "clear.png risk_paid.png", "front": "front.png", "size": "size.png", "starts": "starts.png plan.json",
}  # fmt: skip
"""What the folder of a result holds beside its page, text and JSON object."""


@pytest.mark.parametrize("name", FILES)
def test_every_result_says_the_same_on_terminal_page_and_in_json(name: str, answers: dict, tmp_path: Path) -> None:
    answer, page_and_more = answers[f"{name}_figure"], {"index.html", f"{name}.txt", f"{name}.json"}
    said = report_of(answer)
    assert {file.name for file in answer.save(tmp_path)} == page_and_more | set(FILES[name].split())
    page = (tmp_path / "index.html").read_text()
    told = check_page_is_sound(page).text, " ".join((tmp_path / f"{name}.txt").read_text().split())
    for line in (said.summary, *said.findings):
        assert line.replace("`", "") in told[0] and line in told[1]
    assert json.loads((tmp_path / f"{name}.json").read_text()) == json.loads(json.dumps(answer.to_json()))
    assert 2 <= len(repr(answer).splitlines()) <= 24 and answer._repr_html_().startswith("<b>")
    answer.save(tmp_path / "again")
    assert (tmp_path / "again" / "index.html").read_text() == page


def test_worlds_and_plans_are_drawn_without_an_evaluation(world: mrac.World) -> None:
    plan = mrac.plan(world, 2)
    alone, planned = mrac.plots.world_figure(world), mrac.plots.world_figure(world, plan)
    assert "23 free cells, 2 threat levels" in words(alone)
    assert "2 robots, 23 accessible cells" in words(planned) and f"makespan {plan.makespan} steps" in words(planned)
    named = [[line.get_gid() for line in one.axes[0].lines if line.get_gid()] for one in (alone, planned)]
    assert named == [[], ["robot 0", "robot 1"]]
    assert "start, by robot" in words(mrac.plots.world_figure(world.with_starts([[0, 0], [3, 5]])))


PLAN_ALONE = re.escape(
    "world_figure(what) is a Plan; expected a World, a World and a Plan, or an Evaluation; "
    "use world_figure(world, plan)"
)
WRONG: dict[str, tuple[Callable[[mrac.World], object], str]] = {
    "plan alone": (lambda world: mrac.plots.world_figure(mrac.plan(world)), "^" + PLAN_ALONE + "$"),
    "count": (lambda world: mrac.plots.world_figure(world, 3), "plan=3; expected a Plan"),
    "other map": (lambda world: mrac.plots.world_figure(world, mrac.plan(mrac.load([[0, 0.1]]))), "for another map"),
    "world": (lambda world: mrac.plots.covered_figure(world), "expected a result of type Evaluation"),
    "other answer": (lambda world: mrac.plots.front_figure(mrac.evaluate(world, rollouts=10)), "result of type Front"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_drawn_is_told(name: str, world: mrac.World) -> None:
    call, said = WRONG[name]
    with pytest.raises(mrac.InputError, match=said):
        call(world)


# Charts as pictures: what a page draws is on paper too, every series by name, the same twice.

ROBOTS = (1, 2, 4)
CHARTS = (
    Chart(
        "Coverage over the team, on random maps of the paper's kind",
        (
            Series("closed loop", ROBOTS, (40, 60, 80), (35, 55, 78), (45, 65, 82)),
            Series("open loop", ROBOTS, (38, np.nan, 60), dashed=True),
            Series("stated", (1, 2), (44, 62), kind="points"),
        ),
        "robots", "covered", unit="%", y_range=(0.0, 100.0), at_y=((95.0, "ideal"),),
    ),
    Chart("Runs", (Series("runs", range(50), range(50), kind="bars"),), "steps", "runs"),
)  # fmt: skip


def test_every_series_and_line_is_drawn_by_name_within_its_axes() -> None:
    figure = charts_figure(CHARTS)
    for axes, chart in zip(figure.axes, CHARTS, strict=True):
        names = {text.get_text() for text in axes.get_legend().get_texts()}
        assert names == {*(series.name for series in chart.series), *(words for _, words in chart.at_y)}
        title = axes.title if axes.title.get_text() else axes._left_title
        assert axes.get_xlabel() == chart.x_name and title.get_text().replace("\n", " ") == chart.title
    left, right = figure.axes
    drawn = {line.get_label(): line for line in left.lines}
    assert drawn["open loop"].get_xydata().tolist() == [[1, 38], [4, 60]] and drawn["open loop"].is_dashed()
    assert left.get_ylim() == (0.0, 100.0) and left._left_title.get_window_extent().x1 < right.get_window_extent().x0
    assert png_of(charts_figure, CHARTS) == png_of(charts_figure, CHARTS)


def test_no_upright_line_has_the_colour_of_a_curve() -> None:
    curves = [Series(str(colour), ROBOTS, ROBOTS, colour=colour) for colour in (0, 3, 1, 4)]
    (axes,) = charts_figure([Chart("T", tuple(curves), "x", "y", at_x=((1, "one"), (2, "two")))]).axes
    assert len({str(line.get_color()) for line in axes.lines}) == 6


def test_what_is_beyond_the_range_shown_at_least_and_long_words_stay_within_the_picture() -> None:
    curve = Series("a bound", ROBOTS, (40, 90, 180), (38, 85, 170), (44, 93, 185))
    words = "mean over the worlds, % of the accessible cells"
    chart = Chart("Coverage, what bounds it, and what claims to bound it", (curve,), "robots", words, unit="%",
                  y_range=(0, 100), interval="95 % interval of the mean over worlds")  # fmt: skip
    figure = charts_figure([chart, chart])
    page = figure.bbox
    for axes in figure.axes:
        assert axes.get_ylim() == (0.0, 185.0)
        title = axes._left_title.get_window_extent()  # type: ignore[attr-defined]
        below = axes.texts[0].get_window_extent()
        assert title.y1 < page.y1 and below.y1 < title.y0
        assert max(title.x1, below.x1) < (page.x1 if axes is figure.axes[1] else figure.axes[1].bbox.x0)


# `docs/examples/team_pictures.py` draws the pictures of robots half as fast, radio, and batteries that are charged.

DRAWS = runpy.run_path(str(ROOT / "docs" / "examples" / "team_pictures.py"))


def test_they_are_drawn_and_the_pages_show_them(tmp_path: Path) -> None:
    DRAWS["main"](tmp_path)
    shown = "".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in ("teams.md", "mission.md"))
    drawn = sorted(path.name for path in tmp_path.iterdir())
    assert len(drawn) == 3
    for name in drawn:
        assert f"]({name})" in shown and (ROOT / "docs" / name).exists()


def test_what_they_show_is_what_a_run_has() -> None:
    """Who is first somewhere adds up to what is visited; a chain of hops of six cells joins the third robot, not the
    fourth.
    """
    plan = mrac.plan(DRAWS["site"](), 4, steps_per_move=[1, 1, 2, 2])
    assert DRAWS["firsts"](DRAWS["places"](plan))[-1].sum() == 400
    heard = DRAWS["links"](np.array([[0, 17], [0, 6], [0, 12], [7, 12]]), np.array([[0, 0]]))
    assert [one.tolist() for one, _ in heard] == [[0, 6], [0, 12], [0, 17]]
