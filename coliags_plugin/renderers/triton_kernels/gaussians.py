"""Compositing of 3D Gaussians, forward and backward.

Rows of the table are means2d (2), whitening (3), log(opacity) and the features (``stages.Stages``).
"""

from __future__ import annotations

import triton
import triton.language as tl

from coliags_plugin.renderers.triton_kernels.tile import blend, crosses_half, cut, of_log_alphas, tile_pixels

#: Columns of the table before the features.
OWN_COLUMNS = tl.constexpr(6)


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
def forward(
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
    stride = OWN_COLUMNS + channels
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(before) > 0.0):
        ranks = first + tl.arange(0, RANKS)
        here = ranks < end
        index = tl.load(gaussian + ranks, here, 0).to(tl.int64)
        rows = table + index * stride
        _, _, _, _, _, _, _, alphas = _at_pixels(rows, here, x, y, alpha_min, alpha_max)
        behind, weights = blend(alphas, before, transmittance_min)
        is_channel = here[:, None] & (channel < channels)[None, :]
        features = tl.load(rows[:, None] + OWN_COLUMNS + channel[None, :], is_channel, 0.0)
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
def backward(
    table, gaussian, starts, image, of_image, of_table, columns, width, height, channels,
    alpha_min, alpha_max, transmittance_min,
    CHANNELS: tl.constexpr, SIZE: tl.constexpr, RANKS: tl.constexpr,
):  # fmt: skip
    """Accumulate the table's gradients from those of the composited image."""
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, columns, width, height, SIZE)
    before = inside.to(tl.float32)
    channel = tl.arange(0, CHANNELS)
    stride = OWN_COLUMNS + channels
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
        features = tl.load(rows[:, None] + OWN_COLUMNS + channel[None, :], is_channel, 0.0)
        of_features = tl.dot(weights, tl.trans(of_sums), input_precision="ieee")
        tl.atomic_add(of_rows[:, None] + OWN_COLUMNS + channel[None, :], of_features, is_channel, sem="relaxed")
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
