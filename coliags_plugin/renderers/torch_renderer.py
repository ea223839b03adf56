"""Gaussian splatting in plain PyTorch, the reference that all other backends are tested against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import pydantic

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.renderers.compositing import composite_gaussians
from coliags_plugin.renderers.splatting import CutSettings, SplattingRenderer
from coliags_plugin.renderers.stages import Compositors, draw_view
from coliags_plugin.renderers.surfel_compositing import composite_surfels
from coliags_plugin.renderers.tiles import TileGrid

_COMPOSITORS = Compositors(composite_gaussians, composite_surfels)


class TorchRendererSettings(CutSettings):
    """Options of :class:`TorchRenderer`."""

    tile_size: int = pydantic.Field(default=8, ge=1)
    """Edge of a tile, pixels. Changes the speed, and the result by rounding only."""


class TorchRenderer(SplattingRenderer[TorchRendererSettings]):
    """Reference renderer of 3D Gaussians and surfels, on any device, in float32 or float64: ``docs/rendering.md``."""

    Settings = TorchRendererSettings
    primitives: ClassVar[frozenset[str]] = frozenset({"gaussians3d", "surfels"})
    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})
    name: ClassVar[str] = "torch"

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
    """Render 3D Gaussians, or surfels where they have two scales, from a camera, in their dtype and on their device.

    Everything but ``radii`` and, of 3D Gaussians, ``depth_median`` is differentiable, once, in the Gaussians and in
    ``camera.camera_to_world``; ``means2d.grad`` is set by ``backward``.

    Raises:
        InputError: An output is unknown or not of these Gaussians, or they have neither two nor three scales.
    """
    settings = settings or TorchRendererSettings()
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    return draw_view(gaussians, camera, wants, settings, grid, _COMPOSITORS)
