"""Data manager for RotateColon, PR-Endo's rendered colon with rotated test views (docs/layouts/rotatecolon.md)."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from pydantic import Field
from typing_extensions import override

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.scene_files import for_all, for_every, inventory, numbered, require_folder
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.core.splits import Split
from coliags_plugin.datamanagers.file_formats import ExrDepth, Transforms, camera_of, size_of
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.recorded import ROTATION, InitialPoints, RecordedDataManager, Recording, SceneSettings
from coliags_plugin.datamanagers.shots import Shot, make_shots

log = logging.getLogger(__name__)

_LAYOUT = "RotateColon's transforms.json, train_views/NNNN.png and perhaps depth_train/NNNN.exr"
TRAIN, TRAIN_VIEWS, TRAIN_DEPTH = "transforms.json", "train_views", "depth_train"
TEST = "transforms_test.json"
POINTS = "init_point_cloud.ply"
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
    seen_in: ClassVar[Mapping[str, str]] = {_MAIN_SET: "truth", ROTATION: "truth"}

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        return f"{TRAIN} beside {TRAIN_VIEWS}/" if (path / TRAIN).is_file() and (path / TRAIN_VIEWS).is_dir() else None

    @override
    def open(self, path: Path) -> Recording:
        require_folder(path, _LAYOUT)
        if self.recognise(path) is None:
            raise InputError(f"{path} holds {inventory(path)}", _LAYOUT, "Name the scene's own folder")
        shots, facts = self._views(path / TRAIN, path / TRAIN_VIEWS, path / TRAIN_DEPTH)
        test, parts, test_sets = path / TEST, [facts], {}
        if test.is_file():
            images = path / user_path(self.settings.test_folder)
            if not images.is_dir():
                raise InputError(
                    f"{path} has {TEST} but no folder {self.settings.test_folder}",
                    "the images of the test views",
                    "Name the folder they are in with `datamanager.test_folder=FOLDER`",
                )
            name = _MAIN_SET if self.settings.split in ("all-train", "own") else ROTATION
            test_sets[name], facts[name] = self._views(test, images, None, "test-")
            parts.append(facts[name])
        return Recording(
            folder=path,
            kind="RotateColon layout",
            shots=shots,
            facts=facts,
            described_by=(path / TRAIN, test if test_sets else None),
            test_sets=test_sets,
            own_split={"train": range(len(shots)), "test": ()},
            points_source=path / POINTS,
            read_points=lambda source: _pink(load_points(source)),
            is_complete=not any(part["images_without_pose"] for part in parts),
        )

    def _views(
        self, transforms: Path, folder: Path, depth_folder: Path | None, prefix: str = ""
    ) -> tuple[list[Shot], dict[str, Any]]:
        """Frames of the poses in a JSON file, in order of their numbers, and their provenance.

        There must be an image for every pose; others are counted. Either all frames have a depth file, or none.
        """
        settings, content = self.settings, Transforms(transforms)
        stated = _numbers(transforms, content.names)
        order = sorted(range(len(stated)), key=stated.__getitem__)
        files = numbered(folder, "", frozenset({".png"}))
        frames = {f"frame {number}": number for number in sorted(stated)}
        images = for_every({name: files.get(number) for name, number in frames.items()}, folder, "an image")
        unposed = len(files) - len(images)
        if unposed:
            log.warning("%s: %d images of %s have no pose and are left out", transforms, unposed, folder.name)
        deep = {} if depth_folder is None else numbered(depth_folder, "", frozenset({".exr"}))
        depths = for_all({name: deep.get(number) for name, number in frames.items()}, depth_folder, "a depth file")
        angle = {"camera_angle_x": content.content.get("camera_angle_x")}
        lens = camera_of(angle, str(transforms), "half", lambda: size_of(images[0]))
        rectification = self.rectification_of(lens, images[0])
        form = ExrDepth(settings.depth_channel, settings.depth_divisor)
        shots = make_shots(images, rectification, content.trajectory.camera_to_world[order], depths, form, prefix)
        facts = {
            "layout": "rotatecolon",
            "images_without_pose": unposed,
            "pose_convention": "camera-to-world, OpenGL axes",
        }
        return shots, facts


def _numbers(transforms: Path, names: Sequence[str]) -> list[int]:
    """Frame numbers from ``file_path``, with or without folder and suffix."""
    numbers: list[int] = []
    for name in names:
        stem = name.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(".png")
        if not stem.isdecimal():
            raise InputError(f"{transforms}: file_path '{name}'", "the frame's number, for instance '12'")
        number = int(stem)
        if number in numbers:
            raise InputError(f"{transforms}: frame {number} is repeated", "one pose for each image")
        numbers.append(number)
    return numbers


def _pink(points: PointCloud) -> PointCloud:
    return PointCloud(points.positions, torch.tensor(PINK, dtype=torch.uint8).expand(len(points), 3).contiguous())
