"""Linear regression that outliers hardly affect."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Reweighted solutions.
_ROUNDS = 8
#: Most rows that are used.
_MOST = 20_000


def robust_fit(
    columns: Float[np.ndarray, "N K"],
    values: Float[np.ndarray, "N"],
    weights: Float[np.ndarray, "N"],
    default: Float[np.ndarray, "K"],
    default_weight: float,
) -> Float[np.ndarray, "K"]:
    """Coefficients by least squares reweighted by Cauchy's function of the residual, its scale four median deviations.

    The first column is constant. ``default``, the solution without rows, draws it with the weight of ``default_weight``
    rows of unit weight.
    """
    if len(values) == 0:
        return default.copy()
    every = -(-len(values) // _MOST)
    rows, wanted, trust = columns[::every], values[::every].astype(np.float64), weights[::every].astype(np.float64)
    rows = rows.astype(np.float64)
    scale = np.maximum(rows.std(axis=0), 1e-3)
    scale[0] = 1.0
    middle = np.average(rows, axis=0, weights=trust)
    middle[0] = 0.0
    standard = (rows - middle) / scale
    start = default * scale
    start[0] = default[0] + default[1:] @ middle[1:]
    pull = np.full(len(start), default_weight)
    pull[0] = 1e-3 * default_weight  # the level follows the data at once
    solution, left = start, wanted - standard @ start
    for _ in range(_ROUNDS):
        spread = max(4.0 * float(np.median(np.abs(left - np.median(left)))), 1e-4)
        centred = left - (np.median(left) if solution is start else 0.0)
        each = trust / (1.0 + (centred / spread) ** 2)
        normal = standard.T @ (each[:, None] * standard) + np.diag(pull)
        solution = np.linalg.solve(normal, standard.T @ (each * wanted) + pull * start)
        left = wanted - standard @ solution
    coefficients = solution / scale
    coefficients[0] = solution[0] - coefficients[1:] @ middle[1:]
    return np.asarray(coefficients)
