"""Base class and options of the splatting renderers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import pydantic
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import TypeVar

from coliags_plugin.contracts import GaussianField, Renderer
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS, SURFEL_OUTPUTS, RenderOutput, Splats
from coliags_plugin.core.settings import Settings
from coliags_plugin.renderers.checks import check_primitive


class AutoSettings(Settings):
    """Order of preference, and options common to all splatting renderers."""

    prefer: tuple[str, ...] = ("triton", "cpu", "torch")
    """Names of renderers, the most preferred first."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background RGB."""


class SplattingSettings(Settings):
    """Options common to all splatting renderers; the defaults are 3DGS's (docs/methods.md 2.1, 2.2)."""

    eps2d: float = pydantic.Field(default=0.3, gt=0)
    """Low-pass term added to the diagonal of every 2D covariance, square pixels."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background RGB."""


class CutSettings(SplattingSettings):
    """Options of renderers whose alpha and transmittance thresholds are configurable."""

    alpha_max: float = pydantic.Field(default=0.99, gt=0, lt=1)
    """Upper bound of alpha at any pixel."""
    alpha_min: float = pydantic.Field(default=1 / 255, gt=0, lt=1)
    """Contributions of smaller alpha are skipped."""
    transmittance_min: float = pydantic.Field(default=1e-4, ge=0, lt=1)
    """Compositing stops before the Gaussian that would bring the transmittance below this."""
    surfel_filter: float = pydantic.Field(default=0.70710678, gt=0)
    """Standard deviation of the low-pass filter of surfels, pixels."""
    distortion_far: float = pydantic.Field(default=100.0, gt=0)
    """z-depth that the output ``distortion`` maps to 1; the near plane is mapped to 0. Scene units."""

    def distortion_slope(self, near_plane: float) -> float:
        """Factor of -1/z in the depths whose differences ``distortion`` measures, scene units."""
        if self.distortion_far <= near_plane:
            raise InputError(
                f"renderer.distortion_far {self.distortion_far:g} with near_plane {near_plane:g}",
                "a distortion_far beyond the near plane",
            )
        return self.distortion_far * near_plane / (self.distortion_far - near_plane)


#: Settings of a splatting renderer.
SplattingT = TypeVar("SplattingT", bound=SplattingSettings, default=SplattingSettings)


class SplattingRenderer(Renderer[SplattingT, GaussianField]):
    """Base class of renderers that splat a :class:`GaussianField` into whole images."""

    outputs: ClassVar[frozenset[str]] = frozenset(OUTPUTS) - SURFEL_OUTPUTS
    #: Name in messages.
    name: ClassVar[str]

    @classmethod
    def outputs_of(cls, primitive: str) -> frozenset[str]:
        """Surfels have more outputs than 3D Gaussians."""
        return cls.outputs | SURFEL_OUTPUTS if primitive == "surfels" else cls.outputs

    def render(
        self,
        field: GaussianField,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Tensor | None = None,
    ) -> RenderOutput:
        """Draw a view as :class:`Renderer` says; refuses ``pixels``, as whole images are drawn."""
        self._check(field, pixels)
        return self.draw(field.gaussians(camera), camera, wants)

    def render_in_training(
        self,
        field: GaussianField,
        camera: Camera,
        wants: Sequence[str],
        pixels: Tensor | None,
        generator: torch.Generator,
    ) -> RenderOutput:
        """:meth:`render` in a training step, with noise of the field from the generator where there is any."""
        self._check(field, pixels)
        return self.draw(field.gaussians_in_training(camera, generator), camera, wants)

    def check_field(self, field: GaussianField, near_plane: float) -> None:
        """Refuse a near plane beyond ``distortion_far``."""
        if isinstance(self.settings, CutSettings):
            self.settings.distortion_slope(near_plane)

    def _check(self, field: GaussianField, pixels: Tensor | None) -> None:
        """Refuse single pixels, and fields that are not for this renderer."""
        if pixels is not None:
            raise InputError(
                f"the {self.name} renderer was requested to render single pixels",
                "whole images: it splats",
                "Leave pixels out, or choose a renderer of radiance fields",
            )
        check_primitive(field, self.primitives, self.name)

    @abstractmethod
    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Render the Gaussians from the camera."""


@dataclass(frozen=True)
class DrawnView:
    """Composited images of one view.

    ``maps`` are the other outputs, and the accumulated depth if the expected is wanted: [H, W] or [H, W, C].
    """

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    maps: dict[str, Tensor]
    means2d: Float[Tensor, "N 2"]
    radii: Float[Tensor, "N"]

    def output(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Output of a renderer for this view; ``means2d`` then retains its gradient."""
        maps = {}
        for name in wants:
            if name == "depth_expected":
                # 0, and no gradient, where alpha is 0.
                covered = self.alpha > 0
                depth = self.maps["depth_accumulated"] / torch.where(covered, self.alpha, 1.0)
                maps[name] = torch.where(covered, depth, 0.0)
            elif name not in ("rgb", "alpha"):
                maps[name] = self.maps[name]
        if self.means2d.requires_grad:
            self.means2d.retain_grad()
        return RenderOutput(self.rgb, self.alpha, camera, maps, Splats(gaussians, self.means2d, self.radii))


def split_channels(sums: Float[Tensor, "H W F"], features: dict[str, Tensor]) -> dict[str, Tensor]:
    """Composited channels by output; the renderer's own single channels without the last dimension.

    ``features`` are those of the Gaussians by output, in the same order. [N, C] each
    """
    parts = torch.split(sums, [part.shape[1] for part in features.values()], dim=-1)
    return {
        name: part[..., 0] if name in OUTPUTS and part.shape[-1] == 1 else part
        for name, part in zip(features, parts, strict=True)
    }
