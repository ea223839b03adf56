"""Surfels drawn by the compiled kernels, against the written definition; and what the kernels refuse."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import OUTPUTS
from coliags_plugin.core.rotations import rotation_matrices
from coliags_plugin.renderers import cpu_renderer, torch_renderer
from coliags_plugin.renderers.numba_kernels import pipeline
from tests.renderers.test_cpu_renderer import CUTOFF_MARGIN, few
from tests.renderers.test_surfels import SCENES, as_surfels, make_surfels, scene
from tests.renderers.test_torch_renderer import INPUTS, cast, pinhole, random_gaussians, relative

#: An intersection this many times as far as the disc's centre is near the horizon of the disc's plane, where rays are
#: parallel to it: the last cut-off.
HORIZON = 10.0
#: Accuracy of outputs and gradients where it is not 1e-5 and 2e-5: discs, or what is seen of them, down to a hundredth
#: and a ten-thousandth of a pixel wide magnify the rounding of the pixels' positions.
MAGNIFIED = {"needles": (3e-5, 1.5e-4), "edge-on": (5e-5, 2e-3)}
#: Channels of the feature maps.
FEATURES = {"one": 1, "many": 7}


def thousands():
    """Two thousand surfels, many of them over the edge of a cut-off at some pixel or other."""
    gaussians = random_gaussians(2000, 8, depth=(1.0, 12.0), scale=(0.02, 0.2), opacity=(0.02, 1.0))
    return as_surfels(gaussians), pinhole(90, 70, 70.0, 70.0)


def found(name):
    """A scene in float32."""
    gaussians, camera = thousands() if name == "thousands" else scene(name)
    return cast(gaussians, torch.float32), camera.to(dtype=torch.float32)


def on_a_cutoff(gaussians, camera):
    """Pixels that look different where the cut-offs are moved, or show a disc close to its horizon."""
    gaussians, camera = cast(gaussians, torch.float64), camera.to(dtype=torch.float64)
    kind = torch_renderer.TorchRendererSettings
    plain = kind()
    alphas = []
    for factor in (1 - CUTOFF_MARGIN, 1 + CUTOFF_MARGIN):
        cuts = {name: getattr(plain, name) * factor for name in ("alpha_min", "transmittance_min")}
        nearer = dataclasses.replace(camera, near_plane=camera.near_plane * factor)
        alphas.append(torch_renderer.render_gaussians(gaussians, nearer, settings=kind(**cuts)).alpha)
    pose = camera.camera_to_world
    axes = pose[:3, :3].T @ rotation_matrices(gaussians.quats_wxyz)
    centers = (gaussians.means - pose[:3, 3]) @ pose[:3, :3]
    rays = camera.rays() @ pose[:3, :3]
    rays = rays / rays[..., 2:]
    horizon = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    for center, (first, second, normal), scales, opacity in zip(
        centers, axes.mT, gaussians.scales, gaussians.opacities, strict=True
    ):
        if center[2] > camera.near_plane:
            z = (center @ normal) / (rays @ normal)
            offsets = z[..., None] * rays - center
            on_disc = ((offsets @ first) / scales[0]).square() + ((offsets @ second) / scales[1]).square()
            pixels = (rays - center / center[2])[..., :2] * torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
            squared = torch.minimum(on_disc, pixels.square().sum(-1) / plain.surfel_filter**2)
            horizon |= (opacity * torch.exp(-0.5 * squared) >= plain.alpha_min) & (z > HORIZON * center[2])
    return ((alphas[1] - alphas[0]).abs() > 1e-9) | horizon


def drawn(module, gaussians, camera, dtype, wants=OUTPUTS, ignored=None, of_means2d=0.0):
    """Output and gradients of one renderer under random cotangents, which are 0 at the pixels ignored."""
    gaussians = cast(gaussians, dtype, grad=True)
    features = {name: value.to(dtype).clone().requires_grad_() for name, value in gaussians.features.items()}
    pose = camera.camera_to_world.to(dtype).clone().requires_grad_()
    kind = module.CpuRendererSettings if module is cpu_renderer else module.TorchRendererSettings
    output = module.render_gaussians(
        dataclasses.replace(gaussians, features=features),
        dataclasses.replace(camera, camera_to_world=pose),
        wants,
        kind(background=(0.3, 0.1, 0.9)),
    )
    generator = torch.Generator().manual_seed(1)
    widths = {name: 3 if name in ("rgb", "normals") else 0 for name in OUTPUTS} | FEATURES
    cotangents = {
        name: torch.randn(camera.height, camera.width, *([width] if width else []), generator=generator)
        for name, width in widths.items()
    }
    loss = of_means2d * output.splats.means2d[output.splats.radii > 0].square().sum()
    for name in {"rgb", "alpha", *wants}:
        if ignored is not None:
            cotangents[name][ignored] = 0
        loss = loss + (output[name] * cotangents[name].to(dtype)).sum()
    loss.backward()
    gradients = {key: getattr(gaussians, key).grad for key in INPUTS}
    gradients |= {name: value.grad for name, value in features.items() if name in wants}
    return output, {**gradients, "pose": pose.grad, "means2d": output.splats.means2d.grad}


def with_features(gaussians):
    generator = torch.Generator().manual_seed(4)
    features = {name: torch.randn(len(gaussians), width, generator=generator) for name, width in FEATURES.items()}
    return dataclasses.replace(gaussians, features=features)


@pytest.mark.parametrize("name", [*SCENES, "thousands"])
def test_agrees_with_the_definition_in_float64(name):
    gaussians, camera = found(name)
    ignored = on_a_cutoff(gaussians, camera)
    assert int(ignored.sum()) <= few(ignored.numel())
    ours, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32, ignored=ignored)
    true, true_gradients = drawn(torch_renderer, gaussians, camera, torch.float64, ignored=ignored)
    of_outputs, of_gradients = MAGNIFIED.get(name, (1e-5, 2e-5))
    # Half of the light is one more cut-off, of the median alone.
    off = (ours["depth_median"] - true["depth_median"]).abs() > 10 * of_outputs * true["depth_median"]
    assert int((off & ~ignored).sum()) <= few(ignored.numel())
    for key in OUTPUTS:
        if not (key == "depth_median" and off[~ignored].any()):
            assert relative(ours[key][~ignored], true[key][~ignored]) <= of_outputs, key
    for key, gradient in gradients.items():
        allowed = 5 * of_gradients if key == "pose" else of_gradients  # the pose's is a sum that cancels
        assert relative(gradient, true_gradients[key]) <= allowed, key
    shown = true.splats.radii > 0
    torch.testing.assert_close(
        ours.splats.means2d.detach().double()[shown], true.splats.means2d.detach()[shown], rtol=1e-6, atol=1e-5
    )
    assert int((ours.splats.radii.double() != true.splats.radii).sum()) <= len(gaussians) // 1000


def test_features_and_the_centres_own_gradient_agree_with_the_definition():
    gaussians, camera = found("random")
    gaussians, wants = with_features(gaussians), ("many", "normals", "one", "depth_accumulated")
    ignored = on_a_cutoff(gaussians, camera)
    ours, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32, wants, ignored, of_means2d=0.01)
    true, true_gradients = drawn(torch_renderer, gaussians, camera, torch.float64, wants, ignored, of_means2d=0.01)
    for key in ("rgb", "alpha", *wants):
        assert relative(ours[key][~ignored], true[key][~ignored]) <= 1e-5, key
    for key, gradient in gradients.items():
        assert relative(gradient, true_gradients[key]) <= (1e-4 if key == "pose" else 2e-5), key


@pytest.mark.parametrize(
    "wants",
    [("rgb",), ("depth_median", "normals"), ("inverse_depth_accumulated", "distortion", "one")],
    ids="-".join,
)
def test_outputs_and_gradients_do_not_depend_on_what_else_is_asked_for(wants):
    gaussians, camera = found("across the near plane")
    gaussians = with_features(gaussians)
    less, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32, wants)
    more, _ = drawn(cpu_renderer, gaussians, camera, torch.float32, (*OUTPUTS, "one"))
    _, true_gradients = drawn(torch_renderer, gaussians, camera, torch.float64, wants)
    for key in ("rgb", "alpha", *wants):
        torch.testing.assert_close(less[key], more[key], rtol=1e-6, atol=1e-6)
    for key, gradient in gradients.items():
        assert relative(gradient, true_gradients[key]) <= (1e-4 if key == "pose" else 2e-5), key


@pytest.mark.parametrize("sort", ["by one thread", "by all"])
def test_repeats_to_the_bit_with_any_number_of_threads(sort, monkeypatch):
    if sort == "by all":
        monkeypatch.setattr(pipeline, "_WORTH_SHARING_SORT", 0)
    gaussians, camera = found("thousands")
    gaussians, wants = with_features(gaussians), (*OUTPUTS, "one")
    first = None
    for threads in (2, 1, 3, 5):
        torch.set_num_threads(threads)
        output, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32, wants)
        first = first or (output, gradients)
        assert all(torch.equal(first[0][key], output[key]) for key in wants)
        assert all(torch.equal(first[1][key], gradients[key]) for key in gradients)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), size=st.floats(1e-3, 3.0), depth=st.floats(0.21, 4.0), low_pass=st.floats(0.1, 4.0))
def test_bins_miss_no_pixel_that_a_surfel_reaches(seed, size, depth, low_pass):
    gaussians = random_gaussians(
        1, seed, depth=(depth, 1.5 * depth), scale=(0.1 * size, size), opacity=(0.005, 1.0), spread=1.5
    )
    gaussians = cast(as_surfels(gaussians), torch.float32)
    camera = pinhole(45, 38, 30.0, 27.0, dtype=torch.float32)
    ours = cpu_renderer.render_gaussians(
        gaussians, camera, settings=cpu_renderer.CpuRendererSettings(surfel_filter=low_pass)
    )
    kind = torch_renderer.TorchRendererSettings
    exact, posed = cast(gaussians, torch.float64), camera.to(dtype=torch.float64)
    true = torch_renderer.render_gaussians(exact, posed, settings=kind(surfel_filter=low_pass)).alpha
    # Pixels on the edge of what is drawn may fall to either side.
    brighter, dimmer = (
        torch_renderer.render_gaussians(
            exact,
            dataclasses.replace(posed, near_plane=0.2 * factor),
            settings=kind(surfel_filter=low_pass, alpha_min=factor / 255),
        ).alpha
        for factor in (0.999, 1.001)
    )
    off = (ours.alpha.double() - true).abs() > 1e-3
    assert not (off & (brighter == dimmer)).any()
    assert ours.splats.radii.item() > 0 or not (true > 1.001 / 255).any()


@settings(max_examples=25, deadline=None)
@given(n=st.integers(0, 60), width=st.integers(1, 70), height=st.integers(1, 50), seed=st.integers(0, 99))
def test_any_size(n, width, height, seed):
    gaussians, (_, camera) = as_surfels(random_gaussians(n, seed)), scene("random")
    camera = dataclasses.replace(camera, width=width, height=height, camera_to_world=torch.eye(4))
    ours, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32)
    true, _ = drawn(torch_renderer, cast(gaussians, torch.float32), camera, torch.float64)
    assert ours.rgb.shape == (height, width, 3) and ours["distortion"].shape == (height, width)
    # A pixel on a cut-off may fall to either side in float32.
    off = (ours.rgb.detach().double() - true.rgb.detach()).abs().amax(-1) > 1e-4
    assert off.double().mean() <= 0.001 or int(off.sum()) <= 1
    assert all(gradient is None or torch.isfinite(gradient).all() for gradient in gradients.values())


@pytest.mark.parametrize("near_plane", [0.0, 0.2])
def test_what_is_not_drawn_leaves_no_trace(near_plane):
    """Behind the camera, of no area, too faint, beside the image."""
    means = [[0, 0, -3.0], [0, 0, 2.0], [0, 0, 2.0], [50.0, 0, 2.0]]
    scales = torch.tensor([[0.3, 0.3], [0.3, 0.0], [0.3, 0.3], [0.3, 0.3]])
    gaussians = make_surfels(means, scales, torch.tensor([0.9, 0.9, 1 / 256, 0.9]))
    gaussians = cast(gaussians, torch.float32, grad=True)
    options = cpu_renderer.CpuRendererSettings(background=(0.1, 0.2, 0.3))
    camera = dataclasses.replace(pinhole(dtype=torch.float32), near_plane=near_plane)
    output = cpu_renderer.render_gaussians(gaussians, camera, OUTPUTS, options)
    assert torch.equal(output.rgb, torch.tensor([0.1, 0.2, 0.3]).expand(7, 9, 3))
    assert not any(output[name].any() for name in OUTPUTS if name != "rgb")
    assert not output.splats.radii.any()
    sum(output[name].sum() for name in OUTPUTS).backward()
    assert not any(getattr(gaussians, name).grad.any() for name in INPUTS)


def test_the_median_depth_has_a_gradient():
    gaussians = cast(make_surfels([[0, 0, 2.0], [0, 0, 3.0]], 1e2, 0.4), torch.float32, grad=True)
    output = cpu_renderer.render_gaussians(gaussians, pinhole(dtype=torch.float32), OUTPUTS)
    assert torch.equal(output["depth_median"], torch.full((7, 9), 3.0))
    output["depth_median"][3, 4].backward()
    torch.testing.assert_close(gaussians.means.grad, torch.tensor([[0.0, 0, 0], [0, 0, 1.0]]), rtol=0, atol=1e-6)
    assert not gaussians.opacities.grad.any()


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("means", torch.nan, "means[3]"),
        ("scales", torch.inf, "scales[3]"),
        ("scales", -1.0, "scales[3]"),
        ("quats_wxyz", 0.0, "quats_wxyz[3]"),
        ("opacities", torch.nan, "opacities[3]"),
        ("colors", torch.inf, "colors[3]"),
    ],
)
def test_unusable_surfels_are_named(name, value, part):
    gaussians, camera = found("random")
    getattr(gaussians, name)[3] = value
    with pytest.raises(InputError) as caught:
        cpu_renderer.render_gaussians(gaussians, camera)
    assert part in str(caught.value)


def test_shapes_are_checked():
    gaussians, camera = found("random")
    for broken in (
        gaussians.scales.double(),
        gaussians.scales[:, :1],
        gaussians.scales[:4],
        gaussians.scales[..., None],
    ):
        with pytest.raises(InputError, match="scales"):
            cpu_renderer.render_gaussians(dataclasses.replace(gaussians, scales=broken), camera)
    with pytest.raises(InputError, match="distortion of 3D Gaussians"):
        solid = dataclasses.replace(gaussians, scales=torch.ones(len(gaussians), 3))
        cpu_renderer.render_gaussians(solid, camera, ("distortion",))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_wild_numbers_never_crash(seed):
    """Anything float32 can hold, in any place: an answer or an InputError, never a dead interpreter."""
    gaussians, camera = found("random")
    generator = torch.Generator().manual_seed(seed)
    wild = torch.tensor([0.0, -0.0, 1e-38, -1e38, 1e38, 3e38, torch.inf, torch.nan, 1e-45, 1e10, -1e-10])
    for name in INPUTS:
        value = getattr(gaussians, name)
        hit = torch.rand(value.shape, generator=generator) < 0.02
        value[hit] = wild[torch.randint(len(wild), (int(hit.sum()),), generator=generator)]
    try:
        output, _ = drawn(cpu_renderer, gaussians, camera, torch.float32)
    except InputError:
        return
    assert output.rgb.shape == (camera.height, camera.width, 3)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), exponent=st.integers(-44, 15))
def test_extreme_sizes_and_views_stay_finite(seed, exponent):
    """Discs too small, too large, or seen too nearly edge-on for float32."""
    gaussians = cast(as_surfels(random_gaussians(40, seed, depth=(0.15, 2.0))), torch.float32)
    gaussians.scales[::2] *= 10.0**exponent
    half = torch.tensor(0.5).sqrt()
    gaussians.quats_wxyz[:10] = torch.stack([half, half * 0, half, half * 0])
    gaussians.means[:5, 0] = 0.0
    output, gradients = drawn(cpu_renderer, gaussians, pinhole(9, 7, dtype=torch.float32), torch.float32)
    assert all(torch.isfinite(output[name]).all() for name in OUTPUTS)
    assert all(torch.isfinite(gradients[name]).all() for name in ("opacities", "colors"))
