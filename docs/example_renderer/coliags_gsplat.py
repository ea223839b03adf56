"""Renderer ``gsplat``: 3D Gaussians on CUDA by gsplat 1.5.3 (Apache-2.0), an example of a renderer in another package.

With ``alpha_max`` 0.999, which gsplat does not let choose, it draws what the package's own renderers do, to 2e-5 for
outputs and 5e-4 for gradients, of needles and pancakes 2e-4 and 2e-3. ``depth_median`` it does not have.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians, shortest_axes
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.tensors import constant
from coliags_plugin.renderers.projection import facing
from coliags_plugin.renderers.splatting import (
    SplattingRenderer,
    SplattingSettings,
    output_of,
    split_channels,
)

#: Edge of gsplat's tiles, pixels.
TILE_SIZE = 16


class GsplatRenderer(SplattingRenderer[SplattingSettings]):
    """Renderer of float32 3D Gaussians on CUDA, one projection and one compositing pass for all outputs."""

    Settings = SplattingSettings
    primitives: ClassVar[frozenset[str]] = frozenset({"gaussians3d"})
    devices: ClassVar[frozenset[str]] = frozenset({"cuda"})
    outputs: ClassVar[frozenset[str]] = SplattingRenderer.outputs - {"depth_median"}
    name: ClassVar[str] = "gsplat"

    @classmethod
    def availability(cls) -> Availability:
        """Available where gsplat is installed and a CUDA device is there; its first use may compile for minutes."""
        if importlib.util.find_spec("gsplat") is None:
            return Availability(False, "gsplat is not installed: pip install gsplat")
        if not torch.cuda.is_available():
            return Availability(False, "no CUDA device is available")
        return Availability(True, f"gsplat on {torch.cuda.get_device_name()}")

    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Render the Gaussians; everything but ``radii`` is differentiable, in them and in the pose."""
        self.check_tensors(gaussians)
        self.check_gaussian_outputs(wants, gaussians)
        camera = camera.to(gaussians.means.device, gaussians.means.dtype)
        return output_of(gaussians, camera, wants, *self._drawn(gaussians, camera, wants))

    def _drawn(
        self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]
    ) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Composited images by output, projected centres and radii."""
        if len(gaussians) == 0:  # gsplat divides by their number
            means2d, radii = gaussians.means[:, :2].clone(), gaussians.opacities.detach()
            inputs = (means2d, gaussians.quats_wxyz, gaussians.scales, gaussians.opacities, gaussians.colors)
            nothing = sum(0.0 * value.sum() for value in (*inputs, camera.camera_to_world))  # a graph for backward
            parts = self._parts(gaussians, camera, gaussians.opacities, wants)
            widths = sum(part.shape[1] for part in parts.values())
            sums = nothing + gaussians.means.new_zeros(camera.height, camera.width, widths)
            sums[..., :3] += constant(self.settings.background, sums)
            maps = split_channels(sums, parts)
            return {**maps, "alpha": nothing.expand(camera.height, camera.width)}, means2d, radii
        from gsplat import fully_fused_projection, isect_offset_encode, isect_tiles, rasterize_to_pixels

        # Subtracting the camera's centre before gsplat rotates keeps float32 accurate far from the world's origin.
        view = torch.eye(4, dtype=gaussians.means.dtype, device=gaussians.means.device)
        view[:3, :3] = camera.camera_to_world[:3, :3].T
        size = (camera.width, camera.height)
        shape = (gaussians.means - camera.center, None, gaussians.quats_wxyz, gaussians.scales)
        options = {"eps2d": self.settings.eps2d, "near_plane": camera.near_plane, "opacities": gaussians.opacities}
        projected = fully_fused_projection(*shape, view[None], camera.intrinsics_matrix[None], *size, **options)
        radii, means2d, depths, conics, _ = projected
        # Of what is not drawn gsplat leaves everything but the radii uninitialised.
        visible = (radii[0] > 0).all(-1)
        means2d, depths = torch.where(visible[:, None], means2d[0], 0.0), torch.where(visible, depths[0], 1.0)
        columns, rows = (-(-pixels // TILE_SIZE) for pixels in size)
        _, keys, lists = isect_tiles(means2d[None], radii, depths[None], TILE_SIZE, columns, rows)
        tiles = (isect_offset_encode(keys, 1, columns, rows), lists)
        parts = self._parts(gaussians, camera, depths, wants)
        features = torch.cat(list(parts.values()), dim=-1)
        background = constant(((*self.settings.background, *[0.0] * (features.shape[1] - 3)),), features)
        splats = (means2d[None], conics, features[None], gaussians.opacities[None])
        image, alpha = rasterize_to_pixels(*splats, *size, TILE_SIZE, *tiles, backgrounds=background)
        maps = split_channels(image[0], parts)
        largest = torch.where(visible, radii[0].amax(-1), 0).to(means2d.dtype)
        return {**maps, "alpha": alpha[0, ..., 0]}, means2d, largest

    def _parts(self, gaussians: Gaussians, camera: Camera, depths: Tensor, wants: Sequence[str]) -> dict[str, Tensor]:
        """Channels to composite by output; colour is the first. [N, C] each"""
        parts = {"rgb": gaussians.colors}
        if {"depth_accumulated", "depth_expected"} & {*wants}:
            parts["depth_accumulated"] = depths[:, None]
        if "inverse_depth_accumulated" in wants:
            parts["inverse_depth_accumulated"] = depths.reciprocal()[:, None]
        if "normals" in wants:
            axes = shortest_axes(gaussians.quats_wxyz, gaussians.scales)
            parts["normals"] = facing(axes, gaussians.means - camera.center) @ camera.camera_to_world[:3, :3]
        return parts | {name: gaussians.features[name] for name in wants if name in gaussians.features}


#: For ``COLIAGS_PLUGIN_PATH``, where the package is not installed.
COMPONENTS = {"renderers": {"gsplat": GsplatRenderer}}
