"""Description of a posed video on disk, and the base class of data managers, which make a scene of it."""

from __future__ import annotations

import hashlib
import logging
from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Bool
from pydantic import Field, model_validator
from typing_extensions import Self, override

from coliags_plugin.contracts import DataManager
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import file_sha256, user_path
from coliags_plugin.core.images import sizes_text, tell_of_alpha
from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.provenance import PointsRecord, Provenance, SplitRecord
from coliags_plugin.core.scene_files import (
    FACTORS,
    FRAME_SUFFIXES,
    Unit,
    files_in,
    first_few,
    numbered,
    parallel_map,
    read_unit,
)
from coliags_plugin.core.scenes import TO_GET_DEPTH, Frame, PointCloud, Scene
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.splits import Split, divide
from coliags_plugin.datamanagers.fusion import DEPTH_POINTS, fuse_depth, load_points, subsampled
from coliags_plugin.datamanagers.shots import PAPER_SIZE, Rectification, Shot, StoredPixels, fitted
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.geometry.poses.c3vd import C3vdPoses, read_poses

log = logging.getLogger(__name__)

POINTS_FILE = "points3D.ply"
Share = Annotated[float, Field(ge=0.0, le=1.0)]
InitialPoints = Literal["depth", "data", "file", "none"]


class SceneSettings(Settings):
    """Working size, split and initial points."""

    width: int | None = Field(
        None,
        gt=0,
        description="Working width, pixels. None: the format's own (docs/data.md 2), for most of them what fits 338 x "
        "270, the paper's quarter of a raw frame.",
    )
    height: int | None = Field(None, gt=0, description="Working height, pixels; goes with width.")
    unit: Unit | None = Field(
        None,
        description="Unit of length of the scene's files, 'mm', 'cm', 'm' or 'unknown'; known lengths are converted to "
        "mm. None: as stated by unit.txt, or else the format's.",
    )
    focal_scale: float = Field(
        1.0,
        gt=0.0,
        le=4.0,
        description="Factor on the nominal focal length of undistorted images; below 1 more of a wide field of view is "
        "kept.",
    )
    split: Split = Field(
        "every-8th",
        description="Test frames: 'every-8th': 0, 8, 16, ... as in the paper; 'inner-8th': 4, 12, 20, ... without the "
        "last frame; 'endogslam': 7, 15, 23, ...; 'block': one contiguous block of the video; 'all-train': none; "
        "'own': the dataset's own split. Counted after frame_step and max_frames.",
    )
    block: tuple[Share, Share] = Field(
        (0.4, 0.6), description="Split 'block': start and end of the block, as fractions of the video."
    )
    frame_step: int = Field(1, ge=1, description="Use every n-th frame of the video.")
    max_frames: int | None = Field(None, ge=1, description="Use at most the first n frames, after frame_step.")
    initial_points: InitialPoints = Field(
        "depth",
        description="Initial points: 'depth': fused from the training frames' depth, or the dataset's own if there is "
        "no depth; 'data': the dataset's own, or from depth if there are none; 'file': points_file; 'none': "
        "no points, to inspect a scene.",
    )
    points_file: str = Field(
        POINTS_FILE, description="PLY or NPZ for initial_points 'file', relative to the scene folder or absolute."
    )
    points_count: int = Field(200_000, ge=1, description="Largest number of initial points, sampled at random.")
    seed: int = Field(0, ge=0, description="Seed of the sampling of initial points.")
    outside_files: bool = Field(
        False,
        description="Whether files of the scene may name others outside of its folder, by absolute paths or '..'.",
    )
    keep_pixels: bool = Field(
        True,
        description="Whether to cache images in memory in the stored data type; otherwise they are read from disk at "
        "every access, which is slow, for videos larger than memory.",
    )

    @model_validator(mode="after")
    def _both_sides_or_none(self) -> Self:
        if (self.width is None) != (self.height is None):
            raise ValueError(f"width = {self.width} and height = {self.height}: give both or neither")
        return self

    @model_validator(mode="after")
    def _block_is_a_stretch(self) -> Self:
        if self.block[0] >= self.block[1]:
            raise ValueError(f"block = {self.block}: its start must be below its end")
        return self

    @property
    def size(self) -> tuple[int, int] | None:
        """Working width and height where they are set, pixels."""
        return None if self.width is None or self.height is None else (self.width, self.height)


