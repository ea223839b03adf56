"""Reading, making and measuring of scenes in one call."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.config.assignments import assignments

if TYPE_CHECKING:
    from coliags_plugin.core.scenes import Scene
    from coliags_plugin.surface.coverage.writing import MeasuredCoverage


def load_scene(data: str | Path, data_format: str | None = None, settings: Mapping[str, Any] | None = None) -> Scene:
    """Read a scene.

    Args:
        data: The scene's folder.
        data_format: Name of a data manager; None: the one that recognises the folder.
        settings: Options of the data manager, for instance ``{"frame_step": 4}``.

    Raises:
        InputError: The folder is missing, of no known format or damaged, or an option is unknown.
    """
    from coliags_plugin.engine.data_formats import READING_IS_LONG, open_scene
    from coliags_plugin.engine.progress import progress_callback

    with progress_callback(after=READING_IS_LONG) as progress:
        return open_scene(Path(data), data_format, assignments(settings), progress)


def make_phantom(output: str | Path, /, *, overwrite: bool = False, **settings: Any) -> Path:
    """Generate a synthetic, physically lit colon with exact ground truth, in the layout of a dataset.

    Args:
        output: Folder to make.
        overwrite: Replace the folder where it exists.
        settings: Settings of the phantom (docs/phantom.md 6), for instance ``seed=1, light="strong", frames=60``.

    Returns:
        The folder, a scene to train on.

    Raises:
        InputError: A setting is unknown or invalid, or the folder exists or cannot be written.
    """
    from coliags_plugin.engine.progress import progress_callback
    from coliags_plugin.phantom.generate import generate
    from coliags_plugin.phantom.settings import phantom_settings

    with progress_callback() as progress:
        generate(phantom_settings(settings), Path(output), overwrite=overwrite, progress=progress)
    return Path(output)


def measure_scene_coverage(
    data: str | Path,
    mesh: str | Path,
    output: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> MeasuredCoverage:
    """Measure what a scene's recording shows of a mesh of the wall, without a run. Research use only.

    Args:
        data: The scene's folder.
        mesh: The wall, PLY, OBJ or GLB, in the world and unit of the poses.
        output: Folder to make.
        settings: What counts as seen, by name (docs/coverage.md 3).
        overwrite: Replace the folder where it exists.

    Raises:
        InputError: An option is unknown or invalid; the scene or the mesh cannot be read or do not belong together; or
            the folder exists or cannot be written.
    """
    from coliags_plugin.core.settings import validated
    from coliags_plugin.geometry.meshes.files import read_mesh
    from coliags_plugin.surface.coverage.settings import CoverageSettings
    from coliags_plugin.surface.coverage.writing import check_free, measure_scene, open_recording

    chosen, folder = validated(CoverageSettings, settings or {}, "coverage option"), Path(output)
    check_free(folder, overwrite)
    return measure_scene(open_recording(Path(data)), read_mesh(Path(mesh)), folder, chosen, overwrite)
