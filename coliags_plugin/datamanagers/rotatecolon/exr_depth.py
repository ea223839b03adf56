"""Depth in OpenEXR files, as written by Blender."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Float32, Shaped

from coliags_plugin.core.decoder_messages import decoder_messages
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.depth_formats import DepthFormat

#: Stored depth from this value on is background; Blender writes 1e10.
BACKGROUND = 1e6


@dataclass(frozen=True)
class ExrDepth(DepthFormat):
    """One channel proportional to z-depth; unknown where not finite, not positive or at least ``BACKGROUND``.

    ``divisor`` turns stored values into scene units.
    """

    channel: str
    divisor: float = 1.0

    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """See :class:`DepthFormat`; float32, 0 where unknown."""
        stored = read_exr_channel(path, self.channel)
        known = np.isfinite(stored) & (stored > 0.0) & (stored < BACKGROUND)
        return np.where(known, stored, np.float32(0.0))

    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """See :class:`DepthFormat`."""
        return np.where(stored > 0.0, stored / np.float32(self.divisor), np.float32(np.nan)).astype(np.float32)


#: Files are read one at a time, as what OpenEXR prints is diverted for all threads.
_ALONE = Lock()


def read_exr_channel(path: Path, channel: str) -> Float32[np.ndarray, "H W"]:
    """Read a channel of an EXR file by its full name, from any part."""
    import OpenEXR

    if not path.is_file():
        raise InputError(f"no file {path}", "an OpenEXR file")
    try:
        with (
            _ALONE,
            redirect_stdout(io.StringIO()),  # OpenEXR prints warnings
            decoder_messages(),
            OpenEXR.File(str(path), separate_channels=True) as file,
        ):
            # OpenEXR returns no parts for a damaged file.
            channels = {name: stored.pixels for part in file.parts for name, stored in part.channels.items()}
            if not channels:
                raise ValueError("no channels")
    except (OSError, RuntimeError, ValueError) as error:
        raise _damaged(path) from error
    if channel not in channels:
        raise InputError(
            f"{path} has the channels {', '.join(sorted(channels))}",
            f"a channel {channel}",
            "Choose the one that holds depth with --set datamanager.depth_channel=NAME",
        )
    return np.asarray(channels[channel]).astype(np.float32)


def _damaged(path: Path) -> InputError:
    return InputError(
        f"{path} ({path.stat().st_size} bytes) cannot be decoded",
        "a complete OpenEXR file",
        "It is damaged or cut short: fetch it again",
    )
