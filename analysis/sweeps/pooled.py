"""Rows that pool several runs of a map: each map is averaged first, and counts once.

Runs of a map are pooled over settings (with equal weights) and, within a setting, over rollout seeds (by rollouts).
Settings meet the same luck, so their errors may be one and the same: those of one seed are added up as they are, which
no correlation exceeds; those of different seeds are independent and add in squares.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Estimate
from analysis.sweeps.cases import Label
from analysis.sweeps.rows import KEPT, figures_of, outcomes_of, single_map
from analysis.sweeps.spec_settings import WORLD, is_path
from analysis.sweeps.store.store import Run
from analysis.sweeps.summary import Moments
from planner.limits import MOST_ROLLOUTS
from planner.tally import Tally

Setting = tuple[Label, ...]
"""A run's values of the labels that are pooled."""


@dataclass(frozen=True, eq=False)
class Part:
    """What a row keeps of a run.

    Attributes:
        key: the run's. setting: its values of what is pooled. seed: of its rollouts.
        rollouts: how many. outcomes: of them, by word. means, errors: of `figures_of`.
    """

    key: str
    setting: Setting
    seed: Label
    rollouts: int
    outcomes: Counter[str]
    means: NDArray[np.float64]
    errors: NDArray[np.float64]


def part_of(run: Run, pooled: Sequence[str]) -> Part:
    """The part that a run is of its row; `pooled`: names of labels that vary within rows."""
    setting = tuple(run.what.get(name) for name in pooled if name != "input" or "map" in run.what)
    return Part(run.key, setting, run.what.get("rollout_seed"), run.rollouts, outcomes_of(run), *figures_of(run))


def map_of(run: Run) -> tuple[str, Label]:
    """The map of a run, the same for all settings that a sweep tries on it.

    A generated map is its seed: the worlds of one seed share their obstacles and their luck. Otherwise it is the
    world's content; where places of the scenario are swept, so that every setting changes that, it is the input.
    """
    if run.what.get("map") is not None:
        return "map", run.what["map"]
    if any(name in WORLD or is_path(name) for name in run.what):
        return "input", run.what.get("input")
    return "world", run.facts["world"]


def complete(maps: Iterable[list[Part]]) -> list[list[Part]]:
    """The maps that have every setting that one of them has."""
    maps = list(maps)
    settings = {part.setting for parts in maps for part in parts}
    return [parts for parts in maps if {part.setting for part in parts} == settings]


def weights_of(parts: Sequence[tuple[Setting, int]]) -> NDArray[np.float64]:
    """Weights of a map's (setting, rollouts), float64 that add up to 1: settings alike, within one by rollouts."""
    totals: dict[Setting, int] = {}
    for setting, rollouts in parts:
        totals[setting] = totals.get(setting, 0) + rollouts
    return np.array([rollouts / totals[setting] / len(totals) for setting, rollouts in parts])


def moments_over(maps: Sequence[Sequence[Part]]) -> Moments:
    """Moments of KEPT over maps, each map an average over its parts.

    Where maps share a rollout seed they may share its luck, which the spread between them does not show: that error
    of the mean is added (`Moments.shared`).
    """
    found = Moments(len(KEPT))
    shared: dict[Label, list[NDArray[np.float64]]] = {}
    for parts in maps:
        weights = weights_of([(part.setting, part.rollouts) for part in parts])
        of_seed: dict[Label, list[tuple[float, Part]]] = {}
        for weight, part in zip(weights.tolist(), parts, strict=True):
            of_seed.setdefault(part.seed, []).append((weight, part))
        errors = {seed: _errors(each) for seed, each in of_seed.items()}
        freedom = sum(max(part.rollouts for _, part in each) - 1 for each in of_seed.values())
        means = np.tensordot(weights, [part.means for part in parts], 1)
        found.add(means, np.sum([*errors.values()], axis=0), freedom)
        for seed, error in errors.items():
            shared.setdefault(seed, []).append(np.sqrt(error[:, 0, 0]) / len(maps))
    for each in shared.values():
        if len(each) > 1:
            found.shared += sum(each) ** 2
    return found


def _errors(parts: Sequence[tuple[float, Part]]) -> NDArray[np.float64]:
    """The covariances `[KEPT, L, L]` of a map's errors by one seed, which are added up as if they were one and the
    same."""
    alone = np.sum([weight**2 * part.errors for weight, part in parts], axis=0)
    apart = np.sqrt(alone[:, 0, 0])
    together = np.sum([weight * np.sqrt(part.errors[:, 0, 0]) for weight, part in parts], axis=0)
    scale: NDArray[np.float64] = np.divide(together, apart, out=np.ones_like(apart), where=apart > 0) ** 2
    return alone * scale[:, None, None]


def single_over(found: Sequence[tuple[Setting, Run, Tally]]) -> dict[str, Estimate]:
    """Estimates of one map's rollouts by name, as `single_map`, pooled over its runs.

    Runs that differ in their seed alone are one sample. The half-widths of others are averaged: they hold whatever the
    luck that they share.
    """
    samples: dict[tuple[Setting, str], tuple[Run, Tally]] = {}
    for number, (setting, run, tally) in enumerate(found):
        name = setting, tally.key.rpartition("/")[0]
        apart = number * MOST_ROLLOUTS  # rollouts of other seeds are other rollouts
        own = replace(tally, key=name[1], ids=tuple((start + apart, stop + apart) for start, stop in tally.ids))
        samples[name] = (run, samples[name][1] + own if name in samples else own)
    weights = weights_of([(setting, tally.rollouts) for (setting, _), (_, tally) in samples.items()])
    singles = [single_map(run, tally) for run, tally in samples.values()]
    return {name: _averaged([each[name] for each in singles], weights) for name in singles[0]}


def _averaged(estimates: Sequence[Estimate], weights: NDArray[np.float64]) -> Estimate:
    if len(estimates) == 1:
        return estimates[0]
    columns = np.array([(each.mean, each.se, *each.ci95) for each in estimates])
    mean, se, low, high = (weights @ columns).tolist()
    return Estimate(mean, se, (low, high))
