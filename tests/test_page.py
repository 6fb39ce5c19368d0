"""Pages: their parts, those of evaluations and checks, the runs that they play."""

import base64
import io
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import FOLDER
from drawn_worlds import extreme_worlds
from page_reader import PNG, Browser, Reader, check_page_is_sound, needs_browser
from PIL import Image
from rich.table import Table

import mrac_jax as mrac
from analysis.checking.check import coverage as coverage_chart
from analysis.checking.check import make_survey, run_survey
from analysis.checking.report import check_report, survey_report, survey_summary
from analysis.evaluation.evaluate import Evaluation, evaluate
from analysis.evaluation.layers import nominal, picked
from analysis.evaluation.report import bound_text, completion_text, losses_text, report, summary
from analysis.evaluation.tables import distribution, formulas_text, over_time
from analysis.page import document
from analysis.page.charts import chart_html
from analysis.page.document import MOST_ROWS, TEMPLATES, Html, TableData, asset, block, whole_script, with_code
from analysis.page.elements import CellLayer, Chart, Run, Series
from analysis.page.maps import NOT_FREE, OUT_OF_REACH, STEPS, cell_maps_html, pack, packed_runs
from analysis.pictures import COVERED, picture_style
from analysis.recording.frames import make_frames
from analysis.report.model import KeyFigure, Report, Section
from analysis.report.rendering import figure_of, page_of
from analysis.report.rendering import page_of as page_of_report
from analysis.report.result import save_report
from analysis.sampling import RolloutChoices, make_engine_for
from planner.make_plan import make_plan
from planner.settings import Choices, Settings
from planner.tally import RolloutResults, Trace
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file

# What a page is made of: markup that cannot be broken, tables, curves, maps by cell.

HOSTILE = (
    "</script><script>alert(1)</script><!--<img src=x onerror=alert(2)>\"'&amp;[bold]`${1}`",
    "javascript:alert(1)",
    "a\u202eb\x00c\udc80d\x1b[31m\u2028",
    "../../etc/passwd //host/x\\y",
)


# --- markup ---


@pytest.mark.parametrize("text", HOSTILE)
def test_text_is_shown_and_never_obeyed(text: str) -> None:
    reader = Reader(TEMPLATES.from_string('<p title="{{ text }}">{{ text }}</p>').render(text=text))
    assert [tag for tag, _ in reader.tags] == ["p"]
    assert reader.text == reader.tags[0][1]["title"]
    hidden = {"\u202e": "\\u202e", "\x00": "\\x00", "\udc80": "\\udc80", "\x1b": "\\x1b"}
    for letter, shown in hidden.items():
        text = text.replace(letter, shown)
    assert reader.text.replace("\\u2028", "\u2028") == text


def test_what_stands_between_backticks_is_code() -> None:
    """Options keep their plain spaces: they are copied into a shell."""
    for text, shown in (
        ("take `x <4>` & go", "take <code>x &lt;4&gt;</code> &amp; go"), ("an odd ` one", "an odd ` one"),
        (Html("<b>`as it is`</b>"), "<b>`as it is`</b>"),
        ("run it: x --seed 1 <", 'run it: x <span class="whole">--seed 1</span> &lt;'),
        ("`--policy per_cell --robot-value 4`",
         '<code><span class="whole">--policy per_cell</span> <span class="whole">--robot-value 4</span></code>'),
    ):  # fmt: skip
        assert with_code(text) == shown


def test_no_line_ends_between_a_number_and_its_unit() -> None:
    tied = {"85.73 % ± 0.05 of 3,451 cells": "85.73~%~±~0.05~of 3,451~cells", "no number here": "no number here",
            "a 95 % interval, < 0.1 %": "a 95~% interval, <~0.1~%"}  # fmt: skip
    assert {text: document.unbroken(text).replace("\N{NO-BREAK SPACE}", "~") for text in tied} == tied


def test_html_stands_as_it_is_and_data_is_inert() -> None:
    assert TEMPLATES.from_string("{{ a }}{{ b }}{{ c }}").render(a=Html("<b>"), b=3, c=None) == "<b>3"
    inert = block("data", {"name": HOSTILE[0]})
    assert inert.count("<") == 2 and Reader(inert).data() == [{"name": HOSTILE[0]}]
    assert "</script" not in whole_script() and "</style" not in asset("page.css")


