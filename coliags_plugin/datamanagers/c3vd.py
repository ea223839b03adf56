"""C3VD (Bobrow et al., 2023) and C3VDv2, posed colonoscopy of silicone phantoms (docs/layouts/c3vd.md)."""

from __future__ import annotations

import logging
import math
import re
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from typing_extensions import override

from coliags_plugin.core import scene_files as reading
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import read_text
from coliags_plugin.datamanagers.file_formats import C3VD_DEPTH
from coliags_plugin.datamanagers.recorded import (
    POINTS_FILE,
    ROTATION,
    RecordedDataManager,
    Recording,
    SceneSettings,
    poses_of_images,
)
from coliags_plugin.datamanagers.shots import Rectification, Shot, make_shots, whole_frame
from coliags_plugin.geometry.lenses.models import LENSES, Lens, OmnidirectionalLens, PinholeLens, octagon_mask
from coliags_plugin.geometry.poses.formats import count_first_numbers

log = logging.getLogger(__name__)

LAYOUTS = (
    "the raw release (NNNN_color.png, NNNN_depth.tiff and pose.txt in one folder) "
    "or the undistorted layout (images/, depths/, camera_pose.txt and camera.json)"
)


@dataclass(frozen=True)
class SequenceFiles:
    """The files of one sequence in the layout ``kind``, frame 0 first; depth of all frames or None."""

    kind: str
    folder: Path
    images: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    poses: Path
    camera: Path | None = None


class SequenceDataManager(RecordedDataManager):
    """Base class; subclasses find the files and define the rectification.

    A sub-folder ``rotation`` in the same layout becomes the test set of that name. ``seen/NNNN_seen.png`` in it, and
    ``truth/seen/NNNN_seen.png`` beside the sequence, are the seen masks for :attr:`seen_split`.
    """

    @abstractmethod
    def find(self, folder: Path) -> SequenceFiles:
        """Find the files of the sequence in a folder."""

    @abstractmethod
    def rectification(self, files: SequenceFiles) -> tuple[Rectification, dict[str, Any]]:
        """The rectification of a sequence's images, and its provenance."""

    @override
    def open(self, path: Path) -> Recording:
        files = self.find(path)
        shots, facts = self._shots(files)
        test_sets = {}
        if (path / ROTATION).is_dir():
            test_sets[ROTATION], facts[ROTATION] = self._shots(self.find(path / ROTATION), f"{ROTATION}-")
        return Recording(
            folder=path,
            kind=f"{files.kind} layout, {facts['pose_convention']['order']} poses",
            shots=shots,
            facts=facts,
            described_by=(files.poses, files.camera),
            test_sets=test_sets,
            points_source=path / POINTS_FILE,
        )

    def octagon_rectification(self, lens: Lens, image: Path, mask: bool) -> Rectification:
        """The rectification of raw frames like ``image``, optionally masked outside the octagon."""
        do = "Undistort cropped images yourself and give them in the undistorted layout"
        lens = whole_frame(lens, image, "the lens", do)
        shows = octagon_mask(lens.width, lens.height) if mask else None
        return self.rectification_of(lens, image, shows)

    def _shots(self, files: SequenceFiles, prefix: str = "") -> tuple[list[Shot], dict[str, Any]]:
        poses = poses_of_images(files.poses, len(files.images))
        rectification, described = self.rectification(files)
        shots = make_shots(files.images, rectification, poses.camera_to_world, files.depths, C3VD_DEPTH, prefix)
        facts: dict[str, Any] = {
            "layout": files.kind,
            **described,
            "pose_convention": {"order": poses.convention, **poses.evidence},
        }
        return shots, facts


class C3VDSettings(SceneSettings):
    """Options of the ``c3vd`` data manager."""

    lens: Literal["omnidirectional", "legacy-pinhole", "fisheye"] = Field(
        "omnidirectional",
        description="Lens model to undistort raw frames: 'omnidirectional': that of the rendered ground truth; "
        "'legacy-pinhole': used for most published numbers, and wrong by degrees (docs/layouts/c3vd.md 2); 'fisheye': "
        "REIM-NeRF's.",
    )
    mask: bool = Field(True, description="Ignore pixels outside the octagon of raw frames.")


