import math
import re
import xml.etree.ElementTree as ET

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coliags_plugin.reporting.colormaps import color_table
from coliags_plugin.reporting.html_page import html_blocks, style_classes
from coliags_plugin.reporting.model import Chart, ColorBar, Figures, Series
from coliags_plugin.reporting.numbers import linear_ticks, log_ticks, round_up, tick_label


def line_chart(*arguments, **options):
    page = html_blocks([Figures([Chart(*arguments, **options)])])
    return "".join(re.findall("(?s)<svg.*</svg>", page))


def texts(svg):
    return ["".join(element.itertext()) for element in ET.fromstring(svg).iter("text")]


def points(path):
    return [tuple(map(float, pair.split())) for pair in re.split("[ML]", path.get("d"))[1:]]


def lines(svg):
    return [element for element in ET.fromstring(svg).iter("path") if element.get("class") == "line"]


def test_lines_are_drawn_to_scale_within_labelled_axes():
    series = Series("<b> & co", 0, [0, 1, 2], [5.0, 6.0, 8.0])
    svg = line_chart([series], "step", "PSNR [dB]", x_names=["a", "b", "c"])
    assert {"step", "PSNR [dB]", "a", "b", "c"} <= set(texts(svg))
    assert "&lt;b&gt; &amp; co" in svg and "http" not in svg
    (line,) = lines(svg)
    (x0, y0), (x1, y1), (x2, y2) = points(line)
    width, height = map(float, ET.fromstring(svg).get("viewBox").split()[2:])
    assert 0 <= x0 < x1 < x2 <= width and height >= y0 > y1 > y2 >= 0
    assert y0 - y1 == pytest.approx((y1 - y2) / 2, abs=0.2)
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2)
    (line,) = lines(line_chart([Series("a", 0, [1, 2, 3], [0.01, 0.1, 1.0])], "x", "y", log_y=True))
    (_, y0), (_, y1), (_, y2) = points(line)
    assert y0 - y1 == pytest.approx(y1 - y2, abs=0.2)


@pytest.mark.parametrize("far", [2.0, 40.0])
def test_a_unit_is_as_long_on_both_axes_where_the_scales_are_equal(far):
    (line,) = lines(line_chart([Series("path", 0, [0.0, 3.0], [0.0, far])], "x, mm", "y, mm", equal_scales=True))
    (x0, y0), (x1, y1) = points(line)
    assert (x1 - x0) / 3.0 == pytest.approx((y0 - y1) / far, rel=0.01) and min(x0, y1) >= 0.0


def test_gaps_interrupt_the_line():
    svg = line_chart([Series("a", 0, [1, 2, 3, 4, 5], [1.0, 2.0, math.nan, 3.0, 4.0])], "x", "y")
    assert [len(points(line)) for line in lines(svg)] == [2, 2]
    log = line_chart([Series("a", 0, [1, 2, 3], [1.0, 0.0, 2.0])], "x", "y", log_y=True)
    assert len(lines(log)) == 2


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("y", [[], [math.nan], [2.0], [2.0, 2.0]])
def test_few_values(log, y):
    svg = line_chart([Series("a", 0, list(range(len(y))), y)] if y else [], "x", "y", log_y=log)
    assert "nan" not in svg
    assert len(texts(svg)) > 3 if 2.0 in y else svg == ""


def test_many_names_are_thinned_but_every_point_tells_its_own():
    names = [f"frame_{index:04d}" for index in range(60)]
    svg = line_chart(
        [Series("m", 0, list(range(60)), [1.0 + i for i in range(60)])], "frame", "y", x_names=names, markers=True
    )
    assert 2 <= sum(text in names for text in texts(svg)) <= 10
    assert "m, frame_0059: 60" in svg


def test_styles_repeat_with_dashes():
    assert [style_classes(index) for index in (0, 7, 8, 17)] == ["s0", "s7", "s0 dash1", "s1 dash2"]


def test_color_bar():
    svg = html_blocks([ColorBar((0.0, 5.0), "mm", "error", "|depth error|", "scale")])
    assert texts(svg) == ["|depth error| [mm]", "0", "0.25", "1", "2.5", "5"]
    stops = [element.get("stop-color") for element in ET.fromstring(svg).iter("stop")]
    table = color_table("error")
    assert stops[0] == "#" + bytes(table[0]).hex()
    assert stops[-1] == "#" + bytes(table[255]).hex()


@given(st.floats(1e-9, 1e9))
@settings(max_examples=50)
@example(0.2)
@example(0.3)
def test_round_up_is_the_smallest_of_its_kind(value):
    rounded = round_up(value)
    digit = rounded / 10.0 ** math.floor(math.log10(rounded) + 1e-9)
    assert min(abs(digit - d) for d in (1.0, 2.0, 5.0, 10.0)) < 1e-6
    assert value <= rounded * (1 + 1e-8)
    assert rounded < value * 2.5 * (1 + 1e-8)


def test_ticks():
    assert linear_ticks(0.0, 5.0) == [0, 1, 2, 3, 4, 5]
    assert linear_ticks(0.0, 2.0) == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert [tick_label(t) for t in linear_ticks(0.0, 1.0)] == ["0", "0.2", "0.4", "0.6", "0.8", "1"]
    assert linear_ticks(-3.0, 3.0) == [-2, 0, 2]
    assert log_ticks(0.015, 0.3) == pytest.approx([0.02, 0.05, 0.1, 0.2])
    assert log_ticks(1e-4, 1.0) == pytest.approx([1e-4, 1e-3, 1e-2, 1e-1, 1.0])
    assert [tick_label(value) for value in (0.0, -0.0, 30000.0, 0.05)] == ["0", "0", "30000", "0.05"]


@given(st.floats(-1e5, 1e5), st.floats(1e-3, 1e5))
@settings(max_examples=50)
def test_linear_ticks_lie_inside_and_are_few(low, length):
    ticks = linear_ticks(low, low + length)
    slack = 1e-6 * length
    assert len(ticks) <= 6
    assert all(low - slack <= tick <= low + length + slack for tick in ticks)
