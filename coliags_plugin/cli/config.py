"""``coliags config show``: print a resolved method config."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import Assignments


@dataclass(frozen=True)
class ConfigCommand:
    """Show a method config with everything inherited and every default filled in."""

    action: tyro.conf.Positional[Literal["show"]]
    """What to do."""
    method: tyro.conf.Positional[str]
    """Name of a method or path of a YAML file."""
    origin: bool = False
    """Also print the file and line, option or default that each value comes from."""
    set: Assignments = ()
    """Change a value, as for train."""

    def run(self) -> None:
        """Print YAML."""
        from coliags_plugin.config.method_config import load_method

        loaded = load_method(self.method, self.set)
        print(loaded.with_origins() if self.origin else loaded.config.to_yaml(), end="")
