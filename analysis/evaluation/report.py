"""The report of `mrac-jax evaluate`: coverage, losses, time, their uncertainty, and the outputs' elements."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from functools import partial

import numpy as np

from analysis.estimators.racing import is_best
from analysis.estimators.trial import TreeTruth
from analysis.evaluation import tables as charts
from analysis.evaluation.evaluate import Evaluation
from analysis.evaluation.figures import BEFORE, BEYOND, Chance, Rest
from analysis.evaluation.tables import (
    answer_tables,
    distribution,
    formulas_part,
    over_time,
    over_time_text,
    robots_table,
    worst_cells,
)
from analysis.report.answer import asked, json_end, team_figure
from analysis.report.model import KeyFigure, Part, Pictured, Report
from analysis.statistics.estimates import Estimate, between, in_unit, lost_text
from analysis.theory.bounds import Theorem3
from analysis.theory.exact import OpenLoopExact
from analysis.theory.upper_bound import moves_left
from analysis.theory.verdicts import MEANINGS, ClosedTruth, Truth
from analysis.utils.tables import json_text, plan_text, policy_text, span_text, without_level
from planner.files import Json
from planner.formatting import ceiled, counted, floored, percent, share
from planner.plan.plan import Plan, drive_of
from planner.rollouts.tables import STUCK_AFTER
from planner.simulator.codes import Outcome
from planner.tally import counts_by_word
from planner.world.world import World

# The sentences of an evaluation: coverage, losses, time, and the cells that stand out.

ALIKE = 1e-9
"""Relative difference below which the losses of two cells are equal."""


def losses_text(evaluation: Evaluation) -> str:
    """One sentence on the number of robots lost, and on the probability that all or none are lost.

    The more frequent of "all" and "none" comes first; an event that was not sampled is not called impossible. "No robot
    can be lost" is stated only if the plan meets no danger, because then all runs are nominal in both loops. From a
    mission state the sentence is about the remaining robots, and a second one gives the number lost before.
    """
    gone = 0 if evaluation.plan.state is None else evaluation.plan.state.lost
    said = _losses(evaluation, len(evaluation.plan.robots) - gone, bool(gone))
    return f"{said} {counted(gone, 'robot')} {'was' if gone == 1 else 'were'} lost before." if gone else said


def _losses(evaluation: Evaluation, robots: int, some_before: bool) -> str:
    """The sentence for the `robots` that were alive at the start of the runs."""
    every, none = (evaluation.shown.left[number] for number in (0, robots))
    left = (" that was left" if robots == 1 else " that were left") if some_before else ""
    no_robot = "no further robot is" if some_before else "no robot is"
    if float(evaluation.closed_form.stops_by_cell.sum()) == 0:  # a sum, because any probability above 0 counts
        return f"{no_robot[:1].upper()}{no_robot[1:-3]} can be lost."
    all_of_them = f"All {robots} robots{left} are"
    if robots <= 2:
        all_of_them = f"The robot{left} is" if robots == 1 else f"Both robots{left} are"
    if every.mean == 1:
        return f"{all_of_them} lost in {_each(every.rollouts)}."
    if none.mean == 1:
        return f"{no_robot[:1].upper()}{no_robot[1:]} lost in {_any(none.rollouts)}."
    lost_before, lost = len(evaluation.plan.robots) - robots, evaluation.losses
    mean = f"on average {lost_text(lost.mean - lost_before, robots, lost.decimals)}{left}"
    if lost.half_width > 0.5:  # an interval, because the mean has one decimal too many
        mean += f" ({between(lost.ci95[0] - lost_before, lost.ci95[1] - lost_before, 1, robots, 'fewer')})"
    often = [(all_of_them, "both" if robots == 2 else f"all {robots}", every), (no_robot, "none", none)]
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


def return_text(evaluation: Evaluation) -> str:
    """One sentence on the number of returned robots and the probability that all return; "" if they need not."""
    home, robots = evaluation.shown.home, len(evaluation.plan.robots)
    if home is None:
        return ""
    every = home.at_least[-1]
    if robots == 1:
        return f"The robot returns to base in {every.share} of runs."
    mean = lost_text(home.mean, robots, min(home.digits(), 2))
    mean += "" if mean.endswith("robots") else " robots"
    return f"On average {mean} return to base, all of them in {every.share} of runs."


def completion_text(evaluation: Evaluation) -> str:
    """One sentence on the probability that every cell is visited, and on the mean time."""
    done = evaluation.shown.complete
    where = {0.0: _none(done.rollouts), 1.0: _each(done.rollouts)}.get(done.mean) or f"{done.share} of runs"
    return f"Every accessible cell is visited in {where}; {_time(evaluation)} on average."


def _time(evaluation: Evaluation) -> str:
    """The mean time of a run, or of its last move if robots stop early and then wait for the end.

    Robots that return to base do not wait. With map updates or phases robots may wait for a change of the map for an
    unknown time.
    """
    world, steps, ends = evaluation.world, evaluation.time.mean, evaluation.shown.ends
    waiting = [ends[outcome].mean for outcome in (Outcome.NO_PROGRESS, Outcome.NOT_WORTH_THE_RISK) if outcome in ends]
    changes = world.is_learned or (world.phases is not None and world.phases.told)
    if not waiting or evaluation.plan.comes_home or changes:
        return f"a run takes {world.pace.steps(steps)}"
    # Robots wait STUCK_AFTER of their moves before such an end; the wait is subtracted.
    paces = () if evaluation.plan.settings is None else evaluation.plan.settings.paces
    return f"the last move is at {world.pace.step(steps - STUCK_AFTER * max(paces, default=1) * sum(waiting))}"


def bound_text(evaluation: Evaluation) -> str:
    """The policy-independent upper bound, if it is proven and below 100 %; else ""."""
    if not (most := _most(evaluation)) or is_best(evaluation.plan):
        return ""
    return f"No strategy visits more than {most} on average with this team on this map ({proven(evaluation)})."


def _most(evaluation: Evaluation) -> str:
    """The policy-independent upper bound, rounded up; "" if it is not proven or trivial."""
    limit = evaluation.bounds.any_strategy
    if limit is None or limit.cells > evaluation.tally.accessible - 0.005:
        return ""
    return ceiled(limit.mean)


def proven(evaluation: Evaluation) -> str:
    """The status of the policy-independent upper bound, and the requested limits that it ignores."""
    unknown = []
    if moves_left(evaluation.plan) is not None:
        unknown.append("of the range it uses only which cells are too far")
    if evaluation.choices.deadline is not None:
        unknown.append("it ignores the deadline")
    return "; ".join(["proven", *unknown])


def _each(runs: int) -> str:
    return {0: "every run", 1: "the one run that was done"}.get(runs) or f"each of the {runs:,} runs"


def _any(runs: int) -> str:
    return {0: "any run", 1: _each(runs)}.get(runs) or f"any of the {runs:,} runs"


def _none(runs: int) -> str:
    return {0: "no run", 1: "no run of the one that was done"}.get(runs) or f"none of the {runs:,} runs"


def headline(evaluation: Evaluation) -> str:
    """The summary: coverage and losses in one sentence; every % in it is a share of the accessible cells.

    For the result of a policy search it names the policy and the upper bound; otherwise the coverage that 19 of 20 runs
    reach, if there are enough rollouts. Probabilities in percent are in `losses_text`.
    """
    robots, least = len(evaluation.plan.robots), evaluation.shown.assured
    if evaluation.certain:
        return certain_headline(evaluation)
    shown = without_level(evaluation.visited.describe(100.0, " %")) + " of the accessible cells on average"
    subject, lost = counted(robots, "robot visits", "robots visit"), _lost_clause(evaluation)
    if is_best(evaluation.plan) and (settings := evaluation.plan.settings) is not None:
        most = _most(evaluation)
        limit = f"; no strategy exceeds {most} on average ({proven(evaluation)})" * bool(most)
        return f"{subject} {shown} with {policy_text(settings)}, {lost}{limit}."
    # If the mean is exactly 100 %, the quantile adds nothing.
    adds = least is not None and not shown.startswith("100 % (exact)")
    runs = f" (at least {assured_text(evaluation)} in 19 of 20 runs)" * adds
    return f"{subject} {shown}{runs} {lost}."


def assured_text(evaluation: Evaluation) -> str:
    """The coverage that 19 of 20 runs reach, rounded down as a lower bound."""
    return floored(Fraction(evaluation.shown.assured or 0, evaluation.tally.accessible))


def _lost_clause(evaluation: Evaluation) -> str:
    """ "and lose all 8 robots in almost every run (7.99 on average)": frequencies without %, which is coverage here."""
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
    verb, words = "loses" if alone else "lose", lost_text(losses.mean - gone, robots, losses.decimals)
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
    """A probability as a count of runs: "in 45 of 100 runs", "in almost every run", "in each of the 20 runs"."""
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
    """The summary if all runs are equal."""
    tally, robots = evaluation.tally, len(evaluation.plan.robots)
    covered, steps = evaluation.closed_form.visited / tally.accessible, int(np.flatnonzero(tally.time)[0])
    subject, long = counted(robots, "robot visits", "robots visit"), evaluation.world.pace.steps(steps)
    return (
        f"{subject} {percent(covered, 2)} of the accessible cells in {long} and none is lost: no cell on the "
        "way is dangerous, so every run is the same and 1 rollout is enough."
    )


def interval_text(evaluation: Evaluation) -> str:
    """The meaning of ± and of ranges in brackets, if the sentences contain them; else ""."""
    said = headline(evaluation) + gain_text(evaluation)
    half = "± is half the width of a 95 % interval." * ("±" in said)
    ends = re.search(r"\([\d.,]+ (\.\. [\d.,]+|or more|or less)\)", said) is not None
    return " ".join(filter(None, (half, "A range in brackets is a 95 % interval." * ends)))


def gain_text(evaluation: Evaluation) -> str:
    """The gain from reassigning the areas of lost robots, if it is known; else ""."""
    alone = len(evaluation.plan.robots) == 1
    if alone or evaluation.loop == "open" or not evaluation.closed_form.is_known:
        return ""
    kept = evaluation.closed_form.visited / evaluation.tally.accessible
    covered = evaluation.visited
    more = Estimate(covered.mean - kept, covered.se, (covered.ci95[0] - kept, covered.ci95[1] - kept))
    gain = without_level((more if more.mean >= 0 else more.negated).describe(100, " points"))
    return (
        f"Reassigning the areas of lost robots {'gains' if more.mean >= 0 else 'loses'} {gain} over robots that only "
        f"follow their own plans ({percent(kept)}, exact)."
    )


def quantile_text(evaluation: Evaluation) -> str:
    """The difference between the quantiles of the table and that of the summary; "" if the summary has none."""
    if " in 19 of 20 runs" not in headline(evaluation) or evaluation.shown.visited.known:
        return ""
    return (
        'The table gives sample quantiles; "in 19 of 20 runs" in the first line is a bound with 95 % confidence for '
        "all runs."
    )


def cells_text(evaluation: Evaluation) -> Iterator[str]:
    """Sentences on the cells with the highest losses, and on the cells with low coverage."""
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
        # 1e-12: by rounding, a cumulative sum may fall short of exactly one half.
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


def remainder_text(evaluation: Evaluation, rest: Rest) -> Iterator[str]:
    """Sentences on the state that the plan resumes, and on the cells out of range."""
    plan, cells = evaluation.plan, evaluation.tally.accessible
    kinds, robots = rest.kinds[evaluation.accessible], counted(len(plan.robots), "robot")
    if plan.state is not None:
        before = int((kinds == BEFORE).sum())
        more = evaluation.visited.mean * cells - before
        yield (
            f"By {evaluation.world.pace.step(plan.state.step)}, where this plan resumes, {before:,} of {cells:,} "
            f"accessible cells ({share(before, cells)}) {'was' if before == 1 else 'were'} visited and "
            f"{plan.state.lost} of {robots} lost. Of the {cells - before:,} left {more:,.1f} are visited on average."
        )
    if rest.limited:
        beyond = int((kinds == BEYOND).sum())
        reason = "some robot to visit and return" if rest.returns else "the moves of some robot"
        far = f"Every accessible cell is near enough for {reason}."
        if beyond:
            many = counted(beyond, "accessible cell")
            are = "is" if beyond == 1 else "are"
            far = f"{many} ({share(beyond, cells)}) {are} {rest.too_far}."
        yield far
        if plan.comes_home:
            return
        ended, team = rest.ended, len(plan.robots)
        users = f"{ended} of {robots} use" if ended > 1 else f"{ended} of {robots} uses" if ended else "no robot uses"
        if ended == team:
            users = {1: "the robot uses", 2: "both robots use"}.get(team, f"all {robots} use")
        up = "up their range and stay where they are" if ended > 1 else "up its range and stays where it is"
        yield f"In the run without losses, {users} {up if ended else 'up its range'}."


# The result as the JSON object that `mrac-jax evaluate` prints (SPEC section 9).


def to_json(evaluation: Evaluation) -> Json:
    """The JSON object of SPEC section 9; undefined values are None."""
    tally, plan, known = evaluation.tally, evaluation.plan, evaluation.exact
    cells, found = evaluation.cells, evaluation.figures
    drive = drive_of(robot.path for robot in plan.robots)
    lost = None if known.alive is None else tally.robots - known.alive
    out: Json = {
        "loop": evaluation.loop,
        "engine": evaluation.engine,
        "robots": len(plan.robots),
        "starts": plan.starts,
        "cells": cells,
        "policy": _policy_json(plan),
        "plan_for": plan.plan_for,
        "rollouts": tally.rollouts,
        "seed": evaluation.seed,
        "certain": evaluation.certain,
        "coverage": found.coverage_json(),
        "best": {figure: getattr(evaluation, figure) for figure in (*MEANINGS, "losses")},
        "coverage_of_free_cells": {m: getattr(found, m).mean.mean / cells["free"] for m in MEANINGS},
        "time": found.time.to_json() | {"max": int(np.flatnonzero(tally.time).max())},
        "outcomes": counts_by_word(tally.outcomes, plan.ends_by_deadline),
        "complete": found.complete,
        "alive": {"mean": found.alive.mean},
        "losses": found.losses.to_json() | {"exact": lost},
        "some_left": evaluation.shown.some_left,
        "control": _control_json(evaluation),
        "bounds": _bounds_json(evaluation),
        "verdicts": {check.key: str(check.verdict) for check in evaluation.worst_checks},
        "exact": {
            "open_loop": _open_json(evaluation.closed_form),
            "closed_loop": _closed_json(evaluation.closed),
            "alive": known.alive,
            "time": known.time,
        },
        "plan": {
            "settings": plan.settings,
            "areas": len(plan.areas),
            "levels": len({area.level for area in plan.areas}),
            **{name: getattr(plan, name) for name in ("makespan", "outcome", "shares")},
            "moves": int(drive.moves.sum()),
            "quarter_turns": int(drive.turns.sum()),
        },
        "rollouts_per_second": tally.rollouts / evaluation.seconds if evaluation.seconds > 0 else None,
        "compile_seconds": evaluation.compile_seconds,
        "advice": None,
    }
    if found.home is not None:
        out["home"] = found.home
    for name in ("movers", "phases"):
        if (of := getattr(evaluation.world, name)) is not None:
            out[name] = of.to_json()
    said = {key: found.as_json() for key, found in evaluation.outputs.items()}
    out |= {key: value for key, value in said.items() if value is not None}
    return out | json_end(evaluation, evaluation.notes)


def _control_json(evaluation: Evaluation) -> Json | None:
    """By figure: ratio of variances without and with the control variate, and its slopes; None without one."""
    found = evaluation.control
    said = {"gain": {key: one.gain for key, one in found.items()}, "weights": {k: v.weights for k, v in found.items()}}
    return said if found else None


def _policy_json(plan: Plan) -> Json | None:
    if plan.settings is None:
        return None
    return {
        "name": plan.settings.rule.name,
        "risk_cap": plan.settings.risk_cap,
        "robot_value": plan.settings.robot_value,
    } | ({} if plan.settings.range is None else {"range": plan.settings.range})


def _bounds_json(evaluation: Evaluation) -> Json:
    """The formulas of SPEC section 7."""
    bounds, limit = evaluation.formulas, evaluation.bounds.any_strategy
    undefined = dict.fromkeys(Theorem3.__dataclass_fields__)
    return {
        **{name: getattr(bounds, name) for name in ("eq1", "eq2_printed", "team_survival", "eq4", "eq5")},
        "theorem3": {
            "visited": bounds.theorem3_visited or undefined,
            "survived": bounds.theorem3_survived or undefined,
        },
        "ideal_eq7": bounds.ideal_eq7,
        "ideal_team": bounds.ideal_team,
        "any_strategy": None if limit is None else limit.cells,
    }


def _open_json(exact: OpenLoopExact) -> Json:
    """The open loop's expected values, for either evaluated loop; NaN if not known."""
    return {
        "visited": exact.visited,
        "survived": exact.survived,
        "alive": float(exact.survival.sum()),
        "losses": exact.expected_losses,
        "time": exact.mean_time,
    }


