"""`docs/examples/team_pictures.py` draws the pictures of robots half as fast, radio, and batteries that are charged."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np

import mrac_jax as mrac

ROOT = Path(__file__).parent.parent
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
