"""Camera trajectories, independent of the file format."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import JsonObject

#: Largest deviation of R^T R from the identity, and of a quaternion from unit length. Six digits in files give 1e-6.
RIGID_TOLERANCE = 1e-3
#: Below this length a quaternion has no direction.
ZERO_QUATERNION = 1e-8

#: Between OpenCV's camera axes (x right, y down, z forward) and OpenGL's (x right, y up, z back); its own inverse.
FLIP_Y_AND_Z = np.diag([1.0, -1.0, -1.0, 1.0])


def check_rigid(
    matrices: Float[np.ndarray, "N 4 4"],
    place: Callable[[int], str],
    expected: str = f"both within {RIGID_TOLERANCE:g}",
    do: str = "",
) -> None:
    """Refuse poses that are not finite, rigid and right-handed, or lie beyond ``bounds.LENGTH``; the first is named.

    ``place`` names the matrix of an index in the message: file and line, or frame; ``expected`` and ``do`` are for one
    that is not rigid.
    """
    with np.errstate(invalid="ignore"):
        far = np.abs(matrices[:, :3, 3]).max(axis=1) > bounds.LENGTH
    finite = np.isfinite(matrices).all(axis=(1, 2)) & ~far
    safe = np.where(finite[:, None, None], matrices, np.eye(4))
    rotations = safe[:, :3, :3]
    errors = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max(axis=(1, 2))
    borders = np.abs(safe[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1)
    left_handed = np.linalg.det(rotations) < 0.0
    bad = ~finite | (np.maximum(errors, borders) > RIGID_TOLERANCE) | left_handed
    if not bad.any():
        return
    index = int(np.argmax(bad))
    if far[index]:
        raise InputError(
            f"{place(index)}: a camera at {_listed(matrices[index, :3, 3])}",
            f"coordinates up to {bounds.LENGTH:g}, in mm where lengths are known",
            do,
        )
    if not finite[index]:
        raise InputError(f"{place(index)}: a transform that is not finite", "sixteen finite numbers", do)
    if max(errors[index], borders[index]) > RIGID_TOLERANCE:
        raise InputError(
            f"{place(index)}: not a rigid transform (R^T R is {errors[index]:.2g} from the identity, "
            f"the fixed part {borders[index]:.2g} from 0, 0, 0, 1)",
            expected,
            do,
        )
    raise InputError(
        f"{place(index)}: a left-handed transform (det R = -1)",
        "camera axes x right, y down, z forward in a right-handed world",
        "Undo the flip of one axis in the program that wrote the file",
    )


def rotations_from_wxyz(
    quats_wxyz: Float[np.ndarray, "N 4"], place: Callable[[int], str], *, unit: bool
) -> Float[np.ndarray, "N 3 3"]:
    """Rotation matrices from quaternions, w first, which are normalised here; ``place`` names one by its index.

    With ``unit``, a quaternion further than ``RIGID_TOLERANCE`` from unit length is refused: in a format that stores
    unit quaternions, another length means another column order or a damaged file.
    """
    lengths = np.linalg.norm(quats_wxyz, axis=1)
    for index in np.flatnonzero(~(lengths > ZERO_QUATERNION) | ~np.isfinite(lengths)):
        raise InputError(
            f"{place(int(index))}: the quaternion ({_listed(quats_wxyz[index])}) is not a rotation",
            "four finite numbers, not all 0",
        )
    for index in np.flatnonzero(np.abs(lengths - 1.0) > RIGID_TOLERANCE) if unit else ():
        raise InputError(
            f"{place(int(index))}: a quaternion of length {lengths[index]:.6g}",
            f"length 1 within {RIGID_TOLERANCE:g}",
            "Check the order of the columns",
        )
    return np.asarray(Rotation.from_quat(quats_wxyz[:, [1, 2, 3, 0]]).as_matrix())


def wxyz_from_rotations(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 4"]:
    """Unit quaternions, w first and not negative, of the rotations nearest to the matrices. [N, 4]"""
    xyzw = Rotation.from_matrix(rotations).as_quat(canonical=True)
    return np.asarray(xyzw[:, [3, 0, 1, 2]])


def w_first(matrices: Float[np.ndarray, "N 4 4"], is_first: bool = True) -> Float[np.ndarray, "N 4 4"]:
    """Reorder the quaternions of rigid transforms: read with w last, they are read with w first, or the reverse."""
    stored = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(scalar_first=not is_first)
    return rigid(Rotation.from_quat(stored, scalar_first=is_first).as_matrix(), matrices[:, :3, 3])


def rigid(rotations: Float[np.ndarray, "N 3 3"], translations: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4 4"]:
    """Rigid transforms from rotations and translations. [N, 4, 4]"""
    matrices = np.tile(np.eye(4), (len(rotations), 1, 1))
    matrices[:, :3, :3] = rotations
    matrices[:, :3, 3] = translations
    return matrices


def inverse(matrices: Float[np.ndarray, "N 4 4"]) -> Float[np.ndarray, "N 4 4"]:
    """Inverses of rigid transforms. [N, 4, 4]"""
    transposed = matrices[:, :3, :3].transpose(0, 2, 1)
    return rigid(transposed, -np.einsum("nij,nj->ni", transposed, matrices[:, :3, 3]))


def rotation_angles_deg(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N"]:
    """Rotation angles, degrees, 0 to 180; exact for small angles too. [N]"""
    return np.rad2deg(Rotation.from_matrix(rotations).magnitude())


def _listed(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:g}" for number in numbers)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses in video order, rigid, with OpenCV axes (x right, y down, z forward).

    Lengths and world are as in the file, unless a remark says otherwise.
    """

    camera_to_world: Float[np.ndarray, "N 4 4"]  # float64
    names: tuple[str, ...] | None = None  # image name of each pose in the file
    timestamps: Float[np.ndarray, "N"] | None = None  # capture time of each image, s. float64
    intrinsics: Intrinsics | None = None  # the pinhole that took all images; None: unknown, or other cameras
    # The camera of each pose, by nerfstudio's keys, where they are not one pinhole and nerfstudio has them
    cameras: tuple[JsonObject, ...] | None = None
    stored_as: str = ""  # convention of the file, for messages
    remarks: tuple[str, ...] = ()  # changes and omissions when the file was read

    def __post_init__(self) -> None:
        """Refuse no poses, those not rigid, right-handed and finite, and other than one name or finite time each."""
        matrices = np.asarray(self.camera_to_world, dtype=np.float64)
        if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or not len(matrices):
            raise InputError(f"poses of the shape {list(matrices.shape)}", "[N, 4, 4], at least one")
        check_rigid(matrices, lambda index: f"pose {index}")
        object.__setattr__(self, "camera_to_world", matrices)
        if self.names is not None and len(self.names) != len(matrices):
            raise InputError(f"{len(self.names)} names for {len(matrices)} poses", "one for each")
        if self.timestamps is not None:
            timestamps = np.asarray(self.timestamps, dtype=np.float64)
            if timestamps.shape != (len(matrices),) or not np.all(np.isfinite(timestamps)):
                raise InputError(
                    f"timestamps of the shape {list(timestamps.shape)} for {len(matrices)} poses",
                    "one finite number for each",
                )
            object.__setattr__(self, "timestamps", timestamps)

    def __len__(self) -> int:
        return len(self.camera_to_world)

    @property
    def centers(self) -> Float[np.ndarray, "N 3"]:
        """Camera centres in the world. [N, 3]"""
        return self.camera_to_world[:, :3, 3]

    @property
    def rotations(self) -> Float[np.ndarray, "N 3 3"]:
        """Camera-to-world rotations. [N, 3, 3]"""
        return self.camera_to_world[:, :3, :3]

    @property
    def steps(self) -> Float[np.ndarray, "N-1"]:
        """Distance of each centre from the one before it. [N - 1]"""
        return np.asarray(np.linalg.norm(np.diff(self.centers, axis=0), axis=1))

    def summary(self, unit: str = "units") -> str:
        """One-line summary: number of poses, path length and viewing direction, which reveal a wrong convention."""
        steps = self.steps
        mean_step = float(steps.mean()) if len(steps) else 0.0
        x, y, z = self.rotations[:, :, 2].mean(axis=0)
        return (
            f"{len(self)} poses, path {steps.sum():.4g} {unit}, mean step {mean_step:.3g} {unit}, "
            f"mean looking direction ({x:.2f}, {y:.2f}, {z:.2f})"
        )

    def needed_intrinsics(self, path: Path, holder: str) -> Intrinsics:
        """The intrinsics, for a file that must hold them; refuses a trajectory without."""
        if self.intrinsics is None:
            raise InputError(
                f"no intrinsics for {path}"
                + ("" if self.cameras is None else ", but cameras that are not one pinhole"),
                f"{holder} to hold the camera's intrinsics and image size",
                "Pass `intrinsics=fx,fy,cx,cy` and `size=WIDTHxHEIGHT`",
            )
        return self.intrinsics

    def names_or_numbers(self) -> tuple[str, ...]:
        """The names, or ``0000.png``, ``0001.png``, ... without names."""
        return self.names if self.names is not None else tuple(f"{index:04d}.png" for index in range(len(self)))


def natural_order(names: Sequence[str]) -> list[int]:
    """Indices that sort names in natural order, 2 before 10; stable."""
    return sorted(range(len(names)), key=lambda index: _natural(names[index]))


def refuse_repeated(names: Sequence[str], place: str) -> None:
    """Refuse a name that is repeated; the message gives it and its two indices."""
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        if first.setdefault(name, index) != index:
            raise InputError(
                f"{place}: '{name}' is repeated (poses {first[name]} and {index})", "one pose for each image"
            )


def _natural(name: str) -> tuple[list[tuple[int, int, str]], str]:
    # Numbers before words; the name itself last, to order 01 and 1.
    parts = re.findall(r"\d+|\D+", name)
    digits = [part.lstrip("0") if part.isdecimal() else None for part in parts]
    # By length and then by digits is the order of numbers, also of those too long for int().
    pairs = zip(parts, digits, strict=True)
    return [(1, 0, part) if number is None else (0, len(number), number) for part, number in pairs], name
