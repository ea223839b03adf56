"""Images prepared for matching, with their cameras as matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.structure.features import FeatureSettings, image_and_mask, usable

#: A value, and whether one counts, for every pixel of a frame.
Map = Float32[np.ndarray, "H W"]
Mask = Bool[np.ndarray, "H W"]

#: Added to intensity before the logarithm, which would amplify the noise of dark pixels.
_OFFSET = 0.02


@dataclass(frozen=True, eq=False)
class Pose:
    """Intrinsics and rigid pose of a view in float64."""

    intrinsics: Intrinsics
    camera_to_world: Float[np.ndarray, "4 4"]

    @classmethod
    def of(cls, camera: Camera, size: tuple[int, int] | None = None) -> Pose:
        """The camera, of an image of another width and height if they are given."""
        intrinsics = camera.intrinsics if size is None else camera.intrinsics.resized(*size)
        return cls(intrinsics, camera.camera_to_world.cpu().double().numpy())

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K for pixel centres at integers + 0.5."""
        k = self.intrinsics
        return np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])

    def rays(self) -> Float[np.ndarray, "H W 3"]:
        """Directions through the pixel centres in the camera's axes, z = 1."""
        k = self.intrinsics
        x = (np.arange(k.width) + 0.5 - k.cx) / k.fx
        y = (np.arange(k.height) + 0.5 - k.cy) / k.fy
        return np.stack([*np.meshgrid(x, y), np.ones((k.height, k.width))], axis=-1)

    def to(self, other: Pose) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """Rotation and translation from this camera's axes to another's."""
        turn = other.camera_to_world[:3, :3].T
        return turn @ self.camera_to_world[:3, :3], turn @ (self.camera_to_world[:3, 3] - other.camera_to_world[:3, 3])

    def homography(self, other: Pose) -> tuple[Float32[np.ndarray, "3 3"], Float32[np.ndarray, "3"]]:
        """A and b with which pixel p at z-depth z lies at A (p, 1) z + b in another view, homogeneous."""
        rotation, translation = self.to(other)
        turn = other.matrix @ rotation @ np.linalg.inv(self.matrix)
        return turn.astype(np.float32), (other.matrix @ translation).astype(np.float32)

    def depth_from(self, other: Pose) -> tuple[Float32[np.ndarray, "3"], np.float32]:
        """The a and b with which pixel p of another view at z-depth z has z-depth a . (p, 1) z + b here."""
        rotation, translation = other.to(self)
        return (rotation[2] @ np.linalg.inv(other.matrix)).astype(np.float32), np.float32(translation[2])


@dataclass(frozen=True, eq=False)
class Guide:
    """An image prepared for matching."""

    pose: Pose  # camera of its size
    intensity: Map  # log of green; comparable up to a constant
    usable: Mask  # neither masked nor near a highlight


def guide_of(frame: Frame, reduction: int, features: FeatureSettings) -> Guide:
    """Prepare a frame, reduced by a factor, for matching; ``features`` says what a highlight is."""
    import cv2

    image, mask = image_and_mask(frame)
    good = usable(image, mask, features)
    height, width = good.shape
    # At least 8 pixels a side, unless it was smaller.
    size = max(min(8, width), round(width / reduction)), max(min(8, height), round(height / reduction))
    green = image[..., 1].astype(np.float32) / 255.0
    if reduction > 1:
        green = cv2.resize(green, size, interpolation=cv2.INTER_AREA)
        good = cv2.resize(good.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    intensity = np.log(green + _OFFSET).astype(np.float32)
    middle = float(intensity[good].mean()) if good.any() else 0.0
    return Guide(Pose.of(frame.camera, size), np.ascontiguousarray(intensity - np.float32(middle)), good)
