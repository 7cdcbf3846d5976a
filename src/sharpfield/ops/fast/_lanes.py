# pyright: basic
"""Several neighbouring numbers of an array as one value: loaded, multiplied and stored at once.

Kernels that combine a few scattered rows of channels defeat the compiler's own search for vector
instructions: it cannot know that the rows do not overlap. Saying it outright is several times
faster. `Lanes` of any power of two work on any CPU; the compiler splits or widens them to the
registers at hand.

    row = load(features, start, lanes) * weight + load(features, other, lanes) * (1 - weight)
    store(result, at, row)

`lanes` is a tuple whose length says how many, see `lanes_for`; a tuple's length is part of its
type, so the compiler knows it. Positions count numbers from the start of a contiguous array of any
shape.
"""

import inspect
import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

WIDEST = 16
"""A cache line of float32, and the widest register of today's CPUs."""

CONTRACT = ("contract",)
INT32 = ir.IntType(32)


class Lanes(types.Type):
    """The type of a value that holds `width` numbers of type `element`."""

    def __init__(self, element, width):
        self.element, self.width = element, width
        super().__init__(name=f"Lanes({element}, {width})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        element = dmm.lookup(fe_type.element).get_value_type()
        super().__init__(dmm, fe_type, ir.VectorType(element, fe_type.width))


def lanes_for(*channels: int) -> tuple[int, ...]:
    """The most lanes, at most `WIDEST`, that divide each of these numbers of channels."""
    return (0,) * math.gcd(WIDEST, *channels)


def instruction(define: Callable[..., Any]) -> Callable[..., Any]:
    """Make a function that kernels call of one that says how to generate its code.

    `define` gets numba's typing context and the types of the arguments.
    """
    return intrinsic(inspect.unwrap(define))


def _address(context, builder, array_type, array, position, target):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [position]), target.as_pointer())


def _indices(which):
    """Which numbers a shuffle takes."""
    return ir.Constant(ir.VectorType(INT32, len(which)), list(which))


@instruction
def load(typing, array, position, lanes):
    """The numbers of `array` from `position` on."""
    row = Lanes(array.dtype, lanes.count)

    def generate(context, builder, signature, arguments):
        vector = context.get_value_type(row)
        address = _address(context, builder, array, *arguments[:2], vector)
        return builder.load(address, align=array.dtype.bitwidth // 8)

    return row(array, types.intp, lanes), generate


@instruction
def store(typing, array, position, row):
    """Write the numbers of `row` into `array` from `position` on."""

    def generate(context, builder, signature, arguments):
        value = arguments[2]
        address = _address(context, builder, array, *arguments[:2], value.type)
        builder.store(value, address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, row), generate


@instruction
def zeros(typing, array, lanes):
    """Zeros of the type of the numbers of `array`."""
    row = Lanes(array.dtype, lanes.count)

    def generate(context, builder, signature, arguments):
        return ir.Constant(context.get_value_type(row), None)

    return row(array, lanes), generate


@instruction
def prefetch(typing, array, position):
    """Ask for the cache line of a number that will soon be needed."""

    def generate(context, builder, signature, arguments):
        address = _address(context, builder, array, *arguments, ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [address.type, INT32, INT32, INT32])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        read, keep, data = INT32(0), INT32(3), INT32(1)
        builder.call(function, [address, read, keep, data])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@instruction
def total(typing, row):
    """The sum of the numbers in `row`: the upper half is added to the lower until one is left."""

    def generate(context, builder, signature, arguments):
        vector, width = arguments[0], row.width
        while width > 1:
            width //= 2
            lower = builder.shuffle_vector(vector, vector, _indices(range(width)))
            upper = builder.shuffle_vector(vector, vector, _indices(range(width, 2 * width)))
            vector = builder.fadd(lower, upper)
        return builder.extract_element(vector, INT32(0))

    return row.element(row), generate


def _of_two(operation, **options):
    """The instruction that combines two rows by an operation of llvmlite's builder."""

    def define(typing, one, other):
        def generate(context, builder, signature, arguments):
            return getattr(builder, operation)(*arguments, **options)

        return one(one, other), generate

    return instruction(define)


_add = _of_two("fadd", flags=CONTRACT)
_subtract = _of_two("fsub", flags=CONTRACT)
_multiply = _of_two("fmul", flags=CONTRACT)
_divide = _of_two("fdiv")


def _everywhere(builder, number, width):
    """A number as a row of itself."""
    kind = ir.VectorType(number.type, width)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), number, INT32(0))
    return builder.shuffle_vector(first, first, _indices([0] * width))


