"""A linear programme in HiGHS. Nothing that it says is trusted: whoever asks proves it."""

from __future__ import annotations

import highspy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

INF = highspy.kHighsInf
Floats = NDArray[np.float64]


def make_solver(cost: Floats, upper: Floats, rows: csc_array, least: Floats, most: Floats) -> highspy.Highs:
    """Minimise `cost @ x` over 0 <= x <= `upper` `[C]` with `least` <= `rows` @ x <= `most` `[R]`."""
    programme, solver = highspy.HighsLp(), highspy.Highs()
    programme.num_row_, programme.num_col_ = rows.shape
    programme.col_cost_, programme.col_lower_, programme.col_upper_ = cost, np.zeros(len(cost)), upper
    programme.row_lower_, programme.row_upper_ = least, most
    programme.a_matrix_.start_, programme.a_matrix_.index_ = rows.indptr, rows.indices
    programme.a_matrix_.value_ = rows.data
    solver.silent()
    solver.setOptionValue("threads", 1)  # none of its own, which a fork of this process would lack
    solver.passModel(programme)
    return solver
