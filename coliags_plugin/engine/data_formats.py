"""Which data manager reads a folder."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import PydanticCustomError

from coliags_plugin import registry
from coliags_plugin.components import Component, make_component
from coliags_plugin.config import LoadedMethod, load_method, method_tree
from coliags_plugin.datamanagers.recorded import NoPointsError
from coliags_plugin.errors import InputError
from coliags_plugin.progress import Progress
from coliags_plugin.scenes import Scene
from coliags_plugin.yaml_tree import Node, override

log = logging.getLogger(__name__)

#: Stands for the format that the files show.
AUTO = "auto"


def find_format(path: Path) -> str:
    """The name of the data manager that recognises a folder.

    Raises:
        InputError: The folder is missing, or none or several do.
    """
    known = [name for name in registry.datamanagers if name != AUTO]
    if not path.exists():
        raise InputError(f"no folder {path}", f"a scene in one of the formats {', '.join(known)}", "Check the path")
    reasons = {name: registry.datamanagers.get(name).recognise(path) for name in known}
    found = {name: reason for name, reason in reasons.items() if reason is not None}
    if not found:
        shown = sorted(item.name + "/" * item.is_dir() for item in path.iterdir()) if path.is_dir() else []
        holds = ", ".join(shown[:6]) + (f" and {len(shown) - 6} more" if len(shown) > 6 else "") or "nothing"
        raise InputError(
            f"{path} holds {holds}, which none of the formats {', '.join(known)} recognises",
            "a scene's own folder",
            "docs/data.md lists what each looks like; --format NAME chooses one and says what it misses",
        )
    if len(found) > 1:
        seen = "; ".join(f"{name}: {reason}" for name, reason in found.items())
        raise InputError(f"{path} may be of several formats ({seen})", "one of them", "Choose with --format NAME")
    ((name, reason),) = found.items()
    log.info("%s: format %s (%s)", path, name, reason)
    return name


def chosen_datamanager(component: Component, path: Path) -> Component:
    """The component itself, or for ``auto`` the one that the folder asks for, with the options that were given.

    Raises:
        InputError: See :func:`find_format`.
    """
    if component.name != AUTO:
        return component
    given = component.settings.model_dump(include=component.settings.model_fields_set)
    return make_component(component.kind, {"name": find_format(path), **given})


def load_method_for(
    path: Path, method: str, overrides: Sequence[str] = (), data_format: str | None = None
) -> LoadedMethod:
    """A method config whose data manager is the one that reads ``path``.

    Args:
        path: The scene's folder.
        method: Name or path of a method config.
        overrides: ``key.path=value`` assignments; options of the folder's own format are welcome among them.
        data_format: A data manager's name, instead of what the method says or the files show.

    Raises:
        InputError: No such method or format, or the config is not valid, or see :func:`find_format`.
    """
    if data_format is None and method_tree(method, overrides).find(["datamanager", "name"]).value == AUTO:
        data_format = find_format(path)
    chosen = [] if data_format is None else [f"datamanager.name={data_format}"]
    return load_method(method, [*chosen, *overrides])


def open_scene(
    path: Path, data_format: str | None = None, options: Sequence[str] = (), progress: Progress | None = None
) -> Scene:
    """Read a scene without a method, also one that has nothing to make initial points from.

    Args:
        path: Its folder.
        data_format: A data manager's name; None: the one that recognises the folder.
        options: ``key=value`` options of that data manager.
        progress: Told how far reading is.

    Raises:
        InputError: See :func:`find_format`; an option is unknown; or the scene cannot be read.
    """
    name = find_format(path) if data_format is None else data_format
    tree = Node({}, "options")
    for option in options:
        tree = override(tree, option)
    try:
        return _opened(path, name, tree.plain(), progress)
    except NoPointsError as error:
        log.warning("%s", error)
        return _opened(path, name, {**tree.plain(), "initial_points": "none"}, progress)


def _opened(path: Path, name: str, options: Mapping[str, Any], progress: Progress | None) -> Scene:
    try:
        component = make_component("datamanagers", {**options, "name": name})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(f"--set {key}: {first['msg']}", f"an option of the format {name}") from error
    except PydanticCustomError as error:
        raise InputError(error.message()) from error
    scene: Scene = component.target(component.settings).load(path, progress)
    return scene
