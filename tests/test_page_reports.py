"""The pages of evaluate, check and check --worlds: sound, small, always the same, with the answer's numbers in them."""

from __future__ import annotations

import base64
import re
import zlib
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, browser_path
from conftest import FOLDER
from page_reader import PNG, Reader, check_page_is_sound
from PIL import Image

import mrac_jax as mrac
from analysis.checking.check import MapCheck, check_input
from analysis.checking.report import check_headline, check_report, survey_headline, survey_report
from analysis.checking.survey import Survey, make_survey, run_survey
from analysis.evaluation.answer import Evaluation
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.report import chances_words, headline, limit_words, losses_words, report
from analysis.evaluation.table import formulas_words
from analysis.page.maps import STEPS
from analysis.pictures.style import house_style
from analysis.report.answer import save_report
from analysis.report.html import page_of as page_of_report
from analysis.report.picture import figure_of
from analysis.sampling import RolloutChoices
from analysis.theory.formulas import FORMULAS
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan, RobotPlan
from planner.settings import Choices, Settings
from planner.world.levels import place_starts
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file

NAN = float("nan")
HOSTILE = "maps/</script><script>alert(1)</script>\"'&\u202e\udc80.npz"
COMMAND = "mrac-jax evaluate 'a <map>.yaml' --robots 2 --out report"


@pytest.fixture(scope="module")
def world() -> World:
    return load_world_file(FOLDER / "contiguous-14x23-1001.npz")


@pytest.fixture(scope="module")
def answer(world: World) -> Evaluation:
    """Two robots in the closed loop, with everything that can be asked for."""
    plan = make_plan(world, place_starts(world, 2)[0])
    choices = RolloutChoices(rollouts=300, deadline=40)
    return evaluate(world, plan, choices, threat_scale=(0.5,), band=True)


@pytest.fixture(scope="module")
def checked(world: World) -> MapCheck:
    return check_input(world, make_plan(world, place_starts(world, 2)[0]), RolloutChoices(rollouts=300))


@pytest.fixture(scope="module")
def survey() -> Survey:
    choices = make_survey(2, None, "8x8", (1, 2), Choices())
    return run_survey(choices, RolloutChoices(rollouts=64), processes=1)


def evaluation_page(answer: Evaluation, command: str, pictures: dict[str, bytes]) -> str:
    return page_of_report(report(answer), command, pictures, ("evaluation.json", "plan.json"))


def page_of(answer: Evaluation) -> str:
    return evaluation_page(answer, COMMAND, dict.fromkeys(("world.png", "covered.png", "losses.png", "left.png"), PNG))


def test_evaluation_page(answer: Evaluation) -> None:
    page = page_of(answer)
    reader = check_page_is_sound(page)
    assert len(page) < 300_000
    assert headline(answer) in reader.text and COMMAND in reader.text
    assert reader.text.count("No strategy visits more") <= 1
    headings = [heading for level, heading in reader.headings if level == 2]
    assert headings == ["The map and the plan", "Chances and coverage", "Coverage over time", "Single runs",
                        "Cell by cell", "Robots", "The paper's formulas", "Settings", "Pictures",
                        "How to reproduce"]  # fmt: skip
    assert all(name in reader.text for name in ("world.png", "evaluation.json", "plan.json"))
    assert answer.closed is not None
    known = 100 * answer.closed.visited.value / answer.tally.accessible
    assert f"{known:.2f} %" in reader.text and answer.world.sha256[:16] in reader.text
    assert "By step 40: " in reader.text and "If every threat is so many times the map's" in reader.text


