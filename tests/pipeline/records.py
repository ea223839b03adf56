"""The record of a reconstruction of three sub-maps, one of which failed."""

from __future__ import annotations

from coliags_plugin.pipeline.stages import Record, StageRecord
from coliags_plugin.pipeline.training_stages import PICTURES, SCENE

SCENE_FILE, FOLDER = "run/scene.html", "run/pictures"


def done(files=(), warnings=(), **figures):
    return StageRecord({}, "done", "well", 60.0, dict(files), warnings, figures)


def record_in(folder):
    stages = {
        "frames": done({"frames/images": "frames of use"}),
        "poses": done({"poses": "scene"}),
        "check": done({"check.html": "check"}, ["suspect: the camera jumps. Check it"], frames=14),
        "train": done(steps=2000),
        "evaluate": done(psnr=24.0, ssim=0.85, held_out=2, psnr_training=27.5, psnr_pose_refined=26.0),
        "mesh": done(area=4200.0, unit="mm"),
        "scene": done({SCENE_FILE: SCENE, FOLDER: PICTURES}),
        "coverage": done(seen=0.625),
        "submap-1/check": done({"submap-1/check.html": "check"}, frames=12),
        "submap-1/train": done(steps=500),
        "submap-1/evaluate": done(psnr=22.0, ssim=0.8, held_out=2, psnr_training=23.5),
        "submap-1/mesh": done(area=900.0, unit="units"),
        "submap-1/scene": done({f"submap-1/{SCENE_FILE}": SCENE}),
        "submap-1/coverage": done(seen_area=800.0),
        "submap-2/check": done(frames=5),
        "submap-2/depth": StageRecord({}, "failed", "no surface that 5 frames agree on. Check the poses."),
    }
    return Record(folder, stages)
