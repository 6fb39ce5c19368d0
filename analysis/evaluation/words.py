"""What an evaluation says in whole sentences: coverage, losses, time, and what stands out."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.kit.words import percent, share
from analysis.statistics.estimate import Estimate, assured, proportion
from analysis.statistics.words import between, lost_words
from analysis.theory.reachable import moves_left
from planner.shown import counted
from planner.tally import Outcome

MOST_DIGITS = 4


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


def headline(evaluation: Evaluation) -> str:
    """The answer in one sentence. What 95 % of runs reach is sure with 95 %, or left out."""
    tally, robots = evaluation.tally, len(evaluation.plan.robots)
    if evaluation.certain:
        return certain_headline(evaluation)
    shown = evaluation.visited.said(100.0, " %") + " of the accessible cells on average"
    who, least = counted(robots, "robot visits", "robots visit"), assured(tally.visited)
    runs = "" if least is None else f", and at least {100.0 * least / tally.accessible:.1f} % in 95 % of runs"
    return f"{who} {shown}{runs}."


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


def gain_words(evaluation: Evaluation) -> str:
    """What taking over from the lost brings, where that is known; else nothing."""
    alone = len(evaluation.plan.robots) == 1
    if alone or evaluation.loop == "open" or not evaluation.closed_form.is_known:
        return ""
    kept = evaluation.closed_form.visited / evaluation.tally.accessible
    covered = evaluation.visited
    sign = 1 if covered.mean >= kept else -1
    low, high = sorted(sign * (end - kept) for end in covered.ci95)
    gain = Estimate(sign * (covered.mean - kept), covered.se, (low, high)).said(100, " points")
    return (
        f"Giving the areas of lost robots to the others {'gains' if sign > 0 else 'loses'} {gain} over robots that "
        f"follow their own plans alone ({percent(kept)}, exact)."
    )


def quantile_words(evaluation: Evaluation) -> str:
    """What the quantiles of the table are beside the headline's; nothing where that has none."""
    if assured(evaluation.tally.visited) is None:
        return ""
    return "5 %, median, 95 %: of the runs that were done; what the headline says of 95 % of runs is sure with 95 %."


def cell_words(evaluation: Evaluation) -> Iterator[str]:
    """Where robots are lost, and what is missed."""
    world, lost, chance = evaluation.world, evaluation.expected.stops_by_cell, evaluation.expected.visited_by_cell
    order, total = np.argsort(-lost, kind="stable"), float(lost.sum())
    if total > 0:
        row, col = divmod(int(order[0]), world.shape[1])
        said = f"Most robots are lost in row {row}, column {col}: {lost[order[0]]:.3g} a run"
        dangerous = int((lost > 0).sum())
        few = int(np.searchsorted(np.cumsum(lost[order]), 0.5 * total - 1e-12)) + 1
        rest = f". {counted(few, 'cell')} of the {dangerous:,} where robots are lost take half of all losses."
        yield said + (rest if dangerous > 1 else ", the only cell where one is.")
    cells = np.flatnonzero(world.accessible(evaluation.plan.starts))
    rare, least = int((chance[cells] < 0.5).sum()), int(cells[np.argmin(chance[cells])])
    row, col = divmod(least, world.shape[1])
    of = " of the rollouts" if evaluation.loop == "closed" else ""
    some = "Every accessible cell is covered in at least half of the runs"
    if rare:
        some = f"{counted(rare, 'cell')} of {len(cells):,} are covered in fewer than half of the runs"
    yield f"{some}; least likely: row {row}, column {col} ({percent(float(chance[least]))}{of})."
    if out := int(world.free.sum()) - len(cells):
        yield f"{counted(out, 'free cell')} cannot be reached by any robot; they count only in 'of all free cells'."
