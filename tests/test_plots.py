"""`mrac.plots`: pictures of worlds, plans and answers, which a notebook shows without being told to."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image
from test_analysis_plots import words

import mrac_jax as mrac

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
        "attack_figure": mrac.attack(world, 1, rollouts=256),
        "check_figure": mrac.check(world, 2, rollouts=300),
        "clear_figure": mrac.clear(world, 2, rollouts=256),
        "front_figure": mrac.front(world, 2, rollouts=256),
        "size_figure": mrac.size(world, target=0.5, most=2, rollouts=256),
        "starts_figure": mrac.starts(world, 1, rollouts=256),
    }


def test_the_module_holds_figures_alone() -> None:
    names = dir(mrac.plots)
    assert sorted(mrac.plots.__all__) == names
    for name in names:
        assert name.endswith("_figure")
        assert getattr(mrac.plots, name).__doc__
        assert re.search(rf":members:.*\b{name}\b", REFERENCE), name


def test_a_notebook_shows_every_figure(answers: dict[str, Any]) -> None:
    """IPython asks a cell's last value for `_repr_png_`, whatever backend and settings matplotlib has."""
    shown = {name: getattr(mrac.plots, name)(answer)._repr_png_() for name, answer in answers.items()}
    for name, data in shown.items():
        with Image.open(io.BytesIO(data)) as image:
            assert (image.format, image.width) == ("PNG", 1200), name
    with mpl.rc_context({"font.size": 31}):
        assert mrac.plots.world_figure(answers["world_figure"])._repr_png_() == shown["world_figure"]


def test_worlds_and_plans_are_drawn_without_an_evaluation(world: mrac.World) -> None:
    alone, plan = mrac.plots.world_figure(world), mrac.plan(world, 2)
    assert "23 free cells, 2 threat levels" in words(alone)
    assert not [line for line in alone.axes[0].lines if line.get_gid()]
    planned = mrac.plots.world_figure(world, plan)
    assert "2 robots, 23 accessible cells" in words(planned)
    assert f"makespan {plan.makespan} steps" in words(planned)
    assert [line.get_gid() for line in planned.axes[0].lines if line.get_gid()] == ["robot 0", "robot 1"]
    starting = mrac.plots.world_figure(world.with_starts([[0, 0], [3, 5]]))
    assert "start, by robot" in words(starting)


PLAN_ALONE = re.escape(
    "world_figure(what) is a Plan; expected a World, a World and a Plan, or an Evaluation; "
    "use world_figure(world, plan)"
)
WRONG: dict[str, tuple[Callable[[mrac.World], object], str]] = {
    "plan alone": (lambda world: mrac.plots.world_figure(mrac.plan(world)), "^" + PLAN_ALONE + "$"),
    "count": (lambda world: mrac.plots.world_figure(world, 3), "plan=3; expected a Plan"),
    "other map": (lambda world: mrac.plots.world_figure(world, mrac.plan(mrac.load([[0, 0.1]]))), "for another map"),
    "world": (lambda world: mrac.plots.covered_figure(world), "expected the answer Evaluation"),
    "other answer": (lambda world: mrac.plots.front_figure(mrac.evaluate(world, rollouts=10)), "the answer Front"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_drawn_is_told(name: str, world: mrac.World) -> None:
    call, said = WRONG[name]
    with pytest.raises(mrac.InputError, match=said):
        call(world)
