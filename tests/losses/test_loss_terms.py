import math
from typing import get_args

import pytest
import torch
from pydantic import ValidationError

from coliags_plugin.config import registry
from coliags_plugin.contracts import LossSettings, log_linear
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import DEPTH_KINDS
from coliags_plugin.core.ssim import ssim
from coliags_plugin.losses.depth import DepthKind
from tests.losses.terms import make

HEIGHT, WIDTH = 14, 17


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def image(generator):
    return torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)


@pytest.fixture
def rgb(generator):
    return torch.rand(HEIGHT, WIDTH, 3, generator=generator).requires_grad_()


@pytest.fixture
def depth(generator):
    return 20 + 10 * torch.rand(HEIGHT, WIDTH, generator=generator)


# ---------------------------------------------------------------------------------------------------- all terms alike


@pytest.mark.parametrize("name", ["l1", "mse", "d-ssim", "depth-l1", "estimated-depth", "opacity", "scale-volume"])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, None])
def test_a_finite_scalar_with_a_graph_whatever_the_mask(
    name, share, make_output, make_frame, generator, image, rgb, depth
):
    mask = None if share is None else torch.rand(HEIGHT, WIDTH, generator=generator) < share
    with torch.no_grad():
        if mask is not None:
            rgb[~mask] = torch.nan
            depth[~mask] = torch.inf
    drawn = {kind: (depth + 1).requires_grad_() for kind in ("alpha", *DEPTH_KINDS)}
    scales = torch.rand(5, 3, generator=generator).requires_grad_()
    term = make(name)(make_output(rgb, scales, **drawn), make_frame(image, depth, mask))
    assert term.shape == ()
    assert term.isfinite()
    term.backward()
    for tensor in (rgb, scales, *drawn.values()):
        assert tensor.grad is None or tensor.grad.isfinite().all()
    if share == 0.0 and name != "scale-volume":
        assert term.item() == 0.0


@pytest.mark.parametrize("name", ["l1", "mse", "d-ssim", "estimated-depth", "opacity"])
def test_ignored_pixels_get_no_gradient_and_a_full_mask_changes_nothing(
    name, make_output, make_frame, generator, image, rgb, depth
):
    mask = torch.rand(HEIGHT, WIDTH, generator=generator) < 0.6
    drawn = {kind: torch.rand(HEIGHT, WIDTH, generator=generator).requires_grad_() for kind in ("alpha", *DEPTH_KINDS)}
    output = make_output(rgb, **drawn)
    make(name)(output, make_frame(image, depth, mask)).backward()
    grads = [tensor.grad for tensor in (rgb, *drawn.values()) if tensor.grad is not None]
    assert not any(grad[~mask].any() for grad in grads)
    assert any(grad[mask].any() for grad in grads)
    full = make(name)(output, make_frame(image, depth, torch.ones_like(mask)))
    assert torch.equal(full, make(name)(output, make_frame(image, depth)))


def test_double_precision_stays_double(make_output, make_frame, image, rgb, depth):
    output = make_output(rgb.double(), torch.ones(2, 3).double(), depth_accumulated=depth.double())
    for name in ("l1", "mse", "d-ssim", "depth-l1", "estimated-depth", "scale-volume"):
        assert make(name)(output, make_frame(image, depth)).dtype == torch.float64


def test_only_the_depth_term_needs_depth_and_another_output():
    for name in ("l1", "mse", "d-ssim", "opacity", "scale-volume"):
        assert make(name).loss.needs == make(name).loss.wants == frozenset()
    assert make("depth-l1").loss.needs == {"depth"}
    assert make("depth-l1").loss.wants == {"depth_accumulated"}
    assert make("depth-l1", depth="depth_median").loss.wants == {"depth_median"}


# -------------------------------------------------------------------------------------------------------- photometric


def test_l1_is_the_mean_over_valid_pixels_and_channels(make_output, make_frame):
    image = torch.zeros(1, 2, 3, dtype=torch.uint8)
    image[0, 0] = torch.tensor([255, 51, 0])
    rgb = torch.zeros(1, 2, 3)
    rgb[0, 1] = 0.5
    assert make("l1")(make_output(rgb), make_frame(image)).item() == pytest.approx((1.0 + 0.2 + 3 * 0.5) / 6)
    mask = torch.tensor([[True, False]])
    assert make("l1")(make_output(rgb), make_frame(image, mask=mask)).item() == pytest.approx((1.0 + 0.2) / 3)


def test_d_ssim_is_one_minus_the_ssim_that_is_reported(make_output, make_frame, generator, image, rgb):
    mask = torch.rand(HEIGHT, WIDTH, generator=generator) < 0.6
    frame = make_frame(image, mask=mask)
    assert make("d-ssim")(make_output(rgb), frame).item() == pytest.approx(
        1 - ssim(rgb, frame.rgb, mask).item(), abs=1e-6
    )
    assert make("d-ssim")(make_output(frame.rgb), frame).item() == pytest.approx(0.0, abs=1e-6)


# -------------------------------------------------------------------------------------------------------------- depth


def test_the_depth_kinds_are_the_renderers():
    assert get_args(DepthKind) == DEPTH_KINDS
    with pytest.raises(ValidationError, match="depth_accumulated"):
        make("depth-l1", depth="depth")


