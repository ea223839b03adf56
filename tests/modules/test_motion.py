"""Pose corrections and image displacements: known perturbations are undone, and the gauge is held."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.gaussians import rotation_of_vector
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import PointCloud, Scene, View
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.modules.motion import ImageWarp, ImageWarpSettings, PoseCorrection
from tests.pretended_cuda import PretendedCuda
from tests.scenes import wall_scene
from tests.textured_tube import tube_frames

STEPS = 800
METHOD = (
    f"schedule.steps={STEPS}",
    "strategy=none",
    "field.sh_degree=0",
    "field.initial_opacity=0.5",
    "losses.depth={name: depth-l1, weight: 1.0, depth: depth_expected}",
    "optimizers.means={lr: 0.0003, final_lr: 0.00003, times_extent: true}",
    "optimizers.scales={lr: 0.01, final_lr: 0.001}",
    "optimizers.opacities={lr: 0.05, final_lr: 0.005}",
    "optimizers.sh0={lr: 0.01, final_lr: 0.001}",
    "modules.poses=pose-correction",
    'optimizers."poses.translation"={lr: 0.02, final_lr: 0.002}',
    'optimizers."poses.rotation"={lr: 0.0008, final_lr: 0.00008}',
)


def test_rotation_of_vector_is_scipys_and_alike_on_every_device():
    generator = torch.Generator().manual_seed(0)
    vectors = 3.0 * torch.randn(20, 3, generator=generator, dtype=torch.float64)
    weights = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    for vector in (*vectors, 1e-4 * vectors[0], 1e-30 * vectors[0], torch.zeros(3, dtype=torch.float64)):
        expected = torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())
        torch.testing.assert_close(rotation_of_vector(vector), expected)
        gradients = []
        for device in ("cpu", "cuda"):
            with PretendedCuda():
                seen = vector.clone().to(device).requires_grad_()
                turned = rotation_of_vector(seen)
                (turned * weights.to(device)).sum().backward()
                torch.testing.assert_close(turned.detach().cpu(), expected)
                gradients.append(seen.grad.cpu())
        torch.testing.assert_close(*gradients)


def make(frames=9):
    scene = wall_scene(frames)
    return scene, PoseCorrection(PoseCorrection.Settings(), scene)


@pytest.mark.parametrize("module", [PoseCorrection, ImageWarp])
def test_scenes_whose_depth_is_not_estimated_may_be_left_as_they_are(module):
    given = wall_scene()
    estimated = [frame.with_maps(depth_confidence=torch.ones_like(frame.depth)) for frame in given.train]
    for scene, settings, is_corrected in (
        (given, module.Settings(), True),
        (given, module.Settings(scenes="estimated"), False),
        (replace(given, train=estimated), module.Settings(scenes="estimated"), True),
    ):
        part, frame = module(settings, scene), scene.train[3]
        with torch.no_grad():
            for values in part.parameters():
                values[3] = 0.01
        output = RenderOutput(frame.rgb.float(), torch.ones(frame.rgb.shape[:2]), frame.camera)
        camera, shaded = part.adjust_camera(frame.camera, frame.view(True)), part.shade(output, frame.view(True))
        assert (camera is not frame.camera or shaded is not output) == is_corrected
        assert all(values.requires_grad == is_corrected for values in part.parameters())
        assert bool(part.learned) == is_corrected and ("not estimated" in part.untrained_views) != is_corrected


def test_corrections_turn_about_what_is_in_view():
    scene, module = make()
    frame = scene.train[3]
    with torch.no_grad():  # opposite in another frame, so that the mean stays 0
        module.rotation[3] = torch.tensor([0.02, -0.03, 0.05])
        module.translation[3] = torch.tensor([0.1, 0.2, 0.3])
        module.rotation[0], module.translation[0] = -module.rotation[3], -module.translation[3]
    moved = module.adjust_camera(frame.camera, frame.view(trained=True))
    pose, other = frame.camera.camera_to_world, moved.camera_to_world
    torch.testing.assert_close(other[:3, :3], rotation_of_vector(module.rotation[3].double()) @ pose[:3, :3])
    torch.testing.assert_close(other[:3, :3] @ other[:3, :3].T, torch.eye(3, dtype=torch.float64))
    depth = 20.0 - frame.camera.center[2]  # of the wall
    assert module._pivot_depths[3] == pytest.approx(depth.item(), rel=1e-6)
    pivots = [p[:3, 3] + depth * p[:3, 2] for p in (pose, other)]
    torch.testing.assert_close(pivots[1] - pivots[0], torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))


def test_held_out_frames_follow_the_frames_around_them():
    """Errors linear in time are corrected in a held-out frame exactly as in the training frames beside it."""
    scene, module = make(frames=17)
    times = torch.tensor(module.frames.times)
    turns, shifts = (
        torch.outer(times - 1.0, torch.tensor(way)) for way in ((0.001, -0.002, 0.003), (0.02, 0.05, -0.03))
    )
    with torch.no_grad():
        module.rotation.copy_(turns)
        module.translation.copy_(shifts)
    middle, last = scene.test_sets["test"][1:]
    assert (middle.name, last.name) == ("0008", "0016")
    moved = module.adjust_camera(middle.camera, middle.view(trained=False)).camera_to_world
    pose, depth = middle.camera.camera_to_world, 20.0 - middle.camera.center[2]
    ahead = 8.0 - times.mean()  # of the mean, which is subtracted
    turn = rotation_of_vector(ahead * torch.tensor([0.001, -0.002, 0.003], dtype=torch.float64))
    torch.testing.assert_close(moved[:3, :3], turn @ pose[:3, :3], rtol=0, atol=1e-7)
    pivots = [p[:3, 3] + depth * p[:3, 2] for p in (pose, moved)]
    expected = ahead * torch.tensor([0.02, 0.05, -0.03], dtype=torch.float64)
    torch.testing.assert_close(pivots[1] - pivots[0], expected, rtol=0, atol=1e-4)
    # beyond the last training frame: its own correction
    ends = [
        module.adjust_camera(last.camera, View(name, time, trained))
        for name, time, trained in (("0016", 16.0, False), ("0015", 15.0, True))
    ]
    torch.testing.assert_close(ends[0].camera_to_world, ends[1].camera_to_world)
    assert module.adjust_camera(last.camera, None) is last.camera


def test_what_was_learned_is_the_root_mean_square_of_the_corrections():
    _, module = make()
    with torch.no_grad():
        module.rotation[2, 0] = math.radians(7.0)
        module.translation[:, 1] = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 0.0])
    assert module.learned["rotation_degrees"] == pytest.approx(math.sqrt((36 + 6) / 7), rel=1e-5)
    assert module.learned["translation"] == pytest.approx(math.sqrt(6 / 7), rel=1e-5)


def test_without_fixed_frames_the_mean_correction_is_none():
    scene, module = make()
    with torch.no_grad():
        module.translation.fill_(1.0)
        module.rotation.fill_(0.1)
    for frame in scene.train:
        adjusted = module.adjust_camera(frame.camera, frame.view(trained=True))
        torch.testing.assert_close(adjusted.camera_to_world, frame.camera.camera_to_world, rtol=0, atol=1e-5)


def aligned_errors(found, true):
    """Translation (mm) and rotation (degrees) left in each pose after the best common rigid motion. [F], [F]"""
    turns = torch.stack([b[:3, :3] @ a[:3, :3].T for a, b in zip(found, true, strict=True)]).sum(0)
    left, _, right = torch.linalg.svd(turns)
    turn = left @ right
    shift = torch.stack([b[:3, 3] - turn @ a[:3, 3] for a, b in zip(found, true, strict=True)]).mean(0)
    distances, angles = [], []
    for a, b in zip(found, true, strict=True):
        distances.append((turn @ a[:3, 3] + shift - b[:3, 3]).norm())
        error = Rotation.from_matrix((b[:3, :3].T @ turn @ a[:3, :3]).numpy())
        angles.append(math.degrees(error.magnitude()))
    return torch.stack(distances), torch.tensor(angles)


@pytest.mark.thorough
def test_known_perturbations_are_undone(tmp_path):
    """Nine cameras in a textured tube, each 0.5 mm and 0.5 degrees off: down to a tenth, up to a common motion."""
    frames = tube_frames(9, 1.0, (120, 96), coarseness=3.0)
    points = torch.cat([frame.camera.unproject(frame.depth).reshape(-1, 3)[::7] for frame in frames[::2]]).float()
    colors = torch.cat([frame.image.reshape(-1, 3)[::7] for frame in frames[::2]])
    generator = torch.Generator().manual_seed(3)
    perturbed = []
    for frame in frames:
        turn, shift = torch.randn(2, 3, generator=generator, dtype=torch.float64)
        pose = frame.camera.camera_to_world.clone()
        pose[:3, :3] = pose[:3, :3] @ rotation_of_vector(turn * math.radians(0.5) / turn.norm())
        pose[:3, 3] += 0.5 * shift / shift.norm()
        perturbed.append(replace(frame, camera=replace(frame.camera, camera_to_world=pose)))
    scene = Scene("tube", perturbed, {"test": []}, PointCloud(points, colors), Provenance(fingerprint="tube"))
    trainer = Trainer(
        load_method("3dgs-depth", METHOD), scene, "tube", RunFolder(tmp_path / "run"), 0, torch.device("cpu")
    )
    module = trainer.model.view_modules["poses"]

    def poses():
        views = [(frame.camera, frame.view(trained=True)) for frame in perturbed]
        return [module.adjust_camera(camera, view).camera_to_world.detach() for camera, view in views]

    true = [frame.camera.camera_to_world for frame in frames]
    distances, angles = aligned_errors(poses(), true)
    assert distances.median() > 0.4 and angles.median() > 0.3
    for _ in range(STEPS):
        trainer.take_step()
    distances, angles = aligned_errors(poses(), true)
    assert distances.median() < 0.05 and angles.median() < 0.05
    assert distances.max() < 0.15 and angles.max() < 0.2


# Image displacements: pixels are moved as told, and between frames in time


WIDTH, HEIGHT = 40, 30


def make_warp(frames=9, **options):
    scene = wall_scene(frames)
    return scene, ImageWarp(ImageWarpSettings(**options), scene)


def picture(seed=0):
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))
    return RenderOutput(rgb, torch.ones(HEIGHT, WIDTH), None)


def of_frame(scene, row):
    return scene.train[row].view(trained=True)


def test_pixels_are_taken_from_where_scipy_takes_them():
    scene, module = make_warp(cells=1)
    with torch.no_grad():
        module.displacement[0] = 100.0 * torch.tensor([2.5, -1.25])[:, None, None] / WIDTH  # the mean of nine is left
    shift = torch.tensor([2.5, -1.25]) * (1.0 - 1.0 / len(scene.train))
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    at = torch.stack([rows + shift[1], columns + shift[0]]).numpy()
    made = module.shade(picture(), of_frame(scene, 0)).rgb
    for channel in range(3):
        expected = map_coordinates(picture().rgb[..., channel].numpy(), at, order=1, mode="nearest")
        torch.testing.assert_close(made[..., channel], torch.from_numpy(expected), atol=1e-5, rtol=0.0)


def test_held_out_frames_move_as_the_frames_around_them():
    scene, module = make_warp()
    first, second = of_frame(scene, 2), of_frame(scene, 3)
    with torch.no_grad():
        module.displacement[2:4] = 3.0
    between = View("held out", (first.time + second.time) / 2.0, trained=False)
    torch.testing.assert_close(module.shade(picture(), between).rgb, module.shade(picture(), first).rgb)
    assert torch.equal(module.shade(picture(), None).rgb, picture().rgb)


@pytest.mark.thorough
def test_a_motion_is_learned():
    scene, module = make_warp(cells=2)
    smooth = torch.linspace(0.0, 6.0, WIDTH).sin()[None, :] * torch.linspace(0.0, 5.0, HEIGHT).cos()[:, None]
    still = replace(picture(), rgb=smooth[..., None].expand(-1, -1, 3))
    moved = torch.cat([still.rgb[:, 1:], still.rgb[:, -1:]], dim=1)  # every pixel shows what was one to its right
    optimizer = torch.optim.Adam(module.parameters(), lr=0.1)
    for _ in range(200):
        optimizer.zero_grad()
        pairs = [(0, moved), (1, still.rgb)]
        sum((module.shade(still, of_frame(scene, row)).rgb - target).abs().mean() for row, target in pairs).backward()
        optimizer.step()
    shift = (module.displacement[0] - module.displacement[1]).detach() * WIDTH / 100.0
    assert shift[0].mean() == pytest.approx(1.0, abs=0.05) and shift[1].abs().mean() < 0.1
