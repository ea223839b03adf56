"""Gaussians of an explicit field or a file: a world frame, plain numbers, colours as spherical harmonics."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32
from scipy.special import logit
from torch import Tensor

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.fields.explicit_gaussians import AttenuatedGaussians, ExplicitGaussians, ExplicitGaussiansSettings
from coliags_plugin.fields.spherical_harmonics import Y0

log = logging.getLogger(__name__)

#: Third scale of surfels in files, as a share of the smaller other one: small, and a finite logarithm.
THICKNESS_SHARE = 0.01
#: Opacities are kept this far from 0 and 1, where their logits would be infinite.
OPACITY_MARGIN = 1e-6


@dataclass(frozen=True, eq=False)
class SplatCloud:
    """Gaussians or surfels in the world frame and scene units (mm for C3VD), for all views.

    The colour seen along a direction is max(0, 0.5 + sum of coefficients times basis), in display sRGB, with the order
    and the signs of 3DGS.
    """

    means: Float32[np.ndarray, "N 3"]  # centres
    quats_wxyz: Float32[np.ndarray, "N 4"]  # rotations; need not be normalised
    scales: Float32[np.ndarray, "N S"]  # standard deviations along the local axes, three; two for surfels
    opacities: Float32[np.ndarray, "N"]  # in [0, 1]
    harmonics: Float32[np.ndarray, "N B 3"]  # coefficients of spherical harmonics to degree D, B = (D + 1)^2
    # of colours that follow a lamp at the camera: distances where they are as given, scene units, and the exponents of
    # their fall (:class:`~coliags_plugin.fields.explicit_gaussians.AttenuatedGaussians`); no file format keeps them
    attenuation: Float32[np.ndarray, "N 2"] | None = None

    @classmethod
    def of_tensors(cls, *parts: Tensor) -> SplatCloud:
        """A cloud of tensors in the order of its arrays."""
        return cls(*(np.ascontiguousarray(part.detach().cpu().float().numpy()) for part in parts))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @property
    def colors(self) -> Float32[np.ndarray, "N 3"]:
        """Colours without their dependence on the direction, in [0, 1]. [N, 3]"""
        return np.clip(0.5 + Y0 * self.harmonics[:, 0], 0.0, 1.0)

    @property
    def unit_quats_wxyz(self) -> Float32[np.ndarray, "N 4"]:
        """Rotations of length 1. [N, 4]"""
        lengths = np.linalg.norm(self.quats_wxyz, axis=1, keepdims=True)
        return self.quats_wxyz / np.maximum(lengths, np.finfo(np.float32).tiny)

    @property
    def log_scales(self) -> Float32[np.ndarray, "N S"]:
        """Natural logarithms of the scales, finite. [N, 3] or [N, 2]"""
        return np.log(np.maximum(self.scales, np.finfo(np.float32).tiny))

    @property
    def logits(self) -> Float32[np.ndarray, "N"]:
        """Logits of the opacities, finite. [N]"""
        inside = np.clip(self.opacities.astype(np.float64), OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)
        return np.asarray(logit(inside), np.float32)

    def part(self, chosen: Bool[np.ndarray, "N"]) -> SplatCloud:
        """Some of the Gaussians."""
        return SplatCloud(**{name: values[chosen] for name, values in self._arrays().items()})

    def scaled(self, factor: float) -> SplatCloud:
        """The Gaussians in a world whose lengths are ``factor`` times as large."""
        length = np.float32(factor)
        attenuation = None if self.attenuation is None else self.attenuation * np.array([factor, 1.0], np.float32)
        return replace(self, means=self.means * length, scales=self.scales * length, attenuation=attenuation)

    def _arrays(self) -> dict[str, np.ndarray]:
        """The arrays that it has, by the names of their fields."""
        return {name: values for name, values in vars(self).items() if values is not None}

    def checked(self, source: object) -> SplatCloud:
        """The Gaussians that can be used, of which there must be one; of others there is a warning with their number.

        They are finite, have a rotation, and lie and extend within the bounds of lengths; ``source`` is for messages.
        """
        parts = [np.isfinite(part).all(axis=tuple(range(1, part.ndim))) for part in self._arrays().values()]
        with np.errstate(over="ignore", invalid="ignore"):
            parts.append(np.square(self.quats_wxyz.astype(np.float64)).sum(axis=1) > 1e-24)
            parts += [(np.abs(lengths) <= bounds.LENGTH).all(axis=1) for lengths in (self.means, self.scales)]
        usable = np.all(parts, axis=0)
        count = int(usable.sum())
        if not count:
            raise InputError(
                f"{source} has {len(self)} Gaussians, none of which is usable", "finite numbers, rotations not 0"
            )
        if count < len(self):
            text = "%s: dropped %d of %d Gaussians that are not finite or have no rotation"
            log.warning(text, source, len(self) - count, len(self))
        return self if count == len(self) else self.part(usable)

    def with_thickness(self) -> SplatCloud:
        """Surfels as flat Gaussians, with a third scale; Gaussians unchanged."""
        if self.scales.shape[1] == 3:
            return self
        third = THICKNESS_SHARE * self.scales.min(axis=1, keepdims=True)
        return replace(self, scales=np.concatenate([self.scales, third], axis=1))


def cloud_of_field(field: ExplicitGaussians) -> SplatCloud:
    """The Gaussians, or surfels, of a field, with the harmonics that are active."""
    active = (int(field.degree) + 1) ** 2
    harmonics = torch.cat([field.sh0, field.shN], dim=1)[:, :active]
    parts = [field.means, field.quats, field.scales.exp(), field.opacities.sigmoid(), harmonics]
    if isinstance(field, AttenuatedGaussians):
        parts.append(torch.cat([field.distances, field.exponents], dim=1))
    return SplatCloud.of_tensors(*parts)


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
    settings = ExplicitGaussiansSettings(sh_degree=cloud.degree)
    if cloud.attenuation is None:
        field = ExplicitGaussians(settings, len(cloud))
    else:
        field = AttenuatedGaussians(settings, len(cloud))
        with torch.no_grad():
            for column, values in enumerate((field.distances, field.exponents)):
                values.copy_(torch.from_numpy(cloud.attenuation[:, column : column + 1]))
    load_cloud(field, cloud)
    return field
