"""Masks of the test pixels whose surface is seen by training frames (docs/layouts/c3vd.md 5)."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.files import numbered
from coliags_plugin.datamanagers.recording import Recording, Shot
from coliags_plugin.datamanagers.splits import Split, divide

log = logging.getLogger(__name__)

#: Folder and test set of the rotation views of a sequence.
ROTATION = "rotation"


def find_seen_masks(path: Path, count: int, complete: bool = True) -> dict[int, Path]:
    """Seen masks ``seen/NNNN_seen.png`` in ``path``, by frame index; :func:`with_valid_seen_masks` checks the split.

    ``complete`` tells whether the frames are all images of the dataset. Masks are numbered by image, so that they do
    not match frames where images are left out.
    """
    folder = path / "seen"
    if not complete:
        if folder.is_dir():
            log.warning(
                "%s: seen masks are for all images, but some are left out, so metrics on seen pixels are unavailable",
                folder,
            )
        return {}
    masks = numbered(folder, "seen", frozenset({".png"}))
    for index, mask in masks.items():
        if index >= count:
            do = "Restore the missing frames, or remove the file"
            raise InputError(f"{mask}, but there are {count} frames", f"numbers below {count}", do)
    return masks


def with_valid_seen_masks(
    recording: Recording, split: Split, train: Collection[int], test: Collection[int], path: Path
) -> Recording:
    """Keep the seen masks of test frames if the run trains on the frames they were made for, else drop all.

    ``split`` of all frames is what the masks refer to; ``train`` and ``test`` are indices of the run's frames.
    """
    meant, _ = divide(split, range(len(recording.shots)), recording.own_split)
    trained = set(train)
    if set(meant) == trained:
        shots = [_without_seen(shot) if index in trained else shot for index, shot in enumerate(recording.shots)]
        return replace(recording, shots=shots)
    tested = bool(test or recording.test_sets)
    if tested and any(shot.seen for shots in (recording.shots, *recording.test_sets.values()) for shot in shots):
        log.warning(
            "%s: seen masks are for split '%s' of all frames; this run trains on other frames, so metrics on seen "
            "pixels are unavailable",
            path,
            split,
        )
    test_sets = {name: [*map(_without_seen, shots)] for name, shots in recording.test_sets.items()}
    return replace(recording, shots=[*map(_without_seen, recording.shots)], test_sets=test_sets)


def _without_seen(shot: Shot) -> Shot:
    return shot if shot.seen is None else replace(shot, seen=None)
