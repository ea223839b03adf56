"""Picture of an atlas: the frames with a pose along the video, by model, and why the others have none."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from coliags_plugin.outputs.axis_ticks import linear_ticks, tick_label
from coliags_plugin.outputs.raster_text import INK, draw_text, text_width
from coliags_plugin.reconstruction.structure.sfm import Atlas

_WIDTH, _LEFT, _RIGHT = 1200, 20, 20
#: Top and bottom row of the ribbon, and height of a line of text, px.
_TOP, _BOTTOM, _LINE = 60, 120, 22
#: Colours of models, distinguishable with any colour vision (Okabe and Ito); paler for every further six.
_MODELS = ((86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167), (240, 228, 66), (0, 114, 178))
_LOST = ((70, 70, 70), (130, 130, 130), (185, 185, 185))


def draw_ribbon(atlas: Atlas) -> UInt8[np.ndarray, "H 1200 3"]:
    """Draw the frames from left to right: colours are models, greys frames without a pose, a notch a weak place."""
    count = len(atlas.images)
    reasons = list(dict.fromkeys(atlas.lost.values()))
    lines = [f"{sum(reason == why for reason in atlas.lost.values())} frames without a pose: {why}" for why in reasons]
    lines += [f"left apart after frame {link.after}: {link.reason}" for link in atlas.refused]
    image = np.full((_BOTTOM + 60 + _LINE * len(lines), _WIDTH, 3), 255, np.uint8)
    scale = (_WIDTH - _LEFT - _RIGHT) / count

    def column(frame: float) -> int:
        return round(_LEFT + frame * scale)

    posed = count - len(atlas.lost)
    title = f"{posed} of {count} frames posed ({100.0 * posed / count:.0f} %), {len(atlas.models)} models"
    draw_text(image, title, (_LEFT, 28), 0.6)
    for number, model in enumerate(atlas.models):
        for frame in model.registered:
            image[_TOP:_BOTTOM, column(frame) : max(column(frame + 1), column(frame) + 1)] = _color(number)
        for link in model.links:
            image[_TOP : _TOP + 12, column(link.after + 1) - 1 : column(link.after + 1) + 1] = INK
        label, middle = str(len(model.registered)), (model.registered[0] + model.registered[-1] + 1) / 2.0
        if text_width(label) < scale * len(model.registered):
            draw_text(image, label, (column(middle), (_TOP + _BOTTOM) // 2 + 5), align=0.5)
    for frame, reason in atlas.lost.items():
        color = _LOST[min(reasons.index(reason), len(_LOST) - 1)]
        image[_TOP + 18 : _BOTTOM, column(frame) : max(column(frame + 1), column(frame) + 1)] = color
    for tick in linear_ticks(0.0, float(count)):
        image[_BOTTOM : _BOTTOM + 6, column(tick) : column(tick) + 1] = INK
        draw_text(image, tick_label(tick), (column(tick), _BOTTOM + 22), align=0.5)
    draw_text(image, "frame", (_WIDTH - _RIGHT, _BOTTOM + 40), align=1.0)
    for row, line in enumerate(lines):
        top = _BOTTOM + 48 + _LINE * row
        if row < len(reasons):
            image[top - 10 : top + 2, _LEFT : _LEFT + 12] = _LOST[min(row, len(_LOST) - 1)]
        draw_text(image, line, (_LEFT + 20, top))
    return image


def _color(model: int) -> tuple[int, int, int]:
    strength = 0.5 ** (model // len(_MODELS))
    red, green, blue = (round(255 - strength * (255 - value)) for value in _MODELS[model % len(_MODELS)])
    return red, green, blue
