"""Metrics of images, of depth maps, and of depth at single points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.optimize import minimize_scalar
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio

from coliags_plugin.contracts import Comparison
from coliags_plugin.core import registry
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.core.ssim import ssim
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.metrics.pixels import depth_steps, dilated
from tests.losses.terms import make_output
from tests.metrics.made import depths, images, make
from tests.scenes import plain_frame as make_frame


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(30, 41, 3, generator=generator)
    return (truth + 0.1 * torch.randn(30, 41, 3, generator=generator)).clamp(0, 1), truth


@pytest.fixture
def mask():
    return torch.rand(30, 41, generator=torch.Generator().manual_seed(1)) < 0.7


def test_psnr_against_scikit_image(pair):
    a, b = pair
    expected = peak_signal_noise_ratio(b.double().numpy(), a.double().numpy(), data_range=1.0)
    assert make("psnr")(images(a, b)) == pytest.approx(expected, abs=1e-9)


def test_psnr_with_a_fitted_gain_is_that_of_the_best_factor(pair, mask):
    """The best factor is searched for, and scikit-image scores it."""
    a, b = (image[mask].double().numpy() for image in pair)

    def negative(gain):
        return -peak_signal_noise_ratio(b, gain * a, data_range=1.0)

    best = minimize_scalar(negative, bounds=(0.0, 3.0), method="bounded", options={"xatol": 1e-9})
    assert make("psnr_gain_fitted")(images(*pair, mask)) == pytest.approx(-best.fun, abs=1e-9)
    black = images(torch.zeros_like(pair[0]), pair[1])
    assert make("psnr_gain_fitted")(black) == make("psnr")(black)


def test_ssim_is_the_masked_flavour_in_double_precision(pair, mask):
    a, b = pair
    assert make("ssim")(images(a, b, mask)) == ssim(a.double(), b.double(), mask).item()
    assert make("ssim")(images(b, b, mask)) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", ["psnr", "psnr_gain_fitted", "ssim"])
def test_ignored_pixels_do_not_change_a_metric(name, pair, mask):
    a, b = pair
    hidden = a.clone()
    hidden[~mask] = torch.nan
    assert make(name)(images(hidden, b, mask)) == make(name)(images(a, b, mask))
    assert make(name)(images(a, b, torch.ones_like(mask))) != make(name)(images(a, b, mask))


@pytest.mark.parametrize("name", ["psnr", "psnr_gain_fitted", "ssim", "lpips"])
def test_metrics_of_no_pixel_or_of_a_render_that_is_not_finite_are_unavailable(name, pair, mask):
    a, b = pair
    with pytest.raises(UnavailableError, match="the mask leaves no pixel"):
        make(name)(images(a, b, torch.zeros_like(mask)))
    a[3, 4, 1] = torch.nan
    with pytest.raises(UnavailableError, match="not finite at 1 pixels"):
        make(name)(images(a, b))


@pytest.mark.parametrize("name", ["psnr", "psnr_gain_fitted"])
def test_identical_images_have_no_psnr(name, pair):
    with pytest.raises(UnavailableError, match="images are identical"):
        make(name)(images(pair[1], pair[1]))


# Depth


ALL = ["depth_mse", "depth_mse_inner", "depth_rmse", "depth_mae", "depth_median_error", "depth_abs_rel"]


@pytest.fixture
def truth():
    return 20 + 0.5 * torch.rand(25, 30, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def errors():
    return torch.randn(25, 30, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("columns", [29, 30])
def test_against_numpy_and_scikit_image(columns, truth, errors):
    """The median is of an odd and of an even number of pixels."""
    truth, rendered = truth[:, :columns], (truth + errors)[:, :columns]
    case = depths(rendered, truth)
    a, b = rendered.double().numpy(), truth.double().numpy()
    assert make("depth_mse")(case) == pytest.approx(mean_squared_error(b, a), rel=1e-12)
    assert make("depth_rmse")(case) == pytest.approx(np.sqrt(mean_squared_error(b, a)), rel=1e-12)
    assert make("depth_mae")(case) == pytest.approx(np.mean(np.abs(a - b)), rel=1e-12)
    assert make("depth_median_error")(case) == pytest.approx(np.median(np.abs(a - b)), rel=1e-12)
    assert make("depth_abs_rel")(case) == pytest.approx(np.mean(np.abs(a - b) / b), rel=1e-12)


@pytest.mark.parametrize("name", ALL)
def test_only_valid_pixels_enter(name, truth, errors):
    counts = torch.rand(25, 30, generator=torch.Generator().manual_seed(2)) < 0.5
    rendered, unknown = truth + errors, truth.clone()
    broken = rendered.clone()
    unknown[~counts], broken[~counts] = torch.nan, torch.inf
    assert make(name)(depths(broken, unknown, counts)) == make(name)(depths(rendered, truth, counts))


@pytest.mark.parametrize("name", ALL)
def test_unavailable_depth_metrics_give_the_reason(name, truth):
    with pytest.raises(UnavailableError, match="this frame has no ground-truth depth"):
        make(name)(images(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3)))
    with pytest.raises(UnavailableError, match="no pixel of this frame has a valid ground-truth depth"):
        make(name)(depths(truth, torch.full_like(truth, torch.nan)))
    broken = truth.clone()
    broken[10, 10] = torch.inf
    with pytest.raises(UnavailableError, match="not finite at 1 pixels"):
        make(name)(depths(broken, truth))


def test_relative_error_of_a_depth_of_zero():
    with pytest.raises(UnavailableError, match="0 mm"):
        make("depth_abs_rel")(depths(torch.ones(2, 2), torch.zeros(2, 2)))


# ------------------------------------------------------------------------------------------------------ inner pixels


def test_a_step_marks_both_sides_and_the_margin_two_more():
    truth = torch.full((9, 20), 20.0)
    truth[:, 10:] = 30.0
    rendered = truth.clone()
    rendered[:, 7:13] += 100.0
    assert make("depth_mse_inner")(depths(rendered, truth)) == 0.0
    rendered[:, 6] += 1.0
    assert make("depth_mse_inner")(depths(rendered, truth)) == pytest.approx(1 / 14)


def test_inner_mse_is_unavailable_where_every_pixel_is_near_a_step():
    board = 20 + 10 * ((torch.arange(8)[:, None] + torch.arange(8)) % 2).float()
    with pytest.raises(UnavailableError, match="near depth steps"):
        make("depth_mse_inner")(depths(board, board))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), step=st.floats(0.02, 0.5), reach=st.integers(0, 3))
def test_steps_and_margin_against_scipy(seed, step, reach):
    generator = torch.Generator().manual_seed(seed)
    depth = 20 + 5 * torch.rand(11, 13, generator=generator, dtype=torch.float64)
    has_depth = torch.rand(11, 13, generator=generator) < 0.8
    far = maximum_filter(np.where(has_depth, depth, -np.inf), 3, mode="constant", cval=-np.inf)
    close = minimum_filter(np.where(has_depth, depth, np.inf), 3, mode="constant", cval=np.inf)
    expected = far - close > step * close
    steps = depth_steps(torch.where(has_depth, depth, torch.nan), has_depth, step)
    np.testing.assert_array_equal(steps.numpy(), expected)
    grown = maximum_filter(expected.astype(np.uint8), 2 * reach + 1, mode="constant")
    np.testing.assert_array_equal(dilated(steps, reach).numpy(), grown > 0)


# Depth at single points, and estimated depth, under the protocols


HEIGHT, WIDTH = 6, 8


@pytest.fixture
def frame():
    return make_frame(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8))


@pytest.fixture
def output():
    plane = 20 + torch.arange(WIDTH, dtype=torch.float32).expand(HEIGHT, WIDTH)  # z = 19.5 + column
    rgb = torch.full((HEIGHT, WIDTH, 3), 0.5)
    return make_output(rgb, depth_accumulated=plane, inverse_depth_accumulated=1 / plane)


@pytest.mark.parametrize("quantile", [0.0, 0.5, 0.9, 1.0])
def test_it_is_a_quantile_of_the_relative_errors(quantile):
    generator = torch.Generator().manual_seed(0)
    rendered, has_depth = 10 + 20 * torch.rand(2, 101, generator=generator)
    grey, valid = torch.zeros(1, 1, 3), torch.ones(1, 1, dtype=torch.bool)
    found = make("sparse_depth", quantile=quantile)(
        Comparison(grey, grey, valid, point_depth=rendered, true_point_depth=has_depth)
    )
    expected = np.quantile(np.abs(rendered.numpy() - has_depth.numpy()) / has_depth.numpy(), quantile)
    assert found == pytest.approx(100 * expected, rel=1e-5)


def test_a_protocol_interpolates_at_usable_points(frame, output):
    pixels = torch.tensor([[1.25, 2.5], [4.0, 3.0], [7.5, 5.5], [0.5, 0.5], [3.5, 0.5]])
    has_depth = torch.tensor([20.75 / 1.1, 23.5 / 0.8, 27.0, 20.0, 0.0])  # errors of 10 %, 20 %, 0; ignored; no surface
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[0, 0] = False
    at = replace(frame.with_maps(mask=mask), sparse_depth=SparseDepth(pixels, has_depth))
    comparison = registry.protocols.get("paper")().compare(output, at)
    torch.testing.assert_close(comparison.point_depth, torch.tensor([20.75, 23.5, 27.0]))
    scores = Scorer("paper").score(comparison)
    assert scores.values["sparse_depth_median"] == pytest.approx(10.0, rel=1e-5)
    assert scores.values["sparse_depth_p90"] == pytest.approx(18.0, rel=1e-5)
    assert scores.reasons["depth_mse"] == "this frame has no ground-truth depth"


def test_without_points_or_without_anything_drawn_it_is_unavailable(frame, output):
    scorer, protocol = Scorer("paper"), registry.protocols.get("paper")()
    reasons = scorer.score(protocol.compare(output, frame)).reasons
    assert reasons["sparse_depth_median"] == "this frame has no points of known depth"
    points = SparseDepth(torch.tensor([[2.0, 2.0]]), torch.tensor([20.0]))
    empty = replace(output, alpha=torch.zeros(HEIGHT, WIDTH))
    reasons = scorer.score(protocol.compare(empty, replace(frame, sparse_depth=points))).reasons
    assert reasons["sparse_depth_p90"] == "nothing was drawn at the points of known depth"


@pytest.mark.parametrize("name", ["paper", "authors-code"])
def test_estimated_depth_is_no_truth(name, frame, output):
    depth = torch.full((HEIGHT, WIDTH), 21.0)
    estimated = frame.with_maps(depth=depth, depth_confidence=torch.ones(HEIGHT, WIDTH))
    comparison = registry.protocols.get(name)().compare(output, estimated)
    assert comparison.estimated
    assert comparison.depth is comparison.true_depth is comparison.depth_valid is None
    with pytest.raises(UnavailableError, match="estimated depth is no truth"):
        make("depth_mse")(comparison)
    assert (
        "depth_mse"
        in Scorer(name).score(registry.protocols.get(name)().compare(output, frame.with_maps(depth=depth))).values
    )
