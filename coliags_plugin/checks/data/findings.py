"""Facts that are measured of a scene, and what rules on them and on the pose hypotheses find suspect."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats
import torch
from jaxtyping import Float

from coliags_plugin.checks.data.hypotheses import ADVICE, GIVEN, NO_MOTION, Agreement, BestScale, EpipolarAgreement
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scenes import Frame
from coliags_plugin.geometry.lenses.models import LENSES

#: Largest number of frames sampled for depth and image statistics.
_FRAMES = 64
#: For the correlation of brightness and distance: largest number of frames and of pixels per frame, and fewest pixels.
_LAMP_FRAMES, _LAMP_PIXELS, _LAMP_MIN_PIXELS = 16, 4000, 30
#: Smallest share of the pairs of frames in which points must be found again, else nothing is judged.
MIN_MATCHED = 0.25
#: Grey levels outside these are clipped.
_DARKEST, _BRIGHTEST = 3, 253
#: Focal length of EndoGSLAM's C3VD in image widths.
_ENDOGSLAM = LENSES["legacy-pinhole"].pinhole.fx / LENSES["legacy-pinhole"].width
#: Smallest ratio of the 90th to the 10th percentile of the distances in a frame.
_MIN_DEPTH_RATIO = 1.15


def sampled_frames(frames: Sequence[Frame], count: int = _FRAMES) -> list[Frame]:
    """Evenly spaced sample of the frames, at most ``count``."""
    indices = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), count)).astype(int))
    return [frames[index] for index in indices]


def depth_facts(frames: Sequence[Frame]) -> JsonObject | None:
    """Statistics of z-depth, scene units; shares are of the unmasked pixels. None where no frame has depth."""
    finite, pixels, clipped = [], 0, 0
    for frame in frames:
        depth, bound = frame.depth, frame.depth_at_least
        if depth is None:
            continue
        inside = depth[frame.valid]
        pixels += len(inside)
        clipped += 0 if bound is None else int(torch.isfinite(bound[frame.valid]).sum())
        finite.append(inside[torch.isfinite(inside)])
    if not pixels:
        return None
    values = torch.cat(finite).double().numpy()
    quantiles = np.quantile(values, (0.01, 0.5, 0.99)).tolist() if len(values) else [math.nan] * 3
    shares = {"invalid_share": 1.0 - len(values) / pixels, "clipped_share": clipped / pixels}
    return dict(zip(("nearest", "median", "farthest"), quantiles, strict=True)) | shares


def path_facts(video: Sequence[Frame]) -> JsonObject | None:
    """Camera path: lengths in scene units, ``turn`` in degrees; None for fewer than two frames."""
    if len(video) < 2:
        return None
    poses = np.stack([frame.camera.camera_to_world.double().numpy() for frame in video])
    centers = poses[:, :3, 3]
    lengths = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    # Divided by the index difference, so that skipped frames do not look like jumps.
    steps = lengths / np.maximum(1, np.diff([frame.index for frame in video]))
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    cosines = np.clip((np.trace(relative, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    return {
        "length": float(lengths.sum()),
        "mean_step": float(steps.mean()),
        "moving_step": moving_step(steps),
        "largest_step": float(steps.max()),
        "largest_step_at": video[int(steps.argmax()) + 1].name,
        "turn": float(np.degrees(np.arccos(cosines)).sum()),
    }


def moving_step(steps: Float[np.ndarray, "N"]) -> float:
    """Typical step of a camera while it moves: half of the path is made of shorter steps.

    Pauses, which have no length, do not count, nor do jumps: the longest tenth of the steps is left out.
    """
    jumps = max(len(steps) // 10, min(2, len(steps) // 3))
    ordered = np.sort(steps)[: len(steps) - jumps]
    lengths = np.cumsum(ordered)
    return float(ordered[np.searchsorted(lengths, 0.5 * lengths[-1])])


def camera_facts(frames: Sequence[Frame]) -> list[JsonObject]:
    """Intrinsics of each camera, px, with its first frame: how far off the middle, fx / fy, and degrees across."""
    facts: dict[Intrinsics, JsonObject] = {}
    for frame in frames:
        k = frame.camera.intrinsics
        derived = {
            "frame": frame.name,
            "off_middle": max(abs(k.cx / k.width - 0.5), abs(k.cy / k.height - 0.5)),
            "ratio": k.fx / k.fy,
            "angle": angle_across(k),
        }
        facts.setdefault(k, vars(k) | derived)
    return list(facts.values())


def angle_across(pinhole: Intrinsics) -> float:
    """Horizontal field of view, degrees."""
    return 2.0 * math.degrees(math.atan(0.5 * pinhole.width / pinhole.fx))


def image_facts(frames: Sequence[Frame]) -> JsonObject:
    """Intensities of frames in video order, grey levels; shares of the unmasked pixels; names of repeated frames."""
    means, over, masked, repeated = [], [], [], []
    before: torch.Tensor | None = None
    for frame in frames:
        image, valid = frame.image, frame.valid
        inside = image[valid].float()
        means.append(float(inside.mean()) if len(inside) else 0.0)
        over.append(float((inside >= 254).all(dim=1).float().mean()) if len(inside) else 0.0)
        masked.append(1.0 - float(valid.float().mean()))
        if before is not None and before.shape == image.shape and torch.equal(before, image):
            repeated.append(frame.name)
        before = image
    return {
        "mean": float(np.mean(means)),
        "darkest_frame": float(min(means)),
        "darkest_at": frames[int(np.argmin(means))].name,
        "brightest_frame": float(max(means)),
        "overexposed_share": float(np.mean(over)),
        "masked_share": float(np.mean(masked)),
        "repeated": repeated,
    }


def lamp_facts(frames: Sequence[Frame]) -> JsonObject | None:
    """Rank correlation (Spearman's) of brightness with distance within frames: median, share above 0, and their number.

    It is -1 where every farther pixel is darker, as under a lamp at the camera. None where no frame has enough depth.
    """
    correlations = [_correlation(frame) for frame in sampled_frames(frames, _LAMP_FRAMES)]
    values = np.array([value for value in correlations if value is not None])
    if not len(values):
        return None
    return {
        "correlation": float(np.median(values)),
        "rising_share": float(np.mean(values > 0.0)),
        "frames": len(values),
    }


def _correlation(frame: Frame) -> float | None:
    """Correlation in one frame, from its dense depth or else its single points; None if too few or equally far."""
    pixels, depth = _known_depth(frame)
    brightness = frame.image.numpy()[pixels[:, 1], pixels[:, 0]]
    clear = (brightness.min(axis=1) > _DARKEST) & (brightness.max(axis=1) < _BRIGHTEST)
    clear &= frame.valid.numpy()[pixels[:, 1], pixels[:, 0]]
    if clear.sum() < _LAMP_MIN_PIXELS:
        return None
    rays = frame.camera.rays_at(torch.from_numpy(pixels[clear])).double().norm(dim=1).numpy()
    distance = depth[clear] * rays
    near, far = np.quantile(distance, (0.1, 0.9))
    mean = brightness[clear].mean(axis=1)
    if far < _MIN_DEPTH_RATIO * near or mean.min() == mean.max():
        return None
    return float(scipy.stats.spearmanr(mean, distance).statistic)


def _known_depth(frame: Frame) -> tuple[np.ndarray, Float[np.ndarray, "K"]]:
    """Columns and rows of pixels of known depth [K, 2], and their z-depth [K]."""
    dense, sparse = frame.depth, frame.sparse_depth
    if dense is not None:
        row, column = np.nonzero(np.isfinite(dense.numpy()))
        every = max(1, len(row) // _LAMP_PIXELS)
        row, column = row[::every], column[::every]
        return np.stack([column, row], axis=1), dense.numpy()[row, column].astype(np.float64)
    if sparse is None:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    limits = np.array([frame.camera.width, frame.camera.height]) - 1
    return sparse.pixels.floor().long().numpy().clip(0, limits), sparse.depth.double().numpy()


#: Largest median depth difference of agreeing frames, relative to the depth, if it is true; and if it is estimated: two
#: normal errors that are below 5 % with the least probability compared, 0.8, differ by 3.7 %. It may be twice as large
#: under a pose hypothesis.
MAX_DEPTH_ERROR, MAX_ESTIMATE_ERROR = 0.02, 0.04
#: Smaller errors, of the depth and of epipolar distances in px, are limited by sampling and sharpness, and no evidence.
DEPTH_RESOLUTION, EPIPOLAR_RESOLUTION = 0.005, 0.5
#: A pose hypothesis is reported when it reduces the error by this factor.
CLEARLY_BETTER = 2.0
#: Factors on depth closer to 1 than this (in the logarithm) are ignored.
SCALE_TOLERANCE = 0.1
#: Smallest share of pixels that must project into the other image, and of good matches in front of both cameras.
MIN_SHARE, MIN_IN_FRONT = 0.3, 0.6


def agreement_facts(
    readings: Mapping[str, Agreement], scale: BestScale | None, is_estimated: bool
) -> JsonObject | None:
    """Depth errors with the poses as given, in the best other reading, and with the best factor on depth.

    Infinite where too little overlaps or the factor is no better than half and twice of it; None without readings.
    """
    given = readings.get(GIVEN)
    if given is None:
        return None
    errors = {
        name: math.inf if reading.depth_error is None or reading.share < MIN_SHARE else reading.depth_error
        for name, reading in readings.items()
    }
    best, by_scale, factor = min(ADVICE, key=errors.__getitem__), math.inf, 1.0
    if scale is not None and abs(math.log(scale.factor)) >= SCALE_TOLERANCE:
        # With dummy depth any factor does that makes the motion negligible.
        factor = scale.factor
        by_scale = scale.depth_error if scale.depth_error * CLEARLY_BETTER < scale.beside else math.inf
    return {
        "error": errors[GIVEN],
        "best": best,
        "least": errors[best],
        "advice": ADVICE[best],
        "by_scale": by_scale,
        "factor": factor,
        "inverse": 1.0 / factor,
        "tolerance": MAX_ESTIMATE_ERROR if is_estimated else MAX_DEPTH_ERROR,
        "errors": f"surfaces differ by {_percent(given.depth_error)} of the depth, {given.share:.0%} of the pixels "
        "project into the other image",
        "still": _percent(readings[NO_MOTION].depth_error),
    }


def match_facts(readings: Mapping[str, EpipolarAgreement]) -> JsonObject | None:
    """Epipolar errors with the poses as given, and in the best reading with which the matches agree, if any."""
    given = readings.get(GIVEN)
    if given is None:
        return None
    is_in_front = given.in_front is None or given.in_front >= MIN_IN_FRONT
    better = {
        name: reading
        for name, reading in readings.items()
        if name in ADVICE
        and (reading.in_front or 0.0) >= MIN_IN_FRONT
        and (
            (given.error > EPIPOLAR_RESOLUTION and reading.error * CLEARLY_BETTER < given.error)
            or (not is_in_front and reading.agrees and reading.error <= max(EPIPOLAR_RESOLUTION, given.error))
        )
    }
    best = min(better, key=lambda name: better[name].error, default=GIVEN)
    return vars(given) | {
        "errors": f"{given.count} matches lie {given.error:.2g} px from their epipolar lines (median)",
        "agrees": given.agrees and is_in_front,
        "front": f"with a parallax of {given.parallax:.2g} px"
        if given.in_front is None
        else f"{given.in_front:.0%} in front of both cameras",
        "best": best,
        "least": readings[best].error,
        "best_front": _percent(readings[best].in_front),
        "advice": ADVICE.get(best, ""),
    }


def clearly_agrees(readings: Mapping[str, EpipolarAgreement], others: Mapping[str, EpipolarAgreement]) -> bool:
    """Return whether matches agree with poses that others contradict, and by far: then these others are wrong."""
    given = readings.get(GIVEN)
    return (
        given is not None
        and not findings_of("matches", match_facts(readings))
        and given.error * CLEARLY_BETTER < others[GIVEN].error
    )


@dataclass(frozen=True)
class Finding:
    """One suspected problem."""

    what: str  # short description
    evidence: str  # the numbers behind it
    do: str  # what the user can do about it

    def __str__(self) -> str:
        """The finding as a warning."""
        return f"suspect: {self.what} ({self.evidence}). {self.do}"


def is_flat(depth: JsonObject) -> bool:
    """Return whether depth is the same everywhere; False where it is unknown."""
    return bool(depth["farthest"] - depth["nearest"] < 1e-3 * depth["median"])


#: By the facts they are about: the test, and what is suspect, the evidence and the advice, with the facts' values.
RULES: dict[str, list[tuple[Callable[[JsonObject], bool], str]]] = {
    "agreement": [
        (
            lambda errors: (
                errors["error"] > DEPTH_RESOLUTION
                and errors["by_scale"] * CLEARLY_BETTER < min(errors["error"], errors["least"] * CLEARLY_BETTER)
            ),
            "depth and poses are in different units | as given, {errors}; with depth times {factor:.3g}, "
            "{by_scale:.2%} | Check the units: depth seems to be {inverse:.3g} times what the poses expect",
        ),
        (
            lambda errors: (
                errors["error"] > max(DEPTH_RESOLUTION, errors["least"] * CLEARLY_BETTER)
                and errors["least"] < 2.0 * errors["tolerance"]
            ),
            "poses agree with depth when read as: {best} | as given, {errors}; read this way, {least:.2%} | {advice}",
        ),
        (
            lambda errors: errors["error"] > errors["tolerance"],
            "frames do not agree on the surface | {errors}; without motion, {still} | "
            "Check that images, depth and poses match frame by frame, and the calibration",
        ),
    ],
    "matches": [
        (
            lambda errors: errors["best"] != GIVEN,
            "poses agree with the images when read as: {best} | as given, {errors}, {front}; read this way, "
            "{least:.2g} px, {best_front} in front | {advice}",
        ),
        (
            lambda errors: not errors["agrees"],
            "images do not agree with the poses | {errors}, {front} | "
            "Check that images and poses match frame by frame, and the calibration",
        ),
    ],
    "parallax": [
        (
            lambda errors: errors["agrees"] and errors["in_front"] is None,
            "poses may be right or wrong | {count} matches lie {error:.2g} px from their epipolar lines, but the "
            "camera moves them by {parallax:.2g} px only (median), beside its rotation | "
            "Look at frames further apart, `datamanager.frame_step=N`, or at a part of the video with more motion",
        ),
    ],
    "matched": [
        (
            lambda pairs: pairs["matched"] < MIN_MATCHED * pairs["count"],
            "the images cannot tell whether the poses are right | points are found again in {matched} of {count} pairs "
            "of frames only | Judge the poses by what comes of them: held-out frames, and the depth and mesh by eye; "
            "or check a part of the video that is sharper or has less motion between frames",
        ),
    ],
    "points": [
        (
            lambda data: data["misplaced_observations"] > 0.5 * data["observations"],
            "poses and points of the model contradict each other | {misplaced_observations} of {observations} "
            "observations of points are not where the poses project them | Take poses, points and intrinsics from one "
            "model: a factor on the poses alone, another camera or poses of other images do this",
        ),
    ],
    "depth": [
        (
            lambda depth: depth["invalid_share"] > 0.5,
            "most of the depth is unknown | {invalid_share:.0%} of the unmasked pixels | "
            "Check that the depth files belong to these images and are read with the right number of bits",
        ),
        (
            is_flat,
            "depth is the same everywhere | {nearest:.4g} to {farthest:.4g} | "
            "Check the depth files: a failed export can leave images of one value",
        ),
        (
            lambda depth: depth["metric"] and depth["median"] < 1.0,
            "depth looks like metres | median {median:.4g} mm; renderers clip at a near plane of 0.2 mm | "
            "State the unit of the files: `datamanager.unit=m`, or unit.txt with m",
        ),
        (
            lambda depth: depth["metric"] and depth["median"] > 1000.0,
            "depth is too far for an endoscope | median {median:.4g} mm | Check the unit of the depth files",
        ),
    ],
    "lamp": [
        (
            lambda lamp: lamp["frames"] >= 4 and lamp["correlation"] > 0.3 and lamp["rising_share"] > 0.75,
            "the far is brighter than the near | brightness rises with distance (rank correlation {correlation:.2f}, "
            "the median of {frames} frames), though the lamp is at the camera | "
            "Check whether the depth is reversed: a disparity, inverse or inverted depth, or one of other images",
        ),
    ],
    "path": [
        (
            lambda path: path["length"] == 0.0,
            "the camera does not move | all poses have one centre | Check the pose file",
        ),
        (
            lambda path: path["largest_step"] > 10.0 * max(path["moving_step"], 1e-3 * path["mean_step"]),
            "the camera jumps | {largest_step:.4g} to {largest_step_at}, {moving_step:.4g} typically while it moves | "
            "Check the poses around that frame: a cut in the video, or lines missing",
        ),
    ],
    "camera": [
        (
            lambda camera: camera["off_middle"] > 0.2,
            "the principal point is far from the middle | {frame}: ({cx:.4g}, {cy:.4g}) of {width} x {height} px | "
            "Check that the intrinsics are for images of this size",
        ),
        (
            lambda camera: not 1 / 1.15 < camera["ratio"] < 1.15,
            "pixels are far from square | {frame}: fx / fy = {ratio:.3g} | "
            "Check the intrinsics, or the working width and height",
        ),
        (
            lambda camera: not 25.0 < camera["angle"] < 160.0,
            "the field of view is implausible for an endoscope | {frame}: {angle:.3g} degrees across | "
            "Check the focal length and the image size it is for",
        ),
        (
            lambda camera: (
                camera["dataset"] == "c3vd-endogslam" and abs(camera["fx"] / camera["width"] / _ENDOGSLAM - 1.0) < 1e-3
            ),
            "EndoGSLAM's calibration does not fit C3VD's images and depth | its focal length is 4.3 % above C3VD's, "
            "and images and poses agree on depth 6 % or 2.4 mm (medians) off the files: docs/methods.md 5.4 | "
            "Use these data to compare with published results, and C3VD's own release for geometry",
        ),
    ],
    "images": [
        (
            lambda images: images["darkest_frame"] < 4.0,
            "an image is black | {darkest_at}: mean {darkest_frame:.2g} of 255 | Leave it out",
        ),
        (
            lambda images: images["overexposed_share"] > 0.25,
            "images are overexposed | {overexposed_share:.0%} of the pixels are white | ",
        ),
        (
            lambda images: images["masked_share"] > 0.75,
            "most pixels are masked | {masked_share:.0%} of the pixels are ignored | "
            "Check the meaning of the mask: black is ignored here",
        ),
        (
            lambda images: bool(images["repeated"]),
            "images repeat | {repeats} of the images looked at equal the one before, {repeated[0]} first | Leave "
            "repeated images and their poses out: the video was captured at a higher frame rate than the endoscope's",
        ),
    ],
}


def findings_of(about: str, facts: JsonObject | None) -> list[Finding]:
    """Findings by the rules about one kind of facts; of agreement and matches the first. None without facts."""
    if facts is None:
        return []
    texts = [text.split(" | ") for test, text in RULES[about] if test(facts)]
    findings = [Finding(*(part.format(**facts) for part in parts)) for parts in texts]
    return findings[:1] if about in ("agreement", "matches") else findings


def _percent(value: float | None) -> str:
    return "an unknown part" if value is None else f"{value:.2%}"
