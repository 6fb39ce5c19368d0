"""The compiled simulator's data: tables, the state of a group of rollouts, scratch arrays, and counts.

Axis letters: `A` accessible cells, `K` robots, `M` areas, `T` steps, `L` levels of the stack of states (groups that
wait for groups that split off). Arrays of features that a mission does not use are empty.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import DTypeLike, NDArray

from .codes import FOLLOWING, LANDING, NONE, STARTING, Outcome
from .jit import kernel
from .thresholds import LEAST

# Sets of robots and of areas as bits: uint64 `[words]`, member i in bit i % 64 of word i / 64.

ONE = np.uint64(1)
NOT_ZERO = ir.Constant(ir.IntType(1), 1)
"""Operand of a zero count: the word is not 0, so that the machine need not test it."""


def instruction(result: types.Type, of: types.Type, emit: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """A function of one word that is one or two machine instructions; in compiled code only.

    Args:
        result: Numba type of the result.
        of: Numba type of the word.
        emit: makes the instruction from an IR builder and the word.
    """

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
    """Index of the lowest bit of a word that is not 0."""
    return (int(word) & -int(word)).bit_length() - 1


def highest_bit(word):
    """Index of the highest bit of a word that is not 0."""
    return int(word).bit_length() - 1


@overload(lowest_bit)
def _compiled_lowest_bit(word):
    return lambda word: _zeros_below(word)


@overload(highest_bit)
def _compiled_highest_bit(word):
    return lambda word: 63 - _zeros_above(word)


def fill(bits: NDArray[np.uint64], members: NDArray[np.int64] | list[int] | slice) -> None:
    """Make `bits` the set of these members; not compiled.

    Args:
        bits: uint64 `[W]`, changed in place.
        members: int64 `[M]`, or a range of them.
    """
    flags = np.zeros(64 * len(bits), dtype=np.bool_)
    flags[members] = True
    bits[:] = np.packbits(flags, bitorder="little").view("<u8")


@kernel
def put(bits, member):
    """Add a member to a set."""
    bits[member >> 6] |= ONE << np.uint64(member & 63)


@kernel
def drop(bits, member):
    """Remove a member from a set."""
    bits[member >> 6] &= ~(ONE << np.uint64(member & 63))


@kernel
def holds(bits, member):
    """Whether a set holds the member."""
    return bits[member >> 6] >> np.uint64(member & 63) & ONE != 0


FAR = 2**63 - 1
NO_LEVEL = 2**31 - 1
"""The level of `State.lowest` if no area is unassigned."""
NOWHERE_LEVEL = 2**16 - 1
"""The level of the cells that are in no area."""

RANKED = 128
"""Cells that `Tables.ranked` holds for each cell (a robot in a safe area mostly finds its next cell among them), and
areas that `Tables.foremost` holds."""
STATE_BYTES = 2**28
"""Approximate limit on the levels of one thread: large maps with many robots have room for smaller groups."""
MOST_NARROW = 2**13
"""Areas, and MOST_CELLS cells, that 16 bits of a narrow state can number."""
MOST_CELLS = 2**16 - 1
MOST_PASSES = 8
"""Survived visits of a cell that are counted apart; the effect of more on the chance to detect is bounded
(`analysis.evaluation.outputs.value`)."""
MOST_COUNTED = 2**16 - 1
"""Survived visits of a cell that a state counts."""
STAYS, HITS, ROUTE, ROUTE_LENGTH, THREAT_WORDS = range(5)
"""Columns of `Tables.moving_threats`: chances, of 2**24, that a walking threat stays and that it destroys a robot; the
begin of its route in `routes`; cells of the route, 0: it walks at random."""


class Tables(NamedTuple):
    """Arrays and numbers that every rollout reads.

    Attributes:
        near: uint16 or uint32 `[A, 4]`, neighbours N, W, E, S; A if blocked. sweep: the same, ordered by the sides'
            priority on coverage paths (`Problem.sides`).
        cost_to: int32 or int64 `[A, A]`, safest-path cost from row to column; NONE if unreachable.
        hop_to: like near `[A, A]`, first cell of the path to the row from the column. By target: a leg reads one row.
        ranked: like near `[A, RANKED]`, the cells of least cost from each, by (cost, index); A after the last.
        area_cost: like cost_to `[A, M]`, cost from each cell to each area of t = 0 (its cheapest cell, visited or not);
            area_entry: like near `[A, M]`, that cell.
        foremost: like near `[A, min(M, RANKED)]`, areas of t = 0 for each cell in increasing order of the lower bound
            on their cost per cell to do, or per value; M after the last. Empty where no rule uses it. counted: int64
            `[M]`, cells of each area, or the number of cells times the largest value in it.
        entry: int64 `[A]`, cost of entering each cell (eq. (3)); empty where distances are in tables.
        node, beside, border: the safe components, as in `planner.simulator.searches.SafeParts`; node ends with no
            component, `[A + 1]`. kind: like near `[A]`; cells of one kind cost the same to enter: `kind_cost` `[C]`.
            `kind_begin` `[C]` counts the cells of the kinds before it; both int64. All empty where there are tables.
        nearby: cells that a search passes before the long-range search takes over. wide: as in `SafeParts`. patience:
            searches from a cell before its costs to all cells are kept. goal: cells that count. last_step: step by
            which robots that return to base have to be there. recharge: steps of a recharge, 0: none. deliver_every:
            cells to deliver with which a robot returns and goes on, 0: none. deliver_value: likewise the sum of their
            `cell_value`, int64 `[A]`, empty unless it is used. quiet_steps: steps in a row without
            progress after which a run ends, unless a phase is announced for later. last_update: the step of the last
            announced phase, 0: none.
        truths: int16 `[M, A]`, level of each cell in each candidate of the true map, NONE for an obstacle; of online
            missions. belief: int16 `[A]`, the prior map. price: int64 `[L]`, cost of entering a cell of each level.
            in_view: like near, the cells within sensor range of each cell, from `view_begin` int64 `[A + 1]` on
            (`planner.simulator.map_belief`). Cells that may turn out to be reachable are accessible here, and `entry`
            is that of the prior map. All empty for a known map.
        odds, survival, step: int64 `[A]`, evidence on latent hazards (`planner.world.map_knowledge`), whose classes are
            `truths`. evidence: int64 `[EVIDENCE]`, the other numbers of it. Else empty.
        phases: int64 `[P]`, first step of each phase of changing threats (`planner.simulator.map_belief`). Then bound,
            exposure and chance are `[P A]`, phase by phase, and truths holds the levels of each; else empty.
        bound: uint32 `[A]`, 0 where no visit destroys a robot in any rollout. own_counter, there, column: `[A]`, how an
            uncertain cell is drawn (`planner.world.uncertain_maps.Draws`); else empty. spent: uint64 `[A / 64]`, no
            bits set, where the first loss makes a cell harmless; else empty.
        exposure: int64 `[A]`, hazard that a visit adds to a robot's cumulative hazard (`planner.failure_model`), the
            largest where the cell is uncertain. doses: int64 `[M, C]`, that of every probability in `Draws`.
        chance: float64 `[A]`, p; a tree splits by it.
        nodes, times, begun: the failure model where it is not Exp(1) for all (`planner.failure_model`), else empty:
            `weibull_nodes`; int64 `[K]`, hazard multipliers; int64 `[K]`, the Exp(1) hazard of earlier use.
        moving_threats: int64 `[M, THREAT_WORDS]`, moving threats, usually none (`planner.simulator.moving_threats`).
        routes: int64, the cells of their routes, one route after the other.
        type_of: int64 `[K]`, own_level: int64 `[Y, L]`, as in `planner.mrac.home_paths.OwnMaps`; empty for one robot
            type. Otherwise the tables by cell `[A]` of costs, hops, ranks and hazards are `[Y A]`: type after type.
        pace: int64 `[K]`, steps that a move takes, empty where all robots have one speed. ticks: int64 `[C]`, the
            different ones. clock: uint64 `[C, K / 64]`, the robots of each as bits.
        place: int64 `[A, 2]`, (row, col) of cells. bases: int64 `[B, 2]`. reach: int64 `[1]`, squared radio range
            between robots, and to bases; empty where radio has no limit (`planner.simulator.robot_types`).
            which robots hear each other, and bases: empty where all do (`planner.simulator.robot_types`).
        starts: int32 `[K]`. range: int64 `[K]`, moves that each robot can make.
        order: int32 `[A]`, the cells area by area; begin: int32 `[M + 1]`, where each area begins in it.
        level, owner: int32 `[M]`, the allocation at t = 0.
        given: like near `[K, steps + 1]`, external paths that robots follow first, the last cell repeated to the end.
            length: int32 `[K]`, steps of each. Both empty where there are none.
        home_of: int64 `[K]`, the set of bases of each robot, of B sets. home_bases: bool `[B, A]`. home_steps: int32
            `[B, A]`, moves of the way to base from each cell, NONE where there is none. home_cost: int64 `[B, A]`, its
            cost. onward: like near `[B, A]`, its next cell; at a base that cell. Of the prior map
            (`planner.simulator.range_budget.find_ways_to_base`). All empty where robots do not return to base
            (`planner.simulator.return_home`), except home_of and onward where robots drive back into radio range
            (`planner.simulator.robot_types`).
        follows .. phased: the features of a mission, None where it does not use one: no code of it is compiled
            (`jit_features.FoldAbsent`). In this order: robots follow external paths; legs are found by searches;
            distances are (no tables); the map is uncertain; a loss makes a cell harmless; Weibull shape or hazard
            multipliers; moving threats; several robot types; several speeds; radio range; return to base; online map
            updates; hazard estimates; phases. scores: sums of `planner.rollouts.coverage_gradient` are counted.
        asks, notes, loses: None in compiled programs. Callbacks that choose areas in place of the rule
            (`planner.mission.external_allocation`), record moves and new areas, and say which visits destroy a robot
            (`planner.rollouts.single_run`).
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
    doses: NDArray
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
    given: NDArray
    length: NDArray
    in_view: NDArray
    onward: NDArray
    own_counter: NDArray = np.zeros(0, np.uint32)
    there: NDArray = np.zeros(0, np.uint32)
    column: NDArray = np.zeros(0, np.int32)
    spent: NDArray = np.zeros(0, np.uint64)
    truths: NDArray = np.zeros((0, 0), np.int16)
    belief: NDArray = np.zeros(0, np.int16)
    price: NDArray = np.zeros(0, np.int64)
    view_begin: NDArray = np.zeros(0, np.int64)
    odds: NDArray = np.zeros(0, np.int64)
    survival: NDArray = np.zeros(0, np.int64)
    step: NDArray = np.zeros(0, np.int64)
    evidence: NDArray = np.zeros(0, np.int64)
    phases: NDArray = np.zeros(0, np.int64)
    nodes: NDArray = np.zeros(0, np.int64)
    times: NDArray = np.zeros(0, np.int64)
    begun: NDArray = np.zeros(0, np.int64)
    moving_threats: NDArray = np.zeros((0, THREAT_WORDS), np.int64)
    routes: NDArray = np.zeros(0, np.int64)
    type_of: NDArray = np.zeros(0, np.int64)
    own_level: NDArray = np.zeros((0, 0), np.int64)
    pace: NDArray = np.zeros(0, np.int64)
    ticks: NDArray = np.zeros(0, np.int64)
    clock: NDArray = np.zeros((0, 0), np.uint64)
    place: NDArray = np.zeros((0, 2), np.int64)
    bases: NDArray = np.zeros((0, 2), np.int64)
    reach: NDArray = np.zeros(0, np.int64)
    home_of: NDArray = np.zeros(0, np.int64)
    home_bases: NDArray = np.zeros((0, 0), np.bool_)
    home_steps: NDArray = np.zeros((0, 0), np.int32)
    home_cost: NDArray = np.zeros((0, 0), np.int64)
    cell_value: NDArray = np.zeros(0, np.int64)
    nearby: int = 0
    wide: int = 0
    patience: int = 0
    goal: int = 0
    last_step: int = 0
    recharge: int = 0
    deliver_every: int = 0
    deliver_value: int = 0
    quiet_steps: int = 0
    last_update: int = 0
    follows: bool | None = None
    walks: bool | None = None
    searches: bool | None = None
    uncertain: bool | None = None
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
    """Options of a call: keys of the random numbers, limits, and callbacks.

    Attributes:
        key0, key1: halves of the key of failure thresholds. own0, own1: of uncertain cells. move0, move1: of moves of
            threats. meet0, meet1: of encounters. read0, read1: of detector readings.
        max_steps: T_max. first_only: only the first visit of a cell is checked. stay_inside: legs stay in their area.
        deferred: 0, or the most groups that the call defers (`planner.simulator.rollouts.run_group_tasks`).
        cut: 0, or the mass below which a branch of a tree is left (`planner.rollouts.exact_tree`). most: its largest
            number of histories.
        pause, in_area: None in compiled programs. Of a rollout that runs as Python (`planner.rollouts.single_run`):
            whether it returns after each step, and a user's order of the cells of an area.
    """

    key0: np.uint32
    key1: np.uint32
    own0: np.uint32
    own1: np.uint32
    max_steps: int
    first_only: bool
    stay_inside: bool
    deferred: int
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
"""`State.home` holds the area of a cell above AREA_BITS flags. TO_DO marks a cell of its robot's coverage path."""
WHOLE, LONG = np.int32, np.int64
ROBOT = np.dtype(
    [
        ("cell", WHOLE),  # index of its cell
        ("next", WHOLE),  # the cell that it enters next
        ("target", WHOLE),  # the end of the current leg
        ("doing", WHOLE),
        ("area", WHOLE),  # its area, if it has one
        ("left", WHOLE),  # cells still to do on its coverage path
        ("ahead", WHOLE),  # cells of `legs`, or of path `path`, after `next`; 0: one move, or the leg is in `hop_to`
        ("held", WHOLE),  # whether the cap on robots at risk keeps it from dangerous areas
        ("sure", WHOLE),  # it need not compare its area with others again until `arrivals` exceeds this
        ("path", WHOLE),  # index of its cached coverage path, 0: none
        ("until", LONG),  # turn (`own_turn`) of the last move of a moving robot; moves left of a waiting one
        ("cumulative_hazard", LONG),
        ("least_threshold", LONG),  # no rollout of the group has a lower failure threshold
        ("ready", LONG),  # step at which its recharge ends; FAR before it is at a base; 0: no recharge
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
            "verdict",  # of its visit: ACTS, HIT or PASSED
            "quiet",  # steps in a row without progress
            "progress",  # whether this step has made any
            "first",  # the group's segment of the ids
            "last",
            "areas",  # so far
            "open",  # unassigned areas
            "lowest",  # the level of `State.lowest`
            "unfinished",  # areas with unvisited cells
            "alive",
            "bisected",  # areas shared by bisection
            "divided",  # areas shared that were in several components already
            "changes",  # of the unassigned areas
            "arrivals",  # areas that became unassigned
            "covered",  # cells visited
            "unsurvived",  # visited cells in which no robot has survived yet
            "threats_moved",  # steps in which threats have moved
            "over",  # 0, or the outcome plus 1 once all robots return to base
            "at_home",  # robots at base at the end
            "delivered",  # cells delivered
            "now",  # 1 while a robot decides that moves in the same step
            "unlimited",  # 1 while areas out of a robot's range may be chosen
        )
    ],
    align=True,
)
AT_STOP, MORE, LESS, ALARM, SILENCE, DETECTS, ERRS, EVIDENCE = range(8)
"""`Tables.evidence`: log odds after a loss; classes above and below the first; with a detector the log odds that an
alarm adds and silence subtracts, and the alarms of 2**24 readings at a hazard and elsewhere; else 0."""
SEEN, LOOKED, OUT = 1, 2, 4
TRUTH, BELIEF, MIND = range(3)
"""`State.mind`: index of the true map; index of the team's map, to which cached rows of costs belong."""
WORD = 64


