"""Camera paths of phantoms: withdrawal, rotation in place, inspection, examination, and rotated test views.

The path that inspects rests at stops at even times, alternately far and near. At a far stop the camera is near the
centre line and the wall in the middle of the image is about 60 mm away; at a near stop it has moved straight towards a
spot of the wall, has turned to it and is about 6 mm from the wall. Speeds of the path that examines, a withdrawal back
and forth with fast turns and wall contacts, are per second: more frames show more of the same motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.ndimage
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.trajectory import rigid
from coliags_plugin.phantom.colon import CentreLine, Tracer, WallMotion, frame_times
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import GOLDEN_ANGLE, Purpose, quintic, stream

#: No closer to the wall than this, mm; C3VD's nearest surface of any sequence is 5.9 mm away.
NEAREST = 6.0
#: Arc length of a withdrawal's shallow end, mm. Far enough in that a view turned sideways still ends on the wall.
SHALLOW_END = 26.0

#: Cycles of a sway over a sequence.
_CYCLES = np.array([0.6, 1.3, 2.4])

Curve = Callable[[Float[np.ndarray, "T"]], Float[np.ndarray, "T"]]
#: Distance at which the image motion of an exposure is judged, mm, and the motion from one rendering to the next, px.
_JUDGED_AT, _BLUR_STEP = 15.0, 1.25
#: Most renderings of an exposure.
_MOST = 24


def poses_between(poses: Float[np.ndarray, "T 4 4"], at: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 4 4"]:
    """Poses at fractional frames; positions and rotations are linear from frame to frame."""
    at = np.clip(at, 0.0, len(poses) - 1.0)
    numbers = np.arange(len(poses))
    rotations = Slerp(numbers, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    return rigid(rotations, np.stack([np.interp(at, numbers, axis) for axis in poses[:, :3, 3].T], axis=1))


def poses_during(
    poses: Float[np.ndarray, "T 4 4"], frame: int, shutter: float, focal_length: float, least: int
) -> list[Float[np.ndarray, "4 4"]]:
    """Poses at even times of a frame's exposure, ``least`` or more, close enough for a smooth blur.

    The shutter is open for the share ``shutter`` of the frame interval, and the frame's own pose is in the middle.
    """
    first, last = poses_between(poses, frame + shutter * np.array([-0.5, 0.5]))
    angle = np.arccos(np.clip(0.5 * (np.trace(first[:3, :3].T @ last[:3, :3]) - 1.0), -1.0, 1.0))
    moved = np.linalg.norm(last[:3, 3] - first[:3, 3])
    count = int(np.clip(np.ceil(focal_length * (angle + moved / _JUDGED_AT) / _BLUR_STEP), least, max(_MOST, least)))
    return list(poses_between(poses, frame + shutter * ((np.arange(count) + 0.5) / count - 0.5)))


def rotation(yaw: float, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """Rotation right by yaw, then up by pitch, then clockwise by roll; radians, camera axes."""
    return np.asarray(
        rotation_about(np.array([0.0, 1.0, 0.0]), yaw)
        @ rotation_about(np.array([1.0, 0.0, 0.0]), pitch)
        @ rotation_about(np.array([0.0, 0.0, 1.0]), roll)
    )


def rotation_about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about a unit axis, radians, right-handed (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def square_to(clock: float) -> Float[np.ndarray, "3"]:
    """Axis about which a camera turns towards a clock angle, radians, around its optical axis."""
    return np.array([-np.sin(clock), np.cos(clock), 0.0])


def _farthest(is_clear: Callable[[Any], Any], most: Any, steps: int) -> Any:
    """Largest clear amount up to ``most``, a number or an array of them, by so many bisections."""
    low, high = np.zeros_like(most), most
    for _ in range(steps):
        middle = 0.5 * (low + high)
        clear = is_clear(middle)
        low, high = np.where(clear, middle, low), np.where(clear, high, middle)
    return low


def looking(
    centers: Float[np.ndarray, "T 3"], targets: Float[np.ndarray, "T 3"], frames: Float[np.ndarray, "T 3 3"]
) -> Float[np.ndarray, "T 4 4"]:
    """Poses that look at targets, x along the centre line's first across direction."""
    forward = targets - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = frames[:, :, 0] - (frames[:, :, 0] * forward).sum(axis=1, keepdims=True) * forward
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return rigid(np.stack([right, np.cross(forward, right), forward], axis=2), centers)


