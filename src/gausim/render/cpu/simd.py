"""Vectors of sixteen float32, and of four times that, as values inside numba kernels, with Python's operators.

LLVM maps them onto what the processor has: one AVX-512 register, two of AVX, four of NEON. Loops written with them do
not depend on the mood of the automatic vectoriser, and compile faster because it has nothing left to do. A quad is four
vectors that go through the same operations side by side: of a chain of dependent operations a processor keeps only so
many in view, and four chains in step keep it busy where four in a row leave it waiting.
"""

# Lowering rules of numba take what numba gives them; none of it has published types.
# mypy: allow-untyped-defs, allow-untyped-calls, allow-incomplete-defs, disable-error-code="misc, call-arg"
from __future__ import annotations

import operator

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16


class _Lanes(types.Type):
    """So many lanes of one LLVM type."""

    def __init__(self, name: str, element: ir.Type, lanes: int) -> None:
        super().__init__(name=f"{name}x{lanes}")
        self.lanes, self.llvm = lanes, ir.VectorType(element, lanes)


_F32, _I1, _I32 = ir.FloatType(), ir.IntType(1), ir.IntType(32)
vector, mask = _Lanes("f32", _F32, LANES), _Lanes("i1", _I1, LANES)
quad, _quad_mask = _Lanes("f32", _F32, 4 * LANES), _Lanes("i1", _I1, 4 * LANES)
_MASKS = {vector: mask, quad: _quad_mask}
_VECTOR = vector.llvm


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, kind.llvm)


def _spread(builder, kind, value, lanes=LANES):
    """A vector of so many lanes from either such a vector or a float32."""
    if kind in _MASKS:
        return value
    one = ir.Constant(ir.VectorType(_F32, lanes), ir.Undefined)
    one = builder.insert_element(one, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(_I32, lanes), [0] * lanes))


def _widest(*kinds):
    """Quad if any of these is one, else vector."""
    return quad if quad in kinds else vector


def _alike(builder, kinds, values):
    lanes = _widest(*kinds).lanes
    return [_spread(builder, kind, value, lanes) for kind, value in zip(kinds, values, strict=True)]


def _binary(symbol, compares, emit) -> None:
    """Teaches numba ``symbol`` between two vectors or two quads, or one of them and a float32."""
    pairs = [pair for v in (vector, quad) for pair in ((v, v), (v, types.float32), (types.float32, v))]

    @infer_global(symbol)
    class _Template(ConcreteTemplate):
        cases = [signature(_MASKS[_widest(*pair)] if compares else _widest(*pair), *pair) for pair in pairs]

    def lower(context, builder, sig, args):
        return emit(builder, *_alike(builder, sig.args, args))

    for pair in pairs:
        lower_builtin(symbol, *pair)(lower)


for _symbol, _emit in (
    (operator.add, ir.IRBuilder.fadd),
    (operator.sub, ir.IRBuilder.fsub),
    (operator.mul, ir.IRBuilder.fmul),
    (operator.truediv, ir.IRBuilder.fdiv),
):
    _binary(_symbol, False, _emit)
    _binary(getattr(operator, "i" + _symbol.__name__), False, _emit)

for _symbol, _sign in ((operator.ge, ">="), (operator.gt, ">"), (operator.le, "<="), (operator.lt, "<")):
    _binary(_symbol, True, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))


@infer_global(operator.and_)
class _And(ConcreteTemplate):
    cases = [signature(kind, kind, kind) for kind in (mask, _quad_mask)]


@lower_builtin(operator.and_, mask, mask)
@lower_builtin(operator.and_, _quad_mask, _quad_mask)
def _lower_and(context, builder, sig, args):
    return builder.and_(*args)


def _pointer(context, builder, kind, array, index):
    return builder.bitcast(builder.gep(_member(context, builder, kind, array, "data"), [index]), _VECTOR.as_pointer())


def _member(context, builder, kind, array, name):
    """A field of an array's structure; numba's own proxies would first write all of it to memory, which LLVM undoes."""
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
        lanes = sig.return_type.lanes
        yes, no = (_spread(builder, *pair, lanes) for pair in zip(sig.args[1:], args[1:], strict=True))
        return builder.select(args[0], yes, no)

    return (quad if condition == _quad_mask else vector)(condition, yes, no), emit


def _concatenated(builder, a, b, c, d):
    halves = [_shuffle(builder, *pair, range(2 * LANES)) for pair in ((a, b), (c, d))]
    return _shuffle(builder, *halves, range(4 * LANES))


@intrinsic
def four_times(typing, a):
    """A quad of four times the same vector."""

    def emit(context, builder, sig, args):
        return _shuffle(builder, args[0], args[0], [*range(LANES)] * 4)

    return quad(vector), emit


@intrinsic
def spread(typing, array, index):
    """``array[index]`` in every lane; the array as for :func:`load`."""

    def emit(context, builder, sig, args):
        place = builder.gep(_member(context, builder, sig.args[0], args[0], "data"), [args[1]])
        return _spread(builder, types.float32, builder.load(place))

    return vector(array, types.intp), emit


@intrinsic
def spread_four(typing, array, indices, offset):
    """``array[index + offset]`` for each of four indices, a tuple, side by side."""

    def emit(context, builder, sig, args):
        data = _member(context, builder, sig.args[0], args[0], "data")
        places = [builder.add(index, args[2]) for index in cgutils.unpack_tuple(builder, args[1])]
        a, b, c, d = (_spread(builder, types.float32, builder.load(builder.gep(data, [at]))) for at in places)
        return _concatenated(builder, a, b, c, d)

    return quad(array, indices, types.intp), emit


