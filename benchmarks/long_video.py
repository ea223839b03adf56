"""Time and memory of ``coliags poses sfm`` by the length of a video: images played to and fro.

``python benchmarks/long_video.py IMAGES --counts 240,480,960 --work FOLDER`` prints one row for each number of frames:
processor time and largest resident memory of the whole command, frames with a pose, and models.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from machine import show

from coliags_plugin.reconstruction.structure.image_files import list_images


def write_loop(images: list[Path], folder: Path, count: int) -> None:
    """Links to ``count`` images in the order of a camera that goes to and fro."""
    folder.mkdir(parents=True)
    period = 2 * len(images) - 2
    for index in range(count):
        place = index % period
        image = images[min(place, period - place)]
        (folder / f"{index:06d}{image.suffix}").symlink_to(image.resolve())


def measure(folder: Path, out: Path, options: list[str]) -> dict[str, float | int]:
    """Run the command on a folder: processor time, s, peak memory, MB, number of posed frames and of models."""
    command = [str(Path(sys.executable).with_name("coliags")), "poses", "sfm", str(folder), "-o", str(out), *options]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    atlas = json.loads((out / "atlas.json").read_text())
    count, cpu = len(atlas["frames"]), used.ru_utime + used.ru_stime
    return {
        "frames": count,
        "CPU, s": cpu,
        "CPU a frame, s": cpu / count,
        "memory, MB": used.ru_maxrss / 1024,
        "posed": count - len(atlas["lost"]),
        "models": len({submap["model"] for submap in atlas["submaps"]}),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("--counts", default="240,480,960")
    parser.add_argument("--work", type=Path, required=True, help="new folder for the loops and results")
    asked, options = parser.parse_known_args()  # the others are those of coliags poses sfm
    images = list_images(asked.images)
    rows = []
    for count in map(int, asked.counts.split(",")):
        write_loop(images, asked.work / f"{count}", count)
        rows.append(measure(asked.work / f"{count}", asked.work / f"{count}-scene", options))
    show(rows, None)


if __name__ == "__main__":
    main()
