"""Page that leads to everything a reconstruction has made."""

from __future__ import annotations

from html import escape
from urllib.parse import quote

from coliags_plugin.outputs.page import table, write_page
from coliags_plugin.pipeline.record import Record
from coliags_plugin.pipeline.stages import duration

#: Name of the file.
PAGE_FILE = "index.html"
#: Results are sentences.
_STYLE = ":is(th, td):nth-child(2) { text-align: left; white-space: normal; }"


def write_index(record: Record, title: str) -> None:
    """Write ``index.html``: what each stage gave, and links to the files.

    Args:
        record: Of the reconstruction.
        title: Heading, plain text.

    Raises:
        InputError: The file cannot be written.
    """
    stages = [(name, stage.summary, duration(stage.seconds)) for name, stage in record.stages.items()]
    links = "".join(
        f'<li><a href="{quote(path)}">{escape(path)}</a>: {escape(what)}</li>'
        for stage in record.stages.values()
        for path, what in stage.files.items()
    )
    write_page(
        record.folder / PAGE_FILE,
        title,
        f"<h1>{escape(title)}</h1><p>For research use only.</p>",
        [
            f"<section><h2>Files</h2><ul>{links}</ul></section>",
            f"<section><h2>Stages</h2>{table(('stage', 'result', 'time'), stages)}</section>",
        ],
        _STYLE,
    )
