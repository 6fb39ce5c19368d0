"""Tables on narrow consoles: figures and names stay whole, what is left out is said, the rest stands in blocks."""

from __future__ import annotations

import pytest

from analysis.utils.folder import as_text
from analysis.utils.tables import FittedTable, make_table

COLUMNS = ("place", "bound", "visited, %", "from .. to", "robots lost", "from .. to", "rollouts")
ROW = ("the old depot behind the hall", "1234.5", "91.53", "91.501..91.557", "3.21", "3.1987..3.2213", "1,004,096")


def table(*dropped: str) -> FittedTable:
    made = make_table(COLUMNS, "Places", left=("place",), dropped=dropped)
    made.add_row(*ROW)
    return made


def shown(made: FittedTable, width: int) -> str:
    return as_text(lambda console: console.print(made), width)


@pytest.mark.parametrize("width", [40, 44, 60, 80, 100, 120])
@pytest.mark.parametrize("dropped", [(), ("rollouts", "bound", "from .. to")])
def test_no_figure_is_cut_or_wrapped_and_what_is_left_out_is_named(width: int, dropped: tuple[str, ...]) -> None:
    said = shown(table(*dropped), width)
    body, _, note = " ".join(said.split()).partition("left out, as")
    assert "…" not in said and max(map(len, said.splitlines())) <= width
    for name, cell in list(zip(COLUMNS, ROW, strict=True))[1:]:
        assert (cell in said.split()) != (name in note and cell not in body), (name, said)
    assert all(word in body for word in ROW[0].split())


def test_the_least_important_columns_go_first_and_the_last_of_those_of_a_name() -> None:
    wide = shown(table(), 120).splitlines()
    assert len(wide) == 6 and "left out" not in "".join(wide)
    said = shown(table("rollouts", "from .. to", "bound"), 70)
    gone = "left out, as 70 characters have no room: robots lost from .. to, rollouts; a wider window, --out and --json"
    assert f"{gone} have them" in " ".join(said.split())
    assert ROW[3] in said and ROW[5] not in said and ROW[1] in said


def test_without_columns_to_leave_out_they_stand_in_blocks_that_begin_with_the_name() -> None:
    said = shown(table(), 60)
    assert said.count("place") == said.count("the old depot") > 1
    assert said.count("Places") == 1 and "left out" not in said
