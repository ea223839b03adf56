"""Charts of the light that a run has learned, from its record ``light.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from coliags_plugin.outputs.charts import COLORS, Series, line_chart, style_classes

#: Name of the record in the folder of an evaluation or of renders.
LIGHT_FILE = "light.json"
#: Styles of curves by the colour of light that they are of; true curves have the dashed one of the same colour.
_STYLES = {"red": 7, "green": 2, "blue": 0}
_STYLE_OF_ALL = 4
_EXPONENTS = ("distance_exponent", "cosine_exponent", "incidence_exponent", "lamp_offset")


def light_facts(record: Mapping[str, Any]) -> dict[str, str]:
    """Learned numbers, beside the true ones where they are known."""
    law, true = record["learned"].get("field", {}), record.get("truth", {})
    facts = {}
    for name in _EXPONENTS:
        if name in law:
            beside = f" (true: {_numbers(true[name])})" if name in true else ""
            facts[name.replace("_", " ")] = _numbers(law[name]) + beside
    if "gain_error_rms" in record:
        facts["gain error, rms"] = ", ".join(f"{value:.1%}" for value in record["gain_error_rms"])
    return facts


def light_charts(record: Mapping[str, Any]) -> dict[str, str]:
    """HTML of the charts of law, gains and response by their titles: learned curves, and true ones beside them."""
    curves, unit, middle = record["curves"], record["unit"], record["reference_distance"]
    charts = {}
    if curves["by_distance"] is not None:
        for title, x, y, label in (
            ("Attenuation over distance", "distances", "by_distance", f"distance on the optical axis [{unit}]"),
            ("Attenuation over angle", "angles", "by_angle", f"angle to the axis at {middle:.3g} {unit} [degrees]"),
        ):
            true = _rows(curves[f"true_{y}"])
            charts[title] = _chart(curves[x], curves[y], true, label, "factor on encoded colours")
    if curves["gains"] is not None:
        charts["Gain"] = _chart(
            record["times"], curves["gains"], curves["true_gains"], "frame", "gain on encoded colours"
        )
    learned = _rows(curves["response"])
    if learned is not None:
        true = _rows(curves["true_response"])
        charts["Camera response"] = _chart(curves["colors"], learned, true, "colour before the response", "pixel value")
    return charts


def _rows(curve: Sequence[float] | None) -> list[list[float]] | None:
    """A curve that all colours share."""
    return None if curve is None else [[value] for value in curve]


def _numbers(values: Any) -> str:
    return ", ".join(f"{value:.3g}" for value in (values if isinstance(values, list) else [values]))


def _chart(
    x: Sequence[float],
    learned: Sequence[Sequence[float]],
    true: Sequence[Sequence[float]] | None,
    x_label: str,
    y_label: str,
) -> str:
    """One chart with its key; a row of values for each x."""
    lines = []
    for rows, kind, dashes in ((learned, "learned", 0), (true, "true", COLORS)):
        if not rows:
            continue
        styles = _STYLES if len(rows[0]) == len(_STYLES) else {"all colours": _STYLE_OF_ALL}
        for column, (name, style) in zip(zip(*rows, strict=True), styles.items(), strict=True):
            lines.append(Series(f"{kind}, {name}", style + dashes, list(x), list(column)))
    keys = "".join(
        f'<span class="{style_classes(line.style)}">{"- - " if line.style >= COLORS else "&#9632; "}'
        f"{escape(line.name)}</span> "
        for line in lines
    )
    return f"<p>{keys}</p>{line_chart(lines, x_label, y_label)}"
