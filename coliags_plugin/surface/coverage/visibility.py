"""Recorded views, and the triangles of a mesh that they saw, how often and how well, by casting viewing rays.

Rays go through the lens of the stored images, which are not undistorted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.settings import Settings
from coliags_plugin.datamanagers.file_formats import all_of, read_mask
from coliags_plugin.datamanagers.shots import StoredPixels
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.geometry.meshes.mesh import TriangleMesh


class CoverageSettings(Settings):
    """Options of what counts as seen well, and of which missed regions are listed. Lengths are mm."""

    max_distance: float = Field(default=100.0, gt=0.0)  # farthest z-depth at which surface counts as seen, mm
    far: float = Field(default=60.0, gt=0.0)  # surface that no frame shows from nearer is seen too far away, mm
    dark: float = Field(default=0.12, ge=0.0, le=1.0)  # grey value below which a pixel is too dark to judge the surface
    # Angle to the surface's normal above which it is only glanced at, degrees.
    grazing: float = Field(default=75.0, gt=0.0, le=90.0)
    # Fewest frames that show a surface well; with fewer it is seen only at a glance.
    glance_frames: int = Field(default=3, ge=1)
    # Diameter of the circle of the smallest missed area that is listed, mm.
    region_diameter: float = Field(default=5.0, gt=0.0)
    # Most viewing rays per frame. Images with fewer pixels get 2 x 2 rays a pixel, larger ones are sampled more
    # coarsely.
    rays: int = Field(default=150_000, ge=1000)

    @property
    def region_area(self) -> float:
        """Area of the smallest missed region that is listed, mm^2."""
        return 0.25 * math.pi * self.region_diameter**2


@dataclass(frozen=True)
class CoverageView:
    """One recorded frame."""

    name: str
    camera_to_world: Float[np.ndarray, "4 4"]  # pose, OpenCV axes, mm
    lens: Lens  # the lens it was taken through, at the size of the image
    mask: Bool[np.ndarray, "H W"] | None = None  # pixels with image content; None for all
    # Reads the image through that lens; None where there is none.
    read_image: Callable[[], UInt8[np.ndarray, "H W 3"]] | None = field(default=None, repr=False)

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Optical centre, world, mm. [3]"""
        return np.asarray(self.camera_to_world[:3, 3], np.float64)


