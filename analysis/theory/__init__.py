"""Exact values, the paper's formulas and bounds of our own; no file here sees an engine.

`distribution`, `markov` and `storm` are reached by no command: oracles, which tests hold the rest against.
"""
