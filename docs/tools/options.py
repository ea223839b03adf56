"""The page *Options* of the site: every option of every component, as ``coliags list KIND NAME`` prints it.

``make docs`` builds the page; ``python docs/tools/options.py`` prints it.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from typing import Any

from coliags_plugin.config.method_config import MethodConfig, OptimizerSettings, ScheduleSettings
from coliags_plugin.config.reference import options_of, plain_doc
from coliags_plugin.config.yaml_tree import dump_inline
from coliags_plugin.core.registry import REGISTRIES, Registry
from coliags_plugin.core.settings import Settings
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.pipeline.settings import FrameSettings, ReconstructionSettings
from coliags_plugin.reconstruction.depth.sweeping import DepthEstimationSettings
from coliags_plugin.reconstruction.structure.sfm_settings import (
    CameraSettings,
    FeatureSettings,
    SfmSettings,
    TrackSettings,
)
from coliags_plugin.surface.coverage.visibility import CoverageSettings
from coliags_plugin.surface.meshing.views import MeshSettings

HEAD = """\
# Options

Every option there is, generated from the settings classes. How a method config is written and changed is in
[configs.md](configs.md), where constants come from in [methods.md](methods.md).

A component is `{name: ..., options...}`. Lengths are in scene units: mm, where the data are metric.
"""

#: Where a method config names a component of each kind.
PLACES = {
    "datamanagers": "under `datamanager`",
    "fields": "under `field`",
    "geometry_heads": "under `field.geometry_head`",
    "appearance_heads": "under `field.appearance_head`",
    "renderers": "under `renderer`",
    "modules": "under `modules`, by names of your choice",
    "samplers": "under `sampler`",
    "strategies": "under `strategy`",
    "losses": "under `losses`, by names of your choice",
    "metrics": "named by protocols, not by method configs",
    "protocols": "named under `protocol`; they have no options",
}

#: Settings of commands, under the prefix that ``--set`` of the command needs.
COMMANDS: dict[str, type[Settings]] = {
    "phantom": PhantomSettings,
    "reconstruct": ReconstructionSettings,
    "reconstruct, under `frames.`": FrameSettings,
    "poses sfm": SfmSettings,
    "poses sfm, under `camera.`": CameraSettings,
    "poses sfm, under `tracks.`": TrackSettings,
    "poses sfm and depth, under `features.`": FeatureSettings,
    "depth": DepthEstimationSettings,
    "mesh": MeshSettings,
    "coverage": CoverageSettings,
}


def page() -> str:
    """The whole page."""
    parts = [HEAD, *_config_keys()]
    for kind, registry in REGISTRIES.items():
        parts += _of_kind(kind, registry)
    parts.append("## Commands\n\nSettings of `--set NAME=VALUE` of commands that read no method config.\n")
    for name, settings in COMMANDS.items():
        parts += [f"### {name}\n", f"{whole_text(settings)}\n", table(settings)]
    return "\n".join(parts).rstrip() + "\n"


def _config_keys() -> Iterator[str]:
    yield "## Method config\n"
    yield "Beside these, `base` names the config to inherit from.\n"
    yield table(MethodConfig)
    yield "### optimizers\n"
    yield f"{whole_text(OptimizerSettings)}\n"
    yield table(OptimizerSettings)
    yield "### schedule\n"
    yield f"{whole_text(ScheduleSettings)}\n"
    yield table(ScheduleSettings)


def _of_kind(kind: str, registry: Registry) -> Iterator[str]:
    yield f"## {kind}\n"
    yield f"Components of kind `{kind}`, {PLACES.get(kind, 'named by method configs')}.\n"
    builtin = {name: registry.get(name) for name in registry if registry.source(name) == "built in"}
    chains = {name: declaring_classes(getattr(found, "Settings", None)) for name, found in builtin.items()}
    used = [settings for chain in chains.values() for settings in chain]
    shared = sorted({settings for settings in used if used.count(settings) > 1}, key=used.index)
    for settings in shared:
        yield f"### {kind}: shared, {settings.__name__}\n"
        yield f"{whole_text(settings)}\n"
        yield table(settings, own_only=True)
    for name, found in builtin.items():
        yield f"### {kind}: {name}\n"
        yield f"{as_markdown(plain_doc(found))}\n"
        inherited = [f"those of `{settings.__name__}`" for settings in chains[name] if settings in shared]
        own = [settings for settings in chains[name] if settings not in shared]
        if inherited:
            text = f"{'Also ' if own else 'Options: '}{' and '.join(inherited)}."
            yield f"{text}\n"
        for settings in own:
            yield table(settings, own_only=True)
        if rates := getattr(found, "rates", {}):
            yield f"{rates_text(rates)}\n"


def declaring_classes(settings: type[Settings] | None) -> list[type[Settings]]:
    """The classes that declare a component's options, base class first."""
    chain = [] if settings is None else [found for found in settings.__mro__ if issubclass(found, Settings)]
    return [found for found in reversed(chain) if own_names(found)]


def own_names(settings: type[Settings]) -> list[str]:
    """Options that a class declares itself, in its order."""
    return [name for name in settings.model_fields if name in inspect.get_annotations(settings)]


def whole_text(found: type) -> str:
    """A class's docstring as Markdown."""
    return as_markdown(inspect.getdoc(found) or "")


def as_markdown(text: str) -> str:
    """Sphinx's roles as code, and pages of the documentation as links."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text.replace("``", "`"))
    return re.sub(r"`?docs/((?:layouts/|rivals/)?[\w-]+\.md)`?", r"[\1](\1)", text)


def table(settings: type[Settings], own_only: bool = False) -> str:
    """Options of a class as a Markdown table."""
    rows = ["| option | type | default | what |", "|---|---|---|---|"]
    for option in options_of(settings):
        if own_only and option["name"] not in own_names(settings):
            continue
        default = f"`{dump_inline(option['default'])}`" if "default" in option else "required"
        if option["type"] == "options below":
            default = "as below"
        cells = (f"`{option['name']}`", option["type"], default, as_markdown(option["meaning"]))
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def rates_text(rates: Mapping[str, Mapping[str, Any]]) -> str:
    """Default learning rates by parameter group, as a sentence."""
    return f"Default learning rates: {', '.join(f'`{group}: {dump_inline(rate)}`' for group, rate in rates.items())}."


if __name__ == "__main__":
    print(page(), end="")
