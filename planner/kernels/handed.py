"""Tuples of arrays handed from kernel to kernel by their address: a call that is not inlined passes one word of each.

Part of `planner.kernels.rollouts`, which see. By value an array is seven words, and what a rollout reads and writes is
fifty arrays: a call took longer than most of the kernels do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model

from planner.kernels.state import AREA_WORDS, ROBOT_WORDS, State, Tables

LENGTHS = {(Tables, "near"): 4, (State, "robots"): ROBOT_WORDS, (State, "areas"): AREA_WORDS}
"""How long the rows of a matrix are, where that is known: a row is found without a look at the matrix's shape."""


class Handed(types.Type):
    """The type of the address of a named tuple."""

    def __init__(self, of: Any) -> None:
        self.of, self.types = of, (of,)
        super().__init__(name=f"handed({of})")


@register_model(Handed)
class _Address(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Handed) -> None:
        super().__init__(manager, kind, manager.lookup(kind.of).get_value_type().as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = Handed

    def generic_resolve(self, kind: Handed, name: str) -> Any:
        return kind.of.types[kind.of.fields.index(name)] if name in kind.of.fields else None


@lower_getattr_generic(Handed)
def _load_field(context: Any, builder: Any, kind: Handed, address: Any, name: str) -> Any:
    place = kind.of.fields.index(name)
    value = _load(builder, cgutils.gep_inbounds(builder, address, 0, place))
    length = LENGTHS.get((kind.of.instance_class, name))
    if length is None:
        return value
    shape = context.data_model_manager[kind.of.types[place]].get_field_position("shape")
    return builder.insert_value(value, ir.Constant(ir.IntType(64), length), [shape, 1])


def _load(builder: Any, address: Any) -> Any:
    """What is there, part by part, so that parts which are not used are not loaded."""
    kind = address.type.pointee
    if not isinstance(kind, (ir.LiteralStructType, ir.ArrayType)):
        return builder.load(address)
    value = ir.Constant(kind, ir.Undefined)
    for place in range(len(kind) if isinstance(kind, ir.LiteralStructType) else kind.count):
        part = _load(builder, cgutils.gep_inbounds(builder, address, 0, place))
        value = builder.insert_value(value, part, place)
    return value


@intrinsic
def _hand(typing_context: Any, values: Any) -> Any:
    def keep(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return cgutils.alloca_once_value(builder, args[0])

    return Handed(values)(values), keep


hand: Callable[[Any], Any] = (lambda values: values) if numba.config.DISABLE_JIT else _hand
"""The address of a copy of a named tuple, good until the caller returns or comes here again."""
