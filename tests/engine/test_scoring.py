"""Error profiles of held-out views against closed forms, and refinement of their poses, which undoes a perturbation."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from coliags_plugin.contracts import Comparison
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.scoring import ANGLE_EDGES, DISTANCE_EDGES, ErrorProfiles, Scorer, refined_camera
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from tests.renderers.test_torch_renderer import FieldOf
from tests.scenes import camera_at
from tests.textured_tube import tube_frames


def pose(yaw=0.3):
    return camera_at(1.0, 2.0, 3.0, yaw=yaw).camera_to_world


def view(camera, depth, rgb_error=0.1, depth_error=2.0, mask=None, depth_valid=None):
    """A frame of this true depth and its rendering with these errors."""
    image = torch.full((camera.height, camera.width, 3), 100, dtype=torch.uint8)
    frame = Frame.of("f", 0, image, camera, depth, mask)
    is_known = torch.isfinite(depth) if depth_valid is None else depth_valid
    compared = Comparison(
        frame.rgb + rgb_error, frame.rgb, frame.valid, depth + depth_error, depth, is_known & frame.valid
    )
    return compared, frame


def profiles(*views, unit="mm"):
    records = ErrorProfiles(unit, 1.0)
    for compared, frame in views:
        records.add(compared, frame)
    return records.records()


def pixel(column, row, camera):
    """The bin indices of one pixel's distance per z-depth and angle, by trigonometry."""
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    return math.sqrt(1 + x * x + y * y), math.degrees(math.acos(1 / math.sqrt(1 + x * x + y * y)))


def test_a_distance_on_an_edge_belongs_to_the_bin_above():
    camera = Camera(10.0, 10.0, 0.5, 0.5, 1, 1, pose())
    for edge, z in enumerate(DISTANCE_EDGES[1:-1], start=1):
        assert profiles(view(camera, torch.tensor([[z]])))["distance"].pixels[edge] == 1


def test_pixels_and_errors_are_in_the_bins_where_trigonometry_puts_them():
    """Colour error grows with the angle and depth error with the distance: each bin has the mean over its pixels."""
    camera = Camera(20.0, 17.0, 15.0, 12.5, 32, 24, pose())
    rays = np.array([[pixel(column, row, camera) for column in range(32)] for row in range(24)])
    depth = torch.rand(24, 32, generator=torch.Generator().manual_seed(0)) * 90 + 1
    rgb_error, depth_error = rays[..., 1] / 1000, rays[..., 0]
    compared = view(camera, depth, torch.from_numpy(rgb_error)[..., None], torch.from_numpy(depth_error))
    records = profiles(compared)
    assert (records["distance"].unit, records["angle"].unit) == ("mm", "degrees")
    assert profiles(compared, unit="units")["distance"].unit == "units"
    bins = {"distance": (rays[..., 0] * depth.numpy(), DISTANCE_EDGES), "angle": (rays[..., 1], ANGLE_EDGES)}
    for name, (where, edges) in bins.items():
        assert records[name].edges == edges and sum(records[name].pixels) == 24 * 32
        for index, (low, high) in enumerate(pairwise(edges)):
            inside = (where >= low) & (where < high)
            assert records[name].pixels[index] == inside.sum()
            for errors, means in ((rgb_error, records[name].rgb_mse), (depth_error, records[name].depth_mse)):
                mean = pytest.approx((errors[inside] ** 2).mean(), rel=1e-4) if inside.any() else None
                assert means[index] == mean


def test_the_mean_is_over_the_pixels_of_all_frames_and_channels():
    camera, wide = Camera(10.0, 10.0, 0.5, 0.5, 1, 1, pose()), Camera(1e3, 1e3, 1.0, 0.5, 2, 1, pose(1.0))
    first = view(camera, torch.tensor([[12.0]]), rgb_error=torch.tensor([0.3, 0.0, 0.0]), depth_error=3.0)
    second = view(wide, torch.tensor([[12.0, 13.0]]), rgb_error=0.0, depth_error=0.0)
    records = profiles(first, second)["distance"]
    assert records.pixels[2] == 3
    assert records.depth_mse[2] == 3.0
    assert records.rgb_mse[2] == pytest.approx(0.09 / 3 / 3, rel=1e-5)


def test_only_pixels_of_known_depth_that_are_compared_count():
    camera = Camera(1e3, 1e3, 2.0, 0.5, 4, 1, pose())
    depth = torch.tensor([[12.0, torch.nan, 12.0, 400.0]])
    compared = view(camera, depth, mask=torch.tensor([[True, True, False, True]]))
    assert sum(profiles(compared)["distance"].pixels) == 1, "one is masked, one unknown, and one beyond the last edge"
    everywhere = view(camera, depth, depth_valid=torch.ones(1, 4, dtype=torch.bool))
    assert sum(profiles(everywhere)["distance"].pixels) == 2, "a protocol that compares unknown depth has no distance"


def test_a_depth_that_is_not_finite_leaves_its_bin_without_a_value():
    camera = Camera(1e3, 1e3, 1.0, 0.5, 2, 1, pose())
    records = profiles(view(camera, torch.tensor([[12.0, 12.0]]), depth_error=torch.tensor([[torch.inf, 1.0]])))
    assert records["distance"].pixels[2] == 2 and records["distance"].depth_mse[2] is None
    assert records["distance"].rgb_mse[2] is not None


def test_without_true_depth_there_is_no_profile():
    frame = Frame.of("f", 0, torch.zeros(1, 1, 3, dtype=torch.uint8), Camera(10.0, 10.0, 0.5, 0.5, 1, 1, pose()))
    assert profiles((Comparison(frame.rgb, frame.rgb, frame.valid), frame)) == profiles() == {}


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
