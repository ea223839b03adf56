"""Tensors: copies to devices, masked means, bilinear samples, random numbers of pixels, normals, tables for kernels."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.libraries import what_triton_lacks

#: Multiplier of the position in the sequence, and the two of the mixing, of splitmix64; as signed integers.
_GOLDEN, _MIX = 0x9E3779B97F4A7C15 - 2**64, (0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64)
#: Positions whose neighbours are in memory at once.
_CHUNK = 4096
#: A wall's normal is estimated from one in so many of the points, and from no fewer than so many.
_SHARE, _FEWEST = 500, 20


def constant(values: tuple[Any, ...], like: Tensor) -> Tensor:
    """A tensor of numbers, nested in tuples, of the dtype and on the device of another; not to be changed.

    ``like.new_tensor`` copies each time, which on CUDA waits; this one is kept from call to call.
    """
    return _kept(values, like.dtype, like.device)


@lru_cache(maxsize=1024)
def _kept(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # an inference tensor could not take part in a later backward pass
        return torch.tensor(values, dtype=dtype, device=device)


def sent(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on a device; one of the CPU goes to CUDA through pinned memory, for which the host does not wait."""
    if tensor.device.type == "cpu" and torch.device(device).type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)


def zero_outside(values: Float[Tensor, "H W *C"], mask: Bool[Tensor, "H W"] | None) -> Float[Tensor, "H W *C"]:
    """The values where the mask is True, or everywhere without one; 0 elsewhere.

    Selected with ``torch.where``, not multiplied: NaN or infinity outside still yields 0 and a gradient of exactly 0.
    """
    if mask is None:
        return values
    inside = mask if values.dim() == mask.dim() else mask[..., None]
    return torch.where(inside, values, torch.zeros((), dtype=values.dtype, device=values.device))


