"""Named feature channels: composited like colours by every splatting renderer, with gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.renderers import cpu_renderer, torch_renderer
from tests.renderers.test_torch_renderer import INPUTS, pinhole, random_gaussians

WANTS = ("albedo", "depth_accumulated", "one", "many")


def gaussians_with_features(count=400, dtype=torch.float64):
    """Random Gaussians with 3, 1 and 11 channels, all leaves."""
    gaussians = random_gaussians(count, 5)
    generator = torch.Generator().manual_seed(1)
    features = {name: torch.randn(count, width, generator=generator) for name, width in
                (("albedo", 3), ("one", 1), ("many", 11))}  # fmt: skip
    leaves = {name: getattr(gaussians, name).to(dtype).requires_grad_() for name in INPUTS}
    return replace(
        gaussians, **leaves, features={name: value.to(dtype).requires_grad_() for name, value in features.items()}
    )


@pytest.mark.parametrize("scales", [3, 2], ids=["gaussians3d", "surfels"])
def test_a_feature_equal_to_the_colours_comes_out_as_they_do_over_black(scales):
    gaussians, camera = random_gaussians(200, 3), pinhole(30, 22, 25.0, 25.0)
    features = {"copy": gaussians.colors, "one": torch.ones(200, 1).double()}
    gaussians = replace(gaussians, scales=gaussians.scales[:, :scales], features=features)
    output = torch_renderer.render_gaussians(gaussians, camera, ("copy", "normals", "one"))
    torch.testing.assert_close(output["copy"], output.rgb)
    torch.testing.assert_close(output["one"], output.alpha[..., None])


def test_features_change_nothing_else():
    gaussians, camera = gaussians_with_features(dtype=torch.float32), pinhole(46, 35, 40.0, 41.0, dtype=torch.float32)
    drawn, plain = (
        cpu_renderer.render_gaussians(replace(gaussians, features=features), camera, wants)
        for features, wants in ((gaussians.features, WANTS), ({}, ("depth_accumulated",)))
    )
    assert torch.equal(plain.rgb, drawn.rgb)
    assert torch.equal(plain["depth_accumulated"], drawn["depth_accumulated"])


@pytest.mark.parametrize("module", [cpu_renderer, torch_renderer])
def test_no_gaussians_and_unknown_features(module):
    gaussians = replace(random_gaussians(0), features={"albedo": torch.zeros(0, 3)})
    gaussians = replace(gaussians, **{name: getattr(gaussians, name).float() for name in INPUTS})
    camera = pinhole(9, 7, dtype=torch.float32)
    assert not module.render_gaussians(gaussians, camera, ("albedo",))["albedo"].any()
    with pytest.raises(InputError, match=r"no renderer output 'albed'.*\n?.*'albedo'"):
        module.render_gaussians(gaussians, camera, ("albed",))


def test_unusable_features_are_refused():
    gaussians = gaussians_with_features(dtype=torch.float32)
    camera = pinhole(9, 7, dtype=torch.float32)
    for spoiled, message in ((torch.zeros(3, 2), "feature one of shape"), (torch.zeros(400, 1).double(), "float64")):
        with pytest.raises(InputError, match=message):
            cpu_renderer.render_gaussians(replace(gaussians, features={"one": spoiled}), camera, ("one",))