def _closed_json(closed: ClosedTruth | None) -> Json | None:
    """The closed loop's exact expected values, and how they are known; None if they are not."""
    if closed is None:
        return None
    return closed.further | {
        "visited": _known_json(closed.visited),
        "survived": _known_json(closed.survived),
        "some_left": _known_json(closed.some_left),
        "alive": closed.alive,
        "time": closed.time,
        "how": closed.visited.how,
    }


def _known_json(truth: Truth) -> float | list[float]:
    """A value, or its certain lower and upper bounds."""
    return truth.value if truth.low == truth.high else [truth.low, truth.high]


def report(evaluation: Evaluation, theory: bool = False, bounds: bool = True) -> Report:
    """The report of an evaluation: the answer with the map and the plan, the figures, the details.

    Args:
        evaluation: the result. theory: show the formulas in full.
        bounds: False omits bounds and formulas, whose computation may take seconds.
    """
    world, plan, certain, outputs = evaluation.world, evaluation.plan, evaluation.certain, evaluation.blocks
    rest, looked_at = evaluation.rest, _looked_at(evaluation)
    said = losses_text, completion_text, gain_text, interval_text, quantile_text
    own = () if certain else (*(say(evaluation) for say in said), *(note for found in outputs for note in found.notes))
    home = "" if certain else return_text(evaluation)
    limit = bound_text(evaluation) if bounds and not certain else ""
    return Report(
        "evaluation", "evaluate", asked(world, len(plan.robots), "how much is covered?"), headline(evaluation),
        lambda: to_json(evaluation),
        findings=[
            *filter(None, (*(line for found in outputs for line in found.opens), home)),
            *(line for found in outputs for line in found.alternatives),
            *filter(None, (limit, *(line for found in outputs for line in found.leads))),
        ],
        figures=_key_figures(evaluation), picture=lambda: charts.plan_map(evaluation),
        below=lambda: [chart for found in outputs for chart in found.below],
        parts=[
            Part("Chances and coverage", answer_tables(evaluation), list(filter(None, own))),
            *([] if rest is None else [Part(rest.title, notes=list(remainder_text(evaluation, rest)),
                                            drawn=lambda: [charts.rest_map(evaluation, rest)])]),
            Part("Coverage over time", drawn=lambda: [over_time(evaluation)], lead=over_time_text(evaluation)),
            Part("Single runs", drawn=lambda: distribution(evaluation), lead="How far one run may be from the mean."),
            Part("Cell by cell", notes=() if certain else list(cells_text(evaluation)),
                 drawn=lambda: [charts.maps(evaluation)], whole=worst_cells(evaluation)),
            Part("Robots", [robots_table(evaluation)], aside=True),
            *([formulas_part(evaluation, theory)] if bounds and (theory or not certain) else []),
        ],
        notes=evaluation.notes,
        warnings=["Interrupted: the rollouts done so far are shown."] * evaluation.partial,
        settings=looked_at | _settings(evaluation),
        last=_in_lines(evaluation, looked_at),
        pictures=_pictures(evaluation, rest),
        files={"plan.json": lambda: json_text(plan.to_json(), compact=True)}
        | {name: make for found in outputs for name, make in found.files.items()},
        pace=world.pace,
    )  # fmt: skip


