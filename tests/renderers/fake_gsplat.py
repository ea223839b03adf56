"""gsplat 1.5.3's public functions, without a GPU: its kernels' arithmetic in plain PyTorch, gradients by autograd.

Argument orders, shapes and assertions are those of gsplat 1.5.3 (Apache-2.0), read in its sources, less the options
that the package leaves alone, and so are the constants and the habits that its callers must know: only radii are
written of what is not drawn (here the rest is NaN), and no Gaussians at all end the process (here an exception). Shares
no code with the package.
"""

from __future__ import annotations

import importlib.machinery
import math
import types

import torch

ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN = 0.999, 1 / 255, 1e-4
#: What the arithmetic is done in. float64 leaves only the inputs' rounding; float32 is what the kernels do.
PRECISION = torch.float64

CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 128, 129, 256, 257, 512, 513)


def module(calls=None):
    """A stand-in for ``import gsplat``. ``calls`` collects (name, arguments) of what is called."""

    def recorded(function):
        def call(*args, **kwargs):
            if calls is not None:
                calls.append((function.__name__, args, kwargs))
            return function(*args, **kwargs)

        return call

    fake = types.ModuleType("gsplat")
    fake.__spec__ = importlib.machinery.ModuleSpec("gsplat", None)
    fake.__version__ = "1.5.3"
    for function in (fully_fused_projection, isect_tiles, isect_offset_encode, rasterize_to_pixels):
        setattr(fake, function.__name__, recorded(function))
    return fake


def _check_inputs(means, quats, scales, viewmats, Ks):
    n, c = means.shape[-2], viewmats.shape[-3]
    assert means.shape == (n, 3) and quats.shape == (n, 4) and scales.shape == (n, 3)
    assert viewmats.shape == (c, 4, 4) and Ks.shape == (c, 3, 3) and c == 1
    assert all(value.dtype == torch.float32 for value in (means, quats, scales, viewmats, Ks))
    if n == 0:
        raise ZeroDivisionError("means.numel() / (N * 3): the process dies of SIGFPE")


def _rotations(quats):
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, dim=-2)


def _placed(means, viewmats):
    """Rotation, and centres in camera axes: rotated first and moved then, as the kernels do."""
    turn = viewmats[0, :3, :3].to(PRECISION)
    return turn, means.to(PRECISION) @ turn.T + viewmats[0, :3, 3].to(PRECISION)


def _outside(center, radius_x, radius_y, width, height):
    x, y = center.unbind(-1)
    return (x + radius_x <= 0) | (x - radius_x >= width) | (y + radius_y <= 0) | (y - radius_y >= height)


def _undrawn(values, drawn):
    """[1, N, ...] float32, with NaN where gsplat writes nothing."""
    shape = (-1, *[1] * (values.dim() - 1))
    return torch.where(drawn.view(shape), values, torch.nan).float()[None]


def fully_fused_projection(
    means, covars, quats, scales, viewmats, Ks, width, height, eps2d=0.3, near_plane=0.01, opacities=None
):
    assert covars is None
    _check_inputs(means, quats, scales, viewmats, Ks)
    assert opacities is None or opacities.shape == means.shape[:1]
    turn, local = _placed(means, viewmats)
    inside = (local[:, 2] >= near_plane).detach()
    x, y, z = torch.where(inside[:, None], local, local.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
    fx, fy, cx, cy = Ks[0, 0, 0].item(), Ks[0, 1, 1].item(), Ks[0, 0, 2].item(), Ks[0, 1, 2].item()
    spread = _rotations(quats.to(PRECISION)) * scales.to(PRECISION)[:, None, :]
    covariance = turn @ (spread @ spread.transpose(1, 2)) @ turn.T
    slope_x = (x / z).clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
    slope_y = (y / z).clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
    zero = torch.zeros_like(z)
    row_x = torch.stack([fx / z, zero, -fx * slope_x / z], dim=-1)
    row_y = torch.stack([zero, fy / z, -fy * slope_y / z], dim=-1)
    jacobian = torch.stack([row_x, row_y], dim=1)
    flat = jacobian @ covariance @ jacobian.transpose(1, 2)
    xx, xy, yy = flat[:, 0, 0] + eps2d, flat[:, 0, 1], flat[:, 1, 1] + eps2d
    determinant = xx * yy - xy * xy
    conics = torch.stack([yy, -xy, xx], dim=-1) / determinant[:, None]
    centers = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    with torch.no_grad():
        extend = torch.full_like(z, 3.33)
        bright = torch.ones_like(inside)
        if opacities is not None:
            bright = opacities >= ALPHA_MIN
            extend = extend.minimum((2 * (opacities.to(PRECISION) / ALPHA_MIN).log().clamp_min(0)).sqrt())
        radius_x, radius_y = (extend * xx.sqrt()).ceil(), (extend * yy.sqrt()).ceil()
        drawn = inside & bright & (determinant > 0) & ((radius_x > 0) | (radius_y > 0))
        drawn &= ~_outside(centers, radius_x, radius_y, width, height)
        radii = torch.where(drawn[:, None], torch.stack([radius_x, radius_y], dim=-1), 0).int()[None]
    return radii, _undrawn(centers, drawn), _undrawn(z, drawn), _undrawn(conics, drawn), None


@torch.no_grad()
def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
    n = means2d.shape[-2]
    assert means2d.shape == (1, n, 2) and radii.shape == (1, n, 2) and depths.shape == (1, n)
    assert radii.dtype == torch.int32 and means2d.dtype == depths.dtype == torch.float32
    counts, keys, owners = [], [], []
    bits = depths[0].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    for i in range(n):
        radius_x, radius_y = radii[0, i].tolist()
        if radius_x <= 0 or radius_y <= 0:
            counts.append(0)
            continue
        x, y = means2d[0, i].tolist()
        columns, rows = (
            [
                min(max(0, end), most)
                for end in (math.floor((at - reach) / tile_size), math.ceil((at + reach) / tile_size))
            ]
            for at, reach, most in ((x, radius_x, tile_width), (y, radius_y, tile_height))
        )
        tiles = [row * tile_width + column for row in range(*rows) for column in range(*columns)]
        counts.append(len(tiles))
        keys += [(tile << 32) | bits[i].item() for tile in tiles]
        owners += [i] * len(tiles)
    keys, order = torch.sort(torch.tensor(keys, dtype=torch.int64), stable=True)
    owners = torch.tensor(owners, dtype=torch.int32)[order]
    return torch.tensor(counts, dtype=torch.int32)[None], keys, owners


@torch.no_grad()
def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).int().view(n_images, tile_height, tile_width)


