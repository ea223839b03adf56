"""The camera path of phantoms that inspects: a withdrawal that approaches one spot of the wall after another.

It rests at stops at even times, alternately far and near. At a far stop the camera is near the centre line and the wall
in the middle of the image is about 60 mm away; at a near stop it has moved straight towards a spot of the wall, has
turned to it and is about 6 mm from the wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.phantom.colon import CentreLine
from coliags_plugin.phantom.motion import NEAREST, SHALLOW_END, Curve, draw_sway, times
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, stream
from coliags_plugin.phantom.tracing import Tracer

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


@dataclass(frozen=True)
class _Withdrawal:
    """The motion without its approaches: along the centre line, drifting sideways between them."""

    centre_line: CentreLine
    length: float  # mm of arc
    most: float  # largest offset along each of the two across directions, mm
    drift: tuple[Curve, Curve]  # curve of each offset, of amplitude 1

    def at(self, time: Float[np.ndarray, "T"]) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3 3"]]:
        """Positions, world, mm, and frames of the centre line there."""
        arc = resting(SHALLOW_END + self.length * np.linspace(1.0, 0.0, 2 * APPROACHES + 1)[:, None], time)[:, 0]
        points, frames = self.centre_line.at(arc)
        sideways = self.most * np.stack([curve(time) for curve in self.drift], axis=1)
        sideways *= (1.0 - nearness(time))[:, None]
        return points + np.einsum("tck,tk->tc", frames[:, :, :2], sideways), frames


#: A near stop in the centre line's frame: the camera's offset from the withdrawal, mm, and the rotation vector from the
#: centre line's direction to the spot's, radians.
_Spot = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]


def inspecting_path(centre_line: CentreLine, settings: PhantomSettings, tracer: Tracer) -> Float[np.ndarray, "T 4 4"]:
    """Camera-to-world pose of every frame, OpenCV axes, mm."""
    generator = stream(settings.seed, Purpose.TRAJECTORY)
    drift = draw_sway(generator), draw_sway(generator)
    roll = draw_sway(generator)
    withdrawal = _Withdrawal(centre_line, settings.path_length, settings.light_preset.wobble[1], drift)
    spots = _choose_spots(withdrawal, tracer, settings.seed, generator)

    shifts, turns = np.zeros((2, 2 * APPROACHES + 1, 3))
    shifts[1::2], turns[1::2] = zip(*spots, strict=True)
    turns[::2] = [
        _far_turn(withdrawal, number / APPROACHES, turns[1::2][max(number - 1, 0) : number + 1], tracer)
        for number in range(APPROACHES + 1)
    ]

    time = times(settings)
    points, frames = withdrawal.at(time)
    rolls = np.radians(settings.light_preset.turn[2]) * roll(time)
    poses = np.tile(np.eye(4), (settings.frames, 1, 1))
    poses[:, :3, :3] = frames @ _matrices(resting(turns, time)) @ _matrices(rolls[:, None] * np.array([0.0, 0.0, 1.0]))
    poses[:, :3, 3] = points + np.einsum("tck,tk->tc", frames, resting(shifts, time))
    return poses


def resting(values: Float[np.ndarray, "S K"], time: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T K"]:
    """A twice continuously differentiable curve through values at even times from 0 to 1, which rests at each.

    Between two of them it follows Perlin's quintic, whose first and second derivatives are 0 at its ends.
    """
    position = time * (len(values) - 1)
    low = np.minimum(position.astype(int), len(values) - 2)
    x = (position - low)[:, None]
    share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    return np.asarray(values[low] * (1.0 - share) + values[low + 1] * share)


def nearness(time: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """0 at far stops, 1 at near stops."""
    return resting((np.arange(2 * APPROACHES + 1) % 2.0)[:, None], time)[:, 0]


def _choose_spots(withdrawal: _Withdrawal, tracer: Tracer, seed: int, generator: np.random.Generator) -> list[_Spot]:
    """The spots to inspect: by turns around the lumen, and otherwise random."""
    spots = []
    clock = generator.uniform(0.0, 2.0 * np.pi)
    for number in range(APPROACHES):
        for draw in range(_DRAWS):
            # More and more of the circumference is tried.
            tried = clock + generator.uniform(-1.0, 1.0) * min(0.3 + 0.1 * draw, np.pi)
            turn = _turn(np.radians(generator.uniform(*_SPOT_ANGLE)), tried)
            spot = _approach(withdrawal, number, turn, tracer)
            if spot is not None:
                break
        else:
            raise InputError(
                f"the colon of seed {seed} leaves no path that approaches {APPROACHES} spots of the wall",
                f"{_CLOSEST:g} mm from the wall, a spot at most {_SPOT_WITHIN:g} mm away",
                "Choose another seed",
            )
        spots.append(spot)
        # The golden angle distributes any number of directions evenly.
        clock = tried + np.pi * (3.0 - np.sqrt(5.0))
    return spots


def _approach(withdrawal: _Withdrawal, number: int, turn: Float[np.ndarray, "3"], tracer: Tracer) -> _Spot | None:
    """The near stop on the way to the spot that lies in a direction; None where something else is in the way."""
    away = _matrices(turn) @ np.array([0.0, 0.0, 1.0])
    time = (number + np.linspace(0.0, 1.0, _TESTED)) / APPROACHES
    points, frames = withdrawal.at(time)
    middle = _TESTED // 2
    to_spot = float(_distances(points[middle], frames[middle], away[None], tracer)[0])
    if not np.isfinite(to_spot):
        return None
    course = nearness(time)[:, None] * (frames @ away)

    low, high = 0.0, to_spot
    for _ in range(16):
        amount = 0.5 * (low + high)
        if tracer.clearance(points + amount * course).min() > _CLOSEST:
            low = amount
        else:
            high = amount
    reached = float(tracer.clearance(points[middle : middle + 1] + low * course[middle])[0])
    if reached > _CLOSEST + _CLOSER_BEFORE or to_spot - low > _SPOT_WITHIN:
        return None
    return low * away, turn


def _far_turn(
    withdrawal: _Withdrawal, time: float, neighbours: Float[np.ndarray, "N 3"], tracer: Tracer
) -> Float[np.ndarray, "3"]:
    """Rotation vector of a far stop: the one nearest to its neighbours' of those whose wall is about 60 mm away."""
    (point,), (frame,) = withdrawal.at(np.array([time]))
    clocks = np.arange(24) * (np.pi / 12.0)
    turns = np.array([_turn(angle, clock) for angle in np.radians(_FAR_ANGLES) for clock in clocks])
    around = [_turn(angle, clock) for angle in np.radians(_MIDDLE) for clock in clocks[::3]]
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


def _turn(angle: float, clock: float) -> Float[np.ndarray, "3"]:
    """Rotation vector that turns the third axis by an angle towards a clock angle around it, radians."""
    return angle * np.array([-np.sin(clock), np.cos(clock), 0.0])


def _matrices(turns: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Rotations of rotation vectors."""
    return np.asarray(Rotation.from_rotvec(turns).as_matrix())
