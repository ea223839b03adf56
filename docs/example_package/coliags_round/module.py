"""A vignette shared by all views."""

from dataclasses import replace

import torch
from torch import nn

from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.settings import Settings


class Vignette(ViewModule):
    """Darkens colours with the distance from the principal point, by a learnt factor."""

    Settings = Settings
    whole_image = True  # shade asks where a pixel lies
    rates = {"falloff": {"lr": 0.01}}
    untrained_views = "all views have the same vignette"

    def __init__(self, settings, scene):
        super().__init__(settings, scene)
        self.falloff = nn.Parameter(torch.zeros(()))  # no vignette yet

    def parameter_groups(self):
        """One number."""
        return {"falloff": [self.falloff]}

    def shade(self, output, view):
        """Multiply the colours by exp(-falloff * tan^2 of the angle to the optical axis)."""
        camera = output.camera
        columns = (torch.arange(camera.width, device=output.rgb.device) + 0.5 - camera.cx) / camera.fx
        rows = (torch.arange(camera.height, device=output.rgb.device) + 0.5 - camera.cy) / camera.fy
        squared = columns.square() + rows.square()[:, None]
        return replace(output, rgb=output.rgb * (-self.falloff * squared).exp()[..., None].to(output.rgb))
