"""The contract of a method: what must hold of its config, model, training, rendering and files, check by check."""

from __future__ import annotations

import io
import json
import math
import shutil
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from pydantic_core import PydanticCustomError
from torch import Tensor

from coliags_plugin.checks.method.context import (
    CPU,
    CheckContext,
    MethodCheck,
    components,
    difference,
    refuse,
    write_phantom,
)
from coliags_plugin.checks.results import CheckFailedError, CheckResult, CheckSkippedError, Status
from coliags_plugin.config.components import make_component
from coliags_plugin.config.method_config import load_method, method_tree
from coliags_plugin.config.options import RenderOptions
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, InterruptedRunError
from coliags_plugin.core.render_output import DEPTH_KINDS, RenderOutput
from coliags_plugin.core.scenes import Frame, PointCloud, Scene, View
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import masked_mean
from coliags_plugin.engine.checkpoints import restore_model
from coliags_plugin.engine.data_formats import load_scene
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.rendering import render_run
from coliags_plugin.engine.trained import TrainedRun, load_trained
from coliags_plugin.engine.trainer import Trainer

#: An option, and an output, that nothing has.
_NO_OPTION, _NO_OUTPUT = "no_such_option", "no_such_output"
#: Training frames whose error is measured, and pixels of each where the method trains on pixels.
_FRAMES, _PIXELS = 8, 256
#: Frames of each test set that are evaluated and rendered.
_TEST_FRAMES = 2
#: Alpha from which a pixel has a depth.
_OPAQUE = 0.95
#: Depth may leave the range of the scene by this factor: a model is not good yet after a few steps.
_MARGIN = 10.0
_ROUNDING = 1e-4
#: Steps on other data.
_STEPS = 2

#: Fewer leave nothing to stop half-way, nor between events of a strategy.
MIN_STEPS = 10

#: All checks, in their order.
CHECKS: list[MethodCheck] = []


def _check(name: str, *needs: str) -> Callable[[Callable[[CheckContext], str]], Callable[[CheckContext], str]]:
    """Put a function into the list, under a name and with the checks that it needs."""

    def listed(run: Callable[[CheckContext], str]) -> Callable[[CheckContext], str]:
        CHECKS.append(MethodCheck(name, run, needs))
        return run

    return listed


# Config and model


@_check("resolves")
def resolves(context: CheckContext) -> str:
    """The config is valid, and written to YAML and read again it is itself."""
    context.loaded = context.load()
    config, path = context.loaded.config, context.folder / "resolved.yaml"
    path.write_text(config.to_yaml(), encoding="utf-8")
    again = load_method(str(path.resolve())).config
    changed = [name for name in type(config).model_fields if getattr(again, name) != getattr(config, name)]
    if changed or again.to_yaml() != config.to_yaml():
        raise CheckFailedError(f"written to YAML and read again, it has another {', '.join(changed) or 'text'}")
    names = [node.name for node in components(config).values()]
    return f"{len(names)} components: {', '.join(dict.fromkeys(names))}"


@_check("options", "resolves")
def refuses_options(context: CheckContext) -> str:
    """Every component refuses an option that it does not have, by name."""
    there = components(context.loaded.config)
    for path, component in there.items():
        options = {"name": component.name, **component.settings.model_dump(), _NO_OPTION: 1}
        try:
            make_component(component.kind, options)
        except (ValidationError, PydanticCustomError) as error:
            if _NO_OPTION in str(error):
                continue
            raise CheckFailedError(f"{path}.{_NO_OPTION}=1 is refused without being named: {error}") from error
        raise CheckFailedError(
            f"{path}.{_NO_OPTION}=1 is accepted: let the Settings of '{component.name}' be a subclass of "
            "coliags_plugin.core.settings.Settings"
        )
    return f"unknown options of {len(there)} components are refused"


@_check("builds", "resolves")
def builds(context: CheckContext) -> str:
    """The components fit one another and the scene."""
    context.scene = load_scene(context.loaded.config, context.data)
    trainer = context.build("built")
    if trainer.run.path.exists():
        raise CheckFailedError("the run folder was written before training began")
    numbers = sum(parameter.numel() for parameter in trainer.model.parameters())
    frames = f"{len(context.scene.train)} training frames, {len(context.scene.points)} initial points"
    return f"{numbers} parameters, renderer {trainer.chosen.name}; {frames}"


