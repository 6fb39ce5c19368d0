"""What an evaluation says in whole sentences: coverage, losses, time, and what stands out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.figures import Chance
from analysis.evaluation.rest import BEFORE, BEYOND, Rest
from analysis.kit.words import policy_words, without_level
from analysis.statistics.estimate import Estimate
from analysis.statistics.words import between, lost_words
from analysis.theory.reachable import moves_left
from analysis.trials.best import is_best
from planner.mrac.executive import STUCK_AFTER
from planner.shown import ceiled, counted, floored, percent, share
from planner.tally import Outcome

ALIKE = 1e-9
"""By so much of itself the cost of one cell may exceed that of another and be no more."""


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
    every, none = (evaluation.shown.left[number] for number in (0, robots))
    left = (" that was left" if robots == 1 else " that were left") if some_before else ""
    nobody = "no further robot is" if some_before else "no robot is"
    if float(evaluation.closed_form.stops_by_cell.sum()) == 0:  # a sum, in which no chance is too small to count
        return f"{nobody[:1].upper()}{nobody[1:-3]} can be lost."
    all_of_them = f"All {robots} robots{left} are"
    if robots <= 2:
        all_of_them = f"The robot{left} is" if robots == 1 else f"Both robots{left} are"
    if every.mean == 1:
        return f"{all_of_them} lost in {_each(every.rollouts)}."
    if none.mean == 1:
        return f"{nobody[:1].upper()}{nobody[1:]} lost in {_any(none.rollouts)}."
    lost_before, lost = len(evaluation.plan.robots) - robots, evaluation.losses
    mean = f"on average {lost_words(lost.mean - lost_before, robots, lost.decimals)}{left}"
    if lost.half_width > 0.5:  # a decimal more than the interval allows
        mean += f" ({between(lost.ci95[0] - lost_before, lost.ci95[1] - lost_before, 1, robots, 'fewer')})"
    often = [(all_of_them, "both" if robots == 2 else f"all {robots}", every), (nobody, "none", none)]
    if robots == 1:
        return f"{all_of_them} lost in {every.share} of runs."
    if every.mean == none.mean == 0:
        seen = [number for number, chance in enumerate(evaluation.shown.left) if chance.mean]
        least, most = robots - max(seen), robots - min(seen)
        some = f"{counted(least, 'robot')}" if least == most else f"{least} to {most} robots"
        return f"{some} of {robots}{left} {'is' if most == 1 else 'are'} lost in {_each(every.rollouts)}, {mean}."
    (first, _, number), (_, other, rare) = sorted(often, key=lambda item: -item[2].mean)
    said = f"{first} lost in {number.share} of runs"
    if rare.mean and rare.share[0] != "<":
        said += f", {other} in {rare.share}"
    return f"{said[0].upper()}{said[1:]}; {mean}."


def home_words(evaluation: Evaluation) -> str:
    """How many robots come home, and how often all of them do, in one sentence; nothing where they need not."""
    home, robots = evaluation.shown.home, len(evaluation.plan.robots)
    if home is None:
        return ""
    every = home.at_least[-1]
    if robots == 1:
        return f"The robot comes home in {every.share} of runs."
    mean = lost_words(home.mean, robots, min(home.digits(), 2))
    mean += "" if mean.endswith("robots") else " robots"
    return f"On average {mean} come home, all of them in {every.share} of runs."


def chances_words(evaluation: Evaluation) -> str:
    """How often every cell is visited, and how long a run takes, in one sentence."""
    done = evaluation.shown.complete
    where = {0.0: _none(done.rollouts), 1.0: _each(done.rollouts)}.get(done.mean) or f"{done.share} of runs"
    return f"Every accessible cell is visited in {where}; {_time(evaluation)} on average."


def _time(evaluation: Evaluation) -> str:
    """How long a run takes; where robots stop before all is visited, when they last move: then they wait for the end.

    Robots that come home do not wait. Robots that come to believe another map may wait for it first: nobody counts how
    long.
    """
    world, steps, ends = evaluation.world, evaluation.time.mean, evaluation.shown.ends
    waiting = [ends[outcome].mean for outcome in (Outcome.NO_PROGRESS, Outcome.NOT_WORTH_THE_RISK) if outcome in ends]
    changes = world.is_learned or (world.phases is not None and world.phases.told)
    if not waiting or evaluation.plan.comes_home or changes:
        return f"a run takes {world.pace.steps(steps)}"
    paces = () if evaluation.plan.settings is None else evaluation.plan.settings.paces
    return f"the last move is at {world.pace.step(steps - STUCK_AFTER * max(paces, default=1) * sum(waiting))}"


def limit_words(evaluation: Evaluation) -> str:
    """What no strategy exceeds on average on this map, where that is proven and not plain; else nothing."""
    if not (most := _most(evaluation)) or is_best(evaluation.plan):
        return ""
    return f"No strategy visits more than {most} on average with this team on this map ({proven(evaluation)})."


def _most(evaluation: Evaluation) -> str:
    """The share that no strategy exceeds on average, rounded upwards; "" where that is not proven, or plain."""
    limit = evaluation.bounds.any_strategy
    if limit is None or limit.cells > evaluation.tally.accessible - 0.005:
        return ""
    return ceiled(limit.mean)


def proven(evaluation: Evaluation) -> str:
    """That the bound for every strategy is, and what it does not know of what was asked."""
    unknown = []
    if moves_left(evaluation.plan) is not None:
        unknown.append("of the range it knows only which cells are too far")
    if evaluation.choices.deadline is not None:
        unknown.append("it does not know the deadline")
    return "; ".join(["proven", *unknown])


def _each(runs: int) -> str:
    return {0: "every run", 1: "the one run that was done"}.get(runs) or f"each of the {runs:,} runs"


def _any(runs: int) -> str:
    return {0: "any run", 1: _each(runs)}.get(runs) or f"any of the {runs:,} runs"


def _none(runs: int) -> str:
    return {0: "no run", 1: "no run of the one that was done"}.get(runs) or f"none of the {runs:,} runs"


def headline(evaluation: Evaluation) -> str:
    """What the plan achieves and what it loses, in one sentence; % is a share of the accessible cells throughout it.

    Of a policy that was searched for, with its name and what no policy exceeds; else with what 19 of 20 runs reach,
    where there are enough rollouts to tell. `losses_words` has the chances in percent.
    """
    robots, least = len(evaluation.plan.robots), evaluation.shown.assured
    if evaluation.certain:
        return certain_headline(evaluation)
    shown = without_level(evaluation.visited.said(100.0, " %")) + " of the accessible cells on average"
    who, lost = counted(robots, "robot visits", "robots visit"), _lost_clause(evaluation)
    if is_best(evaluation.plan) and (settings := evaluation.plan.settings) is not None:
        most = _most(evaluation)
        limit = f"; no strategy exceeds {most} on average ({proven(evaluation)})" * bool(most)
        return f"{who} {shown} with {policy_words(settings)}, {lost}{limit}."
    adds = least is not None and not shown.startswith("100 % (exact)")
    runs = f" (at least {assured_words(evaluation)} in 19 of 20 runs)" * adds
    return f"{who} {shown}{runs} {lost}."


def assured_words(evaluation: Evaluation) -> str:
    """What 19 of 20 runs reach, rounded downwards, as it is a lower bound."""
    return floored(Fraction(evaluation.shown.assured or 0, evaluation.tally.accessible))


def _lost_clause(evaluation: Evaluation) -> str:
    """ "and lose all 8 robots in almost every run (7.99 on average)": how often without a %, which is coverage here."""
    gone = 0 if evaluation.plan.state is None else evaluation.plan.state.lost
    robots, losses = len(evaluation.plan.robots) - gone, evaluation.losses
    every, none = (evaluation.shown.left[number] for number in (0, robots))
    alone, left = len(evaluation.plan.robots) == 1, " that were left" if gone else ""
    if robots == 0:
        return "and none is left to lose"
    if float(evaluation.closed_form.stops_by_cell.sum()) == 0:
        return "and cannot be lost" if alone else "and no robot can be lost"
    if alone:
        return f"and is {'' if every.mean else 'not '}lost {_often(every if every.mean else none)}"
    verb, words = "loses" if alone else "lose", lost_words(losses.mean - gone, robots, losses.decimals)
    mean = f" ({words.split()[0]} on average)" if words[0].isdigit() else ""
    if every.mean >= 0.5:
        team = {1: "the robot", 2: "both robots"}.get(robots, f"all {robots} robots")
        return f"and {verb} {team}{left.replace('were', 'was') if robots == 1 else left} {_often(every)}" + (
            mean if every.mean < 1 else ""
        )
    if none.mean == 1:
        return f"and {verb} no robot in {_any(none.rollouts)}"
    if none.mean >= 0.5:
        return f"and {verb} no robot {_often(none)}{mean}"
    return f"and {verb} {words}{'' if words.endswith(('robot', 'robots')) else ' robots'}{left} on average"


def _often(chance: Chance) -> str:
    """A chance as a count of runs: "in 45 of 100 runs", "in almost every run", "in each of the 20 runs"."""
    if chance.mean == 1:
        return f"in {_each(chance.rollouts)}"
    if 0 < chance.rollouts <= 100:
        return f"in {round(chance.mean * chance.rollouts)} of the {chance.rollouts} runs"
    if chance.mean >= 0.995:
        return "in almost every run"
    of = 100 if chance.mean >= 0.05 else 1_000
    return (
        f"in {round(chance.mean * of)} of {of:,} runs" if chance.mean >= 0.0005 else f"in fewer than 1 of {of:,} runs"
    )


def certain_headline(evaluation: Evaluation) -> str:
    """The answer where nothing can happen: one run is all of them."""
    tally, robots = evaluation.tally, len(evaluation.plan.robots)
    covered, steps = evaluation.closed_form.visited / tally.accessible, int(np.flatnonzero(tally.time)[0])
    who, long = counted(robots, "robot visits", "robots visit"), evaluation.world.pace.steps(steps)
    return (
        f"{who} {percent(covered, 2)} of the accessible cells in {long} and none is lost: no cell on the "
        "way is dangerous, so every run is the same and 1 rollout is enough."
    )


def interval_words(evaluation: Evaluation) -> str:
    """How sure the figures are that are said without their level; nothing where none is."""
    said = headline(evaluation) + gain_words(evaluation)
    half = "± is half the width of a 95 % interval." * ("±" in said)
    ends = re.search(r"\([\d.,]+ (\.\. [\d.,]+|or more|or less)\)", said) is not None
    return " ".join(filter(None, (half, "A range in brackets is a 95 % interval." * ends)))


def gain_words(evaluation: Evaluation) -> str:
    """What taking over from the lost brings, where that is known; else nothing."""
    alone = len(evaluation.plan.robots) == 1
    if alone or evaluation.loop == "open" or not evaluation.closed_form.is_known:
        return ""
    kept = evaluation.closed_form.visited / evaluation.tally.accessible
    covered = evaluation.visited
    more = Estimate(covered.mean - kept, covered.se, (covered.ci95[0] - kept, covered.ci95[1] - kept))
    gain = without_level((more if more.mean >= 0 else more.negated).said(100, " points"))
    return (
        f"Giving the areas of lost robots to the others {'gains' if more.mean >= 0 else 'loses'} {gain} over robots "
        f"that follow their own plans alone ({percent(kept)}, exact)."
    )


def quantile_words(evaluation: Evaluation) -> str:
    """What the quantiles of the table are beside the headline's; nothing where that has none."""
    if " in 19 of 20 runs" not in headline(evaluation) or evaluation.shown.visited.known:
        return ""
    return (
        'The table has the quantiles of the runs that were done; "in 19 of 20 runs" in the first line holds with 95 % '
        "confidence."
    )


