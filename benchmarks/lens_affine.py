"""Which reading of the affine part of C3VD's omnidirectional lens agrees with C3VD's poses, on real frames.

Corners are tracked through a video, each track is triangulated from the poses, and the place of the frames in the raw
1350 x 1080 image (they may be a crop of unknown origin and scale) is fitted to the residuals, for each reading. A roll
of the lens, free instead of either reading, shows on which side the poses are; its spread is that over resampled
stretches of the video.

python benchmarks/lens_affine.py FRAMES POSES --step 2
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tyro
from machine import show
from scipy.optimize import least_squares

from coliags_plugin.core.images import read_rgb
from coliags_plugin.geometry.lenses.models import LENSES, CalibratedLens, OmnidirectionalLens
from coliags_plugin.geometry.poses.c3vd import read_poses

#: Features alive at a time, least frames of a track, its observations used, and its least parallax, degrees.
FEATURES, SHORTEST, OBSERVATIONS, PARALLAX = 500, 12, 12, 1.0
#: Distance of features from the edge of the image and from each other, pixels.
MARGIN = 12
#: Largest median residual of a track, pixels, and depths it may have, mm.
WORST, DEPTHS = 6.0, (5.0, 120.0)


@dataclass(frozen=True)
class Options:
    """Compare the two readings."""

    frames: tyro.conf.Positional[Path]
    """Folder of images, sorted by name: raw frames, or an unscaled crop of them."""
    poses: tyro.conf.Positional[Path]
    """C3VD's pose.txt of the same frames."""
    step: int = 2
    """Every how many frames are used."""
    scale: bool = False
    """Also fit the scale of the frames."""
    resamplings: int = 20
    """Resamplings of stretches of the video."""
    json: Path | None = None
    """Also write the rows here."""


@dataclass(frozen=True)
class Tracks:
    """Observations of tracked corners.

    Attributes:
        track: Number of the track of each. [N]
        pixels: Centres at integers + 0.5. [N, 2]
        rotations, centers: Of the camera. [N, 3, 3], [N, 3]
        stretch: Stretch of the video that the track begins in. [T]
    """

    track: np.ndarray
    pixels: np.ndarray
    rotations: np.ndarray
    centers: np.ndarray
    stretch: np.ndarray

    def part(self, numbers: np.ndarray) -> Tracks:
        """Some of the tracks, each as often as it is named."""
        rows = [np.flatnonzero(self.track == number) for number in numbers]
        chosen = np.concatenate(rows)
        named = np.repeat(np.arange(len(numbers)), [len(own) for own in rows])
        return Tracks(named, self.pixels[chosen], self.rotations[chosen], self.centers[chosen], self.stretch[numbers])


def follow(files: Sequence[Path], poses: np.ndarray, step: int) -> Tracks:
    """Track corners forwards, checked backwards."""
    alive: list[list[tuple[int, np.ndarray]]] = []
    ended: list[list[tuple[int, np.ndarray]]] = []
    before = None
    equalise = cv2.createCLAHE(2.0, (8, 8))
    for number in range(0, min(len(files), len(poses)), step):
        image = equalise.apply(cv2.cvtColor(read_rgb(files[number]), cv2.COLOR_RGB2GRAY))
        if before is not None and alive:
            there = np.array([track[-1][1] for track in alive], np.float32).reshape(-1, 1, 2)
            here, found, _ = cv2.calcOpticalFlowPyrLK(before, image, there, None, winSize=(21, 21), maxLevel=3)
            back, again, _ = cv2.calcOpticalFlowPyrLK(image, before, here, None, winSize=(21, 21), maxLevel=3)
            flat, size = here.reshape(-1, 2), np.array(image.shape[::-1])
            good = (found.ravel() == 1) & (again.ravel() == 1)
            good &= np.linalg.norm((back - there).reshape(-1, 2), axis=1) < 0.3
            good &= ((flat > MARGIN) & (flat < size - MARGIN)).all(axis=1)
            ended += [track for track, kept in zip(alive, good, strict=True) if not kept]
            alive = [[*track, (number, place)] for track, place, kept in zip(alive, flat, good, strict=True) if kept]
        free = np.zeros_like(image)
        free[MARGIN:-MARGIN, MARGIN:-MARGIN] = 255
        for track in alive:
            cv2.circle(free, [int(value) for value in track[-1][1]], MARGIN, 0, -1)
        if len(alive) < FEATURES:
            corners = cv2.goodFeaturesToTrack(image, FEATURES - len(alive), 0.01, MARGIN, mask=free)
            alive += [] if corners is None else [[(number, place)] for place in corners.reshape(-1, 2)]
        before = image
    long = [track for track in [*ended, *alive] if len(track) >= SHORTEST]
    rows = [
        (index, *track[place])
        for index, track in enumerate(long)
        for place in np.unique(np.linspace(0, len(track) - 1, OBSERVATIONS).astype(int))
    ]
    frames = np.array([row[1] for row in rows])
    return Tracks(
        np.array([row[0] for row in rows]),
        np.array([row[2] for row in rows], np.float64) + 0.5,
        poses[frames, :3, :3],
        poses[frames, :3, 3],
        np.array([track[0][0] for track in long]) // (14 * step),
    )


