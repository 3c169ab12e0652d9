"""Sixteen floats at once, inside numba kernels.

Numba vectorizes loops only when it can prove enough about them, and small blocks of pixels never qualify. These types
make the vector explicit: ``lanes`` are sixteen float32, a ``mask`` is sixteen booleans, and every operation is one
vector instruction (or two or four where the machine's vectors are shorter). Sums of products are fused only where `fma`
is written, so that the forward and the backward pass decide alike, to the bit.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

LANES = 16

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_BYTE = ir.IntType(8)


class LanesType(types.Type):
    def __init__(self):
        super().__init__(name=f"float32x{LANES}")


class MaskType(types.Type):
    def __init__(self):
        super().__init__(name=f"boolx{LANES}")


lanes = LanesType()
mask = MaskType()


@register_model(LanesType)
class LanesModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _FLOATS)


@register_model(MaskType)
class MaskModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _BITS)


def _operation(emitter) -> Any:
    """Make a function of the kernels from one that is called by the compiler: signature and emitter of instructions."""
    return intrinsic(emitter)


def _define_operator(key, operands, result, emit):
    """Let ``key`` (from the module ``operator``) work on vector types by emitting one instruction."""
    register: Any = infer_global(key)
    register(type(f"Lanes_{key.__name__}", (ConcreteTemplate,), {"cases": [signature(result, *operands)]}))
    lower_builtin(key, *operands)(lambda context, builder, sig, args: emit(builder, *args))


_define_operator(operator.add, (lanes, lanes), lanes, lambda b, x, y: b.fadd(x, y))
_define_operator(operator.sub, (lanes, lanes), lanes, lambda b, x, y: b.fsub(x, y))
_define_operator(operator.mul, (lanes, lanes), lanes, lambda b, x, y: b.fmul(x, y))
_define_operator(operator.truediv, (lanes, lanes), lanes, lambda b, x, y: b.fdiv(x, y))
_define_operator(operator.neg, (lanes,), lanes, lambda b, x: b.fneg(x))
_define_operator(operator.ge, (lanes, lanes), mask, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_define_operator(operator.gt, (lanes, lanes), mask, lambda b, x, y: b.fcmp_ordered(">", x, y))
_define_operator(operator.and_, (mask, mask), mask, lambda b, x, y: b.and_(x, y))
_define_operator(operator.or_, (mask, mask), mask, lambda b, x, y: b.or_(x, y))
_define_operator(operator.invert, (mask,), mask, lambda b, x: b.not_(x))


def _splat(builder, scalar):
    """Repeat a scalar in all lanes."""
    vector = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(_INTS, [0] * LANES)
    return builder.shuffle_vector(vector, ir.Constant(_FLOATS, ir.Undefined), zeros)


def _constant(value):
    return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)


def _call(builder, name, result, arguments, fastmath=()):
    function_type = ir.FunctionType(result, [a.type for a in arguments])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)
    return builder.call(function, arguments, fastmath=fastmath)


def _address(context, builder, array_type, array, index):
    """Pointer to LANES elements of a C-contiguous float32 array from a flat index on."""
    struct = context.make_array(array_type)(context, builder, array)
    return builder.bitcast(builder.gep(struct.data, [index]), _FLOATS.as_pointer())


@_operation
def splat(typingctx, scalar):
    """Lanes that all hold ``scalar``."""
    return lanes(types.float32), lambda context, builder, sig, args: _splat(builder, args[0])


@_operation
def load(typingctx, array, index):
    """Lanes from a float32 array, from flat index ``index`` on; nothing is checked."""

    def emit(context, builder, sig, args):
        return builder.load(_address(context, builder, sig.args[0], *args), align=4)

    return lanes(array, types.intp), emit


@_operation
def broadcast(typingctx, array, index):
    """Lanes that all hold one element of a float32 array, at flat index ``index``; nothing is checked."""

    def emit(context, builder, sig, args):
        struct = context.make_array(sig.args[0])(context, builder, args[0])
        return _splat(builder, builder.load(builder.gep(struct.data, [args[1]])))

    return lanes(array, types.intp), emit


@_operation
def store(typingctx, array, index, value):
    """Write lanes to a float32 array, from flat index ``index`` on; nothing is checked."""

    def emit(context, builder, sig, args):
        builder.store(args[2], _address(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), emit


# A block of pixels: lane 4 y + x. Images hold its four rows of four pixels some stride apart.
ROWS = 4


@_operation
def store_rows(typingctx, array, index, stride, value):
    """Write four rows of four lanes to a float32 array, the first at a flat index, each a stride after the last."""

    def emit(context, builder, sig, args):
        array, at, stride, value = args
        for row in range(ROWS):
            part = _shuffle(builder, value, value, range(row * ROWS, (row + 1) * ROWS))
            _store_part(context, builder, sig.args[0], array, at, part)
            at = builder.add(at, stride)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, lanes), emit


@_operation
def store_rows_of_three(typingctx, array, index, stride, a, b, c):
    """Like `store_rows` for an array that holds three values per pixel, from three vectors; the stride in floats."""

    def emit(context, builder, sig, args):
        array, at, stride, a, b, c = args
        for row in range(ROWS):
            first = row * ROWS
            two, three = [], []
            for x in range(ROWS):
                two += [first + x, LANES + first + x, 0]
                three += [3 * x, 3 * x + 1, LANES + first + x]
            mixed = _shuffle(builder, a, b, [*two, 0, 0, 0, 0])
            mixed = _shuffle(builder, mixed, c, [*three, 0, 0, 0, 0])
            _store_part(context, builder, sig.args[0], array, at, _shuffle(builder, mixed, mixed, range(8)))
            after = builder.add(at, ir.Constant(at.type, 8))
            _store_part(context, builder, sig.args[0], array, after, _shuffle(builder, mixed, mixed, range(8, 12)))
            at = builder.add(at, stride)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, lanes, lanes, lanes), emit


@_operation
def load_rows(typingctx, array, index, stride):
    """Lanes from four rows of four floats, as `store_rows` writes them."""

    def emit(context, builder, sig, args):
        rows = _load_parts(context, builder, sig.args[0], *args, ROWS)
        pairs = [_shuffle(builder, rows[i], rows[i + 1], range(2 * ROWS)) for i in (0, 2)]
        return _shuffle(builder, *pairs, range(LANES))

    return lanes(array, types.intp, types.intp), emit


@_operation
def load_rows_of_three(typingctx, array, index, stride):
    """Three vectors from an array that holds three values per pixel, as `store_rows_of_three` writes them."""

    def emit(context, builder, sig, args):
        low = _load_parts(context, builder, sig.args[0], *args, 8)
        array, at, stride = args
        after = builder.add(at, ir.Constant(at.type, 8))
        high = _load_parts(context, builder, sig.args[0], array, after, stride, ROWS)
        widened = [_shuffle(builder, part, part, [0, 1, 2, 3, 0, 0, 0, 0]) for part in high]
        rows = [_shuffle(builder, a, b, range(LANES)) for a, b in zip(low, widened, strict=True)]
        result = []
        for channel in range(3):
            taken = [3 * x + channel for x in range(ROWS)]
            both = [*taken, *(LANES + i for i in taken)] * 2
            pairs = [_shuffle(builder, rows[i], rows[i + 1], both) for i in (0, 2)]
            result.append(_shuffle(builder, *pairs, [*range(8), *range(LANES, LANES + 8)]))
        return context.make_tuple(builder, sig.return_type, result)

    return types.UniTuple(lanes, 3)(array, types.intp, types.intp), emit


def _part_address(context, builder, array_type, array, index, count):
    struct = context.make_array(array_type)(context, builder, array)
    part = ir.VectorType(ir.FloatType(), count)
    return builder.bitcast(builder.gep(struct.data, [index]), part.as_pointer())


def _store_part(context, builder, array_type, array, index, part):
    builder.store(part, _part_address(context, builder, array_type, array, index, part.type.count), align=4)


def _load_parts(context, builder, array_type, array, index, stride, count):
    """Four short vectors, each a stride after the last."""
    parts = []
    for _ in range(ROWS):
        parts.append(builder.load(_part_address(context, builder, array_type, array, index, count), align=4))
        index = builder.add(index, stride)
    return parts


@_operation
def prefetch(typingctx, array, index):
    """Ask for the cache line of one element of an array, at flat index ``index``, before it is needed."""

    def emit(context, builder, sig, args):
        struct = context.make_array(sig.args[0])(context, builder, args[0])
        address = builder.bitcast(builder.gep(struct.data, [args[1]]), _BYTE.as_pointer())
        reading, soon, data = (ir.Constant(ir.IntType(32), value) for value in (0, 3, 1))
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), [address, reading, soon, data])
        return context.get_dummy_value()

    return types.void(array, types.intp), emit


@_operation
def fma(typingctx, a, b, c):
    """a * b + c, rounded once."""
    return lanes(lanes, lanes, lanes), lambda context, builder, sig, args: _call(
        builder, f"llvm.fma.v{LANES}f32", _FLOATS, args
    )


@_operation
def smaller(typingctx, a, b):
    """Lane by lane the smaller of two."""
    return lanes(lanes, lanes), lambda context, builder, sig, args: builder.select(
        builder.fcmp_ordered("<", *args), *args
    )


@_operation
def larger(typingctx, a, b):
    """Lane by lane the larger of two."""
    return lanes(lanes, lanes), lambda context, builder, sig, args: builder.select(
        builder.fcmp_ordered(">", *args), *args
    )


@_operation
def select(typingctx, condition, a, b):
    """Lane by lane a where the condition holds, else b."""
    return lanes(mask, lanes, lanes), lambda context, builder, sig, args: builder.select(*args)


@_operation
def any_of(typingctx, condition):
    """Whether any lane holds."""

    def emit(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask), emit


@_operation
def unlikely(typingctx, condition):
    """The condition itself; tells the compiler to keep what hangs on it out of the way of the rest."""

    def emit(context, builder, sig, args):
        return _call(builder, "llvm.expect.i1", ir.IntType(1), [args[0], ir.Constant(ir.IntType(1), 0)])

    return types.boolean(types.boolean), emit


@_operation
def bits_of(typingctx, condition):
    """The mask as the low bits of an integer, first lane lowest."""

    def emit(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.uint64(mask), emit


@_operation
def mask_of(typingctx, bits):
    """The mask whose lanes are the low bits of an integer."""

    def emit(context, builder, sig, args):
        return builder.bitcast(builder.trunc(args[0], ir.IntType(LANES)), _BITS)

    return mask(types.uint64), emit


@_operation
def lowest_bit(typingctx, bits):
    """Index of the lowest bit that is set; undefined for zero."""

    def emit(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), emit


@_operation
def totals(typingctx, vectors):
    """Lanes whose i-th is the sum of the i-th of sixteen vectors, each added up in the same fixed order."""

    def emit(context, builder, sig, args):
        rest = [builder.extract_value(args[0], i) for i in range(LANES)]
        width = LANES  # lanes that still belong to one sum
        while width > 1:
            half, half_count = width // 2, len(rest) // 2
            low, high = [], []  # lanes to add up: of each sum the first half and the second half, sums interleaved
            for block in range(LANES // width):
                for vector in (0, 1):
                    begin = vector * LANES + block * width
                    low += range(begin, begin + half)
                    high += range(begin + half, begin + width)
            pairs = zip(rest[:half_count], rest[half_count:], strict=True)
            rest = [builder.fadd(_shuffle(builder, a, b, low), _shuffle(builder, a, b, high)) for a, b in pairs]
            width = half
        return rest[0]

    return lanes(types.UniTuple(lanes, LANES)), emit


def _shuffle(builder, a, b, indices):
    """A vector of some elements of a followed by b."""
    indices = list(indices)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(indices)), indices))


# 2^x on [-1/2, 1/2]: the polynomial of least relative error (9.2e-8 in exact arithmetic) that is exact at 0.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733581185341, 0.009671512991189957, 0.001326472730307149)


_ROUND = 1.5 * 2.0**23  # a float32 this large has no fraction: adding it rounds to a whole number, kept in the low bits


@_operation
def exp2(typingctx, a):
    """2 to the power of each lane, for lanes in [-30, 30]: relative error below 2e-7, never subnormal."""

    def emit(context, builder, sig, args):
        shifted = builder.fadd(args[0], _constant(_ROUND))
        rest = builder.fsub(args[0], builder.fsub(shifted, _constant(_ROUND)))
        value = _constant(_EXP2[-1])
        for coefficient in reversed(_EXP2[:-1]):
            value = _call(builder, f"llvm.fma.v{LANES}f32", _FLOATS, [value, rest, _constant(coefficient)])
        exponent = builder.shl(builder.bitcast(shifted, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _FLOATS)

    return lanes(lanes), emit
