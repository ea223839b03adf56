"""Poses of phantoms that live, against the wave of their wall and the rate of their frames; rows are kept as they come.

python benchmarks/in_vivo.py --folder FOLDER

Phantoms of the preset in-vivo are made in the folder, harder where a patient's video is: less texture, more blur and
noise, compressed frames. Structure from motion is given their images alone, and its models are compared with the poses
relative to the moved wall. What the folder holds already is not done again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from machine import show
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.images import decode_image, write_image
from coliags_plugin.geometry.poses.alignment import Alignment, FrameMatches, align
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.structure.colmap_scene import write_sfm_scene
from coliags_plugin.reconstruction.structure.image_files import list_images
from coliags_plugin.reconstruction.structure.sfm import Atlas, Reconstruction, reconstruct

#: Settings beside those of the preset, with which as few points are followed as through the video of a patient.
HARD = {"texture": 0.2, "noise": 3.0, "softness": 1.5}
#: Frames of a stretch between weak places that is evaluated by itself.
LEAST_FRAMES = 10
#: On either side of a join: frames that are aligned, frames beyond it that are predicted, and fewest of either.
REACH, PREDICTED, FEWEST = 30, 5, 3
#: A join is wrong where the frames beyond it are turned or moved from the prediction by more than this, degrees and mm
#: (medians), or the scales of its sides differ by more than this factor. Positions are compared where the side that
#: is aligned goes this far, and scales where both do, mm: shorter ways are lost in the motion of the wall.
WRONG_DEG, WRONG_MM, WRONG_FACTOR, FAR_ENOUGH_MM = 20.0, 5.0, 1.5, 8.0
#: A pose farther than this from the truth, its whole model aligned, is not one, mm.
LOST_MM = 10.0


@dataclass(frozen=True)
class Options:
    """Options of the benchmark of structure from motion on phantoms with a moving wall."""

    folder: Path
    """Folder of the phantoms, their compressed images and the measured rows (rows.jsonl)."""
    waves: tuple[float, ...] = (0.0, 1.0, 2.0, 4.0)
    """Amplitudes of the peristaltic wave, mm; 0 is a rigid wall, also without breathing, fluid and bubbles."""
    rates: tuple[float, ...] = (15.0, 30.0)
    """Frames per second: the fewer, the faster all motion."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the phantoms."""
    frames: int = 120
    """Of each phantom."""
    size: int = 384
    """Width and height of the images, pixels."""
    quality: int = 30
    """Of the JPEG compression of the images, 1 to 100."""
    easy: bool = False
    """The preset as it is, and images without loss."""
    json: Path | None = None
    """Also write the rows here."""


