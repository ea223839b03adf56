"""All loss terms alike, and those against a frame: of its image, and of depth, along the ray, or whatever there is."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from torch.nn.functional import grid_sample, huber_loss

from coliags_plugin.contracts import LossSettings
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import RenderOutput, concatenate_pixels
from coliags_plugin.core.scenes import SparseDepth, concatenate_targets
from coliags_plugin.core.ssim import ssim
from coliags_plugin.core.tensors import masked_mean
from coliags_plugin.engine.model import Model
from coliags_plugin.modules.exposure import FrameGain
from tests.fields.made import make_field
from tests.losses.terms import make, make_output, step
from tests.scenes import camera_at, wall_scene
from tests.scenes import plain_frame as make_frame

ROWS, COLUMNS = 14, 17


@pytest.fixture
def image():
    return torch.randint(0, 256, (ROWS, COLUMNS, 3), dtype=torch.uint8)


@pytest.fixture
def rgb():
    return torch.rand(ROWS, COLUMNS, 3).requires_grad_()


@pytest.fixture
def depth():
    return 20 + 10 * torch.rand(ROWS, COLUMNS)


# ---------------------------------------------------------------------------------------------------- all terms alike

LOSSES = {name: registry.losses.get(name) for name in registry.losses}


@pytest.fixture(scope="module")
def model():
    """A model with everything that losses read of one."""
    scene = wall_scene()
    field = make_field("gaussians", scene, normal_neighbours=10)
    return Model(field, None, {"exposure": FrameGain(FrameGain.Settings(), scene)})


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
            shape = (ROWS, COLUMNS, 3) if kind in ("rgb", "normals") else (ROWS, COLUMNS)
            values = 0.6 + 0.3 * torch.rand(shape, generator=generator)
            if spoilt is not None:
                values[spoilt] = hidden
            return values.to(dtype).requires_grad_()

        drawn = {kind: pixels(kind) for kind in ("rgb", "alpha", *sorted(loss.wants))}
        rows = {name: torch.rand(count, 3, generator=generator) for name in ("scales", "albedo", "diffuse_factor")}
        rows = {name: values.to(dtype).requires_grad_() for name, values in rows.items()}
        image = torch.randint(0, 256, (ROWS, COLUMNS, 3), generator=generator, dtype=torch.uint8)
        depth = pixels("depth").detach() + 1 if "depth" in loss.needs or name == "scene-depth" else None
        frame = make_frame(image, depth, mask)
        output = make_output(scales=rows.pop("scales"), **drawn)
        splats = replace(output.splats, gaussians=replace(output.splats.gaussians, features=rows))
        output = replace(output, camera=frame.camera, splats=splats)
        term = loss(step(output, frame.target, copy.deepcopy(model).to(dtype)))
        return term, drawn, output.splats.gaussians

    return evaluate


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_finite_scalar_that_ignored_pixels_do_not_change(name, share, evaluate):
    mask = torch.rand(ROWS, COLUMNS) < share
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
    mask = torch.rand(ROWS, COLUMNS) < 0.6
    frame = make_frame(image, mask=mask)
    assert make("d-ssim")(make_output(rgb), frame).item() == pytest.approx(
        1 - ssim(rgb, frame.rgb, mask).item(), abs=1e-6
    )
    assert make("d-ssim")(make_output(frame.rgb), frame).item() == pytest.approx(0.0, abs=1e-6)


# -------------------------------------------------------------------------------------------------------------- depth


@pytest.mark.parametrize("kind", ["depth_accumulated", "depth_expected", "depth_median"])
def test_each_depth_is_compared_as_it_is(kind, image, depth):
    output = make_output(torch.zeros(ROWS, COLUMNS, 3), **{kind: depth + 0.25})
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
    ("number", "weight"),
    [(0, 0.2), (1_000, 0.181), (7_000, 0.0994), (15_000, 0.0447), (20_000, 0.0271), (30_000, 0.01)],
)
def test_the_depth_weight_falls_as_in_the_authors_code(number, weight):
    settings = registry.losses.get("depth-l1").Settings(weight=0.2, final_weight=0.01)
    assert settings.weight_at(number, 30_000) == pytest.approx(weight, rel=3e-3)


def test_a_weight_falls_no_further_than_its_minimum_and_without_an_end_it_is_constant():
    assert {LossSettings(weight=0.8).weight_at(number, 10) for number in (1, 5, 10)} == {0.8}
    floored = LossSettings(weight=0.2, final_weight=0.01, min_weight=0.05)
    free = LossSettings(weight=0.2, final_weight=0.01)
    reached = 30_000 * math.log(4) / math.log(20)  # 0.2 * (1 / 20)^u = 0.05
    assert floored.weight_at(int(reached), 30_000) == free.weight_at(int(reached), 30_000) > 0.05
    assert floored.weight_at(int(reached) + 1, 30_000) == floored.weight_at(30_000, 30_000) == 0.05


# ----------------------------------------------------------------------------------- depth, weighted by its confidence

HEIGHT, WIDTH = 7, 9
WEIGHTED = ("depth-l1", "depth-huber", "distance-l1")


@pytest.fixture
def case():
    """A rendered depth, and a frame with estimated depth, a mask and unknown pixels."""
    depth, rendered = 20 + 10 * torch.rand(2, HEIGHT, WIDTH, dtype=torch.float64)
    depth[0, :3] = torch.nan
    mask = torch.rand(HEIGHT, WIDTH) < 0.7
    confidence = torch.rand(HEIGHT, WIDTH)
    lengths = 1 + torch.rand(HEIGHT, WIDTH, dtype=torch.float64)
    rendered = rendered.requires_grad_()
    output = make_output(torch.zeros(HEIGHT, WIDTH, 3), depth_accumulated=rendered, ray_lengths=lengths)
    frame = make_frame(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8), depth, mask)
    return output, frame.with_maps(depth_confidence=confidence), rendered


def penalties(name, output, frame):
    """Per-pixel penalties; 0 where the depth is unknown."""
    difference = torch.nan_to_num(output["depth_accumulated"] - frame.depth)
    if name == "distance-l1":
        return difference.abs() * output["ray_lengths"]
    if name == "depth-huber":
        return huber_loss(difference, torch.zeros_like(difference), reduction="none", delta=0.2)
    return difference.abs()


@pytest.mark.parametrize("name", WEIGHTED)
def test_pixels_are_weighted_by_their_confidence(name, case):
    output, frame, rendered = case
    has_depth = frame.mask & frame.depth.isfinite()
    weights = frame.depth_confidence.double() * has_depth

    def compared(frame, expected):
        term = make(name)(output, frame)
        gradients = [torch.autograd.grad(each, rendered, retain_graph=True)[0] for each in (term, expected)]
        assert not gradients[0][~has_depth].any()
        return term.item(), expected.item(), *gradients

    expected = (weights * penalties(name, output, frame)).sum() / weights.sum()
    term, value, values, expected = compared(frame, expected)
    assert term == pytest.approx(value, rel=1e-12)
    torch.testing.assert_close(values, expected)
    # Without confidence nothing changes, to the bit.
    expected = masked_mean(penalties(name, output, frame), has_depth)
    plain, value, values, expected = compared(frame.with_maps(depth_confidence=None), expected)
    assert plain == value and torch.equal(values, expected)
    certain = frame.with_maps(depth_confidence=torch.ones(HEIGHT, WIDTH))
    assert make(name)(output, certain).item() == pytest.approx(plain, rel=1e-12)
    nothing = frame.with_maps(depth_confidence=torch.zeros(HEIGHT, WIDTH))
    term, _, values, _ = compared(nothing, 0.0 * rendered.sum())
    assert term == 0.0 and not values.any()


# The distance along the ray

make_distance = partial(make, "distance-l1")


def seen_along(depth, lengths, kind="depth_accumulated"):
    return make_output(torch.zeros(*depth.shape, 3), **{kind: depth, "ray_lengths": lengths})


def test_it_is_the_distance_between_points_on_the_ray():
    camera = camera_at(1.0, 2.0, 3.0, 6, 5, yaw=0.4)
    true, drawn = 20 + 5 * torch.rand(2, 5, 6, dtype=torch.float64)
    lengths = camera.rays().norm(dim=-1)
    frame = make_frame(torch.zeros(5, 6, 3, dtype=torch.uint8), true)
    values = make_distance()(seen_along(drawn, lengths), frame)
    apart = (camera.unproject(drawn) - camera.unproject(true)).norm(dim=-1)
    torch.testing.assert_close(values, apart.mean())
    coarse = make_distance(depth="depth_accumulated_coarse")
    assert coarse(seen_along(drawn, lengths, "depth_accumulated_coarse"), frame) == values
    assert coarse.loss.wants == {"depth_accumulated_coarse", "ray_lengths"} and coarse.loss.needs == {"depth"}


def test_in_the_fields_unit_it_is_divided_by_it():
    frame = make_frame(torch.zeros(1, 2, 3, dtype=torch.uint8), torch.tensor([[10.0, 20.0]]))
    loss = make_distance(unit="field").loss
    model = SimpleNamespace(field=SimpleNamespace(length_unit=torch.tensor(50.0)))
    output = seen_along(torch.tensor([[12.0, 20.0]]), torch.tensor([[1.5, 1.0]]))
    assert loss(step(output, frame.target, model)).item() == pytest.approx(1.5 / 50)


def test_a_share_of_each_image_counts_and_is_always_the_same():
    scene = wall_scene(frames=3, width=300, height=200)
    loss = make_distance(share=0.03).loss
    counted = []
    for frame in scene.train:
        depth = frame.depth.clone().requires_grad_()
        output = seen_along(depth + 1.0, torch.ones_like(depth))
        term = loss(step(output, frame.target))
        assert term.item() == pytest.approx(1.0, abs=1e-4)
        (gradient,) = torch.autograd.grad(term, depth)
        counted.append(gradient != 0)
        assert counted[-1].float().mean().item() == pytest.approx(0.03, abs=0.003)
    assert 0.02 < (counted[0] & counted[1]).sum() / counted[0].sum() < 0.045  # drawn for each frame by itself
    # Pixels of several frames, as of another step: the same ones count.
    pixels = torch.randint(200, (5000, 2))
    parts = [frame.target_at(pixels) for frame in scene.train]
    depth = torch.cat([part.depth for part in parts]).requires_grad_()
    output = concatenate_pixels([seen_along(depth + 1.0, torch.ones_like(depth))])
    term = loss(step(output, concatenate_targets(parts), number=2))
    (gradient,) = torch.autograd.grad(term, depth)
    expected = torch.cat([inside[pixels[:, 1], pixels[:, 0]] for inside in counted])
    assert torch.equal(gradient[:, 0] != 0, expected)
    other = make_distance(share=0.03, seed=1).loss(step(output, concatenate_targets(parts), number=2))
    (gradient,) = torch.autograd.grad(other, depth)
    assert not torch.equal(gradient[:, 0] != 0, expected)


# Whatever depth a scene has: dense, sampled at points against torch's own, and what counts

scene_depth = make("scene-depth")


@pytest.mark.parametrize("is_true", [True, False])
def test_dense_depth_is_compared_in_proportion_to_it(case, is_true):
    output, frame, rendered = case
    has_depth = frame.mask & frame.depth.isfinite()
    truth, difference = frame.depth[has_depth], (rendered - frame.depth)[has_depth]
    if is_true:
        frame = frame.with_maps(depth_confidence=None)
        expected = difference.abs().mean() / truth.mean()
    else:
        penalty = huber_loss(difference / truth, torch.zeros_like(truth), reduction="none", delta=0.05) / 0.05
        expected = (penalty * frame.depth_confidence[has_depth].double().clamp_min(0.1)).mean()
    term = scene_depth(output, frame)
    assert term.item() == pytest.approx(expected.item(), rel=1e-12)
    (expected,) = torch.autograd.grad(expected, rendered, retain_graph=True)
    torch.testing.assert_close(torch.autograd.grad(term, rendered)[0], expected)


@pytest.mark.parametrize(("confidence", "expected"), [(None, 0.2), (torch.ones(1, 5), 0.2 - 0.025)])
def test_ignored_and_unknown_pixels_may_be_nan(confidence, expected):
    depth = torch.tensor([[10.0, torch.nan, 0.0, torch.inf, 20.0]])
    rendered = torch.tensor([[12.0, 5.0, 5.0, 5.0, torch.nan]], requires_grad=True)
    mask = torch.tensor([[True, True, True, True, False]])
    frame = make_frame(torch.zeros(1, 5, 3, dtype=torch.uint8), depth, mask).with_maps(depth_confidence=confidence)
    term = scene_depth(make_output(torch.zeros(1, 5, 3), depth_accumulated=rendered), frame)
    term.backward()
    assert term.item() == pytest.approx(expected)
    assert rendered.grad[0].tolist() == pytest.approx([0.1, 0, 0, 0, 0])


@pytest.fixture
def rendered():
    return (20 + 10 * torch.rand(HEIGHT, WIDTH, dtype=torch.float64)).requires_grad_()


@pytest.fixture
def points():
    """Two hundred places, and their depths."""
    places = torch.rand(200, 2, dtype=torch.float64) * torch.tensor([WIDTH, HEIGHT])
    return places, 20 + 10 * torch.rand(200, dtype=torch.float64)


@pytest.fixture
def at_points():
    """The loss of a rendered depth at points."""

    def term(rendered, pixels, depth, alpha=None, mask=None):
        output = make_output(torch.zeros(*rendered.shape, 3), alpha=alpha, depth_accumulated=rendered)
        frame = make_frame(torch.zeros(*rendered.shape, 3, dtype=torch.uint8), mask=mask)
        points = SparseDepth(torch.as_tensor(pixels), torch.as_tensor(depth))
        return scene_depth(output, replace(frame, sparse_depth=points))

    return term


def bounded(relative):
    return 0.1 * (1 - torch.exp(-relative.abs() / 0.1))


@pytest.mark.parametrize("unit", [1.0, 1e-3, 50.0])
def test_at_points_expected_depth_is_sampled_as_by_torch_with_pixel_centres_at_one_half(
    at_points, rendered, points, unit
):
    pixels, depth = points
    grid = (2 * pixels / torch.tensor([WIDTH, HEIGHT]) - 1)[None, None]
    alpha = 0.2 + 0.8 * torch.rand(HEIGHT, WIDTH)
    expected_depth = (rendered / alpha)[None, None]
    sampled = grid_sample(expected_depth, grid, padding_mode="border", align_corners=False)[0, 0, 0]
    expected = bounded(sampled / depth - 1)[1:].mean()
    measured = unit * depth
    measured[0] = 0.0  # no point of a surface
    term = at_points(unit * rendered, pixels, measured, alpha)
    assert term.item() == pytest.approx(expected.item(), rel=1e-6)
    gradients = [torch.autograd.grad(each, rendered, retain_graph=True)[0] for each in (term, expected)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (1, 1), (1, 6), (5, 1)])
@pytest.mark.parametrize("place", [(0.0, 0.0), (1.0, 1.0), (0.02, 0.98), (0.999, 0.0)])
def test_edges_of_the_image_take_the_outermost_pixels(at_points, size, place):
    rendered = torch.arange(1.0, 1.0 + size[0] * size[1]).reshape(size)
    pixel = (place[0] * size[1], place[1] * size[0])
    row, column = (0 if share < 0.5 else -1 for share in place[::-1])
    assert at_points(rendered, [pixel], [rendered[row, column].item()]).item() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("outside", [(-0.1, 3.0), (4.0, 7.1), (torch.nan, 2.0)])
def test_points_outside_do_not_count(at_points, rendered, outside):
    inside = at_points(rendered, [[4.0, 3.0]], [25.0])
    assert at_points(rendered, [[4.0, 3.0], outside], [25.0, 1e9]) == inside


@pytest.mark.parametrize("spoilt", ["alpha", "mask", "nan"])
def test_a_point_counts_only_where_all_its_pixels_show_something(at_points, rendered, spoilt):
    pixels, depth = [[2.0, 2.0], [6.5, 4.5], [6.5, 5.0]], [25.0, 25.0, 25.0]
    alpha, mask = torch.ones(HEIGHT, WIDTH), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    values = rendered.detach().clone()
    # One of the four pixels around the first point; and a neighbour of weight 0 of the second.
    for row, column in ((1, 2), (5, 6)):
        values[row, column] = torch.nan
        alpha[row, column] = 0.0 if spoilt == "alpha" else 1.0
        mask[row, column] = spoilt != "mask"
    values.requires_grad_()
    term = at_points(values, pixels, depth, alpha, mask)
    term.backward()
    assert term.item() == pytest.approx(bounded(values[4, 6] / 25 - 1).item())
    assert values.grad.nonzero().tolist() == [[4, 6]]


def test_nothing_to_compare_is_zero_and_keeps_the_graph(at_points, rendered):
    frame = make_frame(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8))
    output = make_output(torch.zeros(HEIGHT, WIDTH, 3), depth_accumulated=rendered)
    empty = SparseDepth(torch.zeros(0, 2), torch.zeros(0))
    terms = [scene_depth(output, frame), scene_depth(output, replace(frame, sparse_depth=empty))]
    terms.append(at_points(rendered, [[3.0, 3.0]], [5.0], alpha=torch.zeros(HEIGHT, WIDTH)))
    for term in terms:
        assert term.item() == 0.0
        assert term.dtype == rendered.dtype
        (gradient,) = torch.autograd.grad(term, rendered)
        assert not gradient.any()
