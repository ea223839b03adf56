"""Colours of some rows of spherical harmonics, and their derivatives: sixteen Gaussians at a time, as lanes.

The definition is :func:`coliags_plugin.fields.spherical_harmonics.colors` along normalised vectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.lanes import WIDTH
from coliags_plugin.core.numba_kernels.threads import Crew, pieces
from coliags_plugin.core.tensors import tables
from coliags_plugin.fields.spherical_harmonics import FACTORS, Y0

#: Gaussians that a thread takes at a time.
_PIECE = 16 * WIDTH
#: Basis functions, of which the first is constant.
_TERMS = 1 + len(FACTORS)
#: Shortest norm to divide by, as in ``torch.nn.functional.normalize``.
_SHORTEST = 1e-12
#: Scratch of a thread, in vectors: coefficients, values of the basis and their derivatives, and three coordinates.
_COEFFICIENTS = 0
_BASIS = 3 * _TERMS * WIDTH
_OF_BASIS = _BASIS + _TERMS * WIDTH
_VECTORS = _OF_BASIS + _TERMS * WIDTH
_SCRATCH = _VECTORS + 3 * WIDTH
#: As long as what is read or written at once.
_THREE = (0,) * 3
_SIXTEEN = (0,) * WIDTH


def colors(
    sh0: Float[Tensor, "N 1 3"],
    shN: Float[Tensor, "N B 3"],
    rows: Int[Tensor, "V"],
    sight: Float[Tensor, "V 3"],
    degree: int,
) -> Float[Tensor, "V 3"]:
    """Colours of some rows, which ascend, along vectors from the camera; float32 on the CPU, differentiable once."""
    result: Tensor = _Colors.apply(sh0, shN, sight, rows, degree)  # type: ignore[no-untyped-call]
    return result


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh0: Tensor, shN: Tensor, sight: Tensor, rows: Tensor, degree: int) -> Tensor:
        ctx.save_for_backward(sh0, shN, sight, rows)
        ctx.terms = (degree + 1) ** 2
        result = torch.empty_like(sight, memory_format=torch.contiguous_format)
        Crew().run(_forward, ctx.terms, *tables(sh0, shN, rows, sight, result))
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_color: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        results = [torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in saved[:3]]
        sh0, shN, sight, rows = tables(*saved)
        Crew().run(_backward, ctx.terms, sh0, shN, rows, sight, *tables(of_color, *results))
        return *results, None, None


@kernel
def _forward(counters, terms, sh0, shN, rows, sight, colors):
    """Write the colours of all rows."""
    scratch, places = np.empty(_SCRATCH, np.float32), np.empty(WIDTH, np.int64)
    for first in pieces(counters, 0, len(rows), _PIECE):
        for group in range(first, min(first + _PIECE, len(rows)), WIDTH):
            _load(terms, sh0, shN, rows, sight, group, scratch, places)
            vec.store_all(scratch, _VECTORS, vec.larger(0.0, _sums(terms, scratch)))
            _write_columns(scratch, _VECTORS, 3, colors, places)


@kernel
def _backward(counters, terms, sh0, shN, rows, sight, of_colors, of_sh0, of_shN, of_sight):
    """Write the derivatives of all coefficients, 0 where they do not count, and of the vectors to the Gaussians."""
    scratch, places = np.empty(_SCRATCH, np.float32), np.empty(WIDTH, np.int64)
    gaussians, count = len(sh0) // 3, len(rows)
    width = len(shN) // max(1, gaussians)
    for first in pieces(counters, 0, max(1, count), _PIECE):
        last = min(first + _PIECE, count)
        # A piece also covers the rows up to the next that are not among its own.
        begin, end = (rows[first] if first else 0), (rows[last] if last < count else gaussians)
        of_sh0[3 * begin : 3 * end] = 0.0
        of_shN[width * begin : width * end] = 0.0
        for group in range(first, last, WIDTH):
            direction, norm = _load(terms, sh0, shN, rows, sight, group, scratch, places)
            unclamped = _sums(terms, scratch)
            _read_columns(of_colors, places, 3, scratch, _VECTORS)
            of_color = vec.load_all(scratch, _VECTORS, _THREE)
            of_color = (
                _passed(unclamped[0], of_color[0]),
                _passed(unclamped[1], of_color[1]),
                _passed(unclamped[2], of_color[2]),
            )
            vec.store_all(scratch, _OF_BASIS, vec.repeat(0.0, _SIXTEEN))
            for term in range(terms):
                value, at = vec.load(scratch, _BASIS + WIDTH * term), _COEFFICIENTS + 3 * WIDTH * term
                coefficients = vec.load_all(scratch, at, _THREE)
                vec.store(scratch, _OF_BASIS + WIDTH * term, vec.dot(of_color, coefficients, 0.0))
                vec.store_all(scratch, at, vec.mul((value, value, value), of_color))
            of_direction = _basis_backward(direction, vec.load_all(scratch, _OF_BASIS + WIDTH, FACTORS))
            along = vec.neg(vec.dot(direction, of_direction, 0.0))
            across = vec.fma(direction, (along, along, along), of_direction)
            vec.store_all(scratch, _VECTORS, vec.div(across, (norm, norm, norm)))
            _write_columns(scratch, _VECTORS, 3, of_sight, places)
            _place(rows, group, 3, places)
            _write_columns(scratch, _COEFFICIENTS, 3, of_sh0, places)
            _place(rows, group, width, places)
            _write_columns(scratch, _COEFFICIENTS + 3 * WIDTH, 3 * (terms - 1), of_shN, places)


@part
def _load(terms, sh0, shN, rows, sight, group, scratch, places):
    """Read a group of rows: coefficients and values of the basis, to the scratch; directions, and lengths of sight.

    ``places`` become those of the group's vectors. The last group is filled up with its last row.
    """
    _place(rows, group, 3, places)
    _read_columns(sh0, places, 3, scratch, _COEFFICIENTS)
    _place(rows, group, len(shN) // (len(sh0) // 3), places)
    _read_columns(shN, places, 3 * (terms - 1), scratch, _COEFFICIENTS + 3 * WIDTH)
    for lane in range(WIDTH):
        places[lane] = 3 * min(group + lane, len(rows) - 1)
    _read_columns(sight, places, 3, scratch, _VECTORS)
    vector = vec.load_all(scratch, _VECTORS, _THREE)
    norm = vec.larger(vec.sqrt(vec.dot(vector, vector, 0.0)), _SHORTEST)
    direction = vec.div(vector, (norm, norm, norm))
    vec.store(scratch, _BASIS, Y0)
    vec.store_all(scratch, _BASIS + WIDTH, _basis(direction))
    return direction, norm


@inline
def _place(rows, group, width, places):
    """Offset of a group's rows in a table of rows of a width."""
    for lane in range(WIDTH):
        places[lane] = width * rows[min(group + lane, len(rows) - 1)]


