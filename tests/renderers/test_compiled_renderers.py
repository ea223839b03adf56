"""The compiled kernels against the written definition, for 3D Gaussians and surfels, and what they refuse.

Those of triton run in triton's interpreter where there is no GPU (``tests/conftest.py``).

The definition draws nothing below ``alpha_min`` and stops before ``transmittance_min``. A pixel that float32 rounds to
the other side of such a cut-off is not wrong, only on the cut-off. These pixels are found by moving the cut-offs a
little in float64; there may be few of them, and all others, and the gradients through them, are held to the tolerance.
"""

import dataclasses
from importlib.util import find_spec

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import rotation_matrices
from coliags_plugin.core.render_output import OUTPUTS
from coliags_plugin.renderers.cpu_renderer import CpuRenderer
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from coliags_plugin.renderers.triton_renderer import TritonRenderer
from tests.renderers import test_surfels as surfels
from tests.renderers import test_torch_renderer as solids
from tests.renderers.test_surfels import as_surfels, make_surfels, outputs_of
from tests.renderers.test_torch_renderer import (
    INPUTS,
    cast,
    make,
    pinhole,
    random_gaussians,
    relative,
    render_gaussians,
)

PRIMITIVES = ("gaussians3d", "surfels")
of_each = pytest.mark.parametrize("primitive", PRIMITIVES)
needs_triton = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")


class Interpreted(TritonRenderer):
    """The triton renderer in triton's interpreter."""

    devices = frozenset({"cpu"})


class OnCuda(TritonRenderer):
    """The triton renderer on a device, from and to tensors on the CPU."""

    def draw(self, gaussians, camera, wants):
        moved = {name: getattr(gaussians, name).cuda() for name in INPUTS}
        moved["features"] = {name: value.cuda() for name, value in gaussians.features.items()}
        output = super().draw(dataclasses.replace(gaussians, **moved), camera, wants)
        maps = {name: value.cpu() for name, value in output.maps.items()}
        return dataclasses.replace(output, rgb=output.rgb.cpu(), alpha=output.alpha.cpu(), maps=maps)


RENDERERS = (
    pytest.param(CpuRenderer, id="cpu"),
    pytest.param(Interpreted, id="triton", marks=needs_triton),
    pytest.param(OnCuda, id="triton on CUDA", marks=[needs_triton, pytest.mark.gpu]),
)
#: What takes long in triton's interpreter is thorough.
SLOW_IN_INTERPRETER = (
    RENDERERS[0],
    pytest.param(Interpreted, id="triton", marks=[needs_triton, pytest.mark.thorough]),
    RENDERERS[2],
)
by_each_at_length = pytest.mark.parametrize("renderer", SLOW_IN_INTERPRETER)
#: How far the cut-offs are moved, relative to themselves: more than float32 can be off by.
CUTOFF_MARGIN = 2e-5
#: An intersection this many times as far as the disc's centre is near the horizon of the disc's plane, where rays are
#: parallel to it: the last cut-off of surfels.
HORIZON = 10.0
#: Accuracy of outputs and gradients where it is not 1e-5 and 2e-5: discs, or what is seen of them, down to a hundredth
#: and a ten-thousandth of a pixel wide magnify the rounding of the pixels' positions.
MAGNIFIED = {("surfels", "needles"): (3e-5, 1.5e-4), ("surfels", "edge-on"): (5e-5, 2e-3)}
#: Channels of the feature maps.
FEATURES = {"one": 1, "many": 11}
BACKGROUND = (0.3, 0.1, 0.9)
#: What float32 holds that is not to be expected.
WILD = torch.tensor([0.0, -0.0, 1e-38, -1e38, 1e38, 3e38, torch.inf, torch.nan, 1e-45, 1e10, -1e-10])
SCENES = [
    (primitive, name)
    for primitive, names in zip(PRIMITIVES, (solids.SCENES, surfels.SCENES), strict=True)
    for name in (*names, "thousands")
]