def cell_words(evaluation: Evaluation) -> Iterator[str]:
    """Where robots are lost, and what is missed."""
    world, lost, chance = evaluation.ground, evaluation.expected.stops_by_cell, evaluation.expected.visited_by_cell
    order, total = np.argsort(-lost, kind="stable"), float(lost.sum())
    if total > 0:
        row, col = divmod(int(order[0]), world.shape[1])
        dangerous, where = int((lost > 0).sum()), f"row {row}, column {col}"
        said = f"More robots are lost in {where} than in any other cell"
        if dangerous == 1:
            said = f"Robots are lost in {where} alone"
        elif lost[order[1]] >= lost[order[0]] * (1 - ALIKE):
            said = f"No cell costs more robots than {where}"
        said += f": {lost[order[0]]:.3g} a run"
        few = int(np.searchsorted(np.cumsum(lost[order]), 0.5 * total - 1e-12)) + 1
        take = "takes" if few == 1 else "take"
        rest = f". {counted(few, 'cell')} of the {dangerous:,} where robots are lost {take} half of all losses."
        yield said + (rest if dangerous > 1 else ".")
    cells = np.flatnonzero(evaluation.accessible)
    rare, least = int((chance[cells] < 0.5).sum()), int(cells[np.argmin(chance[cells])])
    row, col = divmod(least, world.shape[1])
    of = "" if evaluation.is_exact else " of the rollouts"
    some = "Every accessible cell is covered in at least half of the runs"
    if rare:
        are = "is" if rare == 1 else "are"
        some = f"{counted(rare, 'cell')} of {len(cells):,} {are} covered in fewer than half of the runs"
    yield f"{some}; least likely: row {row}, column {col} ({percent(float(chance[least]))}{of})."
    if out := int(world.free.sum()) - len(cells):
        count = "it counts" if out == 1 else "they count"
        yield f"{counted(out, 'free cell')} cannot be reached by any robot; {count} only in 'of all free cells'."