# --- the page ---


def test_a_page_of_hostile_words_is_sound() -> None:
    def made() -> str:
        chart = Chart(HOSTILE[0], (Series(HOSTILE[0], [1, 2], [3, 4], [2, 3], [4, 5]),), HOSTILE[1], HOSTILE[2],
                      unit=HOSTILE[0], at_x=((1.5, HOSTILE[0]),), at_y=((3, HOSTILE[3]),))  # fmt: skip
        table = Table(*HOSTILE, title=HOSTILE[0])
        table.add_row(*HOSTILE)
        settings = dict(zip(HOSTILE, HOSTILE, strict=True))
        parts = [Section(HOSTILE[0], figures=lambda: [chart]), Section("Tables", [table], HOSTILE, intro=HOSTILE[0])]
        said = Report(HOSTILE[0], HOSTILE[0], HOSTILE[0], HOSTILE[2], {}, HOSTILE, [KeyFigure(*HOSTILE[:3])],
                      parts=parts, notes=HOSTILE, warnings=HOSTILE, settings=settings, heading=HOSTILE)  # fmt: skip
        return page_of(said, HOSTILE[0], dict.fromkeys(HOSTILE, PNG), HOSTILE)

    page = made()
    reader = check_page_is_sound(page)
    assert page == made()
    assert "alert(1)" in reader.text and len(reader.scripts) == 1
    assert len(reader.all("img")) == len(HOSTILE)


def test_an_axis_of_words_has_words() -> None:
    """In its labels and in the table of values."""
    chart = Chart("T", (Series("one", [0, 1], [3, 4]),), "risk", "covered", x_words=("paper", "log"))
    text = Reader(chart_html(chart)).text
    assert text.count("paper") == text.count("log") == 2


def test_sections_without_anything_are_left_out() -> None:
    said = Report("n", "k", "T", "A.", {}, parts=[Section("One", notes=["x"]), Section("Two")])
    headings = [heading for _, heading in check_page_is_sound(page_of(said, "mrac-jax", {}, ())).headings]
    assert headings == ["T", "One", "How to reproduce"]


# --- tables ---


def test_tables_of_the_command_line_keep_words_and_sides() -> None:
    table = Table("", "a [0, 3]", title="T")
    table.columns[1].justify = "right"
    table.add_row("[b]name[/b] :smile:", "1.5 FAILS")
    known = document.from_rich(table)
    assert known == TableData("T", ("", "a [0, 3]"), (("[b]name[/b] :smile:", "1.5 FAILS"),), frozenset({0}))
    reader = Reader(block("table_of", known))
    assert reader.all("span")[0]["class"] == "verdict fails"
    assert reader.all("td", "number") and not reader.all("details")


def test_long_tables_are_folded_and_cut_with_a_note() -> None:
    rows = tuple((str(number),) for number in range(MOST_ROWS + 5))
    tables = [TableData("T", ("n",), some) for some in (rows, rows[: document.FOLDED_FROM])]
    long, short = (Reader(block("table_of", table)) for table in tables)
    assert len(long.all("tr")) == MOST_ROWS + 1 and long.all("details") and not short.all("details")
    assert f"{MOST_ROWS:,} of {len(rows):,} rows" in long.text


# --- curves ---


def numbers(path: str) -> np.ndarray:
    """The points of SVG path data, float64 `[n, 2]`."""
    return np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", path), dtype=float)


