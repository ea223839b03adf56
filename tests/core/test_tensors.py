"""Arithmetic of cameras, maps and masks, bounds of numbers, and copies to a device."""

from __future__ import annotations

import shutil
import sys
import sysconfig
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from coliags_plugin.core import libraries
from coliags_plugin.core.arrays import dilated, eroded
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import PointCloud, concatenate_targets
from coliags_plugin.core.tensors import bilinear, constant, fixed_uniform, masked_mean, pixel_ids, sent, zero_outside
from coliags_plugin.datamanagers.fusion import subsampled
from coliags_plugin.geometry.lenses.models import FisheyeLens, OpenCVLens
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests.pretended_cuda import CUDA, PretendedCuda
from tests.scenes import camera_at, wall_scene


@settings(max_examples=25, deadline=None)
@given(x=st.floats(-5, 5), y=st.floats(-5, 5), z=st.floats(-5, 5), yaw=st.floats(-3, 3), depth=st.floats(0.1, 100))
def test_unproject_then_project_is_the_pixel_centre(x, y, z, yaw, depth):
    camera = camera_at(x, y, z, yaw=yaw)
    points = camera.unproject(torch.full((24, 32), depth, dtype=torch.float64))
    pixels, depths = camera.project(points.reshape(-1, 3))
    rows, columns = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    expected = torch.stack([columns, rows], -1).reshape(-1, 2).double() + 0.5
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(depths, torch.full_like(depths, depth), rtol=1e-9, atol=0)


def test_project_agrees_with_the_matrices():
    camera = camera_at(1.0, 2.0, 3.0, yaw=0.3)
    point = torch.tensor([2.0, 1.0, 15.0], dtype=torch.float64)
    local = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    homogeneous = camera.intrinsics_matrix @ local
    pixels, depth = camera.project(point[None])
    torch.testing.assert_close(pixels[0], homogeneous[:2] / homogeneous[2])
    torch.testing.assert_close(depth[0], local[2])


def test_resized_camera_sees_the_same():
    camera = camera_at(0.0, 0.0, 0.0)
    half = camera.resized(16, 12)
    point = torch.tensor([[1.0, -2.0, 10.0]], dtype=torch.float64)
    torch.testing.assert_close(half.project(point)[0] * 2, camera.project(point)[0])


# Fixed random numbers of pixels, against splitmix64 in whole numbers


def splitmix64(state):
    state = (state + 0x9E3779B97F4A7C15) % 2**64
    state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) % 2**64
    return state ^ (state >> 31)


@given(frame=st.integers(0, 100_000), pixel=st.integers(0, 2**32 - 1), seed=st.integers(0, 2**31))
def test_numbers_are_splitmix64_of_frame_pixel_and_seed(frame, pixel, seed):
    assert splitmix64(0) == 0xE220A8397B1DCDAF  # its first published output for seed 0
    ids = pixel_ids(frame, torch.tensor([[pixel]]))
    assert ids.item() == frame * 2**32 + pixel
    assert fixed_uniform(ids, seed).item() == (splitmix64(ids.item() ^ splitmix64(seed)) >> 11) / 2**53


def test_a_pixel_has_one_identifier_however_it_is_drawn():
    first, second = wall_scene().train[:2]
    height, width = first.image.shape[:2]
    whole = torch.stack([first.target.ids, second.target.ids])
    assert len(whole.unique()) == 2 * height * width
    pixels = torch.tensor([[3, 1], [30, 20]])
    both = concatenate_targets([frame.target_at(pixels) for frame in (first, second)])
    assert both.ids.shape == (4, 1)
    assert both.ids[:, 0].tolist() == [*whole[0, [1, 20], [3, 30]].tolist(), *whole[1, [1, 20], [3, 30]].tolist()]


# Masked means, dilation and erosion of masks against OpenCV's, and bilinear samples against scipy's


@settings(max_examples=20, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), seed=st.integers(0, 99))
def test_a_full_mask_is_no_mask_to_the_bit(height, width, seed):
    values = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))
    full = torch.ones(height, width, dtype=torch.bool)
    assert torch.equal(masked_mean(values, full), masked_mean(values, None))
    part = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) < 0.5
    expected = values[part].mean() if part.any() else torch.tensor(0.0)
    torch.testing.assert_close(masked_mean(values, part), expected)
    assert torch.equal(zero_outside(values, full), values)


@pytest.mark.parametrize("reach", [0, 1, 3])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (31, 24)])
def test_squares_of_opencv(reach, size):
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    for seed, share in enumerate((0.05, 0.5, 0.97)):
        mask = np.random.default_rng(seed).random(size) < share
        pixels = mask.astype(np.uint8)
        assert np.array_equal(dilated(mask, reach), cv2.dilate(pixels, kernel, borderType=cv2.BORDER_REPLICATE) > 0)
        assert np.array_equal(eroded(mask, reach), cv2.erode(pixels, kernel, borderType=cv2.BORDER_REPLICATE) > 0)


