"""The value output in words and as a table: those of coverage planners, of search and rescue, of mine clearance."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rich.table import Table

from analysis.evaluation.outputs.value_figures import ValueFigures
from analysis.kit.tables import make_table
from analysis.statistics.estimate import Estimate, exactly
from analysis.statistics.mission import TAIL, times_to
from analysis.statistics.words import in_unit
from planner.shown import at_least_words, percent

TITLES = {"coverage": "What the cells are worth", "search": "Search", "clearance": "Clearance"}


def amount(value: float) -> str:
    """A value in as many digits as tell values apart."""
    return f"{value:,.2f}" if abs(value) >= 100 else f"{value:.4g}"


def value_table(value: ValueFigures) -> Table:
    """The field's own figures first, then those that every field asks for."""
    table = make_table(("", "expected", "95 % interval"), TITLES[value.metrics])
    for name, shown, interval in (*ROWS[value.metrics](value), *_common(value)):
        table.add_row(name, shown, interval)
    return table


Rows = Iterator[tuple[str, str, str]]


def _row(name: str, estimate: Estimate, scale: float = 1.0, chance: bool = False) -> tuple[str, str, str]:
    if chance:
        mean, interval = estimate.columns(100 * scale, 100)
        return name, f"{mean} %", in_unit(interval)
    low, high = (amount(scale * end) for end in estimate.ci95)
    exact = estimate.ci95[0] == estimate.ci95[1]
    return name, amount(scale * estimate.mean), "exact" if exact else f"{low} .. {high}"


def _coverage(value: ValueFigures) -> Rows:
    yield _row("value of all free cells", exactly(value.worth.total))
    yield _row("value covered (visited)", value.covered)
    yield _row("value found", value.found)
    yield _row("value left", value.left)
    if value.route_left is not None:
        yield "value left on the route", amount(value.route_left[0]), ""


def _search(value: ValueFigures) -> Rows:
    """Koopman's: success = containment x detection."""
    yield _row("containment (POC): in a cell that is searched", value.covered, value.scale, chance=True)
    detection = "" if value.detection is None else percent(value.detection, 2)
    yield "detection (POD): found, if it is in one", detection, ""
    yield _row("success (POS) = POC x POD", value.found, value.scale, chance=True)
    if value.route_left is not None:
        left = min(value.scale * value.route_left[0], 1.0)
        yield "chance that it lies on the route and is not found", percent(left, 2), ""


def _clearance(value: ValueFigures) -> Rows:
    yield _row("percent clearance", value.found, 1.0 / value.worth.total, chance=True)
    yield _row("expected remaining", value.left)
    if value.route_left is not None:
        total, worst = value.route_left
        yield "expected remaining on the route", amount(total), ""
        yield "residual risk of the route", f"{percent(min(worst, 1.0), 2)} .. {percent(min(total, 1.0), 2)}", "bounds"


ROWS: dict[str, Callable[[ValueFigures], Rows]] = {"coverage": _coverage, "search": _search, "clearance": _clearance}


def _common(value: ValueFigures) -> Rows:
    if value.most is not None:
        yield "no strategy covers more on average (proven)", amount(value.most), ""
    yield "ground visited, m2", amount(value.square_metres), ""
    each = [value.per_robot_lost(of) for of in (value.square_metres, value.covered.mean)]
    for name, ratio in zip(("m2 covered per robot lost", "value covered per robot lost"), each, strict=True):
        yield name, "no robot is lost" if ratio is None else amount(ratio), ""
    for robots, chance in enumerate(value.robots_left, 1):
        if robots in _shown(value.tally.robots):
            yield _row(f"chance that {at_least_words(robots, value.tally.robots)} left", chance, chance=True)
    for share, step in times_to(value.tally).items():
        when = "never" if step is None else f"{step:,}{value.world.pace.also(step)}"
        yield f"steps to {100 * share:g} % of the cells, on average", when, ""
        if step is None:
            break
    yield f"coverage in the worst {100 * TAIL:g} % of runs (CVaR)", percent(value.cvar, 2), ""


def _shown(robots: int) -> set[int]:
    """One, half of them, all."""
    return {1, -(-robots // 2), robots}


def _coverage_sentence(value: ValueFigures) -> str:
    return (
        f"Of {amount(value.worth.total)} in all, {amount(value.covered.mean)} are covered and "
        f"{amount(value.found.mean)} found on average; {amount(value.left.mean)} are left."
    )


def _search_sentence(value: ValueFigures) -> str:
    shown = [percent(min(of.mean * value.scale, 1.0)) for of in (value.found, value.covered)]
    pod = "nothing is searched" if value.detection is None else f"detection {percent(value.detection)}"
    return f"Probability of success {shown[0]}: containment {shown[1]}, {pod}."


def _clearance_sentence(value: ValueFigures) -> str:
    cleared = percent(value.found.mean / value.worth.total)
    return f"{cleared} are cleared on average; {amount(value.left.mean)} of {amount(value.worth.total)} remain."


SENTENCES: dict[str, Callable[[ValueFigures], str]] = {
    "coverage": _coverage_sentence,
    "search": _search_sentence,
    "clearance": _clearance_sentence,
}
"""The answer in one sentence, by whose words."""
