"""Checks of a method's config and of the model made of it."""

from __future__ import annotations

from collections import Counter

from pydantic import ValidationError
from pydantic_core import PydanticCustomError

from coliags_plugin.checks.method.context import CheckContext, as_in_new_process
from coliags_plugin.checks.method.error_location import components
from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.config.components import make_component
from coliags_plugin.config.method_config import load_method
from coliags_plugin.engine.data_formats import load_scene

#: An option that no component has.
NO_OPTION = "no_such_option"


def resolves(context: CheckContext) -> str:
    """The config is valid, and written to YAML and read again it is itself."""
    context.loaded = context.load()
    config = context.loaded.config
    text = config.to_yaml()
    path = context.folder / "resolved.yaml"
    path.write_text(text, encoding="utf-8")
    again = load_method(str(path.resolve())).config
    if again != config or again.to_yaml() != text:
        changed = [name for name in type(config).model_fields if getattr(again, name) != getattr(config, name)]
        raise CheckFailedError(f"written to YAML and read again, it has another {', '.join(changed) or 'text'}")
    names = [node.name for node in components(config).values()]
    return f"{len(names)} components: {', '.join(dict.fromkeys(names))}"


def refuses_options(context: CheckContext) -> str:
    """Every component refuses an option that it does not have, by name."""
    there = components(context.loaded.config)
    for path, component in there.items():
        options = {"name": component.name, **component.settings.model_dump(), NO_OPTION: 1}
        try:
            make_component(component.kind, options)
        except (ValidationError, PydanticCustomError) as error:
            if NO_OPTION in str(error):
                continue
            raise CheckFailedError(f"{path}.{NO_OPTION}=1 is refused without being named: {error}") from error
        raise CheckFailedError(
            f"{path}.{NO_OPTION}=1 is accepted: let the Settings of '{component.name}' be a subclass of "
            "coliags_plugin.core.settings.Settings"
        )
    return f"unknown options of {len(there)} components are refused"


def builds(context: CheckContext) -> str:
    """The components fit one another and the scene."""
    context.scene = load_scene(context.loaded.config, context.data)
    with as_in_new_process():
        trainer = context.build("built")
    if trainer.run.path.exists():
        raise CheckFailedError("the run folder was written before training began")
    numbers = sum(parameter.numel() for parameter in trainer.model.parameters())
    frames = f"{len(context.scene.train)} training frames, {len(context.scene.points)} initial points"
    return f"{numbers} parameters, renderer {trainer.chosen.name}; {frames}"


def has_all_groups(context: CheckContext) -> str:
    """Every trainable parameter is in exactly one parameter group, which an optimizer trains."""
    trainer = context.build("groups")
    groups = trainer.model.parameter_groups()
    counts = Counter(id(parameter) for group in groups.values() for parameter in group)
    named = dict(trainer.model.named_parameters())
    missing = [name for name, parameter in named.items() if parameter.requires_grad and not counts[id(parameter)]]
    if missing:
        raise CheckFailedError(f"in no parameter group, so never trained: {', '.join(missing)}")
    shared = [name for name, parameter in named.items() if counts[id(parameter)] > 1]
    if shared:
        raise CheckFailedError(f"in more than one parameter group: {', '.join(shared)}")
    strangers = counts.keys() - {id(parameter) for parameter in named.values()}
    for group, parameters in groups.items():
        if not parameters:
            raise CheckFailedError(f"parameter group '{group}' is empty")
        if any(id(parameter) in strangers for parameter in parameters):
            raise CheckFailedError(f"parameter group '{group}' holds a parameter that is no attribute of the model")
    return ", ".join(groups)
