"""Coverage of a scene's recording, measured, compared with the truth where there is one, and written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.engine.progress import progress_callback
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import find_true_surface, read_true_surface
from coliags_plugin.surface.coverage.evaluation import Evaluation, evaluate_coverage
from coliags_plugin.surface.coverage.files import write_coverage
from coliags_plugin.surface.coverage.measure import Coverage, measure_coverage
from coliags_plugin.surface.coverage.scene_views import recorded_views
from coliags_plugin.surface.coverage.settings import CoverageSettings


@dataclass(frozen=True)
class MeasuredCoverage:
    """A measurement of coverage and the folder that it was written to.

    Attributes:
        folder: With ``coverage.json``, ``regions.csv``, ``map.png``, ``coverage.ply`` and ``coverage.html``.
        coverage: The measurement.
        evaluation: Against the truth; None without one.
    """

    folder: Path
    coverage: Coverage = field(repr=False)
    evaluation: Evaluation | None = field(repr=False, default=None)


def measure_scene(
    scene: Scene,
    mesh: TriangleMesh,
    output: Path,
    settings: CoverageSettings,
    truth: Path | None = None,
    overwrite: bool = False,
) -> MeasuredCoverage:
    """Measure the coverage of a recording and write it.

    Args:
        scene: The recording.
        mesh: The wall, mm, in the world of the scene.
        output: The folder to make.
        settings: What counts as seen.
        truth: True surface: a mesh in the world of the scene, mm, or the folder of a scene with one; None: that of the
            scene, where there is one.
        overwrite: Replace the folder where it exists.

    Raises:
        InputError: The unit of length is unknown, the mesh is not where the cameras look or is no tube around them, the
            truth cannot be read or is of another world, or the folder exists or cannot be written.
    """
    check_free(output, overwrite)
    views = recorded_views(scene)
    source = truth or find_true_surface(Path(scene.provenance.get("path", "")))
    true = None if source is None else read_true_surface(source, any_frame=True)
    with progress_callback() as progress:
        coverage = measure_coverage(mesh, views, settings, progress)
    evaluation = None if true is None else evaluate_coverage(coverage, true, views)
    write_coverage(coverage, views, output, scene.name, evaluation, overwrite)
    return MeasuredCoverage(output, coverage, evaluation)


def open_recording(path: Path) -> Scene:
    """A scene without initial points, whose images are read when they are used.

    Raises:
        InputError: It cannot be read.
    """
    return open_scene(path, None, ("initial_points=none", "keep_pixels=false"))


def check_free(folder: Path, overwrite: bool) -> None:
    """Refuse an output folder that exists, before any work is done.

    Raises:
        InputError: It exists and ``overwrite`` is off.
    """
    if not overwrite and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} already exists", "a new or empty folder", "Choose another, or pass --overwrite")
