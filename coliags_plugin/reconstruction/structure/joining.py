"""Joins between models of a video: the same wall found again by frames of another model, and both made one model.

After wall contact or a fast turn the camera often comes back to what it had seen. The last frames of each stretch are
compared with the first ones of those that follow: points of either model are searched for in the other's frame, a pose
of that frame is found from them, and the depths of either model there give the ratio of their scales. One comparison
may be chance; many between different frames that tell the same similarity are not.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product, starmap

import numpy as np
from jaxtyping import Float, Float32, Int64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coliags_plugin.core.jobs import with_progress
from coliags_plugin.geometry.poses.alignment import Similarity
from coliags_plugin.reconstruction.structure.adjustment import Rays, held_out_error, median_of_points, rigid_frames
from coliags_plugin.reconstruction.structure.atlas import Again, link_at, weak_links
from coliags_plugin.reconstruction.structure.hypotheses import Hypothesis, adjusted
from coliags_plugin.reconstruction.structure.image_files import mask_of, read_image
from coliags_plugin.reconstruction.structure.mapping import brightness_at
from coliags_plugin.reconstruction.structure.point_tracks import PointFinder, View
from coliags_plugin.reconstruction.structure.video import MatchedVideo

log = logging.getLogger(__name__)

#: Frames at the end of a stretch and at the start of another that are compared, stretches after it, and fewest frames
#: of a model: shorter ones, in wall contact, hardly follow the path.
_FRAMES, _AHEAD, _LEAST_FRAMES = 4, 4, 12
#: Smallest angle between the rays of a point that is searched for, degrees, and its largest median error, pixels.
_LEAST_ANGLE, _LARGEST_ERROR = 0.5, 4.0
#: RANSAC inlier threshold of the pose of a frame, pixels of the reduced image, fewest points that fit it (at most 15 do
#: between a patient's video and a phantom, by chance), fewest of these that have a point of known depth near them, and
#: how near, as a share of the larger side.
_POSE_ERROR, _FEWEST_FOUND, _FEWEST_DEPTHS, _NEAR = 6.0, 20, 5, 0.02
#: Fewest and most random samples from which the pose of a frame is found.
_TRIALS = 300, 3000
#: Similarities agree if their scales do, as natural logarithms, their rotations, degrees, and the places of a camera,
#: as a share of its median depth.
_SAME_SCALE, _SAME_ROTATION, _SAME_PLACE = 0.25, 12.0, 0.35
#: Fewest comparisons that agree, and fewest frames of either side in these.
_FEWEST_AGREEING, _FEWEST_SIDE = 10, 3
#: Largest factor by which held-out tracks are farther off in a joined model than in its parts, and pixels beyond that;
#: and largest share of the frames that lose their poses.
_WORSE, _MORE, _MOST_LOST = 1.05, 0.1, 0.02


def join_models(
    video: MatchedVideo, models: Sequence[Hypothesis]
) -> tuple[MatchedVideo, list[Hypothesis], dict[int, Again]]:
    """Join models of tracks that show the same wall.

    A joined model is adjusted as a whole, with the points that were found again, and kept if held-out tracks are
    hardly farther off than in its parts, nearer points are brighter, and its sides hold together. Returns the video
    with the points found again, the models, and joins that were found but not made.
    """
    compare = _Comparison(video)
    parts = list(models)
    unjoined: list[tuple[range, range]] = []
    cuts = {link.after for model in models for link in weak_links(model.model)}
    stretches = [
        stretch
        for stretch in stretches_of([part.frames for part in parts if len(part.frames) >= _LEAST_FRAMES], cuts)
        if len(stretch) >= _FRAMES
    ]
    for number, earlier in enumerate(with_progress(stretches, "join models", video.progress)):
        for later in stretches[number + 1 : number + 1 + _AHEAD]:
            first, second = (next(part for part in parts if side[0] in part.frames) for side in (earlier, later))
            if first is second:
                continue
            sightings = compare.agreeing(first, earlier, second, later)
            if not sightings:
                continue
            extended, joined = _with_sightings(video, sightings), None
            if len(first.frames) + len(second.frames) <= video.settings.tracks.longest_window:
                joined = _joined(extended, first, second, sightings, earlier[-1], later[0])
            log.info(
                "frames %d and %d show the same wall: %d comparisons of frames agree; %s",
                *(earlier[-1], later[0], len(sightings), "left apart" if joined is None else "joined"),
            )
            if joined is None:
                unjoined.append((earlier, later))
            else:
                video = extended
                parts = [joined, *(part for part in parts if part is not first and part is not second)]
    apart = {}
    for earlier, later in unjoined:  # between the models as they are now
        first, second = (next(part for part in parts if side[0] in part.frames) for side in (earlier, later))
        if first is not second and (sightings := compare.agreeing(first, earlier, second, later)):
            again = _again(sightings, later[0])
            apart[earlier[-1]] = replace(again, similarity=tuple(map(tuple, sightings[0].similarity.matrix.tolist())))
    return video, parts, apart


def stretches_of(models: Sequence[Sequence[int]], cuts: Set[int]) -> list[range]:
    """Stretches of a video whose posed frames are of one model, divided after the frames in ``cuts``.

    Models are given by their frames.
    """
    owned = sorted((frame, number) for number, frames in enumerate(models) for frame in frames)
    runs: list[list[tuple[int, int]]] = []
    for frame, number in owned:
        if not runs or runs[-1][-1][1] != number or not cuts.isdisjoint(range(runs[-1][-1][0], frame)):
            runs.append([])
        runs[-1].append((frame, number))
    return [range(run[0][0], run[-1][0] + 1) for run in runs]


@dataclass(frozen=True, eq=False)
class _Posed:
    """A frame with a pose, and points of its model that it sees."""

    model: Hypothesis
    number: int
    view: View
    points: Float[np.ndarray, "K 3"]  # of the view, world
    pose: Float[np.ndarray, "3 4"]  # world to camera

    @property
    def depths(self) -> Float[np.ndarray, "K"]:
        """Depths of the points."""
        return np.asarray(self.points @ self.pose[2, :3] + self.pose[2, 3])


@dataclass(frozen=True, eq=False)
class _Sighting:
    """Points of one model found in a frame of another, and the similarity from the later to the earlier model."""

    frames: tuple[int, int]  # that were compared, of the earlier and the later model
    seen_in: int  # which of them
    ids: Int64[np.ndarray, "K"]  # of the tracks
    pixels: Float32[np.ndarray, "K 2"]  # of the whole image
    similarity: Similarity


class _Comparison:
    def __init__(self, video: MatchedVideo) -> None:
        self.video = video
        self.finder = PointFinder(video.settings.tracks)

        @lru_cache(maxsize=2 * _FRAMES * (_AHEAD + 1))
        def view(frame: int) -> View:
            return self.finder.view(read_image(video.images[frame]), mask_of(video.images[frame], video.masks))

        self.view = view

    def agreeing(
        self, first_model: Hypothesis, earlier: range, second_model: Hypothesis, later: range
    ) -> list[_Sighting]:
        """Sightings between the ends of two stretches that agree on a similarity, the most typical first.

        Empty if too little of it agrees.
        """
        firsts = self._posed(first_model, [frame for frame in first_model.frames if frame in earlier][-_FRAMES:])
        seconds = self._posed(second_model, [frame for frame in second_model.frames if frame in later][:_FRAMES])
        pairs = [pair for first, second in product(firsts, seconds) for pair in ((first, second), (second, first))]
        sightings = [sighting for sighting in starmap(self._sighting, pairs) if sighting is not None]
        if not sightings:
            return []
        agreeing = _same(sightings, seconds[0])
        fewest = min(len({sighting.frames[side] for sighting in agreeing}) for side in (0, 1))
        return agreeing if len(agreeing) >= _FEWEST_AGREEING and fewest >= _FEWEST_SIDE else []

    def _posed(self, part: Hypothesis, frames: Sequence[int]) -> list[_Posed]:
        """Frames of a model with its well-known points of tracks; those that see none are left out."""
        model = part.model
        rays = Rays.of(model, self.video.track_ids, [points[:, :2] for points in self.video.keypoints])
        rays = rays.only(np.isin(rays.ids, np.concatenate([self.video.track_ids[i] for i in frames]))[rays.tracks], 3)
        points = rays.triangulated()
        errors = median_of_points(rays.errors(model, points), rays.tracks, len(rays.ids))
        is_precise = (rays.angles(points) >= _LEAST_ANGLE) & (errors < _LARGEST_ERROR)
        posed = []
        for frame in frames:
            rows = np.flatnonzero((rays.images == frame + 1) & is_precise[rays.tracks])
            if len(rows):
                view, tracks = self.view(frame), rays.tracks[rows]
                view = view.with_points(rays.ids[tracks], view.from_image(rays.pixels[rows]))
                pose = np.asarray(model.images[frame + 1].cam_from_world().matrix())
                posed.append(_Posed(part, frame, view, points[tracks], pose))
        return posed

    def _sighting(self, source: _Posed, target: _Posed) -> _Sighting | None:
        """Find a frame's points in a frame of another model."""
        import pycolmap

        rows, moved = self.finder.find(source.view, target.view)
        if len(rows) < _FEWEST_FOUND:
            return None
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = _POSE_ERROR * float(target.view.stretch.max())
        options.ransac.random_seed = self.video.settings.seed
        options.ransac.min_num_trials, options.ransac.max_num_trials = _TRIALS
        pixels, points = target.view.in_image(moved), source.points[rows]
        matches = pixels.astype(np.float64), points, target.model.camera
        estimate = pycolmap.estimate_and_refine_absolute_pose(*matches, options)
        if estimate is None or estimate["num_inliers"] < _FEWEST_FOUND:
            return None
        pose, fits = estimate["cam_from_world"].matrix(), np.asarray(estimate["inlier_mask"])
        reach = _NEAR * max(target.view.detail.shape)
        apart, nearest = cKDTree(target.view.pixels).query(moved)
        compared = fits & (np.asarray(apart) < reach)
        if compared.sum() < _FEWEST_DEPTHS:
            return None
        depths = points[compared] @ pose[2, :3] + pose[2, 3]
        factor = float(np.exp(np.median(np.log(depths / target.depths[np.asarray(nearest)[compared]]))))
        frames, similarity = (source.number, target.number), _between(pose, target.pose, factor)
        if source.number > target.number:
            frames, similarity = frames[::-1], _between(target.pose, pose, 1.0 / factor)
        return _Sighting(frames, target.number, source.view.ids[rows[fits]], pixels[fits], similarity)