@dataclass(frozen=True)
class Recording:
    """A posed video on disk."""

    folder: Path
    kind: str  # dataset and layout, for the log
    shots: Sequence[Shot]  # frames in video order
    facts: Mapping[str, Any]  # provenance: layout, lens, pose convention, and what the format adds
    described_by: Sequence[Path | None]  # files of poses and cameras
    test_sets: Mapping[str, Sequence[Shot]] = field(default_factory=dict)  # the dataset's separate ones, by name
    own_split: Mapping[str, Sequence[int]] | None = None  # the dataset's: "train" and "test" indices into ``shots``
    points_source: Path | None = None  # the dataset's initial points, if the file is there
    read_points: Callable[[Path], PointCloud] | None = load_points  # None where the file has none
    is_complete: bool = True  # whether the frames are all images of the dataset
    #: Indices into ``shots`` of the images that "depth", or "points" with their depth, were made from, where known.
    made_from: Mapping[str, Collection[int]] = field(default_factory=dict)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the names and sizes of the frames' files and the contents of those of poses and cameras."""
        digest = hashlib.sha256()
        try:
            for part in ("image", "depth", "mask", "confidence"):
                for path in filter(None, (getattr(shot, part) for shot in self.shots)):
                    named = f"{portable_name(path, self.folder)} {path.stat().st_size}\n"
                    digest.update(named.encode("utf-8", "surrogateescape"))
            for path in filter(None, self.described_by):
                with path.open("rb") as file:
                    while block := file.read(1 << 20):
                        digest.update(block)
        except OSError as error:
            raise InputError(
                f"cannot read {path}: {error.strerror or error}", "a readable file", "Restore it"
            ) from error
        return digest.hexdigest()


def portable_name(path: Path, folder: Path) -> str:
    """Path relative to a scene's folder, or the file name alone outside of it: no path of this machine."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def poses_of_images(file: Path, images: int) -> C3vdPoses:
    """The poses of a file of C3VD's form, of which every image must have one."""
    poses = read_poses(file)
    if len(poses.camera_to_world) != images:
        raise InputError(
            f"{file} has {len(poses.camera_to_world)} poses for {images} images",
            "a pose for every image, in order",
            "Restore the missing ones, or remove the surplus at the end",
        )
    return poses


#: Folder and test set of the rotation views of a sequence.
ROTATION = "rotation"


def _numbered_masks(folder: Path, count: int) -> dict[int, Path]:
    """Masks ``NNNN_seen.png`` by frame index."""
    masks = numbered(folder, "seen", frozenset({".png"}))
    for index, mask in masks.items():
        if index >= count:
            do = "Restore the missing frames, or remove the file"
            raise InputError(f"{mask}, but there are {count} frames", f"numbers below {count}", do)
    return masks


class NoPointsError(InputError):
    """Neither depth nor a point file is available for initial points."""


