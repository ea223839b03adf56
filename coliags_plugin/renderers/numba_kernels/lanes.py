"""Sixteen float32 numbers side by side, as a type that numba kernels compute with.

A loop that is written for one number is at the mercy of the vectoriser, which gives up without a word. Here the vector is
spelled out: every operation below becomes the LLVM instruction for ``<16 x float>``, which LLVM maps to one AVX-512
register, two AVX registers or four NEON ones. Nothing is reassociated and nothing assumes finite numbers; ``fma`` is
fused where the machine can.

``Lanes`` holds numbers and ``LaneMask`` truth values. Wherever lanes are expected a scalar will do: it is repeated.
Arrays are flat, contiguous and float32, and are not bounds checked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

#: Numbers in a vector; pixels of a block.
WIDTH = 16

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_LANES = ir.VectorType(_FLOAT, WIDTH)
_INTS = ir.VectorType(_INT, WIDTH)
_MASK = ir.VectorType(ir.IntType(1), WIDTH)


class Lanes(types.Type):
    """Sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


class LaneMask(types.Type):
    """Sixteen truth values."""

    def __init__(self) -> None:
        super().__init__(name="LaneMask")


lanes = Lanes()
lane_mask = LaneMask()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _LANES)


@register_model(LaneMask)
class _LaneMaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _MASK)


# --- helpers that build instructions ----------------------------------------------------------------------------------


def _vector(values: Sequence[float], kind: ir.VectorType = _LANES) -> ir.Constant:
    return ir.Constant(kind, [ir.Constant(kind.element, value) for value in values])


def _repeat(builder: ir.IRBuilder, scalar: Any) -> Any:
    """One scalar in all lanes."""
    first = builder.insert_element(ir.Constant(ir.VectorType(scalar.type, WIDTH), ir.Undefined), scalar, _index(0))
    return _shuffle(builder, first, first, [0] * WIDTH)


def _index(value: int) -> ir.Constant:
    return ir.Constant(_INT, value)


def _shuffle(builder: ir.IRBuilder, a: Any, b: Any, picks: Sequence[int | None]) -> Any:
    """Lanes of ``a`` (counted from 0) and ``b`` (counted on from there); None for a lane that does not matter."""
    kind = ir.VectorType(_INT, len(picks))
    elements = [ir.Constant(_INT, ir.Undefined if pick is None else pick) for pick in picks]
    return builder.shuffle_vector(a, b, ir.Constant(kind, elements))


def _as_lanes(builder: ir.IRBuilder, value: Any, numba_type: types.Type) -> Any:
    """A value of a type that :func:`_is_numeric` admits, as a vector."""
    if isinstance(numba_type, Lanes):
        return value
    if isinstance(numba_type, types.Integer):
        value = builder.sitofp(value, _FLOAT)
    elif numba_type.bitwidth > 32:
        value = builder.fptrunc(value, _FLOAT)
    return _repeat(builder, value)


def _is_numeric(numba_type: types.Type) -> bool:
    return isinstance(numba_type, (Lanes, types.Integer, types.Float))


def _is_table(numba_type: types.Type) -> bool:
    return (
        isinstance(numba_type, types.Array)
        and numba_type.ndim == 1
        and numba_type.layout == "C"
        and numba_type.dtype == types.float32
    )


def _call(builder: ir.IRBuilder, name: str, arguments: Sequence[Any], result: Any = _LANES) -> Any:
    """Call an LLVM intrinsic."""
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    module = builder.module
    function = module.globals.get(name) or ir.Function(module, kind, name)
    return builder.call(function, arguments)


def _lanewise(emit: Callable[..., Any], arity: int, result: types.Type = lanes) -> Any:
    """An operation on numbers, lane by lane.

    Args:
        emit: Gets the builder and one vector for each operand, and gives the vector of the result.
        arity: How many operands.
        result: Type of the result.
    """

    def typed(operands: tuple[types.Type, ...]) -> Any:
        if not all(_is_numeric(operand) for operand in operands):
            return None

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Sequence[Any]) -> Any:
            vectors = (_as_lanes(builder, *pair) for pair in zip(arguments, signature.args, strict=True))
            return emit(builder, *vectors)

        return result(*operands), generate

    # numba reads the operands from the signature, so each arity needs its own.
    if arity == 1:
        return intrinsic(lambda typing_context, a: typed((a,)))
    if arity == 2:
        return intrinsic(lambda typing_context, a, b: typed((a, b)))
    return intrinsic(lambda typing_context, a, b, c: typed((a, b, c)))


def _compare(comparison: str) -> Any:
    return _lanewise(lambda builder, a, b: builder.fcmp_ordered(comparison, a, b), 2, lane_mask)


