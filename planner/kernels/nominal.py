"""The nominal run by the compiled simulator: a hundred times quicker than the readable one, once it is compiled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planner.kernels.closed_loop import trace_rollouts
from planner.kernels.loop import ClosedLoop
from planner.kernels.state import GOAL
from planner.plans.plan import Plan, RobotPlan, last_move
from planner.trace import EventKind, Trace


def nominal_trace(loop: ClosedLoop) -> Trace:
    """The run of a closed loop with no hits, in which all is as robots believe it once they have looked about."""
    tables = loop.tables
    safe = tables._replace(bound=np.zeros_like(tables.bound), movers=tables.movers[:0])
    if loop.learns and not len(tables.phases):  # threats change whatever happens
        limits = tables.limits.copy()
        limits[GOAL] = len(tables.order)
        safe = safe._replace(truths=tables.belief[None], limits=limits)
    policy = None if loop.policy is None else loop.policy._replace(view_begin=loop.policy.view_begin[:0])
    begin = replace if loop.learns or loop.movers is not None else ClosedLoop.again
    return trace_rollouts(begin(loop, tables=safe, movers=None, doubt=None, policy=policy), 0, (0,))[0]


def with_nominal_run(plan: Plan, loop: ClosedLoop) -> Plan:
    """A plan of which areas and starts are known (`allocated_plan`), with its nominal run; `loop`: its closed loop.

    Equal to the plan of `make_plan` but for legs and the areas that sharing adds, which it does without.
    """
    trace = nominal_trace(loop)
    paths = [path[: last_move(path) + 1] for path in trace.cells.T.astype(np.int64)]
    return replace(
        plan,
        robots=tuple(map(RobotPlan, paths)),
        outcome=plan.ending(trace.outcome).word,
        time=len(trace.cells) - 1,
        shares=int(np.count_nonzero(trace.events[:, 2] == EventKind.SHARED)),
    )