@instruction
def _scale(typing, row, factor):
    def generate(context, builder, signature, arguments):
        factors = _everywhere(builder, arguments[1], row.width)
        return builder.fmul(arguments[0], factors, flags=CONTRACT)

    return row(row, row.element), generate


@instruction
def fill(typing, number, lanes):
    """A row of the same number."""
    row = Lanes(number, lanes.count)

    def generate(context, builder, signature, arguments):
        return _everywhere(builder, arguments[0], row.width)

    return row(number, lanes), generate


@instruction
def count_up(typing, start, lanes):
    """A row of `start`, `start + 1`, `start + 2`, ..."""
    row = Lanes(start, lanes.count)

    def generate(context, builder, signature, arguments):
        steps = ir.Constant(context.get_value_type(row), [float(i) for i in range(row.width)])
        return builder.fadd(_everywhere(builder, arguments[0], row.width), steps)

    return row(start, lanes), generate


@instruction
def at_most(typing, row, limit):
    """The row with numbers above a limit replaced by it."""

    def generate(context, builder, signature, arguments):
        vector, limit = arguments[0], _everywhere(builder, arguments[1], row.width)
        return builder.select(builder.fcmp_ordered("<", vector, limit), vector, limit)

    return row(row, row.element), generate


def _where(comparison):
    """The instruction that keeps numbers of a row where another row compares so with a limit."""

    def define(typing, row, tested, limit):
        def generate(context, builder, signature, arguments):
            limit = _everywhere(builder, arguments[2], row.width)
            kept = builder.fcmp_ordered(comparison, arguments[1], limit)
            return builder.select(kept, arguments[0], ir.Constant(limit.type, None))

        return row(row, tested, row.element), generate

    return instruction(define)


where_least = _where(">=")
"""The row, but zero where `tested` is less than a limit."""

where_below = _where("<")
"""The row, but zero where `tested` reaches a limit."""


EXPONENTIAL = (1.0, 0.6931469776, 0.2402224207, 0.05550733766, 0.009671513139, 0.001326472021)
"""2^x for -1/2 <= x <= 1/2 as a polynomial, lowest power first; off by 2e-7 of the value."""


ROUNDING = 1.5 * 2.0**23


@instruction
def exponential(typing, row):
    """The exponential of float32 numbers between -87 and 88; smaller ones give 1e-38 or less."""

    def generate(context, builder, signature, arguments):
        kind = arguments[0].type
        bits = ir.VectorType(INT32, row.width)

        def same(number):
            return ir.Constant(kind, [number] * row.width)

        def multiply_add(one, other, added):
            return builder.fadd(builder.fmul(one, other, flags=CONTRACT), added, flags=CONTRACT)

        least = same(-87.0)
        power = builder.select(builder.fcmp_ordered(">", arguments[0], least), arguments[0], least)
        power = builder.fmul(power, same(math.log2(math.e)))
        # Numbers this large have no fraction: adding one and taking it away again rounds.
        whole = builder.fsub(builder.fadd(power, same(ROUNDING)), same(ROUNDING))
        rest = builder.fsub(power, whole)
        value = same(EXPONENTIAL[-1])
        for coefficient in EXPONENTIAL[-2::-1]:
            value = multiply_add(value, rest, same(coefficient))
        exponent = builder.add(builder.fptosi(whole, bits), ir.Constant(bits, [127] * row.width))
        exponent = builder.shl(exponent, ir.Constant(bits, [23] * row.width))
        return builder.fmul(value, builder.bitcast(exponent, kind))

    return row(row), generate


@overload(operator.iadd)
@overload(operator.add)
def _overload_add(one, other):
    if isinstance(one, Lanes) and one == other:
        return lambda one, other: _add(one, other)
    return None


@overload(operator.sub)
def _overload_subtract(one, other):
    if isinstance(one, Lanes) and one == other:
        return lambda one, other: _subtract(one, other)
    return None


@overload(operator.truediv)
def _overload_divide(one, other):
    if isinstance(one, Lanes) and one == other:
        return lambda one, other: _divide(one, other)
    return None


@overload(operator.mul)
def _overload_multiply(one, other):
    if isinstance(one, Lanes) and one == other:
        return lambda one, other: _multiply(one, other)
    if isinstance(one, Lanes) and isinstance(other, types.Float):
        return lambda one, other: _scale(one, other)
    return None
