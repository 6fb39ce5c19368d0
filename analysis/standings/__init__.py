"""Which planner is best, and how much is left to gain? Thirty named worlds, everybody on the same luck."""
