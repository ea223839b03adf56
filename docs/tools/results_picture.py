"""Picture of docs/results.md: a held-out and a turned view of six methods and their depth, from the measured runs.

    python docs/tools/results_picture.py OUT

takes the folder of benchmarks/results.py. The scene is the one of those with light that no method assumes in which the
reference has its median PSNR over them; frames are chosen alike.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from results_page import ASSUMED, PAGE, REFERENCE, comparison, planned_cells

import coliags_plugin
from coliags_plugin.reporting.colormaps import color_bar, colorize_depth, common_limits, side_by_side, stacked
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
    scene = median_name({name: of_reference[name].mean("psnr") or 0.0 for name in [*of_reference][ASSUMED:]})
    frames = {part: median_name(values(of_reference[scene], part)) for part in CHOSEN_BY}
    shown = {result.method: result for result in results if result.scene.name == scene and result.method in METHODS}
    runs = {
        cell.method: coliags_plugin.Run(out / "equal-time" / cell.run)
        for cell in planned_cells(out / "equal-time", "paper")
        if cell.scene == scene and cell.method in METHODS
    }
    columns = [column(part, frame, shown, runs) for part, frame in frames.items()]
    picture = side_by_side(columns, [TITLES[part] for part in frames])
    cv2.imwrite(str(PICTURE), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(f"{PICTURE}: {scene}, {', '.join(frames.values())}")


def column(part: str, frame: str, results: Mapping[str, Result], runs: Mapping[str, coliags_plugin.Run]) -> np.ndarray:
    """Colours and depth of a frame as recorded and by each method, below each other, and the scale of depth."""
    views = {name: runs[name].render(frame) for name in METHODS}
    first = views[METHODS[0]]
    assert first.true_rgb is not None and first.true_depth is not None  # a phantom has both
    limits = common_limits([first.true_depth])
    shown = [("recorded", first.true_rgb, first.true_depth)]
    shown += [
        (f"{name}, {values(results[name], part)[frame]:.1f} dB", view.rgb, view.depth) for name, view in views.items()
    ]
    rows = [
        side_by_side([enlarged(rgb), enlarged(colorize_depth(depth, limits))], [title, ""])
        for title, rgb, depth in shown
    ]
    return stacked([*rows, color_bar(limits, "mm", "depth")])


def values(result: Result, part: str) -> dict[str, float]:
    """The metric by which a frame of a test set is chosen, for each frame that has it."""
    of = result.sets[part]
    pairs = zip(of.frames, of.values[CHOSEN_BY[part]], strict=True)
    return {frame: value for frame, value in pairs if value is not None}


def median_name(of: Mapping[str, float]) -> str:
    """Name of the median of named values; of an even number, that of the upper of the middle two."""
    return sorted(of, key=lambda name: of[name])[len(of) // 2]


def enlarged(image: np.ndarray) -> np.ndarray:
    """An image several times as large."""
    return cv2.resize(image, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
