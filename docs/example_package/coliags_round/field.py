"""Round Gaussians of one colour each."""

import torch
from pydantic import Field
from torch import nn

from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.settings import Settings


class RoundGaussiansSettings(Settings):
    """Options of round Gaussians."""

    size: float = Field(default=0.5, gt=0, description="Standard deviation at the start, scene units.")


class RoundGaussians(GaussianField):
    """A Gaussian with one scale and one colour at every initial point."""

    Settings = RoundGaussiansSettings
    primitive = "gaussians3d"
    rates = {"means": {"lr": 0.00016, "times_extent": True}, "sizes": {"lr": 0.005}, "logits": {"lr": 0.02}}

    def __init__(self, settings, count):
        super().__init__()
        self.means = nn.Parameter(torch.zeros(count, 3))
        self.log_sizes = nn.Parameter(torch.full((count,), settings.size).log())
        self.logits = nn.Parameter(torch.zeros(count, 4))  # opacity and colour

    @classmethod
    def from_scene(cls, scene, settings, generator):
        """One at every initial point."""
        if not len(scene.points):
            raise InputError("the scene has no initial points", "one at least", "Set datamanager.initial_points")
        field = cls(settings, len(scene.points))
        field.means.data.copy_(scene.points.positions)
        return field

    @classmethod
    def from_state(cls, state, settings):
        """The field of a checkpoint."""
        field = cls(settings, len(state["means"]))
        field.load_state_dict(state)
        return field

    def gaussians(self, camera, light=None, generator=None):
        """The same from everywhere."""
        count = len(self.means)
        rows = torch.arange(count, device=self.means.device)
        values = self.logits.sigmoid()
        return Gaussians(
            means=self.means,
            quats_wxyz=self.means.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4),
            scales=self.log_sizes.exp()[:, None].expand(count, 3),
            opacities=values[:, 0],
            colors=values[:, 1:],
            source_index=rows,
            visible_sources=rows,
        )

    def parameter_groups(self):
        """Names of ``rates``."""
        return {"means": [self.means], "sizes": [self.log_sizes], "logits": [self.logits]}
