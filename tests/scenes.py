"""Small scenes with closed-form truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.scene_files import write_camera_json
from coliags_plugin.core.scenes import Frame, PointCloud, Scene
from coliags_plugin.geometry.poses.c3vd import matrix_lines
from coliags_plugin.phantom.layouts import depth_steps


def camera_at(x: float, y: float, z: float, width: int = 32, height: int = 24, yaw: float = 0.0) -> Camera:
    """Looks along +z turned by ``yaw``; off-centre principal point, non-square pixels."""
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[0, 0] = c2w[2, 2] = math.cos(yaw)
    c2w[0, 2], c2w[2, 0] = math.sin(yaw), -math.sin(yaw)
    c2w[:3, 3] = torch.tensor([x, y, z])
    return Camera(0.9 * width, 0.85 * width, 0.52 * width, 0.47 * height, width, height, c2w)


def plain_frame(image: torch.Tensor, depth: torch.Tensor | None = None, mask: torch.Tensor | None = None) -> Frame:
    """A frame of these pixels, of a camera at the origin."""
    height, width = image.shape[:2]
    camera = Camera(100.0, 100.0, width / 2, height / 2, width, height, torch.eye(4))
    return Frame.of("0007", 7, image, camera, depth, mask)


def wall_color(points: torch.Tensor) -> torch.Tensor:
    """A smooth pattern on the wall z = 20, RGB in (0, 1)."""
    x, y = points[..., 0], points[..., 1]
    pattern = [0.6 + 0.3 * torch.sin(0.5 * x), 0.4 + 0.2 * torch.cos(0.7 * y), 0.3 + 0.1 * torch.sin(0.4 * (x + y))]
    return torch.stack(pattern, dim=-1)


def wall_scene(frames: int = 9, width: int = 32, height: int = 24, depth: bool = True, lamp: bool = True) -> Scene:
    """The wall z = 20 mm, lit by a lamp on the camera (1/d^2 in linear light) or evenly, filmed along a short path."""
    wall_frames = []
    for index in range(frames):
        camera = camera_at(0.4 * index, 0.1 * index, 0.5 * index, width, height)
        rays = camera.rays()
        z = (20.0 - camera.center[2]) / rays[..., 2]
        points = camera.center + z[..., None] * rays
        distance = (points - camera.center).norm(dim=-1, keepdim=True)
        rgb = wall_color(points) * ((18.0 / distance) ** (2 / 2.2) if lamp else 1.0)
        image = (rgb.clamp(0, 1) * 255).round().to(torch.uint8)
        wall_frames.append(Frame.of(f"{index:04d}", index, image, camera, z.float() if depth else None))
    test = [frame for frame in wall_frames if frame.index % 8 == 0]
    train = [frame for frame in wall_frames if frame.index % 8]
    grid = torch.stack(torch.meshgrid(torch.arange(-12.0, 16, 0.5), torch.arange(-10.0, 12, 0.5), indexing="ij"), -1)
    points = torch.cat([grid.reshape(-1, 2), torch.full((grid[..., 0].numel(), 1), 20.0)], dim=1)
    return Scene("wall", train, {"test": test}, PointCloud(points), Provenance(fingerprint=f"wall-{frames}-{depth}"))


#: Depth and half sizes of the plate before the wall, mm.
PLATE, HALF_PLATE = 9.0, torch.tensor([2.0, 1.6], dtype=torch.float64)


def hidden_by_plate(points: torch.Tensor, source: torch.Tensor) -> torch.Tensor:
    """Whether the plate is between points and a source in front of it."""
    crossing = source + (points - source) * ((PLATE - source[2]) / (points[..., 2:] - source[2]))
    return (points[..., 2] > PLATE) & (crossing[..., :2].abs() < HALF_PLATE).all(-1)


def plate_scene(lamp: Sequence[float], missing: float, frames: int = 12, width: int = 64, height: int = 48) -> Scene:
    """The wall z = 20 mm behind a plate, lit as :func:`wall_scene`; where the plate hides a lamp, a share is missing.

    The lamp's position is in camera axes.
    """
    plate_frames = []
    for index in range(frames):
        x, y, z = 2.5 * math.sin(0.7 * index), 2.0 * math.cos(0.9 * index), 1.5 * math.sin(index)
        camera = camera_at(x, y, z, width, height)
        center, rays = camera.center, camera.rays()
        on_plate, on_wall = (center + (depth - z) * rays for depth in (PLATE, 20.0))
        points = torch.where(hidden_by_plate(on_wall, center)[..., None], on_plate, on_wall)
        light = (18.0 / (points - center).norm(dim=-1)) ** (2 / 2.2)
        light *= 1.0 - missing * hidden_by_plate(points, center + torch.tensor(lamp, dtype=torch.float64))
        image = (0.5 * wall_color(points) * light[..., None] * 255).round().to(torch.uint8)
        plate_frames.append(Frame.of(f"{index:04d}", index, image, camera, (points[..., 2] - z).float()))
    x, y = torch.meshgrid(torch.arange(-12.0, 12.1, 0.5), torch.arange(-10.0, 10.1, 0.5), indexing="ij")
    wall = torch.stack([x, y, torch.full_like(x, 20.0)], dim=-1).reshape(-1, 3)
    plate = torch.cat([0.16 * wall[::2, :2], torch.full((len(wall[::2]), 1), PLATE)], dim=1)
    return Scene("plate", plate_frames, {}, PointCloud(torch.cat([wall, plate])), Provenance(fingerprint="plate"))


def write_wall(folder: Path, frames: int = 9, width: int = 32, height: int = 24, depth: bool = True) -> Path:
    """:func:`wall_scene` on disk, in C3VD's undistorted layout; without depth, its points stand in a file."""
    scene = wall_scene(frames, width, height, depth)
    ordered = sorted([*scene.train, *scene.test_sets["test"]], key=lambda frame: frame.index)
    return write_frames(folder, ordered, depth, None if depth else scene.points)


def write_frames(folder: Path, frames: Sequence[Frame], depth: bool = True, points: PointCloud | None = None) -> Path:
    """A whole scene of C3VD's undistorted layout, with all digits of its poses; depth in mm, NaN where unknown."""
    for index, frame in enumerate(frames):
        write_image(folder / f"images/{index:04d}_color.png", frame.image.numpy())
        if depth:
            write_image(folder / f"depths/{index:04d}_depth.png", depth_steps(frame.depth.numpy()))
    poses = torch.stack([frame.camera.camera_to_world.double() for frame in frames])
    atomic_write(folder / "camera_pose.txt", matrix_lines(poses.numpy()))
    intrinsics = frames[0].camera.intrinsics
    write_camera_json(folder / "camera.json", intrinsics, w=intrinsics.width, h=intrinsics.height)
    if points is not None:
        colors = None if points.colors is None else points.colors.numpy()
        write_ply(folder / "points3D.ply", point_properties(points.positions.numpy(), colors))
    return folder


#: Overrides that make a shipped method small enough for a test.
SMALL = ("datamanager.points_count=2000", "field.voxel_size=2.0", "schedule.log_every=1")
#: The same as words of a command.
SETS = [word for override in SMALL for word in ("--set", override)]