class State(
    namedtuple(
        "State",
        "home order areas robots marks moving waiting open lowest passes legs spent entered heard near entry "
        "level known fate mind odds undelivered",
    )
):
    """State of a group of rollouts; in the stack of states with the leading axis `L`.

    Attributes:
        home: uint16 or uint32 `[A + 1]`, each cell's area and flags; the last element stands for blocked neighbours.
        order: like home `[A]`, the cells area by area; completed areas are not kept in order.
        areas: AREA `[room]`. robots: ROBOT `[K]`. marks: GROUP.
        legs: like home `[K, A]`, the cells of legs that were searched for, last first; else empty.
        moving, waiting: uint64 `[K / 64]`, bits of the robots that move, and of those that could take an area.
        open: uint64 `[room / 64]`, bits of the unassigned areas; words beyond the last area are undefined.
        lowest: like open, those of level `marks.lowest`; no unassigned area has a lower one.
        spent: uint64 `[A / 64]`, bits of the cells that a loss made harmless, or empty.
        passes: uint16 `[A]`, survived visits of each cell, MOST_COUNTED for more; empty where they are not counted.
            With `Tables.scores` `[2 A]`: followed by the robots lost in each cell.
        entered: uint64 `[K / 64]`, bits of the robots that have entered a cell in this step. Only with moving threats,
            which decide at the end of the step whether a robot survives; else empty.
        heard: uint64 `[K / 64]`, scratch; empty where radio has no limit.
        near, entry, level: like `Tables.near`, `entry` and `truths[m]`, as the team's map has them. known: uint8 `[A]`,
            flags: SEEN by a sensor, LOOKED from, OUT of every area and not visited. fate: like home `[room]`, scratch.
            mind: int64 `[MIND]`. All empty for a known map. odds: like `Tables.odds`, updated.
        undelivered: uint64 `[K + 1, A / 64]`, bits of the cells that each robot has visited since its last base;
            the last row: cells delivered. Without rows where robots do not return, or a resumed mission does not know.
    """


