"""Explicit fields as clouds of Gaussians, and back."""

from __future__ import annotations

import numpy as np
import torch

from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians, ExplicitGaussiansSettings


def cloud_of_field(field: ExplicitGaussians) -> SplatCloud:
    """The Gaussians, or surfels, of a field, with the harmonics that are active."""
    active = (int(field.degree) + 1) ** 2
    harmonics = torch.cat([field.sh0, field.shN], dim=1)[:, :active]
    parts = (field.means, field.quats, field.scales.exp(), field.opacities.sigmoid(), harmonics)
    means, quats, scales, opacities, coefficients = (
        np.ascontiguousarray(part.detach().cpu().float().numpy()) for part in parts
    )
    return SplatCloud(means, quats, scales, opacities, coefficients)


def load_cloud(field: ExplicitGaussians, cloud: SplatCloud) -> None:
    """Put a cloud, all finite, into a field of as many Gaussians, of at least its degree, and as many scales."""
    first, higher = cloud.harmonics[:, :1], cloud.harmonics[:, 1:]
    with torch.no_grad():
        field.means.copy_(torch.from_numpy(cloud.means))
        field.quats.copy_(torch.from_numpy(cloud.unit_quats_wxyz))
        field.scales.copy_(torch.from_numpy(cloud.log_scales))
        field.opacities.copy_(torch.from_numpy(cloud.logits))
        field.sh0.copy_(torch.from_numpy(np.ascontiguousarray(first)))
        field.shN[:, : higher.shape[1]] = torch.from_numpy(np.ascontiguousarray(higher))
        field.degree.fill_(cloud.degree)


def field_of_cloud(cloud: SplatCloud) -> ExplicitGaussians:
    """A cloud of Gaussians with three scales each as a field."""
    field = ExplicitGaussians(ExplicitGaussiansSettings(sh_degree=cloud.degree), len(cloud))
    load_cloud(field, cloud)
    return field
