"""8-lane float64 SIMD type for numba kernels; one vector covers eight Gaussians. See `vectors`."""

from __future__ import annotations

import math

from llvmlite import ir
from numba.core import types

from .float32x16 import LANES, lanes
from .vectors import address, call, constant, make, operation, repeat, shuffle

DOUBLES = 8

_DOUBLES = ir.VectorType(ir.DoubleType(), DOUBLES)
_FLOATS = ir.VectorType(ir.FloatType(), DOUBLES)
_INTS = ir.VectorType(ir.IntType(64), DOUBLES)

doubles, _ = make(ir.DoubleType(), DOUBLES, f"v{DOUBLES}f64")


@operation
def spread(typingctx, scalar):
    """Set all lanes to ``scalar``."""
    return doubles(types.float64), lambda context, builder, sig, args: repeat(builder, _DOUBLES, args[0])


@operation
def entry(typingctx, array, index):
    """Load one element of a float64 array, at flat index ``index``, into all lanes; no bounds check."""

    def emit(context, builder, sig, args):
        array, index = args
        scalar = builder.load(address(context, builder, sig.args[0], array, index, ir.DoubleType()))
        return repeat(builder, _DOUBLES, scalar)

    return doubles(array, types.intp), emit


@operation
def column(typingctx, array, row, last, width, index):
    """Load eight rows of a column of a flat float table with ``width`` columns, from ``row`` on.

    Rows beyond ``last`` repeat row ``last``.
    """
    element = array.dtype

    def emit(context, builder, sig, args):
        array, row, last, width, index = args
        content = ir.FloatType() if element == types.float32 else ir.DoubleType()
        vector = ir.Constant(ir.VectorType(content, DOUBLES), ir.Undefined)
        for k in range(DOUBLES):
            at = builder.add(row, ir.Constant(row.type, k))
            at = builder.select(builder.icmp_signed("<", at, last), at, last)
            at = builder.add(builder.mul(at, width), index)
            scalar = builder.load(address(context, builder, sig.args[0], array, at, content))
            vector = builder.insert_element(vector, scalar, ir.Constant(ir.IntType(32), k))
        return vector if element == types.float64 else builder.fpext(vector, _DOUBLES)

    return doubles(array, types.intp, types.intp, types.intp, types.intp), emit


@operation
def set_column(typingctx, array, row, width, index, value):
    """Store eight rows of a column of a flat float32 table with ``width`` columns, from ``row`` on."""

    def emit(context, builder, sig, args):
        array, row, width, index, value = args
        value = builder.fptrunc(value, _FLOATS)
        at = builder.add(builder.mul(row, width), index)
        for k in range(DOUBLES):
            scalar = builder.extract_element(value, ir.Constant(ir.IntType(32), k))
            builder.store(scalar, address(context, builder, sig.args[0], array, at, ir.FloatType()))
            at = builder.add(at, width)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, types.intp, doubles), emit


@operation
def store_doubles(typingctx, array, index, value):
    """Store a vector to a float64 array at flat index ``index``; no bounds check."""

    def emit(context, builder, sig, args):
        array, index, value = args
        builder.store(value, address(context, builder, sig.args[0], array, index, _DOUBLES), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, doubles), emit


@operation
def store_table(typingctx, array, row, columns):
    """Store eight vectors as the columns of eight rows of a flat float64 table with eight columns, from ``row`` on."""

    def emit(context, builder, sig, args):
        array, row, columns = args
        vectors = [builder.extract_value(columns, k) for k in range(DOUBLES)]
        # transpose by exchanging halves, then quarters, then neighbours
        for step in (4, 2, 1):
            done: list = [None] * DOUBLES
            for k in range(DOUBLES):
                if k & step:
                    continue
                a, b = vectors[k], vectors[k + step]
                low = [i if not i & step else DOUBLES + i - step for i in range(DOUBLES)]
                high = [i + step if not i & step else DOUBLES + i for i in range(DOUBLES)]
                done[k], done[k + step] = shuffle(builder, a, b, low), shuffle(builder, a, b, high)
            vectors = done
        at = builder.mul(row, ir.Constant(row.type, DOUBLES))
        for vector in vectors:
            builder.store(vector, address(context, builder, sig.args[0], array, at, _DOUBLES), align=8)
            at = builder.add(at, ir.Constant(at.type, DOUBLES))
        return context.get_dummy_value()

    return types.void(array, types.intp, types.UniTuple(doubles, DOUBLES)), emit


@operation
def widen(typingctx, vector):
    """Convert sixteen float32 to two vectors of float64."""

    def emit(context, builder, sig, args):
        halves = [shuffle(builder, args[0], args[0], range(k, k + DOUBLES)) for k in (0, LANES - DOUBLES)]
        return context.make_tuple(builder, sig.return_type, [builder.fpext(half, _DOUBLES) for half in halves])

    return types.UniTuple(doubles, 2)(lanes), emit


@operation
def sqrt(typingctx, a):
    """Square root."""
    return doubles(doubles), lambda context, builder, sig, args: call(
        builder, f"llvm.sqrt.v{DOUBLES}f64", _DOUBLES, args
    )


@operation
def floor(typingctx, a):
    """Round down to an integer."""
    return doubles(doubles), lambda context, builder, sig, args: call(
        builder, f"llvm.floor.v{DOUBLES}f64", _DOUBLES, args
    )


_FRACTION = (1 << 52) - 1
_ONE = 1023 << 52
_TWO_TO_52 = 1075 << 52


@operation
def log2(typingctx, a):
    """Logarithm to base 2 of positive normal numbers, accurate to a few float64 rounding errors."""

    def emit(context, builder, sig, args):
        def number(value):
            return constant(_DOUBLES, value)

        def integer(value):
            return constant(_INTS, value)

        def fused(a, b, c):
            return call(builder, f"llvm.fma.v{DOUBLES}f64", _DOUBLES, [a, b, c])

        bits = builder.bitcast(args[0], _INTS)
        # x = m 2^k with m in [1, 2); if m > sqrt(2), halve m and increment k, so that |m - 1| is small
        fraction = builder.bitcast(builder.or_(builder.and_(bits, integer(_FRACTION)), integer(_ONE)), _DOUBLES)
        biased = builder.or_(builder.lshr(bits, integer(52)), integer(_TWO_TO_52))
        whole = builder.fsub(builder.bitcast(biased, _DOUBLES), number(2.0**52 + 1023))
        large = builder.fcmp_ordered(">", fraction, number(math.sqrt(2.0)))
        fraction = builder.select(large, builder.fmul(fraction, number(0.5)), fraction)
        whole = builder.select(large, builder.fadd(whole, number(1.0)), whole)
        # ln m = 2 artanh s with s = (m - 1) / (m + 1), |s| < 0.172: eleven terms of the series
        s = builder.fdiv(builder.fsub(fraction, number(1.0)), builder.fadd(fraction, number(1.0)))
        square = builder.fmul(s, s)
        series = number(1 / 21)
        for power in range(19, 0, -2):
            series = fused(series, square, number(1 / power))
        return fused(builder.fmul(s, number(2 / math.log(2.0))), series, whole)

    return doubles(doubles), emit
