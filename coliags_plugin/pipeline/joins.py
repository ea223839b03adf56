"""Joins of segments: the similarity between models of two segments that have posed the same frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.spatial.transform import Rotation
from typing_extensions import Self

from coliags_plugin.datamanagers.colmap import find_models, read_model
from coliags_plugin.geometry.poses.trajectory import inverse
from coliags_plugin.pipeline.survey import Segment

#: Fewest frames that both models have to have posed.
_FEWEST = 6
#: Largest residuals of a join: rotation in degrees, and position as a share of the median depth; and the largest ratio
#: of the depths of a point-wise scale to its median, as a share.
_ROTATION, _POSITION, _SCALE = 3.0, 0.1, 0.2
#: Error of a rotation matrix in double precision that is written as JSON.
_SKEW = 1e-4

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
#: A model of a segment: the segment's name, and the model's folder relative to the segment's scene.
ModelKey = tuple[str, str]


class SegmentJoin(BaseModel):
    """Result of comparing models of two segments."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    segments: tuple[str, str]
    models: tuple[str, str] = ("", "")  # folders, relative to the segments' scenes; empty where a side has none
    frames: int = 0  # posed in both
    joined: bool = False
    reason: str = ""  # why not
    #: similarity from the world of the second to that of the first; None where they are not joined. [4][4]
    transform: Annotated[list[Row], Field(min_length=4, max_length=4)] | None = None
    rotation_deg: float = 0.0  # residual of the shared frames, degrees
    position: float = 0.0  # residual of their positions, relative to the median depth

    @model_validator(mode="after")
    def _transform_of_joined(self) -> Self:
        if self.joined and (self.transform is None or not _is_similarity(np.array(self.transform))):
            raise ValueError("'transform' is no similarity, though 'joined' is true")
        return self

    @property
    def keys(self) -> tuple[ModelKey, ModelKey]:
        """The two models."""
        first, second = zip(self.segments, self.models, strict=True)
        return first, second


def _is_similarity(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """True if a matrix turns, scales and moves, and mirrors nothing."""
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not (1e-9 < scale < 1e9 and np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0))):
        return False
    turn = linear / scale
    return bool(np.abs(turn @ turn.T - np.eye(3)).max() < _SKEW)


@dataclass(frozen=True, eq=False)
class PosedFrames:
    """Frames of a model, by the stems of their names: poses, and median depths of the points that they see."""

    model: str  # folder, relative to the scene
    c2w: dict[str, Float[np.ndarray, "4 4"]]
    depths: dict[str, float]


def read_posed(scene: Path) -> list[PosedFrames]:
    """Read the models of a scene, the largest first."""
    models = []
    for folder in find_models(scene):
        model = read_model(folder)
        frames = PosedFrames(folder.relative_to(scene).as_posix(), {}, {})
        for image, c2w, w2c in zip(model.images, model.camera_to_world, inverse(model.camera_to_world), strict=True):
            if len(image.points):
                frames.c2w[Path(image.name).stem] = c2w
                z_depths = model.positions[image.points] @ w2c[2, :3] + w2c[2, 3]
                frames.depths[Path(image.name).stem] = float(np.median(z_depths))
        models.append(frames)
    return models


def find_joins(out: Path, segments: Sequence[Segment]) -> list[SegmentJoin]:
    """Joins of every two neighbouring segments in the folder of a reconstruction."""
    scenes = [out / segment.name / "poses" for segment in segments]
    posed = [read_posed(scene) if scene.is_dir() else [] for scene in scenes]
    places = list[SegmentJoin]()
    for (first, before), (second, after) in pairwise(zip(segments, posed, strict=True)):
        names, gap = (first.name, second.name), second.first - first.last - 1
        why = f"{gap} frames between them show nothing that can be followed"
        places += joins(names, before, after) if gap < 0 else [SegmentJoin(segments=names, reason=why)]
    return places


def joins(segments: tuple[str, str], first: list[PosedFrames], second: list[PosedFrames]) -> list[SegmentJoin]:
    """Joins of models of one segment with those of the next: of all that share frames, or why there is none."""
    tried = sorted((_join_models(segments, *pair) for pair in product(first, second)), key=lambda join: -join.frames)
    sharing = [join for join in tried if join.frames >= _FEWEST]
    return sharing or tried[:1] or [SegmentJoin(segments=segments, reason="no frame has a pose on one side")]


def _join_models(segments: tuple[str, str], first: PosedFrames, second: PosedFrames) -> SegmentJoin:
    """The similarity by which the shared cameras agree.

    The scale is that of the depths that the shared frames see, which are far less uncertain than the short way of the
    cameras between them.
    """
    names = sorted(first.c2w.keys() & second.c2w.keys())
    models = (first.model, second.model)
    if len(names) < _FEWEST:
        reason = f"{len(names)} frames have a pose on both sides, fewer than {_FEWEST}"
        return SegmentJoin(segments=segments, models=models, frames=len(names), reason=reason)
    ratios = np.array([first.depths[name] / second.depths[name] for name in names])
    scale = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios / scale - 1.0)))
    targets, sources = (np.array([frames.c2w[name] for name in names]) for frames in (first, second))
    turns = Rotation.from_matrix(targets[:, :3, :3] @ sources[:, :3, :3].transpose(0, 2, 1))
    turn = turns.mean()
    rotation = float(np.degrees(np.sqrt(np.mean((turns * turn.inv()).magnitude() ** 2))))
    offsets = targets[:, :3, 3] - scale * turn.apply(sources[:, :3, 3])
    shift, depth = offsets.mean(0), float(np.median([first.depths[name] for name in names]))
    position = float(np.sqrt(np.square(offsets - shift).sum(1).mean())) / depth
    reason = ""
    if rotation > _ROTATION or position > _POSITION or spread > _SCALE:
        reason = (
            f"the {len(names)} shared frames do not agree: cameras turned by {rotation:.1f} degrees, "
            f"{100.0 * position:.0f} % of the depth apart, scales differ by {100.0 * spread:.0f} %"
        )
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = scale * turn.as_matrix(), shift
    return SegmentJoin(
        segments=segments,
        models=models,
        frames=len(names),
        joined=not reason,
        reason=reason,
        transform=None if reason else transform.tolist(),
        rotation_deg=round(rotation, 3),
        position=round(position, 4),
    )