class C3VDDataManager(SequenceDataManager):
    """Reads a C3VD sequence in the raw or the undistorted layout.

    See docs/layouts/c3vd.md 1 and 3, and :class:`SequenceDataManager` for test views beside the sequence.
    """

    Settings = C3VDSettings

    settings: C3VDSettings
    name = "c3vd"

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        if (path / "camera_pose.txt").is_file() and (path / "images").is_dir():
            return "camera_pose.txt beside images/"
        if (path / "pose.txt").is_file() and next(path.glob("*_color.png"), None) is not None:
            return "pose.txt beside NNNN_color.png"
        return None

    @override
    def find(self, folder: Path) -> SequenceFiles:
        """``kind`` is ``raw`` (distorted) or ``undistorted`` (pinhole images)."""
        reading.require_folder(folder, f"a C3VD sequence: {LAYOUTS}")
        kind, poses, camera = "raw", folder / "pose.txt", None
        images = reading.numbered(folder, "color", frozenset({".png"}))
        depths = reading.numbered(folder, "depth", reading.TIFF_SUFFIXES)
        image_folder = folder
        if (folder / "images").is_dir():
            if images:
                raise InputError(
                    f"{folder} holds both {images[min(images)].name} and images/",
                    "one sequence in one layout",
                    "Move one of the two to its own folder",
                )
            kind, poses, camera = "undistorted", folder / "camera_pose.txt", folder / "camera.json"
            image_folder = folder / "images"
            images = reading.numbered(image_folder, "color", reading.IMAGE_SUFFIXES)
            depths = reading.numbered(folder / "depths", "depth", reading.DEPTH_SUFFIXES)
        if not images:
            do = "Name the sequence's own folder, for instance cecum_t1_a"
            raise InputError(f"{image_folder} holds {reading.inventory(image_folder)}", LAYOUTS, do)
        for path in filter(None, (poses, camera)):
            if not path.is_file():
                raise InputError(f"{folder} has images but no {path.name}", LAYOUTS, f"Add {path.name}")
        return SequenceFiles(kind, folder, *reading.paired(folder, images, depths), poses, camera)

    @override
    def rectification(self, files: SequenceFiles) -> tuple[Rectification, dict[str, Any]]:
        if files.camera is not None:
            return self.rectification_of(PinholeLens.of(reading.read_intrinsics(files.camera)), files.camera), {}
        lens = self.settings.lens
        return self.octagon_rectification(LENSES[lens], files.images[0], self.settings.mask), {"lens": lens}


#: From the configuration of the same group's later renderer (C3VDv3). C3VDv2's own page gives no numbers, so this is
#: what v2 was probably rendered with, and unverified (docs/layouts/c3vd-v2.md 2). It counts pixel centres at integers:
#: hence + 0.5.
CANDIDATE_LENS = OmnidirectionalLens(
    width=1350,
    height=1080,
    cx=677.739464094188 + 0.5,
    cy=543.057997844875 + 0.5,
    a0=767.733695862103,
    a2=-0.000592506426558248,
    a3=-2.69440266600040e-07,
    a4=-2.16380341010063e-10,
    c=1.0,
    d=0.0,
    e=0.0,
)

#: Parameters of the model in the order of C3VD's page, and the values of those that may be left out.
ORDER = ("width", "height", "cx", "cy", "a0", "a1", "a2", "a3", "a4", "c", "d", "e")
_OPTIONAL = {"width": 1350.0, "height": 1080.0, "a1": 0.0, "c": 1.0, "d": 0.0, "e": 0.0}
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_NAMED = re.compile(rf"([A-Za-z]\w*)[\"']?\s*[:=\s]\s*({_NUMBER.pattern})")


def read_camera_intrinsics(path: Path) -> OmnidirectionalLens:
    """Read a ``camera_intrinsics.txt``.

    The file's format is not published. Two unambiguous ones are accepted: named numbers (``cx = 677.7``), or twelve
    bare numbers in the order of C3VD's page, :data:`ORDER`, or its last ten (size 1350 x 1080). The centre must be near
    the middle, and the focal length that of a wide-angle lens. Its pixel centres are at integers, as C3VD's.
    """
    text = "\n".join(line.split("#")[0] for line in read_text(path, "a text file of intrinsics").splitlines())
    pairs = [(name.lower(), float(number)) for name, number in _NAMED.findall(text)]
    words = [word for word in re.split(r"[,;\s\[\]()]+", text) if word]
    if not pairs and all(_NUMBER.fullmatch(word) for word in words) and len(words) in (len(ORDER), len(ORDER) - 2):
        pairs = [*zip(ORDER[-len(words) :], map(float, words), strict=True)]
    values = _OPTIONAL | dict(pairs)
    if doubt := _doubt([name for name, _ in pairs], values, words):
        raise InputError(
            f"{path} is ambiguous or implausible: {doubt}",
            f"each number with its name ({', '.join(ORDER)}), or the {len(ORDER)} numbers alone in that order",
            "Rewrite it in this format, or `datamanager.lens=v2` (an unverified candidate), or v1 (C3VD's own)",
        )
    width, height, cx, cy, a0, _, a2, a3, a4, c, d, e = (values[name] for name in ORDER)
    return OmnidirectionalLens(
        width=round(width), height=round(height), cx=cx + 0.5, cy=cy + 0.5, a0=a0, a2=a2, a3=a3, a4=a4, c=c, d=d, e=e
    )


