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

from analysis.page.cell_maps import NOT_FREE, OUT_OF_REACH, STEPS, CellLayer, cell_maps_html
from analysis.page.curves import Chart, Series, curves_html
from analysis.page.document import Page, Section, asset, whole_script
from analysis.page.markup import Html, data, element, escape
from analysis.page.parts import answer_page, noted_tables
from analysis.page.tables import FOLDED_FROM, MOST_ROWS, TableData, from_rich, printed, table_html
from analysis.page.ticks import label, ticks
from analysis.pictures.style import COVERED

HOSTILE = (
    "</script><script>alert(1)</script><!--<img src=x onerror=alert(2)>\"'&amp;[bold]`${1}`",
    "javascript:alert(1)",
    "a\u202eb\x00c\udc80d\x1b[31m\u2028",
    "../../etc/passwd //host/x\\y",
)


# --- markup ---


@pytest.mark.parametrize("text", HOSTILE)
def test_text_is_shown_and_never_obeyed(text: str) -> None:
    reader = Reader(element("p", text, title=text))
    assert [tag for tag, _ in reader.tags] == ["p"]
    assert reader.text == reader.tags[0][1]["title"]
    hidden = {"\u202e": "\\u202e", "\x00": "\\x00", "\udc80": "\\udc80", "\x1b": "\\x1b"}
    for letter, shown in hidden.items():
        text = text.replace(letter, shown)
    assert reader.text.replace("\\u2028", "\u2028") == text


def test_markup() -> None:
    assert element("br") == "<br>"
    assert element("a", "x", element("b", "<"), None, href="#y", hidden=True, id=None, open=False, class_="c") == (
        '<a href="#y" hidden class="c">x<b>&lt;</b></a>'
    )
    assert element("p", aria_label='"') == '<p aria-label="&quot;"></p>'
    assert escape(Html("<b>")) == "<b>" and escape(3) == "3"
    inert = data({"name": HOSTILE[0]})
    assert inert.count("<") == 2 and Reader(inert).data() == [{"name": HOSTILE[0]}]


# --- the page ---


def test_a_page_of_hostile_words_is_sound() -> None:
    def made() -> str:
        chart = Chart(HOSTILE[0], (Series(HOSTILE[0], [1, 2], [3, 4], [2, 3], [4, 5]),), HOSTILE[1], HOSTILE[2],
                      unit=HOSTILE[0], at_x=((1.5, HOSTILE[0]),), at_y=((3, HOSTILE[3]),))  # fmt: skip
        table = TableData(HOSTILE[0], HOSTILE, (HOSTILE, HOSTILE), notes=HOSTILE)
        settings = dict(zip(HOSTILE, HOSTILE, strict=True))
        pictures = dict.fromkeys(HOSTILE, PNG)
        sections = [Section(HOSTILE[0], curves_html(chart)), Section("Tables", noted_tables([table], HOSTILE))]
        return answer_page(HOSTILE[0], HOSTILE[2], sections, HOSTILE[0], pictures, HOSTILE,
                           kind=HOSTILE[0], findings=HOSTILE, settings=settings, warnings=HOSTILE)  # fmt: skip

    page = made()
    reader = check_page_is_sound(page)
    assert page == made()
    assert "alert(1)" in reader.text and len(reader.scripts) == 2
    assert len(reader.all("img")) == len(HOSTILE)


def test_sections_without_anything_are_left_out() -> None:
    page = Page("T", "A.", (Section("One", element("p", "x")), Section("Two", Html())))
    reader = check_page_is_sound(page.html())
    assert [heading for _, heading in reader.headings] == ["T", "One"]
    check_page_is_sound(answer_page("T", "A.", [], "mrac-jax", {}, [], kind="k", findings=[], settings={}))


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
    lines, tables = printed(lambda console: (console.print("words", markup=False), console.print(table)))
    assert lines == ["words"]
    assert tables == [from_rich(table)]
    assert tables[0] == TableData("T", ("", "a [0, 3]"), (("[b]name[/b] :smile:", "1.5 FAILS"),), frozenset({0}))
    reader = Reader(table_html(tables[0]))
    assert reader.all("span")[0]["class"] == "verdict fails"
    assert reader.all("td", "number") and not reader.all("details")


def test_long_tables_are_folded_and_cut_with_a_note() -> None:
    rows = tuple((str(number),) for number in range(MOST_ROWS + 5))
    reader = Reader(table_html(TableData("T", ("n",), rows)))
    assert len(reader.all("tr")) == MOST_ROWS + 1 and reader.all("details")
    assert f"{MOST_ROWS:,} of {len(rows):,} rows" in reader.text
    assert not Reader(table_html(TableData("T", ("n",), rows[:FOLDED_FROM]))).all("details")


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
def cells() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chances, free and accessible cells of a map of 3 x 5."""
    chance = np.linspace(0, 1, 15).reshape(3, 5)
    chance[0, 1], chance[2, 3] = 1e-9, 1 - 1e-9
    free, accessible = np.ones((3, 5), dtype=bool), np.ones((3, 5), dtype=bool)
    free[1, 2] = accessible[1, 2] = accessible[0, 4] = False
    return chance, free, accessible


def test_a_map_holds_every_cell_the_right_way_up(cells: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    chance, free, accessible = cells
    layers = [CellLayer("Chance", "about", chance, COVERED, "%", top=1.0), CellLayer("Lost", "", chance * 2, COVERED)]
    reader = Reader(cell_maps_html(layers, free, accessible, np.array([[2, 0], [2, 0]]), 0.5))
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
    monkeypatch.setattr("analysis.page.cell_maps.MOST_CELLS", 6)
    free = np.ones((5, 5), dtype=bool)
    free[:2, :2] = False
    free[0, 0] = True
    values = np.arange(25.0).reshape(5, 5) / 25
    layers = [CellLayer("Chance", "", values, COVERED, "%"), CellLayer("Lost", "", values, COVERED, blocks="sum")]
    reader = Reader(cell_maps_html(layers, free, free))
    known = reader.data()[0]
    assert known["side"] == 3 and "blocks of 3 x 3 cells" in reader.text
    mean, lost = (unpacked(layer, (2, 2)) / STEPS * layer["largest"] for layer in known["layers"])
    held = free[:3, :3]
    assert np.isclose(mean[0, 0], values[:3, :3][held].mean(), atol=1e-4)
    assert np.allclose(lost, [[values[:3, :3][held].sum(), values[:3, 3:].sum()],
                              [values[3:, :3].sum(), values[3:, 3:].sum()]], atol=1e-3)  # fmt: skip


def test_maps_of_nothing() -> None:
    safe = np.zeros((1, 1))
    reader = Reader(cell_maps_html([CellLayer("Lost", "", safe, COVERED, root=True)], safe == 0, safe == 0))
    assert unpacked(reader.data()[0]["layers"][0], (1, 1)).tolist() == [[0]]
    none = safe > 0
    assert Reader(cell_maps_html([CellLayer("Lost", "", safe, COVERED)], none, none)).data()
