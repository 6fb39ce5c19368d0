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
from numba.core.types.misc import NoneType, Omitted, Optional
from numba.core.untyped_passes import InlineInlinables, WithLifting


@register_pass(mutates_CFG=False, analysis_only=False)
class FoldAbsent(FunctionPass):
    """Replace fields that are None by False before types are inferred: Numba then drops the branches on them."""

    _name = "fold_absent"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        """Whether a field was replaced. Only fields of the function's own arguments are known at this stage."""
        code = state.func_ir
        assigns = [one for block in code.blocks.values() for one in block.find_insts(ir.Assign)]
        # Comparisons with None first: they look at the fields that are replaced.
        folds = sorted((one for one in assigns if isinstance(one.value, ir.Expr)), key=lambda one: one.value.op)
        found = False
        for assign in folds:
            value = assign.value
            constant = _constant(code, state.args, value)
            if constant is not None:
                assign.value, found = ir.Const(constant, assign.loc), True
                # Numba looks values up in its table of definitions: it has to agree with the statement.
                known = code._definitions[assign.target.name]
                known[known.index(value)] = assign.value
        return found


def _constant(code: Any, kinds: Any, value: Any) -> bool | None:
    """The value of an expression on an argument that follows from the argument's type; None if there is none."""
    if value.op == "getattr":
        return False if isinstance(_kind(code, kinds, value), NoneType) else None
    if value.op == "binop" and value.fn in (operator.is_, operator.is_not):
        mine, other = (guard(get_definition, code, side) for side in (value.lhs, value.rhs))
        kind = _kind(code, kinds, mine)
        # A value that is optional, or left out, may be None: Numba decides.
        known = kind is not None and not isinstance(kind, Optional | Omitted)
        if known and isinstance(other, ir.Const) and other.value is None:
            return isinstance(kind, NoneType) == (value.fn is operator.is_)
    return None


def _kind(code: Any, kinds: Any, value: Any) -> Any:
    """The type of a value that is an argument, or a field of one; None if it is neither."""
    if isinstance(value, ir.Arg):
        return kinds[value.index]
    if isinstance(value, ir.Expr) and value.op == "getattr":
        kind = _kind(code, kinds, guard(get_definition, code, value.value))
        kind = getattr(kind, "of", kind)
        if isinstance(kind, BaseNamedTuple):
            return dict(zip(kind.fields, kind.types, strict=True)).get(value.attr)
    return None


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
