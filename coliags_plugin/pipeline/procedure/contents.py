"""What lies in the folder of a procedure: its record, and the sub-maps of all its segments (docs/procedure.md 1)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.atlas import AtlasRecord, read_atlas
from coliags_plugin.datamanagers.units import Unit
from coliags_plugin.pipeline.frames import IMAGES, MADE, FramesRecord
from coliags_plugin.pipeline.page import SubmapResults, results_of
from coliags_plugin.pipeline.procedure.record import PROCEDURE_FILE, ModelKey, Procedure
from coliags_plugin.pipeline.procedure.segments import SURVEY_FILE, Segment
from coliags_plugin.pipeline.stages import Record

#: Arrays of the survey that are shown.
SURVEYED = ("sharpness", "followed", "motion")
_FRAME_NAME = re.compile(r"frame_(\d+)")


T = TypeVar("T")


@dataclass(frozen=True)
class ProcedureSubmap:
    """A model with poses, of a segment."""

    segment: str
    model: str  # folder, relative to the segment's scene
    unit: Unit
    names: Mapping[int, str]  # of the images, by their number in the video, ascending
    results: SubmapResults | None  # None: too few frames to be reconstructed

    @property
    def key(self) -> ModelKey:
        """Segment and model."""
        return self.segment, self.model

    @property
    def number(self) -> int:
        """Of the model within its segment."""
        return int(Path(self.model).name)

    @property
    def name(self) -> str:
        """What pages and folders call it: segment and number."""
        return f"{self.segment}/{self.number}"

    @property
    def first(self) -> int:
        """First frame."""
        return min(self.names)

    @property
    def last(self) -> int:
        """Last frame."""
        return max(self.names)


@dataclass(frozen=True)
class SegmentContents:
    """The reconstruction of a segment, as far as it can be read."""

    span: Segment
    record: Record
    results: Sequence[SubmapResults]
    atlas: AtlasRecord | None
    kept: Mapping[int, str]  # names of the images of frames of use, by their numbers in the video
    why: Mapping[int, str]  # why frames have no pose, by their numbers
    submaps: Sequence[ProcedureSubmap]
    problem: str = ""  # what of it cannot be read, and why

    @property
    def failure(self) -> str:
        """Which stage failed, and why, or that it is not finished; empty where its largest sub-map is done."""
        stages = self.record.stages
        own = {name: stage for name, stage in stages.items() if "/" not in name}
        for name, stage in own.items():
            if stage.state == "failed":
                of = "" if name in ("frames", "poses") else " of its largest sub-map"
                return f"{name}{of} failed: {stage.summary}"
        if self.problem:
            return self.problem
        if not stages:
            return "it was not begun"
        return "" if "report" in own and own["report"].state == "done" else "it is not finished"

    def image(self, out: Path, number: int) -> Path:
        """File of a frame of use."""
        return out / self.span.name / "frames" / IMAGES / f"{self.kept[number]}.png"


@dataclass(frozen=True)
class ProcedureContents:
    """The folder of a procedure."""

    folder: Path
    record: Procedure
    segments: Sequence[SegmentContents]
    submaps: Sequence[ProcedureSubmap]  # of all segments, by their first frames
    survey: Mapping[str, Float[np.ndarray, "N"]] = field(default_factory=dict)  # numbers of each frame, by name
    problems: Sequence[str] = ()  # what cannot be read, and why

    @property
    def posed(self) -> set[int]:
        """Frames with a pose."""
        return {number for submap in self.submaps for number in submap.names}

    @property
    def kept(self) -> set[int]:
        """Frames of use."""
        return {number for segment in self.segments for number in segment.kept}


def read_procedure(out: Path) -> ProcedureContents:
    """Read the folder of a procedure; of damaged or missing parts it is kept what is wrong with them.

    Raises:
        InputError: It has no ``procedure.json``, or one that is damaged.
    """
    record = Procedure.read(out)
    if record is None:
        raise InputError(
            f"no {out / PROCEDURE_FILE}", "the folder of a procedure, as `coliags reconstruct` makes it of a long video"
        )
    segments = [_read_segment(out, span, record) for span in record.segments]
    problems = [f"{one.span.name}: {one.problem}" for one in segments if one.problem]
    survey = _attempt(lambda: _read_survey(out, record), out, problems) or {}
    submaps = sorted((submap for one in segments for submap in one.submaps), key=lambda submap: submap.first)
    return ProcedureContents(out, record, segments, submaps, survey, problems)


def _read_survey(out: Path, record: Procedure) -> dict[str, np.ndarray]:
    if not (out / SURVEY_FILE).is_file():
        return {}
    survey = read_arrays(out / SURVEY_FILE, MADE, optional=SURVEYED)
    if any(values.shape != (record.frames,) or values.dtype.kind != "f" for values in survey.values()):
        shapes = ", ".join(f"{name} {values.dtype} {[*values.shape]}" for name, values in survey.items())
        raise InputError(f"{out / SURVEY_FILE} has {shapes}", f"a number for each of {record.frames} frames")
    return survey


def _attempt(read: Callable[[], T], folder: Path, problems: list[str]) -> T | None:
    """What is read; None of what is damaged, which is said without the place of the folder, as that may be moved."""
    try:
        return read()
    except InputError as error:
        problems.append(str(error).replace(f"{folder}/", "").replace(str(folder), folder.name))
        return None


def _read_segment(out: Path, span: Segment, procedure: Procedure) -> SegmentContents:
    folder, problems = out / span.name, list[str]()
    record = _attempt(lambda: Record.of(folder), folder, problems) or Record(folder)
    frames = _attempt(lambda: FramesRecord.read(folder / "frames"), folder, problems)
    kept = {one.frame: one.name for one in (frames.kept if frames else ()) if span.first <= one.frame <= span.last}
    why = {one.frame: one.why for one in (frames.dropped if frames else ())}
    atlas = _attempt(lambda: read_atlas(folder / "poses"), folder, problems)
    results = [one for one in results_of(record) if one.stages]
    submaps: list[ProcedureSubmap] = []
    if atlas is not None:
        try:
            numbers = _numbers(atlas, {name: number for number, name in kept.items()}, procedure)
            submaps = _submaps(span.name, atlas, numbers, {one.submap.number: one for one in results})
            why |= {numbers[lost.frame]: lost.reason for lost in atlas.lost}
        except (LookupError, ValueError) as error:
            told = f"{error}".encode(errors="backslashreplace").decode()  # a name may be any text
            problems.append(f"poses/atlas.json does not fit the frames: {told}")
            atlas = None
    return SegmentContents(span, record, results, atlas, kept, why, submaps, "; ".join(problems))


def _numbers(atlas: AtlasRecord, known: Mapping[str, int], procedure: Procedure) -> list[int]:
    """Numbers in the video of an atlas's frames: by their names."""
    numbers = []
    for file in atlas.frames:
        if Path(file).name != file:
            raise ValueError(f"the name '{file}'")
        name = Path(file).stem
        named = _FRAME_NAME.fullmatch(name)
        number = known.get(name, int(named.group(1)) if named else -1)
        if not procedure.first <= number < procedure.stop:
            raise ValueError(f"{file} is none of the frames {procedure.first} to {procedure.stop - 1}")
        numbers.append(number)
    return numbers


