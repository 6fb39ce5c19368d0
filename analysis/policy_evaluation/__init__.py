"""Evaluation of user policies against the planner, and a leaderboard on a fixed suite of worlds."""
