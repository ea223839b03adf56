"""Choice of the renderer of a field on a device."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from coliags_plugin.config import registry
from coliags_plugin.config.components import Component, candidates, is_auto, with_options
from coliags_plugin.contracts import Renderer
from coliags_plugin.core.errors import InputError


@dataclass(frozen=True)
class ChosenRenderer:
    """A renderer, its registered name and the reason for choosing it."""

    name: str
    renderer: Renderer
    reason: str


def choose_renderer(component: Component, primitive: str, device: torch.device) -> ChosenRenderer:
    """Make the renderer of a config; of ``auto``, the first preferred one that can render the field."""
    if is_auto(component.kind, component.name):
        return _first_of(component, primitive, device)
    obstacle = component.target.obstacle(primitive, device)
    if obstacle:
        raise InputError(
            f"renderer '{component.name}' {obstacle}", "a renderer that can serve the field", _others(primitive, device)
        )
    return ChosenRenderer(component.name, component.target(component.settings), "named by the config")


def _first_of(auto: Component, primitive: str, device: torch.device) -> ChosenRenderer:
    refused: list[str] = []
    for name in auto.settings.model_dump()["prefer"]:
        candidate = with_options(auto, name)
        obstacle = candidate.target.obstacle(primitive, device)
        if not obstacle:
            available = candidate.target.availability().reason
            reason = "; ".join([*refused, f"{auto.name} chose {name}: {available}"])
            return ChosenRenderer(name, candidate.target(candidate.settings), reason)
        refused.append(f"{name} {obstacle}")
    raise InputError(
        f"no renderer can serve: {'; '.join(refused)}",
        f"one for {primitive} on {device.type}",
        _others(primitive, device),
    )


def _others(primitive: str, device: torch.device) -> str:
    """Hint that names the renderers of a primitive on a device; empty without any."""
    classes = {name: registry.renderers.get(name) for name in candidates("renderers")}
    able = [name for name, found in classes.items() if primitive in found.primitives and device.type in found.devices]
    return f"Set `renderer=NAME`, NAME being {' or '.join(able)}" if able else ""
