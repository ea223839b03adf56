"""Refinement of held-out poses: a known perturbation is undone, and the model stays as it is."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.scoring import Scorer, refined_camera
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from tests.renderers.test_torch_renderer import FieldOf
from tests.textured_tube import tube_frames


@pytest.fixture(scope="module")
def model():
    """Gaussians on the wall of a textured tube."""
    frames = tube_frames(3, 1.0, (64, 52), coarseness=3.0)
    points = torch.cat([frame.camera.unproject(frame.depth.double()).reshape(-1, 3)[::6] for frame in frames])
    colors = torch.cat([frame.rgb.reshape(-1, 3)[::6] for frame in frames])
    count = len(points)
    quats, every = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4), torch.arange(count)
    scales, opacities = torch.full((count, 3), 0.7), torch.full((count,), 0.7)
    wall = Gaussians(points.float(), quats, scales, opacities, colors, every, every)
    tube_model = Model(FieldOf(wall), TorchRenderer(TorchRendererSettings()), {})
    tube_model.register_parameter("weight", torch.nn.Parameter(torch.ones(1)))
    return tube_model


@pytest.fixture(scope="module")
def frame(model):
    """A view of it, and half of its pixels masked."""
    camera = tube_frames(3, 1.0, (64, 52))[1].camera.to(dtype=torch.float32)
    image = (model.render(camera).rgb.clamp(0, 1) * 255).round().to(torch.uint8)
    mask = torch.ones(52, 64, dtype=torch.bool)
    mask[40:] = False
    return Frame.of("0001", 1, torch.where(mask[..., None], image, 0), camera, mask=mask)


@pytest.mark.thorough
def test_a_known_perturbation_is_undone_and_scores_are_better(model, frame):
    true, turn, shift = frame.camera, torch.tensor([0.01, -0.02, 0.03]), torch.tensor([0.4, 0.3, -0.5])
    wrong = replace(frame, camera=true.moved(turn, shift, 40.0))
    for camera, is_near in ((wrong.camera, False), (refined_camera(model, wrong), True)):
        distance = float((camera.center - true.center).norm())
        angle = Rotation.from_matrix((camera.camera_to_world[:3, :3].T @ true.camera_to_world[:3, :3]).numpy())
        degrees = math.degrees(angle.magnitude())
        assert (distance < 0.1 and degrees < 0.2) if is_near else (distance > 0.7 and degrees > 2.0)
    assert model.weight.requires_grad and model.weight.grad is None
    scorer = Scorer("paper", ["psnr", "ssim"])
    darker = frame.with_maps(image=(frame.image * 0.8).to(torch.uint8))
    wrong = replace(darker, camera=true.moved(torch.zeros(3), torch.tensor([0.5, 0.0, 0.0]), 40.0))
    scores = scorer.score(scorer.compare(model, wrong, torch.device("cpu"))).values
    refined, fitted = (scorer.score(view).values for view in scorer.refined(model, wrong))
    assert refined["psnr"] > scores["psnr"] + 0.1
    assert fitted["psnr"] > refined["psnr"] + 10.0 and fitted["psnr"] > 35.0


def test_a_view_of_nothing_keeps_its_pose(model, frame):
    away = frame.camera.moved(torch.tensor([0.0, math.pi, 0.0]), torch.tensor([0.0, 0.0, -500.0]), 0.0)
    lost = replace(frame, camera=away)
    assert refined_camera(model, lost) is away
