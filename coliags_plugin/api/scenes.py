"""Reading and making of scenes in one call."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.config.assignments import assignments

if TYPE_CHECKING:
    from coliags_plugin.core.scenes import Scene


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
