"""What `mrac-jax compare` says: the difference in a sentence, a table, the JSON object."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from analysis.comparison.compare import FIGURES, Comparison, Side
from analysis.kit.face import json_end
from analysis.kit.tables import make_table
from analysis.kit.words import counted
from analysis.statistics.control import Difference
from analysis.statistics.estimate import proportion
from planner.files import Json

SHOWN = {
    "visited": ("visited, %", 100.0),
    "survived": ("survived, %", 100.0),
    "complete": ("chance to visit every cell, %", 100.0),
    "alive": ("robots alive at the end", 1.0),
    "time": ("time, steps", 1.0),
}
"""Name and scale of each figure in the table."""


def headline(answer: Comparison) -> str:
    """The difference in expected visited coverage in one sentence, which says what A and B differ in."""
    if not any(answer.differing):
        return "A and B are the same in everything: no difference (exact)."
    one, other = (f"{name} ({', '.join(words)})" for name, words in zip("AB", answer.differing, strict=True))
    ahead, behind = (f"{100 * count / answer.rollouts:.1f} %" for count in (answer.ahead, answer.behind))
    runs = f"it is ahead in {ahead} of runs, behind in {behind}"
    known = answer.exact_difference("visited")
    if known is not None:
        more = "as much of" if known == 0 else f"{abs(100 * known):.3f} points {_more(known)} of"
        return f"{other} visits {more} the accessible cells {'as' if known == 0 else 'than'} {one} (exact); {runs}."
    estimate = answer.difference("visited").estimate
    low, high = (100 * bound for bound in estimate.ci95)
    if low <= 0 <= high:
        apart = f"B - A = {100 * estimate.mean:.2g} points of coverage ({low:.2g} .. {high:.2g}, 95 %)"
        return f"No difference seen between {one} and {other}: {apart}; {runs.replace('it', 'B', 1)}."
    by = f"{abs(100 * estimate.mean):.2f} points {_more(estimate.mean)} of the accessible cells than {one}"
    return f"{other} visits {by} on average (B - A: {low:.2f} .. {high:.2f}, 95 %); {runs}."


def notes(answer: Comparison) -> list[str]:
    """What else a reader of the difference should know of the two."""
    found = []
    if not answer.same_cells:
        found.append("A and B can reach different cells; coverage is of each one's own")
    if answer.a.choices.loop != answer.b.choices.loop:
        closed, open_ = ("A", "B") if answer.a.choices.loop == "closed" else ("B", "A")
        found.append(
            f"in {closed} the survivors take over the areas of the lost, in {open_} nobody does: the difference is the "
            "loop's too" + (f"; {closed}'s plan alone: --loop open" if len(answer.differing[0]) > 1 else "")
        )
    if len(answer.differing[0]) > 1:
        found.append("A and B differ in more than one thing; the difference is that of all together")
    return found


def _more(value: float) -> str:
    return "more" if value > 0 else "less"


def print_comparison(answer: Comparison, console: Console) -> None:
    """Print the answer, what was compared, and a row for each figure."""
    rate = answer.rollouts / max(answer.seconds, 1e-9)
    lines = [headline(answer), *(f"{name}: {_said(side)}" for name, side in (("A", answer.a), ("B", answer.b)))]
    interrupted = " (interrupted: what was done so far)" if answer.partial else ""
    if answer.certain:
        lines.append("no cell on the way of either is dangerous, so every run is the same and 1 rollout is enough")
    lines.append(
        f"{counted(answer.rollouts, 'rollout')} on common random numbers, seed {answer.a.choices.seed}: "
        f"{rate:,.0f} a second of both{interrupted}"
    )
    lines += [f"note: {note}" for note in notes(answer)]
    for line in lines:
        console.print(line, markup=False, highlight=False)
    console.print(_table(answer))
    console.print(
        "from .. to: 95 % interval of B - A; sharper: variance of the difference on independent runs / on these",
        markup=False,
        highlight=False,
    )


def _said(side: Side) -> str:
    plan, choices = side.plan, side.choices
    made = plan.origin if plan.is_foreign else counted(len(plan.areas), "area")
    loop = f"open loop, {choices.drawn} mode" if choices.loop == "open" else "closed loop"
    first = ", first visits only" if choices.first_only else ""
    by = "" if choices.deadline is None else f", by step {choices.deadline}"
    who = f"{side.world.source}, {counted(len(plan.robots), 'robot')}"
    return f"{who}, {made}, makespan {plan.makespan} steps; {loop}{first}{by}"


def _table(answer: Comparison) -> Table:
    known = {figure: answer.exact_difference(figure) for figure in FIGURES[:2]}
    exactly = any(value is not None for value in known.values())
    title = "; ".join(
        f"{name}: {', '.join(words)}" for name, words in zip("AB", answer.differing, strict=True) if words
    )
    columns = ("", "A", "B", "B - A", "from", "to", *(("exact",) if exactly else ()), "sharper")
    table = make_table(columns, title or None, dropped=("sharper",), padding=(0, 1, 0, 0))
    for figure, (name, scale) in SHOWN.items():
        pairs, apart = answer.pairs[figure], answer.difference(figure)
        sums = ((answer.a, pairs.x), (answer.b, pairs.y))
        means = (scale * side.unit(figure) * total / pairs.rollouts for side, total in sums)
        exact = known.get(figure)
        table.add_row(
            name,
            *(f"{mean:.2f}" for mean in means),
            *(f"{scale * value:+.3f}" for value in (apart.estimate.mean, *apart.estimate.ci95)),
            *(("" if exact is None else f"{scale * exact:+.4f}",) if exactly else ()),
            f"{apart.gain:.2f}" if math.isfinite(apart.gain) else "",
        )
    return table


def comparison_json(answer: Comparison) -> Json:
    """The JSON object of `compare`; coverage and its differences are fractions of the accessible cells."""
    return {
        "answer": headline(answer),
        "a": _side_json(answer, answer.a, "x"),
        "b": _side_json(answer, answer.b, "y"),
        "differing": dict(zip("ab", map(list, answer.differing), strict=True)),
        "rollouts": answer.rollouts,
        "seed": answer.a.choices.seed,
        "certain": answer.certain,
        "difference": {figure: _difference_json(answer.difference(figure)) for figure in FIGURES},
        "exact_difference": {figure: answer.exact_difference(figure) for figure in FIGURES[:2]},
        "b_ahead": proportion(answer.ahead, answer.rollouts, answer.certain).to_json(),
        "b_behind": proportion(answer.behind, answer.rollouts, answer.certain).to_json(),
        "seconds": answer.seconds,
        **json_end(answer),
    }


def _side_json(answer: Comparison, side: Side, which: str) -> Json:
    means = {f: getattr(p, which) / p.rollouts * side.unit(f) for f, p in answer.pairs.items()}
    exact = (
        None
        if side.exact is None
        else dict(zip(FIGURES[:2], (side.unit("visited") * e for e in side.exact), strict=True))
    )
    return {
        "input": side.world.source,
        "robots": len(side.plan.robots),
        "starts": side.plan.starts.tolist(),
        "accessible": side.cells,
        "loop": side.choices.loop,
        "mode": side.choices.drawn,
        "luck": side.choices.luck,
        "threat_checks": "first_visit" if side.choices.first_only else "every_visit",
        "deadline": side.choices.deadline,
        "plan_for": side.plan.plan_for,
        "settings": None if side.plan.settings is None else side.plan.settings.to_json(),
        "mean": means,
        "exact": exact,
    }


def _difference_json(apart: Difference) -> Json:
    return apart.estimate.to_json() | {"gain": apart.gain if math.isfinite(apart.gain) else None}


def rows(answer: Comparison) -> list[tuple[str, str]]:
    """The differences B - A, for a console or a notebook."""
    return [(name, answer.difference(key).estimate.said(scale)) for key, (name, scale) in SHOWN.items()]
