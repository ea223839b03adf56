"""The pipeline as two differentiable functions: Gaussians -> records, records -> images."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.renderers.numba_kernels import layout
from coliags_plugin.renderers.numba_kernels.pipeline import Array, Pipeline


def render(gaussians: layout.Parameters, pose: Tensor, pipeline: Pipeline) -> tuple[Tensor, Tensor, layout.Images]:
    """Render one view; differentiable, once, in all tensors.

    Args:
        gaussians: Float32 tensors on the CPU, checked for shape.
        pose: camera_to_world; its values are those that the pipeline was made with.
        pipeline: A fresh one.

    Returns:
        means2d, which holds its gradient after ``backward``; radii; and the images, None where not wanted.

    Raises:
        UnusableGaussianError: A Gaussian is not finite, has no direction or a negative scale.
        TooManyPairsError: The Gaussians cover too many tiles.
    """
    means2d, records, radii = _Project.apply(*gaussians, pose, pipeline)  # type: ignore[no-untyped-call]
    if means2d.requires_grad:
        means2d.retain_grad()
    images = _Composite.apply(means2d, records, pipeline)  # type: ignore[no-untyped-call]
    return means2d, radii, layout.Images(*images)


class _Project(torch.autograd.Function):
    """Gaussians -> projected centres, records, radii.

    What comes back for ``records`` are sums that ``layout`` describes, not derivatives of its columns: they lead to the
    derivatives of the Gaussians by a shorter way, on which nothing cancels.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        *gaussians, _, pipeline = arguments
        means2d, radii, records = (torch.from_numpy(array) for array in pipeline.project(_flat_gaussians(gaussians)))
        ctx.save_for_backward(*gaussians)
        ctx.pipeline = pipeline
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        return means2d, records, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_means2d: Tensor | None, sums: Tensor | None, of_radii: None) -> tuple[Tensor | None, ...]:
        gaussians = _flat_gaussians(ctx.saved_tensors)
        derivatives, of_pose = ctx.pipeline.project_backward(gaussians, _array(of_means2d), _array(sums))
        means, quats, scales, opacities, colors = (torch.from_numpy(array) for array in derivatives)
        pose = torch.zeros(4, 4)
        pose[:3] = torch.from_numpy(of_pose)
        return means, quats, scales, opacities[:, 0], colors, pose, None


class _Composite(torch.autograd.Function):
    """Projected centres and records -> images. The centres' values are in the records, too."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, records: Tensor, pipeline: Pipeline) -> tuple[Tensor | None, ...]:
        arrays = pipeline.composite()
        images = layout.Images(*(None if array is None else torch.from_numpy(array) for array in arrays))
        ctx.pipeline = pipeline
        ctx.set_materialize_grads(False)
        if images.median is not None:
            ctx.mark_non_differentiable(images.median)
        return tuple(images)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        if all(gradient is None for gradient in given):
            return None, None, None
        of_means2d, sums = ctx.pipeline.composite_backward(layout.Images(*map(_array, given)))
        return torch.from_numpy(of_means2d), torch.from_numpy(sums), None


def _array(tensor: Tensor | None) -> Array | None:
    return None if tensor is None else tensor.detach().contiguous().numpy()


def _flat_gaussians(tensors: Any) -> layout.Parameters:
    arrays: list[Array] = [np.asarray(tensor.detach().contiguous()).reshape(-1) for tensor in tensors]
    return layout.Parameters(*arrays)