@_check("groups", "builds")
def has_all_groups(context: CheckContext) -> str:
    """Every trainable parameter is in exactly one parameter group, which an optimizer trains."""
    model = context.build("groups").model
    groups, named = model.parameter_groups(), dict(model.named_parameters())
    counts = Counter(id(parameter) for group in groups.values() for parameter in group)
    strangers = counts.keys() - set(map(id, named.values()))
    ungrouped = [name for name, value in named.items() if value.requires_grad and not counts[id(value)]]
    foreign = [name for name, group in groups.items() if strangers.intersection(map(id, group))]
    refuse("in no parameter group, so never trained", ungrouped)
    refuse("in more than one parameter group", [name for name, value in named.items() if counts[id(value)] > 1])
    refuse("empty parameter groups", [name for name, group in groups.items() if not group])
    refuse("parameter groups that hold a parameter that is no attribute of the model", foreign)
    return ", ".join(groups)


# Training


@_check("trains", "builds")
def trains(context: CheckContext) -> str:
    """A whole run ends, all its losses and parameters being finite."""
    context.trainer = trainer = context.build("run")
    trainer.start()
    trainer.train()
    context.rows = trainer.run.log_rows()
    spoilt = [name for name, value in trainer.model.named_parameters() if not torch.isfinite(value).all()]
    refuse(f"after {context.steps} steps these are not finite", spoilt)
    rate = context.steps / max(trainer.seconds, 1e-6)
    return f"{context.steps} steps, {rate:.0f} a second, loss {context.rows[-1]['loss']:.4g} at the last"


def _first_steps(context: CheckContext) -> dict[str, int | None]:
    """The first step of the run that counted each loss term; None where none did."""
    steps = {key: [row["step"] for row in context.rows if key in row["terms"]] for key in context.trainer.losses}
    return {key: min(found, default=None) for key, found in steps.items()}


@_check("terms", "trains")
def every_term_counts(context: CheckContext) -> str:
    """Every loss term is active at some step of the run."""
    first, losses = _first_steps(context), context.trainer.losses
    written_for = context.loaded.config.schedule.written_for
    idle = [
        f"'{key}' (after step {losses[key].settings.from_step} of {written_for}); see from_step, or check more `steps`"
        for key, step in first.items()
        if step is None
    ]
    refuse(f"never active in {context.steps} steps", idle)
    return ", ".join(key if step == 1 else f"{key} from step {step}" for key, step in first.items())


@_check("learns", "trains")
def error_falls(context: CheckContext) -> str:
    """Training brings the rendered training images closer to the recorded ones."""
    before = _error(context.build("before"))
    after = _error(context.trainer)
    change = f"mean colour error {before:.4f} before and {after:.4f} after {context.steps} steps"
    if not (math.isfinite(before) and after < before):
        raise CheckFailedError(f"{change}: it should fall")
    return change


