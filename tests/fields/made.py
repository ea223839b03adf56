"""Fields of the wall."""

from __future__ import annotations

from dataclasses import replace

import torch

from coliags_plugin.core.components import make_component
from coliags_plugin.core.scenes import PointCloud
from tests.scenes import wall_scene


def make_field(name, scene=None, seed=0, **options):
    """A field by name and options, of the wall unless a scene is given."""
    component = make_component("fields", {"name": name, **options})
    return component.target.from_scene(scene or wall_scene(), component.settings, torch.Generator().manual_seed(seed))


def colored_wall():
    """The wall with points of random colours."""
    scene = wall_scene()
    count = len(scene.points)
    colors = torch.randint(0, 256, (count, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    return replace(scene, points=PointCloud(scene.points.positions, colors))
