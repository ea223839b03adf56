"""The compiled kernels against the written definition, and what they refuse.

The definition draws nothing below ``alpha_min`` and stops before ``transmittance_min``. A pixel that float32 rounds to
the other side of such a cut-off is not wrong, only on the cut-off. These pixels are found by moving both cut-offs a
little in float64; there may be few of them, and all others, and the gradients through them, are held to the tolerance.
"""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.renderers import cpu_renderer, torch_renderer
from coliags_plugin.renderers.numba_kernels import pipeline
from tests.renderers.test_torch_renderer import (
    INPUTS,
    OUTPUTS,
    SCENES,
    SUMS,
    cast,
    make,
    pinhole,
    random_gaussians,
    relative,
    scene,
)

#: How far the cut-offs are moved, relative to themselves: more than float32 can be off by.
CUTOFF_MARGIN = 2e-5


def few(pixels):
    """What may lie on a cut-off out of so many pixels: half a percent, or two."""
    return max(2, pixels // 200)


def on_a_cutoff(gaussians, camera):
    """Pixels that look different where the cut-offs are moved."""
    gaussians, camera = cast(gaussians, torch.float64), camera.to(dtype=torch.float64)
    kind = torch_renderer.TorchRendererSettings
    plain = kind()
    alphas = []
    for factor in (1 - CUTOFF_MARGIN, 1 + CUTOFF_MARGIN):
        cuts = {name: getattr(plain, name) * factor for name in ("alpha_min", "transmittance_min")}
        alphas.append(torch_renderer.render_gaussians(gaussians, camera, settings=kind(**cuts)).alpha)
    return (alphas[1] - alphas[0]).abs() > 1e-9


def drawn(module, gaussians, camera, dtype, wants=OUTPUTS, background=(0.3, 0.1, 0.9), ignored=None):
    """Output and gradients of one renderer under random cotangents, which are 0 at the pixels ignored."""
    gaussians = cast(gaussians, dtype, grad=True)
    pose = camera.camera_to_world.to(dtype).clone().requires_grad_()
    options = {"background": background}
    kind = module.CpuRendererSettings if module is cpu_renderer else module.TorchRendererSettings
    posed = dataclasses.replace(camera, camera_to_world=pose)
    output = module.render_gaussians(gaussians, posed, wants, kind(**options))
    generator = torch.Generator().manual_seed(1)
    shape = (camera.height, camera.width)
    cotangents = {k: torch.randn(*shape, *([3] * (k in ("rgb", "normals"))), generator=generator) for k in SUMS}
    if ignored is not None:
        for cotangent in cotangents.values():
            cotangent[ignored] = 0
    loss = sum((output[k] * cotangents[k].to(dtype)).sum() for k in SUMS if k in ("rgb", "alpha", *wants))
    loss.backward()
    gradients = {key: getattr(gaussians, key).grad for key in INPUTS}
    return output, {**gradients, "pose": pose.grad, "means2d": output.splats.means2d.grad}


def thousands():
    """Two thousand Gaussians, many of them over the edge of a cut-off at some pixel or other."""
    gaussians = random_gaussians(2000, 8, depth=(1.0, 12.0), scale=(0.02, 0.2), opacity=(0.02, 1.0))
    return gaussians, pinhole(90, 70, 70.0, 70.0)


@pytest.mark.parametrize("name", [*SCENES, "thousands"])
def test_agrees_with_the_definition_in_float64(name):
    gaussians, camera = thousands() if name == "thousands" else scene(name)
    gaussians, camera = cast(gaussians, torch.float32), camera.to(dtype=torch.float32)
    ignored = on_a_cutoff(gaussians, camera)
    assert int(ignored.sum()) <= few(ignored.numel())
    ours, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32, ignored=ignored)
    true, true_gradients = drawn(torch_renderer, gaussians, camera, torch.float64, ignored=ignored)
    for key in SUMS:
        assert relative(ours[key][~ignored], true[key][~ignored]) <= 1e-5, key
    # Half of the light is one more cut-off, of the median alone.
    off = (ours["depth_median"] - true["depth_median"]).abs() > 1e-5 * true["depth_median"]
    assert int((off & ~ignored).sum()) <= few(ignored.numel())
    for key, gradient in gradients.items():
        allowed = 1e-4 if key == "pose" else 2e-5  # the pose's is a sum that cancels
        assert relative(gradient, true_gradients[key]) <= allowed, key
    torch.testing.assert_close(
        ours.splats.means2d.detach().double(), true.splats.means2d.detach(), rtol=1e-5, atol=1e-4
    )
    assert int((ours.splats.radii.double() != true.splats.radii).sum()) <= len(gaussians) // 1000


@pytest.mark.parametrize(
    ("depths", "opacity"),
    [
        ([5.0], (1 + 1e-5) / 255),
        ([4.0, 5.0], 0.99),  # leave a hundredth of a hundredth
    ],
    ids=["alpha", "transmittance"],
)
def test_pixels_on_a_cutoff_are_found(depths, opacity):
    gaussians = make([[0, 0, depth] for depth in depths], 0.2, opacity)
    assert on_a_cutoff(gaussians, pinhole()).nonzero().tolist() == [[3, 4]]


