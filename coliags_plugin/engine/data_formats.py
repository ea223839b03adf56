"""Recognition of the format of a folder, and reading of scenes in it."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from coliags_plugin.config.method_config import LoadedMethod, MethodConfig, load_method, method_tree
from coliags_plugin.config.yaml_tree import Node, override_all
from coliags_plugin.contracts import DataManager
from coliags_plugin.core import registry
from coliags_plugin.core.components import Component, candidates, is_auto, named_component, with_options
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.scene_files import FRAME_SUFFIXES, files_in, inventory
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.recorded import NoPointsError
from coliags_plugin.engine.progress import progress_callback
from coliags_plugin.geometry.lenses.vicalib import calibration_files
from coliags_plugin.geometry.poses.trajectory import natural_order

log = logging.getLogger(__name__)

#: Median depth of scenes of unknown unit in training: with about the depth that colons have in mm, constants in mm
#: (docs/methods.md 4.4) have about the effect that they have on a colon.
UNKNOWN_MEDIAN_DEPTH = 30.0
#: Seconds of reading after which progress is reported.
READING_IS_LONG = 2.0
#: Suffixes of video files, in lower case.
_VIDEO_SUFFIXES = {*".3gp .avi .dv .flv .m2ts .m4v .mkv .mov .mp4 .mpeg .mpg .mts .mxf .ts .vob .webm .wmv".split()}


def formats() -> list[str]:
    """Names of all data managers that read a format of their own."""
    return candidates("datamanagers")


def find_format(path: Path) -> str:
    """The name of the one data manager that recognises a folder."""
    names = ", ".join(formats())
    if not path.exists():
        raise InputError(f"no folder {path}", f"a scene in one of the formats {names}", "Check the path")
    if path.is_file():
        raise _no_folder(path)
    evidence = recognised(path)
    if not evidence and (videos := videos_in(path)):
        raise _no_scene(path, f"{path} holds the video {videos[0].name}, and no scene")
    if not evidence:
        for name in formats():
            registry.datamanagers.get(name).refuse_nearly(path)
        raise InputError(
            f"{path} holds {inventory(path)}, which none of the formats {names} recognises",
            "a scene's own folder",
            "docs/data.md lists what each looks like; `data_format=NAME` chooses one and says what it misses. Images "
            "without poses become a scene by coliags poses sfm; beside depth, rgbd reads them with a TUM trajectory",
        )
    if len(evidence) > 1:
        listed = "; ".join(f"{name}: {reason}" for name, reason in evidence.items())
        raise InputError(
            f"{path} may be of several formats ({listed})", "one of them", "Choose with `data_format=NAME`"
        )
    ((name, reason),) = evidence.items()
    log.info("%s: format %s (%s)", path, name, reason)
    return name


def videos_in(folder: Path) -> list[Path]:
    """The videos of a recording's folder in natural order; none where images are there and no calibration file.

    A WebP beside a video is its preview.
    """
    videos = files_in(folder, _VIDEO_SUFFIXES)
    if files_in(folder, FRAME_SUFFIXES - {".webp"}) and not calibration_files(folder):
        return []
    return [videos[index] for index in natural_order([path.name for path in videos])]


def _no_scene(path: Path, seen: str) -> InputError:
    """Error for a recording that was given in the place of a scene's folder."""
    quoted = shlex.quote(str(path))
    makes = f"coliags reconstruct {quoted} --output FOLDER reconstructs it; coliags poses sfm {quoted} --output FOLDER"
    return InputError(seen, "a scene's folder", f"{makes} makes a scene with poses")


def _no_folder(path: Path) -> InputError:
    """Error for a file that was given in the place of a scene's folder."""
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        return _no_scene(path, f"{path} is a video")
    if recognised(path.parent):
        return InputError(f"{path} is a file of a scene", "the scene's folder", f"Give {shlex.quote(str(path.parent))}")
    return InputError(f"{path} is a file", "a scene's folder, as docs/data.md describes", "")


def recognised(path: Path) -> dict[str, str]:
    """Evidence in a folder for each format that recognises it, by the format's name."""
    reasons = {name: registry.datamanagers.get(name).recognise(path) for name in formats()}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def load_method_for(
    path: Path, method: str, overrides: Sequence[str] = (), data_format: str | None = None
) -> LoadedMethod:
    """A method config whose data manager is the one that reads ``path``.

    Options that the method gives to ``auto`` are those of the folder's format, those of the overrides too; options
    for another format are dropped. ``data_format`` names a data manager instead of what the method says or the files
    show.
    """
    named = method_tree(method, overrides).find(["datamanager", "name"]).value
    if is_auto("datamanagers", named):
        return load_method(method, overrides, data_format or find_format(path))
    chosen = [] if data_format is None else [f"datamanager.name={data_format}"]
    return load_method(method, [*chosen, *overrides])


def load_scene(config: MethodConfig, path: Path) -> Scene:
    """Read the data with the method's data manager and near plane, reporting progress when it takes long."""
    with progress_callback(after=READING_IS_LONG) as progress:
        scene = data_manager(config.datamanager, path).load(path, progress)
    return scene.with_near_plane(config.near_plane)


def training_scale(scene: Scene) -> float:
    """Factor on the lengths of a scene of unknown unit, by which constants in mm have about their usual effect.

    It makes the median depth of the points in view :data:`UNKNOWN_MEDIAN_DEPTH`; 1 where that is at most twice or half
    as large already, where no point tells it, or where the unit is known.
    """
    depths = scene.depths_in_view()
    median = float(depths.median()) if len(depths) and not scene.is_metric else UNKNOWN_MEDIAN_DEPTH
    factor = UNKNOWN_MEDIAN_DEPTH / median
    return 1.0 if 0.5 <= factor <= 2.0 else factor


def at_scale(scene: Scene, scale: float, near_plane: float) -> Scene:
    """A scene to train or render on, with a near plane; its provenance and the log tell the factor on its lengths."""
    if scale != 1.0:
        log.info("the unit of length of scene '%s' is unknown: used at %.4g times its size", scene.name, scale)
    provenance = scene.provenance.model_copy(update={"training_scale": scale})
    return replace(scene.scaled(scale).with_near_plane(near_plane), provenance=provenance)


def data_manager(component: Component, path: Path) -> DataManager:
    """The data manager of a config; of ``auto``, the one that recognises the folder."""
    is_open = is_auto("datamanagers", component.name)
    chosen = with_options(component, find_format(path)) if is_open else component
    manager: DataManager = chosen.target(chosen.settings)
    return manager


def open_scene(
    path: Path,
    data_format: str | None = None,
    options: Sequence[str] = (),
    progress: Progress | None = None,
    stored_size: bool = False,
) -> Scene:
    """Read a scene without a method, also one that has nothing to make initial points from.

    The format is the name of a data manager, or else of the one that recognises the folder; options are ``key=value``
    or ``datamanager.key=value`` of it, as in method configs. With ``stored_size``, images are read at their stored
    size, each when it is used, and without initial points.
    """
    name = find_format(path) if data_format is None else data_format
    if stored_size:
        return _manager(name, options).at_stored_size().load(path, progress)
    try:
        return _manager(name, options).load(path, progress)
    except NoPointsError as error:
        log.warning("%s", error)
        return _manager(name, options, initial_points="none").load(path, progress)


def _manager(name: str, options: Sequence[str], **more: str) -> DataManager:
    stripped = [option.removeprefix("datamanager.") for option in options]
    values = override_all(Node({}, "options"), stripped).plain()
    component = named_component("datamanagers", {**values, **more, "name": name}, "scene")
    manager: DataManager = component.target(component.settings)
    return manager
