"""The page that ends a reconstruction: frames with a pose, figures, surfaces and held-out views of all sub-maps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import escape

from coliags_plugin.core.images import read_rgb
from coliags_plugin.datamanagers.atlas import AtlasRecord, read_atlas
from coliags_plugin.pipeline.context import LARGEST, Submap
from coliags_plugin.pipeline.stages import PAGE_FILE, Record, StageRecord
from coliags_plugin.pipeline.training_stages import PICTURES, SCENE
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.model import (
    Block,
    Bullet,
    Bullets,
    Column,
    EncodedImage,
    Fact,
    Figures,
    Folded,
    Image,
    Page,
    Paragraph,
    Section,
    Table,
    TableCell,
    Template,
    Value,
    as_cell,
    ranked_cells,
)
from coliags_plugin.reporting.numbers import area_text, duration

#: Held-out views shown of each sub-map, beside the worst.
_VIEWS = 6
#: Pictures of a frame, in order.
_KINDS = ("recorded.png", "depth.png", "flattened light.png")
#: Rows of the table of stretches above which it is folded.
_LONG = 12
#: Figures of a sub-map that have a mean over all, with their units.
_MEASURED = {"psnr": "dB", "ssim": "1", "psnr_pose_refined": "dB", "psnr_training": "dB", "gap": "dB"}
#: Columns that are left out where no sub-map has them.
_WHERE_KNOWN = ("span", "psnr_pose_refined", "seen")
#: Figures that are words.
_TEXTS = ("unit", "depth_scale")
#: What to do where the poses of a sub-map are suspect.
SUSPECT = (
    "there the surface may be bent or torn. Compare the held-out views, and see check.html. Better poses may come from "
    "more frames (--every), a part of the video without cuts, a mask of what does not move with the wall (--mask), or "
    "the calibration of the camera (--camera, --params)."
)


@dataclass(frozen=True)
class SubmapResults:
    """The stages of a sub-map, by their names without its folder."""

    submap: Submap
    stages: Mapping[str, StageRecord]

    @property
    def figures(self) -> dict[str, Any]:
        """The numbers of all its stages; of a damaged record, those that are numbers."""
        found: dict[str, Any] = {
            name: value
            for stage in self.stages.values()
            for name, value in stage.figures.items()
            if isinstance(value, str) == (name in _TEXTS) and isinstance(value, int | float | str)
        }
        gap = {"gap": found["psnr_training"] - found["psnr"]} if {"psnr", "psnr_training"} <= found.keys() else {}
        return found | gap

    @property
    def failure(self) -> str:
        """Which stage failed, and why; empty where none did."""
        failed = (f"{name} failed: {stage.summary}" for name, stage in self.stages.items() if stage.state == "failed")
        return next(failed, "")


def results_of(record: Record) -> list[SubmapResults]:
    """The sub-maps of a record, the largest first."""
    stages: dict[int, dict[str, StageRecord]] = {0: {}}
    for name, stage in record.stages.items():
        folder, _, own = name.rpartition("/")
        if own not in ("frames", "poses"):
            stages.setdefault(int(folder.removeprefix("submap-") or 0), {})[own] = stage
    return [SubmapResults(Submap(number), stages[number]) for number in sorted(stages)]


def submap_table(
    results: Sequence[SubmapResults], spans: Sequence[str | None] = (), names: Sequence[str] = ()
) -> Table:
    """Figures of the sub-maps and their means; ``spans`` tell where in the video each is, ``names`` their names."""
    names = names or [f"{one.submap.number}{'' if one.submap.number else ', the largest'}" for one in results]
    figures = [one.figures for one in results]
    columns = [
        Column("submap", "Sub-map", words=True),
        Column("frames", "Frames"),
        Column("span", "In the video", words=True),
        Column("held_out", "Held out"),
        Column("psnr", "PSNR", "dB", "higher"),
        Column("ssim", "SSIM", "1", "higher"),
        Column("psnr_pose_refined", "PSNR, pose refined", "dB"),
        Column("psnr_training", "PSNR of training views", "dB"),
        Column("gap", "Gap", "dB", "lower"),
        Column("area", "Area"),
        Column("seen", "Seen", words=True),
        Column("steps", "Steps"),
        Column("time", "Time"),
    ]
    rows: list[dict[str, Value | TableCell]] = [
        {
            **{key: own.get(key) for key in ("frames", "held_out", "steps")},
            "submap": name,
            "span": span,
            "area": area_of(own),
            "seen": seen_of(own),
            "time": duration(sum(stage.seconds for stage in one.stages.values())),
        }
        for name, span, own, one in zip(names, spans or [None] * len(results), figures, results, strict=True)
    ]
    if len(results) > 1:
        rows.append({"submap": "mean"})
    for key, unit in _MEASURED.items():
        values = [own.get(key) for own in figures]
        if len(results) > 1:
            known = [value for value in values if value is not None]
            values.append(sum(known) / len(known) if known else None)
        for row, cell in zip(rows, ranked_cells(values, unit, None), strict=True):
            row[key] = cell
    for row, one in zip(rows, results, strict=False):
        if one.failure:
            row["psnr"] = replace(as_cell(row["psnr"]), note=one.failure)
    there = {key for row in rows for key, value in row.items() if as_cell(value).text}
    shown = [column for column in columns if column.key not in _WHERE_KNOWN or column.key in there]
    return Table("", shown, rows, name="submaps")


def table_of(columns: Sequence[Column], rows: Iterable[Sequence[Value | TableCell]], name: str = "") -> Table:
    """A table of rows of as many values as there are columns."""
    keys = [column.key for column in columns]
    return Table("", columns, [dict(zip(keys, row, strict=True)) for row in rows], name=name)


def area_of(figures: Mapping[str, Any]) -> str | None:
    """Area of the mesh; None where there is none."""
    return area_text(figures["area"], figures.get("unit") == "mm") if "area" in figures else None


def seen_of(figures: Mapping[str, Any]) -> str | None:
    """Share of the wall seen, in per cent, or the seen area where the whole wall is unknown."""
    if "seen" in figures:
        return f"{100.0 * figures['seen']:.0f} %"
    return area_text(figures["seen_area"], figures.get("unit") == "mm") if "seen_area" in figures else None


def held_out_text(results: Sequence[SubmapResults]) -> str:
    """Held-out PSNR of each sub-map, and the mean; empty where nothing was evaluated."""
    values = [(one.submap.number, psnr) for one in results if (psnr := one.figures.get("psnr")) is not None]
    if not values:
        return ""
    if len(values) == 1:
        return f"{values[0][1]:.2f} dB"
    each = ", ".join(f"{number}: {psnr:.2f}" for number, psnr in values)
    mean = sum(psnr for _, psnr in values) / len(values)
    return f"{mean:.2f} dB in the mean over {len(values)} sub-maps ({each})"


def remarks(record: Record) -> list[str]:
    """What limits the result, and what to do; findings of checks are only counted."""
    told = [
        f"{name} failed: {stage.summary}" if stage.state == "failed" else f"{name}: {warning}"
        for name, stage in record.stages.items()
        if name.rpartition("/")[2] != "check" or stage.state == "failed"
        for warning in (stage.warnings or [""] * (stage.state == "failed"))
    ]
    checks = {one.submap.title: one.stages["check"] for one in results_of(record) if "check" in one.stages}
    if suspect := [f"{title} ({check.summary})" for title, check in checks.items() if check.warnings]:
        told.append(f"the poses of {', '.join(suspect)}: {SUSPECT}")
    return told


def _remarks(record: Record) -> Iterator[Block]:
    """The findings of checks in full."""
    found = [
        Bullet(warning, name, quote(next(iter(stage.files), "")))
        for name, stage in record.stages.items()
        if name.rpartition("/")[2] == "check"
        for warning in stage.warnings
    ]
    if found:
        yield Folded(f"Findings of the checks of images and poses ({len(found)})", [Bullets(found)])


def write_index(record: Record, posed: Path, title: str) -> None:
    """Write ``index.html`` for a reconstruction from the scene ``posed``: one file that opens offline."""
    results = results_of(record)
    atlas = read_atlas(posed)
    known = {} if atlas is None else _spans(atlas)
    spans = [known.get(one.submap.number) for one in results] if known else []
    sections = [
        Section("Scene", list(scene_choice(record.folder, made_files(record.folder, results, SCENE)))),
        Section("Video", list(_video(record, atlas, posed))),
        Section("Depth and light", list(_pictures(record.folder, results))),
        *_views(record.folder, results),
        Section("Sub-maps", [submap_table(results, spans), *_remarks(record)]),
        Section("Files", list(_files(record, results))),
        Section("Stages", [_stage_table(record)]),
    ]
    page = Page(title, sections, list(_facts(record, results, atlas)), "For research use only.", remarks(record))
    write_html(page, record.folder / PAGE_FILE)


def _facts(record: Record, results: Sequence[SubmapResults], atlas: AtlasRecord | None) -> Iterator[Fact]:
    if atlas is not None:
        count = len(atlas.frames)
        posed = count - len(atlas.lost)
        yield Fact("Frames with a pose", f"{posed} of {count} used ({100.0 * posed / count:.0f} %)")
        models = len({stretch.model for stretch in atlas.submaps})
        failed = sum(bool(one.failure) for one in results)
        yield Fact(
            "Sub-maps", f"{len(results) - failed} reconstructed of {models}", note=f"{failed} failed" if failed else ""
        )
    yield Fact("Held-out PSNR", held_out_text(results))
    units = {figures["unit"] for one in results if "unit" in (figures := one.figures)}
    if units:
        known = "mm, by the diameter given" if "poses" in record.stages else "mm"
        yield Fact("Unit of length", known if units == {"mm"} else "unknown" if "mm" not in units else "mm of some")
    yield Fact("Time", duration(sum(stage.seconds for stage in record.stages.values())))


def _spans(atlas: AtlasRecord) -> dict[int, str]:
    """First and last frame of each model, by its number."""
    frames: dict[int, list[int]] = {}
    for stretch in atlas.submaps:
        frames.setdefault(int(Path(stretch.model).name), []).extend(stretch.frames)
    return {number: f"{min(own)} to {max(own)}" for number, own in frames.items() if own}


def _video(record: Record, atlas: AtlasRecord | None, posed: Path) -> Iterator[Block]:
    from coliags_plugin.reconstruction.structure.colmap_scene import RIBBON_FILE

    if "frames" in record.stages:
        yield Paragraph(f"Used are {record.stages['frames'].summary}. frames/frames.json lists them.", hint=False)
    if atlas is None:
        return
    if (posed / RIBBON_FILE).is_file():
        yield Paragraph(
            "From left to right, the frames: each colour is a model, with its number of frames, grey has no pose. A "
            "notch marks a place where few points are seen from both sides."
        )
        yield Figures([Image(EncodedImage.png(read_rgb(posed / RIBBON_FILE)), "", wide=True)])
    rows = list(_stretches(atlas, {one.submap.number for one in results_of(record)}))
    columns = [Column(key, words=key != "Number") for key in ("Frames", "Number", "What", "Why")]
    yield Folded(
        f"{len(rows)} stretches of frames, and why they end", [table_of(columns, rows)], is_open=len(rows) <= _LONG
    )


def _stretches(atlas: AtlasRecord, reconstructed: set[int]) -> Iterator[Sequence[Value]]:
    """Rows of frames in order: those of one model, or without a pose for one reason."""
    what: dict[int, tuple[str, str]] = {lost.frame: ("no pose", lost.reason) for lost in atlas.lost}
    apart = {join.after: join.reason for join in atlas.joins if not join.joined}
    for stretch in atlas.submaps:
        number = int(Path(stretch.model).name)
        few = "" if number in reconstructed else "too few frames to be reconstructed"
        what |= dict.fromkeys(stretch.frames, (f"sub-map {number}", few))
    for key, group in groupby(range(len(atlas.frames)), lambda frame: what.get(frame, ("no pose", ""))):
        frames = list(group)
        first, last = frames[0], frames[-1]
        cut = apart.get(last)
        why = "; ".join(filter(None, (key[1], f"apart from what follows: {cut}" if cut else "")))
        yield [str(first) if first == last else f"{first} to {last}", len(frames), key[0], why]


def scene_choice(folder: Path, scenes: Sequence[tuple[str, str]], room: float = math.inf) -> Iterator[Block]:
    """Pages to fly through, by titles and paths: within this page as far as there is room, bytes, else loaded by it."""
    shown = []
    for title, path in scenes:
        page: str | None = None
        if (folder / path).stat().st_size <= room:
            page = (folder / path).read_text(encoding="utf-8")
            size = len(escape(page).encode())
            room, page = (room - size, page) if size <= room else (room, None)
        shown.append((title, quote(path), page))
    if shown:
        yield Template("scenes.html", {"scenes": shown})


def _pictures(folder: Path, results: Sequence[SubmapResults]) -> Iterator[Block]:
    """Frames, their depth and the wall in flattened light, side by side."""
    scales = {one.submap.title: one.figures.get("depth_scale") for one in results}
    for title, path in made_files(folder, results, PICTURES):
        rows: list[Block] = [Paragraph(f"Colours: {scale}, dark is near.")] if (scale := scales[title]) else []
        for frame in sorted((folder / path).iterdir()):
            files = [file for kind in _KINDS for file in frame.glob(kind)]
            rows.append(Figures([Image(EncodedImage.png(read_rgb(file)), file.stem) for file in files], frame.name))
        yield Folded(title, rows, is_open=title == LARGEST.title)


def made_files(folder: Path, results: Sequence[SubmapResults], what: str) -> list[tuple[str, str]]:
    """Titles of sub-maps, and paths of their files of one kind."""
    return [
        (one.submap.title, path)
        for one in results
        if "scene" in one.stages
        for path, kind in one.stages["scene"].files.items()
        if kind == what and (folder / path).exists()
    ]


def _views(folder: Path, results: Sequence[SubmapResults]) -> list[Section]:
    """The section of held-out views: those of each sub-map as of a scene of its own."""
    from coliags_plugin.comparison.report.sources import read_study
    from coliags_plugin.comparison.report.study import Study
    from coliags_plugin.comparison.report.views import view_section
    from coliags_plugin.results.reading import RESULT_FILE

    runs = []
    for one in results:
        for path in one.stages["evaluate"].files if "evaluate" in one.stages else ():
            evaluation = folder / path
            if (evaluation / RESULT_FILE).is_file():
                run = read_study([evaluation.parent.parent], evaluation.name).runs[0]
                scene = run.result.scene.model_copy(update={"name": one.submap.title})
                runs.append(replace(run, result=run.result.model_copy(update={"scene": scene})))
    return [view_section(Study(tuple(runs)), runs[0].method, _VIEWS)] if runs else []


def _files(record: Record, results: Sequence[SubmapResults]) -> Iterator[Block]:
    own = {
        path: what
        for name in ("frames", "poses")
        if name in record.stages
        for path, what in record.stages[name].files.items()
    }
    if own:
        yield _links(own)
    for one in results:
        files = {path: what for stage in one.stages.values() for path, what in stage.files.items()}
        if len(results) == 1:
            yield _links(files)
        elif files:
            yield Folded(one.submap.title, [_links(files)], is_open=one.submap.number == 0)


def _links(files: Mapping[str, str]) -> Bullets:
    return Bullets([Bullet(what, path, quote(path)) for path, what in files.items()])


def _stage_table(record: Record) -> Table:
    rows = ([name, stage.summary, duration(stage.seconds)] for name, stage in record.stages.items())
    return table_of([Column("stage"), Column("result", words=True), Column("time")], rows)
