"""YAML files of benchmarks and ablations: shipped ones by name, a user's own by path."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from coliags_plugin.config.method_files import BENCHMARKS, method_folder
from coliags_plugin.config.yaml_tree import errors_with_origins, read_tree
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.settings import Settings

_Settings = TypeVar("_Settings", bound=Settings)


def shipped(folder: str = "") -> dict[str, Path]:
    """Files of a folder beside the method configs, by name."""
    files = {path.stem: path for path in (method_folder() / BENCHMARKS / folder).glob("*.yaml")}
    return dict(sorted(files.items()))


def is_path(name: str) -> bool:
    """Whether this is the path of a YAML file, not a name."""
    return name.endswith((".yaml", ".yml"))


def find_file(name: str, files: dict[str, Path], noun: str) -> Path:
    """The file of a name, or the path itself."""
    if is_path(name):
        return Path(name)
    if name not in files:
        raise InputError(f"no {noun} '{name}'", f"one of {', '.join(files)}, or a YAML file", did_you_mean(name, files))
    return files[name]


def read_settings(path: Path, content: type[_Settings], noun: str) -> _Settings:
    """Read and validate a file."""
    tree = read_tree(path)
    try:
        return content.model_validate(tree.plain())
    except ValidationError as error:
        raise InputError("\n".join(errors_with_origins(error, tree, noun))) from error


def descriptions(folder: str = "") -> dict[str, str]:
    """One line on every shipped file of a folder, by name."""
    texts = {}
    for name, path in shipped(folder).items():
        description = read_tree(path).value.get("description")
        texts[name] = "" if description is None else str(description.value)
    return texts
