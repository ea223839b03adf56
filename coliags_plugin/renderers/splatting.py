"""What every splatting renderer shares: options, checks, and whole images only."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import pydantic
from torch import Tensor

from coliags_plugin.contracts import GaussianField, Renderer
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS, RenderOutput
from coliags_plugin.core.settings import Settings


class SplattingSettings(Settings):
    """Options of every splatting renderer. The defaults are the lineage's constants (docs/methods.md 2.1, 2.2)."""

    near_plane: float = pydantic.Field(default=0.2, ge=0)
    """Gaussians with a centre at z <= near_plane are not drawn. Scene units."""
    eps2d: float = pydantic.Field(default=0.3, gt=0)
    """Added to the diagonal of every 2D covariance, so that nothing is thinner than a pixel. Square pixels."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB behind everything."""


class CutSettings(SplattingSettings):
    """Options of the renderers that have the lineage's cuts as options too."""

    alpha_max: float = pydantic.Field(default=0.99, gt=0, lt=1)
    """No Gaussian is more opaque than this at any pixel."""
    alpha_min: float = pydantic.Field(default=1 / 255, gt=0, lt=1)
    """Fainter contributions are skipped."""
    transmittance_min: float = pydantic.Field(default=1e-4, ge=0, lt=1)
    """Compositing stops before the Gaussian that would leave less light than this."""


class SplattingRenderer(Renderer):
    """Draws whole images of what a :class:`GaussianField` shows to a camera."""

    outputs: ClassVar[frozenset[str]] = frozenset(OUTPUTS)
    #: For messages.
    name: ClassVar[str]

    def render(
        self,
        field: GaussianField,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view.

        Args:
            field: A field of a primitive that this renderer serves.
            camera: Where from.
            wants: Names from :data:`coliags_plugin.core.render_output.OUTPUTS` or of the Gaussians' features; rgb and
                alpha always come.
            pixels: Must be None: a splatting renderer draws whole images.

        Raises:
            InputError: ``pixels`` is given, an output is unknown, or the field is not for this renderer.
        """
        if pixels is not None:
            raise InputError(
                f"the {self.name} renderer was asked for single pixels",
                "whole images: it splats",
                "Leave pixels out, or choose a renderer of radiance fields",
            )
        if field.primitive not in self.primitives:
            raise InputError(
                f"a field of '{field.primitive}' for the {self.name} renderer",
                f"one of {', '.join(sorted(self.primitives))}",
                "Choose another renderer or another field",
            )
        return self.draw(field.gaussians(camera), camera, wants)

    @abstractmethod
    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Draw Gaussians as the camera sees them."""


def check_outputs(wants: Sequence[str], gaussians: Gaussians) -> None:
    """Refuse outputs that neither are a renderer's nor features of the Gaussians.

    Raises:
        InputError: See above.
    """
    known = (*OUTPUTS, *gaussians.features)
    for name in wants:
        if name not in known:
            raise InputError(f"no renderer output '{name}'", f"some of {', '.join(known)}", did_you_mean(name, known))
