"""Structure from motion by COLMAP: camera poses, intrinsics and points from images or a video, and their scale."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.geometry.poses.trajectory import Trajectory, inverse
from coliags_plugin.reconstruction.structure.adjustment import held_out_error, rigid_frames, rigidity
from coliags_plugin.reconstruction.structure.atlas import Again, Link, contradictions, link_at, part_of, weak_links
from coliags_plugin.reconstruction.structure.features import quiet_colmap
from coliags_plugin.reconstruction.structure.hypotheses import (
    Hypothesis,
    adjusted,
    best,
    both_signs,
    choose,
    find_camera,
    with_camera,
)
from coliags_plugin.reconstruction.structure.image_files import Masks, read_image
from coliags_plugin.reconstruction.structure.joining import join_models, stretches_of
from coliags_plugin.reconstruction.structure.mapping import bundle_adjust, depths_of
from coliags_plugin.reconstruction.structure.sfm_settings import (
    SfmSettings,
    candidate_cameras,
    field_of_view,
    has_known_camera,
    is_refined,
)
from coliags_plugin.reconstruction.structure.video import MatchedVideo, read_video

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Result of structure from motion. Scale and world frame are arbitrary: images alone determine neither."""

    images: tuple[Path, ...]  # all images but those that repeat the one before, in order
    registered: tuple[int, ...]  # indices of the registered images, ascending
    camera_to_world: Float[np.ndarray, "M 4 4"]  # their poses, OpenCV axes
    names: tuple[str, ...]  # of all images in the model
    model: pycolmap.Reconstruction
    correlation: float | None = None  # of log brightness with log depth; None: unknown
    links: tuple[Link, ...] = ()  # weak places that hold
    test_error: float | None = None  # median error of tracks that mapping has not used, pixels; None: unknown
    lens_side: int | None = None  # larger side of the lens's picture, pixels; None: it fills the images
    rigidity: Mapping[int, float] = field(default_factory=dict)  # residual of a rigid motion, px, by frames apart

    @property
    def trajectory(self) -> Trajectory:
        """Poses named by the images' file names."""
        return Trajectory(self.camera_to_world, names=tuple(self.images[index].name for index in self.registered))

    @property
    def median_depth(self) -> float:
        """Median z-depth of the model's points over all observations, in the model's unit."""
        return float(np.median(np.concatenate([depths for _, depths in depths_of(self.model).values()])))

    def summary(self) -> str:
        """One-line summary."""
        camera, *others = (self.model.cameras[number] for number in sorted(self.model.cameras))
        return (
            f"{len(self.registered)} of {len(self.images)} images posed, {self.model.num_points3D()} points, mean "
            f"reprojection error {self.model.compute_mean_reprojection_error():.2f} px, {camera.model_name} "
            f"{', '.join(f'{value:.5g}' for value in camera.params)}"
            f"{f' and {len(others)} further cameras' if others else ''}, "
            f"field of view {field_of_view(camera, self.lens_side):.0f} degrees"
        )


@dataclass(frozen=True, eq=False)
class Atlas:
    """Models of a video, each in a frame and scale of its own, and the images that none has.

    ``refused`` are the places at which a model was split, as too few points link its sides or their scales differ, and
    those between models of tracks that mapping has not linked.
    """

    images: tuple[Path, ...]  # all images but those that repeat the one before, in order
    models: tuple[Reconstruction, ...]  # the largest first
    lost: dict[int, str]  # why an image has no pose, by its index
    refused: tuple[Link, ...] = ()

    @property
    def largest(self) -> Reconstruction:
        """The model of the most images."""
        return self.models[0]

    def submaps(self) -> list[tuple[int, range]]:
        """Stretches of images of one model without weak places: number of the model, and span; in video order."""
        owner = {index: number for number, model in enumerate(self.models) for index in model.registered}
        cuts = {link.after for model in self.models for link in model.links}
        spans = stretches_of([model.registered for model in self.models], cuts)
        return [(owner[span.start], span) for span in spans]

    def summary(self) -> str:
        """One line, or two where there are several models."""
        text = self.largest.summary()
        if len(self.models) == 1:
            return text
        posed = len(self.images) - len(self.lost)
        sizes = ", ".join(str(len(model.registered)) for model in self.models)
        return f"{posed} of {len(self.images)} images posed, in models of {sizes}\nlargest model: {text}"


