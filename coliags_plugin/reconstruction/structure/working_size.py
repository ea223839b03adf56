"""Converts points triangulated in images of one size to the pixels of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.structure.triangulation import Observations, Triangulation


def in_pixels_of(found: Triangulation, detected: Sequence[Frame], frames: Sequence[Frame]) -> Triangulation:
    """The same points, with observations, reprojection errors and noise in the pixels of other images.

    Args:
        found: Triangulated from ``detected``.
        detected: The frames in which features were detected.
        frames: The same frames at another size.

    Raises:
        InputError: The frames are not the same.
    """
    names = [[frame.name for frame in video] for video in (detected, frames)]
    if names[0] != names[1] or len(found.observations) != len(frames):
        raise InputError(f"{len(detected)} and {len(frames)} frames", "the same frames at two sizes")
    observations, factors = [], []
    errors = np.zeros(len(found))
    for seen, stored, frame in zip(found.observations, detected, frames, strict=True):
        factor = np.array([frame.camera.width / stored.camera.width, frame.camera.height / stored.camera.height])
        pixels = seen.pixels * factor
        projected, _ = frame.camera.to("cpu", torch.float64).project(torch.from_numpy(found.positions[seen.points]))
        np.add.at(errors, seen.points, np.linalg.norm(projected.numpy() - pixels, axis=1))
        observations.append(Observations(pixels, seen.depth, seen.points))
        factors.append(float(np.sqrt(factor.prod())))
    return replace(
        found,
        observations=tuple(observations),
        errors=errors / found.track_lengths,
        pixel_noise=found.pixel_noise * float(np.mean(factors)),
    )
