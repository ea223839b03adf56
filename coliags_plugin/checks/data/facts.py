"""Statistics of a scene's depth, camera path, images and lighting."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy.stats
import torch
from jaxtyping import Float

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scenes import Frame

#: Largest number of frames sampled for depth and image statistics.
_FRAMES = 64
#: For the correlation of brightness and distance: largest number of frames and of pixels per frame, and fewest pixels.
_LAMP_FRAMES, _LAMP_PIXELS, _LAMP_MIN_PIXELS = 16, 4000, 30
#: Grey levels outside these are clipped.
_DARKEST, _BRIGHTEST = 3, 253
#: Smallest ratio of the 90th to the 10th percentile of the distances in a frame.
_MIN_DEPTH_RATIO = 1.15


def sampled_frames(frames: Sequence[Frame], count: int = _FRAMES) -> list[Frame]:
    """Evenly spaced sample of the frames, at most ``count``."""
    indices = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), count)).astype(int))
    return [frames[index] for index in indices]


def depth_facts(frames: Sequence[Frame]) -> JsonObject | None:
    """Statistics of z-depth, scene units; shares are of the unmasked pixels. None where no frame has depth."""
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
    quantiles = np.quantile(values, (0.01, 0.5, 0.99)).tolist() if len(values) else [math.nan] * 3
    shares = {"invalid_share": 1.0 - len(values) / pixels, "clipped_share": clipped / pixels}
    return dict(zip(("nearest", "median", "farthest"), quantiles, strict=True)) | shares


def path_facts(video: Sequence[Frame]) -> JsonObject | None:
    """Camera path: lengths in scene units, ``turn`` in degrees; None for fewer than two frames."""
    if len(video) < 2:
        return None
    poses = np.stack([frame.camera.camera_to_world.double().numpy() for frame in video])
    centers = poses[:, :3, 3]
    lengths = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    # Divided by the index difference, so that skipped frames do not look like jumps.
    steps = lengths / np.maximum(1, np.diff([frame.index for frame in video]))
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    cosines = np.clip((np.trace(relative, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    return {
        "length": float(lengths.sum()),
        "mean_step": float(steps.mean()),
        "moving_step": moving_step(steps),
        "largest_step": float(steps.max()),
        "largest_step_at": video[int(steps.argmax()) + 1].name,
        "extent": float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max() * 2.0),
        "turn": float(np.degrees(np.arccos(cosines)).sum()),
    }


def moving_step(steps: Float[np.ndarray, "N"]) -> float:
    """Typical step of a camera while it moves: half of the path is made of shorter steps.

    Pauses, which have no length, do not count, nor do jumps: the longest tenth of the steps is left out.
    """
    jumps = max(len(steps) // 10, min(2, len(steps) // 3))
    ordered = np.sort(steps)[: len(steps) - jumps]
    lengths = np.cumsum(ordered)
    return float(ordered[np.searchsorted(lengths, 0.5 * lengths[-1])])


def camera_facts(frames: Sequence[Frame]) -> list[JsonObject]:
    """Intrinsics of each camera, px, with its first frame: how far off the middle, fx / fy, and degrees across."""
    facts: dict[Intrinsics, JsonObject] = {}
    for frame in frames:
        k = frame.camera.intrinsics
        derived = {
            "frame": frame.name,
            "off_middle": max(abs(k.cx / k.width - 0.5), abs(k.cy / k.height - 0.5)),
            "ratio": k.fx / k.fy,
            "angle": angle_across(k),
        }
        facts.setdefault(k, vars(k) | derived)
    return list(facts.values())


def angle_across(pinhole: Intrinsics) -> float:
    """Horizontal field of view, degrees."""
    return 2.0 * math.degrees(math.atan(0.5 * pinhole.width / pinhole.fx))


def image_facts(frames: Sequence[Frame]) -> JsonObject:
    """Intensities of frames in video order, grey levels; shares of the unmasked pixels; names of repeated frames."""
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
    return {
        "mean": float(np.mean(means)),
        "darkest_frame": float(min(means)),
        "darkest_at": frames[int(np.argmin(means))].name,
        "brightest_frame": float(max(means)),
        "overexposed_share": float(np.mean(over)),
        "masked_share": float(np.mean(masked)),
        "repeated": repeated,
    }


def lamp_facts(frames: Sequence[Frame]) -> JsonObject | None:
    """Rank correlation (Spearman's) of brightness with distance within frames: median, share above 0, and their number.

    It is -1 where every farther pixel is darker, as under a lamp at the camera. None where no frame has enough depth.
    """
    values = [_correlation(frame) for frame in sampled_frames(frames, _LAMP_FRAMES)]
    known = np.array([value for value in values if value is not None])
    if not len(known):
        return None
    return {"correlation": float(np.median(known)), "rising_share": float(np.mean(known > 0.0)), "frames": len(known)}


def _correlation(frame: Frame) -> float | None:
    """Correlation in one frame, from its dense depth or else its single points; None if too few or equally far."""
    pixels, depth = _known_depth(frame)
    brightness = frame.image.numpy()[pixels[:, 1], pixels[:, 0]]
    clear = (brightness.min(axis=1) > _DARKEST) & (brightness.max(axis=1) < _BRIGHTEST)
    clear &= frame.valid.numpy()[pixels[:, 1], pixels[:, 0]]
    if clear.sum() < _LAMP_MIN_PIXELS:
        return None
    rays = frame.camera.rays_at(torch.from_numpy(pixels[clear])).double().norm(dim=1).numpy()
    distance = depth[clear] * rays
    near, far = np.quantile(distance, (0.1, 0.9))
    mean = brightness[clear].mean(axis=1)
    if far < _MIN_DEPTH_RATIO * near or mean.min() == mean.max():
        return None
    return float(scipy.stats.spearmanr(mean, distance).statistic)


def _known_depth(frame: Frame) -> tuple[np.ndarray, Float[np.ndarray, "K"]]:
    """Columns and rows of pixels of known depth [K, 2], and their z-depth [K]."""
    dense, sparse = frame.depth, frame.sparse_depth
    if dense is not None:
        row, column = np.nonzero(np.isfinite(dense.numpy()))
        every = max(1, len(row) // _LAMP_PIXELS)
        row, column = row[::every], column[::every]
        return np.stack([column, row], axis=1), dense.numpy()[row, column].astype(np.float64)
    if sparse is None:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    limits = np.array([frame.camera.width, frame.camera.height]) - 1
    return sparse.pixels.floor().long().numpy().clip(0, limits), sparse.depth.double().numpy()
