"""Autograd functions of the pipeline: Gaussians -> projections -> images and feature images.

Between them goes, beside the projected centres, a tensor of links, whose content does not matter: the gradients it
receives are the sums that the layouts describe, from which the derivatives of the Gaussians follow more directly and with
less cancellation than from those of the projections.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from coliags_plugin.core.numba_kernels.compilation import Array
from coliags_plugin.core.tensors import tables
from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.pipeline import Pipeline


def render(
    gaussians: Iterable[Tensor], features: Sequence[Tensor], pose: Tensor, pipeline: Pipeline
) -> tuple[Tensor, Tensor, dict[str, Tensor], list[Tensor]]:
    """Render one view on a new pipeline; differentiable, once, in all tensors.

    ``gaussians`` are float32 tensors on the CPU, checked for shape, in the order of ``layout.Parameters``; ``features`` are
    further channels to composite, [N, C] each; ``pose`` is the camera_to_world that the pipeline was made with.

    Returns:
        means2d, which holds its gradient after ``backward``; radii; the images by the names of ``layout.Images``, None where
        not wanted; and the features' images, [H, W, C] each.

    Raises:
        UnusableGaussianError: A Gaussian is not finite, has no direction or a negative scale.
        TooManyPairsError: The Gaussians cover too many tiles.
    """
    means2d, links, radii = _Project.apply(*gaussians, pose, pipeline)  # type: ignore[no-untyped-call]
    if means2d.requires_grad:
        means2d.retain_grad()
    images = _CompositeImages.apply(means2d, links, pipeline)  # type: ignore[no-untyped-call]
    channels: list[Tensor] = []
    if features:
        drawn = _CompositeFeatures.apply(means2d, links, torch.cat(list(features), dim=1), pipeline)  # type: ignore[no-untyped-call]
        channels = list(torch.split(drawn, [feature.shape[1] for feature in features], dim=-1))
    return means2d, radii, dict(zip(layout.Images._fields, images, strict=True)), channels


class _Project(torch.autograd.Function):
    """Gaussians -> projected centres, links, radii."""

    @staticmethod
    def forward(ctx: FunctionCtx, *arguments: Tensor | Pipeline) -> tuple[Tensor, Tensor, Tensor]:
        *gaussians, _, pipeline = arguments
        means2d, radii, links = (torch.from_numpy(array) for array in pipeline.project(_flat_gaussians(gaussians)))
        ctx.save_for_backward(*gaussians)
        ctx.pipeline = pipeline
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        return means2d, links, radii

    @staticmethod
    @once_differentiable
    def backward(
        ctx: FunctionCtx, of_means2d: Tensor | None, sums: Tensor | None, of_radii: None
    ) -> tuple[Tensor | None, ...]:
        gaussians = _flat_gaussians(ctx.saved_tensors)
        derivatives, of_pose = ctx.pipeline.project_backward(gaussians, _array(of_means2d), _array(sums))
        means, quats, scales, opacities, colors = (torch.from_numpy(array) for array in derivatives)
        pose = torch.zeros(4, 4)
        pose[:3] = torch.from_numpy(of_pose)
        return means, quats, scales, opacities[:, 0], colors, pose, None


class _CompositeImages(torch.autograd.Function):
    """Projected centres and links -> images."""

    @staticmethod
    def forward(ctx: FunctionCtx, means2d: Tensor, links: Tensor, pipeline: Pipeline) -> tuple[Tensor | None, ...]:
        arrays = pipeline.composite()
        images = layout.Images(*(None if array is None else torch.from_numpy(array) for array in arrays))
        ctx.pipeline = pipeline
        ctx.set_materialize_grads(False)
        constant = [getattr(images, name) for name in pipeline.constant_images]
        ctx.mark_non_differentiable(*(image for image in constant if image is not None))
        return tuple(images)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, *of_images: Tensor | None) -> tuple[Tensor | None, ...]:
        if all(gradient is None for gradient in of_images):
            return None, None, None
        of_means2d, sums = ctx.pipeline.composite_backward(layout.Images(*map(_array, of_images)))
        return torch.from_numpy(of_means2d), torch.from_numpy(sums), None


class _CompositeFeatures(torch.autograd.Function):
    """Projected centres, links and features -> the features' images, after :class:`_CompositeImages`."""

    @staticmethod
    def forward(ctx: FunctionCtx, means2d: Tensor, links: Tensor, features: Tensor, pipeline: Pipeline) -> Tensor:
        ctx.save_for_backward(features)
        ctx.pipeline = pipeline
        return torch.from_numpy(pipeline.composite_features(np.asarray(features.detach().contiguous())))

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, of_images: Tensor) -> tuple[Tensor | None, ...]:
        (features,) = ctx.saved_tensors
        of_means2d, sums, of_features = ctx.pipeline.composite_features_backward(
            np.asarray(features.detach().contiguous()), np.asarray(of_images.contiguous())
        )
        return torch.from_numpy(of_means2d), torch.from_numpy(sums), torch.from_numpy(of_features), None


def _array(tensor: Tensor | None) -> Array | None:
    return None if tensor is None else tensor.detach().contiguous().numpy()


def _flat_gaussians(tensors: Iterable[Tensor]) -> layout.Parameters:
    return layout.Parameters(*tables(*tensors))
