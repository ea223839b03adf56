"""HTML report: one page that works without a server, without other files and, but for choosing, without scripts.

The same results give the same bytes: the file contains neither the time nor the machine it was written on.
"""

from __future__ import annotations

from pathlib import Path

from coliags_plugin.comparison.report.blocks import Content
from coliags_plugin.comparison.report.content import Choices
from coliags_plugin.comparison.report.frame_section import frame_section
from coliags_plugin.comparison.report.html_blocks import html_block, html_header, html_section
from coliags_plugin.comparison.report.light_section import light_section
from coliags_plugin.comparison.report.pictures import Pictures
from coliags_plugin.comparison.report.profile_charts import profile_section
from coliags_plugin.comparison.report.provenance_section import provenance_section
from coliags_plugin.comparison.report.study import Study
from coliags_plugin.comparison.report.training_charts import training_charts
from coliags_plugin.comparison.report.view_section import view_section
from coliags_plugin.comparison.report.views import Views
from coliags_plugin.outputs.page import write_page

#: Largest page, bytes.
PAGE_LIMIT = 40_000_000
#: Room for what all pages have, and for the text of one picture and its error, bytes.
_FIXED, _PER_FIGURE = 30_000, 1_200

_STYLE, _SCRIPT = (Path(__file__).with_name(name) for name in ("report.css", "report.js"))


def write_html(study: Study, content: Content, choices: Choices, views: Views, output: Path, scene: str = "") -> None:
    """Write the page, and the pictures for which it has no room into a folder beside it.

    Args:
        study: The results.
        content: Its tables.
        choices: Columns, reference, title and note.
        views: Held-out views.
        output: The file.
        scene: Section with a scene (:func:`.scene_section.scene_section`); empty: none.

    Raises:
        InputError: A training log is damaged, or the page cannot be written.
    """
    style, script = (path.read_text(encoding="utf-8") for path in (_STYLE, _SCRIPT))
    before = [html_section(content.metrics), html_section(content.failures) if content.failures else ""]
    after = [
        scene,
        profile_section(study),
        light_section(study),
        "\n".join(
            ["<section><h2>Training</h2>", *map(html_block, content.costs.blocks), training_charts(study), "</section>"]
        ),
        html_section(content.scenes) if content.scenes else "",
        frame_section(study, choices.columns, content.reference),
        provenance_section(study),
    ]
    header = html_header(content)
    text = sum(len(part.encode()) for part in (header, *before, *after, style, script))
    pictures = Pictures(output, PAGE_LIMIT - text - _FIXED - _PER_FIGURE * views.figures)
    middle = view_section(study, views, pictures, content.reference)
    write_page(output, content.title, header, [*before, middle, *after], style, script)
    pictures.remove_former()
