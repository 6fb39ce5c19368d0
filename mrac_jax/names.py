"""The names of the back ends, apart from them: for options and checks, which import no engine."""

from __future__ import annotations

from typing import Literal, get_args

EngineName = Literal["auto", "jax", "numba"]
ENGINES: tuple[EngineName, ...] = get_args(EngineName)
