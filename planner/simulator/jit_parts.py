"""Numba's compiler for programs of many parts: each part is lowered once, and optimised where it ends up.

Numba optimises every function and makes machine code of it, then does it again, and again, where the function has been
linked into its callers. Parts, which Python does not call, are only cleaned of what lowering leaves behind. In programs
and parts no index is negative. Numba's internals, which are used for it, are those of the releases that `jit.KNOWN`
names; with others this is not imported.
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
    """Options of a compilation, by which Numba looks up all that is called: its own take a fifth of the time."""

    __slots__ = ()

    def __hash__(self) -> int:
        return hash(frozenset(self._values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, QuickFlags) and self._values == other._values


class ForwardContext(CPUContext):
    """A target on which no index is negative. Numba asks whether one is at every access, unless it is unsigned."""

    def get_function(self, fn: Any, sig: Any, _firstcall: bool = True) -> Any:
        if getattr(fn, "typing_key", None) in (operator.getitem, operator.setitem):
            of, index, *value = sig.args
            if isinstance(of, Buffer):
                fn, sig = fn.typing_key, sig.replace(args=(of, _unsigned(index), *value))
        return super().get_function(fn, sig, _firstcall)


def _unsigned(index: Any) -> Any:
    """What an index that is not negative, or a tuple of them, may be taken for."""
    if isinstance(index, BaseTuple):
        return BaseTuple.from_types([_unsigned(part) for part in index.types])
    if not isinstance(index, Integer) or isinstance(index, Literal):
        return index
    number: Any = index
    return Integer.from_bitwidth(number.bitwidth, signed=False)


class PartLibrary(JITCodeLibrary):
    """A part's code, for linking alone: no machine code is made of it."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    @property
    def codegen(self) -> PartLibrary:
        """Where its environment would be put, were it ever called."""
        return self

    def set_env(self, _name: str, _environment: Any) -> None:
        """There is no machine code that could need one."""


class ProgramCompiler(FeatureCompiler):
    """The compiler of a program."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.state.flags = QuickFlags(self.state.flags)
        self.state.targetctx.__class__ = ForwardContext  # this compilation's own


class PartCompiler(ProgramCompiler):
    """The compiler of a part."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.state.library = self.state.library or PartLibrary(self.state.targetctx.codegen(), "part")
