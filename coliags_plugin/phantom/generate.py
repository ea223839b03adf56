"""Generates phantoms: colon, lighting, camera path, images and ground truth."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial.transform import Rotation

from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, reporting_unwritable, write_arrays, write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.registry import phantom_layouts
from coliags_plugin.geometry.poses.alignment import umeyama
from coliags_plugin.geometry.poses.trajectory import rigid
from coliags_plugin.phantom.colon import (
    ColonSurface,
    WallMotion,
    build_surface,
    frame_times,
    grow_anatomy,
    nearest_poses_first,
    seen_from,
    wall_motion,
)
from coliags_plugin.phantom.imaging import (
    KNEE,
    Exposure,
    Sensor,
    World,
    develop,
    expose,
    exposure_for,
    exposures,
    meter_weights,
    white_balances,
)
from coliags_plugin.phantom.layouts import Layout, Part, PhantomFrame, WallPoints
from coliags_plugin.phantom.light import CameraLight, IndirectLight, indirect_lights
from coliags_plugin.phantom.mucosa import Mucosa, paint_mucosa
from coliags_plugin.phantom.props import bodies_at, wet_lens
from coliags_plugin.phantom.settings import SAME_COLORS, PhantomSettings
from coliags_plugin.phantom.streams import Purpose, slow_drift, stream
from coliags_plugin.phantom.trajectory import RotationView, camera_path, poses_during, turn_away

_LOG = logging.getLogger(__name__)

#: Pixels of the exposure meter.
_METERED = 2500
#: Images rendered concurrently; open3d is multi-threaded itself, this fills the gaps between its calls.
_AT_ONCE = 2
#: Initial points of the layouts that have some: about as many as structure from motion finds in such a video.
_POINTS = 20_000
#: No closer to a moving wall than this, mm.
_CLEAR = 0.5
#: Pixels that tell how the wall in view has moved.
_FITTED = 4000


@dataclass(frozen=True)
class PreparedPhantom:
    """A prepared phantom: scene, camera poses and exposure, from which :func:`generate` renders the images.

    There are N images: the T frames of the sequence, and then the rotation views.
    """

    settings: PhantomSettings  # resolved
    layout: Layout
    world: World
    sensor: Sensor
    rotation_views: list[RotationView]  # test views with rotated cameras
    poses: Float[np.ndarray, "N 4 4"]  # camera-to-world of every image
    frames: list[int]  # frame of the sequence at whose place and time each image is
    indirect: list[IndirectLight | None]  # of every image
    gains: Float[np.ndarray, "N 3"]  # red, green, blue gain of every image
    motion: WallMotion | None  # of the wall; None if it is rigid

    @property
    def is_training(self) -> Bool[np.ndarray, "T"]:
        """Return which frames of the sequence are not held out."""
        return np.array([not self.layout.is_test(index) for index in range(self.settings.frames)])

    @property
    def training_poses(self) -> list[Float[np.ndarray, "4 4"]]:
        """Poses of the frames that are not held out."""
        return list(self.poses[: self.settings.frames][self.is_training])

    def world_at(self, number: int) -> World:
        """The world as it is in image ``number``."""
        frame = self.frames[number]
        surface = self.world.surface if self.motion is None else self.motion.at(frame)
        bodies = bodies_at(surface, self.settings, frame / self.settings.frame_rate)
        return replace(self.world, surface=surface, indirect=self.indirect[number], bodies=bodies)

    def render_frame(self, number: int) -> tuple[Exposure, UInt8[np.ndarray, "P 3"]]:
        """Render image ``number``."""
        settings, sensor = self.settings, self.sensor
        during: list[Float[np.ndarray, "4 4"]] = []
        if settings.shutter and number < settings.frames:
            focal_length = float(1.0 / np.sqrt(sensor.pixel_angle))
            sequence, least = self.poses[: settings.frames], sensor.samples.shape[1]
            during = poses_during(sequence, number, settings.shutter, focal_length, least)
        exposure = expose(self.world_at(number), sensor, self.poses[number], during)
        if settings.washes:
            time = self.frames[number] / settings.frame_rate
            radiance, cover = wet_lens(sensor.image(exposure.radiance), sensor.image(exposure.cover), settings, time)
            exposure = replace(exposure, radiance=radiance[sensor.mask], cover=cover[sensor.mask])
        if settings.softness:
            exposure = replace(exposure, radiance=sensor.softened(exposure.radiance, settings.softness))
        noise = stream(settings.seed, Purpose.SENSOR, number)
        return exposure, develop(exposure.radiance, self.gains[number], settings, noise, sensor)

    def wall(self, exposure: Exposure, number: int, pixels: Int[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
        """Wall points of lit pixels of image ``number``, world frame; if the wall moves, where they are at rest."""
        if self.motion is not None:
            rest = self.world.surface
            at_rest = rest.tracer.interpolate(rest.vertices, exposure.hits.only(pixels))
            return np.asarray(at_rest, np.float64)
        local, pose = self.sensor.centers[pixels] * exposure.z_depth[pixels, None], self.poses[number]
        return np.asarray(local.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])

    def seen(self, points: Float[np.ndarray, "N 3"], cameras: list[Float[np.ndarray, "4 4"]]) -> Bool[np.ndarray, "N"]:
        """Return which points of the wall are seen from at least one of these poses."""
        return seen_from(points, cameras, self.sensor.lens, self.sensor.mask, self.world.surface.tracer)


def resolve(settings: PhantomSettings, layout: Layout) -> PhantomSettings:
    """Settings with the image size, the layout's if none is given, and without rotation views if it has none."""
    width, height = layout.default_size
    views = settings.rotation_views if layout.has_rotation else 0
    size = {"width": settings.width or width, "height": settings.height or height}
    return settings.model_copy(update={**size, "rotation_views": views})


