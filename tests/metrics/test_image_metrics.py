import pytest
import torch
from scipy.optimize import minimize_scalar
from skimage.metrics import peak_signal_noise_ratio

from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.ssim import ssim
from tests.metrics.made import images, make


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
