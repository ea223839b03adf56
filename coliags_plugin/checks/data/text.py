"""Text of the check results, for the terminal and the HTML page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from coliags_plugin.checks.data.check import SceneCheck
from coliags_plugin.outputs.text_table import aligned

#: Cell of an unavailable value.
_NONE = "-"


def fact_rows(check: SceneCheck) -> Iterator[tuple[str, str]]:
    """Names and values of the scene's statistics, the most important first."""
    scene = check.scene
    data = scene.provenance
    camera = scene.train[0].camera
    counts = {"train": len(scene.train), **{name: len(frames) for name, frames in scene.test_sets.items()}}
    yield "format", str(data.get("dataset", "unknown")) + _in_brackets(data.get("layout"))
    yield "frames", ", ".join(f"{count} {name}" for name, count in counts.items())
    yield "split", str(data.get("split", {}).get("name", "unknown"))
    stored = data.get("stored_size")
    yield (
        "image size",
        f"{camera.width} x {camera.height} px" + (f", stored {stored[0]} x {stored[1]}" if stored else ""),
    )
    yield "lens", str(data["lens"]) if data.get("lens") else "pinhole images"
    angle = 2.0 * math.degrees(math.atan(0.5 * camera.width / camera.fx))
    yield (
        "calibration",
        f"f {camera.fx:.2f}, {camera.fy:.2f}, centre {camera.cx:.2f}, {camera.cy:.2f} px, {angle:.1f} degrees across",
    )
    yield "pose convention", _convention(data.get("pose_convention"))
    unit = data.get("unit", "mm")
    yield "unit of length", str(unit)
    if check.depth is not None:
        depth, mm = check.depth, " mm" if unit == "mm" else ""
        yield (
            "depth",
            f"median {depth.median:.4g}, 1 % to 99 %: {depth.nearest:.4g} to {depth.farthest:.4g}{mm}; "
            f"{depth.invalid_share:.1%} unknown, of which {depth.clipped_share:.1%} clipped",
        )
    else:
        yield "depth", "none"
    if check.path is not None:
        path = check.path
        yield (
            "trajectory",
            f"{path.length:.4g} long, steps {path.mean_step:.3g} (largest {path.largest_step:.3g} to "
            f"{path.largest_step_at}), turns {path.turn:.3g} degrees in all",
        )
    images = check.images
    yield (
        "brightness",
        f"mean {images.mean:.0f} of 255, frames {images.darkest_frame:.0f} to {images.brightest_frame:.0f}, "
        f"{images.overexposed_share:.1%} white, {images.masked_share:.1%} masked",
    )
    if check.lamp is not None:
        lamp = check.lamp
        yield (
            "brightness and distance",
            f"rank correlation {lamp.correlation:.2f} (median of {lamp.frames} frames); below 0, the near is brighter",
        )
    yield "initial points", f"{len(scene.points)} from {data.get('points', {}).get('source', 'unknown')}"


def reading_rows(check: SceneCheck) -> tuple[list[str], list[list[str]]]:
    """Heading and rows of the table of pose hypotheses; no rows where nothing could be compared."""
    if check.agreement:
        head = [
            "poses read as",
            "depth error, %",
            "depth error, mm",
            "colour error, grey levels",
            "projects into the image, %",
        ]
        rows = [
            [
                name,
                _number(found.depth_error, 100.0),
                _number(found.depth_error_mm),
                _number(found.color_error),
                _number(found.share, 100.0),
            ]
            for name, found in check.agreement.items()
        ]
        if check.scale is not None:
            rows.append(
                [
                    f"given, depth times {check.scale.factor:.3g}",
                    _number(check.scale.depth_error, 100.0),
                    _NONE,
                    _NONE,
                    _NONE,
                ]
            )
        return head, rows
    head = [
        "poses read as",
        "distance from the epipolar line, px",
        "in front of both cameras, %",
        "parallax, px",
        "matches",
    ]
    return head, [
        [name, _number(found.error), _number(found.in_front, 100.0), _number(found.parallax), str(found.count)]
        for name, found in check.matches.items()
    ]


def lines(check: SceneCheck) -> Iterator[str]:
    """All results as lines for the terminal."""
    yield from aligned([list(row) for row in fact_rows(check)])
    head, rows = reading_rows(check)
    if rows:
        yield ""
        yield from aligned([head, *rows])
    yield ""
    for finding in check.findings:
        yield f"SUSPECT {finding.what}: {finding.evidence}. {finding.do}."
    for doubt in check.undecided:
        yield f"UNDECIDED {doubt.what}: {doubt.evidence}. {doubt.do}."
    if not check.findings:
        yield "nothing suspect"


def _number(value: float | None, factor: float = 1.0) -> str:
    return _NONE if value is None else f"{value * factor:.3g}"


def _convention(facts: Any) -> str:
    if not isinstance(facts, dict):
        return str(facts) if facts else "not stated"
    words = [value for value in facts.values() if isinstance(value, str)]
    numbers = [f"{key.replace('_', ' ')} {value:.3g}" for key, value in facts.items() if isinstance(value, float)]
    return "; ".join([*words, ", ".join(numbers)] if numbers else words) or "not stated"


def _in_brackets(value: Any) -> str:
    return f" ({value} layout)" if value else ""