def test_a_curve_is_drawn_at_its_values_in_the_colours_of_the_style_sheet() -> None:
    series = (
        Series("a", [0, 5, 10], [0, 50, 100], [0, 40, 90], [10, 60, 100]),
        Series("b", [0, 10], [20, np.nan], kind="points"),
    )
    html = chart_html(Chart("T", series, "robots", "%", unit="%", y_range=(0, 100)))
    assert html == chart_html(Chart("T", series, "robots", "%", unit="%", y_range=(0, 100)))
    reader = Reader(html)
    curves = [attrs for attrs in reader.all("path") if re.search(r"fill: none.*var\(--c0\)", str(attrs["style"]))]
    line, _ = (numbers(str(one["d"])) for one in curves if str(one["d"]).count("L") == 2)
    assert np.allclose(np.diff(line[:, 0]), np.ptp(line[:, 0]) / 2)
    assert np.isclose(line[1, 1], line[[0, 2], 1].mean()) and line[0, 1] > line[2, 1]
    assert "50.00 (40.00 .. 60.00)" in reader.text and "Upright lines: 95 % interval." in reader.text
    assert reader.text.count("b") > 1 and not re.search(r"#[0-9a-f]{6}\b", html), "a dark page has other colours"
    assert {"robots", "0 %", "100 %"} <= set(re.findall(r"<text[^>]*>([^<]*)<", html)), "text, not outlines"


def test_long_curves_are_banded() -> None:
    x = np.arange(100_000)
    reader = Reader(chart_html(Chart("T", (Series("a", x, x / 2, x / 4, x, kind="step"),), "step", "cells")))
    assert "Shaded: 95 % interval." in reader.text and "opacity: 0.2" in str([dict(one) for _, one in reader.tags])


def test_charts_of_one_point_and_of_none() -> None:
    for y in (0.0, 1.0, -3.0):
        assert "<svg" in chart_html(Chart("T", (Series("a", [4], [y]),), "robots", "%"))
    for series in ((Series("a", [], []), Series("b", [1], [np.nan])), ()):
        assert chart_html(Chart("T", series, "robots", "%")) == ""


# --- maps by cell ---


def unpacked(layer: dict, shape: tuple[int, ...]) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(layer["codes"])), dtype="<u2").reshape(shape)


def colours_of(image: dict[str, str | None]) -> np.ndarray:
    """The colours `[H, W, 3]` of an image that is in the page."""
    with Image.open(io.BytesIO(base64.b64decode(str(image["src"]).split(",")[1]))) as data:
        return np.array(data.convert("RGB"))


def test_a_map_holds_every_cell_the_right_way_up() -> None:
    """Of chances on a map of 3 x 5, whose cells but one can be reached from the lower left."""
    chance, threat = np.linspace(0, 1, 15).reshape(3, 5), np.zeros((3, 5))
    chance[0, 1], chance[2, 3] = 1e-9, 1 - 1e-9
    threat[1, 2] = threat[0, 3] = threat[1, 4] = np.nan
    world = World.create(threat, cell_size=0.5)
    layers = [CellLayer("Chance", "about", chance, COVERED, "%", top=1.0), CellLayer("Lost", "", chance * 2, COVERED)]
    reader = Reader(cell_maps_html(layers, world, np.array([[2, 0], [2, 0]])))
    known, accessible = reader.data()[0], world.free & (np.arange(15).reshape(3, 5) != 4)
    assert (known["shape"], known["starts"], known["metres"]) == ([3, 5], [[2, 0], [2, 0]], 0.5)
    for layer, values in zip(known["layers"], (chance, chance * 2), strict=True):
        codes = unpacked(layer, (3, 5))
        assert [codes[1, 2], codes[0, 4], codes[0, 0], codes[2, 4]] == [NOT_FREE, OUT_OF_REACH, 0, STEPS]
        assert np.allclose((codes / STEPS * layer["largest"])[accessible], values[accessible], atol=2 / STEPS)
    codes, colours = unpacked(known["layers"][0], (3, 5)), colours_of(reader.all("img")[0])
    assert codes[0, 1] == 1 and codes[2, 3] == STEPS - 1 and colours.shape == (3, 5, 3)
    assert colours[1, 2].tolist() == [0x3D, 0x43, 0x4C] and colours[0, 4].tolist() == [0xDF, 0xE5, 0xEE]
    for cell, value in (((0, 0), 0.0), ((2, 4), 1.0)):
        assert np.abs(colours[cell] / 255 - COVERED(value)[:3]).max() < 0.02
    assert "3 rows and 5 columns" in str(reader.all("img")[0]["alt"])
    assert [name for name in ("robots' starts", "obstacle", "free, out of reach") if name in reader.text] != []


