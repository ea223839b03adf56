"""Explicit surfels with spherical harmonics, as in 2D Gaussian Splatting."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from typing_extensions import Self

from coliags_plugin.core.scenes import Scene
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians


class Surfels(ExplicitGaussians):
    """Explicit Gaussians on discs, with two scales each; their normals are the third axes of their rotations."""

    primitive: ClassVar[str] = "surfels"
    scale_count: ClassVar[int] = 2

    @classmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """A round surfel at every initial point, with its colour; quaternions are uniform in [0, 1)^4.

        Raises:
            InputError: The scene has no points, or too few for reference normals.
        """
        field = super().from_scene(scene, settings, generator)
        with torch.no_grad():
            field.quats.copy_(torch.rand(field.quats.shape, generator=generator))
        return field