class RecordedDataManager(DataManager):
    """Loads a scene from the :class:`Recording` that a subclass finds on disk."""

    Settings: ClassVar[type[SceneSettings]] = SceneSettings

    settings: SceneSettings
    #: Name in the registry.
    name: ClassVar[str]
    #: Default bounds of the working width and height, pixels: the published size of the dataset, or else the paper's
    #: (docs/data.md 2). None: the stored size.
    fits: tuple[int, int] | None = PAPER_SIZE
    #: Where the folder ``seen`` of the seen masks of the video, and of a test set by its name, is.
    seen_in: ClassVar[Mapping[str, str]] = {"video": "truth", ROTATION: ROTATION}
    #: The split whose training frames the dataset's seen masks refer to (docs/layouts/c3vd.md 5).
    seen_split: ClassVar[Split] = "every-8th"
    #: Where the format has masks, for messages.
    masks_at: ClassVar[str] = "no files"
    #: Unit of length of the dataset's files, where a scene states none.
    unit: ClassVar[Unit] = "mm"
    #: Whether the log tells what is read.
    is_told = True

    @abstractmethod
    def open(self, path: Path) -> Recording:
        """Find the files of a scene and read its poses and cameras, but no pixels.

        Raises:
            InputError: The folder is missing, or files are missing or invalid.
        """

    @override
    def fingerprint(self, path: Path) -> str:
        """Reads no pixels."""
        return self.open(Path(path)).fingerprint

    def stated_unit(self, path: Path) -> Unit:
        """Unit of length of a scene's files, by the settings, the scene or the format, in this order."""
        return self.settings.unit or read_unit(path, self.unit)

    def working_size(self, width: int, height: int) -> tuple[int, int]:
        """Working size for a stored size, pixels: the configured size, or the largest within :attr:`fits`."""
        return self.settings.size or fitted(width, height, self.fits)

    def rectification_of(
        self, lens: Lens, described_by: Path, shows: Bool[np.ndarray, "H W"] | None = None
    ) -> Rectification:
        """The rectification of images from a lens, at the size of the stored images, which ``described_by`` states.

        Images of others than pinholes are undistorted to their nominal pinhole, its focal length times
        ``focal_scale``. ``shows`` are the stored pixels with image content.
        """
        pinhole = lens.resized(*self.working_size(lens.width, lens.height)).pinhole
        if not isinstance(lens, PinholeLens):
            factor = self.settings.focal_scale
            pinhole = replace(pinhole, fx=pinhole.fx * factor, fy=pinhole.fy * factor)
        return Rectification(lens, pinhole, described_by, shows)

    @override
    def at_stored_size(self) -> DataManager:
        changes = {"width": None, "height": None, "keep_pixels": False, "initial_points": "none"}
        manager = type(self)(self.settings.model_copy(update=changes))
        manager.fits = None
        manager.is_told = False  # again
        return manager

    def load(self, path: Path, progress: Progress | None = None) -> Scene:
        """Read the scene at the working size, in the dataset's world frame; see :class:`DataManager`.

        Lengths are in mm, or in the dataset's own unit where that is unknown.
        """
        path, settings = Path(path), self.settings
        recording = self.open(path)
        if any(shot.confidence is not None and shot.depth is None for shot in recording.shots):
            raise InputError(
                f"{path} has confidence in depth, but no depth",
                "confidence beside the depth that it is about",
                "Add the depth, or leave the confidence out",
            )
        train_indices, test_indices = self._split(recording, path)
        seen_masks = self._seen_masks(recording, train_indices, bool(test_indices))
        train = self._frames(recording.shots, train_indices, {})
        test_sets = (
            {"test": self._frames(recording.shots, test_indices, seen_masks.get("video", {}))} if test_indices else {}
        )
        for name, shots in recording.test_sets.items():
            test_sets[name] = self._frames(shots, range(len(shots)), seen_masks.get(name, {}))
        _ = recording.shots[0].rectification.undistortion  # made once, before images are read in parallel
        if settings.keep_pixels:
            frames = sorted(chain(train, *test_sets.values()), key=lambda frame: frame.index)
            stored = [frame.source for frame in frames if isinstance(frame.source, StoredPixels)]
            parallel_map(StoredPixels.preload, stored, "read images", progress)
        points, described = self._initial_points(recording, path, train, progress)
        split = SplitRecord(
            name=settings.split,
            frame_step=settings.frame_step,
            max_frames=settings.max_frames,
            **({"block": settings.block} if settings.split == "block" else {}),
            train=[frame.name for frame in train],
            test_sets={name: [frame.name for frame in frames] for name, frames in test_sets.items()},
        )
        unit = recording.facts.get("unit") or self.stated_unit(path)
        counts = {name: len(frames) for name, frames in {"train": train, **test_sets}.items()}
        used = _held_out_used(recording, test_indices)
        facts: JsonObject = {
            "dataset": self.name,
            **recording.shots[0].rectification.facts(),
            "masks": sum(shot.mask is not None for shot in recording.shots),
            "depth_is_estimated": any(shot.confidence is not None for shot in recording.shots),
            **recording.facts,
            "unit": unit if unit == "unknown" else "mm",
            "fingerprint": recording.fingerprint,
            "split": split,
            "points": described,
            **({"held_out_used": used} if used else {}),
            "frames": {"in_sequence": len(recording.shots), **counts},
        }
        if self.is_told:
            self._tell(recording, path)
        folder = path.resolve()
        return Scene(folder.name, train, test_sets, points, Provenance(**facts), folder).scaled(FACTORS[unit])

    def _tell(self, recording: Recording, path: Path) -> None:
        """Log what is read: sizes where images are downscaled by default, and the number of frames."""
        rectifications = [shot.rectification for shot in recording.shots]
        stored = sizes_text((each.lens.width, each.lens.height) for each in rectifications)
        used = sizes_text((each.pinhole.width, each.pinhole.height) for each in rectifications)
        if used != stored and self.settings.size is None:
            change = "`datamanager.width=W` and `datamanager.height=H` set another size"
            log.info("%s: images stored at %s are used at %s; %s", path, stored, used, change)
        log.info("%s: %d frames, %s", path, len(recording.shots), recording.kind)
        self._tell_masks(recording.shots, path)

    def _tell_masks(self, shots: Sequence[Shot], path: Path) -> None:
        """Log how many frames have masks, as files or alpha channels; warn where some have none, and of unused ones."""
        masks = [shot.mask for shot in shots if shot.mask is not None]
        if masks:
            level = logging.INFO if len(masks) == len(shots) else logging.WARNING
            files = {file for folder in {mask.parent for mask in masks} for file in files_in(folder, FRAME_SUFFIXES)}
            unused = len(files.difference(masks, (shot.image for shot in shots)))
            others = f"; {unused} other files beside the masks" if unused else ""
            log.log(level, "%s: %d of %d frames have a mask%s", path, len(masks), len(shots), others)
        tell_of_alpha(path, [shot.has_alpha for shot in shots])
        used = {path / self.masks_at, *(shot.image for shot in shots), *masks, *(p for m in masks for p in m.parents)}
        folders = {path, *(shot.image.parent for shot in shots)}
        named = {file for folder in folders for file in folder.glob("*[mM][aA][sS][kK]*")} - used
        names = [portable_name(file, path) for file in named if file.is_dir() or file.suffix.lower() in FRAME_SUFFIXES]
        if names:
            what = first_few(sorted(names))
            log.warning("%s: %s not used: format %s reads %s as masks", path, what, self.name, self.masks_at)

    def _seen_masks(
        self, recording: Recording, train: Sequence[int], has_test: bool
    ) -> Mapping[str, Mapping[int, Path]]:
        """Seen masks by frame index, if the run trains on the frames they were made for; none else."""
        parts = ({"video": recording.shots} if has_test else {}) | dict(recording.test_sets)
        folders = {part: recording.folder / self.seen_in[part] / "seen" for part in parts if part in self.seen_in}
        intended, _ = divide(self.seen_split, range(len(recording.shots)), recording.own_split)
        if recording.is_complete and set(intended) == set(train):
            return {part: _numbered_masks(folder, len(parts[part])) for part, folder in folders.items()}
        if any(folder.is_dir() for folder in folders.values()):
            log.warning(
                "%s: seen masks are for %s, so metrics on seen pixels are unavailable",
                recording.folder,
                f"split '{self.seen_split}' of all frames; this run trains on other frames"
                if recording.is_complete
                else "all images, but some are left out",  # they are numbered by image
            )
        return {}

    def _frames(self, shots: Sequence[Shot], indices: Sequence[int], seen_masks: Mapping[int, Path]) -> list[Frame]:
        frames = []
        for index in indices:
            shot = shots[index]
            camera = shot.rectification.camera(shot.camera_to_world)
            source = StoredPixels(shot, self.settings.keep_pixels, seen_masks.get(index))
            frames.append(Frame(shot.name, index, source, camera, shot.sparse_depth))
        return frames

    def _split(self, recording: Recording, path: Path) -> tuple[list[int], list[int]]:
        settings = self.settings
        indices = list(range(0, len(recording.shots), settings.frame_step))[: settings.max_frames]
        if settings.split == "own" and recording.own_split is None:
            raise InputError(f"{path} does not specify its test frames", "a split other than 'own'", "")
        train, test = divide(settings.split, indices, recording.own_split, settings.block)
        if not train:
            raise InputError(
                f"split '{settings.split}' of {len(indices)} frames of {path} leaves no training frames",
                "at least one training frame",
                "Use more frames, or another split ('all-train' holds none out)",
            )
        return train, test

    def _initial_points(
        self, recording: Recording, path: Path, train: Sequence[Frame], progress: Progress | None
    ) -> tuple[PointCloud, PointsRecord]:
        settings = self.settings
        generator = np.random.default_rng(settings.seed)
        if settings.initial_points == "none":
            return PointCloud(torch.zeros(0, 3)), PointsRecord(source="none", count=0)
        has_depth = any(shot.depth is not None for shot in recording.shots)
        source, read_points = recording.points_source, recording.read_points
        if settings.initial_points == "file":
            source, read_points = path / user_path(settings.points_file), load_points
        elif source is None or not source.is_file():
            read_points = None
        if has_depth and (settings.initial_points == "depth" or read_points is None):
            points = fuse_depth(train, settings.points_count, generator, progress)
            return points, PointsRecord(source=DEPTH_POINTS, count=len(points), seed=settings.seed)
        if read_points is None or source is None:
            missing = POINTS_FILE if source is None else source.name
            from_file = "`datamanager.initial_points=file` and `datamanager.points_file=FILE`"
            raise NoPointsError(
                f"{path} has neither depth files nor {missing}",
                "depth or points for the initial Gaussians",
                f"{TO_GET_DEPTH}; or put {missing} (world of the poses) there; or {from_file}",
            )
        points = subsampled(read_points(source), settings.points_count, generator, source)
        record = PointsRecord(
            source=portable_name(source, path), count=len(points), seed=settings.seed, sha256=file_sha256(source)
        )
        return points, record


def _held_out_used(recording: Recording, test: Sequence[int]) -> dict[str, list[str] | None]:
    """Names of the test frames that depth and points were estimated from, see :attr:`Provenance.held_out_used`."""
    sources: dict[str, Any] = {"depth": None} if any(shot.confidence for shot in recording.shots) else {}
    used = {
        what: indices if indices is None else [recording.shots[index].name for index in test if index in indices]
        for what, indices in (sources | dict(recording.made_from)).items()
    }
    return {what: names for what, names in used.items() if test and (names is None or names)}
