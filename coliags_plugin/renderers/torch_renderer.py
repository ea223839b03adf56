"""Gaussian splatting in plain PyTorch: the written definition every other backend is tested against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import pydantic
import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Availability, Field, Renderer
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.gaussians import OUTPUTS, Gaussians, RenderOutput
from coliags_plugin.core.settings import Settings
from coliags_plugin.renderers.compositing import Cuts, composite, log_alpha_polynomials, median_depths, monomials
from coliags_plugin.renderers.projection import ProjectedGaussians, facing_normals, project_gaussians
from coliags_plugin.renderers.tiles import TileGrid, bin_gaussians, gaussian_extents

#: What each output beyond rgb and alpha is composited from. The median depth is no weighted sum.
_SUMMED = {
    "depth_accumulated": "depth",
    "depth_expected": "depth",
    "inverse_depth_accumulated": "inverse_depth",
    "normals": "normal",
}


class TorchRendererSettings(Settings):
    """Options of :class:`TorchRenderer`. The defaults are the lineage's constants (docs/methods.md 2.1, 2.2)."""

    near: float = pydantic.Field(default=0.2, ge=0)
    """Gaussians with a centre at z <= near are not drawn. Scene units."""
    low_pass: float = pydantic.Field(default=0.3, gt=0)
    """Added to the diagonal of every 2D covariance, so that nothing is thinner than a pixel. Square pixels."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB behind everything."""
    tile_size: int = pydantic.Field(default=8, ge=1)
    """Edge of a tile, pixels. Changes the speed, and the result by rounding only."""
    alpha_max: float = pydantic.Field(default=0.99, gt=0, lt=1)
    """No Gaussian is more opaque than this at any pixel."""
    alpha_min: float = pydantic.Field(default=1 / 255, gt=0, lt=1)
    """Fainter contributions are skipped."""
    transmittance_min: float = pydantic.Field(default=1e-4, ge=0, lt=1)
    """Compositing stops before the Gaussian that would leave less light than this."""


class TorchRenderer(Renderer):
    """Splats 3D Gaussians on whatever device, and in whatever precision, they come. See ``docs/rendering.md``."""

    Settings = TorchRendererSettings
    primitives: ClassVar[frozenset[str]] = frozenset({"gaussians3d"})
    outputs: ClassVar[frozenset[str]] = frozenset(OUTPUTS)
    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})

    settings: TorchRendererSettings

    @classmethod
    def availability(cls) -> Availability:
        """Always: it needs nothing but PyTorch."""
        return Availability(True, "plain PyTorch, runs wherever PyTorch does")

    def render(
        self,
        field: Field,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view.

        Args:
            field: A field of 3D Gaussians.
            camera: Where from.
            wants: Names from :data:`coliags_plugin.core.gaussians.OUTPUTS`; rgb and alpha always come.
            pixels: Must be None: a splatting renderer draws whole images.

        Raises:
            InputError: ``pixels`` is given, an output is unknown, or the field holds no 3D Gaussians.
        """
        if pixels is not None:
            raise InputError(
                "the torch renderer was asked for single pixels",
                "whole images: it splats",
                "Leave pixels out, or choose a renderer of radiance fields",
            )
        if field.primitive not in self.primitives:
            raise InputError(
                f"a field of '{field.primitive}' for the torch renderer",
                f"one of {', '.join(sorted(self.primitives))}",
                "Choose another renderer or another field",
            )
        return render_gaussians(field.gaussians(camera), camera, wants, self.settings)


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str] = ("rgb", "alpha"),
    settings: TorchRendererSettings | None = None,
) -> RenderOutput:
    """Render Gaussians as the camera sees them.

    Everything but ``depth_median`` and ``radii`` is differentiable, once, in the Gaussians and in
    ``camera.camera_to_world``; ``means2d.grad`` is there after ``backward``.

    Args:
        gaussians: 3D Gaussians, all of one dtype (float32 or float64) on one device. The result is of that dtype.
        camera: Where from; its pose is cast to the Gaussians' dtype and device.
        wants: Names from :data:`coliags_plugin.core.gaussians.OUTPUTS`; rgb and alpha always come.
        settings: The defaults where None.

    Raises:
        InputError: An output is unknown or the Gaussians are surfels.
    """
    settings = settings or TorchRendererSettings()
    for name in wants:
        if name not in OUTPUTS:
            raise InputError(
                f"no renderer output '{name}'", f"some of {', '.join(OUTPUTS)}", did_you_mean(name, OUTPUTS)
            )
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    cuts = Cuts(settings.alpha_max, settings.alpha_min, settings.transmittance_min)
    projected = project_gaussians(gaussians, camera, settings.near, settings.low_pass)
    if projected.means2d.requires_grad:
        projected.means2d.retain_grad()
    extents = gaussian_extents(projected, gaussians.opacities, grid, settings.alpha_min)
    pairs = bin_gaussians(projected, extents, grid)

    # One table and one lookup: the gradient of a lookup is the dearest step outside compositing.
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
    radii = torch.where(extents.drawn, extents.halves.amax(-1).ceil(), 0.0)
    return RenderOutput(rgb, alpha, projected.means2d, radii, gaussians, maps)


def _features(
    gaussians: Gaussians, projected: ProjectedGaussians, wants: Sequence[str]
) -> tuple[Float[Tensor, "N F"], dict[str, int | slice]]:
    """What to composite, and in which columns: colour, 1 (its sum is alpha), then what the outputs asked for need."""
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
        columns["normal"] = slice(width, width + 3)
    return torch.cat(parts, dim=-1), columns


def _expected(depth_accumulated: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Mean depth of what is drawn; 0, and no gradient, where nothing is."""
    covered = alpha > 0
    return torch.where(covered, depth_accumulated / torch.where(covered, alpha, 1.0), 0.0)
