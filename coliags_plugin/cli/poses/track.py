"""``coliags poses track``: RGB-D odometry, poses from images and depth."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary, train_command

if TYPE_CHECKING:
    from coliags_plugin.core.scenes import Scene
    from coliags_plugin.reconstruction.odometry.tracking import Tracking

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PosesTrackCommand:
    """Estimate the poses of a video from its images and depth, ignoring given poses; write it as a scene."""

    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    """A scene, or a folder with colour, depth and intrinsics but without poses."""
    output: arguments.Output
    """Folder to create, in the layout of `rgbd`."""
    set: arguments.Assignments = ()
    """An option of the data manager, as width=675, or of tracking, as tracking.method=hybrid."""
    format: arguments.DataFormat = None
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Track, write the scene and print a summary."""
        from coliags_plugin.datamanagers.rgbd.writer import write_rgbd_scene
        from coliags_plugin.engine.data_formats import open_video
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reconstruction.odometry.frames import RgbdVideo
        from coliags_plugin.reconstruction.odometry.settings import TrackingSettings
        from coliags_plugin.reconstruction.odometry.tracking import track

        arguments.refuse_output(self.output, self.scene, self.overwrite)
        settings, options = arguments.settings_among(TrackingSettings, self.set, "tracking.")
        with progress_callback() as progress:
            scene, posed = open_video(self.scene, self.format, options, progress)
            tracking = track(RgbdVideo(scene.train), scene.train[0].camera.intrinsics, settings, progress)
            trajectory = write_rgbd_scene(
                self.output,
                scene.train,
                tracking.camera_to_world,
                unit=scene.provenance["unit"],
                overwrite=self.overwrite,
                progress=progress,
            )
        _warn_of_losses(tracking)
        lines = [*_described(tracking), *([_errors(tracking, scene)] if posed else [])]
        print_summary(
            "\n".join(lines), written=[trajectory, self.output], then=[train_command(self.output)], as_json=self.json
        )


def _warn_of_losses(tracking: Tracking) -> None:
    """Log a warning that names the lost frames, whose poses are guesses."""
    import numpy as np

    lost = np.flatnonzero(~tracking.tracked)
    if len(lost):
        shown = ", ".join(map(str, lost[:8])) + (f" and {len(lost) - 8} more" if len(lost) > 8 else "")
        _LOG.warning("frames %s are lost: their poses are guesses at constant velocity", shown)
    for before, after in tracking.jumps:
        _LOG.warning(
            "no motion was found between frames %d and %d: the relative pose of the two segments is a guess",
            before,
            after,
        )


def _described(tracking: Tracking) -> list[str]:
    lines = [
        f"{len(tracking.tracked)} frames, {int(tracking.tracked.sum())} tracked by {tracking.term}; lost edges: "
        f"{len(tracking.failed)} of {len(tracking.tracked) - 1}",
        f"between neighbours: fitness {tracking.fitness:.3f}, inlier RMSE {tracking.depth_rmse:.4g} in the unit "
        f"of the depth (mm in C3VD), "
        f"correlation of brightness {tracking.correlation:.3f}",
    ]
    if tracking.further or tracking.dropped or tracking.refused:
        lines.append(
            f"pose graph: {len(tracking.further)} further edges, {len(tracking.dropped)} dropped as outliers, "
            f"{tracking.refused} pairs that could not be registered"
        )
    return lines


def _errors(tracking: Tracking, scene: Scene) -> str:
    """Trajectory errors against the scene's own poses, which the tracking did not use."""
    import numpy as np

    from coliags_plugin.geometry.poses.alignment import align
    from coliags_plugin.geometry.poses.association import FEWEST_MATCHES, associate
    from coliags_plugin.geometry.poses.trajectory import Trajectory

    if len(scene.train) < FEWEST_MATCHES:
        return f"against the scene's own poses: no errors for fewer than {FEWEST_MATCHES} frames"
    given = Trajectory(np.stack([frame.camera.camera_to_world.double().numpy() for frame in scene.train]))
    estimate = Trajectory(tracking.camera_to_world)
    result = align(estimate, given, associate(estimate, given, "index"))
    share = result.ate_share
    of_path = "" if share is None else f" ({100.0 * share:.3g} % of the path, {result.path_length:.4g})"
    rpe, turn = result.rpe_translation, result.rpe_rotation_deg
    return (
        f"against the scene's own poses: ATE rmse {result.ate.rmse:.4g}{of_path}, max {result.ate.max:.4g}; "
        f"RPE over 1 frame rmse {rpe.rmse:.4g} and {turn.rmse:.4g} deg"
    )
