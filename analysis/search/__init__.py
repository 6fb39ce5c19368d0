"""Searches: team size, Pareto front, start positions, threats to remove or to place."""
