"""What `mrac.judge` says: what the policy covers, its score, and the planner's policies on common random numbers."""

from __future__ import annotations

from analysis.judging.judge import Judged
from analysis.kit.tables import make_table
from analysis.kit.words import without_level
from analysis.report.answer import json_end
from analysis.report.blocks import KeyFigure, Part, Report
from analysis.report.words import asked, map_words, share_figure
from planner.files import Json
from planner.shown import ceiled, counted, percent


def report(judged: Judged) -> Report:
    """What the policy is worth, between a random walk, or random areas, and the bound."""
    robots = len(judged.starts)
    score = [] if judged.score is None else [KeyFigure(judged.score.columns(100.0)[0] + " %", "score")]
    table = make_table(("", "visited, %", "from .. to", "lost", "policy ahead, points"))
    table.add_row("the policy", *judged.coverage.columns(100.0, 100), judged.losses.columns()[0], "")
    for name, plan in judged.plans.items():
        ahead = plan.ahead.said(100)
        table.add_row(name, *plan.coverage.columns(100.0, 100), plan.losses.columns()[0], ahead)
    table.add_row(judged.walk, *judged.random.columns(100.0, 100), "", "")
    table.add_row("no strategy exceeds", ceiled(judged.bound, unit=""), "proven", "", "")
    score_is = f"score: (policy - {judged.walk}) / (bound - {judged.walk})"
    note = f"{score_is}; all on common random numbers, ended at the same step"
    level = "± half the 95 % interval, in brackets its ends"
    return Report(
        "policy", "judge", asked(judged.world, robots, "what is the policy worth?"), headline(judged),
        lambda: _json(judged), figures=[share_figure(judged.coverage, "visited on average"), *score],
        heading=(map_words(judged.world, judged.cells, robots),
                 f"{counted(judged.choices.rollouts, 'rollout')}, seed {judged.choices.seed}, at most "
                 f"{judged.world.pace.steps(judged.max_steps)}"),
        parts=[Part("Common random numbers", [table], [note, level])], pace=judged.world.pace,
    )  # fmt: skip


def headline(judged: Judged) -> str:
    """The policy's coverage, the best of the planner's, and the bound."""
    best = max(judged.plans.items(), key=lambda item: item[1].coverage.mean, default=None)
    beside = "" if best is None else f"; `{best[0]}`: {percent(best[1].coverage.mean)}"
    said = "a random walk" if judged.walk == "random walk" else judged.walk
    walk, bound, covers = percent(judged.random.mean), ceiled(judged.bound, 1), judged.coverage.said(100, " %")
    return f"It covers {without_level(covers)}{beside}; {said}: {walk}, no strategy more than {bound}."


def _json(judged: Judged) -> Json:
    """Coverage: fractions of the accessible cells."""
    return {
        "answer": headline(judged),
        "robots": len(judged.starts),
        "starts": judged.starts,
        "accessible": judged.cells,
        "rollouts": judged.choices.rollouts,
        "seed": judged.choices.seed,
        "max_steps": judged.max_steps,
        "coverage": judged.coverage,
        "losses": judged.losses,
        "steps": judged.steps,
        "random": judged.random,
        "bound": judged.bound,
        "score": judged.score,
        "plans": {
            name: {"coverage": plan.coverage, "losses": plan.losses, "ahead": plan.ahead}
            for name, plan in judged.plans.items()
        },
        **json_end(judged),
    }
