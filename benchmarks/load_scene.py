"""Time and peak memory of reading a long sequence, each case in a process of its own that may open few files.

python benchmarks/load_scene.py --frames 1142 --json FILE
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from machine import numbers_of, peak_mib, show, size_of

#: Different images; the sequence repeats them.
ORIGINALS = 9


@dataclass(frozen=True)
class Options:
    """Measure how a sequence as long as C3VD's longest is read."""

    frames: int = 1142
    """Frames of the sequence; C3VD's cecum_t2_b has 1142."""
    size: str = "338x270"
    """Size of the images on disk WxH, pixels."""
    open_files: int = 256
    """How many files a process may have open."""
    json: Path | None = None
    """Also write the rows here."""
    child: Path | None = None
    """Measure one case, this scene, in this process and print it; what the benchmark starts itself."""
    keep_pixels: bool = True
    """For that case: whether images stay in memory."""


def write_sequence(folder: Path, frames: int, width: int, height: int) -> Path:
    """A few phantom frames over and over, each time from a little further on."""
    from coliags_plugin.phantom.generate import generate
    from coliags_plugin.phantom.settings import PhantomSettings

    coarse = {"mesh_spacing": 1.0, "texture_spacing": 0.3, "interreflection": 0.0, "rotation_views": 0}
    made = folder / "originals"
    generate(PhantomSettings(frames=ORIGINALS, width=width, height=height, **coarse), made)
    scene = folder / "scene"
    for part in ("images", "depths"):
        (scene / part).mkdir(parents=True)
    poses = np.loadtxt(made / "camera_pose.txt", delimiter=",")
    lines = []
    for index in range(frames):
        original = index % ORIGINALS
        for part, name in (("images", "color"), ("depths", "depth")):
            os.link(made / part / f"{original:04d}_{name}.png", scene / part / f"{index:04d}_{name}.png")
        pose = poses[original].copy()
        pose[12:15] += 1e-3 * (index // ORIGINALS)
        lines.append(",".join(f"{number:.9g}" for number in pose))
    (scene / "camera_pose.txt").write_text("\n".join(lines) + "\n")
    os.link(made / "camera.json", scene / "camera.json")
    return scene


def load(scene: Path, keep_pixels: bool) -> tuple[float, float, float, float]:
    """Resident memory before reading and at the peak, MiB; and seconds of reading, elapsed and of the processor."""
    from coliags_plugin.datamanagers.c3vd import C3VDDataManager, C3VDSettings

    before = peak_mib()
    clocks = (time.perf_counter, time.process_time)
    began = [clock() for clock in clocks]
    C3VDDataManager(C3VDSettings(keep_pixels=keep_pixels)).load(scene)
    seconds, processor_seconds = (clock() - start for clock, start in zip(clocks, began, strict=True))
    return before, peak_mib(), seconds, processor_seconds


def main(options: Options) -> None:
    """Run, print a table, and write JSON where asked."""
    if options.child is not None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (options.open_files, options.open_files))
        print(*load(options.child, options.keep_pixels))
        return
    width, height = size_of(options.size)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = write_sequence(Path(folder), options.frames, width, height)
        for keep in (True, False):
            case = ["--child", str(scene), "--keep-pixels" if keep else "--no-keep-pixels"]
            before, peak, seconds, processor_seconds = numbers_of(
                __file__, *case, "--open-files", str(options.open_files)
            )
            rows.append(
                {
                    "keep_pixels": keep,
                    "frames": options.frames,
                    "stored_size": options.size,
                    "seconds": seconds,
                    "processor_seconds": processor_seconds,
                    "frames_per_s": options.frames / seconds,
                    "before_mib": before,
                    "peak_mib": peak,
                }
            )
    show(rows, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options))
