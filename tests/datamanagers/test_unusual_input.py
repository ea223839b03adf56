"""What is unusual in a folder, and no fault."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.datamanagers.layout_faults import MATRICES, PARAMS, load
from tests.datamanagers.spoiling import (
    KINDS,
    Spoil,
    change_json,
    change_npz,
    files,
    remove,
    rename,
)
from tests.phantom.phantom_layouts import in_video_order, true_poses


def _unpad(*patterns: str) -> Spoil:
    return rename([pattern for pattern in patterns if pattern], lambda number: number)


def _unpad_json(pattern: str) -> Spoil:
    def spoil(content: dict) -> None:
        for frame in content["frames"]:
            for key in ("file_path", "depth_file_path", "distmap_path"):
                if key in frame:
                    frame[key] = re.sub(r"0*(\d+)", r"\1", frame[key], count=1)

    return change_json(pattern, spoil)


def _unpad_colmap(folder: Path) -> None:
    _unpad("images/*.png")(folder)
    path = folder / "sparse/0/images.txt"
    path.write_text(re.sub(r"\b0*(\d+)\.png", r"\1.png", path.read_text()))


UNPADDED = {
    **{name: _unpad(KINDS[name].images, KINDS[name].depths) for name in (*MATRICES, "pr-endo", "rotatecolon")},
    "endomapper": _unpad("rgb/*.png", "depth/*.png", "mask/*.png"),
    # In TUM's form by order, names of the fixture are unpadded as they are.
    "rgbd-by-order": _unpad(),
    "colmap-text": _unpad_colmap,
    "nerfstudio": lambda folder: [
        _unpad("images/*.png", "depth/*.png")(folder),
        _unpad_json("transforms.json")(folder),
    ],
    "reim-nerf": lambda folder: [
        _unpad("images/*.png", "distmaps/*.png")(folder),
        _unpad_json("transforms_*.json")(folder),
    ],
}


@pytest.mark.parametrize("name", UNPADDED)
def test_names_without_leading_zeros_come_in_the_order_of_their_numbers(copied, phantoms, name):
    folder = copied(name)
    UNPADDED[name](folder)
    images = files(folder, KINDS[name].images)
    assert sorted(images) != images, "the names' own order is another one"
    frames, expected = (
        in_video_order(load(folder, name)),
        in_video_order(load(phantoms[name] / KINDS[name].scene, name)),
    )
    assert [frame.index for frame in frames] == [frame.index for frame in expected]
    for frame, same in zip(frames, expected, strict=True):
        assert (frame.image == same.image).all()
        assert (frame.camera.camera_to_world == same.camera.camera_to_world).all()
        assert (frame.depth is None) == (same.depth is None)
        assert frame.depth is None or frame.depth.nan_to_num().equal(same.depth.nan_to_num())


def test_an_image_less_than_there_are_poses_is_no_fault_by_time(copied, phantoms):
    folder = copied("rgbd")
    remove("rgb/*.png", 3)(folder)
    found = in_video_order(load(folder, "rgbd"))
    expected = in_video_order(load(phantoms["rgbd"], "rgbd"))
    for frame, same in zip(found, [*expected[:3], *expected[4:]], strict=True):
        assert frame.name == same.name
        assert (frame.camera.camera_to_world == same.camera.camera_to_world).all()
        assert (frame.depth.nan_to_num() == same.depth.nan_to_num()).all()
        # Seen masks are numbered by image and would now be those of others.
        assert frame.seen is None


@pytest.mark.parametrize("name", PARAMS)
def test_quaternions_that_may_be_of_any_length(copied, name):
    """EndoGSLAM optimises quaternions without normalising them, and says so in their name."""
    folder = copied(name)
    before = in_video_order(load(folder, name))
    change_npz(KINDS[name].params, lambda arrays: arrays.update(cam_unnorm_rots=3.0 * arrays["cam_unnorm_rots"]))(
        folder
    )
    after = in_video_order(load(folder, name))
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(one.camera.camera_to_world, other.camera.camera_to_world, atol=1e-5)


def test_both_reading_orders_of_c3vds_poses_give_the_true_ones(phantoms):
    for name, order in (("c3vd-raw", "column-major"), ("c3vd-raw-old", "row-major")):
        scene = load(phantoms[name], name)
        assert scene.provenance["pose_convention"]["order"] == order
        found = np.stack([frame.camera.camera_to_world.numpy() for frame in in_video_order(scene)])
        np.testing.assert_allclose(found, true_poses(phantoms[name]), atol=1e-4)
