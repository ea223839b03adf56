"""Semi-global aggregation of matching costs, and the depth that wins."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.numba_compilation import Array, kernel, part


@part
def _path_step(cost: Array, before: Array, least: float, jump: float, small: float, into: Array, total: Array) -> float:
    """One step of a path: Hirschmueller's recurrence. Returns the least value of ``into``."""
    count = len(cost)
    lowest = np.float32(np.inf)
    for d in range(count):
        value = min(before[d], least + jump)
        if d > 0:
            value = min(value, before[d - 1] + small)
        if d + 1 < count:
            value = min(value, before[d + 1] + small)
        value = cost[d] + value - least
        into[d] = value
        total[d] += value
        lowest = min(lowest, value)
    return lowest


@kernel
def aggregate(
    cost: Array, guide: Array, small: np.float32, large: np.float32, contrast: np.float32, total: Array
) -> None:
    """Sum of the path costs over eight directions.

    ``guide``: image whose edges make jumps cheaper. Penalty of a change by one hypothesis: ``small`` (P1); of any
    greater one: ``large`` (P2) divided by ``1 + contrast * |difference of the guide|``, and not less than ``small``.
    Costs are float32 [H, W, D].
    """
    height, width, count = cost.shape
    total[:] = 0.0
    paths = np.empty((2, width, count), np.float32)
    lowest = np.empty((2, width), np.float32)
    line = np.empty((2, count), np.float32)
    start = np.zeros(count, np.float32)
    for backward in range(2):
        for step in range(height):
            y = height - 1 - step if backward else step
            # Along the row: the direction of this pass.
            least = np.float32(0.0)
            for position in range(width):
                x = width - 1 - position if backward else position
                if position == 0:
                    least = _path_step(cost[y, x], start, np.float32(0.0), large, small, line[0], total[y, x])
                else:
                    aside = x + 1 if backward else x - 1
                    jump = max(small, large / (np.float32(1.0) + contrast * abs(guide[y, x] - guide[y, aside])))
                    least = _path_step(
                        cost[y, x], line[(position + 1) % 2], least, jump, small, line[position % 2], total[y, x]
                    )
        # From the row before, straight and along both diagonals.
        for slope in range(-1, 2):
            for step in range(height):
                y = height - 1 - step if backward else step
                behind = y + 1 if backward else y - 1
                now, then = step % 2, (step + 1) % 2
                for x in range(width):
                    origin = x - slope
                    if step == 0 or origin < 0 or origin >= width:
                        lowest[now, x] = _path_step(
                            cost[y, x], start, np.float32(0.0), large, small, paths[now, x], total[y, x]
                        )
                    else:
                        jump = max(
                            small, large / (np.float32(1.0) + contrast * abs(guide[y, x] - guide[behind, origin]))
                        )
                        lowest[now, x] = _path_step(
                            cost[y, x],
                            paths[then, origin],
                            lowest[then, origin],
                            jump,
                            small,
                            paths[now, x],
                            total[y, x],
                        )


@kernel
def pick(total: Array, cost: Array, rivals: int, index: Array, match: Array, margin: Array) -> None:
    """The hypothesis of the least aggregated cost, to a part of a step by a parabola.

    ``rivals``: how many hypotheses before the best one must have been compared, where there are as many: at the rim of
    an image, what is near leaves the neighbours' views, and what is left wins for want of rivals. Written, float32
    [H, W]: ``index``, the fractional position; ``match``, the correlation at it before aggregation, -1 to 1, 0 without
    its rivals; ``margin``, by how much the aggregated cost of any hypothesis more than two steps away is greater, of
    those with a cost other than exactly 1, which says that nothing was compared.
    """
    height, width, count = total.shape
    for y in range(height):
        for x in range(width):
            costs = total[y, x]
            best = 0
            for d in range(1, count):
                if costs[d] < costs[best]:
                    best = d
            second = np.float32(np.inf)
            for d in range(count):
                if abs(d - best) > 2 and cost[y, x, d] != 1.0:
                    second = min(second, costs[d])
            offset = np.float32(0.0)
            if 0 < best < count - 1:
                bend = costs[best - 1] - np.float32(2.0) * costs[best] + costs[best + 1]
                if bend > np.float32(1e-6):
                    offset = np.float32(0.5) * (costs[best - 1] - costs[best + 1]) / bend
            index[y, x] = np.float32(best) + offset
            match[y, x] = np.float32(1.0) - cost[y, x, best]
            for d in range(max(0, best - rivals), best):
                if cost[y, x, d] == 1.0:
                    match[y, x] = 0.0
            margin[y, x] = second - costs[best] if second < np.inf else np.float32(0.0)
