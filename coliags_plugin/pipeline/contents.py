"""Contents of the folder of a reconstruction: video, segments, sub-maps, why frames have no pose; and their export."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Float64
from pydantic import BaseModel

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, link_or_copy, make_folder, refuse_overlap, write_json
from coliags_plugin.core.scene_files import FRAME_SUFFIXES, Unit, write_unit
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.datamanagers.colmap import ATLAS_FILE, AtlasRecord, read_atlas
from coliags_plugin.geometry.poses import colmap, tum
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.pipeline.frames import FramesRecord
from coliags_plugin.pipeline.joins import ModelKey, SegmentJoin
from coliags_plugin.pipeline.stages import MADE, RECORD_FILE, SHARED, Record, StageRecord, submap_name
from coliags_plugin.pipeline.survey import SURVEY_FILE, Segment, Survey, Video

#: Name of the record of an export, and version of its schema.
MANIFEST, _FORMAT = "manifest.json", 1
#: Name of a frame of a video, with its number.
FRAME_NAME = re.compile(r"frame_(\d+)")
#: Figures that are words.
_TEXTS = ("unit", "depth_scale", "verdict")

ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True)
class SubmapContents:
    """A model of a segment: its frames, and the stages that were run on it."""

    segment: str  # folder of the segment; empty: the only one, which lies in the reconstruction's folder
    model: str  # folder, relative to the segment's scene; of one without an atlas as if it had one
    stages: Mapping[str, StageRecord]  # by their names without its folder; none: too few frames to be reconstructed
    names: Mapping[int, str] = field(default_factory=dict)  # of its images, by their number in the video, ascending
    unit: Unit = "unknown"

    @property
    def key(self) -> ModelKey:
        """Segment and model."""
        return self.segment, self.model

    @property
    def number(self) -> int:
        """Number of the model within its segment."""
        return int(Path(self.model).name)

    @property
    def name(self) -> str:
        """Name on pages and in folders: segment and number."""
        return submap_name(self.segment, self.number)

    @property
    def folder(self) -> str:
        """Folder of its results, relative to the reconstruction's."""
        return "/".join(filter(None, (self.segment, f"submap-{self.number}" if self.number else "")))

    @property
    def first(self) -> int:
        """First frame."""
        return min(self.names, default=0)

    @property
    def last(self) -> int:
        """Last frame."""
        return max(self.names, default=0)

    @cached_property
    def figures(self) -> dict[str, Any]:
        """The numbers of all its stages; of a damaged record, those that are numbers."""
        return {
            name: value
            for stage in self.stages.values()
            for name, value in stage.figures.items()
            if isinstance(value, str) == (name in _TEXTS) and isinstance(value, int | float | str)
        }

    @property
    def counts(self) -> bool:
        """True if its figures are of a surface: its geometry is usable or doubtful."""
        return self.figures.get("verdict") in ("usable", "doubtful")

    @property
    def failure(self) -> str:
        """The stage that failed, and why; empty where none did."""
        failed = (f"{name} failed: {stage.summary}" for name, stage in self.stages.items() if stage.state == "failed")
        return next(failed, "")

    @property
    def outcome(self) -> str:
        """The verdict on its geometry with the reasons, or why there is none."""
        if not self.stages:
            return "too few frames to be reconstructed"
        return self.failure or (self.stages["verdict"].summary if "verdict" in self.stages else "not judged yet")


@dataclass(frozen=True)
class SegmentContents:
    """A segment, as far as it was reconstructed."""

    span: Segment
    stages: Mapping[str, StageRecord]  # by their names within it
    submaps: Sequence[SubmapContents]  # the largest first
    used: Mapping[int, str]  # names of the frames of use, by their number in the video
    lost: Mapping[int, str]  # why frames have no pose, by their numbers

    @property
    def posed(self) -> set[int]:
        """Frames with a pose."""
        return {number for submap in self.submaps for number in submap.names}

    @property
    def failure(self) -> str:
        """The stage that failed, and why, or that it is not finished; empty where its largest sub-map is done."""
        largest = {name: stage for name, stage in self.stages.items() if "/" not in name}
        for name, stage in largest.items():
            if stage.state == "failed":
                return f"{name}{'' if name in SHARED else ' of its largest sub-map'} failed: {stage.summary}"
        if not self.stages:
            return "it was not begun"
        return "" if "report" in largest and largest["report"].state == "done" else "it is not finished"