def reconstruct(
    images: Sequence[Path], settings: SfmSettings | None = None, masks: Masks = None, progress: Progress | None = None
) -> Atlas:
    """Estimate poses and points by structure from motion.

    An unknown camera's model and focal length are chosen on a part of the video (:func:`find_camera`); with features
    they are refined on the largest model, whose cameras the others get, unless their images have other sizes. Images
    are in video order, and share a camera where they have one size; masks are False where a pixel is ignored.

    Raises:
        InputError: There are fewer than two images, one cannot be read, sizes differ where parameters are given, the
            camera model is unknown, no model is found, or its focal length is implausible.
    """
    settings = settings or SfmSettings()
    images = tuple(images)
    if len(images) < 2:
        raise InputError(f"{len(images) or 'no'} image", "at least two", "Give more of the video")
    with quiet_colmap(settings.seed):
        video = read_video(images, settings, masks, progress)
        atlas = _atlas(video, _models(video))
        if not atlas.models:
            counts = [len(keypoints) for keypoints in video.keypoints]
            matches = [len(pairs) for pairs in video.matches.values()] or [0]
            why, count = Counter(atlas.lost.values()).most_common(1)[0]
            raise InputError(
                f"no model from {len(video.images)} images with {np.mean(counts):.0f} points and "
                f"{np.mean(matches):.0f} matches a pair ({count} images: {why})",
                "overlapping images from different camera positions",
                "Take frames farther apart (the camera has to move) or closer together (they have to overlap), give "
                "the camera parameters if known, mask what does not move with the scene, or raise max_ratio",
            )
        return atlas


def _models(video: MatchedVideo) -> list[Hypothesis]:
    """Models of a video with one camera per image size, adjusted, the largest first."""
    settings = video.settings.camera
    start = candidate_cameras(settings, tracked=True)[0][0] if video.tracks else find_camera(video)
    models = video.mapped(start)
    if not models:
        return []
    if video.tracks:
        start = find_camera(video, models)
        for model in models:
            with_camera(model, video, start)
        if settings.refine:
            bundle_adjust(models[0], refine_camera=True)
            for model in models[1:]:
                _take_cameras(model, models[0])
        return [adjusted(model, video) for model in with_progress(models, "adjust models", video.progress)]
    refined = is_refined(settings)
    is_fixed = has_known_camera(settings) and not refined
    largest = choose(both_signs(models[0], video, refined), (0.0, 180.0) if is_fixed else settings.field_of_view)
    hypotheses = [largest]
    for model in models[1:]:
        has_its_cameras = set(model.cameras) <= set(largest.model.cameras)
        if has_its_cameras:
            _take_cameras(model, largest.model)
            bundle_adjust(model, refine_camera=False)
        hypotheses.append(best(both_signs(model, video, refined and not has_its_cameras)))
    return hypotheses


