"""The text of a report, made of a study."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from coliags_plugin.comparison.report.blocks import Block, Content, Folded, Paragraph, Section
from coliags_plugin.comparison.report.comparability import cautions
from coliags_plugin.comparison.report.cost_table import cost_table
from coliags_plugin.comparison.report.metric_columns import check_columns, metric_columns, part_title
from coliags_plugin.comparison.report.published import published_for
from coliags_plugin.comparison.report.scene_tables import scene_table, seed_table
from coliags_plugin.comparison.report.statistics_tables import PREFERRED, choose_reference, compare, comparison_table
from coliags_plugin.comparison.report.statistics_text import EXPLANATION, statistics_text
from coliags_plugin.comparison.report.study import Failure, Part, Study
from coliags_plugin.comparison.report.summary_table import summary_table
from coliags_plugin.comparison.report.tables import Column, Entry, Row, Table, counted

_TIMES = "\N{MULTIPLICATION SIGN}"
#: Scenes listed by name; of more, only their number is given.
_LISTED = 12


@dataclass(frozen=True)
class Choices:
    """What the reader of a report chooses.

    Attributes:
        columns: Metrics to show, in this order; empty: the default ones.
        reference: Method that the others are compared with; None: ``coliags``, or the best where it is not there.
        title: Heading; None: made from methods and scenes.
        note: Remark under the heading.
    """

    columns: Sequence[str] = ()
    reference: str | None = None
    title: str | None = None
    note: str | None = None


def make_content(study: Study, choices: Choices) -> Content:
    """Compose the text.

    Raises:
        InputError: A chosen column or the reference does not exist.
    """
    check_columns(study, choices.columns)
    reference = choose_reference(study, choices.reference)
    return Content(
        title=choices.title if choices.title is not None else _title(study),
        note=choices.note or "",
        reference=reference,
        facts=[(name, value) for name, value in _facts(study) if value],
        description=study.protocol.description,
        cautions=cautions(study),
        metrics=_metrics(study, choices, reference),
        failures=_failures(study.failures),
        costs=Section("Costs", [cost_table(study)]),
        scenes=_scenes(study, choices),
    )


def _title(study: Study) -> str:
    scenes = study.scenes()
    where = scenes[0] if len(scenes) == 1 else counted(len(scenes), "scene")
    if len(study.methods) == 1:
        return f"{study.methods[0]} on {where}"
    return f"{len(study.methods)} methods compared on {where}"


def _facts(study: Study) -> list[tuple[str, str]]:
    scenes, results = study.scenes(), [cell.result for cell in study.cells]
    sizes = dict.fromkeys(result.scene.size for result in results)
    versions = dict.fromkeys(str(result.software.get("package_version") or "") for result in results)
    seeds = sorted({result.seed for result in results})
    frames = {part: sum(len(study.frames(part, scene)) for scene in study.scenes(part)) for part in study.parts}
    splits = dict.fromkeys(part.split for part in study.parts)
    return [
        ("Scene" if len(scenes) == 1 else "Scenes", ", ".join(scenes) if len(scenes) <= _LISTED else str(len(scenes))),
        ("Methods", ", ".join(study.methods)),
        ("Seeds" if len(seeds) > 1 else "Seed", ", ".join(map(str, seeds))),
        ("Split", ", ".join(filter(None, splits))),
        ("Held-out frames", "; ".join(f"{count} {part_title(study, part)}" for part, count in frames.items())),
        ("Image size", ", ".join(f"{width} {_TIMES} {height} px" for width, height in sizes)),
        ("Protocol", f"{study.protocol.name}, version {study.protocol.version}"),
        ("Evaluated with", ", ".join(f"coliags_plugin {version}" for version in versions if version)),
    ]


def _metrics(study: Study, choices: Choices, reference: str) -> Section:
    how = "Means over the frames of each set."
    if len(study.scenes()) > 1:
        how = "Means over the scenes of each set, of each the mean over its frames."
    how += " ↑ higher is better, ↓ lower is better."
    if len(study.methods) > 1:
        how += " Best in bold, second underlined, by the printed digits; equal values share a rank."
    blocks: list[Block] = [Paragraph(how)]
    for part in study.parts:
        # What holds for several parts is said once.
        blocks += [block for block in _part(study, part, choices, reference) if block not in blocks]
    return Section("Metrics", blocks)


def _part(study: Study, part: Part, choices: Choices, reference: str) -> list[Block]:
    columns = metric_columns(study, part, choices.columns)
    compared = {column.key: compare(study, part, column, reference) for column in columns}
    blocks: list[Block] = [summary_table(study, part, columns, compared, published_for(study, part))]
    shown = [column for column in columns if column.shown and compared[column.key]]
    if shown:
        said = choices.reference is not None or reference == PREFERRED
        blocks += [Paragraph(text) for text in statistics_text(compared[shown[0].key], reference, said)]
    if shown and len(study.scenes(part)) > 1:
        leads = [comparison_table(study, part, column, compared[column.key], reference) for column in shown]
        title = f"Lead of {reference} over each method, {part_title(study, part)}"
        blocks.append(Folded(title, [Paragraph(EXPLANATION), *leads]))
    seeds = seed_table(study, part, columns)
    if seeds is not None:
        blocks.append(Folded(seeds.title, [seeds]))
    return blocks


def _scenes(study: Study, choices: Choices) -> Section | None:
    scenes = study.scenes()
    if len(scenes) == 1:
        return None
    tables: dict[str, list[Table]] = {scene: [] for scene in scenes}
    for part in study.parts:
        columns = metric_columns(study, part, choices.columns)
        for scene in study.scenes(part):
            tables[scene].append(scene_table(study, part, columns, scene))
    return Section("Every scene", [Folded(scene, own) for scene, own in tables.items()])


def _failures(failures: Sequence[Failure]) -> Section | None:
    if not failures:
        return None
    blocks: list[Block] = [Paragraph("Means and tests leave these out.")]
    unfinished = Counter(failure.method for failure in failures if failure.reason is None)
    if unfinished:
        each = ", ".join(f"{method} ({count})" for method, count in unfinished.items())
        blocks.append(Paragraph(f"{counted(unfinished.total(), 'cell')} not finished: {each}."))
    rows = tuple(
        Row(failure.method, (Entry(failure.scene), Entry(str(failure.seed), failure.seed), Entry(failure.reason)))
        for failure in failures
        if failure.reason is not None
    )
    if rows:
        columns = (Column("scene", "Scene", words=True), Column("seed", "Seed"), Column("reason", "Reason", words=True))
        blocks.append(Table("Failed", "Method", columns, rows, counted(len(rows), "cell"), name="failed"))
    return Section("Cells without a result", blocks)
