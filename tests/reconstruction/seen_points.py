"""A posed model of few points, with a place at which most of them change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from coliags_plugin.geometry.poses.colmap import colmap_poses, posed_model
from coliags_plugin.phantom.layouts import SeenPoints, add_points
from coliags_plugin.reconstruction.structure.point_tracks import FramePoints
from tests.textured_tube import INTRINSICS, tube_frames

#: Frames, the one after which most points change, and points seen from both sides of it.
COUNT, GAP, COMMON = 8, 3, 9


def frame_model(frames, names=None):
    """A reconstruction of posed frames of one camera, without points: frame i is COLMAP's image i + 1."""
    poses = np.stack([frame.camera.camera_to_world.double().numpy() for frame in frames])
    names = names or [f"{index}.png" for index in range(len(frames))]
    return posed_model(colmap_poses(poses), names, [frames[0].camera.intrinsics], [0] * len(frames))


def seen_points(shift=0.0):
    """A posed model: 40 points on either side of a gap, and a few seen from both, ``shift`` mm farther after it."""
    frames = tube_frames(COUNT, 3.0, (16, 12))
    frames = [replace(frame, camera=frame.camera.resized(160, 128)) for frame in frames]
    rng = np.random.default_rng(0)
    positions = np.stack([*rng.uniform(-8, 8, (2, 80 + COMMON)), rng.uniform(45, 58, 80 + COMMON)], axis=1)
    sides = np.repeat([0, 1, 2], [40, 40, COMMON])
    observed = []
    for index, frame in enumerate(frames):
        after = index > GAP
        numbers = np.flatnonzero((sides == 2) | (sides == after))
        pose = frame.camera.camera_to_world.double().numpy()
        moved = positions[numbers] + np.where(((sides[numbers] == 2) & after)[:, None], [0.0, 0.0, shift], 0.0)
        local = (moved - pose[:3, 3]) @ pose[:3, :3]
        fx, fy, cx, cy = INTRINSICS
        observed.append(SeenPoints(local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy), numbers))
    model = frame_model(frames)
    add_points(model, observed, positions, np.zeros((len(positions), 3), np.uint8))
    return model, observed


def frame_points(ids, pixels):
    """Points of a frame that is sharp and follows the one before it well."""
    dark = np.zeros(len(ids), np.float32)
    return FramePoints(ids, pixels.astype(np.float32), dark, followed=9, shift=0.0, sharpness=1.0, fineness=3.0)
