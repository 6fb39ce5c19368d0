"""The compiled simulator's data: what every rollout reads, the state that it keeps, and what it is counted into.

Part of `planner.simulator.rollouts`, which see. Axis letters: `A` accessible cells, `K` robots, `M` areas, `T` steps,
`L`
levels of the state: sets of rollouts that wait for others which were hit. Arrays that a way of running does without
are empty; from where on they may be is told by `planner.rollouts.loop`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import DTypeLike, NDArray

from .codes import NONE, Doing, Outcome
from .jit import kernel
from .thresholds import LEAST

# Bits of sets of robots and of areas, and where a set of rollouts parts.
#
# Part of `planner.simulator.rollouts`, which see. A set is uint64 `[words]`, member i in bit i % 64 of word i / 64.

ONE = np.uint64(1)
NOT_ZERO = ir.Constant(ir.IntType(1), 1)
"""Said of a word whose zeros are counted, so that the machine need not ask."""


def instruction(result: types.Type, of: types.Type, emit: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """A function of one word that is an instruction or two of the machine, for compiled code alone."""

    @intrinsic
    def one(typing_context: Any, word: Any) -> Any:
        return result(of), lambda _context, builder, _signature, args: emit(builder, args[0])

    return one


popcount = instruction(types.uint32, types.uint32, lambda builder, word: builder.ctpop(word))
"""Bits set in a uint32 word."""
leading_zeros = instruction(types.uint32, types.uint32, lambda builder, word: builder.ctlz(word, NOT_ZERO))
"""Zeros before the first 1 of a uint32 word that is not 0."""
_zeros_below = instruction(types.int64, types.uint64, lambda builder, word: builder.cttz(word, NOT_ZERO))
_zeros_above = instruction(types.int64, types.uint64, lambda builder, word: builder.ctlz(word, NOT_ZERO))


def lowest_bit(word):
    """The number of the lowest bit of a word that is not 0."""
    return (int(word) & -int(word)).bit_length() - 1


def highest_bit(word):
    """The number of the highest bit of a word that is not 0."""
    return int(word).bit_length() - 1


@overload(lowest_bit)
def _compiled_lowest_bit(word):
    return lambda word: _zeros_below(word)


@overload(highest_bit)
def _compiled_highest_bit(word):
    return lambda word: 63 - _zeros_above(word)


def fill(bits: NDArray[np.uint64], members: NDArray[np.int64] | list[int] | slice) -> None:
    """Make `members`, numbers `[M]` or a range of them, those of the set `bits` `[W]`, and no others; not compiled."""
    flags = np.zeros(64 * len(bits), dtype=np.bool_)
    flags[members] = True
    bits[:] = np.packbits(flags, bitorder="little").view("<u8")


@kernel
def put(bits, member):
    """Add a member."""
    bits[member >> 6] |= ONE << np.uint64(member & 63)


@kernel
def drop(bits, member):
    """Take a member out."""
    bits[member >> 6] &= ~(ONE << np.uint64(member & 63))


@kernel
def holds(bits, member):
    """Whether it is one of them."""
    return bits[member >> 6] >> np.uint64(member & 63) & ONE != 0


IDLE, TRAVELING, COVERING, DONE, DEAD, FOLLOWING, RETURNING, CHARGING = map(int, Doing)
LANDING, STARTING = range(len(Doing), len(Doing) + 2)
"""What a robot does besides: it has not entered its start yet, and has no area, or has one."""
COMPLETE, ALL_ROBOTS_LOST, NO_PROGRESS, STEP_LIMIT, _, NOT_WORTH_THE_RISK, _, _ = map(int, Outcome)
PARTED, CUT, AREAS_FULL = -2, -3, -4  # none of them is NONE
"""Why a run stops before its end: its group splits; all of its mass is below the cut; there is no room for areas."""
FAR = 2**63 - 1
NO_LEVEL = 2**31 - 1
"""The level of `State.lowest` where no area is unassigned."""
NOWHERE_LEVEL = 2**16 - 1
"""The level of cells that are in no area."""

RANKED = 128
"""Cells that `Tables.ranked` holds for each cell: a robot in a safe area mostly finds its next cell among them; and
areas that `Tables.foremost` does."""
STATE_BYTES = 2**28
"""What a thread's levels may take up, about: large maps with many robots have room for smaller sets."""
MOST_NARROW = 2**13
"""Areas, and MOST_CELLS cells, that the 16 bits of a narrow state can tell apart."""
MOST_CELLS = 2**16 - 1
MOST_PASSES = 8
"""Survived visits of a cell that are told apart; what further ones add to a chance to detect is bounded
(`analysis.evaluation.outputs.value`)."""
MOST_COUNTED = 2**16 - 1
"""Survived visits of a cell that a state counts."""


