"""SIMD vectors as values in numba kernels: types, operators and common operations.

Numba's automatic vectorization depends on its analysis of a loop. Here vectors are explicit: every operation is one
vector instruction, or two or four on machines with shorter vectors. The two types are `float32x16` and `float64x8`,
each with a mask of booleans. Products and sums are fused only by `fma`, so that kernels with the same arithmetic make
bit-identical decisions.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model


class VectorType(types.Type):
    """Numba type of a vector, or of its mask."""

    def __init__(self, name: str, content: ir.VectorType, suffix: str):
        super().__init__(name=name)
        self.content, self.count, self.suffix = content, content.count, suffix


@register_model(VectorType)
class VectorModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, numba_type.content)


def operation(emitter) -> Any:
    """Register a numba intrinsic; ``emitter`` returns its signature and its code generator."""
    return intrinsic(emitter)


def make(element: ir.Type, count: int, suffix: str) -> tuple[VectorType, VectorType]:
    """Create a vector type and its mask type with their operators; ``suffix`` is LLVM's name of the vector."""
    vector = VectorType(f"vector_{suffix}", ir.VectorType(element, count), suffix)
    mask = VectorType(f"mask_{suffix}", ir.VectorType(ir.IntType(1), count), f"v{count}i1")
    _define(operator.add, (vector, vector), vector, lambda b, x, y: b.fadd(x, y))
    _define(operator.sub, (vector, vector), vector, lambda b, x, y: b.fsub(x, y))
    _define(operator.mul, (vector, vector), vector, lambda b, x, y: b.fmul(x, y))
    _define(operator.truediv, (vector, vector), vector, lambda b, x, y: b.fdiv(x, y))
    _define(operator.neg, (vector,), vector, lambda b, x: b.fneg(x))
    _define(operator.ge, (vector, vector), mask, lambda b, x, y: b.fcmp_ordered(">=", x, y))
    _define(operator.gt, (vector, vector), mask, lambda b, x, y: b.fcmp_ordered(">", x, y))
    _define(operator.and_, (mask, mask), mask, lambda b, x, y: b.and_(x, y))
    _define(operator.or_, (mask, mask), mask, lambda b, x, y: b.or_(x, y))
    _define(operator.invert, (mask,), mask, lambda b, x: b.not_(x))
    return vector, mask


def _define(key, operands, result, emit) -> None:
    """Implement ``key`` (from the module ``operator``) for vector types by one instruction."""
    register: Any = infer_global(key)
    register(type(f"Vector_{key.__name__}", (ConcreteTemplate,), {"cases": [signature(result, *operands)]}))
    lower_builtin(key, *operands)(lambda context, builder, sig, args: emit(builder, *args))


# Helpers for code generators


def constant(vector: ir.VectorType, value: float) -> ir.Constant:
    """Vector constant with one number in all lanes."""
    return ir.Constant(vector, [value] * vector.count)


def repeat(builder, vector: ir.VectorType, scalar):
    """Copy a scalar to all lanes."""
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    return shuffle(builder, first, first, [0] * vector.count)


def shuffle(builder, a, b, indices: Iterable[int]):
    """Select elements of the concatenation of a and b."""
    indices = list(indices)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(indices)), indices))


def call(builder, name: str, result: ir.Type, arguments):
    """Call an LLVM intrinsic."""
    function_type = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), arguments)


def address(context, builder, array_type, array, index, content: ir.Type):
    """Pointer into a C-contiguous array at a flat index."""
    struct = context.make_array(array_type)(context, builder, array)
    return builder.bitcast(builder.gep(struct.data, [index]), content.as_pointer())


# Operations of both types


@operation
def fma(typingctx, a, b, c):
    """a * b + c, rounded once."""
    return a(a, b, c), lambda context, builder, sig, args: call(
        builder, f"llvm.fma.{sig.return_type.suffix}", sig.return_type.content, args
    )


@operation
def smaller(typingctx, a, b):
    """Element-wise minimum."""
    return a(a, b), lambda context, builder, sig, args: builder.select(builder.fcmp_ordered("<", *args), *args)


@operation
def larger(typingctx, a, b):
    """Element-wise maximum."""
    return a(a, b), lambda context, builder, sig, args: builder.select(builder.fcmp_ordered(">", *args), *args)


@operation
def select(typingctx, condition, a, b):
    """Element-wise choice: a if the condition is true, else b."""
    return a(condition, a, b), lambda context, builder, sig, args: builder.select(*args)


@operation
def bits_of(typingctx, condition):
    """Convert a mask to the low bits of an integer, the first lane lowest."""

    def emit(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(sig.args[0].count)), ir.IntType(64))

    return types.uint64(condition), emit


@operation
def any_of(typingctx, condition):
    """True if any lane is true."""

    def emit(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(sig.args[0].count))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(condition), emit


@operation
def unlikely(typingctx, condition):
    """Return the condition, with a hint to the compiler that it is rarely true."""

    def emit(context, builder, sig, args):
        return call(builder, "llvm.expect.i1", ir.IntType(1), [args[0], ir.Constant(ir.IntType(1), 0)])

    return types.boolean(types.boolean), emit


@operation
def lowest_bit(typingctx, bits):
    """Index of the lowest set bit; undefined for zero."""

    def emit(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), emit


@operation
def prefetch(typingctx, array, index):
    """Prefetch the cache line of an array element at flat index ``index``."""

    def emit(context, builder, sig, args):
        array, index = args
        where = address(context, builder, sig.args[0], array, index, ir.IntType(8))
        reading, soon, data = (ir.Constant(ir.IntType(32), value) for value in (0, 3, 1))
        call(builder, "llvm.prefetch.p0", ir.VoidType(), [where, reading, soon, data])
        return context.get_dummy_value()

    return types.void(array, types.intp), emit
