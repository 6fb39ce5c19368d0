"""Formulas, bounds and exact values against enumeration, rollouts and independent solvers."""

from __future__ import annotations