def residuals(
    tracks: Tracks, lens: OmnidirectionalLens, origin: np.ndarray, scale: float = 1.0, roll: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Differences between observed and triangulated directions, in pixels of the lens; points; and their depths."""
    rays = lens.unproject(scale * tracks.pixels + origin)
    bad = ~np.isfinite(rays).all(axis=1)
    rays[bad] = (0.0, 0.0, 1.0)
    cosine, sine = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    x, y = rays[:, 0].copy(), rays[:, 1].copy()
    rays[:, 0], rays[:, 1] = cosine * x - sine * y, sine * x + cosine * y
    world = np.einsum("nij,nj->ni", tracks.rotations, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    across = np.eye(3) - world[:, :, None] * world[:, None, :]
    weight = np.ones(len(rays))
    count = len(tracks.stretch)
    for _ in range(3):  # of angles, not of distances: weighted by the distance found before
        weighted = across * weight[:, None, None]
        left, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(left, tracks.track, weighted)
        np.add.at(right, tracks.track, np.einsum("nij,nj->ni", weighted, tracks.centers))
        points = np.linalg.solve(left + 1e-12 * np.eye(3), right[:, :, None])[:, :, 0]
        weight = 1.0 / np.maximum(np.linalg.norm(points[tracks.track] - tracks.centers, axis=1), 1.0) ** 2
    local = np.einsum("nji,nj->ni", tracks.rotations, points[tracks.track] - tracks.centers)
    apart = rays[:, :2] - local[:, :2] / np.maximum(local[:, 2:], 1e-3)
    apart[bad] = 0.0
    return lens.a0 * apart, points, local[:, 2]


def sound(tracks: Tracks, lens: OmnidirectionalLens, origin: np.ndarray) -> Tracks:
    """Tracks with a small residual, a plausible depth and enough parallax."""
    apart, points, depth = residuals(tracks, lens, origin)
    error = np.linalg.norm(apart, axis=1)
    kept = []
    for number in range(len(tracks.stretch)):
        own = tracks.track == number
        ends = points[number] - tracks.centers[own][[0, -1]]
        angle = np.degrees(np.arccos(np.clip(ends[0] @ ends[1] / np.prod(np.linalg.norm(ends, axis=1)), -1.0, 1.0)))
        if np.median(error[own]) < WORST and DEPTHS[0] < np.median(depth[own]) < DEPTHS[1] and angle > PARALLAX:
            kept.append(number)
    return tracks.part(np.array(kept))


def fit(cost: Callable[[np.ndarray], np.ndarray], start: list[float], size: list[float]) -> tuple[np.ndarray, float]:
    """Robust least squares: parameters and cost."""
    found = least_squares(cost, start, loss="soft_l1", x_scale=size, diff_step=np.full(len(start), 1e-3))
    return found.x, float(found.cost)


def main(options: Options) -> None:
    """Compare the readings and print a table."""
    cv2.setNumThreads(1)
    plain = LENSES["omnidirectional"]
    assert isinstance(plain, OmnidirectionalLens) and isinstance(plain, CalibratedLens)
    readings = {
        "[[c, d], [e, 1]], example loader": replace(plain, d=plain.e, e=plain.d),
        "[[c, e], [d, 1]], renderer": plain,
        "no affine part": replace(plain, d=0.0, e=0.0),
    }
    files = sorted(path for path in options.frames.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    tracks = follow(files, read_poses(options.poses).camera_to_world, options.step)
    height, width = read_rgb(files[0]).shape[:2]
    middle = [0.5 * (plain.width - width), 0.5 * (plain.height - height)]
    tracks = sound(tracks, readings["no affine part"], np.array(middle))
    rows = []
    for name, lens in readings.items():
        start, size = ([*middle, 1.0], [5.0, 5.0, 0.01]) if options.scale else (middle, [5.0, 5.0])

        def cost(values: np.ndarray, lens: OmnidirectionalLens = lens) -> np.ndarray:
            return residuals(tracks, lens, values[:2], *values[2:3])[0].ravel()

        values, total = fit(cost, start, size)
        error = np.linalg.norm(cost(values).reshape(-1, 2), axis=1)
        place = " ".join(f"{value:.4g}" for value in values)
        rows.append({"reading": name, "origin, scale": place, "cost": round(total, 1), "median px": np.median(error)})
    show(rows, options.json)
    flat = readings["no affine part"]
    generator = np.random.default_rng(0)
    stretches = np.unique(tracks.stretch)
    rolls = []
    for draw in range(options.resamplings + 1):
        chosen = stretches if draw == 0 else generator.choice(stretches, len(stretches))
        part = tracks.part(np.concatenate([np.flatnonzero(tracks.stretch == one) for one in chosen]))
        start, size = [*middle, 0.0], [5.0, 5.0, 0.2]
        if options.scale:
            start, size = [*start, 1.0], [*size, 0.01]

        def turned(values: np.ndarray, part: Tracks = part) -> np.ndarray:
            scale = values[3] if len(values) > 3 else 1.0
            return residuals(part, flat, values[:2], scale, values[2])[0].ravel()

        rolls.append(fit(turned, start, size)[0][2])
    spread = np.array(rolls[1:])
    # What a reading does to a pixel right of the centre.
    for name, lens in readings.items():
        ray = lens.unproject(np.array([[lens.cx + 300.0, lens.cy]]))[0]
        print(f"roll of {name}: {np.degrees(np.arctan2(ray[1], ray[0])):+.3f} degrees")
    print(f"free roll: {rolls[0]:+.3f} degrees, standard deviation {spread.std():.3f} over resampled stretches")
    print(f"{len(tracks.stretch)} tracks, {len(tracks.track)} observations, {len(stretches)} stretches")


if __name__ == "__main__":
    main(tyro.cli(Options))