def masked_mean(values: Float[Tensor, "H W *C"], mask: Bool[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Mean over the pixels (and channels) where the mask is True; 0, still part of the graph, where there are none.

    A full mask, or none, gives the unmasked mean to the bit.
    """
    # Sums run in memory order, and ``torch.where`` may lay its result out differently from its input.
    values = values.contiguous()
    if mask is None:
        return values.sum() / max(values.numel(), 1)
    per_pixel = values.shape[2] if values.dim() > mask.dim() else 1
    return zero_outside(values, mask).sum() / (mask.sum() * per_pixel).clamp_min(1)


def weighted_mean(
    values: Float[Tensor, "H W"], mask: Bool[Tensor, "H W"], weights: Float[Tensor, "H W"] | None
) -> Float[Tensor, ""]:
    """Weighted mean over the pixels where the mask is True: sum w v / sum w; 0, still part of the graph, if sum w = 0.

    Weights are not negative; without them it is :func:`masked_mean` to the bit.
    """
    if weights is None:
        return masked_mean(values, mask)
    inside = zero_outside(weights.to(values.dtype), mask)
    total = inside.sum()
    return (zero_outside(values, mask) * inside).sum() / torch.where(total > 0, total, torch.ones_like(total))


def bilinear(image: Float[Tensor, "H W C"], pixels: Float[Tensor, "A B 2"]) -> Float[Tensor, "A B C"]:
    """Sample an image bilinearly at columns and rows, clamped at its edges; pixel centres are at integers + 0.5."""
    size = constant((image.shape[1], image.shape[0]), pixels)
    grid = (2.0 * pixels / size - 1.0).to(image)[None]
    planes = image.permute(2, 0, 1)[None]
    sampled = torch.nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False)
    return sampled[0].permute(1, 2, 0)


def interpolated(
    values: Float[Tensor, "H W"], usable: Bool[Tensor, "H W"], pixels: Float[Tensor, "K 2"]
) -> tuple[Float[Tensor, "K"], Bool[Tensor, "K"]]:
    """Bilinear samples of a map at points, and whether all interpolated pixels are usable.

    Points are columns and rows, pixel centres at integers + 0.5; those outside the map are not usable. Unusable
    pixels may be NaN, and affect no value and no gradient; samples of unusable points mean nothing.
    """
    height, width = values.shape
    size = constant((width, height), pixels)
    inside = ((pixels >= 0) & (pixels <= size)).all(dim=1)
    # Pixel centres at integers from here on; the border is replicated.
    place = torch.minimum((torch.where(inside[:, None], pixels, 0.5) - 0.5).clamp_min(0.0), size - 1)
    corner = torch.minimum(place.floor(), (size - 2).clamp_min(0))
    share = (place - corner).to(values.dtype)
    column, row = corner.long().unbind(1)
    total, counts = values.new_zeros(len(place)), inside
    for down in (0, 1):
        for across in (0, 1):
            weight = (share[:, 0] if across else 1 - share[:, 0]) * (share[:, 1] if down else 1 - share[:, 1])
            index = ((row + down).clamp_max(height - 1), (column + across).clamp_max(width - 1))
            fine = usable[index]
            total = total + weight * torch.where(fine, values[index], 0.0)
            counts = counts & (fine | (weight == 0))
    return total, counts


def pixel_ids(frame: int, pixels: Int[Tensor, "*P"]) -> Int[Tensor, "*P"]:
    """Numbers that no other pixel of the video has, of pixels by row times width plus column, below 2^32."""
    return pixels.to(torch.int64) + (frame << 32)


def fixed_uniform(ids: Int[Tensor, "*P"], seed: int) -> Float[Tensor, "*P"]:
    """A number in [0, 1) for each identifier, the same at every call: splitmix64 of identifier and seed."""
    return (_mixed(ids ^ _mixed(torch.tensor(seed))) >> 11 & (1 << 53) - 1).double() * 2.0**-53


def _mixed(value: Tensor) -> Tensor:
    """The output of splitmix64 in state ``value``; products wrap around."""
    value = value + _GOLDEN
    for shift, factor in zip((30, 27), _MIX, strict=True):
        value = (value ^ _shifted(value, shift)) * factor
    return value ^ _shifted(value, 31)


def _shifted(value: Tensor, bits: int) -> Tensor:
    """Shifted to the right, zeros coming in; torch would repeat the sign."""
    return value >> bits & (1 << 64 - bits) - 1


def point_normals(
    points: Float[Tensor, "P 3"], neighbours: int, at: Float[Tensor, "N 3"] | None = None
) -> Float[Tensor, "N 3"]:
    """Unit normals, of either sign: the direction in which so many points nearest to a position vary least.

    Without positions, at the points themselves, each of which does not count at its own.
    """
    from scipy.spatial import cKDTree

    least = neighbours + (at is None)
    if len(points) < least:
        raise InputError(
            f"{len(points)} initial points for normals from {neighbours} neighbours",
            f"at least {least}",
            "Give the data manager more points, or lower field.normal_neighbours",
        )
    positions, queries = (values.detach().cpu().double().numpy() for values in (points, points if at is None else at))
    tree = cKDTree(positions)
    normals = torch.empty(len(queries), 3, dtype=torch.float64)
    for start in range(0, len(queries), _CHUNK):
        _, nearest = tree.query(queries[start : start + _CHUNK], k=least, workers=-1)
        around = torch.from_numpy(positions[np.asarray(nearest).reshape(-1, least)[:, least - neighbours :]])
        around = around - around.mean(1, keepdim=True)
        _, axes = torch.linalg.eigh(around.mT @ around)  # eigenvalues ascend
        normals[start : start + _CHUNK] = axes[:, :, 0]
    return normals.to(points)


def wall_normals(points: Float[Tensor, "P 3"], at: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Unit normals, of either sign, of the smooth wall that noisy points lie on, at positions.

    Each is that of the nearest five hundredth of the points, and of 20 at least: in a colon's section, of some
    millimetres.
    """
    return point_normals(points, min(len(points), max(_FEWEST, len(points) // _SHARE)), at)


def fit_kernels(*tensors: Tensor) -> bool:
    """True for tensors that kernels compiled by numba can compute with: float32 on the CPU."""
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def fit_triton_kernels(*tensors: Tensor) -> bool:
    """True for tensors that triton's kernels can compute with: float32 on CUDA, where they can be launched."""
    on_device = all(tensor.device.type == "cuda" and tensor.dtype == torch.float32 for tensor in tensors)
    return on_device and what_triton_lacks() is None


def tables(*tensors: Tensor) -> list[npt.NDArray[Any]]:
    """The numbers of CPU tensors as flat arrays for numba, which share the memory of contiguous ones."""
    return [np.asarray(tensor.detach().contiguous()).reshape(-1) for tensor in tensors]


def depth_steps(
    depth: Float[Tensor, "H W"], is_known: Bool[Tensor, "H W"], relative_step: float
) -> Bool[Tensor, "H W"]:
    """Mask of pixels whose 3x3 window holds a depth step: (max - min) / min of its known depths above a threshold.

    Unknown pixels make no step themselves; two known surfaces on either side of one do. The depth is z-depth.
    """
    farthest = _window_max(torch.where(is_known, depth, -torch.inf), 1)
    nearest = -_window_max(torch.where(is_known, -depth, -torch.inf), 1)
    return farthest - nearest > relative_step * nearest


def dilated(marked: Bool[Tensor, "H W"], reach: int) -> Bool[Tensor, "H W"]:
    """The mask dilated by ``reach`` rows and columns."""
    return _window_max(marked.to(torch.float32), reach) > 0


def _window_max(values: Float[Tensor, "H W"], reach: int) -> Float[Tensor, "H W"]:
    """Maximum over the square window around every pixel; pixels outside the image do not count."""
    return torch.nn.functional.max_pool2d(values[None], 2 * reach + 1, stride=1, padding=reach)[0]