def prepare(settings: PhantomSettings, report: Progress) -> PreparedPhantom:
    """Generate the colon and the camera path, and solve for indirect light and exposure."""
    layout: Layout = phantom_layouts.get(settings.layout)()
    settings = resolve(settings, layout)
    report("colon", 0, 4)
    anatomy = grow_anatomy(settings)
    surface = build_surface(anatomy, settings)
    report("colon", 1, 4)
    mucosa = paint_mucosa(anatomy, surface, settings)
    report("colon", 2, 4)
    lamps = CameraLight.all_of(settings)
    motion = wall_motion(anatomy, surface, settings)
    sequence = camera_path(anatomy.centre_line, settings, surface.tracer, motion)
    training = [frame for frame in range(settings.frames) if not layout.is_test(frame)]
    views = turn_away(sequence, settings, training)
    poses = np.stack([*sequence, *(view.camera_to_world for view in views)])
    indirect: list[IndirectLight | None] = [None] * len(poses)
    if settings.interreflection > 0.0:
        generator = stream(settings.seed, Purpose.INTERREFLECTION)
        albedo = vertex_albedo(surface, mucosa)
        indirect[:] = indirect_lights(surface, albedo, lamps, poses, settings.interreflection, generator)
    report("colon", 3, 4)
    size = settings.width or 0, settings.height or 0
    lens, mask = layout.lens(*size)
    if real := settings.real_endoscope:
        lens = layout.lens_of(real.lens, *size)
    phantom = PreparedPhantom(
        settings,
        layout,
        World(surface, mucosa, lamps, settings.light_preset.vignetting),
        Sensor.behind(lens, mask, settings.supersampling),
        views,
        poses,
        [*range(settings.frames), *(view.frame for view in views)],
        indirect,
        np.ones((len(poses), 3)),
        motion,
    )
    phantom = replace(phantom, gains=_gains(phantom, report))
    report("colon", 4, 4)
    return phantom