class Tables(NamedTuple):
    """What every rollout reads.

    Attributes:
        near: uint16 or uint32 `[A, 4]`, neighbours N, W, E, S; A if blocked. sweep: the same, first the one that
            goes first on coverage paths (`Problem.sides`).
        cost_to: int32 or int64 `[A, A]`, safest-path cost from row to column; NONE if unreachable.
        hop_to: like near `[A, A]`, first cell of the path to the row from the column: a leg stays in one row.
        ranked: like near `[A, RANKED]`, the cells of least cost from each, by (cost, index); A after the last.
        area_cost: like cost_to `[A, M]`, cost from each cell to each area of t = 0 (its cheapest cell, visited or not);
            area_entry: like near `[A, M]`, that cell.
        foremost: like near `[A, min(M, RANKED)]`, the areas of t = 0 from each cell by the least that they ever cost
            per cell to do, or by value; M after the last. Empty where no rule asks. counted: int64 `[M]`, cells of each
            of them, or as many times the value of its best.
        entry: int64 `[A]`, cost of entering each cell (eq. (3)); empty where nothing is searched for.
        node, beside, border: the safe components, as `planner.simulator.searches.SafeParts` has them; node has no
            component at its end, `[A + 1]`. kind: like near `[A]`; cells of one kind cost the same to enter,
            `kind_cost` `[C]`, and there are `kind_begin` `[C]` cells of the kinds before it, both int64. All empty
            where there are tables.
        nearby: cells that a search passes before it is one for what is far. wide: as of `SafeParts`. patience: searches
            from a cell before its costs to all are kept. goal: cells that count. last_step: by which robots that return
            to base are to be there. recharge: steps until they have their range again, 0: they do not. quiet_steps:
            steps in a row without progress after which a run ends, unless an announced phase that changes the map
            begins later: last_update is the step of the last one, 0: none.
        truths: int16 `[M, A]`, level of each cell in each map that may be true, NONE of an obstacle, of robots that
            learn it; belief: int16 `[A]`, what they believe before the first step; price: int64 `[L]`, cost of entering
            a cell of each level; in_view: like near, what is seen from each cell, from `view_begin` int64 `[A + 1]` on
            (`planner.simulator.map_belief`). Cells that they come to believe to be within reach are accessible here,
            and `entry` is of before the first step. All empty where the map is known.
        odds, survival, step: int64 `[A]`, evidence on latent hazards (`planner.world.map_knowledge`), whose classes are
            `truths`; lessons: int64 `[LESSONS]`, the rest of it. Else empty.
        phases: int64 `[P]`, the step at which each phase of changing threats begins (`planner.simulator.map_belief`):
            then bound, exposure and chance are `[P A]`, phase by phase, and truths the levels of each; else empty.
        bound: uint32 `[A]`, 0 where no visit destroys a robot, in any rollout. own_counter, there and column `[A]` say
            how an uncertain cell is drawn, as `planner.world.uncertain_maps.Draws` does; else they are empty. spent:
            uint64 `[A / 64]`, no bits, where the first loss makes a cell harmless; else empty.
        exposure: int64 `[A]`, what a visit adds to a robot's cumulative hazard (`planner.failure_model`), the most
            where the cell is uncertain; doses: int64 `[M, C]`, that of every chance in the table of `Draws`.
        chance: float64 `[A]`, p, by which a tree parts.
        nodes, times, begun: what robots bear, if that is not plain (`planner.failure_model`), else empty: `wear_nodes`;
            int64 `[K]`, susceptibilities; int64 `[K]`, what each has borne before, to a fresh robot.
        movers: int64 `[M, MOVER_WORDS]`, threats that move, none in most worlds (`planner.simulator.moving_threats`);
        routes:
            int64, the cells of their routes, one route after the other.
        type_of: int64 `[K]`, own_level: int64 `[Y, L]`, as of `planner.mrac.home_paths.OwnMaps`; empty where robots are
            alike. Else the tables by cell `[A]` above, of costs, hops, ranks and luck, are `[Y A]`: type after type.
        pace: int64 `[K]`, steps that a move takes, empty where all have one speed; ticks: int64 `[C]`, the different
            ones; clock: uint64 `[C, K / 64]`, bits of the robots of each.
        place: int64 `[A, 2]`, (row, col) of cells; bases: int64 `[B, 2]`; reach: int64 `[1]`, squared distance over
            which robots hear each other, and bases: empty where all do (`planner.simulator.robot_types`).
        starts: int32 `[K]`. range: int64 `[K]`, moves that each robot can make.
        order: int32 `[A]`, the cells area by area; begin: int32 `[M + 1]`, where each area begins in it.
        level, owner: int32 `[M]`, the allocation at t = 0.
        given: like near `[K, steps + 1]`, the paths that robots follow first, the last cell of each repeated to the
            end; length: int32 `[K]`, steps of each; both empty where there are none.
        home_of: int64 `[K]`, the bases of each robot, of B sets, home_bases bool `[B, A]`; home_steps: int32 `[B, A]`,
            moves of the way home from each cell, NONE where it is cut off; home_cost: int64 `[B, A]`, its cost; onward:
            like near `[B, A]`, what is entered next on it, at a base that itself. As robots believe the map before the
            first step (`planner.simulator.range_budget.find_ways_home`). All empty where robots stay where they end
            (`planner.simulator.return_home`), but for home_of and onward where they drive back
            (`planner.simulator.robot_types`).
        follows .. phased: the features of a mission, None where a program does without one: none of its code is
            compiled (`jit_features.FoldAbsent`). Robots follow external paths; legs are searched for; there are no
            tables of distances; the map is uncertain; a loss makes a cell harmless; robots wear or differ in
            susceptibility; threats move; robots differ in type; in speed; radio has a range; robots return to base;
            they learn the map; they estimate hazards; threats change by phases. scores: the sums of
            `planner.rollouts.coverage_gradient` are counted.
        asks, notes, loses: None in compiled programs; choose areas in the place of the rule
            (`planner.mission.external_allocation`), note moves and areas that are made, and say which visits destroy a
            robot (`planner.rollouts.single_run`).
    """

    near: NDArray
    sweep: NDArray
    cost_to: NDArray
    hop_to: NDArray
    ranked: NDArray
    area_cost: NDArray
    area_entry: NDArray
    foremost: NDArray
    counted: NDArray
    bound: NDArray
    exposure: NDArray
    chance: NDArray
    starts: NDArray
    range: NDArray
    order: NDArray
    begin: NDArray
    level: NDArray
    owner: NDArray
    entry: NDArray
    node: NDArray
    beside: NDArray
    border: NDArray
    kind: NDArray
    kind_cost: NDArray
    kind_begin: NDArray
    own_counter: NDArray
    there: NDArray
    column: NDArray
    spent: NDArray
    doses: NDArray
    given: NDArray
    length: NDArray
    truths: NDArray
    belief: NDArray
    price: NDArray
    view_begin: NDArray
    in_view: NDArray
    odds: NDArray
    survival: NDArray
    step: NDArray
    lessons: NDArray
    phases: NDArray
    nodes: NDArray
    times: NDArray
    begun: NDArray
    movers: NDArray
    routes: NDArray
    type_of: NDArray
    own_level: NDArray
    pace: NDArray
    ticks: NDArray
    clock: NDArray
    place: NDArray
    bases: NDArray
    reach: NDArray
    home_of: NDArray
    home_bases: NDArray
    home_steps: NDArray
    home_cost: NDArray
    onward: NDArray
    nearby: int = 0
    wide: int = 0
    patience: int = 0
    goal: int = 0
    last_step: int = 0
    recharge: int = 0
    quiet_steps: int = 0
    last_update: int = 0
    follows: bool | None = None
    walks: bool | None = None
    searches: bool | None = None
    doubtful: bool | None = None
    spends: bool | None = None
    wears: bool | None = None
    moving: bool | None = None
    mixed: bool | None = None
    paced: bool | None = None
    radio: bool | None = None
    returns: bool | None = None
    learns: bool | None = None
    estimates: bool | None = None
    phased: bool | None = None
    scores: bool | None = None
    asks: Any = None
    notes: Any = None
    loses: Any = None


