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
from coliags_plugin.renderers.splatting import CutSettings, SplattingRenderer, check_device, check_float32
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
        """Draw Gaussians by :func:`render_gaussians`; refuses Gaussians that are not on a CUDA device."""
        check_device(gaussians, self.devices, self.name)
        return render_gaussians(gaussians, camera, wants, self.settings)


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str] = ("rgb", "alpha"),
    settings: CutSettings | None = None,
) -> RenderOutput:
    """Render float32 3D Gaussians, or surfels where they have two scales, from a camera, on their device.

    Everything but ``radii`` and, of 3D Gaussians, ``depth_median`` is differentiable, once, in the Gaussians and in
    ``camera.camera_to_world``; ``means2d.grad`` is set by ``backward``. CPU tensors need triton's interpreter
    (``TRITON_INTERPRET=1``).

    Raises:
        InputError: An output is unknown or not of these Gaussians, or these are not float32.
    """
    check_float32(gaussians, "triton")
    from coliags_plugin.renderers.triton_kernels import compositing, placing, sweeps

    settings = settings or CutSettings()
    grid = TileGrid(camera.width, camera.height, sweeps.TILE_SIZE)
    stages = Stages(
        placing.place_gaussians, compositing.composite_gaussians, placing.place_surfels, compositing.composite_surfels
    )
    return draw_view(gaussians, camera, wants, settings, grid, stages)
