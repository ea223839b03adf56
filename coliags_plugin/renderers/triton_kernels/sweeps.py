"""Compositing of 3D Gaussians and of surfels, whose depth differs from pixel to pixel; forward and backward.

Rows of the table (``stages.Stages``) of 3D Gaussians are means2d (2), whitening (3), log(opacity) and the features; of
surfels means2d (2), slopes of U, V and W (6), W at the centre, D, the filter's centre (2), log(opacity) and the
features (``ProjectedSurfels.intersections``).
"""

from __future__ import annotations

import triton
import triton.language as tl

#: Edge of a tile, pixels. At 16 the blocks of the backward pass do not fit a program's registers.
TILE_SIZE = 8
#: Pairs composited at a time; products of matrices need at least 16.
RANKS = 16
#: Warps of a program.
FORWARD_WARPS, BACKWARD_WARPS = 4, 8
#: Columns of the tables before the features.
GAUSSIAN_COLUMNS, SURFEL_COLUMNS = tl.constexpr(6), tl.constexpr(13)


@triton.jit
def tile_pixels(tile, columns, width, height, SIZE: tl.constexpr):
    """Centres of a tile's pixels, their index in the image and whether they are in it. [P] each"""
    place = tl.arange(0, SIZE * SIZE)
    column = (tile % columns) * SIZE + place % SIZE
    row = (tile // columns) * SIZE + place // SIZE
    return column + 0.5, row + 0.5, row * width + column, (column < width) & (row < height)


@triton.jit
def cut(alphas, alpha_min, alpha_max):
    """Alphas clamped above, and 0 below alpha_min."""
    alphas = tl.minimum(alphas, alpha_max)
    return tl.where(alphas >= alpha_min, alphas, 0.0)


@triton.jit
def blend(alphas, before, transmittance_min):
    """Transmittance behind each pair, 0 from the one on that would take it below the bound, and weights. [R, P] each"""
    behind = before[None, :] * tl.cumprod(1.0 - alphas, axis=0)
    behind = tl.where(behind >= transmittance_min, behind, 0.0)
    return behind, alphas / (1.0 - alphas) * behind


@triton.jit
def crosses_half(behind, weights, before, RANKS: tl.constexpr):
    """Mask of the pairs that bring the transmittance to one half or less. [R, P]"""
    open_ranks = tl.sum((behind > 0.5).to(tl.int32), axis=0)
    at = tl.arange(0, RANKS)[:, None] == open_ranks[None, :]
    return at & (before > 0.5)[None, :] & (weights > 0.0)


@triton.jit
def of_log_alphas(gained, hidden, alphas, weights, alpha_max):
    """Gradients of log(alpha), from first-order contributions to the loss: each pair's, and all from here on. [R, P]"""
    behind = hidden[None, :] - tl.cumsum(gained, axis=0)
    derivative = gained - behind * (alphas / (1.0 - alphas))
    return tl.where((weights > 0.0) & (alphas < alpha_max), derivative, 0.0)


# --- 3D Gaussians -----------------------------------------------------------------------------------------------------


@triton.jit
def _at_pixels(rows, here, x, y, alpha_min, alpha_max):
    """Whitening [R] each; offsets of pixels from the centres, the same whitened, and alphas [R, P] each."""
    dx = x[None, :] - tl.load(rows, here, 0.0)[:, None]
    dy = y[None, :] - tl.load(rows + 1, here, 0.0)[:, None]
    u_xx, u_yx, u_yy = tl.load(rows + 2, here, 0.0), tl.load(rows + 3, here, 0.0), tl.load(rows + 4, here, 0.0)
    along, across = u_xx[:, None] * dx, u_yx[:, None] * dx + u_yy[:, None] * dy
    log_opacities = tl.load(rows + 5, here, -1e4)
    alphas = tl.exp(log_opacities[:, None] - 0.5 * (along * along + across * across))
    return u_xx, u_yx, u_yy, dx, dy, along, across, cut(alphas, alpha_min, alpha_max)


@triton.jit
def gaussians_forward(
    table, depths, gaussian, starts, image, medians, columns, width, height, channels,
    alpha_min, alpha_max, transmittance_min,
    WITH_MEDIANS: tl.constexpr, CHANNELS: tl.constexpr, SIZE: tl.constexpr, RANKS: tl.constexpr,
):  # fmt: skip
    """Alpha-composite features of 3D Gaussians [channels, H, W], and their median depth [H, W] where wanted."""
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, columns, width, height, SIZE)
    before = inside.to(tl.float32)
    sums = tl.zeros([CHANNELS, SIZE * SIZE], tl.float32)
    median = tl.zeros([SIZE * SIZE], tl.float32)
    channel = tl.arange(0, CHANNELS)
    stride = GAUSSIAN_COLUMNS + channels
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(before) > 0.0):
        ranks = first + tl.arange(0, RANKS)
        here = ranks < end
        index = tl.load(gaussian + ranks, here, 0).to(tl.int64)
        rows = table + index * stride
        _, _, _, _, _, _, _, alphas = _at_pixels(rows, here, x, y, alpha_min, alpha_max)
        behind, weights = blend(alphas, before, transmittance_min)
        is_channel = here[:, None] & (channel < channels)[None, :]
        features = tl.load(rows[:, None] + GAUSSIAN_COLUMNS + channel[None, :], is_channel, 0.0)
        sums += tl.dot(tl.trans(features), weights, input_precision="ieee")
        if WITH_MEDIANS:
            crossing = crosses_half(behind, weights, before, RANKS)
            median += tl.sum(tl.where(crossing, tl.load(depths + index, here, 0.0)[:, None], 0.0), axis=0)
        before = tl.min(behind, axis=0)
        first += RANKS
    stored = (channel < channels)[:, None] & inside[None, :]
    tl.store(image + channel[:, None] * (width * height) + pixel[None, :], sums, stored)
    if WITH_MEDIANS:
        tl.store(medians + pixel, median, inside)


