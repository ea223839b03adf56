"""Runs all consistency checks on a scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

from coliags_plugin.checks.data import findings as suspect
from coliags_plugin.checks.data.facts import (
    DepthFacts,
    ImageFacts,
    PathFacts,
    depth_facts,
    image_facts,
    path_facts,
    sampled_frames,
)
from coliags_plugin.checks.data.findings import Finding
from coliags_plugin.checks.data.hypotheses import CHANGES
from coliags_plugin.checks.data.lamp import LampFacts, lamp_facts
from coliags_plugin.checks.data.matches import EpipolarAgreement, epipolar_agreement, match
from coliags_plugin.checks.data.pairs import video_pairs
from coliags_plugin.checks.data.reprojection import Agreement, BestScale, Pair, agreement, best_scale
from coliags_plugin.core.anonymity import without_places
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Frame, Scene


@dataclass(frozen=True)
class SceneCheck:
    """Result of the consistency checks.

    Attributes:
        scene: The scene checked.
        pairs: Source and target frames of the reprojection or matching.
        depth, path, images, lamp: Statistics; None where there is nothing to measure.
        agreement: Reprojection errors of frames with depth, by pose hypothesis.
        scale: The factor on depth with the smallest reprojection error, and the errors with it.
        matches: Epipolar errors of matched features, by pose hypothesis; empty where there is depth.
        findings: Suspected problems.
        undecided: What the data are not enough to check.
    """

    scene: Scene
    pairs: list[tuple[Frame, Frame]]
    depth: DepthFacts | None
    path: PathFacts | None
    images: ImageFacts
    lamp: LampFacts | None
    agreement: dict[str, Agreement]
    scale: BestScale | None
    matches: dict[str, EpipolarAgreement]
    findings: list[Finding]
    undecided: list[Finding]

    def anonymous(self) -> SceneCheck:
        """The same without absolute paths."""
        return replace(self, scene=replace(self.scene, provenance=without_places(self.scene.provenance)))

    def as_json(self) -> dict[str, Any]:
        """The same as JSON values; unavailable ones are null."""
        plain = {
            "scene": self.scene.name,
            "suspect": bool(self.findings),
            "findings": [asdict(finding) for finding in self.findings],
            "undecided": [asdict(doubt) for doubt in self.undecided],
            "data": self.scene.provenance,
            "initial_points": len(self.scene.points),
            "depth": None if self.depth is None else asdict(self.depth),
            "path": None if self.path is None else asdict(self.path),
            "images": asdict(self.images),
            "lamp": None if self.lamp is None else asdict(self.lamp),
            "pairs": [[source.name, target.name] for source, target in self.pairs],
            "agreement": {name: asdict(found) for name, found in self.agreement.items()},
            "best_depth_scale": None if self.scale is None else asdict(self.scale),
            "matches": {name: asdict(found) for name, found in self.matches.items()},
        }
        cleaned: dict[str, Any] = _without_nan(plain)
        return cleaned


def check_scene(
    scene: Scene, progress: Progress | None = None, at_stored_size: Callable[[], Scene] | None = None
) -> SceneCheck:
    """Run all checks on a scene.

    Args:
        scene: As loaded by a data manager.
        progress: Called during the comparison of frames.
        at_stored_size: Loads the same scene with images of the stored size, in which features are matched if there is
            no depth; None: those of ``scene``.
    """
    video = scene.video
    looked = sampled_frames(video)
    pairs = video_pairs(video)
    with_depth = [Pair(a, b) for a, b in pairs if a.depth is not None and b.depth is not None]
    readings, scale, matched = {}, None, {}
    if with_depth:
        for done, name in enumerate(CHANGES):
            if progress is not None:
                progress("compare frames", done, len(CHANGES))
            readings[name] = agreement(with_depth, name)
        scale = best_scale(with_depth)
    else:
        # Epipolar errors grow with the baseline, so frames further apart are compared.
        pairs = video_pairs(video, farther=3)
        full = {frame.name: frame for frame in (video if at_stored_size is None else at_stored_size().video)}
        matches = match([(full[source.name], full[target.name]) for source, target in pairs])
        found = {name: epipolar_agreement(matches, name) for name in CHANGES}
        matched = {name: reading for name, reading in found.items() if reading is not None}
    if progress is not None:
        progress("compare frames", len(CHANGES), len(CHANGES))
    depth, path, images = depth_facts(looked), path_facts(video), image_facts(looked)
    lamp = lamp_facts(looked)
    found_suspect = [
        *suspect.agreement_findings(readings, scale, path, depth),
        *suspect.match_findings(matched),
        *suspect.depth_findings(depth, scene.is_metric),
        *suspect.lamp_findings(lamp),
        *suspect.path_findings(path),
        *suspect.calibration_findings(video),
        *suspect.image_findings(images),
    ]
    return SceneCheck(
        scene,
        pairs,
        depth,
        path,
        images,
        lamp,
        readings,
        scale,
        matched,
        found_suspect,
        list(suspect.undecided(matched)),
    )


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
