import platform

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.metrics.protocols import through_8_bit, through_16_bit


def one(value):
    return torch.tensor([[value]], dtype=torch.float32)


@pytest.mark.parametrize(
    ("value", "level"),
    [(0.0, 0), (1.0, 255), (-0.2, 0), (1.7, 255), (0.4 / 255, 0), (0.6 / 255, 1), (99.4 / 255, 99), (99.6 / 255, 100)],
)
def test_eight_bits_round_to_the_nearest_level_and_clamp(value, level):
    assert through_8_bit(one(value)).item() == pytest.approx(level / 255, abs=1e-7)


def test_every_eight_bit_level_comes_back_exactly():
    levels = torch.arange(256) / 255
    assert torch.equal(through_8_bit(levels), levels)


def test_nan_is_left_for_the_metrics_to_refuse():
    assert through_8_bit(one(torch.nan)).isnan().all()


@pytest.mark.parametrize("scale", [100.0, 150.0])
def test_sixteen_bits_truncate(scale):
    step = scale / 65535
    assert through_16_bit(one(1000.9 * step), scale).item() == pytest.approx(1000 * step, rel=1e-6)
    assert through_16_bit(one(scale), scale).item() == scale
    assert through_16_bit(one(0.0), scale).item() == 0.0


def test_beyond_full_scale_it_wraps_around():
    """151 mm over 150 is level floor(151 / 150 * 65535) = 65971, of which 16 bits keep 435: 0.9957 mm."""
    assert through_16_bit(one(151.0), 150.0).item() == pytest.approx(435 / 65535 * 150, abs=1e-6)
    assert through_16_bit(one(330.0), 150.0).item() == pytest.approx((144177 - 2 * 65536) / 65535 * 150, abs=1e-6)


@pytest.mark.parametrize("value", [torch.inf, -torch.inf, torch.nan, 1e12])
def test_what_no_integer_holds_becomes_zero(value):
    assert through_16_bit(one(value), 150.0).item() == 0.0


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the cast is undefined in C; x86-64 is meant")
@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 1e7, width=32), min_size=1, max_size=40))
def test_the_cast_is_numpy_s(depths):
    depth = np.array(depths, np.float32)
    with np.errstate(invalid="ignore"):
        stored = (depth / np.float32(150) * np.float32(65535)).astype(np.uint16)
    expected = stored.astype(np.float32) / np.float32(65535) * np.float32(150)
    np.testing.assert_array_equal(through_16_bit(torch.from_numpy(depth), 150.0).numpy(), expected)