class How(NamedTuple):
    """What else a call depends on: the halves of luck's key, those of the key for what is in doubt, T_max, two options.

    `move0` .. `read1`: those of the keys of movers' moves, of meetings, and of readings.

    `aside`: 0, or how many sets of those who are hit the call puts aside, at most
    (`planner.simulator.rollouts.run_set`).
    `pause`, `in_area`: None in compiled programs; of a rollout that runs as Python (`planner.rollouts.single_run`),
    whether it stops after each step, and a user's own order of the cells of an area.
    `cut`: 0, or the mass below which a branch of a tree is left (`planner.rollouts.exact_tree`); `most`: histories of
    it.
    """

    key0: np.uint32
    key1: np.uint32
    own0: np.uint32
    own1: np.uint32
    max_steps: int
    first_only: bool
    stay_inside: bool
    aside: int
    move0: np.uint32
    move1: np.uint32
    meet0: np.uint32
    meet1: np.uint32
    read0: np.uint32
    read1: np.uint32
    cut: int = 0
    most: int = 0
    pause: bool | None = None
    in_area: Callable[[int, int, int], Any] | None = None


VISITED, SURVIVED, TO_DO, AREA_BITS = 1, 2, 4, 3
"""`home`: the area of a cell above AREA_BITS flags, the last of which is of the path that covers the area."""
WHOLE, LONG = np.int32, np.int64
ROBOT = np.dtype(
    [
        ("cell", WHOLE),  # where it is
        ("next", WHOLE),  # the cell that it enters next
        ("target", WHOLE),  # the end of the current leg
        ("doing", WHOLE),
        ("area", WHOLE),  # its area, if it has one
        ("left", WHOLE),  # cells still to do on its coverage path
        ("ahead", WHOLE),  # cells of `legs`, or of path `path`, after `next`; 0: one move, or in `hop_to`
        ("held", WHOLE),  # whether the cap on robots at risk keeps it from dangerous areas
        ("sure", WHOLE),  # it need not compare its area with others again until there are more `arrivals` than this
        ("path", WHOLE),  # number of its remembered coverage path, 0: none
        ("until", LONG),  # turn (`own_turn`) of the last move of a robot that moves; of one that waits, moves left
        ("borne", LONG),  # its cumulative hazard
        ("bears", LONG),  # no rollout of the group has a lower failure threshold
        ("ready", LONG),  # step in which it has its range again; FAR before it is at a base; 0: it is not recharged
    ],
    align=True,
)
AREA = np.dtype(
    [
        ("begin", WHOLE),  # its segment of `order`
        ("end", WHOLE),
        ("level", WHOLE),
        ("left", WHOLE),  # unvisited cells
        ("root", WHOLE),  # the area of t = 0 whose cells these are
    ],
    align=True,
)
GROUP = np.dtype(
    [
        (name, LONG)
        for name in (
            "step",
            "robot",  # that acts in this step
            "verdict",  # what became of it: ACTS, HIT or PASSED
            "quiet",  # steps in a row without progress
            "progress",  # whether this step has made any
            "first",  # the group's part of the ids
            "last",
            "areas",  # so far
            "open",  # unassigned areas
            "lowest",  # the level of `State.lowest`
            "unfinished",  # areas with unvisited cells
            "alive",
            "bisected",  # areas shared by bisection
            "divided",  # areas shared that lay in several components already
            "changes",  # of the unassigned areas
            "arrivals",  # areas that became unassigned
            "covered",  # cells visited
            "unsurvived",  # those of them in which no robot has survived yet
            "roamed",  # steps that moving threats have made
            "over",  # 0, or the outcome plus 1 once all robots return to base
            "at_home",  # robots at base at the end
            "now",  # 1 while a robot decides that moves in the same step
            "unlimited",  # 1 while a robot may choose what is out of its range
        )
    ],
    align=True,
)
STAYS, HITS, ROUTE, ROUTE_LENGTH, MOVER_WORDS = range(5)
"""`Tables.movers`: of 24 bits that are below, one that walks stays, and who is met is stopped; where its route begins
in `routes`, and how many cells it has, 0: it walks."""
AT_STOP, MORE, LESS, ALARM, SILENCE, DETECTS, ERRS, LESSONS = range(8)
"""`Tables.lessons`: log odds after a stop, classes above and below the first; with a detector what an alarm adds and
silence takes, and of how many of 2**24 readings the alarms are, where a hazard is and where none is; else 0."""
SEEN, LOOKED, OUT = 1, 2, 4
TRUTH, BELIEF, MIND = range(3)
"""`mind`: which of the maps is true; the number of the belief, of which a thread has kept its rows."""
RESTS, GAINS, MOVES, NO_ROOM = 0, 1, 2, -1
"""The turn of a robot: it stays, gets an area and stays, or moves; or there is no room for areas."""
ACTS, HIT, PASSED = range(3)
"""VERDICT: the next robot acts; the robot is hit in the cell that it has entered; it is not."""
WORD = 64


