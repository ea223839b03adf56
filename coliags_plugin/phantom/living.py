"""Motion of the wall: a travelling peristaltic wave and breathing, as displacements of the mesh's vertices.

At a time t, the wall is ``centre(s) + shift(s, t) + (radius(s, phi) + wave(s, t)) (cos phi n + sin phi b)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.phantom.colon import DOME, LENGTH, Anatomy, ColonSurface, surface_of
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, smoothstep, stream

#: Length of the bend by breathing along the colon, mm: one period; and the time of one breath, s.
_BEND, BREATH = 160.0, 4.0
#: Length of the peristaltic wave along the centre line, mm, and its speed towards the shallow end, mm/s.
WAVE_LENGTH, WAVE_SPEED = 60.0, 10.0


@dataclass(frozen=True)
class WallMotion:
    """Displacement of the wall from rest. float32, as it is written, so that the files give the same vertices."""

    rest: ColonSurface
    frames: Float[np.ndarray, "R 3 3"]  # axes of the centre line at each row
    radial: Float[np.ndarray, "R C 3"]  # unit, away from the centre line
    wave: Float[np.ndarray, "T R"]  # along radial, mm
    shift: Float[np.ndarray, "T R 3"]  # world, mm

    def at(self, frame: int) -> ColonSurface:
        """The wall at a frame."""
        moved = self.wave[frame, :, None, None] * self.radial + self.shift[frame, :, None]
        grid = self.rest.vertices.reshape(self.radial.shape) + moved
        return surface_of(grid.astype(np.float64), self.frames, self.rest.arc, self.rest.row_length)


def frame_times(settings: PhantomSettings) -> Float[np.ndarray, "T"]:
    """Time of every frame, s."""
    return np.arange(settings.frames) / settings.frame_rate


def wall_motion(anatomy: Anatomy, surface: ColonSurface, settings: PhantomSettings) -> WallMotion | None:
    """The wall's motion; None if it is rigid."""
    if not settings.moves:
        return None
    times = frame_times(settings)
    _, frames = anatomy.centre_line.at(surface.arc)
    clock = np.arange(surface.columns)[None, :, None] * (2.0 * np.pi / surface.columns)
    radial = np.cos(clock) * frames[:, None, :, 0] + np.sin(clock) * frames[:, None, :, 1]
    generator = stream(settings.seed, Purpose.WALL_MOTION)
    phases = generator.uniform(0.0, 2.0 * np.pi, 4)
    return WallMotion(
        rest=surface,
        frames=frames,
        radial=radial.astype(np.float32),
        wave=peristalsis(surface.arc, times, settings, phases[0]).astype(np.float32),
        shift=breathing(surface.arc, times, settings, frames[len(frames) // 2], phases[1:]).astype(np.float32),
    )


def peristalsis(
    arc: Float[np.ndarray, "R"], times: Float[np.ndarray, "T"], settings: PhantomSettings, phase: float
) -> Float[np.ndarray, "T R"]:
    """Change of the radius, mm: a sine that travels towards the shallow end and fades out towards the closed end."""
    travelled = arc[None] + WAVE_SPEED * times[:, None]
    fade = smoothstep((LENGTH - DOME - arc) / 20.0)
    return np.asarray(settings.wave * fade * np.sin(2.0 * np.pi * travelled / WAVE_LENGTH + phase))


def breathing(
    arc: Float[np.ndarray, "R"],
    times: Float[np.ndarray, "T"],
    settings: PhantomSettings,
    axes: Float[np.ndarray, "3 3"],
    phases: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "T R 3"]:
    """Displacement of the centre line, world, mm: it bends and straightens across a fixed direction."""
    direction = np.cos(phases[0]) * axes[:, 0] + np.sin(phases[0]) * axes[:, 1]
    along = np.sin(2.0 * np.pi * arc / _BEND + phases[1])
    swing = settings.breathing * np.sin(2.0 * np.pi * times / BREATH + phases[2])
    return np.asarray(swing[:, None, None] * along[None, :, None] * direction)