def test_the_answer_losses_chances_and_the_map_stand_before_the_sections(answer: Evaluation) -> None:
    """In the order of the file, which is that of a phone and of a screen reader; how the map was read comes last."""
    noted = replace(answer, world=replace(answer.world, notes=("4 rows are dropped",)), notes=("7 were cut off",))
    page = page_of(noted)
    reader = check_page_is_sound(page)
    tally = answer.tally
    wanted = [headline(answer), limit_words(answer), "7 were cut off", "The map and the plan", "mean time",
              "Chances in %, losses and time", "Coverage, % of", losses_words(answer), chances_words(answer),
              "gains", "Expected coverage by the end", formulas_words(answer), "Theorem 3, C = ",
              "4 rows are dropped", "Versions: "]  # fmt: skip
    places = [reader.text.index(words) for words in wanted]
    assert places == sorted(places)
    assert page.index('class="paths"') < page.index("<main") and tally.rollouts == 300
    notes = {attrs["class"] for attrs in reader.all("p") if attrs.get("class") in ("note", "warning")}
    assert notes == {"note"}, "only what must not be overlooked is yellow"
    boxes = [attrs["class"] for attrs in reader.all("div", "grid-box")]
    assert boxes[0] == "grid-box bare" and "grid-box bare" not in boxes[1:], "paths are drawn on demand"


def test_formulas_and_pictures_are_folded_away(answer: Evaluation) -> None:
    page = page_of(answer)
    for words in ("Theorem 3, C = ", "eq. (2) as printed", 'class="pictures"'):
        before = page[: page.index(words)]
        assert before.count("<details>") == before.count("</details>") + 1, words
    before = page[: page.index("Chances in %")]
    assert before.count("<details>") == before.count("</details>")


def test_every_robot_s_path_is_drawn_over_the_map(answer: Evaluation) -> None:
    page = page_of(answer)
    lines = [attrs for attrs in Reader(page).all("path") if (attrs.get("class") or "").startswith("r")]
    assert len(lines) == len(answer.plan.robots)
    for line, robot in zip(lines, answer.plan.robots, strict=True):
        start, *strokes = re.findall(r"M(\d+) (\d+)|([hv])(-?\d+)", str(line["d"]))
        col, row = int(start[0]), int(start[1])
        cells = [row * answer.plan.shape[1] + col]
        for _, _, way, times in strokes:
            for _ in range(abs(int(times))):
                row, col = (row + np.sign(int(times)), col) if way == "v" else (row, col + np.sign(int(times)))
                cells.append(int(row * answer.plan.shape[1] + col))
        moved = robot.path[np.append(True, np.diff(robot.path) != 0)]
        assert cells == moved.tolist()


def test_paths_too_long_for_a_page_are_left_out(answer: Evaluation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.page.paths.PLAN_PATHS_MOST_LETTERS", 10)
    reader = check_page_is_sound(page_of(answer))
    assert "too long to be drawn" in reader.text and not reader.all("svg", "paths")


@pytest.mark.parametrize("levels", [16, 3])
def test_one_chance_has_one_colour_in_pictures_and_on_the_page(levels: int) -> None:
    """Every cell of the map's picture and of the page's map, also where the planner puts several p in one level."""
    threat = np.linspace(0, 0.4, 77).reshape(7, 11)
    threat[2, 3] = NAN
    world = World.create(threat)
    plan = make_plan(world, [[0, 0]], Settings(levels=levels))
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=10))
    page = check_page_is_sound(evaluation_page(answer, COMMAND, {}))
    with Image.open(BytesIO(base64.b64decode(str(page.all("img")[0]["src"]).split(",")[1]))) as image:
        on_page = np.array(image.convert("RGB"))
    with house_style():
        figure = figure_of(report(answer), "world.png")
        drawn = np.asarray(figure.axes[0].images[0].get_array())
    assert np.array_equal(np.round(255 * drawn[..., :3]).astype(int), on_page)
    assert len(np.unique(on_page.reshape(-1, 3), axis=0)) > 40


def test_the_demo_s_page_is_one_file_below_a_megabyte(tmp_path: Path) -> None:
    """The world of `make demo`, with the pictures in the page, copied alone."""
    world = load_input(Path(__file__).parents[1] / "analysis/examples/terrain.yaml")
    plan = make_plan(world, place_starts(world, 8)[0])
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=500))
    save_report(report(answer), tmp_path, COMMAND)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    reader = check_page_is_sound(page)
    assert len(page.encode()) < 1_000_000
    assert len(reader.all("img")) == 6 + 5
    assert not [name for name in tmp_path.iterdir() if f'="{name.name}' in page or f"./{name.name}" in page]