@part
def _read_columns(table, places, width, scratch, at):
    """The columns of sixteen rows, which begin at places of the table."""
    if width >= WIDTH:
        for column in range(0, width, WIDTH):
            first = min(column, width - WIDTH)
            vec.store_columns(scratch, at + WIDTH * first, vec.load_rows(table, places, first))
    else:
        for lane in range(WIDTH):
            for column in range(width):
                scratch[at + WIDTH * column + lane] = vec.number(table, places[lane] + column)


@part
def _write_columns(scratch, at, width, table, places):
    """Write columns to sixteen rows, which begin at places of the table."""
    if width >= WIDTH:
        for column in range(0, width, WIDTH):
            first = min(column, width - WIDTH)
            vec.store_rows(table, places, first, vec.load_columns(scratch, at + WIDTH * first, _SIXTEEN))
    else:
        for lane in range(WIDTH):
            for column in range(width):
                table[places[lane] + column] = vec.number(scratch, at + WIDTH * column + lane)


@inline
def _sums(terms, scratch):
    """Sums of coefficients times basis, plus 0.5, of the three channels."""
    sums = vec.repeat(0.0, _THREE)
    for term in range(terms):
        value = vec.load(scratch, _BASIS + WIDTH * term)
        coefficients = vec.load_all(scratch, _COEFFICIENTS + 3 * WIDTH * term, _THREE)
        sums = vec.fma((value, value, value), coefficients, sums)
    return vec.add(sums, 0.5)


@inline
def _passed(unclamped, of_color):
    """The derivative that a colour clamped to at least 0 passes on."""
    return vec.select(vec.at_least(unclamped, 0.0), of_color, 0.0)


@inline
def _basis(direction):
    """Values of all basis functions but the first."""
    x, y, z = direction
    xx, yy, zz, xy, yz, xz = _products(x, y, z)
    difference, five = vec.sub(xx, yy), vec.fma(5.0, zz, -1.0)
    values = (
        y,
        z,
        x,
        xy,
        yz,
        vec.fma(3.0, zz, -1.0),
        xz,
        difference,
        vec.mul(y, vec.fma(3.0, xx, vec.neg(yy))),
        vec.mul(xy, z),
        vec.mul(y, five),
        vec.mul(z, vec.fma(5.0, zz, -3.0)),
        vec.mul(x, five),
        vec.mul(z, difference),
        vec.mul(x, vec.fma(-3.0, yy, xx)),
    )
    return vec.mul(FACTORS, values)


@inline
def _basis_backward(direction, of_basis):
    """Derivatives of a direction from those of all basis functions but the first."""
    x, y, z = direction
    xx, yy, zz, xy, yz, xz = _products(x, y, z)
    difference, five = vec.sub(xx, yy), vec.fma(5.0, zz, -1.0)
    thrice, six_xy = vec.mul(3.0, difference), vec.mul(6.0, xy)
    of = vec.mul(FACTORS, of_basis)
    of_x = vec.dot(
        (of[3], of[6], of[7], of[8], of[9], of[12], of[13], of[14]),
        (y, z, vec.mul(2.0, x), six_xy, yz, five, vec.mul(2.0, xz), thrice),
        of[2],
    )
    of_y = vec.dot(
        (of[3], of[4], of[7], of[8], of[9], of[10], of[13], of[14]),
        (x, z, vec.mul(-2.0, y), thrice, xz, five, vec.mul(-2.0, yz), vec.neg(six_xy)),
        of[0],
    )
    of_z = vec.dot(
        (of[4], of[5], of[6], of[9], of[10], of[11], of[12], of[13]),
        (y, vec.mul(6.0, z), x, xy, vec.mul(10.0, yz), vec.fma(15.0, zz, -3.0), vec.mul(10.0, xz), difference),
        of[1],
    )
    return of_x, of_y, of_z


@inline
def _products(x, y, z):
    return vec.mul(x, x), vec.mul(y, y), vec.mul(z, z), vec.mul(x, y), vec.mul(y, z), vec.mul(x, z)