def _take_cameras(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> None:
    """Set the parameters of the model's cameras to those of another model that has them, in place."""
    for number, camera in model.cameras.items():
        camera.params = other.cameras[number].params


#: Images of a model below which it is not believed if its error is so many times that of the largest, and below which
#: none is split as what it shows moves; and the fineness of its images, in the median, below which none is believed:
#: that of a blur by 3.5 px of 384.
_SHORT, _WORSE, _LEAST_FINENESS = 12, 2.0, 1.6
#: Extent of the camera's path, as a share of the median depth, that a stretch of what moves has at least: depth is
#: estimated from three others of a frame that are 0.05 away or more, and adjustment changes the extent.
_LEAST_EXTENT = 0.25


def _atlas(video: MatchedVideo, chosen: Sequence[Hypothesis]) -> Atlas:
    """The models, those of tracks split where their sides do not hold together, and joined where they show the same."""
    fewest = video.settings.min_model_size
    hypotheses: list[Hypothesis] = []
    refused: list[Link] = []
    for hypothesis in chosen:
        broken: list[Link] = []
        if video.tracks:
            weak = [link for link in weak_links(hypothesis.model) if not link.holds]
            broken = _apart([*weak, *contradictions(hypothesis.model, weak)], fewest)
        refused += broken
        frames = np.array(hypothesis.frames)
        for part in np.split(frames, np.searchsorted(frames, [link.after for link in broken], side="right")):
            piece = hypothesis
            if broken and len(part) >= fewest:
                piece = adjusted(part_of(hypothesis.model, part.tolist()), video)
            if min(piece.images, len(part)) >= fewest:
                pieces, moving = _rigid_stretches(piece, video)
                hypotheses += pieces
                refused += moving
    apart: dict[int, Again] = {}
    if video.tracks:
        video, hypotheses, apart = join_models(video, hypotheses)
    joined_again = {after for hypothesis in hypotheses for after in hypothesis.joins}
    refused = [link for link in refused if link.after not in joined_again]
    models = [_result(video, model) for model in hypotheses]
    models.sort(key=lambda model: -len(model.registered))
    posed = {index for model in models for index in model.registered}
    lost = {index: _reason(video, index) for index in range(len(video.images)) if index not in posed}
    for model, reason in [(model, _refusal(video, model, models[0])) for model in models]:
        if reason is not None:
            models.remove(model)
            lost |= dict.fromkeys(model.registered, reason)
    lost = dict(sorted(lost.items()))
    if lost:
        names = [video.images[index].name for index in lost]
        shown = ", ".join([*names[:10], *(["..."] if len(names) > 10 else [])])
        log.warning("%d of %d images have no pose: %s", len(lost), len(video.images), shown)
    if len(models) > 1:
        sizes = ", ".join(str(len(model.registered)) for model in models)
        log.warning("%d models have %s images: what lies between them is not known", len(models), sizes)
    atlas = Atlas(video.images, tuple(models), lost)
    refused += _gaps(video, atlas.submaps(), [link.after for link in refused])
    refused = [replace(link, again=apart.get(link.after)) for link in refused]
    return replace(atlas, refused=tuple(sorted(refused, key=lambda link: link.after)))


def _rigid_stretches(hypothesis: Hypothesis, video: MatchedVideo) -> tuple[list[Hypothesis], list[Link]]:
    """Split a model into stretches no longer than its scene is rigid (:func:`rigid_frames`), and link these."""
    longest = rigid_frames(hypothesis.model, video.tracks) if video.tracks else None
    count = 1 if longest is None else min(-(-hypothesis.images // longest), hypothesis.images // _SHORT)
    if longest is None or count < 2:
        return [hypothesis], []
    frames = hypothesis.frames
    centers = np.array([hypothesis.model.images[frame + 1].projection_center() for frame in frames])
    depths = np.concatenate([depths for _, depths in depths_of(hypothesis.model).values()])
    places = _far_apart(centers, count, _LEAST_EXTENT * float(np.median(depths)))
    if not places:
        return [hypothesis], []
    stretches = [stretch.tolist() for stretch in np.split(frames, places)]
    log.warning(
        "images %s to %s: what is seen moves, as rigid for %d frames: split in %d models",
        *(video.images[frames[0]].name, video.images[frames[-1]].name, longest, len(stretches)),
    )
    links = [replace(link_at(hypothesis.model, stretch[-1]), moves=True) for stretch in stretches[:-1]]
    return [adjusted(part_of(hypothesis.model, stretch), video) for stretch in stretches], links


def _far_apart(centers: Float[np.ndarray, "N 3"], count: int, least: float) -> list[int]:
    """Places that split a path into ``count`` stretches, or fewer, as each has an extent of ``least`` or more."""
    places, extent = [0], 0.0
    for index, center in enumerate(centers):
        start = places[-1]
        if (index - start) * count >= len(centers) and extent >= least:
            places.append(index)
            extent = 0.0
        else:
            extent = max(extent, float(np.linalg.norm(centers[start : index + 1] - center, axis=1).max()))
    is_short = extent < least or len(centers) - places[-1] < _SHORT  # the last one, which then belongs to that before
    return places[1:-1] if is_short else places[1:]


def _apart(links: Sequence[Link], least: int) -> list[Link]:
    """Places in order; of those between which ``least`` frames would not be left, the one that fewest points link."""
    groups: list[list[Link]] = []
    for link in sorted(links, key=lambda link: link.after):
        if not groups or link.after - groups[-1][-1].after >= least:
            groups.append([])
        groups[-1].append(link)
    return [min(group, key=lambda link: link.points) for group in groups]


def _refusal(video: MatchedVideo, candidate: Reconstruction, largest: Reconstruction) -> str | None:
    """Why a model of tracks is not believed: all is blurred, or it is short and held-out tracks contradict it."""
    if not video.tracks:
        return None
    if np.median([video.tracks[index].fineness for index in candidate.registered]) < _LEAST_FINENESS:
        return "blurred, as most images of its model"
    if len(candidate.registered) >= _SHORT or candidate.test_error is None or largest.test_error is None:
        return None
    if candidate.test_error > _WORSE * largest.test_error:
        count, error = len(candidate.registered), candidate.test_error
        return f"its model of {count} images is {error:.1f} px from points that are followed"
    return None


def _gaps(video: MatchedVideo, submaps: Sequence[tuple[int, range]], refused: Sequence[int]) -> list[Link]:
    """Places between models at which mapping has found no link, with the number of tracks seen from both sides."""
    gaps = []
    for (model, before), (other, after) in pairwise(submaps):
        is_known = any(before[-1] <= place < after[0] for place in refused)
        if model != other and not is_known and video.tracks:
            ids_before, ids_after = (np.concatenate([video.tracks[i].ids for i in span]) for span in (before, after))
            gaps.append(Link(before[-1], len(np.intersect1d(ids_before, ids_after)), None, None))
    return gaps


#: Points that come from the image before, below which nothing is said to be in common; and the share of the median
#: sharpness of its neighbours below which an image is blurred.
_NOTHING, _BLURRED = 15, 0.5


def _reason(video: MatchedVideo, index: int) -> str:
    if not video.tracks:
        return "too few matches with images that have a pose"
    around = [frame.sharpness for frame in video.tracks[max(0, index - 10) : index + 11]]
    frame = video.tracks[index]
    if frame.sharpness < _BLURRED * np.median(around):
        return "blurred, or the wall is too near to be in focus"
    if index and frame.followed < _NOTHING:
        return "moved too far, or shows nothing of the frame before"
    return "too few points are seen in three frames or more"


#: Correlation of log brightness with log depth below which the lamp at the lens shows: -0.25 to -0.8 in colons.
_LIT = -0.15


def _result(video: MatchedVideo, chosen: Hypothesis) -> Reconstruction:
    images, model = video.images, chosen.model
    registered = chosen.frames
    world_to_camera = np.tile(np.eye(4), (len(registered), 1, 1))
    for row, index in enumerate(registered):
        world_to_camera[row, :3] = model.images[index + 1].cam_from_world().matrix()
    result = Reconstruction(images, tuple(registered), inverse(world_to_camera), video.names, model, chosen.correlation)
    if video.tracks:
        links = {link.after: link for link in weak_links(model) if link.holds}
        links |= {after: replace(link_at(model, after), again=again) for after, again in chosen.joins.items()}
        result = replace(
            result,
            links=tuple(link for _, link in sorted(links.items())),
            test_error=held_out_error(model, video.tracks),
            rigidity=rigidity(model, video.tracks),
        )
    if video.picture is not None:
        result = replace(result, lens_side=max(video.picture.size))
        video.picture.to_frame(model)
    _color(model, images)
    if chosen.correlation is None or chosen.correlation > _LIT:
        log.warning(
            "images %s to %s: nearer points are hardly brighter (correlation of brightness with depth %s): the model "
            "may be reversed in depth, or the lamp is not at the lens. Give the camera's calibration, or other frames",
            images[registered[0]].name,
            images[registered[-1]].name,
            "unknown" if chosen.correlation is None else f"{chosen.correlation:.2f}",
        )
    return result


def _color(model: pycolmap.Reconstruction, images: Sequence[Path]) -> None:
    """Set each point's colour to the mean over its observations."""
    total: dict[int, np.ndarray] = {}
    for number in sorted(model.reg_image_ids()):
        image = read_image(images[number - 1])
        for observation in model.images[number].get_observation_points2D():
            row, column = min(int(observation.y()), image.shape[0] - 1), min(int(observation.x()), image.shape[1] - 1)
            color = image[row, column].astype(np.float64)
            total[observation.point3D_id] = total.get(observation.point3D_id, 0.0) + color
    for point, color in total.items():
        model.points3D[point].color = np.rint(color / model.points3D[point].track.length()).astype(np.uint8)


#: Least number of points beside the path for an estimate of the diameter.
_FEWEST_BESIDE = 30


def millimetres(
    reconstruction: Reconstruction, diameter: float | None = None, distance: tuple[str, str, float] | None = None
) -> float | None:
    """Millimetres per unit of a model; None where the scale stays unknown, with a warning.

    Known are the colon's typical inner diameter, mm, or the names of two images and their cameras' distance, mm, which
    takes precedence.
    """
    try:
        if distance is not None:
            return from_distance(reconstruction, *distance)
        return None if diameter is None else from_diameter(reconstruction, diameter)
    except InputError as error:
        # The poses took minutes: they are kept all the same.
        log.warning("%s The scale stays unknown", error)
        return None


def distances_beside(path: Float[np.ndarray, "M 3"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "K"]:
    """Distances of points from a polyline, without the points ahead of and behind it."""
    start, along = path[:-1], np.diff(path, axis=0)
    squares = np.maximum((along**2).sum(axis=1), 1e-30)
    best = np.full(len(points), np.inf)
    where = np.zeros(len(points))
    for index, (origin, direction, square) in enumerate(zip(start, along, squares, strict=True)):
        share = np.clip((points - origin) @ direction / square, 0.0, 1.0)
        distance = np.linalg.norm(points - origin - share[:, None] * direction, axis=1)
        nearer = distance < best
        best[nearer], where[nearer] = distance[nearer], index + share[nearer]
    return best[(where > 0.0) & (where < len(along))]


def from_diameter(reconstruction: Reconstruction, diameter: float) -> float:
    """Millimetres per unit, for a colon whose inner diameter, mm, is twice the wall's median distance from the path."""
    points = np.array([point.xyz for point in reconstruction.model.points3D.values()]).reshape(-1, 3)
    beside = distances_beside(reconstruction.camera_to_world[:, :3, 3], points)
    if len(beside) < _FEWEST_BESIDE:
        raise InputError(
            f"`diameter={diameter:g}`, and {len(beside)} of {len(points)} points lie beside the camera's path",
            f"at least {_FEWEST_BESIDE}",
            "Take a longer part of the video, or give the distance of two cameras (`distance`), or neither",
        )
    return float(diameter / (2.0 * np.median(beside)))


def from_distance(reconstruction: Reconstruction, first: str, second: str, distance: float) -> float:
    """Millimetres per unit, from a known distance, mm, between the cameras of two images, by file name or stem."""
    rows = {}
    for row, index in enumerate(reconstruction.registered):
        rows[reconstruction.images[index].stem] = rows[reconstruction.images[index].name] = row
    for name in (first, second):
        if name not in rows:
            raise InputError(f"`distance`: no image '{name}' with a pose", "two of the registered images, by name")
    centers = reconstruction.camera_to_world[[rows[first], rows[second]], :3, 3]
    units = float(np.linalg.norm(centers[1] - centers[0]))
    if not units > 0.0:
        raise InputError(f"`distance`: the cameras of {first} and {second} coincide", "two positions")
    return distance / units


def scaled(reconstruction: Reconstruction, factor: float) -> Reconstruction:
    """The model with positions of cameras and points multiplied by a factor."""
    import pycolmap

    model = pycolmap.Reconstruction(reconstruction.model)
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    camera_to_world = reconstruction.camera_to_world.copy()
    camera_to_world[:, :3, 3] *= factor
    return replace(reconstruction, model=model, camera_to_world=camera_to_world)
