"""Robots with a range, and robots that come home."""

from __future__ import annotations
