"""The closed loop as a tree of everything that can happen, and as a Markov chain, from the plain oracle alone."""

from __future__ import annotations
