"""Gaussians of a run for no view in particular, from those of its training views."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.lighting.lamps import HeldLight

#: Training views that are decoded, at most.
VIEWS = 16


def baking_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """At most :data:`VIEWS` of the training cameras, evenly spaced in their order."""
    count = min(VIEWS, len(cameras))
    return [cameras[index * len(cameras) // count] for index in range(count)]


@torch.no_grad()
def bake(field: GaussianField, cameras: Sequence[Camera], light: HeldLight | None = None) -> Gaussians:
    """Every Gaussian that some camera sees, once, with one colour and one shape.

    Colours are means over the views, weighted by opacity; opacities are means over the views that drew it. The shape
    is that of the view in which it is most opaque (explicit Gaussians have only one).

    Args:
        field: What is decoded.
        cameras: From where; at least one.
        light: What lights it; None: the lamp of each camera, so that colours are of the average light.
    """
    sums: dict[str, Tensor] = {}
    for camera in cameras:
        _add(sums, field.gaussians(camera) if light is None else field.gaussians_in_light(camera, light))
    drawn = sums["views"] > 0
    kept = {name: values[drawn] for name, values in sums.items()}
    slots = drawn.nonzero().squeeze(1)
    return Gaussians(
        means=kept["means"],
        quats_wxyz=kept["quats"],
        scales=kept["scales"],
        opacities=kept["opacity"] / kept["views"],
        colors=kept["colors"] / kept["opacity"][:, None],
        source_index=slots,
        visible_sources=slots,
    )


def _add(sums: dict[str, Tensor], view: Gaussians) -> None:
    """Add a view to sums and best shapes, which have one row per slot of the field."""
    slots, opacities = view.source_index, view.opacities
    one = opacities[:, None]
    shapes = {"means": view.means, "quats": view.quats_wxyz, "scales": view.scales, "best": opacities}
    added = {"views": torch.ones_like(opacities), "opacity": opacities, "colors": view.colors * one}
    _make_room(sums, {**shapes, **added}, int(slots.max()) + 1 if len(slots) else 0)
    for name, values in added.items():
        sums[name].index_add_(0, slots, values)
    better = opacities > sums["best"][slots]
    for name, values in shapes.items():
        sums[name][slots[better]] = values[better]


def _make_room(sums: dict[str, Tensor], like: dict[str, Tensor], rows: int) -> None:
    """Zero rows at the end of every tensor, where there are fewer."""
    for name, values in like.items():
        there = sums.get(name, values[:0])
        sums[name] = torch.cat([there, there.new_zeros(max(0, rows - len(there)), *there.shape[1:])])