def few(pixels):
    """Number of pixels that may lie on a cut-off out of so many pixels: half a percent, or two."""
    return max(2, pixels // 200)


def scene(primitive, name="random"):
    """Gaussians and camera in float32."""
    if name == "thousands":  # many of them over the edge of a cut-off at some pixel or other
        gaussians = random_gaussians(2000, 8, depth=(1.0, 12.0), scale=(0.02, 0.2), opacity=(0.02, 1.0))
        gaussians, camera = of_primitive(primitive, gaussians), pinhole(90, 70, 70.0, 70.0)
    else:
        gaussians, camera = (solids if primitive == "gaussians3d" else surfels).scene(name)
    return cast(gaussians, torch.float32), camera.to(dtype=torch.float32)


def of_primitive(primitive, gaussians):
    return gaussians if primitive == "gaussians3d" else as_surfels(gaussians)


def on_a_cutoff(gaussians, camera):
    """Pixels that look different where the cut-offs are moved, or show a disc close to its horizon."""
    gaussians, camera = cast(gaussians, torch.float64), camera.to(dtype=torch.float64)
    are_surfels = gaussians.scales.shape[1] == 2
    kind = TorchRendererSettings
    alphas = []
    for factor in (1 - CUTOFF_MARGIN, 1 + CUTOFF_MARGIN):
        cuts = {name: getattr(kind(), name) * factor for name in ("alpha_min", "transmittance_min")}
        # A surfel is cut off at the near plane pixel by pixel.
        nearer = dataclasses.replace(camera, near_plane=camera.near_plane * (factor if are_surfels else 1))
        alphas.append(render_gaussians(gaussians, nearer, settings=kind(**cuts)).alpha)
    differs = (alphas[1] - alphas[0]).abs() > 1e-9
    return differs | near_horizon(gaussians, camera) if are_surfels else differs


def near_horizon(gaussians, camera):
    plain = TorchRendererSettings()
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
    return horizon


def drawn(renderer, gaussians, camera, dtype, wants=None, ignored=None, of_means2d=0.0):
    """Output and gradients of one renderer under random cotangents, which are 0 at the pixels ignored."""
    wants = wants or outputs_of(gaussians, renderer)
    gaussians = cast(gaussians, dtype, grad=True)
    features = {name: value.to(dtype).clone().requires_grad_() for name, value in gaussians.features.items()}
    pose = camera.camera_to_world.to(dtype).clone().requires_grad_()
    output = render_gaussians(
        dataclasses.replace(gaussians, features=features),
        dataclasses.replace(camera, camera_to_world=pose),
        wants,
        TorchRendererSettings(background=BACKGROUND),
        renderer,
    )
    generator = torch.Generator().manual_seed(1)
    widths = {name: 3 if name in ("rgb", "normals") else 0 for name in OUTPUTS} | FEATURES
    cotangents = {
        name: torch.randn(camera.height, camera.width, *([width] if width else []), generator=generator)
        for name, width in widths.items()
    }
    loss = of_means2d * output.splats.means2d[output.splats.radii > 0].square().sum().cpu()
    for name in {"rgb", "alpha", *wants}:
        if ignored is not None:
            cotangents[name][ignored] = 0
        loss = loss + (output[name] * cotangents[name].to(dtype)).sum()
    loss.backward()
    gradients = {key: getattr(gaussians, key).grad for key in INPUTS}
    gradients |= {name: value.grad for name, value in features.items() if name in wants}
    return output, {**gradients, "pose": pose.grad, "means2d": output.splats.means2d.grad.cpu()}


def with_features(gaussians):
    generator = torch.Generator().manual_seed(4)
    features = {name: torch.randn(len(gaussians), width, generator=generator) for name, width in FEATURES.items()}
    return dataclasses.replace(gaussians, features=features)


@by_each_at_length
@pytest.mark.parametrize(("primitive", "name"), SCENES)
def test_agrees_with_the_definition_in_float64(renderer, primitive, name):
    gaussians, camera = scene(primitive, name)
    ignored = on_a_cutoff(gaussians, camera)
    assert int(ignored.sum()) <= few(ignored.numel())
    wants = outputs_of(gaussians, renderer)
    ours, gradients = drawn(renderer, gaussians, camera, torch.float32, wants, ignored)
    true, true_gradients = drawn(TorchRenderer, gaussians, camera, torch.float64, wants, ignored)
    of_outputs, of_gradients = MAGNIFIED.get((primitive, name), (1e-5, 2e-5))
    if renderer is not CpuRenderer and primitive == "surfels":
        of_gradients *= 3  # sums of offsets in the image, which cancel more than those of offsets on the disc
    # Half of the light is one more cut-off, of the median alone.
    most = (10 if primitive == "surfels" else 1) * of_outputs
    off = (ours["depth_median"] - true["depth_median"]).abs() > most * true["depth_median"]
    assert int((off & ~ignored).sum()) <= few(ignored.numel())
    for key in wants:
        if not (key == "depth_median" and off[~ignored].any()):
            assert relative(ours[key][~ignored], true[key][~ignored]) <= of_outputs, key
    for key, gradient in gradients.items():
        allowed = 5 * of_gradients if key == "pose" else of_gradients  # the pose's is a sum that cancels
        assert relative(gradient, true_gradients[key]) <= allowed, key
    if primitive == "surfels":
        shown, tolerance = true.splats.radii > 0, {"rtol": 1e-6, "atol": 1e-5}
    else:
        shown, tolerance = slice(None), {"rtol": 1e-5, "atol": 1e-4}
    torch.testing.assert_close(
        ours.splats.means2d.detach().cpu().double()[shown], true.splats.means2d.detach()[shown], **tolerance
    )
    assert int((ours.splats.radii.cpu().double() != true.splats.radii).sum()) <= len(gaussians) // 1000


@by_each_at_length
@pytest.mark.parametrize(
    ("primitive", "name", "wants"),
    [
        *((primitive, "random", None) for primitive in PRIMITIVES),  # everything, and a feature
        *(
            pytest.param(primitive, name, wants, marks=pytest.mark.thorough)  # numba compiles every set of outputs
            for primitive, name, *parts in (
                ("gaussians3d", "random", ("rgb",), ("depth_accumulated",), ("inverse_depth_accumulated", "normals")),
                ("gaussians3d", "random", ("many", "normals", "one", "depth_accumulated")),
                ("surfels", "random", ("many", "normals", "one", "depth_accumulated")),
                ("surfels", "across the near plane", ("rgb",), ("depth_median", "normals")),
                ("surfels", "across the near plane", ("inverse_depth_accumulated", "distortion", "one")),
            )
            for wants in parts
        ),
    ],
)
def test_any_outputs_and_features_and_the_centres_own_gradient_agree_with_the_definition(
    renderer, primitive, name, wants
):
    gaussians, camera = scene(primitive, name)
    gaussians, wants = with_features(gaussians), wants or (*outputs_of(gaussians, renderer), "one")
    ignored = on_a_cutoff(gaussians, camera)
    ours, gradients = drawn(renderer, gaussians, camera, torch.float32, wants, ignored, of_means2d=0.01)
    true, true_gradients = drawn(TorchRenderer, gaussians, camera, torch.float64, wants, ignored, of_means2d=0.01)
    for key in {"rgb", "alpha", *wants} - {"depth_median"}:
        assert relative(ours[key][~ignored], true[key][~ignored]) <= 1e-5, key
    if "depth_median" in wants:  # half of the light is one more cut-off
        off = (ours["depth_median"] - true["depth_median"]).abs() > 1e-4 * true["depth_median"]
        assert int((off & ~ignored).sum()) <= few(off.numel())
    for key, gradient in gradients.items():
        assert relative(gradient, true_gradients[key]) <= (1e-4 if key == "pose" else 2e-5), key


@of_each
def test_features_are_composited_like_colours_over_black(primitive):
    gaussians, camera = scene(primitive)
    features = {"copy": gaussians.colors, "white": torch.ones(len(gaussians), 1)}
    copied = dataclasses.replace(gaussians, features=features)
    output = render_gaussians(copied, camera, ("copy", "normals", "white"))
    torch.testing.assert_close(output["copy"], output.rgb)
    torch.testing.assert_close(output["white"], output.alpha[..., None])


@pytest.mark.parametrize("renderer", [CpuRenderer, TorchRenderer])
def test_features_that_are_none(renderer):
    gaussians, camera = scene("gaussians3d")
    nothing = cast(random_gaussians(0), torch.float32)
    nothing, wants = (
        dataclasses.replace(nothing, features={"one": torch.zeros(0, 1)}),
        (*outputs_of(nothing, renderer), "one"),
    )
    assert not render_gaussians(nothing, camera, wants, renderer=renderer)["one"].any()
    with pytest.raises(InputError, match=r"no renderer output 'onne'.*\n?.*'one'"):
        render_gaussians(nothing, camera, ("onne",), renderer=renderer)
    for feature, message in (
        (torch.zeros(3, 2), "feature one of shape"),
        (torch.zeros(len(gaussians), 1).double(), "float64"),
    ):
        with pytest.raises(InputError, match=message):
            spoiled = dataclasses.replace(gaussians, features={"one": feature})
            render_gaussians(spoiled, camera, ("one",), renderer=CpuRenderer)


@of_each
def test_repeats_to_the_bit_with_any_number_of_threads(primitive):
    gaussians, camera = scene(primitive, "thousands")
    wants = outputs_of(gaussians, CpuRenderer)
    if primitive == "surfels":
        gaussians, wants = with_features(gaussians), (*wants, "one")
    first = None
    for threads in (2, 2, 1, 1, 3, 3, 5):
        torch.set_num_threads(threads)
        output, gradients = drawn(CpuRenderer, gaussians, camera, torch.float32, wants)
        first = first or (output, gradients)
        assert all(torch.equal(first[0][key], output[key]) for key in wants)
        assert all(torch.equal(first[1][key], gradients[key]) for key in gradients)


@by_each_at_length
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), size=st.floats(1e-3, 3.0), depth=st.floats(0.21, 4.0), low_pass=st.floats(0.1, 4.0))
def test_bins_miss_no_pixel_that_a_surfel_reaches(renderer, seed, size, depth, low_pass):
    gaussians = random_gaussians(
        1, seed, depth=(depth, 1.5 * depth), scale=(0.1 * size, size), opacity=(0.005, 1.0), spread=1.5
    )
    gaussians = cast(as_surfels(gaussians), torch.float32)
    camera = pinhole(45, 38, 30.0, 27.0, dtype=torch.float32)
    ours = render_gaussians(
        gaussians, camera, settings=TorchRendererSettings(surfel_filter=low_pass), renderer=renderer
    )
    kind = TorchRendererSettings
    exact, posed = cast(gaussians, torch.float64), camera.to(dtype=torch.float64)
    true = render_gaussians(exact, posed, settings=kind(surfel_filter=low_pass)).alpha
    # Pixels on the edge of what is drawn may fall to either side.
    brighter, dimmer = (
        render_gaussians(
            exact,
            dataclasses.replace(posed, near_plane=0.2 * factor),
            settings=kind(surfel_filter=low_pass, alpha_min=factor / 255),
        ).alpha
        for factor in (0.999, 1.001)
    )
    off = (ours.alpha.double() - true).abs() > 1e-3
    assert not (off & (brighter == dimmer)).any()
    assert ours.splats.radii.item() > 0 or not (true > 1.001 / 255).any()


