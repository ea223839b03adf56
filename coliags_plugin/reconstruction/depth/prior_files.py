"""Depth maps by others as a prior, for instance of a monocular network."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.reading.depth_formats import depth_format
from coliags_plugin.datamanagers.reading.files import first_few
from coliags_plugin.datamanagers.rotatecolon.exr_depth import read_exr_channel
from coliags_plugin.reconstruction.depth.priors import DepthPrior
from coliags_plugin.reconstruction.depth.robust_fit import robust_fit

_SUFFIXES = (".png", ".npy", ".exr")
#: How far the aspect ratio of a map may be from the frame's: rounding to whole pixels, but no cropping.
_ASPECT = 0.02
#: Fewest known pixels that scale and shift are fitted to.
_FEWEST = 50


class FilePrior(DepthPrior):
    """Depth maps from files, scale and shift fitted to each frame's known depth, as depth or as inverse depth.

    Args:
        files: Depth map of each frame, by frame name.
    """

    def __init__(self, files: Mapping[str, Path]) -> None:
        self.files = dict(files)

    @classmethod
    def of(cls, folder: Path, frames: Sequence[Frame]) -> FilePrior:
        """The prior of a folder with one map of each frame, named as the frame.

        Raises:
            InputError: The folder is missing, a frame has no map, or a map has another aspect ratio.
        """
        if not folder.is_dir():
            raise InputError(f"--prior {folder}: no such folder", "a folder of depth maps named as the images")
        found = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in _SUFFIXES}
        missing = [frame.name for frame in frames if frame.name not in found]
        if missing:
            raise InputError(
                f"--prior {folder}: {len(missing)} of {len(frames)} frames have no depth map: {first_few(missing)}",
                f"NAME{', NAME'.join(_SUFFIXES)} for every frame",
                "Name the maps as the images",
            )
        prior = cls({frame.name: found[frame.name] for frame in frames})
        for frame in frames:
            prior._read(frame)
        return prior

    def described(self) -> str:
        """See :class:`DepthPrior`: names and a hash of the contents."""
        digest = hashlib.sha256()
        for name, path in self.files.items():
            digest.update(name.encode() + path.read_bytes())
        return digest.hexdigest()

    def log_depth(
        self,
        frame: Frame,
        usable: Bool[np.ndarray, "H W"],
        known: Float32[np.ndarray, "H W"],
        weight: Float32[np.ndarray, "H W"],
        typical: float,
    ) -> Float32[np.ndarray, "H W"]:
        """See :class:`DepthPrior`; unknown pixels of a map take the typical depth."""
        import cv2

        size = (known.shape[1], known.shape[0])
        stored = self._read(frame)
        values = np.asarray(cv2.resize(stored, size, interpolation=cv2.INTER_NEAREST), np.float64)
        there = np.isfinite(values) & (values > 0.0)
        chosen = (weight > 0.0) & usable & there
        nothing = np.full(known.shape, np.log(typical), np.float32)
        if not there.any():
            return nothing
        if chosen.sum() < _FEWEST:
            scale = np.median(values[there])
            return np.where(there, np.log(typical * np.where(there, values, scale) / scale), nothing).astype(np.float32)
        best, least = nothing, np.inf
        for power in (1.0, -1.0):
            target = np.exp(power * known[chosen].astype(np.float64))
            columns = np.stack([np.ones(values.shape), np.where(there, values, 1.0)], axis=-1)
            fit = columns @ robust_fit(columns[chosen], target, weight[chosen], np.zeros(2), 1e-9)
            # A line may leave the positive depths: hold it at a tenth of the least that is known.
            fit = np.clip(fit, 0.1 * target.min(), 10.0 * target.max())
            log_depth = np.log(fit) / power
            error = float(np.average(np.abs(log_depth[chosen] - known[chosen]), weights=weight[chosen]))
            if error < least:
                best, least = np.where(there, log_depth, nothing).astype(np.float32), error
        return best

    def _read(self, frame: Frame) -> Float32[np.ndarray, "h w"]:
        path = self.files[frame.name]
        if path.suffix.lower() == ".exr":
            stored = read_exr_channel(path, "V")
        else:
            form = depth_format(path, 1.0)
            stored = form.z_depth(form.read(path))
        height, width = stored.shape
        camera = frame.camera
        if abs(width * camera.height / (height * camera.width) - 1.0) > _ASPECT:
            raise InputError(
                f"{path} has {width} x {height} pixels, frame {frame.name} {camera.width} x {camera.height}",
                "depth maps of the undistorted working image, of its aspect ratio",
                "Make them from the images of such a scene, or crop them likewise",
            )
        return np.asarray(stored, np.float32)