@pytest.mark.parametrize("wants", [("rgb",), ("depth_accumulated",), ("inverse_depth_accumulated", "normals")])
def test_outputs_do_not_depend_on_what_else_is_asked_for(wants):
    gaussians, camera = scene("random")
    camera = camera.to(dtype=torch.float32)
    few, few_gradients = drawn(cpu_renderer, gaussians, camera, torch.float32, wants)
    many, _ = drawn(cpu_renderer, gaussians, camera, torch.float32)
    for key in ("rgb", "alpha", *wants):
        torch.testing.assert_close(few[key], many[key], rtol=1e-6, atol=1e-6)
    assert all(torch.isfinite(gradient).all() for gradient in few_gradients.values())


@pytest.mark.parametrize("sort", ["by one thread", "by all"])
def test_repeats_to_the_bit_with_any_number_of_threads(sort, monkeypatch):
    if sort == "by all":
        monkeypatch.setattr(pipeline, "_WORTH_SHARING_SORT", 0)
    gaussians, camera = thousands()
    camera = camera.to(dtype=torch.float32)
    first = None
    for threads in (2, 2, 1, 1, 3, 3, 5):
        torch.set_num_threads(threads)
        output, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32)
        first = first or (output, gradients)
        assert all(torch.equal(first[0][key], output[key]) for key in OUTPUTS)
        assert all(torch.equal(first[1][key], gradients[key]) for key in gradients)


@settings(max_examples=25, deadline=None)
@given(n=st.integers(0, 60), width=st.integers(1, 70), height=st.integers(1, 50), seed=st.integers(0, 99))
def test_any_size(n, width, height, seed):
    gaussians, (_, camera) = random_gaussians(n, seed), scene("random")
    camera = dataclasses.replace(camera, width=width, height=height, camera_to_world=torch.eye(4))
    ours, gradients = drawn(cpu_renderer, gaussians, camera, torch.float32)
    true, _ = drawn(torch_renderer, cast(gaussians, torch.float32), camera, torch.float64)
    assert ours.rgb.shape == (height, width, 3)
    # A pixel on a cut-off may fall to either side in float32.
    off = (ours.rgb.detach().double() - true.rgb.detach()).abs().amax(-1) > 1e-4
    assert off.double().mean() <= 0.001 or int(off.sum()) <= 1
    assert all(gradient is None or torch.isfinite(gradient).all() for gradient in gradients.values())


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("means", torch.nan, "means[3]"),
        ("means", torch.inf, "means[3]"),
        ("scales", torch.nan, "scales[3]"),
        ("scales", -1.0, "scales[3]"),
        ("quats_wxyz", 0.0, "quats_wxyz[3]"),
        ("opacities", torch.nan, "opacities[3]"),
        ("colors", torch.inf, "colors[3]"),
    ],
)
def test_unusable_gaussians_are_named(name, value, part):
    gaussians, camera = scene("random")
    gaussians = cast(gaussians, torch.float32)
    getattr(gaussians, name)[3] = value
    with pytest.raises(InputError) as caught:
        cpu_renderer.render_gaussians(gaussians, camera.to(dtype=torch.float32))
    assert part in str(caught.value)


@pytest.mark.parametrize("name", INPUTS)
def test_shapes_and_dtypes_are_checked(name):
    gaussians, camera = scene("random")
    gaussians = cast(gaussians, torch.float32)
    camera = camera.to(dtype=torch.float32)
    value = getattr(gaussians, name)
    # float64, a dimension too many, and rows that do not match
    for broken in (value.double(), value[..., None], torch.cat([value, value[:1]])):
        with pytest.raises(InputError):
            cpu_renderer.render_gaussians(dataclasses.replace(gaussians, **{name: broken}), camera)
    with pytest.raises(InputError, match="no renderer output"):
        cpu_renderer.render_gaussians(gaussians, camera, ("depth",))


def refused_on(device, name):
    gaussians, camera = scene("random")
    gaussians = cast(gaussians, torch.float32)
    elsewhere = dataclasses.replace(gaussians, **{name: getattr(gaussians, name).to(device)})
    with pytest.raises(InputError, match=rf"^{name} on {device}.* for the cpu renderer\. Expected tensors on the cpu"):
        cpu_renderer.render_gaussians(elsewhere, camera.to(dtype=torch.float32))


@pytest.mark.parametrize("name", INPUTS)
def test_tensors_elsewhere_are_refused_by_name(name):
    refused_on("meta", name)


@pytest.mark.gpu
@pytest.mark.parametrize("name", INPUTS)
def test_cuda_tensors_are_refused_by_name(name):
    refused_on("cuda", name)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_wild_numbers_never_crash(seed):
    """Anything float32 can hold, in any place: an answer or an InputError, never a dead interpreter."""
    gaussians, camera = scene("random")
    gaussians = cast(gaussians, torch.float32)
    generator = torch.Generator().manual_seed(seed)
    wild = torch.tensor([0.0, -0.0, 1e-38, -1e38, 1e38, 3e38, torch.inf, torch.nan, 1e-45, 1e10, -1e-10])
    for name in INPUTS:
        value = getattr(gaussians, name)
        hit = torch.rand(value.shape, generator=generator) < 0.02
        value[hit] = wild[torch.randint(len(wild), (int(hit.sum()),), generator=generator)]
    try:
        output, _ = drawn(cpu_renderer, gaussians, camera.to(dtype=torch.float32), torch.float32, ("depth_expected",))
    except InputError:
        return
    assert output.rgb.shape == (camera.height, camera.width, 3)


def test_importing_the_component_does_not_load_numba():
    import subprocess
    import sys

    code = "import sys, coliags_plugin.renderers.cpu_renderer; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "False"
