"""Volume rendering of radiance fields at evenly spaced depths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor
from typing_extensions import Self

from coliags_plugin.contracts import Availability, RadianceField, Renderer
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.render_output import OUTPUTS, SURFEL_OUTPUTS, RenderOutput, concatenate_pixels
from coliags_plugin.core.settings import Settings
from coliags_plugin.renderers.checks import check_outputs, check_primitive

#: Every output of the splatting renderers that has a meaning without surfaces.
_OUTPUTS = frozenset(OUTPUTS) - SURFEL_OUTPUTS - {"normals"}


class VolumeRendererSettings(Settings):
    """Options of :class:`VolumeRenderer`."""

    near_plane: float = Field(default=0.2, gt=0)
    """z-depth of the start of the first interval, scene units."""
    far_plane: float = Field(default=100.0, gt=0)
    """z-depth of the end of the last interval, scene units."""
    samples: int = Field(default=128, ge=2)
    """Intervals per ray; the field is evaluated at their midpoints."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background RGB."""
    rays_at_once: int = Field(default=8192, ge=1)
    """Rays per batch when rendering whole images; bounds memory."""

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if self.far_plane <= self.near_plane:
            raise ValueError(f"far_plane {self.far_plane} does not lie beyond near_plane {self.near_plane}")
        return self


class VolumeRenderer(Renderer):
    """Volume renderer of radiance fields, for whole images or selected pixels."""

    Settings: ClassVar[type[Settings]] = VolumeRendererSettings
    primitives: ClassVar[frozenset[str]] = frozenset({"radiance"})
    outputs: ClassVar[frozenset[str]] = _OUTPUTS
    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})
    renders_pixels: ClassVar[bool] = True

    settings: VolumeRendererSettings

    @classmethod
    def availability(cls) -> Availability:
        """Always available: PyTorch only."""
        return Availability(True, "plain PyTorch, runs wherever PyTorch does")

    def render(
        self,
        field: RadianceField,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view, or some of its pixels.

        Args:
            field: A radiance field.
            camera: Camera of the view.
            wants: Names from :data:`coliags_plugin.core.render_output.OUTPUTS`, normals and distortion excepted;
                rgb and alpha are always included. Depths are z-depths.
            pixels: Columns and rows of the only pixels to render. [P, 2]

        Raises:
            InputError: The field is of another primitive, or an output is not delivered.
        """
        check_primitive(field, self.primitives, "volume")
        check_outputs(wants, sorted(self.outputs))
        like: Any = next(field.parameters())
        camera = camera.to(like.device, like.dtype)
        if pixels is not None:
            return self._march(field, camera, camera.rays_at(pixels), wants)
        rays = camera.rays().flatten(0, 1)
        split: Any = torch.split(rays, self.settings.rays_at_once)
        parts = [self._march(field, camera, part, wants) for part in split]
        whole = concatenate_pixels(parts)
        shape = (camera.height, camera.width)
        maps = {name: value.view(shape) for name, value in whole.maps.items()}
        return RenderOutput(whole.rgb.view(*shape, 3), whole.alpha.view(shape), camera, maps)

    def _march(
        self, field: RadianceField, camera: Camera, rays: Float[Tensor, "P 3"], wants: Sequence[str]
    ) -> RenderOutput:
        """Composite along rays normalised to z = 1."""
        options = self.settings
        ends = (options.near_plane, options.far_plane)
        edges = torch.linspace(*ends, options.samples + 1, dtype=rays.dtype, device=rays.device)
        depths = 0.5 * (edges[1:] + edges[:-1])
        lengths = rays.norm(dim=-1, keepdim=True)
        samples = field.query(camera.center + depths[:, None] * rays[:, None], rays / lengths, camera)
        absorbed = (samples.density * (edges[1:] - edges[:-1]) * lengths).cumsum(1)
        transmittance = torch.exp(-torch.cat([torch.zeros_like(lengths), absorbed], dim=1))
        weights = transmittance[:, :-1] - transmittance[:, 1:]
        alpha = 1.0 - transmittance[:, -1:]
        background = rays.new_tensor(options.background)
        rgb = (weights[..., None] * samples.rgb).sum(1) + (1.0 - alpha) * background
        maps = {
            name: _depth_map(name, weights, depths, transmittance) for name in wants if name not in ("rgb", "alpha")
        }
        return RenderOutput(rgb[:, None], alpha, camera, maps)


def _depth_map(
    name: str, weights: Float[Tensor, "P S"], depths: Float[Tensor, "S"], transmittance: Float[Tensor, "P S+1"]
) -> Float[Tensor, "P 1"]:
    """A z-depth output by name. [P, 1]"""
    if name == "inverse_depth_accumulated":
        return (weights / depths).sum(1, keepdim=True)
    if name == "depth_median":
        reached = transmittance[:, 1:] <= 0.5
        first = reached.to(torch.int8).argmax(1)
        return torch.where(reached.any(1), depths[first], 0.0).detach()[:, None]
    accumulated = (weights * depths).sum(1, keepdim=True)
    if name == "depth_accumulated":
        return accumulated
    alpha = weights.sum(1, keepdim=True)
    return torch.where(alpha > 0, accumulated / torch.where(alpha > 0, alpha, 1.0), 0.0)