@by_each_at_length
@of_each
@settings(max_examples=25, deadline=None)
@given(n=st.integers(0, 60), width=st.integers(1, 70), height=st.integers(1, 50), seed=st.integers(0, 99))
def test_any_size(renderer, primitive, n, width, height, seed):
    gaussians, (_, camera) = of_primitive(primitive, random_gaussians(n, seed)), scene(primitive)
    camera = dataclasses.replace(camera, width=width, height=height, camera_to_world=torch.eye(4))
    ours, gradients = drawn(renderer, gaussians, camera, torch.float32)
    true, _ = drawn(TorchRenderer, cast(gaussians, torch.float32), camera, torch.float64)
    assert ours.rgb.shape == (height, width, 3) and ours["depth_expected"].shape == (height, width)
    # A pixel on a cut-off may fall to either side in float32.
    off = (ours.rgb.detach().double() - true.rgb.detach()).abs().amax(-1) > 1e-4
    assert off.double().mean() <= 0.001 or int(off.sum()) <= 1
    assert all(gradient is None or torch.isfinite(gradient).all() for gradient in gradients.values())


@pytest.mark.parametrize("renderer", [TorchRenderer, *RENDERERS])
@pytest.mark.parametrize(
    ("made", "mean", "scales", "opacity", "quat"),
    [
        *((make, [0, 0, depth], 0.3, 0.7, [1.0, 0, 0, 0]) for depth in (-3.0, 0.0, 0.1, 0.25)),
        *((each, [0, 0, 4.0], 0.3, 1 / 256, [1.0, 0, 0, 0]) for each in (make, make_surfels)),
        *((each, [], 0.3, 0.7, [1.0, 0, 0, 0]) for each in (make, make_surfels)),
        *((make_surfels, [0, 0, depth], 0.3, 0.7, [1.0, 0, 0, 0]) for depth in (-3.0, 0.25)),
        (make_surfels, [0, 0, 3.0], 0.3, 0.7, [0.5, 0.5, 0.5, 0.5]),  # exactly edge-on: its normal is the x axis
        (make_surfels, [0, 0, 3.0], (0.3, 0.0), 0.7, [1.0, 0, 0, 0]),
        (make_surfels, [90.0, 0, 3.0], 0.3, 0.7, [1.0, 0, 0, 0]),
    ],
)
def test_what_is_not_drawn_gets_no_gradient(renderer, made, mean, scales, opacity, quat):
    gaussians = made(mean, scales, opacity, quats=torch.tensor([quat]).expand(len(mean) // 3, 4))
    gaussians = cast(gaussians, torch.float32, grad=True)
    wants, pose = outputs_of(gaussians, renderer), torch.eye(4).requires_grad_()
    near_plane = 0.0 if mean[2:] == [-3.0] else 0.25
    camera = dataclasses.replace(pinhole(dtype=torch.float32), camera_to_world=pose, near_plane=near_plane)
    output = render_gaussians(gaussians, camera, wants, TorchRendererSettings(background=BACKGROUND), renderer)
    assert torch.equal(output.rgb, torch.tensor(BACKGROUND).expand(7, 9, 3))
    assert output.splats.radii.shape == (len(gaussians),) and not output.splats.radii.any()
    assert not any(output[name].any() for name in wants if name != "rgb")
    sum(output[name].sum() for name in wants).backward()
    for gradient in (*(getattr(gaussians, name).grad for name in INPUTS), pose.grad, output.splats.means2d.grad):
        assert not gradient.any()


@of_each
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, value) for name in ("means", "scales") for value in (torch.nan, torch.inf)),
        *(("scales", -1.0), ("quats_wxyz", 0.0), ("opacities", torch.nan), ("colors", torch.inf)),
    ],
)
def test_unusable_gaussians_are_named(primitive, name, value):
    gaussians, camera = scene(primitive)
    getattr(gaussians, name)[3] = value
    with pytest.raises(InputError, match=rf"{name}\[3\]"):
        render_gaussians(gaussians, camera, renderer=CpuRenderer)


