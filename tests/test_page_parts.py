"""What a page is made of: markup that cannot be broken, tables, curves, maps by cell."""

from __future__ import annotations

import base64
import io
import zlib

import numpy as np
import pytest
import quickjs
from page_reader import PNG, Reader, check_page_is_sound
from PIL import Image
from rich.table import Table

from analysis.page.charts import Chart, Series, curves_html, label, ticks
from analysis.page.document import (
    FOLDED_FROM,
    MOST_ROWS,
    TEMPLATES,
    Html,
    TableData,
    asset,
    block,
    from_rich,
    unbroken,
    whole_script,
    with_code,
)
from analysis.page.maps import NOT_FREE, OUT_OF_REACH, STEPS, CellLayer, cell_maps_html
from analysis.pictures.style import COVERED
from analysis.report.html import page_of
from analysis.report.model import KeyFigure, Part, Report
from planner.world.world import World

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
    assert with_code("take `x <4>` & go") == "take <code>x &lt;4&gt;</code> &amp; go"
    assert with_code("an odd ` one") == "an odd ` one"
    assert with_code(Html("<b>`as it is`</b>")) == "<b>`as it is`</b>"


def test_no_line_ends_between_a_number_and_its_unit_or_an_option_and_its_value() -> None:
    """Options keep their plain spaces: they are copied into a shell."""
    tied = {
        "85.73 % ± 0.05 of 3,451 cells": "85.73~%~±~0.05~of 3,451~cells",
        "a 95 % interval, < 0.1 %": "a 95~% interval, <~0.1~%",
        "no number here": "no number here",
    }
    for text, shown in tied.items():
        assert unbroken(text) == shown.replace("~", "\N{NO-BREAK SPACE}")
    assert with_code("lose 0.6: `--policy per_cell --worth 4`") == (
        'lose 0.6: <code><span class="whole">--policy per_cell</span> <span class="whole">--worth 4</span></code>'
    )
    assert with_code("run it: x --seed 1 <") == 'run it: x <span class="whole">--seed 1</span> &lt;'


def test_html_stands_as_it_is_and_data_is_inert() -> None:
    assert TEMPLATES.from_string("{{ a }}{{ b }}{{ c }}").render(a=Html("<b>"), b=3, c=None) == "<b>3"
    inert = block("data", {"name": HOSTILE[0]})
    assert inert.count("<") == 2 and Reader(inert).data() == [{"name": HOSTILE[0]}]


# --- the page ---


def test_a_page_of_hostile_words_is_sound() -> None:
    def made() -> str:
        chart = Chart(HOSTILE[0], (Series(HOSTILE[0], [1, 2], [3, 4], [2, 3], [4, 5]),), HOSTILE[1], HOSTILE[2],
                      unit=HOSTILE[0], at_x=((1.5, HOSTILE[0]),), at_y=((3, HOSTILE[3]),))  # fmt: skip
        table = Table(*HOSTILE, title=HOSTILE[0])
        table.add_row(*HOSTILE)
        settings = dict(zip(HOSTILE, HOSTILE, strict=True))
        parts = [Part(HOSTILE[0], drawn=lambda: [chart]), Part("Tables", [table], HOSTILE, lead=HOSTILE[0])]
        said = Report(HOSTILE[0], HOSTILE[0], HOSTILE[0], HOSTILE[2], dict, HOSTILE, [KeyFigure(*HOSTILE[:3])],
                      parts=parts, notes=HOSTILE, warnings=HOSTILE, settings=settings, heading=HOSTILE)  # fmt: skip
        return page_of(said, HOSTILE[0], dict.fromkeys(HOSTILE, PNG), HOSTILE)

    page = made()
    reader = check_page_is_sound(page)
    assert page == made()
    assert "alert(1)" in reader.text and len(reader.scripts) == 2
    assert len(reader.all("img")) == len(HOSTILE)


def test_an_axis_of_words_has_words() -> None:
    """In its labels, in the table of values and under the pointer."""
    chart = Chart("T", (Series("one", [0, 1], [3, 4]),), "risk", "covered", x_words=("paper", "log"))
    reader = Reader(curves_html(chart))
    assert reader.text.count("paper") == reader.text.count("log") == 2
    assert reader.data()[0]["xWords"] == ["paper", "log"]


def test_sections_without_anything_are_left_out() -> None:
    page = page_of(Report("n", "k", "T", "A.", dict, parts=[Part("One", notes=["x"]), Part("Two")]), "mrac-jax", {}, ())
    headings = [heading for _, heading in check_page_is_sound(page).headings]
    assert headings == ["T", "One", "How to reproduce"]