def test_the_page_says_nothing_of_when_it_was_made(answer: Evaluation) -> None:
    slower = replace(answer, seconds=answer.seconds * 7 + 1, compile_seconds=99.0)
    assert page_of(answer) == page_of(answer) == page_of(slower)


def test_maps_hold_the_expected_values(answer: Evaluation) -> None:
    known = [found for found in check_page_is_sound(page_of(answer)).data() if "layers" in found][-1]
    shape = answer.world.shape
    accessible = answer.world.accessible(answer.plan.starts)
    visited, threat = answer.expected.visited_by_cell, answer.world.threat.ravel()
    expected = (threat, visited, answer.expected.stops_by_cell, threat * (1 - visited))
    assert known["starts"] == answer.plan.starts.tolist() and known["shape"] == list(shape)
    for layer, values in zip(known["layers"][:4], expected, strict=True):
        codes = np.frombuffer(zlib.decompress(base64.b64decode(layer["codes"])), dtype="<u2").reshape(shape)
        assert np.array_equal(codes <= STEPS, accessible)
        shown = (codes / STEPS * layer["largest"])[accessible]
        assert np.allclose(shown, values.reshape(shape)[accessible], atol=2 * layer["largest"] / STEPS)
    areas = known["layers"][4]
    codes = np.frombuffer(zlib.decompress(base64.b64decode(areas["codes"])), dtype="<u2")
    for number, area in enumerate(answer.plan.areas):
        assert (np.round(codes[area.cells] / STEPS * areas["largest"]) == number).all()
        assert areas["names"][number].startswith(f"{number}, level {area.level}, ")


def test_curves_hold_the_expected_values(answer: Evaluation) -> None:
    charts = [found for found in check_page_is_sound(page_of(answer)).data() if "series" in found]
    visited = charts[0]["series"][0]
    steps = np.minimum(np.array(visited["x"], dtype=int), len(answer.expected.visited_curve) - 1)
    cells = answer.tally.accessible
    assert np.allclose(visited["y"], 100 * answer.expected.visited_curve[steps] / cells, atol=0.01)
    chance = charts[1]["series"][0]
    for x, y, low, high in zip(chance["x"], chance["y"], chance["low"], chance["high"], strict=True):
        held = answer.figures.visited.chance(round(x * cells / 100))
        assert np.allclose((y, low, high), 100 * np.array([held.mean, *held.ci95]), atol=0.01)
    assert np.isclose(sum(charts[2]["series"][0]["y"]), 100, atol=0.1)


def hard_worlds() -> dict[str, Evaluation]:
    """One cell, a row with a deadline, a tall map in the open loop, another planner's plan, cells out of reach."""
    one, row = World.create([[0.0]]), World.create([[0.0] * 40 + [0.5]], cell_size=2.5)
    tall = World.create(np.where(np.arange(60)[:, None] % 7 == 6, [[0.1, 0.2, NAN]], [[0.0, 0.05, 0.3]]))
    split = World.create([[0.0, NAN, 0.2], [0.0, NAN, 0.2]])
    worlds = {"one": one, "row": row, "tall": tall, "split": split, "foreign": row}
    plans = {name: make_plan(world, [[0, 0]]) for name, world in worlds.items()}
    paths = tuple(RobotPlan(robot.path[:9]) for robot in plans["row"].robots)
    plans["foreign"] = Plan(row.shape, row.sha256, None, paths, outcome="end_of_paths", time=8)
    choices = {"row": {"deadline": 20}, "tall": {"loop": "open"}, "foreign": {"loop": "open"}}
    return {
        name: evaluate(worlds[name], plans[name], RolloutChoices(rollouts=20, **choices.get(name, {})))  # type: ignore[arg-type]
        for name in worlds
    }