def rasterize_to_pixels(
    means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, backgrounds=None
):
    n, channels = means2d.shape[-2], colors.shape[-1]
    assert means2d.shape == (1, n, 2) and conics.shape == (1, n, 3) and colors.shape == (1, n, channels)
    assert opacities.shape == (1, n)
    assert backgrounds is None or backgrounds.shape == (1, channels)
    assert all(value.dtype == torch.float32 for value in (means2d, conics, colors, opacities))
    padded, backgrounds = _padded(colors, backgrounds, CHANNELS)
    conics, centers = conics[0].to(PRECISION), means2d[0].to(PRECISION)

    def power(ids, pixels):
        dx, dy = (centers[ids, None] - pixels).unbind(-1)
        a, b, c = (conics[ids, k, None] for k in range(3))
        return 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy

    size = (width, height, tile_size)
    image, alpha = _composite(power, padded[0], opacities[0], size, isect_offsets, flatten_ids, backgrounds)
    return image[..., :channels].float()[None], alpha.float()[None]


def _padded(colors, backgrounds, supported):
    channels = colors.shape[-1]
    missing = 0 if channels in supported else (1 << (channels - 1).bit_length()) - channels
    colors = torch.cat([colors, colors.new_zeros((*colors.shape[:-1], missing))], dim=-1)
    if backgrounds is not None:
        backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(len(backgrounds), missing)], dim=-1)
    return colors.to(PRECISION), None if backgrounds is None else backgrounds.to(PRECISION)


def _composite(power, features, opacities, size, offsets, lists, backgrounds):
    """Image and alpha [H, W, 1]."""
    width, height, tile_size = size
    starts = [*offsets.flatten().tolist(), len(lists)]
    image = features.new_zeros(height, width, features.shape[-1])
    alphas = features.new_zeros(height, width, 1)
    for tile in range(offsets.numel()):
        row, column = divmod(tile, offsets.shape[-1])
        ids = lists[starts[tile] : starts[tile + 1]].long()
        across = torch.arange(column * tile_size, min((column + 1) * tile_size, width))
        down = torch.arange(row * tile_size, min((row + 1) * tile_size, height))
        v, u = torch.meshgrid(down, across, indexing="ij")
        pixels = torch.stack([u, v], dim=-1).reshape(-1, 2).to(PRECISION) + 0.5
        sigma = power(ids, pixels)
        alpha = (opacities[ids, None].to(PRECISION) * (-sigma).exp()).clamp(max=ALPHA_MAX)
        alpha = torch.where((sigma < 0) | (alpha < ALPHA_MIN), torch.zeros_like(alpha), alpha)
        after = (1 - alpha).cumprod(0)
        before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
        # After the stop the light left only falls, so what lies behind fails the same test.
        weights = torch.where(after > TRANSMITTANCE_MIN, alpha * before, torch.zeros_like(alpha))
        light = 1 - weights.sum(0)
        # Features of undrawn Gaussians may be NaN; the lists hold drawn ones only.
        sums = torch.einsum("kp,kf->pf", weights, features[ids])
        if backgrounds is not None:
            sums = sums + light[:, None] * backgrounds
        place = (v.flatten(), u.flatten())
        image = image.index_put(place, sums)
        alphas = alphas.index_put(place, 1 - light[:, None])
    return image, alphas