def _submaps(
    segment: str, atlas: AtlasRecord, numbers: Sequence[int], results: Mapping[int, SubmapResults]
) -> list[ProcedureSubmap]:
    units, models = {stretch.model: stretch.unit for stretch in atlas.submaps}, dict[str, dict[int, str]]()
    for stretch in atlas.submaps:
        models.setdefault(stretch.model, {}).update({numbers[index]: atlas.frames[index] for index in stretch.frames})
    return [
        ProcedureSubmap(segment, model, units[model], dict(sorted(names.items())), results.get(int(Path(model).name)))
        for model, names in models.items()
        if names
    ]


def common_frames(procedure: ProcedureContents) -> dict[ModelKey, tuple[ModelKey, Float[np.ndarray, "4 4"]]]:
    """For each sub-map, the first of those it is joined to, and the similarity from its world to that one's. [4, 4]

    A sub-map that is joined to no other is its own first. Of several ways from one to another the shortest counts.
    """
    neighbours: dict[ModelKey, list[tuple[ModelKey, np.ndarray]]] = {one.key: [] for one in procedure.submaps}
    for join in procedure.record.joins:
        first, second = join.keys
        if join.joined and first in neighbours and second in neighbours:
            to_first = np.array(join.transform, dtype=np.float64)
            neighbours[first].append((second, to_first))
            neighbours[second].append((first, np.linalg.inv(to_first)))
    placed: dict[ModelKey, tuple[ModelKey, np.ndarray]] = {}
    for submap in procedure.submaps:
        if submap.key in placed:
            continue
        placed[submap.key] = submap.key, np.eye(4)
        reached = [submap.key]
        for key in reached:  # grows: breadth first
            for other, to_key in neighbours[key]:
                if other not in placed:
                    placed[other] = submap.key, placed[key][1] @ to_key
                    reached.append(other)
    return placed