class State(NamedTuple):
    """A set's state; in the stack of all levels with the leading axis `L`.

    Attributes:
        home: uint16 or uint32 `[A + 1]`, each cell's area and flags; the last one stands for what is blocked.
        order: like home `[A]`, the cells area by area; what is completed is not kept in order.
        areas: AREA `[room]`. robots: ROBOT `[K]`. marks: GROUP.
        legs: like home `[K, A]`, the cells of legs that were searched for, last first; else empty.
        movers, waiting: uint64 `[K / 64]`, bits of the robots that move, and of those that could take an area.
        open: uint64 `[room / 64]`, bits of the unassigned areas; words beyond the last area hold anything.
        lowest: like open, those of level `marks.lowest`; no unassigned area has a lower one.
        spent: uint64 `[A / 64]`, bits of the cells that a hit made harmless, or empty.
        passes: uint16 `[A]`, survived visits of each cell, MOST_COUNTED for more; empty where nobody asks. With
            `Tables.scores` `[2 A]`: behind them the robots lost in each cell.
        entered: uint64 `[K / 64]`, bits of the robots that have entered a cell in this step; empty where nothing moves
            but robots: only then it is not said by the end of their turns whether they survive there.
        heard: uint64 `[K / 64]`, scratch; empty where robots hear each other everywhere.
        near, entry, level: like `Tables.near`, `entry` and `truths[m]`, as robots that learn believe it; known: uint8
            `[A]`, SEEN, LOOKED from, OUT of every area and not visited; fate: like home `[room]`, scratch; mind: int64
            `[MIND]`. All empty where they are told. odds: like `Tables.odds`, by now.
    """

    home: NDArray
    order: NDArray
    areas: NDArray
    robots: NDArray
    marks: NDArray
    movers: NDArray
    waiting: NDArray
    open: NDArray
    lowest: NDArray
    passes: NDArray
    legs: NDArray
    spent: NDArray
    entered: NDArray
    heard: NDArray
    near: NDArray
    entry: NDArray
    level: NDArray
    known: NDArray
    fate: NDArray
    mind: NDArray
    odds: NDArray


