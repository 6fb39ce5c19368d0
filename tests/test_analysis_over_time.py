"""The band of coverage over time: the quantiles of the rollouts that were run, each cut off at each step."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import FOLDER

from analysis.evaluation.charts import over_time
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.outputs.over_time import BAND_LEAST, BAND_MOST, SHARE, STEPS, Band
from analysis.page.charts import curves_html
from analysis.sampling import RolloutChoices, make_roll_out
from analysis.statistics.estimates import QUANTILES, quantile
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan, RobotPlan
from planner.settings import Settings
from planner.tally import Tally
from planner.world.levels import place_starts
from planner.world.world import World, load_world_file

CHOICES = [
    RolloutChoices(loop="closed", rollouts=120),
    RolloutChoices(loop="closed", rollouts=120, first_only=True, seed=5),
    RolloutChoices(loop="open", rollouts=120),
    RolloutChoices(loop="open", rollouts=120, seed=5, deadline=30),
]


@pytest.fixture(scope="module")
def world() -> World:
    return load_world_file(FOLDER / "contiguous-14x23-1000.npz")


@pytest.fixture(scope="module")
def plan(world: World) -> Plan:
    return make_plan(world, place_starts(world, 3)[0])


def tally_of(world: World, plan: Plan, choices: RolloutChoices, until: int | None = None) -> Tally:
    return list(make_roll_out(world, plan, choices)(choices, until))[-1].tally


def band_of(world: World, plan: Plan, choices: RolloutChoices) -> Band:
    found = evaluate(world, plan, choices, band=True).outputs.get("band")
    assert found is not None
    return found


@pytest.mark.parametrize("choices", CHOICES, ids=lambda choices: f"{choices.loop}-{choices.seed}")
def test_the_band_is_that_of_the_same_ids_cut_off_at_every_step(
    world: World, plan: Plan, choices: RolloutChoices
) -> None:
    """Brute force: the first ids again for every step of the band, by the engines, and the quantiles of their tally."""
    band = band_of(world, plan, choices)
    assert band.rollouts == BAND_LEAST
    roll_out, few = make_roll_out(world, plan, choices), replace(choices, rollouts=BAND_LEAST)
    for place in [*range(0, len(band.steps), 7), len(band.steps) - 1]:
        cut = list(roll_out(few, int(band.steps[place])))[-1].tally
        shown = tuple(int(values[place]) for values in (band.low, band.median, band.high))
        assert shown == tuple(quantile(cut.visited, q) for q in QUANTILES), f"step {band.steps[place]}"


def test_the_band_of_robots_that_wear_is_that_of_robots_that_wear(world: World) -> None:
    plan = make_plan(world, place_starts(world, 3)[0], Settings(wear=3.0, susceptibility=(1.0, 4.0, 0.5)))
    choices = RolloutChoices(loop="open", rollouts=120)
    band, roll_out = band_of(world, plan, choices), make_roll_out(world, plan, choices)
    for place in range(0, len(band.steps), 25):
        cut = list(roll_out(replace(choices, rollouts=BAND_LEAST), int(band.steps[place])))[-1].tally
        shown = tuple(int(values[place]) for values in (band.low, band.median, band.high))
        assert shown == tuple(quantile(cut.visited, q) for q in QUANTILES)


def test_every_step_of_a_short_run_is_looked_at_and_the_end_of_the_longest(world: World, plan: Plan) -> None:
    choices = RolloutChoices(rollouts=300, deadline=1000)
    tally = tally_of(world, plan, choices)
    band = band_of(world, plan, choices)
    assert {0, 1000, int(np.flatnonzero(tally.time).max())} <= set(band.steps.tolist())
    assert len(band.steps) <= STEPS + 2
    end = [int(values[-1]) for values in (band.low, band.median, band.high)]
    few = tally_of(world, plan, replace(choices, rollouts=band.rollouts))
    assert end == [quantile(few.visited, q) for q in QUANTILES]


def test_no_more_rollouts_than_were_asked_for_and_few_of_many(world: World, plan: Plan) -> None:
    """Counted where they are run: the calls of the compiled simulator."""
    for asked, again in ((1, 1), (60, 60), (500, BAND_LEAST), (3000, 3000 // SHARE), (100_000, BAND_MOST)):
        choices = RolloutChoices(loop="open", rollouts=asked)
        assert band_of(world, plan, choices).rollouts == again


def test_other_planners_paths_that_wait_and_cross_have_a_band(world: World) -> None:
    free = np.flatnonzero(world.free)
    start = next(int(cell) for cell in free if world.free.flat[cell + 1])
    walk = np.array([start, start, start + 1, start, start, start + 1])
    plan = Plan(shape=world.shape, sha256="", settings=None, areas=(), areas_added=(), robots=(RobotPlan(walk),) * 2)
    choices = RolloutChoices(loop="open", rollouts=50)
    band = band_of(world, plan, choices)
    assert band.steps.tolist() == list(range(6))
    assert band.median.tolist()[:2] == [1, 1]
    assert band.high[-1] == 2


def test_the_evaluation_s_band_is_the_same_for_the_same_seed_and_every_chunk(world: World, plan: Plan) -> None:
    bands = [band_of(world, plan, RolloutChoices(rollouts=2000)) for _ in range(2)]
    for name in ("steps", "low", "median", "high", "rollouts"):
        assert np.array_equal(getattr(bands[0], name), getattr(bands[1], name))
    assert bands[0].rollouts == 200


@pytest.mark.parametrize("loop", ["open", "closed"])
def test_the_page_s_table_shows_the_band_only_where_it_was_looked_at(world: World, loop: str) -> None:
    """1 robot takes some hundred steps: more than are looked at."""
    plan = make_plan(world, place_starts(world, 1)[0])
    choices = RolloutChoices(loop=loop, rollouts=100)  # type: ignore[arg-type]
    answer = evaluate(world, plan, choices, band=True)
    band = answer.outputs.get("band")
    assert band is not None
    assert len(band.steps) < band.steps[-1]
    rows = re.findall(r"<tr>(.*?)</tr>", curves_html(over_time(answer)), re.DOTALL)
    table = [
        [html.unescape(cell).replace("\xa0", " ") for cell in re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row)]
        for row in rows
    ]
    name = next(place for place, words in enumerate(table[0]) if words.startswith("median of 100 rollouts"))
    cells = answer.tally.accessible
    said = {}
    for step, low, middle, high in zip(
        *map(np.ndarray.tolist, (band.steps, band.low, band.median, band.high)), strict=True
    ):
        lowest, median, highest = (f"{100 * value / cells:,.1f}" for value in (low, middle, high))
        said[f"{step:,}"] = median if low == high else f"{median} ({lowest} .. {highest})"
    assert len(table) > 30
    for row in table[1:]:
        assert row[name] == said[row[0]]