@torch.no_grad()
def _error(trainer: Trainer) -> float:
    """Mean absolute colour error over some training frames, as the sampler would render them."""
    errors = []
    for frame in trainer.scene.train[:: max(1, len(trainer.scene.train) // _FRAMES)][:_FRAMES]:
        pixels, target = None, frame.target
        if not trainer.sampler.whole_images:
            pixels = _some_pixels(frame.camera, max(1, frame.camera.width * frame.camera.height // _PIXELS))
            target = frame.target_at(pixels)
        rgb = trainer.model.render(frame.camera, view=frame.view(trained=True), pixels=pixels).rgb
        errors.append(float(masked_mean((rgb - target.rgb).abs(), target.mask)))
    return sum(errors) / len(errors)


def _some_pixels(camera: Camera, every: int) -> Tensor:
    index = torch.arange(0, camera.width * camera.height, every)
    return torch.stack([index % camera.width, index // camera.width], dim=1)


@_check("gradients", "trains")
def gradients_arrive(context: CheckContext) -> str:
    """Every parameter group that is to be trained gets a gradient at some step."""
    adams, groups = context.trainer.optimizers.adam, context.trainer.model.parameter_groups()
    rates = context.loaded.config.optimizers
    without = [name for name, adam in adams.items() if not any(map(_moved, adam.state.values()))]
    frozen = [name for name in without if rates[name].lr == 0.0 or not any(each.requires_grad for each in groups[name])]
    idle = [name for name in without if name not in frozen]
    if idle and None not in _first_steps(context).values():
        raise CheckFailedError(
            f"no gradient but 0 in {context.steps} steps: {', '.join(idle)}; nothing that the losses see depends on "
            "it, or its part is detached or begins later (then check more `steps`)"
        )
    remarks = [f"{', '.join(names)} {what}" for names, what in ((frozen, "frozen"), (idle, "not yet active")) if names]
    return "; ".join([f"{len(adams) - len(without)} of {len(adams)} groups", *remarks])


def _moved(state: dict[str, Any]) -> bool:
    """Whether Adam has seen a gradient other than 0."""
    return "exp_avg_sq" in state and bool(state["exp_avg_sq"].any())


# Rendering


@_check("renders", "trains")
def renders_every_output(context: CheckContext) -> str:
    """Every output has its shape and finite values in range, for views of the video, another size and a free camera."""
    model, frame = context.trainer.model, context.scene.train[0]
    depths = _depth_range(context.scene)
    views: dict[str, tuple[Camera, View | None]] = {
        "a training view": (frame.camera, frame.view(trained=True)),
        "an untrained view": (frame.camera, replace(frame.view(trained=False), name="no such frame", time=0.5)),
        "another size": (_resized(frame.camera), frame.view(trained=True)),
        "a free camera": (_resized(frame.camera), None),
    }
    for what, (camera, view) in views.items():
        wrong = _wrong(_maps(model, camera, view), model, camera, depths)
        if wrong:
            raise CheckFailedError(f"{what} of {camera.width} x {camera.height} pixels: {wrong}")
    return f"{', '.join(sorted(model.outputs))} at {len(views)} views"


def _depth_range(scene: Scene) -> tuple[float, float] | None:
    """Smallest and largest z-depth known in a few training frames, else of the initial points; None without any."""
    known = [frame.depth[frame.depth.isfinite()] for frame in scene.train[:4] if frame.depth is not None]
    z = torch.cat(known) if known else scene.depths_in_view()
    return (float(z.min()), float(z.max())) if len(z) else None


def _resized(camera: Camera) -> Camera:
    """The camera with fewer pixels, an odd number of them, over the same field of view."""
    return camera.resized(*(max(1, int(0.35 * side)) * 2 + 1 for side in (camera.width, camera.height)))


@torch.no_grad()
def _maps(model: Model, camera: Camera, view: View | None, pixels: Tensor | None = None) -> dict[str, Tensor]:
    """All outputs of a view by name."""
    output: RenderOutput = model.render(camera, sorted(model.outputs), view, pixels)
    return {"rgb": output.rgb, "alpha": output.alpha, **output.maps}


def _wrong(there: dict[str, Tensor], model: Model, camera: Camera, depths: tuple[float, float] | None) -> str:
    """The first thing wrong with the outputs of a view; empty without."""
    size = (camera.height, camera.width)
    channels: dict[str, tuple[int, ...]] = {"rgb": (3,), "normals": (3,), **dict.fromkeys(("alpha", *DEPTH_KINDS), ())}
    for name in sorted(model.outputs):
        if name not in there:
            return f"{name} is promised by `outputs` and not delivered"
        found, wanted = tuple(there[name].shape), (*size, *channels.get(name, ("C",)))  # a field's own: however many
        if found[:2] != size or (name in channels and found != wanted):
            return f"{name} has shape {list(found)}, not [{', '.join(map(str, wanted))}]"
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


@_check("renders again", "renders")
def renders_again(context: CheckContext) -> str:
    """Rendering a view twice gives the same bits, with another view in between."""
    model, frame = context.trainer.model, context.scene.train[0]
    view = frame.view(trained=True)
    first = _maps(model, frame.camera, view)
    _maps(model, _resized(frame.camera), None)
    refuse(f"two renderings of frame {frame.name}", difference(first, _maps(model, frame.camera, view)))
    threads = torch.get_num_threads()
    other = 2 if threads == 1 else 1
    torch.set_num_threads(other)
    try:
        apart = difference(first, _maps(model, frame.camera, view))
    finally:
        torch.set_num_threads(threads)
    return f"same bits; on {other} instead of {threads} threads {apart or 'too'}"


@_check("pixels", "renders again")
def renders_pixels(context: CheckContext) -> str:
    """Single pixels are those of the whole image."""
    model, frame = context.trainer.model, context.scene.train[0]
    if not model.renderer.renders_pixels:
        raise CheckSkippedError(f"{type(model.renderer).__name__} renders whole images")
    if any(module.whole_image for module in model.view_modules.values()):
        raise CheckSkippedError("a view module needs whole images")
    camera, view = _resized(frame.camera), frame.view(trained=True)
    pixels = _some_pixels(camera, 7)
    some = _maps(model, camera, view, pixels)
    for name, values in _maps(model, camera, view).items():
        expected, found = values[pixels[:, 1], pixels[:, 0]], some[name][:, 0]
        if found.shape != expected.shape or not torch.allclose(found, expected, rtol=1e-3, atol=1e-4):
            raise CheckFailedError(f"{name} of single pixels is not that of the whole image")
    return f"{len(pixels)} pixels as in the whole image"


@_check("requests", "renders")
def refuses_requests(context: CheckContext) -> str:
    """An output that does not exist is refused, and so are single pixels by a renderer of whole images."""
    model, camera = context.trainer.model, context.scene.train[0].camera
    refused: dict[str, dict[str, Any]] = {f"output '{_NO_OUTPUT}'": {"wants": ("rgb", _NO_OUTPUT)}}
    if not model.renderer.renders_pixels:
        refused["single pixels"] = {"pixels": torch.tensor([[1, 2], [0, 0]])}
    for what, request in refused.items():
        try:
            with torch.no_grad():
                model.render(camera, **request)
        except InputError:
            continue
        except Exception as error:
            raise CheckFailedError(f"{what}: {type(error).__name__} instead of InputError: {error}") from error
        raise CheckFailedError(f"{what}: not refused by {type(model.renderer).__name__}")
    return f"{', '.join(refused)}: refused"


# Checkpoints


@_check("loads", "renders again")
def loads(context: CheckContext) -> str:
    """The run read back from its folder renders the same bits."""
    context.trained = load_trained(context.trainer.run.path, CPU, context.data)
    models, frames = (context.trainer.model.eval(), context.trained.model), context.scene.train[:2]
    for frame in frames:
        for view in (frame.view(trained=True), frame.view(trained=False)):
            refuse(
                f"the run read back renders otherwise: frame {frame.name}",
                difference(*(_maps(model, frame.camera, view) for model in models)),
                "what changes in training must be a parameter or a buffer, and from_state must restore it",
            )
    return f"{len(frames)} frames render the same bits"


@_check("repeats", "renders again")
def repeats(context: CheckContext) -> str:
    """A second run with the same seed has the same bits half-way."""
    second = context.build("halves")
    second.start()
    while second.step < context.half:
        second.take_step()
    second.save()
    context.compare(context.trainer, second, context.half, f"two runs of {context.half} steps from one seed")
    return f"{context.half} steps to the same bits"


@_check("resumes", "loads", "repeats")
def resumes(context: CheckContext) -> str:
    """Stopped half-way and resumed, a run ends in the bits of one that was not."""
    resumed = context.build("halves")
    resumed.resume()
    resumed.train()
    said = f"{context.half} steps, resumed for {context.steps - context.half}"
    context.compare(context.trainer, resumed, context.steps, said)
    return f"{context.half} + {context.steps - context.half} steps end in the bits of {context.steps}"


@_check("checkpoints", "trains")
def refuses_checkpoints(context: CheckContext) -> str:
    """A run of another method is refused, and a checkpoint that lacks a parameter."""
    stranger = context.build("run", method=replace(context.loaded, name=f"not-{context.loaded.name}"))
    try:
        stranger.resume()
    except InputError:
        pass
    else:
        raise CheckFailedError("a run of another method was resumed")
    saved = context.saved(context.trainer, context.steps)
    names = [name for name, _ in context.trainer.model.field.named_parameters()]
    for name in names:
        rest = {key: value for key, value in saved.tensors.items() if key != f"field/{name}"}
        try:
            restore_model(
                replace(saved, tensors=rest), context.loaded.config, context.scene, context.trainer.chosen.renderer
            )
        except InputError:
            continue
        except Exception as error:
            raise CheckFailedError(
                f"from_state without '{name}': {type(error).__name__} instead of KeyError or RuntimeError: {error}"
            ) from error
        raise CheckFailedError(f"a checkpoint without the field's '{name}' was read")
    return f"another method's, and without any of {len(names)} parameters: refused"


@_check("rows", "resumes")
def keeps_rows_together(context: CheckContext) -> str:
    """Rows change together at every event, and a run resumed right after one ends in the same bits."""
    node = context.loaded.config.strategy
    if node.target.serves is None:
        raise CheckSkippedError(f"strategy '{node.name}' changes no rows")
    method = context.load(_spread_out(node.settings, context.steps, context.loaded.config.schedule.written_for))
    copy, changed_at = context.folder / "events-resumed", 0
    trainer = context.build("events", method=method)
    trainer.start()
    counts = [trainer.model.field.element_count]
    if not counts[0]:
        raise CheckFailedError(f"element_count of field '{context.loaded.config.field.name}' is 0: override it")
    # Buffers of the field's parts may be of another kind.
    of_rows = [name for name, length in _lengths(trainer)[0].items() if length == counts[0]]
    while trainer.step < trainer.steps:
        counts.append(_step_by_rows(trainer, of_rows))
        if not changed_at and counts[-1] != counts[0]:
            changed_at = trainer.step
            trainer.save()
            shutil.copytree(trainer.run.path, copy, dirs_exist_ok=True)
    if not changed_at:
        raise CheckSkippedError(f"no row came or went in {trainer.steps} steps ({trainer.strategy.plan()})")
    trainer.save()
    resumed = context.build(copy.name, method=method)
    resumed.resume()
    resumed.train()
    context.compare(trainer, resumed, trainer.steps, f"resumed after the event of step {changed_at}")
    events = sum(a != b for a, b in pairwise(counts))
    return f"{counts[0]} to {counts[-1]} rows in {events} events; resumed after step {changed_at} to the same bits"


def _spread_out(settings: Settings, steps: int, written_for: int) -> list[str]:
    """Overrides with which a strategy has a few events in ``steps``, between which training goes on.

    Intervals, in steps of a run of ``written_for``, are the whole numbers among its options that are called ``every``
    or ``..._every``.
    """
    names = [name for name in type(settings).model_fields if name == "every" or name.endswith("_every")]
    given = {name: getattr(settings, name) for name in names if isinstance(getattr(settings, name), int)}
    shortest, short = min(given.values(), default=0), max(1, written_for // 5)
    return [f"strategy.{name}={short if every == shortest else 2 * short}" for name, every in given.items()]


def _lengths(trainer: Trainer) -> tuple[dict[str, int], dict[str, int]]:
    """Lengths of the field's groups of one parameter and its own buffers, and of the strategy's counters."""
    field = trainer.model.field
    groups = {name: group[0] for name, group in field.parameter_groups().items() if len(group) == 1}
    parts: dict[str, Tensor] = {f"parameter group '{name}'": value for name, value in groups.items()}
    parts |= {f"buffer '{name}'": value for name, value in field.named_buffers(recurse=False)}
    counters = trainer.strategy.state_dict()
    return tuple(  # type: ignore[return-value]
        {name: len(value) for name, value in each.items() if value.ndim} for each in (parts, counters)
    )


def _step_by_rows(trainer: Trainer, of_rows: Sequence[str]) -> int:
    """Take one more step, and compare lengths: of the parts that have a row for each of the field's, and of counters.

    Returns the number of rows.
    """
    before, counters_before = trainer.model.field.element_count, _lengths(trainer)[1]
    step = trainer.take_step()["step"]
    rows = trainer.model.field.element_count
    said = f"step {step}, {before} to {rows} rows: "
    for group, parameters in trainer.model.parameter_groups().items():
        if list(map(id, trainer.optimizers.adam[group].param_groups[0]["params"])) != list(map(id, parameters)):
            raise CheckFailedError(
                f"{said}the optimizer of group '{group}' trains what is no longer the field's; change rows by "
                "ParameterRows alone"
            )
    try:
        trainer.optimizers.check_moments()
    except ValueError as error:
        raise CheckFailedError(f"{said}{error}; change rows by ParameterRows alone") from error
    lengths, counters = _lengths(trainer)
    for name in of_rows:
        if lengths[name] != rows:
            raise CheckFailedError(f"{said}{name} has {lengths[name]}")
    for name, length in counters.items():
        per_row, rest = divmod(counters_before.get(name, 0), before)
        if per_row and not rest and length not in (0, per_row * rows):
            raise CheckFailedError(f"{said}counter '{name}' of the strategy has {length}")
    return rows


# Evaluation and images


@_check("evaluates", "loads")
def evaluates(context: CheckContext) -> str:
    """The method's protocol yields finite metrics, or reasons for those that cannot be had."""
    trained = _few_frames(context)
    file = evaluate(trained, trained.config.protocol) / "metrics.json"
    summary = json.loads(file.read_text(encoding="utf-8"))
    metrics = {name: summary[name] for name in summary["directions"] if name in summary}
    unexplained = [
        name
        for name, value in metrics.items()
        if not (summary["reasons"].get(name) if value is None else math.isfinite(value))
    ]
    refuse("metrics without value or reason", unexplained)
    values = [f"{name} {value:.4g}" for name, value in metrics.items() if value is not None]
    if not values:
        raise CheckFailedError(f"no metric has a value: {next(iter(summary['reasons'].values()))}")
    return f"{trained.config.protocol}: {', '.join(values[:4])}"


@_check("images", "loads")
def writes_images(context: CheckContext) -> str:
    """``coliags render`` writes an image of every kind for every frame."""
    trained = _few_frames(context)
    name, frames = next(iter(trained.scene.test_sets.items()))
    folder = context.folder / "renders"
    render_run(trained, RenderOptions(folder, name, video=False, overwrite=True))
    kinds = {"rgb", "depth", "rgb_error"} | ({"depth_error"} if frames[0].depth is not None else set())
    wanted = [folder / kind / f"{frame.name}.png" for kind in sorted(kinds) for frame in frames]
    missing = [path for path in wanted if not path.is_file() or not path.stat().st_size]
    refuse("no image", [str(path.relative_to(folder)) for path in missing])
    return f"{len(wanted)} images"


def _few_frames(context: CheckContext) -> TrainedRun:
    """The run with only a few test frames."""
    scene = context.trained.scene
    sets = {name: frames[:_TEST_FRAMES] for name, frames in scene.test_sets.items() if frames}
    if not sets:
        raise CheckSkippedError("the scene holds out no test frames")
    return replace(context.trained, scene=replace(scene, test_sets=sets))


# Scenes that lack something, and pixels that are to be ignored

_VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "without depth": lambda scene: replace(scene, train=[_without_depth(frame.to("cpu")) for frame in scene.train]),
    "without points": lambda scene: replace(scene, points=PointCloud(torch.zeros(0, 3))),
    "with one frame": lambda scene: replace(scene, train=scene.train[:1]),
}


def _without_depth(frame: Frame) -> Frame:
    return replace(frame, depth=None, depth_at_least=None, sparse_depth=None, depth_confidence=None)


@_check("other data", "trains")
def copes_with_other_data(context: CheckContext) -> str:
    """A scene without depth, without points or with one training frame is trained on, or refused beforehand."""
    outcomes = {}
    for what, change in _VARIANTS.items():
        begun = False
        try:
            trainer = context.build("elsewhere", change(context.scene))
            begun = True
            _take_steps(trainer)
            outcomes[what] = "trains"
        except InputError as error:
            if begun:
                raise CheckFailedError(f"{what}: refused only when training had begun: {error}") from error
            outcomes[what] = "refused"
        except Exception as error:
            raise CheckFailedError(
                f"{what}: {context.describe(error)}; expected training, or an InputError beforehand"
            ) from error
    return ", ".join(f"{what} {outcome}" for what, outcome in outcomes.items())


@_check("ignored pixels", "repeats")
def ignores_masked_pixels(context: CheckContext) -> str:
    """What is in masked pixels, NaN included, changes no loss and no parameter."""
    runs: list[tuple[list[dict[str, Any]], dict[str, Tensor]]] = []
    for spoilt in (False, True):
        frames = [_masked(frame.to("cpu"), spoilt) for frame in context.scene.train]
        trainer = context.build("masked", replace(context.scene, train=frames))
        runs.append((_take_steps(trainer), trainer.model.state_dict()))
    (rows, first), (spoilt_rows, second) = runs
    for ours, theirs in zip(rows, spoilt_rows, strict=True):
        wrong = [key for key, value in ours["terms"].items() if theirs["terms"][key] != value]
        refuse("loss terms that depend on masked pixels", wrong, "see coliags_plugin.core.tensors")
    refuse("masked pixels change the model", difference(first, second), "see coliags_plugin.core.tensors")
    return "masked pixels change nothing"


def _masked(frame: Frame, spoilt: bool) -> Frame:
    """The frame with a part of its image masked out; ``spoilt``: there of other colours, and depth that is NaN."""
    height, width = frame.image.shape[:2]
    ignored = torch.zeros(height, width, dtype=torch.bool)
    ignored[height // 4 : height // 2, width // 4 : width // 2] = True
    masked = replace(frame, mask=frame.valid & ~ignored)
    if not spoilt:
        return masked
    depth = None if frame.depth is None else frame.depth.masked_fill(ignored, torch.nan)
    return replace(masked, image=torch.where(ignored[..., None], 255 - frame.image, frame.image), depth=depth)


def _take_steps(trainer: Trainer) -> list[dict[str, Any]]:
    return [trainer.take_step() for _ in range(min(_STEPS, trainer.steps))]


# Running them


def check_method(
    method: str,
    folder: Path,
    overrides: Sequence[str] = (),
    data: Path | None = None,
    data_format: str | None = None,
    steps: int = 20,
) -> Iterator[CheckResult]:
    """Check a method, yielding one result after the other.

    Without ``data``, the scene is a small phantom, made within ``folder``, which exists. Schedules are scaled to
    ``steps``.
    """
    method_tree(method, overrides)
    if steps < MIN_STEPS:
        raise InputError(f"`steps={steps}`", f"{MIN_STEPS} or more")
    if data is not None and not data.exists():
        raise InputError(f"no folder {data}", "a scene", "Check the path, or leave `data` out")
    scene = data or write_phantom(method, overrides, folder)
    context = CheckContext(method, tuple(overrides), scene, data_format, steps, folder)
    passed: set[str] = set()
    for check in CHECKS:
        result = _run(check, context, passed)
        if result.status == "passed":
            passed.add(check.name)
        yield result


def _run(check: MethodCheck, context: CheckContext, passed: set[str]) -> CheckResult:
    missing = [name for name in check.needs if name not in passed]
    if missing:
        return CheckResult(check.name, "skipped", f"needs '{missing[0]}'")
    start = time.monotonic()

    def result(status: Status, detail: str, trace: str = "") -> CheckResult:
        return CheckResult(check.name, status, detail, time.monotonic() - start, trace)

    try:
        # Progress bars are not shown; global random numbers, which :meth:`CheckContext.build` resets, go on as before.
        with redirect_stderr(io.StringIO()), torch.random.fork_rng(devices=[]):
            return result("passed", check.run(context))
    except CheckSkippedError as reason:
        return result("skipped", str(reason))
    except CheckFailedError as error:
        return result("failed", "; ".join(str(error).split("\n")), traceback.format_exc() if error.__cause__ else "")
    except InterruptedRunError as error:
        raise KeyboardInterrupt from error
    except Exception as error:
        return result("failed", context.describe(error), traceback.format_exc())