@of_each
def test_shapes_dtypes_devices_and_outputs_are_checked(primitive):
    gaussians, camera = scene(primitive)
    for name in INPUTS:
        value = getattr(gaussians, name)
        for broken, message in (
            (value.double(), rf"^{name} of dtype float64 for the cpu renderer"),
            (value.to("meta"), rf"^{name} on meta for the cpu renderer\. Expected tensors on cpu"),
            (value[..., None], " of shape "),
            (torch.cat([value, value[:1]]), " of shape "),
        ):
            with pytest.raises(InputError, match=message):
                render_gaussians(dataclasses.replace(gaussians, **{name: broken}), camera, renderer=CpuRenderer)
    with pytest.raises(InputError, match="scales"):
        render_gaussians(dataclasses.replace(gaussians, scales=gaussians.scales[:, :1]), camera, renderer=CpuRenderer)
    output, message = ("depth" if primitive == "surfels" else "distortion"), "no renderer output"
    with pytest.raises(InputError, match=message):
        render_gaussians(gaussians, camera, (output,), renderer=CpuRenderer)


@of_each
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_wild_numbers_never_crash(primitive, seed):
    """Anything float32 can hold, in any place: an answer or an InputError, never a dead interpreter."""
    gaussians, camera = scene(primitive)
    generator = torch.Generator().manual_seed(seed)
    for name in INPUTS:
        value = getattr(gaussians, name)
        hit = torch.rand(value.shape, generator=generator) < 0.02
        value[hit] = WILD[torch.randint(len(WILD), (int(hit.sum()),), generator=generator)]
    try:
        output, _ = drawn(CpuRenderer, gaussians, camera, torch.float32)
    except InputError:
        return
    assert output.rgb.shape == (camera.height, camera.width, 3)


