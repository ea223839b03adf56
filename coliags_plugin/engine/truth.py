"""Frames of another scene of the same world, whose depth is true, in the place of a run's own held-out frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, Scene

#: Largest distance between the cameras of a frame in the two scenes, as a share of the scene's extent.
_SAME_PLACE = 0.01


@dataclass(frozen=True)
class Truth:
    """Scene with true depth, for the evaluation of a run that was trained on another scene of the same video.

    Attributes:
        scene: The scene with the true depth: its test sets are what is evaluated, its training frames those that the
            run was trained on, as this scene calls them.
        matched_by: How frames of the two scenes were found to be the same.
    """

    scene: Scene
    matched_by: Literal["name", "index"]


def match_truth(scene: Scene, other: Scene) -> Truth:
    """Find the frames of a run's scene in another one, which has the true depth.

    The set ``test`` is that of the first scene, further sets are those of the second. Frames are matched by name if
    all names are there, else by their index in the video if the scenes have equally many frames.
    """
    mine, theirs = scene.video, other.video
    by_name = {frame.name: frame for frame in theirs}
    by_index = {frame.index: frame for frame in theirs}
    matched_by: Literal["name", "index"] = "name"
    if all(frame.name in by_name for frame in mine):
        matches = {frame.name: by_name[frame.name] for frame in mine}
    elif len(mine) == len(theirs) and all(frame.index in by_index for frame in mine):
        matches, matched_by = {frame.name: by_index[frame.index] for frame in mine}, "index"
    else:
        lone = next(frame.name for frame in mine if frame.name not in by_name)
        raise InputError(
            f"scene '{other.name}' has no frame '{lone}', and {len(theirs)} frames for the {len(mine)} of scene "
            f"'{scene.name}'",
            "the same video, with frames of the same names or in the same number",
            "Name the scene that this one was made from",
        )
    _refuse_other_world(mine, matches, scene.extent, other.name)
    train = [matches[frame.name] for frame in scene.train]
    same_split = {frame.name for frame in train} == {frame.name for frame in other.train}
    sets = {"test": [matches[frame.name] for frame in scene.test_sets.get("test", [])]}
    sets |= {name: frames for name, frames in other.test_sets.items() if name != "test"}
    if not same_split:  # seen masks tell what the other scene's training frames show
        sets = {name: [frame.with_maps(seen=None) for frame in frames] for name, frames in sets.items()}
    split = (other if same_split else scene).provenance.split
    provenance = other.provenance.model_copy(update={"split": split})
    held_out = {name: frames for name, frames in sets.items() if frames}
    return Truth(replace(other, train=train, test_sets=held_out, provenance=provenance), matched_by)


def _refuse_other_world(frames: Sequence[Frame], matches: dict[str, Frame], extent: float, name: str) -> None:
    for frame in frames:
        apart = float((frame.camera.center.double() - matches[frame.name].camera.center.double()).norm())
        if not apart <= _SAME_PLACE * extent:
            raise InputError(
                f"frame '{frame.name}' was taken {apart:.3g} units away from its place in scene '{name}'",
                "scenes with the same poses, in the same unit",
                "Align the scenes first, or evaluate against the scene that the poses are from",
            )
