"""Section of a report with a scene to fly through."""

from __future__ import annotations

from html import escape

_STYLE = "width:100%;height:70vh;border:0"
#: JavaScript: a browser would load a frame of a closed section too.
_LOAD = "const frame = this.querySelector('iframe'); frame.srcdoc ||= frame.dataset.page;"


def scene_section(page: str, name: str) -> str:
    """HTML of the section; the scene is loaded when it is opened.

    Args:
        page: Self-contained HTML page of the scene (:func:`coliags_plugin.export.viewer.saving.scene_page`).
        name: What it shows, plain text.
    """
    frame = f'<iframe title="{escape(name)}" style="{_STYLE}" data-page="{escape(page)}"></iframe>'
    summary = f"<summary>{escape(name)}</summary>"
    return f'<section><h2>Scene</h2><details ontoggle="{_LOAD}">{summary}{frame}</details></section>'
