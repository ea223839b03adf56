"""CUDA renderer by gsplat (Apache-2.0), with the outputs of the torch reference.

Differences from the reference are listed in ``docs/rendering.md``, section "The gsplat backend".
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.rotations import shortest_axes
from coliags_plugin.core.transfers import constant
from coliags_plugin.renderers import gsplat_library
from coliags_plugin.renderers.checks import check_device, check_float32, check_gaussian_outputs, is_surfels
from coliags_plugin.renderers.projection import facing
from coliags_plugin.renderers.splatting import DrawnView, SplattingRenderer, SplattingSettings, split_channels
from coliags_plugin.renderers.torch_renderer import TorchRendererSettings, render_gaussians

#: Edge of gsplat's tiles, pixels: the only size it is tested with.
_TILE_SIZE = 16


class GsplatRendererSettings(SplattingSettings):
    """Options of :class:`GsplatRenderer`. gsplat's other constants are fixed (docs/rendering.md).

    Gaussians exactly at z = ``near_plane`` are drawn too.
    """


class GsplatRenderer(SplattingRenderer[GsplatRendererSettings]):
    """Renderer of 3D Gaussians on CUDA, in float32. See ``docs/rendering.md``."""

    Settings = GsplatRendererSettings
    primitives: ClassVar[frozenset[str]] = frozenset({"gaussians3d"})
    devices: ClassVar[frozenset[str]] = frozenset({"cuda"})
    name: ClassVar[str] = "gsplat"

    @classmethod
    def availability(cls) -> Availability:
        """Available where gsplat's kernels work on a CUDA device, tested once per process."""
        return gsplat_library.availability()

    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """See :func:`render_with_gsplat`; refuses Gaussians that are not on a CUDA device."""
        check_device(gaussians, self.devices, self.name)
        return render_with_gsplat(gaussians, camera, wants, self.settings)


def render_with_gsplat(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str] = ("rgb", "alpha"),
    settings: GsplatRendererSettings | None = None,
) -> RenderOutput:
    """Render float32 3D Gaussians on a CUDA device from a camera.

    Everything but ``depth_median`` and ``radii`` is differentiable, once, in the Gaussians and in
    ``camera.camera_to_world``; ``means2d.grad`` is set by ``backward``.

    Raises:
        InputError: An output is unknown, the Gaussians are surfels or not float32, or gsplat cannot be used here.
    """
    settings = settings or GsplatRendererSettings()
    check_gaussian_outputs(wants, gaussians)
    check_float32(gaussians, "gsplat")
    if is_surfels(gaussians):
        raise InputError("surfels for the gsplat renderer", "3D Gaussians", "Choose renderer 'torch'")
    needs = {"depth_accumulated" if name == "depth_expected" else name for name in wants} - {"rgb", "alpha"}
    camera = camera.to(gaussians.means.device, gaussians.means.dtype)
    # gsplat 1.5.3 divides by the number of Gaussians, which crashes the process if there are none.
    draw = _draw_nothing if len(gaussians) == 0 else _draw_gaussians
    return draw(gaussians, camera, needs, settings).output(gaussians, camera, wants)


