"""Poses and points from pictures alone: COLMAP's incremental structure from motion."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.images import write_mask
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.settings import Settings
from coliags_plugin.datamanagers.colmap.writer import write_model
from coliags_plugin.poses.rigid import inverse
from coliags_plugin.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.structure.colmap_database import write_database
from coliags_plugin.reconstruction.structure.features import Features, FeatureSettings, feature_extractor
from coliags_plugin.reconstruction.structure.matching import Pairs, all_pairs, mutual_matches, video_pairs
from coliags_plugin.reconstruction.structure.pictures import file_names, read_mask, read_picture
from coliags_plugin.reconstruction.structure.quiet import quiet_colmap

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: A focal length that moves from where it began by more than this factor is doubted.
_FOCAL_DRIFT = 2.0


class CameraSettings(Settings):
    """The camera that took every picture."""

    model: str = Field(default="SIMPLE_RADIAL", description="COLMAP's name of a model, for instance OPENCV_FISHEYE.")
    params: tuple[float, ...] | None = Field(
        default=None,
        description="Its parameters, in COLMAP's order; pixels, pixel centres at integers + 0.5. None: found out, "
        "beginning with a focal length of focal_factor times the larger side.",
    )
    refine: bool | None = Field(
        default=None, description="Whether focal length and distortion are adjusted. None: if no parameters are given."
    )
    focal_factor: float = Field(
        default=0.75,
        gt=0.0,
        description="Focal length to begin with, of the picture's larger side. Endoscopes have 0.5 to 1.",
    )

    @property
    def is_refined(self) -> bool:
        """Whether focal length and distortion are adjusted."""
        return self.params is None if self.refine is None else self.refine


class SfmSettings(Settings):
    """How pictures are matched and mapped."""

    camera: CameraSettings = CameraSettings()
    """The camera that took every picture."""
    features: FeatureSettings = FeatureSettings(max_features=6000, peak_threshold=0.002)
    """What is looked for in a picture."""
    overlap: int = Field(
        default=8,
        ge=1,
        description="Pictures are matched with those 1 to this many places on, and 2, 4, ..., 2^(this - 1) on.",
    )
    exhaustive_up_to: int = Field(default=25, ge=0, description="So many pictures or fewer are matched each with each.")
    max_ratio: float = Field(default=0.8, gt=0.0, le=1.0, description="Of a match's distance to that of the next best.")
    max_distance: float = Field(default=0.7, gt=0.0, le=2.0, description="Between matching descriptors of unit length.")
    max_error: float = Field(default=4.0, gt=0.0, description="Pixels that a match may be off two views' geometry.")
    min_model_size: int = Field(default=3, ge=2, description="Pictures that a model has to have.")
    seed: int = Field(default=0, ge=0, description="Of COLMAP's random samples.")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What was found. The scale is arbitrary and the world is any: pictures alone say neither.

    Attributes:
        pictures: All of them, in order.
        registered: Places of the pictures that have poses, in order. [M]
        camera_to_world: Their poses, OpenCV axes. [M, 4, 4]
        names: What the model calls all pictures.
        model: COLMAP's.
        models: How many pictures each of the models found has, the largest first.
    """

    pictures: tuple[Path, ...]
    registered: tuple[int, ...]
    camera_to_world: Float[np.ndarray, "M 4 4"]
    names: tuple[str, ...]
    model: pycolmap.Reconstruction
    models: tuple[int, ...]

    @property
    def left_out(self) -> tuple[Path, ...]:
        """The pictures without a pose."""
        known = set(self.registered)
        return tuple(path for place, path in enumerate(self.pictures) if place not in known)

    @property
    def trajectory(self) -> Trajectory:
        """The poses under the pictures' own names."""
        return Trajectory(self.camera_to_world, names=tuple(self.pictures[place].name for place in self.registered))

    @property
    def median_depth(self) -> float:
        """z-depth of the points in the pictures that see them, the median of all observations; in the model's unit."""
        depths = []
        for place in self.registered:
            image = self.model.images[place + 1]
            seen = [self.model.points3D[point.point3D_id].xyz for point in image.get_observation_points2D()]
            depths.append(np.array(seen).reshape(-1, 3) @ image.cam_from_world().matrix()[2, :3])
            depths[-1] += image.cam_from_world().matrix()[2, 3]
        return float(np.median(np.concatenate(depths)))

    def summary(self) -> str:
        """What came out, in one line."""
        camera, *others = (self.model.cameras[number] for number in sorted(self.model.cameras))
        return (
            f"{len(self.registered)} of {len(self.pictures)} pictures posed, {self.model.num_points3D()} points, mean "
            f"reprojection error {self.model.compute_mean_reprojection_error():.2f} px, {camera.model_name} "
            f"{', '.join(f'{value:.5g}' for value in camera.params)}"
            f"{f' and {len(others)} further cameras' if others else ''}"
        )


