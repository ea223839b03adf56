"""One held-out view: truth and every method, with errors and metrics."""

from __future__ import annotations

from html import escape

from coliags_plugin.comparison.report.html_blocks import swatch
from coliags_plugin.comparison.report.metric_columns import metric_title
from coliags_plugin.comparison.report.pictures import Pictures
from coliags_plugin.comparison.report.study import Cell, Study
from coliags_plugin.comparison.report.tables import column_decimals, number_text, unit_text
from coliags_plugin.comparison.report.view_selection import ChosenFrame
from coliags_plugin.comparison.report.views import EncodedImage, MethodView, View

#: Metrics shown under an image, where available.
_CAPTION_METRICS = ("psnr", "psnr_seen", "ssim", "ssim_seen", "depth_mae", "depth_mae_seen", "depth_mse")
#: Metrics by which views can be sorted.
SORTED_BY = ("psnr", "ssim", "lpips", "depth_mse", "depth_mse_inner", "depth_median_error")


def view_figure(study: Study, view: View, pictures: Pictures, reference: str) -> str:
    """HTML of a view.

    Its ``article`` carries what the script sorts by: the position along the video, and for each metric a number that is
    larger the worse the reference is.
    """
    frame = view.frame
    where = f"frame {frame.name}"
    total = len(study.frames(frame.part, frame.scene))
    why = f" · {escape(frame.why)}" if frame.why else ""
    title = f"{frame.scene} · {frame.part.set_name} · {frame.name}"
    values = "".join(
        f' data-{name.replace("_", "-")}="{_badness(study, name, value)!r}"'
        for name, value in _frame_values(study, frame, reference).items()
    )
    parts = [
        f'<article class="frame" data-title="{escape(title, quote=True)}" data-position="{frame.position}"{values}>',
        f'<h4>{escape(where)} <span class="count">{frame.position + 1} of {total}{why}</span></h4>',
        f'<div class="view" style="--cells: {1 + len(view.methods)}">',
        '<figure class="cell" data-method="truth"><div class="name">truth</div>',
        image_tag(pictures.address(view.truth), view.truth, f"{where}, true image"),
    ]
    if view.depth is not None:
        parts.append(image_tag(pictures.address(view.depth), view.depth, f"{where}, true depth"))
        parts.append("<figcaption><span>above: camera image</span><span>below: true depth</span></figcaption>")
    else:
        parts.append(_missing(view.truth, "no true depth"))
    parts.append("</figure>")
    parts += [_method(study, view, method, pictures) for method in view.methods]
    return "\n".join([*parts, "</div></article>"])


def _method(study: Study, view: View, method: MethodView, pictures: Pictures) -> str:
    name, where = method.cell.method, f"frame {view.frame.name}"
    label = f"{swatch(study.methods.index(name))}<span>{escape(name)}</span>"
    parts = [
        f'<figure class="cell" data-method="{escape(name, quote=True)}"><div class="name">{label}</div>',
        image_tag(pictures.address(method.render), method.render, f"{where}, rendered by {name}"),
    ]
    if method.error is None:
        parts.append(_missing(method.render, "no depth to compare"))
    else:
        kind = "depth" if view.error_kind == "depth" else "colour"
        parts.append(
            image_tag(pictures.address(method.error), method.error, f"{where}, absolute {kind} error of {name}")
        )
        if method.depth is not None:
            parts.append(image_tag(pictures.address(method.depth), method.depth, f"{where}, expected depth of {name}"))
    parts.append(f"<figcaption>{_caption(study, view.frame, method.cell)}</figcaption></figure>")
    return "\n".join(parts)


def _caption(study: Study, frame: ChosenFrame, cell: Cell) -> str:
    values = _values_of(study, frame, cell)
    shown = [name for name in _CAPTION_METRICS if name in values]
    if "depth_mae" in shown and "depth_mse" in shown:
        shown.remove("depth_mse")
    texts = []
    for name in shown:
        unit = study.metrics[name].unit
        number = number_text(values[name], column_decimals(unit, [values[name]]))
        texts.append(f"<span>{escape(f'{metric_title(name)} {number} {unit_text(unit)}'.rstrip())}</span>")
    return "".join(texts) or "no metrics for this frame"


def _values_of(study: Study, frame: ChosenFrame, cell: Cell) -> dict[str, float]:
    """Metrics of a frame of one run."""
    record = study.record(cell, frame.part)
    if record is None:
        return {}
    found = {name: values[frame.position] for name, values in record.values.items()}
    return {name: value for name, value in found.items() if value is not None}


def _frame_values(study: Study, frame: ChosenFrame, reference: str) -> dict[str, float]:
    """What views are sorted by: the reference's metrics of the frame."""
    runs = study.runs(frame.part, frame.scene, reference)
    values = _values_of(study, frame, runs[0]) if runs else {}
    return {name: values[name] for name in SORTED_BY if name in values}


def _badness(study: Study, metric: str, value: float) -> float:
    """Larger for worse frames."""
    return -value if study.metrics[metric].direction == "higher" else value


def image_tag(address: str, image: EncodedImage, alt: str) -> str:
    """HTML of a picture at an address."""
    return (
        f'<img src="{escape(address, quote=True)}" width="{image.width}" height="{image.height}" loading="lazy" '
        f'decoding="async" alt="{escape(alt, quote=True)}">'
    )


def _missing(like: EncodedImage, text: str) -> str:
    return f'<div class="missing" style="aspect-ratio: {like.width} / {like.height}">{escape(text)}</div>'
