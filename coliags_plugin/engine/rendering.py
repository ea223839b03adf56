"""Images and a video of a trained run, along its trajectory or through the keyframes of a camera path."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from pydantic import Field, field_validator
from torch import Tensor

from coliags_plugin.config.options import RenderOptions
from coliags_plugin.config.yaml_tree import dump, tuples
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, check_name, did_you_mean
from coliags_plugin.core.files import atomic_folder, atomic_write, write_json
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.render_output import OPAQUE_ALPHA, RenderOutput
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.settings import Settings, invalid_reported
from coliags_plugin.engine.held_light import render_held
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.reporting.colormaps import (
    color_bar,
    colorize_depth,
    colorize_error,
    depth_error,
    depth_limits,
    error_limit,
    rgb_error,
)
from coliags_plugin.reporting.image_files import eight_bit, write_depth_tiff, write_png
from coliags_plugin.reporting.video import check_rate, write_video

_View = TypeVar("_View", Frame, Camera, Frame | Camera)
#: Outputs of a view unless others are asked for.
_WANTS = ("rgb", "alpha", "depth_accumulated")


def render_run(trained: TrainedRun, options: RenderOptions) -> Path:
    """Render colour, depth and error images of frames, and, unless some are named singly, a video of the trajectory.

    A relit run has its light in ``lamp.yaml``, and no colour errors, there being no images in that light. Depth, of one
    of the kinds of docs/conventions.md 3, is hatched where alpha is below 0.5, and has no errors where the scene's own
    is estimated; as float32 TIFF it has scene units and all pixels. Errors of the frames have one scale, in a picture
    beside their folder. Feature channels have one or three numbers, 1 is white. The video, ``trajectory.mp4``, has
    every frame's view in video order, rgb beside depth. With a camera path to go ``along``, there are no images of
    frames, and the video is ``path.mp4``. Returns the folder.
    """
    along = None if options.along is None else CameraPath.read(options.along)
    output = options.output or trained.run.path / ("path" if along else "relit" if trained.relit else "renders")
    chosen = [] if along is not None else choose_frames(trained.scene, options.frames)
    channels = options.channels
    for channel in channels:
        check_name("feature channel", channel, sorted(trained.model.field.feature_channels))
    depth = f"depth_{options.depth_kind}"
    wants, unit = ("rgb", "alpha", depth), trained.scene.length_unit
    trained.model.check_outputs(wants, f"depth of kind '{options.depth_kind}'")
    path: Sequence[Frame | Camera] = trained.scene.video
    if along is not None:
        path = list(along.cameras(trained.scene.train[0].camera, options.fps))
    video = options.video and (along is not None or frame_sets(trained.scene).keys() >= {*options.frames})
    limits = sampled_depth_limits(trained, chosen or path, depth)
    ends = _error_ends(trained, chosen, depth)
    with (
        atomic_folder(output, options.overwrite) as folder,
        ProgressReport("render", len(chosen) + len(path) * video) as progress,
    ):
        for count, frame in enumerate(chosen, start=1):
            view = render_view(trained, frame, (*wants, *channels))
            write_png(folder / "rgb" / f"{frame.name}.png", eight_bit(view.rgb))
            write_png(folder / "depth" / f"{frame.name}.png", depth_picture(view, depth, limits))
            for name, error in _errors(trained, frame, view, depth).items():
                write_png(folder / name / f"{frame.name}.png", colorize_error(error, ends[name]))
            if options.depth_tiff:
                write_depth_tiff(folder / "depth_tiff" / f"{frame.name}.tiff", view[depth])
            for channel in channels:
                write_png(folder / channel / f"{frame.name}.png", eight_bit(_as_rgb(view[channel])))
            progress.update(count)
        write_png(folder / "depth_scale.png", color_bar(limits, unit, "depth"))
        for name, of in (("rgb_error", "of full scale"), ("depth_error", unit)):
            if (folder / name).exists():  # some frame has such an error
                write_png(folder / f"{name}_scale.png", color_bar((0.0, ends[name]), of, "error"))
        for light in (trained.lamp, trained.held):
            if light is not None:
                atomic_write(folder / "lamp.yaml", dump(light.described))
        if video:
            name = "trajectory.mp4" if along is None else "path.mp4"
            write_video(_film(trained, path, depth, limits, progress, len(chosen)), folder / name, options.fps)
    return output


def sampled_depth_limits(trained: TrainedRun, views: Sequence[Frame | Camera], depth: str) -> tuple[float, float]:
    """One scale for a kind of depth of all views, from that of four of them."""
    rendered = (render_view(trained, view, ("rgb", "alpha", depth)) for view in _sample(views))
    return depth_limits(opaque_depth(output, depth) for output in rendered)


def _error_ends(trained: TrainedRun, frames: Sequence[Frame], depth: str) -> dict[str, float]:
    """Ends of the scales of errors by the names of their pictures, from the errors of four frames."""
    wants = ("rgb", "alpha", depth)
    sample = [_errors(trained, frame, render_view(trained, frame, wants), depth) for frame in _sample(frames)]
    return {name: error_limit(each[name] for each in sample if name in each) for name in ("rgb_error", "depth_error")}


def _sample(views: Sequence[_View]) -> Sequence[_View]:
    return views[:: max(1, len(views) // 4)][:4]


def _errors(trained: TrainedRun, frame: Frame, output: RenderOutput, depth: str) -> dict[str, np.ndarray]:
    """Absolute errors of a rendered frame by the names of their pictures; of depth, scene units."""
    errors, valid = {}, frame.valid.cpu()
    if not trained.relit:
        errors["rgb_error"] = rgb_error(output.rgb.cpu(), frame.image, valid)
    if (true := frame.true_depth) is not None:
        errors["depth_error"] = depth_error(output[depth].cpu(), true, valid)
    return errors


def frame_sets(scene: Scene) -> dict[str, list[Frame]]:
    """Sets of frames that are not empty: ``train``, every test set, and ``all`` (train and test in video order)."""
    sets = {"train": scene.train, **scene.test_sets, "all": scene.video}
    return {name: frames for name, frames in sets.items() if frames}


def choose_frames(scene: Scene, names: Sequence[str]) -> list[Frame]:
    """Frames of a scene by names of sets (:func:`frame_sets`) or of single frames, each frame once."""
    sets = frame_sets(scene)
    named = {frame.name: [frame] for frames in sets.values() for frame in frames} | sets
    for name in names:
        if name not in named:
            expected = f"{', '.join(sets)}, or the name of a frame such as {scene.train[0].name}"
            raise InputError(f"scene '{scene.name}' has no frame '{name}'", expected, did_you_mean(name, named))
    return [*{frame.name: frame for name in names for frame in named[name]}.values()]


@torch.no_grad()
def render_view(trained: TrainedRun, of: Frame | Camera, wants: Sequence[str] = _WANTS) -> RenderOutput:
    """Render a frame of a run's scene, or the view of a free camera."""
    if trained.held is not None:
        camera = of if isinstance(of, Camera) else of.camera
        return render_held(trained.model, camera.to(trained.device), trained.held, wants)
    if isinstance(of, Camera):
        return trained.model.render(of.to(trained.device), wants)
    view = of.view(trained=of.name in trained.training_frames)
    return trained.model.render(of.camera.to(trained.device), wants, view)