def test_extreme_worlds_with_hostile_names() -> None:
    for name, answer in hard_worlds().items():
        shown = replace(answer, world=replace(answer.world, source=HOSTILE), notes=(HOSTILE,), partial=name == "one")
        reader = check_page_is_sound(evaluation_page(shown, HOSTILE, {HOSTILE: PNG}))
        assert "\\u202e\\udc80.npz" in reader.text, name
        assert ("Interrupted" in reader.text) == (name == "one")


def test_check_page(checked: MapCheck) -> None:
    page = page_of_report(check_report(checked), COMMAND, {"check.png": PNG}, ())
    reader = check_page_is_sound(page)
    assert len(page) < 300_000 and page == page_of_report(check_report(checked), COMMAND, {"check.png": PNG}, ())
    assert check_headline(checked) in reader.text and COMMAND in reader.text
    for check in checked.rows:
        assert check.about.plain in reader.text and check.about.source in reader.text
    assert f"{checked.exact.visited:.2f}" in reader.text
    named = replace(checked, world=replace(checked.world, source=HOSTILE))
    check_page_is_sound(page_of_report(check_report(named), HOSTILE, {HOSTILE: PNG}, ()))


def test_survey_page(survey: Survey) -> None:
    page = page_of_report(survey_report(survey), COMMAND, {"over_robots.png": PNG}, ())
    reader = check_page_is_sound(page)
    assert len(page) < 300_000 and page == page_of_report(
        survey_report(replace(survey, seconds=1e6)), COMMAND, {"over_robots.png": PNG}, ()
    )
    assert survey_headline(survey) in reader.text and COMMAND in reader.text
    assert {row.check.about.title for row in survey.rows} <= titles(reader)
    coverage = reader.data()[-1]["series"][0]
    truths = [
        check.truth.value / entry.cells
        for entry in survey.entries
        if entry.robots == 2
        for check in entry.checks
        if check.key == "ideal_team/visited/open"
    ]
    assert np.isclose(coverage["y"][1], 100 * np.mean(truths), atol=0.01)


def titles(reader: Reader) -> set[str]:
    """The formulas that the page's text names."""
    return {about.title for about in FORMULAS.values() if about.title in reader.text}


def test_the_front_s_curve_stands_beside_the_map_with_the_plan_marked() -> None:
    threat = np.zeros((6, 9))
    threat[2:4, 3:7] = 0.2
    answer = mrac.evaluate(mrac.load(threat), 2, rollouts=2048, band=False, progress=False)
    page = evaluation_page(answer, "", {})
    header = page[: page.index("</header>")]
    assert "What coverage costs" in header and "this plan (mrac)" in header
    without = evaluation_page(mrac.evaluate(mrac.load(threat), 2, rollouts=64, band=False, advice=False), "", {})
    assert "What coverage costs" not in without


WIDER = "document.documentElement.scrollWidth > innerWidth"
TABLES = """[...document.querySelectorAll('.scroll')].filter((box) => !box.closest('details:not([open])'))
    .map((box) => [box.scrollWidth > box.clientWidth + 1, box.classList.contains('cut'),
                   getComputedStyle(box, '::before').content.includes('Scroll')])"""
TILES = """[...document.querySelectorAll('.figures li')].map((tile) => tile.getBoundingClientRect())
    .map((box) => [Math.round(box.top), Math.round(box.right)])"""
BAR = "(() => { const bar = document.querySelector('nav ul'); return bar.scrollWidth <= bar.clientWidth; })()"
DRAWN = "getComputedStyle(document.querySelector('.plan-map .paths')).display"


@pytest.mark.skipif(browser_path() is None, reason="no browser here")
@pytest.mark.parametrize("width", [390, 768, 1280])
def test_nothing_is_cut_in_a_browser(answer: Evaluation, tmp_path: Path, width: int) -> None:
    """Tables that are wider than a phone say so, tiles leave no hole, paths are drawn when somebody asks for them."""
    (tmp_path / "page.html").write_text(page_of(answer), encoding="utf-8")
    with Browser(tmp_path / "profile") as browser:
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
