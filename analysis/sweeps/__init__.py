"""Sweeps: many maps, teams, planners and models, in processes or on a cluster, into a crash-safe store."""
