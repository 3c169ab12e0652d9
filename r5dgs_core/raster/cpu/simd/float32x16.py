"""16-lane float32 SIMD type for numba kernels; one vector covers a block of 4 x 4 pixels. See `vectors`."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba.core import types

from .vectors import address, call, constant, make, operation, repeat, shuffle

LANES = 16

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)

lanes, mask = make(ir.FloatType(), LANES, f"v{LANES}f32")


@operation
def splat(typingctx, scalar):
    """Set all lanes to ``scalar``."""
    return lanes(types.float32), lambda context, builder, sig, args: repeat(builder, _FLOATS, args[0])


@operation
def load(typingctx, array, index):
    """Load lanes from a float32 array at flat index ``index``; no bounds check."""

    def emit(context, builder, sig, args):
        array, index = args
        return builder.load(address(context, builder, sig.args[0], array, index, _FLOATS), align=4)

    return lanes(array, types.intp), emit


@operation
def broadcast(typingctx, array, index):
    """Load one element of a float32 array, at flat index ``index``, into all lanes; no bounds check."""

    def emit(context, builder, sig, args):
        struct = context.make_array(sig.args[0])(context, builder, args[0])
        return repeat(builder, _FLOATS, builder.load(builder.gep(struct.data, [args[1]])))

    return lanes(array, types.intp), emit


@operation
def store(typingctx, array, index, value):
    """Store lanes to a float32 array at flat index ``index``; no bounds check."""

    def emit(context, builder, sig, args):
        builder.store(args[2], address(context, builder, sig.args[0], args[0], args[1], _FLOATS), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), emit


# A block of pixels: lane 4 y + x. In images, its four rows of four pixels are a stride apart.
ROWS = 4


@operation
def store_rows(typingctx, array, index, stride, value):
    """Store four rows of four lanes to an array, from a flat index on, rows ``stride`` elements apart.

    The array is float32, or int32 if the lanes are whole numbers.
    """

    def emit(context, builder, sig, args):
        array, at, stride, value = args
        if sig.args[0].dtype == types.int32:
            value = builder.fptosi(value, _INTS)
        for row in range(ROWS):
            part = shuffle(builder, value, value, range(row * ROWS, (row + 1) * ROWS))
            _store_part(context, builder, sig.args[0], array, at, part)
            at = builder.add(at, stride)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, lanes), emit


@operation
def store_rows_of_three(typingctx, array, index, stride, a, b, c):
    """Store three vectors like `store_rows` to an array with three values per pixel; the stride is in floats."""

    def emit(context, builder, sig, args):
        array, at, stride, a, b, c = args
        for row in range(ROWS):
            first = row * ROWS
            two, three = [], []
            for x in range(ROWS):
                two += [first + x, LANES + first + x, 0]
                three += [3 * x, 3 * x + 1, LANES + first + x]
            mixed = shuffle(builder, a, b, [*two, 0, 0, 0, 0])
            mixed = shuffle(builder, mixed, c, [*three, 0, 0, 0, 0])
            _store_part(context, builder, sig.args[0], array, at, shuffle(builder, mixed, mixed, range(8)))
            after = builder.add(at, ir.Constant(at.type, 8))
            _store_part(context, builder, sig.args[0], array, after, shuffle(builder, mixed, mixed, range(8, 12)))
            at = builder.add(at, stride)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, lanes, lanes, lanes), emit


@operation
def load_rows(typingctx, array, index, stride):
    """Load lanes from four rows of four floats, in the layout of `store_rows`."""

    def emit(context, builder, sig, args):
        array, at, stride = args
        rows = _load_parts(context, builder, sig.args[0], array, at, stride, ROWS)
        upper, lower = (shuffle(builder, rows[i], rows[i + 1], range(2 * ROWS)) for i in (0, 2))
        return shuffle(builder, upper, lower, range(LANES))

    return lanes(array, types.intp, types.intp), emit


@operation
def load_rows_of_three(typingctx, array, index, stride):
    """Load three vectors from an array with three values per pixel, in the layout of `store_rows_of_three`."""

    def emit(context, builder, sig, args):
        array, at, stride = args
        low = _load_parts(context, builder, sig.args[0], array, at, stride, 8)
        after = builder.add(at, ir.Constant(at.type, 8))
        high = _load_parts(context, builder, sig.args[0], array, after, stride, ROWS)
        widened = [shuffle(builder, part, part, [0, 1, 2, 3, 0, 0, 0, 0]) for part in high]
        rows = [shuffle(builder, a, b, range(LANES)) for a, b in zip(low, widened, strict=True)]
        result = []
        for channel in range(3):
            taken = [3 * x + channel for x in range(ROWS)]
            both = [*taken, *(LANES + i for i in taken)] * 2
            upper, lower = (shuffle(builder, rows[i], rows[i + 1], both) for i in (0, 2))
            result.append(shuffle(builder, upper, lower, [*range(8), *range(LANES, LANES + 8)]))
        return context.make_tuple(builder, sig.return_type, result)

    return types.UniTuple(lanes, 3)(array, types.intp, types.intp), emit


def _store_part(context, builder, array_type, array, index, part):
    builder.store(part, address(context, builder, array_type, array, index, part.type), align=4)


def _load_parts(context, builder, array_type, array, index, stride, count):
    """Load four short vectors, a stride apart."""
    content, parts = ir.VectorType(ir.FloatType(), count), []
    for _ in range(ROWS):
        parts.append(builder.load(address(context, builder, array_type, array, index, content), align=4))
        index = builder.add(index, stride)
    return parts


@operation
def mask_of(typingctx, bits):
    """Convert the low bits of an integer to a mask."""

    def emit(context, builder, sig, args):
        return builder.bitcast(builder.trunc(args[0], ir.IntType(LANES)), mask.content)

    return mask(types.uint64), emit


@operation
def totals(typingctx, vectors):
    """Horizontal sums of sixteen vectors, one per lane, each added in the same fixed order."""

    def emit(context, builder, sig, args):
        rest = [builder.extract_value(args[0], i) for i in range(LANES)]
        width = LANES  # lanes that belong to one sum
        while width > 1:
            half, half_count = width // 2, len(rest) // 2
            low, high = [], []  # first and second half of each sum, sums interleaved
            for block in range(LANES // width):
                for vector in (0, 1):
                    begin = vector * LANES + block * width
                    low += range(begin, begin + half)
                    high += range(begin + half, begin + width)
            pairs = zip(rest[:half_count], rest[half_count:], strict=True)
            rest = [builder.fadd(shuffle(builder, a, b, low), shuffle(builder, a, b, high)) for a, b in pairs]
            width = half
        return rest[0]

    return lanes(types.UniTuple(lanes, LANES)), emit


# 2^x on [-1/2, 1/2]: minimax polynomial for the relative error (9.2e-8 in exact arithmetic), exact at 0.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733581185341, 0.009671512991189957, 0.001326472730307149)


def _number(value):
    return constant(_FLOATS, float(np.float32(value)))


_ROUND = 1.5 * 2.0**23  # adding it rounds to an integer, held in the low bits, as a float32 this large has no fraction


@operation
def exp2(typingctx, a):
    """2 to the power of each lane, for lanes in [-30, 30]; relative error below 2e-7, never subnormal."""

    def emit(context, builder, sig, args):
        shifted = builder.fadd(args[0], _number(_ROUND))
        rest = builder.fsub(args[0], builder.fsub(shifted, _number(_ROUND)))
        value = _number(_EXP2[-1])
        for coefficient in reversed(_EXP2[:-1]):
            value = call(builder, f"llvm.fma.v{LANES}f32", _FLOATS, [value, rest, _number(coefficient)])
        exponent = builder.shl(builder.bitcast(shifted, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _FLOATS)

    return lanes(lanes), emit


@operation
def reciprocal(typingctx, a):
    """Reciprocal of each lane, for positive normal lanes; relative error below 2e-7, much faster than a division.

    Newton's method from an initial guess that negates the exponent, with an error of at most 12 %.
    """

    def emit(context, builder, sig, args):
        first = builder.sub(ir.Constant(_INTS, [0x7EF127EA] * LANES), builder.bitcast(args[0], _INTS))
        guess, negative = builder.bitcast(first, _FLOATS), builder.fneg(args[0])
        for _ in range(3):
            error = call(builder, f"llvm.fma.v{LANES}f32", _FLOATS, [negative, guess, _number(1.0)])
            guess = call(builder, f"llvm.fma.v{LANES}f32", _FLOATS, [guess, error, guess])
        return guess

    return lanes(lanes), emit
