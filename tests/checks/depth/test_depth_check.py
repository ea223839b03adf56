"""Comparison of estimated with true depth: closed forms, the confidence, bad input, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.checks.depth.check import check_depth
from coliags_plugin.checks.depth.measures import measure
from coliags_plugin.checks.depth.page import depth_page, error_map
from coliags_plugin.checks.depth.pairing import Samples
from coliags_plugin.checks.depth.sources import DepthSource, FrameDepth, open_depth
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.datamanagers.c3vd.writer import write_c3vd_scene
from coliags_plugin.datamanagers.units import write_unit
from coliags_plugin.outputs.colormaps import UNKNOWN_GREY, color_table
from coliags_plugin.outputs.image_files import write_depth_tiff
from coliags_plugin.reporting.terminal import page_text
from tests.commands import refused, run
from tests.scenes import wall_scene

SIZE = (40, 30)
TRUE = np.random.default_rng(0).uniform(6.0, 70.0, SIZE[::-1]).astype(np.float32)


def depth_map(depth=TRUE, confidence=None, sparse=None, size=None, intrinsics=None) -> FrameDepth:
    return FrameDepth(depth, confidence, sparse, size or depth.shape[::-1], intrinsics)


def source(*maps: FrameDepth, names=None, metric=True, path="scene") -> DepthSource:
    names = names or [f"{place:04d}" for place in range(len(maps))]
    return DepthSource(Path(path), metric, names, lambda place: maps[place])


TRUTH = source(depth_map(), depth_map(TRUE + 1))


def test_a_factor_is_measured_exactly():
    check = check_depth(source(depth_map(TRUE * 1.03), depth_map((TRUE + 1) * 1.03)), TRUTH)
    errors = check.dense.errors
    assert errors.pixels == 2 * TRUE.size
    for value in (errors.median, errors.p90, errors.bias):
        assert value == pytest.approx(0.03, rel=1e-5)
    assert (errors.within, errors.coverage) == (1.0, 1.0)
    assert errors.median_length == pytest.approx(0.03 * np.median([TRUE, TRUE + 1]), rel=1e-5)
    assert [(band.low, band.high) for band in check.dense.bands] == [(5, 10), (10, 20), (20, 40), (40, 80)]
    assert sum(band.errors.pixels for band in check.dense.bands) == errors.pixels
    assert all(frame.dense.median == pytest.approx(0.03, rel=1e-5) for frame in check.frames)
    assert "+3" in page_text(depth_page(check))


def test_coverage_counts_only_known_truth():
    estimate, truth = TRUE.copy(), TRUE.copy()
    truth[:10] = np.nan
    estimate[20:] = np.nan
    estimate[10:15] = 0.0
    errors = check_depth(source(depth_map(estimate)), source(depth_map(truth))).dense.errors
    assert (errors.pixels, errors.coverage, errors.median) == (5 * 40, 0.25, 0.0)


def test_alignment_takes_the_median_ratio_out():
    spoilt = TRUE / 7.0
    spoilt[:3] *= 2.0
    unknown = source(depth_map(spoilt), metric=False)
    with pytest.raises(InputError, match="--align-scale"):
        check_depth(unknown, source(depth_map()))
    with pytest.raises(InputError, match="unit"):
        check_depth(source(depth_map()), source(depth_map(), metric=False))
    check = check_depth(unknown, source(depth_map()), align_scale=True)
    assert check.scale == pytest.approx(7.0, rel=1e-6)
    assert check.dense.errors.median == pytest.approx(0.0, abs=1e-6)
    assert check.dense.errors.within == pytest.approx(0.9)
    assert "times 7" in page_text(depth_page(check))


def test_a_calibrated_confidence_has_no_calibration_error():
    """Of the pixels that state a confidence of k / 20, k in 20 are good."""
    stated, good = [], []
    for k in range(1, 20, 2):
        stated += [k / 20] * 200
        good += [True] * (10 * k) + [False] * (200 - 10 * k)
    confidence, true = np.array(stated, np.float32), np.full(len(stated), 20.0)
    estimated = np.where(good, 20.4, 25.0)
    found = measure(Samples(estimated, true, confidence))
    assert len(found.bins) == 10
    assert found.calibration_error == pytest.approx(0.0, abs=1e-6)
    # Of the upper half, k = 11, 13, ... 19 in 20 are good.
    assert (found.sure.pixels, found.sure.coverage) == (1000, 0.5)
    assert found.sure.within == pytest.approx(np.mean([11, 13, 15, 17, 19]) / 20)
    # Twice as sure as is right, in the lower half: off by the mean of k / 20 there.
    overconfident = measure(Samples(estimated, true, np.where(confidence < 0.5, 2 * confidence, confidence)))
    assert overconfident.calibration_error > 0.05


def test_confidence_of_zero_is_unknown_not_wrong():
    confidence = np.zeros(TRUE.size, np.float32)
    confidence[:100] = 1.0
    found = measure(Samples(TRUE.ravel(), TRUE.ravel(), confidence))
    assert [(entry.high, entry.pixels, entry.observed) for entry in found.bins] == [(0.0, 1100, 1.0), (1.0, 100, 1.0)]
    assert found.calibration_error == 0.0
    assert measure(Samples(TRUE.ravel(), TRUE.ravel(), np.zeros(TRUE.size))).calibration_error is None
    assert measure(Samples(TRUE.ravel(), TRUE.ravel(), None)).bins == []


@given(st.floats(0.2, 5.0), st.floats(0.0, 0.3), st.integers(0, 99))
def test_alignment_undoes_any_scale(factor, noise, seed):
    rng = np.random.default_rng(seed)
    true = rng.uniform(5.0, 80.0, 201)
    estimated = true * (1.0 + noise * rng.normal(size=201)).clip(0.1)
    a = check_depth(source(depth_map(estimated[None])), source(depth_map(true[None])), align_scale=True)
    b = check_depth(source(depth_map(estimated[None] * factor)), source(depth_map(true[None])), align_scale=True)
    assert b.dense.errors.median == pytest.approx(a.dense.errors.median, abs=1e-9)
    assert b.scale == pytest.approx(a.scale / factor)
    assert b.dense.errors.p90 >= b.dense.errors.median


def test_truth_of_another_size_is_sampled_at_the_estimates_pixels():
    # Each of the estimate's pixels covers 3 x 3 of the truth, whose middle it is compared with.
    fine = np.kron(TRUE, np.array([[9, 9, 9], [9, 1, 9], [9, 9, 9]], np.float32))
    assert check_depth(source(depth_map()), source(depth_map(fine))).dense.errors.median == 0.0


def test_single_points_are_compared_with_the_pixels_that_hold_them():
    pixels = torch.tensor([[0.2, 0.7], [79.9, 59.9], [10.0, 20.0], [5.0, 5.0]])
    true = torch.tensor([TRUE[0, 0], TRUE[29, 39] / 1.1, TRUE[10, 5], float("nan")])
    points = depth_map(None, sparse=SparseDepth(pixels, true), size=(80, 60))
    check = check_depth(source(depth_map()), source(points))
    assert check.dense is None
    assert (check.sparse.errors.pixels, check.sparse.errors.median) == (3, 0.0)
    assert check.sparse.errors.within == pytest.approx(2 / 3)
    assert check.frames[0].dense is None
    assert check.as_json()["sparse"]["errors"]["pixels"] == 3
    assert "single points" in page_text(depth_page(check))


def test_frames_are_matched_by_name_and_else_by_index():
    shifted = source(depth_map(TRUE + 1), depth_map(TRUE + 2), names=["0001", "0002"])
    check = check_depth(shifted, TRUTH)
    assert check.dense.errors.median == 0.0
    assert check.pairs.left_out == (1, 1)
    assert "without a partner: 1 of the estimate, 1 of the truth" in page_text(depth_page(check))
    renamed = source(depth_map(), depth_map(TRUE + 1), names=["a", "b"])
    assert check_depth(renamed, TRUTH).pairs.by == "index"
    with pytest.raises(InputError, match="no frame in common"):
        check_depth(source(depth_map(), names=["a"]), TRUTH)


def test_other_views_are_refused():
    with pytest.raises(InputError, match="30 x 40"):
        check_depth(source(depth_map(TRUE.T)), source(depth_map()))
    camera = Intrinsics(30.0, 30.0, 20.0, 15.0, *SIZE)
    wide = replace(camera, fx=20.0, fy=20.0)
    with pytest.raises(InputError, match="another than the truth's"):
        check_depth(source(depth_map(intrinsics=camera)), source(depth_map(intrinsics=wide)))
    assert check_depth(source(depth_map(intrinsics=camera)), source(depth_map(intrinsics=camera.resized(*SIZE))))


def test_an_estimate_as_truth_and_depths_that_do_not_overlap_are_refused():
    sure = source(depth_map(confidence=np.ones_like(TRUE)))
    with pytest.raises(InputError, match="holds estimated depth: frame 0000 has a confidence"):
        check_depth(source(depth_map()), sure)
    left, right = TRUE.copy(), TRUE.copy()
    left[:, :20], right[:, 20:] = np.nan, np.nan
    with pytest.raises(InputError, match="no estimate at any"):
        check_depth(source(depth_map(left)), source(depth_map(right)))


def test_error_maps_tell_unknown_truth_from_missing_estimates():
    estimate, truth = TRUE + 1, TRUE.copy()
    truth[0], estimate[1] = np.nan, np.nan
    maps = depth_map(estimate), depth_map(truth)
    image = error_map(check_depth(source(maps[0]), source(maps[1])), *maps, limit=1.0)
    assert (image[1] == UNKNOWN_GREY).all()
    assert not (image[0] == UNKNOWN_GREY).any()
    assert (image[2:] == color_table("error")[255]).all()


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """Scenes of a wall: the truth, an estimate 3 % too far, and one without depth."""
    folder = tmp_path_factory.mktemp("wall")
    scene = wall_scene(9)
    frames = sorted([*scene.train, *scene.test_sets["test"]], key=lambda frame: frame.index)
    images = [frame.image.numpy() for frame in frames]
    poses = torch.stack([frame.camera.camera_to_world for frame in frames]).numpy()
    for name, factor in (("truth", 1.0), ("estimate", 1.03), ("none", None)):
        depths = None if factor is None else [frame.depth.numpy() * factor for frame in frames]
        write_c3vd_scene(folder / name, images, poses, frames[0].camera.intrinsics, depths=depths)
    return folder


def test_command_writes_text_json_page_and_maps(wall, tmp_path, capsys):
    argv = ("depth", "check", wall / "estimate", wall / "truth")
    maps = ("--maps", tmp_path / "maps")
    assert run(*argv, "--html", tmp_path / "d.html", *maps) == 0
    told = capsys.readouterr().out
    assert "9, matched by name" in told
    assert run(*argv, "--json") == 0
    facts = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    # Depth is stored in steps of 0.0015 mm.
    assert facts["dense"]["errors"]["median"] == pytest.approx(0.03, abs=1e-4)
    assert len(facts["frames"]) == 9
    page = (tmp_path / "d.html").read_text()
    assert page.count("<img ") == 4 * 4
    images = sorted((tmp_path / "maps").iterdir())
    assert len(images) == 9
    assert read_rgb(images[0]).shape[1] >= 320
    assert "already exists" in refused(capsys, *argv, *maps)


def test_command_refuses_bad_input(wall, tmp_path, capsys):
    assert "no folder" in refused(capsys, "depth", "check", tmp_path / "gone", wall / "truth")
    assert "has no depth" in refused(capsys, "depth", "check", wall / "none", wall / "truth")
    assert "has no depth" in refused(capsys, "depth", "check", wall / "truth", wall / "none")


def test_a_scene_of_unknown_unit_has_to_be_aligned(wall, tmp_path, capsys):
    write_unit(wall / "estimate", "unknown")
    try:
        assert "--align-scale" in refused(capsys, "depth", "check", wall / "estimate", wall / "truth")
        assert run("depth", "check", wall / "estimate", wall / "truth", "--align-scale") == 0
        assert "times 0.9709" in capsys.readouterr().out
    finally:
        (wall / "estimate" / "unit.txt").unlink()


def test_folders_of_depth_maps(wall, tmp_path, capsys):
    folder = tmp_path / "run" / "depth"
    folder.mkdir(parents=True)
    for place in range(2):
        write_depth_tiff(folder / f"{place}.tiff", (TRUE + place) * 1.03)
        (tmp_path / "true").mkdir(exist_ok=True)
        np.save(tmp_path / "true" / f"{place}.npy", TRUE + place)
    confidence = np.full(SIZE[::-1], 255, np.uint8)
    (tmp_path / "run" / "confidence").mkdir()
    cv2.imwrite(str(tmp_path / "run" / "confidence" / "0.png"), confidence)
    check = check_depth(open_depth(folder), open_depth(tmp_path / "true"))
    assert check.dense.errors.median == pytest.approx(0.03, rel=1e-5)
    assert [(entry.high, entry.pixels) for entry in check.dense.bins] == [(0.0, 1200), (1.0, 1200)]
    assert check.dense.calibration_error == 0.0
    cv2.imwrite(str(tmp_path / "run" / "confidence" / "1.png"), confidence[:5])
    assert "confidence" in refused(capsys, "depth", "check", folder, tmp_path / "true")
    (folder / "0.npy").write_bytes(b"")
    assert "several files 0" in refused(capsys, "depth", "check", folder, tmp_path / "true")
    (folder / "0.npy").unlink()
    (folder / "0.tiff").write_bytes(b"II*")
    assert "0.tiff" in refused(capsys, "depth", "check", folder, tmp_path / "true")
    for empty in (TRUE[:0], TRUE[:, :0]):
        np.save(tmp_path / "true" / "0.npy", empty)
        assert "0.npy is an array" in refused(capsys, "depth", "check", tmp_path / "true", tmp_path / "true")
