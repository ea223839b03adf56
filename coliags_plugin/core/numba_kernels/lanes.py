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

import inspect
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

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


def _pack(builder: ir.IRBuilder, vectors: Sequence[ir.Value]) -> ir.Value:
    """LLVM's form of numba's tuple of lanes."""
    kind = vectors[0].type if vectors else _LANES
    packed = ir.Constant(ir.ArrayType(kind, len(vectors)), ir.Undefined)
    for index, vector in enumerate(vectors):
        packed = builder.insert_value(packed, vector, index)
    return packed


def _at(builder: ir.IRBuilder, table: ir.Value, index: ir.Value, form: ir.Type = _LANES) -> ir.Value:
    """Address of the vector at ``table[index]``."""
    return builder.bitcast(builder.gep(table, [index]), form.as_pointer())


def _successive(builder: ir.IRBuilder, address: ir.Value, count: int) -> list[ir.Value]:
    """An address and the next ones, as far apart as what it is of."""
    return [builder.gep(address, [ir.Constant(_INT, place)]) for place in range(count)]


def _read(builder: ir.IRBuilder, address: ir.Value) -> ir.Value:
    value = builder.load(address)
    value.align = 4
    return value


def _write(builder: ir.IRBuilder, value: ir.Value, address: ir.Value) -> None:
    builder.store(value, address).align = 4


def _write_all(builder: ir.IRBuilder, values: Sequence[ir.Value], addresses: Sequence[ir.Value]) -> None:
    for value, address in zip(values, addresses, strict=True):
        _write(builder, value, address)


# --- operands ---------------------------------------------------------------------------------------------------------


def _is_numeric(numba_type: types.Type) -> bool:
    return isinstance(numba_type, (Lanes, DoubleLanes, types.Integer, types.Float))


def _is_tuple(numba_type: types.Type) -> bool:
    return isinstance(numba_type, types.BaseTuple)


def _is_table(numba_type: types.Type) -> bool:
    kind = (types.float32, 1, "C")
    return isinstance(numba_type, types.Array) and (numba_type.dtype, numba_type.ndim, numba_type.layout) == kind


def _is_integers(numba_type: types.Type) -> bool:
    return isinstance(numba_type, types.Array) and numba_type.dtype == types.int64 and numba_type.ndim == 1


def _elements(operands: Sequence[types.Type]) -> list[types.Type]:
    """The types of all operands, of the elements where they are tuples."""
    return [kind for operand in operands for kind in (operand if _is_tuple(operand) else [operand])]


def _common_type(operands: Sequence[types.Type]) -> types.Type:
    """Double lanes where any operand is of them."""
    return double_lanes if any(isinstance(kind, DoubleLanes) for kind in _elements(operands)) else lanes


def _tuple_length(operands: Sequence[types.Type]) -> int | None:
    """The common length of those operands that are tuples; None where none is, or they do not fit together."""
    lengths = {len(operand) for operand in operands if _is_tuple(operand)}
    return lengths.pop() if len(lengths) == 1 else None


def _as_lanes(builder: ir.IRBuilder, value: ir.Value, numba_type: types.Type, kind: types.Type = lanes) -> ir.Value:
    """A number or lanes, as lanes or double lanes; a mask as it is."""
    wide = isinstance(kind, DoubleLanes)
    if isinstance(numba_type, Lanes):
        return builder.fpext(value, _DOUBLES) if wide else value
    if isinstance(numba_type, (DoubleLanes, LaneMask)):
        return value
    scalar = ir.DoubleType() if wide else _FLOAT
    if isinstance(numba_type, types.Integer):
        value = builder.sitofp(value, scalar)
    elif wide and numba_type.bitwidth < 64:
        value = builder.fpext(value, scalar)
    elif not wide and numba_type.bitwidth > 32:
        value = builder.fptrunc(value, scalar)
    return _repeat(builder, value)


def _element(
    builder: ir.IRBuilder, value: ir.Value, numba_type: types.Type, index: int, kind: types.Type = lanes
) -> ir.Value:
    """One element of a tuple, or what stands for all of them, as lanes or double lanes."""
    if _is_tuple(numba_type):
        return _as_lanes(builder, builder.extract_value(value, index), numba_type[index], kind)
    return _as_lanes(builder, value, numba_type, kind)


