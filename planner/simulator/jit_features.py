"""Features of a mission as fields of a named tuple, None if it does not use them: Numba compiles no code of those.

Numba drops a branch on an argument that is None before it infers types. This pass extends that to fields of arguments:
`if tables.returns and is_late(tables, state, robot)` costs a mission without return to base nothing.
"""

from __future__ import annotations

import operator
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
    """Replace fields that are None by False before types are inferred: Numba then drops the branches on them."""

    _name = "fold_absent"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        """Whether a field was replaced. Only fields of the function's own arguments are known at this stage."""
        code, found = state.func_ir, False
        for block in code.blocks.values():
            for assign in block.find_insts(ir.Assign):
                value = assign.value
                constant = _constant(code, state.args, value) if isinstance(value, ir.Expr) else None
                if constant is not None:
                    assign.value, found = ir.Const(constant, assign.loc), True
                    # Numba looks values up in its table of definitions: it has to agree with the statement.
                    known = code._definitions[assign.target.name]
                    known[known.index(value)] = assign.value
        return found


def _constant(code: Any, kinds: Any, value: Any) -> bool | None:
    """The value of an expression on an argument that follows from the argument's type; None if there is none."""
    if value.op == "getattr":
        kind = _kind_of_argument(code, kinds, value.value)
        kind = getattr(kind, "of", kind)
        fields = dict(zip(kind.fields, kind.types, strict=True)) if isinstance(kind, BaseNamedTuple) else {}
        return False if isinstance(fields.get(value.attr), NoneType) else None
    if value.op == "binop" and value.fn in (operator.is_, operator.is_not):
        kind, other = _kind_of_argument(code, kinds, value.lhs), guard(get_definition, code, value.rhs)
        # Numba drops the branch for an argument that is None, but not the other one for an argument that is not.
        if (
            isinstance(getattr(kind, "of", kind), BaseNamedTuple)
            and isinstance(other, ir.Const)
            and other.value is None
        ):
            return bool(value.fn is operator.is_not)
    return None


def _kind_of_argument(code: Any, kinds: Any, variable: Any) -> Any:
    """The type of the argument that a variable is; None if it is no argument."""
    of = guard(get_definition, code, variable)
    return kinds[of.index] if isinstance(of, ir.Arg) else None


@register_pass(mutates_CFG=False, analysis_only=False)
class FoldAbsentAgain(FoldAbsent):
    """The same pass after inlining."""

    _name = "fold_absent_again"


class FeatureCompiler(Compiler):
    """Numba's compiler with this pass."""

    def define_pipelines(self) -> list[Any]:
        """Insert the pass before each stage at which Numba drops dead branches."""
        (manager,) = super().define_pipelines()
        manager.add_pass_after(FoldAbsent, WithLifting)
        manager.add_pass_after(FoldAbsentAgain, InlineInlinables)
        manager.finalize()
        return [manager]
