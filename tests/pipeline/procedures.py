"""The folder of a procedure of 100 frames: two segments of three sub-maps each, joined at one place, and a failed one.

Frames 0 to 31 and 26 to 57 are those of the first two segments, 58 to 69 are left out, 70 to 89 could not be posed.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.outputs.image_files import write_png
from coliags_plugin.pipeline.stages import Record, StageRecord
from coliags_plugin.results.reading import write_result
from tests.pipeline.conftest import COUNTS, write_atlas
from tests.pipeline.records import SCENE_FILE, done, record_in
from tests.results.made import made_result, made_set

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


def similarity(seed: int) -> np.ndarray:
    """A rotation, scale and shift. [4, 4]"""
    drawn = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = drawn.uniform(0.5, 2.0) * Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = drawn.normal(size=3)
    return matrix


def join(segments, models, transform=None, reason="", frames=5):
    """A join as ``procedure.json`` has it; joined where there is a transform."""
    matrix = None if transform is None else transform.tolist()
    residuals = {"rotation_deg": 0.5, "position": 0.02}
    what = {"segments": segments, "models": models, "frames": frames, "joined": matrix is not None, "reason": reason}
    return {**what, "transform": matrix, **residuals}


def procedure_content(**changes):
    """What ``procedure.json`` holds."""
    content = {
        "format": 1,
        "source": ["withdrawal.mp4"],
        "bytes": 1000,
        "first": 0,
        "options": {},
        "seek": True,
        "deinterlace": False,
        "frames": FRAMES,
        "rate": RATE,
        "size": [40, 32],
        "segments": [{"name": name, "first": first, "last": last} for name, (first, last) in SPANS.items()],
        "skipped": [{"first": 58, "last": 69, "why": "washed with water"}],
        "joins": [
            join(["segment-000", "segment-001"], ["sparse/2", "sparse/0"], similarity(1)),
            join(["segment-001", "segment-002"], ["", ""], reason="12 frames between them", frames=0),
        ],
    }
    return {**content, **changes}


def write_segment(folder: Path, first: int) -> None:
    """A reconstructed segment: frames, poses of three models, scenes, results, depth of the first two."""
    poses = write_atlas(folder / "poses")
    names = [f"{index:03d}" for index in range(sum(COUNTS))] + ["lost"]
    images = folder / "frames" / "images"
    shutil.copytree(poses / "images", images)
    write_image(images / "lost.png", np.zeros((32, 40, 3), np.uint8))
    kept = [{"frame": first + index, "name": name, "blurred": False} for index, name in enumerate(names)]
    write_json(folder / "frames" / "frames.json", {"kept": kept, "dropped": [], "deinterlaced": False})
    record = record_in(folder)
    record.stages["evaluate"] = done({"run/eval/paper": "metrics"}, psnr=24.0, ssim=0.85, held_out=2)
    record.stages["report"] = done()
    for own in ("", "submap-1/"):
        file = folder / own / SCENE_FILE
        file.parent.mkdir(parents=True)
        file.write_text(f"<title>{folder.name} {own}</title>" + "x" * 2000)
        write_json(folder / own / "depth" / "transforms.json", {"frames": []})
    evaluation = folder / "run" / "eval" / "paper"
    write_result(evaluation / "result.json", made_result({"test": made_set(("003", "011"), (20.0 + first, 30.0))}))
    for kind in ("truth", "renders"):
        for name in ("003", "011"):
            write_png(evaluation / kind / "test" / f"{name}.png", np.full((6, 8, 3), 90, np.uint8))
    (folder / "index.html").write_text("the page of a segment")
    record.write()


def write_procedure(out: Path, **changes) -> Path:
    """The folder; ``changes`` are those of ``procedure.json``."""
    for name, (first, _) in SPANS.items():
        if name != "segment-002":
            write_segment(out / name, first)
    (out / "segment-002").mkdir()
    failed = {"frames": done(), "poses": StageRecord({}, "failed", FAILURE)}
    Record(out / "segment-002", failed).write()
    followed = np.linspace(0.0, 1.0, FRAMES, dtype=np.float32)
    motion = np.where(followed < 0.1, np.inf, 0.01).astype(np.float32)
    np.savez(out / "survey.npz", sharpness=followed * 0.02, followed=followed, motion=motion)
    write_json(out / "procedure.json", procedure_content(**changes))
    return out
