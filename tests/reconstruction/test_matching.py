"""Pairs of a video, and features matched by descriptors alone and along epipolar lines."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.cameras import Camera
from coliags_plugin.reconstruction.structure.features import Features, FeatureSettings, highlights, usable
from coliags_plugin.reconstruction.structure.matching import (
    alike_pairs,
    epipolar_matches,
    mutual_matches,
)
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reconstruction.structure.video import MatchedVideo

#: Error, ratio and distance that leave the decision to the geometry.
LOOSE = (1.0, 1.0, 2.0)


def features(pixels, descriptors, scale=2.0):
    keypoints = np.zeros((len(pixels), 4), np.float32)
    keypoints[:, :2], keypoints[:, 2] = pixels, scale
    descriptors = np.asarray(descriptors, np.float32)
    return Features(keypoints, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def camera(x=0.0, y=0.0, z=0.0):
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, 3] = torch.tensor([x, y, z])
    return Camera(100.0, 90.0, 52.0, 47.0, 100, 100, c2w)


def seen(cam, points):
    pixels, _ = cam.project(torch.as_tensor(points, dtype=torch.float64))
    return pixels.numpy()


@given(st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_mutual_matches_are_those_of_a_plain_loop(seed):
    rng = np.random.default_rng(seed)
    one = features(rng.uniform(0, 12, (20, 2)), rng.normal(size=(20, 128)) + 1.0)
    other = features(rng.uniform(0, 12, (25, 2)), rng.normal(size=(25, 128)) + 1.0)
    distance = np.linalg.norm(one.descriptors[:, None] - other.descriptors[None], axis=2)
    expected = []
    for i in range(20):
        j = distance[i].argmin()
        apart = np.linalg.norm(other.pixels - other.pixels[j], axis=1) > 2.0
        if distance[:, j].argmin() == i and distance[i, j] < min(1.0, 0.97 * distance[i, apart].min()):
            expected.append((i, j))
    np.testing.assert_array_equal(mutual_matches(one, other, 0.97, 1.0), np.array(expected).reshape(-1, 2))


def test_nothing_matches_nothing():
    none, some = features(np.empty((0, 2)), np.empty((0, 128))), features([[1, 1], [9, 9]], np.eye(128)[:2])
    for pair in ((none, some), (some, none)):
        assert mutual_matches(*pair, 0.8, 0.7).shape == (0, 2)
        assert epipolar_matches(*pair, (camera(), camera(1.0)), *LOOSE).shape == (0, 2)
    assert not len(epipolar_matches(some, some, (camera(), camera()), *LOOSE))  # from one place


def test_poses_tell_look_alikes_apart():
    """Four spots that look the same, each on an epipolar line of its own."""
    points = np.array([[-3.0, -3, 20], [-1, -1, 22], [1, 1, 21], [3, 3, 25]])
    cameras = camera(), camera(x=2.0)
    alike = np.ones((4, 128))
    first, second = (features(seen(cam, points), alike) for cam in cameras)
    pairs = epipolar_matches(first, second, cameras, 1.0, 0.7, 0.7)
    np.testing.assert_array_equal(pairs, np.repeat(np.arange(4), 2).reshape(4, 2))
    assert not len(mutual_matches(first, second, 0.7, 0.7))


@pytest.mark.parametrize(
    ("x", "y", "scale", "count"),
    [
        # Along x, off the common row by d: the Sampson distance is d / sqrt(2).
        *((-10.0, off, 1.0, count) for off, count in ((0.0, 1), (1.3, 1), (1.5, 0))),
        # From further right, things in front lie further left.
        *((-8.0, 0.0, 1.0, 1), (8.0, 0.0, 1.0, 0), (-8.0, 0.0, 2.0, 0), (-8.0, 0.0, 1.5, 1)),
    ],
)
def test_the_epipolar_error_is_sampsons_rays_meet_in_front_and_scales_agree(x, y, scale, count):
    """A spot that lies x, y pixels elsewhere in the image of a camera 2 mm to the right."""
    cameras, alike = (camera(), camera(x=2.0)), np.ones((1, 128))
    at = seen(cameras[0], [[0.0, 0, 20]])
    other = features(at + np.array([x, y]), alike, 2.0 * scale)
    assert len(epipolar_matches(features(at, alike), other, cameras, *LOOSE)) == count


def test_highlights_and_masks_yield_no_features():
    image = np.full((60, 80, 3), 100, np.uint8)
    image[20:24, 30:34] = 200  # twice as bright as its surroundings
    image[50:52, 60:62] = 255
    image[:, :10] = 118  # brighter, not by enough
    columns = np.nonzero(highlights(image, FeatureSettings()))[1]
    np.testing.assert_array_equal(np.unique(columns), [30, 31, 32, 33, 60, 61])
    assert not highlights(image, FeatureSettings(highlight_level=256)).any()
    mask = np.ones((60, 80), bool)
    mask[:, 70:] = False
    free = usable(image, mask, FeatureSettings(margin=2))
    assert not free[18:26, 28:36].any()
    assert not free[:, 68:].any()
    assert free[:, 40:50].all()
    assert free[17, 31]


def video(places, reach, seed=0):
    """Images at places on a line; each sees the landmarks, two per unit, within ``reach``."""
    rng = np.random.default_rng(seed)
    landmarks = rng.normal(size=(2 * (max(places) + 2 * reach), 128)).astype(np.float32)
    landmarks /= np.linalg.norm(landmarks, axis=1, keepdims=True)
    made = []
    for place in places:
        seen = landmarks[2 * place : 2 * (place + reach)]
        keypoints = np.column_stack([rng.uniform(0, 300, (len(seen), 2)), np.ones(len(seen)), np.zeros(len(seen))])
        made.append(Features(keypoints.astype(np.float32), seen))
    return made


def test_neighbours_and_growing_steps_while_alike():
    pairs = alike_pairs(video(range(40), 14), SfmSettings())
    assert {second - first for first, second in pairs} == {1, 2, 4, 8}
    assert len(pairs) == 39 + 38 + 36 + 32
    # Nothing in common: neighbours alone.
    assert {second - first for first, second in alike_pairs(video(range(0, 400, 10), 8), SfmSettings())} == {1, 2}


def test_returning_to_a_place_closes_a_loop():
    places = [*range(0, 300, 6), *range(300, 0, -6)]
    pairs = alike_pairs(video(places, 14), SfmSettings())
    loops = [(first, second) for first, second in pairs if second - first > 16]
    assert loops
    assert all(abs(places[first] - places[second]) < 14 for first, second in loops)


@pytest.mark.parametrize("count", [30, 60, 74, 100])
def test_the_middle_of_a_video_is_matched_too(count):
    features = video(range(count), 40)
    pairs = alike_pairs(features, SfmSettings())
    names = tuple(map(str, range(count)))
    matches = {pair: np.zeros((0, 2), np.uint32) for pair in pairs}
    keypoints = tuple(one.keypoints for one in features)
    whole = MatchedVideo(tuple(map(Path, names)), names, ((8, 8),) * count, keypoints, (np.zeros(0),) * count, matches)
    part = whole.search_part(24)
    assert len(part.images) == len(part.keypoints) == 24
    steps = {second - first for first, second in part.matches}
    assert {1, 2, 4} <= steps
    indices = [int(name) for name in part.names]
    gap = {later - earlier for earlier, later in itertools.pairwise(indices)}
    assert len(gap) == 1
    assert abs((indices[0] + indices[-1]) / 2 - (count - 1) / 2) <= 1.0