class Work(
    namedtuple(
        "Work",
        "seen stamp stack listed kept rows row_costs row_entries row_of source_of asked oldest heads tails last "
        "words left begin at met here moves rank everywhere distance queue heap_cost heap_cell to_go touched "
        "paths slots ends remembered part gone updated minds",
    )
):
    """Scratch arrays of one thread.

    Attributes:
        seen: int64 `[A + 1]`, number of the last search that met each cell. stamp: int64 `[1]`, searches so far.
        stack, listed: uint32 `[A]`, cells. words: uint32 `[B]`, random words and ids of a group.
        left: int64 `[B, K]`, remaining thresholds on an uncertain map, of ids from `begin` int64 `[1]` on.
        at: int64 `[B, M]`, the cell of each threat in each rollout (A: out of reach), or its index on the route. met:
            int64 `[B]`, the robot that is met next. Both of ids from `begin` on. here: int64 `[A + 1]`, zeros.
        moves: uint32 `[2, M]`, random words of one rollout's moves of threats.
        kept: int64 `[K, 5]`, cached first area of a robot that waits: `changes` and cell for which it is valid; area,
            target, cost.
        rows: like cost_to `[R, A + 1]` or empty, costs from some cells to all, NONE if unreachable and at the end.
            row_costs, row_entries: like area_cost and area_entry `[R, M]`, from the same cells. row_of: int32 `[A]`,
            the row from a cell, NONE if there is none. source_of: int32 `[R]`, its inverse. asked: uint8 `[A]`,
            searches from each cell. oldest: int64 `[1]`, the row to replace next. last: int64 `[1]`, the row that gave
            the last answer, NONE if a search did. heads, tails: int64 `[C]` (`planner.simulator.paths`).
        paths: uint32 `[P]`, cached coverage paths, each after its key (`planner.simulator.return_home`). ends: int64
            `[P / 32]`, end of path n = 1, 2, ... slots: uint16 `[P / 16]`, a path by the hash of its key, 0: none.
            Empty where no paths are cached. remembered: int64 `[1]`, the index of the next path.
        everywhere: bool `[A + 1]`, all cells, the last element excluded. rank, distance, queue, heap_cost, heap_cell,
            to_go, touched: `[A]` (distance with NONE at its end) or empty, as in `SafestPaths` and `far_search`.
        part: int64 `[A + 1]`, gone: uint8 `[A]`, updated: uint32 `[A]`: cells of a map update
            (`planner.simulator.map_belief`); empty for a known map. minds: int64 `[2]`, beliefs so far, and the one
            that `rows` belongs to.
    """


