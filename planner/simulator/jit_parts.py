"""Numba's compiler for programs of many parts: each part is lowered once, and optimised only within its program.

By default Numba optimises each function and generates machine code for it, and does so again wherever the function is
linked into a caller. Parts, which Python does not call, are only cleaned up after lowering. In programs and parts no
index is negative. This module uses internals of the Numba releases in `jit.KNOWN`; with others it is not imported.
"""

from __future__ import annotations

import operator
from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Flags
from numba.core.cpu import CPUContext
from numba.core.types import Integer, Literal
from numba.core.types.common import Buffer
from numba.core.types.containers import BaseTuple

from .jit_features import FeatureCompiler


class QuickFlags(Flags):
    """Compilation options with a fast hash: Numba's own hash takes a fifth of the compile time."""

    __slots__ = ()

    def __hash__(self) -> int:
        return hash(frozenset(self._values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, QuickFlags) and self._values == other._values


class ForwardContext(CPUContext):
    """A target on which no index is negative: Numba tests each index for that unless its type is unsigned."""

    def get_function(self, fn: Any, sig: Any, _firstcall: bool = True) -> Any:
        """Numba's implementation of a call; item access gets unsigned index types."""
        if getattr(fn, "typing_key", None) in (operator.getitem, operator.setitem):
            of, index, *value = sig.args
            if isinstance(of, Buffer):
                fn, sig = fn.typing_key, sig.replace(args=(of, _unsigned(index), *value))
        return super().get_function(fn, sig, _firstcall)


def _unsigned(index: Any) -> Any:
    """The unsigned type of an index type, or of a tuple of them."""
    if isinstance(index, BaseTuple):
        return BaseTuple.from_types([_unsigned(part) for part in index.types])
    if not isinstance(index, Integer) or isinstance(index, Literal):
        return index
    number: Any = index
    return Integer.from_bitwidth(number.bitwidth, signed=False)


class PartLibrary(JITCodeLibrary):
    """Code of a part for linking only: no machine code is generated."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    @property
    def codegen(self) -> PartLibrary:
        """The object that would hold the part's environment if Python called it."""
        return self

    def set_env(self, _name: str, _environment: Any) -> None:
        """Does nothing: there is no machine code that needs an environment."""


class ProgramCompiler(FeatureCompiler):
    """The compiler of a program."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        # Flags and target are replaced per compilation, so other users of Numba in this process keep theirs.
        self.state.flags = QuickFlags(self.state.flags)
        self.state.targetctx.__class__ = ForwardContext  # only for this compilation


class PartCompiler(ProgramCompiler):
    """The compiler of a part."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.state.library = self.state.library or PartLibrary(self.state.targetctx.codegen(), "part")