def test_depth_l1_is_the_mean_over_valid_pixels_of_known_depth(make_output, make_frame):
    image = torch.zeros(2, 2, 3, dtype=torch.uint8)
    truth = torch.tensor([[10.0, torch.nan], [30.0, 40.0]])
    drawn = torch.tensor([[11.0, 5.0], [27.0, 99.0]], requires_grad=True)
    mask = torch.tensor([[True, True], [True, False]])
    term = make("depth-l1")(make_output(torch.zeros(2, 2, 3), depth_accumulated=drawn), make_frame(image, truth, mask))
    term.backward()
    assert term.item() == (1.0 + 3.0) / 2
    assert drawn.grad.tolist() == [[0.5, 0.0], [-0.5, 0.0]]


@pytest.mark.parametrize("kind", ["depth_accumulated", "depth_expected", "depth_median"])
def test_each_depth_is_compared_as_it_is(kind, make_output, make_frame, image, depth):
    output = make_output(torch.zeros(HEIGHT, WIDTH, 3), **{kind: depth + 0.25})
    assert make("depth-l1", depth=kind)(output, make_frame(image, depth)).item() == pytest.approx(0.25, abs=1e-5)


def test_inverse_depth_is_inverted_and_emptiness_is_a_constant(make_output, make_frame):
    image = torch.zeros(1, 3, 3, dtype=torch.uint8)
    truth = torch.tensor([[20.0, 30.0, torch.nan]])
    inverse = torch.tensor([[0.04, 0.0, 0.0]], requires_grad=True)
    output = make_output(torch.zeros(1, 3, 3), inverse_depth_accumulated=inverse)
    term = make("depth-l1", depth="inverse_depth_accumulated")(output, make_frame(image, truth))
    term.backward()
    assert term.item() == pytest.approx((5.0 + 70.0) / 2)
    assert inverse.grad[0].tolist() == pytest.approx([-0.5 / 0.04**2, 0.0, 0.0])
    nearer = make("depth-l1", depth="inverse_depth_accumulated", empty_depth=50.0)(output, make_frame(image, truth))
    assert nearer.item() == pytest.approx((5.0 + 20.0) / 2)


def test_a_frame_without_depth_says_how_to_go_on(make_output, make_frame, image, rgb, depth):
    with pytest.raises(InputError, match=r"'0007' has no depth.*--set losses\.depth=null"):
        make("depth-l1")(make_output(rgb, depth_accumulated=depth), make_frame(image))


# ------------------------------------------------------------------------------------------------------- scale volume


def test_scale_volume_is_the_mean_product(make_output, make_frame, image, rgb):
    scales = torch.tensor([[1.0, 2.0, 3.0], [0.5, 0.5, 4.0]])
    assert make("scale-volume")(make_output(rgb, scales), make_frame(image)).item() == (6.0 + 1.0) / 2
    assert make("scale-volume")(make_output(rgb, scales[:, :2]), make_frame(image)).item() == (2.0 + 0.25) / 2


def test_no_gaussians_cost_nothing(make_output, make_frame, image, rgb):
    scales = torch.zeros(0, 3, requires_grad=True)
    term = make("scale-volume")(make_output(rgb, scales), make_frame(image))
    term.backward()
    assert term.item() == 0.0


def test_a_scale_of_zero_keeps_its_gradient_finite(make_output, make_frame, image, rgb):
    scales = torch.tensor([[0.0, 2.0, 3.0]], requires_grad=True)
    make("scale-volume")(make_output(rgb, scales), make_frame(image)).backward()
    assert scales.grad.tolist() == [[6.0, 0.0, 0.0]]


# ----------------------------------------------------------------------------------------------------------- schedule


@pytest.mark.parametrize(
    ("step", "weight"), [(0, 0.2), (1_000, 0.181), (7_000, 0.0994), (15_000, 0.0447), (20_000, 0.0271), (30_000, 0.01)]
)
def test_the_depth_weight_falls_as_in_the_authors_code(step, weight):
    settings = registry.losses.get("depth-l1").Settings(weight=0.2, final_weight=0.01)
    assert settings.weight_at(step, 30_000) == pytest.approx(weight, rel=3e-3)


@pytest.mark.parametrize("weight", [0.8, 0.0])
def test_a_weight_without_an_end_is_constant(weight):
    assert {LossSettings(weight=weight).weight_at(step, 10) for step in (1, 5, 10)} == {weight}


def test_a_weight_falls_no_further_than_its_minimum():
    floored = LossSettings(weight=0.2, final_weight=0.01, min_weight=0.05)
    free = LossSettings(weight=0.2, final_weight=0.01)
    reached = 30_000 * math.log(4) / math.log(20)  # 0.2 * (1 / 20)^u = 0.05
    assert floored.weight_at(int(reached), 30_000) == free.weight_at(int(reached), 30_000) > 0.05
    assert floored.weight_at(int(reached) + 1, 30_000) == floored.weight_at(30_000, 30_000) == 0.05


@pytest.mark.parametrize(("weight", "final"), [(0.2, 0.0), (0.0, 0.01), (0.0, 0.0), (0.2, -0.01)])
def test_a_weight_that_falls_has_both_ends_above_zero(weight, final):
    with pytest.raises(ValidationError, match=rf"final_weight {final} with weight {weight}: a logarithmic schedule"):
        LossSettings(weight=weight, final_weight=final)
    with pytest.raises(ValueError, match="both ends above 0"):
        log_linear(weight, final, 0.5)
