"""What stands where a number would name something, and there is nothing to name: -1, in arrays and files alike."""

from __future__ import annotations

NONE = -1
"""None of whatever is meant; the kernels, where one number may be of several kinds, say only this."""
NO_CELL = NO_AREA = NO_ROBOT = NO_STEP = NO_ROLLOUT = NONE


# How many there can be: what a random-number counter addresses (SPEC section 6), how ids are kept (section 9).

MAX_STEP = 2**22 - 2
"""Last step that a counter can address."""
MOST_ROLLOUTS = 2**32
"""Rollout ids that there are."""
MAX_PLAN_BYTES = 2**26
"""Of a plan or state file: 64 MiB, about 6 million path entries; to read them Python needs some 16 times that."""
BLOCK = 4096
"""Rollout ids of an aligned block, in which they are stored, resumed and looked at."""
LEAST_SHAPE, MOST_SHAPE = 0.25, 16.0
"""Of what robots that wear bear (`planner.failure_model`)."""
LEAST_SUSCEPTIBILITY, MOST_SUSCEPTIBILITY = 1 / 64, 64.0
"""How often exposure counts on a robot."""