@dataclass(frozen=True)
class RayGrid:
    """Viewing rays on an even grid over the image of a lens, R of them where the image has content."""

    size: tuple[int, int]  # width and height of the grid
    cells: Int[np.ndarray, "R"]  # indices in the grid, row by row
    directions: Float32[np.ndarray, "R 3"]  # camera axes, z = 1
    pixel_angles: Float32[np.ndarray, "R"]  # solid angle of one pixel of the image along each ray, steradians

    @classmethod
    def of(cls, lens: Lens, mask: Bool[np.ndarray, "H W"] | None, most: int) -> RayGrid:
        """The grid of a lens and mask, with at most about ``most`` rays and no more than 2 x 2 in a pixel."""
        scale = min(2.0, (most / (lens.width * lens.height)) ** 0.5)
        # Whole rays per pixel where there is one or more, so that every pixel is sampled alike.
        scale = scale if scale < 1.0 else float(int(scale))
        width, height = max(1, round(lens.width * scale)), max(1, round(lens.height * scale))
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        stretch = np.array([lens.width / width, lens.height / height])
        pixels = np.stack([column.ravel(), row.ravel()], axis=1) * stretch
        inside = np.ones(len(pixels), bool)
        if mask is not None:
            inside = mask[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        directions = np.full((len(pixels), 3), np.nan)
        directions[inside] = lens.unproject(pixels[inside])
        cells = np.flatnonzero(np.isfinite(directions).all(axis=1))
        directions, pixels = directions[cells], pixels[cells]
        # From directions half a pixel aside; 0 where the lens ends there.
        right, down = (lens.unproject(pixels + aside) - lens.unproject(pixels - aside) for aside in 0.5 * np.eye(2))
        area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
        angles = np.nan_to_num(area / np.linalg.norm(directions, axis=1) ** 3)
        return cls((width, height), cells, directions.astype(np.float32), angles.astype(np.float32))

    def nearest(self, lens: Lens, pixels: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "N"]:
        """The ray nearest to each pixel of the lens; -1 outside the image and its content. [N]"""
        width, height = self.size
        ray_of_cell = np.full(width * height, -1)
        ray_of_cell[self.cells] = np.arange(len(self.cells))
        with np.errstate(invalid="ignore"):
            cell = pixels * (width / lens.width, height / lens.height)
            inside = np.all((cell >= 0.0) & (cell < (width, height)), axis=1)
        column, row = np.where(inside[:, None], cell, 0.0).astype(int).T
        return np.asarray(np.where(inside, ray_of_cell[row * width + column], -1))

    def brightness(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "R"]:
        """Grey value of the image, 0 to 1, along each ray. [R]"""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        width, height = self.size
        smaller = width < grey.shape[1]
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
        return np.asarray(grey.reshape(-1)[self.cells].astype(np.float32) / np.float32(255.0))


def recorded_views(scene: Scene) -> list[CoverageView]:
    """Views of all frames of the video, held out or not, in its order; two frames or more."""
    if len(scene.video) < 2:
        raise InputError(f"scene '{scene.name}' has {len(scene.video)} frame", "two frames or more")
    return [_view(frame) for frame in scene.video]


def _view(frame: Frame) -> CoverageView:
    stored = frame.source
    if not isinstance(stored, StoredPixels):
        camera = frame.camera
        mask = None if frame.mask is None else frame.mask.numpy()
        pose = camera.camera_to_world.double().numpy()
        return CoverageView(frame.name, pose, PinholeLens.of(camera.intrinsics), mask, frame.image.numpy)
    shot, rectification = stored.shot, stored.shot.rectification
    mask = None if shot.mask is None else rectification.checked(shot.mask, read_mask(shot.mask))
    content = all_of(rectification.stored_content, mask, shot.shown())
    pose = np.asarray(stored.camera_to_world, np.float64)
    return CoverageView(
        shot.name,
        pose,
        rectification.lens,
        content,
        lambda: rectification.checked(shot.image, read_rgb(shot.image)),
    )


#: Frames that decide which side of a mesh the cameras are on, and rays of each.
_PROBE_FRAMES, _PROBE_RAYS = 8, 20_000


@dataclass(frozen=True)
class RayHits:
    """Rays of one frame that hit a triangle within the range. All [N]."""

    triangle: Int[np.ndarray, "N"]  # what they hit
    ray: Int[np.ndarray, "N"]  # their indices among the rays of the grid
    distance: Float32[np.ndarray, "N"]  # mm
    cosine: Float32[np.ndarray, "N"]  # of the angle between ray and normal, 1 where perpendicular to the surface


@dataclass(frozen=True, eq=False)
class FaceViews:
    """Counts and extremes over the frames that saw each triangle of a mesh. All [F]."""

    frames: Int[np.ndarray, "F"]  # number of frames that saw it at all
    clear_frames: Int[np.ndarray, "F"]  # those that saw it near enough and bright enough
    good_frames: Int[np.ndarray, "F"]  # those of the latter that saw it under a steep enough angle
    # Smallest distance to a camera that saw it, mm; NaN where unseen, here and below.
    distance: Float32[np.ndarray, "F"]
    cosine: Float32[np.ndarray, "F"]  # of the smallest angle between viewing ray and normal
    pixels_per_length: Float32[np.ndarray, "F"]  # finest sampling of the surface by an image, pixels per mm
    brightness: Float32[np.ndarray, "F"]  # highest grey value, 0 to 1; NaN also without images
    best_frame: Int[np.ndarray, "F"]  # index of the frame that sampled it most finely; -1 where unseen

    @classmethod
    def unseen(cls, faces: int) -> FaceViews:
        """The views of triangles before any frame."""
        frames, clear, good = np.zeros((3, faces), np.int32)
        distance, cosine, fineness, brightness = np.full((4, faces), np.nan, np.float32)
        best = np.full(faces, -1, np.int32)
        return cls(frames, clear, good, distance, cosine, fineness, brightness, best)

    @property
    def seen(self) -> Bool[np.ndarray, "F"]:
        """Mask of triangles that a frame saw. [F]"""
        return np.asarray(self.frames > 0)

    @property
    def incidence(self) -> Float32[np.ndarray, "F"]:
        """Smallest angle between viewing ray and normal, degrees. [F]"""
        return np.asarray(np.degrees(np.arccos(np.clip(self.cosine, -1.0, 1.0))))

    def add(self, number: int, hits: RayHits, grid: RayGrid, view: CoverageView, settings: CoverageSettings) -> None:
        """Count a frame by the triangles that it hits."""
        face = hits.triangle
        clear = hits.distance <= settings.far
        if view.read_image is not None and len(face):
            brightness = grid.brightness(view.read_image())[hits.ray]
            clear &= brightness >= settings.dark
            np.fmax.at(self.brightness, face, brightness)
        good = clear & (hits.cosine >= np.cos(np.radians(settings.grazing)))
        self.frames[np.unique(face)] += 1
        self.clear_frames[np.unique(face[clear])] += 1
        self.good_frames[np.unique(face[good])] += 1
        np.fmin.at(self.distance, face, hits.distance)
        np.fmax.at(self.cosine, face, hits.cosine)
        # A pixel covers solid angle * distance^2 / cosine of the surface.
        patch = grid.pixel_angles[hits.ray] * hits.distance**2
        before = np.nan_to_num(self.pixels_per_length, nan=-1.0)
        fineness = np.sqrt(hits.cosine / np.maximum(patch, np.finfo(np.float32).tiny))
        np.fmax.at(self.pixels_per_length, face, fineness)
        self.best_frame[self.pixels_per_length > before] = number


def view_hits(
    mesh: TriangleMesh, view: CoverageView, grid: RayGrid, max_depth: float, both_sides: bool = False
) -> RayHits:
    """First hits of the rays of a view, up to a z-depth in mm, from the front; or, cosines below 0, from behind."""
    rays = np.einsum("nc,dc->nd", grid.directions, view.camera_to_world[:3, :3].astype(np.float32))
    triangle, z_depth = mesh.rays.cast(view.center, rays)
    hit = np.flatnonzero((triangle >= 0) & (z_depth <= max_depth))
    length = np.linalg.norm(grid.directions[hit], axis=1)
    cosine = -np.einsum("nc,nc->n", rays[hit], mesh.normals[triangle[hit]].astype(np.float32)) / length
    facing = np.flatnonzero(cosine > -np.inf if both_sides else cosine > 0.0)
    hit = hit[facing]
    return RayHits(triangle[hit], hit, (z_depth[hit] * length[facing]).astype(np.float32), cosine[facing])


def _visible_centroids(
    mesh: TriangleMesh, view: CoverageView, grid: RayGrid, triangles: Int[np.ndarray, "K"], max_depth: float
) -> RayHits:
    """Triangles whose centroids a view sees, each as a hit of the nearest ray of its grid."""
    offset = mesh.centers[triangles] - view.center
    local = offset @ view.camera_to_world[:3, :3]
    distance = np.linalg.norm(offset, axis=1)
    normals = mesh.normals[triangles].astype(np.float32)
    cosine = -np.einsum("nc,nc->n", offset, normals) / np.maximum(distance, 1e-9)
    narrowest = float(1.0 / np.linalg.norm(grid.directions, axis=1).max(initial=1.0))  # cosine to the optical axis
    ahead = (local[:, 2] > narrowest * distance) & (local[:, 2] <= max_depth) & (cosine > 0.0)
    visible = np.flatnonzero(ahead)
    rays = grid.nearest(view.lens, view.lens.project(local[visible]))
    visible, rays = visible[rays >= 0], rays[rays >= 0]
    blocked = mesh.rays.blocked(view.center, offset[visible])
    visible, rays = visible[~blocked], rays[~blocked]
    return RayHits(triangles[visible], rays, distance[visible].astype(np.float32), cosine[visible].astype(np.float32))


def facing_cameras(mesh: TriangleMesh, views: Sequence[CoverageView], settings: CoverageSettings) -> TriangleMesh:
    """The mesh, its triangles counter-clockwise from the side of the cameras, as most rays of a few frames see it."""
    if not views:
        raise InputError("a recording without frames", "one frame or more")
    if not len(mesh):
        raise InputError("a mesh without triangles", "the surface that the camera filmed")
    probes = views[:: max(1, len(views) // _PROBE_FRAMES)]
    hits = [
        view_hits(mesh, view, grid, settings.max_distance, both_sides=True)
        for view, grid in _with_grids(probes, _PROBE_RAYS)
    ]
    cosines = np.concatenate([each.cosine for each in hits])
    if not len(cosines):
        raise InputError(
            f"no viewing ray of {len(probes)} frames hits the mesh within max_distance, {settings.max_distance:g}",
            "a mesh in the world and unit of the poses",
            "Check that the mesh belongs to this scene",
        )
    if 2 * np.count_nonzero(cosines > 0.0) >= len(cosines):
        return mesh
    return TriangleMesh(mesh.vertices, mesh.triangles[:, ::-1], mesh.colors)


def see_faces(mesh: TriangleMesh, views: Sequence[CoverageView], settings: CoverageSettings) -> FaceViews:
    """Find which triangles of a mesh, in the world frame and mm, the frames of a recording see.

    A frame sees a triangle if one of its viewing rays hits that first, from the front (counter-clockwise), within
    ``settings.max_distance``. Of triangles that no ray of any frame hits, because they lie between the rays, those
    whose centroid is in view count as seen.
    """
    face_views = FaceViews.unseen(len(mesh))
    with ProgressReport("cast viewing rays", len(views)) as progress:
        for number, (view, grid) in enumerate(_with_grids(views, settings.rays)):
            face_views.add(number, view_hits(mesh, view, grid, settings.max_distance), grid, view, settings)
            progress.update(number + 1)
    between = np.flatnonzero(face_views.frames == 0)
    for number, (view, grid) in enumerate(_with_grids(views, settings.rays)):
        hits = _visible_centroids(mesh, view, grid, between, settings.max_distance)
        face_views.add(number, hits, grid, view, settings)
    return face_views


def _with_grids(views: Sequence[CoverageView], most: int) -> Iterator[tuple[CoverageView, RayGrid]]:
    """Views with the ray grids of their lenses and masks, made anew only where lens or mask change."""
    last = None
    for view in views:
        behind = view.lens, None if view.mask is None else view.mask.tobytes()
        if behind != last:
            grid, last = RayGrid.of(view.lens, view.mask, most), behind
        yield view, grid


class Level(IntEnum):
    """Level at which a piece of surface was seen."""

    UNSEEN = 0
    POOR = 1
    GLANCE = 2
    SEEN_WELL = 3


#: Labels and colours (RGB; told apart with any colour vision) of maps and meshes: by level, what was seen well first, and
#: of what was neither seen nor reconstructed, where the place of the surface is a guess.
MAP_LEGEND = (
    ("seen well", (150, 200, 190)),
    ("seen only at a glance", (240, 200, 66)),
    ("seen too dark or too far", (95, 75, 139)),
    ("not seen", (213, 62, 0)),
    ("not seen, place guessed", (122, 20, 20)),
)


def classify(views: FaceViews, settings: CoverageSettings) -> UInt8[np.ndarray, "F"]:
    """Level of each triangle, the values of :class:`Level`. [F]

    Seen well: ``glance_frames`` frames or more saw it near and bright enough, at an angle to its normal of at most
    ``grazing``. At a glance: fewer did, but some saw it near and bright enough. Too dark or too far: no frame did.
    """
    level = np.full(len(views.frames), int(Level.UNSEEN), np.uint8)
    level[views.frames > 0] = Level.POOR
    level[views.clear_frames > 0] = Level.GLANCE
    level[views.good_frames >= settings.glance_frames] = Level.SEEN_WELL
    return level
