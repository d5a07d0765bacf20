"""Reading and writing one-dimensional arrays inside Numba code: 16 numbers at once, or one, without bounds."""

from __future__ import annotations

from llvmlite import ir
from numba.core import types
from numba.core.extending import intrinsic

from stages.avatar.kernels.lanes import f32x16, i32x16


def _pointer(context, builder, kind, array, index, vector):
    data = context.make_array(kind)(context, builder, array).data
    element = builder.gep(data, [context.cast(builder, index, types.int64, types.intp)])
    return builder.bitcast(element, vector.as_pointer())


def _load(lanes):
    @intrinsic
    def apply(typingctx, array, index):
        def code(context, builder, signature, args):
            index = context.cast(builder, args[1], signature.args[1], types.int64)
            where = _pointer(context, builder, signature.args[0], args[0], index, lanes.vector)
            return builder.load(where, align=4)

        return lanes(array, index), code

    return apply


def _store(lanes):
    @intrinsic
    def apply(typingctx, array, index, value):
        def code(context, builder, signature, args):
            index = context.cast(builder, args[1], signature.args[1], types.int64)
            where = _pointer(context, builder, signature.args[0], args[0], index, lanes.vector)
            builder.store(args[2], where, align=4)
            return context.get_dummy_value()

        return types.none(array, index, value), code

    return apply


load, load_index = _load(f32x16), _load(i32x16)
store, store_index = _store(f32x16), _store(i32x16)


def _element(context, builder, signature, args):
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.gep(data, [context.cast(builder, args[1], signature.args[1], types.intp)])


@intrinsic
def peek(typingctx, array, index):
    """array[index] without bounds, wrap-around or view: `array` is one-dimensional and contiguous, `index` is inside."""
    return array.dtype(array, index), lambda context, builder, signature, args: builder.load(
        _element(context, builder, signature, args)
    )


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of array[index] ahead of its use."""

    def code(context, builder, signature, args):
        where = builder.bitcast(_element(context, builder, signature, args), ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [where.type, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch", [where.type], kind)
        builder.call(function, [where, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.none(array, index), code
