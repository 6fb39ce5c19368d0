"""Policies of docs/spec.md, section 11, orders within areas, orders of areas that are found."""

from __future__ import annotations
