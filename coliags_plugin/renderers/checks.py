"""Checks of the arguments of renderers."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import torch

from coliags_plugin.contracts import Field
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS, SURFEL_OUTPUTS


def check_primitive(field: Field, primitives: Collection[str], renderer: str) -> None:
    """Refuse a field that a renderer cannot draw."""
    if field.primitive not in primitives:
        raise InputError(
            f"a field of '{field.primitive}' for the {renderer} renderer",
            f"one of {', '.join(sorted(primitives))}",
            "Choose another renderer or another field",
        )


def check_outputs(wants: Iterable[str], known: Iterable[str]) -> None:
    """Refuse outputs that a renderer does not have."""
    known = tuple(known)
    for name in wants:
        if name not in known:
            raise InputError(f"no renderer output '{name}'", f"some of {', '.join(known)}", did_you_mean(name, known))


def is_surfels(gaussians: Gaussians) -> bool:
    """Whether Gaussians are surfels, with two scales each; InputError if they have neither two nor three."""
    scales = gaussians.scales
    if scales.ndim != 2 or scales.shape[1] not in (2, 3):
        raise InputError(
            f"Gaussians with scales of shape {list(scales.shape)}", "three scales each, [N, 3], or two for surfels"
        )
    return scales.shape[1] == 2


def check_device(gaussians: Gaussians, devices: Collection[str], renderer: str) -> None:
    """Refuse Gaussians that are on a device that a renderer does not serve."""
    if gaussians.means.device.type not in devices:
        raise InputError(
            f"Gaussians on {gaussians.means.device.type} for the {renderer} renderer",
            f"Gaussians on {', '.join(sorted(devices))}",
            "Move the field there, or choose renderer 'auto'",
        )


def check_float32(gaussians: Gaussians, renderer: str) -> None:
    """Refuse Gaussians of another dtype."""
    if gaussians.means.dtype != torch.float32:
        raise InputError(
            f"Gaussians of dtype {str(gaussians.means.dtype).removeprefix('torch.')} for the {renderer} renderer",
            "float32",
            "Cast them, or choose the torch renderer, which computes in float64 too",
        )


def check_gaussian_outputs(wants: Iterable[str], gaussians: Gaussians) -> None:
    """Refuse outputs that are neither a splatting renderer's nor features of the Gaussians, and malformed features."""
    check_outputs(wants, (*OUTPUTS, *gaussians.features))
    of_surfels = sorted(SURFEL_OUTPUTS & {*wants} - {*gaussians.features})
    if of_surfels and not is_surfels(gaussians):
        raise InputError(
            f"output {', '.join(of_surfels)} of 3D Gaussians",
            "surfels, which alone have it",
            "Choose a field of surfels, or leave it out",
        )
    for name, values in gaussians.features.items():
        if values.ndim != 2 or len(values) != len(gaussians):
            raise InputError(f"feature {name} of shape {list(values.shape)}", f"[{len(gaussians)}, channels]")
