"""What stands where a number would name something, and there is nothing to name: -1, in arrays and files alike."""

from __future__ import annotations

NONE = -1
"""None of whatever is meant; the kernels, where one number may be of several kinds, say only this."""
NO_CELL = NO_AREA = NO_ROBOT = NO_STEP = NO_ROLLOUT = NONE