class Operand(NamedTuple):
    """A kind of operand.

    Attributes:
        accepts: Whether an operand may be of a type.
        form: What ``emit`` gets of it, from context, builder, value and type.
        passed: The type that it is converted to; None: as it is.
    """

    accepts: Callable[[types.Type], bool]
    form: Callable[[BaseContext, ir.IRBuilder, ir.Value, types.Type], Any]
    passed: types.Type | None = None


def _data(context: BaseContext, builder: ir.IRBuilder, value: ir.Value, kind: types.Type) -> ir.Value:
    return context.make_array(kind)(context, builder, value).data


def _value(context: BaseContext, builder: ir.IRBuilder, value: ir.Value, kind: types.Type) -> ir.Value:
    return value


#: A table of float32, or of int64: the address of its first number.
TABLE, INTEGERS = Operand(_is_table, _data), Operand(_is_integers, _data)
#: A place in a table, and another integer.
INDEX = Operand(lambda kind: isinstance(kind, types.Integer), _value, types.intp)
INTEGER = INDEX._replace(passed=types.int64)
#: One or sixteen numbers: lanes.
NUMBERS = Operand(_is_numeric, lambda context, builder, value, kind: _as_lanes(builder, value, kind))
#: Sixteen numbers, or truth values.
VECTOR, MASK = (Operand(lambda kind, of=of: isinstance(kind, of), _value) for of in (Lanes, LaneMask))
#: A tuple of vectors: a list of lanes.
VECTORS = Operand(
    _is_tuple,
    lambda context, builder, value, kind: [_element(builder, value, kind, place) for place in range(len(kind))],
)
#: Result of an operation: a tuple of lanes, as long as the operand of kind :data:`LENGTH`.
AS_LONG = object()
#: A tuple of which the length counts.
LENGTH = Operand(_is_tuple, lambda context, builder, value, kind: len(kind))


def _intrinsic(emit: Callable[..., Any], name: str, typed: Callable[..., Intrinsic]) -> Any:
    """Make an intrinsic, whose operands are those of ``emit`` behind the builder: numba reads them from its signature."""

    def resolve(typingctx: Context, *operands: types.Type) -> Intrinsic:
        return typed(*operands)

    names = ["typingctx", *list(inspect.signature(emit).parameters)[1:]]
    parameters = [inspect.Parameter(each, inspect.Parameter.POSITIONAL_OR_KEYWORD) for each in names]
    resolve.__name__, resolve.__doc__ = name, emit.__doc__
    resolve.__signature__ = inspect.Signature(parameters)
    return intrinsic(resolve)


def operation(result: Any, *operands: Operand, name: str | None = None) -> Callable[..., Any]:
    """Decorate what builds an operation's instructions: ``emit(builder, *operands)``, in their forms.

    ``emit`` gives a value of type ``result``; a list of lanes where that is a tuple, :data:`AS_LONG` for one as long as the
    operand of kind :data:`LENGTH`; or nothing where it is None.
    """

    def decorate(emit: Callable[..., Any]) -> Any:
        def typed(*kinds: types.Type) -> Intrinsic:
            if len(kinds) != len(operands) or not all(map(lambda of, kind: of.accepts(kind), operands, kinds)):
                return None
            passed = [kind if of.passed is None else of.passed for of, kind in zip(operands, kinds, strict=True)]
            gives = types.none if result is None else result
            if gives is AS_LONG:
                gives = types.UniTuple(lanes, len(kinds[operands.index(LENGTH)]))

            def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Any) -> ir.Value:
                forms = [
                    of.form(context, builder, value, kind)
                    for of, value, kind in zip(operands, values, signature.args, strict=True)
                ]
                value = emit(builder, *forms)
                if isinstance(value, list):
                    return _pack(builder, value)
                return context.get_dummy_value() if value is None else value

            return gives(*passed), generate

        return _intrinsic(emit, name or emit.__name__, typed)

    return decorate


def _lanewise(name: str, emit: Callable[..., ir.Value], result: types.Type | None = None) -> Any:
    """An operation on numbers, lane by lane, and element by element where operands are tuples.

    ``emit`` gets the builder and one vector for each operand; ``result`` is the type of one element, None for that of the
    operands. Masks are operands as they are, of all elements.
    """

    def typed(*operands: types.Type) -> Intrinsic:
        numbers = [operand for operand in operands if not isinstance(operand, LaneMask)]
        length = _tuple_length(numbers)
        if any(map(_is_tuple, numbers)) != (length is not None) or not all(map(_is_numeric, _elements(numbers))):
            return None
        kind = _common_type(numbers)

        def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Any) -> ir.Value:
            pairs = list(zip(values, signature.args, strict=True))
            if length is None:
                return emit(builder, *(_as_lanes(builder, *pair, kind) for pair in pairs))
            elements = [[_element(builder, *pair, index, kind) for pair in pairs] for index in range(length)]
            return _pack(builder, [emit(builder, *vectors) for vectors in elements])

        gives = result or kind
        return (gives if length is None else types.UniTuple(gives, length))(*operands), generate

    return _intrinsic(emit, name, typed)


