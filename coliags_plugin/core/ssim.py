"""Structural similarity (SSIM) as the splatting papers compute it, with masking inside the windows.

An 11x11 Gaussian window of sigma 1.5 with zero padding, C1 = 0.01^2, C2 = 0.03^2, data range 1, per channel
(docs/methods.md 2.4). Away from the border this is Wang et al. 2004, and scikit-image's ``structural_similarity`` with
``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.core.tensors import constant, fit_kernels, masked_mean, tables, zero_outside

SIGMA = 1.5
#: Half width of the window, pixels.
REACH = 5
C1 = 0.01**2
C2 = 0.03**2
#: Shorter rows of an image, in numbers, are left to PyTorch by the kernels.
_SHORTEST_ROW = 16


def ssim(
    rendered: Float[Tensor, "H W C"], truth: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Mean of :func:`ssim_map` over the valid pixels and all channels; 0 where no pixel is valid."""
    return masked_mean(ssim_map(rendered, truth, mask), mask)


def ssim_map(
    rendered: Float[Tensor, "H W C"], truth: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W C"]:
    """Structural similarity of the windows around every pixel of images in [0, 1].

    Differentiable twice; float32 on the CPU by kernels, once and in the rendered image alone.

    With a mask, a window's means, variances and covariance are taken over its valid pixels alone, their weights
    scaled up to the total that the window has without a mask. So an ignored pixel influences neither the value nor
    the gradient of any other; a window without ignored pixels is what it is without a mask, to the bit; and two equal
    images score 1 whatever the mask. (Setting ignored pixels to one common value in both images would do the first,
    but would also put a strong common edge into all windows around them and so raise the score there.) The values at
    the ignored pixels themselves are meaningless: average with :func:`coliags_plugin.core.tensors.masked_mean`.
    """
    if rendered.shape != truth.shape or rendered.dim() != 3:
        raise ValueError(f"SSIM of images of shapes {tuple(rendered.shape)} and {tuple(truth.shape)}: both [H, W, C]")
    a, b = zero_outside(rendered, mask), zero_outside(truth, mask)
    gain = None if mask is None else _coverage_gain(mask, a.dtype)
    if fit_kernels(a, b) and not b.requires_grad and a.shape[1] * a.shape[2] >= _SHORTEST_ROW:
        compared: Tensor = _Compare.apply(a, b, None if gain is None else gain.expand_as(a))  # type: ignore[no-untyped-call]
        return compared
    # Only the sum of the two variances is used, so one blur serves both. The ground truth is blurred separately, which
    # saves the backward pass the blur of a gradient that is not needed.
    mean_a, squares, products = _blur(torch.cat([a, a * a + b * b, a * b], dim=2)).chunk(3, dim=2)
    mean_b = _blur(b)
    if gain is not None:
        mean_a, mean_b, squares, products = mean_a * gain, mean_b * gain, squares * gain, products * gain
    product_of_means = mean_a * mean_b
    squared_means = mean_a * mean_a + mean_b * mean_b
    likeness = (2.0 * product_of_means + C1) * (2.0 * (products - product_of_means) + C2)
    energy = (squared_means + C1) * (squares - squared_means + C2)
    return likeness / energy


def _coverage_gain(mask: Bool[Tensor, "H W"], dtype: torch.dtype) -> Float[Tensor, "H W 1"]:
    """Factor that renormalises each window over its valid pixels; 0 at an ignored pixel. [H, W, 1]"""
    inside = mask[..., None]
    covered, whole = _blur(inside.to(dtype)), _blur(torch.ones_like(inside, dtype=dtype))
    return torch.where(inside, whole, 0.0) / torch.where(inside, covered, 1.0)


def _blur(images: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Gaussian blur with zero padding. [H, W, C]"""
    blurred: Tensor = _Blur.apply(images)  # type: ignore[no-untyped-call]
    return blurred


class _Compare(torch.autograd.Function):
    """The kernels of ``numba_kernels/ssim.py``."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, gain: Tensor | None) -> Tensor:
        from coliags_plugin.core.numba_kernels.ssim import compare
        from coliags_plugin.core.numba_kernels.threads import Crew

        result = torch.empty(a.shape)
        derivatives = torch.empty(3, *a.shape) if ctx.needs_input_grad[0] else torch.empty(0)
        ctx.sizes, ctx.images = (a.shape[1] * a.shape[2], a.shape[2], *tables(_window().float())), tables(a, b)
        factors = torch.empty(0) if gain is None else gain
        constants, *written, ctx.derivatives = tables(torch.tensor([C1, C2]), factors, result, derivatives)
        Crew().run(compare, *ctx.sizes, constants, *ctx.images, *written, ctx.derivatives)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor, None, None]:
        from coliags_plugin.core.numba_kernels.ssim import compare_backward
        from coliags_plugin.core.numba_kernels.threads import Crew

        of_a = torch.empty(given.shape)
        Crew().run(compare_backward, *ctx.sizes, *ctx.images, *tables(given), ctx.derivatives, *tables(of_a))
        return of_a, None, None


class _Blur(torch.autograd.Function):
    """Blur with an analytic backward: with a symmetric window and zero padding it is its own adjoint."""

    @staticmethod
    def forward(ctx: Any, images: Tensor) -> Tensor:
        return _blur_by_opencv(images) if images.device.type == "cpu" else _blur_by_kornia(images)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return _blur(gradient)


def _blur_by_opencv(images: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Blur by OpenCV on the CPU: an eighth of the time of banded matrix products, far less than a convolution's."""
    pixels = images.detach().contiguous().numpy()
    weights = _window().numpy()
    blurred = cv2.sepFilter2D(pixels, -1, weights, weights, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(blurred.reshape(pixels.shape))


def _blur_by_kornia(images: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Blur by kornia's separable filter, on any device."""
    from kornia.filters import filter2d_separable

    weights = constant(tuple(_window().tolist()), images)[None]
    blurred: Tensor = filter2d_separable(images.permute(2, 0, 1)[None], weights, weights, border_type="constant")
    return blurred[0].permute(1, 2, 0)


@lru_cache(maxsize=1)
def _window() -> Float[Tensor, "11"]:
    """The Gaussian window along one axis. [11]"""
    # Kept between calls, so it must not be an inference tensor: those cannot take part in a later backward pass.
    with torch.inference_mode(False):
        weights = torch.exp(-0.5 * ((torch.arange(2 * REACH + 1, dtype=torch.float64) - REACH) / SIGMA) ** 2)
        return weights / weights.sum()
