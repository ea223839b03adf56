"""Pictures and depth in TUM's form before anyone knows where they were taken from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coliags_plugin.datamanagers.rgbd.association import times
from coliags_plugin.datamanagers.rgbd.reader import RGBDDataManager
from coliags_plugin.poses.trajectory import Trajectory


class UnposedRGBDDataManager(RGBDDataManager):
    """Reads what :class:`RGBDDataManager` does, without a trajectory: every camera is at the origin.

    Registered under no name, so that nothing trains on such poses.
    """

    def _trajectory(self, path: Path, pictures: Sequence[Path]) -> tuple[Path | None, Trajectory]:
        nowhere = np.tile(np.eye(4), (len(pictures), 1, 1))
        # A pose for every picture, at its own time where it has one: pictures pair with depth alone.
        return None, Trajectory(nowhere, timestamps=times(pictures) if self._by_time(pictures) else None)
