"""`starts` and `clear` against simulating everything: `python -m analysis.bench.decisions starts INPUT ROBOTS`, or
`... clear MAPS ROBOTS` on so many of the paper's 20x20 worlds (contiguous).

What simulating everything finds is chosen on other luck than the search's (seed 1), and both picks are compared on a
third one (seed 2): so the regret is not flattered by either choice.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from analysis.depots.answer import Starts
from analysis.depots.search import find_starts
from analysis.halving import Roll, Runs, roll_of, runs_of
from analysis.inputs import input_path
from analysis.removal.search import find_clearing
from analysis.sampling import RolloutChoices
from analysis.statistics.estimate import over_maps
from planner.kernels.tables import AllPairs
from planner.mrac.make_plan import make_plan
from planner.plans.settings import Settings
from planner.worlds.generate import ThreatPattern, random_world
from planner.worlds.scenario import load_input
from planner.worlds.starts import place_starts

ROLLOUTS, JUDGED = 4096, 16_384
SEARCH, ALL, JUDGE = (RolloutChoices(rollouts=ROLLOUTS, seed=seed) for seed in range(3))


def starts(name: str, robots: int) -> str:
    """Every candidate of the border as a depot, against the search."""
    world, clock = load_input(input_path(name)), time.process_time()
    found = find_starts(world, robots, Settings(), SEARCH, depot=True)
    took, kept = time.process_time() - clock, AllPairs()

    def roll(place: int, choices: RolloutChoices) -> Roll:
        plan = make_plan(world, found.places[place].starts, Settings())
        return roll_of(world, plan, choices, kept=kept)

    everywhere = range(len(found.places))
    truth = np.array([runs_of(roll(place, ALL), robots, 0, ROLLOUTS).mean for place in everywhere])
    of_all = int(truth.argmax())
    judged = [runs_of(roll(place, JUDGE), robots, 0, JUDGED) for place in (found.best, of_all)]
    regret = judged[1].gain(judged[0], found.cells)
    points = 100 / found.cells
    both = f"search {points * judged[0].mean:.2f} %, all {points * judged[1].mean:.2f} %"
    return (
        f"{name}, {robots} robots: depots {points * truth.min():.1f} to {points * truth.max():.1f} %; "
        f"{both}; regret {regret.said(points, ' points')}; "
        f"{found.rolled:,} of {len(truth) * ROLLOUTS:,} rollouts ({found.rolled / len(truth) / ROLLOUTS:.1%}); "
        f"{took:.1f} s CPU; rank correlation {_screens(found, truth)}"
    )


def _screens(found: Starts, truth: NDArray[np.float64]) -> str:
    planned = [number for number, place in enumerate(found.places) if place.one_robot is not None]
    bound = spearmanr([place.screen for place in found.places], truth)[0]
    alone = spearmanr([found.places[number].one_robot for number in planned], truth[planned])[0]
    return f"bound {bound:.2f}, eq. (4) {alone:.2f} of {len(planned)}"


def clear(maps: int, robots: int) -> str:
    """Every area of every map cleared, against the search; robots that know and robots that do not."""
    rows = []
    for seed in range(maps):
        rows.append(_cleared(seed, robots))
        print(seed, np.round(rows[-1], 2), flush=True)  # noqa: T201
    names = ("known: regret, cells", "best gain, cells", "rank of gain", "rank of bound", "rank of hits",
             "unknown: regret, cells", "best gain, cells", "rank of gain", "rank of hits", "s CPU")  # fmt: skip
    means = (f"{name} {over_maps(column).said()}" for name, column in zip(names, np.array(rows).T, strict=True))
    return f"{maps} maps, {robots} robots: " + "; ".join(means)


def _cleared(seed: int, robots: int) -> list[float]:
    """A row of `clear`."""
    world = random_world(20, 20, ThreatPattern("contiguous", seed=seed), obstacles=0.25, threats=0.25)
    placed, clock = place_starts(world, robots)[0], time.process_time()
    found = find_clearing(world, placed, Settings(), SEARCH)
    took, options = time.process_time() - clock, found.options
    worlds = [one.threat.cleared(world) for one in options]

    def rolled(place: int, choices: RolloutChoices, know: bool) -> Runs:
        plan = make_plan(worlds[place] if know else world, placed, Settings())
        roll = roll_of(worlds[place], plan, choices) if know else roll_of(world, plan, choices, worlds[place])
        return runs_of(roll, robots, 0, choices.rollouts)

    base = runs_of(roll_of(world, make_plan(world, placed, Settings()), ALL), robots, 0, ROLLOUTS).mean
    row: list[float] = []
    unknown = int(np.argmax([one.unknown.cells.mean for one in options]))
    hits = [one.hits for one in options]
    screens = {
        True: ([one.known.cells.mean if one.known else -1.0 for one in options], [one.screen for one in options], hits),
        False: ([one.unknown.cells.mean for one in options], hits),
    }
    for know, pick in ((True, found.turns[0].pick), (False, unknown)):
        truth = [rolled(place, ALL, know).mean - base for place in range(len(options))]
        fair = replace(JUDGE, rollouts=JUDGED)
        best = rolled(int(np.argmax(truth)), fair, know)
        regret = best.gain(rolled(pick, fair, know), found.cells).mean
        row += [regret, max(truth), *(float(spearmanr(screen, truth)[0]) for screen in screens[know])]
    return [*row, took]


PROGRAMS: dict[str, Callable[[Sequence[str]], str]] = {
    "starts": lambda words: starts(words[0], int(words[1])),
    "clear": lambda words: clear(int(words[0]), int(words[1])),
}

if __name__ == "__main__":
    print(PROGRAMS[sys.argv[1]](sys.argv[2:]))  # noqa: T201
