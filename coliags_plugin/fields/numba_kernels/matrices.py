"""Products of small matrices that stay in a core's cache."""

from __future__ import annotations

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, part

#: Rows of a product computed at a time: a register for each, and one for the other factor.
ROWS = 8


@part
def multiply(shape, a, b, c):
    """Add the product of two matrices to a third: C += A B.

    ``shape`` is (rows of A and C, columns of B and C, a multiple of the lanes' width, columns of A and rows of B). A matrix is
    its table, the place of its first element, the step to the next row and, of A, the step to the next column.
    """
    rows, columns, depth = shape
    left, a_start, a_row, a_column = a
    right, b_start, b_row = b
    result, c_start, c_row = c
    whole = rows - rows % ROWS
    for column in range(0, columns, vec.WIDTH):
        at_b = b_start + column
        for row in range(0, whole, ROWS):
            at_c, at_a = c_start + row * c_row + column, a_start + row * a_row
            total = (
                vec.load(result, at_c),
                vec.load(result, at_c + c_row),
                vec.load(result, at_c + 2 * c_row),
                vec.load(result, at_c + 3 * c_row),
                vec.load(result, at_c + 4 * c_row),
                vec.load(result, at_c + 5 * c_row),
                vec.load(result, at_c + 6 * c_row),
                vec.load(result, at_c + 7 * c_row),
            )
            for d in range(depth):
                total = vec.fma(_column(left, at_a + d * a_column, a_row), vec.load(right, at_b + d * b_row), total)
            for r in range(ROWS):
                vec.store(result, at_c + r * c_row, total[r])
        for row in range(whole, rows):
            at_c, at_a = c_start + row * c_row + column, a_start + row * a_row
            single = vec.load(result, at_c)
            for d in range(depth):
                single = vec.fma(vec.broadcast(left, at_a + d * a_column), vec.load(right, at_b + d * b_row), single)
            vec.store(result, at_c, single)


@inline
def _column(a, start, step):
    """Eight numbers, ``step`` apart, each in all lanes of its vector."""
    return (
        vec.broadcast(a, start),
        vec.broadcast(a, start + step),
        vec.broadcast(a, start + 2 * step),
        vec.broadcast(a, start + 3 * step),
        vec.broadcast(a, start + 4 * step),
        vec.broadcast(a, start + 5 * step),
        vec.broadcast(a, start + 6 * step),
        vec.broadcast(a, start + 7 * step),
    )
