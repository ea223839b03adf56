"""SIMD vectors of sixteen float32 numbers as a numba type.

Automatic vectorisation of scalar loops fails without notice. Here the vector is explicit: every operation below
becomes the LLVM instruction for ``<16 x float>``, which LLVM maps to one AVX-512 register, two AVX registers or four
NEON ones. Nothing is reassociated and nothing assumes finite numbers; ``fma`` is fused where the machine supports it.

``Lanes`` holds numbers and ``LaneMask`` truth values. A scalar operand is repeated in all lanes. Operands of arithmetic
may also be tuples of lanes of one length; the operation then goes through the tuple. Lengths are part of numba's types,
so what is compiled has no loop over them. Tables are flat, contiguous float32 arrays, without bounds checks.

``DoubleLanes`` holds sixteen float64. Where one operand of arithmetic is of this type, the others are widened.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, ClassVar, TypeAlias

from llvmlite import ir
from numba.core import types
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

if TYPE_CHECKING:
    from numba.core.base import BaseContext
    from numba.core.datamodel import DataModelManager
    from numba.core.typing import Context, Signature

#: Signature of an intrinsic and what builds its instructions; None where it does not take such operands.
Intrinsic: TypeAlias = "tuple[Signature, Callable[..., ir.Value]] | None"

#: What an intrinsic is called with.
Values: TypeAlias = Sequence[ir.Value]

#: Numbers in a vector; pixels of a block.
WIDTH = 16

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_LANES = ir.VectorType(_FLOAT, WIDTH)
_DOUBLES = ir.VectorType(ir.DoubleType(), WIDTH)
_INTS = ir.VectorType(_INT, WIDTH)
_MASK = ir.VectorType(ir.IntType(1), WIDTH)
_FLAGS = ir.IntType(WIDTH)


class _VectorType(types.Type):
    """A vector, whose form in LLVM is ``form``."""

    form: ClassVar[ir.Type]

    def __init__(self) -> None:
        super().__init__(name=type(self).__name__)


class Lanes(_VectorType):
    """Sixteen float32."""

    form = _LANES


class DoubleLanes(_VectorType):
    """Sixteen float64."""

    form = _DOUBLES


class LaneMask(_VectorType):
    """Sixteen truth values."""

    form = _MASK


#: Numbers in a kernel.
Vector: TypeAlias = Lanes | DoubleLanes

lanes = Lanes()
double_lanes = DoubleLanes()
lane_mask = LaneMask()


@register_model(Lanes)
@register_model(DoubleLanes)
@register_model(LaneMask)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: DataModelManager, fe_type: _VectorType) -> None:
        super().__init__(dmm, fe_type, fe_type.form)


# --- building instructions --------------------------------------------------------------------------------------------


def _constant(values: Sequence[float], kind: ir.Type = _LANES) -> ir.Value:
    return ir.Constant(kind, [ir.Constant(kind.element, value) for value in values])


def _call(builder: ir.IRBuilder, name: str, *arguments: ir.Value) -> ir.Value:
    """Call an LLVM intrinsic whose operands and result are all lanes, or all double lanes."""
    kind = arguments[0].type
    name += ".v16f64" if kind == _DOUBLES else ".v16f32"
    function = builder.module.globals.get(name)
    if function is None:
        function = ir.Function(builder.module, ir.FunctionType(kind, [kind] * len(arguments)), name)
    return builder.call(function, arguments)


def _shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, picks: Sequence[int | None]) -> ir.Value:
    """Lanes of ``a``, counted from 0, and of ``b``, counted on from there; None for a lane that does not matter."""
    elements = [ir.Constant(_INT, ir.Undefined if pick is None else pick) for pick in picks]
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(picks)), elements))


def _repeat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    kind = ir.VectorType(scalar.type, WIDTH)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_INT, 0))
    return _shuffle(builder, first, first, [0] * WIDTH)


def _is_scalar(numba_type: types.Type) -> bool:
    return isinstance(numba_type, (types.Integer, types.Float))


def _is_numeric(numba_type: types.Type) -> bool:
    return isinstance(numba_type, (Lanes, DoubleLanes)) or _is_scalar(numba_type)


def _elements(operands: Sequence[types.Type]) -> list[types.Type]:
    """The types of all operands, of the elements where they are tuples."""
    return [kind for given in operands for kind in (given if isinstance(given, types.BaseTuple) else [given])]


def _result_type(operands: Sequence[types.Type]) -> types.Type:
    """Double lanes where any operand is of them."""
    return double_lanes if any(isinstance(kind, DoubleLanes) for kind in _elements(operands)) else lanes


def _as_lanes(builder: ir.IRBuilder, value: ir.Value, numba_type: types.Type, kind: types.Type = lanes) -> ir.Value:
    """A number or lanes, as lanes or double lanes."""
    wide = isinstance(kind, DoubleLanes)
    if isinstance(numba_type, Lanes):
        return builder.fpext(value, _DOUBLES) if wide else value
    if isinstance(numba_type, DoubleLanes):
        return value
    scalar = ir.DoubleType() if wide else _FLOAT
    if isinstance(numba_type, types.Integer):
        value = builder.sitofp(value, scalar)
    elif wide and numba_type.bitwidth < 64:
        value = builder.fpext(value, scalar)
    elif not wide and numba_type.bitwidth > 32:
        value = builder.fptrunc(value, scalar)
    return _repeat(builder, value)


def _is_table(numba_type: types.Type) -> bool:
    kind = (types.float32, 1, "C")
    return isinstance(numba_type, types.Array) and (numba_type.dtype, numba_type.ndim, numba_type.layout) == kind


def _tuple_length(operands: Sequence[types.Type]) -> int | None:
    """The common length of those operands that are tuples; None where none is, or they do not fit together."""
    lengths = {len(operand) for operand in operands if isinstance(operand, types.BaseTuple)}
    return lengths.pop() if len(lengths) == 1 else None


def _element(
    builder: ir.IRBuilder, value: ir.Value, numba_type: types.Type, index: int, kind: types.Type = lanes
) -> ir.Value:
    """One element of a tuple, or what stands for all of them, as lanes or double lanes."""
    if isinstance(numba_type, types.BaseTuple):
        return _as_lanes(builder, builder.extract_value(value, index), numba_type[index], kind)
    return _as_lanes(builder, value, numba_type, kind)


def _pack(builder: ir.IRBuilder, vectors: Sequence[ir.Value]) -> ir.Value:
    """LLVM's form of numba's tuple of lanes."""
    kind = vectors[0].type if vectors else _LANES
    packed = ir.Constant(ir.ArrayType(kind, len(vectors)), ir.Undefined)
    for index, vector in enumerate(vectors):
        packed = builder.insert_value(packed, vector, index)
    return packed


def _tuple_of_lanes(length: int) -> types.Type:
    return types.UniTuple(lanes, length)


def _address(
    context: BaseContext,
    builder: ir.IRBuilder,
    table_type: types.Type,
    table: ir.Value,
    index: ir.Value,
    kind: ir.Type = _LANES,
) -> ir.Value:
    data = context.make_array(table_type)(context, builder, table).data
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


def _read(builder: ir.IRBuilder, address: ir.Value) -> ir.Value:
    value = builder.load(address)
    value.align = 4
    return value


def _write(builder: ir.IRBuilder, value: ir.Value, address: ir.Value) -> None:
    builder.store(value, address).align = 4


def _lanewise(
    name: str, arity: int, emit: Callable[..., ir.Value], result: types.Type | None = None
) -> Callable[..., Intrinsic]:
    """An operation on numbers, lane by lane; ``name`` is for error messages.

    ``emit`` gets the builder and one vector for each operand, and gives that of the result, whose type (of one element where
    operands are tuples) is ``result``, None for that of the operands.
    """

    def typed(*operands: types.Type) -> ir.Value:
        length = _tuple_length(operands)
        if any(isinstance(operand, types.BaseTuple) for operand in operands) != (length is not None):
            return None
        if not all(_is_numeric(kind) for kind in _elements(operands)):
            return None
        kind = _result_type(operands)

        def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
            pairs = list(zip(arguments, signature.args, strict=True))
            if length is None:
                return emit(builder, *(_as_lanes(builder, *pair, kind) for pair in pairs))
            vectors = [
                emit(builder, *(_element(builder, *pair, index, kind) for pair in pairs)) for index in range(length)
            ]
            return _pack(builder, vectors)

        given = kind if result is None else result
        return (given if length is None else types.UniTuple(given, length))(*operands), generate

    # numba reads the number of operands from the signature.
    by_arity: dict[int, Callable[..., Intrinsic]] = {
        1: lambda typingctx, a: typed(a),
        2: lambda typingctx, a, b: typed(a, b),
        3: lambda typingctx, a, b, c: typed(a, b, c),
    }
    by_arity[arity].__name__ = name
    return intrinsic(by_arity[arity])


def _comparison(name: str, symbol: str) -> ir.Value:
    return _lanewise(name, 2, lambda builder, a, b: builder.fcmp_ordered(symbol, a, b), lane_mask)


def _of_masks(name: str, emit: Callable[..., ir.Value]) -> Callable[..., Intrinsic]:
    def typed(typingctx: Context, a: types.Type, b: types.Type) -> Intrinsic:
        if not (isinstance(a, LaneMask) and isinstance(b, LaneMask)):
            return None
        return lane_mask(a, b), lambda context, builder, signature, arguments: emit(builder, *arguments)

    typed.__name__ = name
    return intrinsic(typed)


def _of_one(
    name: str, operand: type[types.Type], result: types.Type, emit: Callable[[ir.IRBuilder, ir.Value], ir.Value]
) -> Callable[..., Intrinsic]:
    def typed(typingctx: Context, a: types.Type) -> Intrinsic:
        if not isinstance(a, operand):
            return None
        taken = types.int64 if isinstance(a, types.Integer) else a
        return result(taken), lambda context, builder, signature, arguments: emit(builder, arguments[0])

    typed.__name__ = name
    return intrinsic(typed)


# --- arithmetic -------------------------------------------------------------------------------------------------------

#: a + b
add = _lanewise("add", 2, lambda builder, a, b: builder.fadd(a, b))
#: a - b
sub = _lanewise("sub", 2, lambda builder, a, b: builder.fsub(a, b))
#: a b
mul = _lanewise("mul", 2, lambda builder, a, b: builder.fmul(a, b))
#: a b + c
fma = _lanewise("fma", 3, lambda builder, a, b, c: _call(builder, "llvm.fmuladd", a, b, c))
#: a / b, rounded correctly
div = _lanewise("div", 2, lambda builder, a, b: builder.fdiv(a, b))
#: a / b to a unit or two in the last place, for ordinary numbers
quick_div = _lanewise("quick_div", 2, lambda builder, a, b: builder.fdiv(a, b, flags=("arcp", "afn", "contract")))
#: -a
neg = _lanewise("neg", 1, lambda builder, a: builder.fneg(a))
#: Square root
sqrt = _lanewise("sqrt", 1, lambda builder, a: _call(builder, "llvm.sqrt", a))
#: The integer at or above
ceil = _lanewise("ceil", 1, lambda builder, a: _call(builder, "llvm.ceil", a))
#: The integer at or below
floor = _lanewise("floor", 1, lambda builder, a: _call(builder, "llvm.floor", a))
#: A number in all lanes
splat = _lanewise("splat", 1, lambda builder, a: a)
#: The smaller; b where either is not a number
smaller = _lanewise("smaller", 2, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
#: The larger; b where either is not a number
larger = _lanewise("larger", 2, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))

#: float64 of float32
widen = _lanewise("widen", 1, lambda builder, a: builder.fpext(a, _DOUBLES), double_lanes)
#: The nearest float32 of float64
narrow = _lanewise("narrow", 1, lambda builder, a: builder.fptrunc(a, _LANES), lanes)

# Comparisons are False where either is not a number.
less = _comparison("less", "<")
at_most = _comparison("at_most", "<=")
greater = _comparison("greater", ">")
at_least = _comparison("at_least", ">=")

both = _of_masks("both", lambda builder, a, b: builder.and_(a, b))
either = _of_masks("either", lambda builder, a, b: builder.or_(a, b))


@intrinsic
def select(typingctx: Context, mask: types.Type, chosen: types.Type, other: types.Type) -> Intrinsic:
    """``chosen`` where the mask holds, else ``other``."""
    length = _tuple_length((chosen, other))
    if not isinstance(mask, LaneMask):
        return None
    kind = _result_type((chosen, other))

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        pairs = list(zip(arguments[1:], signature.args[1:], strict=True))
        if length is None:
            return builder.select(arguments[0], *(_as_lanes(builder, *pair, kind) for pair in pairs))
        elements = ([_element(builder, *pair, index, kind) for pair in pairs] for index in range(length))
        return _pack(builder, [builder.select(arguments[0], *chosen) for chosen in elements])

    return (kind if length is None else types.UniTuple(kind, length))(mask, chosen, other), generate


#: The mask that :func:`bits` turns into this integer
from_bits = _of_one(
    "from_bits", types.Integer, lane_mask, lambda builder, flags: builder.bitcast(builder.trunc(flags, _FLAGS), _MASK)
)
#: The mask as an integer, lane 0 in the lowest bit
bits = _of_one(
    "bits", LaneMask, types.int64, lambda builder, mask: builder.zext(builder.bitcast(mask, _FLAGS), ir.IntType(64))
)
#: Place of the lowest bit set in an integer that is not 0
lowest_bit = _of_one(
    "lowest_bit", types.Integer, types.int64, lambda builder, flags: builder.cttz(flags, ir.Constant(ir.IntType(1), 1))
)
#: How many bits are set in an integer
bit_count = _of_one("bit_count", types.Integer, types.int64, lambda builder, flags: builder.ctpop(flags))


# --- 2^x and its inverse --------------------------------------------------------------------------------------------------------------

#: Adding it to a float32 rounds that to an integer, which is then found in the lowest bits.
_ROUNDING_BIAS = 1.5 * 2.0**23
#: Minimax polynomial of 2^f on [-1/2, 1/2] in relative error (7.5e-8), constant term first.
_EXP2_COEFFICIENTS = (
    1.0000000716546822,
    0.6931469670647334,
    0.24022119723848698,
    0.05550713273542824,
    0.009675541334206542,
    0.001327647197931638,
)


def _emit_exp2(builder: ir.IRBuilder, power: ir.Value) -> ir.Value:
    bias = _constant([_ROUNDING_BIAS] * WIDTH)
    biased = builder.fadd(power, bias)
    fraction = builder.fsub(power, builder.fsub(biased, bias))
    value = _constant([_EXP2_COEFFICIENTS[-1]] * WIDTH)
    for coefficient in _EXP2_COEFFICIENTS[-2::-1]:
        value = _call(builder, "llvm.fmuladd", value, fraction, _constant([coefficient] * WIDTH))
    # Shifted to the exponent's place, the integer adds to it.
    exponent = builder.shl(builder.bitcast(biased, _INTS), _constant([23] * WIDTH, _INTS))
    return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _LANES)


#: 2^a to a relative error of 2e-7 for a in [-126, 127]; any bits at all elsewhere
exp2 = _lanewise("exp2", 1, _emit_exp2)

#: Bits of the float32 nearest to sqrt(1/2), at which mantissas begin.
_ROOT_HALF_BITS = 0x3F3504F3


def _emit_log2(builder: ir.IRBuilder, number: ir.Value) -> ir.Value:
    def ints(value: int) -> ir.Value:
        return _constant([value] * WIDTH, _INTS)

    def floats(value: float) -> ir.Value:
        return _constant([value] * WIDTH)

    bits = builder.bitcast(number, _INTS)
    exponent = builder.ashr(builder.sub(bits, ints(_ROOT_HALF_BITS)), ints(23))
    mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, ints(23))), _LANES)
    # log((1 + t) / (1 - t)) = 2 (t + t^3/3 + t^5/5 + ...), and |t| < 0.172.
    t = builder.fdiv(builder.fsub(mantissa, floats(1.0)), builder.fadd(mantissa, floats(1.0)))
    square = builder.fmul(t, t)
    series = floats(2.0 / math.log(2.0) / 9.0)
    for odd in (7.0, 5.0, 3.0, 1.0):
        series = _call(builder, "llvm.fmuladd", series, square, floats(2.0 / math.log(2.0) / odd))
    value = _call(builder, "llvm.fmuladd", series, t, builder.sitofp(exponent, _LANES))
    without = builder.select(builder.fcmp_ordered("==", number, floats(0.0)), floats(-math.inf), floats(math.nan))
    return builder.select(builder.fcmp_ordered(">", number, floats(0.0)), value, without)


#: Logarithm to base 2 to 1e-7 and a unit in the last place, of normal numbers; -inf of 0, not a number below it
log2 = _lanewise("log2", 1, _emit_log2)


# --- memory -----------------------------------------------------------------------------------------------------------


def _reading(
    name: str, result: types.Type, form: ir.Type, emit: Callable[[ir.IRBuilder, ir.Value], ir.Value] | None = None
) -> Callable[..., Intrinsic]:
    """An operation that reads ``form`` at ``table[index]``, without asking whether the index counts from the end."""

    def typed(typingctx: Context, table: types.Type, index: types.Type) -> Intrinsic:
        if not _is_table(table):
            return None

        def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
            value = _read(builder, _address(context, builder, signature.args[0], *arguments, form))
            return emit(builder, value) if emit else value

        return result(table, types.intp), generate

    typed.__name__ = name
    return intrinsic(typed)


#: Sixteen numbers from ``table[index]`` on
load = _reading("load", lanes, _LANES)
#: ``table[index]``
number = _reading("number", types.float32, _FLOAT)
#: ``table[index]`` in all lanes
broadcast = _reading("broadcast", lanes, _FLOAT, _repeat)


def _gathering(name: str, columns: int, result: types.Type) -> Callable[..., Intrinsic]:
    """An operation that reads ``columns`` numbers from ``table[index + columns * place]`` on, for sixteen places."""
    form = _FLOAT if columns == 1 else ir.VectorType(_FLOAT, columns)

    def typed(typingctx: Context, table: types.Type, index: types.Type, places: types.Type) -> Intrinsic:
        if not (_is_table(table) and isinstance(places, Lanes)):
            return None

        def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
            address = _address(context, builder, signature.args[0], *arguments[:2], form)
            whole = builder.fptosi(arguments[2], _INTS)
            rows = []
            for number in range(WIDTH):
                place = builder.extract_element(whole, ir.Constant(_INT, number))
                rows.append(_read(builder, builder.gep(address, [place])))
            if columns == 4:
                return _pack(builder, _columns_of_four(builder, rows))
            vector = ir.Constant(_LANES, ir.Undefined)
            for number, value in enumerate(rows):
                vector = builder.insert_element(vector, value, ir.Constant(_INT, number))
            return vector

        return result(table, types.intp, places), generate

    typed.__name__ = name
    return intrinsic(typed)


def _columns_of_four(builder: ir.IRBuilder, rows: list[ir.Value]) -> list[ir.Value]:
    """The four columns of sixteen rows; each vector in between has every fourth row, so that quarters are transposed."""
    quarters = []
    for first in range(4):
        halves = [_shuffle(builder, rows[row], rows[row + 4], range(8)) for row in (first, first + 8)]
        quarters.append(_shuffle(builder, *halves, range(16)))
    pairs = []
    for a, b in ((quarters[0], quarters[1]), (quarters[2], quarters[3])):
        for low in (0, 2):
            picks = [4 * lane + low + k for lane in range(4) for k in (0, 16, 1, 17)]
            pairs.append(_shuffle(builder, a, b, picks))
    columns = []
    for a, b in ((pairs[0], pairs[2]), (pairs[1], pairs[3])):
        for low in (0, 2):
            picks = [4 * lane + low + k for lane in range(4) for k in (0, 1, 16, 17)]
            columns.append(_shuffle(builder, a, b, picks))
    return columns


#: ``table[index + place]`` for sixteen places, which are whole numbers from 0 to 2^24
gather = _gathering("gather", 1, lanes)
#: The four numbers from ``table[index + 4 place]`` on, of each place: four vectors
gather_fours = _gathering("gather_fours", 4, _tuple_of_lanes(4))


@intrinsic
def store(typingctx: Context, table: types.Type, index: types.Type, value: types.Type) -> Intrinsic:
    """Sixteen numbers to ``table[index]`` and on."""
    if not (_is_table(table) and _is_numeric(value)):
        return None

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        address = _address(context, builder, signature.args[0], *arguments[:2])
        _write(builder, _as_lanes(builder, arguments[2], signature.args[2]), address)
        return context.get_dummy_value()

    return types.none(table, types.intp, value), generate


def _prefetching(name: str, writes: int) -> ir.Value:
    def typed(typingctx: Context, table: types.Type, index: types.Type) -> Intrinsic:
        if not _is_table(table):
            return None

        def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
            address = _address(context, builder, signature.args[0], *arguments, ir.IntType(8))
            kind = ir.FunctionType(ir.VoidType(), [address.type, _INT, _INT, _INT])
            function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
            # Into all levels of the cache for data.
            builder.call(function, [address, *(ir.Constant(_INT, value) for value in (writes, 3, 1))])
            return context.get_dummy_value()

        return types.none(table, types.intp), generate

    typed.__name__ = name
    return intrinsic(typed)


#: Prefetch the cache line of ``table[index]``
prefetch = _prefetching("prefetch", 0)
#: Prefetch the cache line of ``table[index]`` to write it
prefetch_to_write = _prefetching("prefetch_to_write", 1)


def _places(builder: ir.IRBuilder, address: ir.Value, count: int) -> list[ir.Value]:
    return [builder.gep(address, [ir.Constant(_INT, place)]) for place in range(count)]


def _reading_all(
    name: str, form: ir.Type, emit: Callable[[ir.IRBuilder, list[ir.Value]], list[ir.Value]]
) -> Callable[..., Intrinsic]:
    """An operation that reads as many of ``form`` from ``table[index]`` on as a tuple is long; ``emit`` gets their places."""

    def typed(typingctx: Context, table: types.Type, index: types.Type, like: types.Type) -> Intrinsic:
        if not (_is_table(table) and isinstance(like, types.BaseTuple)):
            return None

        def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
            address = _address(context, builder, signature.args[0], *arguments[:2], form)
            return _pack(builder, emit(builder, _places(builder, address, len(like))))

        return _tuple_of_lanes(len(like))(table, types.intp, like), generate

    typed.__name__ = name
    return intrinsic(typed)


def _writing_all(
    name: str, emit: Callable[[ir.IRBuilder, list[ir.Value], list[ir.Value]], None]
) -> Callable[..., Intrinsic]:
    """An operation that writes a tuple of vectors from ``table[index]`` on; ``emit`` gets them and as many places."""

    def typed(typingctx: Context, table: types.Type, index: types.Type, values: types.Type) -> Intrinsic:
        if not (_is_table(table) and isinstance(values, types.BaseTuple)):
            return None

        def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
            address = _address(context, builder, signature.args[0], *arguments[:2])
            vectors = [_element(builder, arguments[2], signature.args[2], place) for place in range(len(values))]
            emit(builder, vectors, _places(builder, address, len(values)))
            return context.get_dummy_value()

        return types.none(table, types.intp, values), generate

    typed.__name__ = name
    return intrinsic(typed)


def _emit_load_columns(builder: ir.IRBuilder, places: list[ir.Value]) -> list[ir.Value]:
    columns = len(places)
    if columns == WIDTH:
        return _transposed(builder, [_read(builder, place) for place in places])
    kind = ir.VectorType(_FLOAT, WIDTH * columns)
    flat = _read(builder, builder.bitcast(places[0], kind.as_pointer()))
    picks = [[row * columns + column for row in range(WIDTH)] for column in range(columns)]
    return [_shuffle(builder, flat, flat, picked) for picked in picks]


def _emit_store_columns(builder: ir.IRBuilder, vectors: list[ir.Value], places: list[ir.Value]) -> None:
    columns = len(vectors)
    if columns == WIDTH:
        _emit_store_all(builder, _transposed(builder, vectors), places)
        return
    while len(vectors) & (len(vectors) - 1):
        vectors.append(ir.Constant(_LANES, ir.Undefined))
    while len(vectors) > 1:
        width = list(range(2 * vectors[0].type.count))
        vectors = [_shuffle(builder, a, b, width) for a, b in zip(vectors[::2], vectors[1::2], strict=True)]
    picks = [column * WIDTH + row for row in range(WIDTH) for column in range(columns)]
    flat = _shuffle(builder, vectors[0], vectors[0], picks)
    _write(builder, flat, builder.bitcast(places[0], flat.type.as_pointer()))


def _emit_store_all(builder: ir.IRBuilder, vectors: list[ir.Value], places: list[ir.Value]) -> None:
    for vector, place in zip(vectors, places, strict=True):
        _write(builder, vector, place)


#: As many vectors, one behind the other from ``table[index]`` on, as a tuple is long
load_all = _reading_all("load_all", _LANES, lambda builder, places: [_read(builder, place) for place in places])
#: Consecutive numbers from ``table[index]`` on, as many as a tuple is long, each in all lanes of its vector
broadcast_all = _reading_all(
    "broadcast_all", _FLOAT, lambda builder, places: [_repeat(builder, _read(builder, place)) for place in places]
)
#: The columns of a matrix with sixteen rows from ``table[index]`` on, as many columns as a tuple is long
load_columns = _reading_all("load_columns", _LANES, _emit_load_columns)
#: A tuple of vectors, one behind the other, to ``table[index]`` and on
store_all = _writing_all("store_all", _emit_store_all)
#: The columns of a matrix with sixteen rows, written row by row from ``table[index]`` on
store_columns = _writing_all("store_columns", _emit_store_columns)


@intrinsic
def load_rows(typingctx: Context, table: types.Type, places: types.Type, column: types.Type) -> Intrinsic:
    """Sixteen consecutive numbers of each of sixteen rows: vector i from ``table[places[i] + column]`` on."""
    if not (_is_table(table) and isinstance(places, types.Array)):
        return None

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        return _pack(builder, [_read(builder, row) for row in _rows(context, builder, signature, arguments)])

    return _tuple_of_lanes(WIDTH)(table, places, types.intp), generate


@intrinsic
def store_rows(
    typingctx: Context, table: types.Type, places: types.Type, column: types.Type, vectors: types.Type
) -> Intrinsic:
    """Sixteen vectors, each to a row: vector i to ``table[places[i] + column]`` and on, in this order."""
    if not (_is_table(table) and isinstance(places, types.Array)):
        return None

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        parts = [_element(builder, arguments[3], signature.args[3], row) for row in range(WIDTH)]
        _emit_store_all(builder, parts, _rows(context, builder, signature, arguments))
        return context.get_dummy_value()

    return types.none(table, places, types.intp, vectors), generate


def _rows(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> list[ir.Value]:
    """Addresses of a column of sixteen rows of a table, which begin at places in it."""
    table, places, column = arguments[:3]
    begins = context.make_array(signature.args[1])(context, builder, places).data
    return [
        _address(context, builder, signature.args[0], table, builder.add(builder.load(begin), column))
        for begin in _places(builder, begins, WIDTH)
    ]


def _transposed(builder: ir.IRBuilder, rows: Sequence[ir.Value]) -> list[ir.Value]:
    """The columns of a 16 x 16 matrix from its rows, or the rows from its columns."""
    low = [lane for pair in range(8) for lane in (pair, WIDTH + pair)]
    high = [lane for pair in range(8, 16) for lane in (pair, WIDTH + pair)]
    vectors = list(rows)
    # Interleaving the first half of the rows with the second rotates the bits of an element's place; after four times
    # row and column have changed roles.
    for _ in range(4):
        halves = zip(vectors[:8], vectors[8:], strict=True)
        vectors = [_shuffle(builder, a, b, picks) for a, b in halves for picks in (low, high)]
    return vectors


@intrinsic
def repeat(typingctx: Context, value: types.Type, like: types.Type) -> Intrinsic:
    """A number, as many times as the tuple ``like`` is long, each time in all lanes."""
    if not (_is_scalar(value) and isinstance(like, types.BaseTuple)):
        return None

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        return _pack(builder, [_as_lanes(builder, arguments[0], signature.args[0])] * len(like))

    return _tuple_of_lanes(len(like))(value, like), generate


# --- across lanes -----------------------------------------------------------------------------------------------------


@intrinsic
def dot(typingctx: Context, a: types.Type, b: types.Type, start: types.Type) -> Intrinsic:
    """``start`` plus the sum of the products of two tuples of lanes of one length."""
    length = _tuple_length((a, b))
    if length is None or not _is_numeric(start):
        return None
    kind = _result_type((a, b, start))

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        total = _as_lanes(builder, arguments[2], signature.args[2], kind)
        for index in range(length):
            factors = (_element(builder, arguments[k], signature.args[k], index, kind) for k in range(2))
            total = _call(builder, "llvm.fmuladd", *factors, total)
        return total

    return kind(a, b, start), generate


@intrinsic
def lane_sums(typingctx: Context, vectors: types.Type) -> Intrinsic:
    """Lane i of the result is the sum of all lanes of vector i of a tuple of at most sixteen; the rest is anything."""
    if not (isinstance(vectors, types.BaseTuple) and len(vectors) <= WIDTH):
        return None

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        parts = [_element(builder, arguments[0], signature.args[0], index) for index in range(len(vectors))]
        return _summed(builder, parts)

    return lanes(vectors), generate


@intrinsic
def store_lane_sums(
    typingctx: Context, table: types.Type, index: types.Type, further: types.Type, vectors: types.Type
) -> Intrinsic:
    """The sums of all lanes of each vector of a tuple: sixteen to ``table[index]`` and on, any others from ``further`` on."""
    if not (_is_table(table) and isinstance(vectors, types.BaseTuple)):
        return None

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: Values) -> ir.Value:
        parts = [_element(builder, arguments[3], signature.args[3], place) for place in range(len(vectors))]
        address = _address(context, builder, signature.args[0], *arguments[:2])
        _write(builder, _summed(builder, parts[:WIDTH]), address)
        address = _address(context, builder, signature.args[0], arguments[0], arguments[2], _FLOAT)
        for place, part in enumerate(parts[WIDTH:]):
            total = builder.extract_element(_summed(builder, [part]), ir.Constant(_INT, 0))
            _write(builder, total, builder.gep(address, [ir.Constant(_INT, place)]))
        return context.get_dummy_value()

    return types.none(table, types.intp, types.intp, vectors), generate


def _summed(builder: ir.IRBuilder, parts: list[ir.Value]) -> ir.Value:
    """The sums of all lanes of at most sixteen vectors."""
    undefined = ir.Constant(_LANES, ir.Undefined)
    run = WIDTH
    # Each vector is made of 16 / run runs, and each run adds up to one of the sums. Two vectors become one with
    # twice as many runs of half the length.
    while run > 1:
        parts = parts + [undefined] * (len(parts) % 2)
        half = run // 2
        low = [lane for start in range(0, 2 * WIDTH, run) for lane in range(start, start + half)]
        pairs = zip(parts[::2], parts[1::2], strict=True)
        parts = [
            builder.fadd(_shuffle(builder, a, b, low), _shuffle(builder, a, b, [lane + half for lane in low]))
            for a, b in pairs
        ]
        run = half
    return parts[0]


def _emit_least(builder: ir.IRBuilder, vector: ir.Value) -> ir.Value:
    for run in (8, 4, 2, 1):
        moved = _shuffle(builder, vector, vector, [lane ^ run for lane in range(WIDTH)])
        vector = builder.select(builder.fcmp_ordered("<", vector, moved), vector, moved)
    return builder.extract_element(vector, ir.Constant(_INT, 0))


#: The least of the sixteen numbers
least_lane = _of_one("least_lane", Lanes, types.float32, _emit_least)


def _fixed(values: Sequence[float]) -> Callable[..., Intrinsic]:
    return intrinsic(lambda typingctx: (lanes(), lambda context, builder, signature, arguments: _constant(values)))


#: Column of a lane's pixel in a block of 4 x 4, or of a block in a tile: 0, 1, 2, 3 four times over
lane_columns = _fixed([float(lane % 4) for lane in range(WIDTH)])
#: Row of a lane's pixel in a block, or of a block in a tile: each of 0, 1, 2, 3 four times
lane_rows = _fixed([float(lane // 4) for lane in range(WIDTH)])
#: Number of a lane: 0 to 15
lane_numbers = _fixed([float(lane) for lane in range(WIDTH)])


@intrinsic
def lane(typingctx: Context, vector: types.Type, index: types.Type) -> Intrinsic:
    """One of the sixteen numbers."""
    if not isinstance(vector, Lanes):
        return None
    return types.float32(vector, types.intp), lambda context, builder, signature, arguments: builder.extract_element(
        *arguments
    )
