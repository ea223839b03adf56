"""Component nodes of method configs: a registered name, or ``auto`` for one of them, with validated settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from pydantic import PlainSerializer, PlainValidator
from pydantic_core import PydanticCustomError

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.registry import REGISTRIES, Resolver
from coliags_plugin.core.settings import Rates, Settings, invalid_reported


@dataclass(frozen=True)
class Component:
    """One validated node of a method config."""

    kind: str  # of registry
    name: str  # in that registry
    settings: Settings  # validated options

    @property
    def target(self) -> Any:
        """The registered class."""
        return REGISTRIES[self.kind].get(self.name)

    @property
    def rates(self) -> Rates:
        """Default learning rates by parameter group, with those of the components among its options."""
        parts = (self, *components_of(self.settings))
        return {group: rates for part in parts for group, rates in part.target.rates.items()}


def components_of(settings: Settings) -> Iterator[Component]:
    """The components among some options, each followed by those among its own options."""
    for value in vars(settings).values():
        for each in value.values() if isinstance(value, dict) else [value]:
            if isinstance(each, Component):
                yield each
                yield from components_of(each.settings)


def make_component(kind: str, node: object) -> Component:
    """Validate ``{"name": ..., options...}``, or a bare name, into a component.

    PydanticCustomError where the name is missing or unknown, ValidationError where an option is.
    """
    if isinstance(node, Component):
        return node
    if isinstance(node, str):
        node = {"name": node}
    if not isinstance(node, dict) or not isinstance(node.get("name"), str):
        names = ", ".join(REGISTRIES[kind].names())
        raise PydanticCustomError("no_name", "a component needs 'name', one of {known}", {"known": names})
    options = {key: value for key, value in node.items() if key != "name"}
    try:
        settings_class = getattr(REGISTRIES[kind].get(node["name"]), "Settings", None)
    except InputError as error:
        raise PydanticCustomError("unknown_component", "{text}", {"text": str(error)}) from error
    if settings_class is None:
        source = REGISTRIES[kind].source(node["name"])
        text = f"'{node['name']}' from {source} has no class attribute 'Settings', which defines its options"
        raise PydanticCustomError("no_settings", "{text}", {"text": text})
    return Component(kind, node["name"], settings_class.model_validate(options))


def named_component(kind: str, node: Mapping[str, object], asking: str) -> Component:
    """Validate a node outside method configs, ``{"name": ..., options...}``, into a component.

    ``asking`` is its origin, for the message.
    """
    try:
        with invalid_reported(f"{asking}: option of '{node['name']}' "):
            return make_component(kind, node)
    except PydanticCustomError as error:
        raise InputError(f"{asking}: {error}") from error


def is_auto(kind: str, name: object) -> bool:
    """True if a name in a config is a resolver's, such as ``auto``, which chooses the component at run time."""
    return isinstance(name, str) and name in REGISTRIES[kind] and isinstance(REGISTRIES[kind].get(name), Resolver)


def candidates(kind: str) -> list[str]:
    """Names of the components of a kind that ``auto`` may stand for."""
    return [name for name in REGISTRIES[kind] if not is_auto(kind, name)]


def with_options(auto: Component, name: str) -> Component:
    """A candidate of ``auto`` with the options that were set for that."""
    options = auto.settings.model_dump(include=auto.settings.model_fields_set - {"prefer"})
    return named_component(auto.kind, {"name": name, **options}, f"{REGISTRIES[auto.kind].noun} {auto.name}, prefer")


_DUMP = PlainSerializer(lambda component: {"name": component.name, **component.settings.model_dump()})
DataManagerNode = Annotated[Component, PlainValidator(partial(make_component, "datamanagers")), _DUMP]
FieldNode = Annotated[Component, PlainValidator(partial(make_component, "fields")), _DUMP]
GeometryHeadNode = Annotated[Component, PlainValidator(partial(make_component, "geometry_heads")), _DUMP]
AppearanceHeadNode = Annotated[Component, PlainValidator(partial(make_component, "appearance_heads")), _DUMP]
RendererNode = Annotated[Component, PlainValidator(partial(make_component, "renderers")), _DUMP]
ModuleNode = Annotated[Component, PlainValidator(partial(make_component, "modules")), _DUMP]
SamplerNode = Annotated[Component, PlainValidator(partial(make_component, "samplers")), _DUMP]
StrategyNode = Annotated[Component, PlainValidator(partial(make_component, "strategies")), _DUMP]
LossNode = Annotated[Component, PlainValidator(partial(make_component, "losses")), _DUMP]
