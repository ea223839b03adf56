"""Coverage of scenes with a mesh of their own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coliags_plugin.surface.coverage.writing import MeasuredCoverage


def measure_scene_coverage(
    data: str | Path,
    mesh: str | Path,
    output: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    truth: str | Path | None = None,
    overwrite: bool = False,
) -> MeasuredCoverage:
    """Measure what a scene's recording shows of a mesh of the wall, without a run. Research use only.

    Args:
        data: The scene's folder.
        mesh: The wall, PLY, OBJ or GLB, in mm in the world of the poses.
        output: Folder to make.
        settings: What counts as seen, by name (docs/coverage.md 3).
        truth: See :meth:`Run.coverage`.
        overwrite: Replace the folder where it exists.

    Raises:
        InputError: An option is unknown or invalid; the scene, the mesh or the truth cannot be read, do not belong
            together, or are not in mm; or the folder exists or cannot be written.
    """
    from coliags_plugin.core.settings import validated
    from coliags_plugin.geometry.meshes.files import read_mesh
    from coliags_plugin.surface.coverage.settings import CoverageSettings
    from coliags_plugin.surface.coverage.writing import check_free, measure_scene, open_recording

    chosen, folder = validated(CoverageSettings, settings or {}, "coverage option"), Path(output)
    check_free(folder, overwrite)
    other = None if truth is None else Path(truth)
    return measure_scene(open_recording(Path(data)), read_mesh(Path(mesh)), folder, chosen, other, overwrite)
