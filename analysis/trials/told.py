"""The team of a plan with other eyes; and told which of several maps is true, or where hazards are, each rollout
on a plan for its own."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices
from analysis.trials.measured import Sampled
from analysis.trials.trial import Trial
from planner.luck import hazards_met, rows_met
from planner.mrac.make_plan import allocated_plan
from planner.plans.plan import Plan
from planner.rollouts.by_luck import sums_by_luck
from planner.tally import Outcome, RolloutResults
from planner.worlds.doubt import LARGEST, Hazard, Uncertain
from planner.worlds.learning import seeing
from planner.worlds.world import World

MOST_MAPS = 64
"""That are planned on: those that the first rollouts meet."""
HISTOGRAMS = ("visited", "survived", "time", "alive")


def with_eyes(world: World, plan: Plan, far: float, choices: RolloutChoices) -> Trial:
    """The team if it saw so many cells far, by a plan that is its own; inf: told the map, if it is not drawn."""
    assert world.knowledge is not None
    if far == world.knowledge.sense.range:
        return Trial(world, plan, choices)
    other = seeing(world, far)
    return Trial(other, allocated_plan(other, plan.starts, plan.require(world)), choices)


def told_of_drawn(world: World, plan: Plan, choices: RolloutChoices, count: int) -> tuple[Sampled, NDArray[np.bool_]]:
    """Rollouts `0 .. count - 1` of the plan's team, each on the map drawn for it, which it is told and plans for.

    And bool `[count]`, which of them those are: the ones that meet one of the first MOST_MAPS maps.
    """
    doubt, settings = world.doubt, plan.require(world)
    assert isinstance(doubt, Uncertain)
    rows = rows_met(doubt, choices.seed, np.arange(count))[:, 0]
    met, first, which = np.unique(rows, return_index=True, return_inverse=True)
    kept = np.sort(np.argsort(first)[:MOST_MAPS])
    results = []
    for row in met[kept].tolist():
        one = replace(world, threat=doubt.threat_at(row), doubt=None, knowledge=None)
        trial = Trial(one, allocated_plan(one, plan.starts, settings), choices)
        sample = trial.sample(0, count)
        results.append(sample.results)
    within = np.isin(which, kept)
    place = np.where(within, np.searchsorted(kept, which), 0)
    columns = {
        of.name: np.stack([getattr(one, of.name) for one in results])[place, np.arange(count)]
        for of in fields(RolloutResults)[1:]
    }
    return only(replace(sample, results=RolloutResults(0, **columns)), within), within


def told_of_hazards(world: World, plan: Plan, choices: RolloutChoices, count: int) -> Sampled:
    """Rollouts `0 .. count - 1` of the plan's team, each told which cells have a hazard in it, and planning for that.

    Where one is a visit stops a robot with h; a sure stop is planned on as the largest chance below 1.
    """
    doubt, settings, results = world.doubt, plan.require(world), []
    assert isinstance(doubt, Hazard)
    for rollout, there in enumerate(hazards_met(doubt, choices.seed, np.arange(count))):
        q = np.where(there.reshape(world.shape), np.where(doubt.h < 1, 1.0, LARGEST), 0.0)
        told = replace(doubt, q=np.where(world.free, q, np.nan).astype(np.float32), detector=None)
        one = replace(world, threat=told.threat, doubt=told)
        sample = Trial(one, allocated_plan(one, plan.starts, settings), choices).sample(rollout, 1)
        assert sample.results is not None
        results.append(sample.results)
    joined = RolloutResults.join(results)
    return only(replace(sample, results=joined), np.ones(count, dtype=np.bool_))


def only(sample: Sampled, kept: NDArray[np.bool_]) -> Sampled:
    """Some rollouts of a sample that begins with id 0, with what means are made of; by luck only if all are kept."""
    assert sample.results is not None
    columns = {of.name: getattr(sample.results, of.name)[kept] for of in fields(RolloutResults)[1:]}
    results, tally, seed = RolloutResults(0, **columns), sample.tally, sample.seed if kept.all() else None
    sizes = {name: max(len(getattr(tally, name)), getattr(results, name).max(initial=0) + 1) for name in HISTOGRAMS}
    counts: dict[str, Any] = {name: np.bincount(getattr(results, name), minlength=size) for name, size in sizes.items()}
    counts["outcomes"] = np.bincount(results.outcome, minlength=len(Outcome))
    if seed is not None:
        counts["by_luck"] = sums_by_luck(results, seed, tally.robots)
    ids = ((0, int(kept.sum())),)
    return replace(sample, tally=replace(tally, ids=ids, **counts), results=results, seed=seed)
