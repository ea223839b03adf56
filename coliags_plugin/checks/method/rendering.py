"""Checks of rendering and evaluation: every promised output, at any size, the same each time; metrics and images."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch
from torch import Tensor

from coliags_plugin.checks.method.context import CheckContext, difference
from coliags_plugin.checks.method.scenes import depth_range
from coliags_plugin.checks.results import CheckFailedError, CheckSkippedError
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import DEPTH_KINDS, RenderOutput
from coliags_plugin.core.scenes import Frame, View
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.rendering import render_run
from coliags_plugin.engine.trained import TrainedRun

#: Alpha from which a pixel has a depth.
_OPAQUE = 0.95
#: Depth may leave the range of the scene by this factor: a model is not good yet after a few steps.
_MARGIN = 10.0
_ROUNDING = 1e-4
NO_OUTPUT = "no_such_output"
#: Frames of each test set that are evaluated and rendered.
_TEST_FRAMES = 2


def renders_every_output(context: CheckContext) -> str:
    """Every output has its shape and finite values in range, for views of the video, another size and a free camera."""
    model, frame = context.trainer.model, context.scene.train[0]
    depths = depth_range(context.scene)
    views: dict[str, tuple[Camera, View | None]] = {
        "a training view": (frame.camera, frame.view(trained=True)),
        "an untrained view": (frame.camera, replace(frame.view(trained=False), name="no such frame", time=0.5)),
        "another size": (_resized(frame.camera), frame.view(trained=True)),
        "a free camera": (_resized(frame.camera), None),
    }
    for what, (camera, view) in views.items():
        wrong = _wrong(_render(model, camera, view), model, camera, depths)
        if wrong:
            raise CheckFailedError(f"{what} of {camera.width} x {camera.height} pixels: {wrong}")
    return f"{', '.join(sorted(model.outputs))} at {len(views)} views"


def _resized(camera: Camera) -> Camera:
    """The camera with fewer pixels, an odd number of them, over the same field of view."""
    return camera.resized(*(max(1, int(0.35 * side)) * 2 + 1 for side in (camera.width, camera.height)))


@torch.no_grad()
def _render(model: Model, camera: Camera, view: View | None) -> RenderOutput:
    return model.render(camera, sorted(model.outputs), view)


def maps(output: RenderOutput) -> dict[str, Tensor]:
    """All outputs by name."""
    return {"rgb": output.rgb, "alpha": output.alpha, **output.maps}


def _wrong(output: RenderOutput, model: Model, camera: Camera, depths: tuple[float, float] | None) -> str:
    """The first thing wrong with an output; empty without."""
    there = maps(output)
    for name in sorted(model.outputs):
        if name not in there:
            return f"{name} is promised by `outputs` and not delivered"
        shape = _shape(name, camera)
        found = there[name].shape
        if (found[:2] if shape is None else found) != (shape or (camera.height, camera.width)):
            return f"{name} has shape {list(found)}, not {list(shape or (camera.height, camera.width, 'C'))}"
        spoilt = int((~torch.isfinite(there[name])).sum())
        if spoilt:
            return f"{name} has {spoilt} numbers that are not finite"
    alpha = there["alpha"]
    if alpha.min() < -_ROUNDING or alpha.max() > 1.0 + _ROUNDING:
        return f"alpha is between {float(alpha.min()):.4g} and {float(alpha.max()):.4g}, not within [0, 1]"
    for name in sorted(model.outputs & set(DEPTH_KINDS)):
        depth = there[name][alpha > _OPAQUE]
        z = 1.0 / depth if name.startswith("inverse") else depth
        if depths is None or not len(z):
            continue
        # Surfels seen edge-on may be far beyond at single pixels (docs/rivals/2dgs.md).
        low, high = torch.quantile(z, z.new_tensor([0.01, 0.99])).tolist()
        if not (low >= depths[0] / _MARGIN and high <= depths[1] * _MARGIN):
            return (
                f"z of {name} is between {low:.4g} and {high:.4g} at 98 % of the pixels with alpha > {_OPAQUE}, and "
                f"the scene lies between z = {depths[0]:.4g} and {depths[1]:.4g}"
            )
    return ""


def _shape(name: str, camera: Camera) -> tuple[int, ...] | None:
    """Shape of an output; None for a field's own channels, however many."""
    if name in ("rgb", "normals"):
        return (camera.height, camera.width, 3)
    return (camera.height, camera.width) if name == "alpha" or name in DEPTH_KINDS else None


def renders_again(context: CheckContext) -> str:
    """Rendering a view twice gives the same bits, with another view in between."""
    model, frame = context.trainer.model, context.scene.train[0]
    view = frame.view(trained=True)
    first = maps(_render(model, frame.camera, view))
    _render(model, _resized(frame.camera), None)
    apart = difference(first, maps(_render(model, frame.camera, view)))
    if apart:
        raise CheckFailedError(f"two renderings of frame {frame.name}: {apart}")
    with _other_threads() as threads:
        apart = difference(first, maps(_render(model, frame.camera, view)))
    return f"same bits; on {threads} threads {apart or 'too'}"


