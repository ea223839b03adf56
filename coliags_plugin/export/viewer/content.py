"""What a view shows of a run: its Gaussians, computed once and shared by all browsers, and pictures of its frames."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from coliags_plugin.contracts import GaussianField, knows_lamp
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import flattened_light
from coliags_plugin.engine.rendering import RGB_ERROR_LIMIT, depth_picture, render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.baking import mean_gaussians
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.viewer.splats import ViewDecoder, most_visible, shown, wire_unit
from coliags_plugin.lighting.lamps import HeldLight
from coliags_plugin.outputs.colormaps import (
    DEPTH_ERROR_LIMIT_MM,
    colorize_depth_error,
    colorize_rgb_error,
    depth_limits,
)
from coliags_plugin.outputs.image_files import as_array, eight_bit

logger = logging.getLogger(__name__)

#: Frames that the scale of depth is taken from.
_SAMPLED = 4


@dataclass(frozen=True)
class Picture:
    """An RGB image, and what its colours mean in plain text."""

    image: UInt8[np.ndarray, "H W 3"]
    caption: str


class FramePictures:
    """What can be shown of a frame: its render, errors and depth, as far as the run and its scene have them."""

    def __init__(self, trained: TrainedRun) -> None:
        self._trained = trained
        self._unit = trained.scene.length_unit
        self._makers: dict[str, Callable[[Frame, RenderOutput], Picture]] = {"render": self._colour}
        if trained.lamp is None:
            self._makers["colour error"] = self._colour_error
        if "depth_expected" in trained.model.outputs:
            self._makers["depth"] = self._depth
            if trained.scene.video[0].true_depth is not None:
                self._makers["depth error"] = self._depth_error

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the pictures that this run has, the render first."""
        return tuple(self._makers)

    def of(self, frame: Frame, kind: str) -> Picture:
        """A picture of a frame of the run's scene, of one of the :attr:`kinds`."""
        return self._makers[kind](frame, self._render(frame))

    def _render(self, frame: Frame) -> RenderOutput:
        wants = ("rgb", "alpha", "depth_expected") if "depth" in self._makers else ("rgb", "alpha")
        return render_view(self._trained, frame, wants)

    def _colour(self, frame: Frame, output: RenderOutput) -> Picture:
        return Picture(as_array(eight_bit(output.rgb)), "render")

    def _colour_error(self, frame: Frame, output: RenderOutput) -> Picture:
        image = colorize_rgb_error(output.rgb.cpu(), frame.image, frame.valid.cpu(), RGB_ERROR_LIMIT)
        return Picture(image, f"colour error, 0 to {RGB_ERROR_LIMIT:g} of full scale")

    def _depth(self, frame: Frame, output: RenderOutput) -> Picture:
        low, high = self._depth_limits
        image = depth_picture(output, "depth_expected", (low, high))
        return Picture(image, f"expected depth, {low:g} to {high:g} {self._unit}")

    def _depth_error(self, frame: Frame, output: RenderOutput) -> Picture:
        true = frame.true_depth
        true = torch.full_like(output.alpha, torch.nan) if true is None else true
        rendered = output["depth_expected"].cpu()
        image = colorize_depth_error(rendered, true.cpu(), frame.valid.cpu(), DEPTH_ERROR_LIMIT_MM)
        return Picture(image, f"error of expected depth, 0 to {DEPTH_ERROR_LIMIT_MM:g} {self._unit}")

    @cached_property
    def _depth_limits(self) -> tuple[float, float]:
        """One scale for the whole video."""
        frames = self._trained.scene.video
        sample = frames[:: max(1, len(frames) // _SAMPLED)][:_SAMPLED]
        return depth_limits([as_array(self._render(frame)["depth_expected"]) for frame in sample], self._unit)


#: Training views that are decoded for the Gaussians of no view in particular, at most.
VIEWS = 16
#: Gaussians beside a view, at most: they are seen only until the next decoding.
MOST_BESIDE = 40_000

NOTHING = SplatCloud(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3))))


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
    first: int = 0  # training frame where a view starts
    # Held while something is computed: browsers take turns.
    lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, trained: TrainedRun) -> ViewerContent:
        """Bake the Gaussians of a run, where its method has any."""
        gaussian_field = trained.model.field
        baked, decoder = NOTHING, None
        if isinstance(gaussian_field, GaussianField):
            logger.info("decoding the Gaussians of %s", trained.method)
            cameras = [frame.camera.to(trained.device) for frame in trained.scene.train]
            scale = trained.model.scale
            placed = [camera.scaled(scale) for camera in spread(cameras)]
            baked = shown(mean_gaussians(gaussian_field, placed)).scaled(1.0 / scale)
            decoder = ViewDecoder(gaussian_field, most_visible(baked, MOST_BESIDE), trained.device, scale)
        else:
            logger.warning(
                "method '%s' has no Gaussians to draw in the browser: there are cameras, meshes and rendered pictures",
                trained.method,
            )
        return cls(trained, trained.scene.video, baked, decoder, FramePictures(trained), wire_unit(baked))

    @classmethod
    def live(cls, trained: TrainedRun) -> ViewerContent:
        """Content of a run that is being trained: Gaussians as each view sees them, and none beside, as they change."""
        gaussian_field = trained.model.field
        if not isinstance(gaussian_field, GaussianField):
            return cls.of(trained)
        decoder = ViewDecoder(gaussian_field, NOTHING, trained.device, trained.model.scale)
        first = decoder.of(trained.scene.train[0].camera)
        return cls(trained, trained.scene.video, first, decoder, FramePictures(trained), wire_unit(first))

    @classmethod
    def of_cloud(cls, trained: TrainedRun, cloud: SplatCloud, first: int = 0) -> ViewerContent:
        """Content of some Gaussians of a run; the view starts at a training frame."""
        return cls(trained, trained.scene.video, cloud, None, FramePictures(trained), wire_unit(cloud), first)

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
        """Where a view starts."""
        return self.trained.scene.train[self.first].camera

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """Up in the image where a view starts, world frame. [3]"""
        return -self.first_camera.camera_to_world[:3, 1].double().cpu().numpy()

    @cached_property
    def look_distance(self) -> float:
        """Distance of the point that the browser's camera turns about: the median depth in the first view.

        Of Gaussians, or else of the scene's points.
        """
        camera = self.first_camera
        centers = torch.as_tensor(self.baked.means if len(self.baked) else self.trained.scene.points.positions).double()
        depth, seen = camera.to("cpu", torch.float64).sees(centers)
        if seen.any():
            return float(depth[seen].median())
        return self.trained.scene.extent or 1.0

    @cached_property
    def flattened(self) -> HeldLight:
        """The same light everywhere: median distance and angle of what training cameras see; renders some views."""
        return flattened_light(self.trained.model, [frame.camera for frame in self.trained.scene.train])

    @property
    def near_plane(self) -> float:
        """z-depth from which on the browser draws, scene units: what renderers use, or a share of the distance."""
        return min(self.first_camera.near_plane, 0.02 * self.look_distance)


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