def test_no_asset_ends_the_element_that_holds_it() -> None:
    assert "</script" not in whole_script() and "</style" not in asset("page.css")


def test_the_script_parses() -> None:
    parse = quickjs.Function("parse", "function parse(text) { new Function(text); }")
    parse(whole_script())
    with pytest.raises(quickjs.JSException, match="SyntaxError"):
        parse(whole_script() + "(")


# --- tables ---


def test_tables_of_the_command_line_keep_words_and_sides() -> None:
    table = Table("", "a [0, 3]", title="T")
    table.columns[1].justify = "right"
    table.add_row("[b]name[/b] :smile:", "1.5 FAILS")
    known = from_rich(table)
    assert known == TableData("T", ("", "a [0, 3]"), (("[b]name[/b] :smile:", "1.5 FAILS"),), frozenset({0}))
    reader = Reader(block("table_of", known))
    assert reader.all("span")[0]["class"] == "verdict fails"
    assert reader.all("td", "number") and not reader.all("details")


def test_long_tables_are_folded_and_cut_with_a_note() -> None:
    rows = tuple((str(number),) for number in range(MOST_ROWS + 5))
    reader = Reader(block("table_of", TableData("T", ("n",), rows)))
    assert len(reader.all("tr")) == MOST_ROWS + 1 and reader.all("details")
    assert f"{MOST_ROWS:,} of {len(rows):,} rows" in reader.text
    assert not Reader(block("table_of", TableData("T", ("n",), rows[:FOLDED_FROM]))).all("details")


# --- curves ---


def test_a_curve_is_drawn_at_its_values() -> None:
    series = (
        Series("a", [0, 5, 10], [0, 50, 100], [0, 40, 90], [10, 60, 100]),
        Series("b", [0, 10], [20, np.nan], kind="points"),
    )
    html = curves_html(Chart("T", series, "robots", "%", unit="%", y_range=(0, 100)))
    reader = Reader(html)
    known = reader.data()[0]
    assert [s["name"] for s in known["series"]] == ["a", "b"]
    assert known["series"][0]["y"] == [0, 50, 100] and known["series"][0]["high"] == [10, 60, 100]
    assert known["series"][1]["x"] == [0]
    paths = {str(attrs.get("class")): str(attrs["d"]) for attrs in reader.all("path")}
    low, high = known["x"]
    at = [1000 * (x - low) / (high - low) for x in (0, 5, 10)]
    drawn = [[float(v) for v in point.split()] for point in paths["line"][1:].split("L")]
    assert np.allclose(drawn, [[at[0], 1000], [at[1], 500], [at[2], 0]], atol=0.1)
    assert "50.0 (40.0 .. 60.0)" in reader.text and "Upright lines: 95 % interval." in reader.text
    assert len(reader.all("button")) == 2


def test_long_curves_are_thinned_and_banded() -> None:
    x = np.arange(100_000)
    html = curves_html(Chart("T", (Series("a", x, x / 2, x / 4, x, kind="step"),), "step", "cells"))
    assert len(html) < 60_000
    known = Reader(html).data()[0]["series"][0]
    assert known["x"][0] == 0 and known["x"][-1] == 99_999 and len(known["x"]) == 400
    assert Reader(html).all("path", "band")


def test_charts_of_one_point_and_of_none() -> None:
    for y in (0.0, 1.0, -3.0):
        assert Reader(curves_html(Chart("T", (Series("a", [4], [y]),), "robots", "%"))).all("path", "dots")
    reader = Reader(
        curves_html(Chart("T", (Series("a", [4], [1]),), "x", "y", at_x=((99, "far"),), at_y=((-9, "low"),)))
    )
    assert not reader.all("path", "mark") and "far" not in reader.text and "low" not in reader.text
    assert curves_html(Chart("T", (Series("a", [], []), Series("b", [1], [np.nan])), "robots", "%")) == ""
    assert curves_html(Chart("T", (), "robots", "%")) == ""


def test_bars_start_at_the_axis() -> None:
    reader = Reader(curves_html(Chart("T", (Series("a", [1, 2, 3], [1, 0, 4], kind="bars"),), "x", "y")))
    path = str(reader.all("path", "bars")[0]["d"])
    assert path.count("Z") == 2 and path.count("M") == 2


