"""Light that methods have learned, beside the true one of phantoms."""

from __future__ import annotations

from html import escape

from coliags_plugin.comparison.report.html_blocks import folded
from coliags_plugin.comparison.report.study import Cell, Study
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json
from coliags_plugin.outputs.light_charts import LIGHT_FILE, light_charts, light_facts
from coliags_plugin.outputs.page import fact_list

_HOW = (
    "What a learned law makes of the light over distance and angle, relative to the optical axis at the median "
    "distance, the gain of every training frame, with a geometric mean of 1, and the camera's response curve. True "
    "curves are those of a phantom: of its direct light, its gains and its camera."
)


def light_section(study: Study) -> str:
    """HTML section; empty where no run has learned any light.

    Raises:
        InputError: A record of light is damaged.
    """
    found = [(cell, html) for cells in study.by_method.values() for cell in cells if (html := _light(cell))]
    if not found:
        return ""
    parts = [
        folded(f"{cell.method} on {cell.scene}, seed {cell.result.seed}", [html], is_open=index == 0)
        for index, (cell, html) in enumerate(found)
    ]
    return "\n".join([f'<section><h2>Learned light</h2><p class="hint">{_HOW}</p>', *parts, "</section>"])


def _light(cell: Cell) -> str:
    """Facts and charts of one run; empty without a record."""
    file = None if cell.evaluation is None else cell.evaluation / LIGHT_FILE
    if file is None or not file.is_file():
        return ""
    record = read_json(file, "the light that a run has learned")
    try:
        facts, charts = light_facts(record), light_charts(record)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(
            f"{file}: {error!r}", "what `coliags eval` writes", "Run `coliags eval` on that run again"
        ) from error
    figures = "".join(f"<figure><h4>{escape(title)}</h4>{chart}</figure>" for title, chart in charts.items())
    return f'{fact_list(facts)}<div class="charts">{figures}</div>'
