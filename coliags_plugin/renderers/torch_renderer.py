"""Gaussian splatting in plain PyTorch, the reference that all other backends are tested against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import pydantic
import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput, Splats
from coliags_plugin.renderers.checks import check_gaussian_outputs
from coliags_plugin.renderers.compositing import Cuts, composite, log_alpha_polynomials, median_depths, monomials
from coliags_plugin.renderers.projection import ProjectedGaussians, facing_normals, project_gaussians
from coliags_plugin.renderers.splatting import CutSettings, SplattingRenderer
from coliags_plugin.renderers.tiles import TileGrid, bin_gaussians, gaussian_extents

#: Per-Gaussian quantity composited for each output beyond rgb and alpha. The median depth is not a weighted sum.
_SUMMED = {
    "depth_accumulated": "depth",
    "depth_expected": "depth",
    "inverse_depth_accumulated": "inverse_depth",
    "normals": "normal",
}


class TorchRendererSettings(CutSettings):
    """Options of :class:`TorchRenderer`."""

    tile_size: int = pydantic.Field(default=8, ge=1)
    """Edge of a tile, pixels. Changes the speed, and the result by rounding only."""


class TorchRenderer(SplattingRenderer):
    """Reference renderer of 3D Gaussians, on any device, in float32 or float64. See ``docs/rendering.md``."""

    Settings = TorchRendererSettings
    primitives: ClassVar[frozenset[str]] = frozenset({"gaussians3d"})
    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})
    name: ClassVar[str] = "torch"

    settings: TorchRendererSettings

    @classmethod
    def availability(cls) -> Availability:
        """Always available: PyTorch only."""
        return Availability(True, "plain PyTorch, runs wherever PyTorch does")

    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """See :func:`render_gaussians`."""
        return render_gaussians(gaussians, camera, wants, self.settings)


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str] = ("rgb", "alpha"),
    settings: TorchRendererSettings | None = None,
) -> RenderOutput:
    """Render 3D Gaussians from a camera.

    Everything but ``depth_median`` and ``radii`` is differentiable, once, in the Gaussians and in
    ``camera.camera_to_world``; ``means2d.grad`` is set by ``backward``.

    Args:
        gaussians: 3D Gaussians, all of one dtype (float32 or float64) on one device. The result is of that dtype.
        camera: Camera of the view; its pose is cast to the Gaussians' dtype and device.
        wants: Names from :data:`coliags_plugin.core.render_output.OUTPUTS`; rgb and alpha are always included.
        settings: Defaults if None.

    Raises:
        InputError: An output is unknown or the Gaussians are surfels.
    """
    settings = settings or TorchRendererSettings()
    check_gaussian_outputs(wants, gaussians)
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    cuts = Cuts(settings.alpha_max, settings.alpha_min, settings.transmittance_min)
    projected = project_gaussians(gaussians, camera, settings.near_plane, settings.eps2d)
    if projected.means2d.requires_grad:
        projected.means2d.retain_grad()
    extents = gaussian_extents(projected, gaussians.opacities, grid, settings.alpha_min)
    pairs = bin_gaussians(projected, extents, grid)

    # One table and one lookup: the gradient of a lookup is the most expensive step outside compositing.
    opacities = torch.where(extents.drawn, gaussians.opacities, 1.0)
    features, columns = _features(gaussians, projected, wants)
    table = torch.cat([projected.means2d, projected.whitenings, opacities.log()[:, None], features], dim=-1)
    of_pairs = table.index_select(0, pairs.gaussian)
    offsets = grid.centers(pairs.tile, table.dtype) - of_pairs[:, :2]
    polynomials = log_alpha_polynomials(of_pairs[:, 5], of_pairs[:, 2:5], offsets)
    pixels = monomials(grid.offsets(table))
    sums = grid.to_image(composite(polynomials, of_pairs[:, 6:], pairs.starts, pixels, cuts))

    alpha = sums[..., 3]
    rgb = sums[..., :3] + (1 - alpha)[..., None] * sums.new_tensor(settings.background)
    maps = {}
    for name in wants:
        if name == "depth_median":
            medians = median_depths(polynomials, projected.depths.detach()[pairs.gaussian], pairs.starts, pixels, cuts)
            maps[name] = grid.to_image(medians[:, None])[..., 0]
        elif name in _SUMMED:
            summed = sums[..., columns[_SUMMED[name]]]
            maps[name] = _expected(summed, alpha) if name == "depth_expected" else summed
        elif name in gaussians.features:
            maps[name] = sums[..., columns[name]]
    radii = torch.where(extents.drawn, extents.halves.amax(-1).ceil(), 0.0)
    return RenderOutput(rgb, alpha, camera, maps, Splats(gaussians, projected.means2d, radii))


def _features(
    gaussians: Gaussians, projected: ProjectedGaussians, wants: Sequence[str]
) -> tuple[Float[Tensor, "N F"], dict[str, int | slice]]:
    """Channels to composite and their columns: colour, 1 (its sum is alpha), then what the outputs need."""
    parts = [gaussians.colors, torch.ones_like(projected.depths)[:, None]]
    columns: dict[str, int | slice] = {}
    width = 4
    needed = {_SUMMED[name] for name in wants if name in _SUMMED}
    if "depth" in needed:
        parts.append(projected.depths[:, None])
        columns["depth"], width = width, width + 1
    if "inverse_depth" in needed:
        parts.append(projected.depths.reciprocal()[:, None])
        columns["inverse_depth"], width = width, width + 1
    if "normal" in needed:
        parts.append(facing_normals(projected, gaussians.scales))
        columns["normal"], width = slice(width, width + 3), width + 3
    for name in wants:
        if name in gaussians.features:
            feature = gaussians.features[name]
            parts.append(feature)
            columns[name], width = slice(width, width + feature.shape[1]), width + feature.shape[1]
    return torch.cat(parts, dim=-1), columns


def _expected(depth_accumulated: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Expected depth; 0, and no gradient, where alpha is 0. [H, W]"""
    covered = alpha > 0
    return torch.where(covered, depth_accumulated / torch.where(covered, alpha, 1.0), 0.0)
