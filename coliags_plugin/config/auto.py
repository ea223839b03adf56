"""Resolution of ``name: auto`` in a config to one of the components of its kind."""

from __future__ import annotations

from collections.abc import Callable

from coliags_plugin.config.components import Component, named_component
from coliags_plugin.config.registry import REGISTRIES, Resolver


def is_auto(kind: str, name: object) -> bool:
    """Whether a name in a config stands for whichever component is resolved."""
    return isinstance(name, str) and name in REGISTRIES[kind] and isinstance(REGISTRIES[kind].get(name), Resolver)


def candidates(kind: str) -> list[str]:
    """Names of the components of a kind that ``auto`` may stand for."""
    return [name for name in REGISTRIES[kind] if not is_auto(kind, name)]


def resolved(component: Component, choose: Callable[[], str]) -> Component:
    """A component, or the one that ``auto`` stands for, as ``choose`` says, with the options that were set."""
    return with_options(component, choose()) if is_auto(component.kind, component.name) else component


def with_options(auto: Component, name: str) -> Component:
    """A candidate of ``auto`` with the options that were set for that.

    Raises:
        InputError: There is no such component, or it lacks an option.
    """
    options = auto.settings.model_dump(include=auto.settings.model_fields_set - {"prefer"})
    return named_component(auto.kind, {"name": name, **options}, f"{REGISTRIES[auto.kind].noun} {auto.name}, prefer")