@contextmanager
def _other_threads() -> Iterator[str]:
    """Another number of torch's threads than there are."""
    before = torch.get_num_threads()
    other = 2 if before == 1 else 1
    torch.set_num_threads(other)
    try:
        yield f"{other} instead of {before}"
    finally:
        torch.set_num_threads(before)


def refuses_requests(context: CheckContext) -> str:
    """An output that does not exist is refused, and so are single pixels by a renderer of whole images."""
    model, camera = context.trainer.model, context.scene.train[0].camera
    refused = {f"output '{NO_OUTPUT}'": {"wants": ("rgb", NO_OUTPUT)}}
    if not model.renderer.renders_pixels:
        refused["single pixels"] = {"pixels": torch.tensor([[1, 2], [0, 0]])}  # type: ignore[dict-item]
    for what, request in refused.items():
        try:
            with torch.no_grad():
                model.render(camera, **request)  # type: ignore[arg-type]
        except InputError:
            continue
        except Exception as error:
            raise CheckFailedError(f"{what}: {type(error).__name__} instead of InputError: {error}") from error
        raise CheckFailedError(f"{what}: not refused by {type(model.renderer).__name__}")
    return f"{', '.join(refused)}: refused"


def renders_pixels(context: CheckContext) -> str:
    """Single pixels are those of the whole image."""
    model, frame = context.trainer.model, context.scene.train[0]
    if not model.renderer.renders_pixels:
        raise CheckSkippedError(f"{type(model.renderer).__name__} renders whole images")
    if any(module.whole_image for module in model.view_modules.values()):
        raise CheckSkippedError("a view module needs whole images")
    camera, view = _resized(frame.camera), frame.view(trained=True)
    index = torch.arange(0, camera.width * camera.height, 7)
    pixels = torch.stack([index % camera.width, index // camera.width], dim=1)
    with torch.no_grad():
        some = maps(model.render(camera, sorted(model.outputs), view, pixels))
    whole = maps(_render(model, camera, view))
    for name, values in whole.items():
        expected = values[pixels[:, 1], pixels[:, 0]]
        found = some[name][:, 0]
        if found.shape != expected.shape or not torch.allclose(found, expected, rtol=1e-3, atol=1e-4):
            raise CheckFailedError(f"{name} of single pixels is not that of the whole image")
    return f"{len(pixels)} pixels as in the whole image"


def same_views(first: Model, second: Model, frames: list[Frame]) -> str:
    """What differs between the renderings of two models; empty where nothing does."""
    for frame in frames:
        for view in (frame.view(trained=True), frame.view(trained=False)):
            ours, theirs = (maps(_render(model, frame.camera, view)) for model in (first, second))
            apart = difference(ours, theirs)
            if apart:
                return f"frame {frame.name}: {apart}"
    return ""


def evaluates(context: CheckContext) -> str:
    """The method's protocol yields finite metrics, or reasons for those that cannot be had."""
    trained = _few_frames(context)
    file = evaluate(trained, trained.config.protocol) / "metrics.json"
    summary = json.loads(file.read_text(encoding="utf-8"))
    names = [name for name in summary["directions"] if name in summary]
    unexplained = [
        name
        for name in names
        if not (summary["reasons"].get(name) if summary[name] is None else math.isfinite(summary[name]))
    ]
    if unexplained:
        raise CheckFailedError(f"metrics without value or reason: {', '.join(unexplained)}")
    values = [f"{name} {summary[name]:.4g}" for name in names if summary[name] is not None]
    if not values:
        raise CheckFailedError(f"no metric has a value: {next(iter(summary['reasons'].values()))}")
    return f"{trained.config.protocol}: {', '.join(values[:4])}"


def writes_images(context: CheckContext) -> str:
    """``coliags render`` writes an image of every kind for every frame."""
    trained = _few_frames(context)
    name, frames = next(iter(trained.scene.test_sets.items()))
    folder = context.folder / "renders"
    render_run(trained, folder, name, video=False, fps=15.0, overwrite=True)
    kinds = {"rgb", "depth", "rgb_error"} | ({"depth_error"} if frames[0].depth is not None else set())
    wanted = [folder / kind / f"{frame.name}.png" for kind in sorted(kinds) for frame in frames]
    missing = [path for path in wanted if not path.is_file() or not path.stat().st_size]
    if missing:
        raise CheckFailedError(f"no image {missing[0].relative_to(folder)}")
    return f"{len(wanted)} images"


def _few_frames(context: CheckContext) -> TrainedRun:
    """The run with only a few test frames."""
    scene = context.trained.scene
    sets = {name: frames[:_TEST_FRAMES] for name, frames in scene.test_sets.items() if frames}
    if not sets:
        raise CheckSkippedError("the scene holds out no test frames")
    return replace(context.trained, scene=replace(scene, test_sets=sets))
