"""Recordings of a calibrated endoscope: the video of a folder, and the camera of the calibration file beside it."""

from __future__ import annotations

import logging
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.recognition import videos_in
from coliags_plugin.geometry.lenses.vicalib import SUFFIX, find_calibration, read_calibration
from coliags_plugin.pipeline.frame_sources import frame_source
from coliags_plugin.reconstruction.structure.sfm_cameras import camera_of_lens
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

log = logging.getLogger(__name__)


def opened_recording(path: Path, settings: SfmSettings) -> tuple[Path, SfmSettings]:
    """The one video of a recording's folder, or else what was given itself; and its camera in the settings.

    The camera is that of the calibration file that the settings name as its model, or, where they name none, of the
    one in the folder; it is scaled to the frames. Without either, the settings are unchanged.

    Raises:
        InputError: As :func:`frame_source`; or a calibration is missing, damaged or of another frame.
    """
    videos = videos_in(path) if path.is_dir() else []
    source = videos[0] if len(videos) == 1 else path
    frames, camera = frame_source(source), settings.camera
    if camera.model is None:
        calibration = find_calibration(path)
        if calibration is None and videos:
            log.warning("%s has no calibration file: its camera is estimated. --camera NAME.xml gives one", path)
    elif camera.model.lower().endswith(SUFFIX):
        if camera.params is not None:
            raise InputError(f"--params, and --camera {camera.model}", "one of them", "Drop --params")
        calibration = read_calibration(Path(camera.model))
    else:
        calibration = None
    if calibration is None:
        return source, settings
    height, width = next(iter(frames))[1].shape[:2]
    model, params = camera_of_lens(calibration.lens, str(calibration.path), width, height)
    log.info("%s: camera of %s, for frames of %d x %d", source, calibration.path, width, height)
    known = camera.model_copy(update={"model": model, "params": params})
    return source, settings.model_copy(update={"camera": known})
