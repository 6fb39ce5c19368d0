"""What `mrac-jax evaluate` says: how much is covered, what it costs, how sure that is; and what its outputs add."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from analysis.evaluation import maps
from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import to_json
from analysis.evaluation.charts import distribution, over_time, over_time_words
from analysis.evaluation.formulas import formulas_part
from analysis.evaluation.rest import Rest
from analysis.evaluation.table import answer_tables, robots_table, worst_cells
from analysis.evaluation.words import (
    assured_words,
    cell_words,
    chances_words,
    gain_words,
    headline,
    home_words,
    interval_words,
    limit_words,
    losses_words,
    quantile_words,
    rest_words,
)
from analysis.kit.folder import json_text
from analysis.kit.words import plan_words, span_words
from analysis.report.blocks import KeyFigure, Part, Pictured, Report
from analysis.report.words import asked, team_figure
from analysis.statistics.words import in_unit
from analysis.trials.exact_loop import TreeTruth
from planner.shown import counted
from planner.worlds.world import World


def report(evaluation: Evaluation, theory: bool = False) -> Report:
    """The answer beside the map and the plan, the figures behind it, then why; `theory`: formulas, unfolded."""
    world, plan, certain, outputs = evaluation.world, evaluation.plan, evaluation.certain, evaluation.blocks
    rest, looked_at = evaluation.rest, _looked_at(evaluation)
    said = losses_words, chances_words, gain_words, interval_words, quantile_words
    own = () if certain else (*(say(evaluation) for say in said), *(note for found in outputs for note in found.notes))
    home, limit = ("", "") if certain else (home_words(evaluation), limit_words(evaluation))
    return Report(
        "evaluation", "evaluate", asked(world, len(plan.robots), "how much is covered?"), headline(evaluation),
        lambda: to_json(evaluation),
        findings=[
            *filter(None, (*(line for found in outputs for line in found.opens), home)),
            *(line for found in outputs for line in found.alternatives),
            *filter(None, (limit, *(line for found in outputs for line in found.leads))),
        ],
        figures=_key_figures(evaluation), picture=lambda: maps.plan_map(evaluation),
        below=lambda: [chart for found in outputs for chart in found.below],
        parts=[
            Part("Chances and coverage", answer_tables(evaluation), list(filter(None, own))),
            *([] if rest is None else [Part(rest.title, notes=list(rest_words(evaluation, rest)),
                                            drawn=lambda: [maps.rest_map(evaluation, rest)])]),
            Part("Coverage over time", drawn=lambda: [over_time(evaluation)], lead=over_time_words(evaluation)),
            Part("Single runs", drawn=lambda: distribution(evaluation), lead="How far one run may be from the mean."),
            Part("Cell by cell", notes=() if certain else list(cell_words(evaluation)),
                 drawn=lambda: [maps.maps(evaluation)], whole=worst_cells(evaluation)),
            Part("Robots", [robots_table(evaluation)], aside=True),
            *([formulas_part(evaluation, theory)] if theory or not certain else []),
        ],
        notes=evaluation.notes,
        warnings=["Interrupted: this is what was done until then."] * evaluation.partial,
        settings=looked_at | _settings(evaluation),
        last=_in_lines(evaluation, looked_at),
        pictures=_pictures(evaluation, rest),
        files={"plan.json": lambda: json_text(plan.to_json(), compact=True)}
        | {name: make for found in outputs for name, make in found.files.items()},
        pace=world.pace,
    )  # fmt: skip


def _looked_at(evaluation: Evaluation) -> dict[str, str]:
    """What was evaluated, and how."""
    cells, plan, tally, world = evaluation.cells, evaluation.plan, evaluation.tally, evaluation.world
    ground = f" ({_area(cells['accessible'] * world.cell_size**2)})" if world.cell_size != 1 else ""
    loop = f"open loop, {evaluation.mode} mode" if evaluation.loop == "open" else "closed loop"
    tree = evaluation.closed.tree if isinstance(evaluation.closed, TreeTruth) else None
    whole = ""
    if tree is not None:
        whole = f"exact: all that can happen, {counted(tree.histories, 'branch', 'branches')}; and "
    return {
        "map": f"{world.shape[0]} x {world.shape[1]} cells of {world.cell_size:g} m; {cells['free']} free, "
        f"{cells['accessible']} accessible{ground}, {cells['dangerous']} of these dangerous",
        **({} if world.doubt is None else {_of_doubt(world): world.doubt.said}),
        **({} if world.knowledge is None else {"told": world.knowledge.said}),
        **({"what p means": evaluation.p_means} if evaluation.p_means else {}),
        "plan": f"{plan.origin if plan.is_foreign else plan_words(plan)}, {span_words(plan, world.pace)}"
        + ("" if world.knowledge is None else ", as the robots believe the map"),
        "rollouts": f"{whole}{counted(tally.rollouts, 'rollout')}, {loop}, seed {evaluation.seed}, "
        f"{evaluation.engine_said}",
    }


def _of_doubt(world: World) -> str:
    """What `World.doubt` is called."""
    return "movers" if world.movers else "phases" if world.phases else "in doubt"


def _in_lines(evaluation: Evaluation, looked_at: Mapping[str, str]) -> list[str]:
    """The same for a terminal, and how fast rollouts were, if there is more than one to tell."""
    plan, rate = evaluation.plan, evaluation.tally.rollouts / max(evaluation.seconds, 1e-9)
    before = {"map": f"{evaluation.world.source}: ", "in doubt": "in doubt: ", "plan": "plan: " * (not plan.is_foreign)}
    lines = [before.get(name, "") + what for name, what in looked_at.items()]
    return lines if evaluation.certain else [*lines[:-1], f"{lines[-1]}: {rate:,.0f} a second"]


def _area(square_metres: float) -> str:
    return f"{square_metres:,.0f} m2" if square_metres < 1e6 else f"{square_metres / 1e6:,.0f} km2"


def _settings(evaluation: Evaluation) -> dict[str, object]:
    """What else the figures depend on, and how the map was read and the plan was made."""
    world, plan = evaluation.world, evaluation.plan
    out: dict[str, object] = {"map's name": world.name, "map's SHA-256": f"{world.sha256[:16]}..."}
    out |= {} if plan.settings is None else plan.settings.shown(world.pace)
    for found in evaluation.blocks:
        out |= found.settings
    noted = {"how the map was read": world.notes, "how the plan was made": plan.notes}
    return out | {name: "; ".join(notes) for name, notes in noted.items() if notes}


def _key_figures(evaluation: Evaluation) -> list[KeyFigure]:
    """The few to take away."""
    found, cells, seen = evaluation.shown, evaluation.tally.accessible, evaluation.visited
    visited, between = seen.columns(100.0, 100)
    (complete, likely), (time, steps) = found.complete.columns(), evaluation.time.columns()
    sure = "with 95 % confidence" if found.visited.known is None else "exact"
    runs = KeyFigure(assured_words(evaluation), "reached in 19 of 20 runs", sure)
    return [
        KeyFigure(f"{visited} %", "visited on average", f"{in_unit(between)}, of {cells:,} accessible cells"),
        *([] if found.assured is None else [runs]),
        KeyFigure(f"{complete} %", "chance to visit every cell", in_unit(likely)),
        team_figure(evaluation.losses, evaluation.losses.robots),
        *([] if found.home is None else [team_figure(found.home, found.home.robots, "robots home at the end")]),
        KeyFigure(
            f"{time} step{'s' * (time != '1')}", "mean time", steps + evaluation.world.pace.also(evaluation.time.mean)
        ),
    ]


def _pictures(evaluation: Evaluation, rest: Rest | None) -> Mapping[str, Callable[[], Pictured]]:
    """What draws each picture, by file name."""
    out: dict[str, Callable[[], Pictured]] = {
        "world.png": lambda: maps.world_drawn(evaluation),
        "covered.png": lambda: maps.covered(evaluation),
        "losses.png": lambda: maps.losses(evaluation),
        "distribution.png": lambda: distribution(evaluation, picture=True),
        "over_time.png": lambda: [over_time(evaluation)],
    }
    for found in evaluation.blocks:
        for name, make in found.layers.items():
            out[name] = partial(maps.with_route, evaluation, make)
        out |= found.pictures
    return out if rest is None else out | {"rest.png": lambda: maps.rest_picture(evaluation, rest)}
