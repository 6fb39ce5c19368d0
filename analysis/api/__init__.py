"""The functions behind the door, `import mrac_jax as mrac`: plain arguments in, the house's answers out.

Each does one of the everyday jobs and is documented for somebody who knows nothing of the rooms behind it. Coverage is
a fraction of the accessible cells; cells are `[row, col]`, row 0 at the top; every error is an `InputError`.
"""

from analysis.api.evaluation import check, compare, evaluate
from analysis.api.experiments import reproduce, results, sweep
from analysis.api.files import export, read_outcomes, read_rollouts, record
from analysis.api.missions import mission
from analysis.api.plans import load, plan
from analysis.api.policies import judge, suite
from analysis.api.searches import attack, clear, front, size, starts

__all__ = [
    "attack", "check", "clear", "compare", "evaluate", "export", "front", "judge", "load", "mission", "plan",
    "read_outcomes", "read_rollouts", "record", "reproduce", "results", "size", "starts", "suite", "sweep",
]  # fmt: skip