@dataclass(frozen=True)
class Contents:
    """The folder of a reconstruction."""

    folder: Path
    video: Video  # of a scene with poses, of one frame
    stages: Mapping[str, StageRecord]
    segments: Sequence[SegmentContents]
    joins: Sequence[SegmentJoin] = ()
    survey: Survey | None = None

    @cached_property
    def submaps(self) -> list[SubmapContents]:
        """Sub-maps of all segments, by their first frames."""
        return sorted(
            (submap for segment in self.segments for submap in segment.submaps), key=lambda submap: submap.first
        )

    @property
    def posed(self) -> set[int]:
        """Frames with a pose."""
        return set().union(*(segment.posed for segment in self.segments))

    @property
    def used(self) -> set[int]:
        """Frames of use."""
        return set().union(*(segment.used for segment in self.segments))

    @property
    def has_frames(self) -> bool:
        """True if there is a survey of frames: not of a scene with poses."""
        return self.video.size is not None

    def seconds(self, frames: Sequence[float] | np.ndarray) -> Float64[np.ndarray, "N"]:
        """Times of frames by their numbers, s; the numbers where neither times nor a rate are known."""
        times, first = None if self.survey is None else self.survey.times, self.video.first
        if times is not None:
            return np.asarray(np.interp(frames, np.arange(first, first + len(times)), times))
        return np.asarray(frames) / (self.video.rate or 1.0)


class _Joins(BaseModel):
    joins: list[SegmentJoin] = []


def read_contents(out: Path, record: Record | None = None) -> Contents:
    """Read the folder of a reconstruction, as far as there are files.

    Raises:
        InputError: A file is damaged, or there is no record.
    """
    record = record or Record.of(out)
    stages = record.stages
    if not stages:
        raise InputError(f"no stage in {out / RECORD_FILE}", "the folder of a reconstruction, which has begun")
    if record.is_done("survey"):
        video = figures_as(stages, "survey", Video, out)
    else:
        video = Video(source=out.resolve().name, frames=1, segments=(Segment(0, 0, ""),))
    contents = [_read_segment(out / span.name, span, record.within(span.name), video) for span in video.segments]
    joins = figures_as(stages, "joins", _Joins, out).joins if "joins" in stages else []
    survey = Survey.read(out) if (out / SURVEY_FILE).is_file() else None
    if survey is not None:
        if not survey.first <= video.first < video.stop <= survey.first + len(survey):
            seen = f"{out / SURVEY_FILE} has {len(survey)} frames"
            raise InputError(seen, f"a number for each of {video.frames} frames")
        survey = survey.part(video.first, video.stop - 1)
    return Contents(out, video, stages, contents, joins, survey)


def figures_as(stages: Mapping[str, StageRecord], name: str, kind: type[ModelT], folder: Path) -> ModelT:
    """Read the figures that a stage has recorded.

    Raises:
        InputError: They are damaged.
    """
    with invalid_reported(f"cannot read {folder / RECORD_FILE}: {name}: ", MADE):
        return kind.model_validate(stages[name].figures)


def _read_segment(folder: Path, span: Segment, stages: Mapping[str, StageRecord], video: Video) -> SegmentContents:
    atlas, frames = read_atlas(folder / "poses"), FramesRecord.read(folder / "frames")
    lost, used = dict[int, str](), dict[int, str]()
    if frames is not None:
        lost = {frame.frame: frame.why for frame in frames.dropped}
        used = {frame.frame: f"{frame.name}.png" for frame in frames.kept if span.first <= frame.frame <= span.last}
    by_submap: dict[int, dict[str, StageRecord]] = {}
    for name, stage in stages.items():
        place, _, step = name.rpartition("/")
        if step not in SHARED:
            by_submap.setdefault(int(place.removeprefix("submap-") or 0), {})[step] = stage
    submaps = {number: SubmapContents(span.name, f"sparse/{number}", steps) for number, steps in by_submap.items()}
    if atlas is not None:
        try:
            numbers = _frame_numbers(atlas, {Path(name).stem: number for number, name in used.items()}, video)
            lost |= {numbers[frame.frame]: frame.reason for frame in atlas.lost}
            names: dict[str, dict[int, str]] = {}
            for stretch in atlas.submaps:
                in_stretch = {numbers[frame]: atlas.frames[frame] for frame in stretch.frames}
                names.setdefault(stretch.model, {}).update(in_stretch)
            units = {stretch.model: stretch.unit for stretch in atlas.submaps}
            for model, images_of in names.items():
                number = int(Path(model).name)
                ordered = dict(sorted(images_of.items()))
                submaps[number] = SubmapContents(span.name, model, by_submap.get(number, {}), ordered, units[model])
        except (LookupError, ValueError) as error:
            text = f"{error}".encode(errors="backslashreplace").decode()  # a name may be any text
            raise InputError(f"{folder / 'poses' / ATLAS_FILE} does not fit the frames: {text}", MADE) from error
    return SegmentContents(span, stages, [submaps[number] for number in sorted(submaps)], used, lost)


def _frame_numbers(atlas: AtlasRecord, numbers: Mapping[str, int], video: Video) -> list[int]:
    """Numbers in the video of an atlas's frames: by their names, in ``numbers`` or of the form ``frame_000123``."""
    in_video = []
    for file in atlas.frames:
        if Path(file).name != file:
            raise ValueError(f"the name '{file}'")
        name = Path(file).stem
        match = FRAME_NAME.fullmatch(name)
        number = numbers.get(name, int(match.group(1)) if match else -1)
        if not video.first <= number < video.stop:
            raise ValueError(f"{file} is none of the frames {video.first} to {video.stop - 1}")
        in_video.append(number)
    return in_video


