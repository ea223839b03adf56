"""C3VD: posed colonoscopy of silicone phantoms, with dense depth (Bobrow et al., 2023)."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from typing_extensions import Self

from coliags_plugin.contracts import DataManager
from coliags_plugin.datamanagers.c3vd_frames import SequenceReader
from coliags_plugin.datamanagers.c3vd_layouts import find_layout, find_optional
from coliags_plugin.datamanagers.fusion import fuse_depth, read_points
from coliags_plugin.datamanagers.splits import Split, held_out
from coliags_plugin.errors import InputError
from coliags_plugin.lenses import LENSES
from coliags_plugin.scenes import Frame, PointCloud, Scene
from coliags_plugin.settings import Settings

log = logging.getLogger(__name__)

POINTS_FILE = "points3D.ply"
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class C3VDSettings(Settings):
    """Options of the ``c3vd`` data manager."""

    width: int | None = Field(
        None, gt=0, description="Working width, pixels. None: what fits 338 x 270, the paper's quarter of a raw frame."
    )
    height: int | None = Field(None, gt=0, description="Working height, pixels; goes with width.")
    lens: Literal["omnidirectional", "legacy-pinhole", "fisheye"] = Field(
        "omnidirectional",
        description="How raw frames are undistorted (pinhole frames need none): 'omnidirectional' rendered the ground "
        "truth; 'legacy-pinhole' is behind most published numbers and off by degrees (docs/data.md 2); "
        "'fisheye' is REIM-NeRF's.",
    )
    focal_scale: float = Field(
        1.0,
        gt=0.0,
        le=4.0,
        description="Factor on the nominal focal length when raw frames are undistorted; below 1 more of the wide view "
        "is kept.",
    )
    mask: bool = Field(True, description="Ignore what lies outside the octagon of raw frames.")
    split: Split = Field(
        "every-8th",
        description="Test frames: 'every-8th': 0, 8, 16, ... as in the paper; 'endogslam': 7, 15, 23, ...; "
        "'block': one stretch of the video; 'all-train': none. Counted after frame_step and max_frames.",
    )
    block: tuple[Share, Share] = Field(
        (0.4, 0.6), description="Split 'block': where the stretch begins and ends, as shares of the video."
    )
    frame_step: int = Field(1, ge=1, description="Use every so-many-th frame of the video.")
    max_frames: int | None = Field(
        None, ge=1, description="Use at most so many frames, the first ones after frame_step."
    )
    initial_points: Literal["depth", "file"] = Field(
        "depth",
        description="Initial points: 'depth': fused from the training frames' depth, or the scene's points3D.ply where "
        "there is no depth; 'file': points_file.",
    )
    points_file: str = Field(
        POINTS_FILE, description="PLY or NPZ for initial_points 'file', relative to the scene folder or absolute."
    )
    points_count: int = Field(200_000, ge=1, description="At most so many initial points, drawn without replacement.")
    seed: int = Field(0, ge=0, description="Of the draw of initial points.")

    @model_validator(mode="after")
    def _both_sides_or_none(self) -> Self:
        if (self.width is None) != (self.height is None):
            raise ValueError(f"width = {self.width} and height = {self.height}: give both or neither")
        return self

    @model_validator(mode="after")
    def _block_is_a_stretch(self) -> Self:
        if self.block[0] >= self.block[1]:
            raise ValueError(f"block = {self.block}: it must begin before it ends")
        return self


class C3VDDataManager(DataManager):
    """Reads a C3VD sequence: the raw release or the undistorted layout, told apart by the files (docs/data.md 1, 3).

    A sub-folder ``rotation`` in either layout becomes the test set of that name. ``seen/NNNN_seen.png`` in it, and
    ``truth/seen/NNNN_seen.png`` beside the sequence (valid for the split every-8th of all frames), mark what training
    frames see.
    """

    Settings = C3VDSettings

    settings: C3VDSettings

    def load(self, path: Path) -> Scene:
        """Read the scene.

        Args:
            path: The sequence's folder.

        Returns:
            Frames of the working size; world and units of the pose file (mm).

        Raises:
            InputError: The folder is missing, or anything in it is not as it should be.
        """
        path = Path(path)
        settings = self.settings
        reader = self._reader(path)
        count = len(reader.layout.images)
        indices = list(range(0, count, settings.frame_step))[: settings.max_frames]
        is_test = held_out(settings.split, len(indices), settings.block)
        if is_test.all():
            raise InputError(
                f"split '{settings.split}' of {len(indices)} frames of {path} leaves none to train on",
                "at least one training frame",
                "Use more frames, or another split ('all-train' holds none out)",
            )
        complete = settings.split == "every-8th" and len(indices) == count
        seen = find_optional(path / "truth" / "seen", "seen", count) if complete else {}
        test_indices = [index for index, held in zip(indices, is_test, strict=True) if held]
        frames = reader.read_all(indices, seen={index: seen[index] for index in test_indices if index in seen})
        train = [frame for frame, held in zip(frames, is_test, strict=True) if not held]
        test_sets = (
            {"test": [frame for frame, held in zip(frames, is_test, strict=True) if held]} if test_indices else {}
        )
        provenance = {
            "dataset": "c3vd",
            "path": str(path.resolve()),
            **_describe(reader, settings),
            "split": {"name": settings.split, **_split_options(settings), "train": [frame.name for frame in train]},
        }
        if (path / "rotation").is_dir():
            rotation = self._reader(path / "rotation")
            number = len(rotation.layout.images)
            marks = find_optional(path / "rotation" / "seen", "seen", number)
            test_sets["rotation"] = rotation.read_all(list(range(number)), "rotation-", marks)
            provenance["rotation"] = _describe(rotation, settings)
        points, provenance["points"] = self._initial_points(path, train)
        provenance["split"]["test_sets"] = {name: [frame.name for frame in held] for name, held in test_sets.items()}
        provenance["frames"] = {
            "in_sequence": count,
            "train": len(train),
            **{name: len(held) for name, held in test_sets.items()},
        }
        provenance["invalid_depth_share"] = _invalid_depth_share(frames)
        convention = reader.poses.convention
        log.info("%s: %d frames, %s layout, %s poses", path, count, reader.layout.kind, convention)
        return Scene(path.resolve().name, train, test_sets, points, provenance)

    def _reader(self, folder: Path) -> SequenceReader:
        settings = self.settings
        return SequenceReader(
            find_layout(folder),
            LENSES[settings.lens],
            size=None if settings.width is None or settings.height is None else (settings.width, settings.height),
            focal_scale=settings.focal_scale,
            mask=settings.mask,
        )

    def _initial_points(self, path: Path, train: Sequence[Frame]) -> tuple[PointCloud, dict[str, Any]]:
        settings = self.settings
        generator = np.random.default_rng(settings.seed)
        has_depth = any(frame.depth is not None for frame in train)
        if settings.initial_points == "depth" and has_depth:
            points = fuse_depth(train, settings.points_count, generator)
            return points, {"source": "depth of the training frames", "count": len(points), "seed": settings.seed}
        file = path / (settings.points_file if settings.initial_points == "file" else POINTS_FILE)
        if settings.initial_points == "depth" and not file.is_file():
            raise InputError(
                f"{path} has neither depth files nor {POINTS_FILE}",
                "depth to make initial points from, or the points themselves",
                f"Put {POINTS_FILE} (world of the poses, mm) there, or set initial_points: file and points_file",
            )
        points = read_points(file, settings.points_count, generator)
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        return points, {"source": str(file), "sha256": digest, "count": len(points), "seed": settings.seed}


def _describe(reader: SequenceReader, settings: C3VDSettings) -> dict[str, Any]:
    view, raw = reader.view, reader.layout.kind == "raw"
    fx, fy, cx, cy = view.pinhole
    return {
        "layout": reader.layout.kind,
        "lens": settings.lens if raw else None,
        "focal_scale": settings.focal_scale if raw else None,
        "mask": "octagon" if raw and settings.mask else None,
        "stored_size": [view.source_width, view.source_height],
        "size": [view.width, view.height],
        "intrinsics": {"fx": fx, "fy": fy, "cx": cx + 0.5, "cy": cy + 0.5, "pixel_centers": "integers + 0.5"},
        "pose_convention": {"order": reader.poses.convention, **reader.poses.evidence},
        "fingerprint": reader.layout.fingerprint(),
    }


def _split_options(settings: C3VDSettings) -> dict[str, Any]:
    options: dict[str, Any] = {"frame_step": settings.frame_step, "max_frames": settings.max_frames}
    if settings.split == "block":
        options["block"] = list(settings.block)
    return options


def _invalid_depth_share(frames: Sequence[Frame]) -> float | None:
    """Share of the unmasked pixels whose depth is unknown; None where there is no depth."""
    shares = [torch.isnan(frame.depth[frame.valid]).double().mean() for frame in frames if frame.depth is not None]
    return float(torch.stack(shares).mean()) if shares else None
