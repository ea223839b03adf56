"""The light that a run has learned, from its record ``light.json``: numbers and charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from coliags_plugin.outputs.charts import COLORS, Series
from coliags_plugin.reporting.model import Chart, Fact

#: Name of the record in the folder of an evaluation or of renders.
LIGHT_FILE = "light.json"
#: Styles of curves by the colour of light that they are of; true curves have the dashed one of the same colour.
_STYLES = {"red": 7, "green": 2, "blue": 0}
_STYLE_OF_ALL = 4
_NUMBERS = ("distance_exponent", "cosine_exponent", "incidence_exponent", "lamp_offset")


def light_facts(record: Mapping[str, Any]) -> list[Fact]:
    """Learned numbers, beside the true ones where they are known."""
    law, true = record["learned"].get("field", {}), record.get("truth", {})
    facts = [
        Fact(name.replace("_", " "), _numbers(law[name]), note=f"true: {_numbers(true[name])}" if name in true else "")
        for name in _NUMBERS
        if name in law
    ]
    errors = ", ".join(f"{value:.1%}" for value in record.get("gain_error_rms", ()))
    return [*facts, Fact("gain error, rms", errors)]


def light_charts(record: Mapping[str, Any]) -> list[Chart]:
    """Charts of law, gains and response: learned curves, and true ones beside them."""
    curves, unit, middle = record["curves"], record["unit"], record["reference_distance"]
    charts = []
    if curves["by_distance"] is not None:
        for title, x, y, label in (
            ("Attenuation over distance", "distances", "by_distance", f"distance on the optical axis [{unit}]"),
            ("Attenuation over angle", "angles", "by_angle", f"angle to the axis at {middle:.3g} {unit} [degrees]"),
        ):
            lines = _lines(curves[x], curves[y], _rows(curves[f"true_{y}"]))
            charts.append(Chart(lines, label, "factor on encoded colours", title, legend=True))
    if curves["gains"] is not None:
        lines = _lines(record["times"], curves["gains"], curves["true_gains"])
        charts.append(Chart(lines, "frame", "gain on encoded colours", "Gain", legend=True))
    if curves["response"] is not None:
        lines = _lines(curves["colors"], _rows(curves["response"]), _rows(curves["true_response"]))
        charts.append(Chart(lines, "colour before the response", "pixel value", "Camera response", legend=True))
    return charts


def _rows(curve: Sequence[float] | None) -> list[list[float]]:
    """A curve that all colours share."""
    return [] if curve is None else [[value] for value in curve]


def _numbers(values: Any) -> str:
    return ", ".join(f"{value:.3g}" for value in (values if isinstance(values, list) else [values]))


def _lines(
    x: Sequence[float], learned: Sequence[Sequence[float]], true: Sequence[Sequence[float]] | None
) -> list[Series]:
    """Learned and true curves; a row of values for each x."""
    lines = []
    for rows, kind, dashes in ((learned, "learned", 0), (true, "true", COLORS)):
        if rows:
            styles = _STYLES if len(rows[0]) == len(_STYLES) else {"all colours": _STYLE_OF_ALL}
            lines += [
                Series(f"{kind}, {name}", style + dashes, list(x), list(column))
                for column, (name, style) in zip(zip(*rows, strict=True), styles.items(), strict=True)
            ]
    return lines
