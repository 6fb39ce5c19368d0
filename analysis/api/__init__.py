"""The functions behind the door, `import mrac_jax as mrac`: plain arguments in, the house's answers out.

Each does one of the everyday jobs and is documented for somebody who knows nothing of the rooms behind it. Coverage is
a fraction of the accessible cells; cells are `[row, col]`, row 0 at the top; every error is an `InputError`.
"""

from analysis.api.plans import (
    export,
    judge,
    load,
    mission,
    plan,
    read_outcomes,
    read_rollouts,
    record,
    reproduce,
    results,
    suite,
    sweep,
)
from analysis.api.questions import attack, check, clear, compare, evaluate, front, size, starts

__all__ = [
    "attack", "check", "clear", "compare", "evaluate", "export", "front", "judge", "load", "mission", "plan",
    "read_outcomes", "read_rollouts", "record", "reproduce", "results", "size", "starts", "suite", "sweep",
]  # fmt: skip
