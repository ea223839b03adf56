"""Pairs of a video that are matched."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from coliags_plugin.reconstruction.structure.features import Features
from coliags_plugin.reconstruction.structure.matching import alike_pairs
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reconstruction.structure.video import MatchedVideo


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


def test_short_videos_are_matched_exhaustively():
    assert len(alike_pairs(video(range(10), 5), SfmSettings())) == 45


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


@pytest.mark.parametrize("count", [26, 74])
def test_pairs_are_few(count):
    pairs = alike_pairs(video(range(count), 30), SfmSettings())
    assert len(pairs) == len(set(pairs)) < 7 * count
    assert all(0 <= first < second < count for first, second in pairs)


@pytest.mark.parametrize("count", [30, 60, 74, 100])
def test_the_middle_of_a_video_is_matched_too(count):
    features = video(range(count), 40)
    pairs = alike_pairs(features, SfmSettings())
    names = tuple(map(str, range(count)))
    matches = {pair: np.zeros((0, 2), np.uint32) for pair in pairs}
    whole = MatchedVideo(
        tuple(map(Path, names)), names, ((8, 8),) * count, tuple(features), (np.zeros(0),) * count, matches
    )
    part = whole.middle(24)
    assert len(part.images) == len(part.features) == 24
    steps = {second - first for first, second in part.matches}
    assert {1, 2, 4} <= steps
    indices = [int(name) for name in part.names]
    gap = {later - earlier for earlier, later in itertools.pairwise(indices)}
    assert len(gap) == 1
    assert abs((indices[0] + indices[-1]) / 2 - (count - 1) / 2) <= 1.0
