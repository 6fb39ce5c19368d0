"""Sweeps: many maps, teams, planners and models, run in processes or on a cluster, with results in a crash-safe store."""
