"""What an evaluation says in whole sentences: losses, time, and how the paper's formulas do."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.kit.words import bearing_words, plan_words, share, span_words
from analysis.statistics.coverage import losses_shown
from analysis.statistics.estimate import Estimate, assured, proportion, quantiles
from analysis.statistics.words import between, lost_words
from analysis.theory.formulas import FORMULAS
from analysis.theory.reachable import moves_left
from analysis.theory.verdicts import Check, Verdict, overall
from planner.rollouts.engine import choose_engine
from planner.shown import counted
from planner.tally import Outcome

FORMULA_WORDS = {
    Verdict.HOLDS: ("holds", "hold"),
    Verdict.FAILS: ("fails", "fail"),
    Verdict.UNDECIDED: ("is undecided", "are undecided"),
    Verdict.VACUOUS: ("says nothing", "say nothing"),
}
MOST_DIGITS = 4
QUANTILE_NAMES = {0.05: "5 %", 0.5: "median", 0.95: "95 %"}


def sampled_share(count: int, runs: int) -> str:
    """`count` of `runs` in percent, with the decimals that the 95 % interval bears out; never rounded to 0 or 100.

    A share that these decimals cannot tell from 0 or 100 gets more of them, up to MOST_DIGITS, then "> 99.9999 %".
    """
    half = 100.0 * proportion(count, runs).half_width
    digits = int(np.clip(math.ceil(-math.log10(half)), 0, MOST_DIGITS))
    while digits < MOST_DIGITS and share(count, runs, digits)[0] in "<>":
        digits += 1
    return share(count, runs, digits)


def chance_columns(chance: Estimate, runs: int) -> tuple[str, str]:
    """A chance in percent, and its interval: ("0.3", "0.0 .. 0.9"), or ("0", "0.4 or less") where none was seen."""
    count = round(chance.mean * runs)
    seen = sampled_share(count, runs).removesuffix(" %")
    if chance.half_width == 0:
        return seen, "exact"
    digits = max(chance.digits(100.0), len(seen.partition(".")[2]))
    low, high = between(100.0 * chance.ci95[0], 100.0 * chance.ci95[1], digits).split(" .. ")
    return seen, f"{high} or less" if count == 0 else f"{low} or more" if count == runs else f"{low} .. {high}"


def losses_words(evaluation: Evaluation) -> str:
    """How many robots are lost, and how often all or none are, as the tally says it, in one sentence.

    The more frequent of "all" and "none" leads; what was never seen is not claimed to be impossible. "No robot can be
    lost" is said where the plan meets no danger: then nobody ever leaves the nominal run, in either loop. From a state
    it is about the robots that are left, and a second sentence says how many were lost before.
    """
    gone = 0 if evaluation.plan.state is None else evaluation.plan.state.lost
    said = _losses(evaluation, len(evaluation.plan.robots) - gone, bool(gone))
    return f"{said} {counted(gone, 'robot')} {'was' if gone == 1 else 'were'} lost before." if gone else said


def _losses(evaluation: Evaluation, robots: int, some_before: bool) -> str:
    """Of the robots that were there when the runs began."""
    tally = evaluation.tally
    runs, every, none = tally.rollouts, int(tally.alive[0]), int(tally.alive[robots])
    left = (" that was left" if robots == 1 else " that were left") if some_before else ""
    nobody = "no further robot is" if some_before else "no robot is"
    if evaluation.closed_form.expected_losses == 0:
        return f"{nobody[:1].upper()}{nobody[1:-3]} can be lost."
    if runs == 0:
        return "How many robots are lost is not known: no run was done."
    all_of_them = f"All {robots} robots{left} are"
    if robots <= 2:
        all_of_them = f"The robot{left} is" if robots == 1 else f"Both robots{left} are"
    if every == runs:
        return f"{all_of_them} lost in {_each(runs)}."
    if none == runs:
        return f"{nobody[:1].upper()}{nobody[1:]} lost in {_any(runs)}."
    lost_before, digits = len(evaluation.plan.robots) - robots, min(evaluation.losses.digits(), 2)
    mean = f"on average {lost_words(evaluation.losses.mean - lost_before, robots, digits)}{left}"
    often = {all_of_them: every, nobody: none}
    if robots == 1:
        return f"{all_of_them} lost in {sampled_share(every, runs)} of runs."
    if every == none == 0:
        seen = np.flatnonzero(tally.alive)
        least, most = robots - int(seen.max()), robots - int(seen.min())
        some = f"{counted(least, 'robot')}" if least == most else f"{least} to {most} robots"
        return f"{some} of {robots}{left} {'is' if most == 1 else 'are'} lost in {_each(runs)}, {mean}."
    (first, number), *rest = sorted(often.items(), key=lambda item: -item[1])
    said = f"{first} lost in {sampled_share(number, runs)} of runs"
    said += "".join(f", {other[0].lower()}{other[1:]} in {sampled_share(rare, runs)}" for other, rare in rest if rare)
    return f"{said[0].upper()}{said[1:]}; {mean}."


def chances_words(evaluation: Evaluation) -> str:
    """How often every cell is visited, and how long a run takes, in one sentence."""
    tally = evaluation.tally
    if not tally.rollouts:
        return ""
    done, runs = int(tally.outcomes[Outcome.COMPLETE]), tally.rollouts
    where = {0: _none(runs), runs: _each(runs)}.get(done) or f"{sampled_share(done, runs)} of runs"
    time = f"a run takes {evaluation.time.mean:,.0f} steps on average"
    return f"Every accessible cell is visited in {where}; {time}."


def limit_words(evaluation: Evaluation) -> str:
    """What no strategy exceeds on average on this map, where that is proven and not plain; else nothing."""
    limit = evaluation.bounds.any_strategy
    if limit is None or limit.cells > evaluation.tally.accessible - 0.005:
        return ""
    most = math.ceil(10_000 * limit.mean) / 100
    return f"No strategy visits more than {most:.2f} % on average with this team on this map ({proven(evaluation)})."


def proven(evaluation: Evaluation) -> str:
    """That the bound for every strategy is, and what it does not know of what was asked."""
    unknown = []
    if moves_left(evaluation.plan) is not None:
        unknown.append("of the range it knows only which cells are too far")
    if evaluation.choices.deadline is not None:
        unknown.append("it does not know the deadline")
    return "; ".join(["proven", *unknown])


def _each(runs: int) -> str:
    return "the one run that was done" if runs == 1 else f"each of the {runs:,} runs"


def _any(runs: int) -> str:
    return _each(runs) if runs == 1 else f"any of the {runs:,} runs"


def _none(runs: int) -> str:
    return "no run of the one that was done" if runs == 1 else f"none of the {runs:,} runs"


def formula_counts(evaluation: Evaluation) -> dict[Verdict, int]:
    """How many of the paper's formulas, every reading counted, have each verdict against the open loop."""
    judged = [
        overall(check for check in evaluation.checks if check.formula == key) for key in FORMULAS if FORMULAS[key].paper
    ]
    return {verdict: judged.count(verdict) for verdict in FORMULA_WORDS}


