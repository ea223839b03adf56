"""The torch renderer against closed forms, against an independent naive renderer, and against symmetries."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_splatting import extent, splat
from pydantic import ValidationError

from coliags_plugin import registry
from coliags_plugin.cameras import Camera
from coliags_plugin.errors import InputError
from coliags_plugin.gaussians import OUTPUTS, Gaussians
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings, render_gaussians

INPUTS = ("means", "quats_wxyz", "scales", "opacities", "colors")
SUMS = tuple(name for name in OUTPUTS if name != "depth_median")


def make(means, scales, opacities, colors=None, quats=None, dtype=torch.float64):
    means = torch.as_tensor(means, dtype=dtype).reshape(-1, 3)
    n = len(means)
    scales = torch.as_tensor(scales, dtype=dtype).expand(n, 3) if torch.as_tensor(scales).ndim < 2 else scales
    colors = torch.ones(n, 3) if colors is None else torch.as_tensor(colors)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4) if quats is None else quats
    index = torch.arange(n)
    opacities = torch.as_tensor(opacities, dtype=dtype).expand(n)
    return Gaussians(means, quats.to(dtype), scales.to(dtype), opacities, colors.to(dtype), index, index)


def pinhole(width=9, height=7, fx=20.0, fy=20.0, cx=None, cy=None, pose=None, dtype=torch.float64):
    pose = torch.eye(4, dtype=dtype) if pose is None else pose.to(dtype)
    cx, cy = (width / 2 if cx is None else cx), (height / 2 if cy is None else cy)
    return Camera(fx, fy, cx, cy, width, height, pose)


def rigid(seed):
    generator = torch.Generator().manual_seed(seed)
    q = torch.randn(4, generator=generator, dtype=torch.float64)
    w, x, y, z = (q / q.norm()).tolist()
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.tensor(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ],
        dtype=torch.float64,
    )
    matrix[:3, 3] = 3 * torch.randn(3, generator=generator, dtype=torch.float64)
    return matrix, torch.tensor([w, x, y, z], dtype=torch.float64)


def cast(gaussians, dtype=None, device=None, grad=False):
    moved = {k: getattr(gaussians, k).detach().to(device=device, dtype=dtype) for k in INPUTS}
    if grad:
        moved = {k: v.clone().requires_grad_() for k, v in moved.items()}
    return dataclasses.replace(gaussians, **moved)


# --- scenes -----------------------------------------------------------------------------------------------------------


def random_gaussians(n, seed=0, depth=(1.0, 9.0), scale=(0.02, 0.3), opacity=(0.05, 1.0), spread=0.6):
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    z = uniform(*depth, n)
    means = torch.stack([z * uniform(-spread, spread, n), z * uniform(-spread, spread, n), z], dim=-1)
    scales = torch.exp(uniform(math.log(scale[0]), math.log(scale[1]), n, 3))
    quats = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    return make(means, scales, uniform(*opacity, n), uniform(0.0, 1.0, n, 3), quats)


def moved(gaussians, transform, quat):
    """The same Gaussians in a world moved by a rigid transform."""
    w, v = quat[0], quat[1:]
    q = gaussians.quats_wxyz
    product = torch.cat(
        [
            (w * q[:, 0] - q[:, 1:] @ v)[:, None],
            w * q[:, 1:] + q[:, :1] * v + torch.linalg.cross(v.expand(len(q), 3), q[:, 1:]),
        ],
        dim=-1,
    )
    return dataclasses.replace(
        gaussians, means=gaussians.means @ transform[:3, :3].T + transform[:3, 3], quats_wxyz=product
    )


def scene(name):
    """A camera and Gaussians, both in a moved world frame, float64."""
    camera = pinhole(37, 26, 31.0, 27.0, 16.3, 14.9)
    if name == "random":
        gaussians = random_gaussians(120)
    elif name == "needles":
        gaussians = random_gaussians(80, 1)
        longest = torch.tensor([2.0, 0.002, 0.002], dtype=torch.float64)
        gaussians = dataclasses.replace(gaussians, scales=longest * (0.5 + gaussians.scales))
    elif name == "pancakes":
        gaussians = random_gaussians(80, 2)
        flat = torch.tensor([0.4, 0.3, 1e-5], dtype=torch.float64)
        gaussians = dataclasses.replace(gaussians, scales=flat * (0.5 + gaussians.scales))
    elif name == "around the camera":
        gaussians = random_gaussians(150, 3, depth=(-2.0, 1.5), scale=(0.005, 0.2), spread=1.5)
    elif name == "crowd in one tile":
        gaussians = random_gaussians(1500, 4, depth=(2.0, 3.0), scale=(0.01, 0.05), opacity=(0.004, 0.03), spread=0.05)
        camera = pinhole(12, 11, 31.0, 27.0)
    elif name == "opaque":
        gaussians = random_gaussians(150, 5, scale=(0.1, 0.6), opacity=(0.9, 1.0))
    elif name == "one pixel wide":
        gaussians, camera = random_gaussians(60, 6), pinhole(1, 23, 31.0, 27.0)
    elif name == "one pixel":
        gaussians, camera = random_gaussians(60, 6), pinhole(1, 1, 31.0, 27.0)
    elif name == "off centre":
        gaussians = random_gaussians(120, 7, spread=2.5)
        camera = pinhole(33, 21, 12.0, 30.0, -6.5, 30.25)
    transform, quat = rigid(11)
    return moved(gaussians, transform, quat), dataclasses.replace(camera, camera_to_world=transform)


SCENES = (
    "random",
    "needles",
    "pancakes",
    "around the camera",
    "crowd in one tile",
    "opaque",
    "one pixel wide",
    "one pixel",
    "off centre",
)


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("opacity", [0.3, 0.99, 0.999, 1.0])
def test_one_gaussian_on_the_axis(opacity):
    z, sigma = 5.0, 0.2
    camera = pinhole()  # 9 x 7: the axis meets the centre of pixel (4, 3)
    gaussians = make([0, 0, z], sigma, opacity, [[0.2, 0.5, 1.0]])
    output = render_gaussians(gaussians, camera, OUTPUTS)
    variance = (camera.fx * sigma / z) ** 2 + 0.3
    alpha = min(0.99, opacity)
    beside = min(0.99, opacity * math.exp(-0.5 * 4 / variance))
    torch.testing.assert_close(output.alpha[3, 4].item(), alpha)
    torch.testing.assert_close(output.alpha[3, 6].item(), beside)
    torch.testing.assert_close(output.alpha[5, 4].item(), beside)
    torch.testing.assert_close(output.rgb[3, 4], alpha * gaussians.colors[0])
    for name, value in {
        "depth_accumulated": alpha * z,
        "depth_expected": z,
        "inverse_depth_accumulated": alpha / z,
        "depth_median": z if alpha >= 0.5 else 0.0,
    }.items():
        torch.testing.assert_close(output[name][3, 4].item(), value, msg=name)
    torch.testing.assert_close(output.means2d, torch.tensor([[4.5, 3.5]], dtype=torch.float64))
    assert output.radii.tolist() == [math.ceil(extent(opacity, variance))]


def test_two_gaussians_one_behind_the_other():
    gaussians = make([[0, 0, 6.0], [0, 0, 4.0]], 0.3, torch.tensor([0.8, 0.4]), [[1.0, 0, 0], [0, 1.0, 0]])
    output = render_gaussians(gaussians, pinhole(), OUTPUTS, TorchRendererSettings(background=(0.0, 0.0, 0.5)))
    front, back = 0.4, 0.6 * 0.8
    expected = {
        "rgb": [back, front, 0.5 * (1 - front - back)],
        "alpha": front + back,
        "depth_accumulated": 4 * front + 6 * back,
        "depth_expected": (4 * front + 6 * back) / (front + back),
        "inverse_depth_accumulated": front / 4 + back / 6,
        "depth_median": 6.0,
    }
    for name, value in expected.items():
        torch.testing.assert_close(output[name][3, 4], torch.tensor(value, dtype=torch.float64), msg=name)


def test_normals_are_the_shortest_axes_facing_the_camera():
    half = math.sqrt(0.5)  # a quarter turn about x takes the local z axis to -y
    quats = torch.tensor([[1.0, 0, 0, 0], [half, half, 0, 0]])
    scales = torch.tensor([[0.5, 0.4, 0.1], [0.5, 0.4, 0.1]])
    gaussians = make([[0, 0, 4.0], [0.0, 1.0, 4.0]], scales, 0.9, quats=quats)
    first, second = (dataclasses.replace(gaussians, **{k: getattr(gaussians, k)[i] for k in INPUTS}) for i in ([0], [1]))
    seen = render_gaussians(first, pinhole(), ("normals",))["normals"][3, 4]
    torch.testing.assert_close(seen, 0.9 * torch.tensor([0, 0, -1.0], dtype=torch.float64))
    output = render_gaussians(second, pinhole(9, 31), ("normals",))
    torch.testing.assert_close(
        output["normals"], output.alpha[..., None] * torch.tensor([0, -1.0, 0], dtype=torch.float64)
    )


def test_compositing_stops_before_the_gaussian_that_would_leave_too_little_light():
    # 0.2^5 = 3.2e-4 is left after five; the sixth would leave 6.4e-5, so neither it nor the seventh is drawn.
    means = torch.tensor([[0, 0, 2.0 + i] for i in range(7)])
    output = render_gaussians(make(means, 5.0, 0.8), pinhole(1, 1), OUTPUTS)
    torch.testing.assert_close(output.alpha.item(), 1 - 0.2**5, rtol=0, atol=1e-4)
    middle = make(means, 1e3, 0.8)  # so wide that alpha is 0.8 at any pixel to 1e-8
    output = render_gaussians(middle, pinhole(), OUTPUTS)
    torch.testing.assert_close(output.alpha[3, 4].item(), 1 - 0.2**5, rtol=1e-12, atol=0)
    weights = [0.8 * 0.2**i for i in range(5)]
    accumulated = sum(w * (2 + i) for i, w in enumerate(weights))
    torch.testing.assert_close(output["depth_accumulated"][3, 4].item(), accumulated, rtol=1e-12, atol=0)


def test_the_stop_is_for_good():
    # After the third, T = 0.04; the fourth (0.99...) is too much, and the faint fifth would fit but stays undrawn.
    opacities = torch.tensor([0.8, 0.8, 0.99, 0.9, 0.01], dtype=torch.float64)
    means = torch.tensor([[0, 0, 2.0 + i] for i in range(5)])
    output = render_gaussians(make(means, 1e3, opacities), pinhole())
    torch.testing.assert_close(output.alpha[3, 4].item(), 1 - 0.2 * 0.2 * 0.01, rtol=1e-12, atol=0)


def test_what_is_fainter_than_the_cut_is_not_drawn():
    gaussians = make([[0, 0, 4.0]], 0.3, 1 / 256)
    output = render_gaussians(gaussians, pinhole())
    assert not output.alpha.any() and output.radii.tolist() == [0]
    camera, variance = pinhole(41, 1), (20 * 0.3 / 4) ** 2 + 0.3
    output = render_gaussians(make([[0, 0, 4.0]], 0.3, 0.7), camera)
    distance = (torch.arange(41) - 20).abs()
    assert torch.equal(output.alpha[0] > 0, distance <= extent(0.7, variance))


def test_median_depth_is_where_transmittance_falls_to_one_half():
    means = torch.tensor([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]])
    depths = [
        render_gaussians(make(means, 1e3, opacity), pinhole(), ("depth_median",))["depth_median"][3, 4].item()
        for opacity in (0.6, 0.5, 0.4, 0.25, 0.2)
    ]
    assert depths == [2.0, 2.0, 3.0, 4.0, 0.0]


# --- culling and emptiness --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [-3.0, 0.0, 0.1, 0.2])
def test_nothing_at_or_before_the_near_plane(depth):
    gaussians = cast(make([[0, 0, depth]], 0.3, 0.7), grad=True)
    output = render_gaussians(gaussians, pinhole(), OUTPUTS, TorchRendererSettings(background=(0.1, 0.2, 0.3)))
    assert torch.equal(output.rgb, torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).expand(7, 9, 3))
    assert output.radii.tolist() == [0]
    sum(output[name].sum() for name in OUTPUTS).backward()
    for name in INPUTS:
        assert not getattr(gaussians, name).grad.any(), name
    assert not output.means2d.grad.any()


def test_near_plane_is_a_setting():
    gaussians = make([[0, 0, 1.0]], 0.1, 0.7)
    assert render_gaussians(gaussians, pinhole(), settings=TorchRendererSettings(near=0.99)).alpha.any()
    assert not render_gaussians(gaussians, pinhole(), settings=TorchRendererSettings(near=1.0)).alpha.any()


@pytest.mark.parametrize("size", [(1, 1), (9, 7)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_gaussians_leave_the_background_and_a_graph(size, dtype):
    gaussians = cast(make(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0)), dtype, grad=True)
    output = render_gaussians(gaussians, pinhole(*size), OUTPUTS, TorchRendererSettings(background=(1.0, 0.5, 0.0)))
    assert output.rgb.dtype == dtype
    assert torch.equal(output.rgb[0, 0], torch.tensor([1.0, 0.5, 0.0], dtype=dtype))
    assert not any(output[name].any() for name in OUTPUTS if name != "rgb")
    (output.rgb.sum() + output["depth_expected"].sum()).backward()
    assert gaussians.means.grad.shape == (0, 3) and output.means2d.grad.shape == (0, 2)


# --- against the naive renderer ---------------------------------------------------------------------------------------


def relative(ours, true):
    return float((ours.double() - true).norm() / true.norm().clamp_min(1e-300))


def with_gradients(draw, gaussians, camera, cotangents):
    gaussians = cast(gaussians, grad=True)
    pose = camera.camera_to_world.clone().requires_grad_()
    outputs, centers = draw(gaussians, dataclasses.replace(camera, camera_to_world=pose))
    loss = sum((outputs[name] * cotangents[name].to(outputs[name].dtype)).sum() for name in SUMS)
    loss.backward()
    return outputs, centers, {**{k: getattr(gaussians, k).grad for k in INPUTS}, "pose": pose.grad}


def ours(**options):
    def draw(gaussians, camera):
        output = render_gaussians(gaussians, camera, OUTPUTS, TorchRendererSettings(**options))
        return {name: output[name] for name in OUTPUTS}, output

    return draw


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_the_naive_renderer(name):
    gaussians, camera = scene(name)
    gaussians = cast(gaussians, torch.float32)  # numbers that float32 holds exactly, so that both precisions see the same
    camera = camera.to(dtype=torch.float32)
    background = (0.3, 0.1, 0.9)
    generator = torch.Generator().manual_seed(1)
    shape = (camera.height, camera.width)
    cotangents = {k: torch.randn(*shape, *([3] * (k in ("rgb", "normals"))), generator=generator) for k in SUMS}

    def draw(gaussians, camera):
        return splat(gaussians, camera, background)

    true, centers, true_gradients = with_gradients(
        draw, cast(gaussians, torch.float64), camera.to(dtype=torch.float64), cotangents
    )
    for dtype, bound in ((torch.float64, 1e-9), (torch.float32, 1e-5)):
        for tile_size in (5, 8, 16) if dtype == torch.float64 else (8,):
            outputs, output, gradients = with_gradients(
                ours(background=background, tile_size=tile_size), cast(gaussians, dtype), camera.to(dtype=dtype), cotangents
            )
            for key in OUTPUTS:
                assert outputs[key].dtype == dtype
                assert relative(outputs[key], true[key]) <= bound, (dtype, tile_size, key)
            for key, gradient in gradients.items():
                assert relative(gradient, true_gradients[key]) <= bound, (dtype, tile_size, key)
            for i, center in centers.items():
                torch.testing.assert_close(output.means2d[i].double(), center, rtol=1e-5, atol=1e-5, check_dtype=False)
