"""Numba's compiler for programs of many parts: each part is lowered once, and optimised where it ends up.

Numba optimises every function and makes machine code of it, then does it again, and again, where the function has been
linked into its callers. Parts, which Python does not call, are only cleaned of what lowering leaves behind; the program
with all of them in it is optimised twice, as what is inlined used to be. In neither is an index negative. Numba's
insides, which are used for it, are those of the releases that `planner.jit` names; with others this is not imported.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import binding  # type: ignore[import-untyped]
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult, Flags
from numba.core.cpu import CPUContext
from numba.core.types import Integer, Literal
from numba.core.types.common import Buffer
from numba.core.types.containers import BaseTuple

from planner.jit_features import FeatureCompiler


class QuickFlags(Flags):
    """Options of a compilation, by which Numba looks up all that is called: its own take a fifth of the time."""

    __slots__ = ()

    def __hash__(self) -> int:
        return hash(frozenset(self._values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, QuickFlags) and self._values == other._values


class QuickCompiler(FeatureCompiler):
    """Numba's compiler with such options."""

    def __init__(
        self, typingctx: Any, targetctx: Any, library: Any, args: Any, return_type: Any, flags: Any, named: Any
    ) -> None:
        super().__init__(typingctx, targetctx, library, args, return_type, QuickFlags(flags), named)


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


def _forward(target: Any) -> Any:
    """The same target as such a context."""
    context = target.subtarget()
    context.__class__ = ForwardContext
    return context


class ProgramLibrary(JITCodeLibrary):
    """A program's code, with its parts."""

    def _optimize_final_module(self) -> None:
        super()._optimize_final_module()
        super()._optimize_final_module()


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

    def serialize_using_object_code(self) -> tuple[str, bytes]:
        """What is kept of it: bitcode."""
        return self.name, self._get_module_for_linking().as_bitcode()


class ProgramCompiler(QuickCompiler):
    """The compiler of a program."""

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, *others: Any) -> None:
        if library is None:
            library = ProgramLibrary(targetctx.codegen(), "program")
            library.enable_object_caching()
        super().__init__(typingctx, _forward(targetctx), library, *others)


class PartCompiler(QuickCompiler):
    """The compiler of a part."""

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, *others: Any) -> None:
        super().__init__(typingctx, _forward(targetctx), library or PartLibrary(targetctx.codegen(), "part"), *others)


class _Known:
    """A target that knows a part's code already, as `CompileResult` asks for it."""

    def __init__(self, target: Any) -> None:
        self._target, self.typing_context = target, target.typing_context
        self.get_executable = target.get_executable

    def codegen(self) -> _Known:
        return self

    def unserialize_library(self, kept: tuple[str, bytes]) -> PartLibrary:
        name, bitcode = kept
        library = PartLibrary(self._target.codegen(), name)
        library._final_module = binding.parse_bitcode(bitcode)
        library._finalize_final_module()
        return library


def rebuild_part(target: Any, reduced: Any) -> Any:
    """A part's result as it was kept."""
    return CompileResult._rebuild(_Known(target), *reduced)._replace(target_context=target)
