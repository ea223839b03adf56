"""Views that only test, and the masks that say what training frames see of test frames (docs/layouts/c3vd.md 5)."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from coliags_plugin.datamanagers.reading.frame_files import marks
from coliags_plugin.datamanagers.recording import Recording, Shot
from coliags_plugin.datamanagers.splits import Split, divide

log = logging.getLogger(__name__)

#: The folder of rotation views beside a sequence, and the test set they become.
ROTATION = "rotation"


def seen_marks(path: Path, count: int, complete: bool = True) -> dict[int, Path]:
    """``seen/NNNN_seen.png`` in a folder, by frame; for which training frames, :func:`with_valid_marks` asks.

    Args:
        path: What holds the folder ``seen``.
        count: Number of frames.
        complete: Whether the frames are all images of the data. Masks are numbered by image, so that an image
            left out puts them out of step.

    Raises:
        InputError: One belongs to no frame.
    """
    folder = path / "seen"
    if complete:
        return marks(folder, "seen", count)
    if folder.is_dir():
        log.warning(
            "%s: seen masks are for all images; some are left out, so figures on seen pixels are left out", folder
        )
    return {}


def with_valid_marks(
    recording: Recording, split: Split, train: Collection[int], test: Collection[int], path: Path
) -> Recording:
    """The recording with those seen masks that are right for a run: all of its test frames' or none.

    Args:
        recording: With every mask that was found.
        split: The masks say what its training frames see, of all frames.
        train: Indices of the frames that the run trains on.
        test: Indices of the frames of the video that it tests on.
        path: The scene, for the log.
    """
    meant, _ = divide(split, range(len(recording.shots)), recording.own_split)
    trained = set(train)
    if set(meant) == trained:
        shots = [_unmarked(shot) if index in trained else shot for index, shot in enumerate(recording.shots)]
        return replace(recording, shots=shots)
    tested = bool(test or recording.test_sets)
    if tested and any(shot.seen for shots in (recording.shots, *recording.test_sets.values()) for shot in shots):
        log.warning(
            "%s: seen masks are for split '%s' of all frames; this run trains on other frames, so figures on seen "
            "pixels are left out",
            path,
            split,
        )
    return replace(
        recording,
        shots=_all_unmarked(recording.shots),
        test_sets={name: _all_unmarked(shots) for name, shots in recording.test_sets.items()},
    )


def _all_unmarked(shots: Sequence[Shot]) -> list[Shot]:
    return [_unmarked(shot) for shot in shots]


def _unmarked(shot: Shot) -> Shot:
    return shot if shot.seen is None else replace(shot, seen=None)
