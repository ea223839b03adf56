"""PSNR of held-out frames interpolated from their neighbours in the video: a baseline for renderings.

``python benchmarks/interpolated_frames.py SCENE [datamanager.split=inner-8th ...]`` prints means over the held-out
frames that have a training frame directly before and after them: of the more similar one, of the mean of both, and of
the mean of both moved halfway along dense optical flow (OpenCV's DIS).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.data_formats import open_scene


def psnr(made: Float[np.ndarray, "H W 3"], frame: Frame) -> float:
    """PSNR over a frame's valid pixels, dB, of an image of 0 to 255."""
    error = made - frame.image.numpy().astype(np.float64)
    return float(20.0 * np.log10(255.0) - 10.0 * np.log10(np.square(error[frame.valid.numpy()]).mean()))


def moved_halfway(image: UInt8[np.ndarray, "H W 3"], other: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """An image moved by half of its optical flow to another."""
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (image, other)]
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(grey[0], grey[1], None)
    height, width = grey[0].shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x, y = columns - flow[..., 0] / 2.0, rows - flow[..., 1] / 2.0
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)


def interpolated(scene_path: Path, options: list[str]) -> tuple[int, Float[np.ndarray, "3"]]:
    """Number of held-out frames, and mean PSNR of the nearest frame, the mean and the flow's midpoint, dB."""
    scene = open_scene(scene_path, options=["initial_points=none", *options])
    trained, video, rows = {frame.name for frame in scene.train}, scene.video, []
    for before, frame, after in zip(video, video[1:], video[2:], strict=False):
        if frame.name in trained or before.name not in trained or after.name not in trained:
            continue
        first, last = before.image.numpy(), after.image.numpy()
        midpoint = (moved_halfway(first, last) + moved_halfway(last, first)) / 2.0
        nearest = max(psnr(first.astype(np.float64), frame), psnr(last.astype(np.float64), frame))
        rows.append((nearest, psnr((first.astype(np.float64) + last) / 2.0, frame), psnr(midpoint, frame)))
    return len(rows), np.mean(rows, axis=0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("options", nargs="*")
    arguments = parser.parse_args()
    count, (nearest, mean, midpoint) = interpolated(arguments.scene, arguments.options)
    print(f"{count} frames; nearest {nearest:.2f} dB, mean {mean:.2f} dB, midpoint of the flow {midpoint:.2f} dB")