def _combine(emit: Callable[..., Any]) -> Any:
    """An operation on two masks."""

    def typed(typing_context: Any, a: types.Type, b: types.Type) -> Any:
        if not (isinstance(a, LaneMask) and isinstance(b, LaneMask)):
            return None
        return lane_mask(a, b), lambda context, builder, signature, arguments: emit(builder, *arguments)

    return intrinsic(typed)


# --- arithmetic -------------------------------------------------------------------------------------------------------

#: a + b
add = _lanewise(ir.IRBuilder.fadd, 2)
#: a - b
sub = _lanewise(ir.IRBuilder.fsub, 2)
#: a b
mul = _lanewise(ir.IRBuilder.fmul, 2)
#: a / b, correctly rounded
div = _lanewise(ir.IRBuilder.fdiv, 2)
#: a / b to about a bit less, by estimating the reciprocal where that is quicker
quick_div = _lanewise(lambda builder, a, b: builder.fdiv(a, b, flags=("fast",)), 2)
#: a b + c
fma = _lanewise(lambda builder, a, b, c: _call(builder, "llvm.fmuladd.v16f32", (a, b, c)), 3)
#: -a
neg = _lanewise(ir.IRBuilder.fneg, 1)
#: Square root
sqrt = _lanewise(lambda builder, a: _call(builder, "llvm.sqrt.v16f32", (a,)), 1)
#: Logarithm to base 2, by sixteen calls of the C library: not for inner loops
log2 = _lanewise(lambda builder, a: _call(builder, "llvm.log2.v16f32", (a,)), 1)
#: Smallest integer that is not below
ceil = _lanewise(lambda builder, a: _call(builder, "llvm.ceil.v16f32", (a,)), 1)
#: Largest integer that is not above
floor = _lanewise(lambda builder, a: _call(builder, "llvm.floor.v16f32", (a,)), 1)
#: A scalar in all lanes
splat = _lanewise(lambda builder, a: a, 1)
#: The smaller; b where either is not a number
smaller = _lanewise(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b), 2)
#: The larger; b where either is not a number
larger = _lanewise(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b), 2)

#: Comparisons; False where either is not a number
less = _compare("<")
at_most = _compare("<=")
greater = _compare(">")
at_least = _compare(">=")

both = _combine(ir.IRBuilder.and_)
either = _combine(ir.IRBuilder.or_)

_EXP2_MAGIC = 1.5 * 2.0**23
#: Minimax polynomial of 2^f on [-1/2, 1/2], lowest order first: relative error below 1e-7 with float32 rounding.
_EXP2_POLYNOMIAL = (
    1.0000000716546679,
    0.6931474804878235,
    0.24022107481956482,
    0.05550713092088699,
    0.009675540961325169,
    0.0013276471774429083,
)


def _emit_exp2(builder: ir.IRBuilder, power: Any) -> Any:
    # Adding 1.5 * 2^23 rounds to the nearest integer and leaves it in the lowest bits.
    magic = _vector([_EXP2_MAGIC] * WIDTH)
    shifted = builder.fadd(power, magic)
    fraction = builder.fsub(power, builder.fsub(shifted, magic))
    value = _vector([_EXP2_POLYNOMIAL[-1]] * WIDTH)
    for coefficient in _EXP2_POLYNOMIAL[-2::-1]:
        value = _call(builder, "llvm.fmuladd.v16f32", (value, fraction, _vector([coefficient] * WIDTH)))
    exponent = builder.shl(builder.bitcast(shifted, _INTS), _vector([23] * WIDTH, _INTS))
    return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _LANES)


#: 2^a for a in [-126, 127]; any bits at all outside
exp2 = _lanewise(_emit_exp2, 1)


@intrinsic
def select(typing_context, mask, chosen, other):  # type: ignore[no-untyped-def]
    """``chosen`` where the mask holds, else ``other``."""
    if not (isinstance(mask, LaneMask) and _is_numeric(chosen) and _is_numeric(other)):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Sequence[Any]) -> Any:
        pairs = zip(arguments[1:], signature.args[1:], strict=True)
        return builder.select(arguments[0], *(_as_lanes(builder, *pair) for pair in pairs))

    return lanes(mask, chosen, other), generate


@intrinsic
def bits(typing_context, mask):  # type: ignore[no-untyped-def]
    """The mask as an integer, lane 0 in the lowest bit."""
    if not isinstance(mask, LaneMask):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Sequence[Any]) -> Any:
        return builder.zext(builder.bitcast(arguments[0], ir.IntType(WIDTH)), ir.IntType(64))

    return types.int64(mask), generate
