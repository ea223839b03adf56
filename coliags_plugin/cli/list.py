"""``coliags list``: list methods and components."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class List:
    """List methods, benchmarks and registered components."""

    kind: tyro.conf.Positional[str] = "all"
    """A kind (methods, benchmarks, ablations, datamanagers, fields, renderers, ...); default: all of them."""

    def run(self) -> None:
        """Print names by kind, with the source of those that are not built in."""
        from functools import partial

        from coliags_plugin.comparison import named_files
        from coliags_plugin.comparison.ablations import ABLATIONS
        from coliags_plugin.config.method_files import method_descriptions
        from coliags_plugin.config.registry import REGISTRIES
        from coliags_plugin.core.errors import InputError, did_you_mean

        described: dict[str, Callable[[], dict[str, str]]] = {
            "methods": method_descriptions,
            "benchmarks": named_files.descriptions,
            "ablations": partial(named_files.descriptions, ABLATIONS),
        }
        kinds = [*described, *REGISTRIES]
        if self.kind not in ("all", *kinds):
            raise InputError(f"no kind '{self.kind}'", f"one of {', '.join(kinds)}", did_you_mean(self.kind, kinds))
        for kind in kinds if self.kind == "all" else [self.kind]:
            if self.kind == "all":
                print(f"{kind}:")
            indent = "  " if self.kind == "all" else ""
            if kind in described:
                rows = described[kind]()
            else:
                sources = {name: REGISTRIES[kind].source(name) for name in REGISTRIES[kind]}
                rows = {name: "" if source == "built in" else f"({source})" for name, source in sources.items()}
            for name, text in rows.items():
                print(f"{indent}{name:<28}{text}".rstrip())