class Counts(
    namedtuple(
        "Counts",
        "visits stops covered unsurvived time new late visited survived alive outcomes left_visited left_survived "
        "left_alive histories home delivered left_delivered passes",
    )
):
    """Counts over rollouts, int64; see planner.tally.Tally.

    Attributes:
        visits, stops, covered: `[A]`, entries, robots lost, rollouts that visited the cell. unsurvived: `[A]`, those of
            them in which no robot survived there.
        time: `[T + 1]`, ends of runs. new: `[T + 1]`, cells visited first at each step. late: `[T + 1]`, first
            survivals at each step less first visits.
        visited, survived: `[GOAL + 1]`; alive: `[K + 1]`; outcomes: `[len(Outcome)]`: rollouts by their number.
        left_visited, left_survived, left_alive: like these, the mass of a tree's branches that were left.
        histories: `[3]`, ends of a tree, branches left, visits at which it may split. Zeros unless for trees.
        home: `[K + 1]`, rollouts by robots at base at the end; empty where robots do not return.
        delivered, left_delivered: like visited, by cells delivered; empty where these are not counted.
        passes: `[A, MOST_PASSES]`, rollouts with at least 1, 2, ... survived visits of the cell; no rows: not counted.
            With `Tables.scores`: float64 `[A, 2]`, sums over rollouts of the cells covered times the robots lost in the
            cell, and times its survived visits. For rollouts they are integers, exact below 2**53.
    """


