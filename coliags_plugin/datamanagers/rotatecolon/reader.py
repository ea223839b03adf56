"""Data manager for RotateColon, PR-Endo's rendered colon with rotated test views."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import torch
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.reading.files import inventory, require_folder
from coliags_plugin.datamanagers.reading.images import size_of
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.recording import Recording, Shot, fingerprint, make_shots
from coliags_plugin.datamanagers.rectification import Rectification
from coliags_plugin.datamanagers.rotatecolon import files as layout
from coliags_plugin.datamanagers.rotatecolon.depth_scale import fit_scale
from coliags_plugin.datamanagers.rotatecolon.exr_depth import ExrDepth
from coliags_plugin.datamanagers.scene_settings import InitialPoints, SceneSettings
from coliags_plugin.datamanagers.seen_masks import ROTATION, find_seen_masks
from coliags_plugin.datamanagers.splits import Split

log = logging.getLogger(__name__)

#: The colour that PR-Endo and the authors' code give all initial points, ignoring the file's colours.
PINK = (188, 99, 76)
#: Name of the split's test set, or of the dataset's test views if the split holds out none.
_MAIN_SET = "test"


class RotateColonSettings(SceneSettings):
    """Options of the ``rotatecolon`` data manager."""

    depth_divisor: float = Field(
        1.4,
        gt=0.0,
        description="Divisor from stored depth to units of the poses. Taken from PR-Endo's code, which does not "
        "explain it (docs/layouts/rotatecolon.md 4).",
    )
    depth_channel: str = Field("ViewLayer.Depth.Z", description="The EXR channel that holds depth.")
    test_folder: str = Field("test_views_1", description="The folder of the images of transforms_test.json.")
    split: Split = Field("all-train", description="As for all data managers; the test views are a separate set.")
    initial_points: InitialPoints = Field("data", description="As for all data managers; init_point_cloud.ply.")


class RotateColonDataManager(RecordedDataManager):
    """Reads a RotateColon scene; see docs/layouts/rotatecolon.md.

    The views of transforms_test.json, which have no depth, are the test set ``test``; where a split holds out training
    views, these are ``test`` and the others ``rotation``. ``truth/seen/NNNN_seen.png`` are the masks of the pixels of
    transforms_test.json's views that training views see.
    """

    Settings = RotateColonSettings

    settings: RotateColonSettings
    name = "rotatecolon"
    #: The dataset does not document it.
    unit = "unknown"
    #: Published results use the stored size.
    fits = None
    seen_split = "all-train"

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """See :class:`DataManager`."""
        return (
            f"{layout.TRAIN} beside {layout.TRAIN_VIEWS}/"
            if (path / layout.TRAIN).is_file() and (path / layout.TRAIN_VIEWS).is_dir()
            else None
        )

    def open(self, path: Path) -> Recording:
        """See :class:`RecordedDataManager`."""
        settings = self.settings
        train, test = self._views(path)
        shots, facts = self._shots(train)
        holds_out = settings.split not in ("all-train", "own")
        name = ROTATION if holds_out else _MAIN_SET
        test_sets = {}
        if test is not None:
            seen = find_seen_masks(path / "truth", len(test.images), complete=not train.unposed and not test.unposed)
            test_sets[name], facts[name] = self._shots(test, seen, "test-")
        points = path / layout.POINTS
        facts["depth_against_points"] = self._compared(shots, points)
        files = [part for part in (train, test) if part is not None]
        return Recording(
            kind="RotateColon layout",
            shots=shots,
            facts=facts,
            fingerprint=fingerprint(
                path,
                (
                    points if points.is_file() else None,
                    *(file for part in files for file in (*part.images, *(part.depths or ()))),
                ),
                (part.transforms for part in files),
            ),
            test_sets=test_sets,
            own_split={"train": range(len(shots)), "test": ()},
            own_points=(lambda: _pink(load_points(points))) if points.is_file() else None,
            points_source=points,
        )

    def _views(self, path: Path) -> tuple[layout.ViewFiles, layout.ViewFiles | None]:
        """The training views, and the test views if there are any."""
        require_folder(path, layout.LAYOUT)
        if self.recognise(path) is None:
            raise InputError(f"{path} holds {inventory(path)}", layout.LAYOUT, "Name the scene's own folder")
        train = layout.find_views(path / layout.TRAIN, path / layout.TRAIN_VIEWS, path / layout.TRAIN_DEPTH)
        if not (path / layout.TEST).is_file():
            return train, None
        images = path / self.settings.test_folder
        if not images.is_dir():
            raise InputError(
                f"{path} has {layout.TEST} but no folder {self.settings.test_folder}",
                "the images of the test views",
                "Name the folder they are in with --set datamanager.test_folder=FOLDER",
            )
        return train, layout.find_views(path / layout.TEST, images, None)

    def _shots(
        self, files: layout.ViewFiles, seen: dict[int, Path] | None = None, prefix: str = ""
    ) -> tuple[list[Shot], dict[str, Any]]:
        settings = self.settings
        width, height = size_of(files.images[0])
        focal = 0.5 * width / math.tan(0.5 * files.angle)
        pinhole = Intrinsics(focal, focal, 0.5 * width, 0.5 * height, width, height)
        rectification = Rectification.of_pinhole(pinhole, files.images[0], self.working_size(width, height))
        depth_format = ExrDepth(settings.depth_channel, settings.depth_divisor)
        shots = make_shots(
            files.images, rectification, files.camera_to_world, files.depths, depth_format, seen or {}, prefix
        )
        facts = {
            "layout": "rotatecolon",
            "transforms": files.transforms.name,
            "images_without_pose": files.unposed,
            "depth_divisor": None if files.depths is None else settings.depth_divisor,
            **rectification.facts(),
            "pose_convention": "camera-to-world, OpenGL axes",
        }
        return shots, facts

    def _compared(self, shots: list[Shot], points: Path) -> dict[str, float] | None:
        """Scale agreement of depth and initial points; None if one of them is missing."""
        if not points.is_file():
            return None
        fit = fit_scale(shots, load_points(points).positions.double().numpy())
        if fit is None:
            return None
        divisor = self.settings.depth_divisor
        if fit.disagrees:
            log.warning(
                "%s: depth / %g is off the points by %.2g of the depth, depth / %.4g by %.2g; "
                "consider depth_divisor (docs/layouts/rotatecolon.md 4)",
                points,
                divisor,
                fit.distance,
                divisor / fit.factor,
                fit.distance_at_best,
            )
        return {
            "best_divisor": divisor / fit.factor,
            "ratio": fit.factor,
            "median_distance_over_depth": fit.distance,
            "at_best_divisor": fit.distance_at_best,
        }


def _pink(points: PointCloud) -> PointCloud:
    return PointCloud(points.positions, torch.tensor(PINK, dtype=torch.uint8).expand(len(points), 3).contiguous())