# --- arithmetic -------------------------------------------------------------------------------------------------------

#: a + b
add = _lanewise("add", lambda builder, a, b: builder.fadd(a, b))
#: a - b
sub = _lanewise("sub", lambda builder, a, b: builder.fsub(a, b))
#: a b
mul = _lanewise("mul", lambda builder, a, b: builder.fmul(a, b))
#: a b + c
fma = _lanewise("fma", lambda builder, a, b, c: _call(builder, "llvm.fmuladd", a, b, c))
#: a / b, rounded correctly
div = _lanewise("div", lambda builder, a, b: builder.fdiv(a, b))
#: a / b to a unit or two in the last place, for ordinary numbers
quick_div = _lanewise("quick_div", lambda builder, a, b: builder.fdiv(a, b, flags=("arcp", "afn", "contract")))
#: -a
neg = _lanewise("neg", lambda builder, a: builder.fneg(a))
#: Square root
sqrt = _lanewise("sqrt", lambda builder, a: _call(builder, "llvm.sqrt", a))
#: The integer at or above
ceil = _lanewise("ceil", lambda builder, a: _call(builder, "llvm.ceil", a))
#: The integer at or below
floor = _lanewise("floor", lambda builder, a: _call(builder, "llvm.floor", a))
#: A number in all lanes
splat = _lanewise("splat", lambda builder, a: a)
#: The smaller; b where either is not a number
smaller = _lanewise("smaller", lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
#: The larger; b where either is not a number
larger = _lanewise("larger", lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
#: ``chosen`` where the mask holds, else ``other``
select = _lanewise("select", lambda builder, mask, chosen, other: builder.select(mask, chosen, other))

#: float64 of float32
widen = _lanewise("widen", lambda builder, a: builder.fpext(a, _DOUBLES), double_lanes)
#: The nearest float32 of float64
narrow = _lanewise("narrow", lambda builder, a: builder.fptrunc(a, _LANES), lanes)

# Comparisons are False where either is not a number.
less = _lanewise("less", lambda builder, a, b: builder.fcmp_ordered("<", a, b), lane_mask)
at_most = _lanewise("at_most", lambda builder, a, b: builder.fcmp_ordered("<=", a, b), lane_mask)
greater = _lanewise("greater", lambda builder, a, b: builder.fcmp_ordered(">", a, b), lane_mask)
at_least = _lanewise("at_least", lambda builder, a, b: builder.fcmp_ordered(">=", a, b), lane_mask)

both = operation(lane_mask, MASK, MASK, name="both")(lambda builder, a, b: builder.and_(a, b))
either = operation(lane_mask, MASK, MASK, name="either")(lambda builder, a, b: builder.or_(a, b))


@operation(lane_mask, INTEGER)
def from_bits(builder, flags):
    """The mask that :func:`bits` turns into this integer."""
    return builder.bitcast(builder.trunc(flags, _FLAGS), _MASK)


@operation(types.int64, MASK)
def bits(builder, mask):
    """The mask as an integer, lane 0 in the lowest bit."""
    return builder.zext(builder.bitcast(mask, _FLAGS), ir.IntType(64))


@operation(types.int64, INTEGER)
def lowest_bit(builder, flags):
    """Place of the lowest bit set in an integer that is not 0."""
    return builder.cttz(flags, ir.Constant(ir.IntType(1), 1))


@operation(types.int64, INTEGER)
def bit_count(builder, flags):
    """Number of bits set in an integer."""
    return builder.ctpop(flags)


# --- 2^x and its inverse ----------------------------------------------------------------------------------------------

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
exp2 = _lanewise("exp2", _emit_exp2)

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
log2 = _lanewise("log2", _emit_log2)


# --- memory -----------------------------------------------------------------------------------------------------------

# Indices never count from the end of a table.


@operation(lanes, TABLE, INDEX)
def load(builder, table, index):
    """Sixteen numbers from ``table[index]`` on."""
    return _read(builder, _at(builder, table, index))


@operation(types.float32, TABLE, INDEX)
def number(builder, table, index):
    """``table[index]``."""
    return _read(builder, _at(builder, table, index, _FLOAT))


@operation(lanes, TABLE, INDEX)
def broadcast(builder, table, index):
    """``table[index]`` in all lanes."""
    return _repeat(builder, _read(builder, _at(builder, table, index, _FLOAT)))


@operation(None, TABLE, INDEX, NUMBERS)
def store(builder, table, index, value):
    """Sixteen numbers to ``table[index]`` and on."""
    _write(builder, value, _at(builder, table, index))


@operation(lanes, TABLE, INDEX, VECTOR)
def gather(builder, table, index, places):
    """``table[index + place]`` for sixteen places, which are whole numbers from 0 to 2^24."""
    vector = ir.Constant(_LANES, ir.Undefined)
    for row, value in enumerate(_gathered(builder, _at(builder, table, index, _FLOAT), places)):
        vector = builder.insert_element(vector, value, ir.Constant(_INT, row))
    return vector


@operation(types.UniTuple(lanes, 4), TABLE, INDEX, VECTOR)
def gather_fours(builder, table, index, places):
    """The four numbers from ``table[index + 4 place]`` on, of each place: four vectors."""
    return _columns_of_four(builder, _gathered(builder, _at(builder, table, index, ir.VectorType(_FLOAT, 4)), places))


def _gathered(builder: ir.IRBuilder, address: ir.Value, places: ir.Value) -> list[ir.Value]:
    """Values at sixteen places behind an address, counted in its elements."""
    whole = builder.fptosi(places, _INTS)
    steps = [builder.extract_element(whole, ir.Constant(_INT, row)) for row in range(WIDTH)]
    return [_read(builder, builder.gep(address, [step])) for step in steps]


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


@operation(None, TABLE, INDEX)
def prefetch(builder, table, index):
    """Prefetch the cache line of ``table[index]``."""
    address = _at(builder, table, index, ir.IntType(8))
    kind = ir.FunctionType(ir.VoidType(), [address.type, _INT, _INT, _INT])
    function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
    # To read, into all levels of the cache for data.
    builder.call(function, [address, *(ir.Constant(_INT, value) for value in (0, 3, 1))])


@operation(AS_LONG, TABLE, INDEX, LENGTH)
def load_all(builder, table, index, like):
    """Successive vectors from ``table[index]`` on, as many as a tuple is long."""
    return [_read(builder, address) for address in _successive(builder, _at(builder, table, index), like)]


@operation(AS_LONG, TABLE, INDEX, LENGTH)
def broadcast_all(builder, table, index, like):
    """Consecutive numbers from ``table[index]`` on, as many as a tuple is long, each in all lanes of its vector."""
    addresses = _successive(builder, _at(builder, table, index, _FLOAT), like)
    return [_repeat(builder, _read(builder, address)) for address in addresses]


@operation(AS_LONG, TABLE, INDEX, LENGTH)
def load_columns(builder, table, index, like):
    """The columns of a matrix with sixteen rows from ``table[index]`` on, as many columns as a tuple is long."""
    if like == WIDTH:
        rows = _successive(builder, _at(builder, table, index), WIDTH)
        return _transposed(builder, [_read(builder, row) for row in rows])
    flat = _read(builder, _at(builder, table, index, ir.VectorType(_FLOAT, WIDTH * like)))
    picks = [[row * like + column for row in range(WIDTH)] for column in range(like)]
    return [_shuffle(builder, flat, flat, picked) for picked in picks]


@operation(None, TABLE, INDEX, VECTORS)
def store_all(builder, table, index, values):
    """Store a tuple of vectors contiguously, starting at ``table[index]``."""
    _write_all(builder, values, _successive(builder, _at(builder, table, index), len(values)))


@operation(None, TABLE, INDEX, VECTORS)
def store_columns(builder, table, index, vectors):
    """The columns of a matrix with sixteen rows, written row by row from ``table[index]`` on."""
    columns = len(vectors)
    if columns == WIDTH:
        _write_all(builder, _transposed(builder, vectors), _successive(builder, _at(builder, table, index), WIDTH))
        return
    while len(vectors) & (len(vectors) - 1):
        vectors.append(ir.Constant(_LANES, ir.Undefined))
    while len(vectors) > 1:
        width = list(range(2 * vectors[0].type.count))
        vectors = [_shuffle(builder, a, b, width) for a, b in zip(vectors[::2], vectors[1::2], strict=True)]
    picks = [column * WIDTH + row for row in range(WIDTH) for column in range(columns)]
    flat = _shuffle(builder, vectors[0], vectors[0], picks)
    _write(builder, flat, _at(builder, table, index, flat.type))


@operation(types.UniTuple(lanes, WIDTH), TABLE, INTEGERS, INDEX)
def load_rows(builder, table, places, column):
    """Sixteen consecutive numbers of each of sixteen rows: vector i from ``table[places[i] + column]`` on."""
    return [_read(builder, address) for address in _rows(builder, table, places, column)]


@operation(None, TABLE, INTEGERS, INDEX, VECTORS)
def store_rows(builder, table, places, column, vectors):
    """Sixteen vectors, each to a row: vector i to ``table[places[i] + column]`` and on, in this order."""
    _write_all(builder, vectors, _rows(builder, table, places, column))


def _rows(builder: ir.IRBuilder, table: ir.Value, places: ir.Value, column: ir.Value) -> list[ir.Value]:
    """Addresses of a column of sixteen rows of a table, which begin at places in it."""
    begins = (builder.load(begin) for begin in _successive(builder, places, WIDTH))
    return [_at(builder, table, builder.add(begin, column)) for begin in begins]


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


@operation(AS_LONG, NUMBERS, LENGTH)
def repeat(builder, value, like):
    """A number, as many times as the tuple ``like`` is long, each time in all lanes."""
    return [value] * like


# --- across lanes -----------------------------------------------------------------------------------------------------


def _emit_dot(builder: ir.IRBuilder, a: Sequence[ir.Value], b: Sequence[ir.Value], start: ir.Value) -> ir.Value:
    for first, second in zip(a, b, strict=True):
        start = _call(builder, "llvm.fmuladd", first, second, start)
    return start


def _typed_dot(a: types.Type, b: types.Type, start: types.Type) -> Intrinsic:
    length = _tuple_length((a, b))
    if length is None or not _is_numeric(start):
        return None
    kind = _common_type((a, b, start))

    def generate(context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Any) -> ir.Value:
        factors = [
            [_element(builder, value, operand, index, kind) for index in range(length)]
            for value, operand in zip(values[:2], signature.args[:2], strict=True)
        ]
        return _emit_dot(builder, *factors, _as_lanes(builder, values[2], signature.args[2], kind))

    return kind(a, b, start), generate


#: ``start`` plus the sum of the products of two tuples of lanes of one length
dot = _intrinsic(_emit_dot, "dot", _typed_dot)


@operation(lanes, VECTORS)
def lane_sums(builder, vectors):
    """Lane i of the result is the sum of all lanes of vector i of a tuple of at most sixteen; the rest is anything."""
    return _summed(builder, vectors)


@operation(None, TABLE, INDEX, INDEX, VECTORS)
def store_lane_sums(builder, table, index, further, vectors):
    """The sums of all lanes of each vector of a tuple: sixteen to ``table[index]`` and on, others from ``further`` on."""
    _write(builder, _summed(builder, vectors[:WIDTH]), _at(builder, table, index))
    rest = [builder.extract_element(_summed(builder, [part]), ir.Constant(_INT, 0)) for part in vectors[WIDTH:]]
    _write_all(builder, rest, _successive(builder, _at(builder, table, further, _FLOAT), len(rest)))


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


@operation(types.float32, VECTOR)
def least_lane(builder, vector):
    """The least of the sixteen numbers."""
    for run in (8, 4, 2, 1):
        moved = _shuffle(builder, vector, vector, [lane ^ run for lane in range(WIDTH)])
        vector = builder.select(builder.fcmp_ordered("<", vector, moved), vector, moved)
    return builder.extract_element(vector, ir.Constant(_INT, 0))


#: Column of a lane's pixel in a block of 4 x 4, or of a block in a tile: 0, 1, 2, 3 four times over
lane_columns = operation(lanes, name="lane_columns")(lambda builder: _constant([float(i % 4) for i in range(WIDTH)]))
#: Row of a lane's pixel in a block, or of a block in a tile: each of 0, 1, 2, 3 four times
lane_rows = operation(lanes, name="lane_rows")(lambda builder: _constant([float(i // 4) for i in range(WIDTH)]))
#: Number of a lane: 0 to 15
lane_numbers = operation(lanes, name="lane_numbers")(lambda builder: _constant([float(i) for i in range(WIDTH)]))


@operation(types.float32, VECTOR, INDEX)
def lane(builder, vector, index):
    """One of the sixteen numbers."""
    return builder.extract_element(vector, index)