@intrinsic
def numbers_of(typing, integers):
    """Each of four integers, a tuple, as a float32 in sixteen lanes, side by side."""

    def emit(context, builder, sig, args):
        numbers = [builder.sitofp(value, _F32) for value in cgutils.unpack_tuple(builder, args[0])]
        a, b, c, d = (_spread(builder, types.float32, number) for number in numbers)
        return _concatenated(builder, a, b, c, d)

    return quad(integers), emit


@intrinsic
def part(typing, whole, number):
    """Vector ``number`` of a quad; the number is a literal."""
    if not isinstance(number, types.IntegerLiteral):
        return None

    def emit(context, builder, sig, args):
        low = LANES * sig.args[1].literal_value
        return _shuffle(builder, args[0], args[0], range(low, low + LANES))

    return vector(whole, number), emit


def _call(builder, name, arguments, result=_VECTOR):
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


@intrinsic
def minimum(typing, a, b):
    """The smaller of two, lane by lane; no lane may be NaN."""

    def emit(context, builder, sig, args):
        a, b = _alike(builder, sig.args, args)
        return builder.select(builder.fcmp_ordered("<", a, b), a, b)

    return _widest(a, b)(a, b), emit


@intrinsic
def maximum(typing, a, b):
    """The larger of two, lane by lane; no lane may be NaN."""

    def emit(context, builder, sig, args):
        a, b = _alike(builder, sig.args, args)
        return builder.select(builder.fcmp_ordered(">", a, b), a, b)

    return _widest(a, b)(a, b), emit


def _unary(name):
    def emit(context, builder, sig, args):
        return _call(builder, f"llvm.{name}.v16f32", args)

    return vector(vector), emit


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
def folded(typing, a, b, half):
    """Halves each block of 2 ``half`` lanes of a and of b by addition; the block of a goes before that of b.

    After ``folded`` with 8, 4, 2 and 1 a vector holds the sums of sixteen. ``half`` is a literal.
    """
    if not isinstance(half, types.IntegerLiteral):
        return None

    def emit(context, builder, sig, args):
        return _fold(builder, args[0], args[1], sig.args[2].literal_value)

    return vector(a, b, half), emit


def _fold(builder, a, b, half):
    low = [offset + base + i for base in range(0, LANES, 2 * half) for offset in (0, LANES) for i in range(half)]
    return builder.fadd(*(_shuffle(builder, a, b, [i + shift for i in low]) for shift in (0, half)))


def _shuffle(builder, a, b, picks):
    """The lanes ``picks`` of a and, counted on, of b."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(picks)), list(picks)))


@intrinsic
def store_rows(typing, image, y, x, value):
    """Writes two rows of eight pixels to ``image`` (H, W) from (y, x) on."""

    def emit(context, builder, sig, args):
        for row in range(2):
            part = _shuffle(builder, args[3], args[3], range(8 * row, 8 * row + 8))
            _store_at(builder, _place(context, builder, sig.args[0], args, row), part)
        return context.get_dummy_value()

    return types.none(image, y, x, value), emit


@intrinsic
def load_rows(typing, image, y, x):
    """Two rows of eight pixels of ``image`` (H, W) from (y, x) on."""

    def emit(context, builder, sig, args):
        places = [_place(context, builder, sig.args[0], args, row) for row in range(2)]
        return _shuffle(builder, *(_load_at(builder, place, 8) for place in places), range(LANES))

    return vector(image, y, x), emit


@intrinsic
def store_colours(typing, image, y, x, red, green, blue):
    """Writes two rows of eight colours to ``image`` (H, W, 3) from (y, x) on."""

    def emit(context, builder, sig, args):
        channels = args[3:]
        for row in range(2):
            place = _place(context, builder, sig.args[0], args, row)
            for at in (0, 8):  # the two overlap: 24 numbers
                stream = range(24 * row + at, 24 * row + at + LANES)
                pair = _shuffle(builder, *channels[:2], [j // 3 + LANES * (j % 3 == 1) for j in stream])
                picks = [LANES + j // 3 if j % 3 == 2 else i for i, j in enumerate(stream)]
                _store_at(builder, builder.gep(place, [ir.Constant(_I32, at)]), _shuffle(builder, pair, args[5], picks))
        return context.get_dummy_value()

    return types.none(image, y, x, red, green, blue), emit


@intrinsic
def load_colours(typing, image, y, x):
    """Red, green and blue of two rows of eight colours of ``image`` (H, W, 3) from (y, x) on."""

    def emit(context, builder, sig, args):
        rows = []
        for row in range(2):
            place = _place(context, builder, sig.args[0], args, row)
            parts = [_load_at(builder, builder.gep(place, [ir.Constant(_I32, at)]), LANES) for at in (0, 8)]
            rows.append(_shuffle(builder, *parts, [*range(LANES), *range(24, 32)]))
        channels = [[3 * i + c + 24 * row for row in range(2) for i in range(8)] for c in range(3)]
        found = [_shuffle(builder, *rows, picks) for picks in channels]
        return context.make_tuple(builder, sig.return_type, found)

    return types.containers.UniTuple(vector, 3)(image, y, x), emit


def _place(context, builder, kind, args, row):
    """Address of ``image[y + row, x]`` as that of a float32."""
    strides = cgutils.unpack_tuple(builder, _member(context, builder, kind, args[0], "strides"))
    y = builder.add(args[1], ir.Constant(args[1].type, row))
    offset = builder.add(builder.mul(y, strides[0]), builder.mul(args[2], strides[1]))
    return cgutils.pointer_add(builder, _member(context, builder, kind, args[0], "data"), offset)


def _store_at(builder, place, value):
    builder.store(value, builder.bitcast(place, value.type.as_pointer())).align = 4


def _load_at(builder, place, lanes):
    found = builder.load(builder.bitcast(place, ir.VectorType(_F32, lanes).as_pointer()))
    found.align = 4
    return found
