"""Section of the held-out views: a slider between two methods, and every method beside the truth."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from itertools import groupby

from coliags_plugin.comparison.report.html_blocks import folded
from coliags_plugin.comparison.report.metric_columns import metric_title, part_title
from coliags_plugin.comparison.report.pictures import Pictures, data_uri
from coliags_plugin.comparison.report.study import Study
from coliags_plugin.comparison.report.view_figures import SORTED_BY, image_tag, view_figure
from coliags_plugin.comparison.report.view_selection import ChosenFrame
from coliags_plugin.comparison.report.views import SCALE_PERCENTILE, EncodedImage, Scales, Views
from coliags_plugin.outputs.charts import color_bar_svg
from coliags_plugin.outputs.colormaps import hatch
from coliags_plugin.outputs.image_files import encode_webp


def view_section(study: Study, views: Views, pictures: Pictures, reference: str) -> str:
    """HTML section; says so where there are no images.

    Args:
        study: The results.
        views: What to show.
        pictures: Where the pictures go.
        reference: Method by whose metrics views are sorted.
    """
    if not views.figures:
        return (
            '<section><h2>Held-out views</h2><p class="hint">No images: only results files are here, without the run '
            "folders.</p></section>"
        )
    drawn = [(view.frame, view_figure(study, view, pictures, reference)) for view in views.drawn()]
    by_scene = [(scene, [*own]) for scene, own in groupby(drawn, key=lambda each: each[0].scene)]
    parts = [
        '<section id="views"><h2>Held-out views</h2>',
        f'<p class="hint">{escape(_how_drawn(study, views.scales, reference))}</p>',
        _scales(views.scales),
        _COMPARATOR.format(reference=escape(reference, quote=True)),
        _sorter(study, reference),
    ]
    for index, (scene, own) in enumerate(by_scene):
        sets = _sets(study, own)
        parts.append(sets if len(by_scene) == 1 else folded(scene, [sets], is_open=index == 0))
    if pictures.beside:
        parts.append(
            f'<p class="hint">{pictures.beside} pictures are in the folder {escape(pictures.folder.name)} beside this '
            "page, to keep it small: they belong together.</p>"
        )
    return "\n".join([*parts, "</section>"])


#: Filled and shown by the script.
_COMPARATOR = """<div class="compare" data-reference="{reference}" hidden>
<div class="choices">
<label>Frame <select data-choice="frame"></select></label>
<label>Left <select data-choice="left"></select></label>
<label>Right <select data-choice="right"></select></label>
<label>Show <select data-choice="kind"><option value="0">image</option><option value="1">error</option></select></label>
</div>
<div class="stage"><img class="right" alt=""><img class="left" alt=""><div class="divider"></div></div>
<label class="slide"><span class="side"></span>
<input type="range" min="0" max="100" value="50" step="1" aria-label="Share of the left method">
<span class="side"></span></label>
</div>"""


def _sorter(study: Study, reference: str) -> str:
    """Choice of the order of the views, shown by the script."""
    options = [
        f'<option value="{name}">worst {escape(metric_title(name))} first</option>'
        for name in SORTED_BY
        if name in study.metrics
    ]
    return (
        '<p class="sorter" hidden><label>Order of the views <select data-sort="views">'
        f'<option value="">along the video</option>{"".join(options)}</select></label> by {escape(reference)}</p>'
    )


def _how_drawn(study: Study, scales: Scales, reference: str) -> str:
    percent = f"{SCALE_PERCENTILE:.0f} %"
    rule = (
        "One scale serves every method, frame and scene of this page; it ends at the smallest 1, 2 or 5 times a power "
        f"of ten below which {percent} of all errors shown lie."
    )
    texts = [f"Frames spread along each video, and the worst of {reference}."]
    if scales.depth_error is not None:
        texts.append("Under each rendering, its absolute depth error.")
    if scales.rgb_error is not None:
        texts.append("Views without true depth show the absolute colour error, the mean of red, green and blue.")
    if scales.expected:
        texts.append("Below it the expected depth, hatched where alpha is below 0.5.")
    texts.append(rule)
    texts.append("Errors beyond it, and missing depth where the truth has one, take its last colour.")
    if scales.reduction > 1:
        texts.append(f"Images are shown at 1/{scales.reduction} of their size.")
    if len({cell.result.seed for cell in study.cells}) > 1:
        texts.append("Of several seeds, the first is shown.")
    texts.append("Photographs are JPEG here; the run folders keep them as PNG.")
    return " ".join(texts)


def _scales(scales: Scales) -> str:
    parts = []
    if scales.depth_error is not None:
        parts.append(color_bar_svg((0.0, scales.depth_error), scales.unit, "error", "|depth error|", "error-scale"))
    if scales.rgb_error is not None:
        parts.append(
            color_bar_svg((0.0, scales.rgb_error), "levels of 255", "error", "|colour error|", "colour-error-scale")
        )
    if scales.depth is not None:
        parts.append(color_bar_svg(scales.depth, scales.unit, "depth", "depth", "depth-scale"))
        sample = EncodedImage("image/webp", encode_webp(hatch(14, 34)), 34, 14)
        parts.append(
            f'<div class="unknown">{image_tag(data_uri(sample), sample, "grey hatch")}'
            "<span>no true depth (plain grey in true depth); in rendered depth: alpha below 0.5</span></div>"
        )
    return f'<div class="scales">{"".join(parts)}</div>'


def _sets(study: Study, views: Iterable[tuple[ChosenFrame, str]]) -> str:
    parts = []
    for part, own in groupby(views, key=lambda each: each[0].part):
        inside = "".join(html for _, html in own)
        parts.append(f'<h3>{escape(part_title(study, part))}</h3><div class="views">{inside}</div>')
    return "".join(parts)
