"""Poses and depth as a method is given them: with errors of a tracker and of depth estimation (docs/phantom.md 3.2)."""

from __future__ import annotations

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, slow_drift, stream

#: Jitter of a training frame's pose, as a share of the drift.
_JITTER = 0.2
#: Standard deviations of the kernels of depth that bleeds over edges, and of its noise, as shares of the width.
_BLEEDING, _BLOBS = 0.006, 0.08


def pose_errors(settings: PhantomSettings, training: Bool[np.ndarray, "T"]) -> Float[np.ndarray, "T 6"]:
    """Errors of poses: translation, mm, and rotation vector, radians. A slow drift, and jitter in training frames."""
    generator = stream(settings.seed, Purpose.POSE_NOISE)
    millimetres, degrees = settings.pose_noise
    deviations = np.repeat([millimetres, np.radians(degrees)], 3)
    drift = slow_drift(generator, len(training), 6, deviations)
    jitter = _JITTER * deviations * generator.standard_normal(drift.shape)
    return np.asarray(drift + jitter * training[:, None])


def displaced(poses: Float[np.ndarray, "N 4 4"], errors: Float[np.ndarray, "N 6"]) -> Float[np.ndarray, "N 4 4"]:
    """Poses moved by errors: translated in world axes, and turned about their own centres."""
    given = poses.copy()
    given[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(errors[:, 3:]).as_matrix()
    given[:, :3, 3] += errors[:, :3]
    return given


def estimated_depth(
    z_depth: Float[np.ndarray, "H W"], settings: PhantomSettings, frame: int
) -> Float[np.ndarray, "H W"]:
    """The z-depth of a frame as it is given, mm: it bleeds over edges, and its relative noise is smooth; 0 stays 0."""
    height, width = z_depth.shape
    known = z_depth > 0.0
    sigma = max(_BLEEDING * width, 0.3)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma)
    blurred = cv2.GaussianBlur(z_depth, (0, 0), sigma) / np.maximum(weight, 1e-6)
    noise = stream(settings.seed, Purpose.DEPTH_NOISE, frame).standard_normal((height, width))
    blobs = _BLOBS * width
    # A Gaussian kernel in two dimensions leaves 1 / (2 sqrt(pi) sigma) of the deviation of white noise.
    noise = scipy.ndimage.gaussian_filter(noise, blobs, mode="wrap") * (2.0 * np.sqrt(np.pi) * blobs)
    return np.where(known, blurred * np.exp(settings.depth_noise * noise), 0.0).astype(np.float32)