def _looked_at(evaluation: Evaluation) -> dict[str, str]:
    """The input of the evaluation, by name."""
    cells, plan, tally, world = evaluation.cells, evaluation.plan, evaluation.tally, evaluation.world
    ground = f" ({_area(cells['accessible'] * world.cell_size**2)})" if world.cell_size != 1 else ""
    loop = f"{evaluation.loop} loop"
    tree = evaluation.closed.tree if isinstance(evaluation.closed, TreeTruth) else None
    whole = ""
    if tree is not None:
        whole = f"exact: all possible histories, {counted(tree.histories, 'branch', 'branches')}; and "
    return {
        "map": f"{world.shape[0]} x {world.shape[1]} cells of {world.cell_size:g} m; {cells['free']} free, "
        f"{cells['accessible']} accessible{ground}, {cells['dangerous']} of these dangerous",
        **({} if world.uncertainty is None else {_uncertainty_name(world): world.uncertainty.description}),
        **({} if world.knowledge is None else {"robots' map": world.knowledge.description}),
        **({"meaning of p": evaluation.p_means} if evaluation.p_means else {}),
        "plan": f"{plan.origin if plan.is_external else plan_text(plan)}, {span_text(plan, world.pace)}"
        + ("" if world.knowledge is None else ", by the prior map"),
        "rollouts": f"{whole}{counted(tally.rollouts, 'rollout')}, {loop}, seed {evaluation.seed}, "
        f"{evaluation.engine_said}",
    }