def formulas_words(evaluation: Evaluation) -> str:
    """One line: how many of the paper's formulas hold on this plan and how many fail."""
    if not evaluation.settled:
        return (
            "No formula and no bound of the paper is given: they presume one known map, each of whose visits stops a "
            "robot with the cell's p, whatever came before"
        )
    if evaluation.plan.state is not None:
        return "The paper's formulas are left out: they are about whole missions, this is the rest of one"
    counts = formula_counts(evaluation)
    said = [
        f"{number} {FORMULA_WORDS[verdict][number != 1]}"
        for verdict, number in counts.items()
        if number or verdict in (Verdict.HOLDS, Verdict.FAILS)
    ]
    return f"Of the paper's {sum(counts.values())} formulas for the open loop, every reading counted, {', '.join(said)}"


def headline(evaluation: Evaluation) -> str:
    """The answer in one sentence. What 95 % of runs reach is sure with 95 %, or left out."""
    tally, robots = evaluation.tally, len(evaluation.plan.robots)
    if evaluation.certain:
        return certain_headline(evaluation)
    shown = evaluation.visited.said(100.0, " %") + " of the accessible cells on average"
    who, least = counted(robots, "robot visits", "robots visit"), assured(tally.visited)
    runs = "" if least is None else f", and at least {100.0 * least / tally.accessible:.1f} % in 95 % of runs"
    return f"{who} {shown}{runs}."


