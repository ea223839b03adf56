"""`coliags check installation` on a device: what it finds of renderers that are right, wrong or broken."""

import json
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch

from coliags_plugin.checks import installation
from coliags_plugin.checks.installation import check_installation
from coliags_plugin.renderers.cpu_renderer import CpuRenderer
from coliags_plugin.renderers.triton_renderer import TritonRenderer
from tests.commands import refused, run
from tests.pretended_cuda import CUDA, PretendedCuda

needs_triton = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(installation, "ACCURACY", (40, 24, 16))
    monkeypatch.setattr(installation, "SPEED", (20, 16, 8))


def checked(device="auto"):
    return {result.name: result for result in check_installation(device)}


def test_the_renderers_of_a_cpu_pass(small):
    results = checked("cpu")
    assert not [result for result in results.values() if result.status == "failed"]
    for name in ("renderer cpu", "renderer torch"):
        detail = results[name].detail
        assert "gaussians3d: error at most" in detail and "surfels: error at most" in detail
        assert detail.count("frames/s") == 2
    assert "frames/s" not in results["renderer volume"].detail + results["renderer triton"].detail


@pytest.mark.thorough
@needs_triton
def test_a_device_that_is_not_there(small, monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    right = TritonRenderer.draw
    with PretendedCuda() as device:
        results = checked("cuda")
        # The opacities of a Gaussian are off by a thousandth in the kernel's table.
        monkeypatch.setattr(
            TritonRenderer,
            "draw",
            lambda self, gaussians, *args: right(
                self, replace(gaussians, opacities=gaussians.opacities * 0.999), *args
            ),
        )
        wrong = checked("cuda")["renderer triton"]
    assert results["cuda"].detail.startswith("PyTorch for CUDA 12.8")
    assert results["cuda:0"].detail == "a pretended device, compute capability 9.0, 16.0 GiB"
    assert "would use triton" in results["renderer auto"].detail
    assert results["renderer triton"].status == "passed" and "surfels: error" in results["renderer triton"].detail
    assert wrong.status == "failed" and wrong.detail.startswith("wrong: ")
    assert device.made_current == [CUDA, CUDA]


def test_without_a_device_it_says_what_it_would_do(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    results = checked()
    assert "its renderers are tried here" in results["cuda"].detail and results["cuda"].status == "skipped"
    assert results["renderer triton"].status == "skipped" and "would use cpu" in results["renderer auto"].detail
    assert not any("frames/s" in result.detail for result in results.values())


@pytest.mark.parametrize(
    ("spoiled", "told"),
    [
        (lambda output: replace(output, alpha=output.alpha * 1.0002), "alpha of"),
        (lambda output: replace(output, rgb=output.rgb + 0.002 * (output.rgb - output.rgb.detach())), "colors of"),
        (lambda output: replace(output, rgb=output.rgb * torch.nan), "rgb of"),
    ],
)
def test_a_wrong_renderer_fails(small, monkeypatch, spoiled, told):
    right = CpuRenderer.draw
    monkeypatch.setattr(CpuRenderer, "draw", lambda *args: spoiled(right(*args)))
    result = checked("cpu")["renderer cpu"]
    assert result.status == "failed" and "`renderer=torch`" in result.detail
    assert all(f"{told} {primitive} by " in result.detail for primitive in ("gaussians3d", "surfels"))


def test_an_exception_is_a_failed_check(small, monkeypatch, capsys):
    def broken(*args):
        raise RuntimeError("\nCUDA error: no kernel image is available.\nCompile with TORCH_USE_CUDA_DSA")

    monkeypatch.setattr(CpuRenderer, "draw", broken)
    assert run("check", "installation", "--device", "cpu") == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("BAD")]
    assert "RuntimeError: CUDA error: no kernel image is available. Until that" in line
    assert run("check", "installation", "--device", "cpu", "--json") == 1
    (failed,) = [each for each in json.loads(capsys.readouterr().out)["checks"] if each["status"] == "failed"]
    assert "in broken" in failed["traceback"]


def test_a_device_that_cannot_be_is_refused(capsys):
    assert "auto, cpu, cuda or cuda:N" in refused(capsys, "check", "installation", "--device", "gpu")


@pytest.mark.gpu
def test_a_device_passes():
    assert checked("cuda")["renderer triton"].status == "passed"
