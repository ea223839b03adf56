"""Camera paths of phantoms: withdrawal, inspection, rotation in place, and rotated test views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.phantom.colon import CentreLine
from coliags_plugin.phantom.examination import examining_path
from coliags_plugin.phantom.inspection import inspecting_path
from coliags_plugin.phantom.living import WallMotion
from coliags_plugin.phantom.motion import NEAREST, SHALLOW_END, draw_sway, looking, rotation, rotation_about, times
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, stream
from coliags_plugin.phantom.tracing import Tracer

#: Interval of held-out test frames.
TEST_EVERY = 8
#: Travel of the ``rotation`` trajectory, mm.
_ROTATION_TRAVEL = 6.0
#: How far ahead on the centre line the camera looks, mm.
_LOOK_AHEAD = 28.0
#: Width of an approach, as a share of the sequence.
_APPROACH_WIDTH = 0.07
_ROTATION_TURN = (15.0, 30.0)


@dataclass(frozen=True)
class RotationView:
    """A rotated test view at the position of a frame."""

    frame: int  # index of the frame whose position and exposure it shares
    turn: float  # angle between its viewing direction and the frame's, degrees
    camera_to_world: Float[np.ndarray, "4 4"]  # OpenCV axes, mm


def camera_path(
    centre_line: CentreLine, settings: PhantomSettings, tracer: Tracer, motion: WallMotion | None = None
) -> Float[np.ndarray, "T 4 4"]:
    """Camera-to-world pose of every frame, OpenCV axes, mm.

    It is at least 6 mm from the wall at rest, except in an examination.
    """
    if settings.trajectory == "examination":
        return examining_path(
            centre_line,
            settings,
            tracer.clearance,
            lambda frame: (tracer if motion is None else Tracer(motion.at(frame))).clearance,
        )
    if settings.trajectory == "inspection":
        poses = inspecting_path(centre_line, settings, tracer)
    else:
        poses = _withdrawing_path(centre_line, settings, tracer)
    nearest = float(tracer.clearance(poses[:, :3, 3]).min())
    if nearest < NEAREST:
        raise InputError(
            f"the colon of seed {settings.seed} leaves only {nearest:.1f} mm between the camera's path and the wall",
            f"at least {NEAREST:g} mm",
            "Choose another seed",
        )
    return poses


def every_8th(index: int) -> bool:
    """Whether a frame is held out by the default split: 0, 8, 16, ..."""
    return index % TEST_EVERY == 0


def turn_away(
    poses: Float[np.ndarray, "T 4 4"], settings: PhantomSettings, is_test: Callable[[int], bool] = every_8th
) -> list[RotationView]:
    """Test views at positions of training frames, rotated by 15 to 30 degrees.

    On a pullback they are rotated in all directions; on a rotation trajectory further outwards.
    """
    generator = stream(settings.seed, Purpose.ROTATION_VIEWS)
    training = [index for index in range(len(poses)) if not is_test(index)]
    views = []
    clock = generator.uniform(0.0, 2.0 * np.pi)
    for number in range(settings.rotation_views):
        position = (number + 0.5) / settings.rotation_views * len(training)
        frame = training[min(int(position), len(training) - 1)]
        # The golden angle distributes any number of directions evenly.
        clock += np.pi * (3.0 - np.sqrt(5.0))
        turn = generator.uniform(*_ROTATION_TURN)
        direction = clock
        if settings.trajectory == "rotation":
            middle = poses[frame, :3, :3].T @ poses[:, :3, 2].mean(axis=0)
            direction = float(np.arctan2(-middle[1], -middle[0]))
        axis = np.array([-np.sin(direction), np.cos(direction), 0.0])
        pose = poses[frame].copy()
        pose[:3, :3] = pose[:3, :3] @ rotation_about(axis, np.radians(turn))
        views.append(RotationView(frame, float(turn), pose))
    return views


def _withdrawing_path(centre_line: CentreLine, settings: PhantomSettings, tracer: Tracer) -> Float[np.ndarray, "T 4 4"]:
    """Poses of the trajectories ``pullback`` and ``rotation``: along the centre line, and almost in place."""
    generator = stream(settings.seed, Purpose.TRAJECTORY)
    preset = settings.light_preset
    time = times(settings)
    if settings.trajectory == "pullback":
        arc = SHALLOW_END + settings.path_length * (1.0 - time)
    else:
        arc = SHALLOW_END + 0.5 * settings.path_length + _ROTATION_TRAVEL * (0.5 - time)
    points, frames = centre_line.at(arc)

    waver = np.stack([draw_sway(generator)(time) for _ in range(5)], axis=1)
    on_the_spot = settings.trajectory == "rotation"
    low, high = (0.3 * excursion if on_the_spot else excursion for excursion in preset.wobble)
    clock = generator.uniform(0.0, 2.0 * np.pi) + 2.2 * waver[:, 0] + 4.0 * time
    amount = 0.5 * (low + high) + 0.5 * (high - low) * waver[:, 1]
    sideways = amount[:, None] * np.stack([np.cos(clock), np.sin(clock)], axis=1)

    def centers(sideways: Float[np.ndarray, "T 2"]) -> Float[np.ndarray, "T 3"]:
        return np.asarray(points + np.einsum("nck,nk->nc", frames[:, :, :2], sideways))

    def distances(sideways: Float[np.ndarray, "T 2"]) -> Float[np.ndarray, "T"]:
        return tracer.clearance(centers(sideways))

    for _ in range(30):
        if distances(sideways).min() >= NEAREST + 0.5:
            break
        sideways = 0.85 * sideways
    for approach in range(0 if on_the_spot else preset.approaches):
        sideways = _with_approach(sideways, distances, preset.closest, approach, time, generator)
    ahead, _ = centre_line.at(arc + _LOOK_AHEAD)
    poses = looking(centers(sideways), ahead, frames)
    if not on_the_spot:
        yaw, pitch, roll = (np.radians(limit) * waver[:, 2 + axis] for axis, limit in enumerate(preset.turn))
    else:
        # An outward spiral, so that the viewing direction covers a disc.
        clock = 2.0 * np.pi * 2.5 * time + generator.uniform(0.0, 2.0 * np.pi)
        away = np.radians(preset.scan) * np.sqrt(time)
        yaw, pitch = away * np.cos(clock), away * np.sin(clock)
        roll = np.radians(preset.turn[2]) * waver[:, 4]
    for pose, turn in zip(poses, np.stack([yaw, pitch, roll], axis=1), strict=True):
        pose[:3, :3] = pose[:3, :3] @ rotation(*turn)
    return poses


def _with_approach(
    sideways: Float[np.ndarray, "T 2"],
    distances: Callable[[Float[np.ndarray, "T 2"]], Float[np.ndarray, "T"]],
    closest: float,
    number: int,
    time: Float[np.ndarray, "T"],
    generator: np.random.Generator,
) -> Float[np.ndarray, "T 2"]:
    """Lateral offsets with one approach to the wall down to ``closest`` mm."""
    middle = (0.40, 0.78)[number % 2] + generator.uniform(-0.04, 0.04)
    swing = np.exp(-0.5 * ((time - middle) / _APPROACH_WIDTH) ** 2)
    clock = generator.uniform(0.0, 2.0 * np.pi)
    direction = np.array([np.cos(clock), np.sin(clock)])
    near = swing > 0.1

    def swung(amount: float) -> Float[np.ndarray, "T 2"]:
        # The wobble is faded out during the approach.
        return np.asarray(sideways * (1.0 - swing[:, None]) + amount * swing[:, None] * direction)

    low, high = 0.0, 14.0
    for _ in range(18):
        amount = 0.5 * (low + high)
        if float(distances(swung(amount))[near].min()) > closest:
            low = amount
        else:
            high = amount
    return swung(low)
