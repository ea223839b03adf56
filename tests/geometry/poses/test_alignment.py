"""Alignment and errors against independent solvers, brute force and invariances."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.alignment import align, associate, umeyama
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests.geometry.poses.winding import some_transform, trajectories, winding

SEEDS = st.integers(0, 10_000)
SCALES = st.floats(0.01, 100.0)


def moved(trajectory, transform, scale=1.0):
    """A copy of a trajectory in another world."""
    poses = transform @ trajectory.camera_to_world
    poses[:, :3, 3] = scale * (transform[:3, :3] @ trajectory.centers.T).T + transform[:3, 3]
    return Trajectory(poses)


def aligned(estimate, reference, **options):
    return align(estimate, reference, associate(estimate, reference), **options)


@given(trajectory=trajectories(), seed=SEEDS, scale=SCALES, with_scale=st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_known_motion_is_recovered(trajectory, seed, scale, with_scale):
    transform, scale = some_transform(seed), scale if with_scale else 1.0
    target = scale * trajectory.centers @ transform[:3, :3].T + transform[:3, 3]
    fit = umeyama(trajectory.centers, target, with_scale)
    size = max(1.0, float(np.abs(target).max()))
    np.testing.assert_allclose(fit.points(trajectory.centers), target, rtol=0, atol=1e-9 * size)
    assert fit.scale == pytest.approx(scale, rel=1e-7)
    np.testing.assert_allclose(fit.rotation, transform[:3, :3], atol=1e-6)


@given(seed=SEEDS, count=st.integers(4, 20))
@settings(max_examples=20, deadline=None)
def test_rotation_is_scipys(seed, count):
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, count, 3))
    fit = umeyama(source, target)
    expected, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    np.testing.assert_allclose(fit.rotation, expected.as_matrix(), atol=1e-6)
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_straight_path_has_errors_too(scale):
    """Any rotation about the line fits its positions."""
    poses = winding(10, 4).camera_to_world.copy()
    poses[:, :3, 3] = np.linspace(0.0, 30.0, 10)[:, None] * (0.4, 0.9, -0.2)
    reference = Trajectory(poses)
    result = aligned(moved(reference, some_transform(3), scale), reference, with_scale=scale != 1.0)
    assert result.ate.max < 1e-10 and result.rpe_translation.max < 1e-10 and result.rpe_rotation_deg.max < 1e-5
    assert result.transform.scale == pytest.approx(1.0 / scale)
    assert np.linalg.det(result.transform.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("away", [0.0, 100.0])
def test_a_camera_that_stays_in_place_has_no_scale(away):
    poses = winding(6, 2).camera_to_world.copy()
    poses[:, :3, 3] = away
    still = Trajectory(poses)
    extent = winding(6).centers - winding(6).centers.mean(axis=0)
    assert aligned(still, winding(6)).ate.rmse == pytest.approx(np.sqrt((extent**2).sum(axis=1).mean()))
    for pair in ((still, winding(6)), (winding(6), still), (still, still)):
        with pytest.raises(InputError, match="a scale cannot be estimated"):
            aligned(*pair, with_scale=True)


@pytest.mark.parametrize("delta", [1, 3])
def test_errors_by_their_definitions(delta):
    """Sturm et al., equations 1 to 5, frame by frame, of poses with noise."""
    reference, rng = winding(12, 1), np.random.default_rng(2)
    poses = reference.camera_to_world.copy()
    poses[:, :3, 3] += rng.normal(0.0, 0.5, (12, 3))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.05, (12, 3))).as_matrix() @ poses[:, :3, :3]
    estimate = Trajectory(poses)
    result = aligned(estimate, reference, delta=delta)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = result.transform.rotation, result.transform.translation
    translations, angles, positions = [], [], []
    for index in range(12):
        true, estimated = reference.camera_to_world[index], estimate.camera_to_world[index]
        absolute = np.linalg.inv(true) @ transform @ estimated
        positions.append(np.linalg.norm(absolute[:3, 3]))
        if index + delta < 12:
            after, found_after = reference.camera_to_world[index + delta], estimate.camera_to_world[index + delta]
            error = np.linalg.inv(np.linalg.inv(true) @ after) @ (np.linalg.inv(estimated) @ found_after)
            translations.append(np.linalg.norm(error[:3, 3]))
            angles.append(np.rad2deg(np.arccos((np.trace(error[:3, :3]) - 1) / 2)))
    np.testing.assert_allclose(result.position_errors, positions)
    report = json.loads(json.dumps(result.to_json("mm"), allow_nan=False))
    assert report["alignment"] == "SE(3)" and report["frames"]["position_error"] == result.position_errors.tolist()
    assert report["ate_share_of_path"] == pytest.approx(result.ate.rmse / reference.steps.sum())
    for errors, spread in (
        (positions, result.ate),
        (translations, result.rpe_translation),
        (angles, result.rpe_rotation_deg),
    ):
        rmse = np.sqrt(np.mean(np.square(errors)))
        expected = [rmse, np.mean(errors), np.median(errors), np.max(errors)]
        assert list(vars(spread).values()) == pytest.approx(expected, rel=1e-6)
    for step in (0, -1, 12, 100):
        with pytest.raises(InputError, match=f"over {step} frames, and 12 matched frames.*1 to 11"):
            aligned(estimate, reference, delta=step)


def named(names, **options):
    return winding(len(names), names=tuple(names), **options)


def pairs(matches):
    return list(zip(matches.first.tolist(), matches.second.tolist(), strict=True))


TWINS = ["left/a.png", "right/a.png", "left/b.png"]
TIMED = (
    winding(4, timestamps=np.array([0.0, 0.1, 0.2, 0.3])),
    winding(5, timestamps=np.array([0.305, 0.099, 0.11, 0.211, 9.0])),
)


@pytest.mark.parametrize(
    ("first", "second", "by", "expected", "skipped"),
    [
        (named(["c", "a", "x", "b"]), named(["a", "b", "c", "d", "e"]), "name", [(0, 2), (1, 0), (3, 1)], None),
        # Names' last parts, where folders and suffixes differ; one that several frames share serves nobody.
        (named(["i/a.png", "i/b.png", "i/c"]), named(["c.jpg", "b.jpg", "a"]), "name", [(0, 2), (1, 1), (2, 0)], None),
        (named(TWINS), named(["a.jpg", "b.jpg", "c.jpg"]), "index", None, ("by name: 'a' names several frames",)),
        (named(TWINS), named(TWINS), "name", None, None),
        (*TIMED, "time", [(1, 1), (2, 3), (3, 0)], None),
        (winding(5), winding(5, timestamps=np.arange(5.0)), "index", [(k, k) for k in range(5)], ()),
        (*[winding(5, timestamps=np.zeros(5))] * 2, "index", None, ("by time: timestamps are repeated",)),
    ],
)  # fmt: skip
def test_by_name_then_time_then_index(first, second, by, expected, skipped):
    matches = associate(first, second)
    assert matches.by == by
    assert expected is None or pairs(matches) == expected
    assert skipped is None or matches.skipped == skipped


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_by_time_is_greedy_over_all_pairs(seed):
    rng = np.random.default_rng(seed)
    times = [np.unique(rng.uniform(0, 1, 12)), rng.permutation(np.unique(rng.uniform(0, 1, 15)))]
    first, second = (winding(len(side), timestamps=side) for side in times)
    gaps = np.abs(times[0][:, None] - times[1])
    expected = []
    while gaps.min() <= 0.05:
        i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
        expected.append((int(i), int(j)))
        gaps[i], gaps[:, j] = np.inf, np.inf
    if len(expected) < 3:
        return
    assert pairs(associate(first, second, "time", 0.05)) == sorted(expected)


@pytest.mark.parametrize(
    ("first", "second", "how", "message"),
    [
        (winding(18), winding(20), (), r"18 and 20 poses.*pass `match=endogslam-train`"),
        (winding(17), winding(20), ("endogslam-train",), "17 poses are not the training frames of 20"),
        (named("abc"), named("wxyz"), (), r"by name: no name in common; by index: 3 and 4 poses"),
        (named("abc"), winding(3), ("name",), "by name: not both have names"),
        (winding(2), winding(2), (), "by index: 2 frames match"),
        (*TIMED, ("time", 0.006), r"by time: 2 within 0.006 s"),
    ],
)
def test_what_cannot_be_matched_says_what_was_tried(first, second, how, message):
    with pytest.raises(InputError, match=message):
        associate(first, second, *how)