def _gains(phantom: PreparedPhantom, report: Progress) -> Float[np.ndarray, "N 3"]:
    """Red, green and blue gain of every image, by metering; refuses a wall that moves over the camera."""
    settings, frames = phantom.settings, phantom.frames
    thin = phantom.sensor.subsampled(_METERED)
    weights, spacing = meter_weights(thin.mask, settings), float(np.sqrt(thin.pixel_angle))
    is_metered = settings.rotation_exposure == "metered"
    ideal = []
    for number in range(len(frames) if is_metered else settings.frames):
        world, pose = phantom.world_at(number), phantom.poses[number]
        if phantom.motion is not None and number < settings.frames:
            nearest = float(world.surface.tracer.clearance(pose[None, :3, 3])[0])
            if nearest < _CLEAR:
                raise InputError(
                    f"the wall moves to {nearest:.1f} mm from the camera at frame {number}",
                    f"at least {_CLEAR:g} mm",
                    "Choose a smaller wave or breathing, or another seed",
                )
        radiance, _, _ = world.look(pose, thin.centers, spacing)
        ideal.append(exposure_for(radiance, settings, weights))
        if settings.moves:
            report("exposure", min(number + 1, settings.frames), settings.frames)
    during, settled = ideal[: settings.frames], ideal[settings.frames :]
    levels = exposures(during, settings)
    rotated = exposures(during, settings, settled) if is_metered else levels[frames[settings.frames :]]
    return np.concatenate([levels, rotated])[:, None] * white_balances(settings)[frames]


def generate(
    settings: PhantomSettings, output: Path, overwrite: bool = False, progress: Progress | None = None
) -> None:
    """Generate a phantom and write it, atomically.

    The folder holds the sequence in ``settings.layout``; rotation-only test views and their seen masks, if the layout
    supports them; ``truth/``, with the mesh, the albedo, the light, every frame's gain, the poses in float64, and the
    seen masks of the sequence's test frames; and ``phantom.json``. The same settings give the same bytes.
    """
    report = progress or (lambda stage, done, total: None)
    with reporting_unwritable(output), atomic_folder(output, overwrite) as folder:
        phantom = prepare(settings, report)
        _write(phantom, folder, report)
        write_json(folder / "phantom.json", {"version": __version__, "settings": phantom.settings.model_dump()})
    _LOG.info("phantom of seed %d written to %s", settings.seed, output)


def _write(phantom: PreparedPhantom, folder: Path, report: Progress) -> None:
    settings, layout, lens, total = phantom.settings, phantom.layout, phantom.sensor.lens, len(phantom.poses)
    frames, training = settings.frames, phantom.is_training
    # Coverage as C3VD counts it: triangles that are the first hit of any pixel ray of any frame.
    observed = np.zeros(len(phantom.world.surface.triangles), bool)
    trained_on = np.zeros_like(observed)
    drawn = []
    fits = []
    report("frames", 0, total)
    for number, (exposure, color) in enumerate(_rendered_frames(phantom, total)):
        image = phantom.sensor.image
        part: Part = "video" if number < frames else "rotation"
        index = number if part == "video" else number - frames
        z_depth = image(exposure.z_depth)
        if settings.depth_noise and part == "video" and training[index]:
            z_depth = estimated_depth(z_depth, settings, index)
        layout.write_frame(folder, PhantomFrame(part, index, image(color), z_depth))
        if phantom.motion is not None and part == "video":
            fits.append(_to_rest(phantom, exposure, number))
        if settings.covers and part == "video":
            write_image(folder / "truth" / "not_wall" / f"{index:04d}.png", image(exposure.cover))
        if part == "video":
            observed[exposure.triangles] = True
        if part == "video" and training[index]:
            trained_on[exposure.triangles] = True
            if layout.has_points:
                drawn.append(_draw_points(phantom, index, exposure, color))
        else:
            mask = image(_seen_mask(phantom, exposure, number))
            write_image(layout.seen_mask(folder, part, index), mask)
        report("frames", number + 1, total)
    poses = phantom.poses
    if any(settings.pose_noise):  # as a tracker would give them
        drift = pose_errors(settings, np.zeros(frames, bool))[phantom.frames[frames:]]
        poses = displaced(poses, np.concatenate([pose_errors(settings, training), drift]))
    layout.write_sequence(folder, "video", poses[:frames], lens)
    if phantom.rotation_views:
        layout.write_sequence(folder, "rotation", poses[frames:], lens)
    if layout.has_points:
        positions, colors = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        points = WallPoints(positions, colors, lambda index: phantom.seen(positions, [phantom.poses[index]]))
        layout.write_points(folder, points, poses[:frames], lens)
    report("truth", 0, 1)
    _write_truth(phantom, folder / "truth", trained_on, observed, fits)
    report("truth", 1, 1)