class Singles(NamedTuple):
    """Results of single rollouts; arrays without rows: not kept.

    Attributes:
        numbers: int32 `[B, SINGLES]`. value_sums: int64 `[B, 2]`, sums over cells of the two tables below.
        covered: int64 `[A]`, value of a cell that is visited.
        found: int64 `[A, MOST_PASSES + 1]`, value of a cell by its survived visits.
        start: the id of the rollout in row 0.
    """

    numbers: NDArray
    value_sums: NDArray
    covered: NDArray
    found: NDArray
    start: int


REMEMBERED, MOST_PATHS = 2**24, 2**16
"""Most words of `Work.paths`, 64 MB, and most paths that 16 bits can number; a map gets 256 to 512 words for each cell.
Thousands of words filled: 113 by 4,096 rollouts of the terrain, 98 by 16,384 on 64x64 with 25 % of threats, 168 by
262,144 on 20x20."""
SINGLES = 9
"""Numbers kept of a single rollout: visited, survived, time, alive, outcome, bisected, divided, at home, delivered."""
ROWS_BYTES = 2**28
"""Approximate limit on the rows of costs of one thread; there are always two."""


def make_counts(
    cells: int, goal: int, robots: int, steps: int, passes: bool = False, home: bool = False, scores: bool = False,
    delivers: bool = False,
) -> Counts:  # fmt: skip
    """Empty counts.

    Args:
        cells: A.
        goal: cells that can be visited.
        robots: K.
        steps: T, the most steps of a rollout.
        passes: whether survived visits are counted.
        home: whether robots at base are.
        scores: whether the sums of `Tables.scores` are.
        delivers: whether cells delivered are.
    """
    figures = (goal + 1, goal + 1, robots + 1)
    sizes = (*[cells] * 4, *[steps + 1] * 3, *figures, len(Outcome), *figures, 3, home * (robots + 1))
    sizes += 2 * (delivers * (goal + 1),)
    by_cell = np.zeros((cells, 2)) if scores else np.zeros((cells if passes else 0, MOST_PASSES), dtype=np.int64)
    return Counts(*[*(np.zeros(size, dtype=np.int64) for size in sizes), by_cell])


