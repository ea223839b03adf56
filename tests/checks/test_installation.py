"""`coliags doctor` on a device: what it finds of renderers that are right, wrong or broken."""

import json
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch

from coliags_plugin.checks import trial_views
from coliags_plugin.checks.installation import check_installation
from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.checks.trial_views import PRIMITIVES, Trial, TrialView, try_renderers
from coliags_plugin.renderers import cpu_renderer, triton_renderer
from tests.commands import refused, run
from tests.pretended_cuda import CUDA, PretendedCuda

needs_triton = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
CPU = torch.device("cpu")
SMALL = Trial(TrialView(40, 24, 16), TrialView(20, 16, 8), turns=2, seconds=0.0)


def tried():
    return {result.name: result for result in try_renderers(CPU, SMALL)}


@pytest.mark.thorough
def test_the_renderers_of_a_cpu():
    results = tried()
    drawn = [f"cpu, {name}: {what}" for name in PRIMITIVES for what in ("errors", "speed")]
    assert list(results) == [*drawn, "anchors of coliags: errors"]
    assert {result.status for result in results.values()} == {"passed"}
    errors, speed = results["cpu, surfels: errors"].detail, results["cpu, surfels: speed"].detail
    assert all(word in errors for word in ("rgb", "distortion", "normals", "means", "pose", "compilation included"))
    decoded = results["anchors of coliags: errors"].detail
    assert all(f"{word} " in decoded for word in ("opacities", "colors", "offsets", "features", "scalings"))
    assert "20 Gaussians, 16x8" in speed and speed.count("frames/s") == 2


@pytest.mark.thorough
@needs_triton
def test_a_device_that_is_not_there(monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    with PretendedCuda() as device:
        results = {result.name: result for result in check_installation("cuda", SMALL)}
    assert results["cuda"].detail.startswith("PyTorch for CUDA 12.8")
    assert results["cuda:0"].detail == "a pretended device, compute capability 9.0, 16.0 GiB"
    assert "would use triton" in results["renderer auto"].detail
    of_triton = {name: result for name, result in results.items() if name.startswith("triton,")}
    of_triton |= {"anchors": results["anchors of coliags: errors"]}
    assert len(of_triton) == 5 and {result.status for result in of_triton.values()} == {"passed"}
    assert device.made_current == [CUDA]


def test_without_a_device_it_says_what_it_would_do(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    results = {result.name: result for result in check_installation()}
    assert "its renderers are tried here" in results["cuda"].detail and results["cuda"].status == "skipped"
    assert not any("errors" in name or "speed" in name for name in results)


def wrong_value(output):
    return replace(output, alpha=output.alpha * 1.0002)


def wrong_gradient(output):
    return replace(output, rgb=output.rgb + 0.002 * (output.rgb - output.rgb.detach()))


def not_a_number(output):
    return replace(output, rgb=output.rgb * torch.nan)


@pytest.mark.parametrize(
    ("spoiled", "told"),
    [
        (wrong_value, "wrong: alpha of outputs"),
        (wrong_gradient, "wrong: colors of gradients"),
        (not_a_number, "rgb of outputs"),
    ],
)
def test_a_wrong_renderer_fails(monkeypatch, spoiled, told):
    right = cpu_renderer.render_gaussians
    monkeypatch.setattr(cpu_renderer, "render_gaussians", lambda *args: spoiled(right(*args)))
    results = tried()
    for primitive in PRIMITIVES:
        result = results[f"cpu, {primitive}: errors"]
        assert result.status == "failed" and told in result.detail and "--set renderer=torch" in result.detail


@pytest.mark.thorough
@needs_triton
def test_a_wrong_kernel_fails(monkeypatch):
    """The opacities of a Gaussian are off by a thousandth in the kernel's table."""
    right = triton_renderer.render_gaussians

    def wrong(gaussians, *args):
        return right(replace(gaussians, opacities=gaussians.opacities * 0.999), *args)

    monkeypatch.setattr(triton_renderer, "render_gaussians", wrong)
    with PretendedCuda():
        for primitive in PRIMITIVES:
            (chosen,) = trial_views._chosen(primitive, CUDA)
            assert chosen.name == "triton"
            with pytest.raises(CheckFailedError, match="wrong: "):
                trial_views._errors(chosen.renderer, primitive, CUDA, SMALL.accuracy)


def opacities_off(drawn):
    return drawn._replace(opacities=drawn.opacities * 1.001)


def other_children(drawn):
    return drawn._replace(source_index=drawn.source_index + 1)


@needs_triton
@pytest.mark.parametrize(
    ("spoiled", "told"), [(opacities_off, "wrong: opacities of outputs"), (other_children, "of them the same")]
)
def test_wrong_decoding_fails(monkeypatch, spoiled, told):
    from coliags_plugin.fields.triton_kernels import children

    right = children.visible_children

    def wrong(*args):
        drawn, visible = right(*args)
        return spoiled(drawn), visible

    monkeypatch.setattr(children, "visible_children", wrong)
    with PretendedCuda():
        result = trial_views._result("anchors", lambda: trial_views._decoding_errors(CUDA, SMALL.accuracy))
    assert result.status == "failed" and told in result.detail


def test_an_exception_is_a_failed_check(monkeypatch, capsys):
    def broken(*args):
        raise RuntimeError("\nCUDA error: no kernel image is available.\nCompile with TORCH_USE_CUDA_DSA")

    monkeypatch.setattr(cpu_renderer, "render_gaussians", broken)
    assert run("doctor", "--device", "cpu") == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("BAD")]
    assert len(lines) == 4
    assert all("RuntimeError: CUDA error: no kernel image is available. Until that" in line for line in lines)
    assert run("doctor", "--device", "cpu", "--json") == 1
    failed = [each for each in json.loads(capsys.readouterr().out)["checks"] if each["status"] == "failed"]
    assert all("in broken" in each["traceback"] for each in failed) and len(failed) == 4


def test_a_device_that_cannot_be_is_refused(capsys):
    assert "auto, cpu, cuda or cuda:N" in refused(capsys, "doctor", "--device", "gpu")


@pytest.mark.gpu
def test_a_device_passes():
    assert {result.status for result in try_renderers(CUDA, Trial())} == {"passed"}