class Work(NamedTuple):
    """Scratch of one thread.

    Attributes:
        seen: int64 `[A + 1]`, cells met in the search of this number; stamp: int64 `[1]`, searches so far.
        stack, listed: uint32 `[A]`, cells. words: uint32 `[B]`, random words and ids of a set.
        left: int64 `[B, K]`, what is left of tolerances where the map is in doubt, of ids from `begin` int64 `[1]` on.
        at: int64 `[B, M]`, where movers are in each rollout, a cell (A: out of reach) or a place on the route; met:
            int64 `[B]`, the robot that is met next; both of ids from `begin` on. here: int64 `[A + 1]`, zeros.
        moves: uint32 `[2, M]`, words of one rollout's moves.
        kept: int64 `[K, 5]`, of a robot that waits: what its first area was at so many changes, seen from which cell.
        rows: like cost_to `[R, A + 1]` or empty, from some cells to every one, NONE if unreachable, and at the end;
            row_costs, row_entries: like area_cost and area_entry `[R, M]`, from the same cells. row_of: int32 `[A]`,
            the row from a cell, NONE if there is none; source_of: int32 `[R]`, the other way round; asked: uint8
            `[A]`, searches from each cell; oldest: int64 `[1]`, the row that is the next to go; last: int64 `[1]`, the
            row that gave the last answer, NONE if a search did; heads, tails: int64 `[C]` (`planner.simulator.paths`).
        paths: uint32 `[P]`, coverage paths that are remembered, each behind its key (`planner.simulator.return_home`);
        ends:
            int64 `[P / 32]`, where path n = 1, 2, .. ends; slots: uint16 `[P / 16]`, a path by its key's hash, 0: none.
            Empty where none are remembered. remembered: int64 `[1]`, the number of the next one.
        everywhere: bool `[A + 1]`, all cells but the last one. The others are `[A]` (distance with NONE at its end), or
            empty, as of `SafestPaths` and `far_search`.
        part: int64 `[A + 1]`, gone: uint8 `[A]`, news: uint32 `[A]`, minds: int64 `[2]`, the beliefs so far, and the
            one that rows are of (`planner.simulator.map_belief`); the first three are empty where robots are told.
    """

    seen: NDArray
    stamp: NDArray
    stack: NDArray
    listed: NDArray
    kept: NDArray
    rows: NDArray
    row_costs: NDArray
    row_entries: NDArray
    row_of: NDArray
    source_of: NDArray
    asked: NDArray
    oldest: NDArray
    heads: NDArray
    tails: NDArray
    last: NDArray
    words: NDArray
    left: NDArray
    begin: NDArray
    at: NDArray
    met: NDArray
    here: NDArray
    moves: NDArray
    rank: NDArray
    everywhere: NDArray
    distance: NDArray
    queue: NDArray
    heap_cost: NDArray
    heap_cell: NDArray
    to_go: NDArray
    touched: NDArray
    paths: NDArray
    slots: NDArray
    ends: NDArray
    remembered: NDArray
    part: NDArray
    gone: NDArray
    news: NDArray
    minds: NDArray


