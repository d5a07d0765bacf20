"""Vectors of 16 floats inside Numba code: one lane a pixel of a 4x4 block.

LLVM does not vectorise the blend by itself (branches, exponentials), so it is given vectors outright: `f32x16` and
`i32x16` values live in registers, operators work lane by lane, scalars are spread over all lanes. On a machine
without 512-bit registers LLVM splits them.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba.core import types
from numba.core.extending import intrinsic, models, overload, register_model

LANES = 16
_F32, _I32, _I1, _I8, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(1), ir.IntType(8), ir.IntType(64)
_VF, _VI, _VM = (ir.VectorType(t, LANES) for t in (_F32, _I32, _I1))


class _Lanes(types.Type):
    def __init__(self, name: str, vector: ir.VectorType):
        self.vector = vector
        super().__init__(name)


f32x16, i32x16, mask16 = _Lanes("f32x16", _VF), _Lanes("i32x16", _VI), _Lanes("mask16", _VM)


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, fe_type.vector)


def _spread(builder: ir.IRBuilder, value: ir.Value, vector: ir.VectorType) -> ir.Value:
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, _I32(0))
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(_I32, LANES), None))


def _as_f32x16(context, builder, value: ir.Value, kind: types.Type) -> ir.Value:
    if kind is f32x16:
        return value
    return _spread(builder, context.cast(builder, value, kind, types.float32), _VF)


def _is_vector(*kinds) -> bool:
    return f32x16 in kinds and all(k is f32x16 or isinstance(k, types.Number) for k in kinds)


def _call(builder: ir.IRBuilder, name: str, result: ir.Type, arguments: list[ir.Value]) -> ir.Value:
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(builder.module.declare_intrinsic(name, fnty=kind), arguments)


def _arithmetic(python_operator, build: str):
    @intrinsic
    def apply(typingctx, a, b):
        def code(context, builder, signature, args):
            a, b = (_as_f32x16(context, builder, v, k) for v, k in zip(args, signature.args))
            return getattr(builder, build)(a, b)

        return f32x16(a, b), code

    @overload(python_operator, inline="always")
    def op(a, b):
        if _is_vector(a, b):
            return lambda a, b: apply(a, b)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")


@intrinsic
def _negative(typingctx, a):
    return f32x16(a), lambda context, builder, signature, args: builder.fneg(args[0])


@overload(operator.neg, inline="always")
def _neg(a):
    if a is f32x16:
        return lambda a: _negative(a)


def _comparison(python_operator, symbol: str):
    @intrinsic
    def apply(typingctx, a, b):
        def code(context, builder, signature, args):
            a, b = (_as_f32x16(context, builder, v, k) for v, k in zip(args, signature.args))
            return builder.fcmp_ordered(symbol, a, b)

        return mask16(a, b), code

    @overload(python_operator, inline="always")
    def op(a, b):
        if _is_vector(a, b):
            return lambda a, b: apply(a, b)


_comparison(operator.ge, ">=")
_comparison(operator.gt, ">")
_comparison(operator.le, "<=")


@intrinsic
def _and(typingctx, a, b):
    return mask16(a, b), lambda context, builder, signature, args: builder.and_(*args)


@overload(operator.and_, inline="always")
def _mask_and(a, b):
    if a is mask16 and b is mask16:
        return lambda a, b: _and(a, b)


@intrinsic
def fma(typingctx, a, b, c):
    """a * b + c, fused where the processor can."""

    def code(context, builder, signature, args):
        return _call(
            builder,
            "llvm.fmuladd.v16f32",
            _VF,
            [_as_f32x16(context, builder, v, k) for v, k in zip(args, signature.args)],
        )

    return f32x16(a, b, c), code


def _pairwise(symbol: str):
    """Of two, the one for which `a symbol b` holds; b if a number is missing. One instruction, unlike LLVM's minnum."""

    @intrinsic
    def apply(typingctx, a, b):
        def code(context, builder, signature, args):
            a, b = (_as_f32x16(context, builder, v, k) for v, k in zip(args, signature.args))
            return builder.select(builder.fcmp_ordered(symbol, a, b), a, b)

        return f32x16(a, b), code

    return apply


lesser, greater = _pairwise("<"), _pairwise(">")


@intrinsic
def select(typingctx, mask, a, b):
    """a where `mask` holds, else b; both float vectors (or numbers)."""

    def code(context, builder, signature, args):
        a, b = (_as_f32x16(context, builder, v, k) for v, k in zip(args[1:], signature.args[1:]))
        return builder.select(args[0], a, b)

    return f32x16(mask, a, b), code


@intrinsic
def select_index(typingctx, mask, index, old):
    """The number `index` where `mask` holds, else the lanes of `old`."""

    def code(context, builder, signature, args):
        index = _spread(builder, context.cast(builder, args[1], signature.args[1], types.int32), _VI)
        return builder.select(args[0], index, args[2])

    return i32x16(mask, index, old), code


