"""Choice of the renderer of a field on a device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from coliags_plugin.config import registry
from coliags_plugin.config.components import Component, named_component
from coliags_plugin.contracts import Renderer
from coliags_plugin.core.errors import InputError


@dataclass(frozen=True)
class ChosenRenderer:
    """A renderer, its registered name and the reason for choosing it."""

    name: str
    renderer: Renderer
    reason: str


def choose_renderer(component: Component, primitive: str, device: torch.device) -> ChosenRenderer:
    """Make the renderer of a config, or the first of its alternatives that can render the field.

    Args:
        component: The config's renderer node.
        primitive: Of the field.
        device: Of the field.

    Raises:
        InputError: It, or each of its alternatives, cannot render this field on this device.
    """
    alternatives = component.target.alternatives(component.settings)
    if not alternatives:
        obstacle = component.target.obstacle(primitive, device)
        if obstacle:
            raise InputError(
                f"renderer '{component.name}' {obstacle}",
                "a renderer that can serve the field",
                _others(primitive, device),
            )
        return ChosenRenderer(component.name, component.target(component.settings), "named by the config")
    return choose_among(component.name, alternatives, primitive, device)


def choose_among(
    chooser: str, configs: Sequence[Mapping[str, Any]], primitive: str, device: torch.device
) -> ChosenRenderer:
    """Make the first of several renderers that can render a field.

    Args:
        chooser: Registered name of the renderer that they are alternatives of.
        configs: Name and options of each renderer, the most preferred first.
        primitive: Of the field.
        device: Of the field.

    Raises:
        InputError: None of them can.
    """
    refused: list[str] = []
    for config in configs:
        candidate = named_component("renderers", dict(config), f"renderer {chooser}, prefer")
        obstacle = candidate.target.obstacle(primitive, device)
        if not obstacle:
            found = candidate.target.availability().reason
            reason = "; ".join([*refused, f"{chooser} chose {candidate.name}: {found}"])
            return ChosenRenderer(candidate.name, candidate.target(candidate.settings), reason)
        refused.append(f"{candidate.name} {obstacle}")
    raise InputError(
        f"no renderer can serve: {'; '.join(refused)}",
        f"one for {primitive} on {device.type}",
        _others(primitive, device),
    )


def _others(primitive: str, device: torch.device) -> str:
    """Hint that names the renderers of a primitive on a device; empty without any."""
    classes = {name: registry.renderers.get(name) for name in registry.renderers}
    able = [name for name, found in classes.items() if primitive in found.primitives and device.type in found.devices]
    return f"Set --set renderer=NAME, NAME being {' or '.join(able)}" if able else ""
