"""What `mrac-jax compare` says: the difference in a sentence, a row for each figure."""

from __future__ import annotations

import math

from rich.table import Table

from analysis.comparison.compare import FIGURES, OF_HOME, Comparison, Side
from analysis.kit.tables import make_table
from analysis.kit.words import bearing_words, span_words
from analysis.report.answer import json_end
from analysis.report.blocks import KeyFigure, Part, Report
from analysis.statistics.estimate import exactly, proportion
from analysis.statistics.words import between, lost_words, of_all
from planner.files import Json
from planner.pace import UNPACED, Pace
from planner.shown import counted, in_percent, percent, share

SHOWN = {
    "visited": ("visited, %", 100.0),
    "survived": ("survived, %", 100.0),
    "complete": ("chance to visit every cell, %", 100.0),
    "alive": ("robots alive at the end", 1.0),
    "time": ("time, steps", 1.0),
    "home": ("robots home at the end", 1.0),
    "all_home": ("chance that all are home, %", 100.0),
}
"""Name and scale of each figure in the table."""
NARROW = 0.1
"""A share, robots or steps: no wider an interval says too little, however small the figures are."""
COLUMNS = "from .. to: 95 % interval of B - A; sharper: variance of the difference on independent runs / on these"


def report(answer: Comparison) -> Report:
    """How far apart the two are, figure by figure."""
    rate, a, b = answer.rollouts / max(answer.seconds, 1e-9), answer.a, answer.b
    names = dict.fromkeys(side.world.name for side in (a, b))
    certain = "no cell on the way of either is dangerous, so every run is the same and 1 rollout is enough"
    return Report(
        "compare", "compare", f"{' and '.join(names)}: which covers more?",
        headline(answer), lambda: _json(answer), figures=_key_figures(answer),
        heading=(f"A: {_said(a)}", f"B: {_said(b)}", *[certain] * answer.certain,
                 f"{counted(answer.rollouts, 'rollout')} on common random numbers, seed {a.choices.seed}"),
        took=[f"{rate:,.0f} rollouts a second of both"], parts=[Part("Figures", [_table(answer)], [COLUMNS])],
        notes=_notes(answer), warnings=["Interrupted: what was done so far."] * answer.partial,
        pace=_pace(answer),
    )  # fmt: skip


def headline(answer: Comparison) -> str:
    """The difference in expected visited coverage in one sentence, which says what A and B differ in."""
    if not any(answer.differing):
        return "A and B are the same in everything: no difference (exact)."
    one, other = (f"{name} ({', '.join(words)})" for name, words in zip("AB", answer.differing, strict=True))
    runs = f"it is {_often(answer, 'ahead')}, {_often(answer, 'behind')}"
    known = answer.exact_difference("visited")
    if known is not None:
        if known == 0:
            return f"{other} visits exactly as much of the accessible cells as {one}; {runs}."
        by = f"{abs(100 * known):.3f} points (exact) {_more(known)} of the accessible cells than {one}"
        return f"{other} visits {by}; {runs}."
    estimate = answer.difference("visited").estimate
    low, high = (100 * bound for bound in estimate.ci95)
    if low <= 0 <= high:
        apart = f"B - A = {100 * estimate.mean:.2g} points of coverage ({low:.2g} .. {high:.2g}, confidence 0.95)"
        return f"No difference seen between {one} and {other}: {apart}; {runs.replace('it', 'B', 1)}."
    by = f"{abs(100 * estimate.mean):.2f} points {_more(estimate.mean)} of the accessible cells than {one}"
    return f"{other} visits {by} on average (B - A: {low:.2f} .. {high:.2f}, confidence 0.95); {runs}."


def _often(answer: Comparison, which: str) -> str:
    """ "ahead in 91.2 % of runs", "never ahead"."""
    count = getattr(answer, which)
    if count in (0, answer.rollouts):
        return f"{'always' if count else 'never'} {which}"
    return f"{which} in {share(count, answer.rollouts)} of runs"


def _more(value: float) -> str:
    return "more" if value > 0 else "less"


def _notes(answer: Comparison) -> list[str]:
    """What else a reader of the difference should know of the two."""
    found, many = [], len(answer.differing[0]) > 1
    if not answer.same_cells:
        found.append("A and B can reach different cells; coverage is of each one's own")
    if answer.a.choices.loop != answer.b.choices.loop:
        closed, open_ = ("A", "B") if answer.a.choices.loop == "closed" else ("B", "A")
        found.append(
            f"in {closed} the survivors take over the areas of the lost, in {open_} nobody does: the difference is the "
            "loop's too" + (f"; {closed}'s plan alone: --loop open" if many else "")
        )
    for name, side in zip("AB", answer.sides, strict=True):
        if side.comes_home and "home" not in answer.figures:
            mean, every = (answer.mean(side, figure) for figure in OF_HOME)
            said = f"{name}'s robots come home, {lost_words(mean, len(side.plan.robots))}"
            found.append(f"{said}, all of them in {percent(every)} of runs; the other side's need not")
    if vague := [SHOWN[figure][0] for figure in answer.figures if _is_vague(answer, figure)]:
        found.append(f"too few rollouts to compare {', '.join(vague)}: the intervals are wider than the figures")
    if many:
        found.append("A and B differ in more than one thing; the difference is that of all together")
    return found


