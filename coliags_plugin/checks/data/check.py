"""Runs all consistency checks on a scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any, Literal

import numpy as np

from coliags_plugin.checks.data import findings as rules
from coliags_plugin.checks.data.findings import Finding
from coliags_plugin.checks.data.hypotheses import (
    CHANGES,
    Agreement,
    BestScale,
    EpipolarAgreement,
    FrameMatches,
    Pair,
    agreement,
    best_scale,
    epipolar_agreement,
    follow,
    match,
)
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scenes import Frame, Scene

#: Largest number of frame pairs.
_PAIRS = 12
#: Shares of the pairs that must have matches: of features, else points are followed; of either, else nothing is judged.
_MATCHED, _JUDGED = 0.5, 0.25
#: Steps count as at most this many typical ones, so that no jump takes all pairs.
_LONGEST_STEP = 3.0


@dataclass(frozen=True)
class SceneCheck:
    """Result of the consistency checks."""

    scene: Scene  # the scene checked
    pairs: list[tuple[Frame, Frame]]  # source and target frames of the reprojection or matching
    facts: dict[str, Any]  # JSON objects of depth, path, images and lamp; None where there is nothing to measure
    agreement: dict[str, Agreement]  # reprojection errors of frames with depth, by pose hypothesis
    scale: BestScale | None  # the factor on depth with the smallest reprojection error, and the errors with it
    #: epipolar errors of matched points, by pose hypothesis; empty where there is depth or too few are matched
    matches: dict[str, EpipolarAgreement]
    matched_by: Literal["features", "tracks"] | None  # how they are matched; None where there is depth
    findings: list[Finding]  # suspected problems
    undecided: list[Finding]  # what the data are not enough to check

    def as_json(self) -> JsonObject:
        """The same as JSON values; unavailable ones are null."""
        values = {
            "scene": self.scene.name,
            "suspect": bool(self.findings),
            "findings": self.findings,
            "undecided": self.undecided,
            "data": self.scene.provenance.record(),
            "initial_points": len(self.scene.points),
            **self.facts,
            "pairs": [[source.name, target.name] for source, target in self.pairs],
            "agreement": self.agreement,
            "best_depth_scale": self.scale,
            "matches": self.matches,
            "matched_by": self.matched_by,
        }
        return {key: _json_value(value) for key, value in values.items()}


def check_scene(
    scene: Scene,
    progress: Progress | None = None,
    at_stored_size: Callable[[], Scene] | None = None,
    match_images: bool = True,
) -> SceneCheck:
    """Run all checks on a scene; without matching of images they take about a second for any number of frames.

    ``at_stored_size`` loads the same scene with images of the stored size, in which points are matched if there is no
    depth, or hardly any that can be trusted; None: those of ``scene``. They are matched by features. Where these fail,
    as in patients, or contradict poses with which points followed from frame to frame clearly agree, these count.
    """
    video = scene.video
    sample = rules.sampled_frames(video)
    pairs = video_pairs(video)
    stored = [(a, b) for a, b in pairs if a.depth is not None and b.depth is not None]
    known = {(a, b): pair for a, b in stored if (pair := Pair(a, b)).is_known}
    with_depth = list(known.values()) if len(known) >= _JUDGED * len(pairs) else []
    agreements: dict[str, Agreement] = {}
    matches: dict[str, EpipolarAgreement] = {}
    matched_by: Literal["features", "tracks"] | None = None
    undecided: list[Finding] = []
    if with_depth:
        pairs = [*known]
        for name in with_progress(list(CHANGES), "compare frames", progress):
            agreements[name] = agreement(with_depth, name)
    elif match_images:
        # Epipolar errors grow with the baseline, so frames further apart are compared.
        pairs = video_pairs(video, farther=3)
        full = video if at_stored_size is None else at_stored_size().video
        place = {frame.name: number for number, frame in enumerate(full)}

        def followed(chosen: list[tuple[Frame, Frame]]) -> list[FrameMatches]:
            return follow([full[place[source.name] : place[target.name] + 1] for source, target in chosen], progress)

        matched_by = "features"
        matched = match([(full[place[source.name]], full[place[target.name]]) for source, target in pairs])
        readings = _readings(matched)
        if len(matched) < _MATCHED * len(pairs):
            matched_by, pairs = "tracks", video_pairs(video)
            matched = followed(pairs)
            readings = _readings(matched)
        elif any(rules.match_findings(readings)):
            # Points are lost over long ways, and short ones tell less of the poses.
            tried = ((chosen, followed(chosen)) for chosen in (pairs, video_pairs(video)))
            enough = next((each for each in tried if len(each[1]) >= _JUDGED * len(each[0])), None)
            if enough is not None and rules.clearly_agrees(others := _readings(enough[1]), readings):
                matched_by, (pairs, matched), readings = "tracks", enough, others
        if len(matched) < _JUDGED * len(pairs):
            undecided = list(rules.unmatched(len(matched), len(pairs)))
        else:
            matches = readings
            undecided = list(rules.undecided(matches))
    scale = best_scale(with_depth) if with_depth else None
    depth, path = rules.depth_facts(sample), rules.path_facts(video)
    images, lamp = rules.image_facts(sample), rules.lamp_facts(sample)
    measured = [
        ("points", dict(vars(scene.provenance))),
        ("depth", depth and depth | {"metric": scene.is_metric}),
        ("lamp", lamp),
        ("path", path),
        *(("camera", camera) for camera in rules.camera_facts(video)),
        ("images", images | {"repeats": len(images["repeated"])}),
    ]
    findings = [
        *rules.agreement_findings(agreements, scale, path, depth, is_estimated(video)),
        *rules.match_findings(matches),
        *(finding for about, values in measured for finding in rules.findings_of(about, values)),
    ]
    facts = {"depth": depth, "path": path, "images": images, "lamp": lamp}
    return SceneCheck(scene, pairs, facts, agreements, scale, matches, matched_by, findings, undecided)


def is_estimated(frames: Sequence[Frame]) -> bool:
    """Whether the depth of frames is an estimate, with a confidence."""
    return any(frame.depth_confidence is not None for frame in frames)


def _readings(matched: Sequence[FrameMatches]) -> dict[str, EpipolarAgreement]:
    """Agreement of the matches with each pose hypothesis under which the camera moves."""
    errors = {name: epipolar_agreement(matched, name) for name in CHANGES}
    return {name: error for name, error in errors.items() if error is not None}


def video_pairs(frames: Sequence[Frame], farther: int = 1) -> list[tuple[Frame, Frame]]:
    """Pairs of frames with a short baseline: long enough to reveal wrong poses, short enough to overlap.

    They are spread evenly over the camera's path, not over time, so that none lies in a pause. ``farther`` multiplies
    the default baseline, a thirtieth of the path and at most ten mean steps.
    """
    video = sorted(frames, key=lambda frame: frame.index)
    apart = min(farther * min(max(1, round(len(video) / 30)), 10), max(1, len(video) - 1))
    if len(video) <= apart:
        return []
    centers = np.stack([frame.camera.center.double().numpy() for frame in video])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    typical = rules.moving_step(steps)
    # A camera that does not move has gone one step a frame, in effect.
    counted = np.minimum(steps, _LONGEST_STEP * typical) if typical > 0.0 else np.ones_like(steps)
    arc = np.concatenate([[0.0], np.cumsum(counted)])
    baseline = arc[-1] * apart / (len(video) - 1) * (1.0 - 1e-9)
    # The last frame of a pause, and the first that is far enough from it.
    first = np.searchsorted(arc, np.linspace(0.0, arc[-1] - baseline, _PAIRS), side="right") - 1
    second = np.minimum(np.searchsorted(arc, arc[first] + baseline), len(video) - 1)
    return [
        (video[here], video[there]) for here, there in dict.fromkeys(zip(first, second, strict=True)) if here < there
    ]


def _json_value(value: Any) -> Any:
    """The value as JSON takes it: dataclasses become mappings, numbers that are not finite None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {key: _json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json_value(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
