"""The camera path of phantoms that examines: a withdrawal back and forth, with fast turns and wall contacts.

Unlike the other paths, its speeds are per second: more frames show more of the same motion.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from coliags_plugin.phantom.colon import CentreLine
from coliags_plugin.phantom.motion import SHALLOW_END, draw_sway, looking, rotation_about
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, stream

#: Frequencies of the path's sway and of the camera's turning, Hz.
_SLOW, _QUICK = np.array([0.08, 0.2, 0.4]), np.array([0.15, 0.4, 0.9])
#: How far the camera goes back and forth along the colon, beside its withdrawal, mm, and from the centre line, mm.
_BACK, _SIDEWAYS = 7.0, 8.0
#: Largest yaw, pitch and roll between fast turns, degrees.
_TURN = (30.0, 25.0, 35.0)
#: Angle of fast turns, degrees, and the times in which they turn, stay and turn back, s.
_FAST_TURN, _FAST_TIMES = (30.0, 50.0), (0.35, 0.4, 0.45)
#: Times in which a contact is approached, lasts and is left, s, and its view's angle to the centre line, degrees.
_CONTACT_TIMES, _CONTACT_TURN = (0.6, 0.35, 0.6), 65.0
#: Distance of the lens from the wall, mm: in a contact, and the smallest otherwise, of a wall at rest.
_TOUCH, _NEAREST = 1.2, 2.5
#: How far ahead on the centre line the camera looks, mm.
_LOOK_AHEAD = 28.0

Clearance = Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, "N"]]


def examining_path(
    centre_line: CentreLine, settings: PhantomSettings, clearance: Clearance, touch: Callable[[int], Clearance]
) -> Float[np.ndarray, "T 4 4"]:
    """Camera-to-world pose of every frame, OpenCV axes, mm; ``touch`` measures clearance in the wall of a frame."""
    generator = stream(settings.seed, Purpose.TRAJECTORY)
    seconds = settings.frames / settings.frame_rate
    share = np.linspace(0.0, 1.0, settings.frames)
    slow = np.stack([draw_sway(generator, _SLOW * seconds)(share) for _ in range(3)], axis=1)
    quick = np.stack([draw_sway(generator, _QUICK * seconds)(share) for _ in range(3)], axis=1)
    arc = SHALLOW_END + _BACK + settings.path_length * (1.0 - share) + _BACK * slow[:, 0]
    points, frames = centre_line.at(arc)
    sideways = np.einsum("tck,tk->tc", frames[:, :, :2], _SIDEWAYS / np.sqrt(2.0) * slow[:, 1:])
    sideways *= _permitted(points, sideways, clearance, settings)[:, None]
    ahead, _ = centre_line.at(arc + _LOOK_AHEAD)
    poses = looking(points + sideways, ahead, frames)
    turns = np.radians(_TURN) * quick
    for pose, (yaw, pitch, roll) in zip(poses, turns, strict=True):
        pose[:3, :3] = pose[:3, :3] @ rotation_about(np.array([0.0, 0.0, 1.0]), roll)
        pose[:3, :3] = pose[:3, :3] @ rotation_about(np.array([0.0, 1.0, 0.0]), yaw)
        pose[:3, :3] = pose[:3, :3] @ rotation_about(np.array([1.0, 0.0, 0.0]), pitch)
    events = np.array(["turn"] * settings.turns + ["contact"] * settings.contacts)
    generator.shuffle(events)
    for number, event in enumerate(events):
        middle = (number + generator.uniform(0.35, 0.65)) / len(events) * seconds
        clock = generator.uniform(0.0, 2.0 * np.pi)
        across = np.array([-np.sin(clock), np.cos(clock), 0.0])
        stages = _FAST_TIMES if event == "turn" else _CONTACT_TIMES
        swing = _swing(np.arange(settings.frames) / settings.frame_rate - middle, stages)
        angle = generator.uniform(*_FAST_TURN) if event == "turn" else _CONTACT_TURN
        frame = min(round(middle * settings.frame_rate), settings.frames - 1)
        aside = poses[frame, :3, :3] @ np.array([np.cos(clock), np.sin(clock), 0.0])
        for pose, amount in zip(poses, swing, strict=True):
            pose[:3, :3] = pose[:3, :3] @ rotation_about(across, amount * np.radians(angle))
        if event == "contact":
            poses[:, :3, 3] += _reach(poses, swing, aside, frame, touch)[:, None] * aside
    return poses


def _permitted(
    points: Float[np.ndarray, "T 3"],
    sideways: Float[np.ndarray, "T 3"],
    clearance: Clearance,
    settings: PhantomSettings,
) -> Float[np.ndarray, "T"]:
    """Share of the sideways motion that keeps the camera off the wall, smooth in time."""
    nearest = _NEAREST + settings.wave + settings.breathing
    low, high = np.zeros(len(points)), np.ones(len(points))
    for _ in range(12):
        middle = 0.5 * (low + high)
        clear = clearance(points + middle[:, None] * sideways) > nearest
        low, high = np.where(clear, middle, low), np.where(clear, high, middle)
    width = max(round(0.4 * settings.frame_rate), 1)
    return np.asarray(scipy.ndimage.gaussian_filter1d(scipy.ndimage.minimum_filter1d(low, 2 * width + 1), 0.5 * width))


def _swing(time: Float[np.ndarray, "T"], stages: tuple[float, float, float]) -> Float[np.ndarray, "T"]:
    """0, then 1 during the second stage, whose middle is time 0, then 0; Perlin's quintic between."""
    there, stay, back = stages
    x = np.clip(np.minimum((time + 0.5 * stay + there) / there, (0.5 * stay + back - time) / back), 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x**2))


def _reach(
    poses: Float[np.ndarray, "T 4 4"],
    swing: Float[np.ndarray, "T"],
    aside: Float[np.ndarray, "3"],
    frame: int,
    touch: Callable[[int], Clearance],
) -> Float[np.ndarray, "T"]:
    """Motion towards the wall, mm, that ends where the lens nearly touches it."""
    near = np.flatnonzero(swing > 0.0)
    clearance = touch(frame)
    low, high = 0.0, 30.0
    for _ in range(16):
        middle = 0.5 * (low + high)
        # Along the whole way, as the distance alone would be large again beyond the wall.
        way = poses[frame, :3, 3] + np.linspace(0.0, middle, 60)[:, None] * aside
        moved = poses[near, :3, 3] + (middle * swing[near])[:, None] * aside
        if min(clearance(way).min(), clearance(moved).min()) > _TOUCH:
            low = middle
        else:
            high = middle
    return low * swing
