"""Reports of `mrac-jax size` and `front`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress, groupby
from math import ceil

from rich.table import Table

from analysis.page.elements import Chart, Series
from analysis.report.model import KeyFigure, Report, Section
from analysis.report.result import map_text, search_report, seed_text, share_figure, sourced, team_figure
from analysis.search.pareto import LANDMARKS, Front, Point, Setting, efficient, settings_of
from analysis.search.team_size import TeamPoint, TeamSize, TeamVerdict
from analysis.statistics.estimates import ALPHA, Estimate, between, losses_sentence, of_all
from analysis.utils.tables import Column, in_percents, json_text, make_table, table_of, without_level
from planner.arguments import argument
from planner.formatting import ceiled, chance, counted, floored, in_percent, percent
from planner.settings import SETTINGS


def size_report(size: TeamSize) -> Report:
    """The number of robots that is enough, the curves that decide it, and every team."""
    world, chart = size.world, _size_chart(size)
    return Report(
        "size", "size", f"{world.name}: how many robots for {_aim(size)}?", size_summary(size),
        size, figures=_size_key_figures(size),
        heading=(f"{map_text(world, size.cells)}, so the target is {size.needed} of them",
                 f"{size.choices.loop} loop, {seed_text(world, size.choices, size.engine)}"),
        picture=lambda: chart, parts=[Section("Teams", [_table(size)], _footnotes(size))], notes=size.notes,
        settings=size.settings.described(world.pace), pace=world.pace, pictures={"size.png": lambda: [chart]},
    )  # fmt: skip


def size_summary(size: TeamSize) -> str:
    """The result in one sentence."""
    aim, undecided = _aim(size), size.of(TeamVerdict.UNDECIDED)
    if size.partial:
        known = {verdict: size.of(verdict) for verdict in TeamVerdict}
        listed = "; ".join(f"{verdict}: {_listed(numbers)}" for verdict, numbers in known.items() if numbers)
        return f"Interrupted before the answer for {aim}: {listed or 'nothing is decided yet'}."
    after = ""
    if undecided:
        most = max(point.rollouts for point in size.points if point.verdict is TeamVerdict.UNDECIDED)
        after = f"; undecided after {counted(most, 'rollout')}: {_listed(undecided)}"
    rest = "; not every team was simulated" * bool(size.passed_over)
    if size.robots is not None:
        found = _figure(size, size.confirmed or size.point(size.robots))
        return f"{counted(size.robots, 'robot is', 'robots are')} enough: {found}{after}{rest}."
    last = size.points[-1]
    if last.verdict is TeamVerdict.IMPOSSIBLE:
        best = last.ideal_coverage if size.goal.confidence is None else last.ideal_chance
        found = f"upper bound {_of(best)}, whatever the policy"
    else:
        found = _figure(size, last)
    team = counted(len(size.starts), "robot")
    return f"No team of up to {team} is shown to be enough for {aim}: with {last.robots}, {found}{after}{rest}."


def _deciding(size: TeamSize, point: TeamPoint) -> Estimate:
    estimate = point.coverage if size.goal.confidence is None else point.chance
    assert estimate is not None
    return estimate


def _figure(size: TeamSize, point: TeamPoint) -> str:
    """The deciding figure of a simulated team, with its 95 % interval."""
    estimate = _deciding(size, point)
    low, high = estimate.ci95
    sure = "exact" if low == high else f"95 % interval {between(100 * low, 100 * high, 2, 100)}"
    sure += _confirmed_note(size, point)
    what = f"chance of {_share(size)} {size.goal.meaning}"
    if size.goal.confidence is None:
        what = f"of the accessible cells {size.goal.meaning} on average"
    return f"{_of(estimate.mean)} {what}{_by(size)} ({sure})"


def _aim(size: TeamSize) -> str:
    """The target of the search, for the title and the summary."""
    goal = size.goal
    if goal.confidence is None:
        return f"{_of(goal.target)} of the accessible cells {goal.meaning} on average{_by(size)}"
    return f"a chance of {_of(goal.confidence)} for {_share(size)} {goal.meaning}{_by(size)}"


def _by(size: TeamSize) -> str:
    end = size.deadline
    return "" if end is None else f" by step {end}{size.world.pace.also(end)}"


def _share(size: TeamSize) -> str:
    if size.goal.target == 1:
        return "every accessible cell"
    return f"at least {chance(size.goal.target, 12)} of the accessible cells"


def _of(fraction: float) -> str:
    """A fraction in percent, with four digits or all given ones; a fraction below 1 is never rounded to 100 %."""
    return chance(fraction, 4)


def _listed(numbers: Sequence[int]) -> str:
    """Integers in text: "7", "7, 8", "1 to 6, 9"."""
    parts = list[str]()
    for _, group in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        run = [number for _, number in group]
        parts += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else map(str, run)
    return ", ".join(parts)


def _confirmed_note(size: TeamSize, point: TeamPoint) -> str:
    return ", fresh rollouts" if point is size.confirmed and _deciding(size, point).half_width else ""


def _size_key_figures(size: TeamSize) -> list[KeyFigure]:
    if size.robots is None:
        return []
    point, undecided = size.confirmed or size.point(size.robots), size.of(TeamVerdict.UNDECIDED)
    name = f"{size.goal.meaning} on average" if size.goal.confidence is None else f"chance of {_target(size)}"
    note = f"{_listed(undecided)} undecided" if undecided else ""
    alive = [] if point.alive is None else [team_figure(point.alive, size.robots, "robots alive at the end")]
    enough = KeyFigure(counted(size.robots, "robot"), "enough", note)
    return [enough, share_figure(_deciding(size, point), name, _confirmed_note(size, point)), *alive]


def _target(size: TeamSize) -> str:
    return "every cell" if size.goal.target == 1 else f"{chance(size.goal.target, 12)} or more"


def _size_chart(size: TeamSize) -> Chart:
    """Coverage and chance by team size with intervals, the upper bound, the target and the result."""
    goal, by_chance = size.goal, size.goal.confidence is not None
    rolled = [point for point in size.points if point.coverage]
    unsure = [point for point in rolled if point.verdict is TeamVerdict.UNDECIDED]
    ideals = [100 * (point.ideal_chance if by_chance else point.ideal_coverage) for point in size.points]
    aim = f"{chance(goal.target, 12)} expected coverage"
    if goal.confidence is not None:
        aim = f"a {chance(goal.confidence, 12)} chance of {_target(size)}"
    robots = f"no team of up to {len(size.starts)}" if size.robots is None else counted(size.robots, "robot")
    return Chart(
        f"Robots for {aim}: {'interrupted' if size.partial else robots}",
        (
            Series.of(f"expected coverage ({goal.meaning})", _sizes(rolled),
                      [p.coverage for p in rolled if p.coverage]),
            Series.of(f"chance of {_target(size)}", _sizes(rolled), [p.chance for p in rolled if p.chance]),
            Series(f"upper bound of the {'chance' if by_chance else 'mean coverage'} for any policy",
                   _sizes(size.points), ideals, dashed=True),
            Series.of("undecided", _sizes(unsure), [_deciding(size, point) for point in unsure], kind="points"),
        ),
        "robots", f"{goal.meaning}, and chance of {_target(size)}, %", unit="%", y_range=(0, 100),
        at_x=() if size.robots is None else ((size.robots, f"enough: {size.robots}"),),
        at_y=((100 * goal.wanted, f"{'target chance' if by_chance else 'target'}: {chance(goal.wanted, 12)}"),),
    )  # fmt: skip


def _sizes(points: Sequence[TeamPoint]) -> list[int]:
    return [point.robots for point in points]


def _table(size: TeamSize) -> Table:
    """The simulated teams, after the last team that a bound excludes."""
    pace = size.world.pace
    ruled_out = [point for point in size.points if point.verdict is TeamVerdict.IMPOSSIBLE]
    shown = [*ruled_out[-1:], *(point for point in size.points if point.alive)]

    def or_bound(point: TeamPoint, found: Estimate | None, bound: float) -> Estimate | str | None:
        return f"<= {ceiled(bound, unit='')}" if point in ruled_out else found

    columns = (
        Column("robots", lambda p: f"1..{p.robots}" if p in ruled_out and p.robots > 1 else p.robots),
        in_percents(size.goal.meaning, lambda p: or_bound(p, p.coverage, p.ideal_coverage), "interval"),
        in_percents("chance", lambda p: or_bound(p, p.chance, p.ideal_chance), "interval"),
        Column("value", lambda p: p.value and in_percent(p.value.mean, 2), shown=size.world.value is not None),
        Column("time", lambda p: p.time and f"{p.time.mean:.0f}"),
        Column("minutes", lambda p: p.time and f"{pace.minutes * p.time.mean:,.1f}", shown=pace),
        Column("alive", lambda p: p.alive and of_all(p.alive.mean, p.robots)),
        Column("verdict", lambda p: p.verdict, words=True),
    )
    return table_of(columns, shown, dropped=("time", "alive"), padding=(0, 1, 0, 0))


def _footnotes(size: TeamSize) -> list[str]:
    """The columns, the confidence of the verdicts, and the teams that were not simulated."""
    figure = "coverage" if size.goal.confidence is None else "chance"
    rolled = [point.rollouts for point in size.points if point.rollouts]
    lines = []
    if any(point.coverage for point in size.points):
        both = "both in %, with 95 % intervals" if rolled else "both in %"
        lines.append(
            f"{size.goal.meaning}: expected coverage; chance: of {_share(size)}; {both}. time: steps; alive: robots at "
            "the end."
        )
    if rolled:
        often = (f"{min(rolled):,} to " if min(rolled) < max(rolled) else "") + counted(max(rolled), "rollout")
        lines.append(
            f"{often} a team. The verdicts are on the {figure} and hold simultaneously "
            f"with {100 * (1 - ALPHA):g} % confidence."
        )
    if size.of(TeamVerdict.UNDECIDED) and size.choices.precision is None and not size.partial:
        lines.append(f"undecided: more than {argument('rollouts', size.choices.rollouts)} may decide.")
    if size.of(TeamVerdict.IMPOSSIBLE):
        lines.append(f"impossible: the value after <= is an upper bound of the {figure} for any policy.")
    if size.passed_over and not size.partial:
        what = "they are not enough if coverage grows with the team" if size.robots else "they may be enough"
        lines.append(f"Not simulated: {_listed(size.passed_over)} robots; {what}.")
    if size.world.value is not None:
        lines.append("value: expected share of the value of all free cells, in %; the target counts cells.")
    return lines


# `mrac-jax front`: the selected point, or losses by coverage; every setting, as curves and in the table.

TITLES = {
    "mrac": "mrac, ended early",
    "per_cell": "per_cell, ended early",
    "risk_cap": "per_cell with a risk cap",
    "robot_value": "per_cell with a robot value",
}
PRICED = {
    ("mrac",): TITLES["mrac"],
    ("per_cell",): TITLES["per_cell"],
    ("risk_cap", "robot_value"): "per_cell with a risk cap or robot value",
}
"""Columns of the table of losses by coverage, by the families in them."""
SELECTED = "selected"


def front_report(front: Front) -> Report:
    """The Pareto front of coverage, robots lost and steps; the plan of the selected point."""
    picked = front.picked
    over_losses, over_time = _front_chart(front, "losses"), _front_chart(front, "time")
    prices = _prices(front)
    settings = settings_of(front.settings, Setting("mrac")).described(front.world.pace)
    return search_report(
        front, "front", "how many robots does coverage cost?", front_summary(front),
        counted(len(front.points), "setting"), f"{counted(front.choices.rollouts, 'rollout')} each, the same ids; ",
        findings=selection_lines(front), figures=_front_key_figures(front), picture=lambda: over_losses,
        parts=[
            Section("Losses and settings", [_points(front) if front.goal else prices], [_footnote(front)],
                    whole=[prices, _points(front, whole=True)]),
            Section("Coverage and mission time", figures=lambda: [over_time]),
        ],
        settings={name: value for name, value in settings.items() if name not in ("policy", "risk_cap", "robot_value")},
        pictures={"front.png": lambda: [over_losses, over_time]},
        files={} if picked is None
        else {"plan.json": lambda: json_text(front.plan_of(picked).to_json(), compact=True)},
    )  # fmt: skip


def front_summary(front: Front) -> str:
    """Coverage and losses in one sentence, by fresh rollouts; `selection_lines` names the settings.

    With a goal, of the selected point; else of the points of `Front.corners`.
    """
    if front.partial:
        return f"Interrupted after {counted(len(front.points), 'setting')}."
    team, limit = counted(len(front.starts), "robot"), _limit(front)
    if not front.goal or front.confirmed is not None:
        points = _reported(front)
        said = ", or ".join(f"{percent(point.coverage.mean)} and lose {_lost(front, point)}" for point in points)
        goal = f"; the goal is {limit}" * bool(front.goal)
        return f"{team} can {front.verb} {said}, on average{_exact(points)}{goal}."
    if front.goal.pick([point.figures for point in front.points]) is not None:
        return f"No setting meets the goal with confidence 0.95: {limit}. Allow a little more, or raise --rollouts."
    best = max(front.points, key=lambda one: one.coverage.mean)
    if front.goal.losses is not None:
        best = min(front.points, key=lambda one: (one.losses.mean, -one.coverage.mean))
    return f"No setting meets the goal, {limit}: the nearest is {_fresh(front, best)}, with {_named(front, best)}."


def _limit(front: Front) -> str:
    goal = front.goal
    if goal.losses is not None:
        return f"at most {goal.losses:g} of {counted(len(front.starts), 'robot')} lost"
    return f"{chance(goal.target or 0, 12)} or more {front.verb}ed"


def _exact(points: Sequence[Point]) -> str:
    return " (exact)" * all(point.exact for point in points)


def _named(front: Front, point: Point) -> str:
    return point.setting.describe(front.world.pace)


def _lost(front: Front, point: Point) -> str:
    return losses_sentence(point.losses, len(front.starts), mean_only=True)


def _reported(front: Front) -> list[Point]:
    """The settings of the summary, on fresh rollouts."""
    return list(front.priced) if front.confirmed is None else [front.confirmed]


def selection_lines(front: Front) -> list[str]:
    """The settings of the summary, their figures with confidence, and the command to evaluate them."""
    reported, again = _reported(front), front.confirmed
    lines = [f"{_named(front, point)}: {_fresh(front, point)}{_exact([point])}." for point in reported]
    if again is not None:
        found = sourced(not again.exact, f"{_fresh(front, again)}.")
        tries = f" It is number {front.tried} of the settings tried there." * (front.tried > 1)
        lines = [f"Best setting found: {_named(front, again)}. {found}", _kept(front, again) + tries]
    if front.words and reported:
        # With three points this is the knee.
        lines.append(f"run it: {front.command_of(reported[(len(reported) - 1) // 2])}")
    if again is not None and again.setting.deadline is not None:
        end = front.world.pace.step(again.setting.deadline)
        home = "robots return to base by then" if front.settings.return_to is not None else "bring the team home then"
        lines.append(f"The mission ends at {end}, and so does its plan: {home}.")
    return lines


def _kept(front: Front, again: Point) -> str:
    """The confidence with which the selected point meets the limit."""
    if again.exact:
        return "The goal is met: these figures are exact."
    bound = f"{floored(again.least, 2)} or more is {front.verb}ed"
    if front.goal.losses is not None:
        bound = f"{ceil(100 * again.most) / 100:.2f} robots or fewer are lost"
    return f"The goal is met with confidence 0.95, for all tries together: on average {bound}."


def _fresh(front: Front, point: Point) -> str:
    lost = losses_sentence(point.losses, len(front.starts))
    return without_level(f"{point.coverage.describe(100, ' %')} {front.verb}ed, {lost} lost").replace(" (exact)", "")


def _front_key_figures(front: Front) -> list[KeyFigure]:
    again = front.confirmed
    if again is None:
        return [
            share_figure(point.coverage, f"costs {_lost(front, point)}", f", {_named(front, point)}")
            for point in front.priced
        ]
    return [
        share_figure(again.coverage, f"{front.choices.metric} on average", "" if again.exact else ", fresh rollouts"),
        team_figure(again.losses, len(front.starts)),
        KeyFigure(front.world.pace.steps(again.time.mean), "mean time", _named(front, again)),
    ]


def _front_chart(front: Front, which: str) -> Chart:
    """Coverage over robots lost, or over steps: a curve for each family, and the selected point as a mark."""
    goal, robots = front.goal, which == "losses"
    # Points far below the front would only stretch the axes.
    least = min(front.points[place].coverage.mean for place in _cheap(front))
    seen = [point for point in front.points if point.coverage.mean >= least]
    families = {name: [p for p in seen if p.setting.family == family] for family, name in TITLES.items()}
    # A family's own front: where cells have to be delivered, a later end may deliver less and lose more.
    shown = {name: [*compress(own, efficient([p.figures for p in own]))] for name, own in families.items()}
    shown[SELECTED] = [] if front.picked is None else [front.picked]
    return Chart(
        "Coverage and robots lost" if robots else "Coverage and mission time",
        tuple(
            Series.of(name, [getattr(point, which).mean for point in points], [point.coverage for point in points],
                      kind="points" if name == SELECTED else "line")
            for name, points in shown.items() if points
        ),
        "robots lost on average" if robots else f"steps on average{front.world.pace.each}",
        f"{front.choices.metric}, % of the accessible cells", unit="%", y_range=(0, 100), fit=True,
        at_x=((goal.losses, f"at most {goal.losses:g} lost"),) if robots and goal.losses is not None else (),
        at_y=() if goal.target is None else ((100 * goal.target, f"{chance(goal.target, 12)} target"),),
        note="Farther up and to the left is better.",
    )  # fmt: skip


def _prices(front: Front) -> Table:
    """The fewest robots lost for each landmark of coverage."""
    found = {mark: [front.cheapest(mark, *families) for families in PRICED] for mark in LANDMARKS}
    rows = [
        (f"{100 * mark:g}", *(_price(front, one) for one in points)) for mark, points in found.items() if any(points)
    ]
    return make_table(("covered, % or more", *PRICED.values()), "Fewest robots lost on average", rows, left=())


def _price(front: Front, point: Point | None) -> str:
    if point is None:
        return ""
    setting, step = point.setting, front.world.pace.step
    at = ", ".join(f"{SETTINGS[name].title} {value:g}" for name, value in setting.limits.items())
    lost = of_all(point.losses.mean, len(front.starts))
    return f"{lost} ({at or ('whole' if setting.deadline is None else step(setting.deadline))})"


def _points(front: Front, whole: bool = False) -> Table:
    """The Pareto front of coverage and losses, and the selected point; `whole`: all settings."""
    pace, picked = front.world.pace, front.picked
    best = {id(point) for point, efficient in zip(front.points, front.efficient, strict=True) if efficient and whole}

    def limit(value: float | None) -> str:
        return "" if value is None else f"{value:g}"

    def end(step: int | None) -> str:
        return "" if step is None else f"{step:,}{pace.also(step)}"

    columns = (
        Column("policy", lambda p: p.setting.policy, words=True),
        Column("risk cap", lambda p: limit(p.setting.risk_cap)),
        Column("robot value", lambda p: limit(p.setting.robot_value)),
        Column("ends at", lambda p: end(p.setting.deadline)),
        in_percents(f"{front.choices.metric}, %", lambda p: p.coverage),
        Column("value, %", lambda p: p.value and in_percent(p.value.mean, 2), shown=front.world.value is not None),
        Column("lost", lambda p: p.losses, "from .. to"),
        Column("steps", lambda p: f"{p.time.mean:,.0f}"),
        Column("minutes", lambda p: f"{pace.minutes * p.time.mean:,.1f}", shown=pace),
        Column("", lambda p: "selected" if p is picked else "efficient" if id(p) in best else "", words=True),
    )
    shown = front.points if whole else sorted((front.points[at] for at in _cheap(front)), key=lambda p: p.losses.mean)
    title = "All settings" if whole else "Pareto front of coverage and robots lost"
    return table_of(columns, shown, title, ("steps", "from .. to", "from .. to"), padding=(0, 1, 0, 0))


def _cheap(front: Front) -> list[int]:
    """Indices of the Pareto front of coverage and losses, and of the selected point."""
    return [place for place, cheap in enumerate(front.cheap) if cheap or place == front.pick]


def _footnote(front: Front) -> str:
    settings, shared = counted(len(front.points), "setting"), ", common random numbers" if front.engine else ""
    if front.goal:
        of = f"{len(_cheap(front))} of {settings}"
        return f"{of}, not dominated in coverage and robots lost{shared}. --out and --json list all."
    biased = "Each entry is the minimum over many settings on the same rollouts, hence slightly too low. "
    return f"{biased * bool(front.engine)}--out and --json list all {settings}; --losses or --target select one."
