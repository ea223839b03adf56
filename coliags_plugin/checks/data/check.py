"""Runs all consistency checks on a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic_core import to_jsonable_python

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
#: Smallest share of the pairs that must have matches of features, else points are followed.
_MATCHED = 0.5
#: Steps count as at most this many typical ones, so that no jump takes all pairs.
_LONGEST_STEP = 3.0

#: Source and target frames.
FramePairs = list[tuple[Frame, Frame]]
Matcher = Literal["features", "tracks"]


@dataclass(frozen=True)
class SceneCheck:
    """Result of the consistency checks."""

    scene: Scene  # the scene checked
    pairs: FramePairs  # source and target frames of the reprojection or matching
    facts: dict[str, Any]  # JSON objects of depth, path, images and lamp; None where there is nothing to measure
    agreement: dict[str, Agreement]  # reprojection errors of frames with depth, by pose hypothesis
    scale: BestScale | None  # the factor on depth with the smallest reprojection error, and the errors with it
    #: epipolar errors of matched points, by pose hypothesis; empty where there is depth or too few are matched
    matches: dict[str, EpipolarAgreement]
    matched_by: Matcher | None  # how they are matched; None where there is depth
    findings: list[Finding]  # suspected problems
    undecided: list[Finding]  # what the data are not enough to check

    def as_json(self) -> JsonObject:
        """The result as JSON values; unavailable ones are null."""
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
        return dict(to_jsonable_python(values, inf_nan_mode="null"))


def check_scene(
    scene: Scene,
    progress: Progress | None = None,
    at_stored_size: Callable[[], Scene] | None = None,
    match_images: bool = True,
) -> SceneCheck:
    """Run all checks on a scene; without matching of images they take about a second for any number of frames.

    ``at_stored_size`` loads the same scene with images of the stored size, in which points are matched if there is no
    depth, or hardly any that can be trusted; None: those of ``scene``.
    """
    video = scene.video
    pairs = video_pairs(video)
    stored = [(a, b) for a, b in pairs if a.depth is not None and b.depth is not None]
    with_depth = {(a, b): pair for a, b in stored if (pair := Pair(a, b)).has_depth}
    agreements: dict[str, Agreement] = {}
    matches: dict[str, EpipolarAgreement] = {}
    matched_by: Matcher | None = None
    scale, undecided = None, []
    if len(with_depth) >= rules.MIN_MATCHED * len(pairs) and with_depth:
        pairs = [*with_depth]
        for name in with_progress(list(CHANGES), "compare frames", progress):
            agreements[name] = agreement([*with_depth.values()], name)
        scale = best_scale([*with_depth.values()])
    elif match_images:
        pairs, matched, matched_by = _match(
            video, video if at_stored_size is None else at_stored_size().video, progress
        )
        undecided = rules.findings_of("matched", {"matched": len(matched), "count": len(pairs)})
        matches = {} if undecided else _readings(matched)
        undecided = undecided or rules.findings_of("parallax", rules.match_facts(matches))
    sample = rules.sampled_frames(video)
    depth, path = rules.depth_facts(sample), rules.path_facts(video)
    images, lamp = rules.image_facts(sample), rules.lamp_facts(sample)
    can_disagree = path and path["length"] and depth and not rules.is_flat(depth)
    measured = [
        ("agreement", rules.agreement_facts(agreements, scale, scene.has_estimated_depth) if can_disagree else None),
        ("matches", rules.match_facts(matches)),
        ("points", dict(vars(scene.provenance))),
        ("depth", depth and depth | {"metric": scene.is_metric}),
        ("lamp", lamp),
        ("path", path),
        *(("camera", camera | {"dataset": scene.provenance.dataset}) for camera in rules.camera_facts(video)),
        ("images", images | {"repeats": len(images["repeated"])}),
    ]
    findings = [finding for about, values in measured for finding in rules.findings_of(about, values)]
    facts = {"depth": depth, "path": path, "images": images, "lamp": lamp}
    return SceneCheck(scene, pairs, facts, agreements, scale, matches, matched_by, findings, undecided)


def _match(
    video: Sequence[Frame], stored: Sequence[Frame], progress: Progress | None
) -> tuple[FramePairs, list[FrameMatches], Matcher]:
    """Match points between frames of the stored size: the pairs, those that have matches, and by what.

    They are matched by features. Where these fail, as in patients, or contradict poses with which points followed from
    frame to frame clearly agree, these count.
    """
    place = {frame.name: number for number, frame in enumerate(stored)}
    # Epipolar errors grow with the baseline, so frames further apart are compared.
    far, near = video_pairs(video, farther=3), video_pairs(video)

    def followed(pairs: FramePairs) -> list[FrameMatches]:
        return follow([stored[place[source.name] : place[target.name] + 1] for source, target in pairs], progress)

    matched = match([(stored[place[source.name]], stored[place[target.name]]) for source, target in far])
    if len(matched) < _MATCHED * len(far):
        return near, followed(near), "tracks"
    readings = _readings(matched)
    if rules.findings_of("matches", rules.match_facts(readings)):
        # Points are lost over long ways, and short ones tell less of the poses.
        for pairs in (far, near):
            tracks = followed(pairs)
            if len(tracks) >= rules.MIN_MATCHED * len(pairs):
                if rules.clearly_agrees(_readings(tracks), readings):
                    return pairs, tracks, "tracks"
                break
    return far, matched, "features"


def _readings(matched: Sequence[FrameMatches]) -> dict[str, EpipolarAgreement]:
    """Agreement of the matches with each pose hypothesis under which the camera moves."""
    errors = {name: epipolar_agreement(matched, name) for name in CHANGES}
    return {name: error for name, error in errors.items() if error is not None}


def video_pairs(frames: Sequence[Frame], farther: int = 1) -> FramePairs:
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
