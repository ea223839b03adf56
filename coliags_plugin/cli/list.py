"""``coliags list``: list methods and components."""

from __future__ import annotations

from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class List:
    """List methods and registered components."""

    kind: tyro.conf.Positional[str] = "all"
    """A kind (methods, datamanagers, fields, renderers, ...); default: all of them."""

    def run(self) -> None:
        """Print names by kind, with the source of those that are not built in."""
        from coliags_plugin.config.method_files import method_descriptions
        from coliags_plugin.config.registry import REGISTRIES
        from coliags_plugin.core.errors import InputError, did_you_mean

        kinds = ["methods", *REGISTRIES]
        if self.kind not in ("all", *kinds):
            raise InputError(f"no kind '{self.kind}'", f"one of {', '.join(kinds)}", did_you_mean(self.kind, kinds))
        for kind in kinds if self.kind == "all" else [self.kind]:
            if self.kind == "all":
                print(f"{kind}:")
            indent = "  " if self.kind == "all" else ""
            if kind == "methods":
                rows = method_descriptions()
            else:
                sources = {name: REGISTRIES[kind].source(name) for name in REGISTRIES[kind]}
                rows = {name: "" if source == "built in" else f"({source})" for name, source in sources.items()}
            for name, text in rows.items():
                print(f"{indent}{name:<28}{text}".rstrip())
