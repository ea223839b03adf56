"""Scene coordinates normalised to [-1, 1], and the distances at which cameras see the surface."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.fields.anchor_points import initial_positions
from coliags_plugin.fields.frustum import spheres_in_frustum

#: Factors on the smallest and the largest distance.
NEAR_MARGIN, FAR_MARGIN = 0.9, 1.1
#: About as many of the initial points, evenly chosen, are looked at from every camera.
_POINTS = 20_000


class SceneNormalisation(nn.Module):
    """Shift and scale that put the scene's initial points into [-1, 1]; saved with the field.

    Attributes:
        center: Mean of the points, scene units. [3]
        unit: Largest absolute coordinate of a point relative to the centre, scene units. []
    """

    center: Tensor
    unit: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("unit", torch.ones(()))

    @classmethod
    def from_scene(cls, scene: Scene) -> Self:
        """The normalisation of a scene's initial points."""
        points = initial_positions(scene).double()
        center = points.mean(0)
        unit = (points - center).abs().max()
        if not unit > 0:
            raise InputError(
                "the scene's initial points are all at one place",
                "points spread over the surface, whose size is the field's unit of length",
                "Give the data manager points or depth",
            )
        made = cls()
        made.center.copy_(center)
        made.unit.copy_(unit)
        return made

    def forward(self, positions: Float[Tensor, "*P 3"]) -> Float[Tensor, "*P 3"]:
        """Scene units to normalised coordinates."""
        return (positions - self.center) / self.unit


def surface_distances(scene: Scene) -> Float[Tensor, "2"]:
    """Smallest and largest distance of a training camera from the initial points in its view, times 0.9 and 1.1.

    Scene units. Occlusion is not tested.
    """
    points = initial_positions(scene).double()
    points = points[:: max(1, len(points) // _POINTS)]
    radii = points.new_zeros(len(points))
    found = []
    for frame in scene.train:
        camera = frame.camera.to(points.device, points.dtype)
        distances = (points - camera.center).norm(dim=1)
        found.append(distances[spheres_in_frustum(points, radii, replace(camera, near_plane=0.0))])
    seen = torch.cat(found)
    if not len(seen):
        raise InputError(
            "no training camera has an initial point in view",
            "points on the surface that the cameras see, between which and the cameras rays are sampled",
            "Look at poses and points with `coliags data check`",
        )
    return torch.stack([NEAR_MARGIN * seen.min(), FAR_MARGIN * seen.max()])
