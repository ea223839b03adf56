"""The page of a procedure: its time line, sub-maps and their joins, scenes, best and worst frames, and failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
from jaxtyping import Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.pipeline.page import (
    SUSPECT,
    area_of,
    made_files,
    remarks,
    scene_choice,
    seen_of,
    submap_table,
    table_of,
)
from coliags_plugin.pipeline.procedure.contents import ProcedureContents, ProcedureSubmap, common_frames, read_procedure
from coliags_plugin.pipeline.procedure.record import ModelKey
from coliags_plugin.pipeline.procedure.timeline import (
    State,
    clock,
    frame_states,
    picture_near,
    small_picture,
    span_text,
    stretches,
    styles,
    submap_between,
    timeline,
)
from coliags_plugin.pipeline.stages import PAGE_FILE
from coliags_plugin.pipeline.training_stages import SCENE
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
    TableCell,
    Template,
    Value,
)
from coliags_plugin.reporting.numbers import area_text, counted, duration
from coliags_plugin.results.reading import RESULT_FILE, read_result

#: Largest page, bytes, and how much of it are scenes.
_LIMIT, _SCENES = 50_000_000, 36_000_000
#: Frames shown as best and as worst, and their width, pixels.
_EXTREMES, _VIEW = 4, 400
#: Stretches without a pose that are listed, the longest.
_LISTED = 200
#: Items named in a sentence.
_NAMED = 5


def write_procedure_page(out: Path) -> None:
    """Write ``index.html`` into the folder of a procedure: one file of at most 50 MB that opens offline.

    Scenes and pictures that have no room in it are loaded from the folder. Parts that are damaged or missing are said
    to be, and the others shown.

    Raises:
        InputError: ``out`` has no ``procedure.json``, or one that is damaged; or the page cannot be written.
    """
    procedure = read_procedure(out)
    states, codes = frame_states(procedure)
    known = [submap for submap in procedure.submaps if submap.results is not None]
    first_of = {key: first for key, (first, _) in common_frames(procedure).items()}
    sections = [
        Section("Time line", [_TIMELINE, timeline(procedure, states, codes)]),
        Section("Map of the sub-maps", list(_map(procedure, first_of))),
        Section("Scenes", list(_scenes(procedure, known))),
        Section("Sub-maps", list(_table(procedure, known, first_of))),
        Section("Worst and best held-out frames", list(_extremes(procedure, known))),
        Section("Frames without a pose", list(_without_pose(procedure, states, codes))),
        Section("Segments", list(_segments(procedure))),
    ]
    source = ", ".join(procedure.record.source)
    page = Page(
        f"Reconstruction of {source}",
        sections,
        list(_facts(procedure, known)),
        "For research use only.",
        list(_cautions(procedure)),
    )
    write_html(page, out / PAGE_FILE, _LIMIT)


_TIMELINE = Paragraph(
    "From left to right, the video. Each colour is a sub-map, whose parts share one frame of reference; grey has no "
    "pose. Brackets are segments, dashed where they failed. Point at a place for frames and reasons."
)


def _facts(procedure: ProcedureContents, known: Sequence[ProcedureSubmap]) -> Iterator[Fact]:
    record, used, posed = procedure.record, procedure.kept, procedure.posed
    length = "" if record.rate is None else duration(record.frames / record.rate)
    size = f"{record.size[0]} x {record.size[1]} px"
    parts = (counted(record.frames, "frame"), length, size, "deinterlaced" if record.deinterlace else "")
    yield Fact("Video", ", ".join(filter(None, parts)))
    share = f" ({100.0 * len(posed) / len(used):.0f} %)" if used else ""
    yield Fact("Frames with a pose", f"{len(posed):,} of {len(used):,} used{share}")
    failed = sum(bool(segment.failure) for segment in procedure.segments)
    note = f"{failed} failed or not finished" if failed else ""
    yield Fact("Segments", f"{len(procedure.segments) - failed} of {len(procedure.segments)}", note=note)
    done = [submap for submap in known if submap.results and not submap.results.failure]
    yield Fact("Sub-maps", f"{len(done)} reconstructed of {len(procedure.submaps)}")
    if record.joins:
        joined, places = ({join.segments for join in record.joins if join.joined or not only} for only in (True, False))
        yield Fact("Joined", f"{len(joined)} of {counted(len(places), 'place')} between segments")
    values = [psnr for submap in known if submap.results and (psnr := submap.results.figures.get("psnr")) is not None]
    if values:
        spread = f"{min(values):.2f} to {max(values):.2f} in {len(values)} sub-maps" if len(values) > 1 else ""
        yield Fact("Held-out PSNR", f"{sum(values) / len(values):.2f} dB", note=spread)
    figures = [submap.results.figures for submap in known if submap.results]
    metric = [own for own in figures if own.get("unit") == "mm"]
    if areas := [own["area"] for own in metric if "area" in own]:
        yield Fact("Area", area_text(sum(areas), metric=True), note=f"of {len(areas)} sub-maps with lengths in mm")
    if shares := [own["seen"] for own in metric if "seen" in own]:
        mean = 100.0 * sum(shares) / len(shares)
        yield Fact("Wall seen", f"{mean:.0f} % in the mean over {counted(len(shares), 'sub-map')}")
    if figures and len(metric) < len(figures):
        yield Fact("Unit of length", "unknown" if not metric else f"mm of {len(metric)} of {len(figures)} sub-maps")
    seconds = sum(stage.seconds for segment in procedure.segments for stage in segment.record.stages.values())
    yield Fact("Time of all stages", duration(seconds) if seconds else None)


def _cautions(procedure: ProcedureContents) -> Iterator[str]:
    if not procedure.posed:
        reasons = Counter(segment.failure for segment in procedure.segments if segment.failure)
        reasons = reasons or Counter(skipped.why for skipped in procedure.record.skipped)
        why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
        yield f"No frame of this video has a pose{why}"
    yield from procedure.problems
    failed = [f"{segment.span.name} ({segment.failure})" for segment in procedure.segments if segment.failure]
    if failed:
        rest = f", and {len(failed) - _NAMED} others" if len(failed) > _NAMED else ""
        yield f"Failed or not finished: {', '.join(failed[:_NAMED])}{rest}"
    suspect = [
        submap.name
        for submap in procedure.submaps
        if submap.results and "check" in submap.results.stages and submap.results.stages["check"].warnings
    ]
    if suspect:
        rest = f" and {len(suspect) - _NAMED} others" if len(suspect) > _NAMED else ""
        yield f"The poses of {counted(len(suspect), 'sub-map')} ({', '.join(suspect[:_NAMED])}{rest}): {SUSPECT}"


def _map(procedure: ProcedureContents, first_of: Mapping[ModelKey, ModelKey]) -> Iterator[Block]:
    """The sub-maps one after the other, connected where they are joined, and the joins in a table."""
    if not procedure.submaps:
        yield Paragraph("No sub-map has poses.", hint=False)
        return
    colors, groups = styles(procedure), _groups(procedure, first_of)
    blocks = []
    for index, submap in enumerate(procedure.submaps):
        figures = {} if submap.results is None else submap.results.figures
        before = procedure.submaps[index - 1] if index else None
        texts = [
            _times(procedure, submap),
            counted(len(submap.names), "frame"),
            area_of(figures),
            f"{seen} seen" if (seen := seen_of(figures)) and "seen" in figures else None,
            "too few frames" if submap.results is None else "failed" if submap.results.failure else None,
        ]
        page = f"{submap.segment}/{PAGE_FILE}"
        blocks.append(
            {
                "name": submap.name,
                "group": groups.get(submap.key, ""),
                "style": colors[submap.name],
                "share": round((submap.last - submap.first + 1) / procedure.record.frames, 5),
                "image": _thumbnail(procedure, submap),
                "texts": [text for text in texts if text],
                "href": quote(page) if (procedure.folder / page).is_file() else "",
                "link": None if before is None else submap_between(procedure, before, submap),
            }
        )
    yield Paragraph(
        "The sub-maps by their first frames, as wide as they are long in time, but for those too short for that. A "
        "solid line joins two whose place and scale to each other are known, a dashed one says why they are not. "
        "Sub-maps with the same letter are in one frame of reference."
    )
    yield Template("submaps.html", {"blocks": blocks})
    if procedure.record.joins:
        rows: list[list[Value | TableCell]] = [
            [
                " and ".join("/".join(filter(None, (name, Path(model).name))) for name, model in join.keys),
                "joined" if join.joined else "apart",
                join.frames,
                join.rotation_deg if join.joined else None,
                None if join.position is None or not join.joined else 100.0 * join.position,
                join.reason,
            ]
            for join in procedure.record.joins
        ]
        columns = [
            Column("Sub-maps"),
            Column("Result", words=True),
            Column("Shared frames"),
            Column("Rotation", unit="degrees"),
            Column("Position", unit="% of the depth"),
            Column("Why apart", words=True),
        ]
        yield Folded("Joins of segments", [table_of(columns, rows, "joins")], is_open=len(rows) <= _NAMED)


def _times(procedure: ProcedureContents, submap: ProcedureSubmap) -> str:
    """From when to when a sub-map is; empty for an unknown rate."""
    return " to ".join(filter(None, dict.fromkeys((clock(procedure, submap.first), clock(procedure, submap.last)))))


def _thumbnail(procedure: ProcedureContents, submap: ProcedureSubmap) -> EncodedImage | None:
    """The middle frame of a sub-map."""
    names = list(submap.names)
    middle = names[len(names) // 2]
    return picture_near(procedure, middle, middle)


def _groups(procedure: ProcedureContents, first_of: Mapping[ModelKey, ModelKey]) -> dict[ModelKey, str]:
    """Letters of sub-maps that are joined to others, A to Z and then AA."""
    sizes = Counter(first_of.values())
    firsts = [submap.key for submap in procedure.submaps if sizes[submap.key] > 1]
    letters = {key: _letter(number) for number, key in enumerate(firsts)}
    return {key: letters[first] for key, first in first_of.items() if first in letters}


def _letter(number: int) -> str:
    return (chr(ord("A") + number // 26 - 1) if number >= 26 else "") + chr(ord("A") + number % 26)


def _scenes(procedure: ProcedureContents, known: Sequence[ProcedureSubmap]) -> Iterator[Block]:
    """The scenes to fly through, the longest sub-maps first."""
    scenes = [
        (", ".join(filter(None, (submap.name, _times(procedure, submap)))), f"{submap.segment}/{path}")
        for submap in sorted(known, key=lambda one: -len(one.names))
        for path in _files(procedure, submap, SCENE)
    ]
    made = list(scene_choice(procedure.folder, scenes, _SCENES))
    if made:
        yield Paragraph("The longest sub-maps are within this page, others are loaded from the folder it lies in.")
        yield from made


def _files(procedure: ProcedureContents, submap: ProcedureSubmap, what: str) -> list[str]:
    if submap.results is None:
        return []
    return [path for _, path in made_files(procedure.folder / submap.segment, [submap.results], what)]


def _table(
    procedure: ProcedureContents, known: Sequence[ProcedureSubmap], first_of: Mapping[ModelKey, ModelKey]
) -> Iterator[Block]:
    """Figures of the reconstructed sub-maps."""
    results = [submap.results for submap in known if submap.results]
    if not results:
        yield Paragraph("No sub-map was reconstructed.", hint=False)
        return
    spans = [span_text(procedure, submap.first, submap.last).removeprefix("frames ") for submap in known]
    table = submap_table(results, spans, [submap.name for submap in known])
    groups = _groups(procedure, first_of)
    if groups:
        rows = [
            {**row, "group": groups.get(known[index].key) if index < len(known) else None}
            for index, row in enumerate(table.rows)
        ]
        at = next(index for index, column in enumerate(table.columns) if column.key == "held_out")
        columns = [*table.columns[:at], Column("group", "Joined as", words=True), *table.columns[at:]]
        table = replace(table, columns=columns, rows=rows)
    yield table
    if few := len(procedure.submaps) - len(known):
        yield Paragraph(f"{counted(few, 'model')} with poses have too few frames to be reconstructed.")


def _extremes(procedure: ProcedureContents, known: Sequence[ProcedureSubmap]) -> Iterator[Block]:
    """Held-out frames with the lowest and with the highest PSNR of all, beside their renderings."""
    found: list[tuple[float, ProcedureSubmap, str, Path, str]] = []
    for submap in known:
        stages = {} if submap.results is None else submap.results.stages
        for path in stages["evaluate"].files if "evaluate" in stages else ():
            evaluation = procedure.folder / submap.segment / path
            try:
                result = read_result(evaluation / RESULT_FILE)
            except InputError:
                continue
            own = result.sets[result.main_set]
            values = zip(own.frames, own.values.get("psnr", ()), strict=False)
            found += [(psnr, submap, name, evaluation, result.main_set) for name, psnr in values if psnr is not None]
    found.sort(key=lambda one: one[0])
    half = min(_EXTREMES, len(found) // 2)
    for title, chosen in (("Lowest", found[:half]), ("Highest", found[::-1][:half])):
        images = []
        for psnr, submap, name, evaluation, frames in chosen:
            files = [evaluation / kind / frames / f"{name}.png" for kind in ("truth", "renders")]
            number = next((number for number, file in submap.names.items() if Path(file).stem == name), None)
            where = name if number is None else span_text(procedure, number, number)
            if (image := small_picture(files, _VIEW)) is not None:
                images.append(Image(image, f"{psnr:.2f} dB: {submap.name}, {where}"))
        if images:
            yield Figures(images, f"{title} PSNR: recorded above, rendered below")


def _without_pose(
    procedure: ProcedureContents, states: Sequence[State], codes: Int[np.ndarray, "N"]
) -> Iterator[Block]:
    """Reasons by how many frames they concern, and the stretches."""
    counts = Counter(codes.tolist())
    reasons = Counter[tuple[str, str]]()
    for code, count in counts.items():
        if states[code].style is None:
            reasons[states[code].what, states[code].why] += count
    if not reasons:
        yield Paragraph("Every frame has a pose.", hint=False)
        return
    rows: list[list[Value | TableCell]] = [
        [why or what, what, count, TableCell(f"{share:.1f}", share)]
        for (what, why), count in reasons.most_common()
        for share in [100.0 * count / procedure.record.frames]
    ]
    columns = [Column("Why"), Column("What", words=True), Column("Frames"), Column("Share", unit="% of the video")]
    yield table_of(columns, rows, "reasons")
    lost = [one for one in stretches(procedure, states, codes) if one.state.style is None]
    longest = sorted(lost, key=lambda one: one.first - one.last)[:_LISTED]
    has_time = procedure.record.rate is not None
    head = ["Frames", *(["From"] if has_time else []), "Number", "Why"]
    listed: list[list[Value]] = [
        [
            f"{one.first} to {one.last}" if one.last > one.first else str(one.first),
            *([clock(procedure, one.first)] if has_time else []),
            one.last - one.first + 1,
            one.state.why or one.state.what,
        ]
        for one in sorted(longest, key=lambda one: one.first)
    ]
    table = table_of([Column(key, words=key != "Number") for key in head], listed, "stretches")
    shown = f"the {_LISTED} longest of {len(lost)}" if len(lost) > _LISTED else str(len(lost))
    yield Folded(f"Stretches without a pose ({shown})", [table])


def _segments(procedure: ProcedureContents) -> Iterator[Block]:
    """The segments with links to their pages, and what they warn of."""
    items = []
    for segment in procedure.segments:
        span, page = segment.span, f"{segment.span.name}/{PAGE_FILE}"
        posed = len({number for submap in segment.submaps for number in submap.names})
        texts = [
            span_text(procedure, span.first, span.last),
            f"{posed:,} of {len(segment.kept):,} used posed",
            counted(len(segment.submaps), "sub-map"),
            segment.failure,
        ]
        there = (procedure.folder / page).is_file()
        items.append(Bullet("; ".join(filter(None, texts)), span.name, quote(page) if there else ""))
    yield Bullets(items) if items else Paragraph("No stretch of this video is long enough for one.", hint=False)
    told = [Bullet(remark, segment.span.name) for segment in procedure.segments for remark in remarks(segment.record)]
    if told:
        yield Folded(f"What the segments warn of ({len(told)})", [Bullets(told)])
