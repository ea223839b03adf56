"""``coliags poses triangulate``: triangulate surface points of a scene with known poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import depth_commands, print_summary

if TYPE_CHECKING:
    from collections.abc import Sequence

    from coliags_plugin.core.scenes import Frame, Scene
    from coliags_plugin.datamanagers.splits import Split

#: Prefix of the triangulation options; all others are the data manager's.
_OWN = "triangulation."


@dataclass(frozen=True)
class PosesTriangulateCommand:
    """Triangulate surface points of a posed video; write it as a scene with initial points and sparse depth."""

    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    """The scene's folder."""
    output: arguments.Output
    """Folder to create, in COLMAP's layout."""
    set: arguments.Assignments = ()
    """An option of the data manager, as width=675, or of triangulation, as triangulation.min_angle=1."""
    format: arguments.DataFormat = None
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Triangulate the training frames, write all frames and print a summary."""
        import logging

        from coliags_plugin.cli.scene_outputs import refuse_output, settings_among
        from coliags_plugin.engine.data_formats import open_scene
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reconstruction.structure.colmap_scene import write_colmap_scene
        from coliags_plugin.reconstruction.structure.triangulation import (
            TriangulationSettings,
            in_pixels_of,
            triangulate,
        )

        refuse_output(self.output, self.scene, self.overwrite)
        settings, options = settings_among(TriangulationSettings, self.set, _OWN)
        with progress_callback() as progress:
            # Initial points are not needed here unless requested.
            scene = open_scene(self.scene, self.format, ["initial_points=none", *options], progress)
            detected = self._at_stored_size(scene, options) if scene.is_resized else scene.train
            points = in_pixels_of(triangulate(detected, settings, progress), detected, scene.train)
        test, split = _held_out(scene)
        unit: Literal["mm", "unknown"] = "mm" if scene.is_metric else "unknown"
        write_colmap_scene(self.output, scene.train, points, test, self.overwrite, unit)
        log = logging.getLogger(__name__)
        if test:
            log.info(
                "points come from the %d training frames; the %d test frames see none", len(scene.train), len(test)
            )
        print_summary(
            points.summary(), written=[self.output], then=depth_commands(self.output, split), as_json=self.json
        )

    def _at_stored_size(self, scene: Scene, options: list[str]) -> Sequence[Frame]:
        """The training frames at the stored size, where more features are found than at a smaller one."""
        import logging

        from coliags_plugin.engine.data_formats import open_scene

        stored = scene.provenance["stored_size"]
        logging.getLogger(__name__).info("features are detected at the stored size, %d x %d", *stored)
        return open_scene(self.scene, self.format, options, stored_size=True).train


def _held_out(scene: Scene) -> tuple[list[Frame], list[str]]:
    """Test frames kept in the written scene, and the options that restore its split."""
    import logging

    from coliags_plugin.datamanagers.splits import held_out

    log = logging.getLogger(__name__)
    test = list(scene.test_sets.get("test", ()))
    others = {name: len(frames) for name, frames in scene.test_sets.items() if name != "test"}
    if others:
        log.warning(
            "left out: %s, which COLMAP's layout does not support",
            ", ".join(f"test set {name} ({count} frames)" for name, count in others.items()),
        )
    chosen = scene.provenance.get("split", {})
    block = tuple(chosen.get("block", (0.4, 0.6)))
    video = scene.video
    test_indices = {frame.index for frame in test}
    is_test = [frame.index in test_indices for frame in video]
    options: dict[Split, list[str]] = {
        "every-8th": [],
        "endogslam": ["datamanager.split=endogslam"],
        "all-train": ["datamanager.split=all-train"],
        "block": ["datamanager.split=block", f"datamanager.block=[{block[0]:g}, {block[1]:g}]"],
    }
    for split, assignments in options.items():
        if held_out(split, len(video), (block[0], block[1])).tolist() == is_test:
            return test, assignments
    log.warning("left out: the %d test frames, as COLMAP's layout cannot mark test frames", len(test))
    return [], options["all-train"]
