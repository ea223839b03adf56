import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from coliags_plugin.config import registry
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.ssim import ssim


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(30, 41, 3, generator=generator)
    return (truth + 0.1 * torch.randn(30, 41, 3, generator=generator)).clamp(0, 1), truth


@pytest.fixture
def mask():
    return torch.rand(30, 41, generator=torch.Generator().manual_seed(1)) < 0.7


def test_psnr_against_scikit_image(make, images, pair):
    a, b = pair
    expected = peak_signal_noise_ratio(b.double().numpy(), a.double().numpy(), data_range=1.0)
    assert make("psnr")(images(a, b)) == pytest.approx(expected, abs=1e-9)


def test_psnr_of_a_known_error(make, images):
    black = torch.zeros(4, 4, 3)
    assert make("psnr")(images(black, black + 0.1)) == pytest.approx(20.0, abs=1e-5)


def test_psnr_pools_the_channels_before_the_logarithm(make, images):
    truth = torch.zeros(2, 2, 3)
    rendered = truth.clone()
    rendered[..., 0] = 0.3
    assert make("psnr")(images(rendered, truth)) == pytest.approx(-10 * math.log10(0.09 / 3), abs=1e-6)


def test_ssim_is_the_masked_flavour_in_double_precision(make, images, pair, mask):
    a, b = pair
    assert make("ssim")(images(a, b, mask)) == ssim(a.double(), b.double(), mask).item()
    assert make("ssim")(images(b, b, mask)) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", ["psnr", "ssim"])
def test_ignored_pixels_do_not_change_a_metric(name, make, images, pair, mask):
    a, b = pair
    hidden = a.clone()
    hidden[~mask] = torch.nan
    assert make(name)(images(hidden, b, mask)) == make(name)(images(a, b, mask))
    assert make(name)(images(a, b, torch.ones_like(mask))) != make(name)(images(a, b, mask))


@pytest.mark.parametrize("name", ["psnr", "ssim", "lpips"])
def test_metrics_of_no_pixel_or_of_a_render_that_is_not_finite_are_unavailable(name, make, images, pair, mask):
    a, b = pair
    with pytest.raises(UnavailableError, match="the mask leaves no pixel"):
        make(name)(images(a, b, torch.zeros_like(mask)))
    a[3, 4, 1] = torch.nan
    with pytest.raises(UnavailableError, match="not finite at 1 pixels"):
        make(name)(images(a, b))


def test_identical_images_have_no_psnr(make, images, pair):
    with pytest.raises(UnavailableError, match="images are identical"):
        make("psnr")(images(pair[1], pair[1]))


def test_every_metric_says_its_direction_and_unit():
    said = {name: (registry.metrics.get(name).higher_is_better, registry.metrics.get(name).unit) for name in (
        "psnr", "ssim", "lpips", "depth_mse", "depth_mse_inner", "depth_rmse", "depth_mae", "depth_median_error",
        "depth_abs_rel",
    )}  # fmt: skip
    assert said == {
        "psnr": (True, "dB"), "ssim": (True, ""), "lpips": (False, ""), "depth_mse": (False, "mm^2"),
        "depth_mse_inner": (False, "mm^2"), "depth_rmse": (False, "mm"), "depth_mae": (False, "mm"),
        "depth_median_error": (False, "mm"), "depth_abs_rel": (False, ""),
    }  # fmt: skip
