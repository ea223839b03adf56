"""Renderer of triton kernels, with the outputs of the torch reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.libraries import what_triton_lacks
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.renderers.splatting import CutSettings, SplattingRenderer
from coliags_plugin.renderers.stages import Stages, draw_view
from coliags_plugin.renderers.tiles import TileGrid


class TritonRenderer(SplattingRenderer[CutSettings]):
    """Renderer of float32 3D Gaussians and surfels on CUDA: ``docs/rendering.md``, section "The triton backend"."""

    devices: ClassVar[frozenset[str]] = frozenset({"cuda"})
    name: ClassVar[str] = "triton"

    @classmethod
    def availability(cls) -> Availability:
        """Available where triton can launch kernels and a CUDA device is there."""
        if (lack := what_triton_lacks()) is not None:
            return Availability(False, lack)
        if not torch.cuda.is_available():
            return Availability(False, "no CUDA device is available")
        return Availability(True, f"triton kernels on {torch.cuda.get_device_name()}")

    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Draw Gaussians, on their device."""
        self.check_gaussian_outputs(wants, gaussians)
        self.check_tensors(gaussians)
        from coliags_plugin.renderers.triton_kernels import compositing, placing, sweeps

        grid = TileGrid(camera.width, camera.height, sweeps.TILE_SIZE)
        stages = Stages(
            placing.place_gaussians,
            compositing.composite_gaussians,
            placing.place_surfels,
            compositing.composite_surfels,
        )
        return draw_view(gaussians, camera, wants, self.settings, grid, stages)
