import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coliags_plugin.outputs.axis_ticks import linear_ticks, log_ticks, round_up, tick_label


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


def test_linear_ticks():
    assert linear_ticks(0.0, 5.0) == [0, 1, 2, 3, 4, 5]
    assert linear_ticks(0.0, 2.0) == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert [tick_label(t) for t in linear_ticks(0.0, 1.0)] == ["0", "0.2", "0.4", "0.6", "0.8", "1"]
    assert linear_ticks(-3.0, 3.0) == [-2, 0, 2]


@given(st.floats(-1e5, 1e5), st.floats(1e-3, 1e5))
@settings(max_examples=50)
def test_linear_ticks_lie_inside_and_are_few(low, length):
    ticks = linear_ticks(low, low + length)
    slack = 1e-6 * length
    assert len(ticks) <= 6
    assert all(low - slack <= tick <= low + length + slack for tick in ticks)


def test_log_ticks_and_labels():
    assert log_ticks(0.015, 0.3) == pytest.approx([0.02, 0.05, 0.1, 0.2])
    assert log_ticks(1e-4, 1.0) == pytest.approx([1e-4, 1e-3, 1e-2, 1e-1, 1.0])
    assert [tick_label(value) for value in (0.0, -0.0, 30000.0, 0.05)] == ["0", "0", "30000", "0.05"]