def rest_words(evaluation: Evaluation, rest: Rest) -> Iterator[str]:
    """What a state leaves, and what a range cuts off: a sentence on each."""
    plan, cells = evaluation.plan, evaluation.tally.accessible
    kinds, robots = rest.kinds[evaluation.accessible], counted(len(plan.robots), "robot")
    if plan.state is not None:
        before = int((kinds == BEFORE).sum())
        more = evaluation.visited.mean * cells - before
        yield (
            f"By {evaluation.world.pace.step(plan.state.step)}, where this goes on, {before:,} of {cells:,} accessible "
            f"cells ({share(before, cells)}) {'was' if before == 1 else 'were'} visited and {plan.state.lost} of "
            f"{robots} lost. Of the {cells - before:,} left {more:,.1f} are visited on average."
        )
    if rest.limited:
        beyond = int((kinds == BEYOND).sum())
        whom = "some robot to visit and come home" if rest.returns else "the moves of some robot"
        far = f"Every accessible cell is near enough for {whom}."
        if beyond:
            many = counted(beyond, "accessible cell")
            are = "is" if beyond == 1 else "are"
            far = f"{many} ({share(beyond, cells)}) {are} {rest.too_far}."
        yield far
        if plan.comes_home:
            return
        ended, team = rest.ended, len(plan.robots)
        who = f"{ended} of {robots} use" if ended > 1 else f"{ended} of {robots} uses" if ended else "no robot uses"
        if ended == team:
            who = {1: "the robot uses", 2: "both robots use"}.get(team, f"all {robots} use")
        up = "up their range and stay where they are" if ended > 1 else "up its range and stays where it is"
        yield f"In the run in which nobody is lost, {who} {up if ended else 'up its range'}."