@by_each_at_length
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), exponent=st.integers(-44, 15))
def test_extreme_sizes_and_views_stay_finite(renderer, seed, exponent):
    """Discs too small, too large, or seen too nearly edge-on for float32."""
    gaussians = cast(as_surfels(random_gaussians(40, seed, depth=(0.15, 2.0))), torch.float32)
    gaussians.scales[::2] *= 10.0**exponent
    half = torch.tensor(0.5).sqrt()
    gaussians.quats_wxyz[:10] = torch.stack([half, half * 0, half, half * 0])
    gaussians.means[:5, 0] = 0.0
    output, gradients = drawn(renderer, gaussians, pinhole(9, 7, dtype=torch.float32), torch.float32)
    assert all(torch.isfinite(output[name]).all() for name in outputs_of(gaussians, renderer))
    assert all(torch.isfinite(gradients[name]).all() for name in ("opacities", "colors"))


def test_triton_refuses_what_its_kernels_cannot_take():
    gaussians, camera = scene("gaussians3d")
    with pytest.raises(InputError, match="means on cpu for the triton renderer"):
        render_gaussians(gaussians, camera, renderer=TritonRenderer)
    with pytest.raises(InputError, match="means of dtype float64 for the triton renderer"):
        render_gaussians(cast(gaussians, torch.float64), camera, renderer=TritonRenderer)