class Counts(NamedTuple):
    """What rollouts are counted into, int64; see planner.tally.Tally.

    Attributes:
        visits, stops, covered: `[A]`, entries, robots stopped, rollouts that visited the cell; unsurvived: `[A]`, those
            of them in which nobody survived there.
        time: `[T + 1]`; new: `[T + 1]`, cells new at each step; late: `[T + 1]`, what more of them was survived then.
        visited, survived: `[GOAL + 1]`; alive: `[K + 1]`; outcomes: `[len(Outcome)]`.
        left_visited, left_survived, left_alive: as those, the mass of a tree that was left, by what it had come to;
            histories: `[3]`, ends of a tree, branches left, visits at which it may part. Zeros but for trees.
        home: `[K + 1]`, rollouts by robots at home at the end; empty where they do not come home.
        passes: `[A, MOST_PASSES]`, rollouts with 1, 2, ... or more survived visits of the cell; no rows: not asked for.
            With `Tables.scores`: float64 `[A, 2]`, sums over rollouts of the cells covered times the robots lost in the
            cell, and times its survived visits. Of rollouts they are whole numbers, exact below 2**53.
    """

    visits: NDArray
    stops: NDArray
    covered: NDArray
    unsurvived: NDArray
    time: NDArray
    new: NDArray
    late: NDArray
    visited: NDArray
    survived: NDArray
    alive: NDArray
    outcomes: NDArray
    left_visited: NDArray
    left_survived: NDArray
    left_alive: NDArray
    histories: NDArray
    home: NDArray
    passes: NDArray


class Singles(NamedTuple):
    """What is kept of single rollouts; arrays without rows: nothing.

    Attributes:
        numbers: int32 `[B, SINGLES]`. worth: int64 `[B, 2]`, the sums over cells of the two tables below.
        covered: int64 `[A]`, what a cell that is visited adds.
        found: int64 `[A, MOST_PASSES + 1]`, what one adds by its survived visits.
        start: the id of the first one, in row 0.
    """

    numbers: NDArray
    worth: NDArray
    covered: NDArray
    found: NDArray
    start: int


REMEMBERED, MOST_PATHS = 2**24, 2**16
"""Most words of `Work.paths`, 64 MB, and paths that 16 bits tell apart; maps have 256 to 512 words for each cell.
Thousands of words that were filled: 113 by 4,096 rollouts of the terrain, 98 by 16,384 on 64x64 with 25 % of threats,
168 by 262,144 on 20x20."""
SINGLES = 8
"""Numbers kept of a single rollout: visited, survived, time, alive, outcome, bisected, divided, home."""
ROWS_BYTES = 2**28
"""What a thread's rows of costs may take up, about; two of them there are always."""


def make_counts(
    cells: int, goal: int, robots: int, steps: int, passes: bool = False, home: bool = False, scores: bool = False
) -> Counts:
    """Empty counts for rollouts of at most `steps` steps, in which `goal` of the cells can be visited.

    `passes`: survived visits are counted too; `home`: robots at home; `scores`: see `Tables`.
    """
    figures = (goal + 1, goal + 1, robots + 1)
    sizes = (*[cells] * 4, *[steps + 1] * 3, *figures, len(Outcome), *figures, 3, home * (robots + 1))
    by_cell = np.zeros((cells, 2)) if scores else np.zeros((cells if passes else 0, MOST_PASSES), dtype=np.int64)
    return Counts(*[*(np.zeros(size, dtype=np.int64) for size in sizes), by_cell])


