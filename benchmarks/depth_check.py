"""Errors of estimated against true depth: absolute, free of scale, bias, and by stated confidence.

python benchmarks/depth_check.py ESTIMATE TRUTH --set split=all-train

Frames are matched by name; if no name is common, by index. The truth, dense or at single points, is read at the
estimate's pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from machine import show

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers.file_formats import resize_nearest
from coliags_plugin.engine.data_formats import open_scene

#: Relative error below which an estimate is good, as in the definition of the confidence, and bins of confidence.
WITHIN, BINS = 0.05, 10


@dataclass(frozen=True)
class Options:
    """Compare estimated with true depth."""

    estimate: tyro.conf.Positional[Path]
    """Scene with estimated depth."""
    truth: tyro.conf.Positional[Path]
    """Scene with true depth of the same undistorted images, dense or at single points."""
    set: tuple[str, ...] = field(default=())
    """Options of both data managers, for instance max_frames=20."""
    json: Path | None = None
    """Also write the rows here."""


def opened(path: Path, options: tuple[str, ...]) -> Scene:
    """A scene with all its depth, for which no initial points are needed."""
    return open_scene(path, options=(*options, "initial_points=none"))


def pairs(estimate: Scene, truth: Scene) -> list[tuple[Frame, Frame]]:
    """Frames of both with the same name, or as many in the same order."""
    named = {frame.name: frame for frame in truth.video}
    common = [(frame, named[frame.name]) for frame in estimate.video if frame.name in named]
    if not common and len(estimate.video) != len(truth.video):
        raise InputError(f"{len(estimate.video)} and {len(truth.video)} frames", "common names, or as many frames")
    return common or list(zip(estimate.video, truth.video, strict=True))


def samples(estimate: Frame, truth: Frame) -> np.ndarray:
    """Estimated depth, true depth and confidence, 1 without any, where the truth is known; NaN: no estimate. [N, 3]"""
    depth, camera = estimate.depth.numpy(), estimate.camera
    stated = np.ones_like(depth) if estimate.depth_confidence is None else estimate.depth_confidence.numpy()
    depth = np.where(estimate.valid.numpy() & (np.nan_to_num(depth) > 0.0), depth, np.nan)
    if truth.depth is not None:
        masked = np.where(truth.valid.numpy(), truth.depth.numpy(), np.nan)
        true, places = resize_nearest(masked, camera.width, camera.height), np.s_[:]
    else:
        factor = np.array([camera.width / truth.camera.width, camera.height / truth.camera.height])
        columns, rows = np.floor(truth.sparse_depth.pixels.double().numpy() * factor).astype(int).T
        places = rows.clip(0, camera.height - 1), columns.clip(0, camera.width - 1)
        true = truth.sparse_depth.depth.numpy()
    values = np.stack([depth[places], true, stated[places]], axis=-1).reshape(-1, 3).astype(np.float64)
    return values[np.nan_to_num(values[:, 1]) > 0.0]


def errors(what: str, estimated: np.ndarray, true: np.ndarray, confidence: np.ndarray) -> dict[str, Any]:
    """Errors of one set of pixels, and their mean confidence; NaN in the estimate: there is none."""
    has_estimate = np.isfinite(estimated)
    relative = estimated[has_estimate] / true[has_estimate] - 1.0
    size = np.abs(relative)
    row = {"pixels": what, "of truth %": 100.0 * has_estimate.mean() if len(has_estimate) else np.nan}
    shares = {"median %": np.median, "90th %": lambda values: np.quantile(values, 0.9)}
    row |= {name: 100.0 * float(of(size)) if len(size) else np.nan for name, of in shares.items()}
    row["within 5 %"] = 100.0 * float((size < WITHIN).mean()) if len(size) else np.nan
    row["stated %"] = 100.0 * float(confidence[has_estimate].mean()) if len(size) else np.nan
    row["bias %"] = 100.0 * float(np.median(relative)) if len(size) else np.nan
    row["median length"] = float(np.median(size * true[has_estimate])) if len(size) else np.nan
    return row


def rows_of(values: np.ndarray) -> list[dict[str, Any]]:
    """Errors as they are; times the median of true / estimated depth; and of each bin of confidence, scaled."""
    estimated, true, confidence = values.T
    has_estimate = np.isfinite(estimated)
    if not has_estimate.any():
        raise InputError("no pixel has both an estimate and a truth", "depth of the same frames")
    scale = float(np.median(true[has_estimate] / estimated[has_estimate]))
    rows = [errors("all", estimated, true, confidence)]
    rows.append(errors(f"all, times {scale:.4g}", scale * estimated, true, confidence))
    if (confidence != 1.0).any():
        bins = np.minimum((confidence * BINS).astype(int), BINS - 1)
        for number in np.unique(bins):
            inside = bins == number
            label = f"confidence {number / BINS:.1f} to {(number + 1) / BINS:.1f}"
            rows.append(errors(label, np.where(inside, scale * estimated, np.nan), true, confidence))
    return rows


def main(options: Options) -> None:
    """Print the errors over all pixels of all frames."""
    estimate, truth = opened(options.estimate, options.set), opened(options.truth, options.set)
    show(rows_of(np.concatenate([samples(*pair) for pair in pairs(estimate, truth)])), options.json)


if __name__ == "__main__":
    main(tyro.cli(Options))
