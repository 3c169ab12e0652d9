"""Eight floats at once, inside numba kernels.

Numba vectorizes loops only when it can prove enough about them, and short rows of pixels never qualify. These types
make the vector explicit: ``lanes`` are eight float32, a ``mask`` is eight booleans, and every operation is one vector
instruction (or two where the machine's vectors are shorter). Sums of products are fused only where `fma` is written, so
that the forward and the backward pass decide alike, to the bit.
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

LANES = 8

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)


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
    """Pointer to eight elements of a C-contiguous float32 array from a flat index on."""
    struct = context.make_array(array_type)(context, builder, array)
    return builder.bitcast(builder.gep(struct.data, [index]), _FLOATS.as_pointer())


@_operation
def splat(typingctx, scalar):
    """Lanes that all hold ``scalar``."""
    return lanes(types.float32), lambda context, builder, sig, args: _splat(builder, args[0])


@_operation
def iota(typingctx):
    """Lanes 0, 1, ... 7."""
    return lanes(), lambda context, builder, sig, args: ir.Constant(_FLOATS, [float(i) for i in range(LANES)])


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
def total(typingctx, a):
    """Sum of the lanes, in a fixed order of halving."""
    return types.float32(lanes), lambda context, builder, sig, args: _call(
        builder,
        f"llvm.vector.reduce.fadd.v{LANES}f32",
        ir.FloatType(),
        [ir.Constant(ir.FloatType(), -0.0), args[0]],
        fastmath=("reassoc",),
    )


# 2^x on [-1/2, 1/2]: the polynomial of least relative error (9.2e-8 in exact arithmetic) that is exact at 0.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733581185341, 0.009671512991189957, 0.001326472730307149)


@_operation
def exp2(typingctx, a):
    """2 to the power of each lane, for lanes in [-30, 30]: relative error below 2e-7, never subnormal."""

    def emit(context, builder, sig, args):
        whole = _call(builder, f"llvm.rint.v{LANES}f32", _FLOATS, args)
        rest = builder.fsub(args[0], whole)
        value = _constant(_EXP2[-1])
        for coefficient in reversed(_EXP2[:-1]):
            value = _call(builder, f"llvm.fma.v{LANES}f32", _FLOATS, [value, rest, _constant(coefficient)])
        exponent = builder.shl(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _FLOATS)

    return lanes(lanes), emit
