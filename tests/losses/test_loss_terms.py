import copy
import math
from dataclasses import replace

import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.contracts import LossSettings
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.core.ssim import ssim
from coliags_plugin.engine.model import Model
from coliags_plugin.modules.exposure import FrameGain
from tests.fields.made import make_field
from tests.losses import terms
from tests.losses.terms import make, make_output
from tests.scenes import plain_frame as make_frame
from tests.scenes import wall_scene

HEIGHT, WIDTH = 14, 17


@pytest.fixture
def image():
    return torch.randint(0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8)


@pytest.fixture
def rgb():
    return torch.rand(HEIGHT, WIDTH, 3).requires_grad_()


@pytest.fixture
def depth():
    return 20 + 10 * torch.rand(HEIGHT, WIDTH)


# ---------------------------------------------------------------------------------------------------- all terms alike

LOSSES = {name: registry.losses.get(name) for name in registry.losses}


@pytest.fixture(scope="module")
def model():
    """A model with everything that losses read of one."""
    scene = wall_scene()
    field = make_field("gaussians", scene, normal_neighbours=10)
    return Model(field, None, {"exposure": FrameGain.from_scene(scene, FrameGain.Settings(), torch.Generator())})


@pytest.fixture
def evaluate(model):
    """A loss of any name, where only what it declares is rendered and known: its value, and its inputs.

    Pixels outside the mask have the value ``hidden``; None leaves them as they are.
    """

    def evaluate(name, mask=None, hidden=None, count=5, dtype=torch.float32):
        generator, spoilt = torch.Generator().manual_seed(0), None if hidden is None else ~mask
        # An option without a default names a channel of the Gaussians.
        required = [key for key, field in LOSSES[name].Settings.model_fields.items() if field.is_required()]
        loss = make(name, **{key: "albedo" for key in required if key != "weight"}).loss

        def pixels(kind):
            shape = (HEIGHT, WIDTH, 3) if kind in ("rgb", "normals") else (HEIGHT, WIDTH)
            values = 0.6 + 0.3 * torch.rand(shape, generator=generator)
            if spoilt is not None:
                values[spoilt] = hidden
            return values.to(dtype).requires_grad_()

        drawn = {kind: pixels(kind) for kind in ("rgb", "alpha", *sorted(loss.wants))}
        rows = {name: torch.rand(count, 3, generator=generator) for name in ("scales", "albedo", "diffuse_factor")}
        rows = {name: values.to(dtype).requires_grad_() for name, values in rows.items()}
        image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
        points = SparseDepth(torch.rand(400, 2, generator=generator) * HEIGHT, torch.rand(400, generator=generator) + 1)
        depth = pixels("depth").detach() + 1 if "depth" in loss.needs else None
        frame = make_frame(image, depth, mask)
        frame = replace(frame, sparse_depth=points) if "sparse_depth" in loss.needs else frame
        output = make_output(scales=rows.pop("scales"), **drawn)
        splats = replace(output.splats, gaussians=replace(output.splats.gaussians, features=rows))
        output = replace(output, camera=frame.camera, splats=splats)
        term = loss(terms.step(output, frame.target, copy.deepcopy(model).to(dtype)))
        return term, drawn, output.splats.gaussians

    return evaluate


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_finite_scalar_that_ignored_pixels_do_not_change(name, share, evaluate):
    mask = torch.rand(HEIGHT, WIDTH) < share
    term, drawn, gaussians = evaluate(name, mask, torch.nan)
    assert term.shape == () and term.isfinite()
    assert torch.equal(term, evaluate(name, mask)[0])
    if share == 1.0:
        assert torch.equal(term, evaluate(name)[0])
        assert evaluate(name, dtype=torch.float64)[0].dtype == torch.float64
        assert not LOSSES[name].needs_splats or evaluate(name, count=0)[0].item() == 0.0
    term.backward()
    for rows in (gaussians.scales, *gaussians.features.values()):
        assert rows.grad is None or rows.grad.isfinite().all()
    gradients = [values.grad for values in drawn.values() if values.grad is not None]
    assert all(gradient.isfinite().all() and not gradient[~mask].any() for gradient in gradients)
    if gradients:
        assert any(gradient.any() for gradient in gradients) == (share > 0.0)
        assert share > 0.0 or term.item() == 0.0


