"""Vectors of sixteen float32 as values inside numba kernels, with Python's operators.

LLVM maps them onto the processor's registers: one of AVX-512, two of AVX, four of NEON. Loops written with them do not
depend on the automatic vectoriser, and compile faster.
"""

# The arguments of numba's lowering rules have no published types.
# mypy: allow-untyped-defs, allow-untyped-calls, allow-incomplete-defs, disable-error-code="misc, call-arg"
from __future__ import annotations

import operator

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
_F32, _I1, _I32 = ir.FloatType(), ir.IntType(1), ir.IntType(32)
_VECTOR = ir.VectorType(_F32, LANES)


class _Lanes(types.Type):
    """Sixteen lanes of one LLVM type."""

    def __init__(self, name: str, element: ir.Type) -> None:
        super().__init__(name=f"{name}x{LANES}")
        self.llvm = ir.VectorType(element, LANES)


vector, mask = _Lanes("f32", _F32), _Lanes("i1", _I1)


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, kind.llvm)


def _spread(builder, kind, value):
    """A vector from either a vector or a float32."""
    if isinstance(kind, _Lanes):
        return value
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(_I32, 0))
    return _shuffle(builder, one, one, [0] * LANES)


def _shuffle(builder, a, b, picks):
    """The lanes ``picks`` of the concatenation of a and b."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(picks)), list(picks)))


_PAIRS = (vector, vector), (vector, types.float32), (types.float32, vector)


def _binary(symbol, result, emit, pairs=_PAIRS) -> None:
    """Registers the operator ``symbol`` between two vectors, or a vector and a float32."""

    @infer_global(symbol)
    class _Template(ConcreteTemplate):
        cases = [signature(result, *pair) for pair in pairs]

    def lower(context, builder, sig, args):
        return emit(builder, *(_spread(builder, *pair) for pair in zip(sig.args, args, strict=True)))

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

for _symbol, _sign in ((operator.ge, ">="), (operator.gt, ">"), (operator.le, "<=")):
    _binary(_symbol, mask, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))


_binary(operator.and_, mask, ir.IRBuilder.and_, [(mask, mask)])


def _pointer(context, builder, kind, array, index):
    return builder.bitcast(builder.gep(_member(context, builder, kind, array, "data"), [index]), _VECTOR.as_pointer())


def _member(context, builder, kind, array, name):
    """A field of an array's structure; numba's proxies would first write all of it to memory, which LLVM removes."""
    return context.data_model_manager[kind].get(builder, array, name)


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
    """Columns of the centres of two rows of eight pixels: 0.5, 1.5, .. 7.5, twice."""
    return _constant([i % 8 + 0.5 for i in range(LANES)])


@intrinsic
def row_centres(typing):
    """Rows of the centres of two rows of eight pixels: eight times 0.5, eight times 1.5."""
    return _constant([i // 8 + 0.5 for i in range(LANES)])


@intrinsic
def select(typing, condition, yes, no):
    """``yes`` where the condition holds, else ``no``, lane by lane."""

    def emit(context, builder, sig, args):
        yes, no = (_spread(builder, *pair) for pair in zip(sig.args[1:], args[1:], strict=True))
        return builder.select(args[0], yes, no)

    return vector(condition, yes, no), emit


@intrinsic
def spread(typing, array, index):
    """``array[index]`` in every lane; the array as for :func:`load`."""

    def emit(context, builder, sig, args):
        place = builder.gep(_member(context, builder, sig.args[0], args[0], "data"), [args[1]])
        return _spread(builder, types.float32, builder.load(place))

    return vector(array, types.intp), emit


def _call(builder, name, arguments, result=_VECTOR):
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def _extreme(a, b, sign):
    def emit(context, builder, sig, args):
        x, y = (_spread(builder, *pair) for pair in zip(sig.args, args, strict=True))
        return builder.select(builder.fcmp_ordered(sign, x, y), x, y)

    return vector(a, b), emit


@intrinsic
def minimum(typing, a, b):
    """The smaller of two, lane by lane; no lane may be NaN."""
    return _extreme(a, b, "<")


@intrinsic
def maximum(typing, a, b):
    """The larger of two, lane by lane; no lane may be NaN."""
    return _extreme(a, b, ">")


@intrinsic
def square_root(typing, a):
    """Square roots of numbers that are not negative."""

    def emit(context, builder, sig, args):
        return _call(builder, "llvm.sqrt.v16f32", args)

    return vector(a), emit


@intrinsic
def largest(typing, a):
    """The largest lane as a number."""

    def emit(context, builder, sig, args):
        return _call(builder, "llvm.vector.reduce.fmax.v16f32", args, _F32)

    return types.float32(vector), emit


@intrinsic
def folded(typing, a, b, half):
    """Halves each block of 2 ``half`` lanes of a and of b by addition; the block of a precedes that of b.

    After ``folded`` with 8, 4, 2 and 1 the lanes of a vector are sums of sixteen. ``half`` is a literal.
    """
    if not isinstance(half, types.IntegerLiteral):
        return None

    def emit(context, builder, sig, args):
        half = sig.args[2].literal_value
        low = [offset + base + i for base in range(0, LANES, 2 * half) for offset in (0, LANES) for i in range(half)]
        return builder.fadd(*(_shuffle(builder, *args[:2], [i + shift for i in low]) for shift in (0, half)))

    return vector(a, b, half), emit
