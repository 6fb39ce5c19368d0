"""What searches compare and conclude: trials, successive halving, the best policy, their picks."""

from __future__ import annotations