def _as_rgb(channel: Tensor) -> Tensor:
    """Three equal numbers per pixel where the channel has one. [H, W, 3]"""
    return channel.reshape(*channel.shape[:2], -1).expand(-1, -1, 3)


def depth_picture(output: RenderOutput, depth: str, limits: tuple[float, float]) -> UInt8[np.ndarray, "H W 3"]:
    """A rendered depth in colours between two limits, hatched where alpha is below :data:`OPAQUE_ALPHA`."""
    return colorize_depth(opaque_depth(output, depth), limits, hatched=True)


def opaque_depth(output: RenderOutput, depth: str) -> Float[Tensor, "H W"]:
    """A rendered depth, NaN where alpha is below :data:`OPAQUE_ALPHA`. [H, W]"""
    return torch.where(output.alpha >= OPAQUE_ALPHA, output[depth], torch.nan)


def _film(
    trained: TrainedRun,
    path: Sequence[Frame | Camera],
    depth: str,
    limits: tuple[float, float],
    progress: ProgressReport,
    done: int,
) -> Iterator[np.ndarray]:
    for count, view in enumerate(path, start=1):
        output = render_view(trained, view, ("rgb", "alpha", depth))
        rgb = eight_bit(output.rgb).cpu().numpy()
        yield np.concatenate([rgb, depth_picture(output, depth, limits)], axis=1)
        progress.update(done + count)