def test_large_maps_come_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.page.maps.MOST_CELLS", 6)
    threat, values = np.zeros((5, 5)), np.arange(25.0).reshape(5, 5) / 25
    threat[1, :2] = np.nan
    world = World.create(threat)
    layers = [CellLayer("Chance", "", values, COVERED, "%"), CellLayer("Lost", "", values, COVERED, blocks="sum")]
    reader = Reader(cell_maps_html(layers, world, np.array([[4, 4]])))
    known, held = reader.data()[0], np.where(world.free, values, 0)
    assert known["side"] == 3 and "blocks of 3 x 3 cells" in reader.text
    mean, lost = (unpacked(layer, (2, 2)) / STEPS * layer["largest"] for layer in known["layers"])
    assert np.isclose(mean[0, 0], held[:3, :3].sum() / 7, atol=1e-4)
    assert np.allclose(lost, np.add.reduceat(np.add.reduceat(held, [0, 3], 0), [0, 3], 1), atol=1e-3)


def test_a_map_of_one_safe_cell() -> None:
    layers = [CellLayer("Lost", "", np.zeros((1, 1)), COVERED, root=True)]
    reader = Reader(cell_maps_html(layers, World.create([[0.0]]), np.array([[0, 0]])))
    assert unpacked(reader.data()[0]["layers"][0], (1, 1)).tolist() == [[0]]


# The pages of evaluate, check and check --worlds: sound, small, always the same, with the answer's numbers in them.

NAN = float("nan")
HOSTILE_REPORTS = "maps/</script><script>alert(1)</script>\"'&\u202e\udc80.npz"
COMMAND = "mrac-jax evaluate 'a <map>.yaml' --robots 2 --out report"


@pytest.fixture(scope="module")
def world() -> World:
    return load_world_file(FOLDER / "contiguous-14x23-1001.npz")


@pytest.fixture(scope="module")
def answer(world: World) -> Evaluation:
    """Two robots in the closed loop, with everything that can be asked for."""
    choices = RolloutChoices(rollouts=300, deadline=40)
    return evaluate(world, mrac.plan(world, 2), choices, threat_scale=(0.5,), band=True)


def evaluation_page(answer: Evaluation, command: str, pictures: dict[str, bytes]) -> str:
    return page_of_report(report(answer), command, pictures, ("evaluation.json", "plan.json"))


def page_of_reports(answer: Evaluation) -> str:
    return evaluation_page(answer, COMMAND, dict.fromkeys(("world.png", "covered.png", "losses.png", "left.png"), PNG))


def test_evaluation_page(answer: Evaluation) -> None:
    page = page_of_reports(answer)
    reader = check_page_is_sound(page)
    headings = [heading for level, heading in reader.headings if level == 2]
    assert headings == ["The map and the plan", "Chances and coverage", "Coverage over time", "Single runs",
                        "Cell by cell", "Robots", "The paper's formulas", "Settings", "Pictures",
                        "How to reproduce"]  # fmt: skip
    known = 100 * answer.closed.visited.value / answer.tally.accessible
    for words in ("world.png", "evaluation.json", "plan.json", f"{known:.2f} %", answer.world.sha256[:16],
                  "By step 40: ", "Results with scaled threats", summary(answer), COMMAND):  # fmt: skip
        assert words in reader.text
    assert len(page) < 300_000 and reader.text.count("No strategy visits more") <= 1


def test_the_answer_losses_chances_and_the_map_stand_before_the_sections(answer: Evaluation) -> None:
    """In the order of the file, which is that of a phone and of a screen reader; how the map was read comes last."""
    noted = replace(answer, world=replace(answer.world, notes=("4 rows are dropped",)), notes=("7 were cut off",))
    page = page_of_reports(noted)
    reader = check_page_is_sound(page)
    tally = answer.tally
    wanted = [summary(answer), bound_text(answer), "7 were cut off", "The map and the plan", "mean time",
              "Chances in %, losses and time", "Coverage, % of", losses_text(answer), completion_text(answer),
              "A team that reassigns", "Expected coverage by the end", formulas_text(answer), "Theorem 3, C = ",
              "4 rows are dropped", "Versions: "]  # fmt: skip
    places = [reader.text.index(words) for words in wanted]
    assert places == sorted(places)
    assert page.index('class="paths"') < page.index("<main") and tally.rollouts == 300
    notes = {attrs["class"] for attrs in reader.all("p") if attrs.get("class") in ("note", "warning")}
    assert notes == {"note"}, "only what must not be overlooked is yellow"
    boxes = [attrs["class"] for attrs in reader.all("div", "grid-box")]
    assert boxes[0] == "grid-box bare" and "grid-box bare" not in boxes[1:], "paths are drawn on demand"


