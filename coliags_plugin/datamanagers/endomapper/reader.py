"""Data manager for posed sequences of the EndoMapper dataset (Azagra et al., 2023): the lens in a calibration file."""

from __future__ import annotations

from coliags_plugin.datamanagers.rgbd.reader import RGBDDataManager


class EndoMapperDataManager(RGBDDataManager):
    """Reads fisheye images, depth, a TUM trajectory and a calibration of Vicalib (docs/layouts/endomapper.md)."""

    name = "endomapper"
    is_calibrated = True
