"""Page of the consistency checks: statistics, findings, pose hypotheses, reprojected frames and the trajectory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from coliags_plugin.checks.data.check import SceneCheck
from coliags_plugin.checks.data.findings import Finding, angle_across
from coliags_plugin.checks.data.hypotheses import LEAST_CONFIDENCE, warp_image
from coliags_plugin.core.images import sizes_text
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reporting import model
from coliags_plugin.reporting.colormaps import colorize_error, hatch, rgb_error
from coliags_plugin.reporting.image_files import EncodedImage, eight_bit
from coliags_plugin.reporting.numbers import counted, sentence, short_number
from coliags_plugin.reporting.text_formats import page_text

#: Number of pairs shown, and difference of the last colour, as a fraction of full scale.
_SHOWN, _DIFFERENCE = 3, 0.2


class ShownCheck(SceneCheck):
    """A result that ``print`` and notebooks show as text."""

    def __repr__(self) -> str:
        return f"{page_text(check_page(self))}\n\n{verdict(self)}"


def check_page(check: SceneCheck) -> model.Page:
    """Everything that the checks found; in the terminal without pictures, trajectory and origin of the data."""
    name, unit = check.scene.name, check.scene.length_unit
    pairs = check.pairs if check.agreement else []  # without depth, nothing is reprojected
    shown = pairs[:: max(1, len(pairs) // _SHOWN)][:_SHOWN]
    sections = [
        model.Section("Suspect", _bullets(check.findings)),
        model.Section("Undecided", _bullets(check.undecided)),
        model.Section("Agreement", _agreement(check)),
        model.Section("Reprojected frames", [_pair_images(*pair) for pair in shown], screen_only=True),
        model.Section("Trajectory", [_trajectory(check.scene.video, unit)], screen_only=True),
        model.Section("Data", [model.record("Origin of the data", check.scene.provenance.record())], screen_only=True),
    ]
    return model.Page(f"{name}: data check", sections, list(_facts(check)), heading=f"{name}: {verdict(check)}")


def _bullets(findings: Sequence[Finding]) -> list[model.Bullets]:
    items = [model.Bullet(" ".join(map(sentence, filter(None, (f.evidence, f.do)))), f.what) for f in findings]
    return [model.Bullets(items, warning=True)] if items else []


def verdict(check: SceneCheck) -> str:
    """Number of findings, in words."""
    return counted(len(check.findings), "suspect finding") if check.findings else "nothing suspect"


def _facts(check: SceneCheck) -> Iterator[model.Fact]:
    scene = check.scene
    data = scene.provenance
    camera = scene.train[0].camera
    counts = {"train": len(scene.train), **{name: len(frames) for name, frames in scene.test_sets.items()}}
    yield model.Fact("format", data.dataset, note=f"{data.layout} layout" if data.layout else "")
    yield model.Fact("frames", ", ".join(f"{count} {name}" for name, count in counts.items()))
    yield model.Fact("split", data.split_name or "unknown")
    size = sizes_text((frame.camera.width, frame.camera.height) for frame in scene.video)
    several, stored = " and others" if " to " in size else "", data.stored_size
    yield model.Fact("image size", f"{size} px" + (f", stored {stored[0]} x {stored[1]}{several}" if stored else ""))
    yield model.Fact("lens", data.lens or "pinhole images")
    focal, center = f"f {camera.fx:.2f}, {camera.fy:.2f}", f"centre {camera.cx:.2f}, {camera.cy:.2f}"
    yield model.Fact("calibration", f"{focal}, {center} px, {angle_across(camera.intrinsics):.1f} degrees across")
    yield model.Fact("pose convention", _convention(data.pose_convention))
    unit = scene.length_unit
    stated = "unknown (`datamanager.unit=mm` or a file unit.txt states it)"
    yield model.Fact("unit of length", unit if scene.is_metric else stated)
    depth, path, images, lamp = check.facts.values()
    depths = (
        "median {median:.4g}, 1 % to 99 %: {nearest:.4g} to {farthest:.4g} {unit}; {invalid_share:.1%} unknown, of "
        "which {clipped_share:.1%} clipped"
    )
    yield model.Fact("depth", depths.format(**depth, unit=unit) if depth else "none")
    if path:
        steps = (
            "steps {mean_step:.3g} (largest {largest_step:.3g} to {largest_step_at}), turns {turn:.3g} degrees in all"
        )
        yield model.Fact("trajectory", f"{path['length']:.4g} {unit} long, {steps.format(**path)}")
    light = (
        "mean {mean:.0f} of 255, frames {darkest_frame:.0f} to {brightest_frame:.0f}, {overexposed_share:.1%} white, "
        "{masked_share:.1%} masked"
    )
    yield model.Fact("brightness", light.format(**images))
    if lamp:
        correlation = f"rank correlation {lamp['correlation']:.2f} (median of {counted(lamp['frames'], 'frame')})"
        yield model.Fact("brightness and distance", f"{correlation}; below 0, the near is brighter")
    yield model.Fact("initial points", f"{len(scene.points)} from {data.points.source}")


def _convention(facts: Any) -> str:
    if not isinstance(facts, dict):
        return str(facts) if facts else "not stated"
    words = [value for value in facts.values() if isinstance(value, str)]
    numbers = [f"{key.replace('_', ' ')} {value:.3g}" for key, value in facts.items() if isinstance(value, float)]
    return "; ".join([*words, ", ".join(numbers)] if numbers else words) or "not stated"


def _agreement(check: SceneCheck) -> list[model.Paragraph | model.Table]:
    """Errors by pose hypothesis; nothing where nothing could be compared."""
    gaps = [target.index - source.index for source, target in check.pairs] or [0]
    apart = f"{min(gaps)} to {max(gaps)} frames"
    if check.agreement:
        estimated = check.scene.has_estimated_depth
        trusted = f" of depth with a confidence of {LEAST_CONFIDENCE:g} or more" if estimated else ""
        note = (
            f"Each of {len(check.pairs)} frames is reprojected {apart} ahead by depth, poses and calibration; medians "
            f"over all pixels{trusted}. If the given poses are not the best row, they are suspect."
        )
        lengths = f"depth error, {check.scene.length_unit}"
        head = ["depth error, %", lengths, "colour error, grey levels", "projects into the image, %"]
        rows = [
            [
                name,
                _percent(e.depth_error),
                short_number(e.depth_difference),
                short_number(e.color_error),
                _percent(e.share),
            ]
            for name, e in check.agreement.items()
        ]
        if scale := check.scale:
            rows.append([f"given, depth times {scale.factor:.3g}", _percent(scale.depth_error), None, None, None])
    else:
        points = "Points followed through" if check.matched_by == "tracks" else "Matched features of"
        note = f"{points} {len(check.pairs)} pairs of frames, {apart} apart, as there is no depth."
        head = ["distance from the epipolar line, px", "in front of both cameras, %", "parallax, px", "matches"]
        rows = [
            [name, short_number(e.error), _percent(e.in_front), short_number(e.parallax), str(e.count)]
            for name, e in check.matches.items()
        ]
    return [model.Paragraph(note), model.simple_table(["poses read as", *head], rows)] if rows else []


def _percent(share: float | None) -> str | None:
    return short_number(share, 100.0)


def _pair_images(source: Frame, target: Frame) -> model.Figures:
    """A frame, its neighbour warped into it by depth and poses, and their difference; hatched where there is none."""
    painted, shown = warp_image(source, target)
    warped = np.where(shown[..., None], eight_bit(painted), hatch(*shown.shape))
    difference = colorize_error(rgb_error(painted.float(), target.rgb, shown), _DIFFERENCE)
    images: list[tuple[np.ndarray | torch.Tensor, str]] = [
        (target.image, target.name),
        (warped, f"{source.name} warped into it"),
        (difference, f"difference, yellow from {_DIFFERENCE:.0%} of full scale on"),
    ]
    return model.Figures([model.Image(EncodedImage.png(rgb), caption) for rgb, caption in images])


def _trajectory(video: Sequence[Frame], unit: str) -> model.Figures:
    centers = np.stack([frame.camera.center.double().numpy() for frame in video])
    x, y, z = (values.tolist() for values in centers.T)
    frames = [float(frame.index) for frame in video]
    along = [model.Series("x", 0, frames, x), model.Series("y", 1, frames, y), model.Series("z", 2, frames, z)]
    position, depth = f"position, {unit}", f"z, {unit}"
    return model.Figures(
        [
            model.Chart(along, "frame", position, "Camera centre along the video", legend=True),
            model.Chart([model.Series("path", 3, z, x)], depth, f"x, {unit}", "From above", equal_scales=True),
            model.Chart([model.Series("path", 3, z, y)], depth, f"y, {unit}", "From the side", equal_scales=True),
        ]
    )