def test_formulas_and_pictures_are_folded_away(answer: Evaluation) -> None:
    page = page_of_reports(answer)
    for words in ("Theorem 3, C = ", "eq. (2) as printed", 'class="pictures"'):
        before = page[: page.index(words)]
        assert before.count("<details>") == before.count("</details>") + 1, words
    before = page[: page.index("Chances in %")]
    assert before.count("<details>") == before.count("</details>")


def test_every_robot_s_path_is_drawn_over_the_map(answer: Evaluation) -> None:
    lines = [one for one in Reader(page_of_reports(answer)).all("path") if (one.get("class") or "").startswith("r")]
    for line, robot in zip(lines, answer.plan.robots, strict=True):
        moved = robot.path[np.append(True, np.diff(robot.path) != 0)]
        assert walked(str(line["d"]), answer.plan.shape[1]) == moved.tolist()


def test_paths_too_long_for_a_page_are_left_out(answer: Evaluation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.page.maps.PLAN_PATHS_MOST_LETTERS", 10)
    reader = check_page_is_sound(page_of_reports(answer))
    assert "too long to be drawn" in reader.text and not reader.all("svg", "paths")


@pytest.mark.parametrize("levels", [16, 3])
def test_one_chance_has_one_colour_in_pictures_and_on_the_page(levels: int) -> None:
    """Every cell of the map's picture and of the page's map, also where the planner puts several p in one level."""
    threat = np.linspace(0, 0.4, 77).reshape(7, 11)
    threat[2, 3] = NAN
    world = World.create(threat)
    plan = make_plan(world, [[0, 0]], Settings(levels=levels))
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=10))
    on_page = colours_of(check_page_is_sound(evaluation_page(answer, COMMAND, {})).all("img")[0])
    with picture_style():
        drawn = np.asarray(figure_of(report(answer), "world.png").axes[0].images[0].get_array())
    assert np.array_equal(np.round(255 * drawn[..., :3]).astype(int), on_page)
    assert len(np.unique(on_page.reshape(-1, 3), axis=0)) > 40


def test_the_demo_s_page_is_one_file_below_a_megabyte(tmp_path: Path) -> None:
    """The world of `make demo`, with the pictures in the page, copied alone."""
    world = load_input(Path(__file__).parents[1] / "analysis/examples/terrain.yaml")
    plan = mrac.plan(world, 8)
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=500))
    save_report(report(answer), tmp_path, COMMAND)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    reader = check_page_is_sound(page)
    assert len(page.encode()) < 1_000_000
    assert len(reader.all("img")) == 6 + 5
    assert not [name for name in tmp_path.iterdir() if f'="{name.name}' in page or f"./{name.name}" in page]


def test_the_page_says_nothing_of_when_it_was_made(answer: Evaluation) -> None:
    slower = replace(answer, seconds=answer.seconds * 7 + 1, compile_seconds=99.0)
    assert page_of_reports(answer) == page_of_reports(answer) == page_of_reports(slower)


def test_maps_hold_the_expected_values(answer: Evaluation) -> None:
    known = [found for found in check_page_is_sound(page_of_reports(answer)).data() if "layers" in found][-1]
    shape, accessible = answer.world.shape, answer.world.accessible(answer.plan.starts)
    visited, threat = answer.expected.visited_by_cell, answer.world.threat.ravel()
    expected = (threat, visited, answer.expected.stops_by_cell, threat * (1 - visited))
    assert known["starts"] == answer.plan.starts.tolist() and known["shape"] == list(shape)
    *layers, areas = known["layers"][:5]
    for layer, values in zip(layers, expected, strict=True):
        codes = unpacked(layer, shape)
        assert np.array_equal(codes <= STEPS, accessible)
        shown = (codes / STEPS * layer["largest"])[accessible]
        assert np.allclose(shown, values.reshape(shape)[accessible], atol=2 * layer["largest"] / STEPS)
    codes = unpacked(areas, (-1,))
    for number, area in enumerate(answer.plan.areas):
        assert (np.round(codes[area.cells] / STEPS * areas["largest"]) == number).all()
        assert areas["names"][number].startswith(f"{number}, level {area.level}, ")


