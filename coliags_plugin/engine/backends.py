"""Which renderer serves a field on a device, and why."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from coliags_plugin.config.components import Component, make_component
from coliags_plugin.contracts import Renderer
from coliags_plugin.core.errors import InputError


@dataclass(frozen=True)
class ChosenRenderer:
    """A renderer and the reason it was chosen."""

    name: str
    renderer: Renderer
    reason: str


def choose_device(wanted: str) -> torch.device:
    """``auto`` takes CUDA where there is one.

    Raises:
        InputError: The device is not there.
    """
    if wanted == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda was asked for, but torch sees none", "cpu, or auto", "See `coliags doctor`")
    return torch.device(wanted)


def choose_renderer(component: Component, primitive: str, device: torch.device) -> ChosenRenderer:
    """Make the renderer a config names; for ``auto``, the first of its preferences that can serve.

    Args:
        component: The config's renderer node.
        primitive: What the field is made of.
        device: Where the field is.

    Raises:
        InputError: It cannot serve this field on this device; names both sides.
    """
    if component.name != "auto":
        obstacle = _obstacle(component, primitive, device)
        if obstacle:
            raise InputError(f"renderer '{component.name}' {obstacle}", "a renderer that can serve the field")
        return ChosenRenderer(component.name, component.target(component.settings), "named by the config")
    refused: list[str] = []
    settings = component.settings.model_dump()
    for name in settings.pop("prefer"):
        candidate = make_component("renderers", {"name": name, **settings})
        obstacle = _obstacle(candidate, primitive, device)
        if not obstacle:
            found = candidate.target.availability().reason
            reason = "; ".join([*refused, f"auto chose {name}: {found}"])
            return ChosenRenderer(name, candidate.target(candidate.settings), reason)
        refused.append(f"{name} {obstacle}")
    raise InputError(f"no renderer can serve: {'; '.join(refused)}", f"one for {primitive} on {device.type}")


def _obstacle(component: Component, primitive: str, device: torch.device) -> str:
    """Why a renderer cannot serve, or an empty string."""
    renderer = component.target
    if primitive not in renderer.primitives:
        return f"draws {', '.join(sorted(renderer.primitives))}, the field is made of {primitive}"
    if device.type not in renderer.devices:
        return f"runs on {', '.join(sorted(renderer.devices))}, the device is {device.type}"
    # Last, because finding out may compile something.
    available = renderer.availability()
    return "" if available.ok else f"cannot run here: {available.reason}"
