import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.ssim import _blur_by_kornia, _blur_by_opencv, _window, ssim, ssim_map

few = settings(max_examples=15, deadline=None)


def images(height, width, seed=0, dtype=torch.float64, channels=3):
    """A smooth image and a disturbed copy of it."""
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(height, width, channels, dtype=dtype, generator=generator)
    rendered = (truth + 0.2 * torch.randn(height, width, channels, dtype=dtype, generator=generator)).clamp(0, 1)
    return rendered, truth


def window():
    weights = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    return weights / weights.sum()


@pytest.mark.parametrize("with_mask", [False, True])
def test_gradients(with_mask):
    a, b = images(4, 7, channels=2)
    mask = torch.rand(4, 7, generator=torch.Generator().manual_seed(1)) < 0.7 if with_mask else None
    a.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: ssim(x, b, mask), a)
    assert torch.autograd.gradgradcheck(lambda x: ssim(x, b, mask), a, fast_mode=True)
    b.requires_grad_()
    assert torch.autograd.gradcheck(lambda y: ssim(a.detach(), y, mask), b)


def brute_force(a, b, mask):
    """Wang et al. 2004 at valid pixels: moments over the window's valid ones, weighted to its total in the image."""
    height, width = mask.shape
    total = []
    weights = np.outer(window(), window())
    for i, j in zip(*np.nonzero(mask), strict=True):
        rows, columns = slice(max(i - 5, 0), i + 6), slice(max(j - 5, 0), j + 6)
        inside = weights[rows.start - i + 5 : rows.start - i + 5 + len(range(height)[rows])]
        inside = inside[:, columns.start - j + 5 : columns.start - j + 5 + len(range(width)[columns])]
        weight = inside * mask[rows, columns]
        weight = (weight * inside.sum() / weight.sum())[..., None]
        x, y = a[rows, columns], b[rows, columns]
        mean_x, mean_y = (weight * x).sum((0, 1)), (weight * y).sum((0, 1))
        variances = (weight * (x * x + y * y)).sum((0, 1)) - mean_x**2 - mean_y**2
        covariance = (weight * x * y).sum((0, 1)) - mean_x * mean_y
        total.append(
            (2 * mean_x * mean_y + 1e-4)
            * (2 * covariance + 9e-4)
            / ((mean_x**2 + mean_y**2 + 1e-4) * (variances + 9e-4))
        )
    return np.array(total)


@few
@given(height=st.integers(1, 36), width=st.integers(1, 20), share=st.floats(0.05, 1.0), seed=st.integers(0, 99))
def test_values_against_brute_force(height, width, share, seed):
    a, b = images(height, width, seed)
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) < share
    mask[0, 0] = True
    expected = brute_force(a.numpy(), b.numpy(), mask.numpy())
    np.testing.assert_allclose(ssim_map(a, b, mask)[mask].numpy(), expected, atol=1e-10)
    assert ssim(a, b, mask).item() == pytest.approx(expected.mean(), abs=1e-10)


@few
@given(share=st.floats(0.05, 0.95), seed=st.integers(0, 99))
def test_ignored_pixels_influence_nothing(share, seed):
    a, b = images(34, 23, seed, torch.float32)
    mask = torch.rand(34, 23, generator=torch.Generator().manual_seed(seed)) < share
    junk_a, junk_b = a.clone(), b.clone()
    junk_a[~mask] = torch.nan
    junk_b[~mask] = 1e6
    a.requires_grad_()
    junk_a.requires_grad_()
    clean, dirty = ssim(a, b, mask), ssim(junk_a, junk_b, mask)
    assert torch.equal(clean, dirty)
    clean.backward()
    dirty.backward()
    assert torch.equal(a.grad, junk_a.grad)
    assert not a.grad[~mask].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_full_mask_is_no_mask_to_the_bit(dtype):
    a, b = images(47, 66, dtype=dtype)
    full = torch.ones(47, 66, dtype=torch.bool)
    assert torch.equal(ssim_map(a, b, full), ssim_map(a, b))
    assert torch.equal(ssim(a, b, full), ssim(a, b))


@pytest.mark.parametrize("size", [(1, 6), (3, 50), (33, 64), (65, 97)])
@pytest.mark.parametrize("with_mask", [False, True])
def test_the_kernels_agree_with_double_precision(size, with_mask):
    """Value and derivative of every window, those beyond the border too, and of rows that are not whole vectors."""
    a, b = images(*size)
    mask = torch.rand(size, generator=torch.Generator().manual_seed(1)) < 0.7 if with_mask else None
    weights = torch.rand(*size, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    maps, gradients = [], []
    for dtype in (torch.float64, torch.float32):
        rendered = a.to(dtype, copy=True).requires_grad_()
        found = ssim_map(rendered, b.to(dtype), mask)
        (found * weights.to(dtype))[... if mask is None else mask].sum().backward()
        maps.append(found.detach().double()[... if mask is None else mask])
        gradients.append(rendered.grad.double())
    torch.testing.assert_close(maps[1], maps[0], rtol=0, atol=2e-5)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=0, atol=1e-4 * float(gradients[0].abs().max()))


def test_the_kernels_give_the_same_bits_on_any_number_of_threads():
    a, b = images(37, 41, dtype=torch.float32)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        rendered = a.clone().requires_grad_()
        found = ssim_map(rendered, b)
        found.square().sum().backward()
        results.append((found, rendered.grad))
    assert all(torch.equal(x, y) for result in results[1:] for x, y in zip(result, results[0], strict=True))


def test_the_kept_weights_survive_a_first_use_in_inference_mode():
    a, b = images(12, 12)
    _window.cache_clear()
    with torch.inference_mode():
        ssim(a, b)
    ssim(a.requires_grad_(), b).backward()
    assert a.grad.isfinite().all()


def test_images_of_different_sizes_are_refused():
    with pytest.raises(ValueError, match=r"\(4, 5, 3\) and \(5, 4, 3\)"):
        ssim(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 30, 9), (40, 33, 3)])
def test_both_blurs_agree(shape, dtype, tolerance):
    image = torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=dtype)
    torch.testing.assert_close(_blur_by_opencv(image), _blur_by_kornia(image), rtol=0, atol=tolerance)
