"""Folders of reconstructions, made without reconstructing: of a short video, and of a long one of 100 frames.

The long one has two segments of three sub-maps each, joined at one place, and a failed one. Frames 0 to 31 and 26 to 57
are those of the first two segments, 58 to 69 are left out, 70 to 89 could not be posed. The short one is the first.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.datamanagers.colmap import ATLAS_FILE
from coliags_plugin.geometry.poses.colmap import write_reconstruction
from coliags_plugin.phantom.layouts import SeenPoints, add_points
from coliags_plugin.pipeline.stages import Record, StageRecord
from coliags_plugin.pipeline.survey import Survey
from coliags_plugin.reporting.image_files import write_png
from coliags_plugin.results.reading import write_result
from tests.reconstruction.seen_points import frame_model
from tests.results.made import made_result, made_set
from tests.textured_tube import tube_frames

#: Frames of the models, along the video; the last is too small.
COUNTS = (14, 12, 5)
FRAMES, RATE = 100, 10.0
SPANS = {"segment-000": (0, 31), "segment-001": (26, 57), "segment-002": (70, 89)}
#: Names of the sub-maps in order, and their frames.
SUBMAPS = {
    "segment-000/0": range(14),
    "segment-000/1": range(14, 26),
    "segment-000/2": range(26, 31),
    "segment-001/0": range(26, 40),
    "segment-001/1": range(40, 52),
    "segment-001/2": range(52, 57),
}
FAILURE = "no two frames overlap"
SCENE_FILE, FOLDER = "run/scene.html", "run/pictures"


def done(files=(), warnings=(), **figures):
    return StageRecord("well", dict(files), warnings, figures, seconds=60.0)


def judged(verdict: str, *reasons: str) -> StageRecord:
    """The stage of the verdict."""
    return StageRecord(": ".join((verdict, *reasons)), figures={"verdict": verdict, "reasons": reasons})


def similarity(seed: int) -> np.ndarray:
    """A rotation, scale and shift. [4, 4]"""
    drawn = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = drawn.uniform(0.5, 2.0) * Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = drawn.normal(size=3)
    return matrix


def join(segments, models, transform=None, reason="", frames=5):
    """A join as the record has it; joined where there is a transform."""
    matrix = None if transform is None else transform.tolist()
    residuals = {"rotation_deg": 0.5, "position": 0.02}
    what = {"segments": segments, "models": models, "frames": frames, "joined": matrix is not None, "reason": reason}
    return {**what, "transform": matrix, **residuals}


JOINS = [
    join(["segment-000", "segment-001"], ["sparse/2", "sparse/0"], similarity(1)),
    join(["segment-001", "segment-002"], ["", ""], reason="12 frames between them", frames=0),
]


def span(name, first, last):
    return {"name": name, "first": first, "last": last}


def video(**changes):
    """Figures of the survey."""
    figures = {
        "source": "withdrawal.mp4",
        "frames": FRAMES,
        "rate": RATE,
        "size": [40, 32],
        "segments": [span(name, *ends) for name, ends in SPANS.items()],
        "skipped": [{"first": 58, "last": 69, "why": "washed with water"}],
    }
    return {**figures, **changes}


def write_atlas(folder, counts=COUNTS, units=("unknown", "unknown", "unknown"), listed=True):
    """A scene of several models, each with a point before every camera, and the ``atlas.json`` that lists them."""
    (folder / "images").mkdir(parents=True)
    start, submaps, names = 0, [], []
    for number, count in enumerate(counts):
        frames = tube_frames(count, 1.0, (40, 32))
        own = [f"{start + index:03d}.png" for index in range(count)]
        for frame, name in zip(frames, own, strict=True):
            write_image(folder / "images" / name, frame.image.numpy())
        model = frame_model(frames, own)
        poses = np.stack([frame.camera.camera_to_world.numpy() for frame in frames])
        points = poses[:, :3, 3] + 2.0 * (number + 1) * poses[:, :3, 2]
        seen = [SeenPoints(np.array([[20.0, 16.0]]), np.array([index])) for index in range(count)]
        add_points(model, seen, points, np.zeros((count, 3), np.uint8))
        write_reconstruction(folder / f"sparse/{number}", model)
        stretch = {"model": f"sparse/{number}", "unit": units[number], "frames": [*range(start, start + count)]}
        submaps.append(stretch)
        names += own
        start += count
    write_unit(folder, units[0])
    if listed:
        lost = [{"frame": start, "reason": "blurred"}]
        write_json(folder / ATLAS_FILE, {"frames": [*names, "lost.png"], "submaps": submaps, "joins": [], "lost": lost})
    return folder


def write_segment(folder: Path, first: int = 0) -> dict[str, StageRecord]:
    """Files and stages of a segment of three sub-maps, the last of which failed."""
    poses = write_atlas(folder / "poses")
    names = [f"{index:03d}" for index in range(sum(COUNTS))] + ["lost"]
    images = folder / "frames" / "images"
    shutil.copytree(poses / "images", images)
    write_image(images / "lost.png", np.zeros((32, 40, 3), np.uint8))
    write_frames(folder, [{"frame": first + index, "name": name, "blurred": False} for index, name in enumerate(names)])
    for place in ("", "submap-1/"):
        file = folder / place / SCENE_FILE
        file.parent.mkdir(parents=True)
        file.write_text(f"<title>{folder.name} {place}</title>" + "x" * 2000)
        write_json(folder / place / "depth" / "transforms.json", {"frames": []})
    for kind in ("recorded", "depth", "flattened light"):
        write_png(folder / FOLDER / "003" / f"{kind}.png", np.full((4, 4, 3), len(kind), np.uint8))
    evaluation = folder / "run" / "eval" / "paper"
    write_result(evaluation / "result.json", made_result({"test": made_set(("003", "011"), (20.0 + first, 30.0))}))
    for kind in ("truth", "renders"):
        for name in ("003", "011"):
            write_png(evaluation / kind / "test" / f"{name}.png", np.full((6, 8, 3), 90, np.uint8))
    return {
        "frames": done({"frames/images": "frames of use"}),
        "poses": done({"poses": "scene"}),
        "check": done({"check.html": "check"}, ["suspect: the camera jumps. Check it"], frames=14),
        "train": done(steps=2000),
        "evaluate": done({"run/eval/paper": "metrics"}, psnr=24.0, ssim=0.85, held_out=2, psnr_training=27.5, gap=3.5),
        "mesh": done(area=4200.0, unit="mm"),
        "verdict": judged("usable"),
        "scene": done({SCENE_FILE: "scene", FOLDER: "pictures"}),
        "coverage": done(seen=0.625),
        "report": done(),
        "submap-1/check": done({"submap-1/check.html": "check"}, frames=12),
        "submap-1/train": done(steps=500),
        "submap-1/evaluate": done(psnr=22.0, ssim=0.8, held_out=2, psnr_training=23.5, gap=1.5, psnr_pose_refined=23.0),
        "submap-1/mesh": done(area=900.0, unit="units"),
        "submap-1/verdict": judged("doubtful", "15 % of the pixels have confident depth"),
        "submap-1/scene": done({f"submap-1/{SCENE_FILE}": "scene"}),
        "submap-1/coverage": done(seen_area=800.0),
        "submap-2/check": done(frames=5),
        "submap-2/depth": failed("no surface that 5 frames agree on. Check the poses."),
    }


def write_frames(folder: Path, frames) -> None:
    write_json(folder / "frames" / "frames.json", {"kept": frames, "dropped": []})


def change_video(out: Path, joins=None, **changes) -> None:
    """Other joins, or figures of the survey, in the record of a long video."""
    record = Record.of(out)
    figures = {**record.stages["survey"].figures, **changes}
    record.stages["survey"] = done(**figures)
    record.stages["joins"] = done(joins=record.stages["joins"].figures["joins"] if joins is None else joins)
    record.write()


def write_long(out: Path, **changes) -> Path:
    """The folder of the long video."""
    stages = {"survey": done(**video()), "joins": done(joins=JOINS)}
    for name, (first, _) in SPANS.items():
        if name != "segment-002":
            stages_of = write_segment(out / name, first)
            (out / name / "index.html").write_text("the page of a segment")
        else:
            (out / name).mkdir()
            stages_of = {"frames": done(), "poses": failed(FAILURE)}
        for key, stage in stages_of.items():
            stages[f"{name}/{key}"] = replace(
                stage, files={f"{name}/{path}": what for path, what in stage.files.items()}
            )
    write_survey(out)
    Record(out, stages).write()
    change_video(out, **changes)
    return out


def write_survey(out: Path, frames: int = FRAMES) -> None:
    followed = np.linspace(0.0, 1.0, frames, dtype=np.float32)
    motion = np.where(followed < 0.1, np.inf, 0.01).astype(np.float32)
    Survey(followed * 0.02, followed, motion, (32, 40), None).write(out)


def write_short(out: Path) -> Path:
    """The folder of the short video."""
    whole = video(frames=32, segments=[span("", 0, 31)], skipped=[])
    Record(out, {"survey": done(**whole), **write_segment(out)}).write()
    return out


def failed(why: str) -> StageRecord:
    return StageRecord(why, state="failed")
