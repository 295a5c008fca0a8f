"""Vectors of float32 in compiled loops: an operation on one is an instruction on all its numbers.

What numba makes of a loop over a few channels is mostly questions: how often it goes round, which
arrays overlap. With vectors there is nothing to ask.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types
from numba.core.errors import TypingError
from numba.extending import models, overload, register_model

from learner.steps.factors import steps_compiler

compiled: Any = steps_compiler(__file__)
"""Compiles what uses vectors."""

LANES = 16
"""Numbers of a vector. Where a processor's registers are smaller, it takes several of them."""

_BITS_FEWER = 16
"""That bfloat16 has."""

_intrinsic: Any = extending.intrinsic  # whose results, numba says, are called as they are written
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_WORDS = ir.VectorType(ir.IntType(32), LANES)
_HALVES = ir.VectorType(ir.IntType(16), LANES)


class _Vector(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector: _Vector) -> None:
        super().__init__(manager, vector, _FLOATS)  # type: ignore[no-untyped-call]


_VECTOR: Any = _Vector()


@_intrinsic  # type: ignore[untyped-decorator]
def load(_typing: Any, array: Any, _at: Any) -> Any:
    """The numbers from one on of an array of float32, or of bfloat16 as u16.

    Args:
        array: One axis, contiguous.
        _at: Where the first is; whether all are inside is not looked at.
    """
    _check_array(array)

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        place = _place(context, builder, array, *args)
        if array.dtype == types.float32:
            return builder.load(place, align=4, typ=_FLOATS)
        words = builder.zext(builder.load(place, align=2, typ=_HALVES), _WORDS)
        return builder.bitcast(builder.shl(words, _all(_BITS_FEWER, _WORDS)), _FLOATS)

    return _VECTOR(array, types.intp), generate


@_intrinsic  # type: ignore[untyped-decorator]
def store(_typing: Any, array: Any, _at: Any, vector: Any) -> Any:
    """Puts the numbers there; rounded, ties to even, if they are to be bfloat16. See `load`."""
    _check_array(array)

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        value, start, numbers = args
        place = _place(context, builder, array, value, start)
        if array.dtype == types.float32:
            builder.store(numbers, place, align=4)
        else:
            builder.store(_rounded(builder, numbers), place, align=2)
        return context.get_dummy_value()

    return types.none(array, types.intp, vector), generate


@_intrinsic  # type: ignore[untyped-decorator]
def spread(_typing: Any, _number: Any) -> Any:
    """A vector of one number, again and again."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        nothing = ir.Constant(_FLOATS, ir.Undefined)
        first = builder.insert_element(nothing, args[0], ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(first, nothing, _all(0, _WORDS))

    return _VECTOR(types.float32), generate


def _zero_where(predicate: str) -> Any:
    @_intrinsic  # type: ignore[untyped-decorator]
    def choose(_typing: Any, _asked: Any, _otherwise: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            zero = _all(0.0, _FLOATS)
            return builder.select(builder.fcmp_ordered(predicate, args[0], zero), zero, args[1])

        return _VECTOR(_VECTOR, _VECTOR), generate

    return choose


zero_if_negative = _zero_where("<")
"""Of two vectors the second, but 0 where the first is below; NaN is not."""
zero_if_not_positive = _zero_where("<=")
"""Of two vectors the second, but 0 where the first is not above; NaN counts as above."""


def _give_operator(symbol: Any, instruction: str) -> None:
    @_intrinsic  # type: ignore[untyped-decorator]
    def apply(_typing: Any, _x: Any, _y: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return getattr(builder, instruction)(*args)

        return _VECTOR(_VECTOR, _VECTOR), generate

    @overload(symbol)
    def choose(x: Any, y: Any) -> Any:
        def of_vectors(x: Any, y: Any) -> Any:
            return apply(x, y)

        return of_vectors if isinstance(x, _Vector) and isinstance(y, _Vector) else None


_give_operator(operator.add, "fadd")
_give_operator(operator.sub, "fsub")
_give_operator(operator.mul, "fmul")


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def load_four(numbers: Any, at: int, step: int) -> Any:
    """Four vectors, each so many numbers after the one before."""
    return (
        load(numbers, at),
        load(numbers, at + step),
        load(numbers, at + 2 * step),
        load(numbers, at + 3 * step),
    )


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def store_four(numbers: Any, at: int, step: int, vectors: Any) -> None:
    """Undoes `load_four`."""
    store(numbers, at, vectors[0])
    store(numbers, at + step, vectors[1])
    store(numbers, at + 2 * step, vectors[2])
    store(numbers, at + 3 * step, vectors[3])


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def add_four(numbers: Any, at: int, step: int, vectors: Any) -> None:
    """Adds to what `load_four` gives."""
    x = load_four(numbers, at, step)
    sums = x[0] + vectors[0], x[1] + vectors[1], x[2] + vectors[2], x[3] + vectors[3]
    store_four(numbers, at, step, sums)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def load_three(numbers: Any, at: int, step: int, n: int) -> Any:
    """Three vectors, each so many numbers after the one before; from the n-th on they are 0."""
    nothing = spread(np.float32(0.0))
    return (
        load(numbers, at) if n > 0 else nothing,
        load(numbers, at + step) if n > 1 else nothing,
        load(numbers, at + 2 * step) if n > 2 else nothing,
    )


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def store_three(numbers: Any, at: int, step: int, n: int, vectors: Any) -> None:
    """Puts n of the three there."""
    if n > 0:
        store(numbers, at, vectors[0])
    if n > 1:
        store(numbers, at + step, vectors[1])
    if n > 2:
        store(numbers, at + 2 * step, vectors[2])


def _check_array(array: Any) -> None:
    numbers = (types.float32, types.uint16)
    is_array = isinstance(array, types.Array) and (array.ndim, array.layout) == (1, "C")
    if not is_array or array.dtype not in numbers:
        raise TypingError(f"expected a contiguous array of float32 or uint16; got {array}")


def _place(context: Any, builder: Any, array: Any, value: Any, at: Any) -> Any:
    data = context.make_array(array)(context, builder, value).data
    numbers = _FLOATS if array.dtype == types.float32 else _HALVES
    return builder.bitcast(builder.gep(data, [at], inbounds=True), numbers.as_pointer())


def _all(number: float, vector: Any) -> Any:
    return ir.Constant(vector, [number] * LANES)


def _rounded(builder: Any, numbers: Any) -> Any:
    bits, fewer = builder.bitcast(numbers, _WORDS), _all(_BITS_FEWER, _WORDS)
    is_odd = builder.and_(builder.lshr(bits, fewer), _all(1, _WORDS))
    raised = builder.add(builder.add(bits, _all(0x7FFF, _WORDS)), is_odd)
    return builder.trunc(builder.lshr(raised, fewer), _HALVES)