def images_of(options: Options, wave: float, rate: float, seed: int) -> tuple[Path, list[Path]]:
    """Folder of a phantom, and its images, compressed as in a video; both are generated if missing."""
    from coliags_plugin.api.scenes import make_phantom

    kind = "easy" if options.easy else "hard"
    scene = options.folder / f"{kind}-{options.size}-{options.frames}-wave{wave:g}-{rate:g}Hz-seed{seed}"
    if not scene.is_dir():
        settings: dict[str, Any] = {"preset": "in-vivo", "seed": seed, "wave": wave, "frame_rate": rate}
        settings |= {"frames": options.frames, "width": options.size, "height": options.size}
        settings |= {"turns": max(1, round(options.frames / rate / 3.0)), "contacts": 1}
        settings |= {} if options.easy else HARD
        settings |= {"breathing": 0.0, "fluid": 0.0, "bubbles": 0} if wave == 0.0 else {}
        make_phantom(scene, **settings)
    if options.easy:
        return scene, list_images(scene / "images")
    compressed = scene.with_name(f"{scene.name}-q{options.quality}")
    if not compressed.is_dir():
        with atomic_folder(compressed) as scratch:
            for path in list_images(scene / "images"):
                image = decode_image(path, cv2.IMREAD_COLOR)
                _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, options.quality])
                write_image(scratch / path.name, cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
    return scene, list_images(compressed)


def row_of(options: Options, wave: float, rate: float, seed: int) -> dict[str, Any]:
    """Run structure from motion on one phantom and compare its poses with the true ones: one row of the table."""
    scene, images = images_of(options, wave, rate, seed)
    moved, rigid = (scene / "truth" / f"camera_to_{frame}.npy" for frame in ("wall", "world"))
    truth = np.load(moved if moved.is_file() else rigid)
    before, start = time.process_time(), time.perf_counter()
    try:
        atlas = reconstruct(images)
    except InputError as error:
        print(f"{scene.name}: {error}")
        atlas = Atlas(tuple(images), (), dict.fromkeys(range(len(images)), "no model"))
    cpu, wall = time.process_time() - before, time.perf_counter() - start
    # Images that repeat the one before are not in the atlas.
    truth = truth[[images.index(path) for path in atlas.images]]
    if atlas.models:
        write_sfm_scene(scene.with_name(f"{scene.name}-poses"), atlas, None, overwrite=True)
    stretches = [
        aligned(atlas.models[number], truth, [index for index in atlas.models[number].registered if index in span])
        for number, span in atlas.submaps()
        if len(span) >= LEAST_FRAMES
    ]
    errors = [one.ate.rmse for one in stretches if one is not None]
    joins = [judged(model, truth, link.after) for model in atlas.models for link in model.links]
    whole = [aligned(model, truth, model.registered) for model in atlas.models]
    tests = [model.test_error for model in atlas.models if model.test_error is not None]
    return {
        "wave, mm": wave,
        "rate, Hz": rate,
        "seed": seed,
        "frames": len(images),
        "posed, %": 100.0 * (len(atlas.images) - len(atlas.lost)) / len(images),
        "models": ", ".join(str(len(model.registered)) for model in atlas.models),
        "ATE of stretches, mm": f"{np.median(errors):.2f} (worst {max(errors):.2f} of {len(errors)})" if errors else "",
        "ATE of models, mm": ", ".join("-" if one is None else f"{one.ate.rmse:.2f}" for one in whole),
        "joins": len(joins),
        "wrong joins": sum(wrong is True for wrong in joins),
        "not judged": sum(wrong is None for wrong in joins),
        "poses far off": sum(int((one.position_errors > LOST_MM).sum()) for one in whole if one is not None),
        "held-out tracks, px": ", ".join(f"{error:.2f}" for error in tests),
        "CPU s": cpu,
        "wall s": wall,
    }


def aligned(model: Reconstruction, truth: np.ndarray, frames: Sequence[int] | np.ndarray) -> Alignment | None:
    """The model's poses of some frames aligned with the truth by a similarity; None for fewer than three."""
    if len(frames) < FEWEST:
        return None
    rows = np.searchsorted(model.registered, frames)
    chosen = np.arange(len(rows))
    return align(
        Trajectory(model.camera_to_world[rows]),
        Trajectory(truth[np.asarray(frames)]),
        FrameMatches(chosen, chosen, "frame"),
        with_scale=True,
    )


def judged(model: Reconstruction, truth: np.ndarray, after: int) -> bool | None:
    """Whether a join is wrong by the true poses; None if both sides have too few frames to tell.

    The longer side is aligned with the truth; where it puts the first frames of the other is compared with these.
    """
    frames = np.asarray(model.registered)
    sides = [frames[frames <= after][-REACH:], frames[frames > after][:REACH]]
    first = len(sides[0]) >= len(sides[1])
    longer, other = sides if first else sides[::-1]
    fit, fit_beyond = aligned(model, truth, longer), aligned(model, truth, other)
    if fit is None:
        return None
    beyond = other[:PREDICTED] if first else other[-PREDICTED:]
    poses, poses_beyond = (model.camera_to_world[np.searchsorted(frames, rows)] for rows in (longer, beyond))
    # By orientations: short ways do not tell the rotation.
    turn = Rotation.from_matrix(truth[longer][:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)).mean()
    turned = turn * Rotation.from_matrix(poses_beyond[:, :3, :3])
    angles = np.degrees((Rotation.from_matrix(truth[beyond][:, :3, :3]).inv() * turned).magnitude())
    wrong = np.median(angles) > WRONG_DEG
    if path_length(truth[longer]) >= FAR_ENOUGH_MM:
        places = fit.transform.points(poses_beyond[:, :3, 3])
        wrong |= np.median(np.linalg.norm(places - truth[beyond][:, :3, 3], axis=1)) > WRONG_MM
        if fit_beyond is not None and path_length(truth[other]) >= FAR_ENOUGH_MM:
            wrong |= abs(np.log(fit_beyond.transform.scale / fit.transform.scale)) > np.log(WRONG_FACTOR)
    return bool(wrong)


def path_length(poses: np.ndarray) -> float:
    """Length of a path, mm."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def main(options: Options) -> None:
    """Measure the rows that are missing, and print the table."""
    options.folder.mkdir(parents=True, exist_ok=True)
    kept = options.folder / "rows.jsonl"
    done = [json.loads(line) for line in kept.read_text().splitlines()] if kept.is_file() else []
    rows = []
    for seed, rate, wave in product(options.seeds, options.rates, options.waves):
        key: dict[str, Any] = {
            "easy": options.easy,
            "quality": options.quality,
            "size": options.size,
            "frames": options.frames,
        }
        key |= {"wave": wave, "rate": rate, "seed": seed}
        row = next((one["row"] for one in done if one["key"] == key), None)
        if row is None:
            row = row_of(options, wave, rate, seed)
            with kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, "row": row}) + "\n")
        rows.append(row)
    show(rows, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
