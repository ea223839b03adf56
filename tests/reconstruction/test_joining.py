"""Joins between models of a video: the same wall found again, models made one, and unrelated ones left apart."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from coliags_plugin.core.images import write_image
from coliags_plugin.reconstruction.structure import joining, sfm
from coliags_plugin.reconstruction.structure.atlas import part_of
from coliags_plugin.reconstruction.structure.features import quiet_colmap
from coliags_plugin.reconstruction.structure.hypotheses import Hypothesis
from coliags_plugin.reconstruction.structure.image_files import list_images
from coliags_plugin.reconstruction.structure.joining import join_models, stretches_of
from coliags_plugin.reconstruction.structure.sfm import reconstruct
from coliags_plugin.reconstruction.structure.sfm_settings import (
    CameraSettings,
    SfmSettings,
    TrackSettings,
    tracked_starts,
)
from coliags_plugin.reconstruction.structure.video import read_video
from tests.textured_tube import INTRINSICS, tube_frames

COUNT, HALF = 26, 13
TRACKED = SfmSettings(camera=CameraSettings(model="PINHOLE", params=INTRINSICS), matching="tracks")
#: Of the second half's model, from the world of the first.
SCALE, TURN, MOVE = 2.5, Rotation.from_euler("xyz", [20.0, -50.0, 130.0], True).as_matrix(), np.array([3.0, -7.0, 40.0])


def images_of(folder, frames):
    for index, frame in enumerate(frames):
        # Lit from the camera, as an image of one brightness is not told from its reversal in depth.
        light = (30.0 / frame.depth.numpy()[..., None]) ** 0.9
        write_image(folder / f"{index:04d}.png", np.clip(frame.image.numpy() * light, 0, 255).astype(np.uint8))
    return tuple(list_images(folder))


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    """A video, its model, and that model cut into two, the second in another frame and scale."""
    folder = tmp_path_factory.mktemp("tube")
    images = images_of(folder, tube_frames(COUNT, 1.0))
    with quiet_colmap(0):
        video = read_video(images, TRACKED)
        (whole,) = video.mapped(TRACKED, tracked_starts(TRACKED.camera)[0][0], None)
    parts = [part_of(whole, range(HALF)), part_of(whole, range(HALF, COUNT))]
    parts[1].transform(pycolmap.Sim3d(SCALE, pycolmap.Rotation3d(TURN), MOVE))
    return video, whole, [Hypothesis.of(part, video.brightness) for part in parts]


@pytest.mark.thorough
def test_models_of_the_same_wall_become_one(halves):
    video, whole, parts = halves
    with quiet_colmap(0):
        extended, (joined,), apart = join_models(video, parts, TRACKED)
    assert apart == {}
    assert joined.frames == list(range(COUNT))
    again = joined.joins[HALF - 1]
    assert again.before == HALF
    assert again.agreeing >= 20  # of 32
    assert again.spread < 0.05
    assert again.similarity is None
    centers = [
        np.array([model.images[number].projection_center() for number in range(1, COUNT + 1)])
        for model in (joined.model, whole)
    ]
    # In the frame and scale of the first half, of as many frames as the second.
    np.testing.assert_allclose(centers[0], centers[1], atol=0.02 * np.ptp(centers[1], axis=0).max())
    for pixels, more, light, ids in zip(
        video.keypoints, extended.keypoints, extended.brightness, extended.track_ids, strict=True
    ):
        np.testing.assert_array_equal(more[: len(pixels)], pixels)
        assert len(more) == len(light) == len(np.unique(ids))


@pytest.mark.thorough
@pytest.mark.parametrize("moves", [False, True])
def test_models_that_are_too_long_together_are_related(halves, moves, monkeypatch):
    video, _, parts = halves
    short = TRACKED
    if moves:
        monkeypatch.setattr(joining, "rigid_frames", lambda model, tracks: COUNT - 1)
    else:
        short = TRACKED.model_copy(update={"tracks": TrackSettings(longest_window=COUNT - 1)})
    with quiet_colmap(0):
        same, kept, apart = join_models(video, parts, short)
    assert same is video
    assert [part.frames for part in kept] == [list(range(HALF)), list(range(HALF, COUNT))]
    matrix = np.array(apart[HALF - 1].similarity)
    assert np.cbrt(np.linalg.det(matrix[:, :3])) == pytest.approx(1.0 / SCALE, rel=0.03)
    np.testing.assert_allclose(SCALE * matrix[:, :3], TURN.T, atol=0.03)
    cameras = [parts[1].model.images[number].projection_center() for number in range(HALF + 1, COUNT + 1)]
    np.testing.assert_allclose(
        np.array(cameras) @ matrix[:, :3].T + matrix[:, 3],
        (np.array(cameras) - MOVE) @ TURN / SCALE,
        atol=0.03 * np.ptp(cameras, axis=0).max() / SCALE,
    )


@pytest.mark.thorough
def test_what_is_split_and_joined_again_is_told_as_joined(tmp_path, monkeypatch):
    monkeypatch.setattr(sfm, "rigid_frames", lambda model, tracks: HALF)
    atlas = reconstruct(images_of(tmp_path, tube_frames(COUNT, 1.0)), TRACKED)
    assert [model.registered for model in atlas.models] == [tuple(range(COUNT))]
    assert [(link.after, link.again.before) for link in atlas.largest.links if link.again] == [(HALF - 1, HALF)]
    assert atlas.refused == ()


@pytest.mark.thorough
def test_unrelated_walls_are_not_joined(tmp_path):
    frames = [*tube_frames(HALF, 1.0), *tube_frames(HALF, 1.0, coarseness=1.4)]
    atlas = reconstruct(images_of(tmp_path, frames), TRACKED)
    assert [len(model.registered) for model in atlas.models] == [HALF, HALF]
    assert [link.again for link in atlas.refused] == [None]


def test_stretches_end_at_other_models_and_at_cuts():
    models = [[0, 1, 2, 6, 7, 8, 9], [3, 4]]
    assert stretches_of(models, set()) == [range(3), range(3, 5), range(6, 10)]
    assert stretches_of(models, {7}) == [range(3), range(3, 5), range(6, 8), range(8, 10)]
    assert stretches_of([[0, 4]], {2}) == [range(1), range(4, 5)]
    assert stretches_of([], set()) == []