def test_curves_hold_the_expected_values(answer: Evaluation) -> None:
    """And each chart is on the page, by its name."""
    text, cells = check_page_is_sound(page_of_reports(answer)).text, answer.tally.accessible
    charts = [over_time(answer), *distribution(answer)]
    assert all(chart.title in text and one.name in text for chart in charts for one in chart.series)
    visited, chance, runs = (chart.series[0] for chart in charts)
    steps = np.minimum(np.array(visited.x), len(answer.expected.visited_curve) - 1)
    assert np.allclose(visited.y, 100 * answer.expected.visited_curve[steps] / cells, atol=0.01)
    for x, *known in zip(*map(np.asarray, (chance.x, chance.y, chance.low, chance.high)), strict=True):
        held = answer.figures.visited.chance(round(x * cells / 100))
        assert np.allclose(known, 100 * np.array([held.mean, *held.ci95]), atol=0.01)
    assert np.isclose(np.sum(runs.y), 100, atol=0.1)


def test_extreme_worlds_with_hostile_names() -> None:
    how = {"row": {"deadline": 20}, "tall": {"loop": "open"}, "foreign": {"loop": "open"}}
    for name, (world, plan) in extreme_worlds(crowd=False).items():
        hostile, is_one = replace(world, source=HOSTILE_REPORTS), name == "one"
        answer = evaluate(world, plan, RolloutChoices(rollouts=20, **how.get(name, {})))
        shown = replace(answer, world=hostile, notes=(HOSTILE_REPORTS,), partial=is_one)
        reader = check_page_is_sound(evaluation_page(shown, HOSTILE_REPORTS, {HOSTILE_REPORTS: PNG}))
        assert "\\u202e\\udc80.npz" in reader.text and ("Interrupted" in reader.text) == is_one, name


def test_check_page(world: World) -> None:
    checked = mrac.check(world, 2, rollouts=300)
    page = page_of_report(check_report(checked), COMMAND, {"check.png": PNG}, ())
    text = check_page_is_sound(page).text
    assert len(page) < 300_000 and COMMAND in text and f"{checked.exact.visited:.2f}" in text
    assert all(check.about.plain in text and check.about.source in text for check in checked.rows)
    named = replace(checked, world=replace(checked.world, source=HOSTILE_REPORTS))
    check_page_is_sound(page_of_report(check_report(named), HOSTILE_REPORTS, {HOSTILE_REPORTS: PNG}, ()))


def test_survey_page() -> None:
    survey = run_survey(make_survey(2, None, "8x8", (1, 2), Choices()), RolloutChoices(rollouts=64), processes=1)
    page, later = (
        page_of_report(survey_report(replace(survey, seconds=seconds)), COMMAND, {"over_robots.png": PNG}, ())
        for seconds in (survey.seconds, 1e6)
    )
    reader = check_page_is_sound(page)
    assert len(page) < 300_000 and page == later
    assert survey_summary(survey) in reader.text and COMMAND in reader.text
    assert all(row.check.about.title in reader.text for row in survey.rows)
    truths = [
        check.truth.value / entry.cells for entry in survey.entries if entry.robots == 2
        for check in entry.checks if check.key == "ideal_team/visited/open"
    ]  # fmt: skip
    assert np.isclose(np.asarray(coverage_chart(survey).series[0].y)[1], 100 * np.mean(truths), atol=0.01)


def test_the_front_s_curve_stands_beside_the_map_with_the_plan_marked() -> None:
    threat = np.zeros((6, 9))
    threat[2:4, 3:7] = 0.2
    drawn, without = (
        evaluation_page(mrac.evaluate(mrac.load(threat), 2, band=False, **how), "", {})
        for how in ({"rollouts": 2048}, {"rollouts": 64, "advice": False})
    )
    header = drawn[: drawn.index("</header>")]
    assert "Coverage and losses" in header and "this plan (mrac)" in header and "Coverage and losses" not in without


