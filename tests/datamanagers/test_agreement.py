"""Depth that frames agree on: what is found and mended on surfaces of known depth, and what stays as it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from coliags_plugin.core.provenance import PointsRecord, Provenance
from coliags_plugin.core.scenes import Frame, PointCloud, Scene
from coliags_plugin.datamanagers.agreement import EXACT, Agreement, agreed_depth
from coliags_plugin.datamanagers.fusion import DEPTH_POINTS
from tests.scenes import camera_at

WIDTH, HEIGHT, FRAMES = 48, 40, 24
BLACK = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
#: Noise of depth, relative.
NOISE = 0.03


def scene_of(frames: list[Frame]) -> Scene:
    provenance = Provenance(points=PointsRecord(source=DEPTH_POINTS, seed=4))
    return Scene("scene", frames, {}, PointCloud(torch.zeros(500, 3)), provenance)


def tube(radius: Callable[[int], float] = lambda index: 15.0) -> Scene:
    """A tube along y, filmed from within by a camera that moves across and along it."""
    frames = []
    for index in range(FRAMES):
        camera = camera_at(0.4 * index - 4.8, 0.1 * index, 0.15 * index, WIDTH, HEIGHT, yaw=0.01 * index - 0.12)
        (x, _, z), (across, _, ahead) = camera.center, camera.rays().unbind(-1)
        a, b, c = across**2 + ahead**2, across * x + ahead * z, x**2 + z**2 - radius(index) ** 2
        depth = (-b + (b**2 - a * c).sqrt()) / a
        frames.append(Frame.of(f"{index:04d}", index, BLACK, camera, depth.float()))
    return scene_of(frames)


def still(depth: torch.Tensor, frames: int = 8, mask: torch.Tensor | None = None) -> Scene:
    """Any depth, in front of a camera that rests."""
    camera = camera_at(0.0, 0.0, 0.0, WIDTH, HEIGHT)
    return scene_of([Frame.of(f"{index:04d}", index, BLACK, camera, depth, mask) for index in range(frames)])


def constant_noise(generator: torch.Generator) -> torch.Tensor:
    """A constant for each frame: all quantiles of the normal distribution, shuffled."""
    quantiles = torch.special.ndtri((torch.arange(FRAMES) + 0.5) / FRAMES)
    return quantiles[torch.randperm(FRAMES, generator=generator)][:, None, None].expand(-1, HEIGHT, WIDTH)


def smooth_noise(generator: torch.Generator) -> torch.Tensor:
    coarse = torch.randn(FRAMES, 1, 6, 6, generator=generator)
    values = functional.interpolate(coarse, (HEIGHT, WIDTH), mode="bicubic", align_corners=True)[:, 0]
    return values / values.std()


def white_noise(generator: torch.Generator) -> torch.Tensor:
    return torch.randn(FRAMES, HEIGHT, WIDTH, generator=generator)


def noisy(scene: Scene, kind: Callable[[torch.Generator], torch.Tensor], deviation: float = NOISE) -> Scene:
    factors = (deviation * kind(torch.Generator().manual_seed(3))).exp()
    frames = [frame.with_maps(depth=frame.depth * by) for frame, by in zip(scene.train, factors, strict=True)]
    return replace(scene, train=frames)


def depths(scene: Scene) -> torch.Tensor:
    return torch.stack([frame.depth for frame in scene.train])


def relative_error(scene: Scene, truth: Scene) -> float:
    """Root mean square error of the logarithm of the depth, which must be known everywhere."""
    return float((depths(scene) / depths(truth)).log().square().mean().sqrt())


def step(between: float | None = None) -> torch.Tensor:
    """Depth 12 in columns 0 to 9 and 20 from column 10 on, which may have a depth between."""
    depth = torch.full((HEIGHT, WIDTH), 20.0)
    depth[:, :10] = 12.0
    if between is not None:
        depth[:, 10] = between
    return depth


def blurred(depth: torch.Tensor) -> torch.Tensor:
    """Rows convolved with (1, 2, 1) / 4."""
    padded = functional.pad(depth[None], (1, 1), mode="replicate")[0]
    return (padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]) / 4


@pytest.fixture(scope="module")
def averaged() -> tuple[Scene, Scene, Scene, Agreement]:
    """A tube, the same with smooth noise, what becomes of it, and its agreement."""
    truth = tube()
    given = noisy(truth, smooth_noise)
    return truth, given, *agreed_depth(given)


def test_exact_sharp_depth_stays_as_it_is():
    scene = tube()
    result, agreement = agreed_depth(scene)
    assert result is scene
    assert agreement.noise < 1e-4 and agreement.remaining_noise == agreement.noise and agreement.sharpness == 1.0
    assert str(agreement) == "noise 0.00 %; depth steps are sharp (1.00)"


def test_smooth_noise_is_found_and_averaged(averaged):
    truth, given, result, agreement = averaged
    assert agreement.noise == pytest.approx(NOISE, rel=0.15)
    remaining = relative_error(result, truth)
    assert remaining < NOISE / 3 and agreement.remaining_noise == pytest.approx(remaining, rel=0.3)
    first, second = 100 * agreement.noise, 100 * agreement.remaining_noise
    assert str(agreement) == f"noise {first:.2f} %, averaged to {second:.2f} %; depth steps are sharp (1.00)"
    assert agreement.record["noise"] == agreement.noise and agreement.record["deviations"].keys() >= {"1", "2", "13"}
    again, same = agreed_depth(given)
    assert torch.equal(depths(again), depths(result)) and same == agreement
    assert torch.equal(again.points.positions, result.points.positions)


def test_points_are_fused_again_from_averaged_depth(averaged):
    _, _, result, _ = averaged
    distances = result.points.positions[:, [0, 2]].norm(dim=1)
    assert len(distances) == 500 and float((distances / 15 - 1).square().mean().sqrt()) < NOISE / 3


def test_noise_that_is_constant_in_a_frame_is_averaged_and_points_of_a_file_stay():
    truth = tube()
    given = replace(noisy(truth, constant_noise), provenance=Provenance(points=PointsRecord(source="points3D.ply")))
    result, agreement = agreed_depth(given)
    assert agreement.noise == pytest.approx(NOISE, rel=0.15)
    assert relative_error(result, truth) < NOISE / 3
    assert result.points is given.points


@pytest.mark.parametrize(("breadth", "period"), [(0.5, 40.0), (2.0, 60.0)])
def test_a_wall_that_moves_is_not_averaged(breadth, period):
    scene = tube(lambda index: 15.0 + breadth * math.sin(2 * math.pi * index / period))
    result, agreement = agreed_depth(scene)
    assert result is scene
    assert agreement.noise < EXACT < agreement.deviations[1] < 0.5 * agreement.deviations[3]


def test_noise_is_told_from_motion():
    truth = tube(lambda index: 15.0 + 0.5 * math.sin(2 * math.pi * index / 60))
    result, agreement = agreed_depth(noisy(truth, smooth_noise))
    assert agreement.noise == pytest.approx(NOISE, rel=0.15)
    assert relative_error(result, truth) < NOISE / 2


def test_white_noise_makes_no_steps():
    """It is averaged away, too; bilinear interpolation averages some of it, which is found too small for that."""
    truth = tube()
    result, agreement = agreed_depth(noisy(truth, white_noise, 0.05))
    assert agreement.sharpness == 1.0 and 0.75 * 0.05 < agreement.noise < 0.05
    assert relative_error(result, truth) < 0.05 / 3


def test_pixels_at_a_blurred_step_get_the_depth_of_their_side():
    given = blurred(step())
    assert given[0, 8:12].tolist() == [12.0, 14.0, 18.0, 20.0]
    result, agreement = agreed_depth(still(given))
    assert agreement.is_blurred and agreement.sharpness == pytest.approx(math.log(18 / 14) / math.log(20 / 12))
    assert str(agreement) == "noise 0.00 %; depth steps are blurred and are sharpened (0.49)"
    torch.testing.assert_close(depths(result), step().expand(8, -1, -1))


def test_the_middle_of_a_blurred_step_is_unknown():
    given = blurred(step(between=16.0))
    assert given[0, 8:13].tolist() == [12.0, 13.0, 16.0, 19.0, 20.0]
    result, _ = agreed_depth(still(given))
    torch.testing.assert_close(depths(result), step(between=math.nan).expand(8, -1, -1), equal_nan=True)


def test_slopes_without_flat_sides_stay():
    given = blurred(step())
    fold = 20.0 * (0.3 * torch.cos(2 * math.pi * (torch.arange(WIDTH) - 20) / 16) - 0.3).exp()
    given[:, 20:] = fold[20:]
    result, agreement = agreed_depth(still(given))
    assert agreement.is_blurred
    assert torch.equal(depths(result)[:, :, 20:], given[:, 20:].expand(8, -1, -1))


def test_sharp_steps_are_left_alone():
    depth = step()
    depth[20:26, 20:30] = torch.nan
    scene = still(depth)
    result, agreement = agreed_depth(scene)
    assert result is scene and agreement.sharpness == 1.0


def test_the_rim_of_unknown_depth_is_unknown_where_steps_are_blurred():
    given, mask = blurred(step()), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    given[20:26, 20:30] = torch.nan
    mask[30:, 44:] = False
    result, _ = agreed_depth(still(given, mask=mask))
    unknown = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    unknown[17:29, 17:33] = unknown[27:, 41:] = True
    assert torch.equal(depths(result).isnan(), unknown.expand(8, -1, -1))


def test_few_frames_with_depth_are_not_compared(averaged):
    _, given, _, _ = averaged
    frames = [frame if frame.index < 4 else frame.with_maps(depth=None) for frame in given.train]
    scene = replace(given, train=frames)
    assert agreed_depth(scene) == (scene, None)
    unknown = still(torch.full((HEIGHT, WIDTH), torch.nan))
    assert agreed_depth(unknown) == (unknown, None)


def test_frames_without_depth_stay_and_masked_pixels_are_unknown(averaged):
    truth, given, _, _ = averaged
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:10, :10] = False
    train = [frame.with_maps(mask=mask) for frame in given.train]
    train[7] = train[7].with_maps(depth=None)
    train[9] = train[9].with_maps(depth=torch.full((HEIGHT, WIDTH), torch.nan))
    result, agreement = agreed_depth(replace(given, train=train))
    assert agreement.is_noisy
    assert result.train[7] is train[7] and result.train[9].depth.isnan().all()
    rest = [frame for frame in result.train if frame.index not in (7, 9)]
    assert all(torch.equal(frame.depth.isnan(), ~mask) for frame in rest)
    assert all(torch.equal(after.image, before.image) for after, before in zip(result.train, train, strict=True))
    errors = torch.cat([(frame.depth / truth.train[frame.index].depth)[mask].log() for frame in rest])
    assert float(errors.square().mean().sqrt()) < NOISE / 3