def _between(pose: Float[np.ndarray, "3 4"], same: Float[np.ndarray, "3 4"], factor: float) -> Similarity:
    """Similarity from the second to the first world, from a camera's pose in both and the ratio of lengths."""
    rotation = pose[:, :3].T @ same[:, :3]
    return Similarity(factor, rotation, pose[:, :3].T @ (factor * same[:, 3] - pose[:, 3]))


def _same(sightings: Sequence[_Sighting], camera: _Posed) -> list[_Sighting]:
    """Largest set of sightings that agree on a similarity, the most typical first."""
    similarities = [sighting.similarity for sighting in sightings]
    scales = np.log([similarity.scale for similarity in similarities])
    rotations = Rotation.from_matrix(np.array([similarity.rotation for similarity in similarities]))
    center = -camera.pose[:, :3].T @ camera.pose[:, 3]
    places = np.array([similarity.points(center[None])[0] for similarity in similarities])
    depth = float(np.median(camera.depths))
    sets = []
    for index in range(len(similarities)):
        agree = np.abs(scales - scales[index]) < _SAME_SCALE
        agree &= (rotations * rotations[index].inv()).magnitude() < np.radians(_SAME_ROTATION)
        agree &= np.linalg.norm(places - places[index], axis=1) < _SAME_PLACE * depth * np.exp(scales[index])
        agree[index] = False
        sets.append(agree)
    points = np.array([len(sighting.ids) for sighting in sightings])
    typical = int(np.argmax([points[agree].sum() + points[index] for index, agree in enumerate(sets)]))
    return [sightings[typical], *(sightings[index] for index in np.flatnonzero(sets[typical]).tolist())]


