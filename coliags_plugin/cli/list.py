"""``coliags list``: list methods and components."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import tyro

from coliags_plugin.cli.arguments import AsJson
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class ListCommand:
    """List methods, benchmarks and registered components."""

    kind: tyro.conf.Positional[str] = "all"
    """A kind (methods, benchmarks, ablations, datamanagers, fields, renderers, ...); default: all of them."""
    json: AsJson = False

    def run(self) -> None:
        """Print names by kind, with the source of those that are not built in."""
        from coliags_plugin.comparison import named_files
        from coliags_plugin.comparison.ablations import ABLATIONS
        from coliags_plugin.config.method_files import method_descriptions
        from coliags_plugin.config.registry import REGISTRIES
        from coliags_plugin.core.errors import InputError, did_you_mean

        def sources(kind: str) -> dict[str, str]:
            named = {name: REGISTRIES[kind].source(name) for name in REGISTRIES[kind]}
            return {name: "" if source == "built in" else f"({source})" for name, source in named.items()}

        descriptions: dict[str, Callable[[], dict[str, str]]] = {
            "methods": method_descriptions,
            "benchmarks": named_files.descriptions,
            "ablations": partial(named_files.descriptions, ABLATIONS),
            **{kind: partial(sources, kind) for kind in REGISTRIES},
        }
        if self.kind not in ("all", *descriptions):
            raise InputError(
                f"no kind '{self.kind}'", f"one of {', '.join(descriptions)}", did_you_mean(self.kind, descriptions)
            )
        kinds = list(descriptions) if self.kind == "all" else [self.kind]
        listed = {kind: descriptions[kind]() for kind in kinds}
        lines = []
        for kind, rows in listed.items():
            indent = ""
            if self.kind == "all":
                lines.append(f"{kind}:")
                indent = "  "
            lines += [f"{indent}{name:<28}{text}".rstrip() for name, text in rows.items()]
        print_summary("\n".join(lines), listed, as_json=self.json)