def _heading(evaluation: Evaluation) -> list[str]:
    cells, plan, tally, world = evaluation.cells, evaluation.plan, evaluation.tally, evaluation.world
    ground = f" ({_area(cells['accessible'] * world.cell_size**2)})" if world.cell_size != 1 else ""
    made = plan.origin
    if not plan.is_foreign:
        made = plan_words(plan)
    loop = f"open loop, {evaluation.mode} mode" if evaluation.loop == "open" else "closed loop"
    return [
        f"{world.source}: {world.shape[0]} x {world.shape[1]} cells of {world.cell_size:g} m; {cells['free']} free, "
        f"{cells['accessible']} accessible{ground}, {cells['dangerous']} of these dangerous",
        *(() if world.doubt is None else (f"in doubt: {world.doubt.said}",)),
        *filter(None, (bearing_words(plan, world),)),
        f"{made if plan.is_foreign else f'plan: {made}'}, {span_words(plan)}",
        f"{counted(tally.rollouts, 'rollout')}, {loop}, seed {evaluation.seed}, {_engine(evaluation)}: "
        f"{tally.rollouts / max(evaluation.seconds, 1e-9):,.0f} a second"
        + (" (interrupted: what was done so far)" if evaluation.partial else ""),
    ]


def _engine(evaluation: Evaluation) -> str:
    """The engine, and why it was taken where nobody asked for it."""
    chosen = choose_engine(evaluation.choices.engine)
    why = f" ({chosen.why})" if evaluation.choices.engine == "auto" and chosen.name == evaluation.engine else ""
    return evaluation.engine + why


def _area(square_metres: float) -> str:
    return f"{square_metres:,.0f} m2" if square_metres < 1e6 else f"{square_metres / 1e6:,.0f} km2"


WORDS = {
    Verdict.FAILS: "FAILS",
    Verdict.HOLDS: "holds",
    Verdict.VACUOUS: "says nothing",
    Verdict.UNDECIDED: "undecided",
}


def verdict_words(checks: Iterable[Check], formula: str) -> str:
    """The verdict on a formula in all its meanings and robots."""
    verdict = overall(check for check in checks if check.formula == formula)
    return "" if verdict is None else WORDS[verdict]


def how_known(evaluation: Evaluation) -> str:
    """Where the expected values come from: "open loop, exact", or "closed loop, sampled, 20,000 rollouts"."""
    if evaluation.loop == "open" and evaluation.closed_form.is_known:
        return "open loop, exact"
    rollouts = counted(evaluation.tally.rollouts, "rollout")
    return f"{evaluation.loop} loop, sampled, {rollouts}" + (", interrupted" if evaluation.partial else "")


def certain_headline(evaluation: Evaluation) -> str:
    """The answer where nothing can happen: one run is all of them."""
    tally, robots = evaluation.tally, len(evaluation.plan.robots)
    covered, steps = 100 * evaluation.closed_form.visited / tally.accessible, int(np.flatnonzero(tally.time)[0])
    who = counted(robots, "robot visits", "robots visit")
    return (
        f"{who} {covered:.2f} % of the accessible cells in {counted(steps, 'step')} and none is lost: no cell on the "
        "way is dangerous, so every run is the same and 1 rollout is enough."
    )


def rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """The key figures, for a console or a notebook."""
    visited, survived, tally = evaluation.visited, evaluation.survived, evaluation.tally
    of_runs = quantiles(tally.visited, 100.0 / tally.accessible, evaluation.certain)
    known = [f"{QUANTILE_NAMES[q]} {value:.1f}" for q, value in of_runs.items() if not math.isnan(value)]
    shown = [
        ("visited", visited.said(100, " %") + (f"; of single runs {', '.join(known)}" if known else "")),
        ("survived", survived.said(100, " %")),
        ("robots lost", "{}; {}".format(*losses_shown(evaluation.losses, len(evaluation.plan.robots)))),
        ("time", f"{evaluation.time.said()} steps"),
        *([("no strategy exceeds", f"{evaluation.bounds.least} on average")] if evaluation.settled else []),
        ("rollouts", f"{tally.rollouts:,}, {evaluation.loop} loop, seed {evaluation.seed}, {evaluation.engine}"),
    ]  # fmt: skip
    what_p_means = bearing_words(evaluation.plan, evaluation.world)
    shown += [("robots", what_p_means)] if what_p_means else []
    return shown + [("note", note) for note in evaluation.notes[:4]]
