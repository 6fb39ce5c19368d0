"""Rollouts as MCAP logs: written, read back, replayed, recovered and drawn."""