def test_samples_are_scipys_also_beyond_the_edge():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(7, 9, 2, generator=generator)
    pixels = torch.rand(4, 5, 2, generator=generator) * torch.tensor([13.0, 11.0]) - 2.0
    samples = bilinear(image, pixels)
    rows, columns = (pixels[..., 1] - 0.5).numpy(), (pixels[..., 0] - 0.5).numpy()
    for channel in range(2):
        expected = map_coordinates(image[..., channel].numpy(), [rows, columns], order=1, mode="nearest")
        torch.testing.assert_close(samples[..., channel], torch.from_numpy(expected), atol=1e-5, rtol=0.0)


# Numbers that are finite in a file and useless in a computation


@pytest.mark.parametrize("far", [1e7, 1e38, 1e308, np.inf, np.nan])
@pytest.mark.parametrize("axis", [0, 2])
def test_cameras_far_away_are_refused(far, axis):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, axis, 3] = far
    with pytest.raises(InputError, match=r"^pose 1: "):
        Trajectory(poses)


@pytest.mark.parametrize(
    "values",
    [
        (1e8, 100, 50, 50, 100, 100),
        (1e-9, 100, 50, 50, 100, 100),
        (100, 100, -1e30, 50, 100, 100),
        (100, 100, float("nan"), 50, 100, 100),
        (100, 100, 50, 50, 100_000, 100),
        (100, 100, 50, 50, 100, 0),
    ],
)
def test_intrinsics_out_of_bounds_are_refused(values):
    with pytest.raises(InputError, match=r"^intrinsics fx"):
        Intrinsics(*values)


@pytest.mark.parametrize("lens", [FisheyeLens, OpenCVLens])
@pytest.mark.parametrize(("term", "value"), [("k1", 1e5), ("k2", -1e300), ("k3", float("inf")), ("fx", 1e9)])
def test_lens_terms_out_of_bounds_are_refused(lens, term, value):
    terms = {"fx": 100.0, "fy": 100.0, "cx": 50.0, "cy": 40.0, **{f"k{number}": 0.0 for number in range(1, 5)}}
    assert lens(width=100, height=80, **terms).pinhole.width == 100
    with pytest.raises(InputError, match=f"^a lens with {term} "):
        lens(width=100, height=80, **{**terms, term: value})


def test_points_far_away_are_left_out(caplog):
    positions = torch.tensor([[0.0, 0, 1], [1e7, 0, 0], [0, float("inf"), 0], [0, 0, float("nan")], [1, 1, 1]])
    points = subsampled(PointCloud(positions), 10, np.random.default_rng(0), None)
    assert points.positions.tolist() == [[0, 0, 1], [1, 1, 1]]
    assert "3 of 5 points are not finite, or beyond 1e+06" in caplog.text


# Copies to a device: numbers that stay there, and tensors without a wait


def test_constants_are_of_the_dtype_and_device_and_made_once():
    for dtype in (torch.float32, torch.float64, torch.int64):
        like = torch.zeros(2, dtype=dtype)
        tensor = constant(((1, 2), (3, 4)), like)
        assert torch.equal(tensor, like.new_tensor([[1, 2], [3, 4]])) and tensor.dtype == dtype
        assert constant(((1, 2), (3, 4)), like) is tensor
    with torch.inference_mode():
        first = constant((5.0,), torch.zeros(1))
    (torch.ones(1, requires_grad=True) * first).sum().backward()  # not an inference tensor


def test_constants_and_what_is_sent_stay_on_the_device():
    with PretendedCuda():
        there = torch.zeros(2, device="cuda")
        tensor = constant((7.0, 8.0), there)
        assert tensor.device == CUDA and constant((7.0, 8.0), torch.zeros(2)).device == torch.device("cpu")
    with PretendedCuda():
        assert (constant((7.0, 8.0), torch.zeros(2, device="cuda")) + 1.0).tolist() == [8.0, 9.0]
    here = torch.arange(6.0)
    assert sent(here, "cpu") is here
    with PretendedCuda():
        there = sent(here, "cuda")
        assert there.device == CUDA and there.tolist() == here.tolist()
        assert sent(there, CUDA) is there and sent(there, "cpu").device == torch.device("cpu")


# What is said where triton cannot launch kernels


@pytest.fixture
def lacks(monkeypatch):
    monkeypatch.setattr(libraries, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.10.0"))
    monkeypatch.delenv("CC", raising=False)
    return libraries.what_triton_lacks.__wrapped__


def test_what_triton_lacks_is_said(lacks, monkeypatch, tmp_path):
    (tmp_path / "Python.h").touch()
    monkeypatch.setattr(sysconfig, "get_paths", lambda scheme: {"include": str(tmp_path)})
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "no C compiler" in lacks() and "gcc" in lacks()
    monkeypatch.setenv("CC", "cc")
    assert lacks() is None
    (tmp_path / "Python.h").unlink()
    assert "headers of Python" in lacks()
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.5.1"))
    assert "triton 3.5.1 is older than 3.6" in lacks()
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    assert "triton is not installed" in lacks()
