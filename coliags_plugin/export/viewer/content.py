"""What a view shows of a run, computed once and shared by all browsers that look at it."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from coliags_plugin.contracts import GaussianField, knows_lamp
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import flattened_light, gaussians_of
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.averages import mean_gaussians
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.viewer.merging import merged_to
from coliags_plugin.export.viewer.pictures import FramePictures
from coliags_plugin.export.viewer.splats import ViewDecoder, shown, wire_unit
from coliags_plugin.lighting.lamps import HeldLight
from coliags_plugin.outputs.image_files import as_array

logger = logging.getLogger(__name__)

#: Training views that are decoded for the Gaussians of no view in particular, at most.
VIEWS = 16
#: Gaussians beside a view, at most: they are seen only until the next decoding.
MOST_BESIDE = 40_000
#: Share of the Gaussians that are near enough to need no smaller cells when they are merged.
_NEAR_SHARE = 0.2

_NOTHING = SplatCloud(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3))))


@dataclass(frozen=True)
class ViewerContent:
    """A run, ready to be shown."""

    trained: TrainedRun
    frames: list[Frame]  # of the video, in its order
    # Its Gaussians for no view in particular, under the light that they got on average; none for a method without
    # Gaussians.
    baked: SplatCloud
    decoder: ViewDecoder | None  # its Gaussians for a view; None for a method without Gaussians
    pictures: FramePictures  # of the frames
    unit: float  # see :func:`~coliags_plugin.export.viewer.splats.wire_unit`
    # Held while something is computed: browsers take turns.
    lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, trained: TrainedRun) -> ViewerContent:
        """Bake the Gaussians of a run, where its method has any."""
        gaussian_field = trained.model.field
        baked, decoder = _NOTHING, None
        if isinstance(gaussian_field, GaussianField):
            logger.info("decoding the Gaussians of %s", trained.method)
            cameras = [frame.camera.to(trained.device) for frame in trained.scene.train]
            baked = shown(mean_gaussians(gaussian_field, spread(cameras)))
            beside = merged_to(baked, MOST_BESIDE, distances(baked, cameras))
            decoder = ViewDecoder(gaussian_field, beside, trained.device)
        else:
            logger.warning(
                "method '%s' has no Gaussians to draw in the browser: there are cameras, meshes and rendered pictures",
                trained.method,
            )
        return cls(trained, trained.scene.video, baked, decoder, FramePictures(trained), wire_unit(baked))

    def relit_evenly(self) -> ViewerContent:
        """The same, its Gaussians baked under the flattened light, where their colours know a lamp."""
        if not self.knows_lamp:
            return self
        field = gaussians_of(self.trained.model)
        cameras = [frame.camera.to(self.trained.device) for frame in self.trained.scene.train]
        return replace(self, baked=shown(mean_gaussians(field, spread(cameras), self.flattened)))

    @property
    def knows_lamp(self) -> bool:
        """Whether the light can be held."""
        return knows_lamp(self.trained.model.field)

    @property
    def title(self) -> str:
        """What is shown, in one line."""
        return f"{self.trained.method} on {self.trained.scene.name}"

    @property
    def first_camera(self) -> Camera:
        """Of the first training frame: where a view starts."""
        return self.trained.scene.train[0].camera

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """Up in the image of the first training frame, world frame. [3]"""
        return -self.first_camera.camera_to_world[:3, 1].double().cpu().numpy()

    @cached_property
    def look_distance(self) -> float:
        """Distance of the point that the browser's camera turns about: the median depth in the first view."""
        camera = self.first_camera
        centers = torch.as_tensor(self.baked.means, dtype=torch.float64)
        depth, seen = camera.to("cpu", torch.float64).sees(centers)
        if seen.any():
            return float(depth[seen].median())
        return self.trained.scene.extent or 1.0

    @cached_property
    def flattened(self) -> HeldLight:
        """The same light everywhere: median distance and angle of what training cameras see; renders some views."""
        return flattened_light(self.trained.model, [frame.camera for frame in self.trained.scene.train])

    @cached_property
    def distances(self) -> Float[np.ndarray, "N"]:
        """See :func:`distances`, of the baked Gaussians. [N]"""
        return distances(self.baked, [frame.camera for frame in self.trained.scene.train])

    @property
    def near_plane(self) -> float:
        """z-depth from which on the browser draws, scene units: what renderers use, or a share of the distance."""
        return min(self.first_camera.near_plane, 0.02 * self.look_distance)


def distances(splats: SplatCloud, cameras: Sequence[Camera]) -> Float[np.ndarray, "N"]:
    """Distance of each splat to the nearest camera, scene units, the nearest fifth counted alike. [N]"""
    centers = np.stack([as_array(camera.center).astype(np.float64) for camera in cameras])
    nearest = np.asarray(cKDTree(centers).query(splats.means)[0])
    return np.maximum(nearest, np.quantile(nearest, _NEAR_SHARE)) if len(nearest) else nearest


def spread(cameras: Sequence[Camera]) -> list[Camera]:
    """At most :data:`VIEWS` of the cameras, evenly spaced in their order."""
    count = min(VIEWS, len(cameras))
    return [cameras[index * len(cameras) // count] for index in range(count)]


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view of a camera, radians; the browser's camera has its principal point in the middle."""
    return 2.0 * math.atan(0.5 * camera.height / camera.fy)


def mesh_files(run: Path) -> dict[str, Path]:
    """Meshes in a run folder by the names of their layers: of ``coliags mesh`` and ``coliags coverage``."""
    files = {"mesh": run / "mesh" / "mesh.ply"}
    for file in sorted((run / "coverage").glob("*.ply")):
        files["coverage" if file.stem == "coverage" else f"coverage: {file.stem}"] = file
    return {name: file for name, file in files.items() if file.is_file()}