WIDER = "document.documentElement.scrollWidth > document.documentElement.clientWidth"
TABLES = """[...document.querySelectorAll('.scroll')].filter((box) => !box.closest('details:not([open])'))
    .map((box) => [box.scrollWidth > box.clientWidth + 1, box.classList.contains('cut'),
                   getComputedStyle(box, '::before').content.includes('Scroll')])"""
TILES = """[...document.querySelectorAll('.figures li')].map((tile) => tile.getBoundingClientRect())
    .map((box) => [Math.round(box.top), Math.round(box.right)])"""
BAR = "(() => { const bar = document.querySelector('nav ul'); return bar.scrollWidth <= bar.clientWidth; })()"
DRAWN = "getComputedStyle(document.querySelector('.plan-map .paths')).display"


@needs_browser
def test_nothing_is_cut_in_a_browser(answer: Evaluation, browser: Browser, tmp_path: Path) -> None:
    """Tables that are wider than a phone say so, tiles leave no hole, paths are drawn when somebody asks for them."""
    (tmp_path / "page.html").write_text(page_of_reports(answer), encoding="utf-8")
    for width in (390, 768, 1280):
        browser.open(tmp_path / "page.html", width=width)
        browser.until(f"{TABLES}.every(([wide, cut]) => wide === cut)")
        tables = browser.run(TABLES)
        assert not browser.run(WIDER) and len(tables) > 2 and all(cut == hint for _, cut, hint in tables)
        assert any(cut for _, cut, _ in tables) == (width == 390)
        assert browser.run(BAR) == (width > 390)
        tiles = browser.run(TILES)
        ends = {max(right for top, right in tiles if top == row) for row, _ in tiles}
        assert len(tiles) > 4 and len(ends) == 1
        assert browser.run(DRAWN) == "none"
        browser.run("document.querySelector('.plan-map input[type=checkbox]').click()")
        assert browser.run(DRAWN) != "none" and not browser.noticed


# The runs that a page plays: packed as they were, picked as `record` picks, and unfolded by its script.

COLS = 23


@pytest.fixture(scope="module")
def answer_runs() -> Evaluation:
    world = load_world_file(FOLDER / "contiguous-14x23-1000.npz")
    return evaluate(world, mrac.plan(world, 3), RolloutChoices(rollouts=60))


@pytest.fixture(scope="module")
def traces(answer_runs: Evaluation) -> tuple[RolloutResults, list[int], list[Trace]]:
    """All results; the rollouts that `record` would pick, and their traces."""
    asked = answer_runs.world, answer_runs.plan, answer_runs.choices
    engine, (_, ids, count) = make_engine_for(*asked), picked(*asked, answer_runs.tally.rollouts)
    assert count == 60
    return engine.results(0, count), ids, list(engine.traces(ids))


@pytest.fixture(scope="module")
def packed(answer_runs: Evaluation) -> dict[str, Any]:
    """What the page's script is given to play."""
    reader = check_page_is_sound(page_of(report(answer_runs), "mrac-jax evaluate", {}, ()))
    return next(found for found in reader.data() if "runs" in found)


def moves_of(text: str) -> bytes:
    """The codes of a robot's moves, a byte each."""
    return zlib.decompress(base64.b64decode(text))


def unpacked_runs(run: dict[str, Any], cols: int) -> np.ndarray:
    """Cells `[T, K]` of a packed run."""
    ways = []
    for start, text in zip(run["starts"], run["moves"], strict=True):
        codes = np.frombuffer(moves_of(text), dtype=np.uint8)
        steps = np.array([0, -cols, cols, -1, 1])[np.pad(codes, (0, run["time"] - len(codes)))]
        ways.append(start + np.append(0, np.cumsum(steps)))
    return np.stack(ways, axis=1)