def _draw_gaussians(
    gaussians: Gaussians, camera: Camera, needs: set[str], settings: GsplatRendererSettings
) -> DrawnView:
    """Render 3D Gaussians in one projection and one compositing pass for all outputs."""
    library = gsplat_library.load()
    sight, view, intrinsics = _view(gaussians, camera)
    size = (camera.width, camera.height)
    radii, means2d, depths, conics, _ = library.fully_fused_projection(
        sight,
        None,
        gaussians.quats_wxyz,
        gaussians.scales,
        view[None],
        intrinsics[None],
        *size,
        eps2d=settings.eps2d,
        near_plane=camera.near_plane,
        opacities=gaussians.opacities,
    )
    # Of what is not drawn gsplat leaves everything but the radii uninitialised.
    visible = (radii[0] > 0).all(-1)
    means2d = torch.where(visible[:, None], means2d[0], 0.0)
    depths = torch.where(visible, depths[0], 1.0)
    parts = {"rgb": gaussians.colors}
    if "depth_accumulated" in needs:
        parts["depth_accumulated"] = depths[:, None]
    if "inverse_depth_accumulated" in needs:
        parts["inverse_depth_accumulated"] = depths.reciprocal()[:, None]
    if "normals" in needs:
        parts["normals"] = _facing_normals(gaussians, sight, camera)
    parts |= {name: gaussians.features[name] for name in gaussians.features if name in needs}
    features = torch.cat(list(parts.values()), dim=-1)
    backgrounds = constant(((*settings.background, *[0.0] * (features.shape[-1] - 3)),), features)
    image, alpha = library.rasterize_to_pixels(
        means2d[None],
        conics,
        features[None],
        gaussians.opacities[None],
        *size,
        _TILE_SIZE,
        *_tiles(library, means2d, radii, depths, size),
        backgrounds=backgrounds if any(settings.background) else None,
    )
    maps = split_channels(image[0], parts)
    if "depth_median" in needs:
        # By the torch reference, as gsplat has none for 3D Gaussians.
        with torch.no_grad():
            options = TorchRendererSettings(eps2d=settings.eps2d)
            maps["depth_median"] = render_gaussians(gaussians, camera, ("depth_median",), options)["depth_median"]
    largest = torch.where(visible, radii[0].amax(-1), 0).to(means2d.dtype)
    return DrawnView(maps["rgb"], alpha[0, ..., 0], maps, means2d, largest)


def _draw_nothing(gaussians: Gaussians, camera: Camera, needs: set[str], settings: GsplatRendererSettings) -> DrawnView:
    """Render no Gaussians: the background, connected to the graph so that ``backward`` works."""
    means2d = gaussians.means[:, :2].clone()
    others = (gaussians.quats_wxyz, gaussians.scales, gaussians.opacities, gaussians.colors, camera.camera_to_world)
    zero = 0.0 * torch.stack([value.sum() for value in (means2d, *others)]).sum()
    alpha = zero.expand(camera.height, camera.width)
    widths = {"normals": 3, **{name: values.shape[1] for name, values in gaussians.features.items()}}
    maps = {name: alpha[..., None].expand(-1, -1, widths[name]) if name in widths else alpha for name in needs}
    if "depth_median" in maps:
        maps["depth_median"] = alpha.detach()
    rgb = alpha[..., None] + constant(settings.background, alpha)
    return DrawnView(rgb, alpha, maps, means2d, gaussians.opacities.detach())


def _view(
    gaussians: Gaussians, camera: Camera
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "4 4"], Float[Tensor, "3 3"]]:
    """Centres relative to the camera's in world axes, the rotation into camera axes, and K.

    Subtracting the camera's centre before gsplat rotates keeps float32 and the pose gradient accurate far from the
    world's origin.
    """
    view = torch.eye(4, dtype=gaussians.means.dtype, device=gaussians.means.device)
    view[:3, :3] = camera.camera_to_world[:3, :3].T
    return gaussians.means - camera.center, view, camera.intrinsics_matrix


def _tiles(
    library: ModuleType, centers: Tensor, radii: Tensor, depths: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Start of each tile's list, and Gaussian indices by tile, front to back. [1, rows, columns], [M]"""
    columns, rows = (-(-pixels // _TILE_SIZE) for pixels in size)
    _, keys, lists = library.isect_tiles(centers[None], radii, depths[None], _TILE_SIZE, columns, rows)
    return library.isect_offset_encode(keys, 1, columns, rows), lists


def _facing_normals(gaussians: Gaussians, sight: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, "N 3"]:
    """Shortest axis of each Gaussian in camera axes, oriented towards the camera. [N, 3]"""
    normals = facing(shortest_axes(gaussians.quats_wxyz, gaussians.scales), sight)
    return normals @ camera.camera_to_world[:3, :3]