def common_frames(contents: Contents) -> dict[ModelKey, tuple[ModelKey, Float[np.ndarray, "4 4"]]]:
    """Place each sub-map with poses in the world of the first that it is joined to, by a similarity. [4, 4]

    A sub-map that is joined to no other is its own first. Of several ways from one to another the shortest counts.
    """
    posed = [submap.key for submap in contents.submaps if submap.names]
    transforms: dict[tuple[ModelKey, ModelKey], np.ndarray] = {}
    for join in contents.joins:
        first, second = join.keys
        if join.joined and first in posed and second in posed:
            to_first = np.array(join.transform, dtype=np.float64)
            transforms.setdefault((first, second), to_first)
            transforms.setdefault((second, first), np.linalg.inv(to_first))
    placed: dict[ModelKey, tuple[ModelKey, np.ndarray]] = {}
    for start in posed:
        if start in placed:
            continue
        placed[start], reached = (start, np.eye(4)), [start]
        for key in reached:  # grows: breadth first
            for (to, other), transform in transforms.items():
                if to == key and other not in placed:
                    placed[other] = start, placed[key][1] @ transform
                    reached.append(other)
    return placed


def export_atlas(out: Path, folder: Path, overwrite: bool = False, link: bool = False) -> dict[str, Any]:
    """Export every sub-map of a video into a folder; returns the content of ``manifest.json``.

    A folder has (docs/reconstruct.md 9): ``colmap/`` with the posed images and the model, ``nerfstudio/`` with dense
    depth where it was estimated, and ``trajectory.txt`` in TUM's format, camera to world, at seconds of the video, or
    frame numbers where its rate is unknown. The manifest has, for each, the similarity from its world to that of the
    first one that it is joined to. With ``link``, images and depth are second names of the files in ``out``, where both
    are on one disk.

    Raises:
        InputError: ``out`` is of no video, has no poses, or is damaged; or ``folder`` is there without ``overwrite``.
    """
    contents = read_contents(out)
    submaps, video = {submap.key: submap for submap in contents.submaps if submap.names}, contents.video
    if not submaps:
        raise InputError(f"{out} has no sub-map with poses", "at least one")
    refuse_overlap(folder, out)
    entries = []
    with atomic_folder(folder, overwrite) as scratch:
        for key, (first, to_first) in common_frames(contents).items():
            submap = submaps[key]
            place = f"{submap.segment or 'submap'}-{submap.number}"
            has_depth = _write_submap(contents, submap, scratch / place, link)
            entries.append(
                {
                    "name": submap.name,
                    "folder": place,
                    "frames": list(submap.names),
                    "unit": submap.unit,
                    "nerfstudio": has_depth,
                    "joined_to": submaps[first].name,
                    "to_joined": to_first.tolist(),
                }
            )
        manifest = {
            "format": _FORMAT,
            "source": [video.source],
            "frames": video.frames,
            "rate": video.rate,
            "size": list(video.size or ()),
            "timestamps": "frame number" if video.rate is None else "s",
            "submaps": entries,
            "joins": [join.model_dump(mode="json") for join in contents.joins],
        }
        write_json(scratch / MANIFEST, manifest)
    return manifest


def _write_submap(contents: Contents, submap: SubmapContents, folder: Path, link: bool) -> bool:
    """Write the files of one sub-map; returns True if there is dense depth.

    Images are linked where asked for; all else, which programs write anew, is copied.
    """
    scene, depth = contents.folder / submap.segment / "poses", contents.folder / submap.folder / "depth"
    model = scene / submap.model
    poses = colmap.read(model)
    numbers = {name: number for number, name in submap.names.items()}
    names = poses.names_or_numbers()
    if set(names) != set(numbers):
        raise InputError(
            f"{model} has {len(names)} frames, and the atlas of its scene names {len(numbers)} of it",
            "the same frames",
            "Restore the segment, or reconstruct it again",
        )
    frames = np.array([numbers[name] for name in names])
    order = np.argsort(frames)
    make_folder(folder)
    trajectory = Trajectory(poses.camera_to_world[order], timestamps=contents.seconds(frames[order]))
    tum.write(folder / "trajectory.txt", trajectory)
    files = {f"colmap/images/{name}": scene / "images" / name for name in names}
    files |= {f"colmap/masks/{name}.png": mask for name in names if (mask := scene / f"masks/{name}.png").is_file()}
    files |= {f"colmap/sparse/0/{file.name}": file for file in sorted(model.iterdir())}
    has_depth = bool(submap.stages) and (depth / "transforms.json").is_file()
    for file in sorted(depth.rglob("*")) if has_depth else ():
        if file.is_file():
            files[f"nerfstudio/{file.relative_to(depth).as_posix()}"] = file
    for place, file in files.items():
        make_folder((folder / place).parent)
        is_image = file.suffix.lower() in FRAME_SUFFIXES
        (link_or_copy if link and is_image else shutil.copyfile)(file, folder / place)
    write_unit(folder / "colmap", submap.unit)
    return has_depth