@triton.jit
def gaussians_backward(
    table, gaussian, starts, image, of_image, of_table, columns, width, height, channels,
    alpha_min, alpha_max, transmittance_min,
    CHANNELS: tl.constexpr, SIZE: tl.constexpr, RANKS: tl.constexpr,
):  # fmt: skip
    """Accumulate the table's gradients from those of the composited image."""
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, columns, width, height, SIZE)
    before = inside.to(tl.float32)
    channel = tl.arange(0, CHANNELS)
    stride = GAUSSIAN_COLUMNS + channels
    stored = (channel < channels)[:, None] & inside[None, :]
    place = channel[:, None] * (width * height) + pixel[None, :]
    of_sums = tl.load(of_image + place, stored, 0.0)
    hidden = tl.sum(of_sums * tl.load(image + place, stored, 0.0), axis=0)
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(before) > 0.0):
        ranks = first + tl.arange(0, RANKS)
        here = ranks < end
        index = tl.load(gaussian + ranks, here, 0).to(tl.int64)
        rows, of_rows = table + index * stride, of_table + index * stride
        u_xx, u_yx, u_yy, dx, dy, along, across, alphas = _at_pixels(rows, here, x, y, alpha_min, alpha_max)
        behind, weights = blend(alphas, before, transmittance_min)
        is_channel = here[:, None] & (channel < channels)[None, :]
        features = tl.load(rows[:, None] + GAUSSIAN_COLUMNS + channel[None, :], is_channel, 0.0)
        of_features = tl.dot(weights, tl.trans(of_sums), input_precision="ieee")
        tl.atomic_add(of_rows[:, None] + GAUSSIAN_COLUMNS + channel[None, :], of_features, is_channel, sem="relaxed")
        gained = tl.dot(features, of_sums, input_precision="ieee") * weights
        of_logs = of_log_alphas(gained, hidden, alphas, weights, alpha_max)
        hidden -= tl.sum(gained, axis=0)
        of_along, of_across = -of_logs * along, -of_logs * across
        total_along, total_across = tl.sum(of_along, axis=1), tl.sum(of_across, axis=1)
        tl.atomic_add(of_rows, -(total_along * u_xx + total_across * u_yx), here, sem="relaxed")
        tl.atomic_add(of_rows + 1, -total_across * u_yy, here, sem="relaxed")
        tl.atomic_add(of_rows + 2, tl.sum(of_along * dx, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 3, tl.sum(of_across * dx, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 4, tl.sum(of_across * dy, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 5, tl.sum(of_logs, axis=1), here, sem="relaxed")
        before = tl.min(behind, axis=0)
        first += RANKS


# --- surfels ----------------------------------------------------------------------------------------------------------


@triton.jit
def _plane(rows, here, column, dx, dy):
    """The number of a pixel that has these slopes and is 0 at the centre. [R, P]"""
    return tl.load(rows + column, here, 0.0)[:, None] * dx + tl.load(rows + column + 1, here, 0.0)[:, None] * dy


@triton.jit
def _hits(rows, here, x, y, near_plane):
    """Ray-disc intersections: offset from the centre, 1 / W, u, v, depth, and whether there is one. [R, P] each"""
    dx = x[None, :] - tl.load(rows, here, 0.0)[:, None]
    dy = y[None, :] - tl.load(rows + 1, here, 0.0)[:, None]
    inverse_w = 1.0 / (_plane(rows, here, 6, dx, dy) + tl.load(rows + 8, here, 0.0)[:, None])
    depths = tl.load(rows + 9, here, 0.0)[:, None] * inverse_w
    # Infinite, or NaN, where W is 0.
    hit = (depths >= near_plane) & (depths < float("inf"))
    inverse_w = tl.where(hit, inverse_w, 0.0)
    u, v = _plane(rows, here, 2, dx, dy) * inverse_w, _plane(rows, here, 4, dx, dy) * inverse_w
    return dx, dy, inverse_w, u, v, tl.where(hit, depths, 1.0), hit


@triton.jit
def _alphas(rows, here, x, y, u, v, hit, sharpness, alpha_min, alpha_max):
    """Alphas, offset from the filter's centre, and whether the disc counts, not the filter. [R, P] each"""
    from_x = x[None, :] - tl.load(rows + 10, here, 0.0)[:, None]
    from_y = y[None, :] - tl.load(rows + 11, here, 0.0)[:, None]
    squared, filtered = u * u + v * v, (from_x * from_x + from_y * from_y) * sharpness
    on_disc = squared <= filtered
    log_opacities = tl.load(rows + 12, here, -1e4)
    alphas = tl.exp(log_opacities[:, None] - 0.5 * tl.where(on_disc, squared, filtered))
    return cut(tl.where(hit, alphas, 0.0), alpha_min, alpha_max), from_x, from_y, on_disc


@triton.jit
def surfels_forward(
    table, gaussian, starts, image, depth_image, spread_image, columns, width, height, channels,
    alpha_min, alpha_max, transmittance_min, near_plane, sharpness,
    WITH_DEPTHS: tl.constexpr, CHANNELS: tl.constexpr, SIZE: tl.constexpr, RANKS: tl.constexpr,
):  # fmt: skip
    """Alpha-composite features of surfels [channels, H, W], and their depths [4, H, W] where wanted.

    With these come the weight, mean and sum of squared differences of 1/z that the backward pass needs. [3, H, W]
    """
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, columns, width, height, SIZE)
    before = inside.to(tl.float32)
    sums = tl.zeros([CHANNELS, SIZE * SIZE], tl.float32)
    of_depth, of_inverse, median = tl.zeros_like(before), tl.zeros_like(before), tl.zeros_like(before)
    total, mean, squares = tl.zeros_like(before), tl.zeros_like(before), tl.zeros_like(before)
    channel = tl.arange(0, CHANNELS)
    stride = SURFEL_COLUMNS + channels
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(before) > 0.0):
        ranks = first + tl.arange(0, RANKS)
        here = ranks < end
        rows = table + tl.load(gaussian + ranks, here, 0) * stride
        _, _, _, u, v, depths, hit = _hits(rows, here, x, y, near_plane)
        alphas, _, _, _ = _alphas(rows, here, x, y, u, v, hit, sharpness, alpha_min, alpha_max)
        behind, weights = blend(alphas, before, transmittance_min)
        is_channel = here[:, None] & (channel < channels)[None, :]
        features = tl.load(rows[:, None] + SURFEL_COLUMNS + channel[None, :], is_channel, 0.0)
        sums += tl.dot(tl.trans(features), weights, input_precision="ieee")
        if WITH_DEPTHS:
            inverse = 1.0 / depths
            of_depth += tl.sum(weights * depths, axis=0)
            of_inverse += tl.sum(weights * inverse, axis=0)
            crossing = crosses_half(behind, weights, before, RANKS)
            median += tl.sum(tl.where(crossing, depths, 0.0), axis=0)
            # Means and squared differences are merged; differences of large sums would not be accurate.
            weight = tl.sum(weights, axis=0)
            own_mean = tl.sum(weights * inverse, axis=0) / tl.where(weight > 0.0, weight, 1.0)
            difference = inverse - own_mean[None, :]
            step = (own_mean - mean) * (weight / tl.where(weight > 0.0, total + weight, 1.0))
            squares += tl.sum(weights * difference * difference, axis=0) + total * step * (own_mean - mean)
            mean += step
            total += weight
        before = tl.min(behind, axis=0)
        first += RANKS
    area = width * height
    stored = (channel < channels)[:, None] & inside[None, :]
    tl.store(image + channel[:, None] * area + pixel[None, :], sums, stored)
    if WITH_DEPTHS:
        tl.store(depth_image + pixel, of_depth, inside)
        tl.store(depth_image + area + pixel, of_inverse, inside)
        tl.store(depth_image + 2 * area + pixel, total * squares, inside)
        tl.store(depth_image + 3 * area + pixel, median, inside)
        tl.store(spread_image + pixel, total, inside)
        tl.store(spread_image + area + pixel, mean, inside)
        tl.store(spread_image + 2 * area + pixel, squares, inside)


@triton.jit
def surfels_backward(
    table, gaussian, starts, image, depth_image, spread_image, of_image, of_depth_image, of_table,
    columns, width, height, channels, alpha_min, alpha_max, transmittance_min, near_plane, sharpness,
    WITH_DEPTHS: tl.constexpr, CHANNELS: tl.constexpr, SIZE: tl.constexpr, RANKS: tl.constexpr,
):  # fmt: skip
    """Accumulate the table's gradients from those of the composited images."""
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, columns, width, height, SIZE)
    before = inside.to(tl.float32)
    channel = tl.arange(0, CHANNELS)
    stride = SURFEL_COLUMNS + channels
    area = width * height
    stored = (channel < channels)[:, None] & inside[None, :]
    place = channel[:, None] * area + pixel[None, :]
    of_sums = tl.load(of_image + place, stored, 0.0)
    hidden = tl.sum(of_sums * tl.load(image + place, stored, 0.0), axis=0)
    if WITH_DEPTHS:
        of_depth = tl.load(of_depth_image + pixel, inside, 0.0)
        of_inverse = tl.load(of_depth_image + area + pixel, inside, 0.0)
        of_spread = tl.load(of_depth_image + 2 * area + pixel, inside, 0.0)
        of_median = tl.load(of_depth_image + 3 * area + pixel, inside, 0.0)
        total = tl.load(spread_image + pixel, inside, 0.0)
        mean = tl.load(spread_image + area + pixel, inside, 0.0)
        squares = tl.load(spread_image + 2 * area + pixel, inside, 0.0)
        hidden += tl.load(depth_image + pixel, inside, 0.0) * of_depth
        hidden += tl.load(depth_image + area + pixel, inside, 0.0) * of_inverse
        # The spread is quadratic in the weights.
        hidden += 2.0 * tl.load(depth_image + 2 * area + pixel, inside, 0.0) * of_spread
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(before) > 0.0):
        ranks = first + tl.arange(0, RANKS)
        here = ranks < end
        index = tl.load(gaussian + ranks, here, 0).to(tl.int64)
        rows, of_rows = table + index * stride, of_table + index * stride
        dx, dy, inverse_w, u, v, depths, hit = _hits(rows, here, x, y, near_plane)
        alphas, from_x, from_y, on_disc = _alphas(rows, here, x, y, u, v, hit, sharpness, alpha_min, alpha_max)
        behind, weights = blend(alphas, before, transmittance_min)
        is_channel = here[:, None] & (channel < channels)[None, :]
        features = tl.load(rows[:, None] + SURFEL_COLUMNS + channel[None, :], is_channel, 0.0)
        of_features = tl.dot(weights, tl.trans(of_sums), input_precision="ieee")
        tl.atomic_add(of_rows[:, None] + SURFEL_COLUMNS + channel[None, :], of_features, is_channel, sem="relaxed")
        gained = tl.dot(features, of_sums, input_precision="ieee")
        of_offset = tl.zeros_like(weights)
        if WITH_DEPTHS:
            inverse = 1.0 / depths
            deviation = inverse - mean[None, :]
            gained += of_depth[None, :] * depths + of_inverse[None, :] * inverse
            gained += of_spread[None, :] * (total[None, :] * deviation * deviation + squares[None, :])
            of_over_z = of_inverse[None, :] + 2.0 * of_spread[None, :] * total[None, :] * deviation
            of_z = weights * (of_depth[None, :] - of_over_z * inverse * inverse)
            crossing = crosses_half(behind, weights, before, RANKS)
            of_offset = (of_z + tl.where(crossing, of_median[None, :], 0.0)) * inverse_w
        gained *= weights
        of_logs = of_log_alphas(gained, hidden, alphas, weights, alpha_max)
        hidden -= tl.sum(gained, axis=0)
        disc = tl.where(on_disc, of_logs, 0.0) * inverse_w
        of_u, of_v = -disc * u, -disc * v
        of_w = disc * (u * u + v * v) - of_offset * depths
        total_u, total_v, total_w = tl.sum(of_u, axis=1), tl.sum(of_v, axis=1), tl.sum(of_w, axis=1)
        for axis in tl.static_range(2):
            of_mean = total_u * tl.load(rows + 2 + axis, here, 0.0) + total_v * tl.load(rows + 4 + axis, here, 0.0)
            of_mean += total_w * tl.load(rows + 6 + axis, here, 0.0)
            tl.atomic_add(of_rows + axis, -of_mean, here, sem="relaxed")
        tl.atomic_add(of_rows + 2, tl.sum(of_u * dx, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 3, tl.sum(of_u * dy, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 4, tl.sum(of_v * dx, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 5, tl.sum(of_v * dy, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 6, tl.sum(of_w * dx, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 7, tl.sum(of_w * dy, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 8, total_w, here, sem="relaxed")
        tl.atomic_add(of_rows + 9, tl.sum(of_offset, axis=1), here, sem="relaxed")
        filtered = tl.where(on_disc, 0.0, of_logs) * sharpness
        tl.atomic_add(of_rows + 10, tl.sum(filtered * from_x, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 11, tl.sum(filtered * from_y, axis=1), here, sem="relaxed")
        tl.atomic_add(of_rows + 12, tl.sum(of_logs, axis=1), here, sem="relaxed")
        before = tl.min(behind, axis=0)
        first += RANKS
