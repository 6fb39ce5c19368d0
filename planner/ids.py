"""How many steps, rollouts and bytes there can be."""

from __future__ import annotations

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
