"""The report of `mrac-jax evaluate`: coverage, losses, time, their uncertainty, and the outputs' elements."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from functools import partial

import numpy as np

from analysis.estimators.racing import is_best
from analysis.estimators.trial import TreeTruth
from analysis.evaluation import tables as charts
from analysis.evaluation.evaluate import Evaluation
from analysis.evaluation.figures import BEFORE, BEYOND, Rest
from analysis.evaluation.tables import (
    answer_tables,
    distribution,
    formulas_part,
    over_time,
    over_time_text,
    worst_cells,
)
from analysis.report.model import KeyFigure, Pictured, Report, Section
from analysis.report.result import asked, team_figure
from analysis.statistics.estimates import Estimate, between, in_unit, robots_text
from analysis.theory.upper_bound import moves_left
from analysis.utils.tables import json_text, plan_text, policy_text, robots_table, span_text, without_level
from planner.formatting import ceiled, counted, floored, percent, share
from planner.rollouts.tables import STUCK_AFTER
from planner.simulator.codes import Outcome

# The sentences of an evaluation: coverage, losses, time, and the cells that stand out.

INTERVALS = "± is half the width of a 95 % interval; a range in brackets is a 95 % interval."
QUANTILES_NOTE = 'The table gives sample quantiles; "in 19 of 20 runs" in the first line is a 95 % confidence bound.'


def losses_text(evaluation: Evaluation) -> str:
    """The mean number of robots lost, and the probabilities that all and that none are lost.

    "No robot can be lost" is stated only if the plan meets no danger, because then all runs are nominal in both loops.
    """
    gone, robots, left = _team(evaluation)
    before = f" {counted(gone, 'robot')} lost before." if gone else ""
    if not evaluation.has_danger:
        return f"No robot can be lost.{before}"
    lost = evaluation.losses
    mean = robots_text(lost.mean - gone, robots, lost.decimals)
    if lost.half_width > 0.5:  # an interval, because the mean has one decimal too many
        mean += f" ({between(max(lost.ci95[0] - gone, 0.0), lost.ci95[1] - gone, 1, robots, 'fewer')})"
    every, none = (evaluation.shown.left[number].share for number in (0, robots))
    return f"{mean[0].upper()}{mean[1:]}{left} lost on average; all in {every} of runs, none in {none}.{before}"


def _team(evaluation: Evaluation) -> tuple[int, int, str]:
    """Robots lost before the runs, robots alive at their start, and the words that tell these apart."""
    gone = 0 if evaluation.plan.state is None else evaluation.plan.state.lost
    return gone, len(evaluation.plan.robots) - gone, " that were left" * bool(gone)


def return_text(evaluation: Evaluation) -> str:
    """One sentence on the number of returned robots and the probability that all return; "" if they need not."""
    home = evaluation.shown.home
    if home is None:
        return ""
    mean = robots_text(home.mean, home.robots, min(home.digits(), 2))
    got = evaluation.delivered
    brought = (
        "" if got is None else f" {without_level(got.describe(100.0, ' %'))} of the accessible cells are delivered."
    )
    return f"{mean} back at base on average; all in {home.at_least[-1].share} of runs.{brought}"


def completion_text(evaluation: Evaluation) -> str:
    """One sentence on the probability that every cell is visited, and on the mean time."""
    chance = evaluation.shown.complete.share
    return f"Every accessible cell is visited in {chance} of runs; {_time(evaluation)} on average."


def _time(evaluation: Evaluation) -> str:
    """The mean time of a run, or of its last move if robots stop early and then wait for the end.

    Robots that return to base do not wait. With map updates or phases robots may wait for a change of the map for an
    unknown time.
    """
    world, steps, ends = evaluation.world, evaluation.time.mean, evaluation.shown.ends
    waiting = [ends[outcome].mean for outcome in (Outcome.NO_PROGRESS, Outcome.NOT_WORTH_THE_RISK) if outcome in ends]
    changes = world.is_learned or (world.phases is not None and world.phases.are_announced)
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


def summary(evaluation: Evaluation) -> str:
    """The summary: coverage and losses in one sentence; every % in it is a share of the accessible cells.

    For the result of a policy search it names the policy and the upper bound; otherwise the coverage that 19 of 20 runs
    reach, if there are enough rollouts. Probabilities in percent are in `losses_text`.
    """
    if evaluation.certain:
        return certain_summary(evaluation)
    gone, robots, left = _team(evaluation)
    shown = without_level(evaluation.visited.describe(100.0, " %")) + " of the accessible cells on average"
    subject = counted(len(evaluation.plan.robots), "robot visits", "robots visit")
    lost = "no robot can be lost"
    if evaluation.has_danger:
        losses = evaluation.losses
        lost = f"with {robots_text(losses.mean - gone, robots, losses.decimals)}{left} lost on average"
    if is_best(evaluation.plan) and (settings := evaluation.plan.settings) is not None:
        most = _most(evaluation)
        limit = f"; no strategy exceeds {most} on average ({proven(evaluation)})" * bool(most)
        return f"{subject} {shown} with {policy_text(settings)}, {lost}{limit}."
    runs = f" (at least {assured_text(evaluation)} in 19 of 20 runs)" * _adds_quantile(evaluation)
    return f"{subject} {shown}{runs}, {lost}."


def _adds_quantile(evaluation: Evaluation) -> bool:
    """Whether the summary gives the coverage that 19 of 20 runs reach: it adds nothing to a mean of exactly 100 %."""
    visited = evaluation.visited
    return (
        evaluation.shown.assured is not None
        and not visited.mean == visited.ci95[0] == 1
        and not is_best(evaluation.plan)
    )


def assured_text(evaluation: Evaluation) -> str:
    """The coverage that 19 of 20 runs reach, rounded down as a lower bound."""
    return floored(Fraction(evaluation.shown.assured or 0, evaluation.tally.accessible))


def certain_summary(evaluation: Evaluation) -> str:
    """The summary if all runs are equal."""
    tally, robots = evaluation.tally, len(evaluation.plan.robots)
    covered, steps = evaluation.closed_form.visited / tally.accessible, int(np.flatnonzero(tally.time)[0])
    subject, long = counted(robots, "robot visits", "robots visit"), evaluation.world.pace.steps(steps)
    return (
        f"{subject} {percent(covered, 2)} of the accessible cells in {long} and none is lost: no cell on the "
        "way is dangerous, so every run is the same and 1 rollout is enough."
    )


def gain_text(evaluation: Evaluation) -> str:
    """The gain from reassigning the areas of lost robots, if it is known; else ""."""
    alone = len(evaluation.plan.robots) == 1
    if alone or evaluation.loop == "open" or not evaluation.closed_form.is_known:
        return ""
    kept = evaluation.closed_form.visited / evaluation.tally.accessible
    covered = evaluation.visited
    more = Estimate(covered.mean - kept, covered.se, (covered.ci95[0] - kept, covered.ci95[1] - kept))
    gain = without_level(more.more(100, " points", ("more", "less")))
    return (
        f"A team that reassigns the areas of lost robots covers {gain} than one whose robots only follow their own "
        f"plans ({percent(kept)}, exact)."
    )


def cells_text(evaluation: Evaluation) -> Iterator[str]:
    """Sentences on the cells with the highest losses, and on the cells with low coverage."""
    world, lost, chance = evaluation.ground, evaluation.expected.stops_by_cell, evaluation.expected.visited_by_cell
    order, total = np.argsort(-lost, kind="stable"), float(lost.sum())
    if total > 0:
        row, col = divmod(int(order[0]), world.shape[1])
        # 1e-12: by rounding, a cumulative sum may fall short of exactly one half.
        few = int(np.searchsorted(np.cumsum(lost[order]), 0.5 * total - 1e-12)) + 1
        yield (
            f"Highest losses: {lost[order[0]]:.3g} robots a run in row {row}, column {col}; half of all losses in "
            f"{few:,} of {counted(int((lost > 0).sum()), 'cell')} with losses."
        )
    cells = np.flatnonzero(evaluation.accessible)
    rare, least = int((chance[cells] < 0.5).sum()), int(cells[np.argmin(chance[cells])])
    row, col = divmod(least, world.shape[1])
    of = "" if evaluation.is_exact else " of the rollouts"
    yield (
        f"Covered in fewer than half of the runs: {rare:,} of {counted(len(cells), 'accessible cell')}; least likely: "
        f"row {row}, column {col} ({percent(float(chance[least]))}{of})."
    )
    if out := int(world.free.sum()) - len(cells):
        yield f"Out of reach of every robot: {counted(out, 'free cell')}, counted only in 'of all free cells'."


def remainder_text(evaluation: Evaluation, rest: Rest) -> Iterator[str]:
    """Sentences on the state that the plan resumes, and on the cells out of range."""
    plan, cells = evaluation.plan, evaluation.tally.accessible
    kinds, robots = rest.kinds[evaluation.accessible], counted(len(plan.robots), "robot")
    if plan.state is not None:
        before = int((kinds == BEFORE).sum())
        yield (
            f"Before {evaluation.world.pace.step(plan.state.step)}, where this plan resumes: {before:,} of {cells:,} "
            f"accessible cells ({share(before, cells)}) visited, {plan.state.lost} of {robots} lost. Of the "
            f"{cells - before:,} left {evaluation.visited.mean * cells - before:,.1f} are visited on average."
        )
    if rest.limited:
        beyond = int((kinds == BEYOND).sum())
        yield f"{rest.too_far.capitalize()}: {counted(beyond, 'accessible cell')} ({share(beyond, cells)})."
        if not plan.comes_home:
            yield f"In the run without losses, {rest.ended} of {robots} use up their range and stay where they are."


ROBOTS = "Robots of the plan, and the chance that each ends its path"


def report(evaluation: Evaluation, theory: bool = False, bounds: bool = True) -> Report:
    """The report of an evaluation: the answer with the map and the plan, the figures, the details.

    Args:
        evaluation: the result. theory: show the formulas in full.
        bounds: False omits bounds and formulas, whose computation may take seconds.
    """
    world, plan, certain, rest = evaluation.world, evaluation.plan, evaluation.certain, evaluation.rest
    notes = [INTERVALS] * (evaluation.visited.half_width > 0)
    notes += [QUANTILES_NOTE] * (_adds_quantile(evaluation) and not evaluation.shown.visited.known)
    said = (losses_text(evaluation), completion_text(evaluation), gain_text(evaluation), *notes)
    own = () if certain else (*said, *evaluation.added("notes"))
    home, limit = return_text(evaluation), bound_text(evaluation) if bounds and not certain else ""
    said = (*evaluation.added("opens"), home, *evaluation.added("alternatives"), limit, *evaluation.added("leads"))
    parts = [
        Section("Chances and coverage", answer_tables(evaluation), list(filter(None, own))),
        Section("Coverage over time", figures=lambda: [over_time(evaluation)], intro=over_time_text(evaluation)),
        Section("Single runs", figures=lambda: distribution(evaluation), intro="How far one run may be from the mean."),
        Section("Cell by cell", notes=() if certain else list(cells_text(evaluation)),
                figures=lambda: [charts.maps(evaluation)], whole=worst_cells(evaluation)),
        Section("Robots", [robots_table(plan, evaluation.closed_form.survival, ROBOTS)], page_only=True),
    ]  # fmt: skip
    if rest is not None:
        parts.insert(1, Section(rest.title, notes=list(remainder_text(evaluation, rest)),
                                figures=lambda: [charts.rest_map(evaluation, rest)]))  # fmt: skip
    if bounds and (theory or not certain):
        parts.append(formulas_part(evaluation, theory))
    rate = "" if certain else f": {evaluation.tally.rollouts / max(evaluation.seconds, 1e-9):,.0f} a second"
    inputs = _inputs(evaluation)
    return Report(
        "evaluation", "evaluate", asked(world, len(plan.robots), "how much is covered?"), summary(evaluation),
        evaluation, list(filter(None, said)), _key_figures(evaluation),
        picture=lambda: charts.plan_map(evaluation), below=lambda: evaluation.added("below"), parts=parts,
        notes=evaluation.notes, warnings=["Interrupted: the rollouts done so far are shown."] * evaluation.partial,
        settings=inputs | _settings(evaluation),
        last=[f"{name}: {value}{rate * (name == 'rollouts')}" for name, value in inputs.items()],
        pictures=_pictures(evaluation, rest), pace=world.pace,
        files={"plan.json": lambda: json_text(plan.to_json(), compact=True)} | evaluation.added_files("files"),
    )  # fmt: skip


def _inputs(evaluation: Evaluation) -> dict[str, str]:
    """The input of the evaluation, by name."""
    cells, plan, world = evaluation.cells, evaluation.plan, evaluation.world
    ground = f" ({_area(cells['accessible'] * world.cell_size**2)})" if world.cell_size != 1 else ""
    tree = evaluation.closed.tree if isinstance(evaluation.closed, TreeTruth) else None
    whole = "" if tree is None else f"all {counted(tree.histories, 'history', 'histories')} (exact), and "
    unsure = "moving threats" if world.moving_threats else "phases" if world.phases else "map uncertainty"
    found = {
        "map": f"{world.name}, {world.shape[0]} x {world.shape[1]} cells of {world.cell_size:g} m; {cells['free']} "
        f"free, {cells['accessible']} accessible{ground}, {cells['dangerous']} of these dangerous",
        unsure: world.uncertainty and world.uncertainty.description,
        "robots' map": world.knowledge and world.knowledge.description,
        "meaning of p": evaluation.p_means,
        "plan": f"{plan.origin if plan.is_external else plan_text(plan)}, {span_text(plan, world.pace)}"
        + ", by the prior map" * (world.knowledge is not None),
        "rollouts": f"{whole}{counted(evaluation.tally.rollouts, 'rollout')}, {evaluation.loop} loop, seed "
        f"{evaluation.seed}, {evaluation.engine_said}",
    }
    return {name: text for name, text in found.items() if text}


def _area(square_metres: float) -> str:
    return f"{square_metres:,.0f} m2" if square_metres < 1e6 else f"{square_metres / 1e6:,.0f} km2"


def _settings(evaluation: Evaluation) -> dict[str, object]:
    """Further settings that affect the figures, and notes of the map's reader and of the planner."""
    world, plan = evaluation.world, evaluation.plan
    out: dict[str, object] = {"map's SHA-256": f"{world.sha256[:16]}..."} | evaluation.added_files("settings")
    out |= {} if plan.settings is None else plan.settings.described(world.pace)
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
    layers = evaluation.added_files("layers").items()
    out |= {name: partial(charts.with_route, evaluation, make) for name, make in layers}
    out |= evaluation.added_files("pictures")
    return out if rest is None else out | {"rest.png": lambda: charts.rest_picture(evaluation, rest)}
