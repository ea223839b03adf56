"""Evaluation of an estimated trajectory against a reference: alignment, ATE, rotation error and RPE.

Absolute trajectory error and relative pose error: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM
systems", IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.association import FrameMatches
from coliags_plugin.geometry.poses.rigid import inverse, rigid, rotation_angles_deg
from coliags_plugin.geometry.poses.similarity import Similarity, WorldRotation, umeyama, world_rotation
from coliags_plugin.geometry.poses.trajectory import Trajectory


@dataclass(frozen=True)
class ErrorStatistics:
    """Summary statistics of errors."""

    rmse: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: Float[np.ndarray, "N"]) -> ErrorStatistics:
        """Statistics of N errors, N > 0."""
        return cls(
            float(np.sqrt(np.mean(errors**2))), float(errors.mean()), float(np.median(errors)), float(errors.max())
        )


@dataclass(frozen=True, eq=False)
class Alignment:
    """Matched frames of an estimate aligned with a reference, and their errors."""

    matches: FrameMatches  # matched frames; ``first`` is the estimate's
    transform: Similarity  # from the estimate's world to the reference's, by the positions
    # Rotation between the worlds for the rotation error; that of ``transform`` unless the path is nearly straight.
    world_rotation: WorldRotation
    with_scale: bool  # whether the scale was estimated
    # The estimate after alignment, camera-to-world: positions by ``transform``, orientations by ``world_rotation``.
    estimate: Float[np.ndarray, "M 4 4"]
    reference: Float[np.ndarray, "M 4 4"]  # the reference, camera-to-world
    delta: int  # matched frames between the two poses of a relative error
    position_errors: Float[np.ndarray, "M"]  # distance of the centres, units of the reference as all lengths here
    rotation_errors_deg: Float[np.ndarray, "M"]  # angle between the cameras
    # RPE, P = M - delta.
    relative_translation_errors: Float[np.ndarray, "P"]
    relative_rotation_errors_deg: Float[np.ndarray, "P"]

    @property
    def ate(self) -> ErrorStatistics:
        """Absolute trajectory error, units of the reference."""
        return ErrorStatistics.of(self.position_errors)

    @property
    def path_length(self) -> float:
        """Length of the reference's path over the matched frames, units of the reference."""
        return float(np.linalg.norm(np.diff(self.reference[:, :3, 3], axis=0), axis=1).sum())

    @property
    def ate_share(self) -> float | None:
        """RMSE of the absolute trajectory error relative to the length of the path; None where there is no path."""
        length = self.path_length
        return self.ate.rmse / length if length > 0.0 else None

    @property
    def rotation_deg(self) -> ErrorStatistics:
        """Rotation error after alignment, degrees."""
        return ErrorStatistics.of(self.rotation_errors_deg)

    @property
    def rpe_translation(self) -> ErrorStatistics:
        """Translation part of the relative pose error, units of the reference."""
        return ErrorStatistics.of(self.relative_translation_errors)

    @property
    def rpe_rotation_deg(self) -> ErrorStatistics:
        """Rotation part of the relative pose error, degrees."""
        return ErrorStatistics.of(self.relative_rotation_errors_deg)

    def to_json(self, unit: str) -> dict[str, Any]:
        """All results as JSON values; ``unit`` names the reference's unit of length."""
        return {
            "unit": unit,
            "matched": len(self.matches),
            "matched_by": self.matches.by,
            "alignment": "Sim(3)" if self.with_scale else "SE(3)",
            "scale": self.transform.scale,
            "rotation": self.transform.rotation.tolist(),
            "translation": self.transform.translation.tolist(),
            "ate": vars(self.ate),
            "path_length": self.path_length,
            "ate_share_of_path": self.ate_share,
            "rotation_deg": vars(self.rotation_deg),
            "world_rotation": vars(self.world_rotation) | {"rotation": self.world_rotation.rotation.tolist()},
            "rpe_delta_frames": self.delta,
            "rpe_translation": vars(self.rpe_translation),
            "rpe_rotation_deg": vars(self.rpe_rotation_deg),
            "frames": {
                "estimate": self.matches.first.tolist(),
                "reference": self.matches.second.tolist(),
                "position_error": self.position_errors.tolist(),
                "rotation_error_deg": self.rotation_errors_deg.tolist(),
            },
        }


def align(
    estimate: Trajectory, reference: Trajectory, matches: FrameMatches, with_scale: bool = False, delta: int = 1
) -> Alignment:
    """Align the matched frames of an estimate with a reference, estimate first, and compute the errors.

    With ``with_scale`` by Sim(3) instead of SE(3), for an estimate of arbitrary scale; the two poses of a relative
    error are ``delta`` matched frames apart.
    """
    if not 1 <= delta < len(matches):
        raise InputError(
            f"a relative error over {delta} frames, and {len(matches)} matched frames",
            f"1 to {len(matches) - 1} frames",
            "Choose --delta accordingly",
        )
    estimated, true = estimate.camera_to_world[matches.first], reference.camera_to_world[matches.second]
    transform = umeyama(estimated[:, :3, 3], true[:, :3, 3], with_scale)
    rotation = world_rotation(estimated[:, :3, :3], true[:, :3, :3], transform)
    aligned = rigid(rotation.rotation @ estimated[:, :3, :3], transform.points(estimated[:, :3, 3]))
    # Relative motions in the camera frame: world frames cancel, the scale does not.
    difference = inverse(_motion(true, delta)) @ _motion(aligned, delta)
    return Alignment(
        matches=matches,
        transform=transform,
        world_rotation=rotation,
        with_scale=with_scale,
        estimate=aligned,
        reference=true,
        delta=delta,
        position_errors=np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1),
        rotation_errors_deg=rotation_angles_deg(true[:, :3, :3].transpose(0, 2, 1) @ aligned[:, :3, :3]),
        relative_translation_errors=np.linalg.norm(difference[:, :3, 3], axis=1),
        relative_rotation_errors_deg=rotation_angles_deg(difference[:, :3, :3]),
    )


def _motion(camera_to_world: np.ndarray, delta: int) -> np.ndarray:
    return np.asarray(inverse(camera_to_world[:-delta]) @ camera_to_world[delta:])