def _is_vague(answer: Comparison, figure: str) -> bool:
    """Whether the interval of a difference says less than the figures of both sides do."""
    apart = answer.difference(figure).estimate
    low, high = apart.ci95
    largest = max(abs(answer.mean(side, figure)) for side in answer.sides)
    return low < 0 < high and not high - low <= max(largest, NARROW)


def _said(side: Side) -> str:
    plan, choices = side.plan, side.choices
    made = plan.origin if plan.is_foreign else counted(len(plan.areas), "area")
    mode = "" if choices.luck == "tolerance" else f", {choices.drawn} mode"
    loop = f"open loop{mode}" if choices.loop == "open" else "closed loop"
    first = ", first visits only" if choices.first_only else ""
    by = "" if choices.deadline is None else f", by step {choices.deadline}{side.world.pace.also(choices.deadline)}"
    who = f"{side.world.source}, {counted(len(plan.robots), 'robot')}"
    means = bearing_words(plan, side.world)
    return f"{who}, {made}, {span_words(plan, side.world.pace)}; {loop}{first}{by}{'; ' if means else ''}{means}"


def _pace(answer: Comparison) -> Pace:
    """How long a step takes, where it takes as long on both sides."""
    pace = answer.a.world.pace
    return pace if pace == answer.b.world.pace else UNPACED


def _shown(answer: Comparison) -> list[tuple[str, str, float]]:
    """Each row's figure, name and scale."""
    pace = _pace(answer)
    minutes = [("time", "time, minutes", pace.minutes)] * bool(pace)
    return [*((figure, *SHOWN[figure]) for figure in answer.figures), *minutes]


def _key_figures(answer: Comparison) -> list[KeyFigure]:
    out = []
    for figure, name, scale in _shown(answer):
        estimate = answer.difference(figure).estimate
        if figure in FIGURES[:2] and (known := answer.exact_difference(figure)) is not None:
            estimate = exactly(known)
        low, high = (scale * end for end in estimate.ci95)
        interval = "exact" if low == high else between(low, high)
        out.append(KeyFigure(f"{scale * estimate.mean:+.2f}", f"{name}: B - A", interval))
    return out


def _table(answer: Comparison) -> Table:
    known = {figure: answer.exact_difference(figure) for figure in FIGURES[:2]}
    exactly = ["exact"] * any(value is not None for value in known.values())
    differ = zip("AB", answer.differing, strict=True)
    title = "; ".join(f"{name}: {', '.join(words)}" for name, words in differ if words)
    columns = ("", "A", "B", "B - A", "from", "to", *exactly, "sharper")
    table = make_table(columns, title or None, dropped=("sharper",), padding=(0, 1, 0, 0))
    for figure, name, scale in _shown(answer):
        apart, exact = answer.difference(figure), known.get(figure)
        table.add_row(
            name,
            *(_mean(answer, side, figure, scale) for side in answer.sides),
            *(f"{scale * value:+.3f}" for value in (apart.estimate.mean, *apart.estimate.ci95)),
            *("" if exact is None else f"{scale * exact:+.4f}" for _ in exactly),
            f"{apart.gain:.2f}" if math.isfinite(apart.gain) else "",
        )
    return table


def _mean(answer: Comparison, side: Side, figure: str, scale: float) -> str:
    """A side's mean, exact where that is known."""
    mean, known = answer.mean(side, figure), side.exact
    if known is not None and figure in FIGURES[:2]:
        mean = side.unit(figure) * known[FIGURES.index(figure)]
    if scale == 100:
        return in_percent(mean, 2)
    robots = len(side.plan.robots)
    return of_all(mean, robots) if figure in ("alive", "home") else f"{scale * mean:.2f}"


def _json(answer: Comparison) -> Json:
    """Coverage and its differences are fractions of the accessible cells."""
    apart = {figure: answer.difference(figure) for figure in answer.figures}
    return {
        "answer": headline(answer),
        "a": _side_json(answer, answer.a),
        "b": _side_json(answer, answer.b),
        "differing": dict(zip("ab", answer.differing, strict=True)),
        "rollouts": answer.rollouts,
        "seed": answer.a.choices.seed,
        "certain": answer.certain,
        "difference": {figure: found.estimate.to_json() | {"gain": found.gain} for figure, found in apart.items()},
        "exact_difference": {figure: answer.exact_difference(figure) for figure in FIGURES[:2]},
        "b_ahead": proportion(answer.ahead, answer.rollouts, answer.certain),
        "b_behind": proportion(answer.behind, answer.rollouts, answer.certain),
        "seconds": answer.seconds,
        **json_end(answer),
    }


def _side_json(answer: Comparison, side: Side) -> Json:
    plan, choices, exact = side.plan, side.choices, None
    if side.exact is not None:
        exact = {figure: side.unit(figure) * value for figure, value in zip(FIGURES[:2], side.exact, strict=True)}
    return {
        "input": side.world.source,
        "robots": len(plan.robots),
        "starts": plan.starts,
        "accessible": side.cells,
        "loop": choices.loop,
        "mode": choices.drawn,
        "luck": choices.luck,
        "threat_checks": "first_visit" if choices.first_only else "every_visit",
        "deadline": choices.deadline,
        "plan_for": plan.plan_for,
        "settings": plan.settings,
        "mean": {figure: answer.mean(side, figure) for figure in answer.figures_of(side)},
        "exact": exact,
    }