def _uncertainty_name(world: World) -> str:
    """The name of `World.uncertainty` in the report."""
    return "moving threats" if world.movers else "phases" if world.phases else "map uncertainty"


def _in_lines(evaluation: Evaluation, looked_at: Mapping[str, str]) -> list[str]:
    """The input as lines for a terminal, and the rate of the rollouts if there are several."""
    plan, rate = evaluation.plan, evaluation.tally.rollouts / max(evaluation.seconds, 1e-9)
    before = {"map": f"{evaluation.world.source}: ", "map uncertainty": "map uncertainty: ",
              "plan": "plan: " * (not plan.is_external)}  # fmt: skip
    lines = [before.get(name, "") + value for name, value in looked_at.items()]
    return lines if evaluation.certain else [*lines[:-1], f"{lines[-1]}: {rate:,.0f} a second"]


def _area(square_metres: float) -> str:
    return f"{square_metres:,.0f} m2" if square_metres < 1e6 else f"{square_metres / 1e6:,.0f} km2"


def _settings(evaluation: Evaluation) -> dict[str, object]:
    """Further settings that affect the figures, and notes of the map's reader and of the planner."""
    world, plan = evaluation.world, evaluation.plan
    out: dict[str, object] = {"map's name": world.name, "map's SHA-256": f"{world.sha256[:16]}..."}
    out |= {} if plan.settings is None else plan.settings.described(world.pace)
    for found in evaluation.blocks:
        out |= found.settings
    noted = {"how the map was read": world.notes, "how the plan was made": plan.notes}
    return out | {name: "; ".join(notes) for name, notes in noted.items() if notes}


