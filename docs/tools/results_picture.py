"""Picture of docs/results.md: a held-out and a turned view of six methods and their depth, from the measured runs.

    python docs/tools/results_picture.py OUT

takes the folder of benchmarks/results.py. The scene is the one of those with light that no method assumes in which the
reference has its median PSNR over them, and so are the frames.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from results_page import ASSUMED, PAGE, REFERENCE, comparison

import coliags_plugin
from coliags_plugin.api.views import RenderedView
from coliags_plugin.outputs.colormaps import color_bar, colorize_depth, common_limits, side_by_side, stacked
from coliags_plugin.results.record import Result

PICTURE = PAGE.parent / "looks" / "phantoms-12.jpg"
METHODS = ("coliags", "coliags-plus", "scaffold-gs-distance-gain", "3dgs-depth-gain", "2dgs-depth", "coliags-no-depth")
#: The metric by which a frame of each test set is chosen, and which stands above its pictures.
CHOSEN_BY = {"test": "psnr", "rotation": "psnr_seen"}
TITLES = {"test": "held out", "rotation": "turned"}
#: Display pixels of a rendered one.
ENLARGED = 2


def main(out: Path) -> None:
    """Choose scene and frames, render, and write the picture."""
    results = comparison(out, "equal-time").results
    of_reference = {result.scene.name: result for result in results if result.method == REFERENCE}
    scene = median({name: of_reference[name].mean("psnr") or 0.0 for name in [*of_reference][ASSUMED:]})
    frames = {part: median(values(of_reference[scene], part)) for part in CHOSEN_BY}
    shown = {result.method: result for result in results if result.scene.name == scene}
    runs = {name: coliags_plugin.Run(path) for name, path in run_folders(out / "equal-time", scene).items()}
    views = {name: {part: runs[name].render(frame) for part, frame in frames.items()} for name in METHODS}
    true_depths = {part: true_depth(view) for part, view in views[METHODS[0]].items()}
    limits = {part: common_limits([depth]) for part, depth in true_depths.items()}
    recorded = {part: (view.true_rgb, true_depths[part]) for part, view in views[METHODS[0]].items()}
    rows = [row(recorded, {part: f"{title}, recorded" for part, title in TITLES.items()}, limits)]
    for name, own in views.items():
        titles = {part: f"{name}, {values(shown[name], part)[frame]:.1f} dB" for part, frame in frames.items()}
        rows.append(row({part: (view.rgb, view.depth) for part, view in own.items()}, titles, limits))
    bars = [color_bar(of, "mm", "depth") for of in limits.values()]
    picture = stacked([*rows, side_by_side(bars, [f"depth, {TITLES[part]}" for part in limits])])
    cv2.imwrite(str(PICTURE), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(f"{PICTURE}: {scene}, {', '.join(frames.values())}")


def row(
    images: Mapping[str, tuple[Any, np.ndarray]], titles: Mapping[str, str], limits: Mapping[str, tuple[float, float]]
) -> np.ndarray:
    """Colours and depth of each chosen frame, side by side."""
    shown = [image for part, (rgb, depth) in images.items() for image in (rgb, colorize_depth(depth, limits[part]))]
    return side_by_side([enlarged(image) for image in shown], [text for part in images for text in (titles[part], "")])


def true_depth(view: RenderedView) -> np.ndarray:
    """The true depth of a frame; a phantom has it."""
    assert view.true_depth is not None
    return view.true_depth


def values(result: Result, part: str) -> dict[str, float]:
    """The metric by which a frame of a test set is chosen, for each frame that has it."""
    of = result.sets[part]
    pairs = zip(of.frames, of.values[CHOSEN_BY[part]], strict=True)
    return {frame: value for frame, value in pairs if value is not None}


def median(of: Mapping[str, float]) -> str:
    """The name whose value is the median, the upper of two."""
    return sorted(of, key=lambda name: of[name])[len(of) // 2]


def run_folders(folder: Path, scene: str) -> dict[str, Path]:
    """The folder of each method's run on a scene."""
    cells = json.loads((folder / "plan.json").read_text(encoding="utf-8"))["cells"]
    return {cell["method"]: folder / cell["run"] for cell in cells if cell["scene"] == scene and cell["seed"] == 0}


def enlarged(image: np.ndarray) -> np.ndarray:
    """An image several times as large."""
    return cv2.resize(image, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
