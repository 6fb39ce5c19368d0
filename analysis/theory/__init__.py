"""Exact values, the paper's formulas and bounds of our own; no file here sees an engine."""
