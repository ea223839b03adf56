"""Views that only test, and the masks that say what training frames see of test frames (docs/layouts/c3vd.md 5)."""

from __future__ import annotations

from pathlib import Path

from coliags_plugin.datamanagers.reading.frame_files import marks
from coliags_plugin.datamanagers.scene_settings import SceneSettings
from coliags_plugin.datamanagers.splits import Split, held_out

#: The folder of rotation views beside a sequence, and the test set they become.
ROTATION = "rotation"


def seen_marks(path: Path, count: int, settings: SceneSettings, split: Split) -> dict[int, Path]:
    """``truth/seen/NNNN_seen.png`` of the test frames of a split; none where another split or fewer frames are used.

    Raises:
        InputError: One belongs to no frame.
    """
    whole = settings.frame_step == 1 and (settings.max_frames is None or settings.max_frames >= count)
    if not whole or settings.split != split:
        return {}
    is_test = held_out(split, count)
    return {place: mark for place, mark in marks(path / "truth" / "seen", "seen", count).items() if is_test[place]}
