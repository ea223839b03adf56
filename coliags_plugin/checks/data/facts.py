"""Statistics of a scene's depth, camera path and images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from coliags_plugin.core.scenes import Frame

#: Largest number of frames sampled for depth and image statistics.
_LOOKED_AT = 64


@dataclass(frozen=True)
class DepthFacts:
    """z-depth of the sampled frames, scene units; shares of the unmasked pixels."""

    nearest: float
    median: float
    farthest: float
    invalid_share: float
    clipped_share: float


@dataclass(frozen=True)
class PathFacts:
    """Camera path: lengths in scene units, rotation in degrees; ``moving_step`` as of :func:`moving_step`."""

    length: float
    mean_step: float
    moving_step: float
    largest_step: float
    largest_step_at: str
    extent: float
    turn: float


@dataclass(frozen=True)
class ImageFacts:
    """Intensities of the sampled frames, grey levels; shares of the unmasked pixels."""

    mean: float
    darkest_frame: float
    darkest_at: str
    brightest_frame: float
    overexposed_share: float
    masked_share: float
    repeated: tuple[str, ...]


def sampled_frames(frames: Sequence[Frame]) -> list[Frame]:
    """Evenly spaced sample of the frames, at most 64."""
    places = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _LOOKED_AT)).astype(int))
    return [frames[place] for place in places]


def depth_facts(frames: Sequence[Frame]) -> DepthFacts | None:
    """Depth statistics, None where no frame has depth."""
    known, pixels, clipped = [], 0, 0
    for frame in frames:
        depth, bound = frame.depth, frame.depth_at_least
        if depth is None:
            continue
        inside = depth[frame.valid]
        pixels += len(inside)
        clipped += 0 if bound is None else int(torch.isfinite(bound[frame.valid]).sum())
        known.append(inside[torch.isfinite(inside)])
    if not pixels:
        return None
    values = torch.cat(known).double().numpy()
    if not len(values):
        return DepthFacts(math.nan, math.nan, math.nan, 1.0, clipped / pixels)
    nearest, median, farthest = (float(value) for value in np.quantile(values, (0.01, 0.5, 0.99)))
    return DepthFacts(nearest, median, farthest, 1.0 - len(values) / pixels, clipped / pixels)


def path_facts(video: Sequence[Frame]) -> PathFacts | None:
    """Path statistics, None for fewer than two frames."""
    if len(video) < 2:
        return None
    poses = np.stack([frame.camera.camera_to_world.double().numpy() for frame in video])
    centers = poses[:, :3, 3]
    lengths = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    # Divided by the index difference, so that skipped frames do not look like jumps.
    steps = lengths / np.maximum(1, np.diff([frame.index for frame in video]))
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    cosines = np.clip((np.trace(relative, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    return PathFacts(
        length=float(lengths.sum()),
        mean_step=float(steps.mean()),
        moving_step=moving_step(steps),
        largest_step=float(steps.max()),
        largest_step_at=video[int(steps.argmax()) + 1].name,
        extent=float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max() * 2.0),
        turn=float(np.degrees(np.arccos(cosines)).sum()),
    )


def moving_step(steps: Float[np.ndarray, "N"]) -> float:
    """Typical step of a camera while it moves: half of the path is made of shorter steps.

    Pauses, which have no length, do not count, nor do jumps: the longest tenth of the steps is left out.

    Args:
        steps: Distances between successive cameras, at least one.
    """
    jumps = max(len(steps) // 10, min(2, len(steps) // 3))
    ordered = np.sort(steps)[: len(steps) - jumps]
    walked = np.cumsum(ordered)
    return float(ordered[np.searchsorted(walked, 0.5 * walked[-1])])


def image_facts(frames: Sequence[Frame]) -> ImageFacts:
    """Image statistics of frames in video order."""
    means, over, masked, repeated = [], [], [], []
    before: torch.Tensor | None = None
    for frame in frames:
        image, valid = frame.image, frame.valid
        inside = image[valid].float()
        means.append(float(inside.mean()) if len(inside) else 0.0)
        over.append(float((inside >= 254).all(dim=1).float().mean()) if len(inside) else 0.0)
        masked.append(1.0 - float(valid.float().mean()))
        if before is not None and before.shape == image.shape and torch.equal(before, image):
            repeated.append(frame.name)
        before = image
    return ImageFacts(
        mean=float(np.mean(means)),
        darkest_frame=float(min(means)),
        darkest_at=frames[int(np.argmin(means))].name,
        brightest_frame=float(max(means)),
        overexposed_share=float(np.mean(over)),
        masked_share=float(np.mean(masked)),
        repeated=tuple(repeated),
    )
