"""Tuples of arrays passed between kernels by address: a call that is not inlined passes one word for each tuple.

By value an array is seven words, and a rollout uses fifty arrays: a call took longer than most kernels. Of a contiguous
array only its address and shape are stored, which determine the rest: with more words LLVM no longer tracks the values
that it has stored.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

from .jit import INTERPRETED
from .state import State, Tables

LENGTHS = {(Tables, "near"): 4, (State, "near"): 4}
"""Row lengths of matrices, where they are constant: a row is found without loading the matrix's shape."""


class StructPointer(types.Type):
    """Numba type of the address of a named tuple."""

    def __init__(self, of: Any) -> None:
        self.of, self.types = of, (of,)
        super().__init__(name=f"handed({of})")


def _follows(kind: types.Type) -> bool:
    """Whether address and shape determine the value: a contiguous array."""
    return isinstance(kind, types.Array) and kind.layout == "C"


@register_model(StructPointer)
class _Address(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: StructPointer) -> None:
        kept = []
        for field in kind.of.types:
            model = manager.lookup(field)
            value = model.get_value_type()
            if _follows(field):
                words = [value.elements[model.get_field_position(part)] for part in ("data", "shape")]
                value = ir.LiteralStructType(words)
            kept.append(value)
        super().__init__(manager, kind, ir.LiteralStructType(kept).as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = StructPointer

    def generic_resolve(self, kind: StructPointer, name: str) -> Any:
        if name not in kind.of.fields:
            return None
        return kind.of.types[kind.of.fields.index(name)]


@lower_getattr_generic(StructPointer)
def _load_field(context: Any, builder: Any, kind: StructPointer, address: Any, name: str) -> Any:
    place = kind.of.fields.index(name)
    field, stored = kind.of.types[place], cgutils.gep_inbounds(builder, address, 0, place)
    if not _follows(field):
        return builder.load(stored)
    data = builder.load(cgutils.gep_inbounds(builder, stored, 0, 0))
    shape = [builder.load(cgutils.gep_inbounds(builder, stored, 0, 1, axis)) for axis in range(field.ndim)]
    length = LENGTHS.get((kind.of.instance_class, name))
    # Constant when compiling: rows are found by a shift instead of a multiplication with a loaded value.
    if length is not None:
        shape[1] = ir.Constant(ir.IntType(64), length)
    return _array(context, builder, field, data, shape)


def _array(context: Any, builder: Any, kind: Any, data: Any, shape: list[Any]) -> Any:
    """A contiguous array without reference counting."""
    itemsize = context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    strides = [itemsize]
    for count in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], count))
    array = context.make_array(kind)(context, builder)
    shape, strides = (cgutils.pack_array(builder, values) for values in (shape, strides))
    populate_array(array, data, shape, strides, itemsize, None)
    return array._getvalue()


@intrinsic
def _hand(typing_context: Any, values: Any) -> Any:
    if isinstance(values, types.NoneType):
        return values(values), lambda context, builder, _signature, _args: context.get_dummy_value()
    kind = StructPointer(values)

    def keep(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        # In the caller's stack frame, once: nothing to free, and valid until the caller returns.
        address = cgutils.alloca_once(builder, context.get_value_type(kind).pointee)
        for place, field in enumerate(values.types):
            value, to = builder.extract_value(args[0], place), cgutils.gep_inbounds(builder, address, 0, place)
            if _follows(field):
                array = context.make_array(field)(context, builder, value)
                builder.store(array.data, cgutils.gep_inbounds(builder, to, 0, 0))
                for axis, count in enumerate(cgutils.unpack_tuple(builder, array.shape)):
                    builder.store(count, cgutils.gep_inbounds(builder, to, 0, 1, axis))
            else:
                builder.store(value, to)
        return address

    return kind(values), keep


class Records(dict[int, Any]):
    """A structured array for code that is not compiled: elements have their fields as attributes.

    Fields are read as those of a C structure in the array's memory: NumPy's records take microseconds per field.
    Elements are made on first use.
    """

    def __init__(self, array: NDArray[np.void]) -> None:
        super().__init__()
        self.array = array
        self._kind, self._bytes = _structure(array.dtype), array.view(np.uint8)

    def __missing__(self, place: int) -> Any:
        record = self._kind.from_buffer(self._bytes, int(place) * self.array.itemsize)
        # Kept for the next access: a rollout reads the same few records millions of times.
        super().__setitem__(place, record)
        return record

    def __len__(self) -> int:
        return len(self.array)

    def __setitem__(self, place: int, record: Any) -> None:
        ctypes.pointer(self[place])[0] = record


_structure: Callable[[Any], Any] = functools.cache(np.ctypeslib.as_ctypes_type)
"""The C structure with the fields of a record's type."""


def with_records(values: Any) -> Any:
    """The named tuple with structured arrays as `Records`, for code that is not compiled."""
    if getattr(values, "_fields", ()) != State._fields:  # by name: the class may be of either load
        return values
    marks = values.marks if isinstance(values.marks, np.ndarray) else np.asarray(values.marks.base).reshape(-1)
    place = 0
    if not isinstance(values.marks, np.ndarray):
        # A single record does not know its index in the array that it views: the address tells it.
        offset = values.marks.__array_interface__["data"][0] - marks.__array_interface__["data"][0]
        place = offset // marks.itemsize
    return values._replace(robots=Records(values.robots), areas=Records(values.areas), marks=Records(marks)[place])


hand: Callable[[Any], Any] = with_records if INTERPRETED else _hand
"""Address of a copy of a named tuple, valid until the caller returns or reaches this call again."""


@intrinsic
def _flat(typing_context: Any, array: Any) -> Any:
    row = array.copy(ndim=1)

    def make(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        given = context.make_array(array)(context, builder, args[0])
        size = functools.reduce(builder.mul, cgutils.unpack_tuple(builder, given.shape))
        return _array(context, builder, row, given.data, [size])

    return row(array), make


flat: Callable[[Any], Any] = (lambda array: array.reshape(-1)) if INTERPRETED else _flat
"""The values of a contiguous array as one row."""