def _key_figures(evaluation: Evaluation) -> list[KeyFigure]:
    """The key figures."""
    found, cells, seen = evaluation.shown, evaluation.tally.accessible, evaluation.visited
    visited, between = seen.columns(100.0, 100)
    (complete, likely), (time, steps) = found.complete.columns(), evaluation.time.columns()
    sure = "with 95 % confidence" if found.visited.known is None else "exact"
    runs = KeyFigure(assured_text(evaluation), "reached in 19 of 20 runs", sure)
    return [
        KeyFigure(f"{visited} %", "visited on average", f"{in_unit(between)}, of {cells:,} accessible cells"),
        *([] if found.assured is None else [runs]),
        KeyFigure(f"{complete} %", "chance to visit every cell", in_unit(likely)),
        team_figure(evaluation.losses, evaluation.losses.robots),
        *([] if found.home is None else [team_figure(found.home, found.home.robots, "robots back at base")]),
        KeyFigure(
            f"{time} step{'s' * (time != '1')}", "mean time", steps + evaluation.world.pace.also(evaluation.time.mean)
        ),
    ]


def _pictures(evaluation: Evaluation, rest: Rest | None) -> Mapping[str, Callable[[], Pictured]]:
    """The function that draws each picture, by file name."""
    out: dict[str, Callable[[], Pictured]] = {
        "world.png": lambda: charts.world_drawn(evaluation),
        "covered.png": lambda: charts.covered(evaluation),
        "losses.png": lambda: charts.losses(evaluation),
        "distribution.png": lambda: distribution(evaluation, picture=True),
        "over_time.png": lambda: [over_time(evaluation)],
    }
    for found in evaluation.blocks:
        for name, make in found.layers.items():
            out[name] = partial(charts.with_route, evaluation, make)
        out |= found.pictures
    return out if rest is None else out | {"rest.png": lambda: charts.rest_picture(evaluation, rest)}
