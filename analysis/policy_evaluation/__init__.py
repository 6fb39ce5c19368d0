"""Policies of users: evaluated beside the planner, and ranked on a fixed suite of worlds."""