def first_room(tables: Tables) -> int:
    """Room for areas that a rollout hardly ever exceeds; in 16 bits if the areas of t = 0 take at most half of it."""
    given = len(tables.level)
    room = given + 4 * len(tables.near)
    return min(room, MOST_NARROW) if 2 * given <= MOST_NARROW else room


def first_state(tables: Tables, room: int, passes: bool = False) -> State:
    """The state before any robot has entered its start.

    Args:
        tables: of the mission.
        room: areas that there is room for.
        passes: whether survived visits are counted.
    """
    size, team, learned = len(tables.near), len(tables.starts), len(tables.belief)
    # Half the bytes if 16 bits hold the areas: copying the state is a large share of the cost of a split.
    kind: DTypeLike = np.uint16 if room <= MOST_NARROW and size < MOST_CELLS else np.uint32
    robots, areas, cells = (-(-count // WORD) for count in (team, room, size))
    learning, returning = len(tables.truths) > 0, len(tables.home_cost) > 0
    free, near = np.append(tables.belief >= 0, False), tables.near[:learned]
    state = State(
        near=np.where(free[near], near, learned).astype(near.dtype),
        entry=np.where(free[:-1], tables.price[np.maximum(tables.belief, 0)], 0),
        level=tables.belief.copy(),
        odds=tables.odds.copy(),
        **_zeros(
            ("home", size + 1, kind),
            ("order", size, kind),
            ("areas", room, AREA),
            ("robots", team, ROBOT),
            ("marks", (), GROUP),
            ("moving waiting", robots, np.uint64),
            ("open lowest", areas, np.uint64),
            ("passes", 2 * size if tables.scores else size * passes, np.uint16),
            ("legs", (team * (len(tables.entry) > 0), size), kind),
            ("spent", len(tables.spent), np.uint64),
            ("entered", robots * (len(tables.moving_threats) > 0), np.uint64),
            ("heard", robots * (len(tables.reach) > 0), np.uint64),
            ("known", learned, np.uint8),
            ("fate", room * learning, kind),
            ("mind", MIND * learning, np.int64),
            ("undelivered", ((team + 1) * returning, cells), np.uint64),
        ),
    )
    _begin(state, tables)
    return state


def _zeros(*rows: tuple[str, Any, DTypeLike]) -> dict[str, NDArray]:
    """Arrays of zeros by name, from rows of (names, shape, type)."""
    return {name: np.zeros(shape, dtype=kind) for names, shape, kind in rows for name in names.split()}


def make_state(first: State, levels: int) -> State:
    """An empty stack of states like `first`, of at most `levels` levels, fewer where STATE_BYTES would be exceeded."""
    a_level = sum(row[:1].nbytes for row in first)
    levels = min(levels, max(1, STATE_BYTES // a_level))
    return State._make(np.empty((levels, *row.shape[1:]), dtype=row.dtype) for row in first)


def largest_group(state: State, most: int) -> int:
    """Largest group, of at most `most` rollouts, that the stack of states can run.

    K + 1 levels serve a group of any size. With fewer levels a group may have no more rollouts than levels, since each
    waiting level holds at least one rollout.
    """
    levels, robots = state.robots.shape
    return most if levels > robots else min(levels, most)


def _begin(state: State, tables: Tables) -> None:
    """Write the state before any robot has entered its start."""
    given = len(tables.level)
    sizes = np.diff(tables.begin)
    if len(state.mind):  # cells in no area: obstacles, or out of reach
        state.home[:] = len(state.areas) - 1 << AREA_BITS | VISITED | SURVIVED
        state.known[:], state.known[tables.order] = OUT, 0
        state.areas["level"][-1] = NOWHERE_LEVEL
        for cell in tables.starts if len(tables.truths) == 1 else ():
            state.known[tables.in_view[tables.view_begin[cell] : tables.view_begin[cell + 1]]] |= SEEN
    state.home[tables.order] = np.repeat(np.arange(given), sizes) << AREA_BITS
    # Blocked cells look visited and belong to no area: the kernels need no test for them.
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
    robots["until"], robots["least_threshold"], robots["sure"] = tables.range, LEAST, NONE
    levels = tables.level[unassigned]
    lowest = levels.min(initial=NO_LEVEL)
    words = {"areas": given, "open": len(unassigned), "lowest": lowest, "unfinished": given}
    for word, value in (words | {"alive": len(tables.starts)}).items():
        state.marks[word] = value
    for bits, members in (
        (state.moving, slice(len(tables.starts))),
        (state.open, unassigned),
        (state.lowest, unassigned[levels == lowest]),
    ):
        fill(bits, members)


def make_work(tables: Tables, most: int, remembers: bool, known: Work | None = None) -> Work:
    """Scratch arrays of a thread for groups of at most `most` rollouts.

    Args:
        tables: of the mission.
        most: B.
        remembers: whether coverage paths are cached.
        known: the arrays of an earlier call, reused but for those by rollout.
    """
    kept = most if len(tables.exposure) and len(tables.own_counter) else 0
    words, left = np.zeros(most, dtype=np.uint32), np.zeros((kept, len(tables.starts)), dtype=np.int64)
    at = np.zeros((most if len(tables.moving_threats) else 0, len(tables.moving_threats)), dtype=np.int64)
    met = np.zeros(len(at), dtype=np.int64)
    if known is not None:
        return known._replace(words=words, left=left, at=at, met=met)
    size, learning = len(tables.near), len(tables.truths) > 0
    searched = size if len(tables.entry) else 0
    remembered = min(REMEMBERED, 2 ** (8 + size.bit_length())) if remembers else 0
    rows = 0 if len(tables.cost_to) else max(2, min(size, ROWS_BYTES // (size * tables.cost_to.itemsize)))
    apart = searched + 1 if searched else 0
    learned, kinds = (size if learning else 0), len(tables.kind_cost)
    scratch = _zeros(
        ("seen here", size + 1, np.int64),
        ("stack listed", size, np.uint32),
        ("stamp oldest begin last remembered", 1, np.int64),
        ("minds", 2, np.int64),
        ("kept", (len(tables.starts), 5), np.int64),
        ("source_of", rows, np.int32),
        ("asked", searched, np.uint8),
        ("heads tails", kinds, np.int64),
        ("moves", (2, len(tables.moving_threats)), np.uint32),
        ("distance", apart, np.int64),
        ("queue", searched, np.uint32),
        ("row_of rank heap_cell", searched, np.int32),
        ("heap_cost to_go touched", searched, np.int64),
        ("slots", min(remembered // 2**4, 2 * MOST_PATHS), np.uint16),
        ("ends", min(remembered // 2**5, MOST_PATHS), np.int64),
        ("part", learned + learning, np.int64),
        ("gone", learned, np.uint8),
        ("updated", learned, np.uint32),
    )
    for name in ("kept", "row_of", "source_of", "last", "rank", "distance"):
        scratch[name][:] = NONE
    scratch["remembered"][:] = 1
    # Large arrays that are written before they are read.
    scratch["rows"] = np.empty((rows, size + 1), dtype=tables.cost_to.dtype)
    scratch["row_costs"] = np.empty((rows, len(tables.level)), dtype=tables.cost_to.dtype)
    scratch["row_entries"] = np.empty((rows, len(tables.level)), dtype=tables.near.dtype)
    scratch["paths"] = np.empty(remembered, dtype=np.uint32)
    return Work(words=words, left=left, at=at, met=met, everywhere=np.arange(apart) < searched, **scratch)