def _rendered_frames(phantom: PreparedPhantom, total: int) -> Iterator[tuple[Exposure, UInt8[np.ndarray, "P 3"]]]:
    """All images in order, rendered a few ahead of the writer."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        waiting = [pool.submit(phantom.render_frame, number) for number in range(min(_AT_ONCE, total))]
        for number in range(total):
            ready = waiting.pop(0).result()
            if number + _AT_ONCE < total:
                waiting.append(pool.submit(phantom.render_frame, number + _AT_ONCE))
            yield ready


def _seen_mask(phantom: PreparedPhantom, exposure: Exposure, number: int) -> UInt8[np.ndarray, "P"]:
    """Seen mask: 255 where a training frame sees the pixel's surface point, else 0."""
    hit = np.flatnonzero(exposure.z_depth > 0.0)
    points = phantom.wall(exposure, number, hit)
    mask = np.zeros(len(exposure.z_depth), np.uint8)
    order = nearest_poses_first(phantom.poses[number], phantom.training_poses)
    mask[hit] = np.where(phantom.seen(points, order), 255, 0)
    return mask


def _draw_points(
    phantom: PreparedPhantom, index: int, exposure: Exposure, color: UInt8[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]:
    """This training frame's share of the initial points and their colours."""
    hit = np.flatnonzero(exposure.z_depth > 0.0)
    share = min(-(-_POINTS // len(phantom.training_poses)), len(hit))
    generator = stream(phantom.settings.seed, Purpose.POINTS, index)
    chosen = np.sort(generator.choice(hit, share, replace=False))
    return phantom.wall(exposure, index, chosen), color[chosen]


def _write_truth(
    phantom: PreparedPhantom,
    folder: Path,
    trained_on: Bool[np.ndarray, "F"],
    observed: Bool[np.ndarray, "F"],
    fits: Sequence[tuple[Float[np.ndarray, "4 4"], float]],
) -> None:
    surface, settings, motion = phantom.world.surface, phantom.settings, phantom.motion
    folder.mkdir(parents=True, exist_ok=True)
    albedo = vertex_albedo(surface, phantom.world.mucosa)
    _write_mesh(folder / "mesh.ply", surface, albedo)
    vertex_seen = phantom.seen(surface.vertices.astype(np.float64), phantom.training_poses)
    faces = {"face_seen": trained_on, "face_seen_by_any_frame": observed}
    write_arrays(folder / "mesh_seen.npz", {"vertex_seen": vertex_seen, **faces})
    texture = {"texture": phantom.world.mucosa.albedo.astype(np.float16), "vertex_albedo": albedo}
    grid = {"row_arc_mm": surface.arc, "columns": np.array(surface.columns)}
    write_arrays(folder / "albedo.npz", texture | grid)
    np.save(folder / "camera_to_world.npy", phantom.poses[: settings.frames])
    _write_gains(folder / "gain.csv", phantom.gains[: settings.frames])
    if phantom.rotation_views:
        _write_gains(folder / "rotation_gain.csv", phantom.gains[settings.frames :])
    lamps = [lamp.describe() for lamp in phantom.world.lamps]
    light: dict[str, Any] = {
        "law": "pixel = noise + shoulder(gain * cos(theta)^vignetting * (albedo * (E n.l + E_indirect) + gloss E))"
        "^(1/gamma), E = beam(psi) (unit_distance_mm / d)^2, psi and d at the lamp",
        **({"lamp": lamps[0]} if len(lamps) == 1 else {"lamps": lamps}),
        "vignetting": phantom.world.vignetting,
        "interreflection": settings.interreflection,
        "gamma": settings.gamma,
        "shoulder_knee": KNEE,
        "noise_grey_levels": settings.noise,
        "gain": settings.gain,
        "rotation_views": [
            {"frame": view.frame, "turn_degrees": round(view.turn, 6)} for view in phantom.rotation_views
        ],
    }
    if settings.s_curve:
        light["s_curve"] = settings.s_curve
    if settings.color_matrix != SAME_COLORS:
        light["color_matrix"] = settings.color_matrix
    write_json(folder / "light.json", light)
    if motion is not None:
        relative, residuals = zip(*fits, strict=True)
        np.save(folder / "camera_to_wall.npy", np.stack(relative))
        displacement = {"radial": motion.radial, "wave_mm": motion.wave, "shift_mm": motion.shift}
        times = {"time_s": frame_times(settings), "residual_mm": np.array(residuals)}
        write_arrays(folder / "wall_motion.npz", displacement | times)


def _to_rest(phantom: PreparedPhantom, exposure: Exposure, number: int) -> tuple[Float[np.ndarray, "4 4"], float]:
    """The pose relative to the wall in view as it is at rest, by the best rigid fit, and its residual (RMS), mm."""
    hit = np.flatnonzero(exposure.z_depth > 0.0)
    hit, pose = hit[:: max(len(hit) // _FITTED, 1)], phantom.poses[number]
    moved = exposure.z_depth[hit, None].astype(np.float64) * phantom.sensor.centers[hit] @ pose[:3, :3].T + pose[:3, 3]
    at_rest = phantom.wall(exposure, number, hit)
    fit = umeyama(moved, at_rest)
    relative = pose.copy()
    relative[:3, :3], relative[:3, 3] = fit.rotation @ pose[:3, :3], fit.points(pose[None, :3, 3])[0]
    return relative, float(np.sqrt(((fit.points(moved) - at_rest) ** 2).sum(axis=1).mean()))


def vertex_albedo(surface: ColonSurface, mucosa: Mucosa) -> Float[np.ndarray, "V 3"]:
    """Albedo at the mesh's vertices, averaged over a mesh cell."""
    row, column = np.meshgrid(
        np.arange(surface.rows, dtype=np.float32), np.arange(surface.columns, dtype=np.float32), indexing="ij"
    )
    footprint = np.full(row.size, surface.row_length, np.float32)
    return mucosa.sample(row.ravel(), column.ravel(), footprint).albedo


def _write_mesh(path: Path, surface: ColonSurface, albedo: Float[np.ndarray, "V 3"]) -> None:
    """Write the wall as a binary PLY; vertex colours are the albedo, encoded with gamma 2.2."""
    colors = np.rint(255.0 * np.clip(albedo, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)
    normals = dict(zip(("nx", "ny", "nz"), surface.normals.T, strict=True))
    shades = dict(zip(("red", "green", "blue"), colors.T, strict=True))
    properties = point_properties(surface.vertices) | normals | shades
    write_ply(path, properties, surface.triangles, "millimetres; colour = albedo ^ (1 / 2.2)")


def _write_gains(path: Path, gains: Float[np.ndarray, "T 3"]) -> None:
    rows = np.column_stack([np.arange(len(gains)), gains])
    np.savetxt(path, rows, "%d,%.9g,%.9g,%.9g", header="frame,gain_r,gain_g,gain_b", comments="")


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
    rotations = poses[:, :3, :3] @ Rotation.from_rotvec(errors[:, 3:]).as_matrix()
    return rigid(rotations, poses[:, :3, 3] + errors[:, :3])


def estimated_depth(
    z_depth: Float[np.ndarray, "H W"], settings: PhantomSettings, frame: int
) -> Float[np.ndarray, "H W"]:
    """The z-depth of a frame as it is given, mm: it bleeds over edges, and its relative noise is smooth; 0 stays 0."""
    height, width = z_depth.shape
    is_wall = z_depth > 0.0
    sigma = max(_BLEEDING * width, 0.3)
    weight = cv2.GaussianBlur(is_wall.astype(np.float32), (0, 0), sigma)
    blurred = cv2.GaussianBlur(z_depth, (0, 0), sigma) / np.maximum(weight, 1e-6)
    noise = stream(settings.seed, Purpose.DEPTH_NOISE, frame).standard_normal((height, width))
    blobs = _BLOBS * width
    # A Gaussian kernel in two dimensions leaves 1 / (2 sqrt(pi) sigma) of the deviation of white noise.
    noise = scipy.ndimage.gaussian_filter(noise, blobs, mode="wrap") * (2.0 * np.sqrt(np.pi) * blobs)
    return np.where(is_wall, blurred * np.exp(settings.depth_noise * noise), 0.0).astype(np.float32)
