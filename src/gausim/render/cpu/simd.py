"""Vectors of sixteen float32 as values inside numba kernels, with Python's operators.

LLVM maps them onto what the processor has: one AVX-512 register, two of AVX, four of NEON. Loops written with them do
not depend on the mood of the automatic vectoriser, and compile faster because it has nothing left to do.
"""

# Lowering rules of numba take what numba gives them; none of it has published types.
# mypy: allow-untyped-defs, allow-untyped-calls, allow-incomplete-defs, disable-error-code="misc"
from __future__ import annotations

import operator

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16


class _Vector(types.Type):
    """Sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name="f32x16")


class _Mask(types.Type):
    """Sixteen truth values."""

    def __init__(self) -> None:
        super().__init__(name="i1x16")


vector, mask = _Vector(), _Mask()
_F32, _I1, _I32 = ir.FloatType(), ir.IntType(1), ir.IntType(32)
_VECTOR, _MASK = ir.VectorType(_F32, LANES), ir.VectorType(_I1, LANES)


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, _VECTOR)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, _MASK)


def _spread(builder, kind, value):
    """A vector from either a vector or a float32."""
    if kind == vector:
        return value
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES))


def _binary(symbol, result, emit) -> None:
    """Teaches numba ``symbol`` between two vectors or a vector and a float32."""
    pairs = [(vector, vector), (vector, types.float32), (types.float32, vector)]

    @infer_global(symbol)
    class _Template(ConcreteTemplate):
        cases = [signature(result, *pair) for pair in pairs]

    def lower(context, builder, sig, args):
        return emit(builder, *(_spread(builder, kind, value) for kind, value in zip(sig.args, args, strict=True)))

    for pair in pairs:
        lower_builtin(symbol, *pair)(lower)


for _symbol, _emit in (
    (operator.add, ir.IRBuilder.fadd),
    (operator.sub, ir.IRBuilder.fsub),
    (operator.mul, ir.IRBuilder.fmul),
    (operator.truediv, ir.IRBuilder.fdiv),
):
    _binary(_symbol, vector, _emit)
    _binary(getattr(operator, "i" + _symbol.__name__), vector, _emit)

for _symbol, _sign in ((operator.ge, ">="), (operator.gt, ">"), (operator.le, "<="), (operator.lt, "<")):
    _binary(_symbol, mask, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))


@infer_global(operator.and_)
class _And(ConcreteTemplate):
    cases = [signature(mask, mask, mask)]


@lower_builtin(operator.and_, mask, mask)
def _lower_and(context, builder, sig, args):
    return builder.and_(*args)


def _pointer(context, builder, kind, array, index):
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


@intrinsic
def load(typing, array, index):
    """The sixteen numbers from ``array[index]`` on; the array is one-dimensional, contiguous and float32."""

    def emit(context, builder, sig, args):
        found = builder.load(_pointer(context, builder, sig.args[0], *args))
        found.align = 4
        return found

    return vector(array, types.intp), emit


@intrinsic
def store(typing, array, index, value):
    """Writes ``value`` from ``array[index]`` on."""

    def emit(context, builder, sig, args):
        written = builder.store(args[2], _pointer(context, builder, sig.args[0], *args[:2]))
        written.align = 4
        return context.get_dummy_value()

    return types.none(array, types.intp, vector), emit


@intrinsic
def splat(typing, value):
    """A number in every lane."""

    def emit(context, builder, sig, args):
        return _spread(builder, types.float32, args[0])

    return vector(types.float32), emit


def _constant(values):
    def emit(context, builder, sig, args):
        return ir.Constant(_VECTOR, [float(value) for value in values])

    return vector(), emit


@intrinsic
def column_centres(typing):
    """Of two rows of eight pixels: 0.5, 1.5, .. 7.5, twice."""
    return _constant([i % 8 + 0.5 for i in range(LANES)])


@intrinsic
def row_centres(typing):
    """Of two rows of eight pixels: eight times 0.5, eight times 1.5."""
    return _constant([i // 8 + 0.5 for i in range(LANES)])


@intrinsic
def lane_numbers(typing):
    """0, 1, .. 15."""
    return _constant(range(LANES))


@intrinsic
def select(typing, condition, yes, no):
    """``yes`` where the condition holds, else ``no``, lane by lane."""

    def emit(context, builder, sig, args):
        yes, no = (_spread(builder, kind, value) for kind, value in zip(sig.args[1:], args[1:], strict=True))
        return builder.select(args[0], yes, no)

    return vector(mask, yes, no), emit


def _call(builder, name, arguments, result=_VECTOR):
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


@intrinsic
def minimum(typing, a, b):
    """The smaller of two, lane by lane; no lane may be NaN."""

    def emit(context, builder, sig, args):
        a, b = (_spread(builder, kind, value) for kind, value in zip(sig.args, args, strict=True))
        return builder.select(builder.fcmp_ordered("<", a, b), a, b)

    return vector(a, b), emit


@intrinsic
def maximum(typing, a, b):
    """The larger of two, lane by lane; no lane may be NaN."""

    def emit(context, builder, sig, args):
        a, b = (_spread(builder, kind, value) for kind, value in zip(sig.args, args, strict=True))
        return builder.select(builder.fcmp_ordered(">", a, b), a, b)

    return vector(a, b), emit


def _unary(name):
    def emit(context, builder, sig, args):
        return _call(builder, f"llvm.{name}.v16f32", args)

    return vector(vector), emit


@intrinsic
def magnitude(typing, a):
    """|a|, lane by lane."""
    return _unary("fabs")


@intrinsic
def square_root(typing, a):
    """Square roots of numbers that are not negative."""
    return _unary("sqrt")


@intrinsic
def rounded_down(typing, a):
    """The largest whole number that is not larger, lane by lane."""
    return _unary("floor")


@intrinsic
def rounded_up(typing, a):
    """The smallest whole number that is not smaller, lane by lane."""
    return _unary("ceil")


@intrinsic
def largest(typing, a):
    """The largest lane as a number."""

    def emit(context, builder, sig, args):
        return _call(builder, "llvm.vector.reduce.fmax.v16f32", args, _F32)

    return types.float32(vector), emit


@intrinsic
def lane_sums(typing, parts):
    """The vector whose lane i is the sum over the lanes of ``parts[i]``, a tuple of at most 16; other lanes are zero.

    Two vectors are folded into one at each of four levels, a third of the instructions of sixteen separate sums.
    """

    def emit(context, builder, sig, args):
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        level = cgutils.unpack_tuple(builder, args[0])
        level += [zero] * (LANES - len(level))
        half = LANES // 2
        while len(level) > 1:
            apart = len(level) // 2
            level = [_fold(builder, level[i], level[i + apart], half, zero) for i in range(apart)]
            half //= 2
        return level[0]

    return vector(parts), emit


def _fold(builder, a, b, half, zero):
    """Halves each block of 2 ``half`` lanes of a and b by addition; a's block goes before b's."""
    if a is zero and b is zero:
        return zero
    blocks = range(0, LANES, 2 * half)
    low = [offset + base + i for base in blocks for offset in (0, LANES) for i in range(half)]
    picks = (ir.Constant(ir.VectorType(_I32, LANES), [i + shift for i in low]) for shift in (0, half))
    return builder.fadd(*(builder.shuffle_vector(a, b, pick) for pick in picks))