def _again(sightings: Sequence[_Sighting], before: int) -> Again:
    """Record of a join, with the spread of the scales of its comparisons."""
    scales = np.log([sighting.similarity.scale for sighting in sightings])
    return Again(before, len(sightings), round(float(scales.std()), 4))


def _with_sightings(video: MatchedVideo, sightings: Sequence[_Sighting]) -> MatchedVideo:
    """Video with the observations of sightings added to its frames."""
    keypoints, brightness, track_ids = list(video.keypoints), list(video.brightness), list(video.track_ids)
    for sighting in sightings:
        frame = sighting.seen_in
        new = ~np.isin(sighting.ids, track_ids[frame])
        pixels = np.zeros((int(new.sum()), keypoints[frame].shape[1]), np.float32)
        pixels[:, :2] = sighting.pixels[new]
        keypoints[frame] = np.concatenate([keypoints[frame], pixels])
        light = brightness_at(read_image(video.images[frame]), pixels[:, :2].astype(np.float64))
        brightness[frame] = np.concatenate([brightness[frame], light])
        track_ids[frame] = np.concatenate([track_ids[frame], sighting.ids[new]])
    return replace(video, keypoints=tuple(keypoints), brightness=tuple(brightness), track_ids=tuple(track_ids))


def _joined(
    video: MatchedVideo, first: Hypothesis, second: Hypothesis, sightings: Sequence[_Sighting], after: int, before: int
) -> Hypothesis | None:
    """Two models made one, in the frame of the larger; None if it is not as good as they are."""
    import pycolmap

    change = pycolmap.Sim3d(sightings[0].similarity.matrix)
    larger, smaller = first, second
    if len(first.frames) < len(second.frames):
        larger, smaller, change = second, first, change.inverse()
    moved = pycolmap.Reconstruction(smaller.model)
    moved.transform(change)
    model = pycolmap.Reconstruction()
    for camera in larger.model.cameras.values():
        model.add_camera_with_trivial_rig(camera)
    for part in (larger.model, moved):
        for number in sorted(part.reg_image_ids()):
            image = part.images[number]
            posed = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=number)
            model.add_image_with_trivial_frame(posed, image.cam_from_world())
    for number in model.reg_image_ids():
        pixels = video.keypoints[number - 1][:, :2].astype(np.float64)
        model.images[number].points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
    result = adjusted(model, video)
    is_complete = result.images >= (1.0 - _MOST_LOST) * (len(first.frames) + len(second.frames))
    longest = rigid_frames(result.model, video.tracks)
    is_held = is_complete and link_at(result.model, after).holds and (longest is None or result.images <= longest)
    is_lit = result.is_lit_from_the_camera and not result.is_reversed
    if not (is_held and is_lit) or _is_worse(result, (first, second), video):
        return None
    return replace(result, joins={**first.joins, **second.joins, after: _again(sightings, before)})


def _is_worse(joined: Hypothesis, parts: Sequence[Hypothesis], video: MatchedVideo) -> bool:
    """True if a joined model has a larger error of held-out tracks than its parts, or one that is unknown."""
    error = held_out_error(joined.model, video.tracks)
    before = [held_out_error(part.model, video.tracks) for part in parts]
    measured = [part_error for part_error in before if part_error is not None]
    if error is None or len(measured) < len(before):
        return True
    return error > _MORE + _WORSE * float(np.average(measured, weights=[len(part.frames) for part in parts]))
