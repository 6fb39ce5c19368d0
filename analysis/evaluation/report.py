"""What `mrac-jax evaluate` says: how much is covered, what it costs, how sure that is; and what its outputs add."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import to_json
from analysis.evaluation.charts import distribution, over_time, over_time_words
from analysis.evaluation.formulas import formulas_part
from analysis.evaluation.rest import Rest, rest_of, rest_words
from analysis.evaluation.table import answer_tables, robots_table, worst_cells
from analysis.evaluation.words import (
    cell_words,
    chance_columns,
    chances_words,
    gain_words,
    headline,
    limit_words,
    losses_words,
    quantile_words,
)
from analysis.kit.folder import json_text
from analysis.kit.words import bearing_words, plan_words, span_words
from analysis.report.blocks import CellMaps, KeyFigure, Part, Pictured, Report
from analysis.report.words import asked, input_name, lost_figure, share_figure
from analysis.statistics.control import complete_chance
from analysis.statistics.estimate import assured
from planner.rollouts.engine import choose_engine
from planner.shown import counted

if TYPE_CHECKING:
    from analysis.page.cell_maps import CellLayer


def report(evaluation: Evaluation, theory: bool = False) -> Report:
    """The answer beside the map and the plan, the figures behind it, then why; `theory`: formulas, unfolded."""
    world, plan, certain, outputs = evaluation.world, evaluation.plan, evaluation.certain, evaluation.blocks
    rest, looked_at = rest_of(world, plan), _looked_at(evaluation)
    own = () if certain else (losses_words(evaluation), chances_words(evaluation), limit_words(evaluation))
    notes = [gain_words(evaluation), quantile_words(evaluation), *(note for found in outputs for note in found.notes)]
    return Report(
        "evaluation", "evaluate", asked(world, len(plan.robots), "how much is covered?"), headline(evaluation),
        lambda: to_json(evaluation),
        findings=[
            *(line for found in outputs for line in found.opens),
            *filter(None, own),
            *(line for found in outputs for line in found.leads),
        ],
        figures=_key_figures(evaluation), picture=lambda: _maps().plan_map(evaluation),
        below=lambda: [chart for found in outputs for chart in found.below],
        parts=[
            Part("Chances and coverage", answer_tables(evaluation), () if certain else list(filter(None, notes))),
            *([] if rest is None else [Part(rest.title, notes=list(rest_words(evaluation, rest)),
                                            drawn=lambda: [_maps().rest_map(evaluation, rest)])]),
            Part("Coverage over time", drawn=lambda: [over_time(evaluation)], lead=over_time_words(evaluation)),
            Part("Single runs", drawn=lambda: distribution(evaluation), lead="How far one run may be from the mean."),
            Part("Cell by cell", notes=() if certain else list(cell_words(evaluation)),
                 drawn=lambda: [_maps().maps(evaluation)], whole=worst_cells(evaluation)),
            Part("Robots", [robots_table(evaluation)], aside=True),
            *([formulas_part(evaluation, theory)] if theory or not certain else []),
        ],
        notes=evaluation.notes,
        warnings=["Interrupted: these are the rollouts that were done until then."] * evaluation.partial,
        settings=looked_at | _settings(evaluation),
        last=_in_lines(evaluation, looked_at),
        pictures=_pictures(evaluation, rest),
        files={"plan.json": lambda: json_text(plan.to_json(), compact=True)},
    )  # fmt: skip


def _looked_at(evaluation: Evaluation) -> dict[str, str]:
    """What was evaluated, and how."""
    cells, plan, tally, world = evaluation.cells, evaluation.plan, evaluation.tally, evaluation.world
    ground = f" ({_area(cells['accessible'] * world.cell_size**2)})" if world.cell_size != 1 else ""
    loop = f"open loop, {evaluation.mode} mode" if evaluation.loop == "open" else "closed loop"
    chosen = choose_engine(evaluation.choices.engine)
    why = f" ({chosen.why})" if evaluation.choices.engine == "auto" and chosen.name == evaluation.engine else ""
    return {
        "map": f"{world.shape[0]} x {world.shape[1]} cells of {world.cell_size:g} m; {cells['free']} free, "
        f"{cells['accessible']} accessible{ground}, {cells['dangerous']} of these dangerous",
        **({} if world.doubt is None else {"in doubt": world.doubt.said}),
        **({"what p means": means} if (means := bearing_words(plan, world)) else {}),
        "plan": f"{plan.origin if plan.is_foreign else plan_words(plan)}, {span_words(plan)}",
        "rollouts": f"{counted(tally.rollouts, 'rollout')}, {loop}, seed {evaluation.seed}, {evaluation.engine}{why}",
    }


def _in_lines(evaluation: Evaluation, looked_at: Mapping[str, str]) -> list[str]:
    """The same for a terminal, and how fast it was."""
    plan, rate = evaluation.plan, evaluation.tally.rollouts / max(evaluation.seconds, 1e-9)
    before = {"map": f"{evaluation.world.source}: ", "in doubt": "in doubt: ", "plan": "plan: " * (not plan.is_foreign)}
    lines = [before.get(name, "") + what for name, what in looked_at.items()]
    return [*lines[:-1], f"{lines[-1]}: {rate:,.0f} a second"]


def _area(square_metres: float) -> str:
    return f"{square_metres:,.0f} m2" if square_metres < 1e6 else f"{square_metres / 1e6:,.0f} km2"


def _settings(evaluation: Evaluation) -> dict[str, object]:
    """What else the figures depend on, and how the map was read and the plan was made."""
    world, plan = evaluation.world, evaluation.plan
    out: dict[str, object] = {"map's name": input_name(world.source), "map's SHA-256": f"{world.sha256[:16]}..."}
    out |= {} if plan.settings is None else plan.settings.shown()
    for found in evaluation.blocks:
        out |= found.settings
    noted = {"how the map was read": world.notes, "how the plan was made": plan.notes}
    return out | {name: "; ".join(notes) for name, notes in noted.items() if notes}


def _key_figures(evaluation: Evaluation) -> list[KeyFigure]:
    """The few to take away."""
    tally, cells = evaluation.tally, evaluation.tally.accessible
    least, (time, steps) = assured(tally.visited), evaluation.time.columns()
    complete, interval = chance_columns(complete_chance(tally, evaluation.certain), tally.rollouts)
    runs = KeyFigure(f"{100 * (least or 0) / cells:.1f} %", "or more in 95 % of runs", "sure with 95 %")
    return [
        share_figure(evaluation.visited, "visited on average", f", of {cells:,} accessible cells"),
        *([] if least is None else [runs]),
        KeyFigure(f"{complete} %", "chance to visit every cell", interval),
        lost_figure(evaluation.losses, len(evaluation.plan.robots)),
        KeyFigure(f"{time} steps", "mean time", steps),
    ]


def _maps() -> ModuleType:
    """What draws maps, which takes matplotlib: for a page and for pictures alone."""
    from analysis.evaluation import maps

    return maps


def _pictures(evaluation: Evaluation, rest: Rest | None) -> Mapping[str, Callable[[], Pictured]]:
    """What draws each picture, by file name."""
    out: dict[str, Callable[[], Pictured]] = {
        "world.png": lambda: _maps().world_figure(evaluation),
        "covered.png": lambda: _maps().covered(evaluation),
        "losses.png": lambda: _maps().losses(evaluation),
        "distribution.png": lambda: distribution(evaluation, picture=True),
        "over_time.png": lambda: [over_time(evaluation)],
    }
    for found in evaluation.blocks:
        for name, make in found.layers.items():
            out[name] = partial(_layer_picture, evaluation, make)
        out |= found.pictures
    return out if rest is None else out | {"rest.png": lambda: _maps().rest_picture(evaluation, rest)}


def _layer_picture(evaluation: Evaluation, make: Callable[[], CellLayer]) -> CellMaps:
    drawn: CellMaps = _maps().with_route(evaluation, make())
    return drawn