@pytest.mark.parametrize("name", [name for name, loss in LOSSES.items() if "depth" in loss.needs])
def test_a_frame_without_depth_says_how_to_go_on(name, image, rgb, depth):
    loss = make(name)
    output = make_output(rgb, **dict.fromkeys(loss.loss.wants, depth))
    with pytest.raises(InputError, match=r"'0007' has no depth.*`losses\.depth=null`"):
        loss(output, make_frame(image))


# -------------------------------------------------------------------------------------------------------- photometric


def test_l1_and_the_mean_square_of_either_image_are_means_over_valid_pixels_and_channels():
    image = torch.zeros(1, 2, 3, dtype=torch.uint8)
    image[0, 0] = torch.tensor([255, 51, 0])
    rgb, coarse = torch.tensor([[[0.0] * 3, [0.5] * 3]]), torch.full((1, 2, 3), 0.5)
    seen = RenderOutput(rgb, torch.ones(1, 2), None, {"rgb_coarse": coarse})
    frame, masked = make_frame(image), make_frame(image, mask=torch.tensor([[True, False]]))
    assert make("l1")(seen, frame).item() == pytest.approx((1.0 + 0.2 + 3 * 0.5) / 6)
    assert make("l1")(seen, masked).item() == pytest.approx((1.0 + 0.2) / 3)
    assert make("mse")(seen, masked).item() == pytest.approx((1.0 + 0.04) / 3)
    other = make("mse", image="rgb_coarse")
    assert other(seen, frame).item() == pytest.approx((0.25 + 0.09 + 0.25 + 3 * 0.25) / 6)
    assert other.loss.wants == {"rgb_coarse"} and make("mse").loss.wants == frozenset()
    assert registry.losses.get("mse").needs == frozenset()


def test_d_ssim_is_one_minus_the_ssim_that_is_reported(image, rgb):
    mask = torch.rand(HEIGHT, WIDTH) < 0.6
    frame = make_frame(image, mask=mask)
    assert make("d-ssim")(make_output(rgb), frame).item() == pytest.approx(
        1 - ssim(rgb, frame.rgb, mask).item(), abs=1e-6
    )
    assert make("d-ssim")(make_output(frame.rgb), frame).item() == pytest.approx(0.0, abs=1e-6)


# -------------------------------------------------------------------------------------------------------------- depth


@pytest.mark.parametrize("kind", ["depth_accumulated", "depth_expected", "depth_median"])
def test_each_depth_is_compared_as_it_is(kind, image, depth):
    output = make_output(torch.zeros(HEIGHT, WIDTH, 3), **{kind: depth + 0.25})
    loss = make("depth-l1", depth=kind)
    assert loss(output, make_frame(image, depth)).item() == pytest.approx(0.25, abs=1e-5)
    assert loss.loss.wants == {kind}


def test_inverse_depth_is_inverted_and_emptiness_is_a_constant():
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


# ----------------------------------------------------------------------------------------------------------- schedule


@pytest.mark.parametrize(
    ("step", "weight"), [(0, 0.2), (1_000, 0.181), (7_000, 0.0994), (15_000, 0.0447), (20_000, 0.0271), (30_000, 0.01)]
)
def test_the_depth_weight_falls_as_in_the_authors_code(step, weight):
    settings = registry.losses.get("depth-l1").Settings(weight=0.2, final_weight=0.01)
    assert settings.weight_at(step, 30_000) == pytest.approx(weight, rel=3e-3)


def test_a_weight_falls_no_further_than_its_minimum_and_without_an_end_it_is_constant():
    assert {LossSettings(weight=0.8).weight_at(step, 10) for step in (1, 5, 10)} == {0.8}
    floored = LossSettings(weight=0.2, final_weight=0.01, min_weight=0.05)
    free = LossSettings(weight=0.2, final_weight=0.01)
    reached = 30_000 * math.log(4) / math.log(20)  # 0.2 * (1 / 20)^u = 0.05
    assert floored.weight_at(int(reached), 30_000) == free.weight_at(int(reached), 30_000) > 0.05
    assert floored.weight_at(int(reached) + 1, 30_000) == floored.weight_at(30_000, 30_000) == 0.05
