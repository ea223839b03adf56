"""Where the shipped method configs lie, and what they are called."""

from __future__ import annotations

from pathlib import Path

from coliags_plugin.config.yaml_tree import read_tree


def method_names() -> list[str]:
    """Every shipped method, ablations included."""
    root = method_folder()
    return sorted(path.relative_to(root).with_suffix("").as_posix() for path in root.rglob("*.yaml"))


def method_folder() -> Path:
    """Where the shipped method configs lie: inside the wheel, or beside the package in a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "method_configs"
    return installed if installed.is_dir() else package.parent / "method_configs"


def method_descriptions() -> dict[str, str]:
    """One line on every shipped method, by name."""
    found = {}
    for name in method_names():
        description = read_tree(method_folder() / f"{name}.yaml").value.get("description")
        found[name] = str(description.value) if description is not None else ""
    return found
