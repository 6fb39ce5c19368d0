"""Features of a mission as fields of a named tuple, None where it does without: Numba compiles none of their code.

Numba drops a branch on an argument that is None before it finds types. This pass makes it see fields of arguments too,
so that `if tables.returns and is_late(tables, state, robot)` costs a mission without return to base nothing.
"""

from __future__ import annotations

from typing import Any

from numba.core import ir
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.ir_utils import get_definition, guard
from numba.core.types.containers import BaseNamedTuple
from numba.core.types.misc import NoneType
from numba.core.untyped_passes import InlineInlinables, WithLifting


@register_pass(mutates_CFG=False, analysis_only=False)
class FoldAbsent(FunctionPass):
    """A field of a named tuple that is None is False, before types are found: Numba then drops what asks for it."""

    _name = "fold_absent"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        """Whether there was one. Only fields of the function's own arguments are known by then."""
        code, found = state.func_ir, False
        for block in code.blocks.values():
            for assign in block.find_insts(ir.Assign):
                value = assign.value
                if isinstance(value, ir.Expr) and value.op == "getattr" and _is_absent(code, state.args, value):
                    assign.value, found = ir.Const(False, assign.loc), True
                    known = code._definitions[assign.target.name]
                    known[known.index(value)] = assign.value
        return found


def _is_absent(code: Any, kinds: Any, value: Any) -> bool:
    of = guard(get_definition, code, value.value)
    kind = kinds[of.index] if isinstance(of, ir.Arg) else None
    kind = getattr(kind, "of", kind)
    return (
        isinstance(kind, BaseNamedTuple)
        and value.attr in kind.fields
        and isinstance(kind.types[kind.fields.index(value.attr)], NoneType)
    )


@register_pass(mutates_CFG=False, analysis_only=False)
class FoldAbsentAgain(FoldAbsent):
    """The same of code that was inlined."""

    _name = "fold_absent_again"


class FeatureCompiler(Compiler):
    """Numba's compiler with this pass."""

    def define_pipelines(self) -> list[Any]:
        """Before each place where Numba drops branches that cannot be taken."""
        (manager,) = super().define_pipelines()
        manager.add_pass_after(FoldAbsent, WithLifting)
        manager.add_pass_after(FoldAbsentAgain, InlineInlinables)
        manager.finalize()
        return [manager]
