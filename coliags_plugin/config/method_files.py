"""Method configs by name: those shipped with the package, and those of other installed packages."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from coliags_plugin.config.registry import installed
from coliags_plugin.config.yaml_tree import read_tree
from coliags_plugin.core.errors import InputError

#: Entry points whose name is a method's, and whose value is the package that holds ``<name>.yaml``.
ENTRY_POINTS = "coliags_plugin.methods"
#: Folder among the shipped method configs that holds benchmarks and ablations instead.
BENCHMARKS = "benchmarks"


def method_names() -> list[str]:
    """Every method, ablations included."""
    return sorted(method_files())


def method_files() -> dict[str, Path]:
    """Files of all methods by name."""
    root = method_folder()
    paths = [path.relative_to(root) for path in root.rglob("*.yaml")]
    files = {path.with_suffix("").as_posix(): root / path for path in paths if path.parts[0] != BENCHMARKS}
    for entry in installed(ENTRY_POINTS):
        if entry.name in files:
            raise InputError(
                f"method '{entry.name}' of package {entry.value} is already there: {files[entry.name]}",
                "one method per name",
                "Rename one of the two",
            )
        files[entry.name] = _file_in(entry.value, entry.name)
    return files


def method_folder() -> Path:
    """Folder of the shipped method configs: inside the wheel, or beside the package in a checkout."""
    package = Path(__file__).parents[1]
    in_wheel = package / "method_configs"
    return in_wheel if in_wheel.is_dir() else package.parent / "method_configs"


def is_path(name: str) -> bool:
    """True for the path of a YAML file, not a name."""
    return name.endswith((".yaml", ".yml"))


def descriptions(files: Mapping[str, Path]) -> dict[str, str]:
    """The description, one line, of every file by name, sorted."""
    texts = {name: read_tree(path).value.get("description") for name, path in sorted(files.items())}
    return {name: "" if text is None else str(text.value) for name, text in texts.items()}


def _file_in(package: str, name: str) -> Path:
    """The file of a method in another package, which is not imported."""
    spec = find_spec(package)
    folders = list(spec.submodule_search_locations or []) if spec is not None else []
    for folder in folders:
        if (Path(folder) / f"{name}.yaml").is_file():
            return Path(folder) / f"{name}.yaml"
    raise InputError(
        f"entry point '{name}' in {ENTRY_POINTS} names package {package}, which has no {name}.yaml",
        "a package with that file",
        "Correct or uninstall it",
    )