def shifted(
    points: Float[np.ndarray, "T 3"], frames: Float[np.ndarray, "T 3 3"], offsets: Float[np.ndarray, "T K"]
) -> Float[np.ndarray, "T 3"]:
    """Points of the centre line moved along the first axes of its frames there, mm."""
    return points + np.einsum("tck,tk->tc", frames[:, :, : offsets.shape[1]], offsets)


def draw_sway(generator: np.random.Generator, cycles: Float[np.ndarray, "3"] = _CYCLES) -> Curve:
    """A smooth random curve with amplitude 1 over times from 0 to 1, independent of its sampling."""
    phase = generator.uniform(0.0, 2.0 * np.pi, 3)
    weight = np.array([1.0, 0.7, 0.35]) * generator.uniform(0.7, 1.3, 3)

    def curve(at: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return np.asarray((weight * np.sin(2.0 * np.pi * cycles * at[:, None] + phase)).sum(axis=1))

    largest = np.abs(curve(np.linspace(0.0, 1.0, 512))).max()
    return lambda at: np.asarray(curve(at) / largest)


#: Near stops of a sequence.
APPROACHES = 3
#: Distance to the wall at the closest point of an approach, mm. The margin is for frames between those tested.
_CLOSEST = NEAREST + 0.4
#: How much farther than that the wall may be at the near stop itself, where a fold is passed closer by, mm.
_CLOSER_BEFORE = 0.3
#: Distance from the camera to the spot that it inspects, at most, mm. At 6.4 mm from the wall, this is an angle of
#: incidence of up to 48 degrees.
_SPOT_WITHIN = 9.5
#: Angle between the centre line and the direction to a spot, degrees. Smaller ones meet the wall too obliquely.
_SPOT_ANGLE = (45.0, 75.0)
#: Spots tried per approach. The worst of 120 seeds in both presets needs 51.
_DRAWS = 256
#: Points per approach at which the distance to the wall is tested. Odd: the near stop is one of them.
_TESTED = 41
#: Distance of the wall in the middle of the image at a far stop, and how far its quartiles may deviate, mm.
_FAR, _FAR_MARGIN = 60.0, 8.0
#: The middle of the image: angles of the rings of rays around its centre, degrees.
_MIDDLE = (2.0, 4.0)
#: Angles between the centre line and the views tried for a far stop, degrees.
_FAR_ANGLES = np.arange(0.0, 36.0, 2.0)


#: A near stop in the centre line's frame: the camera's offset from the withdrawal, mm, and the rotation vector from the
#: centre line's direction to the spot's, radians.
_Spot = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
#: The motion without its approaches: positions, world, mm, and frames of the centre line at times from 0 to 1.
_Withdrawn = Callable[[Float[np.ndarray, "T"]], tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3 3"]]]


def inspecting_path(centre_line: CentreLine, settings: PhantomSettings, tracer: Tracer) -> Float[np.ndarray, "T 4 4"]:
    """Camera-to-world pose of every frame, OpenCV axes, mm."""
    generator = stream(settings.seed, Purpose.TRAJECTORY)
    drift = draw_sway(generator), draw_sway(generator)
    roll = draw_sway(generator)
    stops = SHALLOW_END + settings.path_length * np.linspace(1.0, 0.0, 2 * APPROACHES + 1)[:, None]

    def withdrawn(time: Float[np.ndarray, "T"]) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3 3"]]:
        points, frames = centre_line.at(resting(stops, time)[:, 0])
        sideways = settings.light_preset.wobble[1] * np.stack([curve(time) for curve in drift], axis=1)
        sideways *= (1.0 - nearness(time))[:, None]
        return shifted(points, frames, sideways), frames

    spots = _choose_spots(withdrawn, tracer, settings.seed, generator)

    shifts, turns = np.zeros((2, 2 * APPROACHES + 1, 3))
    shifts[1::2], turns[1::2] = zip(*spots, strict=True)
    turns[::2] = [
        _far_turn(withdrawn, number / APPROACHES, turns[1::2][max(number - 1, 0) : number + 1], tracer)
        for number in range(APPROACHES + 1)
    ]

    time = np.linspace(0.0, 1.0, settings.frames)
    points, frames = withdrawn(time)
    rolls = np.radians(settings.light_preset.turn[2]) * roll(time)
    rotations = frames @ _matrices(resting(turns, time)) @ _matrices(rolls[:, None] * np.array([0.0, 0.0, 1.0]))
    return rigid(rotations, shifted(points, frames, resting(shifts, time)))


def resting(values: Float[np.ndarray, "S K"], time: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T K"]:
    """A twice continuously differentiable curve through values at even times from 0 to 1, which rests at each."""
    position = time * (len(values) - 1)
    low = np.minimum(position.astype(int), len(values) - 2)
    share = quintic((position - low)[:, None])
    return np.asarray(values[low] * (1.0 - share) + values[low + 1] * share)


def nearness(time: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """0 at far stops, 1 at near stops."""
    return resting((np.arange(2 * APPROACHES + 1) % 2.0)[:, None], time)[:, 0]


def _choose_spots(withdrawn: _Withdrawn, tracer: Tracer, seed: int, generator: np.random.Generator) -> list[_Spot]:
    """The spots to inspect: by turns around the lumen, and otherwise random."""
    spots = []
    clock = generator.uniform(0.0, 2.0 * np.pi)
    for number in range(APPROACHES):
        for draw in range(_DRAWS):
            # More and more of the circumference is tried.
            tried = clock + generator.uniform(-1.0, 1.0) * min(0.3 + 0.1 * draw, np.pi)
            turn = np.radians(generator.uniform(*_SPOT_ANGLE)) * square_to(tried)
            spot = _approach(withdrawn, number, turn, tracer)
            if spot is not None:
                break
        else:
            raise InputError(
                f"the colon of seed {seed} leaves no path that approaches {APPROACHES} spots of the wall",
                f"{_CLOSEST:g} mm from the wall, a spot at most {_SPOT_WITHIN:g} mm away",
                "Choose another seed",
            )
        spots.append(spot)
        clock = tried + GOLDEN_ANGLE
    return spots


def _approach(withdrawn: _Withdrawn, number: int, turn: Float[np.ndarray, "3"], tracer: Tracer) -> _Spot | None:
    """The near stop on the way to the spot that lies in a direction; None where something else is in the way."""
    away = _matrices(turn) @ np.array([0.0, 0.0, 1.0])
    time = (number + np.linspace(0.0, 1.0, _TESTED)) / APPROACHES
    points, frames = withdrawn(time)
    middle = _TESTED // 2
    to_spot = float(_distances(points[middle], frames[middle], away[None], tracer)[0])
    if not np.isfinite(to_spot):
        return None
    course = nearness(time)[:, None] * (frames @ away)

    amount = _farthest(lambda amount: tracer.clearance(points + amount * course).min() > _CLOSEST, to_spot, 16)
    reached = float(tracer.clearance(points[middle : middle + 1] + amount * course[middle])[0])
    if reached > _CLOSEST + _CLOSER_BEFORE or to_spot - amount > _SPOT_WITHIN:
        return None
    return amount * away, turn


def _far_turn(
    withdrawn: _Withdrawn, time: float, neighbours: Float[np.ndarray, "N 3"], tracer: Tracer
) -> Float[np.ndarray, "3"]:
    """Rotation vector of a far stop: the one nearest to its neighbours' of those whose wall is about 60 mm away."""
    (point,), (frame,) = withdrawn(np.array([time]))
    clocks = np.arange(24) * (np.pi / 12.0)
    turns = np.array([angle * square_to(clock) for angle in np.radians(_FAR_ANGLES) for clock in clocks])
    around = [angle * square_to(clock) for angle in np.radians(_MIDDLE) for clock in clocks[::3]]
    rays = _matrices(np.array([np.zeros(3), *around]))[:, :, 2]
    directions = np.einsum("tij,rj->tri", _matrices(turns), rays)
    distances = _distances(point, frame, directions.reshape(-1, 3), tracer).reshape(len(turns), -1)
    # Quartiles, as the median of a view onto the edge of a fold changes with every step.
    quartiles = np.quantile(distances, [0.25, 0.75], axis=1)
    error = np.maximum(np.abs(quartiles - _FAR).max(axis=0), _FAR_MARGIN)
    apart = ((turns[:, None] - neighbours[None]) ** 2).sum(axis=(1, 2))
    return np.asarray(turns[np.lexsort((apart, error))[0]])


def _distances(
    point: Float[np.ndarray, "3"], frame: Float[np.ndarray, "3 3"], directions: Float[np.ndarray, "N 3"], tracer: Tracer
) -> Float[np.ndarray, "N"]:
    """Distances, mm, of the wall from a point, infinite where there is none; directions are in axes ``frame``."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame, point
    directions = directions / directions[:, 2:]
    depth = tracer.cast(pose, directions.astype(np.float32)).z_depth
    return np.asarray(depth * np.linalg.norm(directions, axis=1))


def _matrices(turns: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Rotations of rotation vectors."""
    return np.asarray(Rotation.from_rotvec(turns).as_matrix())


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
_TOUCH, _CLEAR_OF_WALL = 1.2, 2.5


def examining_path(
    centre_line: CentreLine, settings: PhantomSettings, tracer: Tracer, motion: WallMotion | None
) -> Float[np.ndarray, "T 4 4"]:
    """Camera-to-world pose of every frame, OpenCV axes, mm; contacts are with the wall as it is then."""
    generator = stream(settings.seed, Purpose.TRAJECTORY)
    seconds, share = settings.frames / settings.frame_rate, np.linspace(0.0, 1.0, settings.frames)
    slow = np.stack([draw_sway(generator, _SLOW * seconds)(share) for _ in range(3)], axis=1)
    quick = np.stack([draw_sway(generator, _QUICK * seconds)(share) for _ in range(3)], axis=1)
    arc = SHALLOW_END + _BACK + settings.path_length * (1.0 - share) + _BACK * slow[:, 0]
    points, frames = centre_line.at(arc)
    sideways = np.einsum("tck,tk->tc", frames[:, :, :2], _SIDEWAYS / np.sqrt(2.0) * slow[:, 1:])
    sideways *= _permitted(points, sideways, tracer, settings)[:, None]
    poses = looking(points + sideways, centre_line.at(arc + _LOOK_AHEAD)[0], frames)
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
        there, stay, back = _FAST_TIMES if event == "turn" else _CONTACT_TIMES
        time = frame_times(settings) - middle
        # 0, then 1 while it stays, whose middle is time 0, then 0.
        x = np.minimum((time + 0.5 * stay + there) / there, (0.5 * stay + back - time) / back)
        swing = quintic(np.clip(x, 0.0, 1.0))
        angle = generator.uniform(*_FAST_TURN) if event == "turn" else _CONTACT_TURN
        frame = min(round(middle * settings.frame_rate), settings.frames - 1)
        aside = poses[frame, :3, :3] @ np.array([np.cos(clock), np.sin(clock), 0.0])
        for pose, amount in zip(poses, swing, strict=True):
            pose[:3, :3] = pose[:3, :3] @ rotation_about(square_to(clock), amount * np.radians(angle))
        if event == "contact":
            wall = tracer if motion is None else motion.at(frame).tracer
            poses[:, :3, 3] += _reach(poses, swing, aside, frame, wall)[:, None] * aside
    return poses


def _permitted(
    points: Float[np.ndarray, "T 3"], sideways: Float[np.ndarray, "T 3"], tracer: Tracer, settings: PhantomSettings
) -> Float[np.ndarray, "T"]:
    """Share of the sideways motion that keeps the camera off the wall, smooth in time."""
    nearest = _CLEAR_OF_WALL + settings.wave + settings.breathing
    low = _farthest(
        lambda share: tracer.clearance(points + share[:, None] * sideways) > nearest, np.ones(len(points)), 12
    )
    width = max(round(0.4 * settings.frame_rate), 1)
    return np.asarray(scipy.ndimage.gaussian_filter1d(scipy.ndimage.minimum_filter1d(low, 2 * width + 1), 0.5 * width))


def _reach(
    poses: Float[np.ndarray, "T 4 4"],
    swing: Float[np.ndarray, "T"],
    aside: Float[np.ndarray, "3"],
    frame: int,
    tracer: Tracer,
) -> Float[np.ndarray, "T"]:
    """Motion towards the wall, mm, that ends where the lens nearly touches it."""
    near = np.flatnonzero(swing > 0.0)

    def is_clear(amount: float) -> bool:
        # Along the whole way, as the distance alone would be large again beyond the wall.
        way = poses[frame, :3, 3] + np.linspace(0.0, amount, 60)[:, None] * aside
        moved = poses[near, :3, 3] + (amount * swing[near])[:, None] * aside
        return bool(min(tracer.clearance(way).min(), tracer.clearance(moved).min()) > _TOUCH)

    return _farthest(is_clear, 30.0, 16) * swing


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
        return examining_path(centre_line, settings, tracer, motion)
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


def turn_away(
    poses: Float[np.ndarray, "T 4 4"], settings: PhantomSettings, training: Sequence[int]
) -> list[RotationView]:
    """Test views at positions of training frames, rotated by 15 to 30 degrees.

    On a pullback they are rotated in all directions; on a rotation trajectory further outwards.
    """
    generator = stream(settings.seed, Purpose.ROTATION_VIEWS)
    views = []
    clock = generator.uniform(0.0, 2.0 * np.pi)
    for number in range(settings.rotation_views):
        position = (number + 0.5) / settings.rotation_views * len(training)
        frame = training[min(int(position), len(training) - 1)]
        clock += GOLDEN_ANGLE
        turn = generator.uniform(*_ROTATION_TURN)
        direction = clock
        if settings.trajectory == "rotation":
            middle = poses[frame, :3, :3].T @ poses[:, :3, 2].mean(axis=0)
            direction = float(np.arctan2(-middle[1], -middle[0]))
        pose = poses[frame].copy()
        pose[:3, :3] = pose[:3, :3] @ rotation_about(square_to(direction), np.radians(turn))
        views.append(RotationView(frame, float(turn), pose))
    return views


def _withdrawing_path(centre_line: CentreLine, settings: PhantomSettings, tracer: Tracer) -> Float[np.ndarray, "T 4 4"]:
    """Poses of the trajectories ``pullback`` and ``rotation``: along the centre line, and almost in place."""
    generator = stream(settings.seed, Purpose.TRAJECTORY)
    preset = settings.light_preset
    time = np.linspace(0.0, 1.0, settings.frames)
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

    def distances(sideways: Float[np.ndarray, "T 2"]) -> Float[np.ndarray, "T"]:
        return tracer.clearance(shifted(points, frames, sideways))

    def approached(sideways: Float[np.ndarray, "T 2"], number: int) -> Float[np.ndarray, "T 2"]:
        middle = (0.40, 0.78)[number % 2] + generator.uniform(-0.04, 0.04)
        swing = np.exp(-0.5 * ((time - middle) / _APPROACH_WIDTH) ** 2)
        clock = generator.uniform(0.0, 2.0 * np.pi)
        course = np.array([np.cos(clock), np.sin(clock)])

        def swung(amount: float) -> Float[np.ndarray, "T 2"]:
            # The wobble is faded out during the approach.
            return np.asarray(sideways * (1.0 - swing[:, None]) + amount * swing[:, None] * course)

        return swung(_farthest(lambda amount: distances(swung(amount))[swing > 0.1].min() > preset.closest, 14.0, 18))

    for _ in range(30):
        if distances(sideways).min() >= NEAREST + 0.5:
            break
        sideways = 0.85 * sideways
    for number in range(0 if on_the_spot else preset.approaches):
        sideways = approached(sideways, number)
    poses = looking(shifted(points, frames, sideways), centre_line.at(arc + _LOOK_AHEAD)[0], frames)
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