def test_a_page_holds_the_plan_and_the_rollouts_that_record_would_pick(
    answer_runs: Evaluation, packed: dict, traces: tuple
) -> None:
    plan, *rolled = packed["runs"]
    assert packed["shape"] == [14, COLS] and packed["accessible"] == answer_runs.tally.accessible
    cells = unpacked_runs(plan, COLS)
    for number, robot in enumerate(answer_runs.plan.robots):
        assert np.array_equal(cells[: len(robot.path), number], robot.path)
    results, ids, found = traces
    assert [run["name"].split(",")[0] for run in rolled] == ["median", "worst", "best"]
    assert results.visited[ids].tolist() == np.sort(results.visited)[[29, 0, -1]].tolist()
    for run, trace in zip(rolled, found, strict=True):
        assert np.array_equal(unpacked_runs(run, COLS), trace.cells)
        assert run["lost"] == [-1 if alive.all() else int(np.argmin(alive)) for alive in make_frames(trace).alive.T]


def test_where_nothing_can_happen_the_plan_alone_is_played() -> None:
    world = World.create(np.zeros((1, 4)))
    answer_runs = evaluate(world, make_plan(world, [[0, 0]]), RolloutChoices(rollouts=10))
    reader = check_page_is_sound(page_of(report(answer_runs), "mrac-jax evaluate", {}, ()))
    runs = next(found for found in reader.data() if "runs" in found)["runs"]
    assert [(run["name"], run["time"], run["lost"]) for run in runs] == [("plan", 3, [-1])]


def test_runs_that_have_no_room_are_left_out(answer_runs: Evaluation, monkeypatch: pytest.MonkeyPatch) -> None:
    run, free = nominal(answer_runs.plan), answer_runs.world.free
    room = sum(map(len, pack(run, COLS)["moves"]))
    monkeypatch.setattr("analysis.page.maps.RUNS_MOST_LETTERS", room)
    assert packed_runs([run, run], free) == packed_runs([run], free) != {}
    monkeypatch.setattr("analysis.page.maps.RUNS_MOST_LETTERS", room - 1)
    assert packed_runs([run], free) == {}
    with pytest.raises(ValueError, match="from cell to cell"):
        pack(Run("jumps", np.array([[0], [2]], dtype=np.int32), np.array([-1])), 5)


@needs_browser
def test_the_script_unfolds_a_run_as_the_recording_does(packed: dict, traces: tuple, browser: Browser) -> None:
    """Who covers which cell when, and every robot's way, beside `make_frames`, which shares nothing with the script."""
    script = asset("replay.js") + """
      const tell = (moves, run, shape) => {
        const replay = unfold(moves, run.starts, run.lost, run.time, ...shape), half = run.time >> 1;
        return { when: [...replay.when], who: [...replay.who], covered: upTo(replay.steps, half),
          left: replay.robots.filter((robot) => !isLost(robot, half)).length,
          at: replay.robots.map((robot) => cellAt(robot, half)),
          trails: replay.robots.map((robot) => trail(robot, half, shape[1])) };
      };"""  # fmt: skip
    for run, trace in zip(packed["runs"][1:], traces[2], strict=True):
        moves = [list(moves_of(text)) for text in run["moves"]]
        given = ", ".join(map(json.dumps, (moves, run, packed["shape"])))
        told = browser.run(f"(() => {{ {script} return tell({given}); }})()")
        frames, half = make_frames(trace), trace.time // 2
        assert told["when"] == frames.visited_at.tolist() and told["who"] == frames.visited_by.tolist()
        assert told["covered"] == frames.visited[half] and told["left"] == frames.alive_count[half]
        assert told["at"] == trace.cells[half].tolist()
        for letters, way in zip(told["trails"], trace.cells[: half + 1].T, strict=True):
            assert walked(letters, COLS) == way[np.append(True, np.diff(way) != 0)].tolist()


def walked(letters: str, cols: int) -> list[int]:
    """The cells of an SVG path of moves."""
    col, row = map(int, re.findall(r"^M(\d+) (\d+)", letters)[0])
    cells = [row * cols + col]
    for way, times in re.findall(r"([hv])(-?\d+)", letters):
        step = (1 if way == "h" else cols) * int(np.sign(int(times)))
        cells += [cells[-1] + step * (number + 1) for number in range(abs(int(times)))]
    return cells