def _doubt(names: list[str], values: dict[str, float], words: list[str]) -> str:
    """A reason why numbers are no calibration of an omnidirectional colonoscope, or none; ``words`` of the file."""
    if not names:
        is_bare = all(_NUMBER.fullmatch(word) for word in words)
        return f"{f'{len(words)} numbers' if is_bare else 'text'} without names"
    faults = {
        "no": set(ORDER) - set(values),
        "twice": {name for name in names if names.count(name) > 1},
        "unknown": set(names) - set(ORDER),
    }
    if any(faults.values()):
        return "; ".join(f"{what} {', '.join(sorted(listed))}" for what, listed in faults.items() if listed)
    width, height, cx, cy, a0, a1, *_, c, d, e = (values[name] for name in ORDER)
    size, is_finite = f"{width:g} x {height:g}", all(map(math.isfinite, values.values()))
    doubts = {
        f"an image of {size}, or numbers that are not finite": not is_finite or min(width, height) < 1.0,
        f"an image of {size} pixels": width % 1.0 or height % 1.0,
        f"a centre ({cx:g}, {cy:g}) far from the middle of {size}": (
            abs(cx - 0.5 * width) > 0.1 * width or abs(cy - 0.5 * height) > 0.1 * height
        ),
        f"a focal length a0 = {a0:g} for {width:g} pixels": not 0.2 * width < a0 < 2.0 * width,
        f"a1 = {a1:g}, which is 0 in this model": a1 != 0.0,
        f"c, d, e = {c:g}, {d:g}, {e:g}, far from 1, 0, 0": max(abs(c - 1.0), abs(d), abs(e)) > 0.1,
    }
    return next((text for text, is_wrong in doubts.items() if is_wrong), "")


V2_LAYOUT = "rgb/NNNN.png and pose.txt, for registered videos also depth/NNNN_depth.tiff"
#: Announced for the release; its location and format are not documented.
INTRINSICS = "camera_intrinsics.txt"


class C3VDv2Settings(SceneSettings):
    """Options of the ``c3vd-v2`` data manager."""

    lens: Literal["file", "v2", "v1"] = Field(
        "file",
        description="Lens calibration: 'file': from camera_intrinsics.txt, or 'v2' if it is missing; 'v2': a candidate "
        "calibration, unverified (docs/layouts/c3vd-v2.md 2); 'v1': C3VD's omnidirectional.",
    )
    mask: bool = Field(True, description="Ignore pixels outside the octagon of the frames.")


class C3VDv2DataManager(SequenceDataManager):
    """Reads a C3VDv2 sequence; see docs/layouts/c3vd-v2.md.

    Registered videos have depth; deformation and screening videos have images and poses only.
    """

    Settings = C3VDv2Settings

    settings: C3VDv2Settings
    name = "c3vd-v2"

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        numbers = any(re.fullmatch(r"\d+", image.stem) for image in path.glob("rgb/*.png"))
        if numbers and (path / "pose.txt").is_file() and count_first_numbers(path / "pose.txt") == 16:
            return "pose.txt (16 numbers a line) beside rgb/NNNN.png"
        return None

    @override
    def find(self, folder: Path) -> SequenceFiles:
        """``camera`` is the intrinsics file, in it or up to two folders up."""
        reading.require_folder(folder, f"a C3VDv2 sequence: {V2_LAYOUT}")
        images = reading.numbered_images(folder / "rgb", "", V2_LAYOUT, "c1_cecum_t1_v1")
        poses = folder / "pose.txt"
        if not poses.is_file():
            raise InputError(f"{folder} has images but no pose.txt", V2_LAYOUT, "Add pose.txt")
        depths = reading.numbered(folder / "depth", "depth", reading.TIFF_SUFFIXES)
        here = folder.resolve()
        camera = next((path / INTRINSICS for path in (here, *here.parents[:2]) if (path / INTRINSICS).is_file()), None)
        return SequenceFiles("c3vd-v2", folder, *reading.paired(folder, images, depths), poses, camera)

    @override
    def rectification(self, files: SequenceFiles) -> tuple[Rectification, dict[str, Any]]:
        lens, source = self._lens(files)
        facts = {"lens": self.settings.lens, "lens_source": source}
        return self.octagon_rectification(lens, files.images[0], self.settings.mask), facts

    def _lens(self, files: SequenceFiles) -> tuple[Lens, str]:
        """The lens and the source of its calibration."""
        if self.settings.lens == "v1":
            return LENSES["omnidirectional"], "C3VD's omnidirectional calibration"
        if self.settings.lens == "file" and files.camera is not None:
            return read_camera_intrinsics(files.camera), str(files.camera)
        if self.settings.lens == "file" and files.folder.name != ROTATION:
            log.warning("%s: no %s, so the lens is an unverified candidate (lens: v2)", files.folder, INTRINSICS)
        return CANDIDATE_LENS, "candidate calibration, unverified"