def test_ticks() -> None:
    assert ticks(0, 100, 5).tolist() == [0, 20, 40, 60, 80, 100]
    assert ticks(0.2, 3, 9, whole=True).tolist() == [1, 2, 3]
    assert np.allclose(ticks(-0.03, 0.03, 3), [-0.02, 0, 0.02])
    assert [label(x, step) for x, step in ((1500, 500), (0.25, 0.05), (-0.0, 1), (1e-6, 1e-6))] == [
        "1,500", "0.25", "0", "0.000001",
    ]  # fmt: skip


# --- maps by cell ---


def unpacked(layer: dict, shape: tuple[int, int]) -> np.ndarray:
    codes = np.frombuffer(zlib.decompress(base64.b64decode(layer["codes"])), dtype="<u2")
    return codes.reshape(shape)


@pytest.fixture(scope="module")
def cells() -> tuple[np.ndarray, World, np.ndarray]:
    """Chances, a map of 3 x 5, and its cells that can be reached from the lower left."""
    chance = np.linspace(0, 1, 15).reshape(3, 5)
    chance[0, 1], chance[2, 3] = 1e-9, 1 - 1e-9
    threat = np.zeros((3, 5))
    threat[1, 2] = threat[0, 3] = threat[1, 4] = np.nan
    world = World.create(threat, cell_size=0.5)
    accessible = world.free.copy()
    accessible[0, 4] = False
    return chance, world, accessible


def test_a_map_holds_every_cell_the_right_way_up(cells: tuple[np.ndarray, World, np.ndarray]) -> None:
    chance, world, accessible = cells
    layers = [CellLayer("Chance", "about", chance, COVERED, "%", top=1.0), CellLayer("Lost", "", chance * 2, COVERED)]
    reader = Reader(cell_maps_html(layers, world, np.array([[2, 0], [2, 0]])))
    known = reader.data()[0]
    assert known["shape"] == [3, 5] and known["starts"] == [[2, 0], [2, 0]] and known["metres"] == 0.5
    for layer, values in zip(known["layers"], (chance, chance * 2), strict=True):
        codes = unpacked(layer, (3, 5))
        assert codes[1, 2] == NOT_FREE and codes[0, 4] == OUT_OF_REACH
        assert np.allclose((codes / STEPS * layer["largest"])[accessible], values[accessible], atol=2 / STEPS)
        assert codes[0, 0] == 0 and codes[2, 4] == STEPS
    codes = unpacked(known["layers"][0], (3, 5))
    assert codes[0, 1] == 1 and codes[2, 3] == STEPS - 1
    with Image.open(io.BytesIO(base64.b64decode(str(reader.all("img")[0]["src"]).split(",")[1]))) as image:
        assert image.size == (5, 3)
        colours = np.array(image.convert("RGB"))
    assert colours[1, 2].tolist() == [0x3D, 0x43, 0x4C] and colours[0, 4].tolist() == [0xDF, 0xE5, 0xEE]
    assert np.abs(colours[0, 0] / 255 - COVERED(0.0)[:3]).max() < 0.02
    assert np.abs(colours[2, 4] / 255 - COVERED(1.0)[:3]).max() < 0.02
    assert "3 rows and 5 columns" in str(reader.all("img")[0]["alt"])
    assert [name for name in ("robots' starts", "obstacle", "free, out of reach") if name in reader.text] != []


def test_large_maps_come_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.page.maps.MOST_CELLS", 6)
    threat = np.zeros((5, 5))
    threat[1, :2] = np.nan
    world, starts = World.create(threat), np.array([[4, 4]])
    values = np.arange(25.0).reshape(5, 5) / 25
    layers = [CellLayer("Chance", "", values, COVERED, "%"), CellLayer("Lost", "", values, COVERED, blocks="sum")]
    reader = Reader(cell_maps_html(layers, world, starts))
    known = reader.data()[0]
    assert known["side"] == 3 and "blocks of 3 x 3 cells" in reader.text
    mean, lost = (unpacked(layer, (2, 2)) / STEPS * layer["largest"] for layer in known["layers"])
    held = world.free[:3, :3]
    assert np.isclose(mean[0, 0], values[:3, :3][held].mean(), atol=1e-4)
    assert np.allclose(lost, [[values[:3, :3][held].sum(), values[:3, 3:].sum()],
                              [values[3:, :3].sum(), values[3:, 3:].sum()]], atol=1e-3)  # fmt: skip


def test_a_map_of_one_safe_cell() -> None:
    layers = [CellLayer("Lost", "", np.zeros((1, 1)), COVERED, root=True)]
    reader = Reader(cell_maps_html(layers, World.create([[0.0]]), np.array([[0, 0]])))
    assert unpacked(reader.data()[0]["layers"][0], (1, 1)).tolist() == [[0]]
