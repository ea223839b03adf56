"""Pose files: which order, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.c3vd import read_poses
from tests.datamanagers.wall_scenes import poses


def write(path, matrices, separator=","):
    path.write_text("\n".join(separator.join(f"{n:.9g}" for n in np.ravel(m)) for m in matrices) + "\n")
    return path


@pytest.mark.parametrize("separator", [",", " ", ", ", "\t"])
@pytest.mark.parametrize("order", ["column-major", "row-major"])
@pytest.mark.parametrize("from_origin", [False, True])
def test_order_is_found(tmp_path, order, separator, from_origin):
    expected = np.linalg.inv(poses(5)[0]) @ poses(5) if from_origin else poses(5)
    stored = expected.transpose(0, 2, 1) if order == "column-major" else expected
    read = read_poses(write(tmp_path / "pose.txt", stored, separator))
    assert read.convention == order
    np.testing.assert_allclose(read.camera_to_world, expected, atol=1e-7)
    assert json.dumps(read.evidence, allow_nan=False)
    larger, smaller = ("last_row", "last_column") if order == "column-major" else ("last_column", "last_row")
    assert read.evidence[f"largest_number_in_{larger}"] > 1.0
    assert read.evidence[f"largest_number_in_{smaller}"] == 0.0
    length = np.linalg.norm(np.diff(expected[:, :3, 3], axis=0), axis=1).sum()
    assert read.evidence["trajectory_length_mm"] == pytest.approx(length)
    assert read.evidence["mean_step_mm"] == pytest.approx(length / 4)


def test_without_translation_only_symmetric_rotations_can_be_read(tmp_path):
    still = poses(3)
    still[:, :3, 3] = 0.0
    with pytest.raises(InputError, match="row-major and column-major order cannot be distinguished"):
        read_poses(write(tmp_path / "pose.txt", still))
    np.testing.assert_array_equal(read_poses(write(tmp_path / "one.txt", [np.eye(4)])).camera_to_world, [np.eye(4)])


def one_line_in_the_other_order(matrices):
    matrices[3] = matrices[3].T
    return matrices


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (one_line_in_the_other_order, "line 4: not a rigid transform"),
        (lambda matrices: [m[:3] for m in matrices], "line 1: .*16 finite numbers"),
    ],
)
def test_bad_poses_are_refused_by_line(tmp_path, change, message):
    """Besides those of :data:`tests.datamanagers.kinds.SAID`."""
    path = write(tmp_path / "pose.txt", change(poses(5)))
    with pytest.raises(InputError, match=message) as caught:
        read_poses(path)
    assert str(path) in str(caught.value)
