"""State files, and states from masks, grids, lists of cells and tracks."""

from __future__ import annotations
