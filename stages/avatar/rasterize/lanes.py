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
_F32, _I32, _I1 = ir.FloatType(), ir.IntType(32), ir.IntType(1)
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
_comparison(operator.lt, "<")


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


def _pairwise(name: str):
    @intrinsic
    def apply(typingctx, a, b):
        def code(context, builder, signature, args):
            return _call(builder, name, _VF, [_as_f32x16(context, builder, v, k) for v, k in zip(args, signature.args)])

        return f32x16(a, b), code

    return apply


lesser, greater = _pairwise("llvm.minnum.v16f32"), _pairwise("llvm.maxnum.v16f32")


@intrinsic
def magnitude(typingctx, a):
    """|a|, lane by lane."""
    return f32x16(a), lambda context, builder, signature, args: _call(builder, "llvm.fabs.v16f32", _VF, list(args))


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


@intrinsic
def total(typingctx, a):
    """The sum of the 16 lanes, added pairwise."""

    def code(context, builder, signature, args):
        value, width = args[0], LANES
        while width > 1:
            width //= 2
            half = ir.VectorType(_I32, width)
            none = ir.Constant(value.type, ir.Undefined)
            low = builder.shuffle_vector(value, none, ir.Constant(half, list(range(width))))
            high = builder.shuffle_vector(value, none, ir.Constant(half, list(range(width, 2 * width))))
            value = builder.fadd(low, high)
        return builder.extract_element(value, _I32(0))

    return types.float32(a), code


@intrinsic
def spread(typingctx, value):
    """A number on all lanes."""
    return f32x16(value), lambda context, builder, signature, args: _as_f32x16(context, builder, args[0], value)


@intrinsic
def exp2(typingctx, x):
    """2^x for x <= 0, relative error 3e-7; below -30 the value of 2^-30, which keeps denormal numbers away."""
    taylor = (1.3333558e-3, 9.6181291e-3, 5.5504109e-2, 2.4022651e-1, 6.9314718e-1, 1.0)

    def code(context, builder, signature, args):
        def number(value):
            return ir.Constant(_VF, [value] * LANES)

        x = _call(builder, "llvm.maxnum.v16f32", _VF, [args[0], number(-30.0)])
        whole = _call(builder, "llvm.rint.v16f32", _VF, [x])
        part = builder.fsub(x, whole)
        value = number(1.5403530e-4)
        for coefficient in taylor:
            value = _call(builder, "llvm.fmuladd.v16f32", _VF, [value, part, number(coefficient)])
        shift = builder.shl(builder.fptosi(whole, _VI), ir.Constant(_VI, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, _VI), shift), _VF)

    return f32x16(x), code


def _pointer(context, builder, kind, array, index, vector):
    data = context.make_array(kind)(context, builder, array).data
    element = builder.gep(data, [context.cast(builder, index, types.int64, types.intp)])
    return builder.bitcast(element, vector.as_pointer())


def _load(vector, lanes, dtype):
    @intrinsic
    def apply(typingctx, array, index):
        def code(context, builder, signature, args):
            index = context.cast(builder, args[1], signature.args[1], types.int64)
            where = _pointer(context, builder, signature.args[0], args[0], index, vector)
            return builder.load(where, align=4)

        return lanes(array, index), code

    return apply


def _store(vector):
    @intrinsic
    def apply(typingctx, array, index, value):
        def code(context, builder, signature, args):
            index = context.cast(builder, args[1], signature.args[1], types.int64)
            where = _pointer(context, builder, signature.args[0], args[0], index, vector)
            builder.store(args[2], where, align=4)
            return context.get_dummy_value()

        return types.none(array, index, value), code

    return apply


load, load_index = _load(_VF, f32x16, types.float32), _load(_VI, i32x16, types.int32)
store, store_index = _store(_VF), _store(_VI)


@intrinsic
def count_trailing_zeros(typingctx, bits):
    """Number of zero bits below the lowest one of a non-zero uint64."""

    def code(context, builder, signature, args):
        found = _call(builder, "llvm.cttz.i64", ir.IntType(64), [args[0], _I1(1)])
        return found

    return types.int64(types.uint64), code