@intrinsic
def at_most(typingctx, index, lanes):
    """True where the number `index` <= the lanes of an i32x16."""

    def code(context, builder, signature, args):
        index = _spread(builder, context.cast(builder, args[0], signature.args[0], types.int32), _VI)
        return builder.icmp_signed("<=", index, args[1])

    return mask16(index, lanes), code


@intrinsic
def any_lane(typingctx, mask):
    """True if any lane of a mask holds."""

    def code(context, builder, signature, args):
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], ir.IntType(16)), ir.IntType(16)(0))

    return types.boolean(mask), code


def _sum_in_pairs(builder: ir.IRBuilder, low: ir.Value, high: ir.Value, half: int) -> ir.Value:
    """Lanes whose bit `half` is 0 hold sums of lanes of `low` that are `half` apart, the others those of `high`."""
    kept = [lane + (LANES if lane & half else 0) for lane in range(LANES)]
    added = [(lane ^ half) + (LANES if lane & half else 0) for lane in range(LANES)]
    kept, added = (ir.Constant(ir.VectorType(_I32, LANES), order) for order in (kept, added))
    return builder.fadd(builder.shuffle_vector(low, high, kept), builder.shuffle_vector(low, high, added))


@intrinsic
def totals(typingctx, vectors):
    """The sums of 16 vectors (a tuple), one a lane: a tree of 15 additions of which each halves two vectors at once."""

    def code(context, builder, signature, args):
        values = [builder.extract_value(args[0], i) for i in range(LANES)]
        half = 1
        while len(values) > 1:
            values = [_sum_in_pairs(builder, *values[i : i + 2], half) for i in range(0, len(values), 2)]
            half *= 2
        return values[0]

    return f32x16(vectors), code


@intrinsic
def spread(typingctx, value):
    """A number on all lanes."""
    return f32x16(value), lambda context, builder, signature, args: _as_f32x16(context, builder, args[0], value)


@intrinsic
def exp2(typingctx, x):
    """2^x for x from -126 to 0, relative error 2e-7; for others any number, or none."""
    polynomial = (1.32647273e-03, 9.67151299e-03, 5.55073358e-02, 2.40222424e-01, 6.93147004e-01, 1.0)
    magic = 1.5 * 2**23  # added, it leaves the nearest integer in the lowest bits

    def code(context, builder, signature, args):
        def number(value):
            return ir.Constant(_VF, [value] * LANES)

        (x,) = args
        shifted = builder.fadd(x, number(magic))
        part = builder.fsub(x, builder.fsub(shifted, number(magic)))
        value = number(polynomial[0])
        for coefficient in polynomial[1:]:
            value = _call(builder, "llvm.fmuladd.v16f32", _VF, [value, part, number(coefficient)])
        shift = builder.shl(builder.bitcast(shifted, _VI), ir.Constant(_VI, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, _VI), shift), _VF)

    return f32x16(x), code


def _each(name: str):
    @intrinsic
    def apply(typingctx, a):
        return f32x16(a), lambda context, builder, signature, args: _call(builder, name, _VF, list(args))

    return apply


magnitude, root = _each("llvm.fabs.v16f32"), _each("llvm.sqrt.v16f32")
down, up = _each("llvm.floor.v16f32"), _each("llvm.ceil.v16f32")


@intrinsic
def bits_between(typingctx, first, last):
    """A byte for each of the first 8 lanes, as a uint64: bits first..last (0..7) of it are set, none where last < first."""

    def code(context, builder, signature, args):
        one = ir.Constant(_VI, [1] * LANES)
        zero, seven = (ir.Constant(_VI, [n] * LANES) for n in (0, 7))
        low, high = (builder.fptosi(v, _VI) for v in args)
        low = _call(builder, "llvm.smax.v16i32", _VI, [low, zero])
        high = _call(builder, "llvm.smin.v16i32", _VI, [high, seven])
        some = builder.icmp_signed("<=", low, high)
        # without any bit these mean nothing, but must still be valid shifts
        low, high = (builder.and_(v, seven) for v in (low, high))
        bits = builder.sub(builder.shl(ir.Constant(_VI, [2] * LANES), high), builder.shl(one, low))
        bytes_ = builder.trunc(builder.select(some, bits, zero), ir.VectorType(_I8, LANES))
        return builder.trunc(builder.bitcast(bytes_, ir.IntType(128)), _I64)

    return types.uint64(first, last), code


@intrinsic
def differ(typingctx, a, b):
    """True if two masks are not the same."""

    def code(context, builder, signature, args):
        a, b = (builder.bitcast(mask, ir.IntType(16)) for mask in args)
        return builder.icmp_unsigned("!=", a, b)

    return types.boolean(a, b), code


@intrinsic
def count_trailing_zeros(typingctx, bits):
    """Number of zero bits below the lowest one of a non-zero uint64."""

    def code(context, builder, signature, args):
        found = _call(builder, "llvm.cttz.i64", ir.IntType(64), [args[0], _I1(1)])
        return found

    return types.int64(types.uint64), code
