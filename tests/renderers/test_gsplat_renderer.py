"""The gsplat renderer: its use of gsplat against a stand-in without a GPU, and gsplat itself where there is one."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import sys
import types

import pytest
import torch
from pydantic import ValidationError

from coliags_plugin.checks.installation import check_installation
from coliags_plugin.config import registry
from coliags_plugin.config.components import make_component
from coliags_plugin.core.errors import InputError
from coliags_plugin.renderers import gsplat_library
from coliags_plugin.renderers.choice import choose_renderer
from coliags_plugin.renderers.gsplat_renderer import GsplatRenderer, GsplatRendererSettings, render_with_gsplat
from coliags_plugin.renderers.torch_renderer import render_gaussians
from tests.renderers import fake_gsplat
from tests.renderers.test_torch_renderer import (
    INPUTS,
    OUTPUTS,
    SCENES,
    FieldOf,
    cast,
    make,
    ours,
    pinhole,
    random_cotangents,
    relative,
    scene,
    with_gradients,
)

BACKGROUND = (0.3, 0.1, 0.9)
#: gsplat's cap on alpha, as the definition's setting; with it both draw the same image.
SAME_CAP = {"alpha_max": 0.999}


def forget():
    gsplat_library.load.cache_clear()
    gsplat_library._trial.cache_clear()


@pytest.fixture
def device(monkeypatch):
    """A machine that seems to have a CUDA device and, so far, no gsplat."""
    forget()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: "a stand-in")
    monkeypatch.setattr(gsplat_library, "PROBE_DEVICE", "cpu")
    monkeypatch.setattr(GsplatRenderer, "devices", frozenset({"cpu"}))
    yield
    forget()


@pytest.fixture
def calls(device, monkeypatch):
    """The stand-in for gsplat is installed; what is called of it, from now on, with which arguments."""
    found = []
    monkeypatch.setitem(sys.modules, "gsplat", fake_gsplat.module(found))
    gsplat_library.load()
    found.clear()
    return found


def theirs(**options):
    def draw(gaussians, camera):
        output = render_with_gsplat(gaussians, camera, OUTPUTS, GsplatRendererSettings(**options))
        return {name: output[name] for name in OUTPUTS}, output

    return draw


def single(name):
    gaussians, camera = scene(name)
    return cast(gaussians, torch.float32), camera.to(dtype=torch.float32)


# --- availability -----------------------------------------------------------------------------------------------------


def install(monkeypatch, library=None, error=None):
    """What ``import gsplat`` gives, or raises."""
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    find, load = importlib.util.find_spec, importlib.import_module

    def import_module(name, *rest):
        if name != "gsplat":
            return load(name, *rest)
        if error:
            raise error
        return library

    def find_spec(name, *rest):
        return object() if name == "gsplat" else find(name, *rest)

    monkeypatch.setattr(importlib, "import_module", import_module)
    monkeypatch.setattr(importlib.util, "find_spec", find_spec)


def test_without_a_device_gsplat_is_not_even_looked_for(monkeypatch):
    forget()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    install(monkeypatch, error=AssertionError("gsplat was imported"))
    for build, reason in ((None, "no CUDA device, as this PyTorch is built without CUDA"), ("12.8", "no CUDA device")):
        monkeypatch.setattr(torch.version, "cuda", build)
        found = GsplatRenderer.availability()
        assert not found.ok and found.reason == reason


def test_without_gsplat_it_says_how_to_install_it(device, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "gsplat" else find(name))
    found = GsplatRenderer.availability()
    assert not found.ok and found.reason == "gsplat is not installed: pip install coliags_plugin[cuda]"


def raising(error):
    def call(*args, **kwargs):
        raise error

    return call


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (ImportError("libcudart.so.12: not found"), "gsplat does not load: ImportError: libcudart.so.12: not found"),
        (RuntimeError("\nError building 'gsplat'\n" + "log\n" * 999), "RuntimeError: Error building 'gsplat'"),
        (KeyError(), "gsplat does not load: KeyError"),
        (
            {"__version__": "1.4.0+pt24cu121"},
            "gsplat 1.4.0+pt24cu121 is too old, 1.5 is needed: pip install coliags_plugin[cuda]",
        ),
        (
            {"fully_fused_projection": raising(RuntimeError("no kernel image is available"))},
            "gsplat 1.5.3 does not work on this device: RuntimeError: no kernel image is available",
        ),
        (
            {"fully_fused_projection": lambda *args, **kwargs: (torch.ones(1, 1, 2), torch.full((1, 1, 2), 3.5))},
            "a Gaussian that belongs at pixel (4, 4) is put at [3.5, 3.5], radii [[[1.0, 1.0]]]",
        ),
    ],
)
def test_a_gsplat_that_cannot_be_used_says_why(device, monkeypatch, found, reason):
    library = fake_gsplat.module()
    if isinstance(found, dict):
        vars(library).update(found)
    install(monkeypatch, library, None if isinstance(found, dict) else found)
    answer = GsplatRenderer.availability()
    assert not answer.ok and answer.reason.endswith(reason)


def test_kernels_that_were_never_built_are_no_attribute_of_none(device, monkeypatch):
    library = fake_gsplat.module()
    library.fully_fused_projection = raising(AttributeError("'NoneType' object has no attribute 'projection'"))
    install(monkeypatch, library)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", types.SimpleNamespace(_C=None))
    found = GsplatRenderer.availability()
    assert not found.ok
    assert found.reason == "gsplat 1.5.3 has no CUDA kernels, and found no CUDA toolkit (nvcc) to build them"


def test_a_working_gsplat_is_tried_once(device, monkeypatch):
    found = []
    install(monkeypatch, fake_gsplat.module(found))
    for _ in range(3):
        assert GsplatRenderer.availability() == gsplat_library.Availability(True, "gsplat 1.5.3 on a stand-in")
    assert len(found) == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_on_this_machine_it_declines_and_rendering_says_so():
    forget()
    assert "no CUDA device" in GsplatRenderer.availability().reason
    assert "gsplat" not in sys.modules
    gaussians, camera = single("random")
    with pytest.raises(InputError, match=r"renderer 'gsplat' cannot run here: no CUDA device"):
        render_with_gsplat(gaussians, camera)


def test_auto_and_the_doctor_give_the_reason(monkeypatch):
    forget()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", None)
    reason = "triton runs on cuda, the device is cpu; gsplat runs on cuda, the device is cpu; "
    chosen = choose_renderer(make_component("renderers", "auto"), "gaussians3d", torch.device("cpu"))
    assert chosen.reason.startswith(reason)
    told = {result.name: result for result in check_installation()}
    missing = "cannot run here: no CUDA device, as this PyTorch is built without CUDA"
    assert told["renderer gsplat"].detail == missing
    assert told["renderer gsplat"].status == "skipped"
    assert f"would use {chosen.name} ({reason}" in told["renderer auto"].detail


def test_auto_takes_gsplat_where_it_works(calls):
    # The renderer seems to run on the CPU here, which is where the stand-in is.
    component = make_component("renderers", {"name": "auto", "background": BACKGROUND})
    chosen = choose_renderer(component, "gaussians3d", torch.device("cpu"))
    assert chosen.name == "gsplat" and chosen.reason.endswith("; auto chose gsplat: gsplat 1.5.3 on a stand-in")
    assert chosen.renderer.settings == GsplatRendererSettings(background=BACKGROUND)
    assert choose_renderer(component, "surfels", torch.device("cpu")).name != "gsplat"


# --- against the definition -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_the_stand_in_gives_the_definition_s_numbers(calls, name):
    gaussians, camera = single(name)
    cotangents = random_cotangents(camera)
    found, output, gradients = with_gradients(theirs(background=BACKGROUND), gaussians, camera, cotangents)
    true, expected, true_gradients = with_gradients(
        ours(background=BACKGROUND, **SAME_CAP),
        cast(gaussians, torch.float64),
        camera.to(dtype=torch.float64),
        cotangents,
    )
    for key in OUTPUTS:
        assert found[key].dtype == torch.float32
        assert relative(found[key], true[key]) <= 5e-6, key
    for key, gradient in true_gradients.items():
        assert relative(gradients[key], gradient) <= 2e-5, key
    assert relative(output.splats.means2d.grad, expected.splats.means2d.grad) <= 1e-5
    drawn = expected.splats.radii > 0
    assert relative(output.splats.means2d[drawn], expected.splats.means2d[drawn]) <= 1e-6
    # gsplat's box of a Gaussian may touch the image where its ellipse does not: such ones are drawn on no pixel.
    assert torch.equal(output.splats.radii[drawn], expected.splats.radii[drawn].float())
    assert not output.splats.means2d.grad[~drawn].any()
    assert output.splats.means2d.isfinite().all() and output.splats.means2d.grad.isfinite().all()


def test_one_projection_and_one_pass_serve_all_outputs(calls):
    gaussians, camera = single("off centre")
    render_with_gsplat(gaussians, camera, [name for name in OUTPUTS if name != "depth_median"])
    assert [name for name, _, _ in calls] == [
        "fully_fused_projection",
        "isect_tiles",
        "isect_offset_encode",
        "rasterize_to_pixels",
    ]
    assert calls[-1][1][2].shape == (1, len(gaussians), 8)


@pytest.mark.parametrize(
    ("wants", "channels"),
    [
        ((), 3),
        (("rgb", "alpha"), 3),
        (("depth_median",), 3),
        (("depth_expected", "depth_accumulated"), 4),
        (("inverse_depth_accumulated",), 4),
        (("depth_expected", "inverse_depth_accumulated"), 5),
        (("normals",), 6),
    ],
)
def test_nothing_is_composited_that_is_not_wanted(calls, wants, channels):
    gaussians, camera = single("one pixel wide")
    output = render_with_gsplat(gaussians, camera, wants)
    (features,) = (args[2] for name, args, _ in calls if name.startswith("rasterize"))
    assert features.shape[-1] == channels
    assert set(output.maps) == set(wants) - {"rgb", "alpha"}
    for name in wants:
        assert output[name].shape == (23, 1, *([3] if name in ("rgb", "normals") else []))


def test_gsplat_is_told_the_camera_and_the_settings(calls):
    gaussians, camera = single("off centre")
    camera = dataclasses.replace(camera, near_plane=0.7)
    settings = GsplatRendererSettings(eps2d=0.1, background=BACKGROUND)
    render_with_gsplat(gaussians, camera, ("depth_expected",), settings)
    (_, projection, options), *_, (_, rasterization, backgrounds) = calls
    means, _, _, _, view, intrinsics, width, height = projection
    assert (width, height) == (33, 21) and options["eps2d"] == 0.1 and options["near_plane"] == 0.7
    torch.testing.assert_close(intrinsics[0], torch.tensor([[12.0, 0, -6.5], [0, 30.0, 30.25], [0, 0, 1]]))
    # gsplat sees the world moved to the camera's centre.
    homogeneous = torch.cat([means, torch.ones(len(means), 1)], dim=1)
    world = torch.cat([gaussians.means, torch.ones(len(means), 1)], dim=1)
    torch.testing.assert_close(homogeneous @ view[0].T, world @ camera.world_to_camera.T, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(backgrounds["backgrounds"], torch.tensor([[*BACKGROUND, 0.0]]))
    assert rasterization[4:7] == (33, 21, 16)


def test_the_pose_s_gradient_is_accurate_far_from_the_world_s_origin(calls):
    gaussians, camera = single("random")
    offset = torch.tensor([3e3, -2e3, 1e3])
    pose = camera.camera_to_world.clone()
    pose[:3, 3] += offset
    far = dataclasses.replace(gaussians, means=gaussians.means + offset)
    camera = dataclasses.replace(camera, camera_to_world=pose)
    cotangents = random_cotangents(camera)
    _, _, gradients = with_gradients(theirs(), far, camera, cotangents)
    _, _, expected = with_gradients(ours(), cast(far, torch.float64), camera.to(dtype=torch.float64), cotangents)
    assert relative(gradients["pose"], expected["pose"]) <= 1e-5


def test_opaque_gaussians_are_capped_later_than_the_definition_says(calls):
    gaussians, camera = cast(make([[0, 0, 5.0]], 0.2, 1.0), torch.float32), pinhole(dtype=torch.float32)
    assert render_with_gsplat(gaussians, camera).alpha[3, 4].item() == pytest.approx(0.999)
    assert render_gaussians(gaussians, camera).alpha[3, 4].item() == pytest.approx(0.99)


# --- emptiness and refusals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["none", "behind", "beside"])
def test_an_empty_view_is_the_background_and_a_graph(calls, what):
    means = {"none": torch.zeros(0, 3), "behind": [[0, 0, -2.0]], "beside": [[50.0, 0, 4.0]]}[what]
    n = len(means)
    gaussians = make(means, torch.full((n, 3), 0.1), torch.full((n,), 0.5))
    for background in (BACKGROUND, (0.0, 0.0, 0.0)):
        drawn, pose = cast(gaussians, torch.float32, grad=True), torch.eye(4).requires_grad_()
        output = render_with_gsplat(drawn, pinhole(pose=pose), OUTPUTS, GsplatRendererSettings(background=background))
        assert torch.equal(output.rgb, torch.tensor(background).expand(7, 9, 3))
        assert output.splats.radii.tolist() == [0] * n
        assert not any(output[name].any() for name in OUTPUTS if name != "rgb")
        assert not output["depth_median"].requires_grad
        sum(output[name].sum() for name in OUTPUTS).backward()
        for name in INPUTS:
            assert not getattr(drawn, name).grad.any(), name
        assert output.splats.means2d.grad.shape == (n, 2) and not output.splats.means2d.grad.any()
        assert pose.grad is None or not pose.grad.any()


def test_the_registered_component_renders_a_field(calls):
    assert registry.renderers.get("gsplat") is GsplatRenderer
    assert GsplatRenderer.outputs == set(OUTPUTS) and GsplatRenderer.primitives == {"gaussians3d"}
    gaussians, camera = single("random")
    output = GsplatRenderer(GsplatRendererSettings()).render(FieldOf(gaussians), camera, ("rgb", "depth_expected"))
    assert output.splats.gaussians is gaussians
    with pytest.raises(KeyError):
        output["depth_median"]


def test_what_cannot_be_rendered_says_so(calls, monkeypatch):
    gaussians, camera = single("random")
    renderer, field = GsplatRenderer(GsplatRendererSettings()), FieldOf(gaussians)
    with pytest.raises(InputError, match=r"dtype float64.*float32"):
        renderer.render(FieldOf(cast(gaussians, torch.float64)), camera)
    with pytest.raises(InputError, match="surfels for the gsplat renderer"):
        render_with_gsplat(dataclasses.replace(gaussians, scales=gaussians.scales[:, :2]), camera)
    monkeypatch.setattr(GsplatRenderer, "devices", frozenset({"cuda"}))
    with pytest.raises(InputError, match="Gaussians on cpu"):
        renderer.render(field, camera)


def test_a_pose_of_another_precision_is_cast(calls):
    gaussians, camera = single("random")
    assert render_with_gsplat(gaussians, camera.to(dtype=torch.float64)).rgb.dtype == torch.float32


@pytest.mark.parametrize("options", [{"eps2d": 0.0}, {"tile_size": 8}, {"alpha_max": 0.99}])
def test_settings_are_checked(options):
    with pytest.raises(ValidationError):
        GsplatRendererSettings(**options)


# --- gsplat itself ----------------------------------------------------------------------------------------------------

#: Relative L2 distance of outputs, and of gradients, to the definition: float32's share (covariances are inverted by a
#: determinant that cancels for needles) and that of approximate exponentials and divisions.
TOLERANCES = {name: (2e-5, 5e-4) for name in SCENES} | {"needles": (2e-4, 2e-3), "pancakes": (2e-4, 2e-3)}
POSE = 5  # times as much: a sum that cancels
#: A pixel on a cut-off (alpha at 1/255, light at 1e-4) may fall either way; so many may, at most.
FLIPPED_SHARE, FLIPPED_PIXELS = 0.01, 2
PIXEL_TOLERANCE = 1e-3


def definition(gaussians, camera, cotangents):
    return with_gradients(ours(**SAME_CAP), cast(gaussians, torch.float64), camera.to(dtype=torch.float64), cotangents)


def check_within_the_table(name, device, radii=True):
    """Against the definition; pixels on a cut-off are counted and then left out."""
    gaussians, camera = single(name)
    draw = theirs()
    cotangents = random_cotangents(camera)
    on_device = cast(gaussians, device=device), camera.to(device)
    there, _, _ = with_gradients(draw, *on_device, {k: v.to(device) for k, v in cotangents.items()})
    true, _, _ = definition(gaussians, camera, cotangents)
    flipped = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    for key in ("alpha", "rgb", "depth_accumulated"):
        error = (there[key].detach().cpu().double() - true[key].detach()).abs().view(*flipped.shape, -1).amax(-1)
        flipped |= error > PIXEL_TOLERANCE * true[key].detach().abs().max()
    few = min(FLIPPED_PIXELS, flipped.numel() // 10)
    assert flipped.sum() <= max(few, FLIPPED_SHARE * flipped.numel())
    kept = {k: v * (~flipped).view(*flipped.shape, *[1] * (v.dim() - 2)) for k, v in cotangents.items()}
    _, output, gradients = with_gradients(draw, *on_device, {k: v.to(device) for k, v in kept.items()})
    _, expected, true_gradients = definition(gaussians, camera, kept)
    outputs_bound, gradients_bound = TOLERANCES[name]
    for key in OUTPUTS:
        assert there[key].device.type == device
        if key != "depth_median":  # that one jumps
            assert relative(there[key].cpu()[~flipped], true[key][~flipped]) <= outputs_bound, key
    for key, gradient in true_gradients.items():
        allowed = gradients_bound * (POSE if key == "pose" else 1)
        assert relative(gradients[key].cpu(), gradient) <= allowed, key
    drawn = expected.splats.radii > 0
    assert relative(output.splats.means2d.grad.cpu()[drawn], expected.splats.means2d.grad[drawn]) <= gradients_bound
    differences = output.splats.radii.cpu()[drawn] - expected.splats.radii[drawn]
    assert not radii or (differences.abs() <= 1).all()  # rounded up from a hair beside


@pytest.mark.parametrize("name", SCENES)
def test_float32_as_gsplat_uses_it_stays_within_the_table(calls, monkeypatch, name):
    monkeypatch.setattr(fake_gsplat, "PRECISION", torch.float32)
    check_within_the_table(name, "cpu")


@pytest.fixture
def gsplat():
    """The real one."""
    forget()
    found = GsplatRenderer.availability()
    if not found.ok:
        pytest.skip(found.reason)


@pytest.mark.gpu
@pytest.mark.parametrize("name", SCENES)
def test_gsplat_gives_the_definition_s_numbers(gsplat, name):
    check_within_the_table(name, "cuda")


@pytest.mark.gpu
def test_gsplat_survives_empty_views(gsplat):
    for means in (torch.zeros(0, 3), torch.tensor([[0, 0, -2.0]]), torch.tensor([[50.0, 0, 4.0]])):
        n = len(means)
        gaussians = make(means, torch.full((n, 3), 0.1), torch.full((n,), 0.5))
        gaussians = cast(gaussians, torch.float32, "cuda", grad=True)
        output = render_with_gsplat(gaussians, pinhole(dtype=torch.float32), OUTPUTS)
        assert not output.alpha.any() and not output.splats.radii.any()
        sum(output[name].sum() for name in OUTPUTS).backward()
        assert not any(getattr(gaussians, name).grad.any() for name in INPUTS)
        assert output.splats.means2d.grad.shape == (n, 2) and not output.splats.means2d.grad.any()