_EXPECTED = "a camera path as `coliags view` saves it (docs/viewer.md 6)"
#: How far the rows of a rotation may be from orthonormal.
_TOLERANCE = 1e-4


class Keyframe(Settings):
    """A camera of a path: its pose in OpenCV's axes, scene units, and its vertical field of view."""

    camera_to_world: tuple[tuple[float, float, float, float], ...]  # 4 rows
    vertical_fov_degrees: float = Field(gt=0, lt=180)

    @classmethod
    def of(cls, camera: Camera) -> Keyframe:
        """The keyframe of a camera."""
        fov = 2.0 * math.degrees(math.atan(0.5 * camera.height / camera.fy))
        rows = tuple(map(tuple, camera.camera_to_world.double().tolist()))
        return cls(camera_to_world=rows, vertical_fov_degrees=fov)

    @field_validator("camera_to_world")
    @classmethod
    def _rigid(cls, rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        matrix = np.array(rows)
        turn = matrix[:3, :3]
        if (
            matrix.shape != (4, 4)
            or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]
            or np.abs(turn @ turn.T - np.eye(3)).max() > _TOLERANCE
            or np.linalg.det(turn) < 0.0
        ):
            raise ValueError("not a rotation and a translation, 4 rows of 4 numbers, the last one 0 0 0 1")
        return rows


class CameraPath(Settings):
    """Keyframes that a camera passes at equal times."""

    keyframes: tuple[Keyframe, ...] = Field(min_length=2, max_length=1000)
    seconds: float = Field(default=2.0, gt=0, le=60)  # from one keyframe to the next

    def write(self, file: Path) -> None:
        """Write the path as JSON, atomically."""
        write_json(file, self.model_dump())

    @classmethod
    def read(cls, file: Path) -> CameraPath:
        """Read a path; InputError where the file is none."""
        with invalid_reported(f"{file}: ", _EXPECTED):
            return cls.model_validate(tuples(read_json(file, _EXPECTED, finite=True)))

    def cameras(self, like: Camera, fps: float) -> Iterator[Camera]:
        """Cameras of a video at a rate, of the size and near plane of a camera, with the principal point in the middle.

        Places and fields of view go smoothly and do not leave the range of the two keyframes around them (PCHIP);
        directions follow a spline of rotations.
        """
        from scipy.interpolate import PchipInterpolator
        from scipy.spatial.transform import Rotation, RotationSpline

        check_rate(fps)
        poses = np.array([keyframe.camera_to_world for keyframe in self.keyframes])
        at = self.seconds * np.arange(len(poses))
        times = np.linspace(0.0, at[-1], max(2, round(at[-1] * fps) + 1))
        centers = PchipInterpolator(at, poses[:, :3, 3])(times)
        turns = RotationSpline(at, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
        fovs = PchipInterpolator(at, [keyframe.vertical_fov_degrees for keyframe in self.keyframes])(times)
        for center, turn, fov in zip(centers, turns, fovs, strict=True):
            focal, matrix = 0.5 * like.height / math.tan(0.5 * math.radians(fov)), torch.eye(4)
            matrix[:3, :3], matrix[:3, 3] = torch.from_numpy(turn), torch.from_numpy(center)
            yield Camera(
                focal, focal, 0.5 * like.width, 0.5 * like.height, like.width, like.height, matrix, like.near_plane
            )
