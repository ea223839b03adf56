"""Which data manager reads a folder."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import PydanticCustomError

from coliags_plugin.config import registry
from coliags_plugin.config.components import Component, make_component
from coliags_plugin.config.method_config import LoadedMethod, MethodConfig, load_method, method_tree
from coliags_plugin.config.yaml_tree import Node, override_all
from coliags_plugin.contracts import DataManager
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.recorded import NoPointsError
from coliags_plugin.engine.progress import progress_callback

log = logging.getLogger(__name__)

#: Seconds of reading from which on it is worth saying how far it is.
READING_IS_LONG = 2.0
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
    found = _recognised(path)
    if not found:
        shown = sorted(item.name + "/" * item.is_dir() for item in path.iterdir()) if path.is_dir() else []
        holds = ", ".join(shown[:6]) + (f" and {len(shown) - 6} more" if len(shown) > 6 else "") or "nothing"
        raise InputError(
            f"{path} holds {holds}, which none of the formats {', '.join(known)} recognises",
            "a scene's own folder",
            "docs/data.md lists what each looks like; --format NAME chooses one and says what it misses. Pictures "
            "without poses become a scene by coliags poses track, if there is depth, or coliags poses sfm",
        )
    if len(found) > 1:
        seen = "; ".join(f"{name}: {reason}" for name, reason in found.items())
        raise InputError(f"{path} may be of several formats ({seen})", "one of them", "Choose with --format NAME")
    ((name, reason),) = found.items()
    log.info("%s: format %s (%s)", path, name, reason)
    return name


def _recognised(path: Path) -> dict[str, str]:
    """Why a folder is of a format, for each that recognises it."""
    known = (name for name in registry.datamanagers if name != AUTO)
    reasons = {name: registry.datamanagers.get(name).recognise(path) for name in known}
    return {name: reason for name, reason in reasons.items() if reason is not None}


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


def load_scene(config: MethodConfig, path: Path) -> Scene:
    """Read the data with the method's data manager; what takes long says how far it is.

    Raises:
        InputError: It cannot be read.
    """
    component = chosen_datamanager(config.datamanager, path)
    with progress_callback(after=READING_IS_LONG) as progress:
        scene: Scene = component.target(component.settings).load(path, progress)
    return scene


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
    given = override_all(Node({}, "options"), options).plain()
    try:
        return _opened(path, name, given, progress)
    except NoPointsError as error:
        log.warning("%s", error)
        return _opened(path, name, {**given, "initial_points": "none"}, progress)


def open_video(
    path: Path, data_format: str | None = None, options: Sequence[str] = (), progress: Progress | None = None
) -> tuple[Scene, bool]:
    """Read all frames of a video as training frames, for whoever finds their poses himself.

    Args:
        path: Its folder: a scene, or one of a format that can do without poses (``rgbd``).
        data_format: See :func:`open_scene`.
        options: See :func:`open_scene`; the split and initial points are not to be chosen.
        progress: Told how far reading is.

    Returns:
        The scene, and whether it has poses; where not, all its cameras are at the origin.

    Raises:
        InputError: See :func:`open_scene`.
    """
    options = (*options, "split=all-train", "initial_points=none")
    name = data_format or _unposed_format(path)
    if name is not None and registry.datamanagers.get(name).recognise_unposed(path):
        component = _component(name, override_all(Node({}, "options"), options).plain())
        manager: DataManager = component.target(component.settings)
        unposed = manager.without_poses()
        if unposed is not manager:
            log.info("%s: format %s without poses", path, name)
            return unposed.load(path, progress), False
    return open_scene(path, data_format, options, progress), True


def _unposed_format(path: Path) -> str | None:
    """The format of a folder that lacks its poses; None where a format recognises it with them, or none does."""
    if not path.exists() or _recognised(path):
        return None
    known = (name for name in registry.datamanagers if name != AUTO)
    return next((name for name in known if registry.datamanagers.get(name).recognise_unposed(path)), None)


def _opened(path: Path, name: str, options: Mapping[str, Any], progress: Progress | None) -> Scene:
    component = _component(name, options)
    scene: Scene = component.target(component.settings).load(path, progress)
    return scene


def _component(name: str, options: Mapping[str, Any]) -> Component:
    try:
        return make_component("datamanagers", {**options, "name": name})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(f"--set {key}: {first['msg']}", f"an option of the format {name}") from error
    except PydanticCustomError as error:
        raise InputError(error.message()) from error