def reconstruct(
    pictures: Sequence[Path],
    settings: SfmSettings | None = None,
    masks: Mapping[Path, Bool[np.ndarray, "H W"]] | Bool[np.ndarray, "H W"] | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Find poses and points by incremental structure from motion; the largest model is taken.

    Args:
        pictures: Files in video order. Those of one size are from one camera.
        settings: Default: a camera about which nothing is known.
        masks: False where a pixel is to be ignored, for all pictures or by picture.
        progress: Told how far it is.

    Raises:
        InputError: There are fewer than two pictures, one cannot be read, sizes differ where parameters are given, the
            camera model is unknown, or no model comes out.
    """
    settings = settings or SfmSettings()
    pictures = tuple(pictures)
    if len(pictures) < 2:
        raise InputError(f"{len(pictures)} pictures", "two at least", "Give more of the video")
    with quiet_colmap(settings.seed):
        features, sizes = _features(pictures, settings, masks, progress)
        cameras = _cameras(settings.camera, pictures, sizes)
        kinds = list(dict.fromkeys(sizes))
        matches = _matches(features, settings, progress)
        names = file_names([path.stem for path in pictures], "")
        names = [f"{name}{path.suffix}" for name, path in zip(names, pictures, strict=True)]
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch) / "database.db"
            taken = [(name, kinds.index(size)) for name, size in zip(names, sizes, strict=True)]
            write_database(database, cameras, taken, features, matches, verified=False)
            models = _mapped(database, Path(scratch), settings, len(pictures), progress)
    counts = [len(found) for found in features]
    if not models:
        raise InputError(
            f"no model from {len(pictures)} pictures with {np.mean(counts):.0f} features and "
            f"{np.mean([len(pairs) for pairs in matches.values()]):.0f} matches a pair",
            "pictures that overlap, taken from different places",
            "Take frames farther apart (the camera has to move) or closer together (they have to overlap), give the "
            "camera if it is known, mask what does not move with the scene, or set max_ratio higher",
        )
    found = _result(pictures, names, models)
    if settings.camera.is_refined:
        _doubt_focal_lengths(found, settings.camera)
    return found


def write_sfm_scene(
    folder: Path,
    found: Reconstruction,
    masks: Mapping[Path, Bool[np.ndarray, "H W"]] | Bool[np.ndarray, "H W"] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a scene in COLMAP's layout: the posed pictures as they are, masks, and the model.

    Args:
        folder: The folder to make.
        found: Of :func:`reconstruct`.
        masks: As there.
        overwrite: Replace the folder where it exists.

    Raises:
        InputError: The folder exists or cannot be written.
    """
    with atomic_folder(folder, overwrite) as scratch:
        (scratch / "images").mkdir()
        for place in found.registered:
            shutil.copyfile(found.pictures[place], scratch / "images" / found.names[place])
            mask = _mask_of(found.pictures[place], masks)
            if mask is not None:
                write_mask(scratch / "masks" / f"{found.names[place]}.png", mask)
        write_model(scratch, found.model)


def masks_for(path: Path, pictures: Sequence[Path]) -> Mapping[Path, np.ndarray] | np.ndarray:
    """Masks of a file, for all pictures, or of a folder, by the pictures' names.

    Args:
        path: A picture that is black where pixels are to be ignored; or a folder of ``NAME.png`` or ``NAME.jpg.png``.
        pictures: What they are for.

    Raises:
        InputError: There is none, or one is missing.
    """
    if path.is_file():
        return read_mask(path)
    masks = {}
    for picture in pictures:
        candidates = (path / f"{picture.name}.png", path / f"{picture.stem}.png")
        file = next((candidate for candidate in candidates if candidate.is_file()), None)
        if file is None:
            raise InputError(
                f"{path} has no mask for {picture.name}",
                f"{candidates[0].name} or {candidates[1].name}",
                "Give one picture for all, or a folder with a mask for each",
            )
        masks[picture] = read_mask(file)
    return masks


def _mask_of(picture: Path, masks: Mapping[Path, np.ndarray] | np.ndarray | None) -> np.ndarray | None:
    return masks.get(picture) if isinstance(masks, Mapping) else masks


def _cameras(
    settings: CameraSettings, pictures: Sequence[Path], sizes: Sequence[tuple[int, int]]
) -> list[pycolmap.Camera]:
    """One camera for each size of picture, in the order they come."""
    import pycolmap

    known = {name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"}
    if settings.model not in known:
        raise InputError(f"camera model {settings.model}", f"one of {', '.join(sorted(known))}")
    cameras = []
    for width, height in dict.fromkeys(sizes):
        focal = settings.focal_factor * max(width, height)
        camera = pycolmap.Camera.create_from_model_name(0, settings.model, focal, width, height)
        if settings.params is not None:
            if len(settings.params) != len(camera.params):
                raise InputError(
                    f"{len(settings.params)} parameters for {settings.model}",
                    f"{len(camera.params)}: {camera.params_info}",
                )
            camera.params = list(settings.params)
        # Also of a guess: without, COLMAP takes two views for uncalibrated, whose geometry the soft pictures of a
        # forward motion hardly fix, and a fisheye's not at all.
        camera.has_prior_focal_length = True
        cameras.append(camera)
    if settings.params is not None and len(cameras) > 1:
        other = next(index for index, size in enumerate(sizes) if size != sizes[0])
        raise InputError(
            f"{pictures[other].name} is {sizes[other][0]} x {sizes[other][1]}, {pictures[0].name} "
            f"{sizes[0][0]} x {sizes[0][1]}",
            "pictures of one size, as one camera's parameters are given",
            "Leave out what does not belong",
        )
    return cameras


def _features(
    pictures: Sequence[Path],
    settings: SfmSettings,
    masks: Mapping[Path, np.ndarray] | np.ndarray | None,
    progress: Progress | None,
) -> tuple[list[Features], list[tuple[int, int]]]:
    """Features, and width and height, of each picture."""
    extract = feature_extractor(settings.features)
    features, sizes = [], []
    for done, path in enumerate(pictures, start=1):
        image, mask = read_picture(path), _mask_of(path, masks)
        height, width = image.shape[:2]
        if mask is not None and mask.shape != (height, width):
            raise InputError(
                f"the mask of {path} is {mask.shape[1]} x {mask.shape[0]}, the picture {width} x {height}", "one size"
            )
        features.append(extract(image, mask))
        sizes.append((width, height))
        if progress is not None:
            progress("find features", done, len(pictures))
    return features, sizes


def _matches(
    features: Sequence[Features], settings: SfmSettings, progress: Progress | None
) -> dict[tuple[int, int], Pairs]:
    pairs = all_pairs(len(features))
    if len(features) > settings.exhaustive_up_to:
        pairs = video_pairs(len(features), settings.overlap)
    matches = {}
    for done, (first, second) in enumerate(pairs, start=1):
        matches[first, second] = mutual_matches(
            features[first], features[second], settings.max_ratio, settings.max_distance
        )
        if progress is not None:
            progress("match features", done, len(pairs))
    return matches


def _mapped(
    database: Path, scratch: Path, settings: SfmSettings, count: int, progress: Progress | None
) -> list[pycolmap.Reconstruction]:
    """The models that COLMAP makes, the largest first.

    A camera that is to be found out is left as it begins until all pictures have poses, and adjusted then: while there
    are few pictures, motion along the line of sight lets it run away. Only where that leaves pictures without poses is
    it adjusted from the start as well, and the larger model wins.
    """
    import pycolmap

    views = pycolmap.TwoViewGeometryOptions()
    views.ransac.max_error = settings.max_error
    views.ransac.random_seed = settings.seed
    # An endoscope's own dark rim is masked, not guessed from matches that stand still.
    views.detect_watermark = False
    pycolmap.geometric_verification(
        str(database), pycolmap.GeometricVerifierOptions(num_threads=1), two_view_geometry_options=views
    )
    found = _mapped_with(database, scratch / "as-given", settings, False, count, progress)
    if settings.camera.is_refined:
        for model in found[:1]:
            _adjust(model)
        if not found or found[0].num_reg_images() < count:
            other = _mapped_with(database, scratch / "adjusted", settings, True, count, progress)
            if other and (not found or other[0].num_reg_images() > found[0].num_reg_images()):
                return other
    return found


def _mapped_with(
    database: Path, scratch: Path, settings: SfmSettings, adjusts: bool, count: int, progress: Progress | None
) -> list[pycolmap.Reconstruction]:
    """The models, the largest first, with a camera that is adjusted all along or not at all.

    One thread: sums in a fixed order.
    """
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = settings.seed
    options.min_model_size = settings.min_model_size
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = adjusts
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = adjusts
    scratch.mkdir()
    posed = 0

    def start() -> None:
        nonlocal posed
        posed = 1
        go_on()

    # Python looks for Ctrl-C whenever it is called.
    def go_on() -> None:
        nonlocal posed
        posed += 1
        if progress is not None:
            progress("find poses", min(posed, count), count)

    found = pycolmap.incremental_mapping(
        str(database),
        str(scratch),
        str(scratch),
        options,
        initial_image_pair_callback=start,
        next_image_callback=go_on,
    )
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


def _adjust(model: pycolmap.Reconstruction) -> None:
    """Adjust camera, poses and points together; drop what does not fit then, and adjust once more."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    getattr(options, "ceres", options).solver_options.num_threads = 1
    mapper = pycolmap.IncrementalPipelineOptions().mapper
    for _ in range(2):
        # pycolmap.bundle_adjustment does the same and switches COLMAP's log on (4.2.1).
        whole = pycolmap.BundleAdjustmentConfig()
        for number in model.reg_image_ids():
            whole.add_image(number)
        whole.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, whole, model).solve()
        pycolmap.ObservationManager(model).filter_all_points3D(
            mapper.filter_max_reproj_error, mapper.filter_min_tri_angle
        )
    model.update_point_3d_errors()


def _result(
    pictures: tuple[Path, ...], names: Sequence[str], models: Sequence[pycolmap.Reconstruction]
) -> Reconstruction:
    model = models[0]
    registered = sorted(number - 1 for number in model.reg_image_ids())
    _color(model, pictures)
    world_to_camera = np.tile(np.eye(4), (len(registered), 1, 1))
    for row, place in enumerate(registered):
        world_to_camera[row, :3] = model.images[place + 1].cam_from_world().matrix()
    found = Reconstruction(
        pictures,
        tuple(registered),
        inverse(world_to_camera),
        tuple(names),
        model,
        tuple(other.num_reg_images() for other in models),
    )
    if found.left_out:
        shown = ", ".join(path.name for path in found.left_out[:10])
        log.warning(
            "%d of %d pictures have no pose: %s%s",
            len(found.left_out),
            len(pictures),
            shown,
            ", ..." if len(found.left_out) > 10 else "",
        )
        if len(models) > 1:
            log.warning("they fall into models of %s; the largest is taken", ", ".join(map(str, found.models)))
    return found


def _doubt_focal_lengths(found: Reconstruction, settings: CameraSettings) -> None:
    for camera in found.model.cameras.values():
        now, start = camera.mean_focal_length(), settings.focal_factor * max(camera.width, camera.height)
        if settings.params is None and not 1.0 / _FOCAL_DRIFT < now / start < _FOCAL_DRIFT:
            log.warning(
                "the focal length went from %.0f to %.0f px: a camera that moves along its line of sight hardly shows "
                "it, and a wrong one bends path and surface. Give the camera's calibration if there is one, or begin "
                "nearer (camera.focal_factor)",
                start,
                now,
            )
            return


def _color(model: pycolmap.Reconstruction, pictures: Sequence[Path]) -> None:
    """Give each point the mean colour of where it was seen."""
    total: dict[int, np.ndarray] = {}
    for number in sorted(model.reg_image_ids()):
        image = read_picture(pictures[number - 1])
        for seen in model.images[number].get_observation_points2D():
            row, column = min(int(seen.y()), image.shape[0] - 1), min(int(seen.x()), image.shape[1] - 1)
            total[seen.point3D_id] = total.get(seen.point3D_id, 0.0) + image[row, column].astype(np.float64)
    for point, color in total.items():
        model.points3D[point].color = np.rint(color / model.points3D[point].track.length()).astype(np.uint8)
