"""Commands on what is there: ``coliags list``, ``config`` and ``weights``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli.texts import in_flags, print_summary
from coliags_plugin.config import options


@dataclass(frozen=True)
class ListCommand:
    """List methods, benchmarks and registered components, or the options of one component."""

    kind: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[KIND]")] = "all"
    """A kind (methods, benchmarks, ablations, datamanagers, fields, renderers, ...), or all of them."""
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[NAME]", help_behavior_hint="")] = ""
    """A component of that kind, of which to print the options and default learning rates."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print names by kind, with the source of those that are not built in, or a description of a component."""
        from coliags_plugin.comparison.named_files import ABLATIONS, shipped
        from coliags_plugin.config.method_config import descriptions, method_files
        from coliags_plugin.core.errors import check_name
        from coliags_plugin.core.registry import REGISTRIES

        if self.name:
            check_name("kind of components", self.kind, REGISTRIES)
            self._describe()
            return
        texts: dict[str, Callable[[], dict[str, str]]] = {
            "methods": lambda: descriptions(method_files()),
            "benchmarks": lambda: descriptions(shipped()),
            "ablations": lambda: descriptions(shipped(ABLATIONS)),
            **{kind: partial(self._components, kind) for kind in REGISTRIES},
        }
        check_name("kind", self.kind, ("all", *texts))
        listed = {kind: texts[kind]() for kind in (texts if self.kind == "all" else [self.kind])}
        lines = []
        for kind, rows in listed.items():
            lines += [f"{kind}:"] if self.kind == "all" else []
            indent = "  " if self.kind == "all" else ""
            lines += [f"{indent}{name:<28}{text}".rstrip() for name, text in rows.items()]
        print_summary("\n".join(lines), listed, as_json=self.json)

    def _components(self, kind: str) -> dict[str, str]:
        """Source of each component that is not built in, behind what it is if one kind is listed, which imports it."""
        from coliags_plugin.config.reference import plain_doc
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.core.registry import REGISTRIES

        texts = {}
        for name in REGISTRIES[kind]:
            source = REGISTRIES[kind].source(name)
            try:
                text = plain_doc(REGISTRIES[kind].get(name), "\n") if kind == self.kind else ""
            except InputError as error:
                text = error.seen
            texts[name] = text if source == "built in" else f"{text} ({source})".strip()
        return texts

    def _describe(self) -> None:
        from coliags_plugin.config.reference import options_of, plain_doc
        from coliags_plugin.config.yaml_tree import dump_inline
        from coliags_plugin.core.registry import REGISTRIES
        from coliags_plugin.reporting.model import Column
        from coliags_plugin.reporting.text_formats import DisplayTable

        registry = REGISTRIES[self.kind]
        target, source = registry.get(self.name), registry.source(self.name)
        described, choices, rates = plain_doc(target), options_of(target), getattr(target, "rates", {})
        tables = {
            ("option", "type", "default", "meaning"): [
                {
                    **each,
                    "option": each["name"],
                    "default": dump_inline(each["default"]) if "default" in each else "required",
                }
                for each in choices
            ],
            ("parameter group", "default rate"): [
                {"parameter group": group, "default rate": dump_inline(rate)} for group, rate in rates.items()
            ],
        }
        parts = [": ".join(filter(None, (f"{self.name} ({source})", described)))]
        for keys, rows in tables.items():
            parts += [str(DisplayTable("", [Column(key, words=True) for key in keys], rows))] if rows else []
        facts = {"description": described, "source": source, "options": choices, "parameter_groups": rates}
        print_summary("\n\n".join(parts), {"kind": self.kind, "name": self.name, **facts}, as_json=self.json)


@dataclass(frozen=True)
class ConfigCommand:
    """Show a method config with everything inherited, where each value comes from, and what it means."""

    method: options.Method
    """Name of a method (`coliags list methods`) or path of a YAML file."""
    set: options.Assignments = ()
    """Change a value, as for train."""

    def run(self) -> None:
        """Print YAML, with comments."""
        from coliags_plugin.config.method_config import load_method

        print(in_flags(load_method(self.method, self.set).annotated()), end="")


@dataclass(frozen=True)
class WeightsCommand:
    """Download the weights that LPIPS needs, or copy them; nothing else in this package downloads."""

    net: Annotated[
        Literal["vgg", "alex", "squeeze", "all"] | None,
        tyro.conf.arg(metavar="{vgg,alex,squeeze,all}", help_behavior_hint=""),
    ] = None
    """Backbone: VGG's has 528 MiB, AlexNet's 233, SqueezeNet's 5; default: vgg and squeeze, for the protocol paper."""
    folder: options.OptionalPath = None
    """Folder to install them in; default: torch's download cache, where LPIPS finds them."""
    from_folder: Annotated[options.OptionalPath, tyro.conf.arg(name="from")] = None
    """Copy the files from this folder instead of downloading them."""

    def run(self) -> None:
        """Install what is missing, and print where the weights of each net are."""
        from coliags_plugin.metrics.lpips import (
            DEFAULT_NETS,
            SOURCES,
            WEIGHTS_VARIABLE,
            find_weights,
            install,
            searched_folders,
        )

        nets = DEFAULT_NETS if self.net is None else tuple(SOURCES) if self.net == "all" else (self.net,)
        folder = None if self.folder is None else self.folder.resolve()
        written = install(nets, folder, self.from_folder)
        for net in nets:
            backbone, heads = find_weights(net, folder)
            print(f"LPIPS {net}: backbone {backbone}, linear heads {heads}")
        if not written:
            print("Everything was there already.")
        if folder is not None and folder not in searched_folders():
            print(f"Set {WEIGHTS_VARIABLE}={folder} for LPIPS to find them.")
