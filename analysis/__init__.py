"""Exact values, bounds and estimates, the pictures, and the command line."""