def first_room(tables: Tables) -> int:
    """Areas that a rollout hardly ever exceeds, in 16 bits if those of t = 0 take up at most half of them."""
    given = len(tables.level)
    room = given + 4 * len(tables.near)
    return min(room, MOST_NARROW) if 2 * given <= MOST_NARROW else room


def fits_narrow(tables: Tables, room: int) -> bool:
    """Whether 16 bits hold the state of so many areas."""
    return room <= MOST_NARROW and len(tables.near) < MOST_CELLS


def first_state(tables: Tables, room: int, passes: bool = False) -> State:
    """t = 0, before any robot has entered its start, with room for `room` areas; `passes`: they are counted."""
    size, team = len(tables.near), len(tables.starts)
    # Half the bytes: copying states is a good part of what parting costs.
    kind: DTypeLike = np.uint16 if fits_narrow(tables, room) else np.uint32
    searching = team if len(tables.entry) else 0
    words = (-(-team // WORD), -(-team // WORD), -(-room // WORD), -(-room // WORD))
    rows = np.zeros(size + 1, dtype=kind), np.zeros(size, dtype=kind), np.zeros(room, AREA), np.zeros(team, ROBOT)
    bits = [np.zeros(count, dtype=np.uint64) for count in words]
    passed = np.zeros(2 * size if tables.scores else size if passes else 0, dtype=np.uint16)
    legs, spent = np.zeros((searching, size), dtype=kind), np.zeros(len(tables.spent), dtype=np.uint64)
    entered = np.zeros(words[0] if len(tables.movers) else 0, dtype=np.uint64)
    heard = np.zeros(words[0] if len(tables.reach) else 0, dtype=np.uint64)
    more = passed, legs, spent, entered, heard, *_first_mind(tables, room, kind)
    state = State._make((*rows, np.zeros((), GROUP), *bits, *more))
    _begin(state, tables)
    return state


def _first_mind(tables: Tables, room: int, kind: DTypeLike) -> Iterator[NDArray]:
    """What robots that learn believe at first: the last fields of a `State`."""
    learning, size = bool(len(tables.truths)), len(tables.belief)
    free = np.append(tables.belief >= 0, False)
    near = tables.near[:size]
    yield np.where(free[near], near, size).astype(near.dtype)
    yield (
        np.where(free[:-1], tables.price[np.maximum(tables.belief, 0)], 0) if learning else np.zeros(0, dtype=np.int64)
    )
    yield tables.belief.copy()
    yield np.zeros(size, dtype=np.uint8)
    yield np.zeros(room if learning else 0, dtype=kind)
    yield np.zeros(MIND if learning else 0, dtype=np.int64)
    yield tables.odds.copy()


def make_state(first: State, levels: int) -> State:
    """A stack of so many levels, fewer where they would not fit in STATE_BYTES; `first`: what sets begin with."""
    a_level = sum(row[:1].nbytes for row in first)
    levels = min(levels, max(1, STATE_BYTES // a_level))
    return State._make(np.empty((levels, *row.shape[1:]), dtype=row.dtype) for row in first)


def largest_set(state: State, most: int) -> int:
    """Rollouts that a set with such a stack may have, at most `most`.

    A level for each robot and one more serve any set. With fewer it may have no more rollouts than there are levels,
    since whoever waits leaves at least one rollout behind.
    """
    levels, robots = state.robots.shape
    return most if levels > robots else min(levels, most)


def _begin(state: State, tables: Tables) -> None:
    """Write t = 0, before any robot has entered its start."""
    given = len(tables.level)
    sizes = np.diff(tables.begin)
    if len(state.mind):  # what is in no area: an obstacle, or out of reach
        state.home[:] = len(state.areas) - 1 << AREA_BITS | VISITED | SURVIVED
        state.known[:], state.known[tables.order] = OUT, 0
        state.areas["level"][-1] = NOWHERE_LEVEL
        for cell in tables.starts if len(tables.truths) == 1 else ():
            state.known[tables.in_view[tables.view_begin[cell] : tables.view_begin[cell + 1]]] |= SEEN
    state.home[tables.order] = np.repeat(np.arange(given), sizes) << AREA_BITS
    # What is blocked looks visited and belongs to no area: no neighbour has to be asked whether it is a cell.
    state.home[-1] = VISITED | SURVIVED
    state.order[: len(tables.order)] = tables.order
    rows = (tables.begin[:-1], tables.begin[1:], tables.level, sizes, np.arange(given))
    for word, values in zip(AREA.names or (), rows, strict=True):
        state.areas[word][:given] = values
    robots, has_owner = state.robots, tables.owner != NONE
    owned, unassigned = np.flatnonzero(has_owner), np.flatnonzero(~has_owner)
    for word in ("cell", "next", "target"):
        robots[word] = tables.starts
    robots["doing"] = LANDING
    if len(tables.given):
        robots["doing"] = FOLLOWING
    else:
        robots["doing"][tables.owner[owned]], robots["area"][tables.owner[owned]] = STARTING, owned
    robots["until"], robots["bears"], robots["sure"] = tables.range, LEAST, NONE
    levels = tables.level[unassigned]
    lowest = levels.min(initial=NO_LEVEL)
    words = {"areas": given, "open": len(unassigned), "lowest": lowest, "unfinished": given}
    for word, value in (words | {"alive": len(tables.starts)}).items():
        state.marks[word] = value
    for bits, members in (
        (state.movers, slice(len(tables.starts))),
        (state.open, unassigned),
        (state.lowest, unassigned[levels == lowest]),
    ):
        fill(bits, members)


def make_work(tables: Tables, most: int, remembers: bool, known: Work | None = None) -> Work:
    """Scratch for sets of at most `most` rollouts; `remembers`: with room for paths; `known`: of an earlier call."""
    kept = most if len(tables.exposure) and len(tables.own_counter) else 0
    words, left = np.zeros(most, dtype=np.uint32), np.zeros((kept, len(tables.starts)), dtype=np.int64)
    at = np.zeros((most if len(tables.movers) else 0, len(tables.movers)), dtype=np.int64)
    met = np.zeros(len(at), dtype=np.int64)
    if known is not None:
        return known._replace(words=words, left=left, at=at, met=met)
    size, learning = len(tables.near), len(tables.truths) > 0
    searched = size if len(tables.entry) else 0
    remembered = min(REMEMBERED, 2 ** (8 + size.bit_length())) if remembers else 0
    rows = 0 if len(tables.cost_to) else max(2, min(size, ROWS_BYTES // (size * tables.cost_to.itemsize)))
    apart = searched + 1 if searched else 0
    return Work(
        seen=np.zeros(size + 1, dtype=np.int64),
        stamp=np.zeros(1, dtype=np.int64),
        stack=np.zeros(size, dtype=np.uint32),
        listed=np.zeros(size, dtype=np.uint32),
        kept=np.full((len(tables.starts), 5), NONE, dtype=np.int64),
        rows=np.empty((rows, size + 1), dtype=tables.cost_to.dtype),
        row_costs=np.empty((rows, len(tables.level)), dtype=tables.cost_to.dtype),
        row_entries=np.empty((rows, len(tables.level)), dtype=tables.near.dtype),
        row_of=np.full(searched, NONE, dtype=np.int32),
        source_of=np.full(rows, NONE, dtype=np.int32),
        asked=np.zeros(searched, dtype=np.uint8),
        oldest=np.zeros(1, dtype=np.int64),
        heads=np.zeros(len(tables.kind_cost), dtype=np.int64),
        tails=np.zeros(len(tables.kind_cost), dtype=np.int64),
        last=np.full(1, NONE, dtype=np.int64),
        words=words,
        left=left,
        begin=np.zeros(1, dtype=np.int64),
        at=at,
        met=met,
        here=np.zeros(size + 1, dtype=np.int64),
        moves=np.zeros((2, len(tables.movers)), dtype=np.uint32),
        rank=np.full(searched, NONE, dtype=np.int32),
        everywhere=np.arange(apart) < searched,
        distance=np.full(apart, NONE, dtype=np.int64),
        queue=np.zeros(searched, dtype=np.uint32),
        heap_cost=np.zeros(searched, dtype=np.int64),
        heap_cell=np.zeros(searched, dtype=np.int32),
        to_go=np.zeros(searched, dtype=np.int64),
        touched=np.zeros(searched, dtype=np.int64),
        paths=np.empty(remembered, dtype=np.uint32),
        slots=np.zeros(min(remembered // 2**4, 2 * MOST_PATHS), dtype=np.uint16),
        ends=np.zeros(min(remembered // 2**5, MOST_PATHS), dtype=np.int64),
        remembered=np.ones(1, dtype=np.int64),
        part=np.zeros(size + 1 if learning else 0, dtype=np.int64),
        gone=np.zeros(size if learning else 0, dtype=np.uint8),
        news=np.zeros(size if learning else 0, dtype=np.uint32),
        minds=np.zeros(2, dtype=np.int64),
    )
