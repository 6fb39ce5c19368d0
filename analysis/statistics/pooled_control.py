"""The control by total tolerance where no map alone has the rollouts for it: slopes that all maps tell together.

A figure stands *beside* its luck: axis `L` = (figure, pieces of its broken line by the total tolerance, less what is
expected of them: `analysis.statistics.control`). The mean of a map's rollouts is one such vector,
with the covariance of its error. For any b, `figure - luck b` has the figure's mean; the b that leaves least of the
rollouts' noise in a mean over maps follows from the sum of these covariances, as each map's own mean tells nothing of
it (analysis of covariance: Cochran, Biometrics 1957). What a map's own rollouts add to b bends its mean by a share of
1 / all rollouts; and where all maps have other luck, the put-right means are a sample of one from each, so their
interval is that of any means over maps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.control import LEAST, PIECES, expected_pieces, inverse_of, pieces
from planner.rollouts.by_luck import COLUMNS
from planner.tally import Tally

BESIDE = 1 + PIECES
FIGURES = COLUMNS[1:]
TRIANGLE = np.triu_indices(PIECES)


def luck_sums(tally: Tally) -> list[int]:
    """Whole numbers that add: rollouts, sums of the pieces, of their products, and of each of FIGURES times each piece.

    Of a block of rollouts, so that int64 holds them. Empty without sums by luck.
    """
    by_luck = tally.by_luck.reshape(-1, len(COLUMNS))
    held = np.flatnonzero(by_luck[:, 0])
    if not len(held):
        return []
    often, luck = by_luck[held, 0], pieces(held, tally.robots)
    products, along = (often[:, None] * luck).T @ luck, by_luck[held, 1:].T @ luck
    return np.concatenate([[often.sum()], often @ luck, products[TRIANGLE], along.ravel()]).tolist()


def beside_luck(
    rollouts: int, figures: Sequence[tuple[int, int]], luck: Sequence[int], robots: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A map's means `[F, L]` of FIGURES and the covariances `[F, L, L]` of their errors.

    `figures`: sums over its rollouts and sums of squares, whole numbers. `luck`: of `luck_sums`; of other rollouts than
    these, or of a single one, it says nothing: zeros.
    """
    means, errors = np.zeros((len(figures), BESIDE)), np.zeros((len(figures), BESIDE, BESIDE))
    means[:, 0] = [total / rollouts for total, _ in figures]
    if rollouts == 1:
        return means, errors
    pairs = (rollouts - 1) * rollouts
    errors[:, 0, 0] = [(square * rollouts - total * total) / rollouts / pairs for total, square in figures]
    if not luck or luck[0] != rollouts:
        return means, errors
    sums, products, along = np.split(np.array(luck[1:], dtype=np.float64), [PIECES, PIECES + len(TRIANGLE[0])])
    spread, met = np.zeros((PIECES, PIECES)), sums / rollouts
    spread[TRIANGLE] = spread.T[TRIANGLE] = products
    means[:, 1:] = met - expected_pieces(robots)
    errors[:, 1:, 1:] = (spread - rollouts * np.outer(met, met)) / pairs
    errors[:, 0, 1:] = errors[:, 1:, 0] = (along.reshape(-1, PIECES) - means[:, :1] * rollouts * met) / pairs
    return means, errors


def weights_of(errors: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """`[L]`, (1, -b) of one figure: what its vectors are to be multiplied with; b = 0 where the rollouts are too few.

    `errors`: `[L, L]`, the sum of its maps' covariances. `freedom`: rollouts that tell of b, of each map one less.
    """
    weights = np.zeros(len(errors))
    weights[0] = 1.0
    if freedom >= LEAST and errors[1:, 1:].any():
        weights[1:] = -inverse_of(errors[1:, 1:])[0] @ errors[1:, 0]
    return weights


def put_right(
    means: NDArray[np.float64], errors: NDArray[np.float64], freedom: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A figure's means `[M]` on all maps without what their luck is worth, and their standard errors `[M]`.

    `means`, `errors`: `[M, L]`, `[M, L, L]`, of one figure of `beside_luck`. `freedom`: as of `weights_of`.
    """
    weights = weights_of(errors.sum(axis=0), freedom)
    return means @ weights, np.sqrt(np.maximum(weights @ errors @ weights, 0.0))
